"""A bus inside the process that misbehaves: what one says is lost, doubled, late, or overtaken.

Who is there is told as it is: presence comes from the engine, which does not lose it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from random import Random

from smartcam.fleet import MemoryBus
from tests.fleet.inside import Data, MemoryConnection

Fate = Callable[[str, bytes], Sequence[float]]
"""Tells after how many seconds each copy of something said arrives; none: it is lost."""


def as_said(key: str, payload: bytes) -> Sequence[float]:
    """Have everything arrive, once and at once."""
    return (0.0,)


class LossyBus(MemoryBus):
    """A bus whose ends misbehave as ``fate`` says; it may be changed at any time.

    Args:
        fate: what becomes of what is said.
        local: frames are handed on as they are; else they go in parts, as between processes.
    """

    def __init__(self, fate: Fate = as_said, *, local: bool = True) -> None:
        super().__init__()
        self.fate, self.local = fate, local
        self.said = 0  # copies that arrived
        self.lost = 0
        self.doubled = 0
        self.late = 0

    def new_connection(self) -> MemoryConnection:
        return _LossyEnd(self)


class _LossyEnd(MemoryConnection):
    def __init__(self, bus: LossyBus) -> None:
        super().__init__(bus)
        self._lossy, self.local = bus, bus.local

    def put_part(self, key: str, head: bytes, data: Data) -> None:
        """Say a part; what is late of it would be broken, so it arrives at once or not at all."""
        if self._lossy.fate(key, head):
            super().put_part(key, head, data)
        else:
            self._lossy.lost += 1

    def put(self, key: str, payload: bytes) -> None:
        bus = self._lossy
        delays = bus.fate(key, payload)
        bus.lost += not delays
        bus.doubled += len(delays) > 1
        for delay in delays:
            bus.said += 1
            if delay:
                bus.late += 1
                self._loop.call_later(delay, super().put, key, payload)
            else:
                super().put(key, payload)


def chance_of(
    chance: Random, *, lost: float = 0.0, doubled: float = 0.0, late: float = 0.0, by: float = 0.05
) -> Fate:
    """Return a fate that is left to chance.

    Args:
        chance: seeded.
        lost: share of what is said that does not arrive.
        doubled: share that arrives twice, the second time late.
        late: share that arrives late, so that what was said later overtakes it.
        by: seconds that something late is late at most.
    """

    def fate(key: str, payload: bytes) -> Sequence[float]:
        place = chance.random()
        if place < lost:
            return ()
        if place < lost + doubled:
            return (0.0, chance.uniform(0, by))
        if place < lost + doubled + late:
            return (chance.uniform(0, by),)
        return (0.0,)

    return fate


def only(kind: str, fate: Fate) -> Fate:
    """Return a fate of one kind of what is said: ``command``, ``ask``, ``reply``, ``results``,
    ``states``; everything else arrives."""

    def chosen(key: str, payload: bytes) -> Sequence[float]:
        return fate(key, payload) if key.split("/")[2] == kind else (0.0,)

    return chosen
