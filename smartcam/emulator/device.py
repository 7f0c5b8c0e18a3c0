"""The camera behind the wire: a model that is moved by time differences.

It knows no socket, loop or clock. Messages of the active session go in by :meth:`Device.handle`,
time by :meth:`Device.tick`; what the camera says is taken with :meth:`Device.take_output`.

Inside, time is whole nanoseconds and every future thing is a row of one small table: instant by
kind. What falls on the same instant happens in the order of :class:`_Event`.

Facts stand in ``docs/protocol.md``. Where the documents are silent the choice is a field of
:class:`~smartcam.emulator.quirks.Quirks`, or is marked *inferred* here.
"""

from __future__ import annotations

import enum
import logging
from collections import deque
from contextlib import nullcontext
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

from smartcam.emulator.clock import NANOSECONDS
from smartcam.emulator.generators import Run
from smartcam.emulator.quirks import Quirks
from smartcam.emulator.scene import TableScene
from smartcam.exceptions import ConfigurationError, InterpretationError
from smartcam.models import Status
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from contextlib import AbstractContextManager

    from smartcam.emulator.application import Application
    from smartcam.models import ByteOrder

__all__ = ["LOST_CLOCK", "OPERATOR_CONDITIONS", "PROTOCOL_VERSION", "Device", "Mode"]

_log = logging.getLogger("smartcam.emulator")

PROTOCOL_VERSION = 1
"""What Connect is answered with (SC manual p. 29, published)."""

LOST_CLOCK = datetime(1970, 1, 1, tzinfo=UTC)
"""What the clock shows after a restart: it is lost (published for a sibling, the value inferred).
The camera's clock has no time zone; UTC stands here because a time of ours needs one."""

OPERATOR_CONDITIONS = Status.OVERHEAT | Status.SYSTEM_ERROR
"""Bits that nothing in the model sets: :meth:`Device.set_condition` does."""

_NUMBERS = 1 << 32  # sequence numbers are UINT32


class Mode(enum.Enum):
    """What the camera is doing."""

    STOPPED = "stopped"
    RUNNING = "running"
    SWITCHING = "switching"
    REBOOTING = "rebooting"


class _Event(enum.IntEnum):
    """Kinds of future things, in the order in which they happen at one instant."""

    INSPECTED = 0
    OVERTRIGGER_ENDS = 1
    LOADED = 2
    BOOTED = 3
    FREE_RUN = 4


def _ns(seconds: float) -> int:
    return round(seconds * NANOSECONDS)


