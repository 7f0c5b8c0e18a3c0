"""The pulse of an agent: how long it was stopped, and what came may have waited for it.

A process that is stopped, or whose event loop is held up, does not see when something comes: what
waited in the system for 3 s looks like what comes now. But it sees by its clock that it did nothing
for 3 s.
"""

from __future__ import annotations

import asyncio
from typing import Final

BEAT_INTERVAL: Final = 0.1
"""Seconds between two looks at the clock."""

STOPPED_AFTER: Final = 0.25
"""Seconds between two looks from which on the agent counts as having been stopped."""

SETTLE_TIME: Final = 1.0
"""Seconds after a stop in which messages may have waited: they lay in the system's buffers."""


class Pulse:
    """Looks at the clock of its event loop, again and again, from :meth:`open` to :meth:`close`."""

    def __init__(self) -> None:
        self._last = self._since = 0.0
        self._settled = float("-inf")
        self._timer: asyncio.TimerHandle | None = None

    def open(self) -> None:
        """Look from now on."""
        self._last = asyncio.get_running_loop().time()
        self._beat()

    def close(self) -> None:
        """Look no more. Idempotent."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def waited(self) -> float:
        """Return the seconds that a message heard now may have waited; 0 if it has not."""
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
