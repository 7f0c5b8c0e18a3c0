"""Choose the next frame of a stream, so that frames do not wait for the link.

A frame that arrives while the link is busy is up to a period old before it can be sent. So the
following frame is sent instead, as soon as it arrives. That costs a part of the frame rate, but the
delay of each frame is only the duration of its own transfer.
"""

from __future__ import annotations

import math

MAX_WAIT_SHARE = 0.04
"""Largest wait of a frame before it is sent, as a share of its transfer time."""

MIN_WAIT_SECONDS = 0.002
"""Wait of a frame before it is sent that is allowed in any case, seconds."""

MAX_WAIT_PERIODS = 1.25
"""Number of periods to wait for the next frame; afterwards the older one is sent."""


class FramePace:
    """Pace of one stream. All times are from one clock."""

    def __init__(self) -> None:
        self._given_at: float | None = None
        self._transit_times = (0.0, 0.0)  # transfer times of the last two frames, seconds
        self._last: tuple[float, int] | None = None
        self._period = 0.0  # period of the source; 0: unknown
        self._due = -math.inf
        self._min_interval = 0.0

    def window(
        self, now: float, arrived_at: float, min_interval: float = 0.0
    ) -> tuple[float, float]:
        """Return the earliest arrival time of the next frame to send, and the end of the wait.

        Args:
            now: time of the request for the next frame, when the last one has arrived.
            arrived_at: time at which the newest frame arrived.
            min_interval: least number of seconds from one frame to the next.
        """
        if self._given_at is not None:
            self._transit_times = (self._transit_times[1], now - self._given_at)
            self._given_at = None
        self._min_interval = min_interval
        transit = min(self._transit_times)
        since, until = now - max(MIN_WAIT_SECONDS, MAX_WAIT_SHARE * transit), now
        if 0 < self._period <= transit:  # the link is busy for a period or more
            until = arrived_at + MAX_WAIT_PERIODS * self._period
        if min_interval and now < self._due:
            since = max(since, self._due - self._period / 2)
            until = max(until, self._due + MAX_WAIT_PERIODS * self._period)
        return since, until

    def note_taken(self, arrived_at: float, offered: int) -> None:
        """Note which frame was taken.

        Args:
            arrived_at: time at which the frame arrived.
            offered: number of frames that came until then.
        """
        if self._last is not None and offered > self._last[1]:
            self._period = (arrived_at - self._last[0]) / (offered - self._last[1])
        self._last = arrived_at, offered
        self._due = max(self._due, arrived_at - self._min_interval) + self._min_interval

    def note_sent(self, now: float) -> None:
        """Note that the frame is sent now."""
        self._given_at = now
