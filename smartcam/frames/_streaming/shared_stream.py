"""One encoder for all who look at a source."""

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
"""Seconds that the source is read on without a viewer: a client that has asked for its parameters
begins to play in that time."""

KEY_PAUSE: Final = 1.0
"""Seconds between two key frames that viewers ask for, however many they are."""

MAX_FAILURES: Final = 3
"""Largest number of frames in a row that cannot be encoded before the stream ends."""


class StreamViewer(Protocol):
    """A viewer that is handed the encoded frames; neither call may wait or raise."""

    def take(self, unit: Frame, key: bool) -> None:
        """Take an encoded frame, which nobody else is held up for."""
        ...

    def ended(self, error: FrameSourceError) -> None:
        """Hear that nothing more comes; it is no viewer any longer."""
        ...


@dataclass(slots=True)
class EncodedCounts:
    """Counts of frames encoded, of key frames among them, and of frames that failed."""

    encoded: int = 0
    keys: int = 0
    failed: int = 0


class SharedH264:
    """Reads a source while there are viewers, and encodes once for all of them.

    Its newest frame is encoded when the one before it is; what comes meanwhile is skipped. A source
    that ends takes its viewers along; with the next one it is tried again.

    Args:
        source: source that is open for as long as this object is used.
        encoder: encoder that nobody else uses.
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
        self._key: Frame | None = None  # the last one since it began to read
        self._key_wanted = False
        self._key_came = -KEY_PAUSE

    @property
    def viewers(self) -> int:
        """Number of viewers."""
        return len(self._viewers)

    def join(self, viewer: StreamViewer) -> None:
        """Hand a viewer what is encoded from now on.

        A key frame comes soon, for the first viewer at once.
        """
        if not self._viewers:
            self._key_came = -KEY_PAUSE
        self._viewers[viewer] = None
        self._key_wanted = True
        self._go()

    def leave(self, viewer: StreamViewer) -> None:
        """Hand a viewer no more; one that was not there is ignored."""
        self._viewers.pop(viewer, None)
        self._rest_if_idle()

    def key_frame(self) -> None:
        """Ask for a key frame: within :data:`KEY_PAUSE`, and one for all who ask until then."""
        self._key_wanted = True

    async def first(self, timeout: float) -> Frame:
        """Return a key frame of the stream that is encoded, or would be for a viewer.

        Raises:
            FrameSourceError: the source gives no frame, or none in time.

        Cancellation: safe.
        """
        if self._task is not None and self._key is not None:
            self._rest_if_idle()
            return self._key
        asking: asyncio.Future[Frame] = asyncio.get_running_loop().create_future()
        self._asking.add(asking)
        self._key_wanted = True
        self._go()
        try:
            async with asyncio.timeout(timeout):
                return await asking
        except TimeoutError:
            raise FrameTimeoutError(
                f"{self.source.name}: no frame came within {timeout:g} s", source=self.source.name
            ) from None
        finally:
            self._asking.discard(asking)
            self._rest_if_idle()

    async def close(self) -> None:
        """Read no longer; viewers are told nothing. Idempotent.

        Cancellation: takes effect when the task has ended, which waits for nothing.
        """
        self._viewers.clear()
        closed = FrameSourceError(f"{self.source.name}: its stream was closed")
        self._rest()
        self._answer(closed)
        while self._ending:
            await asyncio.wait(set(self._ending))

    def _go(self) -> None:
        if self._resting is not None:
            self._resting.cancel()
            self._resting = None
        if self._task is None:
            name = f"stream of {self.source.name}"
            self._task = asyncio.get_running_loop().create_task(self._run(), name=name)
            self._task.add_done_callback(self._ran)

    def _rest_if_idle(self) -> None:
        if self._viewers or self._asking or self._task is None:
            return
        if self._resting is not None:
            self._resting.cancel()
        self._resting = asyncio.get_running_loop().call_later(LINGER, self._rest)

    def _rest(self) -> None:
        """Stop reading; whoever comes now has it begin again."""
        task, self._task = self._task, None
        self._key = None
        if self._resting is not None:
            self._resting.cancel()
            self._resting = None
        if task is not None:
            self._ending.add(task)
            task.add_done_callback(self._ending.discard)
            task.cancel()

    def _ran(self, task: asyncio.Task[FrameSourceError]) -> None:
        """Tell everybody why it ended by itself; whoever comes then has it begin again."""
        if task is not self._task:
            return
        name = self.source.name
        cancelled = FrameSourceError(f"{name}: its stream was cancelled", source=name)
        self._end(cancelled if task.cancelled() else task.result())

    async def _run(self) -> FrameSourceError:
        """Encode until the source ends; return how."""
        name = self.source.name
        try:
            async with self.source.reader(timeout=None) as reader:
                await self._encode(reader)
            error = FrameSourceError(f"{name}: it has ended", source=name)
        except FrameSourceError as exc:
            error = exc
        except SmartCamError as exc:  # source or codecs were closed
            error = FrameSourceError(f"{name}: {exc}", source=name)
        except Exception as exc:  # noqa: BLE001 - viewers are told, whatever it is
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
                continue  # it lingers
            if self._key_wanted and now() - self._key_came >= KEY_PAUSE:
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
                await asyncio.sleep(0)  # many viewers do not hold up the loop
        self.counts.encoded += 1
