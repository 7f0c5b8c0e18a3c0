"""The emulated camera on a port: sockets, a clock and the device between them.

Bytes of a client go ``socket -> ClientLink -> Machine -> EmulatedCamera.received ->
Device.handle``; what the device says goes ``Device.take_output -> Machine -> one write``.
Everything that happens is a *step*: bring the device's time up, do it, deliver, set one timer for
the device's next event.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast

from smartcam._server import Server
from smartcam.emulator._bvs.behaviour import behaviour_of
from smartcam.emulator._bvs.device import Device
from smartcam.emulator._client_link import SecondClientSession
from smartcam.emulator._clock import Clock, OneTimer, RealClock, nanoseconds
from smartcam.emulator._links import TcpListener, UdpListener
from smartcam.emulator._port import Port
from smartcam.emulator._scenario.merge import make_plan
from smartcam.emulator._scenario.timeline import Timeline
from smartcam.emulator._scene import TableScene
from smartcam.emulator._traffic import TrafficLog, Visit
from smartcam.emulator.faults._base import DeviceFault
from smartcam.emulator.faults._device_effects import Stage, act
from smartcam.emulator.faults._matching import FaultQueue
from smartcam.exceptions import ConfigurationError
from smartcam.protocols import messages as m
from smartcam.protocols._base import Transport
from smartcam.protocols._framed.framing import Frame
from smartcam.registry import PROTOCOLS
from smartcam.settings import Address

if TYPE_CHECKING:
    from collections import deque
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    from smartcam.emulator._application import Application
    from smartcam.emulator._bvs.quirks import Quirks
    from smartcam.emulator._client_link import ClientLink
    from smartcam.emulator._clock import TimerHandle
    from smartcam.emulator._links import Listener
    from smartcam.emulator._scenario.scenario import Scenario
    from smartcam.emulator._scenario.states import DeviceState
    from smartcam.emulator._scenario.timeline import Cue
    from smartcam.emulator._traffic import Log
    from smartcam.emulator.faults import Fault, FiredFault
    from smartcam.emulator.faults._base import BaseFault
    from smartcam.emulator.faults._matching import Row
    from smartcam.emulator.faults._wire_effects import WireMessage
    from smartcam.exceptions import RemoteProtocolError
    from smartcam.protocols._base import Protocol
    from smartcam.protocols._framed.dialect import FramedDialect

_log = logging.getLogger("smartcam.emulator")

_LISTENERS: dict[Transport, type[TcpListener | UdpListener]] = {
    Transport.TCP: TcpListener,
    Transport.UDP: UdpListener,
}


@dataclass(slots=True, eq=False)
class _Bracket:
    """A context that begins and ends something; inside itself it does nothing."""

    _begin: Callable[[], None]  # called on the way in; where it raises there is no step
    _end: Callable[[], None]  # called on the way out, after an error too
    _depth: int = 0

    def __enter__(self) -> None:
        if not self._depth:
            self._depth = 1
            try:
                self._begin()
            except BaseException:
                self._depth = 0
                raise
        else:
            self._depth += 1

    def __exit__(self, *error: object) -> None:
        if self._depth > 1:
            self._depth -= 1
            return
        try:
            self._end()
        finally:
            self._depth = 0


class EmulatedCamera(Server):
    """A camera made of software, on a real port.

    ::

        async with EmulatedCamera(applications=[...]) as emulator:
            async with smartcam.connect(emulator.url) as camera:
                ...

    The applications given come beside the built-in ones (1, 3, 7, 9, 21) and replace those of the
    same id. It is stopped at first, unless ``running``.

    Args:
        applications: programs of the camera: :class:`Application` or mappings of its fields.
        scenario: a scenario or the path of its file; what is given here beside it goes before it.
        host: address to listen on; nothing but this.
        port: port to listen on, 0 for a free one; default what the scenario says, else 0.
        transport: ``"tcp"`` or ``"udp"``; default what the scenario says, else ``"tcp"``.
        dialect: name of the wire dialect: ``handbook``, ``thesis``, ``b16`` or ``bid``; default
            what the scenario says, else ``handbook``. ``bid`` is a BVS ID: it runs always, and
            answers every request with a result code.
        clock: its time; a :class:`ManualClock` in tests. Default: real time.
        quirks: what is not known of real cameras: :class:`Quirks` or a mapping of its fields.
        name: for logs.
        active: id of the application that is loaded at first; default the first given, else 1.
        running: in run mode from the beginning.
        seed: of all that is left to chance, the scene's noise and the timeline; default 0.
        builtins: have the built-in applications.
        faults: exact misbehaviour, in order: faults of :mod:`smartcam.emulator.faults`, or mappings
            of their fields with ``kind``. Those that wait for no message happen when it starts.
        timeline: what happens by itself, and when: cues of
            :mod:`smartcam.emulator._scenario.timeline`, or mappings of their fields.
            They come behind the scenario's.

    Attributes:
        host: as given.
        transport: as given.
        dialect: as given.
        name: as given.
        scenario: what all that was given comes to.
        clock: its clock.
        device: the camera behind the wire. Its operator's methods (``trigger()``,
            ``set_condition()``, ...) may be called at any time in the event loop's thread; what
            they cause is sent. Its time is brought up whenever something happens.
        seed: seed of all that is left to chance.

    Raises:
        ConfigurationError: something given is wrong.
    """

    def __init__(
        self,
        applications: Iterable[Application | dict[str, Any]] = (),
        *,
        scenario: Scenario | str | Path | None = None,
        host: str = "127.0.0.1",
        port: int | None = None,
        transport: Literal["tcp", "udp"] | None = None,
        dialect: str | None = None,
        clock: Clock | None = None,
        quirks: Quirks | dict[str, Any] | None = None,
        name: str | None = None,
        active: int | None = None,
        running: bool | None = None,
        seed: int | None = None,
        builtins: bool | None = None,
        faults: Iterable[BaseFault | Mapping[str, Any]] = (),
        timeline: Iterable[Cue | Mapping[str, Any]] = (),
    ) -> None:
        plan = make_plan(
            scenario,
            applications,
            timeline,
            port=port,
            transport=transport,
            dialect=dialect,
            quirks=quirks,
            name=name,
            active=active,
            running=running,
            seed=seed,
            builtins=builtins,
        )
        self.host = host
        self.transport: Literal["tcp", "udp"] = plan.transport
        self.dialect: str = plan.dialect
        self.scenario: Scenario = plan
        self.name: str = plan.name
        self.clock: Clock = clock if clock is not None else RealClock()
        self.seed: int = plan.seed
        self._protocol = cast("Protocol", PROTOCOLS.load("bvs"))
        dialect_spoken = cast("FramedDialect", self._protocol.dialects[plan.dialect])
        self.spoken: FramedDialect = dialect_spoken.with_quirks(plan.quirks.of_the_wire)
        self.device: Device = Device(
            plan.all_applications,
            active=plan.active,
            running=plan.running,
            quirks=plan.quirks,
            scene=TableScene(seed=plan.seed),
            behaviour=behaviour_of(self.spoken, plan.quirks),
        )
        self._step = _Bracket(self._begin_step, self._end_step)
        self.device.around = self.step
        kind = Transport(plan.transport)
        self._scheme = next(s for s, t in self._protocol.schemes.items() if t is kind)
        self._listener: Listener = _LISTENERS[kind](self)
        self._port = Port(self._listener, host, plan.port, self.name)
        self._traffic = TrafficLog(self.spoken)
        self.queue: FaultQueue = FaultQueue(self.spoken, self.clock, self.device.applications)
        self._stage = Stage(
            device=self.device,
            refuse=self._refuse,
            let_second_client_in=self._let_second_client_in,
            clear=self.clear_faults,
        )
        self._timeline = self._make_timeline()
        self._active: ClientLink | SecondClientSession | None = None
        self._refusal: TimerHandle | None = None
        self._refused_until = 0.0
        self._started = False
        self._down = False
        self._moved_at = 0.0
        self._timer = OneTimer(self.clock, self._wake)
        self.queue.add(faults)

    # ------------------------------------------------------------------ what it is

    @property
    def port(self) -> int:
        """The port it listens on; the one given until it is started."""
        return self._port.number

    @property
    def url(self) -> str:
        """Its address with the dialect pinned."""
        quirks = self.spoken.quirks
        return Address("bvs", self._scheme, self.host, self.port, self.dialect, quirks).url

    def __repr__(self) -> str:
        return f"<EmulatedCamera {self.name} {self.url}>"

    @property
    def scene(self) -> TableScene:
        """The table it looks at, with the ground truth."""
        return self.device.scene

    @property
    def quirks(self) -> Quirks:
        """Its quirks."""
        return self.device.quirks

    @property
    def log(self) -> Log:
        """The last frames in both directions, oldest first."""
        return self._traffic.entries

    @property
    def has_session(self) -> bool:
        """Whether a client has the session."""
        return self._active is not None

    @property
    def sessions(self) -> list[str]:
        """Address and port of the client that has the session, or nothing."""
        return [] if self._active is None else [self._active.peer]

    @property
    def links(self) -> list[str]:
        """Address and port of all clients that are connected, with a session or without."""
        return [link.peer for link in self._listener.all_links]

    @property
    def crowded_out(self) -> int:
        """Clients without a session that were sent away because too many were connected."""
        return self._listener.crowded_out

    @property
    def faults(self) -> list[Fault]:
        """The faults that still wait, in the order in which they were given."""
        return self.queue.waiting

    @property
    def commands(self) -> tuple[str, ...]:
        """The commands that the timeline knows, sorted."""
        return self.scenario.commands

    @property
    def cues_done(self) -> list[int]:
        """How often each cue of ``scenario.timeline`` has happened since the start."""
        return self._timeline.done

    @property
    def visits(self) -> deque[Visit]:
        """The last connections that have ended, oldest first; over UDP there are none."""
        return self._traffic.visits

    @property
    def fired(self) -> deque[FiredFault]:
        """The last faults that have happened, oldest first."""
        return self.queue.fired

    async def wait_received(
        self, what: int | type[m.Message], *, count: int = 1, timeout: float = 5.0
    ) -> None:
        """Wait until clients have sent ``count`` whole frames of a kind since the beginning.

        When it returns, the device has handled them. The timeout runs in real time, whatever the
        emulator's clock is.

        Args:
            what: a message id, or a message type.
            count: how many, those that came before this call included.
            timeout: seconds.

        Raises:
            ResponseTimeoutError: they did not come in time.

        Cancellation: safe.
        """
        await self._traffic.wait_received(what, count=count, timeout=timeout)

    # ------------------------------------------------------------------ life

    async def start(self) -> None:
        """Open the port; does nothing if it is started already.

        Raises:
            ConfigurationError: it cannot listen there.

        Cancellation: leaves it stopped.
        """
        if self._started:
            return
        try:
            await self._port.open()
        except (OSError, ValueError, OverflowError) as exc:
            raise ConfigurationError(
                f"emulator: cannot listen on {self.transport} {self.host}:{self.port}: {exc}"
            ) from exc
        self._started = True
        self._down = False
        self._moved_at = self.clock.now
        self._timeline = self._make_timeline()
        if self._timeline.watches:
            self.device.watch(self._entered)
        with self.step():
            self._act_at_once()
            self._timeline.start()
        _log.info("= %s: listening on %s", self.name, self.url)
        if self.scenario.is_random:
            _log.info("= %s: chance has the seed %d", self.name, self.seed)

    async def stop(self) -> None:
        """Close the port and every connection; the device stands still. Does nothing if stopped.

        Cancellation: everything is closed nevertheless.
        """
        if self._started:
            self._started = False
            self._timer.set(None)
            self._timeline.stop()
            self._end_refusal()
            if isinstance(self._active, SecondClientSession):
                self._leave_session()
            self._port.shut()
            await self._port.wait_closed()

    # ------------------------------------------------------------------ faults

    def inject(self, *faults: BaseFault | Mapping[str, Any]) -> None:
        """Add faults behind those that wait; what waits for no message happens now.

        Call it in the event loop's thread. Before the emulator is started they wait until then.

        Args:
            faults: faults of :mod:`smartcam.emulator.faults`, or mappings with ``kind``.

        Raises:
            ConfigurationError: one is wrong, or too many would wait; none was added.
        """
        with self.step():
            self._collect()  # what was said before is not changed
            self.queue.add(faults)
            if self._started:
                self._act_at_once()

    def command(self, name: str) -> None:
        """Give a command: the timeline's cues that wait for it happen.

        Call it in the event loop's thread, while the emulator is started.

        Raises:
            ConfigurationError: no cue has it.
        """
        self._timeline.command(name)

    def clear_faults(self) -> None:
        """Forget the faults that wait, and end those that last.

        BUSY falls, the port opens, the second client goes, connections that are half open or
        stalled are reset. What is delayed comes at its time, and a reboot takes its time.
        """
        self.queue.clear()
        with self.step():
            self.device.end_faults()
            self._end_refusal()
            if isinstance(self._active, SecondClientSession):
                self._leave_session()
            for link in self._listener.all_links:
                link.heal()

    def _refuse(self, seconds: float) -> None:
        """Close the port for a time; connections that are open stay."""
        self._refused_until = max(self._refused_until, self.clock.now + seconds)
        if self._refusal is not None:
            self._refusal.cancel()
        elif not self._down:
            self._port.close()
        self._refusal = self.clock.call_at(self._refused_until, self._wake_port)

    def _let_second_client_in(self) -> None:
        """Another client connects and gets the session, unless a quirk refuses newcomers."""
        if self.device.rebooting or self._refusal is not None or not self._may_take_over(None):
            return
        self._hand_session(SecondClientSession(self.spoken, self._told_second_client))

    def _make_timeline(self) -> Timeline:
        cues, seed = self.scenario.timeline, self.seed
        return Timeline(cues, clock=self.clock, seed=seed, inject=lambda do: self.inject(*do))

    def _entered(self, state: DeviceState) -> None:
        """The device has entered a state: what it said before is not changed by what follows."""
        self._collect()
        self._timeline.entered(state)

    def _act_at_once(self) -> None:
        self._act(self.queue.at_once(), None)

    def _provoke(self, waiting: list[Row], message: m.Message) -> Sequence[Fault]:
        """Let the device faults happen that come before a message; return all it brings about."""
        if not waiting:
            return ()
        faults = self.queue.by_message(waiting, message)
        self._act(faults, "before")
        return faults

    def _act(self, faults: Iterable[Fault], when: Literal["before", "after"] | None) -> None:
        """Let device faults happen; what the camera says to it wakes no other device fault."""
        for fault in faults:
            if isinstance(fault, DeviceFault) and when in {None, fault.when}:
                act(self._stage, fault)
                self._say_all(self.device.take_output(), provoke=False)

    # ------------------------------------------------------------------ steps

    def step(self) -> AbstractContextManager[None]:
        """Bring the device's time up, do the body, deliver what came of it, set the timer.

        Inside another step it is a part of that one.
        """
        return self._step

    def _begin_step(self) -> None:
        if self._started:
            self._move()

    def _end_step(self) -> None:
        if self._started:
            self._settle()

    def received(self, link: ClientLink, message: m.Message) -> None:
        """A link received a message; who has no session is heard with Connect only."""
        connects = isinstance(message, m.Connect)
        if not connects and link is not self._active:
            return
        faults = self._provoke(self.queue.device_heard, message)
        if connects and not link.closed:
            self._connect(link)
        elif link is self._active:  # a fault may have given the session to another
            self.device.handle(message)
            if isinstance(message, m.Disconnect):
                self._collect()
                self._active = None
                link.unseated()
        self._collect()
        self.device.tell_entered()
        if faults:
            self._act(faults, "after")

    def serves(self, link: ClientLink) -> bool:
        """Whether the link has the session."""
        return link is self._active

    def lost(self, link: ClientLink) -> None:
        """A link is gone; if it had the session, that is over."""
        if link is self._active:
            self._leave_session()

    def parted(self, link: ClientLink, *, by_client: bool, reset: bool) -> None:
        """A connection has ended."""
        by: Literal["client", "camera"] = "client" if by_client else "camera"
        self._traffic.visits.append(Visit(self.clock.now, link.peer, by, reset))

    def traced(self, link: ClientLink, sender: m.Sender, what: Frame | RemoteProtocolError) -> None:
        """A machine saw a frame, or bytes that make none."""
        self._traffic.add(self.clock.now, link.peer, sender, what, link.hearing)
        if _log.isEnabledFor(logging.DEBUG):
            self._show_last()
        if sender is m.Sender.CLIENT and isinstance(what, Frame):
            self._traffic.count(what)

    def passed(self, link: ClientLink, sender: m.Sender, message: WireMessage) -> None:
        """What faults made of a message has passed, or is lost."""
        faults = ", ".join(message.faults) or None
        self._note(link.peer, sender, message.what, faults, message.wire)

    def _told_second_client(self, frame: Frame) -> None:
        self._note(SecondClientSession.peer, m.Sender.CAMERA, frame, "second_client", b"")

    def _note(
        self,
        peer: str,
        sender: m.Sender,
        what: Frame | bytes,
        fault: str | None,
        wire: bytes | None,
    ) -> None:
        self._traffic.add(self.clock.now, peer, sender, what, fault, wire)
        if _log.isEnabledFor(logging.DEBUG):
            self._show_last()

    def _show_last(self) -> None:
        entry = self.log[-1]
        mark = "!" if entry.error else "<" if entry.direction == "in" else ">"
        faulty = f" ({entry.fault}; on the wire: {entry.wire})" if entry.fault else ""
        said = entry.error or entry.message or f"message {entry.message_id}: {entry.hex}"
        _log.debug("%s %s: %s%s", mark, entry.peer, said, faulty)

    def _connect(self, link: ClientLink) -> None:
        """Give the session to ``link``: the newcomer wins, unless a quirk says otherwise."""
        if not self._may_take_over(link):
            link.close("another client has the session")
            return
        self._hand_session(link)

    def _may_take_over(self, newcomer: ClientLink | None) -> bool:
        free = self._active is None or self._active is newcomer
        return free or self.transport != "tcp" or self.quirks.second_client != "refuse"

    def _hand_session(self, newcomer: ClientLink | SecondClientSession) -> None:
        old = self._active
        if old is not None and old is not newcomer:
            self._leave_session()
            old.dismiss(f"{newcomer.peer} takes the session over")
        self._active = newcomer
        self.device.handle(m.Connect())

    def _leave_session(self) -> None:
        self._active = None
        self.device.disconnect()

    def _wake(self) -> None:
        with self.step():
            pass

    def _move(self) -> None:
        now = self.clock.now
        passed, self._moved_at = now - self._moved_at, now
        self.device.tick(max(0.0, passed))

    def _collect(self) -> None:
        """Put what the device said into the active link's next write."""
        output = self.device.take_output()
        if self.queue.device_said:
            self._say_all(output, provoke=True)
        elif self._active is not None:
            say = self._active.say
            for message in output:
                say(message)

    def _say_all(self, output: list[m.Message], *, provoke: bool) -> None:
        """Say messages to the one that has the session; they may bring faults about."""
        session = self._active
        for message in output:
            faults = self._provoke(self.queue.device_said, message) if provoke else ()
            if session is not None and session is self._active and self.device.connected:
                session.say(message)
            self._act(faults, "after")

    def _settle(self) -> None:
        self.device.tell_entered()
        self._collect()
        if self._active is not None:
            self._active.flush()
        if self.device.rebooting and not self._down:
            self._go_down()
        elif self._down and not self.device.rebooting:
            self._come_up()
        delay = self.device.next_event_in()
        self._timer.set(None if delay is None else nanoseconds(self._moved_at + delay))

    # ------------------------------------------------------------------ the port

    def _go_down(self) -> None:
        """The camera restarts: every connection is lost, the port is shut."""
        _log.info("= %s: rebooting", self.name)
        self._down = True
        self._active = None
        self._port.shut()

    def _come_up(self) -> None:
        """The camera is there again."""
        _log.info("= %s: up again", self.name)
        self._down = False
        if self._refusal is None:
            self._port.reopen()

    def _end_refusal(self) -> None:
        """Open the port that a fault closed."""
        refusal, self._refusal = self._refusal, None
        self._refused_until = 0.0
        if refusal is not None:
            refusal.cancel()
            if self._started and not self._down:
                self._port.reopen()

    def _wake_port(self) -> None:
        with self.step():
            self._end_refusal()
