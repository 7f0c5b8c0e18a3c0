r"""Refine the corners of a checkerboard.

Two edges cross at a corner. Behind a lens that blurs by a Gaussian of width ``s`` the grey levels
around it are ``offset + gain * erf(d1 / s') * erf(d2 / s')``, where ``d`` is the distance from an
edge and ``s' = sqrt(2) * s``. Seven values, the place and the angle of each edge, blur, gain and
offset, are fitted to all pixels around a corner. The corner is where the edges cross.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.calibration._detection.levenberg import (
    BLUR,
    GAIN,
    OFFSET,
    covariances,
    fits_of,
    refined,
)
from smartcam.calibration._detection.pixels import cut_windows, edge

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration._detection.image import GreyImage
    from smartcam.calibration._detection.levenberg import Fits
    from smartcam.calibration._detection.pixels import Windows
    from smartcam.geometry._inside import Array

MAX_REACH_PX = 13
"""At most this many pixels to each side of a corner are fitted: more of the edges adds little and
takes time."""

MAX_RESIDUAL_RATIO = 0.35
"""Largest RMS of a good fit's residuals, as a part of the gain; where there is no edge it is 1."""

MIN_SINE = 0.17
"""The two edges of a corner must cross at an angle whose sine is larger than this: 10 degrees."""

UNREFINED_SIGMA_PX = 0.25
"""Standard deviation, pixels, of a corner that could not be refined: that of common detectors."""

ROUNDED_PX = 2.0
"""Pixels around the corner of a single square that are not fitted: there the blur rounds the
corner, and unless its angle is a right one the levels are no product of two edges."""

PLACES, ANGLES = slice(0, 4, 2), slice(1, 4, 2)


class Corners(NamedTuple):
    """Corners as fitted to the grey levels."""

    points: Array  # (N, 2), pixels
    covariance: Array  # (N, 2, 2), pixels^2
    # (N,), half the step from black to white, grey levels; positive where the squares between the
    # two steps, and the squares opposite, are black
    gains: Array
    # (N,), whether the fit was good; a corner that was not fitted keeps its place
    fitted: NDArray[np.bool_]


def refine_corners(
    image: GreyImage,
    points: Array,
    ways: Array,
    clear: Array | None = None,
    *,
    single: bool = False,
) -> Corners:
    """Refine corners to a fraction of a pixel, never to a worse place than before.

    A fit that does not come to rest near its start, or that does not look like a corner, leaves the
    corner where OpenCV's ``cornerSubPix`` puts it.

    ``points`` (N, 2) are found to a pixel or two. ``ways`` (N, 2, 2), pixels, lead along the two
    edges; in both directions they span the part of the corner's four squares that is fitted.
    ``clear`` (N, 2) is the part of ``ways`` from an edge within which nothing is printed on the
    squares; None takes all of it. ``single``: the corner is that of one square, which lies
    between the first way and the second one's opposite, which stand counter-clockwise in the
    image's u and v.
    """
    reach = np.linalg.norm(ways, axis=2).min(axis=1)
    start = _start(image, points, reach if clear is None else reach * clear.min(axis=1))
    windows = cut_windows(image, start, ways, MAX_REACH_PX, round_=False, arm_widths=clear)
    if single:
        windows = windows.without(start, ROUNDED_PX)
    guess = _guess(start - windows.middle, ways)
    evaluate = partial(_evaluate, alone=1.0 if single else 0.0)
    fits, good = refined(evaluate, windows, guess, moving=(0, 2), worst=MAX_RESIDUAL_RATIO)
    corners, covariance, crossing = _crossings(fits, windows)
    corners += windows.middle
    moved = np.linalg.norm(corners - start, axis=1)
    good &= crossing & (moved < np.clip(0.5 * reach, 0.75, 3.0))
    if single:
        good &= reach > 1.5 * ROUNDED_PX
    start[good] = corners[good]
    covariance[~good] = UNREFINED_SIGMA_PX**2 * np.eye(2)
    return Corners(start, covariance, fits.values[:, GAIN], good)


