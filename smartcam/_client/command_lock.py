"""Run one command at a time, and go back after a temporary switch.

A *job*, which is a task of the session's task group, goes back to the former application. A job is
finished even if the caller is cancelled; it has a time limit, and every later command waits for it.
If a lost link prevented the job, the next session begins with it. After a reconnect, another job
restores the wanted application and run state.
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
class PreviousState:
    """The camera's state before a switch, to which a job goes back.

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
        return self._lock.take_turn(self._timeout)

    async def __aexit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self._lock.release_turn()


@dataclass(eq=False)
class CommandLock:
    """Lets one command after the other use the camera."""

    _connection: Connection
    _commands: Commands
    _status: StatusRequests
    _state: CameraState
    _waits: Waits
    _switch_timeout: float  # bound of each switch, seconds

    def __post_init__(self) -> None:
        # tasks of the session; None between two sessions
        self._task_group: asyncio.TaskGroup | None = None
        self._state_to_restore: PreviousState | None = None  # state to restore in the next session
        self._lock = asyncio.Lock()
        self._waiting_commands = 0  # commands that wait for the lock
        self._running_jobs: set[asyncio.Task[None]] = set()
        self._job_error: SmartCamError | None = None

    # ------------------------------------------------------------------ for the supervisor

    def begin_session(self, task_group: asyncio.TaskGroup, *, restore: bool) -> None:
        """Begin a session; :meth:`end_session` must be called before its tasks are awaited.

        Args:
            task_group: group of the session's tasks.
            restore: whether to restore the wanted application and run state.
        """
        self._task_group = task_group
        before, self._state_to_restore = self._state_to_restore, None
        if before is not None:
            self._start_job("going_back", self._restore_earlier(before))
        elif restore:
            self._start_job("restoring", self._restore_wanted())

    def end_session(self) -> None:
        """Start no jobs until the next session."""
        self._task_group = None

    async def wait_until_free(self) -> None:
        """Wait until every command of the ended session has ended, or the time limit is over."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._switch_timeout), self._lock:
                pass

    # ------------------------------------------------------------------ for commands

    def hold(self, timeout: float) -> Hold:
        """Return a context manager that holds the turn; it gives the deadline, waiting included.

        Raises:
            ResponseTimeoutError: other commands had the turn for ``timeout`` seconds.
            SmartCamError: the reason why going back failed before this command.
        """
        return Hold(self, timeout)

    @contextlib.asynccontextmanager
    async def hold_in(self, application: int, timeout: float) -> AsyncGenerator[float]:
        """Hold the turn with ``application`` running; gives the deadline.

        Afterwards a job goes back to the former application. It is awaited, except after an error
        or a cancellation.
        """
        self._connection.deadline(timeout)  # refuses a wrong timeout before anything is switched
        async with self.hold(self._switch_timeout) as switch_deadline:
            before = await self.enter_application(application, switch_deadline)
            try:
                yield self._connection.deadline(timeout)
            finally:
                back_job = self.go_back(before)
        if back_job is not None:
            await asyncio.wait({back_job})

    async def take_turn(self, timeout: float) -> float:
        """Wait for the turn and return the deadline; for :class:`Hold`, which releases the turn."""
        deadline = self._connection.deadline(timeout)
        await self.wait_for_turn(deadline, timeout)
        return deadline

    def wait_for_turn(self, deadline: float, timeout: float) -> Coroutine[Any, Any, object]:
        """Return a coroutine that waits for the turn; after it call :meth:`release_turn`.

        Raises:
            LinkError: there is no session.
        """
        self._connection.require_link()
        lock = self._lock
        if lock.locked() or self._waiting_commands or self._running_jobs:
            return self._wait_in_line(deadline, timeout)
        if self._job_error is not None or self._commands.unconfirmed:
            return self._wait_in_line(deadline, timeout)
        return lock.acquire()  # the lock is free: no wait

    def release_turn(self) -> None:
        """Give the turn to the next waiting command."""
        self._lock.release()

    async def _wait_in_line(self, deadline: float, timeout: float) -> None:
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
            self._raise_job_error()
            if self._commands.unconfirmed:
                await self._commands.confirm_run_state(deadline)
        except BaseException:
            self._lock.release()
            raise

    async def enter_application(self, application: int, deadline: float) -> PreviousState:
        """Start ``application`` while the turn is held; go back if that fails."""
        commands = self._commands
        commands.check_id(application)
        active = await commands.query_loaded(deadline)
        before = PreviousState(active, commands.is_in_run_mode, self._state.wanted)
        try:
            await commands.ensure_running(application, deadline)
        except BaseException:
            self.go_back(before)
            raise
        return before

    def go_back(self, before: PreviousState) -> asyncio.Task[None] | None:
        """Start a job that goes back when the turn is free, and return it.

        Without a session return None; then the next session goes back. Of several calls before the
        next session, the last one counts: the outermost of nested blocks calls last.
        """
        if self._task_group is None or self._waits.end_reason is not None:
            self._restore_later(before)
            return None
        return self._start_job("going_back", self._restore_earlier(before))

    def _start_job(self, label: str, job: Coroutine[Any, Any, None]) -> asyncio.Task[None] | None:
        if self._task_group is None:
            job.close()
            return None
        task = self._task_group.create_task(job, name=f"smartcam[{self._connection.name}].{label}")
        self._running_jobs.add(task)
        task.add_done_callback(self._running_jobs.discard)
        return task

    async def go_back_and_wait(self, before: PreviousState) -> None:
        """Go back, or raise the error that prevented it.

        Cancellation: the job is finished nevertheless.
        """
        job = self.go_back(before)
        if job is not None:
            await asyncio.wait({job})
            self._raise_job_error()

    async def load_again(self, needed: Callable[[], bool], timeout: float) -> None:
        """Load the active application again, which empties the camera's queue of input data.

        Args:
            needed: function that returns, when the turn is held, whether loading is still needed.
            timeout: seconds to wait until it is done.

        Raises:
            SmartCamError: the reason why the application could not be loaded.
            ResponseTimeoutError: loading takes longer.

        Cancellation: the job is finished nevertheless, as after the timeout.
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
        self._raise_job_error()

    async def _load_again(self, needed: Callable[[], bool]) -> None:
        """Load the active application again, and start it if it ran; never raises."""
        commands, wanted = self._commands, self._state.wanted
        async with self._lock:
            if not needed():
                return
            name = self._connection.name
            logger.info("%s: loading the application again, to empty the input queue", name)
            try:
                deadline = self._connection.deadline(self._switch_timeout)
                active = await commands.query_loaded(deadline)
                await commands.switch(active, deadline, start=commands.is_in_run_mode)
            except SmartCamError as error:
                logger.warning("%s ! loading again failed: %s", self._connection.name, error)
                if not self._is_loss(error):
                    self._job_error = error
            finally:
                self._state.set_wanted(wanted)

    @property
    def has_jobs(self) -> bool:
        """True while there is a job, so that :meth:`wait_for_jobs` would wait."""
        return bool(self._running_jobs)

    async def wait_for_jobs(self) -> None:
        """Wait until every job is done.

        Each takes at most the switch timeout when it has the turn. A command that has the turn
        before may take longer, so the caller needs its own deadline.
        """
        while self._running_jobs:
            await asyncio.wait(self._running_jobs)

    def _restore_later(self, before: PreviousState) -> None:
        """Keep the state that the next session must restore."""
        self._state_to_restore = before
        self._state.set_wanted(before.wanted)

    async def _restore_earlier(self, before: PreviousState) -> None:
        """Go back to an earlier application and run state; never raises."""
        await self._wait_until_session_began()
        async with self._lock:
            try:
                await self._reach_state(before.application, before.running)
            except SmartCamError as error:
                logger.warning("%s ! going back failed: %s", self._connection.name, error)
                if self._is_loss(error):
                    self._restore_later(before)
                else:
                    self._job_error = error
            finally:
                self._state.set_wanted(before.wanted)

    async def _restore_wanted(self) -> None:
        """Restore the wanted application and run state; never raises.

        If the link is lost again, the next session does it.
        """
        await self._wait_until_session_began()
        wanted = self._state.wanted
        async with self._lock:
            try:
                await self._reach_state(*wanted)
            except SmartCamError as error:
                logger.warning("%s ! restoring failed: %s", self._connection.name, error)
                if not self._is_loss(error):
                    self._job_error = error
            finally:
                self._state.set_wanted(wanted)

    async def _wait_until_session_began(self) -> None:
        """Wait until the session of a job has begun: an eager task starts before that."""
        if self._waits.end_reason is not None:
            await asyncio.sleep(0)

    def _is_loss(self, error: SmartCamError) -> bool:
        """Return True if a command failed because the link is lost, or was given up."""
        link = self._connection.link
        return isinstance(error, LinkError) or (link is not None and link.lost)

    async def _reach_state(self, application: int | None, running: bool | None) -> None:
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
        """Acquire the lock after all jobs.

        The command that had the turn may have started a job while this command waited in line.
        """
        while True:
            await self.wait_for_jobs()
            await self._lock.acquire()
            if not self._running_jobs:
                return
            self._lock.release()

    def _raise_job_error(self) -> None:
        error, self._job_error = self._job_error, None
        if error is not None:
            raise error
