"""Plan a replay from recorded protocol messages, or without these from results; no I/O.

A container belongs to the oldest trigger without a container. Other containers have no trigger of
the client: they come from the digital input, if the application waits for triggers, or from a free
run.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple, cast

from smartcam.exceptions import ConfigurationError, RecordingError
from smartcam.models import (
    ApplicationChanged,
    Connected,
    Disconnected,
    Reconnected,
    Result,
    Status,
    StatusChanged,
)
from smartcam.observers import TraceEntry
from smartcam.protocols import BVS, Transport, Verdict
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK
from smartcam.recording._mcap.form import GAP, RecordedError, status_of
from smartcam.recording._state import RecordedState
from smartcam.registry import PROTOCOLS
from smartcam.settings import is_fleet, parse_address

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from smartcam.protocols import FramedDialect, Protocol
    from smartcam.recording._mcap.form import Item
    from smartcam.recording._reader import RecordedCamera, Recording

CONDITIONS = (Status.OVERHEAT, Status.SYSTEM_ERROR)
"""Bits that an operator of the emulated camera can set; the others follow from its operation."""

MAX_TIME_AFTER_FIRST = 0.1
"""Seconds within which an inspection's further containers follow its first one, if the camera
always reports that it waits for a trigger."""

MAX_REPLAY_BYTES = 1 << 30
"""Largest number of bytes of containers that a replay keeps in memory: five hours of 30 containers
of 2 kB per second."""


@dataclass(slots=True)
class RecordedRun:
    """One recorded inspection."""

    # containers that the camera sent, in order; empty if the trigger had no result
    containers: list[bytes]
    # seconds from the run's beginning to its first container; without a container to its end
    seconds: float
    # seconds from the end of the run before, or from when the camera began to run, to this run;
    # only for a run without a trigger
    pause: float = 0.0
    drops: int = 0  # triggers that the camera dropped before this run


@dataclass(slots=True)
class ApplicationRuns:
    """The recorded inspections of an application, in order."""

    application: int
    # runs that a client triggered, and the others
    triggered: list[RecordedRun] = field(default_factory=list[RecordedRun])
    untriggered: list[RecordedRun] = field(default_factory=list[RecordedRun])
    waits: bool = True  # whether the application waits for triggers; otherwise it runs free
    load_time: float | None = None  # seconds of a switch to it; None if none was recorded


@dataclass(frozen=True, slots=True)
class Change:
    """A change of conditions at a time in seconds after the start of the first session."""

    at: float
    condition: Status
    on: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayPlan:
    """The plan of a replay."""

    dialect: str
    quirks: tuple[str, ...]  # deviations from the dialect
    transport: Literal["tcp", "udp"]
    applications: Mapping[int, ApplicationRuns]  # runs of each application, by id; never empty
    active: int  # id of the application of the first container
    running: bool  # whether the emulated camera begins in run mode
    endian: int  # the status message's endian field
    conditions: Status  # conditions at first
    changes: tuple[Change, ...]  # later changes of conditions, in order
    seconds: float  # length of the recording from its first session on


def plan_replay(recording: Recording, camera: str | None = None) -> ReplayPlan:
    """Plan the replay of a camera of a recording, by default the only one in it.

    Raises:
        ConfigurationError: there is no such camera, it had no session, or it cannot be emulated.
        RecordingError: its containers are more than :data:`MAX_REPLAY_BYTES`.
    """
    recorded = recording.camera(camera)
    dialect, transport = _dialect_of(recording, recorded)
    items = recording.all_items(recorded.name)
    if is_fleet(recorded.url) or recorded.metadata.get("frames") == "no":
        steps = _steps_without_frames(items, recorded.metadata.get("endian", "0"))
        free_running = _free_running(steps)
        steps = _with_steady_statuses(steps, free_running)
    else:
        steps = list(_steps_of_frames(items, dialect))
        free_running = _free_running(steps)
    if recording.since is not None:
        steps = _steps_since(steps, recording.since.timestamp())
    maker = _ScheduleMaker(free_running)
    for step in steps:
        maker.add_step(step)
    maker.finish()
    if maker.session_start is None:
        raise ConfigurationError(
            f"recording {recording.path}: it has no answer of camera {recorded.name!r}"
        )
    applications = _emulatable(recording, maker.applications, dialect)
    return ReplayPlan(
        dialect=dialect.name,
        quirks=dialect.quirks,
        transport=transport,
        applications=applications,
        active=maker.first_application
        if maker.first_application is not None
        else next(iter(applications)),
        running=maker.first_application is not None or maker.ran_at_first,
        endian=maker.endian,
        conditions=maker.conditions,
        changes=tuple(maker.changes),
        seconds=maker.last_time - maker.session_start,
    )


def _emulatable(
    recording: Recording, applications: Mapping[int, ApplicationRuns], dialect: FramedDialect
) -> dict[int, ApplicationRuns]:
    """Return the applications that can be emulated; others must have no containers."""
    emulatable: dict[int, ApplicationRuns] = {}
    for number, runs in applications.items():
        if number in dialect.application_ids and number >= 1:
            emulatable[number] = runs
        elif runs.triggered or runs.untriggered:
            raise ConfigurationError(
                f"recording {recording.path}: application id {number} cannot be emulated in "
                f"dialect {dialect.name}"
            )
    return emulatable or {1: ApplicationRuns(1)}


def _dialect_of(
    recording: Recording, camera: RecordedCamera
) -> tuple[FramedDialect, Literal["tcp", "udp"]]:
    """Return the dialect and the transport of the camera."""
    if not camera.url:
        raise ConfigurationError(
            f"recording {recording.path}: there was no session with camera {camera.name!r}"
        )
    if is_fleet(camera.url):
        dialect = BVS.dialects.get(camera.dialect or HANDBOOK.name)
        if dialect is None:
            raise ConfigurationError(
                f"recording {recording.path}: camera {camera.name!r} of a fleet speaks dialect "
                f"{camera.dialect}, expected one of bvs; the recording has none of its "
                "messages to replay"
            )
        return dialect, "tcp"
    address = parse_address(camera.url)
    if address.protocol != "bvs" or address.dialect is None:
        raise ConfigurationError(
            f"recording {recording.path}: camera {camera.name!r} speaks {address.protocol}, not "
            "bvs; use smartcam.recording.replay(), which also plays protocols of text lines"
        )
    protocol = cast("Protocol", PROTOCOLS.load("bvs"))
    dialect = cast("FramedDialect", protocol.dialects[address.dialect])
    transport = protocol.schemes[address.scheme]
    return dialect.with_quirks(address.quirks), "udp" if transport is Transport.UDP else "tcp"


class _StepKind(enum.Enum):
    """Kinds of steps of a recording."""

    CONNECTED = enum.auto()
    LOST = enum.auto()
    STATUS = enum.auto()
    TRIGGER = enum.auto()
    ABORT = enum.auto()
    SWITCH = enum.auto()
    SWITCHED = enum.auto()
    NAMED = enum.auto()
    CONTAINER = enum.auto()


class _ReplayStep(NamedTuple):
    """The meaning of a frame, or of the end of a link, for a replay."""

    at: float  # time, seconds since 1970
    kind: _StepKind
    number: int = 0  # an application's id, or the endian field
    bits: Status = Status(0)  # bits of a status
    data: bytes = b""  # bytes of a container
    # time in the record, seconds since 1970; ``at`` may be later, since times never go back
    recorded_at: float | None = None


_SIMPLE_STEPS = {
    (">", "Trigger"): _StepKind.TRIGGER,
    (">", "Stop"): _StepKind.ABORT,
    (">", "Reboot"): _StepKind.ABORT,
    ("<", "ConnectAnswer"): _StepKind.CONNECTED,
}
_ANSWERS = {("<", "SwitchAnswer"): _StepKind.SWITCHED, ("<", "QueryAnswer"): _StepKind.NAMED}


def _steps_since(steps: Iterable[_ReplayStep], at: float) -> list[_ReplayStep]:
    """Return the steps from a time on, after earlier steps that set the camera's state then."""
    momentary_kinds = {_StepKind.TRIGGER, _StepKind.CONTAINER, _StepKind.SWITCH}
    return [
        step._replace(at=max(step.at, at))
        for step in steps
        if (step.at if step.recorded_at is None else step.recorded_at) >= at
        or step.kind not in momentary_kinds
    ]


