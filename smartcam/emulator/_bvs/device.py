"""Model the device of an emulated camera; the caller advances the device's time.

It knows no socket, loop or clock. Messages of the active session go in by :meth:`Device.handle`,
time by :meth:`Device.tick`; the camera's messages are taken with :meth:`Device.take_output`.

Internally, time is in whole nanoseconds. Future events are in one small table, with one instant for
each kind of event; events at the same instant happen in the order of :class:`_Event`.

Facts stand in ``docs/protocol.md``. Where the documents are silent, a field of
:class:`~smartcam.emulator.Quirks` decides, or the choice is marked *inferred* in this module.
"""

from __future__ import annotations

import enum
import functools
import logging
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._arguments import (
    check_application,
    check_flag,
    check_integer,
    check_kind,
    check_seconds,
    check_seconds_or_none,
)
from smartcam._user_code import ENDS_PROGRAM
from smartcam.emulator._bvs.behaviour import SMART_CAMERA, Behaviour
from smartcam.emulator._bvs.clock_and_input import LOST_CLOCK, CalendarClock, InputQueue, RunFaults
from smartcam.emulator._bvs.quirks import Quirks
from smartcam.emulator._clock import NANOSECONDS, nanoseconds
from smartcam.emulator._inspected import InspectedApplication, InspectionOrder
from smartcam.emulator._scenario.states import DeviceState, risen_states
from smartcam.emulator._scene import TableScene
from smartcam.exceptions import ConfigurationError, InterpretationError
from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.protocols._inside import ResultCode

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from contextlib import AbstractContextManager
    from datetime import datetime

    from smartcam.emulator._application import Application
    from smartcam.emulator._generators import Values
    from smartcam.emulator._inspected import Inspector
    from smartcam.models import ByteOrder

_log = logging.getLogger("smartcam.emulator")

PROTOCOL_VERSION = 1
"""The protocol version in the answer to Connect (SC manual p. 29, published)."""

OPERATOR_CONDITIONS = Status.OVERHEAT | Status.SYSTEM_ERROR
"""Bits that only an operator sets, by :meth:`Device.set_condition`."""

_DATA_KEY = "data"  # key of input data that is passed to an inspector unread

_NUMBER_COUNT = 1 << 32  # sequence numbers are UINT32

# the status is a plain number, since each step of an IntFlag costs a call
_BUSY = Status.BUSY.value
_RUNNING = Status.RUNNING.value
_WAITING = Status.WAITING_FOR_TRIGGER.value
_OVERTRIGGERED = Status.OVERTRIGGERED.value
_OVERHEAT = Status.OVERHEAT.value
_SYSTEM_ERROR = Status.SYSTEM_ERROR.value
_INPUT_CONTAINER = Status.INPUT_CONTAINER.value


class Mode(enum.Enum):
    """The activity of the camera."""

    STOPPED = "stopped"
    RUNNING = "running"
    SWITCHING = "switching"
    REBOOTING = "rebooting"


class _Event(enum.IntEnum):
    """Kinds of future events, in their order at one instant."""

    INSPECTED = 0
    OVERTRIGGER_ENDS = 1
    LOADED = 2
    BOOTED = 3
    BUSY_ENDS = 4
    FREE_RUN = 5

    __hash__ = int.__hash__  # the hash of Enum is a slow function in Python


class _Inspection(NamedTuple):
    """The values of a running inspection that were fixed when it began."""

    number: int
    run_index: int
    time: float
    input: Mapping[str, Any] | None
    faults: RunFaults


class LastReport(NamedTuple):
    """The result of the last run that had one, even if no client received it."""

    time: float  # seconds
    byte_order: ByteOrder
    result: m.ResultContainer


MAX_EXTRA = 1000
"""Largest number of copies of one run's container that a fault may send."""


