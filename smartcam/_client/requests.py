"""Steps of a conversation with the camera: a few messages out, then a wait with a deadline.

The wire has no correlation: an answer is matched by its kind, at most one request of a kind is
open, and one that was cancelled leaves an owed answer which the next request of that kind awaits
first. An answer that never comes leaves the link untrustworthy, so it is given up.

Every ``deadline`` is loop time. The turn (one command at a time) is the client's business.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import math
from typing import TYPE_CHECKING, TypeVar

from smartcam._client.handshake import code_text
from smartcam._client.polling import StatusPoll
from smartcam.exceptions import (
    CommandRejectedError,
    ConfigurationError,
    ConnectionClosedError,
    LocalProtocolError,
    RemoteProtocolError,
    ResponseTimeoutError,
    SmartCamError,
    UnsupportedError,
)
from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.protocols.base import Transport, Verdict

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam._client.dispatch import Inbox
    from smartcam._client.link import Link
    from smartcam.protocols.base import Dialect

__all__ = ["Conversation", "is_ready"]

AnswerT = TypeVar("AnswerT", bound=m.Message)

TIMER_RESOLUTION = 0.02
"""Seconds that a timer may be early: Windows' clock ticks every 16 ms."""

BUSY_PAUSE = 0.02
"""Seconds until a camera that was too busy for a request is asked again."""


def is_ready(status: Status) -> bool:
    """Running and not BUSY."""
    return Status.RUNNING in status and Status.BUSY not in status


