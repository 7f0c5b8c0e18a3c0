"""Check whether touched points determine a plane's calibration, before it is computed."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._arguments import as_plain_value, excerpt
from smartcam.calibration._plane.fitting import Normalization, Pairs
from smartcam.calibration._units import MAX_PLAUSIBLE_M
from smartcam.geometry._inside import Code, as_points

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from smartcam.geometry._inside import Array

MIN_EXTENT_IN_SIGMAS = 20.0
"""Least width of the touched points, at right angles to their longest direction, in sigmas."""

MIN_WIDTH_RATIO = 0.1
"""Least ratio of the width to the extent along the longest direction, both RMS.

Three points that form an angle of 10 degrees have 0.15.
"""

MAX_THICKNESS_RATIO = 0.2
"""Largest ratio of the extent out of the plane to the width, both RMS."""

SAME_MARK_RATIO = 0.01
"""Camera points with the same touch are taken as one mark if they are closer together than this
fraction of the extent of all points."""

SAME_POINT_RATIO = 1e-9
"""Points that are closer together than this fraction of the extent of all points count as the
same."""

MIN_DIFFERENCE = 1e-100
"""Two coordinates that differ by less than this are the same; its square does not underflow."""


def read_pairs(
    camera_points: ArrayLike, robot_points: ArrayLike, weights: ArrayLike | None
) -> tuple[Array, Array, Array]:
    """Return camera points (N, 2), robot points (N, 3) and weights (N,), copied.

    Raises SHAPE or NOT_FINITE.
    """
    camera = as_points(camera_points, 2, "camera points").copy()
    robot = as_points(robot_points, 3, "robot points").copy()
    if len(camera) != len(robot):
        raise Code.SHAPE.error_with_value(
            f"expected as many robot points as camera points ({len(camera)})",
            len(camera),
            len(robot),
        )
    if weights is None:
        return camera, robot, np.ones(len(camera))
    values = as_points(np.reshape(weights, (-1, 1)), 1, "weights")[:, 0].copy()
    if values.shape != (len(camera),) or (values <= 0).any():
        raise Code.SHAPE.error(
            f"weights: expected {len(camera)} positive numbers, got {values.tolist()[:8]}",
            len(camera),
            values.tolist(),
        )
    return camera, robot, values


class DistinctPoints(NamedTuple):
    """Points after merging repeated touches."""

    camera: Array  # (M, 2), camera's points
    robot: Array  # (M, 3), robot's points
    # (M,), largest weight of a point's touches: all touches share the error of their point
    weights: Array
    point_index: NDArray[np.intp]  # (N,), index of the distinct point of each given point
    first_index: NDArray[np.intp]  # (M,), index of the first given point of each distinct point


def merge_repeated(camera: Array, robot: Array, weights: Array) -> DistinctPoints:
    """Merge repeated points into their means.

    Repeated points are touches of the same camera point, or camera points with the same touch that
    are close together, which are pictures of one mark.
    """
    point_index = np.unique(camera, axis=0, return_inverse=True)[1].ravel()
    touch_index = np.unique(robot, axis=0, return_inverse=True)[1].ravel()
    if len(camera) in {point_index.max(initial=-1) + 1, 0} and touch_index.max(
        initial=-1
    ) + 1 == len(camera):
        indices = np.arange(len(camera), dtype=np.intp)
        return DistinctPoints(camera, robot, weights, indices, indices)
    tolerance = SAME_MARK_RATIO * float(np.linalg.norm(np.ptp(camera, axis=0)))
    for mark in np.flatnonzero(np.bincount(touch_index) > 1):
        same_touch = np.flatnonzero(touch_index == mark)
        if float(np.linalg.norm(np.ptp(camera[same_touch], axis=0))) < tolerance:
            point_index[np.isin(point_index, point_index[same_touch])] = point_index[same_touch[0]]
    first_index, point_index = np.unique(point_index, return_index=True, return_inverse=True)[1:]
    order = np.argsort(first_index)  # numbers in the order of the given points
    first_index, point_index = first_index[order], np.argsort(order)[point_index.ravel()]
    shares = weights / np.bincount(point_index, weights)[point_index]
    means = [
        np.column_stack([np.bincount(point_index, shares * axis) for axis in points.T]).astype(
            float
        )
        for points in (camera, robot)
    ]
    largest_weights = np.zeros(len(first_index))
    np.maximum.at(largest_weights, point_index, weights)
    return DistinctPoints(means[0], means[1], largest_weights, point_index, first_index)


def check_positive(value: float | None, name: str, unit: str) -> None:
    """Raise NOT_FINITE if an option is neither None nor a positive, finite number."""
    if value is None:
        return
    number: object = as_plain_value(value)
    is_number = isinstance(number, (int, float)) and not isinstance(number, bool)
    if not (is_number and 0 < value <= sys.float_info.max):
        raise Code.NOT_FINITE.error(
            f"{name}: expected a positive number of {unit}, got {excerpt(value)}",
            "a positive number",
            value,
        )


def check_samples(
    camera: Array,
    robot: Array,
    min_count: int,
    touch_sigma: float | None,
    *,
    allow_strays: bool = False,
) -> None:
    """Raise if points do not determine a plane and a map onto it.

    ``camera`` (N, 2); ``robot`` (N, 3), metres. ``min_count``: number of points that the model
    needs. ``touch_sigma``: standard deviation of one coordinate, metres; None: not known. Raises
    TOO_FEW, UNIT_UNKNOWN, COINCIDENT, COLLINEAR, NOT_PLANAR or SHORT_LEVER. ``allow_strays``:
    whether some touches may be far off, so that a large field does not prove that the units are
    wrong.
    """
    if len(camera) < min_count:
        raise Code.TOO_FEW.error_with_value(
            f"expected at least {min_count} points", min_count, len(camera)
        )
    if not allow_strays:
        check_extent(robot)
    for points, label in ((camera, "camera points"), (robot, "robot points")):
        _check_distinct(points, label, min_count)
        _check_width(points, label)
    extents = _extents(robot)
    if extents[2] > MAX_THICKNESS_RATIO * extents[1]:
        raise Code.NOT_PLANAR.error(
            f"robot points: expected a plane, got {1e3 * extents[2]:.3g} mm rms out of it and "
            f"{1e3 * extents[1]:.3g} mm rms across",
            float(MAX_THICKNESS_RATIO * extents[1]),
            float(extents[2]),
        )
    if touch_sigma is not None:
        check_lever(lever(robot), touch_sigma)


def check_extent(robot: Array) -> None:
    """Raise UNIT_UNKNOWN if touched points (N, 3) are farther apart than a robot's cell allows."""
    if (size := extent(robot)) > MAX_PLAUSIBLE_M:
        raise Code.UNIT_UNKNOWN.error(
            f"robot points: expected metres, and a field of {MAX_PLAUSIBLE_M:g} m at most, got one "
            f"of {size:.4g} m: are they millimetres? Multiply them by 0.001",
            MAX_PLAUSIBLE_M,
            size,
        )