class Device:
    """One camera.

    Args:
        applications: the programs stored on it; at least one, with different ids.
        active: id of the loaded application; by default that of the first one.
        running: True for run mode from the beginning.
        quirks: assumptions about unknown behaviour of real cameras.
        clock_time: first time of its clock; a time without a zone is used unchanged.
        scene: the scene that the camera looks at.
        behaviour: behaviour of the camera in its dialect.

    Attributes:
        action_context: every operator's action (:meth:`start`, :meth:`stop`, :meth:`trigger`,
            :meth:`switch_application`, :meth:`reboot`, :meth:`set_condition`, :meth:`set_endian`)
            happens inside this context. A server sets a context that first updates the device's
            time and afterwards sends the messages that the action caused.

    Raises:
        ConfigurationError: no application, one id twice, or ``active`` is not among them.
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
        behaviour: Behaviour = SMART_CAMERA,
    ) -> None:
        self.behaviour: Behaviour = behaviour
        self._applications = _by_id(applications)
        self.quirks: Quirks = quirks or Quirks()
        self.scene: TableScene = scene or TableScene()
        self.action_context: Callable[[], AbstractContextManager[object]] = nullcontext
        self._on_entered: Callable[[DeviceState], None] | None = None
        self._entered_states: list[DeviceState] = []
        self._last_word = 0  # status word when states were last noted
        first = next(iter(self._applications)) if active is None else active
        self._set_active_application(self._applications[self._check_known(first)])
        self._now = 0
        self._mode = Mode.STOPPED
        self._events: dict[_Event, tuple[int, Callable[[], None]]] = {}
        self._has_session = False
        self.sessions: int = 0
        self._switch_answer_due = False  # an answer to a switch is due in this session
        self.last_report: LastReport | None = None
        self._output: list[m.Message] = []
        self._last_sent: tuple[int, int] | None = None
        self._conditions = 0
        self._endian = 0
        self._next_number = 0
        self._processing = False
        self._inspector: Inspector | None = None  # inspector of the present run
        self._held_busy = False
        self._triggers_to_drop = 0  # number of triggers still to be dropped
        self._run_faults = RunFaults()  # faults of the running inspection, or else of the next one
        # a reference value (BVS ID) is kept until the next one, and is not queued
        depth = 1 if behaviour.acknowledges else self.quirks.input_queue_depth
        self._inputs = InputQueue(depth)
        self._clock = CalendarClock(clock_time, self._now)
        if running or behaviour.runs_always:
            self._enter_run_mode()

    # ------------------------------------------------------------------ properties

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
        """Mode of the device, such as stopped or running."""
        return self._mode

    @property
    def running(self) -> bool:
        """True in run mode."""
        return self._mode is Mode.RUNNING

    @property
    def processing(self) -> bool:
        """True while an inspection is running."""
        return self._processing

    @property
    def rebooting(self) -> bool:
        """True while the device is off the network because it restarts."""
        return self._mode is Mode.REBOOTING

    @property
    def connected(self) -> bool:
        """True while a client has a session."""
        return self._has_session

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
        return len(self._inputs)

    @property
    def time(self) -> float:
        """Seconds since the device was made."""
        return self._now / NANOSECONDS

    @property
    def clock_time(self) -> datetime:
        """Time that the device's clock shows; the zone has no meaning."""
        return self._clock.read(self._now)

    @property
    def status(self) -> Status:
        """The status word.

        Source: SC manual p. 30 and p. 33 (published); BUSY during an inspection is a quirk; that
            a camera with a System Error accepts no trigger is inferred.
        """
        return Status(self._status_word())

    def _status_word(self) -> int:
        word = self._conditions
        mode = self._mode
        if mode is Mode.SWITCHING or self._held_busy:
            word |= _BUSY
        if self.behaviour.runs_always and (mode is not Mode.RUNNING or self._has_system_error):
            word |= _BUSY  # not Ready
        if mode is Mode.RUNNING:
            word |= _RUNNING
            if self._processing:
                word |= _BUSY if self.quirks.busy_while_processing else 0
                word |= _WAITING if self.quirks.hidden_triggers else 0
            elif self._active.rate is None and not (word & _SYSTEM_ERROR or self._held_busy):
                word |= _WAITING
        return word

    # ------------------------------------------------------------------ the wire

    def handle(self, message: m.Message) -> None:
        """Handle a message of the client; without a session only Connect has an effect.

        The caller must pass only one client's messages. Never raises.
        """
        if self._mode is Mode.REBOOTING:
            return
        if isinstance(message, m.Connect):
            self.connect()
        elif isinstance(message, m.Disconnect):
            is_answered = self._has_session and self.behaviour.answers_disconnect
            self.disconnect()
            self._output = [m.DisconnectAnswer()] if is_answered else []
        elif self._has_session:
            self._handle_request(message)
        self._advance(self._now)

    def connect(self) -> None:
        """Begin a session: send the answer, then the status if the dialect sends one.

        Source: SC manual p. 28, 29 (published); no status in dialect ``bid``: inferred.
        """
        self._has_session, self._switch_answer_due = True, False
        self.sessions += 1
        self._note_entered(DeviceState.CONNECTED)
        self._output = [m.ConnectAnswer(version=PROTOCOL_VERSION)]
        self._last_sent = None
        if self.behaviour.status_with_session:
            self._send_changed_status()
        else:
            self._last_sent = (self._status_word(), self._endian)

    def disconnect(self) -> None:
        """End the session; the camera continues without sending anything.

        Source: SC manual p. 28 (published for the silence); that its state survives is inferred.
        """
        if self._has_session:
            self._note_entered(DeviceState.DISCONNECTED)
        self._has_session = self._switch_answer_due = False  # only the asking client gets an answer
        self._output = []

    def watch(self, on_entered: Callable[[DeviceState], None]) -> None:
        """Call a function for every state that the device enters from now on.

        The function is called right after the event that led to the state; after a message or an
        operator's action, the next :meth:`report_entered` calls it.
        """
        self._on_entered = on_entered
        self._last_word = self._status_word()

    def report_entered(self) -> None:
        """Call the function of :meth:`watch` for each state entered since the last call."""
        while self._entered_states and self._on_entered is not None:
            states, self._entered_states = self._entered_states, []
            for state in states:
                self._on_entered(state)

    def take_output(self) -> list[m.Message]:
        """Return the camera's messages since the last call, in order; the caller owns the list."""
        output, self._output = self._output, []
        return output

    def tick(self, dt: float) -> None:
        """Let ``dt`` seconds pass; each event happens at its own instant.

        Raises:
            ConfigurationError: a negative time.
        """
        dt = check_seconds(dt, "dt", "device")
        self._advance(self._now + nanoseconds(dt))

    def next_event_in(self) -> float | None:
        """Return the seconds until the next scheduled event, None without one."""
        if not self._events:
            return None
        return max(0, min(when for when, _ in self._events.values()) - self._now) / NANOSECONDS

    # ------------------------------------------------------------------ the operator

    def start(self) -> None:
        """Enter run mode, as by the camera's own pages."""
        with self.action_context():
            self._enter_run_mode()
            self._advance(self._now)

    def stop(self) -> None:
        """Leave run mode, as by the camera's own pages."""
        with self.action_context():
            self._leave_run_mode()

    def trigger(self) -> bool:
        """Trigger by the digital input; return True if an inspection began."""
        with self.action_context():
            taken = self._trigger()
            self._advance(self._now)
        return taken

    def switch_application(self, application: int, *, running: bool = False) -> bool:
        """Load another application without the client's knowledge.

        The application is stopped first, regardless of quirks of a client's switch.

        Args:
            application: id of the application to load.
            running: enter run mode when it is loaded.

        Returns:
            False if the camera is switching or rebooting already.

        Raises:
            ConfigurationError: no application has that id.
        """
        application = check_application(application, owner="device")
        running = check_flag(running, "running", "device")
        target = self._applications[self._check_known(application)]
        with self.action_context():
            if self._mode in {Mode.SWITCHING, Mode.REBOOTING}:
                return False
            self._load(target, answer=False, running=running)
            self._advance(self._now)
        return True

    def reboot(self, seconds: float | None = None) -> None:
        """Restart the camera, as by its power switch.

        Args:
            seconds: until the restart is done; None: the quirk ``reboot_time``.
        """
        seconds = check_seconds_or_none(seconds, "seconds", "device")
        with self.action_context():
            self._reboot(seconds)

    def set_condition(self, condition: Status, on: bool) -> None:
        """Set or clear Overheat or System Error.

        With a System Error the running inspection is void, and none begins until it is cleared
        (inferred); a reboot clears it.

        Raises:
            ConfigurationError: another bit, which only the camera's state sets.
        """
        condition = check_kind(condition, Status, "condition", "a Status", "device")
        on = check_flag(on, "on", "device")
        if condition & ~OPERATOR_CONDITIONS:
            raise ConfigurationError(
                f"device: only {OPERATOR_CONDITIONS} can be set, got {condition}"
            )
        with self.action_context():
            bits = condition.value
            self._conditions = self._conditions | bits if on else self._conditions & ~bits
            if self._has_system_error:
                self._void_run()
            self._send_changed_status()

    def set_endian(self, endian: int) -> None:
        """Set the byte order of result containers and input data: 0 little, 1 big.

        Other values are reported unchanged, and containers are little endian.
        """
        endian = check_integer(endian, "endian", 0, 0xFFFFFFFF, "device")
        with self.action_context():
            self._endian = endian
            self._send_changed_status()

    # ------------------------------------------------------------------ faults

    def hold_busy(self, seconds: float | None = None) -> None:
        """Set BUSY and keep it; no inspection begins meanwhile.

        Args:
            seconds: duration; None: until a reboot or :meth:`end_faults`.
        """
        seconds = check_seconds_or_none(seconds, "seconds", "device")
        with self.action_context():
            if self._mode is Mode.REBOOTING:
                return
            self._held_busy = True
            self._events.pop(_Event.BUSY_ENDS, None)
            if seconds is not None:
                self._after(seconds, _Event.BUSY_ENDS, self._end_busy)
            self._send_changed_status()
            self._advance(self._now)

    def drop_triggers(self, count: int) -> None:
        """Drop the next ``count`` triggers, as if the last image were still being analysed."""
        self._triggers_to_drop += check_integer(count, "count", 0, owner="device")

    def change_inspection(
        self, *, late: float = 0.0, no_result: bool = False, extra: int = 0
    ) -> None:
        """Change the running inspection, or else the next one.

        Args:
            late: seconds by which the inspection takes longer.
            no_result: True for an inspection without a result.
            extra: number of times that the inspection's container is sent again.
        """
        late = check_seconds(late, "late", "device")
        no_result = check_flag(no_result, "no_result", "device")
        extra = check_integer(extra, "extra", 0, MAX_EXTRA, "device")
        with self.action_context():
            self._run_faults.delay += nanoseconds(late)
            self._run_faults.no_result |= no_result
            self._run_faults.extra_copies += extra
            if _Event.INSPECTED in self._events:
                when, action = self._events[_Event.INSPECTED]
                self._events[_Event.INSPECTED] = (when + nanoseconds(late), action)

    def end_faults(self) -> None:
        """Undo all faults: BUSY is cleared, and triggers are accepted again."""
        with self.action_context():
            self._forget_faults()
            self._send_changed_status()

    def _end_busy(self) -> None:
        self._held_busy = False
        self._send_changed_status()

    def _forget_faults(self) -> None:
        self._held_busy = False
        self._events.pop(_Event.BUSY_ENDS, None)
        self._triggers_to_drop = 0
        self._run_faults = RunFaults()

    # ------------------------------------------------------------------ requests

    def _handle_request(self, message: m.Message) -> None:
        match message:
            case m.Trigger():
                if self.behaviour.acknowledges:
                    self._acknowledge(message, self._ready_code)
                self._trigger()
            case m.Query():
                self._send(self._make_query_answer())
            case m.SwitchApplication(application=application):
                self._switch(application)
            case m.GetClock():
                code = ResultCode.OK_DATE_TIME if self.behaviour.coded else 0
                self._send(self._clock.answer(self._now, code=code))
            case m.SetClock():
                is_done = self._clock.set(message, self._now)
                self._acknowledge(message, ResultCode.OK if is_done else ResultCode.ERROR)
            case m.SetInput(data=data):
                is_done = self._take_input(data)
                self._acknowledge(message, ResultCode.OK if is_done else ResultCode.ERROR)
            case m.SetSequenceNumber(number=number):
                self._next_number = number
            case m.Start():
                self._enter_run_mode()
            case m.Stop():
                self._leave_run_mode()
            case m.Reboot():
                self._reboot()
            case m.GetStatus():
                self._send_status()
            case m.ResetErrors():
                self._reset_errors(message)
            case m.UnknownMessage(message_id=message_id):
                self._answer_bad_message(message_id, ResultCode.INVALID_COMMAND)
            case m.MalformedMessage(message_id=message_id):
                self._answer_bad_message(message_id, ResultCode.ERROR)
            case _:
                pass

    def _acknowledge(self, request: m.Request, code: int) -> None:
        """Acknowledge a request, if the dialect acknowledges such requests."""
        answer = request.answer
        if self.behaviour.acknowledges and answer and issubclass(answer, m.Acknowledgement):
            self._send(answer(code=code))

    def _answer_bad_message(self, message_id: int, code: int) -> None:
        """Answer a bad message with a result code; a smart camera ignores it (SC manual p. 28)."""
        if self.behaviour.answers_bad_messages:
            self._send(m.UnknownMessage(message_id=message_id, payload=code.to_bytes(2, "little")))

    @property
    def _ready_code(self) -> int:
        return ResultCode.BUSY if self._status_word() & _BUSY else ResultCode.OK

    def _make_query_answer(self) -> m.QueryAnswer:
        """Return the answer to a Query; with ``bid`` it is BUSY while an application is loaded."""
        if self.behaviour.acknowledges and self._mode is Mode.SWITCHING:
            return m.QueryAnswer(code=ResultCode.BUSY, application=0)
        code = ResultCode.OK_INSPECTION_ID if self.behaviour.coded else 0
        return m.QueryAnswer(code=code, application=self._active.id)

    def _reset_errors(self, request: m.ResetErrors) -> None:
        """Clear the sticky bits; a status follows in any case (BVS ID guide p. 227)."""
        self._conditions &= ~(_OVERTRIGGERED | _INPUT_CONTAINER)
        self._acknowledge(request, ResultCode.OK)
        self._send_status()

    def _enter_run_mode(self) -> None:
        if self._mode is not Mode.STOPPED:
            return
        self._set_mode(Mode.RUNNING)
        if not self._active.triggered:
            self._plan_free_run(self._now, 0)
        self._send_changed_status()

    def _leave_run_mode(self) -> None:
        if self._mode is not Mode.RUNNING:
            return
        self._set_mode(Mode.STOPPED)
        self._void_run()
        self._events.pop(_Event.FREE_RUN, None)
        self._send_changed_status()

    def _trigger(self) -> bool:
        """Begin an inspection, or drop the trigger and report that.

        A camera that is stopped or switching ignores the trigger, and so does an application that
        runs free (mvBlueGEMINI manual p. 31 and the newest SC manual p. 48, published).
        """
        if self._mode is not Mode.RUNNING or not self._active.triggered or not self._can_run:
            return False
        if self._processing or self._triggers_to_drop:
            self._triggers_to_drop = max(0, self._triggers_to_drop - 1)
            self._conditions |= _OVERTRIGGERED
            if not self.behaviour.sticky_errors:
                self._after(
                    self.quirks.overtriggered_time, _Event.OVERTRIGGER_ENDS, self._end_overtrigger
                )
            self._send_changed_status()
            return False
        self._begin_run()
        return True

    def _switch(self, application: int) -> None:
        runs_always = self.behaviour.runs_always
        if runs_always and self._status_word() & _BUSY:
            self._send(m.SwitchAnswer(code=ResultCode.BUSY, application=self._active.id))
            return
        if self._mode is Mode.SWITCHING:
            return  # that it is not answered is inferred
        target = self._applications.get(application)  # no application has id 0
        stopped = runs_always or self._mode is not Mode.RUNNING
        policy = "allow" if stopped else self.quirks.switch_while_running
        if target is None or policy == "refuse":
            self._send(
                m.SwitchAnswer(code=self.behaviour.refusal_code, application=self._active.id)
            )
        elif policy == "allow":
            self._load(target, answer=True, running=False)

    def _load(self, target: Application, *, answer: bool, running: bool) -> None:
        """Begin to load ``target``; the status has BUSY until it is loaded."""
        self._void_run()
        self._events.pop(_Event.FREE_RUN, None)
        self._set_mode(Mode.SWITCHING)
        self._switch_answer_due = answer
        finish = functools.partial(self._finish_load, target, running=running)
        self._after(target.load_time, _Event.LOADED, finish)
        self._send_changed_status()

    def _reboot(self, seconds: float | None = None) -> None:
        """Restart: the session ends without a message.

        Source: mvBlueGEMINI manual p. 31 (published for a related camera).
        """
        if self._mode is Mode.REBOOTING:
            return
        self.disconnect()
        self._set_mode(Mode.REBOOTING)
        self._void_run()
        self._events = {}
        self._forget_faults()
        duration = self.quirks.reboot_time if seconds is None else seconds
        self._after(duration, _Event.BOOTED, self._finish_boot)

    # ------------------------------------------------------------------ time

    def _after(self, seconds: float, event: _Event, action: Callable[[], None]) -> None:
        self._events[event] = (self._now + nanoseconds(seconds), action)

    def _advance(self, target: int) -> None:
        """Run all events that are due until ``target``."""
        while self._events:
            when, event = min([(row[0], event) for event, row in self._events.items()])
            if when > target:
                break
            _, action = self._events.pop(event)
            self._now = max(self._now, when)
            action()
            if self._entered_states:
                self.report_entered()
        self._now = target

    def _end_overtrigger(self) -> None:
        self._conditions &= ~_OVERTRIGGERED
        self._send_changed_status()

    def _set_active_application(self, application: Application) -> None:
        """Make an application the active one."""
        self._active = application
        self._period = application.repeat_after
        self._containers: dict[tuple[int, ByteOrder], m.ResultContainer] = {}
        self._runs = 0  # runs since the application was loaded

    def _finish_load(self, target: Application, *, running: bool) -> None:
        self._set_active_application(target)
        self._forget_inputs()
        self._set_mode(Mode.STOPPED)
        message = m.SwitchAnswer(code=0, application=target.id)
        answer, self._switch_answer_due = self._switch_answer_due, False
        before = self.quirks.switch_answer == "before_status"
        if answer and before:
            self._send(message)
        self._send_changed_status()
        if answer and not before:
            self._send(message)
        if running or self.behaviour.runs_always:
            self._enter_run_mode()

    def _finish_boot(self) -> None:
        """End a restart: the last application is stopped, numbers begin at 0, the clock is lost.

        Source: newest SC manual p. 48 (numbering) and BVS ID guide p. 231 (clock), published;
        stopped, and a cleared System Error: inferred.
        """
        self._set_mode(Mode.STOPPED)
        self._forget_inputs()
        self._conditions &= _OVERHEAT
        self._next_number = self._runs = 0
        self._clock = CalendarClock(LOST_CLOCK, self._now)
        if self.behaviour.runs_always:
            self._enter_run_mode()

    # ------------------------------------------------------------------ inspections

    @property
    def _has_system_error(self) -> bool:
        return bool(self._conditions & _SYSTEM_ERROR)

    @property
    def _can_run(self) -> bool:
        return not self._has_system_error and not self._held_busy

    @property
    def _byte_order(self) -> ByteOrder:
        return "big" if self._endian == 1 else "little"

    def _plan_free_run(self, origin: int, count: int) -> None:
        """Schedule free run number ``count``; timed from the first run, runs do not drift."""
        when = origin + nanoseconds(count / (self._active.rate or 1.0))
        self._events[_Event.FREE_RUN] = (
            when,
            functools.partial(self._begin_free_run, origin, count),
        )

    def _begin_free_run(self, origin: int, count: int) -> None:
        self._plan_free_run(origin, count + 1)
        if not self._can_run or self._processing:  # the last run is late
            return
        self._begin_run()
        if not self._run_faults.delay and _Event.INSPECTED in self._events:
            # a run never overlaps with the next, whatever the rounding
            (end_at, action), (next_begin, _) = (
                self._events[_Event.INSPECTED],
                self._events[_Event.FREE_RUN],
            )
            self._events[_Event.INSPECTED] = (min(end_at, next_begin), action)

    def _begin_run(self) -> None:
        """Begin a run with the next number and the next input container."""
        faults = self._run_faults
        run = _Inspection(self._next_number, self._runs, self.time, self._next_input(), faults)
        self._next_number = (self._next_number + 1) % _NUMBER_COUNT
        self._runs += 1
        self._processing = True
        self._note_entered(DeviceState.INSPECTING)
        if isinstance(self._active, InspectedApplication):
            self._inspect(self._active, run)
        else:
            end_at = self._now + nanoseconds(self._active.processing_time) + faults.delay
            self._events[_Event.INSPECTED] = (end_at, functools.partial(self._finish_run, run))
        self._send_changed_status()

    def _inspect(self, application: InspectedApplication, run: _Inspection) -> None:
        """Start the inspection of a picture; the run ends when it is done."""
        data = b"" if run.input is None else run.input[_DATA_KEY]
        order = InspectionOrder(application.id, run.number, data)
        self._inspector = application.inspector
        application.inspector.begin(order, lambda: None, functools.partial(self._inspected, run))

    def _inspected(self, run: _Inspection, values: Values | None) -> None:
        """Use an inspector's result; a fault may delay the run's end."""
        self._inspector = None
        with self.action_context():
            finish = functools.partial(self._finish_run, run, values)
            self._events[_Event.INSPECTED] = (self._now + run.faults.delay, finish)
            self._advance(self._now)

    def _finish_run(self, run: _Inspection, values: Values | None = None) -> None:
        """Send the result, and set Waiting for Trigger (the order is a quirk)."""
        self._processing = False
        self._run_faults = RunFaults()
        result = self._result(run, values)
        if self.quirks.waiting_before_result:
            self._send_changed_status()
        if result is not None and not run.faults.no_result:
            self.last_report = LastReport(self.time, self._byte_order, result)
            for _ in range(1 + run.faults.extra_copies):
                self._send(result)
        self._send_changed_status()

    def _result(self, run: _Inspection, values: Values | None) -> m.ResultContainer | None:
        """Return the result; equal results of an application are built only once."""
        if self._period is None:
            return self._build_result(run, values)
        key = (run.run_index % self._period, self._byte_order)
        result = self._containers.get(key)
        if result is None:
            result = self._build_result(run, values)
            if result is not None:
                self._containers[key] = result
        return result

    def _build_result(self, run: _Inspection, values: Values | None) -> m.ResultContainer | None:
        application = self._active
        order = self._byte_order
        try:
            if not isinstance(application, InspectedApplication):
                data = application.container(
                    number=run.number,
                    run_index=run.run_index,
                    time=run.time,
                    scene=self.scene,
                    values=run.input,
                    byte_order=order,
                )
            elif values is not None:
                data = application.container_of(values, number=run.number, byte_order=order)
            else:
                data = None  # the inspection failed
        except ENDS_PROGRAM:
            raise
        except BaseException:  # noqa: BLE001  a generator is somebody's code; the camera goes on
            _log.exception("! application %d, run %d: no result", application.id, run.number)
            return None
        return None if data is None else m.ResultContainer(application=application.id, data=data)

    def _void_run(self) -> None:
        """Drop the running inspection: it gives no result (inferred)."""
        if self._processing:
            self._run_faults = RunFaults()
        self._processing = False
        self._events.pop(_Event.INSPECTED, None)
        inspector, self._inspector = self._inspector, None
        if inspector is not None:
            inspector.cancel()

    # ------------------------------------------------------------------ input data

    def _take_input(self, data: bytes) -> bool:
        """Queue a container; return False if it is dropped, since it does not fit (inferred)."""
        values = None if self._mode is Mode.SWITCHING else self._read_input(data)
        if values is None:
            return False
        if not self._inputs.put(values):
            self._set_input_bit(is_in_step=False)
            self._send_changed_status()
        return True

    def _read_input(self, data: bytes) -> Mapping[str, Any] | None:
        """Return the values of input data; None if the application takes no such data."""
        if isinstance(self._active, InspectedApplication):
            return {_DATA_KEY: data}
        layout = self._active.input_layout
        if layout is None:
            return None
        try:
            values: Any = layout.parse(data, self._byte_order)
        except InterpretationError as exc:
            _log.debug("= input data dropped: %s", exc)
            return None
        inputs: Mapping[str, Any] = values._asdict()
        return inputs

    def _next_input(self) -> Mapping[str, Any] | None:
        inspected = isinstance(self._active, InspectedApplication)
        if inspected and not self._inputs.was_given:
            return None  # a program may use no input data
        if not inspected and self._active.input_layout is None:
            return None
        values, is_in_step = self._inputs.take()
        self._set_input_bit(is_in_step=is_in_step)
        return values

    def _set_input_bit(self, *, is_in_step: bool) -> None:
        """Set Input Container if containers and inspections are out of step, else clear it.

        A reference value is not queued, so it cannot get out of step.
        """
        self._conditions &= ~_INPUT_CONTAINER
        if not is_in_step and not self.behaviour.acknowledges:
            self._conditions |= _INPUT_CONTAINER

    def _forget_inputs(self) -> None:
        """Empty the queue, as for a newly loaded application (inferred)."""
        self._inputs.clear()
        self._set_input_bit(is_in_step=True)

    # ------------------------------------------------------------------ output

    def _send(self, message: m.Message) -> None:
        if self._has_session:
            self._output.append(message)

    def _note_entered(self, state: DeviceState) -> None:
        if self._on_entered is not None:
            self._entered_states.append(state)

    def _set_mode(self, mode: Mode) -> None:
        self._mode = mode
        self._note_entered(DeviceState(mode.value))

    def _note_risen_bits(self, word: int) -> None:
        """Note the states whose bits have risen in the status word."""
        risen, self._last_word = word & ~self._last_word, word
        self._entered_states += risen_states(risen)

    def _send_changed_status(self) -> None:
        """Send the status if it differs from the status that was sent last."""
        now = (self._status_word(), self._endian)
        if self._on_entered is not None:
            self._note_risen_bits(now[0])
        if now != self._last_sent and self.behaviour.reports_changes:
            self._last_sent = now
            self._send(_status_report(*now))

    def _send_status(self) -> None:
        """Send the status, even if the client has it already."""
        self._last_sent = now = (self._status_word(), self._endian)
        self._send(_status_report(*now))

    def _check_known(self, application: int) -> int:
        if application not in self._applications:
            known = ", ".join(str(key) for key in self._applications)
            raise ConfigurationError(f"no application has the id {application}; there are {known}")
        return application


@functools.lru_cache(maxsize=64)
def _status_report(word: int, endian: int) -> m.StatusReport:
    return m.StatusReport(status=Status(word), endian=endian)


def _by_id(applications: Iterable[Application]) -> dict[int, Application]:
    table: dict[int, Application] = {}
    for application in applications:
        if application.id in table:
            raise ConfigurationError(f"application id {application.id} is there twice")
        table[application.id] = application
    if not table:
        raise ConfigurationError("a camera needs at least one application")
    return table
