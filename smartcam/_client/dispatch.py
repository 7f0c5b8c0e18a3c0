"""What comes from the camera, and who waits for it.

The receive task hands every chunk to :meth:`Inbox.dispatch`, which never waits: an answer completes
its request, a status is shown to every predicate in order, a result gets exactly one fate and goes
to its trigger and to the streams. What the camera is known to be stands here too.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import random
import weakref
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, cast

from smartcam._client.correlation import Attribution, Trigger, Verdict
from smartcam._client.counters import Account
from smartcam.exceptions import (
    CameraFaultError,
    ConnectionClosedError,
    InputContainerError,
    InterpretationError,
    NotRunningError,
    OvertriggeredError,
    SmartCamError,
    WrongApplicationError,
)
from smartcam.models import (
    ApplicationChanged,
    CameraEvent,
    Result,
    Status,
    StatusChanged,
)
from smartcam.protocols import messages as m
from smartcam.protocols.base import Verdict as CodeVerdict
from smartcam.protocols.framed.machine import ResultBurst
from smartcam.streams import Subscribers

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam._client.interpretation import Interpretation
    from smartcam._client.link import Chunk
    from smartcam.observers import Observers
    from smartcam.protocols.base import Dialect
    from smartcam.protocols.framed.machine import Event
    from smartcam.streams import Queue

__all__ = ["Inbox", "PendingTrigger"]

logger: logging.Logger = logging.getLogger("smartcam.client")

Answer = m.Message | SmartCamError

# as plain integers: what an IntFlag does in Python costs more than all else that a status needs
_BUSY, _RUNNING = int(Status.BUSY), int(Status.RUNNING)
_RUNNING_OR_BUSY = _RUNNING | _BUSY
_NOTED = int(Status.OVERTRIGGERED | Status.OVERHEAT | Status.SYSTEM_ERROR)
_FAILING = int(Status.OVERTRIGGERED | Status.INPUT_CONTAINER | Status.SYSTEM_ERROR)

# half the time of a NamedTuple's own; the cast because a bare tuple is generic
_new_tuple = cast("Callable[..., Any]", tuple.__new__)  # pyright: ignore[reportUnknownMemberType]


@dataclass(slots=True)
class _StatusWaiter:
    predicate: Callable[[Status], bool]
    outcome: asyncio.Future[Status]


@dataclass(slots=True, eq=False, kw_only=True)
class PendingTrigger(Trigger):
    """The trigger under way, and who waits for it.

    Attributes:
        outcome: gets the results or the error.
        interpretation: how to read its results.
        has_input: input data was sent with it.
        sent_at: loop time.
        triggered_at: wall clock, UTC.
        application: the one that is believed to be active, None where any will do.
        results: those that came.
    """

    outcome: asyncio.Future[list[Result]]
    interpretation: Interpretation
    has_input: bool
    sent_at: float
    triggered_at: datetime
    application: int | None = None
    results: list[Result] = field(default_factory=list[Result])

    def succeed(self) -> None:
        """Give its caller the results."""
        self.ended = True
        self.outcome.set_result(self.results)

    def fail(self, error: Exception) -> None:
        """Give its caller the reason why there are none."""
        self.ended = True
        self.outcome.set_exception(error)


class Inbox:
    """The receiving half of a client, over all its sessions.

    Args:
        name: the camera's name.
        interpretation: how to read results that no trigger reads otherwise.
        observers: who else wants to know.
    """

    def __init__(self, name: str, interpretation: Interpretation, observers: Observers) -> None:
        self.name = name
        self.interpretation = interpretation
        self.end: SmartCamError | None = None  # why there is no session
        # what the camera is known to be
        self.status: Status | None = None
        self.endian: int = 0
        self.active: int | None = None
        self.expected: int | None = None  # the application that was named, if any
        # who waits for what
        self.attribution: Attribution = Attribution(random.random())  # noqa: S311
        self._pending: PendingTrigger | None = None
        self._numbering: Interpretation | None = None  # how to read numbers, once there are ours
        # the input data of a trigger without a result may still be queued in the camera
        self.input_in_doubt: bool = False
        # by the answer's type; by id for a message that the dialect does not know
        self.answers: dict[type[m.Message] | int, asyncio.Future[Answer]] = {}
        # weak: a waiter that was made and never awaited must not count as a listener
        self.next_results: weakref.WeakSet[asyncio.Future[Result]] = weakref.WeakSet()
        self.result_streams: Subscribers[Result] = Subscribers()
        self.status_streams: Subscribers[Status] = Subscribers()
        self.event_streams: Subscribers[CameraEvent] = Subscribers()
        self.account: Account = Account()
        self.fence_open: bool = False  # the Query in front of the last trigger is not answered
        self.statuses_heard: int = 0
        self.on_status_wanted: Callable[[], None] | None = None  # where it has to be asked for
        self.on_unconfirmed: Callable[[], None] | None = None  # have the status told behind this
        self.on_held: Callable[[], None] | None = None  # have a Query answered
        # containers of which it is not known yet whether they are the trigger's
        self._held: list[tuple[m.ResultContainer, float, datetime]] = []
        self._dialect: Dialect | None = None
        self._observers = observers
        self._observed = bool(observers)
        self._status_waiters: list[_StatusWaiter] = []
        self._asked_at: dict[object, float] = {}
        self.active_in_doubt: bool = False  # somebody else loaded an application
        self.loads_by_others: int = 0
        self._heard_status = False  # in this session
        self._loaded_by_us = False
        self._warned_extra = self._warned_others = False
        self._lossy = False  # a message may come twice, or not
        self._takers: dict[type[Event], Callable[[Any, float, datetime], None]] = {
            m.StatusReport: self._on_status,
            m.ResultContainer: self._on_result,
            ResultBurst: self._on_burst,
            m.QueryAnswer: self._on_active,
            m.SwitchAnswer: self._on_switched,
            m.TriggerAnswer: self._on_trigger_answer,
        }

    def begin(self, dialect: Dialect, *, ordered: bool) -> None:
        """A new session; ``ordered`` where messages come in order and none is lost (TCP)."""
        self.end = None
        self._dialect = dialect
        self._heard_status = self.active_in_doubt = self.fence_open = False
        self._warned_extra = self._warned_others = False
        self._lossy = not ordered
        # where the status has to be asked for, changes of it are missed
        complete = ordered and dialect.capabilities.status_by_itself
        self.attribution.begin_session(ordered=complete)

    # ------------------------------------------------------------------ from the receive task

    def dispatch(self, chunk: Chunk) -> None:
        """Hand on every event of a chunk, in order; never waits, never raises."""
        at, now = datetime.now(UTC), chunk.received_at
        for event in chunk.events:
            take = self._takers.get(type(event))
            if take is not None:  # LinkFailed and LinkEnded: the receive task ends by them
                take(event, now, at)
            if self.answers and isinstance(event, m.Message):
                self._on_answer(event, now)

    def fail(self, error: SmartCamError) -> None:
        """The session is over: tell everybody who waits, and who comes before the next one.

        The first reason stays. Streams go on until :meth:`finish`. What the trigger under way
        would have given may come in the next session: it is owed.
        """
        if self.end is not None:
            return
        self.end = error
        for answer in self.answers.values():
            answer.set_result(error)
        self.answers.clear()
        self._asked_at.clear()
        self.fence_open = False
        waiting: list[asyncio.Future[Any]] = [*self.next_results]
        waiting += [waiter.outcome for waiter in self._status_waiters]
        pending = self.pending
        if pending is not None:
            self.attribution.give_up(pending)
            pending.fail(error)
        for future in waiting:
            if not future.done():
                future.set_exception(error)
        self.next_results.clear()
        self._status_waiters.clear()
        self.release_held()

    def finish(self) -> None:
        """Nothing more will come: end the streams, quietly if it was us who closed."""
        for stream in self.streams():
            stream.end(None if isinstance(self.end, ConnectionClosedError) else self.end)

    # ------------------------------------------------------------------ for the client

    def streams(self) -> list[Queue[Any]]:
        """Every subscription that is still referred to."""
        return [*self.result_streams, *self.status_streams, *self.event_streams]

    @property
    def pending(self) -> PendingTrigger | None:
        """The trigger under way, as long as its caller waits."""
        pending = self._pending
        if pending is None or pending.ended:
            return None
        if pending.outcome.cancelled():  # its caller was not woken yet
            pending.ended = True
            self.attribution.give_up(pending)
            return None
        return pending

    def begin_trigger(self, pending: PendingTrigger) -> None:
        """A trigger is sent now."""
        self._pending = pending
        if pending.number is not None:
            self._numbering = pending.interpretation
        self.attribution.send(pending)

    def end_trigger(self) -> None:
        """Its caller goes on."""
        self._pending = None
        self.attribution.leave()
        self.release_held()

    def next_answer(self, key: type[m.Message] | int) -> asyncio.Future[Answer]:
        """Register for the next answer of this kind; errors come as a result, never raised."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[Answer] = loop.create_future()
        self.answers[key] = future
        if key is not m.SwitchAnswer:  # it takes its time, which is no round trip
            self._asked_at[key] = loop.time()
        return future

    async def wait_status(self, predicate: Callable[[Status], bool], deadline: float) -> Status:
        """Return the first status, the present one included, that ``predicate`` accepts.

        It is shown every status in order. What it raises comes out here.

        Raises:
            TimeoutError: at ``deadline`` (loop time).
            LinkError: the session ended.
        """
        if self.end is not None:
            raise self.end.with_traceback(None)  # raised many times, it would grow each time
        if self.status is not None and predicate(self.status):
            return self.status
        waiter = _StatusWaiter(predicate, asyncio.get_running_loop().create_future())
        self._status_waiters.append(waiter)
        self.want_status()
        try:
            async with asyncio.timeout_at(deadline):
                return await waiter.outcome
        finally:
            if waiter in self._status_waiters:
                self._status_waiters.remove(waiter)

    @property
    def awaits_status(self) -> bool:
        """Whether somebody waits for a status, or for what it may say of the trigger under way."""
        return bool(self._status_waiters) or self._pending is not None

    @property
    def watches_status(self) -> bool:
        """Whether somebody subscribed to statuses or events."""
        streams: list[Queue[Any]] = [*self.status_streams, *self.event_streams]
        return any(not stream.ended for stream in streams)

    def want_status(self) -> None:
        """Have the status asked for, where it does not come by itself."""
        if self.on_status_wanted is not None:
            self.on_status_wanted()

    def set_active(self, application: int, at: datetime) -> None:
        """Note which application is active."""
        previous, self.active = self.active, application
        if previous != application:
            self.publish(
                ApplicationChanged(
                    camera=self.name, at=at, application=application, previous=previous
                )
            )

    def publish(self, event: CameraEvent) -> None:
        """Hand an event to its subscribers."""
        logger.debug("%s = %s", self.name, event)
        self._observers.state(event)
        for stream in self.event_streams:
            stream.offer(event, 0.0)

    # ------------------------------------------------------------------ inside

    def _on_answer(self, message: m.Message, now: float) -> None:
        key = message.message_id if isinstance(message, m.UnknownMessage) else type(message)
        future = self.answers.pop(key, None)
        if future is not None:
            asked_at = self._asked_at.pop(key, None)
            if asked_at is not None:
                self.account.round_trip.add(now - asked_at)
            future.set_result(message)

    def _verdict(self, code: int) -> CodeVerdict:
        return CodeVerdict.DONE if self._dialect is None else self._dialect.code(code).verdict

    def _on_active(self, answer: m.QueryAnswer, now: float, at: datetime) -> None:
        if self.fence_open:
            self.fence_open = False
            self.attribution.on_fence(int(self.status or 0))
        elif self._held:
            self.attribution.on_answer_to_query()
            self.release_held()
        if answer.application != self.active and self._verdict(answer.code) is CodeVerdict.DONE:
            self.set_active(answer.application, at)

    def _on_switched(self, answer: m.SwitchAnswer, now: float, at: datetime) -> None:
        verdict = self._verdict(answer.code)
        if verdict is CodeVerdict.DONE:
            self.expected = answer.application
            self.input_in_doubt = False
            self._loaded_by_us = True
            self.attribution.settled()
        known = self._dialect is None or answer.application in self._dialect.application_ids
        if verdict is CodeVerdict.DONE or known:  # too busy, or too short, to say
            self.set_active(answer.application, at)

    def _on_trigger_answer(self, answer: m.TriggerAnswer, now: float, at: datetime) -> None:
        self.attribution.on_answer()
        pending = self._pending
        if pending is not None and not pending.run.confirmed and self.on_unconfirmed is not None:
            self.on_unconfirmed()

    def _on_status(self, report: m.StatusReport, now: float, at: datetime) -> None:
        before, status = self.status, report.status
        bits = int(status)
        self.statuses_heard += 1
        was = int(before) if self._heard_status and before is not None else None
        self.status, self.endian, self._heard_status = status, report.endian, True
        risen, fallen = bits & ~(was or 0), (was or 0) & ~bits
        if (risen | fallen) & _NOTED:
            self._note_changes(risen, fallen)
        if risen & _FAILING or fallen & _RUNNING:
            self._fail_trigger(risen, fallen)
        if self.attribution.on_status(was, bits):
            self._note_others()
        if self._held:
            self.release_held()
        if self._pending is not None and self._pending.results:
            self._complete(now)
        if bits & _RUNNING_OR_BUSY == _BUSY or (was or 0) & _RUNNING_OR_BUSY == _BUSY:
            self._note_loading(bits)
        if status != before and self._is_watched():
            self.publish(StatusChanged(camera=self.name, at=at, status=status, previous=before))
        if self.status_streams.references:
            for stream in self.status_streams:
                stream.offer(status, now)
        for waiter in tuple(self._status_waiters) if self._status_waiters else ():
            if waiter.outcome.done():
                continue
            try:
                if waiter.predicate(status):
                    waiter.outcome.set_result(status)
            except (Exception, asyncio.CancelledError) as exc:  # noqa: BLE001 - the user's own
                waiter.outcome.set_exception(exc)

    def _is_watched(self) -> bool:
        """Whether anybody would see an event."""
        watched = self._observed or bool(self.event_streams.references)
        return watched or logger.isEnabledFor(logging.DEBUG)

    def _note_loading(self, bits: int) -> None:
        """Doubt which application is active when somebody else's switch has ended.

        Args:
            bits: the status; it, or the one before, was ``Status.loading``.
        """
        if bits & _RUNNING_OR_BUSY == _BUSY:
            self._loaded_by_us = False
        else:
            by_us = self._loaded_by_us or m.SwitchAnswer in self.answers
            self.active_in_doubt = self.active_in_doubt or not by_us
            self.loads_by_others += not by_us

    def _note_changes(self, risen: int, fallen: int) -> None:
        if risen & Status.OVERTRIGGERED:
            self.account.overtriggers += 1
        if risen & Status.OVERHEAT:
            logger.warning("%s ! the camera is too hot: inspections may get worse", self.name)
        if fallen & Status.OVERHEAT:
            logger.info("%s = the camera is no longer too hot", self.name)
        if risen & Status.SYSTEM_ERROR:
            logger.error("%s ! the camera reports System Error", self.name)

    def _fail_trigger(self, risen: int, fallen: int) -> None:
        """End the trigger under way where the status says that its result cannot be trusted."""
        pending = self.pending
        if pending is None:
            return
        error: SmartCamError | None = None
        if risen & Status.SYSTEM_ERROR:
            error = CameraFaultError(f"{self.name}: the camera reports System Error")
        elif risen & Status.OVERTRIGGERED:
            error = OvertriggeredError(
                f"{self.name}: the camera dropped a trigger while ours was under way; "
                "it cannot be told whose"
            )
        elif risen & Status.INPUT_CONTAINER and pending.has_input:
            error = InputContainerError(
                f"{self.name}: input data and inspections are out of step: "
                "the result would not belong to this input"
            )
        elif fallen & Status.RUNNING:
            error = NotRunningError(
                f"{self.name}: somebody else stopped application {self.active} during the "
                f"inspection, which voids it; status: {self.status}"
            )
        if error is not None:
            self.attribution.give_up(pending, "streamed")  # what still comes is nobody's
            pending.fail(error)

    def _on_burst(self, burst: ResultBurst, now: float, at: datetime) -> None:
        """Count and hand on several containers at once; one by one where they may differ."""
        results = self._read_burst(burst, at)
        if results is None:
            for container in burst:
                self._on_result(container, now, at)
            return
        self.set_active(burst.application, at)
        count = len(burst.data)
        account = self.account
        account.count("streamed", count)
        if self.attribution.satisfied:
            self._note_extra(count)
        for stream in self.result_streams:
            stream.offer_all(results, now, burst.size)

    def _read_burst(self, burst: ResultBurst, at: datetime) -> list[Result] | None:
        """Return the results of a burst that is only streamed; None where one may be anything else.

        A trigger or a single waiter may want one, a debt be paid, an observer look at each; and
        what cannot be interpreted is an item of its own.
        """
        application = burst.application
        if not self.attribution.quiet or self.next_results or self._observed:
            return None
        if self.expected not in {None, application} or not self._listening():
            return None
        name, first = self.name, self.account.received + 1
        done = self.interpretation.burst(
            application, burst.data, self.endian, camera=name, number=first, at=at
        )
        if done is None:
            return None
        values, empty_slots = done
        self.account.empty_slots += empty_slots
        # rows of a Result's fields; a loop in Python would take twice as long
        numbers, none = itertools.count(first), itertools.repeat(None)
        names, applications, ats = map(itertools.repeat, (name, application, at))
        fields = (names, applications, none, numbers, none, ats, none, burst.data, values)
        rows = zip(*fields, strict=False)
        return list(map(_new_tuple, itertools.repeat(Result), rows))

    def release_held(self) -> None:
        """Give the containers their fate of which it was not known whether they are the trigger's.

        They are, if nothing of it was seen to begin since; what came before that is older.
        """
        held, self._held = self._held, []
        pending = self.pending
        older = pending is None or pending.run.begun
        for container, now, at in held:
            self._on_result(container, now, at, older=older)

    def _on_result(
        self, container: m.ResultContainer, now: float, at: datetime, *, older: bool = False
    ) -> None:
        account, attribution = self.account, self.attribution
        if container.application < 0:  # a quirk: it does not say whose it is
            active = m.UNNAMED_APPLICATION if self.active is None else self.active
            container = replace(container, application=active)
        pending = self.pending
        expected = self.expected
        if expected is None and pending is not None:
            expected = pending.application
        if self.active != container.application:
            self.set_active(container.application, at)
        if expected is not None and container.application != expected:
            account.count("wrong_application")
            if pending is not None:
                attribution.give_up(pending)  # ours may still come
                pending.fail(self._wrong_application(container, expected))
            return
        numbering = self._numbering
        number = numbering.number(container, self.endian) if numbering is not None else None
        verdict = attribution.judge_other(number) if older else attribution.judge(number)
        if verdict.fate == "held":
            if (
                self.on_held is not None
                and pending is not None
                and len(self._held) < pending.wanted
            ):
                self._held.append((container, now, at))
                self.on_held()
                return
            verdict = attribution.judge_other(number)
        if self._lossy and verdict.fate == "triggered" and self._is_double(container, pending):
            verdict = Verdict("nobody", extra=True)
        if verdict.extra:
            self._note_extra()
        owner = pending if verdict.fate == "triggered" else None
        current = verdict.fate == "triggered" or verdict.fate == "nobody"
        fate: str = verdict.fate
        if owner is None:
            listening = self._listening()
            if fate == "nobody":
                fate = "streamed" if listening else "unclaimed"
            if not listening:
                account.count(fate)
                return
        try:
            result = self._interpret(container, owner, now, at)
        except InterpretationError as error:
            account.count("late" if fate == "late" else "uninterpretable")
            size = len(container.data)
            self._deliver_error(error, owner, number, now, size=size, current=current)
        else:
            account.count(fate)
            self._deliver(result, owner, now, current=current)

    def _is_double(self, container: m.ResultContainer, pending: PendingTrigger | None) -> bool:
        """Whether it is a datagram that came twice, as far as can be told: one like it is there."""
        results = pending.results if pending is not None else []
        return any(one.raw == container.data for one in results)

    def _note_extra(self, count: int = 1) -> None:
        self.account.extra_results += count
        if not self._warned_extra:
            self._warned_extra = True
            logger.warning(
                "%s ! the application sends more than one result for a trigger; "
                "results_per_trigger= takes them all",
                self.name,
            )

    def _note_others(self) -> None:
        self.account.inspections_by_others += 1
        if not self._warned_others:
            self._warned_others = True
            logger.warning("%s ! something else triggers the camera, too", self.name)

    def _listening(self) -> bool:
        return any(not stream.ended for stream in self.result_streams) or any(
            not future.done() for future in self.next_results
        )

    def _interpret(
        self, container: m.ResultContainer, owner: PendingTrigger | None, now: float, at: datetime
    ) -> Result:
        interpretation = owner.interpretation if owner is not None else self.interpretation
        number = self.account.received + 1
        value, sequence, empty_slots = interpretation(
            container, self.endian, camera=self.name, number=number, at=at
        )
        self.account.empty_slots += empty_slots
        return Result(
            self.name,
            container.application,
            sequence,
            number,
            owner.triggered_at if owner is not None else None,
            at,
            now - owner.sent_at if owner is not None else None,
            container.data,
            value,
        )

    def _deliver(
        self, result: Result, owner: PendingTrigger | None, now: float, *, current: bool
    ) -> None:
        """Hand a result on; ``current`` where it is not known to be an older trigger's."""
        if self._observed:
            self._observers.result(result)
        if self.result_streams.references:
            for stream in self.result_streams:
                stream.offer(result, now, len(result.raw))
        if current and self.next_results:
            for future in self._take_next_results():
                future.set_result(result)
        if owner is not None:
            owner.results.append(result)
            owner.came += 1
            self._complete(now)

    def _complete(self, now: float) -> None:
        """End the trigger under way if it has all its results, and nothing speaks against it."""
        owner = self.pending
        if owner is None or owner.came < owner.wanted or not owner.run.confirmed:
            return
        self._end_input_doubt(owner)
        self.account.processing.add(now - owner.sent_at)
        self.attribution.done(owner)
        owner.succeed()

    def _deliver_error(
        self,
        error: InterpretationError,
        owner: PendingTrigger | None,
        number: int | None,
        now: float,
        *,
        size: int,
        current: bool,
    ) -> None:
        if self.result_streams:
            _let_go(error)
        for stream in self.result_streams:
            stream.offer(error, now, size)
        if current:
            for future in self._take_next_results():
                future.set_exception(error)
        if owner is None:
            self._observers.error(self.name, error)
            return
        self._end_input_doubt(owner)
        # where its number cannot be read, it may be another's, and its own still come
        certain = owner.number is None or number == owner.number
        self.attribution.give_up(owner, unread=int(certain))
        if not owner.given_up:
            self.attribution.done(owner)
        owner.fail(error)

    def _end_input_doubt(self, owner: PendingTrigger) -> None:
        if owner.has_input:
            self.input_in_doubt = False

    def _take_next_results(self) -> list[asyncio.Future[Result]]:
        waiting = [future for future in self.next_results if not future.done()]
        self.next_results.clear()
        return waiting

    def _wrong_application(
        self, container: m.ResultContainer, expected: int
    ) -> WrongApplicationError:
        return WrongApplicationError(
            f"{self.name}: a result of application {container.application} came, "
            f"application {expected} was expected",
            expected=expected,
            got=container.application,
        )


def _let_go(error: SmartCamError) -> None:
    """Take the frames from an error that may wait in a queue: they hold a whole delivery's bytes.

    What it came from gets a note instead that says where it was raised.
    """
    chain: list[BaseException | None] = [error]
    while chain:
        one = chain.pop()
        place = one.__traceback__ if one is not None else None
        if one is None or place is None:
            continue
        while place.tb_next is not None:
            place = place.tb_next
        if one is not error:
            code = place.tb_frame.f_code
            one.add_note(f"raised in {code.co_qualname}, {code.co_filename}:{place.tb_lineno}")
        one.__traceback__ = None  # so that each comes once
        chain += (one.__cause__, one.__context__)
