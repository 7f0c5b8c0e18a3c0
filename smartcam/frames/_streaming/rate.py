"""Choose JPEG quality and frame rate for a wanted bit rate or latency."""

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
"""Duration, seconds, over which frames and bytes are counted."""

CHANGE_FACTOR: Final = 1.4
"""Factor by which a value must differ from its mean to count as a change."""

MAX_RISE_PER_SECOND: Final = 1.3
"""Factor by which the bit rate may rise in a second, after the start."""

MAX_FIRST_RISE_PER_SECOND: Final = 8.0
"""Factor by which the bit rate may rise in a second until its first drop."""

MIN_DEVIATION_SHARE: Final = 0.03
"""Share of a value below which a deviation is not corrected."""

BUSY_SHARE: Final = 0.7
"""Share of the time with frames on the way, above which the link limits the frame rate."""

SLOW_SOURCE_FACTOR: Final = 1.15
"""Factor by which pauses between frames are longer if the source limits the frame rate."""

FREE_SHARE: Final = 0.5
"""Share of the time with frames on the way, below which a lower frame rate does not reduce
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
        quality: JPEG quality for the next frames.
        fps: largest frame rate, frames per second.
        why: reason for these values: "bit rate", "latency" or "the best quality"; "" before the
            first frame. "at the lowest quality" is appended if the frame rate is lowered, too, and
            "no frame may be smaller, nor fewer" if all limits are reached.
        bitrate: recent bit rate, bits per second.
        latency: recent time from capture to arrival, seconds.
    """

    quality: int
    fps: float
    why: str
    bitrate: float
    latency: float


class _Mean:
    """A mean of recent values, weighted by time."""

    def __init__(self) -> None:
        self.value = self._weight = 0.0

    def add(self, value: float, seconds: float) -> None:
        alike = self.value / CHANGE_FACTOR < value < self.value * CHANGE_FACTOR
        over = STEADY_AVERAGING_TIME if alike else CHANGE_AVERAGING_TIME
        keeps = self._weight * math.exp(-seconds / over)
        new = -math.expm1(-seconds / over)
        self._weight = keeps + new
        if self._weight:
            self.value += (value - self.value) * new / self._weight


class _Flow:
    """Number of recent frames and bytes, and their duration in seconds."""

    def __init__(self) -> None:
        self.frames = self.bytes = self.seconds = 0.0

    def add(self, size: int, seconds: float) -> None:
        keeps = math.exp(-seconds / COUNTED_SECONDS)
        self.frames = self.frames * keeps + 1
        self.bytes = self.bytes * keeps + size
        self.seconds = self.seconds * keeps + seconds


