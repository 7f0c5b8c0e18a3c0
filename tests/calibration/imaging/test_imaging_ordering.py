"""How the points of a grid are numbered."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from drawnkit import drawn
from imaging_scenes import refused

from smartcam.calibration.codes import Code
from smartcam.calibration.detection.grid_growing import lattices
from smartcam.calibration.detection.ordering import (
    Arrangement,
    arrangements,
    leftmost,
    marked,
    rows_of,
)
from smartcam.calibration.targets import Checkerboard, CircleGrid

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration.geometry.rotations import Array

GRIDS = [
    (CircleGrid(columns=6, rows=4, spacing=0.02, diameter=0.01), 4, 2),
    (CircleGrid(columns=5, rows=5, spacing=0.02, diameter=0.01), 8, 4),
    (CircleGrid(columns=4, rows=11, spacing=0.04, diameter=0.01, asymmetric=True), 2, 1),
    (CircleGrid(columns=4, rows=6, spacing=0.04, diameter=0.01, asymmetric=True), 2, 2),
    (CircleGrid(columns=5, rows=10, spacing=0.04, diameter=0.01, asymmetric=True), 4, 2),
]


def laid_out(points: Array) -> NDArray[np.intp]:
    """Return the places (N, 2) of points that are a grid."""
    (grid,) = lattices(points, np.ones(len(points)), least=len(points), most=len(points))
    places = np.zeros((len(points), 2), dtype=np.intp)
    places[list(grid.values())] = list(grid)
    return places


@pytest.mark.parametrize(("grid", "count", "proper"), GRIDS, ids=repr)
def test_arrangements_of_shuffled_points_are_those_that_look_alike(
    grid: CircleGrid, count: int, proper: int
) -> None:
    pixels = drawn(grid, tilt=40, roll=25).pixels
    shuffled = np.random.default_rng(1).permutation(len(pixels))
    found = pixels[shuffled]
    ways = arrangements(found, laid_out(found), grid)
    assert (len(ways), sum(way.proper for way in ways)) == (count, proper)
    numbered = [way.order.ravel().tolist() for way in ways if way.proper]
    assert np.argsort(shuffled).tolist() in numbered


def test_arrangements_of_other_counts_are_none() -> None:
    grid, other = GRIDS[0][0], CircleGrid(columns=8, rows=3, spacing=0.02, diameter=0.01)
    pixels = drawn(grid).pixels
    assert arrangements(pixels, laid_out(pixels), other) == []


def test_arrangements_of_a_grid_with_a_point_too_many_are_none() -> None:
    board = Checkerboard(columns=5, rows=4, square=0.02)
    pixels, places = drawn(board).pixels, rows_of(5, 4)
    more = np.vstack([pixels, pixels[:1] - 30]), np.vstack([places, [[-1, 0]]])
    assert arrangements(pixels, places, board) != []
    assert arrangements(*more, board) == []


def test_rows_of_counts_columns_first() -> None:
    assert rows_of(3, 2).tolist() == [[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]]


def test_leftmost_is_proper_and_points_right() -> None:
    order = np.zeros((1, 1), dtype=np.intp)
    ways = [
        Arrangement(order, proper=False, rightward=1.0),
        Arrangement(order, proper=True, rightward=-0.9),
        Arrangement(order, proper=True, rightward=0.9),
    ]
    assert leftmost(ways, "board") is ways[2]
    with refused(Code.MIRRORED, "board: expected an image of the sheet as one reads it"):
        leftmost(ways[:1], "board")


@pytest.mark.parametrize(("levels", "origin"), [([40, 200, 190, 180], 0), ([9, 9, 0, 200], None)])
def test_marked_takes_the_darkest_by_a_margin(levels: list[float], origin: int | None) -> None:
    board = Checkerboard(columns=5, rows=4, square=0.02)
    pixels = drawn(board).pixels
    ways = arrangements(pixels, rows_of(5, 4), board)
    corners = [0, 4, 19, 15]

    def level(order: np.ndarray) -> float:
        return levels[corners.index(int(order[0, 0]))]

    if origin is None:
        with refused(Code.AMBIGUOUS_ORIGIN, "by 30 grey levels of 255, got 9"):
            marked(ways, level, "board")
    else:
        way, margin = marked(ways, level, "board")
        assert (way.order[0, 0], margin) == (0, 140)
