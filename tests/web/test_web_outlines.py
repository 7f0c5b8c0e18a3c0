"""The shapes of the tangram pieces."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import pytest

from smartcam.emulator.scene import PIECES, TABLE_SIZE
from smartcam.web.shapes import OUTLINES, SIDE

if TYPE_CHECKING:
    from smartcam.web.shapes import Outline

Point = tuple[float, float]


def edges(outline: Outline) -> list[tuple[Point, Point]]:
    return list(zip(outline, (*outline[1:], outline[0]), strict=True))


def area(outline: Outline) -> float:
    return sum(x1 * y2 - x2 * y1 for (x1, y1), (x2, y2) in edges(outline)) / 2


def placed(name: str) -> Outline:
    x, y, theta = PIECES[name]
    cos, sin = math.cos(theta), math.sin(theta)
    return tuple((x + cos * u - sin * v, y + sin * u + cos * v) for u, v in OUTLINES[name])


def gap(one: Outline, other: Outline) -> float:
    """Return the widest gap that a straight line along an edge has; negative where they touch."""
    widest = -math.inf
    for (x1, y1), (x2, y2) in [*edges(one), *edges(other)]:
        length = math.dist((x1, y1), (x2, y2))
        across = [[((y2 - y1) * x + (x1 - x2) * y) / length for x, y in s] for s in (one, other)]
        (low, high), (low2, high2) = [(min(all_), max(all_)) for all_ in across]
        widest = max(widest, low - high2, low2 - high)
    return widest


def test_outlines_make_one_square() -> None:
    assert list(OUTLINES) == list(PIECES)
    assert all(area(outline) > 0 for outline in OUTLINES.values())  # counter-clockwise
    assert sum(map(area, OUTLINES.values())) == pytest.approx(SIDE**2)
    sizes = {name: area(outline) / SIDE**2 for name, outline in OUTLINES.items()}
    assert sizes["big_triangle_1"] == pytest.approx(1 / 4)
    assert sizes["medium_triangle"] == pytest.approx(1 / 8)
    assert sizes["square"] == pytest.approx(1 / 8)
    assert sizes["parallelogram"] == pytest.approx(1 / 8)
    assert sizes["small_triangle_2"] == pytest.approx(1 / 16)


def test_outlines_are_about_their_centroids() -> None:
    for outline in OUTLINES.values():
        centre = [sum(point[axis] for point in outline) / len(outline) for axis in (0, 1)]
        assert centre == pytest.approx([0.0, 0.0])


def test_pieces_lie_apart_on_the_table_with_their_outlines() -> None:
    shapes = [placed(name) for name in PIECES]
    for x, y in itertools.chain(*shapes):
        assert 0 < x < TABLE_SIZE[0]
        assert 0 < y < TABLE_SIZE[1]
    for one, other in itertools.combinations(shapes, 2):
        assert gap(one, other) > 0.01
