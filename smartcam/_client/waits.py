"""Keep those who wait for an answer or a status, and the reason why there is no session."""

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
"""The outcome of a request: the answer, or the error that says why there is none."""


ErrorT = TypeVar("ErrorT", bound=SmartCamError)


def told(error: ErrorT) -> ErrorT:
    """Return an error to raise where another one is kept.

    A raised error refers to the frames of its caller, and by them to the client: kept by the
    client's own task, it would keep a client alive that nobody has any more.
    """
    made = type(error)(*error.args)  # as copy() does, in a tenth of the steps
    vars(made).update(vars(error))
    made.__cause__ = error.__cause__
    return made


class OwedAnswer(asyncio.Future[Answer]):
    """An answer that the camera owes; it belongs to nobody who waits for it.

    Attributes:
        waiters: what those who wait go on by, each one's own.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__(loop=loop)
        self.waiters: list[Waiter] = []

    def set_result(self, result: Answer) -> None:
        """Have the answer, or why there is none, and wake those who wait."""
        super().set_result(result)
        for waiter in self.waiters:
            wake(waiter)


@dataclass(slots=True, eq=False)
class StatusWaiter:
    """A caller that waits for a status.

    Attributes:
        predicate: says which one.
        outcome: gets it, or what the predicate raised: as a value, for a future takes not every
            error.
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
        statuses: waiters for statuses.
    """

    def __init__(self, counters: ClientCounters) -> None:
        self.end: SmartCamError | None = None
        self._counters = counters
        self.answers: dict[type[m.Message] | int, OwedAnswer] = {}
        self._asked_at: dict[object, float] = {}
        self._behind: dict[object, int] = {}  # deliveries that came before the request was sent
        self._fences_open = 0  # Queries that went out with the last trigger and are not answered
        self.statuses: dict[StatusWaiter, None] = {}  # waiters in order; each leaves in one step

    def begin_session(self) -> None:
        """Begin a session, in which nothing is asked yet."""
        self.end = None
        self._fences_open = 0

    def fail(self, error: SmartCamError) -> bool:
        """End every wait, also one that begins before the next session, with the reason.

        Returns:
            Whether that is news: the first reason stays.
        """
        if self.end is not None:
            return False
        self.end = error
        if self.answers or self.statuses:
            error = told(error)
        for answer in self.answers.values():
            answer.set_result(error)
        self.answers.clear()
        self._asked_at.clear()
        self._behind.clear()
        self._fences_open = 0
        for waiter in self.statuses:
            if not waiter.outcome.done():
                waiter.outcome.set_result(error)
        self.statuses.clear()
        return True

    def finish(self, error: SmartCamError) -> None:
        """Note why there will be no session any more, whatever has ended the last one."""
        self.end = error

    def raise_end(self) -> None:
        """Raise why there is no session, if there is none.

        Raises:
            LinkError: there is no session, and why.
        """
        if self.end is not None:
            raise told(self.end)

    # ------------------------------------------------------------------ answers

    def next_answer(self, key: type[m.Message] | int, *, behind: int = 0) -> OwedAnswer:
        """Register for the next answer of this kind; errors come as a result, never raised.

        What came in the delivery ``behind`` of the link, or in an earlier one, is no answer: it was
        there before the request was sent, and waits to be handed on.
        """
        loop = asyncio.get_running_loop()
        future = OwedAnswer(loop)
        self.answers[key] = future
        self._behind[key] = behind
        if key is not m.SwitchAnswer:  # it takes its time, which is no round trip
            self._asked_at[key] = loop.time()
        return future

    def owed_answer(self, key: type[m.Message] | int) -> OwedAnswer:
        """Return the future of an answer that is owed (:meth:`owes`)."""
        return self.answers.get(key) or self.next_answer(key)

    def owes(self, key: type[m.Message] | int) -> bool:
        """Return True if an answer of this kind is open."""
        return key in self.answers or (key is m.QueryAnswer and self._fences_open > 0)

    def expect_fences(self, count: int) -> None:
        """Note that Queries went out with a trigger, for whose answers nobody waits."""
        self._fences_open = count

    def awaits_fences(self, count: int) -> bool:
        """Return True if so many Queries of a trigger are open, and nobody waits for anything."""
        return self._fences_open == count and not self.answers and not self.statuses

    def take_fence(self) -> bool:
        """Return True if nobody waits for an answer to Query; count that answer off."""
        if not self._fences_open:
            return False
        self._fences_open -= 1
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
        """Return the next status that ``predicate`` accepts; it is shown each one in order.

        What it raises comes out here.

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
            raise outcome.with_traceback(None)  # raised for all who wait, it would grow each time
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    def show(self, status: Status) -> None:
        """Show a status to everybody who waits for one."""
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
