"""Decode the encoded frames of a stream into frames of a source; count lost frames."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import time
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames._codecs.threads import Codecs, StreamRunner, run_without_waiting
from smartcam.frames._frame import Frame, Moment, amend
from smartcam.frames._pixels.formats import find_format

if TYPE_CHECKING:
    from smartcam.frames._codecs.h264 import H264Decoder
    from smartcam.frames._driver import FrameSink
    from smartcam.frames._streaming.rtp.assembling import AccessUnit
    from smartcam.frames._streaming.rtp.stream_codecs import StreamCodec


MAX_WAITING_FRAMES: Final = 16
"""Largest number of encoded frames that wait for the decoder. If there are more, all are dropped,
and decoding continues with a key frame."""

MAX_UNDECODABLE_FRAMES: Final = 10
"""Number of undecodable frames in a row after which the stream may end with an error."""

FAILURE_GRACE: Final = 3.0
"""Seconds of undecodable frames before the stream ends: meanwhile another sender may take over."""


DRAIN_TIMEOUT: Final = 5.0
"""Seconds within which queued frames are decoded after a stream's end."""

DRAIN_CHECK_INTERVAL: Final = 0.005
"""Seconds between two checks of the queue after a stream's end."""


class UnitSource(Protocol):
    """The part of a receiver that decoding uses."""

    def utc(self, timestamp: int, /) -> float | None:
        """Return a time on the sender's wall clock; None: not reported yet."""
        ...

    def request_key_frame(self) -> None:
        """Ask for a key frame."""
        ...

    def note_decoded(self) -> None:
        """Record that a picture was decoded."""
        ...


class DecodingPlan(NamedTuple):
    """The options for decoding a stream.

    Attributes:
        name: name of the source.
        codec: codec of the stream.
        delay: longest time from exposure to arrival, seconds.
        size: size that the pictures must have; None: any.
        sets: parameter sets from the stream's description, with start codes; b"": none.
        pixel_format: pixel format of FFmpeg that pictures are converted to; "": no conversion.
        passes_encoded: whether encoded frames are passed on without decoding.
    """

    name: str
    codec: StreamCodec
    delay: float
    size: tuple[int, int] | None = None
    sets: bytes = b""
    pixel_format: str = ""
    passes_encoded: bool = False