class RateControl:
    """Keep a bit rate or a latency, first by the quality of JPEGs, then by the frame rate.

    ::

        control = RateControl(bitrate=4e6)
        ...  # send a frame of control.quality, control.pause seconds after the last one at least
        control.sent(size, went, took)

    The control lowers the quality to its limit, and only then the frame rate; it raises the frame
    rate first. It follows a drop within a second, and rises by at most 30 % per second to avoid
    oscillation. Of a bit rate and a latency, the stricter one is kept.

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
        self._rise = MAX_FIRST_RISE_PER_SECOND
        self._why: str = ""
        self._logged_fps = self._fps
        self._went: float | None = None
        # frame rate of the source, frames per second; 0: unknown
        self._comes = 0.0
        self._flow = _Flow()
        self._weight = _Mean()  # size of a frame with quantization steps of 1, bytes
        self._transit = _Mean()  # seconds per byte on the way
        self._age, self._took = _Mean(), _Mean()

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
        flow = self._flow
        return RateStatistics(
            self.quality,
            self._fps,
            self._why,
            8 * flow.bytes / flow.seconds if flow.seconds else 0.0,
            self._age.value + self._took.value,
        )

    def sent(
        self, size: int, went: float, took: float, *, age: float = 0.0, quality: int | None = None
    ) -> None:
        """Record a frame that has arrived, and adjust quality and frame rate.

        Args:
            size: bytes of the frame.
            went: time at which the frame was sent, in seconds of any clock.
            took: time until the frame arrived, seconds.
            age: time from the frame's capture until it was sent, seconds.
            quality: quality of the frame; None: the current quality.
        """
        size, took = max(1, size), max(1e-6, took)
        if self._went is None or went <= self._went:
            seconds = self.pause
        else:
            seconds = went - self._went
            self._flow.add(size, seconds)
            self._learn(took / seconds)
        self._went = went
        had = self.quality if quality is None else quality
        # a frame that is long on its way is counted only once
        of_late = max(seconds, took)
        self._weight.add(size * _steps(had) ** SIZE_EXPONENT, of_late)
        self._transit.add(took / size, of_late)
        self._age.add(age, of_late)
        self._took.add(took, of_late)
        self._follow(seconds)

    def _learn(self, busy: float) -> None:
        """Estimate the source's frame rate if neither the link nor this control limits it."""
        rate = self._flow.frames / self._flow.seconds
        if busy < BUSY_SHARE and (
            self._fps >= self._rates[1] or rate * SLOW_SOURCE_FACTOR < self._fps
        ):
            self._comes = rate

    def _follow(self, seconds: float) -> None:
        """Move towards the target values: down at once, up slowly."""
        least, best = self._qualities
        wanted, wanted_fps, why = self._wanted()
        quality = min(best, max(least, _quality(self._weight.value / wanted)))
        grows = self._rise ** min(seconds, STEADY_AVERAGING_TIME)
        if wanted_fps < self._fps * (1 - MIN_DEVIATION_SHARE):
            self._fps, self._rise = wanted_fps, MAX_RISE_PER_SECOND
        elif wanted_fps > self._fps:
            self._fps = min(wanted_fps, self._fps * grows)
        has = self._bytes(self._quality)
        if wanted < has * (1 - MIN_DEVIATION_SHARE) and quality < self._quality:
            self._quality, self._rise = quality, MAX_RISE_PER_SECOND
        elif wanted > has * (1 + MIN_DEVIATION_SHARE) and self._fps >= self._rates[1]:
            slowly = _quality(self._weight.value / (has * grows))
            self._quality = max(self._quality, min(quality, slowly))
        if why in {"bit rate", "latency"}:
            if self._fps < self._rates[1]:  # while the frame rate recovers
                why = f"{why}, at the lowest quality"
            elif self._quality >= best:
                why = "the best quality"
        self._why = why
        self._log_change()

    def _wanted(self) -> tuple[float, float, str]:
        """Return the target size of a frame, bytes, the frame rate, and the reason."""
        fewest, most = self._rates
        smallest = self._bytes(self._qualities[0])
        limits: list[tuple[float, float, str]] = []
        if self._bitrate is not None:
            comes = min(most, max(fewest, self._comes or most))
            limits.append((self._bitrate / 8 / comes, self._bitrate / 8 / smallest, "bit rate"))
        if self._latency is not None:
            size = max(1.0, (self._latency - self._age.value) / self._transit.value)
            limits.append(
                (size, max(most * size / smallest, FREE_SHARE / self._took.value), "latency")
            )
        size, _, name = min(limits)
        if size >= smallest:
            return size, most, name
        fps = min(fps for limit, fps, _ in limits if limit < smallest)
        if fps < fewest:
            return size, fewest, f"{name}: no frame may be smaller, nor fewer"
        return size, min(most, fps), f"{name}, at the lowest quality"

    def _bytes(self, quality: float) -> float:
        return self._weight.value / float(_steps(quality) ** SIZE_EXPONENT)

    def _log_change(self) -> None:
        back = self._fps == self._rates[1] != self._logged_fps
        change = self._fps / self._logged_fps
        if back or not 1 / LOGGED_CHANGE_FACTOR < change < LOGGED_CHANGE_FACTOR:
            self._logged_fps = self._fps
            logger.info("frames: %.3g a second at most: %s", self._fps, self._why)


def _steps(quality: float) -> float:
    """Return the scale of a JPEG's quantization steps, 1 at quality 50 (libjpeg's definition)."""
    return 50 / quality if quality < 50 else max(0.02, (100 - quality) / 50)


def _quality(weight: float) -> float:
    """Return the quality whose steps, to the power ``SIZE_EXPONENT``, are ``weight``."""
    steps = float(max(1e-3, weight) ** (1 / SIZE_EXPONENT))
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
    for name, value, least, most in (
        ("bitrate", bitrate, 1e3, 1e11),
        ("latency", latency, 1e-3, 60.0),
        ("quality", quality[0], 1, quality[1]),
        ("quality", quality[1], 1, 100),
        ("fps", fps[0], 0.01, fps[1]),
        ("fps", fps[1], 0.01, 1000.0),
    ):
        if value is not None:
            check_number(value, name, least, most, "RateControl")


def _check_pair(value: tuple[float, float], name: str) -> None:
    """Raise unless a value is a pair of numbers; the caller checks their range."""
    if not isinstance(value, tuple) or len(value) != 2:
        raise wrong_argument(name, "the least and the most, a pair", value, "RateControl")
    for number in value:
        check_number(number, name, 0, 1e9, "RateControl")
