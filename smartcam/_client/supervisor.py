"""The life of a client: sessions, one after the other, and the steps between them.

Each client has one task for this, the only task outside of a task group. It makes a session, reads
its link to the end by the receive task, ends all waits, and makes the next session after the delays
of :class:`~smartcam.Backoff`. If the camera is lost again soon after a reconnect, another client
has it: then the task stops or, at an agent, tries again slowly. A callback does the steps after the
task's end, since a task that is cancelled before its first step runs no ``finally``.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from smartcam._client.doorbell import outlast
from smartcam._client.handshake import Session, establish
from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import (
    ConnectionClosedError,
    ConnectionLostError,
    ConnectionTakenError,
    LinkError,
    ResponseTimeoutError,
    SmartCamError,
)
from smartcam.models import Connected, Disconnected, Reconnected
from smartcam.protocols import Transport

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam._client.command_lock import CommandLock
    from smartcam._client.commands import Commands
    from smartcam._client.connection import Connection
    from smartcam._client.counters import ClientCounters
    from smartcam._client.dispatch import Dispatch
    from smartcam._client.keepalive import KeepAlive
    from smartcam._client.link import Link
    from smartcam._client.listeners import Listeners
    from smartcam._client.waits import Waits
    from smartcam.observers import Observers
    from smartcam.settings import Address, CameraSettings

logger: logging.Logger = logging.getLogger("smartcam.client")

TAKEN_WITHIN = 10.0
"""Seconds after Connect within which a lost session counts as taken by another client (a decision
of this library: the camera does not report it)."""


FIRST_RETRY_DELAY_OF_TAKEN = 30.0
MAX_RETRY_DELAY_OF_TAKEN = 600.0
"""Shortest and longest time, seconds, until the next try to get a taken camera, if ``on_taken`` is
set: doubled each time that it is taken again. Each try interrupts the other client's session."""


