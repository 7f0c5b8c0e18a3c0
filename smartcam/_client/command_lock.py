"""Run one command at a time, and go back after a temporary switch.

Going back to the former application is a job of the session's task group: it is finished even if
the caller is cancelled, it is bounded, and every later command waits for it. A switch back that a
lost link prevented is done first in the next session; so is restoring the wanted state.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam.exceptions import LinkError, ResponseTimeoutError, SmartCamError
from smartcam.models import Status

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Coroutine
    from types import TracebackType
    from typing import Any

    from smartcam._client.camera_state import CameraState, Wanted
    from smartcam._client.commands import Commands
    from smartcam._client.connection import Connection
    from smartcam._client.status import StatusRequests
    from smartcam._client.waits import Waits

logger: logging.Logger = logging.getLogger("smartcam.client")


@dataclass(frozen=True, slots=True)
class Before:
    """The state to go back to.

    Attributes:
        application: id of the application that was active.
        running: whether the application ran.
        wanted: the application and run state that the program asked for.
    """

    application: int
    running: bool
    wanted: Wanted


@dataclass(slots=True, eq=False)
class Hold:
    """One command's turn: ``async with lock.hold(timeout) as deadline``."""

    _lock: CommandLock
    _timeout: float

    def __aenter__(self) -> Coroutine[Any, Any, float]:
        return self._lock.take(self._timeout)

    async def __aexit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self._lock.give_back()


