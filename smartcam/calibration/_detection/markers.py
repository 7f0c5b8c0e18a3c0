"""Read square markers in images, and compare their places with those on the board.

The number of a marker tells its place on the board. A marker that was misread, or that belongs to
another board, is not at this place, as its neighbours show. The corners of a marker tell how the
board is turned and scaled at the marker. Two markers agree if the vector between their centres is
that on the board, turned and scaled in this way. Markers that agree form a group; if the board is
as described, all markers are in one group.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.calibration._homography import apply_homography, derivatives, fit_homography
from smartcam.geometry._inside import Code, Remark

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

MAX_NEIGHBOUR_PITCHES = 2.9
"""Two markers are compared if they are at most this far apart on the board, in pitches. The pitch
is the distance between two neighbouring markers."""

MAX_VECTOR_DIFFERENCE = 0.15
"""The vector between two markers may differ from the board's by this fraction of its length. A
number that is wrong by one moves a marker by a third of the longest such vector or more."""

MAX_JACOBIAN_DIFFERENCE = 0.5
"""The turns and scales of two neighbouring markers may differ by this fraction."""

MAX_PITCHES_OFF = 0.35
"""A marker without neighbours may lie this many pitches from its predicted place."""

MIN_PITCHES_AGAINST = 0.6
"""A group of markers belongs to a second board if its offset from the place that the others predict
is larger than this many pitches plus MAX_VECTOR_DIFFERENCE times its distance from the others."""

MIN_SECOND_BOARD_MARKERS = 3
"""A group that belongs to a second board has at least this many markers."""

MAX_NUMBERS_IN_MESSAGE = 8
"""A message lists at most this many marker numbers."""

MIN_AGREEING_MARKERS = 2
"""At least this many markers must agree: a single reading may be wrong."""


WINDOWS_PX = (3, 13, 23)
"""Sides of the windows, pixels, whose mean separates dark from light: OpenCV's."""

MAX_MEAN_OUTLINES, MAX_OUTLINES = 1500, 4000
"""Limits for the dark outlines of an image. If the windows have more than the first number on
average, a single window is used, and at most the second number of its outlines is examined. A board
of 1,000 markers, the most that a dictionary has, shows some 3,000."""


class Markers(NamedTuple):
    """Markers that were read."""

    quads: Array  # (N, 4, 2), corners in OpenCV's order, pixels
    ids: NDArray[np.intp]  # (N,), numbers of the markers

    def subset(self, mask: NDArray[np.bool_]) -> Markers:
        """Return the markers where a mask (N,) is True."""
        return Markers(self.quads[mask], self.ids[mask])


class MarkerAgreement(NamedTuple):
    """The result of comparing markers with a board."""

    mask: NDArray[np.bool_]  # True for each marker that lies as on the board
    second_board_count: int  # size of the largest group that lies as on a second board


def marker_dictionary(name: str, min_count: int, label: str) -> Any:
    """Return OpenCV's dictionary of a name, which must have at least ``min_count`` markers.

    ``label`` names the target. Raises SHAPE if the dictionary is unknown or has too few markers.
    """
    cv2 = load("cv2")
    number = getattr(cv2.aruco, name, None)
    if not (name.startswith("DICT_") and isinstance(number, int)):
        raise Code.SHAPE.error(
            f"{label}: expected the name of one of OpenCV's dictionaries such as "
            f"DICT_5X5_250, got {name!r}",
            "DICT_5X5_250",
            name,
        )
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    count = len(dictionary.bytesList)
    if min_count > count:
        raise Code.SHAPE.error_with_value(
            f"{label}: expected at least {min_count} markers in {name}", min_count, count
        )
    return dictionary


