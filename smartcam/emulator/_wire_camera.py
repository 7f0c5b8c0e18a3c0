"""The base class of emulated cameras of every make: port, links, faults, timeline, log.

Every action is a *step*: advance the device's time, act, deliver the device's messages, and set one
timer for the device's next event.
"""

from __future__ import annotations

import logging
import warnings
from abc import abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from smartcam._arguments import (
    check_integer,
    check_kind,
    check_port,
    check_seconds,
    check_seed,
    check_text,
    wrong_argument,
)
from smartcam._server import Server
from smartcam.emulator._clock import Clock, OneTimer, RealClock
from smartcam.emulator._links import TcpListener, UdpListener
from smartcam.emulator._port import Port
from smartcam.emulator._scenario.timeline import Timeline
from smartcam.emulator._traffic import EndedConnection, TrafficLog
from smartcam.emulator.faults._base import DeviceFault
from smartcam.emulator.faults._device_effects import FaultTargets, apply_fault, supported_faults
from smartcam.emulator.faults._matching import FaultQueue
from smartcam.exceptions import ConfigurationError
from smartcam.models import Status
from smartcam.protocols import Frame, Transport
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections import deque
    from collections.abc import Callable, Container, Iterable, Mapping, Sequence
    from contextlib import AbstractContextManager
    from datetime import datetime

    from smartcam.emulator._application import Application
    from smartcam.emulator._bvs.device import LastReport
    from smartcam.emulator._client_link import CameraMachine, ClientLink, Trace
    from smartcam.emulator._clock import TimerHandle
    from smartcam.emulator._links import Listener
    from smartcam.emulator._scenario.scenario import Mistake, Scenario
    from smartcam.emulator._scenario.states import DeviceState
    from smartcam.emulator._scenario.timeline import Cue
    from smartcam.emulator._scene import TableScene
    from smartcam.emulator._traffic import Log
    from smartcam.emulator.faults import Fault, FiredFault
    from smartcam.emulator.faults._base import BaseFault
    from smartcam.emulator.faults._matching import WaitingFault
    from smartcam.emulator.faults._wire_effects import WireCodec, WireMessage
    from smartcam.exceptions import RemoteProtocolError

_log = logging.getLogger("smartcam.emulator")

_CLIENT = m.Sender.CLIENT

MAX_LINKS = 32
"""Largest number of clients that are connected. The camera serves one; others may wait to take
over. A new client is always accepted: the one that was without a session for longest is closed."""

WRITE_LIMIT = 1 << 20
"""Bytes kept for a client that does not read, or held back by faults; if there are more, its
connection ends."""

_LISTENERS: dict[Transport, type[TcpListener | UdpListener]] = {
    Transport.TCP: TcpListener,
    Transport.UDP: UdpListener,
}


@dataclass(slots=True, eq=False)
class _NestedContext:
    """A context that calls a function at its begin and its end; nested uses do nothing."""

    _begin: Callable[[], None]  # called on entering; if it raises there is no step
    _end: Callable[[], None]  # called on leaving, also after an error
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


