"""Rectify the frames of a calibrated pair of cameras, and convert disparities to metres."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._argument_checks import check_arguments
from smartcam._arguments import check_path
from smartcam._extras import load
from smartcam.calibration._inside import MAX_CAMERA_FILE_BYTES, parse_camera_info, rectify
from smartcam.calibration.formats import CameraChain
from smartcam.exceptions import CalibrationError, ConfigurationError, FrameFormatError
from smartcam.geometry import CameraModel, Transform
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

    from smartcam.calibration import StereoCalibration

SIDES: Final = ("left", "right")

MAX_ASPECT_DEVIATION: Final = 0.01
"""Largest relative deviation of a picture's aspect ratio from the calibrated one."""

MAX_ROTATION_ERROR: Final = 1e-3
"""Largest error of an element of a rotation matrix: ROS writes five digits."""

REMAP_VARIANCE_PX2: Final = (1 / 32) ** 2 / 12
"""Variance, pixels^2, that OpenCV's remap adds to a disparity, since it rounds to 1/32 pixel.

Both pictures are rounded; averaging over a window halves the sum of the two variances.
"""

MIN_AVERAGING_FACTOR: Final = 1.25
"""Reduction of size above which a picture is first reduced by averaging, since remap reads only
four pixels."""


@check_arguments(left=check_path, right=check_path)
def read_camera_infos(left: str | os.PathLike[str], right: str | os.PathLike[str]) -> CameraChain:
    """Read a pair from two ``camera_info`` files, as ROS' ``camera_calibration`` writes them.

    ``T_right_left`` is computed from ``rectification_matrix`` and ``projection_matrix``. Reading
    blocks.

    Raises:
        CalibrationError: ``MALFORMED``, ``NOT_FINITE`` or ``SHAPE``: a file is no ``camera_info``;
            ``NOT_RIGID``: a rectification is no rotation; ``SWAPPED_SIDES``: the second file is not
            from the right camera of a pair.
        MissingExtraError: PyYAML is not installed.
        OSError: one of the files cannot be read.
    """
    infos = [(parse_camera_info(_read_text(path)), path) for path in (left, right)]
    (first_info, _), (second_info, _) = infos
    shift = float(second_info.projection[0, 3] / second_info.projection[0, 0])
    if not shift < 0:
        raise CalibrationError(
            f"{right}: expected the camera_info of the right camera of a pair, with a "
            f"projection_matrix whose fourth column begins with minus focal length times baseline, "
            f"got {second_info.projection[0, 3]:g}",
            code=Code.SWAPPED_SIDES,
            got=float(second_info.projection[0, 3]),
        )
    # p_rectified = R1 p_left; the right rectified frame is shifted, so p_right = R2^T (R1 p_left +
    # shift)
    first, second = (_rotation(info.rectification, path) for info, path in infos)
    transform = Transform("right", "left", second.T @ first, second.T @ np.array([shift, 0, 0]))
    return CameraChain(
        cameras=(first_info.camera, second_info.camera),
        transforms=(transform,),
        names=("left", "right"),
    )