@dataclass(eq=False)
class CommandLock:
    """Gives commands their turn."""

    _connection: Connection
    _commands: Commands
    _status: StatusRequests
    _state: CameraState
    _waits: Waits
    _switch_timeout: float  # bound of each switch, seconds

    def __post_init__(self) -> None:
        # tasks of the session; None between two sessions
        self._jobs: asyncio.TaskGroup | None = None
        self._to_restore: Before | None = None  # state to restore in the next session
        self._lock = asyncio.Lock()
        self._waiting_commands = 0  # commands that wait for the lock
        self._leaving: set[asyncio.Task[None]] = set()
        self._failed: SmartCamError | None = None

    # ------------------------------------------------------------------ for the supervisor

    def begin_session(self, jobs: asyncio.TaskGroup, *, restore: bool) -> None:
        """Begin a session; call :meth:`end_session` before its tasks are waited for.

        Args:
            jobs: group of the session's tasks.
            restore: whether to restore the wanted application and run state.
        """
        self._jobs = jobs
        before, self._to_restore = self._to_restore, None
        if before is not None:
            self._start_job("going_back", self._restore_earlier(before))
        elif restore:
            self._start_job("restoring", self._restore())

    def end_session(self) -> None:
        """Begin no jobs until the next session."""
        self._jobs = None

    async def vacated(self) -> None:
        """Wait until every command of the ended session has ended, too; bounded."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._switch_timeout), self._lock:
                pass

    # ------------------------------------------------------------------ for commands

    def hold(self, timeout: float) -> Hold:
        """Hold the turn with ``async with``; it gives the deadline, which includes the wait.

        Raises:
            ResponseTimeoutError: others had it for ``timeout`` seconds.
            SmartCamError: the reason why going back failed before this command.
        """
        return Hold(self, timeout)

    @contextlib.asynccontextmanager
    async def hold_in(self, application: int, timeout: float) -> AsyncGenerator[float]:
        """Hold the turn with ``application`` running; gives the deadline.

        Afterwards the former application is back; after an error or a cancellation this goes on in
        the background.
        """
        # an unknown application is refused before anything is switched
        self._connection.deadline(timeout)
        async with self.hold(self._switch_timeout) as switch_deadline:
            before = await self.enter(application, switch_deadline)
            try:
                yield self._connection.deadline(timeout)
            finally:
                going_back = self.leave(before)
        if going_back is not None:
            await asyncio.wait({going_back})

    async def take(self, timeout: float) -> float:
        """Take the turn and return the deadline; for :class:`Hold`, which gives it back."""
        deadline = self._connection.deadline(timeout)
        await self.turn(deadline, timeout)
        return deadline

    def turn(self, deadline: float, timeout: float) -> Coroutine[Any, Any, object]:
        """Return a coroutine that waits for the turn; after it call :meth:`give_back`.

        Raises:
            LinkError: there is no session.
        """
        self._connection.require_link()
        lock = self._lock
        if lock.locked() or self._waiting_commands or self._leaving:
            return self._wait_for_turn(deadline, timeout)
        if self._failed is not None or self._commands.unconfirmed:
            return self._wait_for_turn(deadline, timeout)
        return lock.acquire()  # the lock is free: no wait

    def give_back(self) -> None:
        """Give the turn to the next waiting command."""
        self._lock.release()

    async def _wait_for_turn(self, deadline: float, timeout: float) -> None:
        self._waiting_commands += 1
        try:
            async with asyncio.timeout_at(deadline):
                await self._acquire()
        except TimeoutError as exc:
            raise ResponseTimeoutError(
                f"{self._connection.name}: another command had the camera for {timeout:g} s",
                waited=timeout,
            ) from exc
        finally:
            self._waiting_commands -= 1
        try:
            self._connection.require_link()  # the link may have been lost meanwhile
            self._raise_failed()
            if self._commands.unconfirmed:
                await self._commands.catch_up(deadline)
        except BaseException:
            self._lock.release()
            raise

    async def enter(self, application: int, deadline: float) -> Before:
        """Start ``application`` while the turn is held; go back if that fails."""
        commands = self._commands
        commands.check_id(application)
        active = await commands.query_loaded(deadline)
        before = Before(active, commands.runs, self._state.wanted)
        try:
            await commands.ensure(application, deadline)
        except BaseException:
            self.leave(before)
            raise
        return before

    def leave(self, before: Before) -> asyncio.Task[None] | None:
        """Go back once the turn is free; without a session return None, and go back in the next.

        If several switches back are due, the one to the outermost block's application counts.
        """
        if self._jobs is None or self._waits.end is not None:
            self._restore_later(before)
            return None
        return self._start_job("going_back", self._restore_earlier(before))

    def _start_job(self, label: str, job: Coroutine[Any, Any, None]) -> asyncio.Task[None] | None:
        if self._jobs is None:
            job.close()
            return None
        task = self._jobs.create_task(job, name=f"smartcam[{self._connection.name}].{label}")
        self._leaving.add(task)
        task.add_done_callback(self._leaving.discard)
        return task

    async def leave_and_wait(self, before: Before) -> None:
        """Go back, and raise the error that prevented it.

        Cancellation: going back is finished nevertheless.
        """
        job = self.leave(before)
        if job is not None:
            await asyncio.wait({job})
            self._raise_failed()

    async def load_again(self, needed: Callable[[], bool], timeout: float) -> None:
        """Load the active application again, which empties the camera's queue of input data.

        Args:
            needed: function that returns, once the turn is held, whether this must still be done.
            timeout: seconds to wait for it.

        Raises:
            SmartCamError: the reason why the application could not be loaded.
            ResponseTimeoutError: loading takes longer.

        Cancellation: it is finished nevertheless, as after the timeout.
        """
        job = self._start_job("loading_again", self._load_again(needed))
        if job is None:
            return
        done, _ = await asyncio.wait({job}, timeout=timeout)
        if not done:
            raise ResponseTimeoutError(
                f"{self._connection.name}: input data of an earlier trigger may still be queued; "
                f"loading the application again, which empties the queue, takes over {timeout:g} s",
                waited=timeout,
            )
        self._raise_failed()

    async def _load_again(self, needed: Callable[[], bool]) -> None:
        """Load the active application again, and start it if it ran; never raises."""
        commands, wanted = self._commands, self._state.wanted
        async with self._lock:
            if not needed():
                return
            logger.info("%s: loaded again, to empty its queue of input", self._connection.name)
            try:
                deadline = self._connection.deadline(self._switch_timeout)
                active = await commands.query_loaded(deadline)
                await commands.switch(active, deadline, start=commands.runs)
            except SmartCamError as error:
                logger.warning("%s ! loading again failed: %s", self._connection.name, error)
                if not self._is_loss(error):
                    self._failed = error
            finally:
                self._state.want(wanted)

    @property
    def goes_back(self) -> bool:
        """True while a job goes back: :meth:`settle` would wait."""
        return bool(self._leaving)

    async def settle(self) -> None:
        """Wait until every job that goes back is done.

        Each is bounded by the switch timeout once it has the turn; the earlier holder may take
        longer, so the caller has its own deadline.
        """
        while self._leaving:
            await asyncio.wait(self._leaving)

    def _restore_later(self, before: Before) -> None:
        """Keep the state that the next session must restore."""
        self._to_restore = before
        self._state.want(before.wanted)

    async def _restore_earlier(self, before: Before) -> None:
        """Restore application and run state; never raises."""
        await self._adopted()
        async with self._lock:
            try:
                await self._reach(before.application, before.running)
            except SmartCamError as error:
                logger.warning("%s ! going back failed: %s", self._connection.name, error)
                if self._is_loss(error):
                    self._restore_later(before)
                else:
                    self._failed = error
            finally:
                self._state.want(before.wanted)

    async def _restore(self) -> None:
        """Restore the named application and the wanted run state; never raises.

        If the link is lost again, the next session does it.
        """
        await self._adopted()
        wanted = self._state.wanted
        async with self._lock:
            try:
                await self._reach(*wanted)
            except SmartCamError as error:
                logger.warning("%s ! restoring failed: %s", self._connection.name, error)
                if not self._is_loss(error):
                    self._failed = error
            finally:
                self._state.want(wanted)

    async def _adopted(self) -> None:
        """Wait until the session of a job is adopted: an eager task begins earlier."""
        if self._waits.end is not None:
            await asyncio.sleep(0)

    def _is_loss(self, error: SmartCamError) -> bool:
        """Return True if the link is lost, which a missing answer causes, too."""
        link = self._connection.link
        return isinstance(error, LinkError) or (link is not None and link.lost)

    async def _reach(self, application: int | None, running: bool | None) -> None:
        """Reach an application and run state with the fewest commands; None leaves it unchanged."""
        commands, status = self._commands, self._status
        deadline = self._connection.deadline(self._switch_timeout)
        active = await commands.query_loaded(deadline)
        if application is not None and active != application:
            await commands.switch(application, deadline, start=running is True)
        elif running and Status.RUNNING not in status.last:
            await commands.start(deadline)
        elif running is False and Status.RUNNING in status.last:
            await commands.stop(deadline)

    async def _acquire(self) -> None:
        """Take the lock after every job that goes back.

        The command with the turn before may have started such a job while this command was in
        line.
        """
        while True:
            await self.settle()
            await self._lock.acquire()
            if not self._leaving:
                return
            self._lock.release()

    def _raise_failed(self) -> None:
        error, self._failed = self._failed, None
        if error is not None:
            raise error
