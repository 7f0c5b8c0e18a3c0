"""Count events, and wait until an event has happened a number of times."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TypeVar

K = TypeVar("K")


class Tally(Counter[K]):
    """A counter that coroutines can wait for."""

    _changed: asyncio.Event | None = None  # set while a coroutine waits

    def add(self, key: K, amount: int = 1) -> None:
        """Count an event, and wake the coroutines that wait."""
        self[key] += amount
        if self._changed is not None:
            self._changed.set()
            self._changed = None

    async def wait(self, key: K, count: int, timeout: float) -> None:
        """Wait until ``key`` was counted ``count`` times since the beginning.

        Raises:
            TimeoutError: the count was not reached in ``timeout`` seconds of real time; the text
                gives the count.

        Cancellation: safe.
        """
        try:
            async with asyncio.timeout(timeout):
                while self[key] < count:
                    changed = self._changed = self._changed or asyncio.Event()
                    await changed.wait()
        except TimeoutError as exc:
            raise TimeoutError(
                f"{key!r} came to {self[key]} in {timeout} s, not to {count}"
            ) from exc
