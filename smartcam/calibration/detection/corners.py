r"""Where the corners of a checkerboard are.

Two edges cross at a corner. Behind a lens that blurs by a Gaussian of width ``s`` the grey levels
around it are ``offset + gain * erf(d1 / s') * erf(d2 / s')``, where ``d`` is the distance from an
edge and ``s' = sqrt(2) * s``. Seven values, the place and the angle of each edge, blur, gain and
offset, are fitted to all pixels around a corner. The corner is where the edges cross.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration.detection.levenberg import covariances, fits_of, fitted, solve
from smartcam.calibration.detection.pixels import cut_windows, edge
from smartcam.calibration.optional_imports import load

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration.detection.image import GreyImage
    from smartcam.calibration.detection.levenberg import Fits
    from smartcam.calibration.detection.pixels import Windows
    from smartcam.calibration.geometry.rotations import Array

__all__ = ["Corners", "refine_corners"]

MOST_REACH = 13
"""Pixels to each side of a window at most: more of the edges adds little and takes time."""

LEAST_BLUR = 0.25
"""Pixels: the pixel's own width; a drawn image may have less, which no fit can tell."""

MOST_BLUR = 6.0
"""Pixels; a fit that needs more has seen something else than a corner."""

LEAST_GAIN = 4.0
"""Grey levels of 255: half the step from black to white at least."""

WORST_RESIDUAL = 0.35
"""Rms of the residuals in parts of the gain at most; without an edge it is 1."""

LEAST_SINE = 0.17
"""Of the angle between the two edges: 10 degrees."""

UNREFINED = 0.25
"""Standard deviation of a corner that could not be refined, pixels: what detectors reach."""

PLACES, ANGLES = slice(0, 4, 2), slice(1, 4, 2)
BLUR, GAIN, OFFSET = 4, 5, 6


class Corners(NamedTuple):
    """Corners as the image's grey levels have them.

    Attributes:
        points: (N, 2), pixels.
        covariance: (N, 2, 2), pixels^2.
        gains: (N,), half the step from black to white, grey levels; positive where the squares
            between the two ways, and opposite, are black.
        fitted: (N,), whether the fit was good; a corner is where it started elsewhere.
    """

    points: Array
    covariance: Array
    gains: Array
    fitted: NDArray[np.bool_]


def refine_corners(
    image: GreyImage, points: Array, ways: Array, clear: Array | None = None
) -> Corners:
    """Return corners to a fraction of a pixel, never worse than they were.

    A fit that does not come to rest near its start, or that does not look like a corner, leaves the
    corner where OpenCV's ``cornerSubPix`` puts it.

    Args:
        image: what they were found in.
        points: (N, 2), to a pixel or two.
        ways: (N, 2, 2), along the two edges; to both sides they span the part of the corner's four
            squares that is looked at, pixels.
        clear: (N, 2), the part of ``ways`` from an edge within which nothing is printed on the
            squares; None where they are clear as a whole.
    """
    reach = np.linalg.norm(ways, axis=2).min(axis=1)
    start = _start(image, points, reach if clear is None else reach * clear.min(axis=1))
    windows = cut_windows(image, start, ways, MOST_REACH, round_=False, clear=clear)
    fits, settled = solve(
        _evaluate,
        windows,
        _guess(windows, start - windows.middle, ways),
        moving=(0, 2),
        bounds={BLUR: (LEAST_BLUR, 2 * MOST_BLUR)},
    )
    corners, covariance, crossing = _crossings(fits, windows)
    corners += windows.middle
    blur, gain = fits.values[:, BLUR], np.abs(fits.values[:, GAIN])
    good = (
        settled
        & crossing
        & (np.linalg.norm(corners - start, axis=1) < np.clip(0.5 * reach, 0.75, 3.0))
        & (blur < MOST_BLUR)
        & (gain > LEAST_GAIN)
        & (np.sqrt(fits.cost / windows.counts) < WORST_RESIDUAL * gain)
    )
    start[good] = corners[good]
    covariance[~good] = UNREFINED**2 * np.eye(2)
    return Corners(start, covariance, fits.values[:, GAIN], good)


def _start(image: GreyImage, points: Array, reach: Array) -> Array:
    """Return points by OpenCV's refinement, with the window of the narrowest corner."""
    cv2 = load("cv2")
    half = int(np.clip(0.8 * reach.min(), 2, 5))
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-2)
    found = points.astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(image.bytes, found, (half, half), (-1, -1), stop)
    refined: Array = np.array(found, dtype=np.float64).reshape(-1, 2)
    return refined


def _guess(windows: Windows, near: Array, ways: Array) -> Array:
    """Return values (N, 7): edges as they should lie, with the gain and offset that fit best."""
    values = np.zeros((len(near), 7))
    angles = np.arctan2(ways[:, :, 0], -ways[:, :, 1])
    values[:, ANGLES] = angles
    values[:, PLACES] = np.cos(angles) * near[:, :1] + np.sin(angles) * near[:, 1:]
    values[:, BLUR] = 1.0
    values[:, GAIN:] = fitted(_evaluate(windows, values), slice(GAIN, None))
    return values


def _evaluate(windows: Windows, values: Array) -> Fits:
    x, y, weights = windows.x, windows.y, windows.weights
    narrow = values.astype(np.float32)
    blur, gain, offset = (narrow[:, [column]] for column in (BLUR, GAIN, OFFSET))
    cosines, sines = np.cos(narrow[:, ANGLES]), np.sin(narrow[:, ANGLES])
    places = narrow[:, PLACES]
    scale = 1 / (np.sqrt(np.float32(2)) * blur)
    far, along, shapes, slopes = [], [], [], []
    for side in (0, 1):
        cosine, sine, place = (part[:, [side]] for part in (cosines, sines, places))
        far.append((cosine * x + sine * y - place) * scale)
        along.append(cosine * y - sine * x)
        shape, slope = edge(far[side])
        shapes.append(shape)
        slopes.append(slope)
    first = slopes[0] * shapes[1] * weights
    second = slopes[1] * shapes[0] * weights
    product = shapes[0] * shapes[1] * weights
    columns = (
        first,
        first * along[0],
        second,
        second * along[1],
        first * far[0] + second * far[1],
        product,
        weights,
    )
    steep, one = gain * scale, np.ones_like(gain)
    factors = (-steep, steep, -steep, steep, -gain / blur, one, one)
    return fits_of(values, columns, factors, windows.levels - gain * product - offset * weights)


def _crossings(fits: Fits, windows: Windows) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return where the edges cross, its covariance, and for which corners they do."""
    places, angles = fits.values[:, PLACES], fits.values[:, ANGLES]
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=2)
    crossing = np.abs(np.linalg.det(normals)) > LEAST_SINE
    normals[~crossing] = np.eye(2)
    inverse = np.linalg.inv(normals)
    corners: Array = (inverse @ places[:, :, None])[:, :, 0]
    along = normals[:, :, 0] * corners[:, 1:] - normals[:, :, 1] * corners[:, :1]
    moves = np.zeros((len(corners), 2, fits.values.shape[1]))
    moves[:, :, PLACES] = inverse
    moves[:, :, ANGLES] = -inverse * along[:, None]
    covariance: Array = moves @ covariances(fits, windows.counts) @ moves.transpose(0, 2, 1)
    return corners, covariance, crossing