class _GapSteps:
    """Makes the steps at the beginnings of files and at gaps.

    Without these steps, results around a gap would be matched with wrong triggers.
    """

    def __init__(self) -> None:
        self._is_complete = False  # whether all earlier items are known

    def steps(self, item: Item | RecordedState, at: float) -> list[_ReplayStep]:
        """Return the steps that an item adds; ``at`` is never less than in the last call."""
        if isinstance(item, RecordedError) and item.error == GAP:
            self._is_complete = False
            return [_ReplayStep(at, _StepKind.LOST)]
        if not isinstance(item, RecordedState):
            self._is_complete = True
            return []
        if not item.connected:
            self._is_complete = False
            return [_ReplayStep(at, _StepKind.LOST)]
        if self._is_complete:
            return []
        self._is_complete = True
        steps = [_ReplayStep(at, _StepKind.CONNECTED)]
        if item.application is not None:
            steps.append(_ReplayStep(at, _StepKind.NAMED, item.application))
        if item.status is not None:
            steps.append(_ReplayStep(at, _StepKind.STATUS, item.endian, item.status))
        return steps


def _steps_of_frames(
    items: Iterable[Item | RecordedState], dialect: FramedDialect
) -> Iterator[_ReplayStep]:
    """Yield the steps among the items; their times never go back.

    Raises:
        ConfigurationError: a frame lacks a field of its message.
        RecordingError: the containers are too large together.
    """
    at, active, size = 0.0, m.UNNAMED_APPLICATION, 0
    gap_steps = _GapSteps()
    for item in items:
        if isinstance(item, RecordedState) and item.at is not None:
            at = max(at, item.at.timestamp())
        for gap_step in gap_steps.steps(item, at):
            active = gap_step.number if gap_step.kind is _StepKind.NAMED else active
            yield gap_step
        if isinstance(item, Disconnected):
            yield _ReplayStep(at, _StepKind.LOST)
        if not isinstance(item, TraceEntry) or item.fields is None:
            continue
        at = max(at, item.at.timestamp())
        try:
            step = _step_of_frame(at, item, dialect)
        except (KeyError, TypeError, ValueError, OverflowError) as exc:
            raise ConfigurationError(
                f"recording: wrong fields of a {item.message}: {item.fields!r:.80}"
            ) from exc
        if step is None:
            continue
        step = step._replace(recorded_at=item.at.timestamp())
        size += len(step.data)
        if size > MAX_REPLAY_BYTES:
            raise RecordingError(
                f"recording: {size} bytes of containers until {item.at}, expected "
                f"{MAX_REPLAY_BYTES} at most for a replay"
            )
        if step.kind is _StepKind.CONTAINER and step.number == m.UNNAMED_APPLICATION:
            step = step._replace(number=active)  # a quirk: the container has no application id
        elif step.kind in {_StepKind.SWITCHED, _StepKind.NAMED}:
            active = step.number
        yield step


