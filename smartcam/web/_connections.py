"""The connections of a site: how many there are, and how long each may take for a request.

All of it holds before a token is looked at. A connection whose request is there in whole is being
answered and has its place for certain; of the others, the one without such a request for longest
makes room for a newcomer. So nobody can lock a page, or take the process its file descriptors,
which the camera's port needs, too.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aiohttp import StreamReader, web

_log = logging.getLogger("smartcam.web")

MAX_CONNECTIONS = 64
"""Connections at a time, event streams among them. A browser opens six, a page keeps one of them
for its events; some systems give a process 256 file descriptors."""

HEAD_TIMEOUT = 10.0
"""Seconds within which a request's head must have come, from its first byte; the first head of a
connection from its beginning."""

KEEP_ALIVE = 60.0
"""Seconds that a connection stays open without a request, or with an answer that nobody reads."""

MAX_HEAD = 1 << 15
"""Bytes of a request's head: about four times what a browser with many cookies sends."""

_HEAD_END = b"\r\n\r\n"
_BUSY = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n"
    b"Retry-After: 1\r\n\r\n"
)


class Places:
    """The places of a site; ``make`` returns what speaks HTTP on a connection."""

    def __init__(self, make: Callable[[], asyncio.Protocol]) -> None:
        self.crowded_out: int = 0  # connections that were closed because too many were open
        self.make: Callable[[], asyncio.Protocol] = make
        self.closed: bool = False
        # the one without a whole request for longest stands first
        self._visitors: dict[Visitor, None] = {}

    def __len__(self) -> int:
        return len(self._visitors)

    def __call__(self) -> Visitor:
        """Return the protocol of a new connection."""
        return Visitor(self)

    def enter(self, visitor: Visitor) -> bool:
        """Take a connection; False where none can make room for it."""
        if len(self._visitors) >= MAX_CONNECTIONS:
            self.crowded_out += 1
            one = next((one for one in self._visitors if not one.answered), None)
            if one is None:
                return False
            one.close(f"{MAX_CONNECTIONS} others are open, it was without a request for longest")
        self._visitors[visitor] = None
        return True

    def renew(self, visitor: Visitor) -> None:
        """A request was answered."""
        if visitor in self._visitors:
            del self._visitors[visitor]
            self._visitors[visitor] = None

    def leave(self, visitor: Visitor) -> None:
        """A connection is gone; harmless when said twice."""
        self._visitors.pop(visitor, None)


class Visitor(asyncio.Protocol):
    """A connection: stands between its transport and what speaks HTTP."""

    _transport: asyncio.Transport

    def __init__(self, places: Places) -> None:
        self.answered: bool = False  # whether a request that is there in whole is being answered
        self._places = places
        self._inner: asyncio.Protocol | None = None  # None: nobody hears what comes
        self._timer: asyncio.TimerHandle | None = None
        self._head: bytearray | None = None  # while a head is awaited: what came of it
        self._idle = False  # its first byte may take long
        self._rest: StreamReader | None = None  # a body that was refused before it had come
        self._peer = "?"

    # ------------------------------------------------------------------ from the transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take a place, or go."""
        self._transport = cast("asyncio.Transport", transport)
        address = transport.get_extra_info("peername")
        self._peer = f"{address[0]}:{address[1]}" if address else "?"
        if self._places.closed:
            self._transport.abort()
        elif not self._places.enter(self):
            _log.info("= %s: connection closed: every place is taken", self._peer)
            self._transport.write(_BUSY)
            self._transport.close()
        else:
            self._inner = self._places.make()
            self._head = bytearray()
            self._set_timer(HEAD_TIMEOUT, "no request")
            self._inner.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        """Pass it on, unless it is a head without end."""
        if self._head is not None:
            self._look_at(data, self._head)
        if self._inner is not None and not self._transport.is_closing():
            self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        """Pass it on."""
        return None if self._inner is None else self._inner.eof_received()

    def pause_writing(self) -> None:
        """Pass it on."""
        if self._inner is not None:
            self._inner.pause_writing()

    def resume_writing(self) -> None:
        """Pass it on."""
        if self._inner is not None:
            self._inner.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """Give the place back."""
        self._stop_timer()
        self._places.leave(self)
        if self._inner is not None:
            self._inner.connection_lost(exc)
        if self._rest is not None:  # for which aiohttp would wait even now
            self._rest.feed_eof()

    # ------------------------------------------------------------------ from the site

    @contextlib.contextmanager
    def request(self, request: web.BaseRequest) -> Iterator[None]:
        """In here a request is dealt with whose head is there."""
        self._stop_timer()
        self._head = None
        try:
            yield
        finally:
            if request.content.is_eof():
                self._head, self._idle = bytearray(), True
                self._set_timer(KEEP_ALIVE, "no request")
            else:  # the connection ends with it
                self._rest = request.content
                self._set_timer(HEAD_TIMEOUT, "no end of a body")

    @contextlib.contextmanager
    def answer(self) -> Iterator[None]:
        """In here a request is answered that is there in whole: the place is safe."""
        self.answered = True
        try:
            yield
        finally:
            self.answered = False
            self._places.renew(self)

    def close(self, reason: str) -> None:
        """End the connection at once."""
        _log.info("= %s: connection closed: %s", self._peer, reason)
        self._stop_timer()
        self._places.leave(self)
        self._transport.abort()

    # ------------------------------------------------------------------ inside

    def _look_at(self, data: bytes, head: bytearray) -> None:
        """Look for the end of the head that is awaited."""
        if self._idle:
            self._idle = False
            self._set_timer(HEAD_TIMEOUT, "half a request")
        known = max(0, len(head) - len(_HEAD_END) + 1)
        head += data
        end = head.find(_HEAD_END, known)
        if end >= 0:
            self._head = None
        if (end if end >= 0 else len(head)) > MAX_HEAD:
            self.close(f"the head of its request has more than {MAX_HEAD} bytes")

    def _set_timer(self, seconds: float, what: str) -> None:
        self._stop_timer()
        if not self._transport.is_closing():
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(seconds, self.close, f"{what} within {seconds:g} s")

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def visitor_of(request: web.BaseRequest) -> Visitor | None:
    """Return the connection that a request came on; None where it is gone."""
    protocol = None if request.transport is None else request.transport.get_protocol()
    return protocol if isinstance(protocol, Visitor) else None
