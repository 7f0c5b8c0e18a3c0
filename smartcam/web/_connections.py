"""The connections of a site: their number, and their time for a request.

The policy is that of every port (:mod:`smartcam._accepting`), and applies before the token is
checked. A complete request counts as a session while it is answered.
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
"""Largest number of connections at a time, including event streams. A browser opens six, of which a
page keeps one for its events; some systems give a process 256 file descriptors."""

HEAD_TIMEOUT = 10.0
"""Seconds within which a request's head must be complete, from its first byte; for the first head
of a connection, from the connection's beginning."""

KEEP_ALIVE_TIMEOUT = 60.0
"""Seconds that a connection stays open without a request, or with an unread answer."""

MAX_HEAD_BYTES = 1 << 15
"""Largest number of bytes of a request's head: about four times that of a browser with many
cookies."""

_HEAD_END = b"\r\n\r\n"
_BUSY = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n"
    b"Retry-After: 1\r\n\r\n"
)


class Visitors:
    """The connections of a site.

    Args:
        make: function that returns a new HTTP protocol for a connection.
    """

    def __init__(self, make: Callable[[], asyncio.Protocol]) -> None:
        self.make: Callable[[], asyncio.Protocol] = make
        self.closed: bool = False
        self.places: Places[Visitor] = Places(
            MAX_CONNECTIONS, within=HEAD_TIMEOUT, missing="no request", own="a request"
        )
        self.acceptor: Acceptor[Visitor] = Acceptor(
            lambda: Visitor(self), self.places, _log, name="smartcam.web"
        )


class Visitor(asyncio.Protocol):
    """A connection, between its transport and its HTTP protocol."""

    _transport: asyncio.Transport

    def __init__(self, visitors: Visitors) -> None:
        self.settled: bool = False  # whether a complete request is being answered
        self._visitors = visitors
        self._acceptor = visitors.acceptor
        self._inner: asyncio.Protocol | None = None  # protocol for the bytes; None: none
        self._head: bytearray | None = None  # received part of an unfinished head
        self._idle = False  # between requests, when the next may take long
        # body of a request that was refused before its end
        self._body: StreamReader | None = None
        self._peer = "?"

    # ------------------------------------------------------------------ from the transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take a place, or close the connection."""
        self._transport = cast("asyncio.Transport", transport)
        address = transport.get_extra_info("peername")
        self._peer = f"{address[0]}:{address[1]}" if address else "?"
        if self._visitors.closed:
            self._transport.abort()
            return
        refusal = self._acceptor.enter(self, address)
        if refusal:
            _log.info("= %s: connection closed: %s", self._peer, refusal)
            self._transport.write(_BUSY)
            self._transport.close()
        else:
            self._inner = self._visitors.make()
            self._head = bytearray()
            self._inner.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        """Pass the bytes on, unless they are an endless head."""
        if self._head is not None:
            self._look_at(data, self._head)
        if self._inner is not None and not self._transport.is_closing():
            self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        """Pass the end of the input on."""
        return None if self._inner is None else self._inner.eof_received()

    def pause_writing(self) -> None:
        """Pass the pause on."""
        if self._inner is not None:
            self._inner.pause_writing()

    def resume_writing(self) -> None:
        """Pass the end of a pause on."""
        if self._inner is not None:
            self._inner.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """Give the place back."""
        self._acceptor.leave(self)
        if self._inner is not None:
            self._inner.connection_lost(exc)
        if self._body is not None:  # aiohttp would still wait for its end
            self._body.feed_eof()

    # ------------------------------------------------------------------ from the site

    @contextlib.contextmanager
    def request(self, request: web.BaseRequest) -> Iterator[None]:
        """Mark a request whose head is complete, while the block runs."""
        self._acceptor.expect(self, None, "")
        self._head = None
        try:
            yield
        finally:
            if request.content.is_eof():
                self._head, self._idle = bytearray(), True
                self._acceptor.expect(self, KEEP_ALIVE_TIMEOUT, "no request")
            else:  # the connection ends with the request
                self._body = request.content
                self._acceptor.expect(self, HEAD_TIMEOUT, "no end of a body")

    @contextlib.contextmanager
    def answer(self) -> Iterator[None]:
        """Mark a request as being answered while the block runs, so that it keeps its place."""
        self.settled = True
        try:
            yield
        finally:
            self.settled = False
            self._acceptor.move_back(self)

    def turn_away(self, why: str) -> None:
        """End the connection at once."""
        _log.info("= %s: connection closed: %s", self._peer, why)
        self._acceptor.leave(self)
        self._transport.abort()

    # ------------------------------------------------------------------ inside

    def _look_at(self, data: bytes, head: bytearray) -> None:
        """Look for the end of the unfinished head."""
        if self._idle:
            self._idle = False
            self._acceptor.expect(self, HEAD_TIMEOUT, "half a request")
        known = max(0, len(head) - len(_HEAD_END) + 1)
        head += data
        end = head.find(_HEAD_END, known)
        if end >= 0:
            self._head = None
        if (end if end >= 0 else len(head)) > MAX_HEAD_BYTES:
            self.turn_away(f"the head of its request has more than {MAX_HEAD_BYTES} bytes")


def visitor_of(request: web.BaseRequest) -> Visitor | None:
    """Return the connection of a request; None if it is gone."""
    protocol = None if request.transport is None else request.transport.get_protocol()
    return protocol if isinstance(protocol, Visitor) else None
