"""Counts work without a clock: Python's steps, memory, and instructions of the processor.

Each is counted for an input and for ones of twice and four times its size. Work that does not
depend on the size falls out: what the second doubling adds is compared to what the first adds. Work
in proportion gives 2, sorting a little more, and work that goes with the square gives 4.
"""

from __future__ import annotations

import gc
import os
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from tests.budgets.parser import Make, Parser, size_of


class Growth(NamedTuple):
    """Counts for an input, and for inputs of twice and four times its size.

    Attributes:
        sizes: bytes of the inputs.
        counts: what was counted for each.
    """

    sizes: tuple[int, ...]
    counts: tuple[int, ...]

    @property
    def factor(self) -> float:
        """The second doubling's cost as a multiple of the first's; 0 where it adds nothing."""
        first, second, third = self.counts
        return max(0, third - second) / max(1, second - first)

    @property
    def added(self) -> int:
        """The cost that the second doubling adds."""
        return self.counts[2] - self.counts[1]

    @property
    def per_byte(self) -> float:
        """The cost that the second doubling adds for each byte that it adds."""
        return self.added / max(1, self.sizes[2] - self.sizes[1])

    @property
    def is_faster(self) -> bool:
        """True if the cost grows faster than the input.

        A saving or a cost that appears at one size only, such as a buffer that got longer, moves
        the factor, too; then the second doubling costs no more a byte than the whole input. Work
        of n² costs 1.5 times as much there, and its factor is 4.
        """
        if self.factor <= MAX_FACTOR:
            return False
        average = self.counts[2] / self.sizes[2]
        return self.factor > MAX_UNEVEN_FACTOR or self.per_byte > MAX_MARGIN * average


MAX_FACTOR = 2.3
"""The most that the second doubling may add, as a multiple of the first: 2 and some for sorting."""

MAX_UNEVEN_FACTOR = 3.0
"""The most that it may add where the cost of a byte stays the same."""

MAX_MARGIN = 1.1
"""The cost of a byte in the second doubling, as a multiple of the average; n log n has 1.07."""

STEADY_FACTOR = 2.1
"""The least that the doubling before that adds then: work of n + b n² with 2.3 has 2.16 there."""


def grow(parser: Parser, make: Make, count: Callable[[Parser, Any], int], size: int) -> Growth:
    """Count for the three sizes; once before, for what is imported and kept.

    Where that seems to grow by more than the input, it is counted once more, and for half the size,
    too: work that grows does so at each doubling, and what happens now and then, such as new memory
    for the process, only adds to a count and only at some of them.
    """
    parser.run(make(size))
    grown = _count(parser, make, count, size)
    if not grown.is_faster:
        return grown
    before = _count(parser, make, count, size // 2)
    again = _count(parser, make, count, size)
    grown = grown._replace(counts=tuple(map(min, grown.counts, again.counts)))
    return grown if before.factor > STEADY_FACTOR else before


def _count(parser: Parser, make: Make, count: Callable[[Parser, Any], int], size: int) -> Growth:
    given = [make(size * times) for times in (1, 2, 4)]
    return Growth(tuple(map(size_of, given)), tuple(count(parser, one) for one in given))


def costliest(parser: Parser) -> str:
    """Return the kind of a parser's inputs that takes most lines of Python for a byte."""
    size = min(parser.size, parser.short, 500)
    costs = {}
    for kind, make in parser.inputs.items():
        if kind in parser.refused_from:
            continue
        given = make(size)
        costs[kind] = steps(parser, given) / max(1, size_of(given))
    return max(costs, key=lambda kind: costs[kind])


def steps(parser: Parser, given: Any) -> int:
    """Return the lines of Python that reading an input takes."""
    found = 0

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        nonlocal found
        found += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        parser.run(given)
    finally:
        sys.settrace(before)
    return found


def memory(parser: Parser, given: Any) -> int:
    """Return the bytes that reading an input takes at most beside the input."""
    gc.collect()
    tracemalloc.start()
    try:
        parser.run(given)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


class Instructions:
    """Counts the instructions of a process that runs in callgrind.

    Callgrind, as it was started (:data:`CALLGRIND`), writes what it has counted, and begins anew,
    whenever the process calls ``getppid``, which nothing else does.

    Args:
        written: what callgrind's files are called; behind it comes their number.
    """

    def __init__(self, written: Path) -> None:
        self._written = written
        self._take()  # the first call looks the function up, and nothing is written
        self._take()

    def __call__(self, parser: Parser, given: Any) -> int:
        """Return the instructions that reading an input takes."""
        gc.collect()
        gc.disable()
        self._take()
        os.getppid()  # what the line before took is not counted
        try:
            parser.run(given)
        finally:
            found = self._take()
            gc.enable()
        return found

    def _take(self) -> int:
        """Have what was counted written; return how much it was."""
        os.getppid()
        written = self._written.parent.glob(f"{self._written.name}.*")
        numbered = sorted((int(path.suffix[1:]), path) for path in written)
        last = b""
        for _, path in numbered:
            with path.open("rb") as file:
                file.seek(-min(END, path.stat().st_size), os.SEEK_END)
                last = file.read()
            path.unlink()
        return int(last.rpartition(b"totals:")[2].split()[0]) if b"totals:" in last else 0


END = 200
"""Bytes at the end of callgrind's files in which the total stands."""

CALLGRIND = ("valgrind", "--tool=callgrind", "--dump-before=getppid", "--quiet")
