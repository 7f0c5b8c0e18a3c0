"""Convert a plane calibration to a rigid frame and a scale, for programs that know only frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.geometry import Transform
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from smartcam.calibration._plane.calibration import PlaneCalibration

_MAX_SIMILAR_DEVIATION = 1e-9
"""Largest deviation of two axes from equal length and a right angle, by rounding."""


class PlaneFrame(NamedTuple):
    """A frame in the camera's plane.

    Attributes:
        transform: ``T_robot_plane``: the plane's origin is the camera's (0, 0), its x and y are the
            camera's, its z is the plane's normal.
        scale: metres per unit of the camera's coordinates. Multiply coordinates by it, then apply
            the transform: ``transform.apply(scale * (u, v, 0))``.
    """

    transform: Transform
    scale: float


def plane_frame(calibration: PlaneCalibration, *, name: str = "plane") -> PlaneFrame:
    """Return the frame of a calibration's plane, and its scale.

    Args:
        calibration: a calibration of the model ``rigid``, ``similarity`` or ``touches``.
        name: name of the plane's frame, used if the calibration has no ``camera_frame``.

    Raises:
        CalibrationError: ``NOT_SIMILAR``: the model is ``affine`` or ``homography``, which is no
            frame: its axes differ in scale, or its scale differs from point to point.
    """
    matrix = calibration.matrix / calibration.matrix[3, 2]
    axes = matrix[:3, :2]
    inner = axes.T @ axes
    square = 0.5 * float(np.trace(inner))
    shear = float(np.abs(inner - square * np.eye(2)).max()) / square
    bend = float(np.abs(matrix[3, :2]).max()) * calibration.normalization.camera_size
    if max(shear, bend) > _MAX_SIMILAR_DEVIATION:
        raise Code.NOT_SIMILAR.error(
            f"{calibration.model}: expected one scale for the whole plane, got axes that differ by "
            f"{shear:.2g} and a scale that changes by {bend:.2g} over the points: a rigid frame "
            "cannot express this; export the matrix, or fit a similarity",
            "similarity",
            calibration.model,
        )
    source = calibration.camera_frame or name
    transform = Transform(calibration.robot_frame, source, calibration.rotation, calibration.origin)
    return PlaneFrame(transform, calibration.scale)
