"""Send requests to the camera, and wait for each answer with a deadline.

No message names its request. So an answer is matched by its type, and at most one request of a
type is open. A cancelled request leaves a pending answer, which the next request of that type
awaits first. If an answer never comes, the link is given up, since later answers would be matched
wrongly. This happens only after ``request_timeout`` (``switch_timeout`` for a switch), even if the
caller's deadline is earlier, since other callers use the link, too.

Every ``deadline`` is loop time. The command lock decides whose command runs, one at a time.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from smartcam._client.deadline import DeadlineTimer, weak_callback
from smartcam._client.doorbell import wake
from smartcam._client.handshake import code_text
from smartcam.exceptions import (
    CommandRejectedError,
    RemoteProtocolError,
    ResponseTimeoutError,
    SmartCamError,
    UnsupportedError,
)
from smartcam.protocols import Verdict
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from smartcam._client.camera_state import CameraState
    from smartcam._client.connection import Connection
    from smartcam._client.doorbell import Waiter
    from smartcam._client.link import Link
    from smartcam._client.waits import PendingAnswer, Waits

AnswerT = TypeVar("AnswerT", bound=m.Message)

TIMER_RESOLUTION = 0.02
"""Seconds that a timer may be early: Windows' clock ticks every 16 ms."""


@dataclass(eq=False)
class Requests:
    """Sends requests to the camera and waits for answers, over one link after the other."""

    _connection: Connection
    _waits: Waits
    _state: CameraState
    # seconds that an answer may take before the link is given up, also after a caller's deadline
    answer_timeout: float
    _switch_timeout: float  # seconds that the answer to a switch may take

    def __post_init__(self) -> None:
        self.name: str = self._connection.name
        self._locks: dict[object, asyncio.Lock] = collections.defaultdict(asyncio.Lock)
        self._due: dict[object, float] = {}  # loop time when an answer is overdue, by its key
        # the waiter that the shared timer wakes
        self._timed_waiter: Waiter | None = None
        self._timer = DeadlineTimer(weak_callback(self, Requests._wake_timed_waiter))

    def finish(self) -> None:
        """End for good: leave nothing in the event loop."""
        self._timer.cancel()

    def begin_session(self) -> None:
        """Forget the pending answers of the session before."""
        self._due.clear()

    # ------------------------------------------------------------------ send and wait

    async def send_unanswered(
        self, message: m.Message, deadline: float, *, answered: bool | None = None
    ) -> None:
        """Send a message that the camera never answers; return once it is written.

        Args:
            message: the message.
            deadline: loop time.
            answered: False if the camera answers messages of this class, but not this one.

        Raises:
            ResponseTimeoutError: the camera takes no bytes.
        """
        link = self._connection.require_link()
        link.send(message, answered=answered)
        if link.is_writable():
            return
        try:
            async with asyncio.timeout_at(deadline):
                await link.drain()
        except TimeoutError as exc:
            error = ResponseTimeoutError(
                f"{self.name}: the camera takes no more bytes; {type(message).__name__} is stuck"
            )
            link.give_up(error)
            raise error from exc

    async def command(self, message: m.Request, deadline: float) -> None:
        """Send a command; if the dialect acknowledges it, wait for the acknowledgement.

        Raises:
            UnsupportedError: the dialect, or the camera, does not know it.
            CommandRejectedError: the camera refused it.
            ResponseTimeoutError: no answer, as for :meth:`exchange`.
        """
        answer = type(message).answer
        if answer is None or not self._connection.dialect.answers(type(message)):
            await self.send_unanswered(message, deadline)
            return
        reply = await self.exchange(message, answer, deadline)
        self.check(type(message), reply)

    def check(self, request: type[m.Message], answer: m.Message) -> None:
        """Raise the error for an answer's code, unless the code is a success.

        Raises:
            UnsupportedError: the camera does not know the request.
            CommandRejectedError: the camera refused, or is too busy.
        """
        code = answer.code if isinstance(answer, m.Acknowledgement) else 0
        verdict = self._connection.dialect.code(code, request).verdict
        if verdict is Verdict.DONE:
            return
        text = (
            f"{self.name}: {request.__name__}: "
            f"the camera answered {code_text(self._connection.dialect, code, request)}"
        )
        if verdict is Verdict.UNKNOWN:
            raise UnsupportedError(text)
        raise CommandRejectedError(
            text,
            message_id=self._connection.dialect.message_id(request),
            code=code,
            active_application=self._state.active,
        )

    async def ask(self, message: m.Message, answer: type[AnswerT], deadline: float) -> AnswerT:
        """Send a request and return its answer; statuses and results may come before the answer.

        Raises:
            ResponseTimeoutError: the answer did not come, as for :meth:`exchange`.
        """
        reply = await self.exchange(message, answer, deadline)
        if not isinstance(reply, answer):
            raise RemoteProtocolError(f"{self.name}: {reply} came, {answer.__name__} was expected")
        return reply

    async def exchange(
        self, message: m.Message, key: type[m.Message] | int, deadline: float
    ) -> m.Message:
        """Send a request and return its answer, as :meth:`ask` does.

        ``key``: the answer's type; its id for a message that the dialect does not know.

        Raises:
            ResponseTimeoutError: the answer did not come. It stays pending, since it may still
                come; if ``request_timeout`` is over as well, the link is given up.
        """
        if self.is_free(key):  # same effect as post(), without a coroutine
            answer = self._send(message, key, deadline)
        else:
            answer = await self.post(message, key, deadline)
        try:
            return await self._take_answer(answer, deadline)
        except TimeoutError as exc:
            error = self._timeout_error(message, "no answer to", "in time")
            self._give_up_overdue(key, error)
            raise error from exc

    async def post(
        self, message: m.Message, key: type[m.Message] | int, deadline: float
    ) -> PendingAnswer:
        """Send a request as soon as none of its kind is open, and return its pending answer.

        Args:
            message: the request.
            key: key of its answer's registration.
            deadline: loop time until which earlier requests are awaited.

        Raises:
            ResponseTimeoutError: an earlier one was open until ``deadline``.
        """
        if not self.is_free(key):
            await self.await_turn(key, message, deadline)
        return self._send(message, key, deadline)  # at once, before the next request in line

    def is_free(self, key: type[m.Message] | int) -> bool:
        """Return True if no answer of this kind is pending, and no such request waits in line."""
        waits = self._waits
        any_pending = waits.pending_answers or waits.open_queries
        return not ((any_pending and waits.is_pending(key)) or self._locks[key].locked())

    async def await_turn(
        self, key: type[m.Message] | int, message: m.Message, deadline: float
    ) -> None:
        """Wait in line with requests of this kind until none is open; the caller must then send.

        Raises:
            ResponseTimeoutError: an earlier one was open until ``deadline``, as in
                :meth:`await_pending`.
        """
        lock = self._locks[key]
        try:
            async with asyncio.timeout_at(deadline):
                await lock.acquire()
        except TimeoutError as exc:
            raise self._unsent_error(message) from exc
        try:
            await self.await_pending(key, message, deadline)
        finally:
            lock.release()

    def _send(
        self, message: m.Message, key: type[m.Message] | int, deadline: float
    ) -> PendingAnswer:
        link = self._connection.require_link()
        link.send(message)
        return self._register_answer(link, key, deadline)

    def register_answer(self, key: type[m.Message] | int, deadline: float) -> PendingAnswer:
        """Register for the answer to a request that was just sent, awaited until ``deadline``.

        The answer may come later: the link is given up only after ``request_timeout``.
        """
        return self._register_answer(self._connection.require_link(), key, deadline)

    def _register_answer(
        self, link: Link, key: type[m.Message] | int, deadline: float
    ) -> PendingAnswer:
        timeout = self._switch_timeout if key is m.SwitchAnswer else self.answer_timeout
        now = link.loop.time()
        due = now + timeout
        self._due[key] = max(deadline, due)
        return self._waits.expect_answer(key, link.loop, now, after_delivery=link.deliveries)

    # ------------------------------------------------------------------ Query and status

    async def round_trip(self, deadline: float) -> None:
        """Wait for the answer to a Query: all that the camera sent before is received then."""
        await self.await_pending(m.SwitchAnswer, m.Query(), deadline)
        await self.exchange(m.Query(), m.QueryAnswer, deadline)

    def expect_query_answers(self, count: int, sent_at: float, deadline: float) -> None:
        """Record that Queries were sent with a trigger; no task waits for their answers."""
        self._waits.open_queries = count
        due = sent_at + self.answer_timeout
        # max() takes twenty times as long
        self._due[m.QueryAnswer] = due if due > deadline else deadline  # noqa: FURB136

    def ask_status(self) -> None:
        """Make the camera send its status, if it does not come by itself.

        Raises:
            ConnectionLostError: the link is gone.
        """
        link = self._connection.require_link()
        link.send(m.GetStatus(), answered=False)
        self._state.note_status_request(link.loop.time())

    def ask_sign_of_life(self, deadline: float) -> bool:
        """Send a Query unless one is open, and return whether it was sent.

        The answer, a sign of life, is due at ``deadline``.
        """
        if self._waits.is_pending(m.QueryAnswer):
            return False
        features = self._connection.features
        # the status is requested, too; over UDP a pending answer to an earlier request may be lost
        if features.polled and not (features.keeps_order and self._state.status_is_pending):
            self.ask_status()
        self._connection.require_link().send(m.Query())
        self.register_answer(m.QueryAnswer, deadline)
        return True

    def ask_active_application(self) -> None:
        """Send a Query after a switch by others, as soon as no earlier Query is open."""
        with contextlib.suppress(SmartCamError):  # the link is over: the receive task reports it
            if self.ask_sign_of_life(asyncio.get_running_loop().time()):
                self._state.clear_application_doubt()

    def is_done(self, request: type[m.Message], answer: m.Acknowledgement) -> bool:
        """Return True if an answer is a success, so that :meth:`check` would not raise."""
        link = self._connection.require_link()
        return link.machine.dialect.code(answer.code, request).verdict is Verdict.DONE

    def is_busy(self, answer: m.Acknowledgement) -> bool:
        """Return True if an answer says that the camera was too busy."""
        return self._connection.dialect.code(answer.code).verdict is Verdict.BUSY

    # ------------------------------------------------------------------ answers

    def is_pending(self, key: type[m.Message]) -> bool:
        """Return True if an answer of this kind is pending."""
        return self._waits.is_pending(key)

    async def await_pending(
        self, key: type[m.Message] | int, message: m.Message, deadline: float
    ) -> None:
        """Wait for the answer to an earlier request, and ignore the answer.

        Raises:
            ResponseTimeoutError: the answer did not come; if it is overdue, the link is given up.
        """
        while self._waits.is_pending(key):  # a trigger may send the next Query meanwhile
            answer = self._waits.pending_answer(key)
            try:
                await self._take_answer(answer, deadline)
            except TimeoutError as exc:
                error = self._unsent_error(message)
                self._give_up_overdue(key, error)
                raise error from exc

    def _give_up_overdue(self, key: type[m.Message] | int, error: ResponseTimeoutError) -> None:
        """Give the link up if the pending answer is overdue."""
        loop = asyncio.get_running_loop()
        if loop.time() + TIMER_RESOLUTION >= self._due[key]:
            self._connection.require_link().give_up(error)

    async def _take_answer(self, answer: PendingAnswer, deadline: float) -> m.Message:
        """Wait until an answer is there, and return it.

        If the waiting task is cancelled, the answer stays pending.

        Raises:
            TimeoutError: the deadline is over.
        """
        if not answer.done():
            link = self._connection.require_link()
            waiter: Waiter = link.make_future()
            answer.waiters.append(waiter)
            timer = None  # of several waits at the same time, only the first uses the shared timer
            if self._timed_waiter is None:
                self._timed_waiter = waiter
                self._timer.set(deadline)
            else:
                timer = link.loop.call_at(deadline, wake, waiter)
            try:
                await waiter
            finally:
                if timer is None:
                    self._timed_waiter = None
                    self._timer.clear()
                else:
                    timer.cancel()
                answer.waiters.remove(waiter)
            if not answer.done():
                raise TimeoutError
        reply = answer.result()
        if isinstance(reply, SmartCamError):
            raise reply.with_traceback(None)
        return reply

    def _wake_timed_waiter(self) -> None:
        if self._timed_waiter is not None:
            wake(self._timed_waiter)

    def _unsent_error(self, message: m.Message) -> ResponseTimeoutError:
        return self._timeout_error(message, "could not send", "in time: an earlier answer is owed")

    def _timeout_error(self, message: m.Message, failure: str, reason: str) -> ResponseTimeoutError:
        dialect = self._connection.dialect
        return ResponseTimeoutError(
            f"{self.name}: {failure} {dialect.message_label(message)} {reason}; "
            f"status: {self._state.status}",
            message_id=dialect.message_id(message),
        )