def _steps_without_frames(items: Iterable[Item | RecordedState], endian: str) -> list[_ReplayStep]:
    """Return the steps of a fleet's camera from its results and events, in order.

    A trigger precedes the first of its results; a trigger without a result is left out.

    Raises:
        ConfigurationError: ``endian`` is no number.
        RecordingError: the containers are too large together.
    """
    if endian not in {"0", "1"}:
        raise ConfigurationError(f"recording: endian: expected 0 or 1, got {endian:.20}")
    steps: list[_ReplayStep] = []
    triggered_at, size = None, 0
    gap_steps = _GapSteps()
    for item in items:
        when = item.received_at if isinstance(item, Result) else item.at
        at = 0.0 if when is None else when.timestamp()
        steps += gap_steps.steps(item, at)
        match item:
            case Connected() | Reconnected():
                steps.append(_ReplayStep(at, _StepKind.CONNECTED))
            case Disconnected():
                steps.append(_ReplayStep(at, _StepKind.LOST))
            case StatusChanged(status=status):
                steps.append(_ReplayStep(at, _StepKind.STATUS, int(endian), status))
            case ApplicationChanged(application=application):
                steps.append(_ReplayStep(at, _StepKind.SWITCHED, application))
            case Result():
                size += len(item.raw)
                if item.triggered_at is None:
                    steps.append(_ReplayStep(at, _StepKind.ABORT))  # the earlier inspection is over
                elif item.triggered_at != triggered_at:
                    steps.append(_ReplayStep(at - (item.latency or 0.0), _StepKind.TRIGGER))
                triggered_at = item.triggered_at
                steps.append(_ReplayStep(at, _StepKind.CONTAINER, item.application, data=item.raw))
            case _:
                pass
        if size > MAX_REPLAY_BYTES:
            raise RecordingError(
                f"recording: {size} bytes of containers until {at:.0f}, expected "
                f"{MAX_REPLAY_BYTES} at most for a replay"
            )
    return _on_one_clock(steps)


