"""Project points with derivatives, and divide residuals by their noise; all fits use this.

A pose is a rotation R (3, 3) and a translation t (3,) that lead from the target to the camera. Its
six small changes are a turn w and a shift d in the camera's frame: R becomes exp([w]x) R, and t
becomes t + d.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.calibration._statistics import Noise

if TYPE_CHECKING:
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array

MIN_SIGMA_PX = 1e-4
"""Least standard deviation that is assumed, pixels, so that views without noise have finite
weights."""

SIGNIFICANCE_LEVEL = 0.01
"""Residuals count as larger than the points' covariance says if noise alone causes them with less
than this probability."""


MAX_DEGREE = 5
"""Smooth errors of a lens are approximated by polynomials of the place in the image, up to this
degree."""

SMOOTH_TERM_COUNT = (MAX_DEGREE + 1) * (MAX_DEGREE + 2)
"""Number of terms of these polynomials, for both coordinates."""


class Projection(NamedTuple):
    """Projected points, with their derivatives."""

    pixels: Array  # (N, 2), pixels; NaN for points behind the camera
    by_point: Array  # (N, 2, 3), derivative by the point in the camera's frame, pixels per metre
    by_lens: Array  # (N, 2, 4 + K), derivative by fx, fy, cx, cy and the K coefficients


def linearize(points: Array, camera: CameraModel) -> Projection:
    """Project points (N, 3) of the camera's frame, with derivatives."""
    cv2, zero = load("cv2"), np.zeros(3)
    source = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 1, 3)
    count = len(camera.distortion)
    if not len(source):
        return Projection(np.zeros((0, 2)), np.zeros((0, 2, 3)), np.zeros((0, 2, 4 + count)))
    if camera.distortion_model == "equidistant":
        projected, jacobian = cv2.fisheye.projectPoints(
            source, zero, zero, camera.matrix, camera.distortion
        )
        # columns: f 2, c 2, k 4, rotation 3, translation 3, skew 1
        jacobian = jacobian.reshape(-1, 2, 15)
        by_lens, by_point = jacobian[..., :8], jacobian[..., 11:14]
    else:
        projected, jacobian = cv2.projectPoints(
            source, zero, zero, camera.matrix, camera.distortion
        )
        # columns: rotation 3, translation 3, f 2, c 2, k
        jacobian = jacobian.reshape(-1, 2, 10 + count)
        by_point, by_lens = jacobian[..., 3:6], jacobian[..., 6:]
    pixels = np.array(projected, dtype=np.float64).reshape(-1, 2)
    pixels[source[:, 0, 2] <= 0] = np.nan
    return Projection(pixels, by_point, by_lens)


def pixels_by_pose(by_point: Array, turned_points: Array) -> Array:
    """Return the derivatives of pixels with respect to the six steps of a pose (N, 2, 6).

    ``by_point`` (N, 2, 3): derivatives by the points in the camera's frame. ``turned_points`` (N,
    3): R @ points, without the translation.
    """
    # p = R m + t becomes exp([w]x) R m + t + d, to first order p + w x (R m) + d. So a pixel's
    # derivative by d is that by p, g, and by w it is (R m) x g, since g (w x q) = w (q x g).
    x, y, z = turned_points.T[:, :, None]
    by_x, by_y, by_z = np.moveaxis(by_point, 2, 0)
    by_turn = (y * by_z - z * by_y, z * by_x - x * by_z, x * by_y - y * by_x)
    changes: Array = np.stack([*by_turn, by_x, by_y, by_z], axis=2)
    return changes


def pixels_by_smooth_errors(pixels: Array, size: tuple[int, int]) -> Array:
    """Return the derivatives (N, 2, T) of pixels (N, 2) by T coefficients of smooth lens errors."""
    x, y = (2.0 * pixels / max(size) - np.array(size) / max(size)).T
    powers = [x**i * y**j for i in range(MAX_DEGREE + 1) for j in range(MAX_DEGREE + 1 - i)]
    changes = np.kron(np.eye(2), np.stack(powers, axis=1)[:, None])
    return np.asarray(changes, dtype=np.float64)


def whitening(covariance: Array, extra_variance: float) -> Array:
    """Return matrices (N, 2, 2) that make residuals independent, of variance 1.

    ``covariance`` (N, 2, 2) is that of the residuals; ``extra_variance`` is a variance that is
    added to each coordinate, pixels^2.
    """
    # With C^-1 = L L^T (Cholesky) the residuals L^T r have the covariance L^T C L = I, and their
    # squares add up to r^T C^-1 r.
    total = covariance + max(extra_variance, MIN_SIGMA_PX**2) * np.eye(2)
    matrices = np.linalg.cholesky(np.linalg.inv(total)).swapaxes(1, 2)
    return np.asarray(matrices, dtype=np.float64)


def excess_variance(residuals: Array, covariance: Array, freedom: int) -> float:
    """Return the variance of residuals, pixels^2, that their covariance does not explain.

    Added to each coordinate, it makes the sum of the weighted squares equal to their degrees of
    freedom. It is 0 if chance makes residuals this large in 1 of 100 cases or more. ``residuals``
    are (N, 2), pixels, ``covariance`` is (N, 2, 2), and ``freedom`` is the number of coordinates
    minus that of fitted parameters; with 0 or less the result is 0.
    """
    # Along each point's principal axes: find s^2 with sum e_j^2 / (l_j + s^2) = freedom. The sum
    # falls with s^2, so there is one root at most, which is not above sum e_j^2 / freedom.
    # Source: Paule and Mandel, Consensus Values and Weighting Factors (1982).
    values, vectors = np.linalg.eigh(covariance)
    squared = np.einsum("nij,ni->nj", vectors, residuals) ** 2
    values = np.maximum(values, 0.0) + MIN_SIGMA_PX**2

    def excess_squares(variance: float) -> float:
        return float((squared / (values + variance)).sum()) - freedom

    if freedom <= 0 or not np.isfinite(squared).all():
        return 0.0
    if Noise(1.0).chance(excess_squares(0.0) + freedom, freedom) >= SIGNIFICANCE_LEVEL:
        return 0.0
    largest = float(squared.sum()) / freedom
    return float(load("scipy.optimize").brentq(excess_squares, 0.0, largest, xtol=1e-16))
