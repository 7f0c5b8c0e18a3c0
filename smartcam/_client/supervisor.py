"""Make a client's sessions, one after the other, and do the steps between them.

Each client has one task for this, the only task outside of a task group. It makes a session, lets
the receive task read the link to its end, ends all waits, and makes the next session after the
delays of :class:`~smartcam.Backoff`. If the camera is lost again soon after a reconnect, another
client has it: then the task ends or, at an agent, tries again at long intervals. A callback does
the steps after the task's end, since a task that is cancelled before its first step runs no
``finally``.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from smartcam._client.doorbell import wait_ended
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
"""Seconds after Connect within which a lost session counts as taken by another client: the camera
does not report it, so this is a decision of the library."""

FIRST_RETRY_DELAY_OF_TAKEN = 30.0
MAX_RETRY_DELAY_OF_TAKEN = 600.0
"""Shortest and longest time, seconds, until the next try to get a taken camera, if ``on_taken`` is
set: doubled each time that it is taken again. Each try interrupts the other client's session."""


@dataclass(eq=False)
class Supervisor:
    """Makes sessions, and reads the link of each until it ends.

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
        self._first_session: asyncio.Future[SmartCamError | None] | None = None
        self._change_event: asyncio.Event | None = None  # set at a change of the connection
        self._closing = False
        self._closed_error: ConnectionClosedError | None = None  # error for all waits after close()
        self._end_error: SmartCamError | None = None  # why the client ended without a close()
        self._is_finished = False  # whether the task has ended, and all waits with it
        self._reading = False  # whether the task reads a link, and so detects its end
        self.on_taken: Callable[[], None] | None = None
        self._taken_count = 0  # number of losses in a row to another client
        self._take_back_requested = asyncio.Event()
        self._short_session_count = 0  # number of sessions in a row that were lost soon
        # whether a restart of the camera explains an early loss of this session
        self._early_loss_expected = False
        self._restarting_link: Link | None = None  # link over which a restart was requested

    # ------------------------------------------------------------------ for the client

    @property
    def started(self) -> bool:
        """True once the supervisor was started."""
        return self._task is not None

    @property
    def has_ended(self) -> bool:
        """True if there will be no further session."""
        return self._closing or self._end_error is not None

    @property
    def address(self) -> Address:
        """The camera's address, which names the dialect once it was found out."""
        return self._settings.address if self.session is None else self.session.address

    @property
    def connected(self) -> bool:
        """True while there is a session."""
        session = self.session
        return session is not None and not session.link.lost and self._waits.end_reason is None

    def use_settings(self, settings: CameraSettings) -> None:
        """Replace the settings of sessions; only before the supervisor is started."""
        self._settings = settings

    async def open(self) -> None:
        """Start, and wait for the first session.

        Raises:
            ConnectFailedError: no session could be made.
        """
        self._first_session = first_session = asyncio.get_running_loop().create_future()
        self._task = asyncio.create_task(
            self._run(), name=f"smartcam[{self._settings.address.host}].supervisor"
        )
        self._task.add_done_callback(self._on_task_end)
        error = await first_session
        if error is not None:
            raise error

    async def close(self) -> None:
        """End the task and the session, with a Disconnect if there is time. Idempotent, bounded.

        Cancellation: the link is dropped at once.
        """
        task, session = self._task, self.session
        self._closed_error = closed = self._closed_error or self.closed_error()
        self._closing = True
        try:
            if self.connected and self._lock.has_jobs:
                with contextlib.suppress(TimeoutError):  # another task's command may be under way
                    async with asyncio.timeout(self._settings.switch_timeout):
                        await self._lock.wait_for_jobs()
            was_connected = self.connected
            self._dispatch.fail(closed)
            if was_connected and session is not None:
                await session.link.close(self._settings.close_timeout)
        finally:
            self._dispatch.fail(closed)
            self._drop_link()
            if task is not None:
                await wait_ended(task)
            if not self._is_finished:
                self._dispatch.finish(self._end_error or closed)
                self._commands.end_session()

    def abandon(self) -> bool:
        """Drop the link and end the task soon, from any thread, for a client without references.

        Returns:
            True if there was anything to end.
        """
        task = self._task
        if task is None or task.done():
            return False
        self._closing = True
        with contextlib.suppress(RuntimeError):  # a closed loop has closed its links
            task.get_loop().call_soon_threadsafe(self._drop_link)
        return True

    def _drop_link(self) -> None:
        """Send a Disconnect without waiting, drop the link, and end the task."""
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
                    if not self.started or self.has_ended:
                        self._connection.require_link()
                    changed = self._change_event = self._change_event or asyncio.Event()
                    if self.connected:
                        await self._lock.wait_for_jobs()
                    if self.connected:
                        return
                    await changed.wait()
        except TimeoutError as exc:
            last_error = self._counters.last_error or "none yet"
            raise ResponseTimeoutError(
                f"{self._name}: no session within {timeout:g} s; the last error: {last_error}",
                waited=timeout,
            ) from exc

    @property
    def taken(self) -> bool:
        """True if another client has the camera."""
        return isinstance(self._waits.end_reason, ConnectionTakenError)

    def take_back(self) -> None:
        """Try a taken camera again now."""
        if self.taken:
            self._take_back_requested.set()

    def expect_restart(self, link: Link) -> None:
        """Record that a restart was requested: the link will end without a fault."""
        self._restarting_link = link

    def closed_error(self) -> ConnectionClosedError:
        """Return the error of a client that this program has closed or not opened."""
        address = self._settings.address
        state = "closed" if self.started else "not opened yet"
        return ConnectionClosedError(
            f"{self._name}: the connection is {state}", host=address.host, port=address.port
        )

    # ------------------------------------------------------------------ the task

    def _on_task_end(self, task: asyncio.Task[SmartCamError]) -> None:
        """End all waits, since the task has ended and there will be no further session."""
        error = self._end_reason(task)
        self._dispatch.fail(error)
        if self._closing:
            # also after an earlier loss of the session
            error = self._closed_error or self.closed_error()
        else:
            self._end_error = error
        if self.session is not None:
            self.session.link.abort()
        self._counters.end_session()
        self._dispatch.finish(error)
        self._commands.end_session()
        self._is_finished = True
        self._wake_waiters()
        if self._first_session is not None and not self._first_session.done():
            self._first_session.set_result(error)

    def _end_reason(self, task: asyncio.Task[SmartCamError]) -> SmartCamError:
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
            return await self._run_sessions()
        except ENDS_PROGRAM as exc:
            # the receive task has raised the error in the loop; here only clean up
            return self._lost_error(exc)

    async def _run_sessions(self) -> SmartCamError:
        """Make sessions; return the reason why there will be no more."""
        session = await establish(self._settings, self._observers.trace, self._dispatch.layout)
        while True:
            is_reconnect = self.session is not None
            error = await self._run_session(session)
            made_at = session.early_chunks[0].received_at
            restarting, self._restarting_link = self._restarting_link is session.link, None
            if self._closing or self._settings.reconnect is None:
                return error
            keeps_order = session.link.machine.transport is Transport.TCP
            # over UDP the loss is noticed late, by silence
            now = asyncio.get_running_loop().time()
            is_short = (now if keeps_order else session.link.last_byte_at) - made_at < TAKEN_WITHIN
            may_be_taken = session.dialect.exclusive and _may_be_taken(
                error, keeps_order=keeps_order
            )
            if is_reconnect and is_short and not self._early_loss_expected and may_be_taken:
                taken = self._taken_error(error)
                if self.on_taken is None:
                    return taken
                await self._lock.wait_until_free()
                session = await self._retry_taken(taken, self.on_taken)
                continue
            if not is_short:
                self._taken_count = 0
            self._short_session_count = (
                self._short_session_count + 1 if is_reconnect and is_short else 0
            )
            self._early_loss_expected = restarting
            await self._lock.wait_until_free()
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
                    self._adopt_session(session)
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

    def _adopt_session(self, session: Session) -> None:
        is_reconnect = self.session is not None
        self.session = session
        keeps_order = session.link.machine.transport is Transport.TCP
        self._dispatch.begin_session(session.dialect, keeps_order=keeps_order)
        self._commands.begin_session(session.link)
        self._counters.begin_session(session.link.machine.counters)
        event_class = Reconnected if is_reconnect else Connected
        if logger.isEnabledFor(logging.INFO):
            logger.info("%s = connected to %s", self._name, session.address.url)
        if self._listeners.wants_changes:
            url = session.address.url
            self._listeners.publish(event_class(camera=self._name, at=datetime.now(UTC), url=url))
        self._dispatch.dispatch_early(session.early_chunks)
        if self._first_session is not None and not self._first_session.done():
            self._first_session.set_result(None)
        self._wake_waiters()

    async def _receive(self, link: Link) -> ConnectionLostError:
        """Dispatch each chunk until the link ends; return the reason of its end."""
        while True:
            try:
                chunk = await link.receive()
            except ConnectionLostError as error:
                return error.with_traceback(None)  # else it would refer to this task's stack
            if self._listeners.has_subscribers:
                link.wake_after_subscribers()
            self._dispatch.dispatch(chunk)
            del chunk  # free it, since the next chunk may come much later

    def _report_loss(self, link: Link, error: ConnectionLostError) -> None:
        """End all waits, since a link has ended; all its events are dispatched."""
        restarting = self._restarting_link is link
        expected = self._closing or restarting
        reason = "the camera restarts" if restarting else str(error.__cause__)
        reason = "closed by this side" if self._closing else reason
        if not expected:
            logger.warning("! %s", error)
            self._counters.note_loss(error)
            self._observers.error(self._name, error)
        self._dispatch.fail(error)
        if self._listeners.wants_changes:
            at = datetime.now(UTC)
            event = Disconnected(camera=self._name, at=at, reason=reason, expected=expected)
            self._listeners.publish(event)
        self._wake_waiters()

    async def _retry_taken(
        self, taken: ConnectionTakenError, notify: Callable[[], None]
    ) -> Session:
        """Make a new session after a long pause, or as soon as :meth:`take_back` is called.

        Raises:
            SmartCamError: the client gave up.
        """
        pause = self._pause_of_taken
        self._waits.end_reason = taken
        self._taken_count += 1
        self._take_back_requested.clear()
        notify()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(pause):
                await self._take_back_requested.wait()
        # a camera that does not answer now serves no client: it is treated like a lost one
        return await self._reconnect(taken, at_once=True)

    async def _reconnect(self, loss: LinkError, *, at_once: bool = False) -> Session:
        """Try to make a new session until the policy gives up; ``at_once``: without a first pause.

        Raises:
            SmartCamError: the client gave up.
        """
        policy, name = self._settings.reconnect, self._name
        settings = replace(self._settings, address=self.address)
        last_error: SmartCamError = loss
        if policy is not None:
            delays = policy.delays(short_lived=self._short_session_count)
            for try_number, delay in enumerate(itertools.chain([0.0] * at_once, delays), 1):
                await asyncio.sleep(delay)
                try:
                    return await establish(settings, self._observers.trace, self._dispatch.layout)
                except SmartCamError as exc:
                    last_error = exc
                level = logging.WARNING if try_number == 1 else logging.DEBUG
                logger.log(level, "%s ! reconnect %d: %s", name, try_number, last_error)
                self._counters.note_loss(last_error)
                self._observers.error(name, last_error)
                if not policy.transient(last_error):
                    break
        raise ConnectionLostError(
            f"{loss}; given up after that: {last_error}",
            host=settings.address.host,
            port=settings.address.port,
        ) from last_error

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
        doubled = min(self._taken_count, 16)  # a larger power is far beyond the longest pause
        return min(FIRST_RETRY_DELAY_OF_TAKEN * 2.0**doubled, MAX_RETRY_DELAY_OF_TAKEN)

    def _wake_waiters(self) -> None:
        """Wake the tasks that wait for a change of the connection."""
        changed, self._change_event = self._change_event, None
        if changed is not None:
            changed.set()


def _may_be_taken(error: ConnectionLostError, *, keeps_order: bool) -> bool:
    """Return True if another client may have caused the loss.

    On TCP the camera closes the connection of the earlier client, so only a closed connection
    counts. Over UDP the camera falls silent. Bytes that break the protocol, a fault of this
    program, and an unreachable network or port never count.
    """
    cause = error.__cause__
    if isinstance(cause, ConnectionRefusedError):
        return False
    return isinstance(cause, ConnectionError if keeps_order else (ConnectionError, TimeoutError))
