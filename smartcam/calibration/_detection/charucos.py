"""ChArUco boards in images: corners with ids, some of which may be hidden."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from smartcam.calibration._codes import Code
from smartcam.calibration._detection.corners import refine_corners
from smartcam.calibration._detection.grid_growing import alike_areas, lattices
from smartcam.calibration._detection.image import USUAL_SIZE, GreyImage, reduced, scaled
from smartcam.calibration._geometry.homography import apply_homography, fit_homography, local_steps
from smartcam.calibration._optional_imports import load
from smartcam.calibration._views import TargetView
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._geometry.rotations import Array
    from smartcam.calibration._targets import Charuco

FEWEST = 4
"""Corners that fix a pose at least."""

LARGEST_DOUBLED = 2600
"""Longest side, pixels, of an image that is looked at in double size, too, for small markers."""

LEAST_IN_ROWS = 5
"""Dark quadrangles in rows and columns that may be a board's markers, at least."""

LEAST_READ, MOST_UNREAD = 0.6, 2.5
"""Pixels of a module of a marker: with fewer it is not read in double size, either; with more there
is none, where none was read."""

PART = 0.45
"""Of a square around a corner that is fitted."""


def charuco_board(target: Charuco) -> Any:
    """Return OpenCV's board; SHAPE: no such dictionary, or too few markers in it."""
    cv2 = load("cv2")
    number = getattr(cv2.aruco, target.dictionary, None)
    if not (target.dictionary.startswith("DICT_") and isinstance(number, int)):
        raise CalibrationError(
            "charuco: expected the name of one of OpenCV's dictionaries such as DICT_5X5_250, "
            f"got {target.dictionary!r}",
            code=Code.SHAPE,
            expected="DICT_5X5_250",
            got=target.dictionary,
        )
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    board = cv2.aruco.CharucoBoard(
        (target.columns, target.rows), target.square, target.marker, dictionary
    )
    board.setLegacyPattern(target.legacy_pattern)
    needed, there = len(board.getIds()), len(dictionary.bytesList)
    if needed > there:
        raise CalibrationError(
            f"charuco of {target.columns} x {target.rows} squares: expected at least {needed} "
            f"markers in {target.dictionary}, got {there}",
            code=Code.SHAPE,
            expected=needed,
            got=there,
        )
    return board


def find_charuco(image: GreyImage, target: Charuco, name: str = "") -> TargetView:
    """Find the corners of a ChArUco board that are seen.

    Raises TARGET_NOT_FOUND, MIRRORED, or SHAPE: no such dictionary.
    """
    ids, found = _numbered(image, target)
    flat = target.points[ids, :2]
    matrix = fit_homography(flat, found)
    if matrix is None:
        raise _not_found(target, "all in a line", len(ids))
    ways = local_steps(partial(apply_homography, matrix), flat, PART * target.square)
    clear = (1 - target.marker / target.square) / 2 / PART - 1 / np.linalg.norm(ways, axis=2)
    corners = refine_corners(image, found, ways, clear)
    row, column = np.divmod(ids, target.columns - 1)
    colours = (1 - 2 * ((row + column) % 2)) * np.sign(corners.gains)
    seen = corners.fitted & (colours * (colours @ corners.fitted) > 0)
    if seen.sum() < FEWEST:
        raise _not_found(target, "clear enough", int(seen.sum()))
    return TargetView(
        target=target,
        size=image.size,
        ids=ids[seen],
        points=corners.points[seen],
        covariance=corners.covariance[seen],
        name=name,
    )


def _numbered(image: GreyImage, target: Charuco) -> tuple[NDArray[np.intp], Array]:
    """Return numbers (N,), ascending, and corners (N, 2).

    Where few are found beside what may be markers, the mirror image is looked at as well: a
    marker's mirror image can be another one of its dictionary, and such neighbours give corners
    with wrong numbers.
    """
    seen = _detect(image, target)
    count = len(seen.ids)
    if 2 * count > max(len(target.points), 4 * FEWEST):
        return seen.ids, seen.points
    if seen.side and len(_detect(_flipped(image), target).ids) >= max(FEWEST, 2 * count):
        raise CalibrationError(
            f"charuco of {target.columns} x {target.rows} squares: expected an image of the sheet "
            "as one reads it, got one that is mirrored",
            code=Code.MIRRORED,
            expected="the sheet as one reads it",
            got="its mirror image",
        )
    if count < FEWEST:
        doubt = seen.markers and not count and target.rows % 2 == 0
        legacy = ": is its legacy_pattern right?" if doubt else ""
        raise _not_found(target, f"beside {seen.markers} of its markers{legacy}", count)
    return seen.ids, seen.points


def _flipped(image: GreyImage) -> GreyImage:
    return GreyImage(
        np.ascontiguousarray(image.levels[:, ::-1]), np.ascontiguousarray(image.bytes[:, ::-1])
    )


