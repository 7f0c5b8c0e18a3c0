"""Steps of a conversation with the camera: a few messages out, then a wait with a deadline.

The wire has no correlation: an answer is matched by its kind, at most one request of a kind is
open, and one that was cancelled leaves an owed answer which the next request of that kind awaits
first. An answer that never comes leaves the link untrustworthy, so it is given up.

Every ``deadline`` is loop time. The turn (one command at a time) is the client's business.
"""

from __future__ import annotations

import asyncio
import collections
from datetime import UTC, datetime
from typing import TYPE_CHECKING, TypeVar

from smartcam.exceptions import (
    CameraBusyError,
    CameraFaultError,
    CommandRejectedError,
    ConfigurationError,
    ConnectionClosedError,
    InputContainerError,
    NotRunningError,
    RemoteProtocolError,
    ResponseTimeoutError,
    SmartCamError,
    TriggerTimeoutError,
)
from smartcam.inbox import Inbox, PendingTrigger
from smartcam.models import Status
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.connection import Link
    from smartcam.interpretation import Interpretation
    from smartcam.models import Result

__all__ = ["Conversation"]

AnswerT = TypeVar("AnswerT", bound=m.Message)

TIMER_RESOLUTION = 0.02
"""Seconds that a timer may be early: Windows' clock ticks every 16 ms."""

MAX_APPLICATION_ID = 0xFFFFFFFF
"""The id is a UINT32 on the wire (SC manual p. 34, published)."""


def is_ready(status: Status) -> bool:
    """Running and not BUSY."""
    return Status.RUNNING in status and Status.BUSY not in status


def is_stopped(status: Status) -> bool:
    """Neither Running nor BUSY."""
    return not status & (Status.RUNNING | Status.BUSY)


def takes_trigger(status: Status) -> bool:
    """The camera waits for a trigger and is not BUSY."""
    return Status.WAITING_FOR_TRIGGER in status and Status.BUSY not in status


_WHY_READY = "; it does not while it inspects, and an application that runs free never does"


