"""An RTSP connection: requests, answers, and packets between them."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING, Any, Final

from smartcam.exceptions import FrameSourceError, MessageError
from smartcam.frames._streaming.rtsp_client.answers import (
    AnswerParser,
    ChannelPacket,
    ServerAnswer,
    ServerRequest,
)
from smartcam.frames._streaming.rtsp_client.authorization import challenge_of

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable

    from smartcam.frames._streaming.rtsp_client.authorization import Credentials


MAX_UNSENT_BYTES: Final = 64 << 10
"""Largest number of bytes that wait for a server; more, such as reports, are dropped."""

MAX_REFUSALS: Final = 3
"""Largest number of refusals of one request's authorization, such as for an old nonce."""

MAX_UNANSWERED: Final = 32
"""Largest number of unanswered requests that are kept, since answers may be late."""

_ANSWERED_METHODS: Final = ("GET_PARAMETER", "OPTIONS", "SET_PARAMETER")
_ENDING_METHODS: Final = ("REDIRECT", "TEARDOWN")


class RtspLink(asyncio.Protocol):
    """A connection to a server: it sends one request at a time, and passes packets on.

    Args:
        name: name of the source, for errors.
        credentials: user and password.

    Attributes:
        on_packet: function that is called with a channel and a packet.
        on_batch_read: function that is called after each batch of packets.
        on_end: function that is called once with the reason of the end.
    """

    def __init__(self, name: str, credentials: Credentials) -> None:
        self.name, self._credentials = name, credentials
        self.on_packet: Callable[[int, bytes], None] = _ignore
        self.on_batch_read: Callable[[], None] = _ignore
        self.on_end: Callable[[str], None] = _ignore
        self.end_reason = ""  # why the link ended; "": it has not ended
        self._parser = AnswerParser()
        self._transport: asyncio.Transport | None = None
        self._cseq = 0
        self._pending_answer: tuple[int, asyncio.Future[ServerAnswer]] | None = None
        self._unanswered: list[int] = []
        self._request_lock = asyncio.Lock()

    @classmethod
    async def connect(
        cls,
        name: str,
        host_and_port: tuple[str, int],
        credentials: Credentials,
        tls: ssl.SSLContext | None,
    ) -> RtspLink:
        """Return a connection to a host and port.

        Raises:
            OSError: there is no connection.
        """
        loop = asyncio.get_running_loop()
        _, link = await loop.create_connection(
            lambda: cls(name, credentials),
            *host_and_port,
            ssl=tls,
            server_hostname=host_and_port[0] if tls else None,
        )
        return link

    @property
    def peer(self) -> tuple[Any, ...]:
        """The server's address."""
        return tuple(self._socket_info("peername"))

    @property
    def address(self) -> tuple[Any, ...]:
        """The local address."""
        return tuple(self._socket_info("sockname"))

    @property
    def family(self) -> socket.AddressFamily:
        """The family of the addresses."""
        return socket.AF_INET6 if ":" in str(self.peer[0]) else socket.AF_INET

    def fail(self, reason: str) -> None:
        """End the link with a reason for :attr:`on_end`."""
        self._end(reason)

    def _socket_info(self, name: str) -> Any:
        value = None if self._transport is None else self._transport.get_extra_info(name)
        if not value:
            raise self._error(self.end_reason or "the connection is lost")
        return value

    async def ask(
        self, method: str, url: str, headers: dict[str, str] | None = None, body: bytes = b""
    ) -> ServerAnswer:
        """Send a request, and return its answer; send the password if the server asks for it.

        Raises:
            FrameSourceError: the connection ended, or the password is wrong or missing.
        """
        async with self._request_lock:
            for refusals in range(1, MAX_REFUSALS + 1):
                answer = await self._ask_once(method, url, headers or {}, body)
                if answer.status != 401:
                    return answer
                challenges = answer.headers.get("www-authenticate", ())
                if refusals == MAX_REFUSALS or not self._credentials.store_challenge(challenges):
                    raise self._refused_error(method, answer)
            raise AssertionError("MAX_REFUSALS is at least 1")

    def _refused_error(self, method: str, answer: ServerAnswer) -> FrameSourceError:
        challenges = answer.headers.get("www-authenticate", ())
        shown = ", ".join(challenges)[:200] or "no challenge"
        hint = f"expected Basic, or Digest with MD5 or SHA-256, got {shown!r}"
        if not self._credentials.has_user:
            hint = "put USER:PASSWORD@ before the host"
        elif challenge_of(challenges) is not None:
            hint = "wrong user or password"
        return self._error(f"{method}: 401 Unauthorized: {hint}")

    async def _ask_once(
        self, method: str, url: str, headers: dict[str, str], body: bytes
    ) -> ServerAnswer:
        self._cseq += 1
        lines = [f"{method} {url} RTSP/1.0", f"CSeq: {self._cseq}", "User-Agent: smartcam"]
        authorization = self._credentials.header(method, url)
        lines += [f"Authorization: {authorization}"] if authorization else []
        lines += (f"{name}: {value}" for name, value in headers.items())
        future: asyncio.Future[ServerAnswer] = asyncio.get_running_loop().create_future()
        self._pending_answer = (self._cseq, future)
        try:
            if not self.write("\r\n".join((*lines, "", "")).encode() + body):
                raise self._error(self.end_reason or "the server accepts no more data")
            return await future
        finally:
            if self._pending_answer is not None and not future.done():
                self._unanswered = [
                    *self._unanswered[1 - MAX_UNANSWERED :],
                    self._pending_answer[0],
                ]
            self._pending_answer = None

    def write(self, data: bytes) -> bool:
        """Send bytes; return False if too many wait, or the link has ended."""
        transport = self._transport
        if transport is None or transport.is_closing():
            return False
        if transport.get_write_buffer_size() > MAX_UNSENT_BYTES:
            return False
        transport.write(data)
        return True

    def close(self) -> None:
        """End the link after the written bytes are sent; stop passing on packets. Idempotent."""
        self.on_packet, self.on_batch_read, self.on_end = _ignore, _ignore, _ignore
        self._end("it was closed")

    def abort(self) -> None:
        """Abort the link. Idempotent."""
        self.close()
        if self._transport is not None:
            self._transport.abort()

    # asyncio

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the transport."""
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 - of a socket
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Parse bytes, and process complete messages."""
        if self.end_reason:
            return
        self._parser.feed(data)
        try:
            while not self.end_reason and (item := self._parser.next()) is not None:
                self._on_message(item)
        except MessageError as error:
            self._end(str(error))
        self.on_batch_read()

    def connection_lost(self, exc: Exception | None) -> None:
        """Fail all calls that wait for an answer."""
        reason = getattr(exc, "strerror", None) if exc is not None else None
        lost = f"the connection is lost: {reason}"
        self._end(lost if reason else "the server closed the connection")

    # received messages

    def _on_message(self, item: ServerAnswer | ServerRequest | ChannelPacket) -> None:
        if isinstance(item, ChannelPacket):
            self.on_packet(item.channel, item.data)
        elif isinstance(item, ServerAnswer):
            self._on_answer(item)
        else:
            self._on_request(item)

    def _on_answer(self, answer: ServerAnswer) -> None:
        """Pass an answer to its caller, also if a server sends a wrong CSeq or none."""
        cseq = answer.cseq
        if cseq in self._unanswered:
            self._unanswered.remove(cseq)
        elif (
            self._pending_answer is not None
            and not self._pending_answer[1].done()
            and answer.status >= 200
        ):
            self._pending_answer[1].set_result(answer)

    def _on_request(self, request: ServerRequest) -> None:
        """Answer a server's request, such as a check whether the client is alive."""
        is_supported = request.method in (*_ANSWERED_METHODS, *_ENDING_METHODS)
        cseq = next(iter(request.headers.get("cseq", ())), "0")[:16]
        status = "200 OK" if is_supported else "501 Not Implemented"
        self.write(f"RTSP/1.0 {status}\r\nCSeq: {cseq}\r\n\r\n".encode("latin-1"))
        if request.method in _ENDING_METHODS:
            self._end(f"the server ended the session ({request.method})")

    def _end(self, reason: str) -> None:
        if self.end_reason:
            return
        self.end_reason = reason
        if self._pending_answer is not None and not self._pending_answer[1].done():
            self._pending_answer[1].set_exception(self._error(reason))
            self._pending_answer[1].exception()  # mark the error as retrieved
        on_end, self.on_end = self.on_end, _ignore
        on_end(reason)
        if self._transport is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._transport.close()

    def _error(self, text: str) -> FrameSourceError:
        return FrameSourceError(f"{self.name}: {text}", source=self.name)


def _ignore(*_: object) -> None:
    pass
