"""The newest frames of some sources, for viewers: the common part of pages with pictures.

Each viewer of a source has its own reader and WebSocket, with at most one picture in transfer: when
the page reports that it has shown the last picture, the newest one is sent. So a slow
viewer skips pictures, and delays neither the device nor other viewers. Without viewers there is no
reader, and the device does not stream.
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
from smartcam.web._streams import SHOW_TIMEOUT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from aiohttp import web

    from smartcam.exceptions import SmartCamError
    from smartcam.frames import Frame, FrameReader, FrameSource

_log = logging.getLogger("smartcam.web")

FILES: Final = ("pictures.css", "pictures.js")
"""Files of pages with pictures, beside their own."""

MAX_VIEWERS: Final = 32
"""Largest number of WebSockets at a time: eight people before four cameras."""

PROTOCOL: Final = "smartcam.frames"
"""Subprotocol of the WebSockets that send pictures."""

MAX_PICTURE_BYTES: Final = 1 << 24
"""Largest number of bytes of a picture that is sent; a camera's own JPEGs may be of any
size."""

ACCOUNT_PERIOD: Final = 1.0
"""Seconds without a frame after which the page gets the account anyway."""

THREADS: Final = 2
"""Threads that make JPEGs; more threads would wait for the processor."""

REOPEN_BACKOFF: Final = Backoff(initial=0.5, maximum=5.0)
"""Delays before a source that ended with an error is read again."""


def _ignore(_error: SmartCamError | None) -> None:
    """Ignore the outcome of a try."""


class SitePictures:
    """The sources of a site, and their viewers.

    Args:
        sources: sources that the caller opens and closes; the site waits for a source to open.
        quality: quality of the JPEGs that are made. A frame that comes as a JPEG stays as it is.

    Attributes:
        sources: the given sources.
        failures: reason why a source is not open, by its place in ``sources``.
        viewers: sockets of the pages that show a source.
    """

    def __init__(self, sources: Iterable[FrameSource], quality: int) -> None:
        if not 1 <= quality <= 100:
            raise ConfigurationError(f"quality: expected 1 to 100, got {quality!r}")
        self.sources: tuple[FrameSource, ...] = tuple(sources)
        self.failures: dict[int, str] = {}
        self.viewers: set[Viewer] = set()
        self._quality = quality
        self._presses: list[Press] = []
        self._threads: ThreadPoolExecutor | None = None

    def start(self) -> None:
        """Start the threads that make pictures; do nothing if they run."""
        if self._threads is None:
            self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix="smartcam.web.jpeg")
            self._presses = [Press(self._threads, self._quality) for _ in self.sources]

    def end_viewers(self) -> None:
        """Notify all viewers of the site's end."""
        for viewer in self.viewers:
            viewer.end()

    async def stop(self) -> None:
        """End the threads, once all viewers have left.

        Cancellation: takes effect at once; the threads end by themselves.
        """
        self.end_viewers()
        for viewer in tuple(self.viewers):
            await viewer.gone.wait()
        threads, self._threads = self._threads, None
        if threads is not None:
            await asyncio.to_thread(threads.shutdown)

    def press(self, place: int) -> Press:
        """Return the maker of JPEGs of a source."""
        return self._presses[place]

    def state(self, place: int) -> dict[str, Any]:
        """Return the state of a source, as values for JSON."""
        source = self.sources[place]
        try:
            streams: str | None = str(source.format)
        except LocalProtocolError:
            streams = None
        account = source.statistics()
        return {
            "place": place,
            "name": source.name,
            "format": streams,
            "failure": self._failure(place) if streams is None else "",
            "streaming": account.streaming,
            "readers": account.readers,
            "started": account.started,
            "frames": account.frames,
            "lost": account.lost,
            "features": source.has_features,
        }

    def _failure(self, place: int) -> str:
        return self.failures.get(place, f"{self.sources[place].name} is not open")

    async def keep_open(
        self, place: int, tried: Callable[[SmartCamError | None], None] = _ignore
    ) -> None:
        """Keep a source open until the task is cancelled; try again if it cannot be opened.

        Args:
            place: place of the source.
            tried: function that gets the error of each try, None for success.
        """
        for delay in Backoff().delays():
            try:
                async with self.sources[place]:
                    self.failures.pop(place, None)
                    tried(None)
                    await asyncio.Event().wait()
            except (FrameSourceError, ConfigurationError, UnsupportedError) as exc:
                self.failures[place] = str(exc)
                tried(exc)
            await asyncio.sleep(delay)

    async def view(self, place: int, request: web.Request) -> web.WebSocketResponse:
        """Show a source to a viewer, until the end.

        Raises:
            RefusedError: the request is no WebSocket, or there are :data:`MAX_VIEWERS` already.
        """
        check_websocket(request, PROTOCOL, len(self.viewers), MAX_VIEWERS)
        return await Viewer(self, place, request).serve()


