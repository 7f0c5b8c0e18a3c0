r"""Refine the places of a checkerboard's corners to a fraction of a pixel.

Two edges cross at a corner. Behind a lens that blurs by a Gaussian of width ``s`` the grey levels
around it are ``offset + gain * erf(d1 / s') * erf(d2 / s')``, where ``d`` is the distance from an
edge and ``s' = sqrt(2) * s``. Seven values, the distance and the angle of each edge, blur, gain and
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
    fit_windows,
    make_fits,
)
from smartcam.calibration._detection.pixels import cut_windows, edge_profile

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration._detection.image import GreyImage
    from smartcam.calibration._detection.levenberg import Fits
    from smartcam.calibration._detection.pixels import Windows
    from smartcam.geometry._inside import Array

MAX_REACH_PX = 13
"""At most this many pixels to each side of a corner are fitted: longer edges add little and take
time."""

MAX_RESIDUAL_RATIO = 0.35
"""Largest RMS of a good fit's residuals, as a fraction of the gain; without an edge the RMS is as
large as the gain."""

MIN_SINE = 0.17
"""The two edges of a corner must cross at an angle whose sine is larger than this: 10 degrees."""

UNREFINED_SIGMA_PX = 0.25
"""Standard deviation, pixels, that is assumed for a corner that could not be refined: it is usual
for other detectors."""

ROUNDED_RADIUS_PX = 2.0
"""Pixels within this radius of a single square's corner are not fitted: the blur rounds the corner,
and unless its angle is a right angle, the levels there are no product of two edges."""

EDGE_DISTANCES, ANGLES = slice(0, 4, 2), slice(1, 4, 2)


class Corners(NamedTuple):
    """Corners as fitted to the grey levels."""

    points: Array  # (N, 2), pixels
    covariance: Array  # (N, 2, 2), pixels^2
    # (N,), half the step from black to white, grey levels; positive if the square between the two
    # edge steps and the opposite square are black
    gains: Array
    # (N,), whether the fit was good; a corner that was not fitted is where cornerSubPix puts it
    fitted: NDArray[np.bool_]


def refine_corners(
    image: GreyImage,
    points: Array,
    edge_steps: Array,
    arm_widths: Array | None = None,
    *,
    is_single_square: bool = False,
) -> Corners:
    """Refine corners to a fraction of a pixel, never to a worse place than before.

    A corner whose fit does not converge near its start, or does not look like a corner, stays where
    OpenCV's ``cornerSubPix`` puts it.

    The places ``points`` (N, 2) may be off by a pixel or two. ``edge_steps`` (N, 2, 2), pixels,
    lead along the two edges; with their opposites they span the part of the four squares that is
    fitted. ``arm_widths`` (N, 2): only pixels within this fraction of ``edge_steps`` from an edge
    are fitted, since something else is printed beyond; None: all pixels are fitted.
    ``is_single_square``: the corner is that of one square, which lies between the first step and
    the opposite of the second one; these two are in counter-clockwise order in the image's u and v.
    """
    reach = np.linalg.norm(edge_steps, axis=2).min(axis=1)
    start = _refine_by_opencv(
        image, points, reach if arm_widths is None else reach * arm_widths.min(axis=1)
    )
    windows = cut_windows(
        image, start, edge_steps, MAX_REACH_PX, elliptical=False, arm_widths=arm_widths
    )
    if is_single_square:
        windows = windows.without_discs(start, ROUNDED_RADIUS_PX)
    start_values = _start_values(start - windows.centre, edge_steps)
    evaluate = partial(_evaluate, single_square=1.0 if is_single_square else 0.0)
    fits, is_good = fit_windows(
        evaluate,
        windows,
        start_values,
        position_indices=(0, 2),
        max_residual_ratio=MAX_RESIDUAL_RATIO,
    )
    corners, covariance, is_crossing = _crossings(fits, windows)
    corners += windows.centre
    distances = np.linalg.norm(corners - start, axis=1)
    is_good &= is_crossing & (distances < np.clip(0.5 * reach, 0.75, 3.0))
    if is_single_square:
        is_good &= reach > 1.5 * ROUNDED_RADIUS_PX
    start[is_good] = corners[is_good]
    covariance[~is_good] = UNREFINED_SIGMA_PX**2 * np.eye(2)
    return Corners(start, covariance, fits.values[:, GAIN], is_good)


def _refine_by_opencv(image: GreyImage, points: Array, reach: Array) -> Array:
    """Refine points by OpenCV's ``cornerSubPix``, with a window that fits the smallest squares."""
    cv2 = load("cv2")
    half_window = int(np.clip(0.8 * reach.min(), 2, 5))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-2)
    corners = points.astype(np.float32).reshape(-1, 1, 2)
    corners = cv2.cornerSubPix(
        image.uint8_levels, corners, (half_window, half_window), (-1, -1), criteria
    )
    refined: Array = np.array(corners, dtype=np.float64).reshape(-1, 2)
    return refined


