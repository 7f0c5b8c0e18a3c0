"""Compute the sigmas of poses in the robot's space, from those of the camera and calibration."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from smartcam.models import PoseSigma

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.geometry._inside import Array
    from smartcam.models import Localization

STEP_SHARE: Final = 1e-4
"""Length of the steps of numerical derivatives, as a fraction of the touched field."""


def robot_sigmas(
    localizations: list[Localization],
    transform: Callable[[Array], Array],
    normal: Array,
    jacobian: Callable[[Array], Array],
    covariance: Array,
    size: float,
    *,
    flip: bool,
) -> list[PoseSigma]:
    """Return the sigmas of poses in the robot's space.

    Args:
        localizations: localizations of the camera, whose poses have sigmas.
        transform: function that maps points of the camera (N, 2) to the robot's space.
        normal: the plane's normal (3,).
        jacobian: function that returns the derivatives (N, 3, K) of mapped points with respect to
            the calibration's parameters.
        covariance: covariance of these parameters, (K, K).
        size: size of the touched field, in the camera's unit.
        flip: whether the poses are turned about their x axis.
    """
    points = np.array([localization.pose.position[:2] for localization in localizations])
    angles = np.array([localization.pose.orientation.theta for localization in localizations])
    step = STEP_SHARE * size

    def points_ahead(points: Array, angles: Array) -> Array:
        return points + step * np.column_stack([np.cos(angles), np.sin(angles)])

    def mapped_headings(points: Array, angles: Array) -> Array:
        return transform(points_ahead(points, angles)) - transform(points)

    headings = mapped_headings(points, angles)
    lengths = np.linalg.norm(headings, axis=1)
    left_normals = np.cross(normal, headings) / lengths[:, None]

    def pose_change(shift: Array, heading_change: Array) -> Array:
        """Return the changes of x, y, z and the angle, (N, 4)."""
        angle = (left_normals * heading_change).sum(axis=1) / lengths
        return np.column_stack([shift, angle])

    columns = []
    for axis in np.eye(2):
        shifted = [points + sign * step * axis for sign in (1, -1)]
        position_change = (transform(shifted[0]) - transform(shifted[1])) / (2 * step)
        heading_change = (
            mapped_headings(shifted[0], angles) - mapped_headings(shifted[1], angles)
        ) / (2 * step)
        columns.append(pose_change(position_change, heading_change))
    heading_change = (
        mapped_headings(points, angles + STEP_SHARE) - mapped_headings(points, angles - STEP_SHARE)
    ) / (2 * STEP_SHARE)
    columns.append(pose_change(np.zeros_like(heading_change), heading_change))
    slopes = np.stack(columns, axis=2)
    covariances = np.array(
        [_pose_covariance(localization.pose.sigma) for localization in localizations]
    )
    rows_at_points, rows_ahead = jacobian(points), jacobian(points_ahead(points, angles))
    angle_rows = (
        np.einsum("ni,nik->nk", left_normals, rows_ahead - rows_at_points) / lengths[:, None]
    )
    rows = np.concatenate([rows_at_points, angle_rows[:, None]], axis=1)
    totals = slopes @ covariances @ slopes.swapaxes(1, 2) + rows @ covariance @ rows.swapaxes(1, 2)
    return [_pose_sigma(total, -1.0 if flip else 1.0) for total in totals]


def _pose_covariance(sigma: PoseSigma | None) -> Array:
    """Return the covariance (3, 3) of x, y and theta; NaN without a sigma."""
    if sigma is None:
        return np.full((3, 3), np.nan)
    xy, xt, yt = sigma.correlation_xy, sigma.correlation_xt, sigma.correlation_yt
    unit = np.array([[1, xy, xt], [xy, 1, yt], [xt, yt, 1]])
    sigmas = np.array(sigma[:3])
    covariance: Array = unit * np.outer(sigmas, sigmas)
    return covariance


def _pose_sigma(covariance: Array, sign: float) -> PoseSigma:
    """Return the sigmas of a covariance (4, 4) of x, y, z and theta; ``sign`` -1 negates theta."""
    x, y, z, theta = np.sqrt(np.diag(covariance).clip(0)).tolist()

    def correlation(first: int, second: int) -> float:
        size = math.sqrt(float(covariance[first, first] * covariance[second, second]))
        return float(np.clip(covariance[first, second] / size, -1, 1)) if size > 0 else 0.0

    return PoseSigma(
        x, y, theta, correlation(0, 1), sign * correlation(0, 3), sign * correlation(1, 3), z
    )
