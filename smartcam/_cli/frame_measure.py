"""Measure a source of frames: rate, jitter, age, latency, losses, load of the processor."""

from __future__ import annotations

import asyncio
import math
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from smartcam.exceptions import FrameSourceError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.frames import Frame, FrameReader, FrameSource

STAMP_PERIOD: Final = 0.1
"""Seconds between two searches for a stamp: the time, which synthetic:// draws into pictures."""

STAMP_ROWS: Final = 16
"""Number of rows of a picture that a stamp covers."""

MAX_LATENCY: Final = 60.0
"""Largest plausible latency, seconds; beyond it, or below 0, the stamp is of another clock."""


async def measure(source: FrameSource, seconds: float) -> dict[str, Any]:
    """Read a source for some time, from its first frame on, and return the figures.

    Raises:
        FrameSourceError: the source gave no frame, or ended with an error.

    Cancellation: safe; reading stops.
    """
    async with source.reader() as reader:
        try:
            first = await anext(reader)
        except StopAsyncIteration:
            raise FrameSourceError(f"{source.name}: it ended before its first frame") from None
        received = _ReceivedFrames(first)
        started_at, cpu_start = time.monotonic(), time.process_time()
        try:
            async with asyncio.timeout(seconds):
                await received.read(reader)
        except TimeoutError as exc:
            if isinstance(exc, FrameSourceError):  # a FrameTimeoutError is a timeout, too
                raise
        finally:
            elapsed = time.monotonic() - started_at
            cpu_time = time.process_time() - cpu_start
            await received.stamps.wait_for_search()
        return {
            "source": source.name,
            **_picture(first),
            "seconds": elapsed,
            **received.figures(),
            "cpu_percent": 100 * cpu_time / elapsed if elapsed else None,
        }


def _picture(frame: Frame) -> dict[str, Any]:
    return {"format": frame.format.name, "width": frame.width, "height": frame.height}


@dataclass(slots=True)
class _Stamps:
    """Measures latencies by the stamps in pictures, which a thread reads."""

    latencies: list[float] = field(default_factory=list[float])
    _last: float = -math.inf
    _task: asyncio.Task[None] | None = None

    def look_for_stamp(self, frame: Frame, now: float) -> None:
        """Look for a stamp in the frame, if the last search is over and not too recent.

        ``now``: time of the frame's arrival.
        """
        if now - self._last < STAMP_PERIOD or not (self._task is None or self._task.done()):
            return
        self._last = now
        self._task = asyncio.create_task(self._read_stamp(frame, now))

    async def wait_for_search(self) -> None:
        """Wait until the running search for a stamp ends."""
        if self._task is not None:
            await asyncio.wait([self._task])

    async def _read_stamp(self, frame: Frame, arrived_at: float) -> None:
        stamp = await asyncio.to_thread(_stamp_of, frame)
        if stamp is not None and 0 <= arrived_at - stamp < MAX_LATENCY:
            self.latencies.append(arrived_at - stamp)


def _stamp_of(frame: Frame) -> float | None:
    from smartcam.frames._inside import read_stamp

    try:
        stamp = read_stamp(frame.grey()[:STAMP_ROWS])
    except FrameSourceError:  # a frame without brightness, or wrong bytes: no stamp
        return None
    return None if stamp is None else stamp[1] / 1e9


class _ReceivedFrames:
    """Reads frames from a reader and keeps what the figures need.

    ``first``: the frame that was read already.
    """

    def __init__(self, first: Frame) -> None:
        self.stamps = _Stamps()
        self._first = self._last = first
        self._intervals: list[float] = []
        self._ages: list[float] = []
        self._frames_received = 1
        self._delivered = self._skipped = self._lost = 0
        self._note_frame(first)

    async def read(self, reader: FrameReader) -> None:
        """Read to the end of the source."""
        lost = reader.statistics().lost
        self._delivered = 1
        async for frame in reader:
            statistics = reader.statistics()
            if statistics.skipped == self._skipped and not frame.lost:
                self._intervals.append(frame.captured - self._last.captured)
            self._frames_received = statistics.delivered + statistics.skipped
            self._delivered, self._skipped = statistics.delivered, statistics.skipped
            self._lost = statistics.lost - lost
            self._last = frame
            self._note_frame(frame)

    def _note_frame(self, frame: Frame) -> None:
        now = time.monotonic()
        self._ages.append(now - frame.captured)
        self.stamps.look_for_stamp(frame, now)

    def figures(self) -> dict[str, Any]:
        """Return the figures; None for a figure that needs more frames."""
        span = self._last.captured - self._first.captured
        return {
            "frames": self._delivered,
            "lost": self._lost,
            "skipped": self._skipped,
            "rate": (self._frames_received - 1) / span if span > 0 else None,
            "interval_ms": _ms(_mean(self._intervals)),
            "jitter_ms": _ms(_deviation(self._intervals)),
            "longest_ms": _ms(max(self._intervals, default=None)),
            "moment": self._first.moment.value,
            "age_ms": _spread(self._ages),
            "latency_ms": _spread(self.stamps.latencies),
            "stamps": len(self.stamps.latencies),
        }


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else round(1e3 * seconds, 4)


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _deviation(values: Sequence[float]) -> float | None:
    mean = _mean(values)
    if mean is None or len(values) < 2:
        return None
    return math.sqrt(sum((value - mean) ** 2 for value in values) / (len(values) - 1))


def _spread(seconds: Sequence[float]) -> dict[str, float | None] | None:
    """Return the median, the 99th percentile and the maximum, in milliseconds."""
    if not seconds:
        return None
    in_order = sorted(seconds)
    shares = {"median": 0.5, "p99": 0.99, "worst": 1.0}
    return {name: _ms(in_order[round(part * (len(in_order) - 1))]) for name, part in shares.items()}


def measurement_text(value: dict[str, Any]) -> str:
    """Return the measured rates, ages and latencies as lines for people."""
    head = f"{value['source']}: {value['format']} {value['width']}x{value['height']}"
    rows = [
        f"{head}, {value['frames']} frames in {value['seconds']:.1f} s",
        f"  rate      {_figure(value['rate'], 'a second')}",
        f"  interval  {_figure(value['interval_ms'], 'ms')}, jitter "
        f"{_figure(value['jitter_ms'], 'ms rms')}, longest {_figure(value['longest_ms'], 'ms')}",
        f"  age       {_spread_text(value['age_ms'])}, since the {value['moment']}",
    ]
    if value["latency_ms"] is not None:
        rows.append(
            f"  latency   {_spread_text(value['latency_ms'])}, by the stamp in {value['stamps']} "
            "pictures"
        )
    else:
        rows.append("  latency   not known: the pictures have no stamp of this machine's clock")
    rows += [
        f"  lost      {value['lost']}, skipped {value['skipped']}",
        f"  CPU       {_figure(value['cpu_percent'], '% of a core')}",
    ]
    return "\n".join(rows)


def _figure(number: float | None, unit: str) -> str:
    return "not known" if number is None else f"{number:.4g} {unit}"


def _spread_text(spread: dict[str, float | None] | None) -> str:
    if spread is None:
        return "not known"
    return (
        f"median {_figure(spread['median'], 'ms')}, p99 {_figure(spread['p99'], 'ms')}, "
        f"worst {_figure(spread['worst'], 'ms')}"
    )
