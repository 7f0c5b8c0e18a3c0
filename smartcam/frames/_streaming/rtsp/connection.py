"""A client's connection: its requests in order, and its sessions."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from typing import TYPE_CHECKING, Final, Protocol

from smartcam.frames._streaming.rtsp.authentication import PasswordGate
from smartcam.frames._streaming.rtsp.delivery import (
    MAX_WAITING_BYTES,
    SEND_BUFFER_BYTES,
    ChannelDelivery,
)
from smartcam.frames._streaming.rtsp.messages import (
    MAX_MESSAGE_BYTES,
    ChannelData,
    RequestParser,
    RtspError,
    RtspRequest,
    answer,
    cseq_of,
)
from smartcam.frames._streaming.rtsp.requests import answer_to

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.frames._streaming.rtsp.authentication import Authentication
    from smartcam.frames._streaming.rtsp.session import RtspSession
    from smartcam.frames._streaming.rtsp.streams import RtspStream


_log = logging.getLogger(__name__)

REQUEST_TIMEOUT: Final = 10.0
"""Seconds for receiving a request that has begun."""

IDLE_TIMEOUT: Final = 60.0
"""Seconds that a connection may stay open without a session, even if requests come."""

MAX_STRAY_PACKETS: Final = 64
"""Largest number of packets accepted without a session, such as RTCP after a TEARDOWN."""

CLOSE_TIMEOUT: Final = 1.0
"""Seconds for sending the last bytes before a connection is aborted."""

MAX_ANSWER_BYTES, MAX_PLAYING_BYTES = 64 << 10, 4 * MAX_WAITING_BYTES
"""Largest number of bytes that wait for a client, before it plays and while it plays."""


class ConnectionOwner(Protocol):
    """The server's interface for its connections."""

    authentication: Authentication
    number: int

    def enter(self, connection: RtspConnection, peer: object) -> str:
        """Register a new connection; return the reason if there are too many, else ""."""
        ...

    def leave(self, connection: RtspConnection) -> None:
        """Forget a connection that is closed."""
        ...

    def served(self, connection: RtspConnection) -> None:
        """Mark a connection as the most recently served, which makes room last."""
        ...

    def last_session_ended(self, connection: RtspConnection) -> None:
        """Note that a connection has no session any more."""
        ...

    def stream(self, name: str) -> RtspStream:
        """Return a stream, or raise RtspError."""
        ...

    def admit(self, session: RtspSession, peer: str) -> None:
        """Count a viewer, or raise RtspError."""
        ...

    def dismiss(self, session: RtspSession, peer: str) -> None:
        """Remove a viewer from the count."""
        ...


