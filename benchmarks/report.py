"""What a run shows: a table, and JSON with every figure."""

from __future__ import annotations

import dataclasses
import platform
import sys
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from benchmarks.measure import Comparison, Curve

__all__ = ["as_json", "markdown", "notes", "table"]

HEADINGS = ("benchmark", "case", "smartcam", "yardstick", "measured", "middle half", "goal", "")


def table(comparisons: Iterable[Comparison], *, without: str = "") -> str:
    """Return a table for a terminal, which Markdown takes as well; one column may be left out."""
    rows = [HEADINGS, *map(_row, comparisons)]
    if without:
        column = HEADINGS.index(without)
        rows = [(*row[:column], *row[column + 1 :]) for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [_line(row, widths) for row in rows]
    lines.insert(1, _line(["-" * width for width in widths], widths))
    return "\n".join(lines)


def notes(comparisons: Iterable[Comparison]) -> str:
    """Return what is to be known of some lines, each note once, with the first line it is of."""
    first: dict[str, str] = {}
    for one in comparisons:
        if one.note:
            first.setdefault(one.note, one.case)
    return "".join(f"- {case}: {note}\n" for note, case in first.items())


def markdown(comparisons: Sequence[Comparison], pictures: Mapping[str, Path]) -> str:
    """Return what a run shows as a part of a page: when and where, a table each, the plots.

    Args:
        comparisons: the tables' lines.
        pictures: files by what they show; a benchmark's own begin with its name.
    """
    facts = as_json((), ())
    lines = [
        f"Measured on {facts['at'][:10]} with Python {facts['python']}, {facts['processors']}.",
        "",
    ]
    lines += _images(pictures, "goals")
    for name in dict.fromkeys(one.benchmark for one in comparisons):
        rows = [one for one in comparisons if one.benchmark == name]
        lines += [f"### {name.capitalize()}", "", table(rows, without="benchmark"), ""]
        lines += [notes(rows)] if notes(rows) else []
        lines += _images(pictures, f"{name}-")
    return "\n".join(lines).rstrip()


def _images(pictures: Mapping[str, Path], begins: str) -> list[str]:
    named = [(title, path.name) for title, path in pictures.items()]
    return [f"![{title}]({name})\n" for title, name in named if name.startswith(begins)]


def as_json(comparisons: Iterable[Comparison], curves: Iterable[Curve]) -> dict[str, Any]:
    """Return every figure as plain data."""
    return {
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processors": _processors(),
        "comparisons": [
            {
                **dataclasses.asdict(one),
                "figures": one.figures,
                "unit": one.unit,
                "median": one.median,
                "spread": one.spread,
                "met": one.met,
            }
            for one in comparisons
        ],
        "curves": [dataclasses.asdict(curve) for curve in curves],
    }


def _processors() -> str:
    if sys.platform == "linux":
        with open("/proc/cpuinfo") as file:  # noqa: PTH123
            for line in file:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    return platform.processor()


def _row(one: Comparison) -> tuple[str, ...]:
    low, high = one.spread
    digits = 2 if abs(one.median) < 100 else 0
    unit = "x" if one.unit == "x" else f" {one.unit}"
    yardstick = one.yardstick
    met = {None: "", True: "met", False: "MISSED"}[one.met]
    return (
        one.benchmark,
        one.case,
        _figure(one.subject.median, one.subject.unit),
        f"{_figure(yardstick.median, yardstick.unit)} {yardstick.name}" if yardstick else "",
        f"{one.median:.{digits}f}{unit}",
        f"{low:.{digits}f} to {high:.{digits}f}",
        str(one.goal or ""),
        met,
    )


def _figure(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}" if abs(value) < 1000 else f"{value:,.0f} {unit}"


def _line(cells: Iterable[str], widths: Iterable[int]) -> str:
    return "| " + " | ".join(map(str.ljust, cells, widths)) + " |"