class UnitDecoding:
    """Decode a stream for a driver.

    Args:
        plan: options for decoding.
        sink: receiver of the frames and of the final error.
    """

    def __init__(self, plan: DecodingPlan, sink: FrameSink) -> None:
        self._plan, self._sink, self._name = plan, sink, plan.name
        self._size = plan.size or (plan.codec.size_in(plan.sets) if plan.sets else None)
        self._loop = asyncio.get_running_loop()
        self._units: collections.deque[tuple[AccessUnit, float | None]] = collections.deque()
        self._unit_queued = asyncio.Event()
        self.overflows = 0
        self._source: UnitSource | None = None
        self._skipped_units = 0  # number of units dropped since the last decoded one
        self._must_restart = True  # whether decoding must restart with the next unit
        self._reorders = False
        self._pace = _UnitPace()
        self._missed_frames = self._sequence = 0
        self._failed_in_row = 0  # number of consecutive undecodable frames
        self._failing_since = 0.0
        self._has_shown = False
        self._ended = False
        self._codecs = Codecs(threads=1)
        self._run = StreamRunner(self._codecs)
        self._decoder: H264Decoder | None = None
        self._idle = False  # True while no frame is decoded or queued
        self._task: asyncio.Task[None] | None = None

    async def start(self, source: UnitSource) -> None:
        """Start decoding the frames of a source."""
        self._source = source
        await self._codecs.__aenter__()
        self._task = asyncio.create_task(self._decode_queued(), name=f"frames of {self._name}")

    async def stop(self) -> None:
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

    def report_end(self, error: FrameSourceError) -> None:
        """Report the end to the sink, once."""
        if not self._ended:
            self._ended = True
            error.source = self._name
            if self._missed_frames and self._has_shown:
                self._sink.lost(self._missed_frames)
            self._sink.ended(error)

    async def finish(self, error: FrameSourceError) -> None:
        """Report the end to the sink after decoding the queued frames.

        The wait is bounded by :data:`DRAIN_TIMEOUT`.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(DRAIN_TIMEOUT):
                while self._units and not self._ended:  # noqa: ASYNC110 - there is no event
                    await asyncio.sleep(DRAIN_CHECK_INTERVAL)
        self.report_end(error)

    def queue_units(self, units: list[AccessUnit]) -> None:
        """Queue encoded frames for the decoder; drop all queued frames if there are too many."""
        source = self._source
        assert source is not None  # noqa: S101 - set by start
        self._units += [(unit, source.utc(unit.timestamp)) for unit in units]
        if len(self._units) > MAX_WAITING_FRAMES:
            self.overflows += 1
            self._skipped_units += len(self._units)
            self._missed_frames += sum(self._pace.lost_frames(unit) for unit, _ in self._units)
            self._must_restart |= any(unit.starts_stream for unit, _ in self._units)
            self._units.clear()
            source.request_key_frame()
        if self._idle and self._units and self._run.runs_in_loop and not self._ended:
            try:
                run_without_waiting(self._decode_next())
            except Exception as exc:  # noqa: BLE001 - passed on to readers
                self._report_failure(exc)
        if self._units:
            self._unit_queued.set()

    def _report_failure(self, exc: Exception) -> None:
        """Report an error of any kind to the sink."""
        if not isinstance(exc, FrameSourceError):
            error = FrameSourceError(f"{self._name}: {exc!r}")
            error.__cause__ = exc
            exc = error
        self.report_end(exc)

    async def _decode_queued(self) -> None:
        """Decode queued frames until the stream ends."""
        try:
            while not self._ended:
                if not self._units:
                    self._unit_queued.clear()
                    self._idle = True
                    await self._unit_queued.wait()
                self._idle = False
                if self._units:
                    await self._decode_next()
                    await asyncio.sleep(0)  # several pictures must not block the loop
        except Exception as exc:  # noqa: BLE001 - passed on to readers
            self._report_failure(exc)

    async def _decode_next(self) -> None:
        unit, device_time = self._units.popleft()
        is_restart = unit.starts_stream or self._must_restart
        is_reordered = not is_restart and self._pace.comes_before_last(unit)
        missing = self._pace.lost_frames(unit) + self._skipped_units
        self._missed_frames += missing
        if is_reordered and not self._reorders:
            self._reorders = is_restart = True
        if is_restart or self._decoder is None:
            self._decoder = self._new_decoder()
            unit = self._with_parameters(unit) if is_restart else unit
        elif missing:
            self._decoder.note_loss()
        self._skipped_units, self._must_restart = 0, False
        await self._decode_unit(self._decoder, unit, device_time)

    def _new_decoder(self) -> H264Decoder:
        reorders, pixel_format = self._reorders, self._plan.pixel_format
        return self._plan.codec.decoder(self._run, reorders=reorders, pixel_format=pixel_format)

    def _with_parameters(self, unit: AccessUnit) -> AccessUnit:
        if not self._plan.sets or self._plan.codec.size_in(unit.data) is not None:
            return unit
        return unit._replace(data=self._plan.sets + unit.data)

    async def _decode_unit(
        self, decoder: H264Decoder, unit: AccessUnit, device_time: float | None
    ) -> None:
        """Decode an encoded frame, and pass its picture on."""
        frame = self._encoded_frame(unit, device_time)
        if frame is not None and not self._plan.passes_encoded:
            frame = await self._decode_frame(decoder, frame)
        if frame is not None:
            self._pass_on(frame)
        elif not (self._reorders and decoder.has_whole_picture):  # else it waits for later frames
            self._missed_frames += 1
            if self._source is not None:
                self._source.request_key_frame()

    def _encoded_frame(self, unit: AccessUnit, device_time: float | None) -> Frame | None:
        """Return an encoded frame; None: the size is not known yet."""
        size = self._size = self._plan.codec.size_in(unit.data) or self._size
        if size is None:
            return None
        if self._plan.size not in (None, size):
            raise FrameFormatError(
                f"{self._name}: expected {_format_size(self._plan.size)}, the size at the opening, "
                f"got {_format_size(size)}: open it again",
                available=(_format_size(size),),
            )
        age = self._loop.time() - unit.arrived_at
        return Frame(
            data=unit.data,
            format=find_format(self._plan.codec.format),
            width=size[0],
            height=size[1],
            stride=0,
            captured=time.monotonic() - age,
            utc=time.time() - age,
            moment=Moment.ARRIVAL,
            duration=self._plan.delay,
            device_time=device_time,
            sequence=0,
            source=self._name,
        )

    async def _decode_frame(self, decoder: H264Decoder, frame: Frame) -> Frame | None:
        try:
            decoded = await decoder.decode(frame)
        # a single frame may be damaged; many in a row are an error
        except FrameFormatError as exc:
            self._failed_in_row += 1
            if self._failed_in_row == 1:
                self._failing_since = self._loop.time()
            too_long = self._loop.time() - self._failing_since >= FAILURE_GRACE
            if self._failed_in_row < MAX_UNDECODABLE_FRAMES or not too_long:
                return None
            raise FrameFormatError(f"{self._name}: {exc}", available=exc.available) from exc
        self._failed_in_row = 0
        return decoded

    def _pass_on(self, picture: Frame) -> None:
        if self._source is not None:
            self._source.note_decoded()
        lost, self._missed_frames = self._missed_frames if self._has_shown else 0, 0
        self._has_shown = True
        self._sequence += 1 + lost
        if not self._ended:
            self._sink.frame(amend(picture, sequence=self._sequence, lost=lost))


class _UnitPace:
    """Estimate the number of frames lost in a gap from the time between frames."""

    def __init__(self) -> None:
        self._last_timestamp: int | None = None
        self._frame_ticks = 0  # ticks between the last two consecutive frames

    def comes_before_last(self, unit: AccessUnit) -> bool:
        """Return True if a frame must be shown before an earlier received one."""
        return (
            self._last_timestamp is not None and -MAX_STEP_TICKS < self._ticks_since_last(unit) < 0
        )

    def lost_frames(self, unit: AccessUnit) -> int:
        """Return the estimated number of frames lost before this frame.

        If whole frames were lost, their number follows from the gap and the time between earlier
        frames. It is at most the number of damaged frames and lost packets.
        """
        is_first = self._last_timestamp is None or unit.starts_stream
        since = 0 if is_first else self._ticks_since_last(unit)
        min_lost = max(unit.damaged_frames, 1 if unit.lost_packets or unit.starts_stream else 0)
        if not min_lost and 0 < since < MAX_STEP_TICKS:
            self._frame_ticks = since
        if self._last_timestamp is None or since >= 0:
            self._last_timestamp = unit.timestamp
        estimate = round(since / self._frame_ticks) - 1 if self._frame_ticks and since > 0 else 0
        return max(min_lost, min(estimate, unit.damaged_frames + unit.lost_packets))

    def _ticks_since_last(self, unit: AccessUnit) -> int:
        since = unit.timestamp - (self._last_timestamp or 0)
        return (since + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000


MAX_STEP_TICKS: Final = 60 * 90_000
"""Largest time between two frames, ticks, that counts as the time between frames."""


def _format_size(size: tuple[int, int] | None) -> str:
    return "any size" if size is None else f"{size[0]}x{size[1]}"
