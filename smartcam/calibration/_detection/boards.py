"""Find checkerboards of any size in images, whole or in part.

A corner of a board is a saddle of the grey levels, and the saddles next to it are turned by 90
degrees. Little else in a picture is connected like that. Saddles are looked for in a reduced image;
missing corners are then fitted in the full image, at places predicted from those found.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.calibration._detection.corners import refine_corners
from smartcam.calibration._detection.dots import GridMap
from smartcam.calibration._detection.grid_growing import lattices
from smartcam.calibration._detection.image import reduced
from smartcam.calibration._detection.saddles import find_saddles
from smartcam.calibration._homography import local_steps

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smartcam.calibration._detection.grid_growing import Lattice
    from smartcam.calibration._detection.image import GreyImage
    from smartcam.geometry._inside import Array

USUAL_SIDE_PX = 800
"""Longest side of a usual image, pixels: a board is looked for at half of this size, at this size
and at twice this size, unless the image is smaller."""

NEIGHBOURS = 8
"""Nearest saddles among which the next corners are looked for: four corners and other saddles
nearby."""

FITTED_SHARE = 0.45
"""Edges at a corner are fitted along this part of a square's side, which ends before the next
edges."""

MIN_FITTED_SHARE = 0.6
"""A board has at least this part of its tried corners fitted well, with alternating colours."""

MIN_FILLED_SHARE = 0.5
"""An outermost row or column is left out where fewer than this part of its corners are seen."""

MAX_OFFSET_STEPS = 0.25
"""A fitted corner may lie this part of a step, from one corner to the next, off its predicted
place."""

MIN_SQUARE_PIXELS = 9.0
"""A corner is fitted only where a square has a larger area than this in the image, pixels^2."""

MAX_REACH_PX = 8.0
"""At most this many pixels around a corner are fitted: enough to see whether there is a corner."""

MAX_CORNERS_JUDGED = 24
"""At most this many corners of a candidate are checked to decide whether it is a board."""

PLACES_IN_SQUARES = np.array(
    [
        (side * x, up * y)
        for side, up in ((1, 1), (-1, -1), (1, -1), (-1, 1))
        for x, y in itertools.product((0.2, 0.35), repeat=2)
    ]
)
"""(16, 2), places in the four squares beside a corner, as parts of the steps to the next corners:
first those in two opposite squares, then those in the other two."""

MAX_SAME_BOARD_OFF_PX = 3.0
"""Two sizes of an image show the same board if its corners differ by at most this median
distance."""

MAX_ROUNDS = 4
"""A board is completed in at most this many rounds."""


class Board(NamedTuple):
    """Corners in rows and columns."""

    points: Array  # (N, 2), pixels
    places: NDArray[np.intp]  # (N, 2), column and row; their origin and directions are arbitrary
    # whether the image has another board with the same numbers of columns and rows
    again: bool = False

    @property
    def shape(self) -> tuple[int, int]:
        """Columns and rows."""
        if not len(self.places):
            return 0, 0
        columns, rows = (np.ptp(self.places, axis=0) + 1).tolist()
        return columns, rows

    @property
    def is_full(self) -> bool:
        """True if no corner is missing."""
        columns, rows = self.shape
        return len(self.places) == columns * rows

    def by_rows(self, columns: int, rows: int) -> Array | None:
        """Return all points (columns * rows, 2) row by row; None if the board has another shape."""
        if not self.is_full or sorted(self.shape) != sorted((columns, rows)):
            return None
        row, column = (1, 0) if self.shape == (columns, rows) else (0, 1)
        return self.points[np.lexsort((self.places[:, column], self.places[:, row]))]

    def shows(self, other: Board) -> bool:
        """Return True if this board has most of the corners of another one."""
        tree = load("scipy.spatial").cKDTree(self.points)
        return bool(np.median(tree.query(other.points)[0]) < MAX_SAME_BOARD_OFF_PX)

    def filled(self) -> Board:
        """Return the board with each missing corner at the place that the others predict."""
        low, high = self.places.min(axis=0), self.places.max(axis=0)
        missing = _missing(self, low, high)
        points = GridMap(self.places.astype(np.float64), self.points)(missing.astype(np.float64))
        return Board(np.concatenate([self.points, points]), np.concatenate([self.places, missing]))

    def trimmed(self) -> Board:
        """Return the board without outermost rows and columns that have few corners."""
        places = self.places
        for axis, end in itertools.product((0, 1), (np.min, np.max)):
            if not len(places):
                break
            outermost = places[:, axis] == end(places[:, axis])
            if outermost.sum() < MIN_FILLED_SHARE * self.shape[1 - axis]:
                return self._replace(
                    points=self.points[~outermost], places=places[~outermost]
                ).trimmed()
        return self


def parity(places: NDArray[np.intp]) -> Array:
    """Return 1 and -1 in alternation, like the colours of a board."""
    return np.where(places.sum(axis=1) % 2 == 0, 1.0, -1.0)


def boards(image: GreyImage, count: int, *, most: int) -> Iterator[Board]:
    """Yield the largest board in each size of an image, of about ``most`` corners at the most.

    The search in a size ends with the first one of ``count`` corners or more.
    """
    least = math.ceil(max(image.size) / USUAL_SIDE_PX)
    for times in dict.fromkeys((2 * least, least, (least + 1) // 2)):
        seen = find_saddles(reduced(image.bytes, times))
        largest: Lattice = {}
        grids = lattices(seen.points, seen.alike, least=4, most=most, neighbours=NEIGHBOURS)
        for grid in grids:
            largest = max(largest, grid, key=len)
            if len(largest) >= count:
                break
        if largest:
            again = any(_shape(grid) == _shape(largest) for grid in grids)
            points = (seen.points[list(largest.values())] + 0.5) * times - 0.5
            yield Board(points, np.array(list(largest), dtype=np.intp), again).trimmed()


def _shape(grid: Lattice) -> list[int]:
    """Return a grid's counts of columns and rows, the smaller first, and of its corners."""
    return [*sorted(np.ptp(np.array(list(grid)), axis=0).tolist()), len(grid)]


