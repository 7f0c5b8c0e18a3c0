"""Convert depth and clouds to ROS' messages and back, without a node."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.exceptions import RosMessageError
from smartcam.ros2._cameras.image_messages import array_fields

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry import CameraModel

_FLOAT32: Final = 7
_TYPES: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Types of numpy by the numbers of ``sensor_msgs/PointField``."""

POINT_BYTES: Final = 16
"""Number of bytes of a point: x, y, z and rgb."""

NO_DISPARITY: Final = -1.0
"""Value in pixels that means no disparity; it is less than ``min_disparity``."""

DISPARITY_STEP: Final = 1 / 16
"""Resolution of OpenCV's matchers, pixels."""


MAX_DEPTH_STEPS: Final = 65534.0
"""Number of steps from the farthest depth, value 1, to the nearest in a compressed picture."""

MIN_DEPTH_RANGE: Final = 1.001
"""Smallest ratio of farthest to nearest depth in a compressed picture, so that steps are not 0."""

PNG_OPTIONS: Final = (16, 1)
"""OpenCV's option IMWRITE_PNG_COMPRESSION with its value 1, the fastest compression."""


class CloudPoints(NamedTuple):
    """The contents of a ``sensor_msgs/PointCloud2``, for ``Cloud(*cloud_from(message))``.

    Attributes:
        points: (N, 3) float32, metres, all finite.
        colours: (N, 3) uint8, red, green, blue; None without.
    """

    points: NDArray[np.float32]
    colours: NDArray[np.uint8] | None


def depth_fields(
    depth: NDArray[np.float32], header: dict[str, Any], encoding: str = "32FC1"
) -> dict[str, Any]:
    """Return a depth picture as ``sensor_msgs/Image``, as REP-118 defines it.

    Args:
        depth: (H, W), metres; 0: no depth.
        header: header of the message.
        encoding: ``32FC1``, metres, NaN for no depth; ``16UC1``, millimetres, 0 for no depth and
            for depths of more than 65.535 m.
    """
    if encoding == "32FC1":
        pixels = np.where(depth > 0, depth, np.float32(np.nan)).astype(np.float32)
        return array_fields(pixels, encoding, header)
    return array_fields(_millimetres(depth), encoding, header)


def compressed_depth_fields(
    depth: NDArray[np.float32], header: dict[str, Any], encoding: str = "32FC1"
) -> dict[str, Any]:
    """Return a depth picture in the form of image_transport's ``compressedDepth``.

    Its data are an int32, which is 0, two float32 (a, b), and a PNG with 16 bits. For ``32FC1`` a
    value v of the PNG is the depth ``a / (v - b)``, 0 means no depth; a and b are such that the
    nearest and the farthest depth of the picture use the whole range. For ``16UC1`` values are
    millimetres.
    Source: ``codec.cpp`` and ``compression_common.h`` of image_transport_plugins.

    Args:
        depth: (H, W), metres; 0: no depth.
        header: header of the message.
        encoding: as for :func:`depth_fields`.
    """
    a = b = 0.0
    valid = depth > 0
    if encoding == "16UC1":
        values = _millimetres(depth)
    elif valid.any():
        nearest, farthest = float(depth[valid].min()), float(depth[valid].max())
        farthest = max(farthest, nearest * MIN_DEPTH_RANGE)
        a = MAX_DEPTH_STEPS / (1 / nearest - 1 / farthest)
        b = 1 - a / farthest
        inverse = a / np.where(valid, depth, np.float32(farthest)).astype(np.float64) + b
        values = np.where(valid, np.rint(inverse), 0).astype(np.uint16)
    else:
        values = np.zeros(depth.shape, np.uint16)
    is_encoded, png = load("cv2").imencode(".png", values, PNG_OPTIONS)
    if not is_encoded:
        raise RosMessageError(f"depth of {depth.shape}: OpenCV makes no PNG of it")
    data = struct.pack("<iff", 0, a, b) + png.tobytes()
    return {"header": header, "format": f"{encoding}; compressedDepth png", "data": data}


