"""Triangulate points that two cameras see."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.calibration._lens.projection import linearize, whitening
from smartcam.geometry._inside import cross_matrix

if TYPE_CHECKING:
    from smartcam.geometry import CameraModel, Transform
    from smartcam.geometry._inside import Array

MAX_STEPS = 10
"""Limit of the steps from the linear solution to the least reprojection error; two or three are
usually enough."""

MAX_FINAL_STEP_RATIO = 1e-9
"""The iteration ends when a step moves a point by less than this fraction of its depth."""


class CameraPair(NamedTuple):
    """Two cameras."""

    left: CameraModel  # lens of the left camera
    right: CameraModel  # lens of the right camera
    transform: Transform  # ``T_right_left``


class TriangulatedPoints(NamedTuple):
    """Triangulated points with their covariance."""

    # (N, 3), left camera's frame, metres; NaN where the rays do not meet in front of both cameras
    points: Array
    covariance: Array  # (N, 3, 3), m^2


def triangulate(
    pair: CameraPair, pixels: tuple[Array, Array], covariance: tuple[Array, Array]
) -> TriangulatedPoints:
    """Return the points whose projections are nearest to the given pixels.

    The sum of squares in both images, weighted by the covariance of the pixels, is minimized. For
    normal noise no unbiased estimate has a smaller variance. ``pixels`` (N, 2) and ``covariance``
    (N, 2, 2) are those of the left and of the right image.
    """
    points = _linear_solution(pair, pixels)
    points[~(points[:, 2] > 0)] = np.nan
    whiteners = [whitening(matrix, 0.0) for matrix in covariance]
    normal = np.full((len(points), 3, 3), np.nan)
    for _ in range(MAX_STEPS):
        normal, step = _step(pair, pixels, whiteners, points)
        points = points + step
        with np.errstate(invalid="ignore"):
            is_moving = np.linalg.norm(step, axis=1) > MAX_FINAL_STEP_RATIO * np.abs(points[:, 2])
        if not is_moving.any():
            break
    is_behind = ~((points[:, 2] > 0) & (pair.transform.apply(points)[:, 2] > 0))
    points[is_behind] = np.nan
    points[~np.isfinite(points).all(axis=1)] = np.nan  # a point without a solution
    # The covariance of least squares with residuals of variance 1 is (J^T J)^-1.
    # Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, section 5.2.
    inverse = np.full_like(normal, np.nan)
    inverse[~is_behind] = np.linalg.pinv(normal[~is_behind], hermitian=True)
    return TriangulatedPoints(points, inverse)


def _linear_solution(pair: CameraPair, pixels: tuple[Array, Array]) -> Array:
    """Return the points (N, 3) by the direct linear transform of the rays."""
    if not len(pixels[0]):
        return np.zeros((0, 3))
    # A ray (x, y) of the plane z = 1 gives two linear equations of the homogeneous point X with the
    # rows P_i of its camera's matrix: (x P_3 - P_1) X = 0 and (y P_3 - P_2) X = 0. Both cameras
    # give four, whose least singular vector is X. Left P = (I 0), right P = (R t).
    # Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, section 12.2.
    first, second = pair.left.directions(pixels[0]), pair.right.directions(pixels[1])
    matrix = np.column_stack([pair.transform.rotation, pair.transform.translation])
    homogeneous = load("cv2").triangulatePoints(np.eye(3, 4), matrix, first.T, second.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        points: Array = np.asarray(homogeneous[:3] / homogeneous[3], dtype=np.float64).T
    points[~np.isfinite(points).all(axis=1)] = np.nan
    return points


def _step(
    pair: CameraPair, pixels: tuple[Array, Array], whiteners: list[Array], points: Array
) -> tuple[Array, Array]:
    """Return the normal matrices (N, 3, 3) and Gauss and Newton's step (N, 3)."""
    # (J^T J) d = J^T r, where the right camera's rows of J have the chain rule's R of R X + t. All
    # points are solved at once: a thousand points take a few milliseconds.
    in_left = linearize(points, pair.left)
    in_right = linearize(pair.transform.apply(points), pair.right)
    jacobian_parts = [
        whiteners[0] @ in_left.by_point,
        whiteners[1] @ in_right.by_point @ pair.transform.rotation,
    ]
    residual_parts = [
        whiteners[0] @ (pixels[0] - in_left.pixels)[..., None],
        whiteners[1] @ (pixels[1] - in_right.pixels)[..., None],
    ]
    jacobian, residuals = (
        np.concatenate(jacobian_parts, axis=1),
        np.concatenate(residual_parts, axis=1),
    )
    normal = jacobian.swapaxes(1, 2) @ jacobian
    right_side = jacobian.swapaxes(1, 2) @ residuals
    finite = np.isfinite(normal).all(axis=(1, 2)) & np.isfinite(right_side).all(axis=(1, 2))
    step = np.full((len(points), 3), np.nan)
    inverse = np.linalg.pinv(normal[finite], hermitian=True)
    step[finite] = (inverse @ right_side[finite])[..., 0]
    return normal, step


def epipolar_distances(pair: CameraPair, pixels: tuple[Array, Array]) -> Array:
    """Return the distances of undistorted pixels from the epipolar lines of their partners.

    ``pixels`` (N, 2): those of the left and of the right image. The result (N, 2) has the distances
    in the left and in the right image, pixels.
    """
    # A point's two rays and the baseline lie in one plane: x2^T E x1 = 0 with E = [t]x R. In pixels
    # without distortion it is F = K2^-T E K1^-1; F x1 is the line of x1's partner in the right
    # image, F^T x2 that in the left one, and a point's distance from a line (a, b, c) is
    # |a u + b v + c| / sqrt(a^2 + b^2).
    # Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, sections 9.2 and 9.6.
    left, right, transform = pair
    essential = cross_matrix(transform.translation) @ transform.rotation
    homogeneous = [
        np.column_stack([camera.undistort(pixels_of_camera), np.ones(len(pixels_of_camera))])
        for camera, pixels_of_camera in zip((left, right), pixels, strict=True)
    ]
    matrix = np.linalg.inv(right.matrix).T @ essential @ np.linalg.inv(left.matrix)
    lines = [homogeneous[1] @ matrix, homogeneous[0] @ matrix.T]
    products = np.abs((homogeneous[1] * lines[1]).sum(axis=1))
    distances = [products / np.linalg.norm(line[:, :2], axis=1) for line in lines]
    return np.column_stack(distances)
