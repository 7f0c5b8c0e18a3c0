"""Place a target, its rays, rulers and texts on a page; all lengths are millimetres.

The rays A and B are printed lines from the target's origin, along its x and y axes. The target is
at the lower left, so that they are as long as the page allows. Rulers are to its left and below it;
texts are above it, to the right of the ray B.
"""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Final

from smartcam.calibration._printing.page import Label, Polygon, rectangle
from smartcam.calibration._targets import AREA_DIAMETER_SQUARES, AREA_DISTANCE_SQUARES

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from smartcam.calibration._printing.page import Point, Shape
    from smartcam.calibration._printing.shapes import Box

RULER_MM: Final = 100.0
"""Length of each of the two rulers, mm."""

BORDER_MM: Final = 5.0
"""Width of the page's border that many printers cannot print on, mm."""

MAX_MOVE_MM: Final = 5.0
"""Free space moves a target by at most this far from the border, mm; the rays get the rest."""

MARGIN_RATIO: Final = 0.2
"""Width of the white margin around a target, as a fraction of a square's side or of the distance
between dots."""
MIN_MARGIN_MM, MAX_MARGIN_MM = 2.0, 6.0
"""Bounds of the width of the white margin around a target, mm."""

MIN_RAY_MM: Final = 8.0
RAY_WIDTH: Final = 0.4
RAY_HEAD_MM: Final = (4.0, 1.5)
"""Length of a ray's head and half its width, mm."""
NOTCH_RATIO: Final = 0.65
"""Depth of the notch in the back of a ray's head, as a fraction of its length: a solid head would
be taken for a dot."""
LETTER_MM: Final = 4.0
"""Height of the rays' letters, mm."""

TICK_MM: Final = (0.3, 3.0)
"""Width and height of a ruler's ticks, mm."""
RULER_SPAN_MM: Final = RULER_MM + 12.0
"""Length of a ruler with its label, mm."""

TEXT_MM, LINE_MM = 2.6, 3.4
"""Height of a text and distance between its lines, mm."""
RULE_MM: Final = 0.2
"""Thickness of the line under a text, mm: letters that are joined to a line are not taken for
dots."""
TEXT_LEFT_MM: Final = RAY_HEAD_MM[1] + LETTER_MM + 2
"""Distance from the ray B to the texts right of its letter, mm."""
MIN_LETTERS_PER_LINE: Final = 20
"""A line has room for at least this many letters, even on a small page."""
LETTER_WIDTH_RATIO: Final = 0.6
"""Assumed width of a letter, as a fraction of its height: more than the average of Helvetica or
Arial."""

AREA_REACH_SQUARES: Final = AREA_DISTANCE_SQUARES + AREA_DIAMETER_SQUARES / 2
"""Distance from a checkerboard's outer corners to the outer rims of the origin's dot and of the
round white areas at the other corners, in squares."""

AREA_GAP_MM: Final = 1.0
"""Distance between such an area and the next printed part, mm."""