def _millimetres(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Return depths in millimetres, 0 for no depth and for depths too large for 16 bits."""
    rounded = np.rint(depth * np.float32(1000))
    is_in_range = (rounded > 0) & (rounded <= np.iinfo(np.uint16).max)
    return np.where(is_in_range, rounded, 0).astype(np.uint16)


def disparity_fields(
    disparity: NDArray[np.float32],
    header: dict[str, Any],
    focal: float,
    baseline: float,
    largest: float,
) -> dict[str, Any]:
    """Return ``stereo_msgs/DisparityImage``.

    Args:
        disparity: (H, W), pixels; NaN: none, for which the message has -1.
        header: header of the left picture.
        focal: focal length, pixels.
        baseline: distance of the two cameras, metres.
        largest: largest disparity of the search, pixels.
    """
    height, width = disparity.shape
    pixels = np.nan_to_num(disparity, nan=NO_DISPARITY).astype(np.float32)
    return {
        "header": header,
        "image": array_fields(pixels, "32FC1", header),
        "f": focal,
        "t": baseline,
        "valid_window": {"width": width, "height": height},
        "min_disparity": 0.0,
        "max_disparity": largest,
        "delta_d": DISPARITY_STEP,
    }


def depth_points(depth: NDArray[np.float32], lens: CameraModel) -> NDArray[np.float32]:
    """Return the points (H, W, 3) of a depth picture without distortion; NaN where it is 0."""
    height, width = depth.shape
    z = np.where(depth > 0, depth, np.float32(np.nan)).astype(np.float32)
    (fx, _, cx), (_, fy, cy) = lens.matrix[:2]
    x = ((np.arange(width) - cx) / fx).astype(np.float32)
    y = ((np.arange(height) - cy) / fy).astype(np.float32)
    return np.stack([x[None] * z, y[:, None] * z, z], axis=-1)


def cloud_fields(
    points: NDArray[np.float32], colours: NDArray[np.uint8] | None, header: dict[str, Any]
) -> dict[str, Any]:
    """Return ``sensor_msgs/PointCloud2`` with x, y, z and, with colours, rgb.

    Args:
        points: (N, 3), or organized as a picture (H, W, 3) with NaN for no point, metres.
        colours: colours of the points, red first, or grey without the last axis; None: no colours.
        header: header of the message.
    """
    rows = points if points.ndim == 3 else points[None]
    height, width = rows.shape[:2]
    names = ["x", "y", "z"]
    step = POINT_BYTES if colours is not None else POINT_BYTES - 4
    data = np.zeros((height, width, step // 4), "<f4")
    data[..., :3] = rows
    if colours is not None:
        names.append("rgb")
        grey = colours.ndim == points.ndim - 1
        rgb = np.broadcast_to(colours[..., None], points.shape) if grey else colours
        channels = rgb.reshape(height, width, 3).astype(np.uint32)
        packed = (channels[..., 0] << 16) | (channels[..., 1] << 8) | channels[..., 2]
        data[..., 3] = packed.astype("<u4").view("<f4")
    return {
        "header": header,
        "height": height,
        "width": width,
        "fields": [
            {"name": name, "offset": 4 * index, "datatype": _FLOAT32, "count": 1}
            for index, name in enumerate(names)
        ],
        "is_bigendian": False,
        "point_step": step,
        "row_step": step * width,
        "data": data.reshape(-1).view(np.uint8),
        "is_dense": bool(np.isfinite(rows).all()),
    }


def cloud_from(message: Any) -> CloudPoints:
    """Return the points of a ``sensor_msgs/PointCloud2``, row by row; points with NaN are left out.

    Raises:
        RosMessageError: the cloud has no x, y and z, they are no floats, or there are too few
            bytes.
    """
    fields = {field.name: field for field in message.fields}
    if missing := [name for name in "xyz" if name not in fields]:
        raise RosMessageError(
            f"point cloud: expected x, y and z, got {', '.join(fields) or 'no fields'} without "
            f"{', '.join(missing)}"
        )
    xyz = [_column(message, fields[name], "f") for name in "xyz"]
    points = np.stack(xyz, axis=-1).reshape(-1, 3).astype(np.float32)
    valid = np.isfinite(points).all(axis=1)
    packed = fields.get("rgb") or fields.get("rgba")
    if packed is None:
        return CloudPoints(points[valid], None)
    values = np.ascontiguousarray(_column(message, packed, "fui")).reshape(-1)
    if values.dtype.itemsize != 4:
        raise RosMessageError(f"point cloud: expected {packed.name} of 4 bytes, got {values.dtype}")
    bits = values.view(np.uint32)[valid]
    colours = np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], axis=-1).astype(np.uint8)
    return CloudPoints(points[valid], colours)


def _column(message: Any, field: Any, allowed_kinds: str) -> NDArray[Any]:
    """Return one field of all points as an array (H, W) in this machine's byte order."""
    name = _TYPES.get(field.datatype, "")
    if not name or name[0] not in allowed_kinds or field.count > 1:
        raise RosMessageError(
            f"point cloud: {field.name}: expected one number a point, of numpy's kinds "
            f"{'/'.join(allowed_kinds)}, got {field.count} of datatype {field.datatype}"
        )
    dtype = np.dtype(f"{'>' if message.is_bigendian else '<'}{name}")
    height, width, step, row = (message.height, message.width, message.point_step, message.row_step)
    data = memoryview(message.data).cast("B")
    field_end = field.offset + dtype.itemsize
    expected_bytes = row * (height - 1) + step * (width - 1) + field_end
    if not height or not width:
        return np.zeros((0, 0), dtype.newbyteorder("="))
    if field_end > step or row < step * (width - 1) + field_end or expected_bytes > len(data):
        raise RosMessageError(
            f"point cloud {width}x{height}: expected {expected_bytes} bytes, rows of "
            f"{step * width}, points of {step}, {field.name} at offset {field.offset}, "
            f"got {len(data)} bytes, rows of {row}"
        )
    view = np.ndarray((height, width), dtype, data, field.offset, (row, step))
    return view if dtype.isnative else view.astype(dtype.newbyteorder("="))
