"""The pulse of an agent: for how long it was stopped, while messages may have waited.

A process that is stopped, or whose event loop is blocked, does not see when a message comes: one
that waited in the system for 3 s looks like a new one. But its clock shows that it did nothing for
3 s.
"""

from __future__ import annotations

import asyncio
from typing import Final

BEAT_INTERVAL: Final = 0.1
"""Seconds between two readings of the clock."""

STOPPED_AFTER: Final = 0.25
"""Seconds between two readings beyond which the agent counts as stopped."""

SETTLE_TIME: Final = 1.0
"""Seconds after a stop in which messages may come that have waited in the system's buffers."""


class Pulse:
    """Reads the clock of its event loop periodically, from :meth:`open` to :meth:`close`."""

    def __init__(self) -> None:
        self._last = self._since = 0.0
        self._settled = float("-inf")
        self._timer: asyncio.TimerHandle | None = None

    def open(self) -> None:
        """Start to read the clock."""
        self._last = asyncio.get_running_loop().time()
        self._beat()

    def close(self) -> None:
        """Stop reading the clock. Idempotent."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def waited(self) -> float:
        """Return the seconds for which a message that comes now may have waited."""
        now = self._look()
        return now - self._since if now < self._settled else 0.0

    def _beat(self) -> None:
        self._look()
        self._timer = asyncio.get_running_loop().call_later(BEAT_INTERVAL, self._beat)

    def _look(self) -> float:
        now = asyncio.get_running_loop().time()
        if now - self._last > STOPPED_AFTER:
            if self._last >= self._settled:
                self._since = self._last
            self._settled = now + SETTLE_TIME
        self._last = now
        return now