class RtspConnection(asyncio.Protocol):
    """Read requests, answer them, and end the sessions at the end.

    A task answers one request at a time; meanwhile at most the bytes of one message are read.
    """

    transport: asyncio.Transport

    def __init__(self, owner: ConnectionOwner) -> None:
        self.owner = owner
        self.gate = PasswordGate(owner.authentication)
        self.sessions: dict[str, RtspSession] = {}
        self.address: tuple[str | int, ...] = ()
        self.peer: tuple[str | int, ...] = ()
        self._parser = RequestParser()
        self._arrived, self._lost = asyncio.Event(), asyncio.Event()
        self._serving = False  # an authorized request is being answered
        self._strays = 0
        self._closing = False
        self._reading = True
        self._abort_timer: asyncio.TimerHandle | None = None
        self.task: asyncio.Task[None] | None = None

    # asyncio

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Start the connection, or refuse it."""
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 - of a socket
        self.transport = transport
        peer, address = (transport.get_extra_info(name) for name in ("peername", "sockname"))
        sock = transport.get_extra_info("socket")
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        refusal = self.owner.enter(self, peer) if peer and address else "its address is unknown"
        if refusal:
            _log.info("= %s: connection closed: %s", peer, refusal)
            transport.write(answer(503, "", (), b"too many connections\n"))
            self.close()
            return
        self.peer, self.address = tuple(peer), tuple(address)
        self.task = asyncio.get_running_loop().create_task(self._run(), name="smartcam.rtsp")
        self.task.add_done_callback(self._task_ended)

    def _task_ended(self, _: asyncio.Task[None]) -> None:
        self.close()  # the task may not have started
        self.owner.leave(self)

    def data_received(self, data: bytes) -> None:
        """Store bytes; pause reading if the task is too slow."""
        if self._closing:
            return
        self._parser.feed(data)
        self._arrived.set()
        if self._reading and self._parser.waiting > MAX_MESSAGE_BYTES:
            self._reading = False
            self.transport.pause_reading()

    def eof_received(self) -> None:
        """Let asyncio close the connection, since the client cannot keep a session alive."""

    def connection_lost(self, exc: Exception | None) -> None:
        """End the task and the sessions."""
        self._closing = True
        self._lost.set()
        self._end_sessions("")
        if self._abort_timer is not None:
            self._abort_timer.cancel()
        if self.task is not None:
            self.task.cancel()

    # called by the server

    def close(self, why: str = "") -> None:
        """Close the connection when all bytes are sent, or after a short time. Idempotent."""
        self._end_sessions(why)
        if self._closing:
            return
        self._closing = True
        self.transport.close()
        loop = asyncio.get_running_loop()
        self._abort_timer = loop.call_later(CLOSE_TIMEOUT, self.transport.abort)

    def abort(self) -> None:
        """Abort the connection."""
        self._closing = True
        self.transport.abort()

    @property
    def settled(self) -> bool:
        """True if the connection has a session, or is being served."""
        return bool(self.sessions) or self._serving

    def turn_away(self, why: str) -> None:
        """Abort the connection to make room, or since it has no session in time."""
        _log.info("= %s: connection closed: %s", self.peer, why)
        self.abort()

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """Mark an authorized request as being answered during the block."""
        self._serving = True
        try:
            yield
        finally:
            self._serving = False
            self.owner.served(self)

    def session_ended(self, session: RtspSession, why: str) -> None:
        """Remove an ended session, and close the connection with the last session.

        If the client accepts no data, the connection is aborted.
        """
        self.forget(session)
        if not why:
            self.abort()
        elif not self.sessions:
            self.close()

    def forget(self, session: RtspSession) -> None:
        """Remove a closed session."""
        if self.sessions.pop(session.id, None) is not None:
            self.owner.dismiss(session, str(self.peer[0]))
            if not self.sessions:
                self.owner.last_session_ended(self)

    def channels(self) -> Iterator[int]:
        """Yield the channels in use."""
        for session in self.sessions.values():
            if isinstance(session.delivery, ChannelDelivery):
                yield from session.delivery.channels

    def _end_sessions(self, why: str) -> None:
        for session in list(self.sessions.values()):
            session.close(why)
            self.forget(session)

    # the task

    async def _run(self) -> None:
        try:
            while True:
                message = await self._next()
                if isinstance(message, RtspRequest):
                    await self._answer(message)
                elif not self._take(message):
                    break
                await asyncio.sleep(0)  # let other tasks run
        except RtspError as refusal:
            self._refuse(refusal, "")
        except Exception:  # noqa: BLE001 - one connection only
            _log.exception("! RTSP: a connection failed")
        finally:
            self.close()
        await self._lost.wait()

    async def _next(self) -> RtspRequest | ChannelData:
        """Return the next message.

        Raises:
            RtspError: no complete request came in time.
        """
        now = asyncio.get_running_loop().time
        half_since: float | None = None
        while (message := self._parser.next()) is None:
            if not self._parser.in_midst:
                half_since = None
            elif half_since is None:
                half_since = now()
            if not await self._more(None if half_since is None else half_since + REQUEST_TIMEOUT):
                text = f"expected a whole request within {REQUEST_TIMEOUT:g} s"
                raise RtspError(408, text, fatal=True)
        return message

    async def _more(self, end: float | None) -> bool:
        """Wait for bytes; return whether they came in time."""
        if not self._reading and not self._closing:
            self._reading = True
            self.transport.resume_reading()
        self._arrived.clear()
        try:
            async with asyncio.timeout_at(end):
                await self._arrived.wait()
        except TimeoutError:
            return False
        return True

    def _take(self, packet: ChannelData) -> bool:
        """Process RTCP; return False after too many packets without a session."""
        for session in self.sessions.values():
            delivery = session.delivery
            if isinstance(delivery, ChannelDelivery) and packet.channel == delivery.channels[1]:
                session.take_rtcp(packet.data)
        self._strays += not self.sessions
        return self._strays <= MAX_STRAY_PACKETS

    async def _answer(self, request: RtspRequest) -> None:
        cseq = ""
        try:
            cseq = cseq_of(request)
            made = await answer_to(self, request)
        except RtspError as refusal:
            self._refuse(refusal, cseq)
            return
        self._write(answer(200, cseq, made.headers, made.body))

    def _refuse(self, refusal: RtspError, cseq: str) -> None:
        body = f"{refusal.text}\n".encode()
        headers = (*refusal.headers, ("Content-Type", "text/plain; charset=utf-8"))
        if refusal.fatal:
            headers = (*headers, ("Connection", "close"))
        self._write(answer(refusal.status, cseq, headers, body))
        if refusal.fatal:
            self.close()

    def _write(self, data: bytes) -> None:
        if self._closing:
            return
        self.transport.write(data)
        playing = any(session.playing for session in self.sessions.values())
        most = MAX_PLAYING_BYTES if playing else MAX_ANSWER_BYTES
        if self.transport.get_write_buffer_size() > most:
            self.abort()
