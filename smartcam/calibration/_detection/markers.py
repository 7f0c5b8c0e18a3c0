"""Read square markers in images, and compare their places with those on the board.

A marker that was misread, or that belongs to another board, lies elsewhere than its number says.
Its neighbours show it. From the corners of a marker follows how the board is turned and scaled
there; two markers agree if the vector between their centres is then the one on the board. Markers
that agree form a group; on a board that matches its description there is one group of all.
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
"""Two markers are compared if they are at most this far apart on the board, in distances of next
neighbours."""

MAX_VECTOR_DIFFERENCE = 0.15
"""The vector between two markers may differ from the board's by this part of its length. A number
that is wrong by one moves a marker by a third of the longest such vector or more."""

MAX_SLOPE_DIFFERENCE = 0.5
"""The turns and scales of two neighbouring markers may differ by this part."""

MAX_PITCHES_OFF = 0.35
"""A marker without a neighbour may lie this many distances of next neighbours off the place that
the others predict."""

MIN_PITCHES_AGAINST = 0.6
"""A group of markers contradicts the board's description if it lies at least this many distances of
next neighbours, plus MAX_VECTOR_DIFFERENCE times its distance from the others, off the place that
they predict."""

MIN_CONTRARY_MARKERS = 3
"""A group that contradicts the description of the target has at least this many markers."""

MAX_NUMBERS_IN_MESSAGE = 8
"""A message lists at most this many marker numbers."""

MIN_AGREEING_MARKERS = 2
"""At least this many markers must agree: one alone rests on a single reading."""


WINDOWS_PX = (3, 13, 23)
"""Sides of the windows, pixels, whose mean separates dark from light: OpenCV's."""

MAX_OUTLINES_OF_ALL_WINDOWS, MAX_OUTLINES = 1500, 4000
"""Dark outlines of an image, as the mean over the windows: with more than the first number a single
window is used, and of that at most the second number is examined. A board of 1,000 markers, the
most that a dictionary has, shows some 3,000."""


class Markers(NamedTuple):
    """Markers that were read."""

    quads: Array  # (N, 4, 2), corners in OpenCV's order, pixels
    ids: NDArray[np.intp]  # (N,), numbers of the markers

    def selected(self, which: NDArray[np.bool_]) -> Markers:
        """Return some of the markers."""
        return Markers(self.quads[which], self.ids[which])


class MarkerAgreement(NamedTuple):
    """The result of comparing markers with a board."""

    good: NDArray[np.bool_]  # indices of the markers that lie as on the board
    contrary: int  # count of markers that agree with each other at other places


def marker_dictionary(name: str, needed: int, label: str) -> Any:
    """Return OpenCV's dictionary of a name, which must have at least ``needed`` markers.

    ``label`` names the target. Raises SHAPE if the dictionary is unknown or has too few markers.
    """
    cv2 = load("cv2")
    number = getattr(cv2.aruco, name, None)
    if not (name.startswith("DICT_") and isinstance(number, int)):
        raise Code.SHAPE.refusal(
            f"{label}: expected the name of one of OpenCV's dictionaries such as "
            f"DICT_5X5_250, got {name!r}",
            "DICT_5X5_250",
            name,
        )
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    count = len(dictionary.bytesList)
    if needed > count:
        raise Code.SHAPE.unexpected(
            f"{label}: expected at least {needed} markers in {name}", needed, count
        )
    return dictionary


