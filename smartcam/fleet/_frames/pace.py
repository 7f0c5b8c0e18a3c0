"""Choose the frame that a stream is given: one that has not waited for the link.

A frame that came while the link was taken has grown old by up to a period before it can go. So the
next one goes instead, as soon as it is there: that costs a part of the frame rate, and each frame
that arrives is only as old as its own way.
"""

from __future__ import annotations

import math

MAX_WAIT_SHARE = 0.04
"""Share of a frame's time on the way that a frame may have waited before."""

MIN_WAIT_SECONDS = 0.002
"""Seconds that each frame may have waited in any case."""

PATIENCE = 1.25
"""Periods in which the next frame is expected; then the older one goes after all."""


class FramePace:
    """Pace of one stream. All times are of one clock."""

    def __init__(self) -> None:
        self._gave: float | None = None
        self._ways = (0.0, 0.0)  # what the last two took to get there
        self._last: tuple[float, int] | None = None
        self._period = 0.0  # of the source; 0: unknown
        self._due = -math.inf
        self._rest = 0.0

    def asked(self, now: float, came: float, rest: float = 0.0) -> tuple[float, float]:
        """Return since when the next frame has to have come, and until when it is waited for.

        Args:
            now: the next frame is asked for; so the last one is there.
            came: when the newest frame came.
            rest: seconds from one frame to the next at least.
        """
        if self._gave is not None:
            self._ways, self._gave = (self._ways[1], now - self._gave), None
        self._rest = rest
        way = min(self._ways)
        since, until = now - max(MIN_WAIT_SECONDS, MAX_WAIT_SHARE * way), now
        if 0 < self._period <= way:  # else the link is free before there is another
            until = came + PATIENCE * self._period
        if rest and now < self._due:
            since = max(since, self._due - self._period / 2)
            until = max(until, self._due + PATIENCE * self._period)
        return since, until

    def took(self, came: float, offered: int) -> None:
        """Take down which frame it is.

        Args:
            came: time at which the frame came.
            offered: number of frames that came until then.
        """
        if self._last is not None and offered > self._last[1]:
            self._period = (came - self._last[0]) / (offered - self._last[1])
        self._last = came, offered
        self._due = max(self._due, came - self._rest) + self._rest

    def gave(self, now: float) -> None:
        """Take down that it goes on its way."""
        self._gave = now
