"""Run an agent, which has the sessions with its cameras and carries out programs' calls.

Each program numbers its calls, so that the agent carries out a call only once if it arrives twice.
The agent does not carry out a call that arrives after its deadline. Every running call is a task of
the agent. It ends at the call's deadline, when the program cancels it, or when the program is lost.
"""

from __future__ import annotations

import asyncio
import collections
import functools
import logging
import time
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_clock_seconds, check_seconds
from smartcam._client._inside import new_tuple
from smartcam._finishing import close_all
from smartcam.exceptions import (
    ConfigurationError,
    ConnectionLostError,
    LocalProtocolError,
    ProtocolError,
    ReservationLostError,
    SmartCamError,
    UnsupportedError,
)
from smartcam.fleet._agent.bundle import AgentBundle
from smartcam.fleet._agent.calls import ACTIONS, GATED_COMMANDS, ProgramCall, agent_clock
from smartcam.fleet._agent.claims import Claims
from smartcam.fleet._agent.client import Owner
from smartcam.fleet._agent.shared_camera import SharedCamera
from smartcam.fleet._agent.summary import Summaries
from smartcam.fleet._agent.workers import Workers
from smartcam.fleet._bus.errors import late_call_error, to_fields
from smartcam.fleet._bus.keys import COMMANDS
from smartcam.fleet._bus.wire import (
    BusMessage,
    TriggerCall,
    decode,
    decode_trigger,
    encode,
    encode_trigger_reply,
    reply_grace,
)
from smartcam.fleet._frames.camera_frames import NO_FRAME_SUPPLY, SharedFrames
from smartcam.fleet._frames.encoding import FrameEncoder
from smartcam.fleet._frames.sender import FrameSender
from smartcam.fleet._json.json_services import JsonServices
from smartcam.fleet._operations.trigger_counts import RESULT, Totals, outcome_of
from smartcam.fleet._program.program_name import ROLES_OF_NAMES, ProgramName
from smartcam.fleet._security.certificates import VIEWER

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from typing import Self

    from smartcam.calibration._inside import CalibrationsByCamera
    from smartcam.fleet._bus.bus import Bus, Handle
    from smartcam.fleet._bus.keys import Keys
    from smartcam.fleet._file.standby import Standby
    from smartcam.fleet._frames.camera_frames import FrameSupply
    from smartcam.models import CameraEvent
    from smartcam.observers import Observer
    from smartcam.settings import CameraSettings

logger: logging.Logger = logging.getLogger("smartcam.fleet")

MAX_PROGRAMS_PER_ROLE = 4096
"""Largest number of programs of each role at a time, so that the programs of one role cannot keep
out those of other roles."""

PRESENCE_TIMEOUT = 10.0
"""Seconds after a program's first call in which the program must have announced its presence on the
bus. Otherwise it is forgotten, since the agent would not notice its end."""

MAX_CALLS_PER_PROGRAM = 256
"""Largest number of running questions of one program, and largest number of its running commands,
for each camera of the agent."""

MAX_QUESTIONS_PER_ROLE = 16 * MAX_CALLS_PER_PROGRAM
"""Largest number of running questions of all programs of one role, for each camera."""

MAX_REMEMBERED_CALLS = 4096
"""Number of calls of each program that are remembered, to recognize repetitions. A call that is
older than these is not carried out."""

MAX_REMEMBERED_CAMERAS = 1000
"""Largest number of cameras that are no longer shared, but whose next message numbers are
remembered."""

FIRST_ATTEMPT_TIMEOUT = 30.0
"""Seconds to wait at the start for the first attempts to connect to the cameras."""


END_NOTICE_DELAY = 0.02
"""Seconds to wait between the last message about a camera and the end of the camera's presence.
Without this wait, programs may learn of the end first."""


