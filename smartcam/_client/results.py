"""Decide where each result goes: to the running trigger, to streams, or only into the counters."""

from __future__ import annotations

import itertools
import logging
import random
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from smartcam._client.correlation import Correlation, Match, SentTrigger
from smartcam._client.deadline import DeadlineTimer, weak_callback
from smartcam._client.interpretation import new_tuple
from smartcam._client.waits import copy_to_raise
from smartcam.exceptions import (
    CameraFaultError,
    InputContainerError,
    InterpretationError,
    NotRunningError,
    OvertriggeredError,
    SmartCamError,
    WrongApplicationError,
)
from smartcam.models import Result, Status
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    import asyncio
    from datetime import datetime

    from smartcam._client.camera_state import CameraState
    from smartcam._client.counters import ClientCounters
    from smartcam._client.doorbell import DirectFuture
    from smartcam._client.interpretation import Interpretation
    from smartcam._client.listeners import Listeners
    from smartcam.protocols._inside import ResultBurst

    # a container, its fate, its number, and its arrival by the loop's and the wall clock
    _Unproven = tuple[m.ResultContainer, str, int | None, float, datetime]

logger: logging.Logger = logging.getLogger("smartcam.client")

# a change of these bits may mean that the running trigger has failed; a plain integer, since
# operations of an IntFlag cost more than the rest of handling a status
_FAILURE_BITS = int(
    Status.OVERTRIGGERED | Status.INPUT_CONTAINER | Status.SYSTEM_ERROR | Status.RUNNING
)

_CURRENT = {"triggered", "nobody"}
"""Fates of containers that are not known to belong to an older trigger."""


@dataclass(slots=True, eq=False)
class PendingTrigger(SentTrigger):
    """The running trigger, and the outcome that its caller waits for.

    Attributes:
        outcome: future with the results or the error.
        interpretation: interpretation that reads the results.
        has_input: True if input data was sent with the trigger.
        sent_at: loop time at which the trigger was sent.
        triggered_at: time of the wall clock, UTC.
        application: id of the application that is probably active; None: any is accepted.
        results: results received so far.
        unproven: containers received before the proof that the camera accepted the trigger. With
            the proof, those with the fate ``triggered`` are the trigger's results.
    """

    outcome: DirectFuture[list[Result]] | asyncio.Future[list[Result]]
    interpretation: Interpretation
    has_input: bool
    sent_at: float
    triggered_at: datetime
    application: int | None
    results: list[Result]
    unproven: list[_Unproven] = field(init=False, default_factory=list)

    def fail(self, error: Exception) -> None:
        """End the trigger with an error for its caller."""
        self.ended = True
        if not self.outcome.done():  # an interpreter may have cancelled the caller
            self.outcome.set_exception(error)


