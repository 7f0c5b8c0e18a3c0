"""Keep the waits for answers and statuses, and the reason why there is no session."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from smartcam._client.doorbell import wake
from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import SmartCamError
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam._client.counters import ClientCounters
    from smartcam._client.doorbell import Waiter
    from smartcam.models import Status

Answer = m.Message | SmartCamError
"""The outcome of a request: the answer, or the reason of its absence as an error."""


ErrorT = TypeVar("ErrorT", bound=SmartCamError)


def copy_to_raise(error: ErrorT) -> ErrorT:
    """Return a copy of a kept error, to be raised.

    A raised error refers to the stack frames of the caller, and so to the client. If the client's
    task kept that error, it would keep an unreferenced client alive.
    """
    copy = type(error)(*error.args)  # same result as copy(), in a tenth of the steps
    vars(copy).update(vars(error))
    copy.__cause__ = error.__cause__
    return copy


class PendingAnswer(asyncio.Future[Answer]):
    """A pending answer of the camera, for which several tasks may wait.

    Attributes:
        waiters: a future of each waiting task.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__(loop=loop)
        self.waiters: list[Waiter] = []

    def set_result(self, result: Answer) -> None:
        """Set the answer, or the reason of its absence, and wake the waiters."""
        super().set_result(result)
        for waiter in self.waiters:
            wake(waiter)


@dataclass(slots=True, eq=False)
class StatusWaiter:
    """A caller that waits for a status.

    Attributes:
        predicate: function that returns True for the awaited status.
        outcome: future of the status, or of the predicate's error as a value, since a future does
            not take every error.
    """

    predicate: Callable[[Status], bool]
    outcome: asyncio.Future[Status | BaseException]


class Waits:
    """The answers and statuses that callers await from the camera.

    Args:
        counters: counters of the round trips.

    Attributes:
        end_reason: reason why there is no session, None while there is one.
        pending_answers: futures of answers, by the type of the answer; by id for a message that
            the dialect does not know.
        open_queries: number of unanswered Queries that were sent with the last trigger.
        status_waiters: callers that wait for a status, in order.
    """

    def __init__(self, counters: ClientCounters) -> None:
        self.end_reason: SmartCamError | None = None
        self._counters = counters
        self.pending_answers: dict[type[m.Message] | int, PendingAnswer] = {}
        self._asked_at: dict[object, float] = {}
        # number of the last delivery before each request was sent, by the key of its answer
        self._last_delivery_before: dict[object, int] = {}
        self.open_queries: int = 0
        self.status_waiters: dict[StatusWaiter, None] = {}  # a dict: each is removed in one step

    def begin_session(self) -> None:
        """Begin a session, without a pending request."""
        self.end_reason = None
        self.open_queries = 0

    def fail(self, error: SmartCamError) -> bool:
        """End every wait with an error; waits that begin before the next session raise it, too.

        Returns:
            True if it is the first error of this session; a later one is ignored.
        """
        if self.end_reason is not None:
            return False
        self.end_reason = error
        if self.pending_answers or self.status_waiters:
            error = copy_to_raise(error)
        for answer in self.pending_answers.values():
            answer.set_result(error)
        self.pending_answers.clear()
        self._asked_at.clear()
        self._last_delivery_before.clear()
        self.open_queries = 0
        for waiter in self.status_waiters:
            if not waiter.outcome.done():
                waiter.outcome.set_result(error)
        self.status_waiters.clear()
        return True

    def finish(self, error: SmartCamError) -> None:
        """Record the reason why there will be no session any more."""
        self.end_reason = error

    def raise_end(self) -> None:
        """Raise the reason why there is no session; do nothing during a session.

        Raises:
            LinkError: the reason why there is no session.
        """
        if self.end_reason is not None:
            raise copy_to_raise(self.end_reason)

    # ------------------------------------------------------------------ answers

    def expect_answer(
        self,
        key: type[m.Message] | int,
        loop: asyncio.AbstractEventLoop,
        now: float,
        *,
        after_delivery: int = 0,
    ) -> PendingAnswer:
        """Register for the next answer of this kind; an error comes as the future's result, too.

        Messages in the link's delivery number ``after_delivery`` or an earlier one are no answer:
        they were received before the request was sent, and wait to be dispatched.
        """
        future = PendingAnswer(loop)
        self.pending_answers[key] = future
        self._last_delivery_before[key] = after_delivery
        if key is not m.SwitchAnswer:  # a switch takes long, which is no round trip
            self._asked_at[key] = now
        return future

    def pending_answer(self, key: type[m.Message] | int) -> PendingAnswer:
        """Return the future of a pending answer (:meth:`is_pending`); register a Query's now."""
        answer = self.pending_answers.get(key)
        if answer is None:
            loop = asyncio.get_running_loop()
            answer = self.expect_answer(key, loop, loop.time())
        return answer

    def is_pending(self, key: type[m.Message] | int) -> bool:
        """Return True if an answer of this kind is pending."""
        return key in self.pending_answers or (key is m.QueryAnswer and self.open_queries > 0)

    def expect_query_answers(self, count: int) -> None:
        """Record that Queries went out with a trigger; no task waits for their answers."""
        self.open_queries = count

    def awaits_only_queries(self, count: int) -> bool:
        """Return True if ``count`` Queries of a trigger are open, and no task awaits anything."""
        return self.open_queries == count and not self.pending_answers and not self.status_waiters

    def count_query_answer(self) -> bool:
        """Count an answer to Query for the last trigger; return False if none is expected."""
        if not self.open_queries:
            return False
        self.open_queries -= 1
        return True

    def on_message(self, message: m.Message, now: float, delivery: int) -> None:
        """Complete the request that a message answers, if one is open."""
        key = message.message_id if isinstance(message, m.UnknownMessage) else type(message)
        if delivery <= self._last_delivery_before.get(key, 0):
            return
        future = self.pending_answers.pop(key, None)
        if future is not None:
            asked_at = self._asked_at.pop(key, None)
            if asked_at is not None:
                self._counters.round_trip.add(now - asked_at)
            future.set_result(message)

    # ------------------------------------------------------------------ statuses

    async def wait_status(self, predicate: Callable[[Status], bool], deadline: float) -> Status:
        """Return the next status that ``predicate`` accepts; every status is passed to it in order.

        An error of the predicate is raised here.

        Raises:
            TimeoutError: at ``deadline`` (loop time).
            LinkError: the session ended.
        """
        waiter = StatusWaiter(predicate, asyncio.get_running_loop().create_future())
        self.status_waiters[waiter] = None
        try:
            async with asyncio.timeout_at(deadline):
                outcome = await waiter.outcome
        finally:
            self.status_waiters.pop(waiter, None)
        if isinstance(outcome, SmartCamError):
            raise outcome.with_traceback(None)  # shared: each raise would make the traceback longer
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    def offer_status(self, status: Status) -> None:
        """Call the predicate of every waiter with a status."""
        for waiter in tuple(self.status_waiters):
            if waiter.outcome.done():
                continue
            try:
                if waiter.predicate(status):
                    waiter.outcome.set_result(status)
            except ENDS_PROGRAM:
                raise
            except BaseException as exc:  # noqa: BLE001 - the user's own
                waiter.outcome.set_result(exc)
