"""Map a camera's pixels to places on a sheet that the camera sees, in metres.

With a lens, pixels are corrected for its distortion, and their rays are intersected with the plane
in which the target was located. Without a lens, a homography is fitted to all points of the target:
it is right for any tilt, but does not correct distortion: the error that remains is smallest
between the points, and larger outside of them.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration._homography import (
    apply_homography,
    derivatives,
    element_derivatives,
    fit_homography,
)
from smartcam.calibration._least_squares import diagonal_scale, inverse_scaled
from smartcam.calibration._lens.poses import check_view, locate
from smartcam.calibration._lens.projection import excess_variance, whitening
from smartcam.calibration._solvers import Poses
from smartcam.geometry._inside import (
    Code,
    as_points,
    check_finite,
    cross_matrix,
    not_finite_error,
    quaternion_about_z,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from smartcam.calibration._views import TargetView
    from smartcam.exceptions import CalibrationError
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array

MAX_STEPS = 20
"""The fit of the homography takes at most this many steps; it usually takes 2 or 3."""

MAX_FINAL_STEP_SIGMAS = 1e-6
"""The fit ends when a step changes each element of the homography by less than this fraction of its
standard deviation (the others being fixed); the next step would be a million times smaller."""

DIRECTION_STEP_PX = 0.5
"""A direction on the sheet is computed from points this many pixels ahead and behind."""


class SheetPlane:
    """A solver from a camera's pixels to a sheet's metres.

    Poses must be those of localizations with the y axis up: x is u, y is -v, and angles
    count counter-clockwise. The results are in the target's frame, on its plane.

    Args:
        size: width and height of the camera's images, pixels.
        matrix: (3, 3), ``w (p, 1) = matrix (x, y, 1)`` from the sheet, metres, to pixels or, with a
            lens, to directions (x/z, y/z) of the camera's frame; ``w`` is positive for points in
            front of the camera.
        covariance: (9, 9), of the matrix' elements, row by row.
        camera: the lens; None: pixels are taken as they are.

    Raises:
        CalibrationError: NOT_FINITE: a matrix that cannot be inverted.
    """

    def __init__(
        self,
        size: tuple[int, int],
        matrix: ArrayLike,
        covariance: ArrayLike,
        camera: CameraModel | None = None,
    ) -> None:
        self.size: tuple[int, int] = size
        self.matrix: Array = np.array(matrix, dtype=np.float64).reshape(3, 3)
        self.covariance: Array = np.array(covariance, dtype=np.float64).reshape(9, 9)
        self.camera: CameraModel | None = camera
        self._inverse_matrix = _invert_matrix(self.matrix)

    def on_sheet(self, pixels: ArrayLike) -> Array:
        """Map pixels (N, 2), v down, to the sheet (N, 2), metres.

        Raises:
            CalibrationError: SHAPE or NOT_FINITE; OUT_OF_FIELD: outside of the image, or behind the
                sheet's horizon.
        """
        pixel_array = self._check_pixels(pixels)
        return self._map_to_sheet(self._undistort(pixel_array), pixel_array)

    def in_image(self, points: ArrayLike) -> Array:
        """Map points (N, 2) of the sheet, metres, to pixels (N, 2), v down.

        NaN for points behind the camera.
        """
        sheet_points = as_points(points, 2, "points of the sheet")
        homogeneous = sheet_points @ self.matrix[:, :2].T + self.matrix[:, 2]
        if self.camera is not None:
            return self.camera.project(homogeneous)
        homogeneous[homogeneous[:, 2] <= 0] = np.nan
        pixels: Array = homogeneous[:, :2] / homogeneous[:, 2:]
        return pixels

    def covariance_at(self, pixels: ArrayLike) -> Array:
        """Return the covariance (N, 2, 2) of :meth:`on_sheet`, m^2, that the view's noise causes.

        Raises:
            CalibrationError: as :meth:`on_sheet`.
        """
        by_elements = self.element_slopes(self.on_sheet(pixels))
        covariance: Array = by_elements @ self.covariance @ by_elements.swapaxes(1, 2)
        return covariance

    def element_slopes(self, sheet_points: Array) -> Array:
        """Return the derivatives (N, 2, 9) of points (N, 2) of the sheet by the matrix' elements.

        Each pixel stays fixed.
        """
        # The pixel does not change: 0 = D dx + E dm, with the derivatives D by the point and E by
        # the elements, so dx = -D^-1 E dm.
        by_elements = element_derivatives(self.matrix, sheet_points)
        slopes = np.linalg.solve(derivatives(self.matrix, sheet_points), by_elements)
        return np.asarray(-slopes, dtype=np.float64)

    def on_sheet_unchecked(self, pixels: Array) -> Array:
        """Map pixels (N, 2), v down, as :meth:`on_sheet`, but also pixels outside of the image."""
        return self._map_to_sheet(self._undistort(pixels), pixels)

    def solve(self, poses: Poses) -> Poses:
        """Return the poses on the sheet.

        Raises:
            CalibrationError: OUT_OF_PLANE: a pose has a height or a tilt; and those of
                :meth:`on_sheet`.
        """
        x, y, z, w = poses.quaternions.T
        if poses.points[:, 2].any() or x.any() or y.any():
            raise Code.OUT_OF_PLANE.error(
                "sheet: expected poses in the image, turned about its z only, got some with a "
                "height or a tilt"
            )
        pixels = self._check_pixels(poses.points[:, :2] * [1.0, -1.0])
        headings = np.column_stack([w * w - z * z, -2.0 * z * w])
        points, ends, starts = (
            self._map_to_sheet(self._undistort(shifted_pixels), shifted_pixels)
            for shifted_pixels in (
                pixels,
                pixels + DIRECTION_STEP_PX * headings,
                pixels - DIRECTION_STEP_PX * headings,
            )
        )
        directions = ends - starts
        return Poses(
            np.column_stack([points, np.zeros(len(points))]),
            quaternion_about_z(np.arctan2(directions[:, 1], directions[:, 0])),
        )

    def _check_pixels(self, pixels: ArrayLike) -> Array:
        pixel_array = as_points(pixels, 2, "pixels")
        width, height = self.size
        is_outside = (
            (pixel_array < -DIRECTION_STEP_PX)
            | (pixel_array > [width - DIRECTION_STEP_PX, height - DIRECTION_STEP_PX])
        ).any(axis=1)
        if is_outside.any():
            pixel = pixel_array[int(np.argmax(is_outside))].tolist()
            raise Code.OUT_OF_FIELD.error_with_value(
                f"sheet: expected pixels of an image of {width} x {height}, v down",
                self.size,
                pixel,
            )
        return pixel_array

    def _undistort(self, pixels: Array) -> Array:
        return pixels if self.camera is None else self.camera.directions(pixels)

    def _map_to_sheet(self, undistorted: Array, pixels: Array) -> Array:
        homogeneous = undistorted @ self._inverse_matrix[:, :2].T + self._inverse_matrix[:, 2]
        if not (homogeneous[:, 2] > 0).all():
            pixel = pixels[int(np.argmin(homogeneous[:, 2]))].tolist()
            raise Code.OUT_OF_FIELD.error(
                f"sheet: expected pixels that show its plane, got {pixel}: behind its horizon",
                got=pixel,
            )
        with np.errstate(all="ignore"):
            points: Array = homogeneous[:, :2] / homogeneous[:, 2:]
        check_finite(points, "sheet: points")
        return points


def _invert_matrix(matrix: Array) -> Array:
    try:
        inverse = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    except np.linalg.LinAlgError as exc:
        raise not_finite_error("sheet's matrix", matrix.tolist()) from exc
    check_finite(inverse, "sheet's matrix")
    return inverse


class PlaneView(NamedTuple):
    """The result of :func:`fit_sheet_view`."""

    plane: SheetPlane
    # standard deviation of a coordinate of the target's points from their predicted places, pixels
    rms: float
    # part of ``rms`` that the noise of the view's points does not explain, pixels; 0 if it does
    unexplained: float


def fit_sheet_view(view: TargetView, camera: CameraModel | None = None) -> PlaneView:
    """Fit the map from pixels to the sheet that a view shows.

    ``view`` has at least 4 points of the target that are not on a line; without a lens (``camera``,
    for images of the same size) at least 5, so that the fit of the homography can be checked.
    Raises as :func:`~smartcam.calibration.locate`.
    """
    check_view(view, view.size if camera is None else camera.size)
    sheet_points = view.object_points[:, :2]
    start = fit_homography(sheet_points, view.points)
    if start is None or not math.isfinite(float(np.abs(start).sum())):
        raise _no_fit_error(view)
    if camera is None:
        return _fit_without_lens(view, start)
    pose = locate(view, camera)
    extra_variance = excess_variance(pose.residuals, view.covariance, 2 * len(sheet_points) - 6)
    rotation, shift = pose.transform.rotation, pose.transform.translation
    first, second = rotation[:, 0], rotation[:, 1]
    # The matrix is (r1 r2 t) of T_camera_target. Its columns move with the pose's turn q by
    # q x r = -[r]x q, and with its shift by d.
    by_pose = np.zeros((3, 3, 6))  # derivatives of rows, columns of the matrix, by turn and shift
    by_pose[:, 0, :3], by_pose[:, 1, :3] = -cross_matrix(first), -cross_matrix(second)
    by_pose[:, 2, 3:] = np.eye(3)
    by_pose_rows = by_pose.reshape(9, 6)
    matrix = np.column_stack([first, second, shift])
    return PlaneView(
        SheetPlane(view.size, matrix, by_pose_rows @ pose.covariance @ by_pose_rows.T, camera),
        pose.rms,
        math.sqrt(extra_variance),
    )


def _fit_without_lens(view: TargetView, start: Array) -> PlaneView:
    """Return the map by the most likely homography to a view's pixels."""
    sheet_points, pixels = view.object_points[:, :2], view.points
    freedom = 2 * len(sheet_points) - 8
    if freedom <= 0:
        raise Code.TOO_FEW.error_with_value(
            "sheet: expected 5 points or more without a lens", 5, len(sheet_points)
        )
    normalizing = _normalizing_matrix(sheet_points)
    source = apply_homography(normalizing, sheet_points)
    start_matrix = start @ np.linalg.inv(normalizing)
    matrix, covariance = _fit_homography(
        start_matrix / start_matrix[2, 2], source, pixels, view.covariance
    )
    residuals = pixels - apply_homography(matrix, source)
    extra_variance = excess_variance(residuals, view.covariance, freedom)
    if extra_variance:
        noise = view.covariance + extra_variance * np.eye(2)
        matrix, covariance = _fit_homography(matrix, source, pixels, noise)
        residuals = pixels - apply_homography(matrix, source)
    # Row by row the elements of M T are (I x T^T) times those of M (Kronecker's product).
    to_original = np.kron(np.eye(3), normalizing.T)
    plane = SheetPlane(view.size, matrix @ normalizing, to_original @ covariance @ to_original.T)
    rms = math.sqrt(float((residuals**2).sum()) / freedom)
    return PlaneView(plane, rms, math.sqrt(extra_variance))


