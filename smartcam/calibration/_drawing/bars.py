"""Draw charts with one or two bars for each view, and a line at the overall value of a series."""

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
"""A chart has at most about this many horizontal grid lines."""

DIGITS: Final = "0123456789"

SERIES_CLASSES: Final = ("first", "second")
"""CSS classes of the first and of the second series."""


class Series(NamedTuple):
    """The values of one kind of bar: one value for each view, and the overall value."""

    name: str
    values: Sequence[float]  # NaN for a view without a value
    level: float = math.nan  # overall value of all views; NaN if there is none


class Chart(NamedTuple):
    """A chart with the bars of all views, in one unit."""

    unit: str
    series: Sequence[Series]  # one series or two
    names: Sequence[str]  # names of the views
    is_left_out: Sequence[bool]  # whether each view was left out


def draw_bars(charts: Sequence[Chart], title: str) -> str:
    """Return an SVG document with the charts one below the other."""
    height = HEAD + HEIGHT + FOOT
    shapes = itertools.chain.from_iterable(
        _chart(chart, 30 + number * height) for number, chart in enumerate(charts)
    )
    title_shapes = [text((LEFT, 26), title, "title")] if title else []
    return document(LEFT + WIDTH + GAP, 30 + len(charts) * height, [*title_shapes, *shapes])


def short_names(names: Sequence[str]) -> list[str]:
    """Return the names without their common beginning and end; digits are kept."""
    if len(set(names)) < 2:
        return list(names)
    prefix = _common_start(names).rstrip(DIGITS)
    tails = [name[len(prefix) :] for name in names]
    suffix = _common_start([tail[::-1] for tail in tails])[::-1].lstrip(DIGITS)
    shorts = [tail[: len(tail) - len(suffix)] for tail in tails]
    return [short or name for short, name in zip(shorts, names, strict=True)]


def _common_start(names: Sequence[str]) -> str:
    """Return the beginning that all names have in common."""
    same = itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in same)


def _chart(chart: Chart, top: float) -> Iterator[str]:
    largest = _largest(chart)
    step = round_down(largest / 2)
    step *= next(factor for factor in (1, 2, 5, 10) if largest / (step * factor) <= MAX_LINES - 1)
    bottom = top + HEAD + HEIGHT
    zoom = HEIGHT / (1.08 * largest)
    yield from _legend(chart, top + 24)
    for number in range(math.floor(1.08 * largest / step) + 1):
        y = bottom - number * step * zoom
        yield line((LEFT, y), (LEFT + WIDTH, y), "axis", ' stroke-opacity="0.35"')
        yield text((LEFT - 8, y + 4), f"{number * step:.6g}", "", ' text-anchor="end"')
    yield text((LEFT - 8, top + HEAD - 12), chart.unit, "", ' text-anchor="end"')
    yield from _bars(chart, bottom, zoom)
    for series, css_class in zip(chart.series, SERIES_CLASSES, strict=False):
        if math.isfinite(series.level):
            y = bottom - series.level * zoom
            yield line((LEFT, y), (LEFT + WIDTH, y), f"level {css_class}-line")
    yield line((LEFT, bottom), (LEFT + WIDTH, bottom), "axis")


def _largest(chart: Chart) -> float:
    """Return the upper end of a chart's axis; bars of left-out views may be longer."""
    used_values = [
        value
        for series in chart.series
        for value, left_out in (
            *zip(series.values, chart.is_left_out, strict=True),
            (series.level, False),
        )
        if math.isfinite(value) and not left_out
    ]
    all_values = [
        value for series in chart.series for value in series.values if math.isfinite(value)
    ]
    largest_used = max(used_values, default=0.0)
    return (
        max(largest_used, min(max(all_values), MAX_BAR_RATIO * largest_used))
        if largest_used
        else max(all_values, default=1.0) or 1.0
    )


def _bars(chart: Chart, bottom: float, zoom: float) -> Iterator[str]:
    count = max(len(chart.names), 1)
    view_width = WIDTH / count
    width = min(0.8 * view_width / len(chart.series), 40.0)
    shorts = short_names(chart.names)
    longest = max((len(label) for label in shorts), default=1)
    # a name at each bar if there is room, else at every second, fifth, tenth, ...
    min_label_step = math.ceil(LETTER_WIDTH_PX * (min(longest, 12) + 1) / view_width)
    label_step = next(n for n in (1, 2, 5, 10, 20, 50, 100, 10**9) if n >= min_label_step)
    for number, (name, short) in enumerate(zip(chart.names, shorts, strict=True)):
        centre = LEFT + (number + 0.5) * view_width
        left_out = ", left out" if chart.is_left_out[number] else ""
        for series_index, (series, css_class) in enumerate(
            zip(chart.series, SERIES_CLASSES, strict=False)
        ):
            value = series.values[number]
            if math.isfinite(value):
                x = centre + (series_index - len(chart.series) / 2) * width
                label = f"{name}{left_out}: {series.name} {value:.3g} {chart.unit}"
                fill = "off" if chart.is_left_out[number] else css_class
                height = min(value * zoom, HEIGHT)
                yield rectangle((x, bottom - height), (width, height), f'class="{fill}"', label)
                if height < value * zoom and series_index == 0:
                    label_place = (centre, bottom - HEIGHT - 6)
                    yield text(label_place, f"{value:.2g}", "small", ' text-anchor="middle"')
        if number % label_step == 0:
            yield text((centre, bottom + 18), short[:12], "", ' text-anchor="middle"')


def _legend(chart: Chart, y: float) -> Iterator[str]:
    x = LEFT
    entries = [
        (
            css_class,
            f"{series.name} ({series.level:.3g} {chart.unit} overall)"
            if math.isfinite(series.level)
            else series.name,
        )
        for series, css_class in zip(chart.series, SERIES_CLASSES, strict=False)
    ]
    if any(chart.is_left_out):
        entries.append(("off", "left out"))
    for css_class, label in entries:
        yield rectangle((x, y - 10), (12, 12), f'class="{css_class}"')
        yield text((x + 18, y), label)
        x += 18 + LETTER_WIDTH_PX * len(label) + 20