def marker_finder(image: NDArray[np.uint8], dictionary: Any, parameters: Any = None) -> Any:
    """Return OpenCV's detector for an image, set up so that its time is bounded.

    The detector compares each dark outline with each other one. If there are many, one window is
    used instead of three; if there are too many, only the largest outlines are examined.
    """
    cv2 = load("cv2")
    options = cv2.aruco.DetectorParameters() if parameters is None else parameters
    lengths = {window: _outlines(image, window, options) for window in WINDOWS_PX}
    if sum(map(len, lengths.values())) > len(WINDOWS_PX) * MAX_MEAN_OUTLINES:
        window = sorted(WINDOWS_PX, key=lambda side: len(lengths[side]))[len(WINDOWS_PX) // 2]
        options.adaptiveThreshWinSizeMin = options.adaptiveThreshWinSizeMax = window
        longest = np.sort(lengths[window])[::-1]
        if len(longest) > MAX_OUTLINES:
            options.minMarkerPerimeterRate = float(longest[MAX_OUTLINES] + 1.5) / max(image.shape)
    return cv2.aruco.ArucoDetector(dictionary, options)


def _outlines(image: NDArray[np.uint8], window: int, options: Any) -> NDArray[np.intp]:
    """Return the lengths, pixels, of the dark outlines that may be those of markers.

    A pixel is dark if it is darker than the mean of a window around it.
    """
    cv2 = load("cv2")
    method, threshold_type = cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV
    dark = cv2.adaptiveThreshold(
        image, 255, method, threshold_type, window, options.adaptiveThreshConstant
    )
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    lengths = np.array([len(contour) for contour in contours], dtype=np.intp)
    low, high = options.minMarkerPerimeterRate, options.maxMarkerPerimeterRate
    largest = max(image.shape)  # OpenCV takes whole pixels
    return lengths[(lengths >= int(low * largest)) & (lengths <= int(high * largest))]


def compare_with_board(markers: Markers, board: Array) -> MarkerAgreement:
    """Find the markers that are arranged as on a board; a number that was read twice counts once.

    ``board`` (M, 4, 2): the corners of the markers by their numbers, in any unit. If fewer than
    MIN_AGREEING_MARKERS markers agree, the mask is False for all.
    """
    mask = np.zeros(len(markers.ids), dtype=np.bool_)
    known_indices = np.flatnonzero((markers.ids >= 0) & (markers.ids < len(board)))
    if len(known_indices) < MIN_AGREEING_MARKERS:
        return MarkerAgreement(mask, 0)
    ids, quads = markers.ids[known_indices], markers.quads[known_indices]
    corners_on_board = board[ids]
    centres, board_centres, jacobians = (
        quads.mean(axis=1),
        corners_on_board.mean(axis=1),
        _jacobians(quads, corners_on_board),
    )
    pitch = _pitch(board.mean(axis=1))
    groups = _group_numbers(
        _agreement_mask(jacobians, centres, board_centres, MAX_NEIGHBOUR_PITCHES * pitch)
    )
    in_largest_group = groups == np.bincount(groups).argmax()
    matrix = fit_homography(
        corners_on_board[in_largest_group].reshape(-1, 2), quads[in_largest_group].reshape(-1, 2)
    )
    if in_largest_group.sum() < MIN_AGREEING_MARKERS or matrix is None:
        return MarkerAgreement(mask, 0)
    distances = np.linalg.norm(apply_homography(matrix, board_centres) - centres, axis=1)
    distances /= pitch * np.sqrt(np.abs(np.linalg.det(jacobians)))
    group_distances = (
        np.linalg.norm(board_centres[:, None] - board_centres[in_largest_group], axis=2).min(axis=1)
        / pitch
    )
    has_like_jacobian = _have_like_jacobians(jacobians, derivatives(matrix, board_centres))
    agrees = in_largest_group | (
        (distances < MAX_PITCHES_OFF) & has_like_jacobian & ~np.isin(ids, ids[in_largest_group])
    )
    mask[known_indices[agrees]] = True
    is_on_second_board = ~agrees & (
        distances > MIN_PITCHES_AGAINST + MAX_VECTOR_DIFFERENCE * group_distances
    )
    return MarkerAgreement(mask, int(np.bincount(groups[is_on_second_board], minlength=1).max()))


def check_one_board(agreeing_count: int, second_board_count: int, label: str) -> None:
    """Raise WRONG_TARGET if markers are arranged as on another board, or as on several.

    ``agreeing_count``: number of markers arranged as on the board. ``second_board_count``: number
    of others that agree with each other, but not with these. ``label`` names the target.
    """
    if second_board_count >= MIN_SECOND_BOARD_MARKERS and 2 * second_board_count >= agreeing_count:
        raise Code.WRONG_TARGET.error(
            f"{label}: expected markers of one such board, got {agreeing_count} arranged as on it "
            f"and {second_board_count} arranged as on another one: the board has other numbers of "
            "columns and rows, or the picture shows several boards with the same numbers",
            f"{agreeing_count + second_board_count} markers of one board",
            agreeing_count,
        )


def predict_pixels(quads: Array, board_corners: Array, places: Array) -> tuple[Array, Array]:
    """Predict the pixels of places (N, 2) on a board from the nearest markers, and the scales.

    The scales (N,) are pixels per unit of the board. ``quads`` (M, 4, 2): the corners of markers in
    the image; ``board_corners``: on the board.
    """
    jacobians, centres, board_centres = (
        _jacobians(quads, board_corners),
        quads.mean(axis=1),
        board_corners.mean(axis=1),
    )
    vectors = places[:, None] - board_centres
    distances = np.linalg.norm(vectors, axis=2)
    expected = centres + np.einsum("jkl,ijl->ijk", jacobians, vectors)
    # a corner of a square lies between the two nearest markers, whose errors by perspective are
    # about opposite, so their predictions are averaged
    is_near = distances < 1.1 * distances.min(axis=1, keepdims=True)
    shares = is_near / is_near.sum(axis=1, keepdims=True)
    predicted: Array = np.einsum("ij,ijk->ik", shares, expected)
    return predicted, shares @ np.sqrt(np.abs(np.linalg.det(jacobians)))


def stray_remarks(marker_ids: Sequence[int]) -> tuple[Remark, ...]:
    """Return a remark that names the markers that were left out; none without such markers."""
    if not marker_ids:
        return ()
    shown = ", ".join(map(str, marker_ids[:MAX_NUMBERS_IN_MESSAGE])) + (
        ", ..." if marker_ids[MAX_NUMBERS_IN_MESSAGE:] else ""
    )
    text = f"markers left out, which do not stand where the board has them: {shown}"
    return (Code.OUTLIER.remark(text),)


def _jacobians(quads: Array, board_corners: Array) -> Array:
    """Return the derivatives of the pixels by the board's x and y at each marker, (N, 2, 2)."""
    board_offsets = board_corners - board_corners.mean(axis=1, keepdims=True)
    pixel_offsets = quads - quads.mean(axis=1, keepdims=True)
    squares = (board_offsets**2).sum(axis=(1, 2)) / 2  # equal along x and y
    jacobians: Array = pixel_offsets.transpose(0, 2, 1) @ board_offsets / squares[:, None, None]
    return jacobians


def _pitch(centres: Array) -> float:
    """Return the distance between a board's markers that are next to each other."""
    distances = np.linalg.norm(centres - centres[0], axis=1)
    return float(distances[1:].min()) if len(centres) > 1 else 0.0


def _agreement_mask(
    jacobians: Array, centres: Array, board_centres: Array, max_distance: float
) -> NDArray[np.bool_]:
    """Return a mask (N, N) that is True for two markers that agree."""
    vectors = board_centres[None] - board_centres[:, None]
    distances = np.linalg.norm(vectors, axis=2)
    # the mean of both derivatives predicts one marker from the other exactly to second order
    mean_jacobians = (jacobians[:, None] + jacobians[None]) / 2
    expected = np.einsum("ijkl,ijl->ijk", mean_jacobians, vectors)
    differences = np.linalg.norm(centres[None] - centres[:, None] - expected, axis=2)
    return np.asarray(
        (distances > 0)
        & (distances <= max_distance)
        & (differences < MAX_VECTOR_DIFFERENCE * np.linalg.norm(expected, axis=2))
        & _have_like_jacobians(jacobians[:, None], jacobians[None])
    )


def _have_like_jacobians(first: Array, second: Array) -> NDArray[np.bool_]:
    """Return a mask of the pairs of jacobians (..., 2, 2) with about the same turn and scale."""
    differences = np.linalg.norm(first - second, axis=(-2, -1))
    return np.asarray(
        differences < MAX_JACOBIAN_DIFFERENCE * np.linalg.norm((first + second) / 2, axis=(-2, -1))
    )


def _group_numbers(agreement: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the number (N,) of the group of agreeing markers to which each marker belongs."""
    _, groups = load("scipy.sparse.csgraph").connected_components(agreement, directed=False)
    return np.asarray(groups, dtype=np.intp)
