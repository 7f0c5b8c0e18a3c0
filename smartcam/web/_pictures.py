"""Send the newest frames of some sources to viewers; every page with live pictures uses this.

Each viewer of a source has its own reader and WebSocket. The newest picture is sent when the page
reports that it has shown the last one. So a slow viewer skips pictures, and delays neither the
device nor other viewers. Without viewers there is no reader, and the device does not stream.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final

from smartcam._extras import from_part
from smartcam.backoff import Backoff
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
    FrameTimeoutError,
    LocalProtocolError,
    UnsupportedError,
)
from smartcam.web._sockets import PageSocket, check_websocket
from smartcam.web._streams import READER_TIMEOUT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from aiohttp import web

    from smartcam.exceptions import SmartCamError
    from smartcam.frames import Frame, FrameReader, FrameSource

_log = logging.getLogger("smartcam.web")

FILES: Final = ("pictures.css", "pictures.js")
"""Files that pages with pictures need in addition to their own."""

MAX_VIEWERS: Final = 32
"""Largest number of WebSockets at a time, enough for eight people who each watch four cameras."""

PROTOCOL: Final = "smartcam.frames"
"""Subprotocol of the WebSockets that send pictures."""

MAX_PICTURE_BYTES: Final = 1 << 24
"""Largest number of bytes of a picture that is sent; JPEGs that come from a camera can be of any
size."""

COUNTS_PERIOD: Final = 1.0
"""Seconds without a frame after which the page gets only the counts of frames."""

THREADS: Final = 2
"""Number of threads that make JPEGs; more threads would only wait for the processor."""

REOPEN_BACKOFF: Final = Backoff(initial=0.5, maximum=5.0)
"""Delays before a source that ended with an error is read again."""


def _ignore(_error: SmartCamError | None) -> None:
    """Do nothing: the default of ``on_attempt``."""


class SitePictures:
    """The sources of a site, and their viewers.

    Args:
        sources: sources that the caller opens and closes; the site waits for a source to open.
        quality: quality of the JPEGs that are made. A frame that comes as a JPEG stays as it is.

    Attributes:
        sources: the given sources.
        failures: reason why a source is not open, by its index in ``sources``.
        viewers: sockets of the pages that show a source.
    """

    def __init__(self, sources: Iterable[FrameSource], quality: int) -> None:
        if not 1 <= quality <= 100:
            raise ConfigurationError(f"quality: expected 1 to 100, got {quality!r}")
        self.sources: tuple[FrameSource, ...] = tuple(sources)
        self.failures: dict[int, str] = {}
        self.viewers: set[Viewer] = set()
        self._quality = quality
        self._jpeg_makers: list[JpegMaker] = []
        self._threads: ThreadPoolExecutor | None = None

    def start(self) -> None:
        """Start the threads that make pictures; do nothing if they run."""
        if self._threads is None:
            self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix="smartcam.web.jpeg")
            self._jpeg_makers = [JpegMaker(self._threads, self._quality) for _ in self.sources]

    def end_viewers(self) -> None:
        """Tell all viewers that the site ends."""
        for viewer in self.viewers:
            viewer.end()

    async def stop(self) -> None:
        """End the threads, once all viewers have left.

        Cancellation: takes effect at once; the threads end by themselves.
        """
        self.end_viewers()
        for viewer in tuple(self.viewers):
            await viewer.has_left.wait()
        threads, self._threads = self._threads, None
        if threads is not None:
            await asyncio.to_thread(threads.shutdown)

    def jpeg_maker(self, index: int) -> JpegMaker:
        """Return the object that makes the JPEGs of a source."""
        return self._jpeg_makers[index]

    def state(self, index: int) -> dict[str, Any]:
        """Return the state of a source, as values for JSON."""
        source = self.sources[index]
        try:
            format_text: str | None = str(source.format)
        except LocalProtocolError:  # not open
            format_text = None
        counts = source.statistics()
        return {
            "index": index,
            "name": source.name,
            "format": format_text,
            "failure": self._failure(index) if format_text is None else "",
            "streaming": counts.streaming,
            "readers": counts.readers,
            "started": counts.started,
            "frames": counts.frames,
            "lost": counts.lost,
            "features": source.has_features,
        }

    def _failure(self, index: int) -> str:
        return self.failures.get(index, f"{self.sources[index].name} is not open")

    async def keep_open(
        self, index: int, on_attempt: Callable[[SmartCamError | None], None] = _ignore
    ) -> None:
        """Keep a source open until the task is cancelled; try again if it cannot be opened.

        Args:
            index: index of the source.
            on_attempt: function that gets the error of each attempt; None: it succeeded.
        """
        for delay in Backoff().delays():
            try:
                async with self.sources[index]:
                    self.failures.pop(index, None)
                    on_attempt(None)
                    await asyncio.Event().wait()
            except (FrameSourceError, ConfigurationError, UnsupportedError) as exc:
                self.failures[index] = str(exc)
                on_attempt(exc)
            await asyncio.sleep(delay)

    async def serve_viewer(self, index: int, request: web.Request) -> web.WebSocketResponse:
        """Send the pictures of a source to a viewer until the viewer leaves or the site ends.

        Raises:
            RefusedError: the request is no WebSocket, or there are :data:`MAX_VIEWERS` already.
        """
        check_websocket(request, PROTOCOL, len(self.viewers), MAX_VIEWERS)
        return await Viewer(self, index, request).serve()


class JpegMaker:
    """Makes the JPEGs of a source in threads; all viewers share the JPEG of a frame."""

    def __init__(self, threads: ThreadPoolExecutor, quality: int) -> None:
        self._threads = threads
        self._quality = quality
        self._frame: Frame | None = None
        self._jpeg_future: asyncio.Future[bytes] | None = None

    async def jpeg(self, frame: Frame) -> bytes:
        """Return a frame as a JPEG.

        Raises:
            FrameFormatError: the frame's bytes are wrong, or the JPEG is too large.
            MissingExtraError: a codec is not installed.

        Cancellation: safe; other callers that wait for the same JPEG still get it.
        """
        if self._jpeg_future is None or self._frame is not frame:
            loop = asyncio.get_running_loop()
            self._frame = frame
            self._jpeg_future = loop.run_in_executor(
                self._threads, _make_jpeg, frame, self._quality
            )
            self._jpeg_future.add_done_callback(_mark_retrieved)
        return await asyncio.shield(self._jpeg_future)

    def drop_picture(self) -> None:
        """Drop the last frame and its JPEG."""
        self._frame = self._jpeg_future = None


def _make_jpeg(frame: Frame, quality: int) -> bytes:
    with from_part("frames", "pictures on a page need"):
        from smartcam.web._jpeg import jpeg
    data = jpeg(frame, quality)
    if len(data) > MAX_PICTURE_BYTES:
        raise FrameFormatError(
            f"{frame.source}: a JPEG of {len(data)} bytes; expected {MAX_PICTURE_BYTES} at most",
            source=frame.source,
        )
    return data


def _mark_retrieved(future: asyncio.Future[bytes]) -> None:
    if not future.cancelled():
        future.exception()  # asyncio would log an error that no caller retrieves


class Viewer(PageSocket):
    """The WebSocket that sends the pictures of a source to a page.

    Attributes:
        index: index of the source.
        address: address of the viewer.
        has_left: event that is set when the viewer has left.
    """

    def __init__(self, pictures: SitePictures, index: int, request: web.Request) -> None:
        super().__init__(request, PROTOCOL, "picture")
        self._pictures = pictures
        self._source = pictures.sources[index]
        self.index: int = index
        self.address: str = request.remote or ""
        self.has_left = asyncio.Event()
        self._sent_count = 0

    async def serve(self) -> web.WebSocketResponse:
        """Send pictures until the page is closed."""
        self._pictures.viewers.add(self)
        try:
            return await super().serve()
        finally:
            self._pictures.viewers.discard(self)
            self.has_left.set()
            if not any(viewer.index == self.index for viewer in self._pictures.viewers):
                self._pictures.jpeg_maker(self.index).drop_picture()

    async def _send_messages(self) -> None:
        """Send pictures, and read the source again after it was lost.

        The page shows a source as lost until the next picture arrives.
        """
        delays, lost = REOPEN_BACKOFF.delays(), False
        while True:
            count_before = self._sent_count
            try:
                async with self._source.reader(timeout=COUNTS_PERIOD) as reader:
                    if not lost:
                        await self._send(
                            {"state": "no_frame_yet", **self._pictures.state(self.index)}
                        )
                    await self._send_pictures(reader)
            except LocalProtocolError:
                await self._send(
                    {"state": "not_open", "text": self._pictures.state(self.index)["failure"]}
                )
                lost = False
            except (FrameSourceError, ConfigurationError) as exc:
                await self._send({"state": "lost", "text": str(exc)})
                lost = True
            else:
                await self._send({"state": "ended", "text": f"{self._source.name} has ended."})
                # a new reader would play a recording again from its start
                await asyncio.Event().wait()
            if self._sent_count > count_before:
                delays = REOPEN_BACKOFF.delays()
            await asyncio.sleep(next(delays))

    async def _send_pictures(self, reader: FrameReader) -> None:
        """Send pictures until the source ends."""
        bad_count = 0
        while True:
            try:
                frame = await anext(reader)
            except FrameTimeoutError:
                await self._send({"counts": _counts(reader, bad_count)})
                continue
            except StopAsyncIteration:
                return
            try:
                picture = await self._pictures.jpeg_maker(self.index).jpeg(frame)
            except FrameFormatError as exc:
                bad_count += 1
                await self._send({"counts": _counts(reader, bad_count), "bad": str(exc)})
                continue
            await self._send_picture(_frame_fields(frame), _counts(reader, bad_count), picture)

    async def _send_picture(
        self, frame: dict[str, Any], counts: dict[str, Any], picture: bytes
    ) -> None:
        """Send JSON and a picture, and wait until the page has shown it.

        Raises:
            TimeoutError: the page did not show the picture in time.
        """
        head = json.dumps({"frame": frame, "counts": counts}).encode()
        self._was_shown.clear()
        async with asyncio.timeout(READER_TIMEOUT):
            await self._socket.send_bytes(len(head).to_bytes(4, "little") + head + picture)
            self._sent_count += 1
            await self._was_shown.wait()

    async def _send(self, value: dict[str, Any]) -> None:
        async with asyncio.timeout(READER_TIMEOUT):
            await self._socket.send_str(json.dumps(value))


def _frame_fields(frame: Frame) -> dict[str, Any]:
    """Return a frame's properties for a page; ``age`` is its age now."""
    return {
        "sequence": frame.sequence,
        "width": frame.width,
        "height": frame.height,
        "format": frame.format.name,
        "age": frame.age,
        "moment": frame.moment.value,
    }


def _counts(reader: FrameReader, bad_count: int) -> dict[str, Any]:
    """Return the counts of a viewer's frames so far, with the time of the count."""
    counts = reader.statistics()
    return {
        "at": time.monotonic(),
        "offered": counts.offered,
        "delivered": counts.delivered,
        "skipped": counts.skipped,
        "lost": counts.lost,
        "bad": bad_count,
    }