class Press:
    """Makes JPEGs of a source in threads, each frame once for all viewers."""

    def __init__(self, threads: ThreadPoolExecutor, quality: int) -> None:
        self._threads = threads
        self._quality = quality
        self._frame: Frame | None = None
        self._made: asyncio.Future[bytes] | None = None

    async def jpeg(self, frame: Frame) -> bytes:
        """Return a frame as a JPEG.

        Raises:
            FrameFormatError: its bytes are wrong, or too many.
            MissingExtraError: a codec is not installed.

        Cancellation: safe; other callers that wait for the JPEG get it.
        """
        if self._made is None or self._frame is not frame:
            loop = asyncio.get_running_loop()
            self._frame = frame
            self._made = loop.run_in_executor(self._threads, _pressed, frame, self._quality)
            self._made.add_done_callback(_retrieved)
        return await asyncio.shield(self._made)

    def forget(self) -> None:
        """Drop the kept pictures."""
        self._frame = self._made = None


def _pressed(frame: Frame, quality: int) -> bytes:
    with from_part("frames", "pictures on a page need"):
        from smartcam.web._jpeg import jpeg
    data = jpeg(frame, quality)
    if len(data) > MAX_PICTURE_BYTES:
        raise FrameFormatError(
            f"{frame.source}: a JPEG of {len(data)} bytes; expected {MAX_PICTURE_BYTES} at most",
            source=frame.source,
        )
    return data


def _retrieved(made: asyncio.Future[bytes]) -> None:
    if not made.cancelled():
        made.exception()  # marks the error as handled if all callers are gone


class Viewer(PageSocket):
    """The WebSocket of a page that shows a source.

    Attributes:
        place: place of the source.
        address: address of the viewer.
        gone: event that is set when the viewer has left.
    """

    def __init__(self, pictures: SitePictures, place: int, request: web.Request) -> None:
        super().__init__(request, PROTOCOL, "picture")
        self._pictures = pictures
        self._source = pictures.sources[place]
        self.place: int = place
        self.address: str = request.remote or ""
        self.gone = asyncio.Event()
        self._sent = 0

    async def serve(self) -> web.WebSocketResponse:
        """Show frames until the page is closed."""
        self._pictures.viewers.add(self)
        try:
            return await super().serve()
        finally:
            self._pictures.viewers.discard(self)
            self.gone.set()
            if not any(viewer.place == self.place for viewer in self._pictures.viewers):
                self._pictures.press(self.place).forget()

    async def _show(self) -> None:
        """Show frames, and read the source again after it ended.

        The page shows a lost source as lost until its next picture.
        """
        delays, lost = REOPEN_BACKOFF.delays(), False
        while True:
            before = self._sent
            try:
                async with self._source.reader(timeout=ACCOUNT_PERIOD) as reader:
                    if not lost:
                        await self._send({"state": "waiting", **self._pictures.state(self.place)})
                    await self._show_frames(reader)
            except LocalProtocolError:
                await self._send(
                    {"state": "awaited", "text": self._pictures.state(self.place)["failure"]}
                )
                lost = False
            except (FrameSourceError, ConfigurationError) as exc:
                await self._send({"state": "lost", "text": str(exc)})
                lost = True
            else:
                await self._send({"state": "ended", "text": f"{self._source.name} has ended."})
                # after a second message the page would play the recording again
                await asyncio.Event().wait()
            if self._sent > before:
                delays = REOPEN_BACKOFF.delays()
            await asyncio.sleep(next(delays))

    async def _show_frames(self, reader: FrameReader) -> None:
        """Show frames until the source ends."""
        bad = 0
        while True:
            try:
                frame = await anext(reader)
            except FrameTimeoutError:
                await self._send({"account": _account(reader, bad)})
                continue
            except StopAsyncIteration:
                return
            try:
                picture = await self._pictures.press(self.place).jpeg(frame)
            except FrameFormatError as exc:
                bad += 1
                await self._send({"account": _account(reader, bad), "bad": str(exc)})
                continue
            await self._send_picture(_about(frame), _account(reader, bad), picture)

    async def _send_picture(
        self, frame: dict[str, Any], account: dict[str, Any], picture: bytes
    ) -> None:
        """Send a picture after its JSON, and wait until it is shown; TimeoutError: too late."""
        head = json.dumps({"frame": frame, "account": account}).encode()
        self._shown.clear()
        async with asyncio.timeout(SHOW_TIMEOUT):
            await self._socket.send_bytes(len(head).to_bytes(4, "little") + head + picture)
            self._sent += 1
            await self._shown.wait()

    async def _send(self, value: dict[str, Any]) -> None:
        async with asyncio.timeout(SHOW_TIMEOUT):
            await self._socket.send_str(json.dumps(value))


def _about(frame: Frame) -> dict[str, Any]:
    """Return the description of a frame for a page, with the frame's present age."""
    return {
        "sequence": frame.sequence,
        "width": frame.width,
        "height": frame.height,
        "format": frame.format.name,
        "age": frame.age,
        "moment": frame.moment.value,
    }


def _account(reader: FrameReader, bad: int) -> dict[str, Any]:
    """Return the counts of a viewer's frames so far; ``at``: seconds of ``time.monotonic()``."""
    account = reader.statistics()
    return {
        "at": time.monotonic(),
        "offered": account.offered,
        "delivered": account.delivered,
        "skipped": account.skipped,
        "lost": account.lost,
        "bad": bad,
    }
