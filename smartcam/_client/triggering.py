"""Trigger the camera: wait until it is ready, send the trigger, and return results or an error.

First the results that earlier triggers still owe are awaited or made impossible, and a Query is
sent before each trigger, so that no older result counts as the trigger's
(:mod:`smartcam._client.correlation`).
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from smartcam._arguments import duration_text
from smartcam._client.correlation import (
    EvidenceByAcknowledgement,
    EvidenceByAnswer,
    EvidenceByRoundTrip,
    EvidenceByStatus,
    TriggerEvidence,
)
from smartcam._client.results import PendingTrigger
from smartcam._client.status import runs_not_busy
from smartcam.exceptions import (
    CameraBusyError,
    CameraFaultError,
    CommandRejectedError,
    InputContainerError,
    NotRunningError,
    OvertriggeredError,
    ResponseTimeoutError,
    SmartCamError,
    TriggerTimeoutError,
    UnsupportedError,
    WrongApplicationError,
)
from smartcam.models import Status
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Coroutine, Sequence
    from typing import Any

    from smartcam._client.camera_state import CameraState
    from smartcam._client.commands import Commands
    from smartcam._client.connection import Connection, Features
    from smartcam._client.interpretation import Interpretation
    from smartcam._client.link import Link
    from smartcam._client.polling import Polling
    from smartcam._client.requests import Requests
    from smartcam._client.results import Results
    from smartcam._client.status import StatusRequests
    from smartcam._client.waits import Answer, Waits
    from smartcam.models import Result

_WAITING, _OVERTRIGGERED = int(Status.WAITING_FOR_TRIGGER), int(Status.OVERTRIGGERED)
_SYSTEM_ERROR = int(Status.SYSTEM_ERROR)
# of these bits exactly Waiting is set if a trigger may be sent at once
_READY_BITS = int(
    Status.WAITING_FOR_TRIGGER | Status.BUSY | Status.SYSTEM_ERROR | Status.OVERTRIGGERED
)
# of these bits exactly Waiting is set if the camera waits for a trigger
_WAITS_BITS = int(Status.WAITING_FOR_TRIGGER | Status.BUSY | Status.SYSTEM_ERROR)

LATE_GRACE = 0.25
"""Seconds for which a late result is awaited before a Stop makes it impossible. Most results are
only a little late, and to stop and start an application takes longer."""


OVERTRIGGERED_GRACE = 1.0
"""Seconds for which a trigger waits until the Overtriggered of an earlier one falls. While the bit
is set, it cannot show that a new trigger was dropped, so no trigger is sent."""

DELAYED_BELOW_SHARE = 0.5
"""A trigger that is sent with less than this share of its timeout left counts as delayed."""

MIN_TIMEOUT_SHARE = 0.01
"""Least share of its timeout that a delayed trigger must have left."""

END_TRIGGER_SHARE = 0.8
"""Share of the time until a trigger's deadline after which the client ends the trigger, on a camera
that would not end it by itself. In the remaining time the answer arrives."""

_READY_HINT = (
    "; a camera does not wait for one while it inspects, or while an application runs free"
)


_SHOWS_TRIGGERS_HINT = (
    "; if this camera never shows that, add shows_triggers=no to its URL: then results need no "
    "such proof"
)

_QUERY, _TRIGGER, _GET_STATUS = m.Query(), m.Trigger(), m.GetStatus()

TRIGGER_BETWEEN_QUERIES = (_QUERY, _TRIGGER, _QUERY)
"""The messages of a trigger if statuses alone show its outcome. The machine recognizes them by this
one object."""


@dataclass(slots=True)
class TriggerRequest:
    """The arguments of a trigger, checked.

    Attributes:
        interpretation: interpretation of its results.
        input_data: data to send right before the trigger, None for none.
        results: number of results expected.
        wait: whether to wait until the camera accepts a trigger; otherwise a busy camera is an
            error.
        expected: id of the application that the results must come from; None: the application that
            this program loaded last, if any.
    """

    interpretation: Interpretation
    input_data: bytes | None
    results: int
    wait: bool
    expected: int | None = None


def is_stopped(status: Status) -> bool:
    """Return True if the camera is neither Running nor BUSY."""
    return not status & (Status.RUNNING | Status.BUSY)


def waits_for_trigger(status: Status) -> bool:
    """Return True if the camera waits for a trigger and is not BUSY."""
    return Status.WAITING_FOR_TRIGGER in status and Status.BUSY not in status


@dataclass(eq=False)
class Triggers:
    """Triggers a camera, one trigger at a time, in the order of the command lock."""

    _connection: Connection
    _requests: Requests
    _status: StatusRequests
    _commands: Commands
    _results: Results
    _state: CameraState
    _waits: Waits
    _polling: Polling

    def __post_init__(self) -> None:
        self._name = self._connection.name
        self._correlation = self._results.correlation
        # over UDP: link on which a status may have been lost
        self._doubtful_link: Link | None = None
        self._quickest_time = 0.0
        self._quickest_application: int | None = None  # application of the quickest result
        self._end_timer: asyncio.TimerHandle | None = None  # timer of the trigger under way

    def set_next_number(self, number: int) -> None:
        """Record that the user has set the number of the next run."""
        self._correlation.set_next_number(number)

    def _check_time_left(self, time_left: float, timeout: float) -> None:
        """Check that a delayed trigger has enough time left for its result.

        Otherwise its result would arrive late, and the next trigger would have to wait for that
        result first.

        Raises:
            ResponseTimeoutError: less time is left than the quickest result of this application
                took, or than a hundredth of the timeout.
        """
        quickest = self._quickest_time if self._quickest_application == self._state.active else 0.0
        needed = max(quickest, MIN_TIMEOUT_SHARE * timeout)
        if time_left < needed:
            waited = timeout - time_left
            raise ResponseTimeoutError(
                f"{self._name}: the camera was ready for the trigger only after {waited:.3g} s of "
                f"{timeout:g} s, and its result needs at least {needed:.3g} s",
                waited=waited,
            )

    def trigger(
        self, request: TriggerRequest, deadline: float, timeout: float
    ) -> Coroutine[Any, Any, list[Result]]:
        """Wait until the camera accepts a trigger, send it, and return its results.

        Args:
            request: the trigger's arguments.
            deadline: loop time at which the trigger ends.
            timeout: seconds of the whole call.

        Raises:
            SmartCamError: one of the outcomes of :meth:`Camera.trigger`.
        """
        if self._connection.features.acknowledged:
            return self._trigger_until_taken(request, deadline, timeout)
        return self._trigger_once(request, deadline, timeout)

    async def _trigger_until_taken(
        self, request: TriggerRequest, deadline: float, timeout: float
    ) -> list[Result]:
        """Send a trigger until the camera accepts one, and return its results.

        It is sent again only after a refusal: without an answer the camera may have accepted it.
        """
        busy: CameraBusyError | None = None
        while True:
            try:
                if busy is not None:
                    await self._status.pause(deadline, "the camera to take a trigger")
                return await self._trigger_once(request, deadline, timeout)
            except CameraBusyError as exc:
                if not request.wait:
                    raise
                busy = exc
            except (ResponseTimeoutError, TriggerTimeoutError) as exc:
                if busy is None:
                    raise
                raise TriggerTimeoutError(f"{exc}; {busy}", waited=exc.waited) from busy

    async def _trigger_once(
        self, request: TriggerRequest, deadline: float, timeout: float
    ) -> list[Result]:
        """Send one trigger when the camera accepts it, and return its results.

        Raises:
            SmartCamError: one of the outcomes of :meth:`Camera.trigger`.
        """
        connection, state, correlation = self._connection, self._state, self._correlation
        features, interpretation = connection.features, request.interpretation
        expected = state.expected if request.expected is None else request.expected
        if not self._can_send_now(request, expected):
            await self._get_ready(request, expected, deadline)
        numbering = interpretation.numbering(state.active) if features.numbered else None
        link = connection.require_link()
        now = link.loop.time()
        if deadline - now < DELAYED_BELOW_SHARE * timeout:
            self._check_time_left(deadline - now, timeout)
        number = None if numbering is None else correlation.take_number(numbering.highest)
        pending = PendingTrigger(
            request.results,
            number,
            EvidenceByStatus() if features.statuses_suffice else _evidence(features),
            link.make_future(),
            interpretation,
            request.input_data is not None,
            now,
            datetime.now(UTC),
            # application: any, if each has its own interpreter, so that no layout can be wrong
            request.expected if interpretation.by_application else state.active,
            [],
        )
        messages: Sequence[m.Message] = TRIGGER_BETWEEN_QUERIES
        if not features.statuses_suffice or number is not None or request.input_data is not None:
            messages = await self._prepare(pending, link, request.input_data, deadline)
            await self._await_turn(deadline)
        self._results.begin_trigger(pending, deadline)
        try:
            self._send(pending, link, messages, deadline)
            if not link.is_writable():
                with contextlib.suppress(TimeoutError):  # the outcome is then a timeout, too
                    async with asyncio.timeout_at(deadline):
                        await link.drain()
            results = await pending.outcome  # TimeoutError: the timer of Results, at the deadline
        except TimeoutError as exc:
            raise self._give_up_at_deadline(pending, link, deadline) from exc
        except asyncio.CancelledError:
            if not pending.outcome.done() or pending.outcome.cancelled():
                correlation.give_up(pending)
                if self._end_timer is not None and not self._end_timer.cancelled():
                    self._send_end_trigger(link)
            else:
                pending.outcome.exception()  # no task will read it
            raise
        else:
            took = link.last_byte_at - now
            if took < self._quickest_time or self._quickest_application != state.active:
                self._quickest_time, self._quickest_application = took, state.active
            return results
        finally:
            if self._end_timer is not None:
                self._end_timer.cancel()
                self._end_timer = None
            if features.polled:
                self._polling.end_trigger()
            self._results.end_trigger()

    def _can_send_now(self, request: TriggerRequest, expected: int | None) -> bool:
        """Return True if :meth:`_get_ready` has certainly nothing to do."""
        correlation = self._correlation
        return (
            self._connection.features.statuses_suffice
            and self._state.bits & _READY_BITS == _WAITING
            and (expected is None or expected == self._state.active)
            and request.input_data is None
            and self._doubtful_link is None
            and not correlation.status_may_be_old
            and not correlation.owed
            and not self._commands.is_halted()
            and self._requests.is_free(m.QueryAnswer)
        )

    async def _get_ready(
        self, request: TriggerRequest, expected: int | None, deadline: float
    ) -> None:
        """Wait until the camera accepts a trigger, and no result of an earlier one can arrive.

        Raises:
            SmartCamError: one of the outcomes of :meth:`Camera.trigger`; no trigger was sent.
        """
        connection, state, correlation = self._connection, self._state, self._correlation
        features = connection.features
        if features.polled:
            await self._status.refresh(deadline)
            correlation.note_query_answered()
        if state.bits & _SYSTEM_ERROR:
            raise self._fault_error()
        if request.input_data is not None and self._results.input_in_doubt:
            raise InputContainerError(
                f"{self._name}: input data of an earlier trigger, which had no result, may still "
                "be queued in the camera and would be taken for this one's; switch_application() "
                "empties the queue"
            )
        if expected is not None and state.active != expected:
            await self._check_application(expected, deadline)
        if self._doubtful_link is not None and self._doubtful_link is connection.link:
            await self._status.make_camera_send(deadline)
            # afterwards a status has arrived, or was lost again
            await self._requests.round_trip(deadline)
            self._doubtful_link = None
            correlation.note_query_answered()
        interpretation = request.interpretation
        numbering = interpretation.numbering(state.active) if features.numbered else None
        # if each container has a number, it identifies older results
        numbers_suffice = numbering is not None and numbering.always
        if correlation.status_may_be_old:  # the status may not show the earlier trigger yet
            await self._requests.round_trip(deadline)
            correlation.note_query_answered()
        if correlation.owed or self._commands.is_halted():
            await self._settle_owed(deadline, wait=request.wait, numbers_suffice=numbers_suffice)
        waited = False  # wait for a turn among Queries only once: many would delay the trigger long
        while True:
            status = state.bits
            if status & _WAITS_BITS != _WAITING:
                await self._wait_until_accepting(deadline, wait=request.wait)
            elif status & _OVERTRIGGERED:
                await self._clear_overtriggered(deadline)
            elif features.sends_queries and (
                self._waits.is_pending(m.QueryAnswer)  # only one Query can be open
                if waited
                else not self._requests.is_free(m.QueryAnswer)
            ):
                await self._requests.await_turn(m.QueryAnswer, _TRIGGER, deadline)
                waited = True
            else:
                break

    async def _await_turn(self, deadline: float) -> None:
        """Wait until a trigger may be sent: another task may have sent a Query."""
        requests, features = self._requests, self._connection.features
        while True:
            if features.acknowledged and self._waits.is_pending(m.TriggerAnswer):
                await requests.await_pending(m.TriggerAnswer, _TRIGGER, deadline)
            elif features.sends_queries and self._waits.is_pending(m.QueryAnswer):
                await requests.await_turn(m.QueryAnswer, _TRIGGER, deadline)
            else:
                break

    def _send(
        self, pending: PendingTrigger, link: Link, messages: Sequence[m.Message], deadline: float
    ) -> None:
        """Write a trigger with its other messages; note the pending answers."""
        requests, features = self._requests, self._connection.features
        link.send_all(messages)
        if features.statuses_suffice and messages is TRIGGER_BETWEEN_QUERIES:
            requests.expect_query_answers(2, pending.sent_at, deadline)
            return
        if features.ends_triggers:
            end = pending.sent_at + END_TRIGGER_SHARE * (deadline - pending.sent_at)
            self._end_timer = link.loop.call_at(end, self._send_end_trigger, link)
        if features.sends_queries:
            requests.expect_query_answers(messages.count(_QUERY), pending.sent_at, deadline)
        if features.acknowledged:
            self._expect_acknowledgement(pending, deadline)
        elif pending.has_input:
            self._results.note_input_sent()
        if features.polled:
            self._polling.begin_trigger(messages.count(_GET_STATUS))

    def _give_up_at_deadline(
        self, pending: PendingTrigger, link: Link, deadline: float
    ) -> TriggerTimeoutError:
        """Give up a trigger at its deadline; return the error."""
        self._correlation.give_up(pending)
        # over UDP the status at the beginning of the inspection may have been lost
        was_seen = self._connection.features.keeps_order or pending.evidence.begin_count
        self._doubtful_link = None if was_seen else link
        waited = max(0.0, deadline - pending.sent_at)
        arrived = f"{len(pending.results)} of {pending.wanted} results"
        return TriggerTimeoutError(
            f"{self._name}: {arrived if pending.results else 'no result'} within "
            f"{duration_text(waited)} of the trigger; status: {self._status.last}"
            f"{_missing_messages_text(pending)}",
            waited=waited,
        )

    async def _prepare(
        self, pending: PendingTrigger, link: Link, input_data: bytes | None, deadline: float
    ) -> list[m.Message]:
        """Return the messages of a trigger; send its input data now if the camera answers that."""
        requests, features = self._requests, self._connection.features
        asks_status = features.sends_queries and features.polled and features.shows_triggers
        messages: list[m.Message] = [_QUERY] if features.sends_queries else []
        if asks_status:
            messages.append(_GET_STATUS)
        if pending.number is not None:
            messages.append(m.SetSequenceNumber(number=pending.number))
        if features.acknowledged:
            await requests.await_pending(m.TriggerAnswer, m.Trigger(), deadline)
        if input_data is not None and link.machine.dialect.answers(m.SetInput):
            await requests.command(m.SetInput(data=input_data), deadline)
        elif input_data is not None:
            messages.append(m.SetInput(data=input_data))
        messages.append(_TRIGGER)
        if features.sends_queries and features.shows_triggers:
            messages.append(_GET_STATUS if asks_status else _QUERY)
        return messages

    def _send_end_trigger(self, link: Link) -> None:
        """Send the message that ends the running trigger, which the camera would not end itself."""
        with contextlib.suppress(SmartCamError):  # the link is over, and the trigger with it
            link.send(m.EndTrigger(), answered=False)

    def _expect_acknowledgement(self, pending: PendingTrigger, deadline: float) -> None:
        """Register for the trigger's answer, and end the trigger at once if it is a refusal."""

        def on_answer(answer: asyncio.Future[Answer]) -> None:
            reply = answer.result()
            if isinstance(reply, SmartCamError) or pending.outcome.done():
                return
            try:
                self._requests.check(m.Trigger, reply)
            except (CommandRejectedError, UnsupportedError) as exc:
                busy = isinstance(reply, m.Acknowledgement) and self._requests.is_busy(reply)
                if not self._connection.features.keeps_order:  # perhaps an earlier trigger's answer
                    self._correlation.give_up(pending)
                pending.fail(CameraBusyError(str(exc)) if busy else exc)
            except SmartCamError as exc:  # the link is over
                pending.fail(exc)

        self._requests.register_answer(m.TriggerAnswer, deadline).add_done_callback(on_answer)

    async def _check_application(self, expected: int, deadline: float) -> None:
        """Check that an application is the active one.

        Raises:
            WrongApplicationError: somebody else has switched; only a Query was sent.
        """
        await self._requests.round_trip(deadline)  # the known status may be old
        active = self._state.active
        if active != expected:
            raise WrongApplicationError(
                f"{self._name}: application {active} is active, somebody else has switched; "
                f"{expected} was expected",
                expected=expected,
                got=active,
            )

    async def _wait_until_accepting(self, deadline: float, *, wait: bool) -> None:
        """Wait until the camera accepts a trigger, or raise the reason why it never will."""
        begin = asyncio.get_running_loop().time()
        end_foreign_at = math.inf  # time at which another program's trigger is ended
        if self._connection.features.ends_triggers:
            end_foreign_at = begin + min(self._requests.answer_timeout, 0.5 * (deadline - begin))
        while True:
            if self._state.bits & _SYSTEM_ERROR:
                raise self._fault_error()
            status = self._status.last
            if waits_for_trigger(status):
                return
            if is_stopped(status):
                raise NotRunningError(
                    f"{self._name}: {self._state.active_text} is stopped: start it, or name it so "
                    f"that it is started; status: {status}"
                )
            if not wait:
                raise CameraBusyError(
                    f"{self._name}: the camera does not wait for a trigger: {status}"
                )
            try:
                await self._status.wait_asking_again(_is_decisive, min(deadline, end_foreign_at))
            except TimeoutError as exc:
                if asyncio.get_running_loop().time() < deadline:
                    end_foreign_at = math.inf
                    await self._end_foreign_trigger(deadline)
                    continue
                hint = _READY_HINT if runs_not_busy(status) else ""
                waited = max(0.0, deadline - begin)
                raise TriggerTimeoutError(
                    f"{self._name}: the camera did not wait for a trigger within "
                    f"{duration_text(waited)}; status: {self._status.last}{hint}",
                    waited=waited,
                ) from exc

    async def _end_foreign_trigger(self, deadline: float) -> None:
        """End a trigger of another program or of a lost link, which the camera would not end."""
        ours = self._waits.is_pending(m.TriggerAnswer)
        if Status.BUSY in self._status.last and not ours:
            self._send_end_trigger(self._connection.require_link())
            # afterwards no line of that trigger can be taken for the next one's
            await self._requests.round_trip(deadline)

    def _fault_error(self) -> CameraFaultError:
        return CameraFaultError(f"{self._name}: the camera reports System Error")

    async def _settle_owed(self, deadline: float, *, wait: bool, numbers_suffice: bool) -> None:
        """Await the owed result of an earlier trigger, or make it impossible.

        After Stop the running inspection has no result (inferred); containers before the answer to
        a later Query are of earlier triggers. On a camera without Stop this waits until the camera
        waits for a trigger again, and for the answer to a Query. With ``numbers_suffice`` only an
        interrupted stop is finished, since sequence numbers identify older results.
        """
        correlation, commands = self._correlation, self._commands
        if not commands.is_halted() and (numbers_suffice or correlation.owed_fate is None):
            return
        dialect = self._connection.dialect
        if dialect.results_are_attributable or not dialect.has(m.Stop):
            await self._wait_until_accepting(deadline, wait=wait)
            await self._requests.round_trip(deadline)
            correlation.forget_owed()
            return
        now = asyncio.get_running_loop().time()
        if not commands.is_halted() and Status.RUNNING in self._status.last:
            grace = min(deadline, now + min(LATE_GRACE, 0.5 * (deadline - now)))
            with contextlib.suppress(TimeoutError):
                await self._status.wait(_is_decisive, grace)
            if correlation.owed_fate is None:
                return
        if commands.is_in_run_mode:
            # if this is interrupted, the next trigger does it again
            await commands.discard_inspection(deadline)
        correlation.forget_owed()

    async def _clear_overtriggered(self, deadline: float) -> None:
        """Reset Overtriggered, or wait until it falls, so that it can rise for the next trigger.

        Source: the bit falls by itself (SC manual p. 30, published), at an unknown time; on BVS ID
        it stays until it is reset (BVS ID guide p. 227, published).

        Raises:
            OvertriggeredError: the bit stays set; no trigger was sent.
        """
        now = asyncio.get_running_loop().time()
        grace = min(OVERTRIGGERED_GRACE, 0.5 * (deadline - now))
        if self._connection.dialect.has(m.ResetErrors):
            await self._requests.command(m.ResetErrors(), deadline)
            await self._status.refresh(deadline)
        with contextlib.suppress(TimeoutError):
            await self._status.wait_asking_again(_is_not_overtriggered, now + grace)
            return
        raise OvertriggeredError(
            f"{self._connection.name}: Overtriggered has stayed set for {duration_text(grace)}. As "
            "long as it is, the camera cannot show that it drops a trigger, so none was sent. It "
            "may fall when the application is stopped and started"
        )


