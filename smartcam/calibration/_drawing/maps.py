"""Draw maps over a camera's field of view, as coloured cells with a legend."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._svg import document, line, rectangle, text

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from smartcam.geometry._inside import Array

WIDTH: Final = 640.0
"""Width of a map, pixels."""

BORDER, HEAD, FOOT = 30.0, 70.0, 84.0
"""Margins beside, above and below a map, pixels."""

COLOURS: Final = (
    *((68, 1, 84), (65, 68, 135), (42, 120, 142), (34, 168, 132)),
    *((122, 209, 81), (253, 231, 37)),
)
"""Colours from small to large values, dark to light, so that colour-blind people can read them.

Source: S. van der Walt and N. Smith, viridis (public domain).
"""

COLOUR_COUNT: Final = 24
"""Number of colours of a map; neighbouring cells of one colour become one rectangle."""

MAX_DECADES: Final = 3.0
"""A map's colours span at most this many powers of ten below its largest value; still smaller
values have the first colour."""

TICK_COUNT: Final = 5


class Map(NamedTuple):
    """The values of one map, with the texts and points on it."""

    title: str
    size: tuple[int, int]  # size of the image, pixels
    values: Array  # (h, w), at a grid of points from corner to corner, drawn as cells; NaN: none
    caption: str = ""  # text below the map
    points: Array = np.zeros((0, 2))  # pixels that are marked by dots


def draw_maps(maps: Sequence[Map], title: str, unit: str) -> str:
    """Return an SVG document with maps side by side, which share one legend."""
    values = np.concatenate([shown_map.values[np.isfinite(shown_map.values)] for shown_map in maps])
    positive_values = values[values > 0.0]
    largest = float(positive_values.max()) if len(positive_values) else 1.0
    smallest = float(positive_values.min()) if len(positive_values) else 0.1
    smallest = max(min(smallest, 0.999 * largest), largest / 10.0**MAX_DECADES)
    height = max(WIDTH * shown_map.size[1] / shown_map.size[0] for shown_map in maps)
    shapes = [text((BORDER, 28), title, "title")] if title else []
    for number, shown_map in enumerate(maps):
        shapes += _map_shapes(shown_map, BORDER + number * (WIDTH + BORDER), smallest, largest)
    shapes += _legend(HEAD + height + 44, smallest, largest, unit)
    return document(len(maps) * (WIDTH + BORDER) + BORDER, HEAD + height + FOOT, shapes)


def _map_shapes(shown_map: Map, left: float, smallest: float, largest: float) -> Iterator[str]:
    height = WIDTH * shown_map.size[1] / shown_map.size[0]
    rows, columns = shown_map.values.shape
    cell = np.array([WIDTH / columns, height / rows])
    yield text((left, HEAD - 12), shown_map.title)
    colour_indices = _colour_indices(shown_map.values, smallest, largest)
    yield '<g shape-rendering="crispEdges">'
    for row in range(rows):
        # neighbouring cells of one colour become one rectangle
        starts = np.flatnonzero(np.diff(colour_indices[row], prepend=-2))
        for start, end in zip(starts, [*starts[1:], columns], strict=True):
            colour_index = int(colour_indices[row, start])
            fill = (
                'fill="none"'
                if colour_index < 0
                else f'fill="{_colour(colour_index / (COLOUR_COUNT - 1))}"'
            )
            corner = (left + start * cell[0], HEAD + row * cell[1])
            yield rectangle(corner, ((end - start) * cell[0], cell[1]), fill)
    yield "</g>"
    point_places = [left, HEAD] + (shown_map.points + 0.5) * WIDTH / shown_map.size[0]
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in point_places.tolist())
    yield f'<path d="{dots}" class="seen"/>'
    yield rectangle((left, HEAD), (WIDTH, height), 'class="axis"')
    yield from _value_labels(shown_map.values, left, height)
    if shown_map.caption:
        yield text((left, HEAD + height + 20), shown_map.caption)


def _value_labels(values: Array, left: float, height: float) -> Iterator[str]:
    """Yield texts with the values at corners and centre, and a cross at the largest value."""
    rows, columns = values.shape
    for row, y in ((0, 20.0), (rows // 2, height / 2 + 5), (rows - 1, height - 10)):
        outer_columns = [(0, 8.0, "start"), (columns - 1, WIDTH - 8, "end")]
        for column, x, anchor in (
            outer_columns if row != rows // 2 else [(columns // 2, WIDTH / 2, "middle")]
        ):
            value = values[row, column]
            label = f"{value:.2g}" if math.isfinite(value) else "beyond the lens model"
            yield text((left + x, HEAD + y), label, "on-map", f' text-anchor="{anchor}"')
    if np.isfinite(values).any():
        row, column = np.unravel_index(np.nanargmax(values), values.shape)
        centre = np.array(
            [left + (column + 0.5) * WIDTH / columns, HEAD + (row + 0.5) * height / rows]
        )
        # the cross must not cover a number
        if row not in {0, rows - 1} or column not in {0, columns - 1}:
            for css_class in ("mark-rim", "mark"):
                for arm in np.array([[6.0, 0.0], [0.0, 6.0]]):
                    yield line(centre - arm, centre + arm, css_class)


def _colour_indices(values: Array, smallest: float, largest: float) -> Array:
    """Return the index of each value's colour, by its logarithm; -1 for NaN and infinity."""
    clipped = np.where(np.isfinite(values), np.clip(values, smallest, largest), smallest)
    fractions = np.log(clipped / smallest) / math.log(largest / smallest)
    levels = np.clip(np.round(fractions * (COLOUR_COUNT - 1)), 0, COLOUR_COUNT - 1)
    indices: Array = np.where(np.isfinite(values), levels, -1)
    return indices


def _colour(fraction: float) -> str:
    position = fraction * (len(COLOURS) - 1)
    low = min(math.floor(position), len(COLOURS) - 2)
    pairs = zip(COLOURS[low], COLOURS[low + 1], strict=True)
    channels = (round(a + (position - low) * (b - a)) for a, b in pairs)
    return "#" + "".join(f"{channel:02x}" for channel in channels)


def _legend(y: float, smallest: float, largest: float, unit: str) -> Iterator[str]:
    width = WIDTH / COLOUR_COUNT
    yield '<g shape-rendering="crispEdges">'
    for step in range(COLOUR_COUNT):
        fill = f'fill="{_colour(step / (COLOUR_COUNT - 1))}"'
        yield rectangle((BORDER + step * width, y - 12), (width, 12), fill)
    yield "</g>"
    for tick in range(TICK_COUNT):
        fraction = tick / (TICK_COUNT - 1)
        value = smallest * (largest / smallest) ** fraction
        anchor = "start" if tick == 0 else "end" if tick == TICK_COUNT - 1 else "middle"
        label = f"{value:.2g}{f' {unit}' if tick == TICK_COUNT - 1 else ''}"
        yield text((BORDER + fraction * WIDTH, y + 16), label, "", f' text-anchor="{anchor}"')
