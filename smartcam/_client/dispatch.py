"""Pass everything that the camera sends to the tasks that wait for it.

The receive task passes every chunk to :meth:`Dispatch.dispatch`, which never waits: an answer
completes its request, every predicate is called with each status in order, and a result gets
exactly one fate and goes to its trigger and to the streams.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._client.limited_log import LimitedLog
from smartcam._client.waits import copy_to_raise
from smartcam.exceptions import ConnectionClosedError
from smartcam.models import NoticeReceived, Status, StatusChanged
from smartcam.protocols import Verdict
from smartcam.protocols import messages as m
from smartcam.protocols._inside import ResultBurst

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from smartcam._client.camera_state import CameraState
    from smartcam._client.counters import ClientCounters
    from smartcam._client.link import Chunk
    from smartcam._client.listeners import Listeners
    from smartcam._client.requests import Requests
    from smartcam._client.results import Results
    from smartcam._client.waits import Waits
    from smartcam.exceptions import SmartCamError
    from smartcam.layout import Layout
    from smartcam.protocols import Dialect
    from smartcam.protocols._inside import Event

MIN_EVENTS_TO_GATHER = 6
"""Least number of events of a chunk whose containers are gathered: two results, each between
statuses."""

EVENTS_PER_TRIGGER = 5
"""Usual number of events after a trigger: two answers to Queries, and between them the result,
which is between two statuses."""

MAX_NOTICE_CHARACTERS = 4096
"""Largest number of characters that are kept of a camera's notice."""

_LOGGED_CHANGES = (
    (
        Status.OVERHEAT,
        logging.WARNING,
        "heat",
        "! the camera is too hot: inspections may get worse",
    ),
    (Status.OVERHEAT, logging.INFO, "no heat", "= the camera is no longer too hot"),
    (Status.SYSTEM_ERROR, logging.ERROR, "System Error", "! the camera reports System Error"),
)
"""Bits whose change is logged: with INFO their fall, otherwise their rise."""

_NOTED_BITS = int(Status.OVERTRIGGERED | Status.OVERHEAT | Status.SYSTEM_ERROR)

_WAITING, _RUNNING = int(Status.WAITING_FOR_TRIGGER), int(Status.RUNNING)


class _UsualExchange(NamedTuple):
    """The messages that usually surround a trigger's result: the same objects each time.

    Attributes:
        first_answer: answer to the Query before the trigger.
        begin_status: status when the inspection begins.
        end_status: status when the camera waits again.
        last_answer: answer to the Query after the trigger.
        application: the application that both answers name.
        bits: bits of the last status, equal to the bits of the status before.
        endian: byte order in both statuses.
    """

    first_answer: Event
    begin_status: m.StatusReport
    end_status: m.StatusReport
    last_answer: Event
    application: int
    bits: int
    endian: int


