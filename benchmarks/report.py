"""What a run shows: a table, and JSON with every figure."""

from __future__ import annotations

import dataclasses
import platform
import sys
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable

    from benchmarks.measure import Comparison, Curve

__all__ = ["as_json", "table"]

HEADINGS = ("benchmark", "case", "smartcam", "yardstick", "measured", "middle half", "goal", "")


def table(comparisons: Iterable[Comparison]) -> str:
    """Return a table for a terminal; Markdown takes it as well."""
    rows = [HEADINGS, *map(_row, comparisons)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(HEADINGS))]
    lines = [_line(row, widths) for row in rows]
    lines.insert(1, _line(["-" * width for width in widths], widths))
    return "\n".join(lines)


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
