"""Convert lenses to ROS' ``camera_info`` and back, without a node."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam.calibration._inside import CameraInfo
from smartcam.exceptions import RosMessageError
from smartcam.geometry import CameraModel

if TYPE_CHECKING:
    from numpy.typing import NDArray

LENSES: Final = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
"""Possible numbers of coefficients by the model of distortion."""


def lens_fields(
    lens: CameraModel | None,
    header: dict[str, Any],
    size: tuple[int, int],
    *,
    rectification: NDArray[np.float64] | None = None,
    projection: NDArray[np.float64] | None = None,
) -> dict[str, Any]:
    """Return the fields of ``sensor_msgs/CameraInfo``.

    Args:
        lens: model of the lens; None: not calibrated, so K, D, R and P are zero.
        header: header of the picture.
        size: width and height of the picture, pixels.
        rectification: (3, 3), from the camera's frame into the rectified one; None: no rotation.
        projection: (3, 4), of the rectified picture, pixels; None: of the lens without distortion.
    """
    fields: dict[str, Any] = {"header": header, "width": size[0], "height": size[1]}
    if lens is None:
        return fields
    rotation = np.eye(3) if rectification is None else rectification
    projection_matrix = (
        np.column_stack([lens.matrix, np.zeros(3)]) if projection is None else projection
    )
    return fields | {
        "distortion_model": lens.distortion_model,
        "d": np.array(lens.distortion, np.float64),
        "k": np.ravel(lens.matrix),
        "r": np.ravel(rotation),
        "p": np.ravel(projection_matrix),
    }


def lens_from(message: Any) -> CameraInfo | None:
    """Return the lens of a ``sensor_msgs/CameraInfo``, its rectification and projection.

    Returns:
        The lens; None if it is not calibrated.

    Raises:
        RosMessageError: the model of the lens is unknown, or the picture is binned or a region.
        CalibrationError: the matrix or coefficients do not make a lens.
    """
    if not message.k[0]:
        return None
    count = len(message.d)
    model = message.distortion_model or "plumb_bob"
    if model not in LENSES or (count and count not in LENSES[model]):
        known = "; ".join(f"{name} with {' or '.join(map(str, n))}" for name, n in LENSES.items())
        raise RosMessageError(
            f"camera_info: expected {known} coefficients, got {model!r:.40} with {count}"
        )
    roi = message.roi
    if max(message.binning_x, message.binning_y) > 1 or roi.x_offset or roi.y_offset:
        raise RosMessageError("camera_info: expected that of the whole picture, got a part of it")
    coefficients = np.zeros(max(LENSES[model]))
    coefficients[:count] = message.d
    lens = CameraModel(
        size=(int(message.width), int(message.height)),
        matrix=np.reshape(message.k, (3, 3)).astype(np.float64),
        distortion=coefficients,
        distortion_model=model,  # type: ignore[arg-type]
    )
    rotation, projection = np.reshape(message.r, (3, 3)), np.reshape(message.p, (3, 4))
    if not np.any(rotation):
        rotation = np.eye(3)
    if not np.any(projection):
        projection = np.column_stack([lens.matrix, np.zeros(3)])
    if not all(math.isfinite(number) for number in (*rotation.ravel(), *projection.ravel())):
        raise RosMessageError("camera_info: expected finite numbers in R and P")
    return CameraInfo(lens, message.header.frame_id, rotation, projection)
