"""A camera's intrinsic parameters ("lens"), which map directions to pixels and back.

The camera's frame is that of OpenCV and ROS' optical frames: x to the right of the image, y down,
z forward. The middle of the upper left pixel has the coordinates (0, 0).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeAlias

import numpy as np

from smartcam._extras import load
from smartcam.geometry._checks import check_choice, check_size
from smartcam.geometry._codes import Code
from smartcam.geometry._rotations import Array, as_points
from smartcam.geometry._stored import Matrix3, Number, Size, Stored, rows

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

DistortionModel: TypeAlias = Literal["plumb_bob", "rational_polynomial", "equidistant"]
"""Distortion models, by their names in ROS' ``camera_info``."""

COEFFICIENT_NAMES: dict[DistortionModel, tuple[str, ...]] = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}
"""Names of each model's coefficients, in order. In ``equidistant`` they are factors of powers of
the angle to the optical axis."""

COEFFICIENT_COUNTS: dict[DistortionModel, int] = {
    model: len(names) for model, names in COEFFICIENT_NAMES.items()
}


def coefficient_names(model: DistortionModel) -> tuple[str, ...]:
    """Return the names of a model's coefficients; raise SHAPE if there is no such model."""
    check_choice(model, list(COEFFICIENT_NAMES), "distortion model")
    return COEFFICIENT_NAMES[model]


def _as_coefficients(values: ArrayLike) -> Array:
    """Return coefficients from a row or a column as a copy (K,); raise SHAPE or NOT_FINITE."""
    try:
        coefficients = np.reshape(values, (-1, 1))
    except (TypeError, ValueError, ArithmeticError) as exc:
        raise Code.SHAPE.error(
            f"distortion: expected numbers of shape (K,): {exc!s:.200}", "(K,)"
        ) from exc
    return as_points(coefficients, 1, "distortion")[:, 0].copy()


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraModel(Stored):
    """A camera's lens, as :func:`~smartcam.calibration.calibrate_intrinsics` finds it.

    Attributes:
        size: width and height of the camera's images, pixels.
        matrix: (3, 3), focal lengths and principal point, pixels; rows and columns of pixels are at
            right angles.
        distortion: (K,), as many coefficients as the distortion model has.
        distortion_model: name of the distortion model.
    """

    _label: ClassVar[str] = "calibration of cameras"

    size: Size
    matrix: Matrix3
    distortion: Annotated[Array, rows(Number)] = field(default_factory=lambda: np.zeros(5))
    distortion_model: DistortionModel = "plumb_bob"

    def __post_init__(self) -> None:
        check_size(self.size, "camera")
        matrix = as_points(self.matrix, 3, "camera matrix").copy()
        count = len(coefficient_names(self.distortion_model))
        distortion = _as_coefficients(self.distortion)
        if len(distortion) != count:
            raise Code.SHAPE.error_with_value(
                f"{self.distortion_model}: expected {count} coefficients", count, len(distortion)
            )
        has_form = matrix.shape == (3, 3) and not (matrix[[0, 1, 2, 2], [1, 0, 0, 1]]).any()
        if not (has_form and matrix[0, 0] > 0 and matrix[1, 1] > 0 and matrix[2, 2] == 1):
            raise Code.SHAPE.error_with_value(
                "camera matrix: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal "
                "lengths and no skew",
                "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
                matrix.tolist(),
            )
        for name, value in (("matrix", matrix), ("distortion", distortion)):
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @property
    def field_of_view(self) -> tuple[float, float]:
        """Horizontal and vertical angle of view without distortion, radians."""
        width, height = self.size
        return (
            2 * math.atan(width / 2 / self.matrix[0, 0]),
            2 * math.atan(height / 2 / self.matrix[1, 1]),
        )

    def project(self, points: ArrayLike) -> Array:
        """Project points of the camera's frame into the image.

        Args:
            points: (N, 3), metres, in front of the camera.

        Returns:
            (N, 2), pixels; NaN for points behind the camera.

        Raises:
            CalibrationError: SHAPE or NOT_FINITE.
        """
        camera_points = as_points(points, 3, "points in front of the camera")
        if not len(camera_points):
            return np.zeros((0, 2))
        cv2 = load("cv2")
        # u = fx x'' + cx, v = fy y'' + cy of the distorted direction. With x = X/Z, y = Y/Z and
        # r^2 = x^2 + y^2:
        #     x'' = x g + 2 p1 x y + p2 (r^2 + 2 x^2),  y'' = y g + p1 (r^2 + 2 y^2) + 2 p2 x y,
        #     g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6);
        # equidistant, with a = atan(r): (x'', y'') = (x, y) a (1 + k1 a^2 + ... + k4 a^8) / r.
        # Source: Brown, Decentering Distortion of Lenses (1966); Kannala and Brandt, A Generic
        # Camera Model (2006); OpenCV's documentation of calib3d and of its fisheye part.
        source = camera_points.reshape(-1, 1, 3)
        zero = np.zeros(3)
        if self.distortion_model == "equidistant":
            projected, _ = cv2.fisheye.projectPoints(
                source, zero, zero, self.matrix, self.distortion
            )
        else:
            projected, _ = cv2.projectPoints(source, zero, zero, self.matrix, self.distortion)
        pixels: Array = np.array(projected, dtype=np.float64).reshape(-1, 2)
        pixels[camera_points[:, 2] <= 0] = np.nan
        return pixels

    def directions(self, pixels: ArrayLike) -> Array:
        """Return the directions x/z and y/z of the rays through pixels, corrected for distortion.

        Args:
            pixels: (N, 2).

        Returns:
            (N, 2), x and y where the rays meet the plane z = 1 of the camera's frame.

        Raises:
            CalibrationError: SHAPE or NOT_FINITE.
        """
        image_points = as_points(pixels, 2, "pixels")
        if not len(image_points):
            return np.zeros((0, 2))
        cv2 = load("cv2")
        source = image_points.reshape(-1, 1, 2)
        if self.distortion_model == "equidistant":
            rays: Any = cv2.fisheye.undistortPoints(source, self.matrix, self.distortion)
        else:
            # no closed form: x = (x'' - tangential(x)) / g(x) is iterated from x = x''
            # it stops after 100 steps, or when a step is below 1e-12 of the focal length
            stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
            rays = cv2.undistortPointsIter(
                source, self.matrix, self.distortion, np.eye(3), np.eye(3), stop
            )
        directions: Array = np.array(rays, dtype=np.float64).reshape(-1, 2)
        return directions

    def undistort(self, pixels: ArrayLike) -> Array:
        """Return pixels (N, 2) without the lens' distortion, (N, 2)."""
        rays = self.directions(pixels)
        undistorted: Array = rays @ self.matrix[:2, :2].T + self.matrix[:2, 2]
        return undistorted
