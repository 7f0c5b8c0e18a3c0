"""Who waits for an answer or a status, and why there is no session to wait in."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam.exceptions import SmartCamError
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam._client.counters import ClientCounters
    from smartcam.models import Status

Answer = m.Message | SmartCamError
"""What a request gets: the answer, or why there is none."""


@dataclass(slots=True)
class StatusWaiter:
    predicate: Callable[[Status], bool]
    outcome: asyncio.Future[Status]


class Waits:
    """What is awaited of the camera: answers by their kind, and statuses.

    Args:
        counters: where round trips are counted.

    Attributes:
        end: why there is no session, None while there is one.
        answers: who waits for an answer, by its type; by id for a message that the dialect does not
            know.
        statuses: who waits for a status.
    """

    def __init__(self, counters: ClientCounters) -> None:
        self.end: SmartCamError | None = None
        self._counters = counters
        self.answers: dict[type[m.Message] | int, asyncio.Future[Answer]] = {}
        self._asked_at: dict[object, float] = {}
        self._fence_open = False  # the Query in front of the last trigger is not answered
        self.statuses: list[StatusWaiter] = []

    def begin_session(self) -> None:
        """A session is there, nothing is asked in it yet."""
        self.end = None
        self._fence_open = False

    def fail(self, error: SmartCamError) -> bool:
        """Tell everybody who waits that the session is over, and who comes before the next one.

        Returns:
            Whether that is news: the first reason stays.
        """
        if self.end is not None:
            return False
        self.end = error
        for answer in self.answers.values():
            answer.set_result(error)
        self.answers.clear()
        self._asked_at.clear()
        self._fence_open = False
        for waiter in self.statuses:
            if not waiter.outcome.done():
                waiter.outcome.set_exception(error)
        self.statuses.clear()
        return True

    def finish(self, error: SmartCamError) -> None:
        """Note why there will be no session any more, whatever has ended the last one."""
        self.end = error

    def raise_end(self) -> None:
        """Raise why there is no session, if there is none.

        Raises:
            LinkError: it.
        """
        if self.end is not None:
            raise self.end.with_traceback(None)  # raised many times, it would grow each time

    # ------------------------------------------------------------------ answers

    def next_answer(self, key: type[m.Message] | int) -> asyncio.Future[Answer]:
        """Register for the next answer of this kind; errors come as a result, never raised."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[Answer] = loop.create_future()
        self.answers[key] = future
        if key is not m.SwitchAnswer:  # it takes its time, which is no round trip
            self._asked_at[key] = loop.time()
        return future

    def owed_answer(self, key: type[m.Message] | int) -> asyncio.Future[Answer]:
        """Return the future of an answer that is owed (:meth:`owes`)."""
        return self.answers.get(key) or self.next_answer(key)

    def owes(self, key: type[m.Message] | int) -> bool:
        """Whether an answer of this kind is open."""
        return key in self.answers or (key is m.QueryAnswer and self._fence_open)

    def expect_fence(self) -> None:
        """Note that a Query went out in front of a trigger, for whose answer nobody waits."""
        self._fence_open = True

    def take_fence(self) -> bool:
        """Close the fence; return whether it was open, so that an answer to Query is its own."""
        was, self._fence_open = self._fence_open, False
        return was

    def on_message(self, message: m.Message, now: float) -> None:
        """Complete the request that a message answers, if one is open."""
        key = message.message_id if isinstance(message, m.UnknownMessage) else type(message)
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
        self.statuses.append(waiter)
        try:
            async with asyncio.timeout_at(deadline):
                return await waiter.outcome
        finally:
            if waiter in self.statuses:
                self.statuses.remove(waiter)

    def show(self, status: Status) -> None:
        """Show a status to everybody who waits for one."""
        for waiter in tuple(self.statuses):
            if waiter.outcome.done():
                continue
            try:
                if waiter.predicate(status):
                    waiter.outcome.set_result(status)
            except (Exception, asyncio.CancelledError) as exc:  # noqa: BLE001 - the user's own
                waiter.outcome.set_exception(exc)