def marker_finder(bytes_: NDArray[np.uint8], dictionary: Any, parameters: Any = None) -> Any:
    """Return OpenCV's detector for an image, set up so that its time is bounded.

    The detector compares each dark outline with each other one. If there are many, one window is
    used instead of three; if there are too many, only the largest outlines are examined.
    """
    cv2 = load("cv2")
    given = cv2.aruco.DetectorParameters() if parameters is None else parameters
    lengths = {window: _outlines(bytes_, window, given) for window in WINDOWS_PX}
    if sum(map(len, lengths.values())) > len(WINDOWS_PX) * MAX_OUTLINES_OF_ALL_WINDOWS:
        window = sorted(WINDOWS_PX, key=lambda side: len(lengths[side]))[len(WINDOWS_PX) // 2]
        given.adaptiveThreshWinSizeMin = given.adaptiveThreshWinSizeMax = window
        longest = np.sort(lengths[window])[::-1]
        if len(longest) > MAX_OUTLINES:
            given.minMarkerPerimeterRate = float(longest[MAX_OUTLINES] + 1.5) / max(bytes_.shape)
    return cv2.aruco.ArucoDetector(dictionary, given)


def _outlines(bytes_: NDArray[np.uint8], window: int, given: Any) -> NDArray[np.intp]:
    """Return the lengths, pixels, of the outlines that may be a marker's.

    A pixel is dark if it is darker than the mean of a window around it.
    """
    cv2 = load("cv2")
    mean, kind = cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV
    dark = cv2.adaptiveThreshold(bytes_, 255, mean, kind, window, given.adaptiveThreshConstant)
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    lengths = np.array([len(contour) for contour in contours], dtype=np.intp)
    low, high = given.minMarkerPerimeterRate, given.maxMarkerPerimeterRate
    largest = max(bytes_.shape)  # OpenCV takes whole pixels
    return lengths[(lengths >= int(low * largest)) & (lengths <= int(high * largest))]


def agreeing(markers: Markers, board: Array) -> MarkerAgreement:
    """Compare markers with a board; count each number once.

    ``board`` (M, 4, 2): the corners of the markers by their numbers, in any unit. If fewer than
    MIN_AGREEING_MARKERS markers agree, the result has none.
    """
    good = np.zeros(len(markers.ids), dtype=np.bool_)
    known = np.flatnonzero((markers.ids >= 0) & (markers.ids < len(board)))
    if len(known) < MIN_AGREEING_MARKERS:
        return MarkerAgreement(good, 0)
    ids, quads = markers.ids[known], markers.quads[known]
    flat = board[ids]
    seen, mapped, slopes = quads.mean(axis=1), flat.mean(axis=1), _slopes(quads, flat)
    pitch = _pitch(board.mean(axis=1))
    groups = _hanging_together(_agreements(slopes, seen, mapped, MAX_NEIGHBOUR_PITCHES * pitch))
    largest = groups == np.bincount(groups).argmax()
    matrix = fit_homography(flat[largest].reshape(-1, 2), quads[largest].reshape(-1, 2))
    if largest.sum() < MIN_AGREEING_MARKERS or matrix is None:
        return MarkerAgreement(good, 0)
    distances = np.linalg.norm(apply_homography(matrix, mapped) - seen, axis=1)
    distances /= pitch * np.sqrt(np.abs(np.linalg.det(slopes)))
    away = np.linalg.norm(mapped[:, None] - mapped[largest], axis=2).min(axis=1) / pitch
    upright = _alike(slopes, derivatives(matrix, mapped))
    joined = largest | ((distances < MAX_PITCHES_OFF) & upright & ~np.isin(ids, ids[largest]))
    good[known[joined]] = True
    contrary = ~joined & (distances > MIN_PITCHES_AGAINST + MAX_VECTOR_DIFFERENCE * away)
    return MarkerAgreement(good, int(np.bincount(groups[contrary], minlength=1).max()))


def check_one_board(agreed: int, contrary: int, label: str) -> None:
    """Raise WRONG_TARGET if markers are arranged as on another board, or as on several.

    ``agreed`` markers are arranged as on the board; ``contrary`` others agree with each other, but
    not with these. ``label`` names the target.
    """
    if contrary >= MIN_CONTRARY_MARKERS and 2 * contrary >= agreed:
        raise Code.WRONG_TARGET.refusal(
            f"{label}: expected markers of one such board, got {agreed} that stand to each other "
            f"as on it and {contrary} others that do so elsewhere: columns and rows are others, or "
            "several boards with the same numbers are in the picture",
            f"{agreed + contrary} markers of one board",
            agreed,
        )


def seen_from_nearest(quads: Array, flat: Array, at: Array) -> tuple[Array, Array]:
    """Predict the pixels of places (N, 2) on a board from the nearest markers, and the scale there.

    ``quads`` (M, 4, 2): the corners of markers in the image, ``flat`` on the board.
    """
    slopes, seen, mapped = _slopes(quads, flat), quads.mean(axis=1), flat.mean(axis=1)
    ways = at[:, None] - mapped
    distances = np.linalg.norm(ways, axis=2)
    expected = seen + np.einsum("jkl,ijl->ijk", slopes, ways)
    # a corner of a square lies between the two next markers, and perspective beside one of them
    # is about the opposite of that beside the other
    is_near = distances < 1.1 * distances.min(axis=1, keepdims=True)
    shares = is_near / is_near.sum(axis=1, keepdims=True)
    places: Array = np.einsum("ij,ijk->ik", shares, expected)
    return places, shares @ np.sqrt(np.abs(np.linalg.det(slopes)))


def remarks_on_strays(numbers: Sequence[int]) -> tuple[Remark, ...]:
    """Return the remark that names the markers left out; nothing without any."""
    if not numbers:
        return ()
    shown = ", ".join(map(str, numbers[:MAX_NUMBERS_IN_MESSAGE])) + (
        ", ..." if numbers[MAX_NUMBERS_IN_MESSAGE:] else ""
    )
    text = f"markers left out, which do not stand where the board has them: {shown}"
    return (Code.OUTLIER.remark(text),)


def _slopes(quads: Array, flat: Array) -> Array:
    """Return the derivatives of the pixels by the board's x and y at each marker, (N, 2, 2)."""
    around = flat - flat.mean(axis=1, keepdims=True)
    seen = quads - quads.mean(axis=1, keepdims=True)
    squares = (around**2).sum(axis=(1, 2)) / 2  # sums over the corners, equal along x and y
    slopes: Array = seen.transpose(0, 2, 1) @ around / squares[:, None, None]
    return slopes


def _pitch(middles: Array) -> float:
    """Return the distance between a board's markers that are next to each other."""
    distances = np.linalg.norm(middles - middles[0], axis=1)
    return float(distances[1:].min()) if len(middles) > 1 else 0.0


def _agreements(slopes: Array, seen: Array, mapped: Array, reach: float) -> NDArray[np.bool_]:
    """Return a mask (N, N) that is True for two markers that agree."""
    ways = mapped[None] - mapped[:, None]
    distances = np.linalg.norm(ways, axis=2)
    # the mean of both derivatives predicts one marker from the other exactly to second order
    both = (slopes[:, None] + slopes[None]) / 2
    expected = np.einsum("ijkl,ijl->ijk", both, ways)
    apart = np.linalg.norm(seen[None] - seen[:, None] - expected, axis=2)
    return np.asarray(
        (distances > 0)
        & (distances <= reach)
        & (apart < MAX_VECTOR_DIFFERENCE * np.linalg.norm(expected, axis=2))
        & _alike(slopes[:, None], slopes[None])
    )


def _alike(one: Array, other: Array) -> NDArray[np.bool_]:
    """Return True for each pair of slopes (..., 2, 2) with about the same turn and scale."""
    differ = np.linalg.norm(one - other, axis=(-2, -1))
    return np.asarray(
        differ < MAX_SLOPE_DIFFERENCE * np.linalg.norm((one + other) / 2, axis=(-2, -1))
    )


def _hanging_together(agreed: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the number of the group of agreeing markers that each belongs to, (N,)."""
    _, parts = load("scipy.sparse.csgraph").connected_components(agreed, directed=False)
    return np.asarray(parts, dtype=np.intp)
