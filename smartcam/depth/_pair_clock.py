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
"""Pairs that are remembered: 20 s at 30 pairs a second."""

SKEW_PAIRS: Final = 30
"""Pairs over which the skew is measured."""

MIN_PAIRS: Final = 30
"""Pairs needed to know a rate."""


class _SeenPair(NamedTuple):
    captured: tuple[float, float]  # left and right, seconds of ours
    sequence: tuple[int, int]


class PairClock:
    """Skew and drift of two cameras, from the frames that were paired."""

    def __init__(self) -> None:
        self._seen: collections.deque[_SeenPair] = collections.deque(maxlen=MAX_PAIRS)

    def saw(self, left: Frame, right: Frame) -> None:
        """Take a pair; one whose numbers begin again begins everything again."""
        now = _SeenPair((left.captured, right.captured), (left.sequence, right.sequence))
        if self._seen and not all(
            a < b for a, b in zip(self._seen[-1].sequence, now.sequence, strict=True)
        ):
            self._seen.clear()
        self._seen.append(now)

    def skew(self) -> float | None:
        """Return the median skew of the last pairs, seconds the right one is later."""
        recent = list(self._seen)[-SKEW_PAIRS:]
        if not recent:
            return None
        return statistics.median(one.captured[1] - one.captured[0] for one in recent)

    def drift(self, clocks: Sequence[ClockStatistics | None]) -> tuple[float | None, str]:
        """Return by how much the right clock is faster, and what says so.

        Both cameras count their frames by their own clocks: where those tell no time, and the
        nominal rates are the same, the ratio of the rates is that of the clocks.
        """
        left, right = (None if one is None else one.drift for one in clocks)
        if left is not None and right is not None:
            return (right - left) / (1 + left), "clocks"
        rates = self._rates()
        if rates is None:
            return None, ""
        drift = rates[1] / rates[0] - 1
        return (drift, "frames") if abs(drift) <= MAX_DRIFT else (None, "")

    def _rates(self) -> tuple[float, float] | None:
        """Return both cameras' frames per second of our clock."""
        seen = list(self._seen)
        if len(seen) < MIN_PAIRS or seen[-1].captured[0] - seen[0].captured[0] < MIN_DRIFT_DURATION:
            return None
        found = []
        for side in (0, 1):
            at = np.array([one.captured[side] - seen[0].captured[side] for one in seen])
            number = np.array([one.sequence[side] - seen[0].sequence[side] for one in seen])
            found.append(float(np.polyfit(at, number, 1)[0]))
        return (found[0], found[1]) if min(found) > 0 else None
