"""Number the points that were found as the target numbers them.

A detector returns a grid whose first point may be any of its corners. There are only a few ways to
lay the target's rows and columns over it. Those in which the sheet's front faces the camera are
``proper``; the others show it mirrored.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._targets import CircleGrid
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._targets import Checkerboard
    from smartcam.geometry._inside import Array

MIN_ORIGIN_CONTRAST = 30.0
"""A marked origin is darker than the next darkest corner by at least this many grey levels of
255."""

_TURNS: Final = [
    np.array(entries).reshape(2, 2)
    for entries in itertools.product((-1, 0, 1), repeat=4)
    if abs(entries[0] * entries[3] - entries[1] * entries[2]) == 1
]
"""Matrices from the steps by which a grid was found to the steps to the next column and row:
turns, mirrored or not, and shears, since a tilted sheet's diagonals may look shorter than its
sides."""


class Arrangement(NamedTuple):
    """One way to number the points that were found."""

    # (rows, columns), index of the found point in each row and column of the target
    order: NDArray[np.intp]
    proper: bool  # True if the sheet's front is seen, and not its mirror image
    rightward: float  # cosine of the angle between the target's x and the image's u


def arrangements(
    points: Array, places: NDArray[np.intp], target: Checkerboard | CircleGrid
) -> list[Arrangement]:
    """Return all ways in which a grid can be numbered.

    ``points`` (N, 2), pixels, are all points of the target in any order; ``places`` (N, 2) the
    column and the row of each, with arbitrary origin and directions; in a grid with shifted rows
    they count the steps along the two diagonals, to the nearest points.
    """
    wanted = _places(target)
    ways: list[Arrangement] = []
    if len(points) != len(wanted):
        return ways
    for turn in _TURNS:
        turned = places @ turn
        index_at = {place: index for index, place in enumerate(_from_zero(turned))}
        order = [index_at.get(place) for place in wanted]
        if None not in order:
            shaped = np.array(order, dtype=np.intp).reshape(target.rows, target.columns)
            ways.append(_arrangement(points, shaped))
    return ways


def _from_zero(places: NDArray[np.intp]) -> list[tuple[int, int]]:
    return [(x, y) for x, y in (places - places.min(axis=0)).tolist()]


def _places(target: Checkerboard | CircleGrid) -> list[tuple[int, int]]:
    """Return the columns and rows of a target's points, as :func:`arrangements` takes them."""
    row, column = np.divmod(np.arange(target.columns * target.rows), target.columns)
    if isinstance(target, CircleGrid) and target.asymmetric:
        half = 2 * column + row % 2
        column, row = (half + row) // 2, (half - row) // 2
    return _from_zero(np.stack([column, row], axis=1))


def places_row_by_row(columns: int, rows: int) -> NDArray[np.intp]:
    """Return the places (N, 2) of points that come row by row."""
    row, column = np.divmod(np.arange(columns * rows), columns)
    return np.stack([column, row], axis=1)


def _arrangement(points: Array, order: NDArray[np.intp]) -> Arrangement:
    origin, x_end, y_end = points[order[0, 0]], points[order[0, -1]], points[order[-1, 0]]
    x, y = x_end - origin, y_end - origin
    turn = float(
        x[0] * y[1] - x[1] * y[0]
    )  # v points down: negative where y is counter-clockwise of x
    return Arrangement(order, turn < 0, float(x[0] / np.hypot(*x)))


def most_rightward(ways: Sequence[Arrangement], label: str) -> Arrangement:
    """Return the proper arrangement whose x points most to the image's right, which is unique.

    Raises MIRRORED if no arrangement is proper; ``label`` names the target.
    """
    proper = [arrangement for arrangement in ways if arrangement.proper]
    if not proper:
        raise Code.MIRRORED.refusal(
            f"{label}: expected an image of the sheet as one reads it, got one that is mirrored",
            "y to the left of x",
            "y to the right of x",
        )
    return max(proper, key=lambda arrangement: arrangement.rightward)


def marked(
    ways: Sequence[Arrangement], level: Callable[[NDArray[np.intp]], float], label: str
) -> tuple[Arrangement, float]:
    """Return the arrangement with a dark mark at its origin, and the mark's margin in grey levels.

    ``level`` returns the grey level, of 255, at the place where an arrangement would have its mark.
    ``label`` are the target and its mark, for messages. Raises AMBIGUOUS_ORIGIN if the mark is too
    little darker than the next corner, and MIRRORED.
    """
    levels = {int(arrangement.order[0, 0]): level(arrangement.order) for arrangement in ways}
    origin, second = sorted(levels, key=lambda corner: levels[corner])[:2]
    margin = levels[second] - levels[origin]
    if not margin >= MIN_ORIGIN_CONTRAST:
        raise Code.AMBIGUOUS_ORIGIN.refusal(
            f"{label}: expected the origin to be darker than the other corners by "
            f"{MIN_ORIGIN_CONTRAST:g} grey levels of 255, got {margin:.0f}",
            MIN_ORIGIN_CONTRAST,
            margin,
        )
    return most_rightward(
        [arrangement for arrangement in ways if arrangement.order[0, 0] == origin], label
    ), margin
