"""Number the points that were found in an image as the target numbers them.

A detector returns a grid whose first point may be any of its corners. There are only a few ways to
number its points by the target's rows and columns. In some of them the sheet's front faces the
camera (``is_front``); the others show the sheet mirrored.
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
"""A marked origin is darker than any other corner by at least this many grey levels of 255."""

_STEP_CHANGES: Final = [
    np.array(entries).reshape(2, 2)
    for entries in itertools.product((-1, 0, 1), repeat=4)
    if abs(entries[0] * entries[3] - entries[1] * entries[2]) == 1
]
"""Matrices from the steps of a found grid to the steps of the target's columns and rows: turns,
with or without a reflection, and shears, since a tilted sheet's diagonals may look shorter than its
sides."""


class Arrangement(NamedTuple):
    """One way to number the points that were found."""

    # (rows, columns), index of the found point in each row and column of the target
    order: NDArray[np.intp]
    is_front: bool  # whether the sheet's front is seen; False: its mirror image
    rightward: float  # cosine of the angle between the target's x and the image's u


def find_arrangements(
    points: Array, grid_positions: NDArray[np.intp], target: Checkerboard | CircleGrid
) -> list[Arrangement]:
    """Return all ways in which a grid can be numbered.

    ``points`` (N, 2): all points of the target in any order, pixels. ``grid_positions`` (N, 2): the
    column and the row of each point, with arbitrary origin and directions. In a grid with shifted
    rows, positions count the steps along the two diagonals, to the nearest points.
    """
    target_positions = _target_positions(target)
    arrangements: list[Arrangement] = []
    if len(points) != len(target_positions):
        return arrangements
    for step_change in _STEP_CHANGES:
        turned_positions = grid_positions @ step_change
        index_at = {
            position: index for index, position in enumerate(_shift_to_zero(turned_positions))
        }
        order = [index_at.get(position) for position in target_positions]
        if None not in order:
            order_by_rows = np.array(order, dtype=np.intp).reshape(target.rows, target.columns)
            arrangements.append(_arrangement(points, order_by_rows))
    return arrangements


def _shift_to_zero(grid_positions: NDArray[np.intp]) -> list[tuple[int, int]]:
    return [(x, y) for x, y in (grid_positions - grid_positions.min(axis=0)).tolist()]


def _target_positions(target: Checkerboard | CircleGrid) -> list[tuple[int, int]]:
    """Return the columns and rows of a target's points, as :func:`find_arrangements` takes them."""
    row, column = np.divmod(np.arange(target.columns * target.rows), target.columns)
    if isinstance(target, CircleGrid) and target.asymmetric:
        half_steps = 2 * column + row % 2
        column, row = (half_steps + row) // 2, (half_steps - row) // 2
    return _shift_to_zero(np.stack([column, row], axis=1))


def positions_row_by_row(columns: int, rows: int) -> NDArray[np.intp]:
    """Return the grid positions (N, 2), column and row, of points in the order of rows."""
    row, column = np.divmod(np.arange(columns * rows), columns)
    return np.stack([column, row], axis=1)


def _arrangement(points: Array, order: NDArray[np.intp]) -> Arrangement:
    origin, x_end, y_end = points[order[0, 0]], points[order[0, -1]], points[order[-1, 0]]
    x, y = x_end - origin, y_end - origin
    # v points down, so the cross product of x and y is negative if the sheet's front is seen
    cross_product = float(x[0] * y[1] - x[1] * y[0])
    return Arrangement(order, cross_product < 0, float(x[0] / np.hypot(*x)))


def choose_rightward(arrangements: Sequence[Arrangement], label: str) -> Arrangement:
    """Return the arrangement that shows the front and whose x points most to the image's right.

    Raises MIRRORED if no arrangement shows the front; ``label`` names the target.
    """
    front_views = [arrangement for arrangement in arrangements if arrangement.is_front]
    if not front_views:
        raise Code.MIRRORED.error(
            f"{label}: expected an image of the sheet as one reads it, got one that is mirrored",
            "y pointing to the left of x",
            "y pointing to the right of x",
        )
    return max(front_views, key=lambda arrangement: arrangement.rightward)


def choose_marked(
    arrangements: Sequence[Arrangement], level: Callable[[NDArray[np.intp]], float], label: str
) -> tuple[Arrangement, float]:
    """Return the arrangement with a dark mark at its origin, and the mark's margin in grey levels.

    ``level`` returns the grey level, of 255, at the place where an arrangement would have its mark.
    ``label``: the target and its mark, for messages. Raises MIRRORED; or AMBIGUOUS_ORIGIN: the
    darkest corner is not MIN_ORIGIN_CONTRAST darker than the next one.
    """
    levels = {
        int(arrangement.order[0, 0]): level(arrangement.order) for arrangement in arrangements
    }
    origin, second = sorted(levels, key=lambda corner: levels[corner])[:2]
    margin = levels[second] - levels[origin]
    if not margin >= MIN_ORIGIN_CONTRAST:
        raise Code.AMBIGUOUS_ORIGIN.error(
            f"{label}: expected the origin to be darker than the other corners by "
            f"{MIN_ORIGIN_CONTRAST:g} grey levels of 255, got {margin:.0f}",
            MIN_ORIGIN_CONTRAST,
            margin,
        )
    return choose_rightward(
        [arrangement for arrangement in arrangements if arrangement.order[0, 0] == origin], label
    ), margin
