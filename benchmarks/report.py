"""What a run shows: a table, and JSON with every figure."""

from __future__ import annotations

import dataclasses
import platform
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.measure import Comparison, Goal, Instructions, Series

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from benchmarks.measure import Curve

__all__ = ["as_json", "comparison", "markdown", "notes", "table"]

ROOT = Path(__file__).parent

HEADINGS = (
    "benchmark",
    "case",
    "smartcam",
    "yardstick",
    "measured",
    "range",
    "instructions",
    "goal",
    "",
)
INSTRUCTIONS = HEADINGS.index("instructions")


def table(comparisons: Iterable[Comparison], *, without: str = "") -> str:
    """Return a table for a terminal, which Markdown takes as well.

    Args:
        comparisons: its lines.
        without: a column to be left out; so is that of instructions where none were counted.
    """
    rows = [HEADINGS, *map(_row, comparisons)]
    left_out = [HEADINGS.index(without)] if without else []
    if not any(row[INSTRUCTIONS] for row in rows[1:]):
        left_out.append(INSTRUCTIONS)
    rows = [tuple(cell for place, cell in enumerate(row) if place not in left_out) for row in rows]
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


def markdown(
    comparisons: Sequence[Comparison],
    pictures: Mapping[str, Path],
    facts: Mapping[str, Any],
    benchmarks: Iterable[str],
) -> str:
    """Return what a run shows as a part of a page: when and where, a table each, the plots.

    Args:
        comparisons: the tables' lines.
        pictures: files by what they show; a benchmark's own begin with its name.
        facts: of the run, as :func:`as_json` gives them.
        benchmarks: all that there are: those without a line are named as missing.
    """
    shown = {one.benchmark for one in comparisons}
    missing = ", ".join(name for name in benchmarks if name not in shown)
    lines = [
        f"Measured on {facts['at'][:10]} of commit `{facts['commit']}` with Python "
        f"{facts['python']}, {facts['processors']}. {_durations(facts['seconds'])}"
        + (f" Not measured here: {missing}." if missing else ""),
        "",
    ]
    lines += _images(pictures, "goals")
    for name in dict.fromkeys(one.benchmark for one in comparisons):
        rows = [one for one in comparisons if one.benchmark == name]
        lines += [f"### {name.capitalize()}", "", table(rows, without="benchmark"), ""]
        lines += [notes(rows)] if notes(rows) else []
        lines += _images(pictures, f"{name}-")
    return "\n".join(lines).rstrip()


def _durations(seconds: Mapping[str, float]) -> str:
    """Return how long the run took, and what took a minute or more of it."""
    minutes = {name: round(took / 60) for name, took in seconds.items()}
    long = sorted((name for name in minutes if minutes[name]), key=lambda name: -minutes[name])
    parts = ", ".join(f"{name} {minutes[name]}" for name in long)
    return f"The run took {sum(seconds.values()) / 60:.0f} minutes" + (
        f" ({parts}; the others less than one each)." if parts else "."
    )


def _images(pictures: Mapping[str, Path], begins: str) -> list[str]:
    named = [(title, path.name) for title, path in pictures.items()]
    return [f"![{title}]({name})\n" for title, name in named if name.startswith(begins)]


def as_json(
    comparisons: Iterable[Comparison], curves: Iterable[Curve], seconds: Mapping[str, float]
) -> dict[str, Any]:
    """Return every figure as plain data, and how long each benchmark took."""
    return {
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": _commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processors": _processors(),
        "seconds": {name: round(took, 1) for name, took in seconds.items()},
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


def comparison(data: Mapping[str, Any]) -> Comparison:
    """Return the comparison that :func:`as_json` made such data of."""
    fields = {one.name: data[one.name] for one in dataclasses.fields(Comparison)}
    fields["subject"] = Series(**data["subject"])
    kinds = {"yardstick": Series, "goal": Goal}
    for name, kind in kinds.items():
        if data[name] is not None:
            fields[name] = kind(**data[name])
    if data["instructions"] is not None:
        fields["instructions"] = Instructions(*data["instructions"])
    return Comparison(**fields)


def _commit() -> str:
    """Return what is measured: the commit, and whether files differ from it."""
    described = ("git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=12")
    try:
        return subprocess.run(described, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


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
        f"{low:.{digits}f} to {high:.{digits}f}{_processes(one)}",
        _instructions(one),
        str(one.goal or ""),
        met,
    )


def _processes(one: Comparison) -> str:
    return f" of {one.processes} processes" if one.processes > 1 else ""


def _instructions(one: Comparison) -> str:
    """Return thousands of both sides, and how many times the yardstick's they are."""
    if one.instructions is None:
        return ""
    subject, yardstick = one.instructions
    return f"{_thousands(subject)} / {_thousands(yardstick)} = {subject / yardstick:.2f}x"


def _thousands(count: float) -> str:
    return f"{count / 1e3:.3g}k" if count < 1e6 else f"{count / 1e3:,.0f}k"


def _figure(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}" if abs(value) < 1000 else f"{value:,.0f} {unit}"


def _line(cells: Iterable[str], widths: Iterable[int]) -> str:
    return "| " + " | ".join(map(str.ljust, cells, widths)) + " |"
