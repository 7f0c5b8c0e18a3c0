"""Find checkerboards with any number of squares in images, whole or in part.

A corner of a board is a saddle of the grey levels, and the saddles next to it are turned by 90
degrees. Hardly anything else in a picture has such neighbours. Saddles are searched in a reduced
image. The corners that were not found there are fitted in the full image, at the places that the
found corners predict.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.calibration._detection.corners import refine_corners
from smartcam.calibration._detection.dots import GridMap
from smartcam.calibration._detection.grid_growing import grow_grids
from smartcam.calibration._detection.image import shrink_image
from smartcam.calibration._detection.saddles import find_saddles
from smartcam.calibration._homography import local_steps

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smartcam.calibration._detection.grid_growing import Lattice
    from smartcam.calibration._detection.image import GreyImage
    from smartcam.geometry._inside import Array

USUAL_SIDE_PX = 800
"""Longest side of a usual image, pixels: a board is searched at half of this size, at this size and
at twice this size, unless the image is smaller."""

NEIGHBOURS = 8
"""The four corners next to a corner are searched among this many nearest saddles, since other
saddles may lie between them."""

FITTED_SHARE = 0.45
"""Edges at a corner are fitted along this fraction of a square's side, so that the fit does not
reach the edges at the next corner."""

MIN_FITTED_SHARE = 0.6
"""A candidate is a board if at least this fraction of its corners is found by fits, and if the
colours of the squares there alternate as on a board."""

MIN_FILLED_SHARE = 0.5
"""An outermost row or column is left out if less than this fraction of its corners is found."""

MAX_OFFSET_STEPS = 0.25
"""A fitted corner may differ from its predicted place by this fraction of the step between
corners."""

MIN_SQUARE_PIXELS = 9.0
"""A corner is fitted only if a square next to the corner has a larger area than this in the image,
pixels^2."""

MAX_REACH_PX = 8.0
"""Only pixels up to this distance from a corner are fitted: they show whether there is a corner."""

MAX_CORNERS_JUDGED = 24
"""At most this many corners of a candidate are checked to decide whether it is a board."""

SQUARE_SAMPLES = np.array(
    [
        (side * x, up * y)
        for side, up in ((1, 1), (-1, -1), (1, -1), (-1, 1))
        for x, y in itertools.product((0.2, 0.35), repeat=2)
    ]
)
"""(16, 2), places in the four squares around a corner, as fractions of the steps to the next
corners: eight places in two opposite squares, then eight in the two other squares."""

MAX_SAME_BOARD_OFF_PX = 3.0
"""Boards found in two reductions of an image are the same board if the median distance between
their corners is less than this many pixels."""

MAX_ITERATIONS = 4
"""Missing corners of a board are added in at most this many rounds."""


class Board(NamedTuple):
    """The found corners of a board, with their columns and rows."""

    points: Array  # (N, 2), pixels
    grid_positions: NDArray[np.intp]  # (N, 2), column and row; origin and directions are arbitrary
    # whether the image has another board with as many columns, rows and corners
    has_twin: bool = False

    @property
    def counts(self) -> tuple[int, int]:
        """Columns and rows."""
        if not len(self.grid_positions):
            return 0, 0
        columns, rows = (np.ptp(self.grid_positions, axis=0) + 1).tolist()
        return columns, rows

    @property
    def is_full(self) -> bool:
        """True if no corner is missing."""
        columns, rows = self.counts
        return len(self.grid_positions) == columns * rows

    def points_by_rows(self, columns: int, rows: int) -> Array | None:
        """Return all points (columns * rows, 2) row by row; None if any is missing."""
        if not self.is_full or sorted(self.counts) != sorted((columns, rows)):
            return None
        row, column = (1, 0) if self.counts == (columns, rows) else (0, 1)
        return self.points[
            np.lexsort((self.grid_positions[:, column], self.grid_positions[:, row]))
        ]

    def shows_same_board(self, other: Board) -> bool:
        """Return True if this board has most of the corners of another one."""
        tree = load("scipy.spatial").cKDTree(self.points)
        return bool(np.median(tree.query(other.points)[0]) < MAX_SAME_BOARD_OFF_PX)

    def fill_missing(self) -> Board:
        """Return the board with each missing corner at the place that the others predict."""
        low, high = self.grid_positions.min(axis=0), self.grid_positions.max(axis=0)
        missing = _missing_positions(self, low, high)
        points = GridMap(self.grid_positions.astype(np.float64), self.points)(
            missing.astype(np.float64)
        )
        return Board(
            np.concatenate([self.points, points]), np.concatenate([self.grid_positions, missing])
        )

    def trim_rim(self) -> Board:
        """Return the board without outermost rows and columns that have few corners."""
        grid_positions = self.grid_positions
        for axis, end in itertools.product((0, 1), (np.min, np.max)):
            if not len(grid_positions):
                break
            is_outermost = grid_positions[:, axis] == end(grid_positions[:, axis])
            if is_outermost.sum() < MIN_FILLED_SHARE * self.counts[1 - axis]:
                return self._replace(
                    points=self.points[~is_outermost], grid_positions=grid_positions[~is_outermost]
                ).trim_rim()
        return self


def colour_signs(grid_positions: NDArray[np.intp]) -> Array:
    """Return 1 or -1 for each position; the signs alternate like the colours of a board."""
    return np.where(grid_positions.sum(axis=1) % 2 == 0, 1.0, -1.0)


def find_boards(image: GreyImage, wanted_count: int, *, max_count: int) -> Iterator[Board]:
    """Reduce an image by up to three factors, and yield the largest board in each reduced image.

    No board has many more than ``max_count`` corners. The search in an image ends with the first
    board of ``wanted_count`` corners or more.
    """
    min_factor = math.ceil(max(image.size) / USUAL_SIDE_PX)
    for factor in dict.fromkeys((2 * min_factor, min_factor, (min_factor + 1) // 2)):
        saddles = find_saddles(shrink_image(image.uint8_levels, factor))
        largest: Lattice = {}
        grid_search = grow_grids(
            saddles.points,
            saddles.may_be_neighbours,
            min_count=4,
            max_count=max_count,
            neighbours=NEIGHBOURS,
        )
        for grid in grid_search:
            largest = max(largest, grid, key=len)
            if len(largest) >= wanted_count:
                break
        if largest:
            size = _grid_size(largest)
            # the grids that the loop above has not taken
            has_twin = any(_grid_size(other) == size for other in grid_search)
            points = (saddles.points[list(largest.values())] + 0.5) * factor - 0.5
            yield Board(points, np.array(list(largest), dtype=np.intp), has_twin).trim_rim()


def _grid_size(grid: Lattice) -> list[int]:
    """Return a grid's counts of columns and rows, the smaller first, and of its corners."""
    return [*sorted(np.ptp(np.array(list(grid)), axis=0).tolist()), len(grid)]


