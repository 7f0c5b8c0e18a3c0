"""Draw one or two bars for each view, with lines at the values of all views together."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam.calibration._svg import document, line, rectangle, round_down, text

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

WIDTH, HEIGHT = 900.0, 260.0
"""Width and height of a chart, pixels."""

LEFT, HEAD, FOOT, GAP = 70.0, 66.0, 40.0, 30.0
"""Margins of a chart on the left, above, below and on the right, pixels."""

LETTER_WIDTH_PX: Final = 7.5
"""Approximate width of a letter, pixels."""

MAX_BAR_RATIO: Final = 3.0
"""Bars longer than this many times the longest bar of a used view are cut, and labelled with their
value."""

MAX_LINES: Final = 5
"""A chart has at most this many horizontal lines."""

DIGITS: Final = "0123456789"

FILLS: Final = ("first", "second")
"""Classes of the series."""


class Series(NamedTuple):
    """One bar of each view."""

    name: str
    values: Sequence[float]  # NaN for a view without a value
    level: float = math.nan  # value of all views together; NaN if there is none


class Chart(NamedTuple):
    """Bars of each view, in one unit."""

    unit: str
    series: Sequence[Series]  # one series or two
    names: Sequence[str]  # names of the views
    off: Sequence[bool]  # whether each view was left out


def draw_bars(charts: Sequence[Chart], title: str) -> str:
    """Return charts, one below the other."""
    height = HEAD + HEIGHT + FOOT
    parts = itertools.chain.from_iterable(
        _chart(chart, 30 + number * height) for number, chart in enumerate(charts)
    )
    head = [text((LEFT, 26), title, "title")] if title else []
    return document(LEFT + WIDTH + GAP, 30 + len(charts) * height, [*head, *parts])


def short_names(names: Sequence[str]) -> list[str]:
    """Return the names without their common beginning and end; digits are kept."""
    if len(set(names)) < 2:
        return list(names)
    begin = _common(names).rstrip(DIGITS)
    tails = [name[len(begin) :] for name in names]
    end = _common([tail[::-1] for tail in tails])[::-1].lstrip(DIGITS)
    shorts = [tail[: len(tail) - len(end)] for tail in tails]
    return [short or name for short, name in zip(shorts, names, strict=True)]


def _common(names: Sequence[str]) -> str:
    """Return the beginning that all names have in common."""
    same = itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in same)


def _chart(chart: Chart, top: float) -> Iterator[str]:
    largest = _largest(chart)
    step = round_down(largest / 2)
    step *= next(factor for factor in (1, 2, 5, 10) if largest / (step * factor) <= MAX_LINES - 1)
    foot = top + HEAD + HEIGHT
    zoom = HEIGHT / (1.08 * largest)
    yield from _legend(chart, top + 24)
    for number in range(math.floor(1.08 * largest / step) + 1):
        y = foot - number * step * zoom
        yield line((LEFT, y), (LEFT + WIDTH, y), "axis", ' stroke-opacity="0.35"')
        yield text((LEFT - 8, y + 4), f"{number * step:.6g}", "", ' text-anchor="end"')
    yield text((LEFT - 8, top + HEAD - 12), chart.unit, "", ' text-anchor="end"')
    yield from _bars(chart, foot, zoom)
    for series, kind in zip(chart.series, FILLS, strict=False):
        if math.isfinite(series.level):
            y = foot - series.level * zoom
            yield line((LEFT, y), (LEFT + WIDTH, y), f"level {kind}-line")
    yield line((LEFT, foot), (LEFT + WIDTH, foot), "axis")


def _largest(chart: Chart) -> float:
    """Return the upper end of a chart, from the views that were used."""
    used = [
        value
        for series in chart.series
        for value, left_out in (*zip(series.values, chart.off, strict=True), (series.level, False))
        if math.isfinite(value) and not left_out
    ]
    every = [value for series in chart.series for value in series.values if math.isfinite(value)]
    most = max(used, default=0.0)
    return (
        max(most, min(max(every), MAX_BAR_RATIO * most)) if most else max(every, default=1.0) or 1.0
    )


def _bars(chart: Chart, foot: float, zoom: float) -> Iterator[str]:
    count = max(len(chart.names), 1)
    room = WIDTH / count
    width = min(0.8 * room / len(chart.series), 40.0)
    shorts = short_names(chart.names)
    longest = max((len(label) for label in shorts), default=1)
    # a name at each bar where there is room, else at each second, fifth, tenth, ...
    needed = math.ceil(LETTER_WIDTH_PX * (min(longest, 12) + 1) / room)
    each = next(n for n in (1, 2, 5, 10, 20, 50, 100, 10**9) if n >= needed)
    for number, (name, short) in enumerate(zip(chart.names, shorts, strict=True)):
        middle = LEFT + (number + 0.5) * room
        left_out = ", left out" if chart.off[number] else ""
        for place, (series, kind) in enumerate(zip(chart.series, FILLS, strict=False)):
            value = series.values[number]
            if math.isfinite(value):
                x = middle + (place - len(chart.series) / 2) * width
                label = f"{name}{left_out}: {series.name} {value:.3g} {chart.unit}"
                fill = "off" if chart.off[number] else kind
                height = min(value * zoom, HEIGHT)
                yield rectangle((x, foot - height), (width, height), f'class="{fill}"', label)
                if height < value * zoom and place == 0:
                    at = (middle, foot - HEIGHT - 6)
                    yield text(at, f"{value:.2g}", "small", ' text-anchor="middle"')
        if number % each == 0:
            yield text((middle, foot + 18), short[:12], "", ' text-anchor="middle"')


def _legend(chart: Chart, y: float) -> Iterator[str]:
    x = LEFT
    entries = [
        (
            kind,
            series.name
            + (f" ({series.level:.3g} {chart.unit} in all)" if math.isfinite(series.level) else ""),
        )
        for series, kind in zip(chart.series, FILLS, strict=False)
    ]
    if any(chart.off):
        entries.append(("off", "left out"))
    for kind, label in entries:
        yield rectangle((x, y - 10), (12, 12), f'class="{kind}"')
        yield text((x + 18, y), label)
        x += 18 + LETTER_WIDTH_PX * len(label) + 20
