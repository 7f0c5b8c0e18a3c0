"""Convert the time of a camera's own clock to seconds of ``time.monotonic()``."""

from __future__ import annotations

import collections
from dataclasses import dataclass
from typing import Final

MAX_INTERVALS: Final = 40
"""Largest number of intervals that are kept."""

INTERVAL_DURATION: Final = 0.5
"""Seconds of one interval, of which only the frame with the shortest delay is kept."""

MIN_EARLY_JUMP_SECONDS: Final = 0.05
"""Seconds by which a frame comes too early for its clock after a jump of the clock."""

MIN_SURE_INTERVALS: Final = 4
"""Number of intervals after which such a jump is certain: earlier, all frames may be late."""

MIN_DRIFT_DURATION: Final = 4.0
"""Least duration of frames, seconds, to measure a drift."""

MAX_DRIFT: Final = 0.01
"""Largest plausible drift; a clock with a larger drift counts in another unit."""


@dataclass(frozen=True, slots=True)
class ClockStatistics:
    """The measured drift and jumps of a camera's clock.

    Attributes:
        drift: seconds per second by which the clock is too fast; None: not known yet.
        jumps: number of times that the clock was reset, forwards or backwards.
    """

    drift: float | None
    jumps: int


class DeviceClock:
    """The offset of a device's clock from the host's, estimated from the arrival of its frames.

    A frame arrives with a varying delay. So arrival minus device time has a lower edge: the offset
    between the clocks plus the shortest delay; its slope is the drift. The estimated time is late
    by the shortest delay only.

    The offset rises no faster than a clock can drift, so a queue that delays all frames does not
    change it. A clock that was set back by less than the time between two frames looks like a
    queue; its frames count as too old until the offset has adapted.

    Attributes:
        jumps: number of times that the clock was reset.
    """

    def __init__(self) -> None:
        self._lowest = collections.deque[tuple[float, float]](maxlen=MAX_INTERVALS)
        self._drift: float | None = None
        self._edge = (0.0, 0.0)  # point on the lower edge
        self._last: float | None = None
        self._piece_began = 0.0
        self._last_offset: float | None = None  # offset at the last frame
        self._before_queue: float | None = None  # offset before frames were delayed
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
            self._drift = self._last_offset = self._before_queue = None
        self._remember(device, arrival - device)
        offset = self._offset(device)
        if self._last_offset is not None and self._last is not None:
            highest = self._last_offset + MAX_DRIFT * (device - self._last)
            if offset <= highest:
                self._before_queue = None
            elif self._before_queue is None:
                self._before_queue = self._last_offset
            offset = min(offset, highest)
        self._last_offset, self._last = offset, device
        return min(arrival, device + offset)

    def _jumped(self, device: float, arrival: float) -> bool:
        if self._last is None:
            return False
        if device < self._last:
            return True
        late = arrival - device - self._offset(device)
        if self._before_queue is not None:  # the delay has ended
            late = max(late, arrival - device - self._before_queue)
        return late < -MIN_EARLY_JUMP_SECONDS and len(self._lowest) >= MIN_SURE_INTERVALS

    def _remember(self, device: float, offset: float) -> None:
        if not self._lowest or device - self._piece_began >= INTERVAL_DURATION:
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
        for _ in range(3):  # iterate with the slope subtracted
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
    """Return the lowest point relative to a line of the given slope."""
    return min(points, key=lambda point: point[1] - slope * point[0])
