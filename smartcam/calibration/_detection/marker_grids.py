"""Find grids of markers in images: Kalibr's AprilGrid and OpenCV's GridBoard."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam._extras import load
from smartcam.calibration._detection.corners import refine_corners
from smartcam.calibration._detection.image import USUAL_SIDE_PX, reduced, scaled
from smartcam.calibration._detection.markers import (
    MIN_AGREEING_MARKERS,
    Markers,
    agreeing,
    check_one_board,
    marker_dictionary,
    marker_finder,
    remarks_on_strays,
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
"""Part of the black border, or of the white gap beside a corner, that is fitted."""

MAX_MOVED_PX = 1.0
"""A corner that could not be fitted is kept if refinement moved it by less than this many
pixels."""

MAX_DOUBLED_PX = 2600
"""An image whose longest side is at most this many pixels is also searched at twice its size."""


def find_marker_grid(image: GreyImage, target: MarkerGrid, name: str = "") -> TargetView:
    """Find the corners of the visible markers.

    Raises TARGET_NOT_FOUND, WRONG_TARGET, or SHAPE if the dictionary is unknown.
    """
    kind_text = f"grid of {target.columns} x {target.rows} markers"
    board = target.points[target.corners, :2]
    best, strays, read = Markers(np.zeros((0, 4, 2)), np.zeros(0, dtype=np.intp)), (), 0
    against = 0
    times = math.ceil(max(image.size) / USUAL_SIDE_PX)
    for scale in dict.fromkeys((1 / times, 1.0, 2.0)):
        few = len(best.ids) < len(board) / 2
        if len(best.ids) == len(board) or (
            scale > 1 and not (few and read and max(image.size) <= MAX_DOUBLED_PX)
        ):
            break
        looked_at = reduced(image.bytes, times) if scale < 1 else scaled(image.bytes, scale)
        markers = _read(looked_at, target, scale)
        good, contrary = agreeing(markers, board)
        read, against = max(read, len(good)), max(against, contrary)
        if good.sum() > len(best.ids):
            best = markers.selected(good)
            strays = tuple(sorted((markers.ids[~good] + target.first_id).tolist()))
    check_one_board(len(best.ids), against, kind_text)
    if len(best.ids) < MIN_AGREEING_MARKERS:
        raise Code.TARGET_NOT_FOUND.refusal(
            f"{kind_text}: expected at least {MIN_AGREEING_MARKERS} that stand to each other as "
            f"on the board, found {len(best.ids)} of {read} markers of its dictionary",
            MIN_AGREEING_MARKERS,
            len(best.ids),
        )
    numbers = target.corners[best.ids].ravel()
    order = np.argsort(numbers)
    ids, points = numbers[order], best.quads.reshape(-1, 2)[order]
    corners = _refined(image, target, ids, points)
    seen = corners.fitted | (np.linalg.norm(corners.points - points, axis=1) < MAX_MOVED_PX)
    return TargetView(
        target=target,
        size=image.size,
        ids=ids[seen],
        points=corners.points[seen],
        covariance=corners.covariance[seen],
        name=name,
        warnings=remarks_on_strays(strays),
    )


def _read(bytes_: NDArray[np.uint8], target: MarkerGrid, scale: float) -> Markers:
    """Return the markers read at ``scale`` times the size, numbered from the target's first."""
    cv2: Any = load("cv2")
    count = target.columns * target.rows
    dictionary = marker_dictionary(target.dictionary, target.first_id + count, target.kind)
    given = cv2.aruco.DetectorParameters()
    given.markerBorderBits = target.border
    quads, numbers, _ = marker_finder(bytes_, dictionary, given).detectMarkers(bytes_)
    if numbers is None:
        return Markers(np.zeros((0, 4, 2)), np.zeros(0, dtype=np.intp))
    pixels = (np.array(quads, dtype=np.float64).reshape(-1, 4, 2) + 0.5) / scale - 0.5
    return Markers(pixels, np.array(numbers, dtype=np.intp).ravel() - target.first_id)


def _refined(image: GreyImage, target: MarkerGrid, ids: NDArray[np.intp], points: Array) -> Corners:
    """Return the refined corners of markers; at each, either four squares meet or a marker ends."""
    flat = target.points[ids, :2]
    matrix = fit_homography(flat, points)
    if matrix is None:
        raise Code.TARGET_NOT_FOUND.refusal(
            f"{target.kind}: expected corners that are not all in a line"
        )
    modules = marker_dictionary(target.dictionary, 0, target.kind).markerSize + 2 * target.border
    clear = FITTED_SHARE * min(target.border * target.marker / modules, target.gap)
    ways = local_steps(partial(apply_homography, matrix), flat, clear)
    if target.kalibr:
        return refine_corners(image, points, ways)
    # from the corner into the marker, in the order that the fit of a single square needs
    row, column = np.divmod(ids, 2 * target.columns)
    ways *= np.stack([1 - 2 * (column % 2), 1 - 2 * (row % 2)], axis=1)[:, :, None]
    ways[np.linalg.det(ways) < 0] = ways[np.linalg.det(ways) < 0][:, ::-1]
    ways[:, 1] *= -1
    return refine_corners(image, points, ways, single=True)


def marker_patterns(target: MarkerGrid) -> NDArray[np.bool_]:
    """Return the black modules of each marker (M, H, H), the upper row first, as printed."""
    count = target.columns * target.rows
    dictionary = marker_dictionary(target.dictionary, target.first_id + count, target.kind)
    modules = int(dictionary.markerSize) + 2 * target.border
    drawn = [
        dictionary.generateImageMarker(target.first_id + marker, modules, borderBits=target.border)
        for marker in range(count)
    ]
    patterns: NDArray[np.bool_] = np.array(drawn) == 0
    return patterns[:, ::-1, ::-1] if target.kalibr else patterns