class WireCamera(Server):
    """An emulated camera of any make on a real port; a subclass implements the messages.

    Args:
        codec: codec of the messages on the wire.
        device: the camera without the wire; faults call its operator's methods.
        host: address to listen on, without a scheme or a port.
        port: port to listen on, 0 for a free one.
        transport: ``"tcp"`` or ``"udp"``.
        dialect: name of the wire dialect.
        name: name of the camera in logs.
        clock: clock of the camera.
        seed: seed of all random numbers.
        timeline: events that happen by themselves, with their times.

    Raises:
        ConfigurationError: the camera cannot do something in the timeline.
    """

    max_links: int = MAX_LINKS
    """Largest number of clients."""
    write_limit: int = WRITE_LIMIT
    """Bytes kept for a client that does not read, or held back by faults; more end its
    connection."""
    accepted_options: ClassVar[frozenset[str]] = frozenset()
    """The options among ``scenario``, ``dialect``, ``transport``, ``seed``, ``web`` and ``replay``
    that the camera accepts."""
    device: Any
    """The camera itself, without the wire."""
    states: ClassVar[frozenset[DeviceState]] = frozenset()
    """The states that the camera can enter, for a timeline."""

    def __init__(
        self,
        *,
        codec: WireCodec,
        device: object,
        host: str,
        port: int,
        transport: Literal["tcp", "udp"],
        dialect: str,
        name: str,
        clock: Clock | None,
        seed: int,
        timeline: Sequence[Cue],
        applications: Container[int] = (),
    ) -> None:
        owner = "emulator"
        host = check_text(host, "host", owner, least=1, most=300)
        port = check_port(port, owner)
        name = check_text(name, "name", owner, most=200)
        if clock is not None:
            check_kind(clock, Clock, "clock", "a Clock", owner)
        self.host: str = host
        self.transport: Literal["tcp", "udp"] = transport
        self.dialect: str = dialect
        self.name: str = name
        self.clock: Clock = clock if clock is not None else RealClock()
        self.seed: int = check_seed(seed, owner)
        self.fault_kinds: frozenset[str] = supported_faults(device)
        self.codec: WireCodec = codec
        self._cues = timeline
        self._step = _NestedContext(self._begin_step, self._end_step)
        self._listener: Listener = _LISTENERS[Transport(transport)](self)
        self._port = Port(self._listener, host, port, name)
        self._traffic = TrafficLog(codec)
        self._step_at: float | None = None  # time of the present step
        self._logs_frames = False  # whether each frame is logged, checked once a step
        self.queue: FaultQueue = FaultQueue(codec, self.clock, applications, self.fault_kinds)
        self._fault_targets = FaultTargets(
            device=device,
            refuse=self._refuse,
            let_second_client_in=self._let_second_client_in,
            clear=self.clear_faults,
        )
        self._timeline = self._make_timeline()
        self._refusal_timer: TimerHandle | None = None
        self._refused_until = 0.0
        self._started = False
        self._is_down = False
        self._timer = OneTimer(self.clock, self._wake)

    @classmethod
    @abstractmethod
    def from_scenario(
        cls,
        plan: Scenario,
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
        transport: Literal["tcp", "udp"] | None = None,
        dialect: str | None = None,
        quirks: dict[str, Any] | None = None,
        clock: Clock | None = None,
        seed: int | None = None,
    ) -> WireCamera:
        """Return a camera of a scenario; the other arguments override it.

        Raises:
            ConfigurationError: an argument is wrong, or not supported by this kind of camera.
        """

    @classmethod
    @abstractmethod
    def mistake(cls, plan: Scenario) -> Mistake | None:
        """Return the path of an unsupported field in a scenario, and the reason; or None."""

    @classmethod
    def state_options(cls, active: int | None, *, running: bool) -> dict[str, Any]:
        """Return the options for a camera whose program is active, and runs, from the start.

        Empty for cameras without programs.
        """
        return {}

    # ------------------------------------------------------------------ properties

    @property
    @abstractmethod
    def url(self) -> str:
        """The camera's address."""

    @property
    @abstractmethod
    def application_ids(self) -> list[int]:
        """Ids of the camera's programs."""

    @property
    @abstractmethod
    def sessions(self) -> list[str]:
        """Address and port of the clients that have a session."""

    @property
    def has_session(self) -> bool:
        """True while a client has a session."""
        return bool(self.sessions)

    @property
    def scene(self) -> TableScene | None:
        """The table that the camera sees; None for a camera without one."""
        return None

    @property
    def table(self) -> TableScene | None:
        """The table that the camera's pages show; None without one."""
        return self.scene

    @property
    def clock_time(self) -> datetime | None:
        """Time that the camera's own clock shows; None for a camera without a clock."""
        return None

    @property
    def last_report(self) -> LastReport | None:
        """The last run's result, even if no client received it; None without one."""
        return None

    def application_of(self, message: m.ResultContainer) -> Application | None:
        """Return the application that describes a result; None without one."""
        return None

    def shown(self) -> dict[str, Any]:
        """Return the state that the camera's page shows; a subclass replaces some entries."""
        return {
            "mode": "running" if self._started else "stopped",
            "status": Status(0),
            "active_application": None,
            "conditions": {},
            "running": self._started,
            "processing": False,
            "endian": 0,
            "next_number": None,
            "queued_inputs": None,
            "run_ends": "ResultContainer",  # message by which a client learns of a run's end
            "applications": [],
            "cells": {},
            "quirks": {},
            "quirks_chosen": {},
        }

    @property
    def port(self) -> int:
        """The port that the camera listens on; the given one until it is started."""
        return self._port.number

    @property
    def log(self) -> Log:
        """The last frames in both directions, oldest first."""
        return self._traffic.entries

    @property
    def links(self) -> list[str]:
        """Address and port of all clients that are connected, with a session or without."""
        return [link.peer for link in self._listener.all_links]

    @property
    def crowded_out(self) -> int:
        """Clients without a session that were closed because too many were connected."""
        return self._listener.places.crowded_out

    @property
    def faults(self) -> list[Fault]:
        """The faults that still wait, in the order in which they were given."""
        return self.queue.waiting

    @property
    def commands(self) -> tuple[str, ...]:
        """The commands that the timeline knows, sorted."""
        return tuple(sorted({cue.command for cue in self._cues if cue.command is not None}))

    @property
    def is_random(self) -> bool:
        """True if the timeline depends on chance."""
        return any(cue.is_random for cue in self._cues)

    @property
    def cue_counts(self) -> list[int]:
        """Number of times that each cue of the timeline has happened since the start."""
        return self._timeline.injected_counts

    @property
    def ended_connections(self) -> deque[EndedConnection]:
        """The last connections that have ended, oldest first; over UDP there are none."""
        return self._traffic.ended_connections

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
            count: number of messages, including those before this call.
            timeout: seconds.

        Raises:
            ResponseTimeoutError: the frames did not come in time.

        Cancellation: safe.
        """
        if not isinstance(what, type):
            what = check_integer(what, "what", 0, 0xFFFFFFFF, "wait_received")
        elif not issubclass(what, m.Message):
            raise wrong_argument("what", "a message's id or type", what, "wait_received")
        count = check_integer(count, "count", 0, owner="wait_received")
        timeout = check_seconds(timeout, "timeout", "wait_received")
        await self._traffic.wait_received(what, count=count, timeout=timeout)

    # ------------------------------------------------------------------ life

    async def start(self) -> None:
        """Open the port; do nothing if the camera is started already.

        Raises:
            ConfigurationError: the server cannot listen there.

        Cancellation: leaves the camera stopped.
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
        self._is_down = False
        self._timeline = self._make_timeline()
        self._after_start()
        with self.step():
            self._run_immediate_faults()
            self._timeline.start()
        _log.info("= %s: listening on %s", self.name, self.url)
        if self.is_random:
            _log.info("= %s: the random timeline has the seed %d", self.name, self.seed)

    async def stop(self) -> None:
        """Close the port and every connection; the device stands still. Do nothing if stopped.

        Cancellation: everything is closed nevertheless.
        """
        if self._started:
            self._started = False
            self._timer.set(None)
            self._timeline.stop()
            self._end_refusal()
            self._before_stop()
            self._port.close_with_links()
            await self._port.wait_closed()

    def __del__(self) -> None:
        # the event loop refers to the camera until it is stopped; so here the loop is gone, too
        if vars(self).get("_started", False):
            text = f"emulated camera at {self.url} was not stopped"
            warnings.warn(text, ResourceWarning, source=self, stacklevel=2)

    # ------------------------------------------------------------------ faults

    def inject(self, *faults: BaseFault | Mapping[str, Any]) -> None:
        """Add faults after the waiting ones; faults that wait for no message happen now.

        Call it in the event loop's thread. Before the emulator's start they wait for it.

        Args:
            faults: faults of :mod:`smartcam.emulator.faults`, or mappings with ``kind``.

        Raises:
            ConfigurationError: one of the faults is wrong, or too many would wait; none was added.
        """
        with self.step():
            self._collect()  # messages from before are not changed
            self.queue.add(faults)
            if self._started:
                self._run_immediate_faults()

    def command(self, name: str) -> None:
        """Give a command: the timeline's cues that wait for it happen.

        Call it in the event loop's thread, while the emulator is started.

        Raises:
            ConfigurationError: no cue has it.
        """
        self._timeline.command(check_text(name, "name", "command", most=200))

    def clear_faults(self) -> None:
        """Forget faults that wait, and end faults that last.

        BUSY is cleared, the port opens, the second client leaves, connections that are half open or
        stalled are reset. Delayed messages come at their time, and a reboot takes its time.
        """
        self.queue.clear()
        with self.step():
            self._end_device_faults()
            self._end_refusal()
            for link in self._listener.all_links:
                link.end_fault_effects()

    def _refuse(self, seconds: float) -> None:
        """Close the port for a time; open connections stay."""
        self._refused_until = max(self._refused_until, self.clock.now + seconds)
        if self._refusal_timer is not None:
            self._refusal_timer.cancel()
        elif not self._is_down:
            self._port.close()
        self._refusal_timer = self.clock.call_at(self._refused_until, self._wake_port)

    def _let_second_client_in(self) -> None:
        """Let another client connect; it has no effect on a camera that serves several."""

    def _make_timeline(self) -> Timeline:
        return Timeline(
            self._cues, clock=self.clock, seed=self.seed, inject=lambda do: self.inject(*do)
        )

    def _on_state_entered(self, state: DeviceState) -> None:
        """Note that the device has entered a state, after all its earlier messages."""
        self._collect()
        self._timeline.note_entered(state)

    def _run_immediate_faults(self) -> None:
        self._run_device_faults(self.queue.at_once(), None)

    def _fire_before(self, waiting: list[WaitingFault], message: m.Message) -> Sequence[Fault]:
        """Run the device faults that come before a message; return all triggered faults."""
        if not waiting:
            return ()
        faults = self.queue.by_message(waiting, message)
        self._run_device_faults(faults, "before")
        return faults

    def _run_device_faults(
        self, faults: Iterable[Fault], when: Literal["before", "after"] | None
    ) -> None:
        """Run device faults; the camera's answers trigger no other device fault."""
        for fault in faults:
            if isinstance(fault, DeviceFault) and when in {None, fault.when}:
                apply_fault(self._fault_targets, fault)
                self._deliver_at_once()

    # ------------------------------------------------------------------ for links

    @abstractmethod
    def make_machine(self, transport: Transport, trace: Trace) -> CameraMachine:
        """Return the machine of a new link."""

    @abstractmethod
    def handle_message(self, link: ClientLink, message: m.Message) -> None:
        """Handle a message of a link."""

    @abstractmethod
    def serves(self, link: ClientLink) -> bool:
        """Return True if the link has a session."""

    @abstractmethod
    def forget_link(self, link: ClientLink) -> None:
        """Forget a link that is gone; a second call does nothing."""

    def connection_begun(self, link: ClientLink) -> None:
        """Note that a connection was made."""

    def connection_ended(self, link: ClientLink, *, by_client: bool, reset: bool) -> None:
        """Note that a connection has ended."""
        ended_by: Literal["client", "camera"] = "client" if by_client else "camera"
        ended = EndedConnection(self.clock.now, link.peer, ended_by, reset)
        self._traffic.ended_connections.append(ended)

    def note_frame(
        self, link: ClientLink, sender: m.Sender, content: Frame | RemoteProtocolError
    ) -> None:
        """Note a frame that a machine saw, or bytes that make no frame."""
        traffic, now = self._traffic, self._step_at
        if now is None:
            now = self.clock.now
        if isinstance(content, Frame):
            traffic.entries.add_frame(now, link.peer, sender, content, link.input_faults)
            if sender is _CLIENT:
                traffic.count(content)
        else:
            traffic.add(now, link.peer, sender, content, link.input_faults)
        if self._logs_frames:
            self._log_last_entry()

    def note_message(self, link: ClientLink, sender: m.Sender, message: WireMessage) -> None:
        """Log a message that passed or is lost, as faults have changed it."""
        faults = ", ".join(message.effects) or None
        self._log_content(link.peer, sender, message.content, faults, message.wire)

    def _log_content(
        self,
        peer: str,
        sender: m.Sender,
        content: Frame | bytes,
        fault: str | None,
        wire: bytes | None,
    ) -> None:
        self._traffic.add(self.clock.now, peer, sender, content, fault, wire)
        if _log.isEnabledFor(logging.DEBUG):
            self._log_last_entry()

    def _log_last_entry(self) -> None:
        entry = self.log[-1]
        mark = "!" if entry.error else "<" if entry.direction == "in" else ">"
        faulty = f" ({entry.fault}; on the wire: {entry.wire})" if entry.fault else ""
        content = entry.error or entry.message or f"message {entry.message_id}: {entry.hex}"
        _log.debug("%s %s: %s%s", mark, entry.peer, content, faulty)

    # ------------------------------------------------------------------ steps

    def step(self) -> AbstractContextManager[None]:
        """Advance the device's time, run the body, deliver the messages, set the timer.

        Inside another step it is a part of that step.
        """
        return self._step

    def _begin_step(self) -> None:
        self._logs_frames = _log.isEnabledFor(logging.DEBUG)
        if self._started:
            self._step_at = now = self.clock.now
            self._advance_device(now)

    def _end_step(self) -> None:
        try:
            if self._started:
                self._finish_step()
        finally:
            self._step_at = None

    def _wake(self) -> None:
        with self.step():
            pass

    @abstractmethod
    def _advance_device(self, now: float) -> None:
        """Advance the device's time; ``now``: the clock's time, seconds."""

    @abstractmethod
    def _collect(self) -> None:
        """Put the device's messages into the next write."""

    @abstractmethod
    def _finish_step(self) -> None:
        """Deliver the messages of a step, and set the timer."""

    def _deliver_at_once(self) -> None:
        """Send the messages that a fault made the device send; they trigger no other fault."""

    def _after_start(self) -> None:
        """Called after the start, before the first step."""

    def _before_stop(self) -> None:
        """Called before the stop, while links are still there."""

    def _end_device_faults(self) -> None:
        """End the lasting faults of the device."""

    # ------------------------------------------------------------------ the port

    def _end_refusal(self) -> None:
        """Open the port that a fault closed."""
        timer, self._refusal_timer = self._refusal_timer, None
        self._refused_until = 0.0
        if timer is not None:
            timer.cancel()
            if self._started and not self._is_down:
                self._port.reopen()

    def _wake_port(self) -> None:
        with self.step():
            self._end_refusal()