def complete_board(image: GreyImage, board: Board) -> Board | None:
    """Return the board with missing corners added; None if fits show that this is no board."""
    sampled_positions = board.grid_positions[
        :: math.ceil(len(board.grid_positions) / MAX_CORNERS_JUDGED)
    ]
    _, signs = _fit_corners(image, board, sampled_positions)
    sign_sum = float(colour_signs(sampled_positions) @ signs)
    if abs(sign_sum) < MIN_FITTED_SHARE * len(sampled_positions):
        return None
    new_positions = board.grid_positions
    for _ in range(MAX_ITERATIONS):
        missing = _missing_positions(
            board, board.grid_positions.min(axis=0) - 1, board.grid_positions.max(axis=0) + 1
        )
        # new corners may predict the empty positions next to them better
        is_beside_new = (
            np.abs(missing[:, None] - new_positions).max(axis=2).min(axis=1, initial=2) <= 1
        )
        missing = missing[is_beside_new]
        points, signs = _fit_corners(image, board, missing)
        is_corner = colour_signs(missing) * signs * sign_sum > 0
        if not is_corner.any():
            break
        new_positions = missing[is_corner]
        board = Board(
            np.concatenate([board.points, points[is_corner]]),
            np.concatenate([board.grid_positions, new_positions]),
        ).trim_rim()
    return board


def _missing_positions(
    board: Board, low: NDArray[np.intp], high: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return the grid positions (N, 2) from ``low`` to ``high`` without a corner so far."""
    all_positions = itertools.product(*(range(a, b + 1) for a, b in zip(low, high, strict=True)))
    found_positions = set(map(tuple, board.grid_positions.tolist()))
    missing = [position for position in all_positions if position not in found_positions]
    return np.array(missing, dtype=np.intp).reshape(-1, 2)


def _fit_corners(
    image: GreyImage, board: Board, grid_positions: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Return corners (N, 2) at a board's grid positions, and the signs of their colours.

    The sign of a corner's ``gain`` tells which two of its squares are black. The sign is 0 if the
    image shows no corner there, and outside of the image.
    """
    grid_map = GridMap(board.grid_positions.astype(np.float64), board.points)
    coordinates = grid_positions.astype(np.float64)
    points, steps = grid_map(coordinates), local_steps(grid_map, coordinates, 1.0)
    signs = np.zeros(len(grid_positions))
    is_candidate = ((points >= 0) & (points <= np.array(image.size) - 1)).all(axis=1)
    is_candidate &= np.abs(np.linalg.det(steps)) > MIN_SQUARE_PIXELS
    is_candidate[is_candidate] = looks_like_corners(
        image, points[is_candidate], steps[is_candidate]
    )
    if is_candidate.any():
        lengths = np.linalg.norm(steps[is_candidate], axis=2)
        share = np.minimum(FITTED_SHARE, MAX_REACH_PX / lengths.max(axis=1))[:, None, None]
        corners = refine_corners(image, points[is_candidate], share * steps[is_candidate])
        offsets = np.linalg.norm(corners.points - points[is_candidate], axis=1)
        shortest = lengths.min(axis=1)
        is_good = corners.fitted & (offsets < MAX_OFFSET_STEPS * shortest)
        points[is_candidate] = corners.points
        signs[is_candidate] = np.sign(corners.gains) * is_good
    return points, signs


def looks_like_corners(image: GreyImage, points: Array, steps: Array) -> NDArray[np.bool_]:
    """Return a mask of the points (N, 2) at which two opposite squares are darker than the others.

    The test rejects most positions that are no corners, and is much faster than a fit. ``steps``
    (N, 2, 2) lead to the next corners, pixels.
    """
    if not len(points):
        return np.zeros(0, dtype=np.bool_)
    cv2 = load("cv2")
    samples = points[:, None] + np.einsum("pk,nki->npi", SQUARE_SAMPLES, steps)
    levels = cv2.remap(
        image.levels,
        samples.astype(np.float32),
        None,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    pair, other_pair = levels.reshape(len(points), 2, 2, -1).mean(axis=3).transpose(1, 0, 2)
    return np.asarray(
        (pair.max(axis=1) < other_pair.min(axis=1)) | (other_pair.max(axis=1) < pair.min(axis=1))
    )
