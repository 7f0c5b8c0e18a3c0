"""A source of frames: its device streams while somebody reads."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import math
import time
import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
    LocalProtocolError,
)
from smartcam.frames._clocks import DeviceClock
from smartcam.frames._driver import FrameSink
from smartcam.frames._reader import FRAME_TIMEOUT, FrameReader

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import EllipsisType
    from typing import Self

    from smartcam.calibration._lens.model import CameraModel
    from smartcam.frames._clocks import ClockStatistics
    from smartcam.frames._driver import FrameDriver, StreamFormat
    from smartcam.frames._frame import Frame


_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SourceStatistics:
    """What a source did since it was opened.

    Attributes:
        streaming: whether the device streams now.
        readers: who reads now.
        started: how often the device began to stream.
        frames: came, for readers or not.
        lost: never came: lost in the camera or on the way.
        ahead: frames whose time was later than that of their arrival; they have that of the
            arrival instead.
        clock: of the camera's own clock; None: it has none.
    """

    streaming: bool
    readers: int
    started: int
    frames: int
    lost: int
    ahead: int
    clock: ClockStatistics | None


class FrameSource(FrameSink):
    """Frames of one camera, for any number of readers; ``async with`` opens and closes it.

    The device streams while somebody reads, and does nothing otherwise. Made by
    :func:`smartcam.frames.open`.

    Args:
        driver: of the device; it is the source's from now on.
        camera_info: the lens, which every frame gets; None: as the driver has it.
        timeout: seconds that an iteration waits for a frame; None: as long as it takes.
        stall: seconds without a frame after which a streaming device counts as stuck: readers get
            a :exc:`~smartcam.FrameSourceError`. None: never, as with one that waits for triggers.
        linger: seconds that it goes on streaming after the last reader, for one that comes back.

    Raises:
        ConfigurationError: a time that is none.
    """

    def __init__(
        self,
        driver: FrameDriver,
        *,
        camera_info: CameraModel | None = None,
        timeout: float | None = FRAME_TIMEOUT,
        stall: float | None = 5.0,
        linger: float = 0.0,
    ) -> None:
        for name, value in (("timeout", timeout), ("stall", stall)):
            if value is not None and not 0 < value < math.inf:
                raise ConfigurationError(f"{name}: expected seconds above 0 or None, got {value!r}")
        if not 0 <= linger <= 3600:
            raise ConfigurationError(f"linger: expected 0 to 3600 seconds, got {linger!r}")
        self._driver = driver
        self._camera_info = camera_info
        self._timeout, self._stall, self._linger = timeout, stall, linger
        self._readers: set[weakref.ref[FrameReader]] = set()
        self._format: StreamFormat | None = None
        self._task: asyncio.Task[None] | None = None
        self._changed = asyncio.Event()  # readers came or went, or the driver ended
        self._took = asyncio.Event()  # a reader took a frame, or went
        self._held_up = False  # the driver waits for readers
        self._streaming = False
        self._over: tuple[FrameSourceError | None] | None = None  # what the driver ended with
        self._frames = self._lost = self._started = self._ahead = 0
        self._clock: DeviceClock | None = None
        self._newest: Frame | None = None
        self._last_came = self._idle_since = 0.0  # on the loop's clock

    @property
    def name(self) -> str:
        """The camera's name."""
        return self._driver.name

    @property
    def driver(self) -> FrameDriver:
        """The device's driver, for what only its kind can, such as a V4L2 device's controls."""
        return self._driver

    @property
    def format(self) -> StreamFormat:
        """What it streams.

        Raises:
            LocalProtocolError: it is not open.
        """
        if self._format is None:
            raise LocalProtocolError(f"{self.name} is not open: async with it")
        return self._format

    def statistics(self) -> SourceStatistics:
        """Return what it did since it was opened."""
        return SourceStatistics(
            self._streaming,
            len(self._readers),
            self._started,
            self._frames,
            self._lost,
            self._ahead,
            None if self._clock is None else self._clock.statistics(),
        )

    async def __aenter__(self) -> Self:
        """Open the device; it does not stream yet.

        Raises:
            FrameSourceError: it is not there, in use, or cannot do what it is asked for.

        Cancellation: nothing stays open.
        """
        if self._task is not None:
            raise LocalProtocolError(f"{self.name} is open already")
        try:
            self._format = self._checked(await self._driver.open())
        except BaseException:
            await self._driver.close()
            raise
        self._task = asyncio.create_task(self._run(), name=f"frames of {self.name}")
        return self

    def _checked(self, form: StreamFormat) -> StreamFormat:
        size = (form.width, form.height)
        if self._camera_info is not None and tuple(self._camera_info.size) != size:
            raise FrameFormatError(
                f"{self.name}: expected frames of the size that camera_info has, "
                f"{self._camera_info.size[0]}x{self._camera_info.size[1]}, got {form}",
                source=self.name,
                available=(str(form),),
            )
        return form

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Stop streaming and give the device back; readers end. Idempotent.

        Cancellation: the device is given back first; how long that takes its driver bounds.
        """
        task, self._task, self._format = self._task, None, None
        for reader in self._alive():
            reader.close()
        if task is None:
            return
        task.cancel()
        cancelled: asyncio.CancelledError | None = None
        while not task.done():
            try:
                await asyncio.wait([task])
            except asyncio.CancelledError as again:
                cancelled = again
        if cancelled is not None:
            raise cancelled
        if not task.cancelled() and (error := task.exception()) is not None:
            raise error

    def reader(self, *, timeout: float | EllipsisType | None = ...) -> FrameReader:
        """Begin to read; the device streams from now on.

        Args:
            timeout: seconds that an iteration waits for a frame; None: as long as it takes; left
                out: the source's.

        Raises:
            LocalProtocolError: the source is not open.
        """
        if self._task is None:
            raise LocalProtocolError(f"{self.name} is not open: async with it, then read")
        reader = FrameReader(self, self._timeout if timeout is ... else timeout)
        self.attach(reader)
        return reader

    def attach(self, reader: FrameReader) -> None:
        """Have a reader hear of frames from now on."""
        self._readers.add(weakref.ref(reader, self._dropped))
        self._changed.set()

    def __aiter__(self) -> FrameReader:
        return self.reader()

    async def newest(self, *, max_age: float = 1.0, timeout: float | None = FRAME_TIMEOUT) -> Frame:
        """Return the newest frame, as :meth:`FrameReader.newest` does for a reader of its own.

        Who asks often keeps a reader, or opens the source with ``linger``: without either the
        device begins to stream for each.
        """
        async with self.reader() as reader:
            if self._newest is not None and self._newest.age <= max_age:
                return self._newest
            return await reader.newest(max_age=max_age, timeout=timeout)

    async def after(self, moment: float, *, timeout: float | None = FRAME_TIMEOUT) -> Frame:
        """Return the first frame exposed after a moment, as :meth:`FrameReader.after` does."""
        async with self.reader() as reader:
            if self._newest is not None and self._newest.began >= moment:
                return self._newest
            return await reader.after(moment, timeout=timeout)

    # what the driver says

    def frame(self, frame: Frame) -> None:
        """Take a frame from the driver."""
        if frame.lost:
            self.lost(frame.lost)
        self._last_came = asyncio.get_running_loop().time()
        frame = self._timed(frame, time.monotonic())
        if self._camera_info is not None and frame.camera_info is None:
            frame = dataclasses.replace(frame, camera_info=self._camera_info)
        self._frames += 1
        self._newest = frame
        for reader in self._alive():
            reader._offer(frame)  # noqa: SLF001 - the two are one

    def _timed(self, frame: Frame, now: float) -> Frame:
        """Return a frame with its time on our clock, not later than now."""
        captured = frame.captured
        if frame.device_time is not None and not self._driver.times_frames:
            if self._clock is None:
                self._clock = DeviceClock()
            jumps = self._clock.statistics().jumps
            captured = self._clock.captured(frame.device_time, captured)
            if self._clock.statistics().jumps > jumps:
                _log.warning(
                    "%s: the camera's clock was set anew, at frame %d", self.name, frame.sequence
                )
        if captured > now:  # no camera sees what has not happened yet
            self._ahead += 1
            captured = now
        if captured == frame.captured:
            return frame
        shift = captured - frame.captured
        return dataclasses.replace(frame, captured=captured, utc=frame.utc + shift)

    def lost(self, count: int) -> None:
        """Take from the driver that frames were lost."""
        self._lost += count
        for reader in self._alive():
            reader._miss(count)  # noqa: SLF001

    def skipped(self, count: int) -> None:
        """Take from the driver that frames were skipped before they came here."""
        self._frames += count
        for reader in self._alive():
            reader._skip(count)  # noqa: SLF001

    def ended(self, error: FrameSourceError | None) -> None:
        """Take from the driver that nothing more comes."""
        self._over = (error,)
        self._changed.set()

    async def taken(self) -> None:
        """Wait until every reader has taken the last frame; meanwhile nothing is stuck."""
        self._held_up = True
        try:
            while any(reader._next is not None for reader in self._alive()):  # noqa: SLF001
                self._took.clear()
                await self._took.wait()
        finally:
            self._held_up = False
            self._last_came = asyncio.get_running_loop().time()

    def _alive(self) -> list[FrameReader]:
        return [reader for one in self._readers if (reader := one()) is not None]

    def _dropped(self, one: weakref.ref[FrameReader]) -> None:
        self._readers.discard(one)
        if not self._readers and self._task is not None:
            self._idle_since = self._task.get_loop().time()
        self._changed.set()
        self._took.set()

    def _forget(self, reader: FrameReader) -> None:
        self._dropped(weakref.ref(reader))

    async def _run(self) -> None:
        """Stream while somebody reads."""
        try:
            while True:
                await self._until_changed(lambda: bool(self._readers))
                try:
                    await self._stream()
                except FrameSourceError as error:
                    self._tell(error)
                except Exception as error:  # noqa: BLE001 - a driver may be anybody's
                    _log.exception("%s: its driver failed", self.name)
                    self._tell(FrameSourceError(f"{self.name}: {error!r}", source=self.name))
        finally:
            self._newest = None
            await self._driver.close()

    async def _stream(self) -> None:
        """Have the device stream until nobody reads, or it ends."""
        self._over = None
        self._newest = None
        try:
            await self._driver.start(self)
            self._streaming = True
            self._started += 1
            self._last_came = asyncio.get_running_loop().time()
            await self._while_read()
        finally:
            self._streaming = False
            self._newest = None
            await self._driver.stop()
        over, self._over = self._over, None
        if over is not None:
            self._tell(over[0])

    async def _while_read(self) -> None:
        """Wait until the driver ended, it is stuck, or nobody reads for as long as it lingers."""
        while self._over is None:
            if not self._readers:
                left = self._idle_since + self._linger - asyncio.get_running_loop().time()
                if not await self._within(left, lambda: bool(self._readers)) and left <= 0:
                    return
            elif self._stall is None:
                await self._until_changed(lambda: not self._readers)
            else:
                left = self._last_came + self._stall - asyncio.get_running_loop().time()
                if left <= 0 and self._held_up:
                    left = self._stall
                if left <= 0:
                    raise FrameSourceError(
                        f"{self.name}: it streams, but gave no frame for {self._stall:g} s",
                        source=self.name,
                    )
                await self._within(left, lambda: not self._readers)

    async def _within(self, seconds: float, reached: Callable[[], bool]) -> bool:
        """Wait for a change; return whether it came in time."""
        try:
            async with asyncio.timeout(seconds):
                await self._until_changed(reached)
        except TimeoutError:
            return False
        return True

    async def _until_changed(self, reached: Callable[[], bool]) -> None:
        while not (reached() or self._over is not None):
            self._changed.clear()
            await self._changed.wait()

    def _tell(self, error: FrameSourceError | None) -> None:
        """End all readers; one that comes later has the device tried again."""
        for reader in self._alive():
            reader._end(error)  # noqa: SLF001
            self._forget(reader)
