"""Convert the time of a camera's own clock to seconds of ``time.monotonic()``."""

from __future__ import annotations

import collections
from dataclasses import dataclass
from typing import Final

MAX_INTERVALS: Final = 40
"""Largest number of intervals that are kept."""

INTERVAL_DURATION: Final = 0.5
"""Seconds of one interval; only the frame with the shortest delay in it is kept."""

MIN_EARLY_JUMP_SECONDS: Final = 0.05
"""A frame that arrives at least this many seconds before its own time stamp shows that the
camera's clock jumped."""

MIN_INTERVALS_FOR_JUMP: Final = 4
"""Number of intervals after which an early frame proves a jump; with fewer, all may be late."""

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
    between the clocks plus the shortest delay. The slope of this edge is the drift. So the
    estimated time of a frame is late by the shortest delay only.

    The offset rises no faster than a clock can drift, so a queue that delays all frames does not
    change it. If a clock is set back by less than the time between two frames, this looks like a
    queue: the frames' times are too early until the offset has adapted.

    Attributes:
        jumps: number of times that the clock was reset.
    """

    def __init__(self) -> None:
        self._interval_minima = collections.deque[tuple[float, float]](maxlen=MAX_INTERVALS)
        self._edge_slope: float | None = None  # slope of the lower edge; None: not known yet
        self._edge_point = (0.0, 0.0)  # point on the lower edge
        self._last_device_time: float | None = None
        self._interval_start = 0.0
        self._last_offset: float | None = None  # offset at the last frame
        self._offset_before_queue: float | None = None  # offset before frames were delayed
        self.jumps = 0

    def statistics(self) -> ClockStatistics:
        """Return the drift and the jumps of the device's clock known so far."""
        # device time = (arrival - offset) / (1 + slope): with a slope above 0 the clock is too slow
        drift = None if self._edge_slope is None else -self._edge_slope / (1 + self._edge_slope)
        return ClockStatistics(drift, self.jumps)

    def host_time(self, device_time: float, arrival: float) -> float:
        """Return a device's time on the host's clock, never later than ``arrival``.

        Args:
            device_time: time of the device's clock, seconds.
            arrival: time of arrival, seconds of ``time.monotonic()``.
        """
        if self._has_jumped(device_time, arrival):
            self.jumps += 1
            self._interval_minima.clear()
            self._edge_slope = self._last_offset = self._offset_before_queue = None
        self._add_point(device_time, arrival - device_time)
        offset = self._offset(device_time)
        if self._last_offset is not None and self._last_device_time is not None:
            highest = self._last_offset + MAX_DRIFT * (device_time - self._last_device_time)
            if offset <= highest:
                self._offset_before_queue = None
            elif self._offset_before_queue is None:
                self._offset_before_queue = self._last_offset
            offset = min(offset, highest)
        self._last_offset, self._last_device_time = offset, device_time
        return min(arrival, device_time + offset)

    def _has_jumped(self, device_time: float, arrival: float) -> bool:
        if self._last_device_time is None:
            return False
        if device_time < self._last_device_time:
            return True
        lateness = arrival - device_time - self._offset(device_time)
        if self._offset_before_queue is not None:  # the queue may have ended
            lateness = max(lateness, arrival - device_time - self._offset_before_queue)
        return (
            lateness < -MIN_EARLY_JUMP_SECONDS
            and len(self._interval_minima) >= MIN_INTERVALS_FOR_JUMP
        )

    def _add_point(self, device_time: float, offset: float) -> None:
        if not self._interval_minima or device_time - self._interval_start >= INTERVAL_DURATION:
            self._interval_start = device_time
            self._interval_minima.append((device_time, offset))
        elif offset < self._interval_minima[-1][1]:
            self._interval_minima[-1] = (device_time, offset)
        else:
            return
        self._edge_slope = self._estimate_slope()
        self._edge_point = _lowest_point(list(self._interval_minima), self._edge_slope or 0.0)

    def _estimate_slope(self) -> float | None:
        """Return the slope of the lower edge; None if too little is known."""
        points = list(self._interval_minima)
        if points[-1][0] - points[0][0] < MIN_DRIFT_DURATION:
            return None
        half = len(points) // 2
        first, second = _lowest_point(points[:half], 0.0), _lowest_point(points[half:], 0.0)
        for _ in range(3):  # the lowest points depend on the slope
            slope = _slope(first, second)
            first = _lowest_point(points[:half], slope)
            second = _lowest_point(points[half:], slope)
        slope = _slope(first, second)
        return slope if abs(slope) <= MAX_DRIFT else None

    def _offset(self, device_time: float) -> float:
        edge_time, offset = self._edge_point
        return offset + (self._edge_slope or 0.0) * (device_time - edge_time)


def _slope(first: tuple[float, float], second: tuple[float, float]) -> float:
    return (second[1] - first[1]) / (second[0] - first[0])


def _lowest_point(points: list[tuple[float, float]], slope: float) -> tuple[float, float]:
    """Return the lowest point relative to a line of the given slope."""
    return min(points, key=lambda point: point[1] - slope * point[0])
