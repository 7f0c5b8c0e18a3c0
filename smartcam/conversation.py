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
from datetime import UTC, datetime
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from smartcam.alarm import Alarm
from smartcam.attribution import PendingTrigger
from smartcam.exceptions import (
    CameraBusyError,
    CameraFaultError,
    CommandRejectedError,
    ConfigurationError,
    ConnectionClosedError,
    InputContainerError,
    LocalProtocolError,
    NotRunningError,
    RemoteProtocolError,
    ResponseTimeoutError,
    SmartCamError,
    TriggerTimeoutError,
    UnsupportedError,
    WrongApplicationError,
)
from smartcam.handshake import code_text
from smartcam.models import Status
from smartcam.polling import StatusPoll
from smartcam.protocols import messages as m
from smartcam.protocols.base import Transport, Verdict

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from typing import Any

    from smartcam.connection import Link
    from smartcam.inbox import Inbox
    from smartcam.interpretation import Interpretation
    from smartcam.models import Result
    from smartcam.protocols.base import Dialect

__all__ = ["Conversation", "TriggerRequest"]

AnswerT = TypeVar("AnswerT", bound=m.Message)

TIMER_RESOLUTION = 0.02
"""Seconds that a timer may be early: Windows' clock ticks every 16 ms."""

BUSY_PAUSE = 0.02
"""Seconds until a camera that was too busy for a request is asked again."""

_WAITING, _OVERTRIGGERED = int(Status.WAITING_FOR_TRIGGER), int(Status.OVERTRIGGERED)
_SPEAKS_AGAINST = int(
    Status.WAITING_FOR_TRIGGER | Status.BUSY | Status.SYSTEM_ERROR
)  # of these Waiting alone is to be set before a trigger

LATE_GRACE = 0.25
"""Seconds that a late result is waited for before it is made impossible: most are only a little
late, and stopping and starting an application costs more."""


OVERTRIGGERED_GRACE = 1.0
"""Seconds that a trigger waits for the Overtriggered of an earlier one to fall. While it is set it
cannot tell that ours was dropped; a camera on which it stays set must not stop the line."""


