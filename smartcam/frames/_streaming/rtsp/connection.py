"""A client's connection: its requests in order, and its sessions."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from typing import TYPE_CHECKING, Final, Protocol

from smartcam.frames._streaming.rtsp.authentication import PasswordCheck
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
    cseq_of,
    encode_answer,
)
from smartcam.frames._streaming.rtsp.requests import execute_request

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
"""Largest number of bytes that wait to be sent, before the client plays and while it plays."""


class ConnectionOwner(Protocol):
    """The server's interface for its connections."""

    authentication: Authentication
    sdp_session: int

    def register(self, connection: RtspConnection, peer: object) -> str:
        """Register a new connection; return the reason if there are too many, else ""."""
        ...

    def unregister(self, connection: RtspConnection) -> None:
        """Remove a connection that is closed."""
        ...

    def mark_served(self, connection: RtspConnection) -> None:
        """Mark a connection as the most recently served one: others are closed first for room."""
        ...

    def on_last_session_end(self, connection: RtspConnection) -> None:
        """Start the time limit of a connection that has no session any more."""
        ...

    def stream(self, name: str) -> RtspStream:
        """Return a stream, or raise RtspError."""
        ...

    def add_viewer(self, session: RtspSession, peer: str) -> None:
        """Count a viewer, or raise RtspError if there are too many."""
        ...

    def remove_viewer(self, session: RtspSession, peer: str) -> None:
        """Remove a viewer from the count."""
        ...


