"""Find grids of markers in images: Kalibr's AprilGrid and OpenCV's GridBoard."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam._extras import load
from smartcam.calibration._detection.corners import refine_corners
from smartcam.calibration._detection.image import USUAL_SIDE_PX, resize_image, shrink_image
from smartcam.calibration._detection.markers import (
    MIN_AGREEING_MARKERS,
    Markers,
    check_one_board,
    compare_with_board,
    marker_dictionary,
    marker_finder,
    stray_remarks,
)
from smartcam.calibration._homography import apply_homography, fit_homography, local_steps
from smartcam.calibration._views import TargetView
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration._detection.corners import Corners
    from smartcam.calibration._detection.image import GreyImage
    from smartcam.calibration._targets import MarkerGrid
    from smartcam.geometry._inside import Array

FITTED_SHARE = 0.9
"""Part of the black border, or of the gap between markers, along which edges are fitted."""

MAX_REFINEMENT_PX = 1.0
"""A corner that could not be fitted is kept if OpenCV's refinement moved it by less than this many
pixels."""

MAX_DOUBLED_PX = 2600
"""An image whose longest side is at most this many pixels is also searched at twice its size."""


def find_marker_grid(image: GreyImage, target: MarkerGrid, name: str = "") -> TargetView:
    """Find the corners of the visible markers.

    Raises TARGET_NOT_FOUND or WRONG_TARGET; or SHAPE: OpenCV has no such dictionary of markers.
    """
    label = f"grid of {target.columns} x {target.rows} markers"
    board_corners = target.points[target.corners, :2]
    best, stray_ids, read_count = Markers(np.zeros((0, 4, 2)), np.zeros(0, dtype=np.intp)), (), 0
    second_board_count = 0
    factor = math.ceil(max(image.size) / USUAL_SIDE_PX)
    for scale in dict.fromkeys((1 / factor, 1.0, 2.0)):
        has_few = len(best.ids) < len(board_corners) / 2
        if len(best.ids) == len(board_corners) or (
            scale > 1 and not (has_few and read_count and max(image.size) <= MAX_DOUBLED_PX)
        ):
            break
        scaled_image = (
            shrink_image(image.uint8_levels, factor)
            if scale < 1
            else resize_image(image.uint8_levels, scale)
        )
        markers = _read_markers(scaled_image, target, scale)
        mask, second_board_here = compare_with_board(markers, board_corners)
        read_count = max(read_count, len(mask))
        second_board_count = max(second_board_count, second_board_here)
        if mask.sum() > len(best.ids):
            best = markers.subset(mask)
            stray_ids = tuple(sorted((markers.ids[~mask] + target.first_id).tolist()))
    check_one_board(len(best.ids), second_board_count, label)
    if len(best.ids) < MIN_AGREEING_MARKERS:
        raise Code.TARGET_NOT_FOUND.error(
            f"{label}: expected at least {MIN_AGREEING_MARKERS} markers arranged as "
            f"on the board, found {len(best.ids)} of {read_count} markers of its dictionary",
            MIN_AGREEING_MARKERS,
            len(best.ids),
        )
    point_ids = target.corners[best.ids].ravel()
    order = np.argsort(point_ids)
    ids, points = point_ids[order], best.quads.reshape(-1, 2)[order]
    corners = _refine(image, target, ids, points)
    is_kept = corners.fitted | (np.linalg.norm(corners.points - points, axis=1) < MAX_REFINEMENT_PX)
    return TargetView(
        target=target,
        size=image.size,
        ids=ids[is_kept],
        points=corners.points[is_kept],
        covariance=corners.covariance[is_kept],
        name=name,
        warnings=stray_remarks(stray_ids),
    )


def _read_markers(image: NDArray[np.uint8], target: MarkerGrid, scale: float) -> Markers:
    """Return a resized image's markers, in pixels of the given one; ids count from ``first_id``."""
    cv2: Any = load("cv2")
    count = target.columns * target.rows
    dictionary = marker_dictionary(target.dictionary, target.first_id + count, target.kind)
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits = target.border
    quads, marker_ids, _ = marker_finder(image, dictionary, options).detectMarkers(image)
    if marker_ids is None:
        return Markers(np.zeros((0, 4, 2)), np.zeros(0, dtype=np.intp))
    pixels = (np.array(quads, dtype=np.float64).reshape(-1, 4, 2) + 0.5) / scale - 0.5
    return Markers(pixels, np.array(marker_ids, dtype=np.intp).ravel() - target.first_id)


def _refine(image: GreyImage, target: MarkerGrid, ids: NDArray[np.intp], points: Array) -> Corners:
    """Return the refined corners of markers; on Kalibr's grid each is a corner of four squares."""
    board_points = target.points[ids, :2]
    matrix = fit_homography(board_points, points)
    if matrix is None:
        raise Code.TARGET_NOT_FOUND.error(
            f"{target.kind}: expected corners that are not all in a line"
        )
    modules = marker_dictionary(target.dictionary, 0, target.kind).markerSize + 2 * target.border
    fitted_length = FITTED_SHARE * min(target.border * target.marker / modules, target.gap)
    edge_steps = local_steps(partial(apply_homography, matrix), board_points, fitted_length)
    if target.kalibr:
        return refine_corners(image, points, edge_steps)
    # steps from the corner into the marker, in the order that the fit of a single square needs
    row, column = np.divmod(ids, 2 * target.columns)
    edge_steps *= np.stack([1 - 2 * (column % 2), 1 - 2 * (row % 2)], axis=1)[:, :, None]
    edge_steps[np.linalg.det(edge_steps) < 0] = edge_steps[np.linalg.det(edge_steps) < 0][:, ::-1]
    edge_steps[:, 1] *= -1
    return refine_corners(image, points, edge_steps, is_single_square=True)


def marker_patterns(target: MarkerGrid) -> NDArray[np.bool_]:
    """Return a mask (M, H, H) of the black modules of each of M markers, its upper row first."""
    count = target.columns * target.rows
    dictionary = marker_dictionary(target.dictionary, target.first_id + count, target.kind)
    modules = int(dictionary.markerSize) + 2 * target.border
    images = [
        dictionary.generateImageMarker(target.first_id + marker, modules, borderBits=target.border)
        for marker in range(count)
    ]
    patterns: NDArray[np.bool_] = np.array(images) == 0
    return patterns[:, ::-1, ::-1] if target.kalibr else patterns
