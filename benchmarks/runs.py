"""A benchmark in several new processes, one after the other: what differs from process to process.

Where a process' memory lies, and what its allocator has seen, decides a good part of what a short
operation costs, and stays as it is in all rounds of that process. So a comparison is made in
several, each with peers of its own; each gives its median, and what is shown is the median of these
and the range from the least to the most.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.measure import Comparison, Curve, Series
from benchmarks.report import comparison

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from benchmarks.measure import Plan

__all__ = ["merged", "middle", "run"]


def run(plan: Plan, name: str) -> Iterator[Comparison | Curve]:
    """Run a benchmark in ``plan.processes`` new processes, and make one of what they found.

    Raises:
        RuntimeError: one of them failed; the text has its last words.
    """
    found = [
        _child(plan, name, instructions=plan.instructions and not n) for n in range(plan.processes)
    ]
    for alike in zip(*(one["comparisons"] for one in found), strict=True):
        yield merged([comparison(one) for one in alike])
    for curves in zip(*(one["curves"] for one in found), strict=True):
        yield middle([Curve(**one) for one in curves])


def _child(plan: Plan, name: str, *, instructions: bool) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "figures.json")
        command = [sys.executable, "-m", "benchmarks", name, "--processes", "1"]
        command += ["--rounds", str(plan.rounds), "--json", str(file)]
        command += ["--instructions" if instructions else "--no-instructions"]
        done = subprocess.run(command, capture_output=True, text=True)
        if not file.exists():
            raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
        figures: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return figures


def merged(alike: Sequence[Comparison]) -> Comparison:
    """Return one comparison whose figures are the medians of each process."""
    first = alike[0]
    assert all(one.case == first.case for one in alike)
    yardsticks = [one.yardstick for one in alike if one.yardstick is not None]
    return dataclasses.replace(
        first,
        subject=_medians([one.subject for one in alike]),
        yardstick=_medians(yardsticks) if yardsticks else None,
        processes=len(alike),
    )


def _medians(alike: Sequence[Series]) -> Series:
    return Series(alike[0].name, alike[0].unit, [one.median for one in alike])


def middle(alike: Sequence[Curve]) -> Curve:
    """Return the curve through the medians."""
    lines = {
        name: [
            (points[0][0], statistics.median(y for _, y in points))
            for points in zip(*(one.lines[name] for one in alike), strict=True)
        ]
        for name in alike[0].lines
    }
    return dataclasses.replace(alike[0], lines=lines)
