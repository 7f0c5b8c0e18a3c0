"""Decode the encoded frames of a stream into frames of a source; count lost frames."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import time
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames._codecs.threads import Codecs, StreamRuns, at_once
from smartcam.frames._frame import Frame, Moment, amend
from smartcam.frames._pixels.formats import find_format

if TYPE_CHECKING:
    from smartcam.frames._codecs.h264 import H264Decoder
    from smartcam.frames._driver import FrameSink
    from smartcam.frames._streaming.rtp.assembling import AccessUnit
    from smartcam.frames._streaming.rtp.codings import Coding


MAX_WAITING_FRAMES: Final = 16
"""Largest number of encoded frames that wait for the decoder; more are dropped until a key
frame."""

MAX_UNDECODABLE_FRAMES: Final = 10
"""Number of undecodable frames in a row after which the stream may end with an error."""

FAILURE_GRACE: Final = 3.0
"""Seconds of undecodable frames before the stream ends: the first sender may be a wrong one."""


DRAIN_TIMEOUT: Final = 5.0
"""Seconds for decoding queued frames after a stream's end."""

DRAIN_CHECK_INTERVAL: Final = 0.005
"""Seconds between two checks of the queue after a stream's end."""


class UnitSource(Protocol):
    """The part of a receiver that decoding uses."""

    def utc(self, timestamp: int, /) -> float | None:
        """Return a time on the sender's wall clock; None: not reported yet."""
        ...

    def want_picture(self) -> None:
        """Ask for a key frame."""
        ...

    def shown(self) -> None:
        """Note that a picture was decoded."""
        ...


class DecodingPlan(NamedTuple):
    """The options for decoding a stream.

    Attributes:
        name: name of the source.
        coding: codec of the stream.
        delay: longest time from exposure to arrival, seconds.
        size: size that the pictures must have; None: any.
        sets: parameters of the codec from the stream's description, as in a file.
        to: pixel format of FFmpeg that pictures are converted to; "": no conversion.
        passed_on: whether encoded frames are passed on without decoding.
    """

    name: str
    coding: Coding
    delay: float
    size: tuple[int, int] | None = None
    sets: bytes = b""
    to: str = ""
    passed_on: bool = False


