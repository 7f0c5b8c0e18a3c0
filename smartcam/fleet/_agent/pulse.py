"""Measure for how long an agent was stopped, and received messages may have waited unread.

A process that is stopped, or whose event loop is blocked, cannot tell when a message arrived: a
message that has waited in the system for 3 s looks like a new message. But a clock that is read
regularly shows that the process did nothing for 3 s.
"""

from __future__ import annotations

import asyncio
from typing import Final

BEAT_INTERVAL: Final = 0.1
"""Seconds between two readings of the clock."""

STOPPED_AFTER: Final = 0.25
"""Seconds between two readings beyond which the agent counts as stopped."""

BACKLOG_TIME: Final = 1.0
"""Seconds after a stop in which messages may still be read that waited in the system's buffers."""


class Pulse:
    """Reads the clock of its event loop periodically, from :meth:`open` to :meth:`close`."""

    def __init__(self) -> None:
        self._last_reading_at = self._stopped_at = 0.0
        self._backlog_until = float("-inf")
        self._timer: asyncio.TimerHandle | None = None

    def open(self) -> None:
        """Start to read the clock."""
        self._last_reading_at = asyncio.get_running_loop().time()
        self._beat()

    def close(self) -> None:
        """Stop reading the clock. Idempotent."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def max_wait(self) -> float:
        """Return the longest time that a message that arrives now may have waited, seconds."""
        now = self._read_clock()
        return now - self._stopped_at if now < self._backlog_until else 0.0

    def _beat(self) -> None:
        self._read_clock()
        self._timer = asyncio.get_running_loop().call_later(BEAT_INTERVAL, self._beat)

    def _read_clock(self) -> float:
        now = asyncio.get_running_loop().time()
        if now - self._last_reading_at > STOPPED_AFTER:
            if self._last_reading_at >= self._backlog_until:
                self._stopped_at = self._last_reading_at
            self._backlog_until = now + BACKLOG_TIME
        self._last_reading_at = now
        return now
