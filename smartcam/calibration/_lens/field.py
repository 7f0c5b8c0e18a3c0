"""Compute how errors of a lens move points in the image, without the part that poses compensate.

Two calibrations of one lens may differ without disagreeing: if the principal point of one is off,
the camera seems turned by as much, and every pose that is found with that lens is turned equally.
So the small motion of the camera that fits an error over the field best is subtracted from the
error. The points to which this motion is fitted can be chosen: best are the target's points where
the calibration saw them. Points that are much nearer or farther than these are then less certain. A
program that finds the camera's pose at one distance and uses it at another has the same
uncertainty.

Source: the idea is mrcal's (D. Kogan), which calls that motion the implied transformation; the
formulas here are written anew.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._lens.projection import linearize, pixels_by_pose
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array

DEFAULT_MAP_SHAPE: Final = (25, 33)
"""Rows and columns of a map: odd numbers, so that the map has a middle."""

MAX_MAP_SIDE: Final = 500
"""A map has at most this many rows, and as many columns."""

MAX_ROUND_TRIP_PX: Final = 1e-3
"""A pixel is in the model's range if its direction, projected again, differs from the pixel by less
than this."""

MIN_MOTION_PLACES: Final = 6
"""A motion is fitted to at least this many places; three determine it."""


class Sensitivity(NamedTuple):
    """The derivatives of projected points (N) by a lens' values and by the camera's motion."""

    by_lens: Array  # (N, 2, 4 + K), derivatives by the values of the lens
    by_motion: Array  # (N, 2, 6), a turn and a shift; the latter is 0 for points at infinity
    # (N, 2, 3), derivatives by the point, pixels per metre; for directions pixels per radian
    by_point: Array

    def without_motion(self, alignment: Sensitivity) -> Array:
        """Return ``by_lens`` minus the camera motion that fits best at the alignment's points."""
        # Pixels move by B d with the lens and by A m with the motion: at the alignment points g,
        # m = -A_g^+ B_g d minimizes the squares, so B d + A m = (B - A A_g^+ B_g) d.
        count = self.by_lens.shape[2]
        motion = np.linalg.lstsq(
            alignment.by_motion.reshape(-1, 6), alignment.by_lens.reshape(-1, count), rcond=None
        )
        remaining: Array = self.by_lens - self.by_motion @ motion[0]
        return remaining


def check_distance(distance: float | None) -> None:
    """Raise ``NOT_FINITE`` for a distance that is not valid; None means infinity."""
    if distance is not None and not (math.isfinite(distance) and distance > 0.0):
        raise Code.NOT_FINITE.error_with_value(
            "distance: expected a positive number of metres, or None for infinity",
            "a positive number",
            distance,
        )


def map_pixels(size: tuple[int, int], shape: tuple[int, int]) -> Array:
    """Return the pixels of a map that reaches from corner to corner, (rows, columns, 2).

    Raises ``SHAPE`` if there are fewer than 2 rows or columns, or more than 500.
    """
    if len(shape) != 2 or not all(2 <= side <= MAX_MAP_SIDE for side in shape):
        raise Code.SHAPE.error_with_value(
            f"shape of a map: expected rows and columns, each from 2 to {MAX_MAP_SIDE}",
            (2, MAX_MAP_SIDE),
            shape,
        )
    rows, columns = (
        np.linspace(0.0, side - 1.0, count) for side, count in zip(size[::-1], shape, strict=True)
    )
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def points_of_pixels(camera: CameraModel, pixels: Array, distance: float | None) -> Array:
    """Return the points (N, 3) at a distance that pixels (N, 2) show, or directions for None.

    NaN where no direction leads to the pixel: the model of a lens may not reach the image's
    corners, and the iteration that inverts the model then ends at another pixel.
    """
    directions = np.column_stack([camera.directions(pixels), np.ones(len(pixels))])
    directions[~np.isfinite(directions).all(axis=1)] = [0.0, 0.0, 1.0]
    distances = np.linalg.norm(camera.project(directions) - pixels, axis=1)
    points: Array = (
        directions / np.linalg.norm(directions, axis=1, keepdims=True) * (distance or 1.0)
    )
    points[~(distances < MAX_ROUND_TRIP_PX)] = np.nan
    return points


def sensitivity(camera: CameraModel, points: Array, *, at_infinity: bool = False) -> Sensitivity:
    """Return the derivatives of the pixels of points (N, 3); NaN where a point is NaN.

    ``at_infinity``: the points, in the camera's frame, are directions to points at infinity.
    """
    finite = np.isfinite(points).all(axis=1, keepdims=True)
    safe_points = np.where(finite, points, [0.0, 0.0, 1.0])
    projection = linearize(safe_points, camera)
    motion = pixels_by_pose(projection.by_point, safe_points)
    if at_infinity:
        motion[:, :, 3:] = 0.0
    missing = np.where(finite, 0.0, np.nan)[:, :, None]
    return Sensitivity(
        projection.by_lens + missing, motion + missing, projection.by_point + missing
    )


def finite_points(points: Array) -> Array:
    """Return the points (N, 3) that are not NaN; raise ``OUT_OF_FIELD`` if there are too few."""
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) < MIN_MOTION_PLACES:
        raise Code.OUT_OF_FIELD.error(
            f"field of the lens: expected {MIN_MOTION_PLACES} places or more that its model "
            f"reaches, got {len(finite)} of {len(points)}",
            MIN_MOTION_PLACES,
            len(finite),
        )
    return finite
