"""Choose JPEG quality and frame rate so that a bit rate or latency is kept."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import Final

from smartcam._arguments import check_number, wrong_argument
from smartcam.exceptions import ConfigurationError

logger: logging.Logger = logging.getLogger("smartcam.frames")

CHANGE_AVERAGING_TIME: Final = 0.3
"""Averaging time, seconds, of the frames' size after a change of the scene."""

STEADY_AVERAGING_TIME: Final = 1.0
"""Averaging time, seconds, of the frames' size in a steady scene."""

COUNTED_SECONDS: Final = 2.0
"""Time constant, seconds, with which the counts of frames and bytes decay."""

CHANGE_FACTOR: Final = 1.4
"""Factor by which a value must differ from its mean to count as a sudden change."""

MAX_RISE_PER_SECOND: Final = 1.3
"""Factor by which the bit rate may rise in a second after its first drop."""

MAX_FIRST_RISE_PER_SECOND: Final = 8.0
"""Factor by which the bit rate may rise in a second until its first drop."""

MIN_DEVIATION_SHARE: Final = 0.03
"""Relative deviation from the target below which the quality stays unchanged, and the frame rate is
not lowered."""

BUSY_SHARE: Final = 0.7
"""The link limits the frame rate if a frame is in transit for at least this share of the time."""

SLOW_SOURCE_FACTOR: Final = 1.15
"""The source limits the frame rate if its rate times this factor is below the allowed rate."""

MAX_BUSY_SHARE_WHEN_FREE: Final = 0.5
"""If frames are in transit for less than this share of the time, a lower frame rate does not reduce
latency."""

LOGGED_CHANGE_FACTOR: Final = 1.25
"""Factor by which the frame rate must change before it is logged again."""

SIZE_EXPONENT: Final = 0.7
"""A JPEG's size is about proportional to this negative power of its quantization steps; feedback
corrects the rest."""


@dataclass(frozen=True, slots=True)
class RateStatistics:
    """Quality and rates of a rate control, with the reason.

    Attributes:
        quality: JPEG quality of the next frame.
        fps: largest frame rate, frames per second.
        reason: why these values: "bit rate", "latency" or "at the highest quality"; "" before the
            first frame. "at the lowest quality" follows if the frame rate is lowered, too, and
            "at the lowest quality and frame rate" if neither can be lowered further.
        bitrate: recent bit rate, bits per second.
        latency: recent time from capture to arrival, seconds.
    """

    quality: int
    fps: float
    reason: str
    bitrate: float
    latency: float


class _Mean:
    """A mean of recent values, weighted by time."""

    def __init__(self) -> None:
        self.value = self._weight = 0.0

    def add(self, value: float, seconds: float) -> None:
        is_steady = self.value / CHANGE_FACTOR < value < self.value * CHANGE_FACTOR
        averaging_time = STEADY_AVERAGING_TIME if is_steady else CHANGE_AVERAGING_TIME
        old_weight = self._weight * math.exp(-seconds / averaging_time)
        new_weight = -math.expm1(-seconds / averaging_time)
        self._weight = old_weight + new_weight
        if self._weight:
            self.value += (value - self.value) * new_weight / self._weight


class _RecentCounts:
    """Decaying counts of recent frames and bytes, and of the seconds in which they were sent."""

    def __init__(self) -> None:
        self.frames = self.bytes = self.seconds = 0.0

    def add(self, size: int, seconds: float) -> None:
        decay = math.exp(-seconds / COUNTED_SECONDS)
        self.frames = self.frames * decay + 1
        self.bytes = self.bytes * decay + size
        self.seconds = self.seconds * decay + seconds


