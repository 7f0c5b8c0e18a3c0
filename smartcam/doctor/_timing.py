"""Figures of measured times: minimum, median, 99th percentile and jitter."""

from __future__ import annotations

import math
import statistics
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence


class Figures(NamedTuple):
    """Figures of a series of times; seconds.

    Attributes:
        times: number of times in the series.
        min: shortest time.
        median: median of the times.
        p99: the 99th percentile by nearest rank, which is the longest of up to 100 times.
        jitter: mean of the absolute differences of successive times; 0 for a single one.
    """

    times: int
    min: float
    median: float
    p99: float
    jitter: float

    def __str__(self) -> str:
        """Return the figures as text, in milliseconds."""
        low, middle, high, jitter = (f"{1e3 * seconds:.1f}" for seconds in self[1:])
        return f"min {low}, median {middle}, p99 {high} ms, jitter {jitter} ms"


def figures(times: Sequence[float]) -> Figures:
    """Return the figures of one or more times, given in the order of measurement."""
    ordered = sorted(times)
    steps = [abs(after - before) for before, after in pairwise(times)]
    return Figures(
        len(times),
        ordered[0],
        statistics.median(ordered),
        ordered[math.ceil(0.99 * len(ordered)) - 1],
        statistics.fmean(steps) if steps else 0.0,
    )
