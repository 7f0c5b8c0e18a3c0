"""Figures as SVG: each curve, and one overview of what was reached of each goal.

They are drawn for light and dark pages alike: no background, grey axes, text as text. The same
figures give the same bytes.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from benchmarks.measure import Comparison, Curve

__all__ = ["write"]

GREY, PALE = "#808080", "#80808055"
COLOURS = ("#3b82c4", "#e07b39", "#3a9d6e", "#a45fb8", "#b8922e", "#c9506b")
"""Of lines; each stands out from white and from black."""

MET, MISSED = COLOURS[2], COLOURS[5]

STYLE: dict[Any, Any] = {
    "svg.hashsalt": "smartcam",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9,
    "text.color": GREY,
    "axes.facecolor": "none",
    "axes.edgecolor": GREY,
    "axes.labelcolor": GREY,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "grid.color": PALE,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
}

GOALS = "Times the goal: 1 is the goal, left of it is better"

WIDE = 50.0
"""Values from the smallest to the largest beyond which an axis is logarithmic."""


def write(
    curves: Iterable[Curve], comparisons: Iterable[Comparison], folder: Path
) -> dict[str, Path]:
    """Draw each curve, and the overview, into files of ``folder``; return these by their titles.

    Args:
        curves: each gives a file named after its benchmark and title.
        comparisons: those with a goal stand in ``goals.svg``.
        folder: made where it is missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with rc_context(STYLE):
        figures = {
            one.title: (f"{one.benchmark}-{_slug(one.title)}", _curve(one)) for one in curves
        }
        judged = [one for one in comparisons if one.goal is not None]
        if judged:
            figures[GOALS] = ("goals", _goals(judged))
        paths: dict[str, Path] = {}
        for title, (name, figure) in figures.items():
            paths[title] = folder / f"{name}.svg"
            figure.savefig(paths[title], format="svg", transparent=True, metadata={"Date": None})
    return paths


def _curve(curve: Curve) -> Figure:
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.add_subplot()
    for colour, (name, points) in zip(_colours(len(curve.lines)), curve.lines.items(), strict=True):
        xs, ys = zip(*sorted(points), strict=True)
        axes.plot(xs, ys, color=colour, marker="o", markersize=3.5, linewidth=1.6, label=name)
    points = [point for line in curve.lines.values() for point in line]
    if _wide([x for x, _ in points]):
        axes.set_xscale("log")
    if _wide([y for _, y in points]):
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0)
    axes.set_title(curve.title, loc="left")
    axes.set_xlabel(curve.x)
    axes.set_ylabel(curve.y)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(_number))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True)
    if len(curve.lines) > 1:
        axes.legend(labelcolor=GREY)
    return figure


def _goals(comparisons: Sequence[Comparison]) -> Figure:
    """Draw a bar for each goal: how far the figure is from it, 1 being the goal itself."""
    rows = list(reversed(comparisons))
    shares = [_share(one) for one in rows]
    figure = Figure(figsize=(7.2, 0.8 + 0.38 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    axes.set_xscale("log")
    places = range(len(rows))
    axes.vlines(
        [1.0] * len(rows), [at - 0.27 for at in places], [at + 0.27 for at in places], color=GREY
    )
    axes.barh(
        places,
        [share - 1.0 for share in shares],
        left=1.0,
        height=0.36,
        color=[MET if one.met else MISSED for one in rows],
    )
    for place, one in enumerate(rows):
        _describe(axes, one, place)
    axes.set_xlim(min(*shares, 0.1) / 1.5, max(*shares, 10.0) * 1.5)
    axes.set_ylim(-0.5, len(rows) - 0.1)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.set_title(GOALS, loc="left")
    axes.xaxis.set_major_formatter(FuncFormatter(_number))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, axis="x")
    axes.set_axisbelow(True)
    return figure


def _describe(axes: Axes, one: Comparison, place: int) -> None:
    """Write above a bar what it is, and at its right what was measured and wanted."""
    across = axes.get_yaxis_transform()
    unit = "x" if one.unit == "x" else f" {one.unit}"
    text = f"{one.benchmark}: {_case(one)}"
    axes.text(0.0, place + 0.42, text, transform=across, fontsize=8, va="center")
    measured = f"{one.median:.3g}{unit}, {one.goal}"
    axes.text(1.01, place, measured, transform=across, fontsize=8, va="center")


def _share(one: Comparison) -> float:
    """Return the figure as a share of its goal; less is better whichever way the goal points."""
    assert one.goal is not None
    least = 1e-3  # of the goal: "more" may be nothing, or less
    if one.goal.relation == "at most":
        return max(one.median / one.goal.value, least)
    return one.goal.value / max(one.median, least * one.goal.value)


def _case(one: Comparison) -> str:
    if one.yardstick is None or one.how == "alone":
        return one.case
    return f"{one.case}, {'more than' if one.how == 'more' else 'against'} {one.yardstick.name}"


def _colours(count: int) -> Sequence[str]:
    return [COLOURS[number % len(COLOURS)] for number in range(count)]


def _wide(values: Sequence[float]) -> bool:
    return min(values) > 0 and max(values) / min(values) > WIDE


def _number(value: float, _: object) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:g}"


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")
