"""Map the uncertainty of a calibrated lens' projection over its field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration._lens.field import (
    DEFAULT_MAP_SHAPE,
    check_distance,
    finite_points,
    map_pixels,
    points_of_pixels,
    sensitivity,
)

if TYPE_CHECKING:
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array


class MapFigures(NamedTuple):
    """Four numbers that sum up a map, as the RMS of a coordinate.

    A number is NaN if the lens' model reaches none of its pixels.

    Attributes:
        centre: value at the centre of the image.
        corners: RMS of the four corners, or of those that the model reaches.
        worst: largest value.
        rms: RMS over the field.
    """

    centre: float
    corners: float
    worst: float
    rms: float


@dataclass(frozen=True, kw_only=True, eq=False)
class ProjectionUncertainty:
    """The uncertainty with which a lens projects a fixed point of the world.

    Attributes:
        size: width and height of the images, pixels.
        distance: distance of the points from the camera, metres; None: infinity.
        pixels: (h, w, 2), places of the map.
        covariance: (h, w, 2, 2), of the projection of a point whose true pixel is that place,
            pixels^2; NaN where no direction leads to the pixel.
        by_point: (h, w, 2, 3), derivative of the pixel by the point, in pixels per metre along the
            axes of the camera's frame; at infinity per radian.
    """

    size: tuple[int, int]
    distance: float | None
    pixels: Array
    covariance: Array
    by_point: Array

    @property
    def sigma(self) -> Array:
        """Standard deviation of a coordinate, (h, w), pixels."""
        sigma: Array = np.sqrt(np.trace(self.covariance, axis1=2, axis2=3) / 2)
        return sigma

    @property
    def across(self) -> Array:
        """Standard deviation across the line of sight, at ``distance``, (h, w), metres.

        For points at infinity it is an angle, radians.
        """
        # A pixel's derivative by the point, J (2, 3), is 0 along the ray, so J^+ gives the least
        # shift, which is across it.
        inverse = np.full_like(self.by_point.swapaxes(2, 3), np.nan)
        finite = np.isfinite(self.by_point).all(axis=(2, 3))
        inverse[finite] = np.linalg.pinv(self.by_point[finite])
        shifts = inverse @ self.covariance @ inverse.swapaxes(2, 3)
        across: Array = np.sqrt(np.trace(shifts, axis1=2, axis2=3) / 2)
        return across

    @property
    def figures(self) -> MapFigures:
        """Four numbers that sum up ``sigma``, pixels."""
        return figures(self.sigma)


def figures(sigma: Array) -> MapFigures:
    """Sum up a map (h, w) of standard deviations, or of lengths, by four numbers."""
    rows, columns = sigma.shape
    corners = sigma[[0, 0, -1, -1], [0, -1, 0, -1]]
    finite = sigma[np.isfinite(sigma)]
    return MapFigures(
        float(sigma[rows // 2, columns // 2]),
        _rms(corners[np.isfinite(corners)]),
        float(finite.max()) if len(finite) else math.nan,
        _rms(finite),
    )


def _rms(values: Array) -> float:
    return math.sqrt(float((values**2).mean())) if len(values) else math.nan


def uncertainty(
    camera: CameraModel,
    covariance: Array,
    alignment_points: Array,
    *,
    distance: float | None = None,
    shape: tuple[int, int] = DEFAULT_MAP_SHAPE,
) -> ProjectionUncertainty:
    """Return the map of a lens' uncertainty, from the covariance of the lens' values.

    ``alignment_points``: (N, 3), points in the camera's frame; a change of the lens that a motion
    of the camera explains at them is left out. Other arguments and errors: as in
    :meth:`~smartcam.calibration.IntrinsicCalibration.uncertainty`.
    """
    check_distance(distance)
    pixels = map_pixels(camera.size, shape)
    points = points_of_pixels(camera, pixels.reshape(-1, 2), distance)
    field = sensitivity(camera, points, at_infinity=distance is None)
    by_lens = field.without_motion(sensitivity(camera, finite_points(alignment_points)))
    return ProjectionUncertainty(
        size=camera.size,
        distance=distance,
        pixels=pixels,
        covariance=(by_lens @ covariance @ by_lens.swapaxes(1, 2)).reshape(*shape, 2, 2),
        by_point=field.by_point.reshape(*shape, 2, 3),
    )