def _start_values(points: Array, edge_steps: Array) -> Array:
    """Return the start values (N, 7) of a fit: those of edges along the given steps."""
    values = np.zeros((len(points), 7))
    # an edge along (x, y) has the normal (-y, x), and its points fulfil cos(angle) u + sin(angle) v
    # = distance
    angles = np.arctan2(edge_steps[:, :, 0], -edge_steps[:, :, 1])
    values[:, ANGLES] = angles
    values[:, EDGE_DISTANCES] = np.cos(angles) * points[:, :1] + np.sin(angles) * points[:, 1:]
    return values


def _evaluate(windows: Windows, values: Array, single_square: float = 0.0) -> Fits:
    """Return the fits of four squares, or with ``single_square`` = 1 of a single one.

    The levels of a single square are ``offset + gain * ((1 + E1) * (1 + E2) / 2 - 1)``, those of
    four ``offset + gain * E1 * E2``.
    """
    x, y, weights = windows.x, windows.y, windows.weights
    values32 = values.astype(np.float32)
    blur, gain, offset = (values32[:, [column]] for column in (BLUR, GAIN, OFFSET))
    cosines, sines = np.cos(values32[:, ANGLES]), np.sin(values32[:, ANGLES])
    edge_distances = values32[:, EDGE_DISTANCES]
    scale = 1 / (np.sqrt(np.float32(2)) * blur)
    signed_distances, positions, shapes, slopes = [], [], [], []
    # d = cos(a) x + sin(a) y - distance changes by -1 with the edge's distance, and with a by
    # cos(a) y - sin(a) x, the position along the edge. The level gain E(d1 / s) E(d2 / s) + offset,
    # E = erf, moves with d1 by gain E'(d1 / s) E(d2 / s) / s, and with the blur, to which s is in
    # proportion, by -gain (E'_1 d1 / s E_2 + E'_2 d2 / s E_1) / blur.
    for side in (0, 1):
        cosine, sine, edge_distance = (part[:, [side]] for part in (cosines, sines, edge_distances))
        signed_distances.append((cosine * x + sine * y - edge_distance) * scale)
        positions.append(cosine * y - sine * x)
        shape, slope = edge_profile(signed_distances[side])
        shapes.append(shape)
        slopes.append(slope)
    product_factor = np.float32(1 - single_square / 2)
    one_side, other_side = (
        product_factor * (np.float32(single_square) + shape) * weights for shape in shapes
    )
    first_slope = slopes[0] * other_side
    second_slope = slopes[1] * one_side
    product = (np.float32(single_square) + shapes[0]) * other_side - np.float32(
        single_square
    ) * weights
    columns = (
        first_slope,
        first_slope * positions[0],
        second_slope,
        second_slope * positions[1],
        first_slope * signed_distances[0] + second_slope * signed_distances[1],
        product,
        weights,
    )
    gain_scale, ones = gain * scale, np.ones_like(gain)
    factors = (-gain_scale, gain_scale, -gain_scale, gain_scale, -gain / blur, ones, ones)
    return make_fits(values, columns, factors, windows.levels - gain * product - offset * weights)


def _crossings(fits: Fits, windows: Windows) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the crossings of the edges, their covariances, and a mask of those that cross."""
    # N p = q with the normals as rows of N: p = N^-1 q, and dp = N^-1 (dq - dN p); a normal turned
    # by da moves by da along its edge, so dN p is da times the way along it.
    edge_distances, angles = fits.values[:, EDGE_DISTANCES], fits.values[:, ANGLES]
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=2)
    is_crossing = np.abs(np.linalg.det(normals)) > MIN_SINE
    normals[~is_crossing] = np.eye(2)
    inverse = np.linalg.inv(normals)
    corners: Array = (inverse @ edge_distances[:, :, None])[:, :, 0]
    positions = normals[:, :, 0] * corners[:, 1:] - normals[:, :, 1] * corners[:, :1]
    derivatives = np.zeros((len(corners), 2, fits.values.shape[1]))
    derivatives[:, :, EDGE_DISTANCES] = inverse
    derivatives[:, :, ANGLES] = -inverse * positions[:, None]
    covariance: Array = (
        derivatives @ covariances(fits, windows.counts) @ derivatives.transpose(0, 2, 1)
    )
    return corners, covariance, is_crossing
