"""Pass everything that comes from the camera to the tasks that wait for it.

The receive task hands every chunk to :meth:`Dispatch.dispatch`, which never waits: an answer
completes its request, a status is shown to every predicate in order, a result gets exactly one fate
and goes to its trigger and to the streams.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._client.remarks import Remarks
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

FEWEST_GATHERED = 6
"""Least number of events of a chunk to examine: two results, each between statuses."""

ROUND_EVENTS = 5
"""Events that a trigger brings: two answers to Queries, and between them two statuses around the
result."""

MAX_NOTICE_CHARACTERS = 4096
"""Largest number of characters of a camera's remark that are kept."""

_LOGGED = (
    (
        Status.OVERHEAT,
        logging.WARNING,
        "heat",
        "! the camera is too hot: inspections may get worse",
    ),
    (Status.OVERHEAT, logging.INFO, "no heat", "= the camera is no longer too hot"),
    (Status.SYSTEM_ERROR, logging.ERROR, "System Error", "! the camera reports System Error"),
)
"""Bits whose rise is logged; with INFO, their fall is, too."""

_NOTED = int(Status.OVERTRIGGERED | Status.OVERHEAT | Status.SYSTEM_ERROR)

_WAITING, _RUNNING = int(Status.WAITING_FOR_TRIGGER), int(Status.RUNNING)


