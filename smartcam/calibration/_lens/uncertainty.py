"""Map the uncertainty of a calibrated lens' projection over its field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration._lens.field import (
    SHAPE,
    check_distance,
    known_points,
    places,
    points_at,
    sensitivity,
)

if TYPE_CHECKING:
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array


class MapFigures(NamedTuple):
    """A map in four numbers, of a coordinate; NaN where the lens' model does not reach.

    Attributes:
        centre: value in the middle of the image.
        corners: the mean of the four corners (root of the mean square), or of those of them that
            the model reaches.
        worst: the largest.
        mean: over the field (root of the mean square).
    """

    centre: float
    corners: float
    worst: float
    mean: float


@dataclass(frozen=True, kw_only=True, eq=False)
class ProjectionUncertainty:
    """The uncertainty with which a lens projects a fixed point of the world.

    Attributes:
        size: width and height of the images, pixels.
        distance: distance of the points from the camera, metres; None: infinity.
        pixels: (h, w, 2), the places.
        covariance: (h, w, 2, 2), of where a point is projected that is truly seen there, pixels^2;
            NaN where no direction leads to a pixel.
        by_point: (h, w, 2, 3), by how much a point's pixel moves with the point, pixels for each
            metre along the axes of the camera's frame; at infinity for each radian.
    """

    size: tuple[int, int]
    distance: float | None
    pixels: Array
    covariance: Array
    by_point: Array

    @property
    def sigma(self) -> Array:
        """(h, w), standard deviation of a coordinate, pixels."""
        sigma: Array = np.sqrt(np.trace(self.covariance, axis1=2, axis2=3) / 2)
        return sigma

    @property
    def across(self) -> Array:
        """(h, w), what ``sigma`` is at the distance, across the line of sight, metres.

        Of points at infinity it is the angle, radians.
        """
        # A pixel's derivative by the point, J (2, 3), is 0 along the ray, so J^+ gives the least
        # shift, which is across it.
        back = np.full_like(self.by_point.swapaxes(2, 3), np.nan)
        known = np.isfinite(self.by_point).all(axis=(2, 3))
        back[known] = np.linalg.pinv(self.by_point[known])
        shifts = back @ self.covariance @ back.swapaxes(2, 3)
        across: Array = np.sqrt(np.trace(shifts, axis1=2, axis2=3) / 2)
        return across

    @property
    def figures(self) -> MapFigures:
        """``sigma`` in four numbers, pixels."""
        return figures(self.sigma)


def figures(sigma: Array) -> MapFigures:
    """Return a map (h, w) of standard deviations, or lengths, in four numbers."""
    rows, columns = sigma.shape
    corners = sigma[[0, 0, -1, -1], [0, -1, 0, -1]]
    known = sigma[np.isfinite(sigma)]
    return MapFigures(
        float(sigma[rows // 2, columns // 2]),
        _mean(corners[np.isfinite(corners)]),
        float(known.max()) if len(known) else math.nan,
        _mean(known),
    )


def _mean(values: Array) -> float:
    return math.sqrt(float((values**2).mean())) if len(values) else math.nan


def uncertainty(
    camera: CameraModel,
    covariance: Array,
    gauge: Array,
    *,
    distance: float | None = None,
    shape: tuple[int, int] = SHAPE,
) -> ProjectionUncertainty:
    """Return the map of a lens whose values (fx, fy, cx, cy, coefficients) have a covariance.

    ``gauge``: (N, 3), the points before the camera that the motion is fitted to. The rest is as
    :meth:`~smartcam.calibration.IntrinsicCalibration.uncertainty` says, errors as well.
    """
    check_distance(distance)
    pixels = places(camera.size, shape)
    points = points_at(camera, pixels.reshape(-1, 2), distance)
    field = sensitivity(camera, points, far=distance is None)
    freed = field.freed(sensitivity(camera, known_points(gauge)))
    return ProjectionUncertainty(
        size=camera.size,
        distance=distance,
        pixels=pixels,
        covariance=(freed @ covariance @ freed.swapaxes(1, 2)).reshape(*shape, 2, 2),
        by_point=field.by_point.reshape(*shape, 2, 3),
    )