class PageLayout:
    """The places of all parts on a page.

    Args:
        box: rectangle around the target's pattern.
        pitch: a square's side, or the distance of two dots.
        area_reach: distance by which the origin's dot and the white areas at the other corners
            reach beyond the pattern's corners; 0 without a mark.
        texts: lines of text to print.
        width: width of the page.
        height: height of the page.

    Attributes:
        origin: the target's origin from the page's lower left corner.
        needed_width: width of a page on which the whole layout fits.
        needed_height: height of a page on which the whole layout fits.
    """

    def __init__(
        self,
        box: Box,
        *,
        pitch: float,
        area_reach: float,
        texts: Sequence[str],
        width: float,
        height: float,
    ) -> None:
        self._box = box
        self.width = width
        self.height = height
        self._margin = min(max(MARGIN_RATIO * pitch, MIN_MARGIN_MM), MAX_MARGIN_MM)
        self._area_reach = area_reach
        ray_space = max(self._margin + MIN_RAY_MM, self._area_reach)
        x, needed_width = _place_along_side(
            (box.left, box.right), (self._ruler_space(box.high), ray_space), width
        )
        letters_per_line = max(
            int((width - BORDER_MM - x - TEXT_LEFT_MM) / (LETTER_WIDTH_RATIO * TEXT_MM)),
            MIN_LETTERS_PER_LINE,
        )
        self._lines = [line for text in texts for line in textwrap.wrap(text, letters_per_line)]
        self._text_width = max(map(len, self._lines)) * LETTER_WIDTH_RATIO * TEXT_MM
        text_space = self._distance_from_target(
            TEXT_LEFT_MM + self._text_width, box.right
        ) + LINE_MM * len(self._lines)
        y, needed_height = _place_along_side(
            (box.low, box.high), (self._ruler_space(box.right), max(ray_space, text_space)), height
        )
        self.origin: Point = (x, y)
        self.needed_width: float = needed_width
        self.needed_height: float = needed_height

    def _ruler_space(self, edge: float) -> float:
        """Return the space for a ruler along a target that reaches from its origin to ``edge``."""
        return max(self._distance_from_target(RULER_SPAN_MM, edge) + TICK_MM[1], self._area_reach)

    def _distance_from_target(self, end: float, edge: float) -> float:
        """Return the distance from the target to a part that reaches from the origin to ``end``.

        The part is between the areas at the corners, or beyond them if it does not fit between.
        """
        return self._margin if end <= edge else max(self._margin, self._area_reach + AREA_GAP_MM)

    @property
    def excess(self) -> float:
        """Length by which the layout is too large for the page; zero if it fits."""
        return max(self.needed_width - self.width, 0.0) + max(self.needed_height - self.height, 0.0)

    def extra_shapes(self) -> Iterator[Shape]:
        """Yield rays, rulers and texts."""
        x, y = self.origin
        box = self._box
        length_a = self.width - BORDER_MM - (x + box.right + self._margin)
        yield from _ray_shapes(x + box.right + self._margin, y, length_a, "A")
        top = self.height - BORDER_MM
        length_b = top - (y + box.high + self._margin)
        yield from map(
            _mirror_diagonally, _ray_shapes(y + box.high + self._margin, x, length_b, "B")
        )
        yield from _ruler_shapes(
            x, y + box.low - self._distance_from_target(RULER_SPAN_MM, box.right) - TICK_MM[1]
        )
        ruler_left = x + box.left - self._distance_from_target(RULER_SPAN_MM, box.high) - TICK_MM[1]
        yield from map(_mirror_diagonally, _ruler_shapes(y, ruler_left))
        for number, line in enumerate(self._lines):
            baseline = top - TEXT_MM - LINE_MM * number
            yield rectangle(x + TEXT_LEFT_MM, baseline, self._text_width, RULE_MM)
            yield Label((x + TEXT_LEFT_MM, baseline), line, TEXT_MM)


def _place_along_side(
    pattern: tuple[float, float], spaces: tuple[float, float], page_side: float
) -> tuple[float, float]:
    """Return the origin's position along a side of the page, and the least length of that side.

    ``pattern``: start and end of the pattern, from its origin. ``spaces``: space needed before and
    after the pattern.
    """
    low, high = pattern
    needed = 2 * BORDER_MM + spaces[0] + max(high - low + spaces[1], RULER_SPAN_MM - low)
    shift = min(max(page_side - needed, 0.0) / 2, MAX_MOVE_MM)
    return BORDER_MM + shift + spaces[0] - low, needed


def _ray_shapes(start: float, y: float, length: float, letter: str) -> Iterator[Polygon | Label]:
    """Yield the shapes of a ray along x."""
    tip = start + length
    neck, notch = tip - RAY_HEAD_MM[0], tip - (1 - NOTCH_RATIO) * RAY_HEAD_MM[0]
    yield rectangle(start, y - RAY_WIDTH / 2, notch - start, RAY_WIDTH)
    yield Polygon(
        (
            (neck, y - RAY_HEAD_MM[1]),
            (tip, y),
            (neck, y + RAY_HEAD_MM[1]),
            (notch, y),
        )
    )
    yield Label((neck, y + RAY_HEAD_MM[1] + 1), letter, LETTER_MM)


def _ruler_shapes(start: float, low: float) -> Iterator[Polygon | Label]:
    """Yield the shapes of a ruler along x, measured between the outer sides of its outer ticks."""
    thickness, height = TICK_MM
    yield rectangle(start, low, RULER_MM, thickness)
    for tick in range(11):
        offset = min(max(RULER_MM / 10 * tick, thickness / 2), RULER_MM - thickness / 2)
        yield rectangle(
            start + offset - thickness / 2, low + thickness, thickness, height - thickness
        )
    yield rectangle(start + RULER_MM + 1, low, RULER_SPAN_MM - RULER_MM - 1, RULE_MM)
    yield Label((start + RULER_MM + 1, low), f"{RULER_MM:g} mm", TEXT_MM)


def _mirror_diagonally(shape: Polygon | Label) -> Shape:
    """Return a shape along x mirrored to one along y; letters are not mirrored.

    A single letter stays upright, a longer text runs upwards.
    """
    if isinstance(shape, Polygon):
        return Polygon(tuple((y, x) for x, y in reversed(shape.points)))
    x, y = shape.place
    if len(shape.text) == 1:
        return Label((y, x), shape.text, shape.size)
    return Label((y + shape.size, x), shape.text, shape.size, runs_upwards=True)
