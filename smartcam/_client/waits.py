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

    A raised error refers to the frames of its caller, and by them to the client: kept by the
    client's own task, it would keep an unreferenced client alive.
    """
    made = type(error)(*error.args)  # same result as copy(), in a tenth of the steps
    vars(made).update(vars(error))
    made.__cause__ = error.__cause__
    return made


class PendingAnswer(asyncio.Future[Answer]):
    """A pending answer of the camera; it belongs to no single waiter.

    Attributes:
        waiters: a future for each waiter.
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
        end: reason why there is no session, None while there is one.
        answers: waiters for answers, by the type of the answer; by id for a message that the
            dialect does not know.
        fences_open: Queries that went out with the last trigger and are not answered.
        statuses: waiters for statuses.
    """

    def __init__(self, counters: ClientCounters) -> None:
        self.end: SmartCamError | None = None
        self._counters = counters
        self.answers: dict[type[m.Message] | int, PendingAnswer] = {}
        self._asked_at: dict[object, float] = {}
        self._behind: dict[object, int] = {}  # deliveries received before the request was sent
        self.fences_open: int = 0
        self.statuses: dict[StatusWaiter, None] = {}  # waiters in order; each leaves in one step

    def begin_session(self) -> None:
        """Begin a session, without a pending request."""
        self.end = None
        self.fences_open = 0

    def fail(self, error: SmartCamError) -> bool:
        """End every wait, also one that begins before the next session, with the reason.

        Returns:
            True if it is the first reason, which stays.
        """
        if self.end is not None:
            return False
        self.end = error
        if self.answers or self.statuses:
            error = copy_to_raise(error)
        for answer in self.answers.values():
            answer.set_result(error)
        self.answers.clear()
        self._asked_at.clear()
        self._behind.clear()
        self.fences_open = 0
        for waiter in self.statuses:
            if not waiter.outcome.done():
                waiter.outcome.set_result(error)
        self.statuses.clear()
        return True

    def finish(self, error: SmartCamError) -> None:
        """Note the reason why there will be no session any more."""
        self.end = error

    def raise_end(self) -> None:
        """Raise the reason why there is no session, if there is none.

        Raises:
            LinkError: the reason why there is no session.
        """
        if self.end is not None:
            raise copy_to_raise(self.end)

    # ------------------------------------------------------------------ answers

    def next_answer(
        self,
        key: type[m.Message] | int,
        loop: asyncio.AbstractEventLoop,
        now: float,
        *,
        behind: int = 0,
    ) -> PendingAnswer:
        """Register for the next answer of this kind; errors come as a result, never raised.

        Messages in the delivery ``behind`` of the link, or in an earlier one, are no answer: they
        came before the request was sent, and wait to be passed on.
        """
        future = PendingAnswer(loop)
        self.answers[key] = future
        self._behind[key] = behind
        if key is not m.SwitchAnswer:  # a switch takes long, which is no round trip
            self._asked_at[key] = now
        return future

    def pending_answer(self, key: type[m.Message] | int) -> PendingAnswer:
        """Return the future of a pending answer (:meth:`is_pending`)."""
        answer = self.answers.get(key)
        if answer is None:
            loop = asyncio.get_running_loop()
            answer = self.next_answer(key, loop, loop.time())
        return answer

    def is_pending(self, key: type[m.Message] | int) -> bool:
        """Return True if an answer of this kind is pending."""
        return key in self.answers or (key is m.QueryAnswer and self.fences_open > 0)

    def expect_fences(self, count: int) -> None:
        """Note that Queries went out with a trigger; no task waits for their answers."""
        self.fences_open = count

    def awaits_fences(self, count: int) -> bool:
        """Return True if ``count`` Queries of a trigger are open, and no task waits."""
        return self.fences_open == count and not self.answers and not self.statuses

    def take_fence(self) -> bool:
        """Return True if no task waits for an answer to Query; count that answer off."""
        if not self.fences_open:
            return False
        self.fences_open -= 1
        return True

    def on_message(self, message: m.Message, now: float, delivery: int) -> None:
        """Complete the request that a message answers, if one is open."""
        key = message.message_id if isinstance(message, m.UnknownMessage) else type(message)
        if delivery <= self._behind.get(key, 0):
            return
        future = self.answers.pop(key, None)
        if future is not None:
            asked_at = self._asked_at.pop(key, None)
            if asked_at is not None:
                self._counters.round_trip.add(now - asked_at)
            future.set_result(message)

    # ------------------------------------------------------------------ statuses

    async def status(self, predicate: Callable[[Status], bool], deadline: float) -> Status:
        """Return the next status that ``predicate`` accepts; it gets each status in order.

        Its errors are raised here.

        Raises:
            TimeoutError: at ``deadline`` (loop time).
            LinkError: the session ended.
        """
        waiter = StatusWaiter(predicate, asyncio.get_running_loop().create_future())
        self.statuses[waiter] = None
        try:
            async with asyncio.timeout_at(deadline):
                outcome = await waiter.outcome
        finally:
            self.statuses.pop(waiter, None)
        if isinstance(outcome, SmartCamError):
            raise outcome.with_traceback(None)  # else it would grow with each waiter's raise
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    def show(self, status: Status) -> None:
        """Pass a status to every waiter."""
        for waiter in tuple(self.statuses):
            if waiter.outcome.done():
                continue
            try:
                if waiter.predicate(status):
                    waiter.outcome.set_result(status)
            except ENDS_PROGRAM:
                raise
            except BaseException as exc:  # noqa: BLE001 - the user's own
                waiter.outcome.set_result(exc)
