"""Encode a source once for all viewers."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from smartcam.exceptions import FrameFormatError, FrameSourceError, FrameTimeoutError, SmartCamError
from smartcam.frames._codecs.h264 import entry_point

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

    def take(self, unit: Frame, key: bool) -> None:
        """Receive an encoded frame, without blocking."""
        ...

    def ended(self, error: FrameSourceError) -> None:
        """Receive the error that ended the stream; the viewer is then removed."""
        ...


@dataclass(slots=True)
class EncodedCounts:
    """Counts of encoded frames, of key frames among them, and of failed frames."""

    encoded: int = 0
    keys: int = 0
    failed: int = 0


class SharedH264:
    """Read a source while there are viewers, and encode it once for all.

    The newest frame is encoded after the one before; other frames are skipped. When the source
    ends, its viewers are removed; the next viewer restarts the source.

    Args:
        source: open source, which must stay open while this object is used.
        encoder: encoder of this stream only.
    """

    def __init__(self, source: FrameSource, encoder: H264Encoder) -> None:
        self.source = source
        self.counts = EncodedCounts()
        self._encoder = encoder
        self._viewers: dict[StreamViewer, None] = {}
        self._asking: set[asyncio.Future[Frame]] = set()
        self._task: asyncio.Task[FrameSourceError] | None = None
        self._ending: set[asyncio.Task[FrameSourceError]] = set()
        self._resting: asyncio.TimerHandle | None = None
        self._key: Frame | None = None  # last key frame since reading began
        self._key_wanted = False
        self._key_came = -KEY_FRAME_INTERVAL

    @property
    def viewers(self) -> int:
        """Number of viewers."""
        return len(self._viewers)

    def join(self, viewer: StreamViewer) -> None:
        """Add a viewer, which receives all frames from now on.

        A key frame comes soon; for the first viewer at once.
        """
        if not self._viewers:
            self._key_came = -KEY_FRAME_INTERVAL
        self._viewers[viewer] = None
        self._key_wanted = True
        self._start()

    def leave(self, viewer: StreamViewer) -> None:
        """Remove a viewer; an unknown viewer is ignored."""
        self._viewers.pop(viewer, None)
        self._stop_if_idle()

    def key_frame(self) -> None:
        """Request a key frame, at most one per :data:`KEY_FRAME_INTERVAL` for all viewers."""
        self._key_wanted = True

    async def first(self, timeout: float) -> Frame:
        """Return a key frame of the stream, which is started if needed.

        Raises:
            FrameSourceError: the source ended, or no frame came in time.

        Cancellation: safe.
        """
        if self._task is not None and self._key is not None:
            self._stop_if_idle()
            return self._key
        asking: asyncio.Future[Frame] = asyncio.get_running_loop().create_future()
        self._asking.add(asking)
        self._key_wanted = True
        self._start()
        try:
            async with asyncio.timeout(timeout):
                return await asking
        except TimeoutError:
            raise FrameTimeoutError(
                f"{self.source.name}: no frame came within {timeout:g} s", source=self.source.name
            ) from None
        finally:
            self._asking.discard(asking)
            self._stop_if_idle()

    async def close(self) -> None:
        """Stop reading, without informing viewers. Idempotent.

        Cancellation: takes effect after the task has ended, without delay.
        """
        self._viewers.clear()
        closed = FrameSourceError(f"{self.source.name}: its stream was closed")
        self._stop_reading()
        self._answer(closed)
        while self._ending:
            await asyncio.wait(set(self._ending))

    def _start(self) -> None:
        if self._resting is not None:
            self._resting.cancel()
            self._resting = None
        if self._task is None:
            name = f"stream of {self.source.name}"
            self._task = asyncio.get_running_loop().create_task(self._run(), name=name)
            self._task.add_done_callback(self._ended)

    def _stop_if_idle(self) -> None:
        if self._viewers or self._asking or self._task is None:
            return
        if self._resting is not None:
            self._resting.cancel()
        self._resting = asyncio.get_running_loop().call_later(LINGER, self._stop_reading)

    def _stop_reading(self) -> None:
        """Stop reading; a new viewer restarts it."""
        task, self._task = self._task, None
        self._key = None
        if self._resting is not None:
            self._resting.cancel()
            self._resting = None
        if task is not None:
            self._ending.add(task)
            task.add_done_callback(self._ending.discard)
            task.cancel()

    def _ended(self, task: asyncio.Task[FrameSourceError]) -> None:
        """Report the error of the ended task to all viewers; a new viewer restarts it."""
        if task is not self._task:
            return
        name = self.source.name
        cancelled = FrameSourceError(f"{name}: its stream was cancelled", source=name)
        self._end(cancelled if task.cancelled() else task.result())

    async def _run(self) -> FrameSourceError:
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

    def _end(self, error: FrameSourceError) -> None:
        self._task = self._key = None
        viewers, self._viewers = list(self._viewers), {}
        for viewer in viewers:
            viewer.ended(error)
        self._answer(error)

    def _answer(self, answer: Frame | FrameSourceError) -> None:
        for asking in self._asking:
            if asking.done():
                continue
            if isinstance(answer, FrameSourceError):
                asking.set_exception(answer)
            else:
                asking.set_result(answer)

    async def _encode(self, reader: FrameReader) -> None:
        now = asyncio.get_running_loop().time
        self._encoder.begin_anew()
        failures = 0
        async for frame in reader:
            if not self._viewers and not self._asking:
                continue  # no viewers during the linger
            if self._key_wanted and now() - self._key_came >= KEY_FRAME_INTERVAL:
                self._encoder.begin_anew()
                self._key_came = now()
            try:
                unit = await self._encoder.encode(frame)
            except FrameFormatError:
                self.counts.failed += 1
                failures += 1
                if failures == MAX_FAILURES:
                    raise
                continue
            failures = 0
            await self._hand_out(unit, entry_point(bytes(unit.data))[0])

    async def _hand_out(self, unit: Frame, key: bool) -> None:
        if key:
            self.counts.keys += 1
            self._key, self._key_wanted = unit, False
            self._key_came = asyncio.get_running_loop().time()
            self._answer(unit)
        for viewer in list(self._viewers):
            if viewer in self._viewers:
                viewer.take(unit, key)
                await asyncio.sleep(0)  # many viewers must not block the loop
        self.counts.encoded += 1
