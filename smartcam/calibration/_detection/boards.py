"""Checkerboards of any size in images: corners in rows and columns, whole or in part.

Saddles of the grey levels whose neighbours are turned against them hang together as a board's
corners do, and little else does. They are looked for in a reduced image, and completed in the given
one by fits where the ones found say that the next ones are.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration._detection.corners import refine_corners
from smartcam.calibration._detection.dots import GridMap
from smartcam.calibration._detection.grid_growing import lattices
from smartcam.calibration._detection.image import reduced
from smartcam.calibration._detection.saddles import find_saddles
from smartcam.calibration._geometry.homography import local_steps

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smartcam.calibration._detection.grid_growing import Lattice
    from smartcam.calibration._detection.image import GreyImage
    from smartcam.calibration._geometry.rotations import Array

USUAL_SIDE = 800
"""Longest side, pixels, of the image that is looked at in half of this size first, then in this,
and then in double size, as far as it is as large."""

NEIGHBOURS = 8
"""Saddles around one among which a board's next ones are: four and what else is near."""

PART = 0.45
"""Of a square around a corner that is fitted: its own edges, not the next ones and their blur."""

LEAST_FITTED = 0.6
"""Of the corners whose fit is good and whose colours are in turn; what is no board has fewer."""

LEAST_FILLED = 0.5
"""Of an outermost row or column, which is left out with fewer corners."""

ASIDE = 0.25
"""Of a step, from where a corner should be to where it is at most."""

LEAST_AREA = 9.0
"""Of a square that is fitted, pixels^2."""

MOST_REACH = 8.0
"""Pixels from a corner that are fitted at most: enough to see whether there is one."""

MOST_FITTED = 24
"""Corners of a part of a board by which is judged whether it is one."""

MOST_ROUNDS = 4
"""In which a board is completed."""


class Board(NamedTuple):
    """Corners in rows and columns."""

    points: Array  # (N, 2), pixels
    places: NDArray[np.intp]  # (N, 2), column and row, counted from anywhere in any direction

    @property
    def shape(self) -> tuple[int, int]:
        """Columns and rows."""
        if not len(self.places):
            return 0, 0
        columns, rows = (np.ptp(self.places, axis=0) + 1).tolist()
        return columns, rows

    @property
    def is_full(self) -> bool:
        """Whether no corner is missing."""
        columns, rows = self.shape
        return len(self.places) == columns * rows

    def by_rows(self, columns: int, rows: int) -> Array | None:
        """Return all points (columns * rows, 2), row by row; None where it is another board."""
        if not self.is_full or sorted(self.shape) != sorted((columns, rows)):
            return None
        row, column = (1, 0) if self.shape == (columns, rows) else (0, 1)
        return self.points[np.lexsort((self.places[:, column], self.places[:, row]))]

    def trimmed(self) -> Board:
        """Return it without outermost rows and columns that have few corners."""
        places = self.places
        for axis, end in itertools.product((0, 1), (np.min, np.max)):
            if not len(places):
                break
            outermost = places[:, axis] == end(places[:, axis])
            if outermost.sum() < LEAST_FILLED * self.shape[1 - axis]:
                return Board(self.points[~outermost], places[~outermost]).trimmed()
        return self


def parity(places: NDArray[np.intp]) -> Array:
    """Return 1 and -1 in turn."""
    return np.where(places.sum(axis=1) % 2 == 0, 1.0, -1.0)


def boards(image: GreyImage, count: int, *, most: int) -> Iterator[Board]:
    """Yield the largest board in each size of an image, with ``most`` corners or some more.

    The search in a size ends with the first one of ``count`` corners or more.
    """
    least = math.ceil(max(image.size) / USUAL_SIDE)
    for times in dict.fromkeys((2 * least, least, (least + 1) // 2)):
        seen = find_saddles(reduced(image.bytes, times))
        largest: Lattice = {}
        for found in lattices(seen.points, seen.alike, least=4, most=most, neighbours=NEIGHBOURS):
            largest = max(largest, found, key=len)
            if len(largest) >= count:
                break
        if largest:
            points = (seen.points[list(largest.values())] + 0.5) * times - 0.5
            yield Board(points, np.array(list(largest), dtype=np.intp)).trimmed()


def completed(image: GreyImage, board: Board) -> Board | None:
    """Return a board with the corners that were missed; None where fits show none."""
    some = board.places[:: math.ceil(len(board.places) / MOST_FITTED)]
    _, signs = _fitted(image, board, some)
    sign = float(parity(some) @ signs)
    if abs(sign) < LEAST_FITTED * len(some):
        return None
    for _ in range(MOST_ROUNDS):
        missing = _missing(board)
        points, signs = _fitted(image, board, missing)
        right = parity(missing) * signs * sign > 0
        if not right.any():
            break
        board = Board(
            np.concatenate([board.points, points[right]]),
            np.concatenate([board.places, missing[right]]),
        ).trimmed()
    return board


def _missing(board: Board) -> NDArray[np.intp]:
    """Return the places (N, 2) where no corner was found, those next to the board among them."""
    low, high = board.places.min(axis=0) - 1, board.places.max(axis=0) + 1
    every = itertools.product(*(range(a, b + 1) for a, b in zip(low, high, strict=True)))
    there = set(map(tuple, board.places.tolist()))
    missing = [place for place in every if place not in there]
    return np.array(missing, dtype=np.intp).reshape(-1, 2)


def _fitted(image: GreyImage, board: Board, places: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return corners (N, 2) at a board's places, and the signs of their gains.

    The sign is 0 where the image shows no corner, or is not there.
    """
    mapped = GridMap(board.places.astype(np.float64), board.points)
    at = places.astype(np.float64)
    points, ways = mapped(at), local_steps(mapped, at, 1.0)
    signs = np.zeros(len(places))
    inside = ((points >= 0) & (points <= np.array(image.size) - 1)).all(axis=1)
    inside &= np.abs(np.linalg.det(ways)) > LEAST_AREA
    if inside.any():
        lengths = np.linalg.norm(ways[inside], axis=2)
        part = np.minimum(PART, MOST_REACH / lengths.max(axis=1))[:, None, None]
        corners = refine_corners(image, points[inside], part * ways[inside])
        aside = np.linalg.norm(corners.points - points[inside], axis=1)
        step = lengths.min(axis=1)
        good = corners.fitted & (aside < ASIDE * step)
        points[inside] = corners.points
        signs[inside] = np.sign(corners.gains) * good
    return points, signs
