"""Compute the errors of poses in the robot's space, from those of camera and calibration."""

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
"""Length of the steps of numerical derivatives, as a part of the touched field."""


def robot_sigmas(
    seen: list[Localization],
    transform: Callable[[Array], Array],
    normal: Array,
    by_matrix: Callable[[Array], Array],
    covariance: Array,
    size: float,
    *,
    flip: bool,
) -> list[PoseSigma]:
    """Return the errors of poses in the robot's space.

    Args:
        seen: localizations of the camera, whose poses have sigmas.
        transform: function that maps points of the camera (N, 2) to the robot's space.
        normal: the plane's normal (3,).
        by_matrix: derivatives of mapped points by the calibration's parameters, (N, 3, K).
        covariance: covariance of these parameters, (K, K).
        size: size of the touched field, in the camera's unit.
        flip: whether the poses are turned about their x axis.
    """
    points = np.array([localization.pose.position[:2] for localization in seen])
    angles = np.array([localization.pose.orientation.theta for localization in seen])
    step = STEP_SHARE * size

    def ahead(at: Array, turn: Array) -> Array:
        return at + step * np.column_stack([np.cos(turn), np.sin(turn)])

    def directions(at: Array, turn: Array) -> Array:
        return transform(ahead(at, turn)) - transform(at)

    along = directions(points, angles)
    lengths = np.linalg.norm(along, axis=1)
    left = np.cross(normal, along) / lengths[:, None]

    def pose_change(off_place: Array, off_along: Array) -> Array:
        """Return the changes of x, y, z and the angle, (N, 4)."""
        angle = (left * off_along).sum(axis=1) / lengths
        return np.column_stack([off_place, angle])

    columns = []
    for axis in np.eye(2):
        ends = [points + sign * step * axis for sign in (1, -1)]
        place = (transform(ends[0]) - transform(ends[1])) / (2 * step)
        turned = (directions(ends[0], angles) - directions(ends[1], angles)) / (2 * step)
        columns.append(pose_change(place, turned))
    turned = (directions(points, angles + STEP_SHARE) - directions(points, angles - STEP_SHARE)) / (
        2 * STEP_SHARE
    )
    columns.append(pose_change(np.zeros_like(turned), turned))
    slopes = np.stack(columns, axis=2)
    covariances = np.array([_covariance(localization.pose.sigma) for localization in seen])
    at, front = by_matrix(points), by_matrix(ahead(points, angles))
    turns = np.einsum("ni,nik->nk", left, front - at) / lengths[:, None]
    rows = np.concatenate([at, turns[:, None]], axis=1)
    totals = slopes @ covariances @ slopes.swapaxes(1, 2) + rows @ covariance @ rows.swapaxes(1, 2)
    return [_sigma(total, -1.0 if flip else 1.0) for total in totals]


def _covariance(sigma: PoseSigma | None) -> Array:
    """Return the covariance (3, 3) of x, y and theta; NaN without a sigma."""
    if sigma is None:
        return np.full((3, 3), np.nan)
    xy, xt, yt = sigma.correlation_xy, sigma.correlation_xt, sigma.correlation_yt
    unit = np.array([[1, xy, xt], [xy, 1, yt], [xt, yt, 1]])
    sigmas = np.array(sigma[:3])
    covariance: Array = unit * np.outer(sigmas, sigmas)
    return covariance


def _sigma(covariance: Array, sign: float) -> PoseSigma:
    """Return the sigmas of a covariance (4, 4) of x, y, z and theta; ``sign`` is that of theta."""
    x, y, z, theta = np.sqrt(np.diag(covariance).clip(0)).tolist()

    def correlation(first: int, second: int) -> float:
        size = math.sqrt(float(covariance[first, first] * covariance[second, second]))
        return float(np.clip(covariance[first, second] / size, -1, 1)) if size > 0 else 0.0

    return PoseSigma(
        x, y, theta, correlation(0, 1), sign * correlation(0, 3), sign * correlation(1, 3), z
    )
