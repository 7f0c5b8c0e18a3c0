"""Outline the tangram pieces, to draw them.

A tangram is a square cut into seven pieces; this one has sides of 0.1 m, so that the pieces do not
touch in the scene (derived from :data:`~smartcam.emulator._scene.PIECES`). The pose of a piece
is that of its centroid; a triangle's longest side, and the longer side of the parallelogram, lie
along its x axis.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping

SIDE = 0.1
"""Side of the square that all seven pieces make together, in metres."""

Outline: TypeAlias = tuple[tuple[float, float], ...]
"""Corners x, y relative to the centroid, in metres, counter-clockwise."""


def _triangle(longest: float) -> Outline:
    """Return an isosceles right triangle."""
    height = longest / 2
    base = -height / 3
    return ((-longest / 2, base), (longest / 2, base), (0.0, base + height))


def _parallelogram(base: float, height: float, lean: float) -> Outline:
    left, right = (base + lean) / 2, (base - lean) / 2
    return (
        (-left, -height / 2),
        (right, -height / 2),
        (left, height / 2),
        (-right, height / 2),
    )


_EDGE = SIDE / math.sqrt(8)

OUTLINES: Mapping[str, Outline] = {
    "big_triangle_1": _triangle(SIDE),
    "big_triangle_2": _triangle(SIDE),
    "medium_triangle": _triangle(SIDE / math.sqrt(2)),
    "small_triangle_1": _triangle(SIDE / 2),
    "small_triangle_2": _triangle(SIDE / 2),
    "square": _parallelogram(_EDGE, _EDGE, 0.0),
    "parallelogram": _parallelogram(SIDE / 2, SIDE / 4, SIDE / 4),
}
"""The outline of each piece, by its name in a scene."""