@dataclass(eq=False)
class Supervisor:
    """Makes sessions and reads them.

    Attributes:
        session: the last session that was made, None before the first.
        on_taken: function that is called when another client took the camera, after which sessions
            are tried at long intervals; None: the client ends.
    """

    _settings: CameraSettings
    _connection: Connection
    _commands: Commands
    _lock: CommandLock
    _dispatch: Dispatch
    _waits: Waits
    _listeners: Listeners
    _counters: ClientCounters
    _keepalive: KeepAlive
    _observers: Observers

    def __post_init__(self) -> None:
        self.session: Session | None = None
        self._name = self._settings.name
        self._task: asyncio.Task[SmartCamError] | None = None
        self._opened: asyncio.Future[SmartCamError | None] | None = None
        self._changed: asyncio.Event | None = None  # of the tasks that wait for a change
        self._closing = False
        self._closed: ConnectionClosedError | None = None  # error for all waits after close()
        self._ended_by: SmartCamError | None = None  # reason of the end, if not this program
        self._finished = False  # whether the task is over, and all waits have ended
        self._reading = False  # whether the task reads a link, and so detects its end
        self.on_taken: Callable[[], None] | None = None
        self._times_taken = 0  # losses in a row to another client
        self._take_back = asyncio.Event()
        self._short_lived = 0  # sessions in a row that were lost soon
        # whether an early loss of this session has another cause than a client
        self._excused = False
        self._restarting: Link | None = None  # link over which a restart was requested

    # ------------------------------------------------------------------ for the client

    @property
    def started(self) -> bool:
        """True if the supervisor was ever started."""
        return self._task is not None

    @property
    def over(self) -> bool:
        """True if there will be no further session."""
        return self._closing or self._ended_by is not None

    @property
    def address(self) -> Address:
        """The camera's address, with the dialect pinned once it was found out."""
        return self._settings.address if self.session is None else self.session.address

    @property
    def connected(self) -> bool:
        """True while there is a session."""
        session = self.session
        return session is not None and not session.link.lost and self._waits.end is None

    def use_settings(self, settings: CameraSettings) -> None:
        """Replace the settings of sessions; only before the supervisor is started."""
        self._settings = settings

    async def open(self) -> None:
        """Start, and wait for the first session.

        Raises:
            ConnectFailedError: no session could be made.
        """
        self._opened = opened = asyncio.get_running_loop().create_future()
        self._task = asyncio.create_task(
            self._run(), name=f"smartcam[{self._settings.address.host}].supervisor"
        )
        self._task.add_done_callback(self._end)
        error = await opened
        if error is not None:
            raise error

    async def close(self) -> None:
        """End the task and the session, with a Disconnect if there is time. Idempotent, bounded.

        Cancellation: the link is dropped at once.
        """
        task, session = self._task, self.session
        self._closed = closed = self._closed or self.closed_error()
        self._closing = True
        try:
            if self.connected and self._lock.goes_back:
                with contextlib.suppress(TimeoutError):  # another task's command may be under way
                    async with asyncio.timeout(self._settings.switch_timeout):
                        await self._lock.settle()
            linked = self.connected
            self._dispatch.fail(closed)
            if linked and session is not None:
                await session.link.close(self._settings.close_timeout)
        finally:
            self._dispatch.fail(closed)
            self._drop()
            if task is not None:
                await outlast(task)
            if not self._finished:
                self._dispatch.finish(self._ended_by or closed)
                self._commands.end_session()

    def abandon(self) -> bool:
        """Drop the link and end the task soon, from any thread: no reference to the client is left.

        Returns:
            True if there was anything to end.
        """
        task = self._task
        if task is None or task.done():
            return False
        self._closing = True
        with contextlib.suppress(RuntimeError):  # a closed loop has closed its links
            task.get_loop().call_soon_threadsafe(self._drop)
        return True

    def _drop(self) -> None:
        """Drop the link at once, after a Disconnect, and end the task."""
        if self.session is not None:
            self.session.link.give_up(ConnectionAbortedError("closed by this side"))
        if self._task is not None and not self._reading:
            self._task.cancel()

    async def wait_connected(self, deadline: float, timeout: float) -> None:
        """Wait until there is a session, and its state is restored.

        Raises:
            LinkError: there will be no session.
            ResponseTimeoutError: at ``deadline`` (loop time).
        """
        try:
            async with asyncio.timeout_at(deadline):
                while True:
                    if not self.started or self.over:
                        self._connection.require_link()
                    changed = self._changed = self._changed or asyncio.Event()
                    if self.connected:
                        await self._lock.settle()
                    if self.connected:
                        return
                    await changed.wait()
        except TimeoutError as exc:
            why = self._counters.last_error or "none yet"
            raise ResponseTimeoutError(
                f"{self._name}: no session within {timeout:g} s; the last error: {why}",
                waited=timeout,
            ) from exc

    @property
    def taken(self) -> bool:
        """True if another client has the camera."""
        return isinstance(self._waits.end, ConnectionTakenError)

    def take_back(self) -> None:
        """Try a taken camera again now."""
        if self.taken:
            self._take_back.set()

    def expect_restart(self, link: Link) -> None:
        """Note that a restart was requested: the link will end without a fault."""
        self._restarting = link

    def closed_error(self) -> ConnectionClosedError:
        """Return the error of a client that this program has closed or not opened."""
        address = self._settings.address
        state = "closed" if self.started else "not opened yet"
        return ConnectionClosedError(
            f"{self._name}: the connection is {state}", host=address.host, port=address.port
        )

    # ------------------------------------------------------------------ the task

    def _end(self, task: asyncio.Task[SmartCamError]) -> None:
        """End all waits, since the task has ended and there will be no further session."""
        error = self._reason(task)
        self._dispatch.fail(error)
        if self._closing:
            error = self._closed or self.closed_error()  # also after an earlier loss of the session
        else:
            self._ended_by = error
        if self.session is not None:
            self.session.link.abort()
        self._counters.end()
        self._dispatch.finish(error)
        self._commands.end_session()
        self._finished = True
        self._wake_waiters()
        if self._opened is not None and not self._opened.done():
            self._opened.set_result(error)

    def _reason(self, task: asyncio.Task[SmartCamError]) -> SmartCamError:
        """Return why the ended task makes no more sessions."""
        if task.cancelled():
            if self._closing:
                return self.closed_error()
            return self._lost_error(asyncio.CancelledError("the client's own task was cancelled"))
        cause = task.exception()
        if cause is None:
            return task.result()
        if isinstance(cause, SmartCamError):
            return cause
        if isinstance(cause, BaseExceptionGroup):
            cause = cause.exceptions[0]
        logger.error("%s ! the supervisor failed", self._name, exc_info=cause)
        return self._lost_error(cause)

    def _lost_error(self, cause: BaseException) -> ConnectionLostError:
        error = ConnectionLostError(f"{self._name}: {cause!r} in the client")
        error.__cause__ = cause
        return error

    async def _run(self) -> SmartCamError:
        try:
            return await self._live()
        except ENDS_PROGRAM as exc:
            # the receive task has raised the error in the loop; here only clean up
            return self._lost_error(exc)

    async def _live(self) -> SmartCamError:
        """Make sessions; return the reason why there will be no more."""
        session = await establish(self._settings, self._observers.trace, self._dispatch.layout)
        while True:
            again = self.session is not None
            error = await self._run_session(session)
            made_at = session.early[0].received_at
            restarting, self._restarting = self._restarting is session.link, None
            if self._closing or self._settings.reconnect is None:
                return error
            ordered = session.link.machine.transport is Transport.TCP
            # over UDP the loss began earlier: only silence shows that another client has the camera
            now = asyncio.get_running_loop().time()
            short = (now if ordered else session.link.heard_at) - made_at < TAKEN_WITHIN
            takes = session.dialect.exclusive and _may_be_taken(error, ordered=ordered)
            if again and short and not self._excused and takes:
                taken = self._taken_error(error)
                if self.on_taken is None:
                    return taken
                await self._lock.vacated()
                session = await self._retry_taken(taken, self.on_taken)
                continue
            if not short:
                self._times_taken = 0
            self._short_lived = self._short_lived + 1 if again and short else 0
            self._excused = restarting
            await self._lock.vacated()
            session = await self._reconnect(error)

    async def _run_session(self, session: Session) -> ConnectionLostError:
        """Keep one session until its link ends; return the reason of the end."""
        settings, link = self._settings, session.link
        error: ConnectionLostError
        self._reading = True
        try:
            restore = settings.restore and self.session is not None
            async with asyncio.TaskGroup() as tasks:
                try:
                    self._lock.begin_session(tasks, restore=restore)
                    self._adopt(session)
                    stop_watching = self._keepalive.watch(link)
                    try:
                        name = f"smartcam[{self._name}].receive"
                        error = await tasks.create_task(self._receive(link), name=name)
                    finally:
                        stop_watching()
                    self._report_loss(link, error)  # also ends the waits of jobs
                finally:
                    self._lock.end_session()
        finally:
            self._reading = False
            self._commands.end_session()
            link.abort()
        return error

    def _adopt(self, session: Session) -> None:
        again = self.session is not None
        self.session = session
        ordered = session.link.machine.transport is Transport.TCP
        self._dispatch.begin_session(session.dialect, ordered=ordered)
        self._commands.begin_session(session.link)
        self._counters.begin(session.link.machine.counters)
        kind = Reconnected if again else Connected
        if logger.isEnabledFor(logging.INFO):
            logger.info("%s = connected to %s", self._name, session.address.url)
        if self._listeners.hears_changes:
            url = session.address.url
            self._listeners.publish(kind(camera=self._name, at=datetime.now(UTC), url=url))
        self._dispatch.dispatch_early(session.early)
        if self._opened is not None and not self._opened.done():
            self._opened.set_result(None)
        self._wake_waiters()

    async def _receive(self, link: Link) -> ConnectionLostError:
        """Dispatch each chunk until the link ends; return the reason of its end."""
        while True:
            try:
                chunk = await link.receive()
            except ConnectionLostError as error:
                return error.with_traceback(None)  # else it would refer to this task's frames
            if self._listeners.has_subscribers:
                link.wake_in_order()
            self._dispatch.dispatch(chunk)
            del chunk  # free it, since the next chunk may come much later

    def _report_loss(self, link: Link, error: ConnectionLostError) -> None:
        """End all waits, since a link has ended; all its events are dispatched."""
        restarting = self._restarting is link
        expected = self._closing or restarting
        reason = "the camera restarts" if restarting else str(error.__cause__)
        reason = "closed by this side" if self._closing else reason
        if not expected:
            logger.warning("! %s", error)
            self._counters.note_loss(error)
            self._observers.error(self._name, error)
        self._dispatch.fail(error)
        if self._listeners.hears_changes:
            at = datetime.now(UTC)
            event = Disconnected(camera=self._name, at=at, reason=reason, expected=expected)
            self._listeners.publish(event)
        self._wake_waiters()

    async def _retry_taken(
        self, taken: ConnectionTakenError, notify: Callable[[], None]
    ) -> Session:
        """Make a new session after a long pause, or as soon as the camera is to be taken back.

        Raises:
            SmartCamError: the client gave up.
        """
        pause = self._pause_of_taken
        self._waits.end = taken
        self._times_taken += 1
        self._take_back.clear()
        notify()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(pause):
                await self._take_back.wait()
        # a camera that does not answer has no client, so it counts as lost from then on
        return await self._reconnect(taken, at_once=True)

    async def _reconnect(self, loss: LinkError, *, at_once: bool = False) -> Session:
        """Try to make a new session until the policy ends it; ``at_once``: without a first pause.

        Raises:
            SmartCamError: the client gave up.
        """
        policy, name = self._settings.reconnect, self._name
        settings = replace(self._settings, address=self.address)
        failed: SmartCamError = loss
        if policy is not None:
            delays = policy.delays(short_lived=self._short_lived)
            for tried, delay in enumerate(itertools.chain([0.0] * at_once, delays), 1):
                await asyncio.sleep(delay)
                try:
                    return await establish(settings, self._observers.trace, self._dispatch.layout)
                except SmartCamError as exc:
                    failed = exc
                level = logging.WARNING if tried == 1 else logging.DEBUG
                logger.log(level, "%s ! reconnect %d: %s", name, tried, failed)
                self._counters.note_loss(failed)
                self._observers.error(name, failed)
                if not policy.transient(failed):
                    break
        raise ConnectionLostError(
            f"{loss}; given up after that: {failed}",
            host=settings.address.host,
            port=settings.address.port,
        ) from failed

    def _taken_error(self, error: ConnectionLostError) -> ConnectionTakenError:
        address = self.address
        outcome = f"stopped, so as not to fight for it ({error})"
        if self.on_taken is not None:
            outcome = f"it is tried again in {self._pause_of_taken:.0f} s ({error})"
        taken = ConnectionTakenError(
            f"{self._name}: lost again right after a reconnect: another client has the "
            f"camera, which serves one; {outcome}",
            host=address.host,
            port=address.port,
        )
        taken.__cause__ = error.__cause__
        logger.warning("! %s", taken)
        self._counters.note_loss(taken)
        self._observers.error(self._name, taken)
        return taken

    @property
    def _pause_of_taken(self) -> float:
        """Seconds until a camera that was taken is tried again."""
        doubled = min(self._times_taken, 16)  # a larger power is far beyond the longest pause
        return min(FIRST_RETRY_DELAY_OF_TAKEN * 2.0**doubled, MAX_RETRY_DELAY_OF_TAKEN)

    def _wake_waiters(self) -> None:
        """Wake the tasks that wait for a change of the connection."""
        changed, self._changed = self._changed, None
        if changed is not None:
            changed.set()


def _may_be_taken(error: ConnectionLostError, *, ordered: bool) -> bool:
    """Return True if the loss may be another client's doing.

    On TCP the camera closes the connection of the earlier client, so only a closed connection
    counts. Over UDP it only falls silent. A broken frame, a fault of this program, and a
    network or a port that is gone never count.
    """
    cause = error.__cause__
    if isinstance(cause, ConnectionRefusedError):
        return False
    return isinstance(cause, ConnectionError if ordered else (ConnectionError, TimeoutError))