class CallNumbers:
    """The numbers of the calls that were received from one program.

    Args:
        floor: number up to which all calls count as received.
    """

    def __init__(self, floor: int = 0) -> None:
        self.floor = floor
        self._known_calls: set[int] = set()

    @property
    def last_call(self) -> int:
        """The highest received number."""
        return max(self._known_calls, default=self.floor)

    def add_if_new(self, call: int) -> bool:
        """Remember a call; return True if it is received for the first time."""
        if call <= self.floor or call in self._known_calls:
            return False
        self._known_calls.add(call)
        if len(self._known_calls) > MAX_REMEMBERED_CALLS:
            newest = sorted(self._known_calls)[MAX_REMEMBERED_CALLS // 2 :]
            self.floor = newest[0] - 1
            self._known_calls = set(newest)
        return True


@dataclass(eq=False)
class Guest:
    """A program that has called this agent.

    Questions and commands are bounded separately, so that questions cannot block commands.

    Attributes:
        program: name and secret of the program.
        number: number of the program in the results of its triggers.
        is_present: whether the program has announced its presence on the bus.
        questions, commands: numbers of the received questions, and of the received commands.
        tasks: tasks of running calls, by kind (True: a command) and number of the call.
        running_counts: number of running questions (False) and of running commands (True).
        switches: client and state to restore after each temporary switch of the application, by the
            camera's name and the call's number.
        last_state: number of the last state in the program's replies, by camera.
    """

    program: ProgramName
    number: int
    is_present: bool
    questions: CallNumbers = field(default_factory=CallNumbers)
    commands: CallNumbers = field(default_factory=CallNumbers)
    tasks: dict[tuple[bool, int], asyncio.Task[None]] = field(
        default_factory=dict[tuple[bool, int], "asyncio.Task[None]"]
    )
    running_counts: list[int] = field(default_factory=lambda: [0, 0])
    switches: dict[tuple[str, int], Any] = field(default_factory=dict[tuple[str, int], Any])
    last_state: dict[str, int] = field(default_factory=dict[str, int])

    @property
    def last_call(self) -> int:
        """The highest received number of a call."""
        return max(self.questions.last_call, self.commands.last_call)

    def add_if_new(self, call: int, command: bool) -> bool:
        """Remember a call; return True if it is received for the first time."""
        return (self.commands if command else self.questions).add_if_new(call)

    def begin_call(self, command: bool, call: int, task: asyncio.Task[None]) -> None:
        """Count a call as running."""
        self.tasks[command, call] = task
        self.running_counts[command] += 1

    def end_call(self, command: bool, call: int) -> asyncio.Task[None] | None:
        """Count a call as ended; return its task, or None if it had ended before."""
        task = self.tasks.pop((command, call), None)
        if task is not None:
            self.running_counts[command] -= 1
        return task


class Agent:
    """Shares cameras over a bus.

    Args:
        name: name of the agent.
        keys: keys of the fleet.
        bus: the agent's own connection to the bus.
        cameras: options of the client of each camera, by the camera's name.
        history: largest numbers of kept results and of their bytes for each camera.
        on_event: callback for events of the cameras.
        frames: sources of frames, by camera's name, for the cameras with frames.
        observers: observers of all sessions.
        standby: settings of a standby agent, which takes over cameras of lost agents; None: this
            agent is no standby agent.
        on_retired: callback that is called if the agent ends because another agent has its name.
        calibrations: calibrations of the cameras; None if there is no folder for them.

    Attributes:
        retired_by: error that ended this agent because another agent has its name; otherwise None.
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
        frames: Mapping[str, FrameSupply] | None = None,
        observers: Iterable[Observer] = (),
        standby: Standby | None = None,
        on_retired: Callable[[ConfigurationError], None] = lambda _: None,
        calibrations: CalibrationsByCamera | None = None,
    ) -> None:
        self.name = name
        self.retired_by: ConfigurationError | None = None
        self._on_retired = on_retired
        self._frames = dict(frames or {})
        self._observers = tuple(observers)
        self._sender, self._encoder = FrameSender(bus, keys), FrameEncoder()
        self.epoch: int = time.time_ns()
        self._keys, self._bus = keys, bus
        self._cameras, self._history, self._on_event = cameras, history, on_event
        self.shared_cameras: dict[str, SharedCamera] = {}
        self._programs: dict[str, Guest] = {}
        # by role: present programs, by their tokens; and programs that left, oldest first, with
        # their last call
        self._present = collections.defaultdict[str, set[str]](set)
        self._last_calls = collections.defaultdict[str, dict[str, int]](dict)
        self._role_counts: collections.Counter[str] = collections.Counter()  # number of programs
        # running questions, by program
        self._question_counts: collections.Counter[str] = collections.Counter()
        self._last_program_number = 0
        self._workers = Workers()
        self._tasks: set[asyncio.Task[None]] = set()
        self._handles: list[Handle] = []
        # presence of each shared camera, and the task of its session
        self._sharing: dict[str, tuple[Handle, asyncio.Task[None]]] = {}
        # next numbers of cameras that were shared before
        self._remembered_numbers: dict[str, tuple[int, ...]] = {}
        self._json_services = JsonServices(self, keys, bus, calibrations)
        self.closing_cameras: set[SharedCamera] = set()  # cameras that are being closed
        self.past_totals: Totals = Totals()  # counts of cameras that are no longer shared
        self._summaries = Summaries(self, keys, bus)
        self._bundle = AgentBundle(name, self.epoch, keys, bus)
        self.is_standby: bool = standby is not None
        self._claims = Claims(self, keys, bus, standby)

    # ------------------------------------------------------------------ life

    async def open(self, timeout: float) -> Self:
        """Connect to the bus, and start the sessions with the cameras.

        Raises:
            ConnectFailedError: there is no bus within ``timeout`` seconds.
            ConfigurationError: an option of a camera is wrong, another agent has this agent's name,
                or another agent has a camera and neither is a standby agent.
        """
        await self._bus.open(timeout)
        keys, bus, handles = self._keys, self._bus, self._handles
        try:
            await self._claims.check_name_free(timeout)
            handles.append(bus.watch(keys.program("*"), self._on_program))
            for role in (None, *ROLES_OF_NAMES):
                pattern, on_call = self._calls_key(role, "**"), self._call_handler(role)
                handles.append(bus.subscribe(pattern, on_call, low_priority=role == VIEWER))
            self._json_services.open()
            self._summaries.open()
            self._bundle.open()
            await self._claims.claim_name(timeout)
            handles.append(bus.announce(keys.agent(self.name)))
            await self._claims.open(self._cameras, timeout)
        except BaseException:
            await self.close()
            raise
        return self

    async def close(self) -> None:
        """Leave the bus, end calls and sessions, within a limited time. Idempotent.

        Cancellation: the sessions' links are dropped at once; the bus is still left.
        """
        handles, self._handles = self._handles, []
        self._claims.close()
        self._json_services.close()
        self._summaries.close()
        for handle in (*handles, *(token for token, _ in self._sharing.values())):
            handle.close()
        for program in [*self._programs]:
            self._forget_program(program, restore_applications=False)
        for task in self._workers.close():
            self._add_task(task)
        for task in tuple(self._tasks):
            task.cancel()
        try:
            await asyncio.gather(*self._tasks, return_exceptions=True)
            try:
                await close_all(camera.close for camera in self.shared_cameras.values())
            except Exception:
                logger.exception("%s ! closing a camera failed", self.name)
            await self._encoder.close()
        finally:
            self._bundle.close()
            self._sender.close()
            await self._bus.close()

    def retire(self, reason: ConfigurationError) -> None:
        """Start to end the sessions and the agent, since another agent has its name."""
        if self.retired_by is not None:
            return
        logger.error("%s ! %s", self.name, reason)
        self.retired_by = reason
        self.start_task(self._retire(reason), "smartcam.fleet.retire")

    async def _retire(self, error: ConfigurationError) -> None:
        handles, self._handles = self._handles, []
        self._claims.close()
        self._json_services.close()
        self._summaries.close()
        for handle in handles:
            handle.close()
        reason = "another agent has its name"
        try:
            names = [*self.shared_cameras]
            await close_all(functools.partial(self.unshare, name, reason) for name in names)
        except Exception:
            logger.exception("%s ! closing a camera failed", self.name)
        finally:
            self._on_retired(error)

    def share(
        self, name: str, settings: CameraSettings, frames_of: FrameSupply | None = None
    ) -> SharedCamera:
        """Start a session with a camera, and share the camera.

        Args:
            name: name of the camera.
            settings: settings of the client that has the session.
            frames_of: source of the camera's frames; None for none.

        Raises:
            ConfigurationError: an option of the camera is wrong.
        """
        bus, keys, topics = self._bus, self._keys, self._json_services.topics
        if frames_of is not None:
            self._frames[name] = frames_of
        source = self._frames.get(name, NO_FRAME_SUPPLY)
        reporter = source.reporter
        frames = SharedFrames(
            name, source.make, self._sender, self._encoder, source.url, reporter is not None
        )
        on_event = self._on_camera_event
        camera = SharedCamera(
            name,
            settings,
            bus,
            keys,
            self.epoch,
            self._history,
            on_event,
            topics,
            frames,
            self._bundle,
            self._observers if reporter is None else (reporter, *self._observers),
        )
        camera.numbers = self._remembered_numbers.pop(name, camera.numbers)
        camera.first_result, camera.is_only_agent = camera.results.next_number, not self.is_standby
        self.shared_cameras[name] = camera
        session_task = self.start_task(camera.run(), f"smartcam.fleet.{name}")
        self._sharing[name] = bus.announce(keys.camera(self.name, name)), session_task
        return camera

    async def add_camera(
        self, name: str, settings: CameraSettings, frames_of: FrameSupply | None = None
    ) -> None:
        """Share a further camera, or stand by for it while another agent has the camera.

        Raises:
            ConfigurationError: an option of the camera is wrong; or another agent has it.
        """
        if self.retired_by is not None:
            raise self.retired_by.with_traceback(None)
        if frames_of is not None:
            self._frames[name] = frames_of
        await self._claims.claim_camera(name, settings)

    async def check_address_free(self, name: str, settings: CameraSettings) -> None:
        """Check that the fleet does not have a camera already under another name.

        Raises:
            ConfigurationError: the fleet has this camera; the text names it and its agent.
        """
        await self._claims.check_addresses_free({name: settings})

    async def remove_camera(self, name: str, reason: str) -> None:
        """Stop sharing a camera, or standing by for it; its programs get ``reason``."""
        self._claims.drop_claim(name)
        if name in self.shared_cameras:
            await self.unshare(name, reason)

    async def unshare(self, name: str, reason: str) -> None:
        """End the session with a camera, and stop sharing it, within a limited time.

        Args:
            name: name of the camera.
            reason: reason for the camera's programs, as a text.

        Cancellation: takes effect at the end.
        """
        camera = self.shared_cameras.pop(name)
        # announced before the presence ends: without this, programs would take the agent for lost
        camera.announce_removed(reason)
        self.closing_cameras.add(camera)
        token, session_task = self._sharing.pop(name)
        try:
            try:
                if not self._bus.local:
                    await asyncio.sleep(END_NOTICE_DELAY)
            finally:
                token.close()
                session_task.cancel()
            await asyncio.wait({session_task})
        finally:
            try:
                await camera.close()
            finally:
                self._remembered_numbers[name] = camera.numbers
                self.closing_cameras.discard(camera)
                self.past_totals.add([camera.client.statistics()])
        if len(self._remembered_numbers) > MAX_REMEMBERED_CAMERAS:
            del self._remembered_numbers[next(iter(self._remembered_numbers))]

    def is_shared(self, camera: SharedCamera) -> bool:
        """Return True if a camera is still shared, and by this object."""
        return self.shared_cameras.get(camera.name) is camera

    @property
    def program_count(self) -> int:
        """Number of programs that use the agent."""
        return len(self._programs)

    @property
    def call_count(self) -> int:
        """Number of running calls of programs."""
        return sum(len(guest.tasks) for guest in self._programs.values())

    def _on_camera_event(self, event: CameraEvent) -> None:
        self._claims.on_event(event)
        self._on_event(event)

    async def wait_first_attempts(self) -> None:
        """Wait until the first attempt with each camera has ended, within a limited time."""
        deadline = asyncio.get_running_loop().time() + FIRST_ATTEMPT_TIMEOUT
        for camera in tuple(self.shared_cameras.values()):
            await camera.wait_first_attempt(max(0.0, deadline - asyncio.get_running_loop().time()))

    def start_task(self, work: Any, name: str) -> asyncio.Task[None]:
        """Run a coroutine in a task, which the agent cancels at its end."""
        task = asyncio.get_running_loop().create_task(work, name=name)
        self._add_task(task)
        return task

    def _add_task(self, task: asyncio.Task[None]) -> None:
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _cancel_task(self, call: asyncio.Task[None]) -> None:
        """Cancel a call's task, and keep a reference to it until it has ended."""
        self._add_task(call)
        call.cancel()

    @property
    def busy(self) -> bool:
        """True while a program has reserved a camera, or a command runs."""
        return (
            self._json_services.busy
            or any(command for guest in self._programs.values() for command, _ in guest.tasks)
            or any(camera.gate.holder is not None for camera in self.shared_cameras.values())
        )

    # ------------------------------------------------------------------ programs

    def _on_program(self, key: str, present: bool) -> None:
        token = self._keys.tail(key, "presence/program")[-1]
        program = ProgramName.from_token(token)
        if not program.is_genuine:
            return
        tokens, guest = self._present[program.role], self._programs.get(program.name)
        if not present:
            tokens.discard(token)
        elif len(tokens) < MAX_PROGRAMS_PER_ROLE:
            tokens.add(token)
        if guest is None or guest.program != program:
            return
        guest.is_present = present
        if not present:
            self._forget_program(program.name)

    def _forget_program(self, program: str, *, restore_applications: bool = True) -> None:
        """End the calls and reservations of a lost program."""
        guest = self._programs.pop(program, None)
        if guest is None:
            return
        role = guest.program.role
        self._role_counts[role] -= 1
        last_calls = self._last_calls[role]
        last_calls[program] = guest.last_call
        if len(last_calls) > MAX_PROGRAMS_PER_ROLE:
            del last_calls[next(iter(last_calls))]
        for task in guest.tasks.values():
            self._cancel_task(task)
        self._sender.forget_program(program)
        for shared in self.shared_cameras.values():
            shared.gate.lose_program(program)
            shared.frames.forget_program(program)
        if restore_applications:
            for camera, before in guest.switches.values():
                camera.leave_application(before)

    def _known_guest(self, program: ProgramName) -> Guest | None:
        """Return a known program; None if it is unknown, or another program uses its name."""
        guest = self._programs.get(program.name)
        return guest if guest is not None and guest.program == program else None

    def _welcome(self, program: ProgramName, call: int) -> Guest | None:
        """Return the program that sent a hello, new or known; None if it has left since then."""
        known, role = self._known_guest(program), program.role
        last_call = self._last_calls[role].get(program.name, 0)  # if the program had left
        if known is None and call > last_call:
            if self._role_counts[role] >= MAX_PROGRAMS_PER_ROLE:
                raise LocalProtocolError(
                    f"{self.name}: {MAX_PROGRAMS_PER_ROLE} programs of role {role} are here already"
                )
            present = program.token in self._present[role]
            numbers = CallNumbers(last_call), CallNumbers(last_call)
            known = Guest(program, self.new_program_number(), present, *numbers)
            self._programs[program.name] = known
            self._role_counts[role] += 1
            if not present:
                loop = asyncio.get_running_loop()
                loop.call_later(PRESENCE_TIMEOUT, self._check_presence, known)
        return known

    def _check_presence(self, guest: Guest) -> None:
        """Forget a program whose presence was not seen in time."""
        if not guest.is_present and self._programs.get(guest.program.name) is guest:
            logger.warning("%s ! %s is not present: forgotten", self.name, guest.program.name)
            self._forget_program(guest.program.name)

    def new_program_number(self) -> int:
        """Return the number for a new program, which marks the results of its triggers."""
        self._last_program_number += 1
        return self._last_program_number

    # ------------------------------------------------------------------ calls

    def _calls_key(self, role: str | None, camera: str) -> str:
        """Return the key of the questions of a role; with None the key of commands."""
        keys = self._keys
        return (
            keys.command(self.name, camera) if role is None else keys.ask(role, self.name, camera)
        )

    def _call_handler(self, role: str | None) -> Callable[[str, bytes], None]:
        """Return the callback for calls of one kind: a role's questions, or with None commands."""
        root, command = self._calls_key(role, ""), role is None

        def on_call(key: str, payload: bytes) -> None:
            name = key.removeprefix(root)
            try:
                camera, trigger = self.shared_cameras[name], decode_trigger(payload, "a call")
                if trigger is None:
                    self._on_call(camera, decode(payload, "a call"), role)
                elif command:
                    self._on_trigger(camera, *trigger)
                else:
                    raise ProtocolError(f"{name}: a trigger is no question")
            except (ProtocolError, LocalProtocolError, KeyError, TypeError, ValueError) as exc:
                logger.warning("%s ! a call that cannot be read: %s", name, exc)

        return on_call

    def _check_caller(self, token: str, role: str | None) -> ProgramName:
        """Check the token of the calling program, and return its name.

        Raises:
            ProtocolError: the program uses another program's name, or the key of another role.
        """
        program = ProgramName.from_token(token)
        if not program.is_genuine or role not in {None, program.role}:
            raise ProtocolError(f"{self.name}: a call as {program.name:.80}, by another program")
        return program

    def _on_call(self, camera: SharedCamera, message: BusMessage, role: str | None) -> None:
        fields, command = message.fields, role is None
        program, number = self._check_caller(str(fields["program"]), role), int(fields["call"])
        name = program.name
        if "received" in fields:
            self._sender.confirm(name, number, fields["received"])
            return
        if "cancel" in fields:
            self._cancel(camera, name, int(fields["cancel"]), command)
            self._reply(name, number, {"answer": {}})
            return
        action, timeout = str(fields["do"]), fields.get("timeout", 1.0)
        deadline = fields.get("deadline")
        epoch, arguments = fields.get("epoch", self.epoch), fields.get("arguments", {})
        guest = self._welcome(program, number) if action == "hello" else self._known_guest(program)
        reservation = fields.get("reservation")
        if reservation is not None:
            reservation = int(reservation)
        remaining = self._admit_call(
            camera, guest, name, number, epoch, action, deadline, timeout, command, reservation
        )
        if guest is not None and remaining is not None:
            owner = Owner(guest.number, number)
            blobs, switches = message.blobs, guest.switches
            call = ProgramCall(
                camera, name, owner, arguments, blobs, remaining, switches, None, reservation
            )
            self._start(action, call, guest, command)

    def _on_trigger(self, camera: SharedCamera, token: str, trigger: TriggerCall) -> None:
        number, action = trigger.call, "trigger"
        program, _, secret = token.partition(".")
        guest = self._programs.get(program)
        if guest is None or guest.program.secret != secret:
            guest, program = None, self._check_caller(token, None).name
        epoch, deadline, timeout = trigger.epoch, trigger.deadline, trigger.timeout
        reservation = trigger.reservation
        remaining = self._admit_call(
            camera, guest, program, number, epoch, action, deadline, timeout, True, reservation
        )
        if guest is not None and remaining is not None:
            owner, switches = new_tuple(Owner, (guest.number, number)), guest.switches
            fields: Any = camera, program, owner, {}, [], remaining, switches, trigger, reservation
            call: ProgramCall = new_tuple(ProgramCall, fields)
            worker = self._workers.get_worker()
            guest.begin_call(True, number, worker.task)
            worker.start_work(partial(self._carry_out, action, call, guest, True))

    def _admit_call(
        self,
        camera: SharedCamera,
        guest: Guest | None,
        program: str,
        number: int,
        epoch: int,
        action: str,
        deadline: float | None,
        timeout: float,
        command: bool,
        reservation: int | None,
    ) -> float | None:
        """Return the seconds that a call may take; None if the call is refused, or a repetition."""
        if guest is None or epoch != self.epoch:
            error_class = ConnectionLostError if reservation is None else ReservationLostError
            stranger = error_class(
                f"{camera.name}: the agent {self.name} was restarted, or took this program for "
                f"gone{'' if reservation is None else ', and lost its reservation'}; {action} was "
                "not done"
            )
            self._reply(program, number, {"error": to_fields(stranger), "stranger": True})
            return None
        if not guest.add_if_new(number, command):
            return None  # a repetition of a call that runs or has ended
        error: SmartCamError | None = None
        remaining = 1.0
        try:
            timeout = check_seconds(timeout, "timeout", camera.name)
            if deadline is not None:
                remaining = (
                    check_clock_seconds(deadline, "deadline", camera.name)
                    + reply_grace(timeout) / 2
                    - agent_clock()
                )
        except ConfigurationError as exc:
            error = exc
        error = error or self._refusal_error(camera, guest, action, remaining, command)
        if error is not None:
            if action == "trigger":
                camera.triggers[outcome_of(error)] += 1
            self._reply(program, number, {"error": to_fields(error)})
            return None
        return min(timeout, remaining)

    def _refusal_error(
        self, camera: SharedCamera, guest: Guest, action: str, remaining: float, command: bool
    ) -> SmartCamError | None:
        """Return the error that refuses a call; None if the call is accepted."""
        if action not in ACTIONS or (action in COMMANDS) != command:
            return UnsupportedError(f"{camera.name}: the agent {self.name} cannot {action!r:.40}")
        if remaining < 0:
            return late_call_error(
                action, f"{camera.name}: {action} came after its deadline; it was not done"
            )
        cameras = len(self.shared_cameras)
        if (
            not command
            and self._question_counts[guest.program.role] >= MAX_QUESTIONS_PER_ROLE * cameras
        ):
            return LocalProtocolError(
                f"{camera.name}: too many questions of role {guest.program.role} are under way"
            )
        if guest.running_counts[command] >= MAX_CALLS_PER_PROGRAM * cameras:
            kind = "commands" if command else "questions"
            return LocalProtocolError(
                f"{camera.name}: {guest.running_counts[command]} {kind} of this program are running"
            )
        return None

    def _start(self, action: str, call: ProgramCall, guest: Guest, command: bool) -> None:
        task = asyncio.get_running_loop().create_task(
            self._carry_out(action, call, guest, command),
            name=f"smartcam.fleet.{call.camera.name}.{action}",
        )
        guest.begin_call(command, call.owner.call, task)
        if not command:
            self._question_counts[guest.program.role] += 1
            task.add_done_callback(partial(self._on_question_done, guest.program.role))

    def _on_question_done(self, role: str, _: object) -> None:
        self._question_counts[role] -= 1

    def _cancel(self, shared: SharedCamera, program: str, number: int, command: bool) -> None:
        guest = self._programs.get(program)
        if guest is None:
            return
        guest.add_if_new(number, command)  # so that a late call is not carried out
        task = guest.end_call(command, number)
        if task is not None:
            self._cancel_task(task)
        if not command:
            self._sender.confirm(program, number, None)
            return
        shared.gate.release((program, number))
        switch = guest.switches.pop((shared.name, number), None)
        if switch is not None:  # the switch was done, but its program no longer waits for it
            camera, before = switch
            camera.leave_application(before)

    async def _carry_out(self, action: str, call: ProgramCall, guest: Guest, command: bool) -> None:
        """Carry out a call, and reply; a program that has cancelled gets no reply."""
        camera = call.camera
        has_entered_gate, outcome = False, "cancelled"
        try:
            if call.reservation is not None:
                camera.check_reserved((call.program, call.reservation), action)
            if action in GATED_COMMANDS:
                if not camera.gate.try_enter(call.program):
                    waits_since = agent_clock()
                    await camera.enter_gate(call.program, action, call.timeout)
                    call = call._replace(
                        timeout=max(0.0, call.timeout - (agent_clock() - waits_since))
                    )
                has_entered_gate = True
            fields, blobs = await ACTIONS[action](call)
        except Exception as exc:
            if not isinstance(exc, SmartCamError):
                logger.exception("%s ! %s failed", camera.name, action)
            reply: dict[str, Any] = {"error": to_fields(exc)}
            blobs, outcome = [], outcome_of(exc)
        else:
            reply, outcome = {"answer": fields}, RESULT
        finally:
            if action == "trigger":
                camera.triggers[outcome] += 1
            if has_entered_gate:
                camera.gate.leave(call.program)
            guest.end_call(command, call.owner.call)
        if action == "trigger" and blobs:
            self._reply_to_trigger(call, guest, blobs[0])
            return
        camera.flush()
        reply |= {"states": camera.states.next_number, "results": camera.results.next_number}
        self._reply(call.program, call.owner.call, reply, blobs)

    def _reply_to_trigger(self, call: ProgramCall, guest: Guest, groups: bytes) -> None:
        """Reply with the trigger's results, and with states that the program does not have yet."""
        camera, next_number = call.camera, call.camera.states.next_number
        states = camera.unsent_states(guest.last_state.get(camera.name, 0))
        guest.last_state[camera.name] = next_number
        camera.flush(states=not states)
        if states and len(self._programs) == 1:
            camera.drop_unsent_states()
        number, clock = call.owner.call, agent_clock()
        reply = encode_trigger_reply(number, self.epoch, clock, next_number, states, groups)
        self._bus.put(self._keys.reply(call.program), reply)

    def _reply(
        self, program: str, number: int, fields: dict[str, Any], blobs: list[bytes] | None = None
    ) -> None:
        reply = {"call": number, "epoch": self.epoch, "clock": agent_clock(), **fields}
        self._bus.put(self._keys.reply(program), encode(reply, blobs or ()))