@dataclass(eq=False)
class Dispatch:
    """The receiving half of a client, over all its sessions."""

    _name: str
    _state: CameraState
    _waits: Waits
    _results: Results
    _listeners: Listeners
    _requests: Requests
    _counters: ClientCounters

    def __post_init__(self) -> None:
        self._dialect: Dialect | None = None
        self._log = LimitedLog(self._name)
        # messages around the last trigger's result; None if they were not the usual ones
        self._usual: _UsualExchange | None = None
        self._observers_want_events = False
        self._handlers: dict[type[Event], Callable[[Any, float, datetime], None]] = {
            m.StatusReport: self._on_status,
            m.ResultContainer: self._results.on_result,
            ResultBurst: self._results.on_burst,
            m.QueryAnswer: self._on_query_answer,
            m.SwitchAnswer: self._on_switch_answer,
            m.TriggerAnswer: self._on_trigger_answer,
            m.Notice: self._on_notice,
        }

    @property
    def layout(self) -> Layout | None:
        """Layout that results are read with; None if there is none, or several."""
        return self._results.interpretation.layout

    def begin_session(self, dialect: Dialect, *, keeps_order: bool) -> None:
        """Begin a session; ``keeps_order``: messages come in order and none is lost (TCP)."""
        self._dialect = dialect
        self._waits.begin_session()
        self._state.begin_session()
        # if the status comes only on request, changes of it are missed
        gets_all = keeps_order and dialect.capabilities.unasked_status and dialect.shows_triggers
        self._results.begin_session(keeps_order=keeps_order, gets_every_status=gets_all)

    def dispatch_early(self, chunks: Iterable[Chunk]) -> None:
        """Pass on the messages received while the session was made.

        Until this call only the handshake sends requests, so answers among them belong to it.
        """
        for chunk in chunks:
            self._dispatch_chunk(chunk)
        if self._state.application_in_doubt:
            self._requests.ask_active_application()

    def dispatch(self, chunk: Chunk) -> None:
        """Pass on every event of a chunk, in order; never waits, never raises."""
        self._dispatch_chunk(chunk)
        if self._state.application_in_doubt:
            self._requests.ask_active_application()

    def _dispatch_chunk(self, chunk: Chunk) -> None:
        at, now, answers = datetime.now(UTC), chunk.received_at, self._waits.pending_answers
        events, handlers = chunk.events, self._handlers
        self._observers_want_events = self._listeners.observers_want_events()
        if len(events) == EVENTS_PER_TRIGGER and self._handle_usual_exchange(events, now, at):
            return
        if len(events) >= MIN_EVENTS_TO_GATHER and self._is_streaming_only():
            events = gather_containers(events, self._state.endian)
        for event in events:
            handle = handlers.get(type(event))
            if handle is not None:  # LinkFailed and LinkEnded have none: they end the receive task
                handle(event, now, at)
            if answers and isinstance(event, m.Message):
                self._waits.on_message(event, now, chunk.delivery)

    def _handle_usual_exchange(self, events: list[Event], now: float, at: datetime) -> bool:
        """Handle the answers to the running trigger in one step, if they are the usual ones.

        Otherwise, or if anybody but the trigger's caller and streams of results needs the events,
        do nothing and return False. ``python -m tests.client.proofs.straight`` shows that the
        effect is the same as if the events were handled one by one.
        """
        first_answer, begin_status, container, end_status, last_answer = events
        usual = self._usual
        if (
            usual is None
            or first_answer is not usual.first_answer
            or begin_status is not usual.begin_status
            or end_status is not usual.end_status
            or last_answer is not usual.last_answer
        ):
            usual = self._usual = _usual_exchange(events)
        if usual is None or type(container) is not m.ResultContainer:
            return False
        state, listeners = self._state, self._listeners
        if (
            self._observers_want_events
            or listeners.events.references
            or listeners.statuses.references
            or not self._waits.awaits_only_queries(2)
            or not state.is_unchanged(usual.application, usual.bits, usual.endian)
            or container.application != usual.application
        ):
            return False
        owner = self._results.match_usual_exchange(container)
        if owner is None:
            return False
        self._waits.expect_query_answers(0)
        if listeners.wants_statuses:  # true in a fleet's agent
            state.note_status(usual.begin_status, ())
            listeners.offer_status(usual.begin_status.status, now)
            self._results.deliver(container, owner, "triggered", None, now, at)
            state.note_status(usual.end_status, ())
            listeners.offer_status(usual.end_status.status, now)
            return True
        state.note_usual_statuses(usual.end_status)
        self._results.deliver(container, owner, "triggered", None, now, at)
        return True

    def _is_streaming_only(self) -> bool:
        """Return True if no task waits for messages but the streams of results."""
        waits, listeners = self._waits, self._listeners
        awaited = waits.pending_answers or waits.status_waiters or listeners.wants_statuses
        return not (awaited or listeners.wants_events) and self._results.is_streaming_only

    def fail(self, error: SmartCamError) -> None:
        """End the session: every wait ends with an error, also one that begins between sessions.

        The first error counts. Streams stay open until :meth:`finish`.
        """
        if self._waits.fail(error):
            self._log.end()
            if self._listeners.may_have_waiters:
                self._listeners.fail(copy_to_raise(error))
            self._results.fail(error)

    def finish(self, error: SmartCamError) -> None:
        """End the streams for good because of ``error``; without an error if this side closed."""
        self.fail(error)
        self._waits.finish(error)
        self._results.finish()
        self._requests.finish()
        self._handlers = {}  # its methods would keep this object until a garbage collection
        self._listeners.end(None if isinstance(error, ConnectionClosedError) else error)

    # ------------------------------------------------------------------ kinds of events

    def _verdict(self, code: int) -> Verdict:
        return Verdict.DONE if self._dialect is None else self._dialect.code(code).verdict

    def _on_query_answer(self, answer: m.QueryAnswer, now: float, at: datetime) -> None:
        if self._waits.count_query_answer():
            self._results.on_trigger_query_answer(now)
        state = self._state
        if answer.application != state.active and self._verdict(answer.code) is Verdict.DONE:
            state.set_active(answer.application, at)

    def _on_switch_answer(self, answer: m.SwitchAnswer, now: float, at: datetime) -> None:
        is_done = self._verdict(answer.code) is Verdict.DONE
        if is_done:
            self._state.note_switch(answer.application)
            self._results.on_switched()
        is_valid_id = self._dialect is None or answer.application in self._dialect.application_ids
        if is_done or is_valid_id:  # else the camera was too busy, or the answer too short
            self._state.set_active(answer.application, at)

    def _on_trigger_answer(self, answer: m.TriggerAnswer, now: float, at: datetime) -> None:
        if self._verdict(answer.code) is Verdict.DONE:
            self._results.on_trigger_answer(now)

    def _on_notice(self, notice: m.Notice, now: float, at: datetime) -> None:
        self._counters.note_notice()
        level = logging.WARNING if notice.kind == "error" else logging.INFO
        kind, code, text = notice.kind, notice.code, notice.text[:MAX_NOTICE_CHARACTERS]
        line = "! the camera says: %s %d: %.200s"
        self._log.log(f"notice {kind}", level, line, kind, code, text, now=now)
        event = NoticeReceived(camera=self._name, at=at, kind=kind, code=code, text=text)
        self._listeners.publish(event)

    def _on_status(self, report: m.StatusReport, now: float, at: datetime) -> None:
        state, waits, listeners, status = self._state, self._waits, self._listeners, report.status
        before = state.status
        previous = state.note_status(report, waits.pending_answers)
        bits, old_bits = state.bits, previous or 0
        if (bits ^ old_bits) & _NOTED_BITS:
            self._note_changes(bits, old_bits, now)
        self._results.on_status(previous, bits, now)
        if status != before and (self._observers_want_events or listeners.events.references):
            event = StatusChanged(camera=self._name, at=at, status=status, previous=before)
            listeners.publish(event)
        listeners.offer_status(status, now)
        if waits.status_waiters:
            waits.offer_status(status)

    def _note_changes(self, bits: int, old_bits: int, now: float) -> None:
        risen, fallen = bits & ~old_bits, old_bits & ~bits
        if risen & Status.OVERTRIGGERED:
            self._counters.note_overtrigger()
        for bit, level, kind, text in _LOGGED_CHANGES:
            if (risen if level != logging.INFO else fallen) & bit:
                self._log.log(kind, level, text, now=now)