def lever(robot: Array) -> float:
    """Return the extent of touched points (N, 3) at right angles to the longest one, metres."""
    return float(np.ptp(_in_principal_axes(robot)[:, 1]))


def extent(points: Array) -> float:
    """Return the diagonal of the field that touched points (N, 3) span, metres."""
    return float(np.linalg.norm(np.ptp(_in_principal_axes(points)[:, :2], axis=0)))


def check_lever(size: float, touch_sigma: float) -> None:
    """Raise SHORT_LEVER if points lie too close together for the error of the touches.

    ``size``: extent of the points, metres. ``touch_sigma``: that of one coordinate, metres.
    """
    if size < MIN_EXTENT_IN_SIGMAS * touch_sigma:
        raise Code.SHORT_LEVER.error(
            f"robot points: expected at least {MIN_EXTENT_IN_SIGMAS:g} sigmas of a touch "
            f"({1e3 * MIN_EXTENT_IN_SIGMAS * touch_sigma:.3g} mm) in each direction, "
            f"got {1e3 * size:.3g} mm: they lie too close together, or are in another unit",
            MIN_EXTENT_IN_SIGMAS * touch_sigma,
            size,
        )


def normalize(camera: Array, robot: Array, weights: Array) -> tuple[Normalization, Pairs]:
    """Return the points centred and scaled for the fit, and their centres and sizes."""
    camera_centre, robot_centre = camera.mean(axis=0), robot.mean(axis=0)
    camera_centred, robot_centred = camera - camera_centre, robot - robot_centre
    camera_size = math.sqrt(float((camera_centred**2).sum(axis=1).mean()))
    robot_size = math.sqrt(float((robot_centred**2).sum(axis=1).mean()))
    frame = Normalization(camera_centre, camera_size, robot_centre, robot_size)
    return frame, Pairs(camera_centred / camera_size, robot_centred / robot_size, weights)


def _in_principal_axes(points: Array) -> Array:
    """Return the coordinates of points along their principal axes, the longest first."""
    centred = points - points.mean(axis=0)
    rotated: Array = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
    return rotated


def _extents(points: Array) -> Array:
    """Return the RMS extents along the points' principal axes, the longest first."""
    centred = points - points.mean(axis=0)
    singular = np.asarray(np.linalg.svd(centred, compute_uv=False), dtype=np.float64)
    return singular / math.sqrt(len(points))


def _check_distinct(points: Array, label: str, min_count: int) -> None:
    extent = float(np.ptp(points, axis=0).max())
    rounding = np.finfo(np.float64).eps * float(np.abs(points).max())
    tolerance = max(SAME_POINT_RATIO * extent, 4.0 * rounding, MIN_DIFFERENCE)
    distinct_count = len(np.unique(np.round((points - points[0]) / tolerance), axis=0))
    if distinct_count < min_count:
        raise Code.COINCIDENT.error_with_value(
            f"{label}: expected at least {min_count} different ones", min_count, distinct_count
        )


def _check_width(points: Array, label: str) -> None:
    along, across = _extents(points)[:2]
    if across < MIN_WIDTH_RATIO * along:
        raise Code.COLLINEAR.error(
            f"{label}: expected an extent across of at least {MIN_WIDTH_RATIO:g} of that along, "
            f"got {across / along:.2g}: they lie nearly in a line",
            MIN_WIDTH_RATIO,
            float(across / along),
        )
