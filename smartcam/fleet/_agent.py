"""An agent: it has the sessions with its cameras, and does what programs call for.

Each call has a number of its program's, and is done once however often it arrives; one that comes
after its deadline is not done at all. Every call is a task of the agent's, which ends with its
deadline, with the program's cancellation, and with the program itself.
"""

from __future__ import annotations

import asyncio
import logging
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import (
    ConnectionLostError,
    LocalProtocolError,
    ProtocolError,
    SmartCamError,
    UnsupportedError,
)
from smartcam.fleet._bundle import AgentBundle
from smartcam.fleet._calls import ACTIONS, PASSES_GATE, ProgramCall, now
from smartcam.fleet._claims import Claims
from smartcam.fleet._errors import late, to_fields
from smartcam.fleet._frame_encoding import FrameEncoder
from smartcam.fleet._frame_sender import FrameSender
from smartcam.fleet._frames import NO_FRAMES, SharedFrames
from smartcam.fleet._host import Host
from smartcam.fleet._keys import COMMANDS
from smartcam.fleet._plain import Plain
from smartcam.fleet._shared import Owner
from smartcam.fleet._summary import Summaries
from smartcam.fleet._trigger_counts import RESULT, Totals, outcome_of
from smartcam.fleet._wire import (
    BusMessage,
    TriggerOrder,
    decode,
    decode_order,
    encode,
    encode_outcome,
    grace,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from typing import Self

    from smartcam.fleet._bus import Bus, Handle
    from smartcam.fleet._frames import FramesOf
    from smartcam.fleet._keys import Keys
    from smartcam.fleet._standby_file import Standby
    from smartcam.models import CameraEvent
    from smartcam.observers import Observer
    from smartcam.settings import CameraSettings

logger: logging.Logger = logging.getLogger("smartcam.fleet")

MOST_PROGRAMS = 4096
MOST_CALLS = 256
"""Calls of one program that may be under way at a time, for each camera of the agent."""

KNOWN_CALLS = 4096
"""CallNumbers of calls that are remembered for each program; older ones are not done any more."""

KNOWN_CAMERAS = 1000
"""Cameras shared no more whose numbers go on where they ended, should they come back."""

FIRST_TRY = 30.0
"""Seconds that the first try to reach a camera is waited for at the start."""


class CallNumbers:
    """CallNumbers of calls that were seen.

    Args:
        floor: those up to this one count as seen.
    """

    def __init__(self, floor: int = 0) -> None:
        self.floor = floor
        self._known: set[int] = set()

    @property
    def last(self) -> int:
        """The highest that was seen."""
        return max(self._known, default=self.floor)

    def is_new(self, call: int) -> bool:
        """Whether a call has not been seen; it is known from now on."""
        if call <= self.floor or call in self._known:
            return False
        self._known.add(call)
        if len(self._known) > KNOWN_CALLS:
            kept = sorted(self._known)[KNOWN_CALLS // 2 :]
            self.floor = kept[0] - 1
            self._known = set(kept)
        return True


@dataclass(eq=False)
class Guest:
    """A program that calls.

    Questions and commands are kept apart: who may only ask can say another program's name, and must
    not keep its commands from being done, or cancel them.

    Attributes:
        number: by which results say whose they are.
        questions, commands: numbers of its calls of each kind.
        tasks: its calls under way, by kind (whether a command) and number.
        entered: what its temporary switches go back to.
        told: the number up to which it has heard of states with its replies, by camera.
    """

    number: int
    questions: CallNumbers = field(default_factory=CallNumbers)
    commands: CallNumbers = field(default_factory=CallNumbers)
    tasks: dict[tuple[bool, int], asyncio.Task[None]] = field(
        default_factory=dict[tuple[bool, int], "asyncio.Task[None]"]
    )
    entered: dict[tuple[str, int], Any] = field(default_factory=dict[tuple[str, int], Any])
    told: dict[str, int] = field(default_factory=dict[str, int])

    @property
    def last(self) -> int:
        """The highest number of a call that was seen."""
        return max(self.questions.last, self.commands.last)

    def is_new(self, call: int, command: bool) -> bool:
        """Whether a call has not been seen; it is known from now on."""
        return (self.commands if command else self.questions).is_new(call)


class Agent:
    """Shares cameras over a bus.

    Args:
        name: of the agent.
        keys: of the fleet.
        bus: an end of its own.
        cameras: options of the client of each camera, by the camera's name.
        history: results that are kept for each camera, and their bytes.
        on_event: is told what happens to the cameras.
        frames: where the frames of each camera come from that has any, by the camera's name.
        observers: see what the sessions see.
        standby: how it stands by for cameras that others have; None: it does not.
    """

    def __init__(
        self,
        name: str,
        keys: Keys,
        bus: Bus,
        cameras: dict[str, CameraSettings],
        *,
        history: tuple[int, int] = (10_000, 1 << 24),
        on_event: Callable[[CameraEvent], None] = lambda _: None,
        frames: Mapping[str, FramesOf] | None = None,
        observers: Iterable[Observer] = (),
        standby: Standby | None = None,
    ) -> None:
        self.name = name
        self._frames = dict(frames or {})
        self._observers = tuple(observers)
        self._sender, self._encoder = FrameSender(bus, keys), FrameEncoder()
        self.epoch: int = time.time_ns()
        self._keys, self._bus = keys, bus
        self._cameras, self._history, self._on_event = cameras, history, on_event
        self.hosts: dict[str, Host] = {}
        self._programs: dict[str, Guest] = {}
        self._gone: dict[str, int] = {}  # programs that left, oldest first: their last call
        self._numbers = 0
        self._tasks: set[asyncio.Task[None]] = set()
        self._declared: list[Handle] = []
        self._shared: dict[str, tuple[Handle, asyncio.Task[None]]] = {}
        self._numbers_at: dict[str, tuple[int, ...]] = {}  # of cameras that were shared before
        self._plain = Plain(self, keys, bus)
        self.leaving: set[Host] = set()  # are being closed
        self.past: Totals = Totals()  # of cameras shared no more
        self._summaries = Summaries(self, keys, bus)
        self._bundle = AgentBundle(name, self.epoch, keys, bus)
        self.stands_by: bool = standby is not None
        self._claims = Claims(self, keys, bus, standby)

    # ------------------------------------------------------------------ life

    async def open(self, timeout: float) -> Self:
        """Come to the bus, and begin to have sessions with the cameras.

        Raises:
            ConnectFailedError: there is no bus within ``timeout`` seconds.
            ConfigurationError: an option of a camera cannot work, or another agent has it and
                neither stands by; or another agent has this one's name.
        """
        await self._bus.open(timeout)
        keys, bus, declared = self._keys, self._bus, self._declared
        try:
            await self._claims.refuse_namesake(timeout)
            declared.append(bus.watch(keys.program("*"), self._on_program))
            for command in (True, False):
                key = keys.call(self.name, "**", command=command)
                declared.append(bus.subscribe(key, self._hears(command)))
            self._plain.open()
            self._summaries.open()
            self._bundle.open()
            declared.append(bus.be_present(keys.agent(self.name)))
            await self._claims.open(self._cameras, timeout)
        except BaseException:
            await self.close()
            raise
        return self

    async def close(self) -> None:
        """Leave the bus, end calls and sessions; bounded. Idempotent.

        Cancellation: the sessions' links are dropped at once; the bus is left nevertheless.
        """
        declared, self._declared = self._declared, []
        self._claims.close()
        self._plain.close()
        self._summaries.close()
        for handle in (*declared, *(token for token, _ in self._shared.values())):
            handle.close()
        for program in [*self._programs]:
            self._forget(program, going_back=False)
        for task in tuple(self._tasks):
            task.cancel()
        try:
            await asyncio.gather(*self._tasks, return_exceptions=True)
            closing = (host.close() for host in self.hosts.values())
            await asyncio.gather(*closing, return_exceptions=True)
            await self._encoder.close()
        finally:
            self._bundle.close()
            self._sender.close()
            await self._bus.close()

    def share(self, name: str, settings: CameraSettings, frames_of: FramesOf | None = None) -> Host:
        """Begin to have a session with a camera, and to share it.

        Args:
            name: of the camera.
            settings: of the client.
            frames_of: where its frames come from.

        Raises:
            ConfigurationError: an option of it cannot work.
        """
        bus, keys, topics = self._bus, self._keys, self._plain.topics
        if frames_of is not None:
            self._frames[name] = frames_of
        found = self._frames.get(name, NO_FRAMES)
        frames = SharedFrames(name, found.make, self._sender, self._encoder, found.url)
        events = self._on_camera_event
        host = Host(
            name,
            settings,
            bus,
            keys,
            self.epoch,
            self._history,
            events,
            topics,
            frames,
            self._bundle,
            self._observers,
        )
        host.numbers = self._numbers_at.pop(name, host.numbers)
        host.began, host.final = host.results.following, not self.stands_by
        self.hosts[name] = host
        running = self.begin(host.run(), f"smartcam.fleet.{name}")
        self._shared[name] = bus.be_present(keys.camera(self.name, name)), running
        return host

    async def want(
        self, name: str, settings: CameraSettings, frames_of: FramesOf | None = None
    ) -> None:
        """Share one more camera, or stand by for it.

        Raises:
            ConfigurationError: an option of it cannot work; or another agent has it.
        """
        if frames_of is not None:
            self._frames[name] = frames_of
        await self._claims.want(name, settings)

    async def drop(self, name: str) -> None:
        """Share a camera no more, nor stand by for it; bounded."""
        self._claims.drop(name)
        if name in self.hosts:
            await self.unshare(name)

    async def unshare(self, name: str) -> None:
        """End the session with a camera, and share it no more; bounded."""
        host = self.hosts.pop(name)
        self.leaving.add(host)
        token, running = self._shared.pop(name)
        token.close()
        running.cancel()
        try:
            await asyncio.gather(running, return_exceptions=True)
            await host.close()
        finally:
            self._numbers_at[name] = host.numbers
            self.leaving.discard(host)
            self.past.add([host.camera.statistics()])
        if len(self._numbers_at) > KNOWN_CAMERAS:
            del self._numbers_at[next(iter(self._numbers_at))]

    @property
    def programs(self) -> int:
        """How many programs are here."""
        return len(self._programs)

    @property
    def calls(self) -> int:
        """How many calls of theirs are under way."""
        return sum(len(guest.tasks) for guest in self._programs.values())

    def _on_camera_event(self, event: CameraEvent) -> None:
        self._claims.on_event(event)
        self._on_event(event)

    async def wait_tried(self) -> None:
        """Wait until each camera was tried once, well or not; bounded."""
        await asyncio.gather(*(host.tried(FIRST_TRY) for host in self.hosts.values()))

    def begin(self, work: Any, name: str) -> asyncio.Task[None]:
        """Have something done in a task, which ends with the agent."""
        task = asyncio.get_running_loop().create_task(work, name=name)
        self._own(task)
        return task

    def _own(self, task: asyncio.Task[None]) -> None:
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _end(self, call: asyncio.Task[None]) -> None:
        """Cancel a call, which nobody else looks after from now on."""
        self._own(call)
        call.cancel()

    @property
    def busy(self) -> bool:
        """Whether a program has a camera reserved, or a command under way.

        Of programs without smartcam every call counts.
        """
        return (
            self._plain.busy
            or any(command for guest in self._programs.values() for command, _ in guest.tasks)
            or any(host.gate.holder is not None for host in self.hosts.values())
        )

    # ------------------------------------------------------------------ programs

    def _on_program(self, key: str, present: bool) -> None:
        if not present:
            self._forget(self._keys.tail(key, "presence/program")[-1])

    def _forget(self, program: str, *, going_back: bool = True) -> None:
        """End all that a program has here: it is gone."""
        guest = self._programs.pop(program, None)
        if guest is None:
            return
        self._gone[program] = guest.last
        if len(self._gone) > MOST_PROGRAMS:
            del self._gone[next(iter(self._gone))]
        for task in guest.tasks.values():
            self._end(task)
        self._sender.forget(program)
        for host in self.hosts.values():
            host.gate.forget(program)
            host.frames.forget(program)
        if going_back:
            for camera, before in guest.entered.values():
                camera.leave(before)

    def _guest(self, program: str, call: int) -> Guest | None:
        """Return who says hello; None where that was said before it left, and comes only now."""
        known, left = self._programs.get(program), self._gone.get(program, 0)
        if known is None and call > left:
            if len(self._programs) >= MOST_PROGRAMS:
                raise LocalProtocolError(f"{self.name}: {MOST_PROGRAMS} programs are here already")
            known = self._programs[program] = Guest(
                self.next_program(), CallNumbers(left), CallNumbers(left)
            )
        return known

    def next_program(self) -> int:
        """Return the number of another program, by which results say whose they are."""
        self._numbers += 1
        return self._numbers

    # ------------------------------------------------------------------ calls

    def _hears(self, command: bool) -> Callable[[str, bytes], None]:
        """Return what takes calls of one kind: commands, or questions."""
        root = self._keys.call(self.name, "", command=command)

        def hear(key: str, payload: bytes) -> None:
            name = key.removeprefix(root)
            try:
                host, order = self.hosts[name], decode_order(payload, "a call")
                if order is None:
                    self._on_call(host, decode(payload, "a call"), command)
                else:
                    self._on_order(host, *order, command)
            except (ProtocolError, LocalProtocolError, KeyError, TypeError, ValueError) as exc:
                logger.warning("%s ! a call that cannot be read: %s", name, exc)

        return hear

    def _on_call(self, host: Host, message: BusMessage, command: bool) -> None:
        fields = message.fields
        program, number = str(fields["program"]), int(fields["call"])
        if "come" in fields:
            self._sender.come(program, number, fields["come"])
            return
        if "cancel" in fields:
            self._cancel(host, program, int(fields["cancel"]), command)
            self._reply(program, number, {"answer": {}})
            return
        said, timeout = str(fields["do"]), float(fields.get("timeout", 1.0))
        deadline = float(fields["deadline"]) if "deadline" in fields else None
        epoch, arguments = fields.get("epoch", self.epoch), fields.get("arguments", {})
        guest = self._guest(program, number) if said == "hello" else self._programs.get(program)
        left = self._admit(host, guest, program, number, epoch, said, deadline, timeout, command)
        if guest is not None and left is not None:
            owner = Owner(guest.number, number)
            call = ProgramCall(host, program, owner, arguments, message.blobs, left, guest.entered)
            self._start(said, call, guest, command)

    def _on_order(self, host: Host, program: str, order: TriggerOrder, command: bool) -> None:
        number, guest, said = order.call, self._programs.get(program), "trigger"
        epoch, deadline, timeout = order.epoch, order.deadline, order.timeout
        left = self._admit(host, guest, program, number, epoch, said, deadline, timeout, command)
        if guest is not None and left is not None:
            owner = Owner(guest.number, number)
            call = ProgramCall(host, program, owner, {}, [], left, guest.entered, order)
            self._start(said, call, guest, command)

    def _admit(
        self,
        host: Host,
        guest: Guest | None,
        program: str,
        number: int,
        epoch: int,
        said: str,
        deadline: float | None,
        timeout: float,
        command: bool,
    ) -> float | None:
        """Return the seconds that a call may take; None where it is not done, or not again."""
        if guest is None or epoch != self.epoch:
            stranger = ConnectionLostError(
                f"{host.name}: the agent {self.name} was restarted, or took this program for "
                f"gone; {said} was not done"
            )
            self._reply(program, number, {"error": to_fields(stranger), "stranger": True})
            return None
        if not guest.is_new(number, command):
            return None  # it is done, or under way: a double
        left = 1.0 if deadline is None else deadline + grace(timeout) / 2 - now()
        error: SmartCamError | None = None
        if said not in ACTIONS or (said in COMMANDS) != command:
            error = UnsupportedError(f"{host.name}: the agent {self.name} cannot {said!r:.40}")
        elif left < 0:
            error = late(said, f"{host.name}: {said} came after its deadline; it was not done")
        elif len(guest.tasks) >= MOST_CALLS * len(self.hosts):
            error = LocalProtocolError(
                f"{host.name}: {len(guest.tasks)} calls of this program are under way"
            )
        if error is not None:
            if said == "trigger":
                host.triggers[outcome_of(error)] += 1
            self._reply(program, number, {"error": to_fields(error)})
            return None
        return min(timeout, left)

    def _start(self, said: str, call: ProgramCall, guest: Guest, command: bool) -> None:
        guest.tasks[command, call.owner.call] = asyncio.get_running_loop().create_task(
            self._do(said, call, guest, command), name=f"smartcam.fleet.{call.host.name}.{said}"
        )

    def _cancel(self, host: Host, program: str, number: int, command: bool) -> None:
        guest = self._programs.get(program)
        if guest is None:
            return
        guest.is_new(number, command)  # if it comes yet, it comes too late
        task = guest.tasks.pop((command, number), None)
        if task is not None:
            self._end(task)
        if not command:
            self._sender.come(program, number, None)
            return
        host.gate.release((program, number))
        entered = guest.entered.pop((host.name, number), None)
        if entered is not None:  # it was done, and its program does not know
            camera, before = entered
            camera.leave(before)

    async def _do(self, said: str, call: ProgramCall, guest: Guest, command: bool) -> None:
        """Do a call, and reply; a program that has cancelled gets none."""
        host = call.host
        inside, outcome = False, "cancelled"
        try:
            if said in PASSES_GATE:
                if not host.gate.goes_in(call.program):
                    begun = now()
                    await host.enter(call.program, said, call.timeout)
                    call = call._replace(timeout=max(0.0, call.timeout - (now() - begun)))
                inside = True
            fields, blobs = await ACTIONS[said](call)
        except Exception as exc:
            if not isinstance(exc, SmartCamError):
                logger.exception("%s ! %s failed", host.name, said)
            reply: dict[str, Any] = {"error": to_fields(exc)}
            blobs, outcome = [], outcome_of(exc)
        else:
            reply, outcome = {"answer": fields}, RESULT
        finally:
            if said == "trigger":
                host.triggers[outcome] += 1
            if inside:
                host.gate.leave(call.program)
            guest.tasks.pop((command, call.owner.call), None)
        if said == "trigger" and blobs:
            self._reply_to_trigger(call, guest, blobs[0])
            return
        host.flush()
        reply |= {"states": host.states.following, "results": host.results.following}
        self._reply(call.program, call.owner.call, reply, blobs)

    def _reply_to_trigger(self, call: ProgramCall, guest: Guest, runs: bytes) -> None:
        """Reply, with the states that nobody was told of; others hear of them a little later."""
        host, following = call.host, call.host.states.following
        told = host.untold(guest.told.get(host.name, 0))
        guest.told[host.name] = following
        host.flush(states=not told)
        if told and len(self._programs) == 1:
            host.forget_fresh()
        reply = encode_outcome(call.owner.call, self.epoch, now(), following, told, runs)
        self._bus.put(self._keys.reply(call.program), reply)

    def _reply(
        self, program: str, number: int, fields: dict[str, Any], blobs: list[bytes] | None = None
    ) -> None:
        said = {"call": number, "epoch": self.epoch, "clock": now(), **fields}
        self._bus.put(self._keys.reply(program), encode(said, blobs or ()))