@dataclass(eq=False)
class Results:
    """Gives each container exactly one fate, and its result to its trigger and to the streams.

    Attributes:
        interpretation: interpretation of results, unless a trigger has its own.
        correlation: finds the trigger of each container.
        input_in_doubt: whether the input data of a trigger without a result may still be queued in
            the camera.
    """

    _name: str
    interpretation: Interpretation
    _state: CameraState
    _listeners: Listeners
    _counters: ClientCounters

    def __post_init__(self) -> None:
        self.correlation: Correlation = Correlation(random.random())  # noqa: S311
        self.input_in_doubt: bool = False
        self._pending: PendingTrigger | None = None
        # reads the sequence numbers in results; None until a trigger had a number
        self._number_reader: Interpretation | None = None
        self._warned_extra = self._warned_others = False
        self._lossy = False  # whether a message may arrive twice or be lost (UDP)
        self._timer = DeadlineTimer(weak_callback(self, Results._time_out))

    def _time_out(self) -> None:
        self.give_up(TimeoutError())

    def begin_session(self, *, keeps_order: bool, gets_every_status: bool) -> None:
        """Begin a session.

        Args:
            keeps_order: messages come in order and none is lost (TCP).
            gets_every_status: every change of the status is sent, in order.
        """
        self._warned_extra = self._warned_others = False
        self._lossy = not keeps_order
        self.correlation.begin_session(gets_every_status=gets_every_status)

    def fail(self, error: SmartCamError) -> None:
        """End the session and the running trigger.

        The camera may still send the trigger's results in the next session; then they are late.
        """
        if self._pending is not None:
            self.give_up(copy_to_raise(error))

    def finish(self) -> None:
        """End for good: leave nothing in the event loop."""
        self._timer.cancel()

    # ------------------------------------------------------------------ the running trigger

    def _waiting_trigger(self) -> PendingTrigger | None:
        """Return the running trigger while its caller waits, else None."""
        pending = self._pending
        if pending is None:
            return None
        if pending.outcome.cancelled() and not pending.ended:  # the caller was not woken yet
            pending.ended = True
            self.correlation.give_up(pending)
        if not pending.ended:
            return pending
        if pending.unproven:
            self._release_unproven(pending)
        return None

    def begin_trigger(self, pending: PendingTrigger, deadline: float) -> None:
        """Record that a trigger is sent; its results are late after ``deadline`` (loop time)."""
        self._pending = pending
        self._timer.set(deadline)
        if pending.number is not None:
            self._number_reader = pending.interpretation
        self.correlation.begin_trigger(pending)

    def end_trigger(self) -> None:
        """Record that the trigger's caller no longer waits."""
        pending, self._pending = self._pending, None
        if pending is not None and pending.unproven:
            pending.ended = True
            self._release_unproven(pending)
        self._timer.clear()
        self.correlation.end_trigger()

    def give_up(self, error: Exception) -> None:
        """End the running trigger with an error; its results are late from now on."""
        pending = self._waiting_trigger()
        if pending is not None:
            self.correlation.give_up(pending)
            pending.fail(error)
            self._release_unproven(pending)

    def note_input_sent(self) -> None:
        """Record that input data was sent with the trigger; the camera may not have used it."""
        self.input_in_doubt = True

    # ------------------------------------------------------------------ received messages

    def on_switched(self) -> None:
        """Forget older results, which cannot arrive after another application was loaded."""
        self.input_in_doubt = False
        self.correlation.forget_owed()

    def on_trigger_query_answer(self, now: float) -> None:
        """Record that the Query that was sent with the last trigger is answered."""
        self.correlation.on_trigger_query_answer()
        self._decide(now)

    def on_trigger_answer(self, now: float) -> None:
        """Record that the last trigger was acknowledged."""
        self.correlation.on_trigger_answer()
        self._decide(now)

    def _decide(self, now: float) -> None:
        """End the running trigger if the messages received so far decide its outcome."""
        pending = self._waiting_trigger()
        if pending is None:
            return
        if pending.evidence.doubtful:
            self._fail(
                pending,
                OvertriggeredError(
                    f"{self._name}: it is unknown to which trigger the result belongs: something "
                    "else has triggered the camera just now, or an answer of the camera is missing"
                ),
            )
        else:
            if pending.unproven and pending.evidence.proven:
                self._release_unproven(pending)
            if pending.results:
                self._complete(pending, now)

    def on_status(self, previous: int | None, bits: int, now: float) -> None:
        """Handle a status.

        Args:
            previous: the status before, None if there was none in this session.
            bits: the new status.
            now: loop time.
        """
        old_bits = previous or 0
        if (bits ^ old_bits) & _FAILURE_BITS:
            self._fail_by_status(bits & ~old_bits, old_bits & ~bits)
        if self.correlation.on_status(previous, bits):
            self._note_foreign_inspection()
        if self._pending is not None:
            self._decide(now)

    def _fail_by_status(self, risen: int, fallen: int) -> None:
        """End the running trigger if the status shows that its result would be unreliable."""
        pending = self._waiting_trigger()
        if pending is None:
            return
        error: SmartCamError | None = None
        if risen & Status.SYSTEM_ERROR:
            error = CameraFaultError(f"{self._name}: the camera reports System Error")
        elif risen & Status.OVERTRIGGERED:
            error = OvertriggeredError(
                f"{self._name}: the camera dropped a trigger while ours was under way; "
                "it is unknown whether it dropped ours"
            )
        elif risen & Status.INPUT_CONTAINER and pending.has_input:
            error = InputContainerError(
                f"{self._name}: input data and inspections are out of step: "
                "the result would not belong to this input"
            )
        elif fallen & Status.RUNNING:
            error = NotRunningError(
                f"{self._name}: somebody else stopped {self._state.active_text} during the "
                f"inspection, which voids it; status: {self._state.status}"
            )
        if error is not None:
            self._fail(pending, error)

    def _fail(self, pending: PendingTrigger, error: SmartCamError) -> None:
        """End the running trigger; later results of it go to the streams."""
        self.correlation.give_up(pending, "streamed")
        pending.fail(error)
        self._release_unproven(pending)

    def _release_unproven(self, pending: PendingTrigger) -> None:
        """Pass the unproven containers to the trigger, or to the streams if it has ended."""
        unproven, pending.unproven = pending.unproven, []
        if not pending.ended:
            pending.received -= sum(fate == "triggered" for _, fate, *_ in unproven)
        for container, fate, number, now, at in unproven:
            if fate != "triggered":
                self.deliver(container, None, fate, number, now, at)
            elif not pending.ended:  # it ends if a container cannot be interpreted
                self.deliver(container, pending, fate, number, now, at)
            else:
                older = self.correlation.judge_older(number).fate
                self.deliver(container, None, older, number, now, at)

    def on_burst(self, burst: ResultBurst, now: float, at: datetime) -> None:
        """Count several containers and pass them on, singly if their fates may differ."""
        results = self._read_burst(burst, at)
        if results is None:
            for container in burst:
                self.on_result(container, now, at)
            return
        self._state.set_active(burst.application, at)
        count = len(burst.data)
        self._counters.count("streamed", count)
        if self.correlation.judge(None).extra:
            self._note_extra(count)
        self._listeners.offer_burst(results, now, burst.size)

    @property
    def is_streaming_only(self) -> bool:
        """True if all results go to streams, and need not be passed on singly.

        No result can then belong to a trigger, be owed, or count as an extra result.
        """
        correlation = self.correlation
        needed = self._pending or self._number_reader or correlation.owed or correlation.satisfied
        return not needed and self._listeners.results_only_streamed

    def _read_burst(self, burst: ResultBurst, at: datetime) -> list[Result] | None:
        """Return the results of a burst that is only streamed; None if they must be passed singly.

        They must if a trigger or a caller of ``next_result()`` may need one of them, if a result
        may be owed, or if a container cannot be interpreted: streams get the error in its place.
        """
        application = burst.application
        if self._pending or self._number_reader or self.correlation.owed:
            return None
        if not self._listeners.results_only_streamed:
            return None
        if self._state.expected not in {None, application}:
            return None
        name, first = self._name, self._counters.received + 1
        interpreted = self.interpretation.burst(
            application, burst.data, self._state.endian, camera=name, number=first, at=at
        )
        if interpreted is None:
            return None
        values, empty_slots = interpreted
        self._counters.add_empty_slots(empty_slots)
        # rows of a Result's fields; a loop in Python would take twice as long
        numbers, none = itertools.count(first), itertools.repeat(None)
        names, applications, ats = map(itertools.repeat, (name, application, at))
        fields = (names, applications, none, numbers, none, ats, none, burst.data, values)
        rows = zip(*fields, strict=False)
        return list(map(new_tuple, itertools.repeat(Result), rows))

    def on_result(self, container: m.ResultContainer, now: float, at: datetime) -> None:
        """Decide the fate of a container, and pass its result on.

        Args:
            container: container received.
            now: loop time at which the container came.
            at: time of the wall clock at which the container came.
        """
        state, counters, pending = self._state, self._counters, self._waiting_trigger()
        active, expected = state.active, state.expected
        if container.application < 0:  # some cameras do not send the application
            application = m.UNNAMED_APPLICATION if active is None else active
            container = replace(container, application=application)
        if expected is None and pending is not None:
            expected = pending.application
        if active != container.application:
            state.set_active(container.application, at)
        if expected is not None and container.application != expected:
            # the trigger's result may still arrive
            self.give_up(self._wrong_application(container, expected))
            if state.shared:  # the result may be for another program
                self.deliver(container, None, "streamed", None, now, at)
            else:
                counters.count("wrong_application")
            return
        reader = self._number_reader
        number = None if reader is None else reader.sequence_number(container, state.endian)
        correlation = self.correlation
        is_ours = container.requested
        match = (
            correlation.judge(number) if is_ours is None else correlation.judge_requested(is_ours)
        )
        if self._lossy and match.fate == "triggered" and self._is_repeated(container, pending):
            match = Match("nobody", extra=True)
        if match.extra:
            self._note_extra()
        is_ours = match.fate == "triggered" and pending is not None
        if pending is not None and (pending.unproven or (is_ours and not pending.evidence.proven)):
            pending.unproven.append((container, match.fate, number, now, at))
            if is_ours:
                pending.received += 1
            return
        owner = pending if match.fate == "triggered" else None
        self.deliver(container, owner, match.fate, number, now, at)

    def deliver(
        self,
        container: m.ResultContainer,
        owner: PendingTrigger | None,
        fate: str,
        number: int | None,
        now: float,
        at: datetime,
    ) -> None:
        """Count a container, and pass its result to its trigger ``owner`` and to the listeners."""
        counters, listeners = self._counters, self._listeners
        current = fate in _CURRENT
        if owner is None:
            is_wanted = listeners.wants_results
            if fate == "nobody":
                fate = "streamed" if is_wanted else "unclaimed"
            if not is_wanted:
                counters.count(fate)
                return
        name, own_number = self._name, counters.received + 1
        interpretation, began, latency = self.interpretation, None, None
        if owner is not None:
            interpretation, began = owner.interpretation, owner.triggered_at
            latency = now - owner.sent_at
        try:
            # interpretation(...) instead of its method costs four times as much
            value, sequence, empty_slots = interpretation.__call__(
                container, self._state.endian, camera=name, number=own_number, at=at
            )
        except InterpretationError as error:
            counters.count("late" if fate == "late" else "uninterpretable")
            size, is_owned = len(container.data), owner is not None
            listeners.offer_error(error, now, size, current=current, reported_by_caller=is_owned)
            if owner is not None:
                self._fail_uninterpretable(owner, error, number)
            return
        if empty_slots:
            counters.add_empty_slots(empty_slots)
        application, data = container.application, container.data
        fields = (name, application, sequence, own_number, began, at, latency, data, value)
        result: Result = new_tuple(Result, fields)
        counters.count(fate)
        listeners.offer_result(result, now, current=current, late=fate == "late")
        if owner is not None:
            owner.results.append(result)
            owner.received += 1
            self._complete(owner, now)

    def match_usual_exchange(self, container: m.ResultContainer) -> PendingTrigger | None:
        """Return the running trigger if a container between its Queries' answers is its result.

        Then the answers are recorded, and the caller passes the container to :meth:`deliver`. None
        if the answers do not suffice for the decision, or if the trigger already has a result.
        """
        pending = self._pending
        if pending is None or pending.ended or pending.outcome.done() or pending.received:
            return None
        if self._lossy or self._number_reader is not None or container.requested is not None:
            return None
        expected = self._state.expected
        if expected is None:
            expected = pending.application
        if expected is not None and expected != container.application:
            return None
        if pending.unproven or pending.given_up or not self.correlation.note_exchange(pending):
            return None
        return pending

    def _is_repeated(self, container: m.ResultContainer, pending: PendingTrigger | None) -> bool:
        """Return True if the same container has arrived before, as with a repeated datagram."""
        results = pending.results if pending is not None else []
        return any(result.raw == container.data for result in results)

    def _note_extra(self, count: int = 1) -> None:
        self._counters.note_extra(count)
        if not self._warned_extra:
            self._warned_extra = True
            logger.warning(
                "%s ! the application sends more than one result for a trigger; "
                "results_per_trigger= takes them all",
                self._name,
            )

    def _note_foreign_inspection(self) -> None:
        self._counters.note_foreign_inspection()
        if not self._warned_others:
            self._warned_others = True
            logger.warning("%s ! something else triggers the camera, too", self._name)

    def _complete(self, owner: PendingTrigger, now: float) -> None:
        """End a trigger that has all its results, if messages prove that they belong to it."""
        if owner.received < owner.wanted or not owner.evidence.proven or owner.outcome.done():
            return
        if owner.has_input:
            self.input_in_doubt = False
        self._counters.processing.add(now - owner.sent_at)
        self.correlation.complete(owner)
        owner.ended = True
        owner.outcome.set_result(owner.results)

    def _fail_uninterpretable(
        self, owner: PendingTrigger, error: InterpretationError, number: int | None
    ) -> None:
        """End a trigger whose result cannot be interpreted."""
        if owner.has_input:
            self.input_in_doubt = False
        # without a readable number the result may be another trigger's
        is_its_result = owner.number is None or number == owner.number
        self.correlation.give_up(owner, unread=int(is_its_result))
        if not owner.given_up:
            self.correlation.complete(owner)
        owner.fail(error)

    def _wrong_application(
        self, container: m.ResultContainer, expected: int
    ) -> WrongApplicationError:
        return WrongApplicationError(
            f"{self._name}: a result of application {container.application} came, "
            f"application {expected} was expected",
            expected=expected,
            got=container.application,
        )
