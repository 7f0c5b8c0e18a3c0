"""A camera's lens: from directions to pixels and back.

The camera's frame is that of OpenCV and ROS' optical frames: x to the right of the image, y down,
z forward. Pixels count from the middle of the upper left one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from smartcam.calibration.codes import Code
from smartcam.calibration.geometry.rotations import as_points
from smartcam.calibration.optional_imports import load
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from smartcam.calibration.geometry.rotations import Array

__all__ = ["CameraModel", "DistortionModel"]

DistortionModel: TypeAlias = Literal["plumb_bob", "rational_polynomial", "equidistant"]
"""Names of ROS' ``camera_info``."""

COEFFICIENTS: dict[DistortionModel, int] = {
    "plumb_bob": 5,
    "rational_polynomial": 8,
    "equidistant": 4,
}
"""k1, k2, p1, p2, k3 and k4, k5, k6; k1 to k4 of the angle for ``equidistant``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraModel:
    """What :func:`~smartcam.calibration.lens.intrinsics.calibrate_intrinsics` finds.

    Attributes:
        size: width and height of its images, pixels.
        matrix: (3, 3), focal lengths and principal point, pixels; rows and columns of pixels are at
            right angles.
        distortion: (K,), as many as its model has.
        distortion_model: which.
    """

    size: tuple[int, int]
    matrix: Array
    distortion: Array = field(default_factory=lambda: np.zeros(5))
    distortion_model: DistortionModel = "plumb_bob"

    def __post_init__(self) -> None:
        matrix = as_points(self.matrix, 3, "camera matrix").copy()
        count = COEFFICIENTS.get(self.distortion_model)
        if count is None:
            raise CalibrationError(
                f"distortion model: expected one of {list(COEFFICIENTS)}, "
                f"got {self.distortion_model!r}",
                code=Code.SHAPE,
                expected=list(COEFFICIENTS),
                got=self.distortion_model,
            )
        distortion = as_points(np.reshape(self.distortion, (-1, 1)), 1, "distortion")[:, 0].copy()
        if len(distortion) != count:
            raise CalibrationError(
                f"{self.distortion_model}: expected {count} coefficients, got {len(distortion)}",
                code=Code.SHAPE,
                expected=count,
                got=len(distortion),
            )
        plain = matrix.shape == (3, 3) and not (matrix[[0, 1, 2, 2], [1, 0, 0, 1]]).any()
        if not (plain and matrix[0, 0] > 0 and matrix[1, 1] > 0 and matrix[2, 2] == 1):
            raise CalibrationError(
                "camera matrix: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal "
                f"lengths and no skew, got {matrix.tolist()}",
                code=Code.SHAPE,
                expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
                got=matrix.tolist(),
            )
        for name, value in (("matrix", matrix), ("distortion", distortion)):
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @property
    def field_of_view(self) -> tuple[float, float]:
        """Angles that the image is wide and high without its distortion, radians."""
        width, height = self.size
        return (
            2 * math.atan(width / 2 / self.matrix[0, 0]),
            2 * math.atan(height / 2 / self.matrix[1, 1]),
        )

    def project(self, points: ArrayLike) -> Array:
        """Return where points of the camera's frame are in the image.

        Args:
            points: (N, 3), metres, before the camera.

        Returns:
            (N, 2), pixels; NaN for what lies behind the camera.

        Raises:
            CalibrationError: SHAPE or NOT_FINITE.
        """
        given = as_points(points, 3, "points before the camera")
        if not len(given):
            return np.zeros((0, 2))
        cv2 = load("cv2")
        source = given.reshape(-1, 1, 3)
        zero = np.zeros(3)
        if self.distortion_model == "equidistant":
            seen = cv2.fisheye.projectPoints(source, zero, zero, self.matrix, self.distortion)[0]
        else:
            seen = cv2.projectPoints(source, zero, zero, self.matrix, self.distortion)[0]
        pixels: Array = np.array(seen, dtype=np.float64).reshape(-1, 2)
        pixels[given[:, 2] <= 0] = np.nan
        return pixels

    def directions(self, pixels: ArrayLike) -> Array:
        """Return where the rays through pixels pass the plane z = 1 of the camera's frame.

        Args:
            pixels: (N, 2).

        Returns:
            (N, 2), x and y there: without the lens' distortion.

        Raises:
            CalibrationError: SHAPE or NOT_FINITE.
        """
        given = as_points(pixels, 2, "pixels")
        if not len(given):
            return np.zeros((0, 2))
        cv2 = load("cv2")
        source = given.reshape(-1, 1, 2)
        if self.distortion_model == "equidistant":
            rays: Any = cv2.fisheye.undistortPoints(source, self.matrix, self.distortion)
        else:
            # stop: 100 steps or 1e-12 of the focal length
            stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
            rays = cv2.undistortPointsIter(
                source, self.matrix, self.distortion, np.eye(3), np.eye(3), stop
            )
        directions: Array = np.array(rays, dtype=np.float64).reshape(-1, 2)
        return directions

    def undistort(self, pixels: ArrayLike) -> Array:
        """Return where pixels (N, 2) would be without the lens' distortion, (N, 2)."""
        rays = self.directions(pixels)
        straight: Array = rays @ self.matrix[:2, :2].T + self.matrix[:2, 2]
        return straight