class Conversation:
    """What is said to the camera, step by step, over one link after the other.

    Args:
        inbox: the receiving half.
        patience: seconds that an answer may take, however short the deadline of who asks.
    """

    def __init__(self, inbox: Inbox, patience: float) -> None:
        self.inbox = inbox
        self._patience = patience
        self.name: str = inbox.name
        self.link: Link | None = None
        self.loop: asyncio.AbstractEventLoop | None = None
        self.wants_running: bool | None = None  # None: neither was asked for
        self._locks: dict[object, asyncio.Lock] = collections.defaultdict(asyncio.Lock)
        self._due: dict[object, float] = {}  # until when the last request of a kind was to wait
        self.halted_at: int | None = None  # loads by others when a trigger's fence stopped it
        self.unconfirmed: bool = False  # a Start or Stop was sent, its status has not come
        self.poll: StatusPoll | None = None  # where the status does not come by itself
        self.numbered: bool = False  # a trigger may be given a sequence number
        self.acknowledged: bool = False  # a trigger is answered
        self.fences: bool = False  # a Query in front of a trigger tells what is older
        self.confirms: bool = False  # a status behind its answer tells whether it was taken
        self.at_end: list[Callable[[], None]] = []  # called when there will be no session any more

    def begin(self, link: Link) -> None:
        """A new session: nothing is owed on it, its status is heard."""
        self.link = link
        self.loop = asyncio.get_running_loop()
        self._due.clear()
        self.unconfirmed = False
        self.end_polling()
        dialect = link.machine.dialect
        self.numbered = dialect.has(m.SetSequenceNumber)
        self.acknowledged = dialect.has(m.TriggerAnswer)
        by_itself = dialect.capabilities.status_by_itself
        # who does one thing after the other needs neither
        self.fences = self.ordered and not dialect.in_order
        self.confirms = self.fences and self.acknowledged and not by_itself
        self.inbox.on_held = self.ask_what_is_active
        if not by_itself:
            self.poll = StatusPoll(link, self.inbox, self._patience)
            self.inbox.on_status_wanted = self.poll.wanted
            self.inbox.on_unconfirmed = self.poll.ask
            self.poll.wanted()

    def end_polling(self) -> None:
        """The session is over, or none has begun."""
        self.inbox.on_status_wanted = self.inbox.on_unconfirmed = None
        if self.poll is not None:
            self.poll.stop()
            self.poll = None

    def end(self) -> None:
        """There will be no session any more."""
        for end in self.at_end:
            end()
        self.end_polling()

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
    def dialect(self) -> Dialect:
        """What is spoken in this session.

        Raises:
            LinkError: there is none.
        """
        return self.require_link().machine.dialect

    def require(self, message_type: type[m.Message]) -> None:
        """See to it that the dialect has a message, before anything is done for it.

        Raises:
            UnsupportedError: it has not.
            LinkError: there is no session.
        """
        if not self.dialect.has(message_type):
            raise self.dialect.unsupported(message_type)

    @property
    def status(self) -> Status:
        """The last status; there is one since the session was made."""
        return self.inbox.status or Status(0)

    @property
    def runs(self) -> bool:
        """Running, or stopped only by a trigger that was interrupted before it started again."""
        return self.halted or Status.RUNNING in self.status

    @property
    def halted(self) -> bool:
        """A trigger's fence has stopped it and not started it again, nor has anybody loaded it."""
        return self.halted_at == self.inbox.loads_by_others

    def deadline(self, timeout: float) -> float:
        """Return the loop time in ``timeout`` seconds.

        Raises:
            ConfigurationError: it is no finite number of seconds, 0 or more.
        """
        if not 0 <= timeout < math.inf:
            raise ConfigurationError(f"{self.name}: timeout {timeout!r} is no number of seconds")
        loop = self.loop or asyncio.get_running_loop()  # which is a system call in CPython 3.11
        return loop.time() + timeout

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
        if link.writable:
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

    async def command(
        self, message: m.Request, deadline: float, *, due: float | None = None
    ) -> None:
        """Send a command; where the dialect acknowledges it, wait for that.

        Args:
            message: the command.
            deadline: loop time.
            due: as for :meth:`exchange`.

        Raises:
            UnsupportedError: the dialect, or the camera, does not know it.
            CommandRejectedError: the camera refused it.
            ResponseTimeoutError: no answer; the link is given up.
        """
        answer = type(message).answer
        if answer is None or not self.dialect.answers(type(message)):
            await self.tell(message, deadline)
            return
        got = await self.exchange(message, answer, deadline, due=due)
        self.check(type(message), got)

    def check(self, request: type[m.Message], answer: m.Message) -> None:
        """Raise what an answer's code says, where it does not say that all is well.

        Raises:
            UnsupportedError: the camera does not know the request.
            CommandRejectedError: it refused, or is too busy.
        """
        code = answer.code if isinstance(answer, m.Acknowledgement) else 0
        verdict = self.dialect.code(code, request).verdict
        if verdict is Verdict.DONE:
            return
        said = (
            f"{self.name}: {request.__name__}: "
            f"the camera answered {code_text(self.dialect, code, request)}"
        )
        if verdict is Verdict.UNKNOWN:
            raise UnsupportedError(said)
        raise CommandRejectedError(
            said,
            message_id=self.dialect.message_id(request),
            code=code,
            active_application=self.inbox.active,
        )

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
            await self.await_owed(key, message, deadline)
            self.require_link().send(message)
            return self.expect(key, deadline if due is None else due)
        finally:
            lock.release()

    def expect(
        self, key: type[m.Message] | int, due: float
    ) -> asyncio.Future[m.Message | SmartCamError]:
        """Register for the answer to a request that was just sent; it is owed until ``due``."""
        self._due[key] = due
        return self.inbox.next_answer(key)

    async def until(
        self,
        predicate: Callable[[Status], bool],
        deadline: float,
        what: str,
        *,
        insist: bool = True,
    ) -> Status:
        """Wait for a status.

        Args:
            predicate: says which.
            deadline: loop time.
            what: it in words.
            insist: have it said again where it may have been lost.

        Raises:
            ResponseTimeoutError: says what was waited for and what the status is.
        """
        begin = asyncio.get_running_loop().time()
        try:
            if not insist:
                return await self.inbox.wait_status(predicate, deadline)
            return await self.wait_status(predicate, deadline)
        except TimeoutError as exc:
            waited = max(0.0, deadline - begin)
            raise ResponseTimeoutError(
                f"{self.name}: waited {round(waited, 2):g} s for {what}; status: {self.status}",
                waited=waited,
            ) from exc

    async def wait_status(self, predicate: Callable[[Status], bool], deadline: float) -> Status:
        """Wait for a status; over UDP, where one may be lost, have it said again half-way.

        Raises:
            TimeoutError: at ``deadline``.
        """
        if not self.ordered and self.poll is None:
            now = asyncio.get_running_loop().time()
            with contextlib.suppress(TimeoutError):
                return await self.inbox.wait_status(predicate, now + 0.5 * (deadline - now))
            await self.ask_for_status(deadline)
        return await self.inbox.wait_status(predicate, deadline)

    async def ask_for_status(self, deadline: float) -> None:
        """Have the camera say its status, by Get status where there is that.

        Elsewhere Connect brings one (SC manual p. 29, published). A Query goes first: who has lost
        the session must not take it back by this.
        """
        link = self.require_link()
        if self.poll is not None:
            link.send(m.GetStatus(), answered=False)
            return
        try:
            await self.fence(deadline)
            link.send(m.Connect())
        except ResponseTimeoutError:
            pass  # its own time may not be over; liveness sees to the rest
        except LocalProtocolError as exc:  # the last one's answer never came
            link.give_up(TimeoutError(f"statuses are lost: {exc}"))

    async def refresh_status(self, deadline: float) -> None:
        """Know the status as it is now, where it can be asked for.

        Raises:
            ResponseTimeoutError: the camera did not tell it.
        """
        if not self.dialect.has(m.GetStatus):
            return
        heard = self.inbox.statuses_heard
        while True:  # a datagram may be lost
            self.require_link().send(m.GetStatus(), answered=False)
            await self.fence(deadline)
            if self.inbox.statuses_heard != heard:
                return
            await self.pause(deadline, "the camera to tell its status")

    # ------------------------------------------------------------------ run state, application

    async def start(self, deadline: float) -> None:
        """Enter run mode and wait until the camera reports it."""
        self.require(m.Start)
        self.wants_running = True
        await self.enter_run_mode(deadline)

    async def stop(self, deadline: float) -> None:
        """Leave run mode and wait until the camera reports it."""
        self.require(m.Stop)
        self.wants_running = False
        await self._leave_run_mode(deadline)

    async def enter_run_mode(self, deadline: float) -> None:
        """Enter run mode whether it was asked for or not."""
        await self._confirm(m.Start(), is_ready, deadline, "Running and not BUSY after Start")
        self.halted_at = None

    async def _leave_run_mode(self, deadline: float) -> None:
        self.halted_at = None
        await self.halt(deadline)

    async def halt(self, deadline: float) -> None:
        """Leave run mode for a moment."""
        await self._confirm(m.Stop(), _is_not_running, deadline, "not Running after Stop")

    async def _confirm(
        self, command: m.Request, predicate: Callable[[Status], bool], deadline: float, what: str
    ) -> None:
        self.unconfirmed = True  # and it stays so where the wait is interrupted
        await self.command(command, deadline)
        await self.refresh_status(deadline)
        await self.until(predicate, deadline, what)
        self.unconfirmed = False

    async def catch_up(self, deadline: float) -> None:
        """Know the status again where a start or stop was interrupted.

        What these two have caused comes before the answer to a Query that was sent after them, or
        is to be asked for.
        """
        if self.poll is not None:
            await self.refresh_status(deadline)
        else:
            await self.fence(deadline)
        self.unconfirmed = False

    async def fence(self, deadline: float) -> None:
        """Have heard everything that the camera said before now.

        The deadline may be a trigger's and as short as it likes: it does not cost the link.
        """
        await self.await_owed(m.SwitchAnswer, m.Query(), deadline)
        await self.exchange(m.Query(), m.QueryAnswer, deadline, due=self.due_after(deadline))

    def expect_fence(self, sent_at: float, deadline: float) -> None:
        """A Query went out in front of a trigger; its answer is owed, and nobody waits for it."""
        self.inbox.fence_open = True
        self._due[m.QueryAnswer] = max(deadline, sent_at + self._patience)

    def owes(self, key: type[m.Message] | int) -> bool:
        """Whether an answer of this kind is open."""
        inbox = self.inbox
        return key in inbox.answers or (key is m.QueryAnswer and inbox.fence_open)

    def due_after(self, deadline: float) -> float:
        """Return until when an answer may come that a trigger waits for, however short that is."""
        return max(deadline, asyncio.get_running_loop().time() + self._patience)

    def ask_for_life(self, due: float) -> bool:
        """Send a Query unless one is open; its answer is owed until ``due`` (loop time)."""
        if self.owes(m.QueryAnswer):
            return False
        link = self.require_link()
        if self.poll is not None:
            link.send(m.GetStatus(), answered=False)  # so that it does not grow old
        link.send(m.Query())
        self._due[m.QueryAnswer] = due
        self.inbox.next_answer(m.QueryAnswer)
        return True

    def ask_what_is_active(self) -> None:
        """Send a Query after somebody else's switch, as soon as none is open from before it."""
        with contextlib.suppress(SmartCamError):  # the link is over: the receive task tells
            if self.ask_for_life(asyncio.get_running_loop().time() + self._patience):
                self.inbox.active_in_doubt = False

    async def query(self, deadline: float) -> int:
        """Return the active application.

        During a switch a Query tells the old id, so an owed switch answer is awaited first; or it
        is answered as too busy, and asked again.

        Raises:
            ResponseTimeoutError: no answer, or none but that the camera is busy.
        """
        await self.await_owed(m.SwitchAnswer, m.Query(), deadline)
        while True:
            answer = await self.ask(m.Query(), m.QueryAnswer, deadline)
            if not self.is_busy(answer):
                self.check(m.Query, answer)
                return answer.application
            await self.pause(deadline, "the busy camera to name its application")

    def is_busy(self, answer: m.Acknowledgement) -> bool:
        """Whether an answer says that the camera was too busy."""
        return self.dialect.code(answer.code).verdict is Verdict.BUSY

    async def pause(self, deadline: float, what: str) -> None:
        """Wait a moment before the camera is asked again.

        Raises:
            ResponseTimeoutError: there is no time left.
        """
        now = asyncio.get_running_loop().time()
        if deadline - now <= BUSY_PAUSE:
            raise ResponseTimeoutError(
                f"{self.name}: waited until the time was over for {what}; status: {self.status}"
            )
        with contextlib.suppress(TimeoutError):  # and a loss ends it at once
            await self.inbox.wait_status(_never, now + BUSY_PAUSE)

    async def query_loaded(self, deadline: float) -> int:
        """Return the active application; while one is being loaded a Query tells the old one."""
        await self.refresh_status(deadline)  # whether it runs is asked next
        await self.until(_is_not_loading, deadline, "the application to be loaded")
        return await self.query(deadline)

    async def ensure(self, application: int, deadline: float) -> None:
        """Have an application running and ready, by the least that is needed."""
        if await self.query_loaded(deadline) != application:
            await self.switch(application, deadline, start=True)
            return
        self.inbox.expected = application
        if Status.RUNNING not in self.status:
            await self.start(deadline)
        self.wants_running = True
        await self.until(is_ready, deadline, "Running and not BUSY")

    async def switch(self, application: int | str, deadline: float, *, start: bool) -> None:
        """Stop if need be, switch, wait until not BUSY, start if wanted.

        Args:
            application: its id, or the name of its file.
            deadline: loop time.
            start: enter run mode afterwards, where there is one.

        Raises:
            UnsupportedError: the dialect loads no applications, or none by name.
            CommandRejectedError: the camera refused; the old application runs again if it ran.
        """
        request = self._load_request(application)
        active: int | None
        stops = self.dialect.has(m.Stop)
        was_running = self.runs and stops
        if stops and application == 0 and 0 not in self.dialect.application_ids:
            # Never allowed, several applications may carry it (SC manual p. 34, published): so
            # nothing is stopped for it.
            code, active = 1, await self.query(deadline)
        else:
            if was_running:
                await self._leave_run_mode(deadline)
            answer = await self.ask(request, m.SwitchAnswer, deadline)
            while self.is_busy(answer):
                await self.pause(deadline, f"the busy camera to load {application}")
                answer = await self.ask(request, m.SwitchAnswer, deadline)
            code = answer.code
            told = answer.application in self.dialect.application_ids
            active = answer.application if told else self.inbox.active
        done = self.dialect.code(code).verdict is Verdict.DONE
        if not done or (isinstance(application, int) and active != application):
            if was_running and Status.RUNNING not in self.status:
                await self.enter_run_mode(deadline)
            refusal = (
                f"the camera refused to switch to application {application}: "
                f"{code_text(self.dialect, code, type(request))}"
            )
            if application == 0 and 0 not in self.dialect.application_ids:
                refusal = "no application may have the id 0"
            elif done:
                refusal = f"the camera says it switched, but not to application {application}"
            raise CommandRejectedError(
                f"{self.name}: {refusal}; application {active} is active",
                message_id=self.dialect.message_id(request),
                code=code,
                active_application=active,
            )
        await self.refresh_status(deadline)
        await self.until(lambda status: Status.BUSY not in status, deadline, "not BUSY")
        if start and stops:
            await self.start(deadline)

    def _load_request(self, application: int | str) -> m.Request:
        if isinstance(application, str):
            self.require(m.LoadFile)
            if not application.isprintable():
                raise ConfigurationError(f"{self.name}: {application!r} is no file's name")
            return m.LoadFile(name=application.encode())
        self.require(m.SwitchApplication)
        ids = self.dialect.application_ids
        if application != 0 and application not in ids:
            raise ConfigurationError(
                f"{self.name}: application id {application} is not {ids.start} to {ids.stop - 1}"
            )
        return m.SwitchApplication(application=application)

    @property
    def ordered(self) -> bool:
        """Whether messages come in order and none is lost."""
        return self.require_link().machine.transport is Transport.TCP

    # ------------------------------------------------------------------ answers

    async def await_owed(
        self, key: type[m.Message] | int, message: m.Message, deadline: float
    ) -> None:
        """Wait for the answer to an earlier request, which is dropped.

        Raises:
            ResponseTimeoutError: it did not come; the link is given up if its own time is over too.
        """
        while self.owes(key):  # a trigger may have sent the next Query before this goes on
            owed = self.inbox.answers.get(key) or self.inbox.next_answer(key)
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
        dialect = self.dialect
        return ResponseTimeoutError(
            f"{self.name}: {what} {dialect.called(message)} {why}; status: {self.status}",
            message_id=dialect.message_id(message),
        )


def _never(_: Status) -> bool:
    return False


def _is_not_loading(status: Status) -> bool:
    return not status.loading


def _is_not_running(status: Status) -> bool:
    return Status.RUNNING not in status
