"""Serve streams of server-sent events to any number of readers.

A stream looks for events ten times per second, and writes them. It does not look for events while
its reader is slow, and disconnects a reader that accepts nothing. So nothing waits for a reader.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from typing import TYPE_CHECKING, Any, NamedTuple

from aiohttp import web

from smartcam.exceptions import LinkError
from smartcam.models import jsonable
from smartcam.web._errors import RefusedError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

_log = logging.getLogger("smartcam.web")

MAX_STREAMS = 16
"""Largest number of event streams at the same time; each of them looks for events."""

PERIOD = 0.1
"""Seconds between two looks for events."""

READER_TIMEOUT = 10.0
"""Seconds that a reader has to accept written events; then its stream ends."""


class StreamEvent(NamedTuple):
    """One server-sent event."""

    kind: str  # the event's name
    data: Any  # values for JSON
    serial: int | None = None  # id of the event; None without one

    def as_text(self) -> str:
        """Return the event in the stream's format."""
        id_line = "" if self.serial is None else f"id: {self.serial}\n"
        return f"event: {self.kind}\n{id_line}data: {json.dumps(jsonable(self.data))}\n\n"


class Streams:
    """All event streams of a site."""

    def __init__(self) -> None:
        self._closing = asyncio.Event()
        self._count = 0

    def __len__(self) -> int:
        return self._count

    async def serve(
        self, request: web.Request, find_events: Callable[[], Iterable[StreamEvent]]
    ) -> web.StreamResponse:
        """Write events until the reader is gone, is too slow, or :meth:`close` is called.

        ``find_events`` is called every :data:`PERIOD`, and returns the events to write.

        Raises:
            RefusedError: 503, there are :data:`MAX_STREAMS` already.

        Cancellation: ends the stream.
        """
        if self._count >= MAX_STREAMS:
            raise RefusedError(503, f"event stream {MAX_STREAMS + 1}", f"{MAX_STREAMS} at one time")
        response = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
        self._count += 1
        try:
            await response.prepare(request)
            while not self._closing.is_set() and is_open(request):
                await _write(response, "".join(event.as_text() for event in find_events()))
                await self.wait_closing(PERIOD)
            if is_open(request):
                await _write(response, None)
        except TimeoutError:
            _log.info("= %s: event stream ended, its reader is too slow", request.remote)
            if request.transport is not None:
                request.transport.abort()
        except LinkError:  # a ConnectionError, but of the camera
            raise
        except ConnectionError:
            pass  # the reader is gone
        finally:
            self._count -= 1
        return response

    def close(self) -> None:
        """End all streams, and refuse new ones."""
        self._closing.set()

    async def wait_closing(self, seconds: float) -> bool:
        """Wait for some time; return True as soon as all streams have to end, otherwise False."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._closing.wait()
        return self._closing.is_set()


def is_open(request: web.Request) -> bool:
    """Return True while the client is connected."""
    transport = request.transport
    return transport is not None and not transport.is_closing()


async def _write(response: web.StreamResponse, text: str | None) -> None:
    """Write a text; None: end the stream."""
    async with asyncio.timeout(READER_TIMEOUT):
        if text is None:
            await response.write_eof()
        elif text:
            await response.write(text.encode())
