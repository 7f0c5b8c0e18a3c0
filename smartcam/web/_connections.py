"""Bound the number of a site's connections, and how long each may take to send a request.

The rules are the same for every port of smartcam (:mod:`smartcam._accepting`), and apply before the
token is checked. A connection whose complete request is being answered is never closed to make room
for another one.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, cast

from smartcam._accepting import Acceptor, Places

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aiohttp import StreamReader, web

_log = logging.getLogger("smartcam.web")

MAX_CONNECTIONS = 64
"""Largest number of open connections, including event streams. A browser opens six connections; a
page uses one of them for its events. Some systems give a process 256 file descriptors."""

HEAD_TIMEOUT = 10.0
"""Seconds from the first byte of a request until its head must be complete; for the first request,
from the start of the connection."""

KEEP_ALIVE_TIMEOUT = 60.0
"""Seconds that a connection stays open without a request, or with an unread answer."""

MAX_HEAD_BYTES = 1 << 15
"""Largest number of bytes of a request's head: about four times the head of a browser with many
cookies."""

_HEAD_END = b"\r\n\r\n"
_BUSY = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n"
    b"Retry-After: 1\r\n\r\n"
)


class SiteConnections:
    """Creates the connections of a site, and bounds their number.

    Args:
        make_protocol: function that returns a new HTTP protocol for a connection.
    """

    def __init__(self, make_protocol: Callable[[], asyncio.Protocol]) -> None:
        self.make_protocol: Callable[[], asyncio.Protocol] = make_protocol
        self.closed: bool = False
        self.places: Places[SiteConnection] = Places(
            MAX_CONNECTIONS,
            timeout=HEAD_TIMEOUT,
            missing="no request",
            session_name="a request",
        )
        self.acceptor: Acceptor[SiteConnection] = Acceptor(
            lambda: SiteConnection(self), self.places, _log, name="smartcam.web"
        )


class SiteConnection(asyncio.Protocol):
    """A connection: passes bytes from the transport to aiohttp's HTTP protocol, within bounds."""

    _transport: asyncio.Transport

    def __init__(self, connections: SiteConnections) -> None:
        self.keeps_place: bool = False  # whether a complete request is being answered
        self._connections = connections
        self._acceptor = connections.acceptor
        self._inner: asyncio.Protocol | None = None  # the HTTP protocol; None: connection refused
        self._head: bytearray | None = None  # received part of an unfinished head
        self._awaits_request = (
            False  # whether the last request was answered, and no byte came since
        )
        # unread body of a request that was refused
        self._body: StreamReader | None = None
        self._peer = "?"

    # ------------------------------------------------------------------ from the transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to serve the connection, or close it if there are too many."""
        self._transport = cast("asyncio.Transport", transport)
        address = transport.get_extra_info("peername")
        self._peer = f"{address[0]}:{address[1]}" if address else "?"
        if self._connections.closed:
            self._transport.abort()
            return
        refusal = self._acceptor.enter(self, address)
        if refusal:
            _log.info("= %s: connection closed: %s", self._peer, refusal)
            self._transport.write(_BUSY)
            self._transport.close()
        else:
            self._inner = self._connections.make_protocol()
            self._head = bytearray()
            self._inner.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        """Pass the bytes to the HTTP protocol, unless the head of the request is too long."""
        if self._head is not None:
            self._check_head(data, self._head)
        if self._inner is not None and not self._transport.is_closing():
            self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        """Pass the end of the input to the HTTP protocol."""
        return None if self._inner is None else self._inner.eof_received()

    def pause_writing(self) -> None:
        """Pass the pause to the HTTP protocol."""
        if self._inner is not None:
            self._inner.pause_writing()

    def resume_writing(self) -> None:
        """Pass the end of a pause to the HTTP protocol."""
        if self._inner is not None:
            self._inner.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop counting the connection, and end the HTTP protocol."""
        self._acceptor.leave(self)
        if self._inner is not None:
            self._inner.connection_lost(exc)
        if self._body is not None:  # aiohttp would still wait for the body's end
            self._body.feed_eof()

    # ------------------------------------------------------------------ from the site

    @contextlib.contextmanager
    def serving_request(self, request: web.BaseRequest) -> Iterator[None]:
        """Serve a request in the block; afterwards bound the wait for the next request."""
        self._acceptor.set_time_limit(self, None, "")
        self._head = None
        try:
            yield
        finally:
            if request.content.is_eof():
                self._head, self._awaits_request = bytearray(), True
                self._acceptor.set_time_limit(self, KEEP_ALIVE_TIMEOUT, "no request")
            else:  # the connection ends with the request
                self._body = request.content
                self._acceptor.set_time_limit(self, HEAD_TIMEOUT, "no end of a body")

    @contextlib.contextmanager
    def running_handler(self) -> Iterator[None]:
        """Keep the connection from being closed for another one while a handler runs."""
        self.keeps_place = True
        try:
            yield
        finally:
            self.keeps_place = False
            self._acceptor.restart_idle_time(self)

    def close_for(self, reason: str) -> None:
        """Close the connection at once."""
        _log.info("= %s: connection closed: %s", self._peer, reason)
        self._acceptor.leave(self)
        self._transport.abort()

    # ------------------------------------------------------------------ the head of a request

    def _check_head(self, data: bytes, head: bytearray) -> None:
        """Find the end of the unfinished head; close the connection if the head is too long."""
        if self._awaits_request:
            self._awaits_request = False
            self._acceptor.set_time_limit(self, HEAD_TIMEOUT, "half a request")
        search_start = max(0, len(head) - len(_HEAD_END) + 1)
        head += data
        end = head.find(_HEAD_END, search_start)
        if end >= 0:
            self._head = None
        if (end if end >= 0 else len(head)) > MAX_HEAD_BYTES:
            self.close_for(f"the head of its request has more than {MAX_HEAD_BYTES} bytes")


def connection_of(request: web.BaseRequest) -> SiteConnection | None:
    """Return the connection of a request; None if it is gone."""
    protocol = None if request.transport is None else request.transport.get_protocol()
    return protocol if isinstance(protocol, SiteConnection) else None