class Device:
    """One camera.

    Args:
        applications: the programs stored on it; at least one, ids differ.
        active: id of the loaded one; default the first.
        running: in run mode from the beginning.
        quirks: what is not known about real cameras.
        clock_time: what its clock shows at first; a time without a zone is taken as it is.
        scene: the table it looks at.

    Attributes:
        around: every operator's action (:meth:`start`, :meth:`stop`, :meth:`trigger`,
            :meth:`switch_application`, :meth:`reboot`, :meth:`set_condition`,
            :meth:`set_endian`) happens inside this context. A server puts one here that first
            brings the device's time up and afterwards sends what the action caused.

    Raises:
        ConfigurationError: no application, one id twice, or ``active`` is none of them.
    """

    def __init__(
        self,
        applications: Iterable[Application],
        *,
        active: int | None = None,
        running: bool = False,
        quirks: Quirks | None = None,
        clock_time: datetime = LOST_CLOCK,
        scene: TableScene | None = None,
    ) -> None:
        self._applications = _by_id(applications)
        self.quirks = quirks or Quirks()
        self.scene = scene or TableScene()
        self.around: Callable[[], AbstractContextManager[object]] = nullcontext
        self._active = self._applications[
            self._known(next(iter(self._applications)) if active is None else active)
        ]
        self._now = 0
        self._mode = Mode.STOPPED
        self._events: dict[_Event, int] = {}
        self._session = False
        self._output: list[m.Message] = []
        self._reported: tuple[Status, int] | None = None
        self._conditions = Status(0)
        self._endian = 0
        self._next_number = 0
        self._runs = 0  # of the active application since it was loaded
        self._run: Run | None = None
        self._free_origin = 0
        self._free_count = 0
        self._target: Application | None = None
        self._answer_switch = False
        self._run_after_load = False
        self._queue: deque[Mapping[str, Any]] = deque()
        self._last_input: Mapping[str, Any] | None = None
        self._set_clock(clock_time)
        if running:
            self._enter_run_mode()

    # ------------------------------------------------------------------ what it is

    @property
    def applications(self) -> Mapping[int, Application]:
        """The stored applications by id."""
        return self._applications

    @property
    def active_application(self) -> int:
        """Id of the loaded application; the old one during a switch."""
        return self._active.id

    @property
    def mode(self) -> Mode:
        """What it is doing."""
        return self._mode

    @property
    def running(self) -> bool:
        """Whether it is in run mode."""
        return self._mode is Mode.RUNNING

    @property
    def processing(self) -> bool:
        """Whether an inspection is under way."""
        return self._run is not None

    @property
    def rebooting(self) -> bool:
        """Whether it is off the network because it restarts."""
        return self._mode is Mode.REBOOTING

    @property
    def connected(self) -> bool:
        """Whether a client has a session."""
        return self._session

    @property
    def endian(self) -> int:
        """The status message's endian field: 0 little, 1 big."""
        return self._endian

    @property
    def next_number(self) -> int:
        """Sequence number of the next run."""
        return self._next_number

    @property
    def queued_inputs(self) -> int:
        """Input containers that wait for an inspection."""
        return len(self._queue)

    @property
    def time(self) -> float:
        """Seconds since the device was made."""
        return self._now / NANOSECONDS

    @property
    def clock_time(self) -> datetime:
        """What its clock shows; the zone means nothing."""
        passed = timedelta(microseconds=(self._now - self._clock_set_at) // 1000)
        try:
            return self._clock + passed
        except OverflowError:
            return datetime.max.replace(tzinfo=UTC)

    @property
    def status(self) -> Status:
        """The status word.

        Source: SC manual p. 30 and p. 33 (published); BUSY during an inspection is a quirk; a
        camera with a System Error takes no trigger (inferred).
        """
        word = self._conditions
        if self._mode is Mode.SWITCHING:
            word |= Status.BUSY
        if self._mode is Mode.RUNNING:
            word |= Status.RUNNING
            if self._run is not None:
                word |= Status.BUSY if self.quirks.busy_while_processing else Status(0)
            elif self._active.triggered and not self._faulty:
                word |= Status.WAITING_FOR_TRIGGER
        return word

    # ------------------------------------------------------------------ the wire

    def handle(self, message: m.Message) -> None:
        """Take a message of the client; without a session everything but Connect is ignored.

        The caller sees to it that only one client's messages come here. Never raises.
        """
        if self._mode is Mode.REBOOTING:
            return
        if isinstance(message, m.Connect):
            self.connect()
        elif isinstance(message, m.Disconnect):
            self.disconnect()
        elif self._session:
            self._obey(message)
        self._advance(self._now)

    def connect(self) -> None:
        """Begin a session: the answer, then a status, whatever it is.

        Source: SC manual p. 28, 29 (published).
        """
        self._session = True
        self._output = [m.ConnectAnswer(version=PROTOCOL_VERSION)]
        self._reported = None
        self._report()

    def disconnect(self) -> None:
        """End the session; the camera goes on with what it does, in silence.

        Source: SC manual p. 28 (published for the silence); that its state survives is inferred.
        """
        self._session = False
        self._output = []

    def take_output(self) -> list[m.Message]:
        """Return what the camera said since the last call, in order; the caller owns the list."""
        output, self._output = self._output, []
        return output

    def tick(self, dt: float) -> None:
        """Let ``dt`` seconds pass; what happens in them happens at its own instant.

        Raises:
            ConfigurationError: a negative time.
        """
        if not dt >= 0:
            raise ConfigurationError(f"device: the time goes forwards, got {dt} s")
        self._advance(self._now + _ns(dt))

    def next_event_in(self) -> float | None:
        """Return the seconds until something happens by itself, None where nothing will."""
        if not self._events:
            return None
        return max(0, min(self._events.values()) - self._now) / NANOSECONDS

    # ------------------------------------------------------------------ the operator

    def start(self) -> None:
        """Enter run mode, as by the camera's own pages."""
        with self.around():
            self._enter_run_mode()
            self._advance(self._now)

    def stop(self) -> None:
        """Leave run mode, as by the camera's own pages."""
        with self.around():
            self._leave_run_mode()

    def trigger(self) -> bool:
        """Trigger by the digital input; True if an inspection began."""
        with self.around():
            taken = self._trigger()
            self._advance(self._now)
        return taken

    def switch_application(self, application: int, *, running: bool = False) -> bool:
        """Load another application behind the client's back.

        It is stopped for that, whatever the quirks say about a client's switch.

        Args:
            application: its id.
            running: enter run mode when it is loaded.

        Returns:
            False if the camera is switching or rebooting already.

        Raises:
            ConfigurationError: no application has that id.
        """
        target = self._applications[self._known(application)]
        with self.around():
            if self._mode in {Mode.SWITCHING, Mode.REBOOTING}:
                return False
            self._load(target, answer=False, running=running)
            self._advance(self._now)
        return True

    def reboot(self) -> None:
        """Restart the camera, as by its power switch."""
        with self.around():
            self._reboot()

    def set_condition(self, condition: Status, on: bool) -> None:  # noqa: FBT001
        """Set or clear Overheat or System Error.

        With a System Error the inspection under way is void, and none begins until it is cleared
        (inferred); a reboot clears it.

        Raises:
            ConfigurationError: another bit; those follow from what the camera does.
        """
        if condition & ~OPERATOR_CONDITIONS:
            raise ConfigurationError(
                f"device: only {OPERATOR_CONDITIONS.describe()} can be set, "
                f"got {condition.describe()}"
            )
        with self.around():
            self._conditions = self._conditions | condition if on else self._conditions & ~condition
            if self._faulty:
                self._void_run()
            self._report()

    def set_endian(self, endian: int) -> None:
        """Set the byte order of result containers and input data: 0 little, 1 big.

        Other values are reported as they are and build little endian.
        """
        with self.around():
            self._endian = endian
            self._report()

    # ------------------------------------------------------------------ requests

    def _obey(self, message: m.Message) -> None:
        match message:
            case m.Query():
                self._say(m.QueryAnswer(application=self._active.id))
            case m.SwitchApplication(application=application):
                self._switch(application)
            case m.GetClock():
                self._say(self._clock_answer())
            case m.SetClock():
                self._take_clock(message)
            case m.SetInput(data=data):
                self._take_input(data)
            case m.SetSequenceNumber(number=number):
                self._next_number = number
            case m.Trigger():
                self._trigger()
            case m.Start():
                self._enter_run_mode()
            case m.Stop():
                self._leave_run_mode()
            case m.Reboot():
                self._reboot()
            case _:
                pass  # an unknown message is ignored in silence (SC manual p. 28, published)

    def _enter_run_mode(self) -> None:
        if self._mode is not Mode.STOPPED:
            return
        self._mode = Mode.RUNNING
        if not self._active.triggered:
            self._free_origin, self._free_count = self._now, 0
            self._events[_Event.FREE_RUN] = self._now
        self._report()

    def _leave_run_mode(self) -> None:
        if self._mode is not Mode.RUNNING:
            return
        self._mode = Mode.STOPPED
        self._void_run()
        self._events.pop(_Event.FREE_RUN, None)
        self._report()

    def _trigger(self) -> bool:
        """Begin an inspection, or drop the trigger and say so.

        A stopped, switching or untriggered application ignores it (mvBlueGEMINI manual p. 31 and
        the newest SC manual p. 48, published).
        """
        if self._mode is not Mode.RUNNING or not self._active.triggered or self._faulty:
            return False
        if self._run is not None:
            self._conditions |= Status.OVERTRIGGERED
            self._schedule(_Event.OVERTRIGGER_ENDS, self.quirks.overtriggered_time)
            self._report()
            return False
        self._begin_run()
        return True

    def _switch(self, application: int) -> None:
        if self._mode is Mode.SWITCHING:
            return  # not answered: inferred
        target = self._applications.get(application)  # 0 is never among them
        how = self.quirks.switch_while_running if self._mode is Mode.RUNNING else "allow"
        if target is None or how == "refuse":
            self._say(m.SwitchAnswer(code=1, application=self._active.id))
        elif how == "allow":
            self._load(target, answer=True, running=False)

    def _load(self, target: Application, *, answer: bool, running: bool) -> None:
        """Begin to load ``target``; the status says BUSY until it is there."""
        self._void_run()
        self._events.pop(_Event.FREE_RUN, None)
        self._mode = Mode.SWITCHING
        self._target, self._answer_switch, self._run_after_load = target, answer, running
        self._schedule(_Event.LOADED, target.load_time)
        self._report()

    def _reboot(self) -> None:
        """Go down: the session is gone without a word.

        Source: mvBlueGEMINI manual p. 31 (published for the sibling).
        """
        if self._mode is Mode.REBOOTING:
            return
        self.disconnect()
        self._mode = Mode.REBOOTING
        self._run = None
        self._events = {}
        self._schedule(_Event.BOOTED, self.quirks.reboot_time)

    # ------------------------------------------------------------------ time

    def _schedule(self, event: _Event, seconds: float) -> None:
        self._events[event] = self._now + _ns(seconds)

    def _advance(self, target: int) -> None:
        """Let everything happen that is due until ``target``."""
        while self._events:
            event, when = min(self._events.items(), key=lambda item: (item[1], item[0]))
            if when > target:
                break
            self._now = max(self._now, when)
            del self._events[event]
            self._happen(event)
        self._now = target

    def _happen(self, event: _Event) -> None:
        match event:
            case _Event.INSPECTED:
                self._finish_run()
            case _Event.OVERTRIGGER_ENDS:
                self._conditions &= ~Status.OVERTRIGGERED
                self._report()
            case _Event.LOADED:
                self._finish_load()
            case _Event.BOOTED:
                self._finish_boot()
            case _Event.FREE_RUN:
                self._begin_free_run()

    def _finish_load(self) -> None:
        if self._target is not None:
            self._active, self._target = self._target, None
        self._forget_inputs()
        self._runs = 0
        self._mode = Mode.STOPPED
        answer = m.SwitchAnswer(code=0, application=self._active.id)
        before = self.quirks.switch_answer == "before_status"
        if self._answer_switch and before:
            self._say(answer)
        self._report()
        if self._answer_switch and not before:
            self._say(answer)
        if self._run_after_load:
            self._enter_run_mode()

    def _finish_boot(self) -> None:
        """Come up: the last application, stopped; numbering at 0, the clock is lost.

        Source: newest SC manual p. 48 (numbering) and BVS ID guide p. 231 (clock), published;
        stopped, and a cleared System Error: inferred.
        """
        self._mode = Mode.STOPPED
        self._target = None
        self._forget_inputs()
        self._conditions &= Status.OVERHEAT
        self._next_number = self._runs = 0
        self._set_clock(LOST_CLOCK)

    # ------------------------------------------------------------------ inspections

    @property
    def _faulty(self) -> bool:
        return bool(self._conditions & Status.SYSTEM_ERROR)

    @property
    def _byte_order(self) -> ByteOrder:
        return "big" if self._endian == 1 else "little"

    def _begin_free_run(self) -> None:
        """Begin the run that is due and plan the next, counted from the start: no drift."""
        self._free_count += 1
        rate = self._active.rate or 1.0
        self._events[_Event.FREE_RUN] = self._free_origin + _ns(self._free_count / rate)
        if not self._faulty:
            self._begin_run()

    def _begin_run(self) -> None:
        """Take the next number and the next input container."""
        number, self._next_number = self._next_number, (self._next_number + 1) % _NUMBERS
        application = self._active
        self._run = Run(
            number=number,
            index=self._runs,
            time=self.time,
            layout=application.result_layout,
            scene=self.scene,
            input=self._next_input(),
            parameters=application.parameters,
        )
        self._runs += 1
        self._schedule(_Event.INSPECTED, application.processing_time)
        self._report()

    def _finish_run(self) -> None:
        """Send the result, then Waiting for Trigger rises again (the order is a quirk)."""
        run, self._run = self._run, None
        result = self._result(run) if run is not None else None
        if self.quirks.waiting_before_result:
            self._report()
        if result is not None:
            self._say(result)
        self._report()

    def _result(self, run: Run) -> m.ResultContainer | None:
        application = self._active
        try:
            data = application.container(run, self._byte_order)
        except Exception:  # a generator is somebody's code; the camera goes on without a result
            _log.exception("! application %d, run %d: no result", application.id, run.number)
            return None
        return None if data is None else m.ResultContainer(application=application.id, data=data)

    def _void_run(self) -> None:
        """Drop the inspection under way: no result comes from it (inferred)."""
        self._run = None
        self._events.pop(_Event.INSPECTED, None)

    # ------------------------------------------------------------------ input data

    def _take_input(self, data: bytes) -> None:
        """Queue a container; one that does not fit the layout is dropped (inferred).

        Source: SC manual p. 30 and p. 33 (published) for the queue and its status bit.
        """
        layout = self._active.input_layout
        if layout is None or self._mode is Mode.SWITCHING:
            return
        try:
            values: Any = layout.parse(data, self._byte_order)
        except InterpretationError as exc:
            _log.debug("= input data dropped: %s", exc)
            return
        if len(self._queue) == self.quirks.input_queue_depth:
            self._queue.popleft()
            self._conditions |= Status.INPUT_CONTAINER
            self._report()
        self._queue.append(values._asdict())

    def _next_input(self) -> Mapping[str, Any] | None:
        """Take a container from the queue, or the last one again; keep the status bit in step."""
        if self._active.input_layout is None:
            return None
        if self._queue:
            self._last_input = self._queue.popleft()
            self._conditions &= ~Status.INPUT_CONTAINER
        else:
            self._conditions |= Status.INPUT_CONTAINER
        return self._last_input

    def _forget_inputs(self) -> None:
        """A newly loaded application has an empty queue (inferred)."""
        self._queue.clear()
        self._last_input = None
        self._conditions &= ~Status.INPUT_CONTAINER

    # ------------------------------------------------------------------ the clock

    def _set_clock(self, time: datetime) -> None:
        self._clock = time.replace(tzinfo=UTC)
        self._clock_set_at = self._now

    def _take_clock(self, message: m.SetClock) -> None:
        """Set the clock; what is no time is dropped.

        Source: mvBlueGEMINI manual p. 30 (published): invalid values may be dropped or converted.
        """
        try:
            time = datetime(
                message.year,
                message.month,
                message.day,
                message.hour,
                message.minute,
                message.second,
                tzinfo=UTC,
            )
        except (ValueError, OverflowError):
            return
        self._set_clock(time)

    def _clock_answer(self) -> m.ClockAnswer:
        time = self.clock_time
        return m.ClockAnswer(
            year=time.year,
            month=time.month,
            day=time.day,
            hour=time.hour,
            minute=time.minute,
            second=time.second,
        )

    # ------------------------------------------------------------------ output

    def _say(self, message: m.Message) -> None:
        if self._session:
            self._output.append(message)

    def _report(self) -> None:
        """Send the status if it differs from the one the client has."""
        now = (self.status, self._endian)
        if now != self._reported:
            self._reported = now
            self._say(m.StatusReport(status=now[0], endian=now[1]))

    def _known(self, application: int) -> int:
        if application not in self._applications:
            known = ", ".join(str(key) for key in self._applications)
            raise ConfigurationError(f"no application has the id {application}; there are {known}")
        return application


def _by_id(applications: Iterable[Application]) -> dict[int, Application]:
    table: dict[int, Application] = {}
    for application in applications:
        if application.id in table:
            raise ConfigurationError(f"application id {application.id} is there twice")
        table[application.id] = application
    if not table:
        raise ConfigurationError("a camera needs at least one application")
    return table