class UnitDecoding:
    """Decode a stream for a driver.

    Args:
        plan: options for decoding.
        sink: receiver of the frames and of the final error.
    """

    def __init__(self, plan: DecodingPlan, sink: FrameSink) -> None:
        self._plan, self._sink, self._name = plan, sink, plan.name
        self._size = plan.size or (plan.coding.size_in(plan.sets) if plan.sets else None)
        self._loop = asyncio.get_running_loop()
        self._units: collections.deque[tuple[AccessUnit, float | None]] = collections.deque()
        self._arrived = asyncio.Event()
        self.overflows = 0
        self._source: UnitSource | None = None
        self._skipped = 0  # number of units dropped since the last decoded one
        self._anew = True  # whether the next unit begins another stream
        self._reorders = False
        self._pace = _UnitPace()
        self._missed = self._number = 0
        self._failed = 0  # number of undecodable frames in a row
        self._failing_since = 0.0
        self._shown = False
        self._ended = False
        self._codecs = Codecs(threads=1)
        self._run = StreamRuns(self._codecs)
        self._decoder: H264Decoder | None = None
        self._idle = False  # True while no frame is decoded or queued
        self._task: asyncio.Task[None] | None = None

    async def begin(self, source: UnitSource) -> None:
        """Start decoding the frames of a source."""
        self._source = source
        await self._codecs.__aenter__()
        self._task = asyncio.create_task(self._decode(), name=f"frames of {self._name}")

    async def end(self) -> None:
        """Stop decoding; the sink is not called any more."""
        self._ended = True
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
        try:
            if task is not None:
                await asyncio.wait([task])
        finally:
            await self._codecs.close()

    def over(self, error: FrameSourceError) -> None:
        """Report the end to the sink, once."""
        if not self._ended:
            self._ended = True
            error.source = self._name
            if self._missed and self._shown:
                self._sink.lost(self._missed)
            self._sink.ended(error)

    async def finish(self, error: FrameSourceError) -> None:
        """Report the end to the sink after decoding the queued frames.

        The wait is bounded by :data:`DRAIN_TIMEOUT`.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(DRAIN_TIMEOUT):
                while self._units and not self._ended:  # noqa: ASYNC110 - there is no event
                    await asyncio.sleep(DRAIN_CHECK_INTERVAL)
        self.over(error)

    def take(self, units: list[AccessUnit]) -> None:
        """Queue encoded frames for the decoder: all, or none if there are too many."""
        source = self._source
        assert source is not None  # noqa: S101 - set by begin
        self._units += [(unit, source.utc(unit.timestamp)) for unit in units]
        if len(self._units) > MAX_WAITING_FRAMES:
            self.overflows += 1
            self._skipped += len(self._units)
            self._missed += sum(self._pace.lost(unit) for unit, _ in self._units)
            self._anew |= any(unit.begins for unit, _ in self._units)
            self._units.clear()
            source.want_picture()
        if self._idle and self._units and self._run.short and not self._ended:
            try:
                at_once(self._decode_next())
            except Exception as exc:  # noqa: BLE001 - passed on to readers
                self._fail(exc)
        if self._units:
            self._arrived.set()

    def _fail(self, exc: Exception) -> None:
        """Report an error of any kind to the sink."""
        if not isinstance(exc, FrameSourceError):
            failed = FrameSourceError(f"{self._name}: {exc!r}")
            failed.__cause__ = exc
            exc = failed
        self.over(exc)

    async def _decode(self) -> None:
        """Decode the queued frames."""
        try:
            while not self._ended:
                if not self._units:
                    self._arrived.clear()
                    self._idle = True
                    await self._arrived.wait()
                self._idle = False
                if self._units:
                    await self._decode_next()
                    await asyncio.sleep(0)  # several pictures must not block the loop
        except Exception as exc:  # noqa: BLE001 - passed on to readers
            self._fail(exc)

    async def _decode_next(self) -> None:
        unit, device_time = self._units.popleft()
        begins = unit.begins or self._anew
        goes_back = not begins and self._pace.goes_back(unit)
        missing = self._pace.lost(unit) + self._skipped
        self._missed += missing
        if goes_back and not self._reorders:
            self._reorders = begins = True
        if begins or self._decoder is None:
            self._decoder = self._made_decoder()
            unit = self._with_sets(unit) if begins else unit
        elif missing:
            self._decoder.lost()
        self._skipped, self._anew = 0, False
        await self._give(self._decoder, unit, device_time)

    def _made_decoder(self) -> H264Decoder:
        reorders, to = self._reorders, self._plan.to
        return self._plan.coding.decoder(self._run, reorders=reorders, to=to)

    def _with_sets(self, unit: AccessUnit) -> AccessUnit:
        if not self._plan.sets or self._plan.coding.size_in(unit.data) is not None:
            return unit
        return unit._replace(data=self._plan.sets + unit.data)

    async def _give(
        self, decoder: H264Decoder, unit: AccessUnit, device_time: float | None
    ) -> None:
        """Decode an encoded frame, and pass its picture on."""
        frame = self._frame(unit, device_time)
        if frame is not None and not self._plan.passed_on:
            frame = await self._decoded(decoder, frame)
        if frame is not None:
            self._show(frame)
        elif not (self._reorders and decoder.whole):  # the decoder waits for another frame
            self._missed += 1
            if self._source is not None:
                self._source.want_picture()

    def _frame(self, unit: AccessUnit, device_time: float | None) -> Frame | None:
        """Return an encoded frame; None: the size is not known yet."""
        size = self._size = self._plan.coding.size_in(unit.data) or self._size
        if size is None:
            return None
        if self._plan.size not in (None, size):
            raise FrameFormatError(
                f"{self._name}: expected {_shown(self._plan.size)}, the size at the opening, "
                f"got {_shown(size)}: open it again",
                available=(_shown(size),),
            )
        passed = self._loop.time() - unit.arrived
        return Frame(
            data=unit.data,
            format=find_format(self._plan.coding.format),
            width=size[0],
            height=size[1],
            stride=0,
            captured=time.monotonic() - passed,
            utc=time.time() - passed,
            moment=Moment.ARRIVAL,
            duration=self._plan.delay,
            device_time=device_time,
            sequence=0,
            source=self._name,
        )

    async def _decoded(self, decoder: H264Decoder, frame: Frame) -> Frame | None:
        try:
            decoded = await decoder.decode(frame)
        # a single frame may be damaged; many in a row are an error
        except FrameFormatError as exc:
            self._failed += 1
            if self._failed == 1:
                self._failing_since = self._loop.time()
            late = self._loop.time() - self._failing_since >= FAILURE_GRACE
            if self._failed < MAX_UNDECODABLE_FRAMES or not late:
                return None
            raise FrameFormatError(f"{self._name}: {exc}", available=exc.available) from exc
        self._failed = 0
        return decoded

    def _show(self, picture: Frame) -> None:
        if self._source is not None:
            self._source.shown()
        lost, self._missed = self._missed if self._shown else 0, 0
        self._shown = True
        self._number += 1 + lost
        if not self._ended:
            self._sink.frame(amend(picture, sequence=self._number, lost=lost))


class _UnitPace:
    """The pace of encoded frames, which gives the number of frames in a gap."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._step = 0  # ticks between the last two consecutive frames

    def goes_back(self, unit: AccessUnit) -> bool:
        """Return True if a frame must be shown before an earlier received one."""
        return self._last is not None and -MAX_STEP_TICKS < self._since(unit) < 0

    def lost(self, unit: AccessUnit) -> int:
        """Return the estimated number of frames lost before this frame.

        For a gap with whole frames lost, the number follows from the time and the pace of earlier
        frames, and is at most the number of missing packets.
        """
        since = 0 if self._last is None or unit.begins else self._since(unit)
        least = max(unit.damaged, 1 if unit.lost or unit.begins else 0)
        if not least and 0 < since < MAX_STEP_TICKS:
            self._step = since
        if self._last is None or since >= 0:
            self._last = unit.timestamp
        fits = round(since / self._step) - 1 if self._step and since > 0 else 0
        return max(least, min(fits, unit.damaged + unit.lost))

    def _since(self, unit: AccessUnit) -> int:
        since = unit.timestamp - (self._last or 0)
        return (since + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000


MAX_STEP_TICKS: Final = 60 * 90_000
"""Largest distance of two frames, ticks, that defines a pace."""


def _shown(size: tuple[int, int] | None) -> str:
    return "any size" if size is None else f"{size[0]}x{size[1]}"
