"""Estimate the offset and drift between two cameras' clocks."""

from __future__ import annotations

import collections
import statistics
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.frames._inside import MAX_DRIFT, MIN_DRIFT_DURATION

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.frames import Frame
    from smartcam.frames._inside import ClockStatistics

MAX_PAIRS: Final = 600
"""Largest number of pairs that are kept: 20 s at 30 pairs per second."""

SKEW_PAIRS: Final = 30
"""Number of recent pairs over which the skew is measured."""

MIN_PAIRS: Final = 30
"""Least number of pairs to estimate frame rates."""


class _TimedPair(NamedTuple):
    captured: tuple[float, float]  # left and right, seconds of the local clock
    sequence: tuple[int, int]


class PairClock:
    """Estimate skew and drift of two cameras from their paired frames."""

    def __init__(self) -> None:
        self._pairs: collections.deque[_TimedPair] = collections.deque(maxlen=MAX_PAIRS)

    def add_pair(self, left: Frame, right: Frame) -> None:
        """Record a pair; restart if a camera's frame numbers restarted."""
        pair = _TimedPair((left.captured, right.captured), (left.sequence, right.sequence))
        if self._pairs and not all(
            a < b for a, b in zip(self._pairs[-1].sequence, pair.sequence, strict=True)
        ):
            self._pairs.clear()
        self._pairs.append(pair)

    def skew(self) -> float | None:
        """Return the median time, seconds, from the left to the right frames of recent pairs."""
        recent = list(self._pairs)[-SKEW_PAIRS:]
        if not recent:
            return None
        return statistics.median(pair.captured[1] - pair.captured[0] for pair in recent)

    def drift(self, clocks: Sequence[ClockStatistics | None]) -> tuple[float | None, str]:
        """Return the right clock's drift relative to the left clock, and the source of this value.

        Each camera's own clock sets its frame rate. So without the clocks' timestamps, and with
        the same nominal rate, the ratio of the measured frame rates is the ratio of the clocks.
        """
        left, right = (None if clock is None else clock.drift for clock in clocks)
        if left is not None and right is not None:
            return (right - left) / (1 + left), "clocks"
        rates = self._rates()
        if rates is None:
            return None, ""
        drift = rates[1] / rates[0] - 1
        return (drift, "frames") if abs(drift) <= MAX_DRIFT else (None, "")

    def _rates(self) -> tuple[float, float] | None:
        """Return both cameras' frame rates by the local clock."""
        pairs = list(self._pairs)
        if (
            len(pairs) < MIN_PAIRS
            or pairs[-1].captured[0] - pairs[0].captured[0] < MIN_DRIFT_DURATION
        ):
            return None
        rates = []
        for side in (0, 1):
            times = np.array([pair.captured[side] - pairs[0].captured[side] for pair in pairs])
            frame_numbers = np.array(
                [pair.sequence[side] - pairs[0].sequence[side] for pair in pairs]
            )
            rates.append(float(np.polyfit(times, frame_numbers, 1)[0]))
        return (rates[0], rates[1]) if min(rates) > 0 else None
