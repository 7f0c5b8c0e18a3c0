"""Whether points can give a calibration at all, before a number is made of them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration._codes import Code
from smartcam.calibration._geometry.rotations import as_points
from smartcam.calibration._plane.fitting import Normalization, Pairs
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from smartcam.calibration._geometry.rotations import Array

LEAST_LEVER = 20.0
"""Extent of the touched points across their longest direction, in sigmas of a touch."""

LEAST_WIDTH = 0.1
"""Extent across over extent along the longest direction; both rms.

Three points whose legs are 10 degrees apart have 0.15.
"""

MOST_THICKNESS = 0.2
"""Extent out of the plane over extent across the longest direction, both rms."""

SAME = 1e-9
"""Of the points' extent: what is closer together counts as the same."""

SMALLEST = 1e-100
"""Difference of two coordinates below which they are the same: the square of it is a number."""


def read_pairs(
    camera_points: ArrayLike, robot_points: ArrayLike, weights: ArrayLike | None
) -> tuple[Array, Array, Array]:
    """Return camera points (N, 2), robot points (N, 3) and weights (N,), copied.

    Raises SHAPE or NOT_FINITE.
    """
    camera = as_points(camera_points, 2, "camera points").copy()
    robot = as_points(robot_points, 3, "robot points").copy()
    if len(camera) != len(robot):
        raise CalibrationError(
            f"expected as many robot points as camera points ({len(camera)}), got {len(robot)}",
            code=Code.SHAPE,
            expected=len(camera),
            got=len(robot),
        )
    if weights is None:
        return camera, robot, np.ones(len(camera))
    given = as_points(np.reshape(weights, (-1, 1)), 1, "weights")[:, 0].copy()
    if given.shape != (len(camera),) or (given <= 0).any():
        raise CalibrationError(
            f"weights: expected {len(camera)} positive numbers, got {given.tolist()[:8]}",
            code=Code.SHAPE,
            expected=len(camera),
            got=given.tolist(),
        )
    return camera, robot, given


def check_positive(value: float | None, name: str, unit: str) -> None:
    """Raise (NOT_FINITE) where an option is neither None nor a positive number."""
    if value is not None and not (math.isfinite(value) and value > 0):
        raise CalibrationError(
            f"{name}: expected a positive number of {unit}, got {value}",
            code=Code.NOT_FINITE,
            expected="a positive number",
            got=value,
        )


def check_samples(camera: Array, robot: Array, least: int, touch_sigma: float | None) -> None:
    """Raise where points do not determine a plane and a map onto it.

    ``camera`` (N, 2); ``robot`` (N, 3), metres; ``least`` points are needed by the model;
    ``touch_sigma``: of one coordinate, metres; None where it is not known. TOO_FEW, COINCIDENT,
    COLLINEAR, NOT_PLANAR or SHORT_LEVER.
    """
    if len(camera) < least:
        raise CalibrationError(
            f"expected at least {least} points, got {len(camera)}",
            code=Code.TOO_FEW,
            expected=least,
            got=len(camera),
        )
    for points, what in ((camera, "camera points"), (robot, "robot points")):
        _check_distinct(points, what, least)
        _check_width(points, what)
    extents = _extents(robot)
    if extents[2] > MOST_THICKNESS * extents[1]:
        raise CalibrationError(
            f"robot points: expected a plane, got {1e3 * extents[2]:.3g} mm rms out of it and "
            f"{1e3 * extents[1]:.3g} mm rms across",
            code=Code.NOT_PLANAR,
            expected=float(MOST_THICKNESS * extents[1]),
            got=float(extents[2]),
        )
    if touch_sigma is not None:
        check_lever(lever(robot), touch_sigma)


def lever(robot: Array) -> float:
    """Return the extent of touched points (N, 3) across their longest direction, metres."""
    return float(np.ptp(_turned(robot)[:, 1]))


def check_lever(found: float, touch_sigma: float) -> None:
    """Raise (SHORT_LEVER) where points lie too close together for how well they are touched.

    ``found``: how far they reach, metres. ``touch_sigma``: of one coordinate, metres.
    """
    if found < LEAST_LEVER * touch_sigma:
        raise CalibrationError(
            f"robot points: expected at least {LEAST_LEVER:g} sigmas of a touch "
            f"({1e3 * LEAST_LEVER * touch_sigma:.3g} mm) in each direction, "
            f"got {1e3 * found:.3g} mm: they lie too close together, or are in another unit",
            code=Code.SHORT_LEVER,
            expected=LEAST_LEVER * touch_sigma,
            got=found,
        )


def normalize(camera: Array, robot: Array, weights: Array) -> tuple[Normalization, Pairs]:
    """Return the points as the fit wants them, and where they were."""
    camera_centre, robot_centre = camera.mean(axis=0), robot.mean(axis=0)
    near, far = camera - camera_centre, robot - robot_centre
    camera_size = math.sqrt(float((near**2).sum(axis=1).mean()))
    robot_size = math.sqrt(float((far**2).sum(axis=1).mean()))
    frame = Normalization(camera_centre, camera_size, robot_centre, robot_size)
    return frame, Pairs(near / camera_size, far / robot_size, weights)


def _turned(points: Array) -> Array:
    """Return points along their own axes, the longest first."""
    centred = points - points.mean(axis=0)
    turned: Array = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
    return turned


def _extents(points: Array) -> Array:
    """Return the rms extents along the points' own axes, the longest first."""
    centred = points - points.mean(axis=0)
    singular = np.asarray(np.linalg.svd(centred, compute_uv=False), dtype=np.float64)
    return singular / math.sqrt(len(points))


def _check_distinct(points: Array, what: str, least: int) -> None:
    extent = float(np.ptp(points, axis=0).max())
    rounding = np.finfo(np.float64).eps * float(np.abs(points).max())
    grain = max(SAME * extent, 4.0 * rounding, SMALLEST)
    distinct = len(np.unique(np.round((points - points[0]) / grain), axis=0))
    if distinct < least:
        raise CalibrationError(
            f"{what}: expected at least {least} different ones, got {distinct}",
            code=Code.COINCIDENT,
            expected=least,
            got=distinct,
        )


def _check_width(points: Array, what: str) -> None:
    along, across = _extents(points)[:2]
    if across < LEAST_WIDTH * along:
        raise CalibrationError(
            f"{what}: expected an extent across of at least {LEAST_WIDTH:g} of that along, "
            f"got {across / along:.2g}: they lie nearly in a line",
            code=Code.COLLINEAR,
            expected=LEAST_WIDTH,
            got=float(across / along),
        )