class _Sighting(NamedTuple):
    """What was found of a board."""

    ids: NDArray[np.intp]  # (N,), ascending
    points: Array  # (N, 2), pixels
    markers: int  # how many were read
    # of what may be markers, pixels of the given image: of those that were read, or of quadrangles
    # in rows and columns; 0: there are none
    side: float


def _detect(image: GreyImage, target: Charuco) -> _Sighting:
    """Find a board in a reduced image, in the given one, and in one that is twice as large.

    The next one is looked at where the one before does not show enough; the last one only where
    there may be markers that are too small to be read.
    """
    best = _Sighting(np.zeros(0, dtype=np.intp), np.zeros((0, 2)), 0, 0.0)
    times = math.ceil(max(image.size) / USUAL_SIZE)
    if times > 1:
        best = _look(reduced(image.bytes, times), 1 / times, target, best)
        if _is_all(best, target, image):
            return best
    best = _look(image.bytes, 1.0, target, best)
    few = max(image.size) <= LARGEST_DOUBLED and 2 * len(best.ids) <= len(target.points)
    if few and (best.markers or 0 < best.side < MOST_UNREAD * _modules(charuco_board(target))):
        best = _look(scaled(image.bytes, 2.0), 2.0, target, best)
    return best


def _is_all(seen: _Sighting, target: Charuco, image: GreyImage) -> bool:
    """Return whether all corners were found that should be in the image."""
    if len(seen.ids) < FEWEST:
        return False
    matrix = fit_homography(target.points[seen.ids, :2], seen.points)
    if matrix is None:
        return False
    expected = apply_homography(matrix, target.points[:, :2])
    inside = ((expected >= 0) & (expected <= np.array(image.size) - 1)).all(axis=1)
    return bool(np.isin(np.flatnonzero(inside), seen.ids).all())


def _look(bytes_: NDArray[np.uint8], scale: float, target: Charuco, best: _Sighting) -> _Sighting:
    """Return what an image shows that is ``scale`` times as large, or the best before it."""
    cv2 = load("cv2")
    board = charuco_board(target)
    given = cv2.aruco.CharucoParameters()
    given.minMarkers = 1
    finder = cv2.aruco.ArucoDetector(board.getDictionary())
    quads, numbers, others = finder.detectMarkers(bytes_)
    side = _side(quads) if numbers is not None else _side_in_rows(others, board)
    best = best._replace(side=max(best.side, side / scale))
    if numbers is None:
        return best
    quads, numbers, _, _ = finder.refineDetectedMarkers(bytes_, board, quads, numbers, others)
    detector = cv2.aruco.CharucoDetector(board, given)
    corners, found, *_ = detector.detectBoard(bytes_, markerCorners=quads, markerIds=numbers)
    markers = max(best.markers, len(numbers))
    if found is None or len(found) <= len(best.ids):
        return best._replace(markers=markers)
    # OpenCV counts rows from the top
    row, column = np.divmod(np.array(found, dtype=np.intp).ravel(), target.columns - 1)
    ids = (target.rows - 2 - row) * (target.columns - 1) + column
    points = (np.array(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
    order = np.argsort(ids)
    return _Sighting(ids[order], points[order], markers, best.side)


def _modules(board: Any) -> int:
    """Return how many squares a side of a marker has, its black rim among them."""
    return int(board.getDictionary().markerSize) + 2


def _areas(quads: Sequence[Array]) -> Array:
    corners = np.array(quads, dtype=np.float64).reshape(-1, 4, 2)
    (a, b), (c, d) = (corners[:, 2] - corners[:, 0]).T, (corners[:, 3] - corners[:, 1]).T
    areas: Array = np.maximum(np.abs(a * d - b * c) / 2, 1.0)
    return areas


def _side(quads: Sequence[Array]) -> float:
    return float(np.sqrt(np.median(_areas(quads))))


def _side_in_rows(quads: Sequence[Array], board: Any) -> float:
    """Return the side of dark quadrangles (1, 4, 2) that stand in rows and columns as markers do.

    0: there are none, or too small ones for a marker that can be read.
    """
    if len(quads) < LEAST_IN_ROWS:
        return 0.0
    areas = _areas(quads)
    middles = np.array(quads, dtype=np.float64).reshape(-1, 4, 2).mean(axis=1)
    most = len(board.getIds())
    found = lattices(middles, alike_areas(areas), least=LEAST_IN_ROWS, most=most)
    sides = [_side([quads[one] for one in grid.values()]) for grid in found]
    return max((side for side in sides if side > LEAST_READ * _modules(board)), default=0.0)


def _not_found(target: Charuco, how: str, count: int) -> CalibrationError:
    return CalibrationError(
        f"charuco: expected at least {FEWEST} corners of a board of {target.columns} x "
        f"{target.rows} squares, found {count} {how}",
        code=Code.TARGET_NOT_FOUND,
        expected=FEWEST,
        got=count,
    )