def _fit_homography(
    matrix: Array, source: Array, pixels: Array, noise: Array
) -> tuple[Array, Array]:
    """Return the homography and the covariance of its elements (9, 9); the last element is 1."""
    # Gauss and Newton's steps, two or three from the linear solution. With 54 points they take 1.8
    # ms, SciPy's least_squares takes 2.2 ms (measured) and as many lines of code.
    weights, normal = whitening(noise, 0.0), np.eye(8)
    for _ in range(MAX_STEPS):
        residuals = weights @ (pixels - apply_homography(matrix, source))[..., None]
        jacobian = (weights @ element_derivatives(matrix, source)[..., :8]).reshape(-1, 8)
        normal = jacobian.T @ jacobian
        step = np.linalg.solve(normal, jacobian.T @ residuals.ravel())
        matrix = matrix + np.append(step, 0.0).reshape(3, 3)
        if (np.abs(step) * diagonal_scale(normal)).max() < MAX_FINAL_STEP_SIGMAS:
            break
    covariance = np.zeros((9, 9))
    covariance[:8, :8] = inverse_scaled(normal)
    return matrix, covariance


def _normalizing_matrix(points: Array) -> Array:
    """Return the matrix (3, 3) that centres points, and scales them to distances of about 1."""
    # With the sheet's centre at the origin, the last element is the depth there, which is not 0, so
    # it can be set to 1; and the equations are well conditioned. Source: Hartley and Zisserman,
    # Multiple View Geometry, 2nd edition, section 4.4.4.
    centre = points.mean(axis=0)
    factor = 1.0 / math.sqrt(float(((points - centre) ** 2).sum(axis=1).mean()))
    return np.array([[factor, 0, -factor * centre[0]], [0, factor, -factor * centre[1]], [0, 0, 1]])


def _no_fit_error(view: TargetView) -> CalibrationError:
    return Code.POOR_FIT.error(
        f"sheet: expected a plane in front of the camera that fits the {len(view.ids)} points of "
        "the view, got none",
        "a plane in front of the camera",
    )
