"""Find ChArUco boards in images: each corner has an id, so some corners may be hidden."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.calibration._detection.corners import refine_corners
from smartcam.calibration._detection.grid_growing import area_test, grow_grids
from smartcam.calibration._detection.image import (
    USUAL_SIDE_PX,
    GreyImage,
    resize_image,
    shrink_image,
)
from smartcam.calibration._detection.markers import (
    Markers,
    check_one_board,
    compare_with_board,
    marker_dictionary,
    marker_finder,
    predict_pixels,
    stray_remarks,
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
"""Dark quadrangles in rows and columns may be a board's markers if there are at least this many."""

MIN_MODULE_PIXELS, MAX_UNREAD_MODULE_PIXELS = 0.6, 2.5
"""Limits for the side of a marker's module (a square of its code), pixels. Smaller modules cannot
be read even in an image enlarged twice. Markers with larger modules would have been read, so
quadrangles of that size are no markers."""

MAX_SQUARES_OFF = 0.3
"""A corner may differ from the nearest markers' prediction by this fraction of a square's side."""

FITTED_SHARE = 0.45
"""The edges at a corner are fitted along this fraction of a square's side."""


def charuco_board(target: Charuco, *, legacy_pattern: bool | None = None) -> Any:
    """Return OpenCV's board; raise SHAPE if the dictionary is unknown or has too few markers.

    ``legacy_pattern``: None uses the target's own.
    """
    cv2 = load("cv2")
    min_markers = target.columns * target.rows // 2
    dictionary = marker_dictionary(target.dictionary, min_markers, _name(target))
    board = cv2.aruco.CharucoBoard(
        (target.columns, target.rows), target.square, target.marker, dictionary
    )
    board.setLegacyPattern(target.legacy_pattern if legacy_pattern is None else legacy_pattern)
    return board


def _name(target: Charuco) -> str:
    return f"charuco of {target.columns} x {target.rows} squares"


def find_charuco(image: GreyImage, target: Charuco, name: str = "") -> TargetView:
    """Find the visible corners of a ChArUco board.

    Raises TARGET_NOT_FOUND, WRONG_TARGET or MIRRORED; or SHAPE: the dictionary is unknown.
    """
    sighting = _find_board(image, target)
    ids, points = sighting.ids, sighting.points
    board_points = target.points[ids, :2]
    matrix = fit_homography(board_points, points)
    if matrix is None:
        raise _not_found_error(target, "all in a line", len(ids))
    edge_steps = local_steps(
        partial(apply_homography, matrix), board_points, FITTED_SHARE * target.square
    )
    # from an edge to one pixel before the marker beside it
    arm_widths = (1 - target.marker / target.square) / 2 / FITTED_SHARE - 1 / np.linalg.norm(
        edge_steps, axis=2
    )
    corners = refine_corners(image, points, edge_steps, arm_widths)
    row, column = np.divmod(ids, target.columns - 1)
    colours = (1 - 2 * ((row + column) % 2)) * np.sign(corners.gains)
    is_good = corners.fitted & (colours * (colours @ corners.fitted) > 0)
    if is_good.sum() < MIN_CORNERS:
        raise _not_found_error(target, "clear enough", int(is_good.sum()))
    return TargetView(
        target=target,
        size=image.size,
        ids=ids[is_good],
        points=corners.points[is_good],
        covariance=corners.covariance[is_good],
        name=name,
        warnings=stray_remarks(sighting.stray_ids),
    )


def _find_board(image: GreyImage, target: Charuco) -> _Sighting:
    """Return the sighting of a board, with at least four corners.

    If only few corners are found, the mirrored image is searched as well: the mirror image of a
    marker can be another marker of the dictionary.
    """
    sighting = _search_sizes(image, target)
    corner_count = len(sighting.ids)
    if sighting.other_pattern_count >= max(MIN_CORNERS, sighting.agreeing_count + 1):
        raise _other_pattern_error(target, sighting)
    check_one_board(sighting.agreeing_count, sighting.second_board_count, _name(target))
    if 2 * corner_count > max(len(target.points), 4 * MIN_CORNERS):
        return sighting
    if sighting.marker_side and len(_search_sizes(_flipped(image), target).ids) >= max(
        MIN_CORNERS, 2 * corner_count
    ):
        raise Code.MIRRORED.error(
            f"{_name(target)}: expected an image of the sheet "
            "as one reads it, got one that is mirrored",
            "the sheet as one reads it",
            "its mirror image",
        )
    if corner_count < MIN_CORNERS:
        text = f"corners and {sighting.marker_count} markers of its dictionary"
        if sighting.marker_count:
            text += f", {sighting.agreeing_count} of them arranged as on the board"
        raise _not_found_error(target, text, corner_count)
    return sighting