class RateControl:
    """Keep a bit rate or a latency, first by the quality of JPEGs, then by the frame rate.

    ::

        control = RateControl(bitrate=4e6)
        ...  # send a frame of control.quality, control.pause seconds after the last one at least
        control.record_arrival(size, sent_at, transit_time)

    The control lowers the quality to its limit, and only then the frame rate; it raises the frame
    rate first. It follows a drop within a second. After the first drop it rises by at most
    30 % per second, to avoid oscillation. Of a bit rate and a latency, the stricter one is kept.

    Args:
        bitrate: bits per second on average.
        latency: seconds from capture to arrival.
        quality: lowest and highest JPEG quality, 1 to 100.
        fps: lowest and highest frame rate, frames per second.

    Raises:
        ConfigurationError: neither bit rate nor latency is given, or a value is out of range.
    """

    def __init__(
        self,
        bitrate: float | None = None,
        latency: float | None = None,
        quality: tuple[int, int] = (10, 90),
        fps: tuple[float, float] = (1.0, 30.0),
    ) -> None:
        _check(bitrate, latency, quality, fps)
        self._bitrate, self._latency = bitrate, latency
        self._qualities, self._rates = quality, fps
        self._quality, self._fps = float(quality[0]), float(fps[1])
        self._max_rise = MAX_FIRST_RISE_PER_SECOND
        self._reason: str = ""
        self._logged_fps = self._fps
        self._last_sent_at: float | None = None
        # frame rate of the source, frames per second; 0: unknown
        self._source_fps = 0.0
        self._recent = _RecentCounts()
        self._normalized_size = _Mean()  # bytes of a frame at quality 50
        self._time_per_byte = _Mean()  # transit time per byte, seconds
        self._age, self._transit_time = _Mean(), _Mean()

    @property
    def quality(self) -> int:
        """Quality for the next frame."""
        return round(self._quality)

    @property
    def fps(self) -> float:
        """Largest frame rate, frames per second."""
        return self._fps

    @property
    def pause(self) -> float:
        """Least time between two frames, seconds."""
        return 1 / self._fps

    def statistics(self) -> RateStatistics:
        """Return the current quality and rates, with the reason."""
        recent = self._recent
        return RateStatistics(
            self.quality,
            self._fps,
            self._reason,
            8 * recent.bytes / recent.seconds if recent.seconds else 0.0,
            self._age.value + self._transit_time.value,
        )

    def record_arrival(
        self,
        size: int,
        sent_at: float,
        transit_time: float,
        *,
        age: float = 0.0,
        quality: int | None = None,
    ) -> None:
        """Record a frame that has arrived, and adjust quality and frame rate.

        Args:
            size: bytes of the frame.
            sent_at: time at which the frame was sent, in seconds of any clock.
            transit_time: time until the frame arrived, seconds.
            age: time from the frame's capture until it was sent, seconds.
            quality: quality of the frame; None: the current quality.
        """
        size, transit_time = max(1, size), max(1e-6, transit_time)
        if self._last_sent_at is None or sent_at <= self._last_sent_at:
            seconds = self.pause
        else:
            seconds = sent_at - self._last_sent_at
            self._recent.add(size, seconds)
            self._estimate_source_rate(transit_time / seconds)
        self._last_sent_at = sent_at
        frame_quality = self.quality if quality is None else quality
        # a frame counts for the time since the last one, or for its transit if that is longer
        duration = max(seconds, transit_time)
        self._normalized_size.add(size * _step_scale(frame_quality) ** SIZE_EXPONENT, duration)
        self._time_per_byte.add(transit_time / size, duration)
        self._age.add(age, duration)
        self._transit_time.add(transit_time, duration)
        self._adjust(seconds)

    def _estimate_source_rate(self, busy_share: float) -> None:
        """Estimate the source's frame rate if neither the link nor this control limits it."""
        rate = self._recent.frames / self._recent.seconds
        if busy_share < BUSY_SHARE and (
            self._fps >= self._rates[1] or rate * SLOW_SOURCE_FACTOR < self._fps
        ):
            self._source_fps = rate

    def _adjust(self, seconds: float) -> None:
        """Lower the quality and the frame rate to their targets at once; raise them slowly."""
        min_quality, max_quality = self._qualities
        target_size, target_fps, reason = self._target()
        quality = _quality_for(self._normalized_size.value / target_size)
        quality = min(max_quality, max(min_quality, quality))
        max_growth = self._max_rise ** min(seconds, STEADY_AVERAGING_TIME)
        if target_fps < self._fps * (1 - MIN_DEVIATION_SHARE):
            self._fps, self._max_rise = target_fps, MAX_RISE_PER_SECOND
        elif target_fps > self._fps:
            self._fps = min(target_fps, self._fps * max_growth)
        current_size = self._frame_bytes(self._quality)
        if target_size < current_size * (1 - MIN_DEVIATION_SHARE) and quality < self._quality:
            self._quality, self._max_rise = quality, MAX_RISE_PER_SECOND
        elif target_size > current_size * (1 + MIN_DEVIATION_SHARE) and self._fps >= self._rates[1]:
            reachable = _quality_for(self._normalized_size.value / (current_size * max_growth))
            self._quality = max(self._quality, min(quality, reachable))
        if reason in {"bit rate", "latency"}:
            if self._fps < self._rates[1]:  # while the frame rate recovers
                reason = f"{reason}, at the lowest quality"
            elif self._quality >= max_quality:
                reason = "at the highest quality"
        self._reason = reason
        self._log_change()

    def _target(self) -> tuple[float, float, str]:
        """Return the target size of a frame, bytes, the frame rate, and the reason."""
        min_fps, max_fps = self._rates
        smallest = self._frame_bytes(self._qualities[0])
        limits: list[tuple[float, float, str]] = []
        if self._bitrate is not None:
            source_fps = min(max_fps, max(min_fps, self._source_fps or max_fps))
            limits.append(
                (self._bitrate / 8 / source_fps, self._bitrate / 8 / smallest, "bit rate")
            )
        if self._latency is not None:
            size = max(1.0, (self._latency - self._age.value) / self._time_per_byte.value)
            unqueued_fps = MAX_BUSY_SHARE_WHEN_FREE / self._transit_time.value
            limits.append((size, max(max_fps * size / smallest, unqueued_fps), "latency"))
        size, _, name = min(limits)
        if size >= smallest:
            return size, max_fps, name
        fps = min(fps for limit, fps, _ in limits if limit < smallest)
        if fps < min_fps:
            return size, min_fps, f"{name}, at the lowest quality and frame rate"
        return size, min(max_fps, fps), f"{name}, at the lowest quality"

    def _frame_bytes(self, quality: float) -> float:
        return self._normalized_size.value / float(_step_scale(quality) ** SIZE_EXPONENT)

    def _log_change(self) -> None:
        recovered = self._fps == self._rates[1] != self._logged_fps
        change = self._fps / self._logged_fps
        if recovered or not 1 / LOGGED_CHANGE_FACTOR < change < LOGGED_CHANGE_FACTOR:
            self._logged_fps = self._fps
            logger.info("frames: at most %.3g per second: %s", self._fps, self._reason)