def completed(image: GreyImage, board: Board) -> Board | None:
    """Return the board with missed corners added; None if the fits find no corners."""
    sampled = board.places[:: math.ceil(len(board.places) / MAX_CORNERS_JUDGED)]
    _, signs = _fitted(image, board, sampled)
    sign = float(parity(sampled) @ signs)
    if abs(sign) < MIN_FITTED_SHARE * len(sampled):
        return None
    recent = board.places
    for _ in range(MAX_ROUNDS):
        missing = _missing(board, board.places.min(axis=0) - 1, board.places.max(axis=0) + 1)
        # a new corner beside an empty place may predict that place better
        beside = np.abs(missing[:, None] - recent).max(axis=2).min(axis=1, initial=2) <= 1
        missing = missing[beside]
        points, signs = _fitted(image, board, missing)
        right = parity(missing) * signs * sign > 0
        if not right.any():
            break
        recent = missing[right]
        board = Board(
            np.concatenate([board.points, points[right]]), np.concatenate([board.places, recent])
        ).trimmed()
    return board


def _missing(board: Board, low: NDArray[np.intp], high: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the places (N, 2) from ``low`` to ``high`` where no corner has been found yet."""
    every = itertools.product(*(range(a, b + 1) for a, b in zip(low, high, strict=True)))
    found_places = set(map(tuple, board.places.tolist()))
    missing = [place for place in every if place not in found_places]
    return np.array(missing, dtype=np.intp).reshape(-1, 2)


def _fitted(image: GreyImage, board: Board, places: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return corners (N, 2) at a board's places, and the signs of their gains.

    The sign is 0 where the image shows no corner, and for places outside of the image.
    """
    mapped = GridMap(board.places.astype(np.float64), board.points)
    at = places.astype(np.float64)
    points, ways = mapped(at), local_steps(mapped, at, 1.0)
    signs = np.zeros(len(places))
    inside = ((points >= 0) & (points <= np.array(image.size) - 1)).all(axis=1)
    inside &= np.abs(np.linalg.det(ways)) > MIN_SQUARE_PIXELS
    inside[inside] = like_corners(image, points[inside], ways[inside])
    if inside.any():
        lengths = np.linalg.norm(ways[inside], axis=2)
        part = np.minimum(FITTED_SHARE, MAX_REACH_PX / lengths.max(axis=1))[:, None, None]
        corners = refine_corners(image, points[inside], part * ways[inside])
        aside = np.linalg.norm(corners.points - points[inside], axis=1)
        step = lengths.min(axis=1)
        good = corners.fitted & (aside < MAX_OFFSET_STEPS * step)
        points[inside] = corners.points
        signs[inside] = np.sign(corners.gains) * good
    return points, signs


def like_corners(image: GreyImage, points: Array, ways: Array) -> NDArray[np.bool_]:
    """Return True for each point (N, 2) beside which two opposite squares are darker than the rest.

    The test rejects most places that are no corners, in a small part of the time of a fit. ``ways``
    (N, 2, 2) lead to the next corners, pixels.
    """
    if not len(points):
        return np.zeros(0, dtype=np.bool_)
    cv2 = load("cv2")
    at = points[:, None] + np.einsum("pk,nki->npi", PLACES_IN_SQUARES, ways)
    levels = cv2.remap(
        image.levels, at.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    one, other = levels.reshape(len(points), 2, 2, -1).mean(axis=3).transpose(1, 0, 2)
    return np.asarray((one.max(axis=1) < other.min(axis=1)) | (other.max(axis=1) < one.min(axis=1)))
