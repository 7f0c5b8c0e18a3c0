"""The log of a link proxy's actions, and their counts."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from smartcam.emulator._inside import Tally

MAX_ENTRIES = 10_000
"""Largest number of entries kept; the oldest are dropped. The counts continue."""


class Entry(NamedTuple):
    """One event.

    Attributes:
        what: a rule's name in lower case, or ``connect``, ``eof`` (a side sends no more), ``lost``
            (a side reset the connection), ``no target``, ``too many``, ``not accepted``,
            ``resume``, ``full`` (a datagram was dropped, since too many wait) and ``refused`` (a
            datagram could not be sent).
        connection: number of the connection, from 1; 0 for an entry without one.
        direction: ``up`` or ``down``; empty for an entry about both.
        at: offset in the sender's stream, or number of the datagram; None for an action that the
            program asked for.
    """

    what: str
    connection: int = 0
    direction: str = ""
    at: int | None = None


class LinkLog:
    """Keeps the last entries and counts all of them.

    Attributes:
        log: the last entries, the oldest first.
        counts: number of entries by ``what``.
        passed: output of the proxy, by direction: bytes on TCP, datagrams on UDP.
    """

    def __init__(self) -> None:
        self.log: deque[Entry] = deque(maxlen=MAX_ENTRIES)
        self.counts: Tally[str] = Tally()
        self.passed: Tally[str] = Tally()

    def note(
        self, what: str, connection: int = 0, direction: str = "", at: int | None = None
    ) -> None:
        """Keep an entry; the arguments are its fields."""
        self.log.append(Entry(what, connection, direction, at))
        self.counts.add(what)
