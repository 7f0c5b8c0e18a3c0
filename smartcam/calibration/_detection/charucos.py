"""Find ChArUco boards in images: their corners have ids, and some may be hidden."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.calibration._detection.corners import refine_corners
from smartcam.calibration._detection.grid_growing import alike_areas, lattices
from smartcam.calibration._detection.image import USUAL_SIDE_PX, GreyImage, reduced, scaled
from smartcam.calibration._detection.markers import (
    Markers,
    agreeing,
    check_one_board,
    marker_dictionary,
    marker_finder,
    remarks_on_strays,
    seen_from_nearest,
)
from smartcam.calibration._homography import apply_homography, fit_homography, local_steps
from smartcam.calibration._views import TargetView
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._targets import Charuco
    from smartcam.exceptions import CalibrationError
    from smartcam.geometry._inside import Array

MIN_CORNERS = 4
"""At least this many corners determine a pose."""

MAX_DOUBLED_PX = 2600
"""An image whose longest side is at most this many pixels is also searched at twice its size."""

MIN_QUADRANGLES = 5
"""Fewer dark quadrangles than this, in rows and columns, are not taken for a board's markers."""

MIN_MODULE_PIXELS, MAX_UNREAD_MODULE_PIXELS = 0.6, 2.5
"""Sides of a marker's module, pixels: a smaller one than the first cannot be read even at twice the
size; one larger than the second would have been read, so quadrangles of that size are no
markers."""

MAX_SQUARES_OFF = 0.3
"""A corner may lie this many sides of a square away from where the nearest markers predict it."""

FITTED_SHARE = 0.45
"""The edges at a corner are fitted along this part of a square's side."""


def charuco_board(target: Charuco, *, legacy_pattern: bool | None = None) -> Any:
    """Return OpenCV's board; raise SHAPE if the dictionary is unknown or has too few markers.

    ``legacy_pattern``: None uses the target's own.
    """
    cv2 = load("cv2")
    needed = target.columns * target.rows // 2
    dictionary = marker_dictionary(target.dictionary, needed, _name(target))
    board = cv2.aruco.CharucoBoard(
        (target.columns, target.rows), target.square, target.marker, dictionary
    )
    board.setLegacyPattern(target.legacy_pattern if legacy_pattern is None else legacy_pattern)
    return board


def _name(target: Charuco) -> str:
    return f"charuco of {target.columns} x {target.rows} squares"


def find_charuco(image: GreyImage, target: Charuco, name: str = "") -> TargetView:
    """Find the visible corners of a ChArUco board.

    Raises TARGET_NOT_FOUND, MIRRORED, or SHAPE if the dictionary is unknown.
    """
    sighting = _numbered(image, target)
    ids, points = sighting.ids, sighting.points
    flat = target.points[ids, :2]
    matrix = fit_homography(flat, points)
    if matrix is None:
        raise _not_found_error(target, "all in a line", len(ids))
    ways = local_steps(partial(apply_homography, matrix), flat, FITTED_SHARE * target.square)
    clear = (1 - target.marker / target.square) / 2 / FITTED_SHARE - 1 / np.linalg.norm(
        ways, axis=2
    )
    corners = refine_corners(image, points, ways, clear)
    row, column = np.divmod(ids, target.columns - 1)
    colours = (1 - 2 * ((row + column) % 2)) * np.sign(corners.gains)
    seen = corners.fitted & (colours * (colours @ corners.fitted) > 0)
    if seen.sum() < MIN_CORNERS:
        raise _not_found_error(target, "clear enough", int(seen.sum()))
    return TargetView(
        target=target,
        size=image.size,
        ids=ids[seen],
        points=corners.points[seen],
        covariance=corners.covariance[seen],
        name=name,
        warnings=remarks_on_strays(sighting.strays),
    )


