"""Convert the time of a camera's own clock to seconds of ``time.monotonic()``."""

from __future__ import annotations

import collections
from dataclasses import dataclass
from typing import Final

WINDOW: Final = 40
"""Number of intervals of time that are remembered."""

PIECE_DURATION: Final = 0.5
"""Seconds of one interval; of its frames only the one with the shortest delay counts."""

MIN_EARLY_JUMP_SECONDS: Final = 0.05
"""The clock has jumped if a frame comes this many seconds sooner than the clock allows."""

MIN_SURE_INTERVALS: Final = 4
"""Number of intervals after which such a jump is certain: before, all frames may have been late."""

MIN_DRIFT_DURATION: Final = 4.0
"""Seconds of frames needed to measure a drift."""

MAX_DRIFT: Final = 0.01
"""Largest drift that is followed; a clock with a larger one counts in another unit."""


@dataclass(frozen=True, slots=True)
class ClockStatistics:
    """The measured drift and jumps of a camera's clock.

    Attributes:
        drift: seconds per second by which the clock is too fast; None: not known yet.
        jumps: number of times that the clock was set anew, forwards or backwards.
    """

    drift: float | None
    jumps: int


class DeviceClock:
    """The offset of a device's clock from the host's, estimated from the arrival of its frames.

    A frame arrives after it was taken, with a delay that varies. So arrival minus device time has a
    lower edge, which is the offset between the clocks plus the shortest delay; its slope is the
    drift. The estimated time is late by the shortest delay, and by nothing else.

    If all frames come late, they have waited somewhere, for however long: the offset rises no
    faster than a clock can drift. A clock that was set back by less than the time between two
    frames looks the same; its frames count as older than they are until the offset has adapted.

    Attributes:
        jumps: number of times that the clock was set anew.
    """

    def __init__(self) -> None:
        self._lowest: collections.deque[tuple[float, float]] = collections.deque(maxlen=WINDOW)
        self._drift: float | None = None
        self._edge = (0.0, 0.0)  # the one of them that the lower edge goes through
        self._last: float | None = None
        self._piece_began = 0.0
        self._held: float | None = None  # the offset at the last frame
        self._before_queue: float | None = None  # the offset before frames were delayed
        self.jumps = 0

    def statistics(self) -> ClockStatistics:
        """Return the drift and the jumps of the device's clock known so far."""
        # device = (arrival - offset) / (1 + slope): a slope above 0 is a clock that is too slow
        drift = None if self._drift is None else -self._drift / (1 + self._drift)
        return ClockStatistics(drift, self.jumps)

    def captured(self, device: float, arrival: float) -> float:
        """Return a device's time on the host's clock, never later than ``arrival``.

        Args:
            device: time of the device's clock, seconds.
            arrival: time of arrival, seconds of ``time.monotonic()``.
        """
        if self._jumped(device, arrival):
            self.jumps += 1
            self._lowest.clear()
            self._drift = self._held = self._before_queue = None
        self._remember(device, arrival - device)
        offset = self._offset(device)
        if self._held is not None and self._last is not None:
            highest = self._held + MAX_DRIFT * (device - self._last)
            if offset <= highest:
                self._before_queue = None
            elif self._before_queue is None:
                self._before_queue = self._held
            offset = min(offset, highest)
        self._held, self._last = offset, device
        return min(arrival, device + offset)

    def _jumped(self, device: float, arrival: float) -> bool:
        if self._last is None:
            return False
        if device < self._last:
            return True
        late = arrival - device - self._offset(device)
        if self._before_queue is not None:  # frames come without delay again
            late = max(late, arrival - device - self._before_queue)
        return late < -MIN_EARLY_JUMP_SECONDS and len(self._lowest) >= MIN_SURE_INTERVALS

    def _remember(self, device: float, offset: float) -> None:
        if not self._lowest or device - self._piece_began >= PIECE_DURATION:
            self._piece_began = device
            self._lowest.append((device, offset))
        elif offset < self._lowest[-1][1]:
            self._lowest[-1] = (device, offset)
        else:
            return
        self._drift = self._slope()
        self._edge = _lowest(list(self._lowest), self._drift or 0.0)

    def _slope(self) -> float | None:
        """Return the slope of the lower edge; None if too little is known."""
        points = list(self._lowest)
        if points[-1][0] - points[0][0] < MIN_DRIFT_DURATION:
            return None
        half = len(points) // 2
        first, second = _lowest(points[:half], 0.0), _lowest(points[half:], 0.0)
        for _ in range(3):  # the same again, with the slope subtracted
            slope = _slope(first, second)
            first = _lowest(points[:half], slope)
            second = _lowest(points[half:], slope)
        slope = _slope(first, second)
        return slope if abs(slope) <= MAX_DRIFT else None

    def _offset(self, device: float) -> float:
        at, offset = self._edge
        return offset + (self._drift or 0.0) * (device - at)


def _slope(first: tuple[float, float], second: tuple[float, float]) -> float:
    return (second[1] - first[1]) / (second[0] - first[0])


def _lowest(points: list[tuple[float, float]], slope: float) -> tuple[float, float]:
    """Return the point that a line of a slope, raised from below, meets first."""
    return min(points, key=lambda one: one[1] - slope * one[0])