def _other_pattern_error(target: Charuco, sighting: _Sighting) -> CalibrationError:
    """Return the error for markers that are arranged as in the other ``legacy_pattern``."""
    expected, other = target.legacy_pattern, not target.legacy_pattern
    return Code.WRONG_TARGET.error(
        f"{_name(target)}: expected markers as "
        f"legacy_pattern={expected} has them; got {sighting.agreeing_count} that are arranged so, "
        f"and {sighting.other_pattern_count} arranged as with legacy_pattern={other}",
        f"legacy_pattern={expected}",
        f"legacy_pattern={other}",
    )


def _flipped(image: GreyImage) -> GreyImage:
    return GreyImage(
        np.ascontiguousarray(image.levels[:, ::-1]),
        np.ascontiguousarray(image.uint8_levels[:, ::-1]),
    )


class _Sighting(NamedTuple):
    """The markers and corners that were found of one board."""

    ids: NDArray[np.intp]  # (N,), ascending
    points: Array  # (N, 2), pixels
    marker_count: int  # number of markers that were read, whether or not they lie as on the board
    agreeing_count: int  # number of read markers that are arranged as on the board
    second_board_count: int  # number of other markers that lie as on a second board
    other_pattern_count: int  # number of markers arranged as with the other legacy_pattern
    stray_ids: tuple[int, ...]  # ids of the markers that were left out
    # side of a marker, pixels of the given image: that of the markers that were read; if none was
    # read, that of quadrangles in rows and columns; 0 without such quadrangles
    marker_side: float


def _search_sizes(image: GreyImage, target: Charuco) -> _Sighting:
    """Search a board in a reduced image, then in the given image, then at twice its size.

    No further size is searched once enough of the board was found. The image is enlarged only if it
    may have markers that are too small to be read.
    """
    best = _Sighting(np.zeros(0, dtype=np.intp), np.zeros((0, 2)), 0, 0, 0, 0, (), 0.0)
    factor = math.ceil(max(image.size) / USUAL_SIDE_PX)
    if factor > 1:
        best = _search_image(shrink_image(image.uint8_levels, factor), 1 / factor, target, best)
        if _has_all_corners(best, target, image):
            return best
    best = _search_image(image.uint8_levels, 1.0, target, best)
    can_double = max(image.size) <= MAX_DOUBLED_PX and 2 * len(best.ids) <= len(target.points)
    if can_double and (
        best.marker_count
        or 0
        < best.marker_side
        < MAX_UNREAD_MODULE_PIXELS * _modules_per_side(charuco_board(target))
    ):
        best = _search_image(resize_image(image.uint8_levels, 2.0), 2.0, target, best)
    return best


def _has_all_corners(sighting: _Sighting, target: Charuco, image: GreyImage) -> bool:
    """Return True if all corners were found that should be in the image."""
    if len(sighting.ids) < MIN_CORNERS:
        return False
    matrix = fit_homography(target.points[sighting.ids, :2], sighting.points)
    if matrix is None:
        return False
    expected = apply_homography(matrix, target.points[:, :2])
    is_inside = ((expected >= 0) & (expected <= np.array(image.size) - 1)).all(axis=1)
    return bool(np.isin(np.flatnonzero(is_inside), sighting.ids).all())


def _search_image(
    image: NDArray[np.uint8], scale: float, target: Charuco, best: _Sighting
) -> _Sighting:
    """Return the sighting in a resized image if it shows more than ``best``, else ``best``."""
    board = charuco_board(target)
    finder = marker_finder(image, board.getDictionary())
    quads, ids_read, rejected = finder.detectMarkers(image)
    marker_side = _median_side(quads) if ids_read is not None else _side_in_grid(rejected, board)
    best = best._replace(marker_side=max(best.marker_side, marker_side / scale))
    if ids_read is None:
        return best
    board_corners = _marker_corners(board)
    markers = Markers(np.array(quads, dtype=np.float64).reshape(-1, 4, 2), ids_read.ravel())
    mask, second_board_count = compare_with_board(markers, board_corners)
    stray_ids = tuple(sorted(markers.ids[~mask].tolist()))
    other_pattern_count = 0
    if target.rows % 2 == 0:
        other_board = charuco_board(target, legacy_pattern=not target.legacy_pattern)
        other_pattern_count = int(
            compare_with_board(markers, _marker_corners(other_board)).mask.sum()
        )
    best = best._replace(
        marker_count=max(best.marker_count, len(mask)),
        agreeing_count=max(best.agreeing_count, int(mask.sum())),
        second_board_count=max(best.second_board_count, second_board_count),
        other_pattern_count=max(best.other_pattern_count, other_pattern_count),
    )
    if not mask.any():
        return best
    kept_quads = [quad for quad, is_kept in zip(quads, mask, strict=True) if is_kept]
    quads, ids_read, *_ = finder.refineDetectedMarkers(
        image, board, kept_quads, ids_read[mask], rejected
    )
    markers = Markers(np.array(quads, dtype=np.float64).reshape(-1, 4, 2), ids_read.ravel())
    ids, corners = _interpolate_corners(
        image, board, markers.subset(compare_with_board(markers, board_corners).mask)
    )
    if len(ids) <= len(best.ids):
        return best
    # OpenCV counts rows from the top
    row, column = np.divmod(ids, target.columns - 1)
    ids = (target.rows - 2 - row) * (target.columns - 1) + column
    order = np.argsort(ids)
    points = (corners + 0.5) / scale - 0.5
    return best._replace(ids=ids[order], points=points[order], stray_ids=stray_ids)


