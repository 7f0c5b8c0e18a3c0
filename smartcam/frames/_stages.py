"""Correct frames by a calibration: remove a lens' distortion, rectify pairs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam._extras import load
from smartcam.exceptions import ConfigurationError, FrameFormatError
from smartcam.geometry import CameraModel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration._inside import Rectification
    from smartcam.frames._frame import Frame
    from smartcam.frames._group import FrameSet


class Undistorter:
    """Remove the distortion of a lens from pictures; the maps are computed once.

    Args:
        camera: model of the lens that took the pictures.
        alpha: part of the picture that is kept: 0: only valid pixels; 1: all source pixels.

    Attributes:
        camera: model of a lens without distortion that would take the corrected pictures.

    Raises:
        ConfigurationError: an alpha outside of 0 to 1.
        MissingExtraError: OpenCV (extra ``calibration``) is not installed.
    """

    def __init__(self, camera: CameraModel, *, alpha: float = 0.0) -> None:
        if not 0 <= alpha <= 1:
            raise ConfigurationError(f"undistort: alpha: expected 0 to 1, got {alpha!r}")
        cv2 = load("cv2")
        self._size = tuple(camera.size)
        lens, no_rotation = (camera.matrix, camera.distortion), np.eye(3)
        if camera.distortion_model == "equidistant":
            new_matrix = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                *lens, camera.size, no_rotation, balance=alpha
            )
            maps = cv2.fisheye.initUndistortRectifyMap(
                *lens, no_rotation, new_matrix, camera.size, cv2.CV_16SC2
            )
        else:
            new_matrix = cv2.getOptimalNewCameraMatrix(*lens, camera.size, alpha)[0]
            maps = cv2.initUndistortRectifyMap(
                *lens, no_rotation, new_matrix, camera.size, cv2.CV_16SC2
            )
        self._maps = maps
        self.camera: CameraModel = CameraModel(size=camera.size, matrix=new_matrix)

    def __call__(self, frame: Frame, *, colour: bool = False) -> NDArray[Any]:
        """Return a frame's picture without distortion; pixels without a source are 0.

        Args:
            frame: frame of the lens' size.
            colour: whether to return colours, (H, W, 3), or brightness, (H, W).

        Raises:
            FrameFormatError: the frame has another size, or no colours or brightness.
        """
        _check_size(frame, self._size)
        picture = frame.rgb() if colour else frame.grey()
        cv2 = load("cv2")
        return np.asarray(cv2.remap(picture, *self._maps, cv2.INTER_LINEAR))


class Rectifier:
    """Rectify pairs of pictures by a calibration's maps: a point is in the same row of both.

    Args:
        rectification: result of :meth:`~smartcam.calibration.StereoCalibration.rectify`.
        size: width and height of the source pictures, pixels.
        left: name of the left camera in the sets.
        right: name of the right camera in the sets.
    """

    def __init__(
        self,
        rectification: Rectification,
        size: tuple[int, int],
        *,
        left: str = "left",
        right: str = "right",
    ) -> None:
        cv2 = load("cv2")
        self._names, self._size = (left, right), tuple(size)
        self._maps = tuple(cv2.convertMaps(map_, None, cv2.CV_16SC2) for map_ in rectification.maps)

    def __call__(self, pair: FrameSet, *, colour: bool = False) -> tuple[NDArray[Any], ...]:
        """Return both rectified pictures, the left one first; pixels without a source are 0.

        Raises:
            FrameFormatError: a frame has another size, or no colours or brightness.
        """
        cv2 = load("cv2")
        pictures = []
        for name, maps in zip(self._names, self._maps, strict=True):
            frame = pair[name]
            _check_size(frame, self._size)
            picture = frame.rgb() if colour else frame.grey()
            pictures.append(np.asarray(cv2.remap(picture, *maps, cv2.INTER_LINEAR)))
        return tuple(pictures)


def _check_size(frame: Frame, size: tuple[int, ...]) -> None:
    if (frame.width, frame.height) != size:
        raise FrameFormatError(
            f"{frame.source}: expected frames of the lens' {size[0]}x{size[1]}, got "
            f"{frame.width}x{frame.height}",
            source=frame.source,
        )
