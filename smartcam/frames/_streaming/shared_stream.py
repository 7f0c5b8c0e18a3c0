"""Encode a source once for all viewers."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from smartcam.exceptions import FrameFormatError, FrameSourceError, FrameTimeoutError, SmartCamError
from smartcam.frames._codecs.h264 import random_access_point

if TYPE_CHECKING:
    from smartcam.frames._codecs.h264 import H264Encoder
    from smartcam.frames._frame import Frame
    from smartcam.frames._reader import FrameReader
    from smartcam.frames._source import FrameSource


_log = logging.getLogger(__name__)

LINGER: Final = 2.0
"""Seconds for which a source is read without viewers: a client that got the description starts to
play within this time."""

KEY_FRAME_INTERVAL: Final = 1.0
"""Least time between two requested key frames, seconds."""

MAX_FAILURES: Final = 3
"""Number of frames in a row that fail to encode, after which the stream ends."""


class StreamViewer(Protocol):
    """A viewer that receives encoded frames; its methods must not wait or raise."""

    def on_frame(self, unit: Frame, is_key_frame: bool) -> None:
        """Receive an encoded frame, without blocking."""
        ...

    def on_stream_end(self, error: FrameSourceError) -> None:
        """Receive the error that ended the stream; the viewer is then removed."""
        ...


@dataclass(slots=True)
class EncodedCounts:
    """Counts of encoded frames, of key frames among them, and of failed frames."""

    encoded: int = 0
    key_frames: int = 0
    failed: int = 0


class SharedH264:
    """Read a source while there are viewers, and encode it once for all.

    After a frame the newest one is encoded; frames that came in between are skipped. When the
    source ends, all viewers are removed; the next viewer restarts the source.

    Args:
        source: open source, which must stay open while this object is used.
        encoder: encoder of this stream only.
    """

    def __init__(self, source: FrameSource, encoder: H264Encoder) -> None:
        self.source = source
        self.counts = EncodedCounts()
        self._encoder = encoder
        self._viewers: dict[StreamViewer, None] = {}
        self._key_frame_futures: set[asyncio.Future[Frame]] = set()
        self._task: asyncio.Task[FrameSourceError] | None = None
        self._ending: set[asyncio.Task[FrameSourceError]] = set()
        self._linger_timer: asyncio.TimerHandle | None = None
        self._last_key_frame: Frame | None = None  # last key frame since reading began
        self._key_frame_wanted = False
        self._last_key_frame_at = -KEY_FRAME_INTERVAL

    @property
    def viewer_count(self) -> int:
        """Number of viewers."""
        return len(self._viewers)

    def add_viewer(self, viewer: StreamViewer) -> None:
        """Add a viewer, which receives all frames from now on.

        A key frame comes soon; for the first viewer at once.
        """
        if not self._viewers:
            self._last_key_frame_at = -KEY_FRAME_INTERVAL
        self._viewers[viewer] = None
        self._key_frame_wanted = True
        self._start()

    def remove_viewer(self, viewer: StreamViewer) -> None:
        """Remove a viewer; an unknown viewer is ignored."""
        self._viewers.pop(viewer, None)
        self._stop_soon_if_idle()

    def request_key_frame(self) -> None:
        """Request a key frame, at most one per :data:`KEY_FRAME_INTERVAL` for all viewers."""
        self._key_frame_wanted = True

    async def first_key_frame(self, timeout: float) -> Frame:
        """Return the last key frame, or wait for the first one; the stream is started if needed.

        Raises:
            FrameSourceError: the source ended, or no frame came in time.

        Cancellation: safe.
        """
        if self._task is not None and self._last_key_frame is not None:
            self._stop_soon_if_idle()
            return self._last_key_frame
        future: asyncio.Future[Frame] = asyncio.get_running_loop().create_future()
        self._key_frame_futures.add(future)
        self._key_frame_wanted = True
        self._start()
        try:
            async with asyncio.timeout(timeout):
                return await future
        except TimeoutError:
            raise FrameTimeoutError(
                f"{self.source.name}: no frame came within {timeout:g} s", source=self.source.name
            ) from None
        finally:
            self._key_frame_futures.discard(future)
            self._stop_soon_if_idle()

    async def close(self) -> None:
        """Stop reading, without informing viewers. Idempotent.

        Cancellation: ends the wait at once; the reading stops nevertheless.
        """
        self._viewers.clear()
        error = FrameSourceError(f"{self.source.name}: its stream was closed")
        self._stop_reading()
        self._resolve_futures(error)
        while self._ending:
            await asyncio.wait(set(self._ending))

    def _start(self) -> None:
        if self._linger_timer is not None:
            self._linger_timer.cancel()
            self._linger_timer = None
        if self._task is None:
            name = f"stream of {self.source.name}"
            self._task = asyncio.get_running_loop().create_task(self._read_source(), name=name)
            self._task.add_done_callback(self._on_task_done)

    def _stop_soon_if_idle(self) -> None:
        if self._viewers or self._key_frame_futures or self._task is None:
            return
        if self._linger_timer is not None:
            self._linger_timer.cancel()
        self._linger_timer = asyncio.get_running_loop().call_later(LINGER, self._stop_reading)

    def _stop_reading(self) -> None:
        """Stop reading; a new viewer restarts it."""
        task, self._task = self._task, None
        self._last_key_frame = None
        if self._linger_timer is not None:
            self._linger_timer.cancel()
            self._linger_timer = None
        if task is not None:
            self._ending.add(task)
            task.add_done_callback(self._ending.discard)
            task.cancel()

    def _on_task_done(self, task: asyncio.Task[FrameSourceError]) -> None:
        """Report the error of the ended task to all viewers; a new viewer restarts it."""
        if task is not self._task:
            return
        name = self.source.name
        cancelled = FrameSourceError(f"{name}: its stream was cancelled", source=name)
        self._end_stream(cancelled if task.cancelled() else task.result())

    async def _read_source(self) -> FrameSourceError:
        """Encode until the source ends; return its error."""
        name = self.source.name
        try:
            async with self.source.reader(timeout=None) as reader:
                await self._encode(reader)
            error = FrameSourceError(f"{name}: the source has ended", source=name)
        except FrameSourceError as exc:
            error = exc
        except SmartCamError as exc:  # source or codecs were closed
            error = FrameSourceError(f"{name}: {exc}", source=name)
        except Exception as exc:  # noqa: BLE001 - passed on to viewers
            _log.exception("%s: cannot be encoded", name)
            error = FrameSourceError(f"{name}: {exc!r}", source=name)
        return error

    def _end_stream(self, error: FrameSourceError) -> None:
        self._task = self._last_key_frame = None
        viewers, self._viewers = list(self._viewers), {}
        for viewer in viewers:
            viewer.on_stream_end(error)
        self._resolve_futures(error)

    def _resolve_futures(self, outcome: Frame | FrameSourceError) -> None:
        for future in self._key_frame_futures:
            if future.done():
                continue
            if isinstance(outcome, FrameSourceError):
                future.set_exception(outcome)
            else:
                future.set_result(outcome)

    async def _encode(self, reader: FrameReader) -> None:
        now = asyncio.get_running_loop().time
        self._encoder.request_key_frame()
        failures = 0
        async for frame in reader:
            if not self._viewers and not self._key_frame_futures:
                continue  # no viewers during the linger
            if self._key_frame_wanted and now() - self._last_key_frame_at >= KEY_FRAME_INTERVAL:
                self._encoder.request_key_frame()
                self._last_key_frame_at = now()
            try:
                unit = await self._encoder.encode(frame)
            except FrameFormatError:
                self.counts.failed += 1
                failures += 1
                if failures == MAX_FAILURES:
                    raise
                continue
            failures = 0
            await self._send_to_viewers(unit, random_access_point(bytes(unit.data))[0])

    async def _send_to_viewers(self, unit: Frame, is_key_frame: bool) -> None:
        if is_key_frame:
            self.counts.key_frames += 1
            self._last_key_frame, self._key_frame_wanted = unit, False
            self._last_key_frame_at = asyncio.get_running_loop().time()
            self._resolve_futures(unit)
        for viewer in list(self._viewers):
            if viewer in self._viewers:
                viewer.on_frame(unit, is_key_frame)
                await asyncio.sleep(0)  # many viewers must not block the loop
        self.counts.encoded += 1