def _usual_exchange(events: list[Event]) -> _UsualExchange | None:
    """Return the messages around a trigger's result; None if they are not the usual ones."""
    first, begin, _, end, last = events
    if (
        not isinstance(begin, m.StatusReport)
        or not isinstance(end, m.StatusReport)
        or not isinstance(first, m.QueryAnswer)
        or not isinstance(last, m.QueryAnswer)
    ):
        return None
    bits, application = int(end.status), first.application
    is_waiting = bits & (_WAITING | _RUNNING) == _WAITING | _RUNNING
    if not is_waiting or int(begin.status) != bits & ~_WAITING:
        return None
    if begin.endian != end.endian or last.application != application:
        return None
    return _UsualExchange(first, begin, end, last, application, bits, end.endian)


def gather_containers(events: list[Event], endian: int) -> list[Event]:
    """Return all containers among events as one burst, followed by the statuses.

    A camera that runs free sends statuses around each container, so that containers that were
    received together could not be interpreted together. The events are returned unchanged if there
    are other kinds among them, if the containers are of several applications, or if a status has
    another byte order than ``endian``, the present one.
    """
    statuses: list[Event] = []
    data: list[bytes] = []
    applications: set[int] = set()
    for event in events:
        if isinstance(event, m.StatusReport) and event.endian == endian:
            statuses.append(event)
        elif isinstance(event, ResultBurst):
            data += event.data
            applications.add(event.application)
        elif isinstance(event, m.ResultContainer) and _is_plain(event):
            data.append(event.data)
            applications.add(event.application)
        else:
            return events
    if len(data) < 2 or len(applications) != 1 or not statuses:
        return events
    size = sum(map(len, data))
    return [ResultBurst(application=applications.pop(), data=data, size=size), *statuses]


def _is_plain(container: m.ResultContainer) -> bool:
    """Return True if a container has only bytes, names its application, and answers no request."""
    named = container.application >= 0 and not container.requested
    return named and container.cells is None and container.fault is None
