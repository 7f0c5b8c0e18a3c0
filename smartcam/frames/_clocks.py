"""A camera's own clock on ours: what it says becomes seconds of ``time.monotonic()``."""

from __future__ import annotations

import collections
from dataclasses import dataclass
from typing import Final

WINDOW: Final = 40
"""Pieces of time that are remembered."""

PIECE: Final = 0.5
"""Seconds of one: of each the frame that came soonest counts."""

FAST: Final = 0.05
"""Seconds; a frame that comes sooner than the clock allows by more means that the clock jumped."""

SETTLED: Final = 4
"""Pieces from which on one is sure of that: before, the frames may all have been late."""

SLOW: Final = 1.0
"""Seconds; frames that all come later by more mean the same: no way here takes that long."""

PATIENCE: Final = 5
"""So many such frames in a row."""

LEAST_SPAN: Final = 4.0
"""Seconds of frames from which on a drift is told."""

MOST_DRIFT: Final = 0.01
"""A clock that is more than 1 % off is not followed: that is no drift, but another unit."""


@dataclass(frozen=True, slots=True)
class ClockStatistics:
    """What is known of a camera's clock.

    Attributes:
        drift: by how much it is too fast, seconds a second; None: not known yet.
        jumps: how often it was set anew, forwards or backwards.
    """

    drift: float | None
    jumps: int


class DeviceClock:
    """Where a device's clock is on ours, from when its frames arrive.

    A frame arrives after it was taken, by a way that takes longer now and shorter then. So
    arrival minus device time has a lower edge, which is the offset between the clocks and the
    shortest way; its slope is the drift. What is found is late by the shortest way, and by nothing
    else.
    """

    def __init__(self) -> None:
        self._lowest: collections.deque[tuple[float, float]] = collections.deque(maxlen=WINDOW)
        self._drift: float | None = None
        self._last: float | None = None
        self._piece_began = 0.0
        self._slow = 0
        self._jumps = 0

    def statistics(self) -> ClockStatistics:
        """Return what is known now."""
        # device = (arrival - offset) / (1 + slope): a slope above 0 is a clock that is too slow
        drift = None if self._drift is None else -self._drift / (1 + self._drift)
        return ClockStatistics(drift, self._jumps)

    def captured(self, device: float, arrival: float) -> float:
        """Return a device's time on ours; never later than ``arrival``.

        Args:
            device: what its clock said, seconds.
            arrival: when that came, seconds of ``time.monotonic()``.
        """
        if self._jumped(device, arrival):
            self._jumps += 1
            self._lowest.clear()
            self._drift, self._slow = None, 0
        self._last = device
        self._remember(device, arrival - device)
        return min(arrival, device + self._offset(device))

    def _jumped(self, device: float, arrival: float) -> bool:
        if self._last is None:
            return False
        if device < self._last:
            return True
        late = arrival - device - self._offset(device)
        self._slow = self._slow + 1 if late > SLOW else 0
        settled = len(self._lowest) >= SETTLED
        return (late < -FAST and settled) or self._slow >= PATIENCE

    def _remember(self, device: float, offset: float) -> None:
        if not self._lowest or device - self._piece_began >= PIECE:
            self._piece_began = device
            self._lowest.append((device, offset))
        elif offset < self._lowest[-1][1]:
            self._lowest[-1] = (device, offset)
        else:
            return
        self._drift = self._slope()

    def _slope(self) -> float | None:
        """Return the slope of the lower edge; None where too little is known."""
        points = list(self._lowest)
        if points[-1][0] - points[0][0] < LEAST_SPAN:
            return None
        half = len(points) // 2
        first, second = _lowest(points[:half], 0.0), _lowest(points[half:], 0.0)
        for _ in range(3):  # with the slope taken off, the same again
            slope = _slope(first, second)
            first = _lowest(points[:half], slope)
            second = _lowest(points[half:], slope)
        slope = _slope(first, second)
        return slope if abs(slope) <= MOST_DRIFT else None

    def _offset(self, device: float) -> float:
        slope = self._drift or 0.0
        return min(offset + slope * (device - at) for at, offset in self._lowest)


def _slope(first: tuple[float, float], second: tuple[float, float]) -> float:
    return (second[1] - first[1]) / (second[0] - first[0])


def _lowest(points: list[tuple[float, float]], slope: float) -> tuple[float, float]:
    """Return the point that a line of a slope, raised from below, meets first."""
    return min(points, key=lambda one: one[1] - slope * one[0])