def _start(image: GreyImage, points: Array, reach: Array) -> Array:
    """Refine points by OpenCV, with a window that fits the smallest corner."""
    cv2 = load("cv2")
    half = int(np.clip(0.8 * reach.min(), 2, 5))
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-2)
    at = points.astype(np.float32).reshape(-1, 1, 2)
    at = cv2.cornerSubPix(image.bytes, at, (half, half), (-1, -1), stop)
    refined: Array = np.array(at, dtype=np.float64).reshape(-1, 2)
    return refined


def _guess(start: Array, ways: Array) -> Array:
    """Return the values (N, 7) that a fit begins with: the edges along the given steps."""
    values = np.zeros((len(start), 7))
    # an edge along (x, y) has the normal (-y, x), and its points fulfil cos(angle) u + sin(angle) v
    # = place
    angles = np.arctan2(ways[:, :, 0], -ways[:, :, 1])
    values[:, ANGLES] = angles
    values[:, PLACES] = np.cos(angles) * start[:, :1] + np.sin(angles) * start[:, 1:]
    return values


def _evaluate(windows: Windows, values: Array, alone: float = 0.0) -> Fits:
    """Return the fits of four squares, or with ``alone`` = 1 of a single one.

    The levels of a single square are ``offset + gain * ((1 + E1) * (1 + E2) / 2 - 1)``, those of
    four ``offset + gain * E1 * E2``.
    """
    x, y, weights = windows.x, windows.y, windows.weights
    narrow = values.astype(np.float32)
    blur, gain, offset = (narrow[:, [column]] for column in (BLUR, GAIN, OFFSET))
    cosines, sines = np.cos(narrow[:, ANGLES]), np.sin(narrow[:, ANGLES])
    places = narrow[:, PLACES]
    scale = 1 / (np.sqrt(np.float32(2)) * blur)
    signed, along, shapes, slopes = [], [], [], []
    # d = cos(a) x + sin(a) y - place moves with place by -1, and with a by cos(a) y - sin(a) x, the
    # way along the edge. The level gain E(d1 / s) E(d2 / s) + offset, E = erf, moves with d1 by
    # gain E'(d1 / s) E(d2 / s) / s, and with the blur, to which s is in proportion, by
    # -gain (E'_1 d1 / s E_2 + E'_2 d2 / s E_1) / blur.
    for side in (0, 1):
        cosine, sine, place = (part[:, [side]] for part in (cosines, sines, places))
        signed.append((cosine * x + sine * y - place) * scale)
        along.append(cosine * y - sine * x)
        shape, slope = edge(signed[side])
        shapes.append(shape)
        slopes.append(slope)
    half = np.float32(1 - alone / 2)
    one_side, other_side = (half * (np.float32(alone) + shape) * weights for shape in shapes)
    first = slopes[0] * other_side
    second = slopes[1] * one_side
    product = (np.float32(alone) + shapes[0]) * other_side - np.float32(alone) * weights
    columns = (
        first,
        first * along[0],
        second,
        second * along[1],
        first * signed[0] + second * signed[1],
        product,
        weights,
    )
    steep, ones = gain * scale, np.ones_like(gain)
    factors = (-steep, steep, -steep, steep, -gain / blur, ones, ones)
    return fits_of(values, columns, factors, windows.levels - gain * product - offset * weights)


def _crossings(fits: Fits, windows: Windows) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the crossings of the edges, their covariances, and a mask of those that cross."""
    # N p = q with the normals as rows of N: p = N^-1 q, and dp = N^-1 (dq - dN p); a normal turned
    # by da moves by da along its edge, so dN p is da times the way along it.
    places, angles = fits.values[:, PLACES], fits.values[:, ANGLES]
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=2)
    crossing = np.abs(np.linalg.det(normals)) > MIN_SINE
    normals[~crossing] = np.eye(2)
    inverse = np.linalg.inv(normals)
    corners: Array = (inverse @ places[:, :, None])[:, :, 0]
    along = normals[:, :, 0] * corners[:, 1:] - normals[:, :, 1] * corners[:, :1]
    moves = np.zeros((len(corners), 2, fits.values.shape[1]))
    moves[:, :, PLACES] = inverse
    moves[:, :, ANGLES] = -inverse * along[:, None]
    covariance: Array = moves @ covariances(fits, windows.counts) @ moves.transpose(0, 2, 1)
    return corners, covariance, crossing
