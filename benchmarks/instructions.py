"""How many instructions an operation takes: the one figure that the machine's other work leaves be.

``valgrind --tool=callgrind`` counts those of a process, fifty times slower than it runs. A process
does N operations and another one 2 N; what is between them is N operations, without start and end.
Instructions within the system's kernel are not in it. Where there is no valgrind, the column is
left out.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks import cores, sides

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from benchmarks.measure import Plan

__all__ = ["count_sides", "counted", "difference", "wanted"]

TOOL = "valgrind"

TOTAL = re.compile(r"Collected : (\d+)")

PATIENCE = 600.0
"""Seconds until a process that does not end is an error."""


def count_sides(
    plan: Plan, module: str, ports: Mapping[str, int], operations: int
) -> dict[str, float]:
    """Return the instructions of an operation of each side; nothing where none are to be counted.

    Args:
        plan: says whether they are counted.
        module: a benchmark with ``SIDES``.
        ports: of the sides' peers, by the sides.
        operations: N; enough that what differs from run to run is little of it.
    """
    if not plan.instructions:
        return {}

    def total(side: str, count: int) -> int:
        with counted() as (prefix, read):
            subprocess.run(
                [*prefix, *sides.command(module, side, ports[side], count), sides.COUNTED],
                stdout=subprocess.DEVNULL,
                check=True,
                timeout=PATIENCE,
            )
            return read()

    return {side: difference(partial(total, side), operations) for side in ports}


SAME = ("env", "PYTHONHASHSEED=0")
"""What makes a process do the same each time."""


def difference(total: Callable[[int], int], operations: int) -> float:
    """Return what one of N operations takes, from what N and 2 N take; both at the same time."""
    with cores.free(), ThreadPoolExecutor(2) as pool:
        once, twice = pool.map(total, (operations, 2 * operations))
    return (twice - once) / operations


@contextlib.contextmanager
def counted() -> Iterator[tuple[list[str], Callable[[], int]]]:
    """Give what stands before a command so that it is counted, and what reads the count."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "log")
        prefix = [
            *SAME,
            TOOL,
            "--tool=callgrind",
            f"--log-file={log}",
            f"--callgrind-out-file={Path(folder, 'out')}",
        ]

        def read() -> int:
            text = log.read_text(encoding="utf-8")
            found = TOTAL.search(text)
            if found is None:
                raise RuntimeError(f"{TOOL} counted nothing: {text[-500:]}")
            return int(found[1])

        yield prefix, read


def wanted(*, asked: bool) -> bool:
    """Return whether they are counted: asked for, and there is valgrind; if not, say so."""
    if asked and shutil.which(TOOL) is None:
        print(f"instructions: left out: no {TOOL} here", file=sys.stderr)
        return False
    return asked