class Conversation:
    """What is said to the camera over one session, step by step.

    Args:
        inbox: the receiving half.
        patience: seconds that an answer may take, however short the deadline of who asks.
    """

    def __init__(self, inbox: Inbox, patience: float) -> None:
        self.inbox = inbox
        self._patience = patience
        self.name: str = inbox.name
        self.link: Link | None = None
        self.wants_running: bool = False
        self._locks: dict[object, asyncio.Lock] = collections.defaultdict(asyncio.Lock)
        self._due: dict[object, float] = {}  # until when the last request of a kind was to wait
        self._halted = False  # stopped by a trigger's fence that has not started it again yet
        self._unconfirmed = False  # a Start or Stop was sent, its status has not come

    def require_link(self) -> Link:
        """Return the link.

        Raises:
            LinkError: there is none, and why.
        """
        if self.inbox.end is not None:
            raise self.inbox.end.with_traceback(None)  # raised many times, it would grow each time
        if self.link is None:
            raise ConnectionClosedError(f"{self.name}: not connected: open it first")
        return self.link

    @property
    def status(self) -> Status:
        """The last status; there is one since the session was made."""
        return self.inbox.status or Status(0)

    @property
    def runs(self) -> bool:
        """Running, or stopped only by a trigger that was interrupted before it started again."""
        return self._halted or Status.RUNNING in self.status

    def deadline(self, timeout: float) -> float:
        """Return the loop time in ``timeout`` seconds.

        Raises:
            ConfigurationError: it is no finite number of seconds, 0 or more.
        """
        if not 0 <= timeout < float("inf"):
            raise ConfigurationError(f"{self.name}: timeout {timeout!r} is no number of seconds")
        return asyncio.get_running_loop().time() + timeout

    # ------------------------------------------------------------------ say and wait

    async def tell(
        self, message: m.Message, deadline: float, *, answered: bool | None = None
    ) -> None:
        """Send what the camera never answers; returns once written.

        Args:
            message: what to say.
            deadline: loop time.
            answered: False for a message without a name that is not answered either.

        Raises:
            ResponseTimeoutError: the camera takes no bytes.
        """
        link = self.require_link()
        link.send(message, answered=answered)
        try:
            async with asyncio.timeout_at(deadline):
                await link.drain()
        except TimeoutError as exc:
            error = ResponseTimeoutError(
                f"{self.name}: the camera takes no more bytes; {type(message).__name__} is stuck"
            )
            link.give_up(error)
            raise error from exc

    async def ask(self, message: m.Message, answer: type[AnswerT], deadline: float) -> AnswerT:
        """Send a request and return its answer, which may come among statuses and results.

        Raises:
            ResponseTimeoutError: it did not come; the link is given up.
        """
        got = await self.exchange(message, answer, deadline)
        if not isinstance(got, answer):
            raise RemoteProtocolError(f"{self.name}: {got} came, {answer.__name__} was expected")
        return got

    async def exchange(
        self,
        message: m.Message,
        key: type[m.Message] | int,
        deadline: float,
        *,
        due: float | None = None,
    ) -> m.Message:
        """Send a request and return the answer registered under ``key``; as :meth:`ask`.

        With ``due`` behind the deadline, an answer that has not come at the deadline stays owed.
        """
        answer = await self.post(message, key, deadline, due=due)
        try:
            return await self._take_answer(answer, deadline)
        except TimeoutError as exc:
            error = self._timeout(message, "no answer to", "in time")
            self._give_up_overdue(key, error)
            raise error from exc

    async def post(
        self,
        message: m.Message,
        key: type[m.Message] | int,
        deadline: float,
        *,
        due: float | None = None,
    ) -> asyncio.Future[m.Message | SmartCamError]:
        """Send a request as soon as none of its kind is open; its answer is owed from then on.

        Args:
            message: the request.
            key: what its answer is registered under.
            deadline: loop time until when to wait for earlier ones.
            due: until when the answer may come before the link is given up; default ``deadline``.

        Raises:
            ResponseTimeoutError: an earlier one was open until ``deadline``.
        """
        lock = self._locks[key]
        try:
            async with asyncio.timeout_at(deadline):
                await lock.acquire()
        except TimeoutError as exc:
            raise self._unsent(message) from exc
        try:
            await self._await_owed(key, message, deadline)
            self.require_link().send(message)
            self._due[key] = deadline if due is None else due
            return self.inbox.next_answer(key)
        finally:
            lock.release()

    async def until(
        self, predicate: Callable[[Status], bool], deadline: float, what: str
    ) -> Status:
        """Wait for a status.

        Raises:
            ResponseTimeoutError: says what was waited for and what the status is.
        """
        begin = asyncio.get_running_loop().time()
        try:
            return await self.inbox.wait_status(predicate, deadline)
        except TimeoutError as exc:
            waited = max(0.0, deadline - begin)
            raise ResponseTimeoutError(
                f"{self.name}: waited {round(waited, 2):g} s for {what}; status: {self.status}",
                waited=waited,
            ) from exc

    # ------------------------------------------------------------------ run state, application

    async def start(self, deadline: float) -> None:
        """Enter run mode and wait until the camera reports it."""
        self.wants_running = True
        await self._confirm(m.Start(), is_ready, deadline, "Running and not BUSY after Start")
        self._halted = False

    async def stop(self, deadline: float) -> None:
        """Leave run mode and wait until the camera reports it."""
        self.wants_running = self._halted = False
        await self._halt(deadline)

    async def _halt(self, deadline: float) -> None:
        await self._confirm(m.Stop(), _is_not_running, deadline, "not Running after Stop")

    async def _confirm(
        self, command: m.Message, predicate: Callable[[Status], bool], deadline: float, what: str
    ) -> None:
        self._unconfirmed = True  # and it stays so where the wait is interrupted
        await self.tell(command, deadline)
        await self.until(predicate, deadline, what)
        self._unconfirmed = False

    async def catch_up(self, deadline: float) -> None:
        """Know the status again where a start or stop was interrupted.

        What these two have caused comes before the answer to a Query that was sent after them.
        """
        if self._unconfirmed:
            await self._fence(deadline)
            self._unconfirmed = False

    async def _fence(self, deadline: float) -> None:
        """Have heard everything that the camera said before now.

        The deadline may be a trigger's and as short as it likes: it does not cost the link.
        """
        due = max(deadline, asyncio.get_running_loop().time() + self._patience)
        await self._await_owed(m.SwitchAnswer, m.Query(), deadline)
        await self.exchange(m.Query(), m.QueryAnswer, deadline, due=due)

    async def query(self, deadline: float) -> int:
        """Return the active application.

        During a switch a Query tells the old id, so an owed switch answer is awaited first.
        """
        await self._await_owed(m.SwitchAnswer, m.Query(), deadline)
        return (await self.ask(m.Query(), m.QueryAnswer, deadline)).application

    async def ensure(self, application: int, deadline: float) -> None:
        """Have an application running and ready, by the least that is needed."""
        if await self.query(deadline) != application:
            await self.switch(application, deadline, start=True)
            return
        self.inbox.expected = application
        if Status.RUNNING not in self.status:
            await self.start(deadline)
        self.wants_running = True
        await self.until(is_ready, deadline, "Running and not BUSY")

    async def switch(self, application: int, deadline: float, *, start: bool) -> None:
        """Stop if need be, switch, wait until not BUSY, start if wanted.

        Raises:
            CommandRejectedError: the camera refused; the old application runs again if it ran.
        """
        if not 0 <= application <= MAX_APPLICATION_ID:
            raise ConfigurationError(
                f"{self.name}: application id {application} is not 0 to {MAX_APPLICATION_ID}"
            )
        was_running = self.runs
        if application == 0:
            # Never allowed, several applications may carry it (SC manual p. 34, published): so
            # nothing is stopped for it.
            code, active = 1, await self.query(deadline)
        else:
            if was_running:
                await self.stop(deadline)
            request = m.SwitchApplication(application=application)
            answer = await self.ask(request, m.SwitchAnswer, deadline)
            self.inbox.debt = None  # stopped, and the answer came behind whatever was under way
            code, active = answer.code, answer.application
        if code != 0 or active != application:
            if was_running and Status.RUNNING not in self.status:
                await self.start(deadline)
            refusal = f"the camera refused to switch to application {application} (status {code})"
            if application == 0:
                refusal = "no application may have the id 0"
            elif code == 0:
                refusal = f"the camera says it switched, but not to application {application}"
            raise CommandRejectedError(
                f"{self.name}: {refusal}; application {active} is active",
                message_id=self.require_link().machine.dialect.message_id(m.SwitchApplication),
                code=code,
                active_application=active,
            )
        await self.until(lambda status: Status.BUSY not in status, deadline, "not BUSY")
        if start:
            await self.start(deadline)

    # ------------------------------------------------------------------ trigger

    async def trigger(
        self,
        interpretation: Interpretation,
        input_data: bytes | None,
        deadline: float,
        *,
        wait: bool,
    ) -> Result:
        """Wait until the camera takes a trigger, send it, return the result.

        Raises:
            SmartCamError: one of the outcomes of :meth:`SmartCamera.trigger`.
        """
        inbox, loop = self.inbox, asyncio.get_running_loop()
        self._raise_fault()
        if input_data is not None and inbox.input_in_doubt:
            raise InputContainerError(
                f"{self.name}: input data of an earlier trigger, which had no result, may still be "
                "queued in the camera and would be taken for this one's; switch_application() "
                "empties the queue"
            )
        if inbox.debt is not None:
            await self._settle_debt(deadline)
        await self._wait_for_trigger(deadline, wait=wait)
        link = self.require_link()
        outcome: asyncio.Future[Result] = loop.create_future()
        sent_at = loop.time()
        pending = inbox.pending = PendingTrigger(
            outcome, interpretation, input_data is not None, sent_at, datetime.now(UTC)
        )
        try:
            if input_data is not None:
                inbox.input_in_doubt = True  # until its result is there
                link.send(m.SetInput(data=input_data), m.Trigger())
            else:
                link.send(m.Trigger())
            async with asyncio.timeout_at(deadline):
                await link.drain()
                return await outcome
        except TimeoutError as exc:
            if outcome.done() and not outcome.cancelled():
                return outcome.result()
            inbox.give_up(pending)
            waited = deadline - sent_at
            raise TriggerTimeoutError(
                f"{self.name}: no result within {round(waited, 2):g} s of the trigger; "
                f"status: {self.status}",
                waited=waited,
            ) from exc
        except asyncio.CancelledError:
            if not outcome.done() or outcome.cancelled():
                inbox.give_up(pending)
            raise
        finally:
            inbox.pending = None

    async def _wait_for_trigger(self, deadline: float, *, wait: bool) -> None:
        """Wait until the camera takes a trigger, or say why it never will."""
        begin = asyncio.get_running_loop().time()
        while True:
            self._raise_fault()
            status = self.status
            if takes_trigger(status):
                return
            if is_stopped(status):
                raise NotRunningError(
                    f"{self.name}: application {self.inbox.active} is stopped: start it, or name "
                    f"it so that it is started; status: {status}"
                )
            if not wait:
                raise CameraBusyError(
                    f"{self.name}: the camera does not wait for a trigger: {status}"
                )
            try:
                await self.inbox.wait_status(_is_decided, deadline)
            except TimeoutError as exc:
                free = _WHY_READY if is_ready(status) else ""
                waited = max(0.0, deadline - begin)
                raise TriggerTimeoutError(
                    f"{self.name}: the camera did not wait for a trigger within "
                    f"{round(waited, 2):g} s; status: {self.status}{free}",
                    waited=waited,
                ) from exc

    def _raise_fault(self) -> None:
        if Status.SYSTEM_ERROR in self.status:
            raise CameraFaultError(f"{self.name}: the camera reports System Error")

    async def _settle_debt(self, deadline: float) -> None:
        """Make a result that may still come impossible: Stop voids it, a Query is the fence.

        Source: that Stop voids the inspection under way is inferred. What comes before the
        Query's answer came from before.
        """
        if self.runs:
            self._halted = True  # interrupted here, the next trigger does all of it again
            await self._halt(deadline)
            await self._fence(deadline)
            await self.start(deadline)
        self.inbox.debt = None

    # ------------------------------------------------------------------ answers

    async def _await_owed(
        self, key: type[m.Message] | int, message: m.Message, deadline: float
    ) -> None:
        """Wait for the answer to an earlier request, which is dropped.

        Raises:
            ResponseTimeoutError: it did not come; the link is given up if its own time is over too.
        """
        owed = self.inbox.answers.get(key)
        if owed is None:
            return
        try:
            await self._take_answer(owed, deadline)
        except TimeoutError as exc:
            error = self._unsent(message)
            self._give_up_overdue(key, error)
            raise error from exc

    def _give_up_overdue(self, key: type[m.Message] | int, error: ResponseTimeoutError) -> None:
        """Give the link up if the answer that is owed should have come by now."""
        loop = asyncio.get_running_loop()
        if loop.time() + TIMER_RESOLUTION >= self._due[key]:
            self.require_link().give_up(error)

    async def _take_answer(
        self, answer: asyncio.Future[m.Message | SmartCamError], deadline: float
    ) -> m.Message:
        # asyncio.wait leaves the future alone when this task is cancelled: the answer stays owed
        loop = asyncio.get_running_loop()
        await asyncio.wait({answer}, timeout=max(0.0, deadline - loop.time()))
        if not answer.done():
            raise TimeoutError
        got = answer.result()
        if isinstance(got, SmartCamError):
            raise got.with_traceback(None)
        return got

    def _unsent(self, message: m.Message) -> ResponseTimeoutError:
        return self._timeout(message, "could not send", "in time: an earlier answer is owed")

    def _timeout(self, message: m.Message, what: str, why: str) -> ResponseTimeoutError:
        message_id = self.require_link().machine.dialect.message_id(message)
        return ResponseTimeoutError(
            f"{self.name}: {what} {type(message).__name__} ({message_id:#04x}) {why}; "
            f"status: {self.status}",
            message_id=message_id,
        )


def _is_not_running(status: Status) -> bool:
    return Status.RUNNING not in status


def _is_decided(status: Status) -> bool:
    return takes_trigger(status) or is_stopped(status) or Status.SYSTEM_ERROR in status