def _step_scale(quality: float) -> float:
    """Return the scale of a JPEG's quantization steps: 1 at quality 50, as libjpeg defines it."""
    return 50 / quality if quality < 50 else max(0.02, (100 - quality) / 50)


def _quality_for(size_ratio: float) -> float:
    """Return the quality whose frames are ``size_ratio`` times smaller than those of quality 50."""
    steps = float(max(1e-3, size_ratio) ** (1 / SIZE_EXPONENT))
    return 50 / steps if steps > 1 else 100 - 50 * steps


def _check(
    bitrate: float | None,
    latency: float | None,
    quality: tuple[int, int],
    fps: tuple[float, float],
) -> None:
    if bitrate is None and latency is None:
        raise ConfigurationError("RateControl: expected a bit rate or a latency, got neither")
    _check_pair(quality, "quality")
    _check_pair(fps, "fps")
    for name, value, minimum, maximum in (
        ("bitrate", bitrate, 1e3, 1e11),
        ("latency", latency, 1e-3, 60.0),
        ("quality", quality[0], 1, quality[1]),
        ("quality", quality[1], 1, 100),
        ("fps", fps[0], 0.01, fps[1]),
        ("fps", fps[1], 0.01, 1000.0),
    ):
        if value is not None:
            check_number(value, name, minimum, maximum, "RateControl")


def _check_pair(value: tuple[float, float], name: str) -> None:
    """Raise unless a value is a pair of numbers; the caller checks their range."""
    if not isinstance(value, tuple) or len(value) != 2:
        raise wrong_argument(name, "the least and the most, a pair", value, "RateControl")
    for number in value:
        check_number(number, name, 0, 1e9, "RateControl")