_ON_AGENT_CLOCK = {_StepKind.TRIGGER, _StepKind.ABORT, _StepKind.CONTAINER}


def _on_one_clock(steps: list[_ReplayStep]) -> list[_ReplayStep]:
    """Return steps with times on one clock, which fit the steps' order.

    The times of results are on the agent's clock, the times of other events on the program's.
    """
    min_offset, max_offset = -math.inf, math.inf  # bounds of the difference between the clocks
    last_by_program, last_by_agent = -math.inf, -math.inf  # time of the last step on each clock
    for step in steps:
        if step.kind is _StepKind.CONTAINER:
            last_by_agent = step.at
            min_offset = max(min_offset, last_by_program - last_by_agent)
        elif step.kind not in _ON_AGENT_CLOCK:
            last_by_program = step.at
            max_offset = min(max_offset, last_by_program - last_by_agent)
    # usually a status follows a result at once, so the upper bound is the better estimate
    nearest = max_offset if min_offset <= max_offset < math.inf else min_offset
    offset = 0.0 if min_offset <= 0 <= max_offset else nearest
    fitted: list[_ReplayStep] = []
    last = -math.inf
    for step in steps:
        at = step.at + offset if step.kind in _ON_AGENT_CLOCK else step.at
        if step.kind is not _StepKind.TRIGGER:
            at = last = max(at, last)
        fitted.append(step._replace(at=at, recorded_at=step.at))
    return fitted


def _with_steady_statuses(
    steps: Iterable[_ReplayStep], free_running: set[int]
) -> list[_ReplayStep]:
    """Replace the bits that change with each inspection, since their times are too coarse."""
    adjusted: list[_ReplayStep] = []
    active: int | None = None
    for step in steps:
        if step.kind in {_StepKind.SWITCHED, _StepKind.NAMED, _StepKind.CONTAINER}:
            active = step.number
        if step.kind is _StepKind.STATUS:
            bits = step.bits & ~(Status.OVERTRIGGERED | Status.WAITING_FOR_TRIGGER)
            if Status.RUNNING in bits and active not in free_running:
                bits |= Status.WAITING_FOR_TRIGGER
            adjusted.append(step._replace(bits=bits))
        else:
            adjusted.append(step)
    return adjusted


def _step_of_frame(at: float, entry: TraceEntry, dialect: FramedDialect) -> _ReplayStep | None:
    """Return the step of a frame; None if the frame means nothing for a replay."""
    key, fields = (entry.direction, entry.message), entry.fields
    if key in _SIMPLE_STEPS:
        return _ReplayStep(at, _SIMPLE_STEPS[key])
    if key in _ANSWERS:
        done = dialect.code(int(fields.get("code", 0))).verdict is Verdict.DONE
        return _ReplayStep(at, _ANSWERS[key], int(fields["application"])) if done else None
    match key:
        case (">", "SwitchApplication"):
            return _ReplayStep(at, _StepKind.SWITCH, int(fields["application"]))
        case ("<", "StatusReport"):
            bits = status_of(fields["status"])
            return _ReplayStep(at, _StepKind.STATUS, int(fields.get("endian", 0)), bits)
        case ("<", "ResultContainer"):
            number = int(fields.get("application", m.UNNAMED_APPLICATION))
            return _ReplayStep(at, _StepKind.CONTAINER, number, data=bytes.fromhex(fields["data"]))
        case _:
            return None


