"""Points that two cameras see, in space."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration.lens.projection import linearize, whitening
from smartcam.calibration.optional_imports import load

if TYPE_CHECKING:
    from smartcam.calibration.geometry.frames import Transform
    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.lens.model import CameraModel

__all__ = ["Triangulated", "epipolar_distances", "triangulate"]

STEPS = 10
"""From the linear solution to the least reprojection error; two or three are enough."""

SETTLED = 1e-9
"""Part of its depth that a point still moves in the last step."""


class Triangulated(NamedTuple):
    """Points and how sure they are.

    Attributes:
        points: (N, 3), left camera's frame, metres; NaN where the rays do not meet before both
            cameras.
        covariance: (N, 3, 3), m^2.
    """

    points: Array
    covariance: Array


def triangulate(
    left: CameraModel,
    right: CameraModel,
    transform: Transform,
    pixels: tuple[Array, Array],
    covariance: tuple[Array, Array],
) -> Triangulated:
    """Return the points whose projections are nearest to what both cameras see.

    Nearest is the least sum of squares in both images, weighted by the covariance of the pixels:
    for normal noise no unbiased estimate has a smaller variance.

    Args:
        left: its lens.
        right: its lens.
        transform: ``T_right_left``.
        pixels: (N, 2) each, left and right.
        covariance: (N, 2, 2) each.
    """
    points = _linear(left, right, transform, pixels)
    points[~(points[:, 2] > 0)] = np.nan
    white = [whitening(one, 0.0) for one in covariance]
    normal = np.full((len(points), 3, 3), np.nan)
    for _ in range(STEPS):
        normal, step = _step(left, right, transform, pixels, white, points)
        points = points + step
        with np.errstate(invalid="ignore"):
            moved = np.linalg.norm(step, axis=1) > SETTLED * np.abs(points[:, 2])
        if not moved.any():
            break
    behind = ~((points[:, 2] > 0) & (transform.apply(points)[:, 2] > 0))
    points[behind] = np.nan
    points[~np.isfinite(points).all(axis=1)] = np.nan  # none of them is infinite
    inverse = np.full_like(normal, np.nan)
    inverse[~behind] = np.linalg.pinv(normal[~behind], hermitian=True)
    return Triangulated(points, inverse)


def _linear(
    left: CameraModel, right: CameraModel, transform: Transform, pixels: tuple[Array, Array]
) -> Array:
    """Return the points by the direct linear transform of the rays (N, 3)."""
    if not len(pixels[0]):
        return np.zeros((0, 3))
    first, second = left.directions(pixels[0]), right.directions(pixels[1])
    matrix = np.column_stack([transform.rotation, transform.translation])
    found = load("cv2").triangulatePoints(np.eye(3, 4), matrix, first.T, second.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        points: Array = np.asarray(found[:3] / found[3], dtype=np.float64).T
    points[~np.isfinite(points).all(axis=1)] = np.nan
    return points


def _step(
    left: CameraModel,
    right: CameraModel,
    transform: Transform,
    pixels: tuple[Array, Array],
    white: list[Array],
    points: Array,
) -> tuple[Array, Array]:
    """Return the normal matrices (N, 3, 3) and Gauss and Newton's step (N, 3)."""
    one, two = linearize(points, left), linearize(transform.apply(points), right)
    rows = [white[0] @ one.by_point, white[1] @ two.by_point @ transform.rotation]
    off = [
        white[0] @ (pixels[0] - one.pixels)[..., None],
        white[1] @ (pixels[1] - two.pixels)[..., None],
    ]
    jacobian, residuals = np.concatenate(rows, axis=1), np.concatenate(off, axis=1)
    normal = jacobian.swapaxes(1, 2) @ jacobian
    right_side = jacobian.swapaxes(1, 2) @ residuals
    known = np.isfinite(normal).all(axis=(1, 2)) & np.isfinite(right_side).all(axis=(1, 2))
    step = np.full((len(points), 3), np.nan)
    inverse = np.linalg.pinv(normal[known], hermitian=True)
    step[known] = (inverse @ right_side[known])[..., 0]
    return normal, step


def epipolar_distances(
    left: CameraModel, right: CameraModel, transform: Transform, pixels: tuple[Array, Array]
) -> Array:
    """Return how far undistorted pixels are from the other camera's rays through their partners.

    Args:
        left: its lens.
        right: its lens.
        transform: ``T_right_left``.
        pixels: (N, 2) each, left and right.

    Returns:
        (N, 2): in the left image and in the right one, pixels.
    """
    x, y, z = transform.translation
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    seen = [
        np.column_stack([camera.undistort(some), np.ones(len(some))])
        for camera, some in zip((left, right), pixels, strict=True)
    ]
    matrix = np.linalg.inv(right.matrix).T @ cross @ transform.rotation @ np.linalg.inv(left.matrix)
    lines = [seen[1] @ matrix, seen[0] @ matrix.T]
    products = np.abs((seen[1] * lines[1]).sum(axis=1))
    distances = [products / np.linalg.norm(one[:, :2], axis=1) for one in lines]
    return np.column_stack(distances)