class TriggerRequest(NamedTuple):
    """What a trigger is to do.

    Attributes:
        interpretation: how to read its results.
        input_data: sent right before it, None for none.
        results: how many results it is to have.
        wait: wait until the camera takes a trigger; else refuse where it does not.
    """

    interpretation: Interpretation
    input_data: bytes | None
    results: int
    wait: bool


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
        self._loop: asyncio.AbstractEventLoop | None = None
        self.wants_running: bool | None = None  # None: neither was asked for
        self._locks: dict[object, asyncio.Lock] = collections.defaultdict(asyncio.Lock)
        self._due: dict[object, float] = {}  # until when the last request of a kind was to wait
        self._halted_at: int | None = None  # loads by others when a trigger's fence stopped it
        self.unconfirmed: bool = False  # a Start or Stop was sent, its status has not come
        self._status_in_doubt = False  # over UDP: it may have been lost
        self._alarm = Alarm(self._expire)
        self._poll: StatusPoll | None = None  # where the status does not come by itself
        self._numbered = self._acknowledged = False  # the dialect's triggers

    def begin(self, link: Link) -> None:
        """A new session: nothing is owed on it, its status is heard."""
        self.link = link
        self._loop = asyncio.get_running_loop()
        self._due.clear()
        self.unconfirmed = self._status_in_doubt = False
        self.end_polling()
        dialect = link.machine.dialect
        self._numbered = dialect.has(m.SetSequenceNumber)
        self._acknowledged = dialect.has(m.TriggerAnswer)
        if not dialect.capabilities.status_by_itself:
            self._poll = StatusPoll(link, self.inbox, self._patience)
            self.inbox.on_status_wanted = self._poll.wanted
            self._poll.wanted()

    def end_polling(self) -> None:
        """The session is over, or none has begun."""
        self.inbox.on_status_wanted = None
        if self._poll is not None:
            self._poll.stop()
            self._poll = None

    def end(self) -> None:
        """There will be no session any more."""
        self._alarm.cancel()
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
        return self._halted or Status.RUNNING in self.status

    @property
    def _halted(self) -> bool:
        """A trigger's fence has stopped it and not started it again, nor has anybody loaded it."""
        return self._halted_at == self.inbox.loads_by_others

    def deadline(self, timeout: float) -> float:
        """Return the loop time in ``timeout`` seconds.

        Raises:
            ConfigurationError: it is no finite number of seconds, 0 or more.
        """
        if not 0 <= timeout < math.inf:
            raise ConfigurationError(f"{self.name}: timeout {timeout!r} is no number of seconds")
        loop = self._loop or asyncio.get_running_loop()  # which is a system call in CPython 3.11
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
            await self._await_owed(key, message, deadline)
            self.require_link().send(message)
            self._due[key] = deadline if due is None else due
            return self.inbox.next_answer(key)
        finally:
            lock.release()

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
            return await self._wait_status(predicate, deadline)
        except TimeoutError as exc:
            waited = max(0.0, deadline - begin)
            raise ResponseTimeoutError(
                f"{self.name}: waited {round(waited, 2):g} s for {what}; status: {self.status}",
                waited=waited,
            ) from exc

    async def _wait_status(self, predicate: Callable[[Status], bool], deadline: float) -> Status:
        """Wait for a status; over UDP, where one may be lost, have it said again half-way.

        Raises:
            TimeoutError: at ``deadline``.
        """
        if not self._ordered and self._poll is None:
            now = asyncio.get_running_loop().time()
            with contextlib.suppress(TimeoutError):
                return await self.inbox.wait_status(predicate, now + 0.5 * (deadline - now))
            await self._ask_for_status(deadline)
        return await self.inbox.wait_status(predicate, deadline)

    async def _ask_for_status(self, deadline: float) -> None:
        """Have the camera say its status, by Get status where there is that.

        Elsewhere Connect brings one (SC manual p. 29, published). A Query goes first: who has lost
        the session must not take it back by this.
        """
        link = self.require_link()
        if self._poll is not None:
            link.send(m.GetStatus(), answered=False)
            return
        try:
            await self._fence(deadline)
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
            await self._fence(deadline)
            if self.inbox.statuses_heard != heard:
                return
            await self._pause(deadline, "the camera to tell its status")

    # ------------------------------------------------------------------ run state, application

    async def start(self, deadline: float) -> None:
        """Enter run mode and wait until the camera reports it."""
        self.require(m.Start)
        self.wants_running = True
        await self._enter_run_mode(deadline)

    async def stop(self, deadline: float) -> None:
        """Leave run mode and wait until the camera reports it."""
        self.require(m.Stop)
        self.wants_running = False
        await self._leave_run_mode(deadline)

    async def _enter_run_mode(self, deadline: float) -> None:
        await self._confirm(m.Start(), is_ready, deadline, "Running and not BUSY after Start")
        self._halted_at = None

    async def _leave_run_mode(self, deadline: float) -> None:
        self._halted_at = None
        await self._halt(deadline)

    async def _halt(self, deadline: float) -> None:
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
        if self._poll is not None:
            await self.refresh_status(deadline)
        else:
            await self._fence(deadline)
        self.unconfirmed = False

    async def _fence(self, deadline: float) -> None:
        """Have heard everything that the camera said before now.

        The deadline may be a trigger's and as short as it likes: it does not cost the link.
        """
        await self._await_owed(m.SwitchAnswer, m.Query(), deadline)
        await self.exchange(m.Query(), m.QueryAnswer, deadline, due=self._due_after(deadline))

    def _due_after(self, deadline: float) -> float:
        """Return until when an answer may come that a trigger waits for, however short that is."""
        return max(deadline, asyncio.get_running_loop().time() + self._patience)

    def ask_for_life(self, due: float) -> bool:
        """Send a Query unless one is open; its answer is owed until ``due`` (loop time)."""
        if m.QueryAnswer in self.inbox.answers:
            return False
        link = self.require_link()
        if self._poll is not None:
            link.send(m.GetStatus(), answered=False)  # so that it does not grow old
        link.send(m.Query())
        self._due[m.QueryAnswer] = due
        self.inbox.next_answer(m.QueryAnswer)
        return True

    def ask_what_is_active(self) -> None:
        """Send a Query after somebody else's switch, as soon as none is open from before it."""
        with contextlib.suppress(SmartCamError):  # the link is over: its reader knows
            if self.ask_for_life(asyncio.get_running_loop().time() + self._patience):
                self.inbox.active_in_doubt = False

    async def query(self, deadline: float) -> int:
        """Return the active application.

        During a switch a Query tells the old id, so an owed switch answer is awaited first; or it
        is answered as too busy, and asked again.

        Raises:
            ResponseTimeoutError: no answer, or none but that the camera is busy.
        """
        await self._await_owed(m.SwitchAnswer, m.Query(), deadline)
        while True:
            answer = await self.ask(m.Query(), m.QueryAnswer, deadline)
            if not self._is_busy(answer):
                self.check(m.Query, answer)
                return answer.application
            await self._pause(deadline, "the busy camera to name its application")

    def _is_busy(self, answer: m.Acknowledgement) -> bool:
        return self.dialect.code(answer.code).verdict is Verdict.BUSY

    async def _pause(self, deadline: float, what: str) -> None:
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
        if self._poll is not None:
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
            while self._is_busy(answer):
                await self._pause(deadline, f"the busy camera to load {application}")
                answer = await self.ask(request, m.SwitchAnswer, deadline)
            code = answer.code
            told = answer.application in self.dialect.application_ids
            active = answer.application if told else self.inbox.active
        done = self.dialect.code(code).verdict is Verdict.DONE
        if not done or (isinstance(application, int) and active != application):
            if was_running and Status.RUNNING not in self.status:
                await self._enter_run_mode(deadline)
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

    # ------------------------------------------------------------------ trigger

    def trigger(
        self, request: TriggerRequest, deadline: float
    ) -> Coroutine[Any, Any, list[Result]]:
        """Wait until the camera takes a trigger, send it, return its results.

        Raises:
            SmartCamError: one of the outcomes of :meth:`SmartCamera.trigger`.
        """
        if self._acknowledged:
            return self._trigger_until_taken(request, deadline)
        return self._trigger_once(request, deadline)

    async def _trigger_until_taken(self, request: TriggerRequest, deadline: float) -> list[Result]:
        """Trigger again where the camera says that it was too busy for it."""
        while True:
            try:
                return await self._trigger_once(request, deadline)
            except CameraBusyError as exc:
                if not request.wait:
                    raise
                try:
                    await self._pause(deadline, "the camera to take a trigger")
                except ResponseTimeoutError as timeout:
                    raise TriggerTimeoutError(f"{timeout}; {exc}") from exc

    async def _trigger_once(self, request: TriggerRequest, deadline: float) -> list[Result]:
        """Send one trigger as soon as the camera takes it, return its results.

        Raises:
            SmartCamError: one of the outcomes of :meth:`SmartCamera.trigger`.
        """
        attribution, loop = self.inbox.attribution, self._loop or asyncio.get_running_loop()
        if self._poll is not None:
            await self.refresh_status(deadline)
        self._raise_fault()
        if request.input_data is not None and self.inbox.input_in_doubt:
            raise InputContainerError(
                f"{self.name}: input data of an earlier trigger, which had no result, may still be "
                "queued in the camera and would be taken for this one's; switch_application() "
                "empties the queue"
            )
        if self.inbox.expected is not None and self.inbox.active != self.inbox.expected:
            await self._check_application(deadline)
        if self._status_in_doubt:
            await self._ask_for_status(deadline)
            await self._fence(deadline)  # it has come by then, or is lost again
            self._status_in_doubt = False
        interpretation = request.interpretation
        numbering = interpretation.numbering(self.inbox.active) if self._numbered else None
        # an older result shows by its number where each container has one
        decided = numbering is not None and numbering.always
        if self._halted or (attribution.debt is not None and not decided):
            await self._settle_debt(deadline, wait=request.wait)
        if int(self.status) & _SPEAKS_AGAINST != _WAITING:
            await self._wait_for_trigger(deadline, wait=request.wait)
        if int(self.status) & _OVERTRIGGERED:
            await self._clear_overtriggered(deadline)
            await self._wait_for_trigger(deadline, wait=request.wait)
        while attribution.unsettled and not decided and self._ordered:
            await self._settle_others(deadline)
            await self._wait_for_trigger(deadline, wait=request.wait)
        pending = PendingTrigger(
            loop.create_future(),
            request.interpretation,
            request.input_data is not None,
            loop.time(),
            datetime.now(UTC),
            wanted=request.results,
            number=attribution.take_number(numbering.highest) if numbering is not None else None,
            # where each application has its own interpreter none is read with another's layout
            application=None if request.interpretation.by_application else self.inbox.active,
        )
        return await self._await_results(pending, request.input_data, deadline)

    async def _await_results(
        self, pending: PendingTrigger, input_data: bytes | None, deadline: float
    ) -> list[Result]:
        inbox, outcome, link = self.inbox, pending.outcome, self.require_link()
        words: list[m.Message] = []
        if pending.number is not None:
            words.append(m.SetSequenceNumber(number=pending.number))
        if self._acknowledged:
            await self._await_owed(m.TriggerAnswer, m.Trigger(), deadline)
        if input_data is not None and link.machine.dialect.answers(m.SetInput):
            due = self._due_after(deadline)
            await self.command(m.SetInput(data=input_data), deadline, due=due)
        elif input_data is not None:
            words.append(m.SetInput(data=input_data))
        inbox.attribution.send(pending)
        self._alarm.set(deadline)
        try:
            link.send(*words, m.Trigger())
            if self._acknowledged:
                self._expect_acknowledgement(pending, deadline)
            else:
                inbox.input_in_doubt = inbox.input_in_doubt or input_data is not None
            if self._poll is not None:
                self._poll.wanted()
            if not link.writable:
                with contextlib.suppress(TimeoutError):  # at which the outcome is one, too
                    async with asyncio.timeout_at(deadline):
                        await link.drain()
            return await outcome
        except TimeoutError as exc:
            inbox.attribution.give_up(pending)
            # it may have been stopped: then Waiting did not drop for this trigger
            self._status_in_doubt = not (self._ordered or pending.dropped_waiting)
            waited = deadline - pending.sent_at
            came = f"{len(pending.results)} of {pending.wanted} results"
            raise TriggerTimeoutError(
                f"{self.name}: {came if pending.results else 'no result'} within "
                f"{round(waited, 2):g} s of the trigger; status: {self.status}",
                waited=waited,
            ) from exc
        except asyncio.CancelledError:
            if not outcome.done() or outcome.cancelled():
                inbox.attribution.give_up(pending)
            else:
                outcome.exception()  # nobody will look at it
            raise
        finally:
            self._alarm.clear()
            inbox.attribution.pending = None

    def _expect_acknowledgement(self, pending: PendingTrigger, deadline: float) -> None:
        """Have the trigger end at once where the camera says that it took none."""

        def on_answer(answer: asyncio.Future[m.Message | SmartCamError]) -> None:
            got = answer.result()
            if isinstance(got, SmartCamError) or pending.outcome.done():
                return
            try:
                self.check(m.Trigger, got)
            except (CommandRejectedError, UnsupportedError) as exc:
                busy = isinstance(got, m.Acknowledgement) and self._is_busy(got)
                if not self._ordered:  # it may be the answer to an earlier one
                    self.inbox.attribution.give_up(pending)
                pending.outcome.set_exception(CameraBusyError(str(exc)) if busy else exc)
            except SmartCamError as exc:  # the link is over
                pending.outcome.set_exception(exc)

        self._due[m.TriggerAnswer] = self._due_after(deadline)
        self.inbox.next_answer(m.TriggerAnswer).add_done_callback(on_answer)

    def _expire(self) -> None:
        """The trigger's deadline: from this moment on its result is late."""
        pending = self.inbox.attribution.pending
        if pending is not None and not pending.outcome.done():
            self.inbox.attribution.give_up(pending)
            pending.outcome.set_exception(TimeoutError())

    async def _check_application(self, deadline: float) -> None:
        """See to it that the application that was named is the active one.

        Raises:
            WrongApplicationError: somebody else has switched; nothing was sent but a Query.
        """
        inbox = self.inbox
        await self._fence(deadline)  # what is known may be old
        if inbox.active != inbox.expected:
            raise WrongApplicationError(
                f"{self.name}: application {inbox.active} is active, somebody else has switched; "
                f"{inbox.expected} was expected",
                expected=inbox.expected,
                got=inbox.active,
            )

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
                await self._wait_status(_is_decided, deadline)
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

    @property
    def _ordered(self) -> bool:
        return self.require_link().machine.transport is Transport.TCP

    async def _settle_debt(self, deadline: float, *, wait: bool) -> None:
        """Await the result of an earlier trigger, or make it impossible.

        Stop voids the inspection under way, a Query is the fence: what comes before its answer
        came from before. Without a Stop the inspection's end is awaited: the camera waits for a
        trigger again. A camera that does one thing after the other needs the fence only.
        Source: that Stop voids the inspection is inferred.
        """
        if self.dialect.in_order or not self.dialect.has(m.Stop):
            await self._wait_for_trigger(deadline, wait=wait)
            await self._fence(deadline)
            self.inbox.attribution.settled()
            return
        attribution, now = self.inbox.attribution, asyncio.get_running_loop().time()
        if not self._halted and Status.RUNNING in self.status:
            grace = min(deadline, now + min(LATE_GRACE, 0.5 * (deadline - now)))
            with contextlib.suppress(TimeoutError):
                await self.inbox.wait_status(_is_decided, grace)
            if attribution.debt is None:
                return
        if self.runs:
            # interrupted here, the next trigger does all of it again
            self._halted_at = self.inbox.loads_by_others
            await self._halt(deadline)
            await self._fence(deadline)
            await self._enter_run_mode(deadline)
        attribution.settled()

    async def _clear_overtriggered(self, deadline: float) -> None:
        """Reset Overtriggered, or wait a moment for it to fall: only then can it rise for ours.

        Source: it falls by itself (SC manual p. 30, published), when is unknown; on BVS ID it stays
        until it is reset (BVS ID guide p. 227, published).
        """
        if self.dialect.has(m.ResetErrors):
            await self.command(m.ResetErrors(), deadline, due=self._due_after(deadline))
            await self.refresh_status(deadline)
            return
        now = asyncio.get_running_loop().time()
        grace = now + min(OVERTRIGGERED_GRACE, 0.5 * (deadline - now))
        with contextlib.suppress(TimeoutError):
            await self.inbox.wait_status(_is_not_overtriggered, grace)

    async def _settle_others(self, deadline: float) -> None:
        """Have heard the result of an inspection that somebody else triggered."""
        attribution = self.inbox.attribution
        attribution.unsettled = False  # the next one may begin meanwhile
        try:
            await self._fence(deadline)
        except BaseException:
            attribution.unsettled = True
            raise

    # ------------------------------------------------------------------ answers

    async def _await_owed(
        self, key: type[m.Message] | int, message: m.Message, deadline: float
    ) -> None:
        """Wait for the answer to an earlier request, which is dropped.

        Raises:
            ResponseTimeoutError: it did not come; the link is given up if its own time is over too.
        """
        while (owed := self.inbox.answers.get(key)) is not None:
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


def _never(_: Status) -> bool:
    return False


def _is_not_overtriggered(status: Status) -> bool:
    return Status.OVERTRIGGERED not in status


def _is_not_loading(status: Status) -> bool:
    return not status.loading


def _is_not_running(status: Status) -> bool:
    return Status.RUNNING not in status


def _is_decided(status: Status) -> bool:
    return takes_trigger(status) or is_stopped(status) or Status.SYSTEM_ERROR in status