class _Round(NamedTuple):
    """The messages around the result of a trigger: the same objects each time.

    Attributes:
        first: answer to the Query before the trigger.
        began: status when the inspection begins.
        ended: status when the camera waits again.
        last: answer to the Query after the trigger.
        application: the application that both answers name.
        bits: bits of the last status, equal to the bits of the status before.
        endian: byte order in both statuses.
    """

    first: Event
    began: m.StatusReport
    ended: m.StatusReport
    last: Event
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
        self._remarks = Remarks(self._name)
        self._round: _Round | None = None  # around the last trigger's result, if that was usual
        self._notes_events = False  # events are used although there is no subscriber
        self._takers: dict[type[Event], Callable[[Any, float, datetime], None]] = {
            m.StatusReport: self._on_status,
            m.ResultContainer: self._results.on_result,
            ResultBurst: self._results.on_burst,
            m.QueryAnswer: self._on_active,
            m.SwitchAnswer: self._on_switched,
            m.TriggerAnswer: self._on_trigger_answer,
            m.Notice: self._on_notice,
        }

    @property
    def layout(self) -> Layout | None:
        """Layout that results are read with; None if there is none, or several."""
        return self._results.interpretation.layout

    def begin_session(self, dialect: Dialect, *, ordered: bool) -> None:
        """Begin a session; ``ordered``: messages come in order and none is lost (TCP)."""
        self._dialect = dialect
        self._waits.begin_session()
        self._state.begin_session()
        # if the status comes only on request, changes of it are missed
        complete = ordered and dialect.capabilities.status_by_itself and dialect.shows_triggers
        self._results.begin_session(ordered=ordered, complete=complete)

    def dispatch_early(self, chunks: Iterable[Chunk]) -> None:
        """Pass on the messages received while the session was made.

        No request is sent before that: an answer among them belongs to the handshake.
        """
        for chunk in chunks:
            self._hand_on(chunk)
        if self._state.active_in_doubt:
            self._requests.ask_what_is_active()

    def dispatch(self, chunk: Chunk) -> None:
        """Pass on every event of a chunk, in order; never waits, never raises."""
        self._hand_on(chunk)
        if self._state.active_in_doubt:
            self._requests.ask_what_is_active()

    def _hand_on(self, chunk: Chunk) -> None:
        at, now, answers = datetime.now(UTC), chunk.received_at, self._waits.answers
        events, takers = chunk.events, self._takers
        self._notes_events = self._listeners.notes_events()
        if len(events) == ROUND_EVENTS and self._take_round(events, now, at):
            return
        if len(events) >= FEWEST_GATHERED and self._only_streams():
            events = gathered(events, self._state.endian)
        for event in events:
            take = takers.get(type(event))
            if take is not None:  # LinkFailed and LinkEnded: the receive task ends by them
                take(event, now, at)
            if answers and isinstance(event, m.Message):
                self._waits.on_message(event, now, chunk.delivery)

    def _take_round(self, events: list[Event], now: float, at: datetime) -> bool:
        """Handle the answers to the trigger under way in one step, if they are the usual ones.

        Only the trigger's caller and streams of results may use them. The effect is the same as of
        one event after the other, which
        ``python -m tests.client.proofs.straight`` shows, or does nothing and returns False.
        """
        first, began, container, ended, last = events
        known = self._round
        if (
            known is None
            or first is not known.first
            or began is not known.began
            or ended is not known.ended
            or last is not known.last
        ):
            known = self._round = _round_of(events)
        if known is None or type(container) is not m.ResultContainer:
            return False
        state, listeners = self._state, self._listeners
        if (
            self._notes_events
            or listeners.events.references
            or listeners.statuses.references
            or not self._waits.awaits_fences(2)
            or not state.stays(known.application, known.bits, known.endian)
            or container.application != known.application
        ):
            return False
        owner = self._results.take_round(container)
        if owner is None:
            return False
        self._waits.expect_fences(0)
        if listeners.hears_statuses:  # an agent
            state.report(known.began, ())
            listeners.offer_status(known.began.status, now)
            self._results.hand_on(container, owner, "triggered", None, now, at)
            state.report(known.ended, ())
            listeners.offer_status(known.ended.status, now)
            return True
        state.report_round(known.ended)
        self._results.hand_on(container, owner, "triggered", None, now, at)
        return True

    def _only_streams(self) -> bool:
        """Return True if no task needs statuses, and containers go to streams in any case."""
        waits, listeners = self._waits, self._listeners
        awaited = waits.answers or waits.statuses or listeners.hears_statuses
        return not (awaited or listeners.sees_events) and self._results.only_streams

    def fail(self, error: SmartCamError) -> None:
        """End the session: every wait ends with an error, also one begun before the next session.

        The first reason stays. Streams go on until :meth:`finish`.
        """
        if self._waits.fail(error):
            self._remarks.end()
            if self._listeners.may_await:
                self._listeners.fail(copy_to_raise(error))
            self._results.fail(error)

    def finish(self, error: SmartCamError) -> None:
        """End the streams for good because of ``error``, quietly if this side closed."""
        self.fail(error)
        self._waits.finish(error)
        self._results.finish()
        self._requests.finish()
        self._takers = {}  # its methods refer to this object, which would wait for the collector
        self._listeners.end(None if isinstance(error, ConnectionClosedError) else error)

    # ------------------------------------------------------------------ by the kind of event

    def _verdict(self, code: int) -> Verdict:
        return Verdict.DONE if self._dialect is None else self._dialect.code(code).verdict

    def _on_active(self, answer: m.QueryAnswer, now: float, at: datetime) -> None:
        if self._waits.take_fence():
            self._results.on_query_answer(now)
        state = self._state
        if answer.application != state.active and self._verdict(answer.code) is Verdict.DONE:
            state.set_active(answer.application, at)

    def _on_switched(self, answer: m.SwitchAnswer, now: float, at: datetime) -> None:
        done = self._verdict(answer.code) is Verdict.DONE
        if done:
            self._state.switched(answer.application)
            self._results.on_switched()
        known = self._dialect is None or answer.application in self._dialect.application_ids
        if done or known:  # else the camera was too busy, or the answer too short
            self._state.set_active(answer.application, at)

    def _on_trigger_answer(self, answer: m.TriggerAnswer, now: float, at: datetime) -> None:
        if self._verdict(answer.code) is Verdict.DONE:
            self._results.on_trigger_answer(now)

    def _on_notice(self, notice: m.Notice, now: float, at: datetime) -> None:
        self._counters.note_notice()
        level = logging.WARNING if notice.kind == "error" else logging.INFO
        kind, code, text = notice.kind, notice.code, notice.text[:MAX_NOTICE_CHARACTERS]
        form = "! the camera says: %s %d: %.200s"
        self._remarks.log(f"notice {kind}", level, form, kind, code, text, now=now)
        event = NoticeReceived(camera=self._name, at=at, kind=kind, code=code, text=text)
        self._listeners.publish(event)

    def _on_status(self, report: m.StatusReport, now: float, at: datetime) -> None:
        state, waits, listeners, status = self._state, self._waits, self._listeners, report.status
        before = state.status
        previous = state.report(report, waits.answers)
        bits, was = state.bits, previous or 0
        if (bits ^ was) & _NOTED:
            self._note_changes(bits, was, now)
        self._results.on_status(previous, bits, now)
        if status != before and (self._notes_events or listeners.events.references):
            event = StatusChanged(camera=self._name, at=at, status=status, previous=before)
            listeners.publish(event)
        listeners.offer_status(status, now)
        if waits.statuses:
            waits.show(status)

    def _note_changes(self, bits: int, was: int, now: float) -> None:
        risen, fallen = bits & ~was, was & ~bits
        if risen & Status.OVERTRIGGERED:
            self._counters.note_overtrigger()
        for word, level, kind, text in _LOGGED:
            if (risen if level != logging.INFO else fallen) & word:
                self._remarks.log(kind, level, text, now=now)


def _round_of(events: list[Event]) -> _Round | None:
    """Return the messages around a trigger's result; None if they are not the usual ones."""
    first, began, _, ended, last = events
    if (
        not isinstance(began, m.StatusReport)
        or not isinstance(ended, m.StatusReport)
        or not isinstance(first, m.QueryAnswer)
        or not isinstance(last, m.QueryAnswer)
    ):
        return None
    bits, application = int(ended.status), first.application
    plain = bits & (_WAITING | _RUNNING) == _WAITING | _RUNNING
    if not plain or int(began.status) != bits & ~_WAITING:
        return None
    if began.endian != ended.endian or last.application != application:
        return None
    return _Round(first, began, ended, last, application, bits, ended.endian)


def gathered(events: list[Event], endian: int) -> list[Event]:
    """Return events of a camera that runs free with its containers as one burst, then the statuses.

    It sends statuses around each container, so that containers that came together could not be
    read together. The events are unchanged if there is anything else among them, or the place of a
    container matters: it is of another application, or follows a status with another byte order
    than ``endian``, the present one.
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
    """Return True if a container has only bytes, names its application, and was not asked for."""
    named = container.application >= 0 and not container.asked
    return named and container.cells is None and container.fault is None
