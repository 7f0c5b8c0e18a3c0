"""Statistics of measured times: minimum, median, 99th percentile and jitter."""

from __future__ import annotations

import math
import statistics
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence


class TimeStatistics(NamedTuple):
    """Statistics of a series of times; seconds.

    Attributes:
        samples: number of times in the series.
        min: shortest time.
        median: median of the times.
        p99: the 99th percentile by nearest rank, which is the longest of up to 100 times.
        jitter: mean of the absolute differences of successive times; 0 for a single one.
    """

    samples: int
    min: float
    median: float
    p99: float
    jitter: float

    def __str__(self) -> str:
        """Return the statistics as text, in milliseconds."""
        low, middle, high, jitter = (f"{1e3 * seconds:.1f}" for seconds in self[1:])
        return f"min {low}, median {middle}, p99 {high} ms, jitter {jitter} ms"


def time_statistics(times: Sequence[float]) -> TimeStatistics:
    """Return the statistics of one or more times, given in the order of measurement."""
    ascending = sorted(times)
    steps = [abs(after - before) for before, after in pairwise(times)]
    return TimeStatistics(
        len(times),
        ascending[0],
        statistics.median(ascending),
        ascending[math.ceil(0.99 * len(ascending)) - 1],
        statistics.fmean(steps) if steps else 0.0,
    )
