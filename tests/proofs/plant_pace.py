"""The present speed of this computer: a deadline may be missed by what others do here, not by luck.

A piece of work whose time is known is done again and again. What is a wait by design, such as the
lease, takes as long as ever; what is work takes as much longer as the piece does.
"""

from __future__ import annotations

import asyncio
import hashlib
import math
import time
from collections import deque
from statistics import fmean
from typing import NamedTuple

PIECE = bytes(1 << 20)
TIMES = 4

USUAL = 0.004
"""Seconds for the piece on a computer with nothing else to do, of two cores, of 2020 or so."""

EVERY = 0.5
"""Seconds between two pieces, which take a hundredth of a core."""

MOST = 10.0
"""A computer that is slower by more is none to judge on."""


class Limit(NamedTuple):
    """The time that something may take.

    Attributes:
        work: seconds of it that are work, which others may hold up.
        wait: seconds that are waited by design.
    """

    work: float
    wait: float = 0.0

    @property
    def seconds(self) -> float:
        """All of them, on a computer with nothing else to do."""
        return self.wait + self.work


class Pace:
    """Looks how fast this computer is, as long as :meth:`run` does."""

    def __init__(self) -> None:
        self._looks: deque[tuple[float, float]] = deque(maxlen=2000)  # when, how slow

    async def run(self) -> None:
        """Look again and again."""
        while True:
            slow = await asyncio.to_thread(_work) / USUAL
            self.note(time.monotonic(), slow)
            await asyncio.sleep(EVERY)

    def note(self, at: float, slow: float) -> None:
        """The piece took ``slow`` times as long as usual, up to a time."""
        self._looks.append((at, slow))

    def since(self, begun: float) -> float:
        """Return how many times as long as usual work has taken since then; 1 at least."""
        looks = [slow for at, slow in self._looks if at >= begun]
        if not looks:
            looks = [slow for _, slow in [*self._looks][-1:]] or [1.0]
        return min(MOST, max(1.0, fmean(looks)))

    def end(self, begun: float, limit: Limit) -> float:
        """Return when the time is up for what began then."""
        return begun + limit.wait + limit.work * self.since(begun)

    def __str__(self) -> str:
        looks = [slow for _, slow in self._looks] or [math.nan]
        return f"work took {fmean(looks):.1f} times as long as usual, at most {max(looks):.1f}"


def _work() -> float:
    begun = time.perf_counter()
    found = hashlib.blake2b()
    for _ in range(TIMES):
        found.update(PIECE)  # which leaves the interpreter to others
    return time.perf_counter() - begun
