"""Choose the next frame of a stream: one that has not waited for the link.

A frame that came while the link was busy is up to a period old before it can be sent. So the next
one is sent instead, as soon as it is there: that costs a part of the frame rate, but each frame
arrives only as late as its own transfer takes.
"""

from __future__ import annotations

import math

MAX_WAIT_SHARE = 0.04
"""A frame may have waited before for this share of its time on the way."""

MIN_WAIT_SECONDS = 0.002
"""A frame may have waited this many seconds in any case."""

MAX_WAIT_PERIODS = 1.25
"""Number of periods to wait for the next frame; then the older one is sent after all."""


class FramePace:
    """Pace of one stream. All times are from one clock."""

    def __init__(self) -> None:
        self._gave: float | None = None
        self._ways = (0.0, 0.0)  # seconds on the way of the last two frames
        self._last: tuple[float, int] | None = None
        self._period = 0.0  # period of the source; 0: unknown
        self._due = -math.inf
        self._rest = 0.0

    def asked(self, now: float, came: float, rest: float = 0.0) -> tuple[float, float]:
        """Return the time after which the next frame must have come, and the end of the wait.

        Args:
            now: time of the request for the next frame, when the last one has arrived.
            came: time at which the newest frame came.
            rest: least number of seconds from one frame to the next.
        """
        if self._gave is not None:
            self._ways, self._gave = (self._ways[1], now - self._gave), None
        self._rest = rest
        way = min(self._ways)
        since, until = now - max(MIN_WAIT_SECONDS, MAX_WAIT_SHARE * way), now
        if 0 < self._period <= way:  # otherwise the link is free before the next frame comes
            until = came + MAX_WAIT_PERIODS * self._period
        if rest and now < self._due:
            since = max(since, self._due - self._period / 2)
            until = max(until, self._due + MAX_WAIT_PERIODS * self._period)
        return since, until

    def took(self, came: float, offered: int) -> None:
        """Note which frame was taken.

        Args:
            came: time at which the frame came.
            offered: number of frames that came until then.
        """
        if self._last is not None and offered > self._last[1]:
            self._period = (came - self._last[0]) / (offered - self._last[1])
        self._last = came, offered
        self._due = max(self._due, came - self._rest) + self._rest

    def gave(self, now: float) -> None:
        """Note that the frame is sent now."""
        self._gave = now
