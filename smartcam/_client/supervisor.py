"""The life of a client: sessions, one after the other, and what happens between them.

One task per client, its only bare ``create_task``. It makes a session, has the receive
task read its link to the end, tells everybody that it is over, and by the
:class:`~smartcam.Backoff` makes the next. When the camera was lost again soon after a
reconnect another client has it: then it stops.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from smartcam._client.handshake import Session, establish
from smartcam.exceptions import (
    ConnectionClosedError,
    ConnectionLostError,
    ConnectionTakenError,
    ResponseTimeoutError,
    SmartCamError,
)
from smartcam.models import Connected, Disconnected, Reconnected
from smartcam.protocols._base import Transport

if TYPE_CHECKING:
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
"""Seconds: a session that is lost again within this time of its Connect was taken by another
client (a decision of this library; the camera does not say so)."""


@dataclass(eq=False)
class Supervisor:
    """Makes sessions and reads them.

    Attributes:
        session: the last session that was made, None before the first.
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
        self._task: asyncio.Task[None] | None = None
        self._opened: asyncio.Future[SmartCamError | None] | None = None
        self._changed = asyncio.Event()
        self._closing = False
        self._ended_by: SmartCamError | None = None  # why there is no more session, if not by us
        self._reading = False  # a link, whose end it notices by itself
        self._short_lived = 0  # sessions in a row that were lost soon
        self._excused = False  # an early loss of this session is no other client's doing
        self._restarting: Link | None = None  # the camera was told to restart over this link

    # ------------------------------------------------------------------ for the client

    @property
    def started(self) -> bool:
        """Whether it was ever started."""
        return self._task is not None

    @property
    def over(self) -> bool:
        """Whether there will be no session any more."""
        return self._closing or self._ended_by is not None

    @property
    def address(self) -> Address:
        """The camera's address, with the dialect pinned once it was found out."""
        return self._settings.address if self.session is None else self.session.address

    @property
    def connected(self) -> bool:
        """Whether there is a session."""
        session = self.session
        return session is not None and not session.link.lost and self._waits.end is None

    async def open(self) -> None:
        """Start, and wait for the first session.

        Raises:
            ConnectFailedError: there was none.
        """
        self._opened = asyncio.get_running_loop().create_future()
        self._task = asyncio.create_task(
            self._run(), name=f"smartcam[{self._settings.address.host}].supervisor"
        )
        await asyncio.wait({self._opened})
        error = self._opened.result()
        if error is not None:
            raise error

    async def close(self) -> None:
        """End the session, in order if there is time, and the task. Idempotent, bounded.

        Cancellation: the link is dropped at once.
        """
        task, session = self._task, self.session
        self._closing = True
        try:
            if self.connected:
                with contextlib.suppress(TimeoutError):  # another's command may be in between
                    async with asyncio.timeout(self._settings.switch_timeout):
                        await self._lock.settle()
            linked = self.connected
            self._dispatch.fail(self.closed_error())
            if linked and session is not None:
                await session.link.close(self._settings.close_timeout)
        finally:
            self._dispatch.fail(self.closed_error())
            if session is not None:
                session.link.give_up(ConnectionAbortedError("closed by this side"))
            if task is not None:
                if not self._reading:
                    task.cancel()
                await asyncio.wait({task})
            self._dispatch.finish(self._ended_by or self.closed_error())
            self._commands.end_session()

    async def wait_connected(self, deadline: float, timeout: float) -> None:
        """Wait until there is a session, and what had to be restored in it is.

        Raises:
            LinkError: there will be none.
            ResponseTimeoutError: at ``deadline`` (loop time).
        """
        try:
            async with asyncio.timeout_at(deadline):
                while True:
                    if not self.started or self.over:
                        self._connection.require_link()
                    changed = self._changed
                    if self.connected:
                        await self._lock.settle()
                    if self.connected:
                        return
                    await changed.wait()
        except TimeoutError as exc:
            why = self._counters.last_error or "there was none yet"
            raise ResponseTimeoutError(
                f"{self._name}: no session within {timeout:g} s; the last one: {why}",
                waited=timeout,
            ) from exc

    def restarts(self, link: Link) -> None:
        """The camera was told to restart over this link: it ends, and that is no fault."""
        self._restarting = link

    def closed_error(self) -> ConnectionClosedError:
        """Return the error of a client that has no session by our own will."""
        address = self._settings.address
        state = "closed" if self.started else "not opened yet"
        return ConnectionClosedError(
            f"{self._name}: the connection is {state}", host=address.host, port=address.port
        )

    # ------------------------------------------------------------------ the task

    async def _run(self) -> None:
        """Make sessions until one ends for good; then tell everybody."""
        error: SmartCamError = self.closed_error()
        try:
            error = await self._live()
        except SmartCamError as exc:
            error = exc
        except Exception as exc:  # nobody must wait for a dead supervisor
            logger.exception("%s ! the supervisor failed", self._name)
            cause = exc.exceptions[0] if isinstance(exc, ExceptionGroup) else exc
            error = ConnectionLostError(f"{self._name}: {cause!r} in the client")
            error.__cause__ = cause
        finally:
            self._dispatch.fail(error)
            if self._closing:
                error = self.closed_error()  # whatever it was before
            else:
                self._ended_by = error
            if self.session is not None:
                self.session.link.abort()
            self._counters.end()
            self._dispatch.finish(error)
            self._commands.end_session()
            self._tell()
            if self._opened is not None and not self._opened.done():
                self._opened.set_result(error)

    async def _live(self) -> SmartCamError:
        """Have sessions; return why there will be no more."""
        session = await establish(self._settings, self._observers.trace)
        while True:
            again = self.session is not None
            error = await self._have(session)
            made_at = session.early[0].received_at
            restarting, self._restarting = self._restarting is session.link, None
            if self._closing or self._settings.reconnect is None:
                return error
            silence = _silence(error, self._settings.liveness_timeout)
            short = asyncio.get_running_loop().time() - silence - made_at < TAKEN_WITHIN
            ordered = session.link.machine.transport is Transport.TCP
            takes = session.dialect.exclusive and _may_be_taken(error, ordered=ordered)
            if again and short and not self._excused and takes:
                return self._taken(error)
            self._short_lived = self._short_lived + 1 if again and short else 0
            self._excused = restarting
            await self._lock.vacated()
            session = await self._reconnect(error)

    async def _have(self, session: Session) -> ConnectionLostError:
        """Have one session until its link ends; return why it did."""
        settings, link = self._settings, session.link
        error: ConnectionLostError
        self._reading = True
        try:
            restore = settings.restore and self.session is not None
            async with self._lock.session(restore=restore) as tasks:
                self._adopt(session)
                with self._keepalive.watched(link):
                    name = f"smartcam[{self._name}].receive"
                    error = await tasks.create_task(self._receive(link), name=name)
                self._tell_of_loss(link, error)  # ends the jobs' waits too
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
        logger.info("%s = connected to %s", self._name, session.address.url)
        kind = Reconnected if again else Connected
        event = kind(camera=self._name, at=datetime.now(UTC), url=session.address.url)
        self._listeners.publish(event)
        self._dispatch.dispatch_early(session.early)
        if self._opened is not None and not self._opened.done():
            self._opened.set_result(None)
        self._tell()

    async def _receive(self, link: Link) -> ConnectionLostError:
        """The receive task: have each chunk dispatched until the link ends; return why it did."""
        while True:
            try:
                chunk = await link.receive()
            except ConnectionLostError as error:
                return error
            self._dispatch.dispatch(chunk)
            del chunk  # the next one may take its time

    def _tell_of_loss(self, link: Link, error: ConnectionLostError) -> None:
        """Tell everybody that a link has ended; what came before is dispatched."""
        restarting = self._restarting is link
        expected = self._closing or restarting
        reason = "the camera restarts" if restarting else str(error.__cause__)
        reason = "closed by this side" if self._closing else reason
        if not expected:
            logger.warning("! %s", error)
            self._counters.note_loss(error)
            self._observers.error(self._name, error)
        self._dispatch.fail(error)
        self._listeners.publish(
            Disconnected(camera=self._name, at=datetime.now(UTC), reason=reason, expected=expected)
        )
        self._tell()

    async def _reconnect(self, loss: ConnectionLostError) -> Session:
        """Make a new session, as often as the policy says.

        Raises:
            SmartCamError: it was given up.
        """
        policy, name = self._settings.reconnect, self._name
        settings = self._settings.model_copy(update={"address": self.address})
        failed: SmartCamError = loss
        if policy is not None:
            for tried, delay in enumerate(policy.delays(short_lived=self._short_lived), 1):
                await asyncio.sleep(delay)
                try:
                    return await establish(settings, self._observers.trace)
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

    def _taken(self, error: ConnectionLostError) -> ConnectionTakenError:
        address = self.address
        taken = ConnectionTakenError(
            f"{self._name}: lost again right after a reconnect: another client has the "
            f"camera, which serves one; stopped, so as not to fight for it ({error})",
            host=address.host,
            port=address.port,
        )
        taken.__cause__ = error.__cause__
        logger.warning("! %s", taken)
        self._counters.note_loss(taken)
        self._observers.error(self._name, taken)
        return taken

    def _tell(self) -> None:
        """Wake who waits for a change of the connection."""
        self._changed.set()
        self._changed = asyncio.Event()


def _silence(error: ConnectionLostError, liveness_timeout: float | None) -> float:
    """Return the seconds since a link was lost when it is noticed: only silence may tell."""
    cause = error.__cause__
    if isinstance(cause, ResponseTimeoutError) or not isinstance(cause, TimeoutError):
        return 0.0
    return liveness_timeout or 0.0


def _may_be_taken(error: ConnectionLostError, *, ordered: bool) -> bool:
    """Whether it may be another client's doing.

    A broken frame and a fault of ours are not, nor, on TCP, is an answer that came too late for us.
    """
    cause = error.__cause__
    return isinstance(cause, OSError) and not (ordered and isinstance(cause, ResponseTimeoutError))