def _numbered(image: GreyImage, target: Charuco) -> _Sighting:
    """Return the sighting of a board, with at least four corners.

    If only few markers are read beside many quadrangles, the mirrored image is searched as well:
    the mirror image of a marker can be another marker of the dictionary.
    """
    seen = _detect(image, target)
    count = len(seen.ids)
    if seen.otherwise >= max(MIN_CORNERS, seen.agreeing + 1):
        raise _other_pattern_error(target, seen)
    check_one_board(seen.agreeing, seen.contrary, _name(target))
    if 2 * count > max(len(target.points), 4 * MIN_CORNERS):
        return seen
    if seen.side and len(_detect(_flipped(image), target).ids) >= max(MIN_CORNERS, 2 * count):
        raise Code.MIRRORED.refusal(
            f"{_name(target)}: expected an image of the sheet "
            "as one reads it, got one that is mirrored",
            "the sheet as one reads it",
            "its mirror image",
        )
    if count < MIN_CORNERS:
        read = f"beside {seen.markers} markers of its dictionary"
        if seen.markers:
            read += f", of which {seen.agreeing} stand to each other as on such a board"
        raise _not_found_error(target, read, count)
    return seen


def _other_pattern_error(target: Charuco, seen: _Sighting) -> CalibrationError:
    """Return the error for markers that are arranged as in the other ``legacy_pattern``."""
    expected, other = target.legacy_pattern, not target.legacy_pattern
    return Code.WRONG_TARGET.refusal(
        f"{_name(target)}: expected markers as "
        f"legacy_pattern={expected} has them, of which {seen.agreeing} stand to each other as on "
        f"that board; got {seen.otherwise} that stand as legacy_pattern={other} has them",
        f"legacy_pattern={expected}",
        f"legacy_pattern={other}",
    )


def _flipped(image: GreyImage) -> GreyImage:
    return GreyImage(
        np.ascontiguousarray(image.levels[:, ::-1]), np.ascontiguousarray(image.bytes[:, ::-1])
    )


class _Sighting(NamedTuple):
    """The markers and corners that were found of one board."""

    ids: NDArray[np.intp]  # (N,), ascending
    points: Array  # (N, 2), pixels
    markers: int  # count of the markers that were read
    agreeing: int  # count of those that are arranged as on the board
    contrary: int  # count of others that agree with each other, but not with these
    otherwise: int  # count of those arranged as on the board of the other legacy_pattern
    strays: tuple[int, ...]  # ids of the markers that were left out
    # side of a module, pixels of the given image: of the markers that were read, or else of
    # quadrangles in rows and columns; 0 if there are neither
    side: float


def _detect(image: GreyImage, target: Charuco) -> _Sighting:
    """Find a board in a reduced image, else in the given image, else in it enlarged twofold.

    Each image is searched only if the one before shows too little, and the last one only if there
    may be markers that were too small to be read.
    """
    best = _Sighting(np.zeros(0, dtype=np.intp), np.zeros((0, 2)), 0, 0, 0, 0, (), 0.0)
    times = math.ceil(max(image.size) / USUAL_SIDE_PX)
    if times > 1:
        best = _look(reduced(image.bytes, times), 1 / times, target, best)
        if _is_all(best, target, image):
            return best
    best = _look(image.bytes, 1.0, target, best)
    few = max(image.size) <= MAX_DOUBLED_PX and 2 * len(best.ids) <= len(target.points)
    if few and (
        best.markers or 0 < best.side < MAX_UNREAD_MODULE_PIXELS * _modules(charuco_board(target))
    ):
        best = _look(scaled(image.bytes, 2.0), 2.0, target, best)
    return best


def _is_all(seen: _Sighting, target: Charuco, image: GreyImage) -> bool:
    """Return True if all corners were found that should be in the image."""
    if len(seen.ids) < MIN_CORNERS:
        return False
    matrix = fit_homography(target.points[seen.ids, :2], seen.points)
    if matrix is None:
        return False
    expected = apply_homography(matrix, target.points[:, :2])
    inside = ((expected >= 0) & (expected <= np.array(image.size) - 1)).all(axis=1)
    return bool(np.isin(np.flatnonzero(inside), seen.ids).all())