class RtspConnection(asyncio.Protocol):
    """Read and answer requests; end the sessions when the connection ends.

    A task answers one request at a time. While it does, about one further message is read.
    """

    transport: asyncio.Transport

    def __init__(self, owner: ConnectionOwner) -> None:
        self.owner = owner
        self.password_check = PasswordCheck(owner.authentication)
        self.sessions: dict[str, RtspSession] = {}
        self.address: tuple[str | int, ...] = ()
        self.peer: tuple[str | int, ...] = ()
        self._parser = RequestParser()
        self._data_arrived, self._is_lost = asyncio.Event(), asyncio.Event()
        self._is_serving = False  # whether an authorized request is being answered
        self._stray_packets = 0
        self._is_closing = False
        self._is_reading = True
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
        refusal = self.owner.register(self, peer) if peer and address else "its address is unknown"
        if refusal:
            _log.info("= %s: connection closed: %s", peer, refusal)
            transport.write(encode_answer(503, "", (), b"too many connections\n"))
            self.close()
            return
        self.peer, self.address = tuple(peer), tuple(address)
        self.task = asyncio.get_running_loop().create_task(
            self._process_messages(), name="smartcam.rtsp"
        )
        self.task.add_done_callback(self._on_task_done)

    def _on_task_done(self, _: asyncio.Task[None]) -> None:
        self.close()  # the task may not have started
        self.owner.unregister(self)

    def data_received(self, data: bytes) -> None:
        """Store bytes; pause reading if the task is too slow."""
        if self._is_closing:
            return
        self._parser.feed(data)
        self._data_arrived.set()
        if self._is_reading and self._parser.unparsed_bytes > MAX_MESSAGE_BYTES:
            self._is_reading = False
            self.transport.pause_reading()

    def eof_received(self) -> None:
        """Let asyncio close the connection, since the client cannot keep a session alive."""

    def connection_lost(self, exc: Exception | None) -> None:
        """End the task and the sessions."""
        self._is_closing = True
        self._is_lost.set()
        self._end_sessions("")
        if self._abort_timer is not None:
            self._abort_timer.cancel()
        if self.task is not None:
            self.task.cancel()

    # called by the server

    def close(self, reason: str = "") -> None:
        """Close the connection when all bytes are sent, or after a short time. Idempotent."""
        self._end_sessions(reason)
        if self._is_closing:
            return
        self._is_closing = True
        self.transport.close()
        loop = asyncio.get_running_loop()
        self._abort_timer = loop.call_later(CLOSE_TIMEOUT, self.transport.abort)

    def abort(self) -> None:
        """Abort the connection."""
        self._is_closing = True
        self.transport.abort()

    @property
    def keeps_place(self) -> bool:
        """True if the connection has a session, or is being served."""
        return bool(self.sessions) or self._is_serving

    def close_for(self, why: str) -> None:
        """Abort the connection to make room for another, or since it opened no session in time."""
        _log.info("= %s: connection closed: %s", self.peer, why)
        self.abort()

    @contextlib.contextmanager
    def mark_serving(self) -> Iterator[None]:
        """Mark an authorized request as being answered during the block."""
        self._is_serving = True
        try:
            yield
        finally:
            self._is_serving = False
            self.owner.mark_served(self)

    def on_session_end(self, session: RtspSession, reason: str) -> None:
        """Remove an ended session, and close the connection after the last session.

        Args:
            session: session that ended by itself.
            reason: reason of the end; "": the client accepts no data, so the connection is aborted.
        """
        self.remove_session(session)
        if not reason:
            self.abort()
        elif not self.sessions:
            self.close()

    def remove_session(self, session: RtspSession) -> None:
        """Remove a closed session."""
        if self.sessions.pop(session.id, None) is not None:
            self.owner.remove_viewer(session, str(self.peer[0]))
            if not self.sessions:
                self.owner.on_last_session_end(self)

    def used_channels(self) -> Iterator[int]:
        """Yield the channels that the sessions use."""
        for session in self.sessions.values():
            if isinstance(session.delivery, ChannelDelivery):
                yield from session.delivery.channels

    def _end_sessions(self, reason: str) -> None:
        for session in list(self.sessions.values()):
            session.close(reason)
            self.remove_session(session)

    # the task

    async def _process_messages(self) -> None:
        try:
            while True:
                message = await self._next_message()
                if isinstance(message, RtspRequest):
                    await self._answer_request(message)
                elif not self._on_channel_data(message):
                    break
                await asyncio.sleep(0)  # let other tasks run
        except RtspError as error:
            self._send_error(error, "")
        except Exception:  # noqa: BLE001 - one connection only
            _log.exception("! RTSP: a connection failed")
        finally:
            self.close()
        await self._is_lost.wait()

    async def _next_message(self) -> RtspRequest | ChannelData:
        """Return the next message.

        Raises:
            RtspError: no complete request came in time.
        """
        now = asyncio.get_running_loop().time
        incomplete_since: float | None = None
        while (message := self._parser.next()) is None:
            if not self._parser.has_partial_message:
                incomplete_since = None
            elif incomplete_since is None:
                incomplete_since = now()
            deadline = None if incomplete_since is None else incomplete_since + REQUEST_TIMEOUT
            if not await self._wait_for_data(deadline):
                text = f"expected a whole request within {REQUEST_TIMEOUT:g} s"
                raise RtspError(408, text, fatal=True)
        return message

    async def _wait_for_data(self, deadline: float | None) -> bool:
        """Wait for bytes; return False if none came in time."""
        if not self._is_reading and not self._is_closing:
            self._is_reading = True
            self.transport.resume_reading()
        self._data_arrived.clear()
        try:
            async with asyncio.timeout_at(deadline):
                await self._data_arrived.wait()
        except TimeoutError:
            return False
        return True

    def _on_channel_data(self, packet: ChannelData) -> bool:
        """Process RTCP; return False after too many packets without a session."""
        for session in self.sessions.values():
            delivery = session.delivery
            if isinstance(delivery, ChannelDelivery) and packet.channel == delivery.channels[1]:
                session.take_rtcp(packet.data)
        self._stray_packets += not self.sessions
        return self._stray_packets <= MAX_STRAY_PACKETS

    async def _answer_request(self, request: RtspRequest) -> None:
        cseq = ""
        try:
            cseq = cseq_of(request)
            answer = await execute_request(self, request)
        except RtspError as error:
            self._send_error(error, cseq)
            return
        self._write(encode_answer(200, cseq, answer.headers, answer.body))

    def _send_error(self, error: RtspError, cseq: str) -> None:
        body = f"{error.text}\n".encode()
        headers = (*error.headers, ("Content-Type", "text/plain; charset=utf-8"))
        if error.fatal:
            headers = (*headers, ("Connection", "close"))
        self._write(encode_answer(error.status, cseq, headers, body))
        if error.fatal:
            self.close()

    def _write(self, data: bytes) -> None:
        if self._is_closing:
            return
        self.transport.write(data)
        is_playing = any(session.is_playing for session in self.sessions.values())
        limit = MAX_PLAYING_BYTES if is_playing else MAX_ANSWER_BYTES
        if self.transport.get_write_buffer_size() > limit:
            self.abort()