def _marker_corners(board: Any) -> Array:
    """Return the corners of a board's markers, in the order of their ids, (M, 4, 2)."""
    return np.asarray(board.getObjPoints(), dtype=np.float64)[:, :, :2]


def _interpolate_corners(
    image: NDArray[np.uint8], board: Any, markers: Markers
) -> tuple[NDArray[np.intp], Array]:
    """Return OpenCV's numbers of the corners next to markers, and their pixels (N, 2).

    Corners that are not where the markers predict them are left out.
    """
    cv2 = load("cv2")
    parameters = cv2.aruco.CharucoParameters()
    parameters.minMarkers = 1
    if hasattr(parameters, "checkMarkers"):  # OpenCV 4.11 and later
        parameters.checkMarkers = False  # results of both versions are then equal
    detector = cv2.aruco.CharucoDetector(board, parameters)
    quads = [quad[None].astype(np.float32) for quad in markers.quads]
    marker_ids = markers.ids.astype(np.int32)[:, None]
    corners, corner_ids, *_ = detector.detectBoard(image, markerCorners=quads, markerIds=marker_ids)
    if corner_ids is None or not len(corner_ids):
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    ids = np.asarray(corner_ids, dtype=np.intp).ravel()
    points = np.array(corners, dtype=np.float64).reshape(-1, 2)
    places = np.asarray(board.getChessboardCorners(), dtype=np.float64)[ids, :2]
    board_corners = _marker_corners(board)[markers.ids]
    expected, scales = predict_pixels(markers.quads, board_corners, places)
    square = float(board.getSquareLength())
    is_right = np.linalg.norm(points - expected, axis=1) < MAX_SQUARES_OFF * square * scales
    return ids[is_right], points[is_right]


def _modules_per_side(board: Any) -> int:
    """Return the number of modules along a marker's side, including its black border."""
    return int(board.getDictionary().markerSize) + 2


def _quad_areas(quads: Sequence[Array]) -> Array:
    corners = np.array(quads, dtype=np.float64).reshape(-1, 4, 2)
    (a, b), (c, d) = (corners[:, 2] - corners[:, 0]).T, (corners[:, 3] - corners[:, 1]).T
    areas: Array = np.maximum(np.abs(a * d - b * c) / 2, 1.0)
    return areas


def _median_side(quads: Sequence[Array]) -> float:
    return float(np.sqrt(np.median(_quad_areas(quads))))


def _side_in_grid(quads: Sequence[Array], board: Any) -> float:
    """Return the side, pixels, of dark quadrangles (1, 4, 2) in rows and columns.

    These may be markers. It is 0 if there are none, or only quadrangles too small for a marker that
    can be read.
    """
    if len(quads) < MIN_QUADRANGLES:
        return 0.0
    areas = _quad_areas(quads)
    centres = np.array(quads, dtype=np.float64).reshape(-1, 4, 2).mean(axis=1)
    marker_count = len(board.getIds())
    grids = grow_grids(centres, area_test(areas), min_count=MIN_QUADRANGLES, max_count=marker_count)
    sides = [_median_side([quads[index] for index in grid.values()]) for grid in grids]
    return max(
        (side for side in sides if side > MIN_MODULE_PIXELS * _modules_per_side(board)), default=0.0
    )


def _not_found_error(target: Charuco, reason: str, count: int) -> CalibrationError:
    return Code.TARGET_NOT_FOUND.error(
        f"charuco: expected at least {MIN_CORNERS} corners of a board of {target.columns} x "
        f"{target.rows} squares, found {count} {reason}",
        MIN_CORNERS,
        count,
    )