def _look(bytes_: NDArray[np.uint8], scale: float, target: Charuco, best: _Sighting) -> _Sighting:
    """Return the sighting in an image ``scale`` times as large, or the best one before it."""
    board = charuco_board(target)
    finder = marker_finder(bytes_, board.getDictionary())
    quads, numbers, others = finder.detectMarkers(bytes_)
    side = _side(quads) if numbers is not None else _side_in_rows(others, board)
    best = best._replace(side=max(best.side, side / scale))
    if numbers is None:
        return best
    flat = _map(board)
    read = Markers(np.array(quads, dtype=np.float64).reshape(-1, 4, 2), numbers.ravel())
    good, contrary = agreeing(read, flat)
    strays = tuple(sorted(read.ids[~good].tolist()))
    otherwise = 0
    if target.rows % 2 == 0:
        turned = charuco_board(target, legacy_pattern=not target.legacy_pattern)
        otherwise = int(agreeing(read, _map(turned)).good.sum())
    best = best._replace(
        markers=max(best.markers, len(good)),
        agreeing=max(best.agreeing, int(good.sum())),
        contrary=max(best.contrary, contrary),
        otherwise=max(best.otherwise, otherwise),
    )
    if not good.any():
        return best
    shaped = [quad for quad, fits in zip(quads, good, strict=True) if fits]
    quads, numbers, *_ = finder.refineDetectedMarkers(bytes_, board, shaped, numbers[good], others)
    read = Markers(np.array(quads, dtype=np.float64).reshape(-1, 4, 2), numbers.ravel())
    ids, corners = _between(bytes_, board, read.selected(agreeing(read, flat).good))
    if len(ids) <= len(best.ids):
        return best
    # OpenCV counts rows from the top
    row, column = np.divmod(ids, target.columns - 1)
    ids = (target.rows - 2 - row) * (target.columns - 1) + column
    order = np.argsort(ids)
    points = (corners + 0.5) / scale - 0.5
    return best._replace(ids=ids[order], points=points[order], strays=strays)


def _map(board: Any) -> Array:
    """Return the corners of a board's markers, in the order of their ids, (M, 4, 2)."""
    return np.asarray(board.getObjPoints(), dtype=np.float64)[:, :, :2]


def _between(
    bytes_: NDArray[np.uint8], board: Any, markers: Markers
) -> tuple[NDArray[np.intp], Array]:
    """Return OpenCV's numbers of the corners beside markers, and their places (N, 2).

    Corners that are not where their markers predict them are left out.
    """
    cv2 = load("cv2")
    given = cv2.aruco.CharucoParameters()
    given.minMarkers = 1
    if hasattr(given, "checkMarkers"):  # OpenCV 4.11 and later
        given.checkMarkers = False  # the two forms of OpenCV's result agree
    detector = cv2.aruco.CharucoDetector(board, given)
    quads = [quad[None].astype(np.float32) for quad in markers.quads]
    numbers = markers.ids.astype(np.int32)[:, None]
    corners, seen_ids, *_ = detector.detectBoard(bytes_, markerCorners=quads, markerIds=numbers)
    if seen_ids is None or not len(seen_ids):
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    ids = np.asarray(seen_ids, dtype=np.intp).ravel()
    points = np.array(corners, dtype=np.float64).reshape(-1, 2)
    at = np.asarray(board.getChessboardCorners(), dtype=np.float64)[ids, :2]
    flat = _map(board)[markers.ids]
    seen, step = seen_from_nearest(markers.quads, flat, at)
    square = float(board.getSquareLength())
    right = np.linalg.norm(points - seen, axis=1) < MAX_SQUARES_OFF * square * step
    return ids[right], points[right]


def _modules(board: Any) -> int:
    """Return the count of squares along a marker's side, its black rim included."""
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
    if len(quads) < MIN_QUADRANGLES:
        return 0.0
    areas = _areas(quads)
    middles = np.array(quads, dtype=np.float64).reshape(-1, 4, 2).mean(axis=1)
    most = len(board.getIds())
    grids = lattices(middles, alike_areas(areas), least=MIN_QUADRANGLES, most=most)
    sides = [_side([quads[index] for index in grid.values()]) for grid in grids]
    return max((side for side in sides if side > MIN_MODULE_PIXELS * _modules(board)), default=0.0)


def _not_found_error(target: Charuco, how: str, count: int) -> CalibrationError:
    return Code.TARGET_NOT_FOUND.refusal(
        f"charuco: expected at least {MIN_CORNERS} corners of a board of {target.columns} x "
        f"{target.rows} squares, found {count} {how}",
        MIN_CORNERS,
        count,
    )
