"""What a link proxy really did: its log, its counts, and waiting for them."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from typing import NamedTuple

__all__ = ["MAX_ENTRIES", "Entry", "Journal"]

MAX_ENTRIES = 10_000
"""Entries kept; the oldest go first. The counts go on."""


class Entry(NamedTuple):
    """One thing that happened.

    Attributes:
        what: a rule's name in small letters, or ``connect``, ``eof`` (a side sends no more),
            ``lost`` (a side reset the connection), ``no target``, ``too many``, ``not accepted``,
            ``resume``, ``full`` and ``refused`` (a datagram that did not go out).
        connection: its number, from 1; 0 where there is none.
        direction: ``up`` or ``down``; empty where it is about both.
        at: offset in the sender's stream, or number of the datagram; None for what the proxy was
            told while it ran.
    """

    what: str
    connection: int = 0
    direction: str = ""
    at: int | None = None


class Journal:
    """Keeps the last entries and counts all of them.

    Attributes:
        log: the last entries, the oldest first.
        counts: how often each thing happened.
        passed: what left the proxy, by direction: bytes on TCP, datagrams on UDP.
    """

    def __init__(self) -> None:
        self.log: deque[Entry] = deque(maxlen=MAX_ENTRIES)
        self.counts: Counter[str] = Counter()
        self.passed: Counter[str] = Counter()
        self._changed = asyncio.Event()

    def note(self, entry: Entry) -> None:
        """Keep an entry."""
        self.log.append(entry)
        self.counts[entry.what] += 1
        self._wake()

    def count_passed(self, direction: str, amount: int) -> None:
        """Count what went out."""
        self.passed[direction] += amount
        self._wake()

    async def wait_for(self, what: str, count: int, timeout: float) -> None:
        """Wait until something has happened ``count`` times since the beginning.

        Raises:
            TimeoutError: it did not in ``timeout`` seconds.

        Cancellation: safe.
        """
        await self._wait(self.counts, what, count, timeout)

    async def wait_passed(self, direction: str, amount: int, timeout: float) -> None:
        """Wait until ``amount`` bytes or datagrams went out in a direction.

        Raises:
            TimeoutError: they did not in ``timeout`` seconds.

        Cancellation: safe.
        """
        await self._wait(self.passed, direction, amount, timeout)

    async def _wait(self, counter: Counter[str], key: str, wanted: int, timeout: float) -> None:
        try:
            async with asyncio.timeout(timeout):
                while counter[key] < wanted:
                    await self._changed.wait()
        except TimeoutError as exc:
            raise TimeoutError(
                f"{key!r} came to {counter[key]} in {timeout} s, not to {wanted}"
            ) from exc

    def _wake(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()
