"""ChArUco boards in images: corners with ids, some of which may be hidden."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.calibration._codes import Code
from smartcam.calibration._detection.corners import refine_corners
from smartcam.calibration._detection.image import GreyImage, scaled
from smartcam.calibration._geometry.homography import apply_homography, fit_homography, local_steps
from smartcam.calibration._optional_imports import load
from smartcam.calibration._views import TargetView
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration._geometry.rotations import Array
    from smartcam.calibration._targets import Charuco

FEWEST = 4
"""Corners that fix a pose at least."""

LARGEST_DOUBLED = 2600
"""Longest side, pixels, of an image that is looked at in double size, too, for small markers."""

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

    Where few are found, the mirror image is looked at as well: a marker's mirror image can be
    another one of its dictionary, and such neighbours give corners with wrong numbers.
    """
    ids, found, markers = _detect(image, target)
    if 2 * len(ids) > max(len(target.points), 4 * FEWEST):
        return ids, found
    flipped = GreyImage(
        np.ascontiguousarray(image.levels[:, ::-1]), np.ascontiguousarray(image.bytes[:, ::-1])
    )
    if len(_detect(flipped, target)[0]) >= max(FEWEST, 2 * len(ids)):
        raise CalibrationError(
            f"charuco of {target.columns} x {target.rows} squares: expected an image of the sheet "
            "as one reads it, got one that is mirrored",
            code=Code.MIRRORED,
            expected="the sheet as one reads it",
            got="its mirror image",
        )
    if len(ids) < FEWEST:
        doubt = markers and not len(ids) and target.rows % 2 == 0
        legacy = ": is its legacy_pattern right?" if doubt else ""
        raise _not_found(target, f"beside {markers} of its markers{legacy}", len(ids))
    return ids, found


def _detect(image: GreyImage, target: Charuco) -> tuple[NDArray[np.intp], Array, int]:
    """Return numbers (N,), ascending, corners (N, 2), and how many markers were seen."""
    cv2 = load("cv2")
    given = cv2.aruco.CharucoParameters()
    given.minMarkers, given.tryRefineMarkers = 1, True
    detector = cv2.aruco.CharucoDetector(charuco_board(target), given)
    numbers, found, markers = np.zeros(0, dtype=np.intp), np.zeros((0, 2)), 0
    for scale in (1.0, 2.0):
        corners, ids, _, seen = detector.detectBoard(scaled(image, scale))
        markers = max(markers, 0 if seen is None else len(seen))
        if ids is not None and len(ids) > len(numbers):
            numbers = np.array(ids, dtype=np.intp).ravel()
            found = (np.array(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
        if 2 * len(numbers) > len(target.points) or max(image.size) > LARGEST_DOUBLED:
            break
    # OpenCV counts rows from the top
    row, column = np.divmod(numbers, target.columns - 1)
    ids = (target.rows - 2 - row) * (target.columns - 1) + column
    order = np.argsort(ids)
    return ids[order], found[order], markers


def _not_found(target: Charuco, how: str, count: int) -> CalibrationError:
    return CalibrationError(
        f"charuco: expected at least {FEWEST} corners of a board of {target.columns} x "
        f"{target.rows} squares, found {count} {how}",
        code=Code.TARGET_NOT_FOUND,
        expected=FEWEST,
        got=count,
    )