def _rotation(matrix: NDArray[np.float64], path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Return the rotation nearest to a matrix that was written with five digits."""
    u, _, v = np.linalg.svd(matrix)
    rotation = np.asarray(u @ v)
    if np.linalg.det(rotation) < 0 or np.abs(rotation - matrix).max() > MAX_ROTATION_ERROR:
        raise CalibrationError(
            f"{path}: rectification_matrix: expected a rotation, got {matrix.tolist()}",
            code=Code.NOT_RIGID,
            got=matrix.tolist(),
        )
    return rotation


def _read_text(path: str | os.PathLike[str]) -> str:
    with Path(path).open("rb") as file:
        content = file.read(MAX_CAMERA_FILE_BYTES + 1)
    if len(content) > MAX_CAMERA_FILE_BYTES:
        raise CalibrationError(
            f"{path}: expected a camera_info of {MAX_CAMERA_FILE_BYTES} bytes at most",
            code=Code.MALFORMED,
        )
    try:
        return content.decode()
    except UnicodeDecodeError as exc:
        raise CalibrationError(f"{path}: expected text: {exc}", code=Code.MALFORMED) from exc


def scale_camera(camera: CameraModel, size: tuple[int, int]) -> CameraModel:
    """Return the lens for a scaled picture."""
    # the first pixel's middle is at 0, its corner at -1/2; the corner does not move
    across, down = size[0] / camera.size[0], size[1] / camera.size[1]
    matrix = camera.matrix.copy()
    matrix[0] = [across * matrix[0, 0], 0, across * (matrix[0, 2] + 0.5) - 0.5]
    matrix[1] = [0, down * matrix[1, 1], down * (matrix[1, 2] + 0.5) - 0.5]
    return CameraModel(
        size=size,
        matrix=matrix,
        distortion=camera.distortion,
        distortion_model=camera.distortion_model,
    )


class CalibratedPair:
    """A calibration of a pair, prepared for pictures of one size.

    All methods block: call them in a thread.

    Raises ConfigurationError: the cameras are not side by side; CalibrationError: as
    :meth:`StereoCalibration.rectify`.
    """

    def __init__(
        self,
        calibration: StereoCalibration | CameraChain,
        *,
        size: tuple[int, int] | None,
        alpha: float,
        focal_sigma: float,
    ) -> None:
        lenses, transform, covariance = _split_calibration(calibration)
        self._shapes = tuple(lens.size for lens in lenses)
        picture_size = lenses[0].size if size is None else size
        left, right = (scale_camera(lens, picture_size) for lens in lenses)
        rectification = rectify(left, right, transform, alpha=alpha)
        self.size = rectification.size
        projection = rectification.projections[1]
        self.focal = float(projection[0, 0])
        self.baseline = -float(projection[0, 3]) / self.focal
        if not self.baseline > 0:
            where = "right of the right one" if projection[0, 3] else "above or below it"
            raise ConfigurationError(
                f"stereo: expected a left camera that is left of the right one, got one {where}: "
                "swap the two, or turn both by a quarter"
            )
        self.camera_info = CameraModel(
            size=rectification.size, matrix=rectification.projections[0][:, :3]
        )
        self._focal_sigma = focal_sigma * picture_size[0] / lenses[0].size[0]
        self._covariance_root = _covariance_root(rectification.rotations[1], covariance)
        self._maps, self._masks = rectification.maps, rectification.masks
        self.rotation: NDArray[np.float64] = rectification.rotations[0]
        self._cached_maps: list[tuple[tuple[int, int], Any]] = [((0, 0), None)] * 2

    def rectify(self, picture: NDArray[Any], side: int, source: str) -> NDArray[Any]:
        """Return the rectified picture, (H, W) or (H, W, C); 0 outside of the given picture.

        Raises FrameFormatError: the picture's aspect ratio is not the calibrated one.
        """
        cv2 = load("cv2")
        height, width = picture.shape[:2]
        shape = self._shapes[side]
        if abs(width * shape[1] / (height * shape[0]) - 1) > MAX_ASPECT_DEVIATION:
            raise FrameFormatError(
                f"{source}: expected a picture with the aspect ratio of {shape[0]}x{shape[1]}, "
                f"with which the {SIDES[side]} camera was calibrated, got {width}x{height}: cut, "
                "or of another mode of the sensor?",
                source=source,
            )
        if width > MIN_AVERAGING_FACTOR * self.size[0]:
            picture = cv2.resize(picture, self.size, interpolation=cv2.INTER_AREA)
            width, height = self.size
        maps_size, maps = self._cached_maps[side]
        if maps_size != (width, height):
            scale = np.array([width / self.size[0], height / self.size[1]], np.float32)
            float_maps = (self._maps[side] + np.float32(0.5)) * scale - np.float32(0.5)
            maps = cv2.convertMaps(float_maps, None, cv2.CV_16SC2)
            self._cached_maps[side] = ((width, height), maps)
        return np.asarray(cv2.remap(picture, *maps, cv2.INTER_LINEAR))

    def drop_outside(self, disparity: NDArray[np.float32]) -> None:
        """Set disparities to NaN where a rectified picture has no source."""
        first, second = self._masks
        if first.all() and second.all():
            return
        column = np.arange(self.size[0]) - np.nan_to_num(disparity)
        column = np.clip(np.round(column), 0, self.size[0] - 1).astype(np.intp)
        disparity[~(first & np.take_along_axis(second, column, axis=1))] = np.nan

    def to_depth(self, disparity: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return depths in metres (H, W), 0 where no disparity is above 0."""
        metres = np.zeros_like(disparity)
        np.divide(self.focal * self.baseline, disparity, out=metres, where=disparity > 0)
        return metres

    def depth_sigma(
        self, depth: NDArray[np.float32], disparity_sigma: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return the standard deviation of depths, metres; NaN where there is no depth."""
        # Z = f b / d, so sigma_Z = Z^2 / (f b) sigma_d; the calibration's error is added to the
        # variance of the disparity
        has_depth = depth > 0
        z = np.where(has_depth, depth, np.float32(1))
        variance = disparity_sigma.astype(np.float32) ** 2 + np.float32(REMAP_VARIANCE_PX2)
        if self._covariance_root is not None:
            variance += self._calibration_variance(z, self._covariance_root)
        sigma = z * z / np.float32(self.focal * self.baseline) * np.sqrt(variance)
        if self._focal_sigma:
            sigma = np.hypot(sigma, z * np.float32(self._focal_sigma / self.focal))
        return np.where(has_depth, sigma, np.float32(np.nan)).astype(np.float32)

    def _calibration_variance(
        self, z: NDArray[np.float32], covariance_root: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Return the variance of the disparity that follows from the transform's covariance."""
        # A point (X, Y, Z) is at P - (b, 0, 0) in the right rectified frame; a small turn w and
        # shift t of the left camera in it moves that by w x P + t, and its column by
        # f (dx / Z - x' dz / Z), with x' = (X - b) / Z: a row of the six unknowns' factors.
        f, (cx, cy) = np.float32(self.focal), self.camera_info.matrix[:2, 2]
        x = ((np.arange(self.size[0]) - cx) / self.focal).astype(np.float32)[None]
        y = ((np.arange(self.size[1]) - cy) / self.focal).astype(np.float32)[:, None]
        inverse_depth = 1 / z
        right_x = x - np.float32(self.baseline) * inverse_depth
        factors = (
            -right_x * y,
            1 + right_x * x,
            -y,
            inverse_depth,
            np.float32(0),
            -right_x * inverse_depth,
        )
        variance = np.zeros_like(z)
        for column in covariance_root.T:
            part = np.zeros_like(z)
            for factor, weight in zip(factors, column, strict=True):
                part += np.float32(weight) * factor
            variance += part * part
        return variance * f * f


def _split_calibration(
    calibration: StereoCalibration | CameraChain,
) -> tuple[tuple[CameraModel, CameraModel], Transform, NDArray[np.float64] | None]:
    """Return both lenses, ``T_right_left``, and its covariance; None: it is not known."""
    if not isinstance(calibration, CameraChain):
        return (
            (calibration.left, calibration.right),
            calibration.transform,
            calibration.covariance,
        )
    if len(calibration.cameras) != 2:
        raise ConfigurationError(
            f"stereo: expected the calibration of two cameras, got {len(calibration.cameras)}: "
            f"{', '.join(calibration.names)}"
        )
    left, right = calibration.cameras
    return (left, right), calibration.transforms[0], None


def _covariance_root(
    rotation: NDArray[np.float64], covariance: NDArray[np.float64] | None
) -> NDArray[np.float64] | None:
    """Return A (6, 6) with A A^T the covariance in the right rectified frame; None if unknown."""
    if covariance is None or not covariance.any():
        return None
    block_rotation = np.kron(np.eye(2), rotation)
    values, vectors = np.linalg.eigh(block_rotation @ covariance @ block_rotation.T)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))