def _is_not_overtriggered(status: Status) -> bool:
    return Status.OVERTRIGGERED not in status


def _evidence(features: Features) -> TriggerEvidence:
    """Return a new object for the evidence that a trigger's results need in this protocol."""
    if not features.sends_queries:
        # over UDP an answer may be lost or late
        acknowledged = features.acknowledged and features.keeps_order
        return EvidenceByAcknowledgement() if acknowledged else TriggerEvidence()
    if not features.shows_triggers:
        return EvidenceByRoundTrip()
    return EvidenceByAnswer() if features.polled else EvidenceByStatus()


def _missing_messages_text(pending: PendingTrigger) -> str:
    """Return the part of an error text about the camera's missing messages."""
    evidence, early = pending.evidence, ""
    if pending.early_count:
        results = "1 result" if pending.early_count == 1 else f"{pending.early_count} results"
        early = f"; {results} came before the camera had shown that it took the trigger"
    if not evidence.takes_containers:
        hint = _SHOWS_TRIGGERS_HINT if early else ""
        return f"; the camera has not shown that it took the trigger{early}{hint}"
    if not evidence.proven:
        return f"; the camera has not answered the question that was sent with the trigger{early}"
    return early


def _is_decisive(status: Status) -> bool:
    return waits_for_trigger(status) or is_stopped(status) or Status.SYSTEM_ERROR in status
