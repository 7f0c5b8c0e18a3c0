"""Place a target, its rays, rulers and texts on a page; all lengths are millimetres.

The target is at the lower left, so that the rays A and B are as long as the page allows. Rulers are
left of it and below it, texts above it, right of the ray B.
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
"""Border of the page, mm, which many printers leave white."""

MAX_MOVE_MM: Final = 5.0
"""Largest distance of a target from the border, mm; the rest of the space is for the rays."""

MARGIN_RATIO: Final = 0.2
"""Width of the white margin around a target, as a part of a square's side or of the distance
between dots."""
MIN_MARGIN_MM, MAX_MARGIN_MM = 2.0, 6.0
"""Bounds of the width of the white margin around a target, mm."""

MIN_RAY_MM: Final = 8.0
RAY_WIDTH: Final = 0.4
RAY_HEAD_MM: Final = (4.0, 1.5)
"""Length of a ray's head and half its width, mm."""
NOTCH_RATIO: Final = 0.65
"""Depth of the notch in the back of a ray's head, as a part of its length: a solid head would be
taken for a dot."""
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
"""Assumed width of a letter, as a part of its height: more than the average of Helvetica or
Arial."""

AREA_REACH_SQUARES: Final = AREA_DISTANCE_SQUARES + AREA_DIAMETER_SQUARES / 2
"""Distance that the areas outside of a checkerboard's outer corners reach, in sides of a square."""

AREA_GAP_MM: Final = 1.0
"""Distance between a white area outside of a checkerboard and the parts beyond it, mm."""


class PageLayout:
    """The places of all parts on a page.

    Args:
        box: rectangle around the target's pattern.
        pitch: a square's side, or the distance of two dots.
        areas: distance that white areas outside of the pattern's corners reach, an origin mark
            included.
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
        areas: float,
        texts: Sequence[str],
        width: float,
        height: float,
    ) -> None:
        self._box = box
        self.width = width
        self.height = height
        self._quiet = min(max(MARGIN_RATIO * pitch, MIN_MARGIN_MM), MAX_MARGIN_MM)
        self._areas = areas
        ray = max(self._quiet + MIN_RAY_MM, self._areas)
        x, needed_width = _along((box.left, box.right), (self._ruler_band(box.high), ray), width)
        letters = max(
            int((width - BORDER_MM - x - TEXT_LEFT_MM) / (LETTER_WIDTH_RATIO * TEXT_MM)),
            MIN_LETTERS_PER_LINE,
        )
        self._lines = [line for text in texts for line in textwrap.wrap(text, letters)]
        self._longest = max(map(len, self._lines)) * LETTER_WIDTH_RATIO * TEXT_MM
        text = self._clear(TEXT_LEFT_MM + self._longest, box.right) + LINE_MM * len(self._lines)
        y, needed_height = _along(
            (box.low, box.high), (self._ruler_band(box.right), max(ray, text)), height
        )
        self.origin: Point = (x, y)
        self.needed_width: float = needed_width
        self.needed_height: float = needed_height

    def _ruler_band(self, edge: float) -> float:
        """Return the width of a ruler beside a target that reaches from its origin to ``edge``."""
        return max(self._clear(RULER_SPAN_MM, edge) + TICK_MM[1], self._areas)

    def _clear(self, end: float, edge: float) -> float:
        """Return the distance from the target of a part that reaches from the origin to ``end``.

        The part is placed between the areas at the corners, or beyond them if it does not fit.
        """
        return self._quiet if end <= edge else max(self._quiet, self._areas + AREA_GAP_MM)

    @property
    def excess(self) -> float:
        """Length by which the layout is too large for the page; zero if it fits."""
        return max(self.needed_width - self.width, 0.0) + max(self.needed_height - self.height, 0.0)

    def furniture(self) -> Iterator[Shape]:
        """Yield rays, rulers and texts."""
        x, y = self.origin
        box = self._box
        end = self.width - BORDER_MM - (x + box.right + self._quiet)
        yield from _ray(x + box.right + self._quiet, y, end, "A")
        top = self.height - BORDER_MM
        upward = top - (y + box.high + self._quiet)
        yield from map(_upright, _ray(y + box.high + self._quiet, x, upward, "B"))
        yield from _ruler(x, y + box.low - self._clear(RULER_SPAN_MM, box.right) - TICK_MM[1])
        beside = x + box.left - self._clear(RULER_SPAN_MM, box.high) - TICK_MM[1]
        yield from map(_upright, _ruler(y, beside))
        for number, line in enumerate(self._lines):
            low = top - TEXT_MM - LINE_MM * number
            yield rectangle(x + TEXT_LEFT_MM, low, self._longest, RULE_MM)
            yield Label((x + TEXT_LEFT_MM, low), line, TEXT_MM)


def _along(
    pattern: tuple[float, float], bands: tuple[float, float], side: float
) -> tuple[float, float]:
    """Return the origin's place along a side of the page, and the least length of that side.

    ``pattern``: begin and end of the pattern, from its origin. ``bands``: space needed before and
    after the pattern.
    """
    low, high = pattern
    needed = 2 * BORDER_MM + bands[0] + max(high - low + bands[1], RULER_SPAN_MM - low)
    spare = min(max(side - needed, 0.0) / 2, MAX_MOVE_MM)
    return BORDER_MM + spare + bands[0] - low, needed


def _ray(start: float, across: float, length: float, letter: str) -> Iterator[Polygon | Label]:
    """Yield a ray along x."""
    tip = start + length
    neck, notch = tip - RAY_HEAD_MM[0], tip - (1 - NOTCH_RATIO) * RAY_HEAD_MM[0]
    yield rectangle(start, across - RAY_WIDTH / 2, notch - start, RAY_WIDTH)
    yield Polygon(
        (
            (neck, across - RAY_HEAD_MM[1]),
            (tip, across),
            (neck, across + RAY_HEAD_MM[1]),
            (notch, across),
        )
    )
    yield Label((neck, across + RAY_HEAD_MM[1] + 1), letter, LETTER_MM)


def _ruler(start: float, low: float) -> Iterator[Polygon | Label]:
    """Yield a ruler along x; it reaches from the outer side of its first tick to the last one's."""
    thick, high = TICK_MM
    yield rectangle(start, low, RULER_MM, thick)
    for tick in range(11):
        middle = min(max(RULER_MM / 10 * tick, thick / 2), RULER_MM - thick / 2)
        yield rectangle(start + middle - thick / 2, low + thick, thick, high - thick)
    yield rectangle(start + RULER_MM + 1, low, RULER_SPAN_MM - RULER_MM - 1, RULE_MM)
    yield Label((start + RULER_MM + 1, low), f"{RULER_MM:g} mm", TEXT_MM)


def _upright(shape: Polygon | Label) -> Shape:
    """Turn a shape along x into one along y: mirrored, except for its letters.

    A single letter stays upright, a longer text runs upwards.
    """
    if isinstance(shape, Polygon):
        return Polygon(tuple((y, x) for x, y in reversed(shape.points)))
    x, y = shape.place
    if len(shape.text) == 1:
        return Label((y, x), shape.text, shape.size)
    return Label((y + shape.size, x), shape.text, shape.size, turned=True)