def _free_running(steps: Iterable[_ReplayStep]) -> set[int]:
    """Return the applications that ran and never waited for a trigger."""
    bits_by_application: dict[int, Status] = {}
    active: int | None = None
    early = Status(0)  # bits of statuses before the application is known
    for step in steps:
        if step.kind is _StepKind.STATUS:
            if step.bits.loading:
                active = None
            elif active is None:
                early |= step.bits
            else:
                bits_by_application[active] = bits_by_application.get(active, Status(0)) | step.bits
        elif step.kind in {_StepKind.SWITCHED, _StepKind.NAMED, _StepKind.CONTAINER}:
            active = step.number
            bits_by_application[active] = bits_by_application.get(active, Status(0)) | early
            early = Status(0)
    return {
        number
        for number, bits in bits_by_application.items()
        if Status.RUNNING in bits and Status.WAITING_FOR_TRIGGER not in bits
    }


class _ScheduleMaker:
    """Makes a plan from the steps of a recording."""

    def __init__(self, free_running: set[int]) -> None:
        self.applications: dict[int, ApplicationRuns] = {}  # runs so far, by application
        # time at which the first session began, seconds since 1970; None before
        self.session_start: float | None = None
        self.last_time: float = 0.0  # time of the last step, seconds since 1970
        self.first_application: int | None = None  # application of the first container; None before
        self.ran_at_first: bool = False  # whether Running was set in the first status
        self.endian: int = 0  # byte order of the last status before the first container
        self.conditions: Status = Status(0)  # conditions of the first status
        self.changes: list[Change] = []  # changes of conditions so far
        self._free_running = free_running  # applications that run free
        self._active: int | None = None
        self._session_status: Status | None = None  # last status in this session
        self._last_status: Status | None = None  # last status of all sessions
        self._triggers: list[float] = []  # times of triggers without a container so far
        self._drops = 0  # number of triggers dropped since the last run
        self._waits_from = self._waited_until = 0.0  # times at which Waiting for Trigger rose, fell
        self._open_run: RecordedRun | None = None  # run whose inspection may send more containers
        self._open_run_at = 0.0  # time of the first container of that run
        self._untriggered_start: float | None = None  # start of an inspection without a trigger
        self._pause_start = 0.0  # time from which the pause before the next untriggered run counts
        # time of the last request to switch, and the id of the requested application
        self._switching: tuple[float, int] | None = None
        self._handlers: Mapping[_StepKind, Callable[[_ReplayStep], None]] = {
            _StepKind.CONNECTED: self._on_connected,
            _StepKind.LOST: self._on_lost,
            _StepKind.STATUS: self._on_status,
            _StepKind.TRIGGER: self._on_trigger,
            _StepKind.ABORT: lambda _: self._end_inspection(),
            _StepKind.SWITCH: self._on_switch,
            _StepKind.SWITCHED: self._on_switched,
            _StepKind.NAMED: lambda step: self._set_active(step.number),
            _StepKind.CONTAINER: self._on_container,
        }

    def add_step(self, step: _ReplayStep) -> None:
        """Add the next step."""
        self.last_time = step.at
        self._handlers[step.kind](step)

    def finish(self) -> None:
        """End the plan, without a trigger whose result was not recorded."""
        self._triggers.clear()

    # ------------------------------------------------------------------ steps

    def _on_connected(self, _: _ReplayStep) -> None:
        if self.session_start is None:
            self.session_start = self._pause_start = self.last_time
        self._session_status = None

    def _on_lost(self, _: _ReplayStep) -> None:
        self._triggers.clear()  # their results were lost with the link
        self._open_run = self._untriggered_start = self._switching = None

    def _on_status(self, step: _ReplayStep) -> None:
        before, self._session_status = self._session_status, step.bits
        risen = step.bits & ~before if before is not None else Status(0)
        fallen = before & ~step.bits if before is not None else Status(0)
        self._add_changes(step.bits)
        if self.first_application is None:
            self.endian = step.number
        if Status.RUNNING in risen:
            self._pause_start = self.last_time
        if Status.WAITING_FOR_TRIGGER in fallen:
            self._waited_until = self.last_time
        if Status.OVERTRIGGERED in risen and self._triggers:
            self._count_drop(step.bits)
        if Status.SYSTEM_ERROR in risen or Status.RUNNING in fallen:
            self._end_inspection()
        if Status.WAITING_FOR_TRIGGER in fallen and not self._triggers:
            self._untriggered_start = self.last_time
        if Status.WAITING_FOR_TRIGGER in risen:
            self._waits_from = self.last_time
            self._open_run = None

    def _add_changes(self, bits: Status) -> None:
        before, self._last_status = self._last_status, bits
        if before is None:
            self.conditions = bits & (Status.OVERHEAT | Status.SYSTEM_ERROR)
            self.ran_at_first = Status.RUNNING in bits
            return
        for condition in CONDITIONS:
            on = condition in bits
            if (condition in before) != on and self.session_start is not None:
                self.changes.append(Change(self.last_time - self.session_start, condition, on))

    def _count_drop(self, bits: Status) -> None:
        """Count the last trigger as dropped by the camera."""
        self._triggers.pop()
        if self._triggers:
            return  # during a triggered inspection the emulated camera itself drops the trigger
        if Status.WAITING_FOR_TRIGGER in bits:
            self._drops += 1
        elif self._untriggered_start is None:  # an untriggered inspection, noticed late
            self._untriggered_start = self._waited_until

    def _on_trigger(self, _: _ReplayStep) -> None:
        self._open_run = None
        if self._waits_for_trigger:
            self._end_inspection()  # since the camera waits, the earlier inspection is over
        self._triggers.append(self.last_time)

    def _on_switch(self, step: _ReplayStep) -> None:
        self._switching = (self.last_time, step.number)

    def _on_switched(self, step: _ReplayStep) -> None:
        self._end_inspection()
        self._set_active(step.number)
        switching, self._switching = self._switching, None
        if switching is not None and switching[1] == step.number:
            self._runs_of(step.number).load_time = self.last_time - switching[0]

    def _on_container(self, step: _ReplayStep) -> None:
        if self.first_application is None:
            self.first_application = step.number
        self._set_active(step.number)
        runs = self._runs_of(step.number)
        if not runs.waits:
            self._triggers.clear()  # a free-running application ignores them
            pause = self._pause(self.last_time)
            runs.untriggered.append(RecordedRun([step.data], 0.0, pause=pause))
        elif self._triggers:
            start = self._triggers.pop(0)
            self._open_run = RecordedRun([step.data], self.last_time - start, drops=self._drops)
            self._drops = 0
            runs.triggered.append(self._open_run)
        elif self._open_run is not None and not self._is_inspection_over():
            self._open_run.containers.append(step.data)
        else:
            start_seen = self._untriggered_start is not None or not self._waits_for_trigger
            start = self.last_time if self._untriggered_start is None else self._untriggered_start
            run = RecordedRun([step.data], self.last_time - start, pause=self._pause(start))
            runs.untriggered.append(run)
            self._open_run = run if start_seen else None
        if self._open_run is not None and len(self._open_run.containers) == 1:
            self._open_run_at = self.last_time
        self._untriggered_start = None

    @property
    def _waits_for_trigger(self) -> bool:
        """True if the camera waits for a trigger, by its last status."""
        return (
            self._session_status is not None and Status.WAITING_FOR_TRIGGER in self._session_status
        )

    def _is_inspection_over(self) -> bool:
        """Return True if the camera waits, and more results can no longer arrive."""
        return self._waits_for_trigger and self.last_time - self._open_run_at > MAX_TIME_AFTER_FIRST

    # ------------------------------------------------------------------ helper methods

    def _pause(self, start: float) -> float:
        """Return the pause before an untriggered run; the next pause counts from now on."""
        pause = max(0.0, start - self._pause_start)
        self._pause_start = self.last_time
        return pause

    def _end_inspection(self) -> None:
        """End the running inspection, whose trigger has no result."""
        if self._active is not None and self._runs_of(self._active).waits:
            for start in self._triggers:
                end = self._waits_from if self._waits_from > start else self.last_time
                run = RecordedRun([], end - start, drops=self._drops)
                self._runs_of(self._active).triggered.append(run)
                self._drops = 0
        self._triggers.clear()
        self._open_run = self._untriggered_start = None

    def _set_active(self, number: int) -> None:
        if number != self._active:
            self._active = number
            self._runs_of(number)

    def _runs_of(self, number: int) -> ApplicationRuns:
        return self.applications.setdefault(
            number, ApplicationRuns(number, waits=number not in self._free_running)
        )
