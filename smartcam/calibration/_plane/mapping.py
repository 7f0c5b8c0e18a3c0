"""Map points between a camera's plane and the robot's space, and poses to the robot's space.

The heading of a part in the plane is its direction in the image, mapped at that place. For a
similarity the pose is the frame of the plane times the turn about z. A tilted camera changes angles
a little, so the derivative of the map is used.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from smartcam._extras import load
from smartcam.calibration._homography import apply_homography, derivatives, tangent_frames
from smartcam.geometry._inside import (
    MAX_COORDINATE,
    Code,
    as_points,
    check_finite,
    not_finite_error,
    quaternion_from_matrix,
)
from smartcam.models import Header, Localization, Pose, Position, Quaternion

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import ArrayLike, NDArray

    from smartcam.exceptions import CalibrationError
    from smartcam.geometry._inside import Array

MAX_POINTS_OF_NUMPY = 512
"""With at most this many points, numpy is faster than OpenCV, which is then not loaded."""

POINTS_PER_BLOCK = 65_536
"""Number of points that are mapped at a time: intermediate values stay in the processor's cache,
and calls are few (blocks of 16,384 points take 1.5 times as long, of 10^6 points 1.25 times;
measured)."""

# takes half the time of the NamedTuples' own constructor; a bare tuple is generic, hence the cast
_new_tuple = cast("Callable[..., Any]", tuple.__new__)  # pyright: ignore[reportUnknownMemberType]


class PlaneMap:
    """The map between a camera's plane and the robot's space.

    Args:
        matrix: (4, 3) with ``w (x, y, z, 1) = matrix (u, v, 1)``, metres.
        centre: (2,), a point in the camera's field, where ``w`` is positive.

    Raises:
        CalibrationError: NOT_FINITE: the matrix maps the centre nowhere, or all points to a line.
    """

    def __init__(self, matrix: Array, centre: Array) -> None:
        self.matrix: Array = matrix
        """As given."""
        self._depth: tuple[float, float, float] = tuple(matrix[3].tolist())
        self._max_row_sum = 3.0 * float(np.abs(matrix).max())
        self.projective: bool = bool(matrix[3, :2].any())
        """True if parallel lines may meet, as under a homography."""
        with np.errstate(all="ignore"):
            self._prepare(matrix, centre)
        arrays = [self.origin, self.frame, self._plane_matrix, self._inverse_plane_matrix]
        if not (all(np.isfinite(array).all() for array in arrays) and 0 < self.scale < math.inf):
            raise not_finite_error("plane's matrix", matrix.tolist())

    def _prepare(self, matrix: Array, centre: Array) -> None:
        self.origin: Array = apply_homography(matrix, centre[None])[0]
        """Position (3,) of the centre, metres."""
        derivative = derivatives(matrix, centre[None])[0]
        self.scale: float = math.sqrt(np.linalg.norm(np.cross(derivative[:, 0], derivative[:, 1])))
        """Metres per unit of the camera at the centre."""
        self.frame: Array = tangent_frames(derivative[None], np.array([[1.0, 0.0]]))[0]
        """Rotation (3, 3): x as the camera's x at the centre, z the plane's normal."""
        plane_axes = self.frame[:, :2].T
        self._plane_matrix = np.vstack(
            [plane_axes @ matrix[:3] - np.outer(plane_axes @ self.origin, matrix[3]), matrix[3]]
        )
        try:
            self._inverse_plane_matrix = np.asarray(
                np.linalg.inv(self._plane_matrix), dtype=np.float64
            )
        except np.linalg.LinAlgError as exc:
            raise not_finite_error("plane's matrix", matrix.tolist()) from exc
        self._quaternion = Quaternion(*quaternion_from_matrix(self.frame).tolist())

    def transform(self, points: ArrayLike, out: Array | None = None) -> Array:
        """Map camera points to the robot's space, (N, 3); see ``PlaneCalibration.transform``."""
        points_array = np.asarray(points, dtype=np.float64)
        if points_array.ndim != 2 or points_array.shape[1] not in {2, 3}:
            points_array = as_points(points, 2, "camera points")
        result = (
            np.empty((len(points_array), 3)) if out is None else _check_out(out, len(points_array))
        )
        if len(points_array) <= MAX_POINTS_OF_NUMPY:
            self._check_horizon(points_array)
            with np.errstate(all="ignore"):
                mapped = points_array[:, :2] @ self.matrix[:, :2].T + self.matrix[:, 2]
                np.divide(mapped[:, :3], mapped[:, 3:], out=result)
            if not np.isfinite(result).all():
                _check_mapped(points_array, result)
            return result
        blocks = _HomogeneousBlocks(points_array)
        for begin in range(0, len(points_array), POINTS_PER_BLOCK):
            block = points_array[begin : begin + POINTS_PER_BLOCK]
            largest = self._largest_coordinate(block)
            least_depth = self._least_depth(largest)
            if not least_depth > 0:
                self._check_horizon(block)
            self._map_block(blocks.block(begin), result[begin : begin + POINTS_PER_BLOCK])
            if not (
                least_depth > 0
                and self._max_row_sum * max(largest, 1.0) / least_depth < MAX_COORDINATE
            ):
                _check_mapped(block, result[begin : begin + POINTS_PER_BLOCK])
        return result

    def _largest_coordinate(self, points: Array) -> float:
        """Return the largest absolute coordinate; for a projective map, NaN if there is a NaN."""
        if self.projective:  # OpenCV divides by NaN, and gives 0
            return max(float(points.max()), -float(points.min()))
        cv2 = load("cv2")
        size: float = cv2.norm(points.reshape(-1, 1), cv2.NORM_INF)
        return size

    def _least_depth(self, largest: float) -> float:
        """Return the least ``w`` of points whose coordinates are at most ``largest``."""
        u, v, constant = self._depth
        return constant - (abs(u) + abs(v)) * largest

    def _map_block(self, homogeneous: Array, result: Array) -> None:
        """Map contiguous points (n, 3) whose third component is 1."""
        cv2 = load("cv2")
        source, target = homogeneous.reshape(-1, 1, 3), result.reshape(-1, 1, 3)
        if self.projective:
            matrix = np.zeros((4, 4))
            matrix[:, :3] = self.matrix
            cv2.perspectiveTransform(source, matrix, dst=target)
        else:
            cv2.transform(source, self.matrix[:3], dst=target)

    def _check_horizon(self, points: Array) -> None:
        """Raise OUT_OF_FIELD if a point lies behind the plane's horizon; NaN is ignored."""
        if not self.projective or not len(points):
            return
        w = points[:, :2] @ self.matrix[3, :2] + self.matrix[3, 2]
        if (w <= 0).any():
            raise _behind_horizon_error(points[int(np.argmin(w)), :2].tolist())

    def inverse(self, points: ArrayLike) -> Array:
        """Map robot points (N, 3), projected onto the plane, to the camera's (N, 2)."""
        points_array = as_points(points, 3, "robot points")
        in_plane = (points_array - self.origin) @ self.frame[:, :2]
        homogeneous = (
            in_plane @ self._inverse_plane_matrix[:, :2].T + self._inverse_plane_matrix[:, 2]
        )
        if (homogeneous[:, 2] <= 0).any():
            raise _behind_horizon_error(points_array[int(np.argmin(homogeneous[:, 2]))].tolist())
        with np.errstate(all="ignore"):
            image: Array = homogeneous[:, :2] / homogeneous[:, 2:]
        check_finite(image, "inverse")
        return image

    def poses(
        self,
        localizations: Iterable[Localization],
        robot_frame: str,
        camera_frame: str | None,
        *,
        flip: bool,
    ) -> list[Localization]:
        """Return localizations in the robot's space; see ``PlaneCalibration.to_robot``."""
        new, atan2, sin, cos = _new_tuple, math.atan2, math.sin, math.cos
        (a, b, c), (d, e, f), (p, q, constant) = self._plane_matrix.tolist()
        (xx, yx, _), (xy, yy, _), (xz, yz, _) = self.frame.tolist()
        ox, oy, oz = self.origin.tolist()
        tx, ty, tz, tw = self._quaternion
        projective, isfinite = self.projective, math.isfinite
        last_header: Header | None = None
        header: Header | None = None
        mapped: list[Localization] = []
        for feature_id, quality, photo_index, pose in localizations:
            camera_header, (u, v, height), (qx, qy, qz, qw) = pose
            if height or qx or qy:
                raise _out_of_plane_error(pose)
            if camera_header is not last_header:
                header = _robot_header(camera_header, robot_frame, camera_frame)
                last_header = camera_header
            # in the plane, relative to its origin
            x, y = a * u + b * v + c, d * u + e * v + f
            direction_u, direction_v = qw * qw - qz * qz, 2.0 * qz * qw
            heading_x, heading_y = (
                a * direction_u + b * direction_v,
                d * direction_u + e * direction_v,
            )
            if projective:
                w = p * u + q * v + constant
                if w <= 0:
                    raise _behind_horizon_error([u, v])
                x, y = x / w, y / w
                heading_w = p * direction_u + q * direction_v
                heading_x, heading_y = heading_x - x * heading_w, heading_y - y * heading_w
            half_angle = 0.5 * atan2(heading_y, heading_x)
            s, k = sin(half_angle), cos(half_angle)
            # the plane's turn times the turn about z
            i, j = tx * k + ty * s, ty * k - tx * s
            m, r = tz * k + tw * s, tw * k - tz * s
            orientation = (r, m, -j, -i) if flip else (i, j, m, r)
            position = (ox + xx * x + yx * y, oy + xy * x + yy * y, oz + xz * x + yz * y)
            # the sum of all numbers is one operation, and is not finite if one of them is not
            if not isfinite(sum(position) + (i + j + m + r)):
                raise not_finite_error(f"pose of {feature_id!r:.60}", (*position, *orientation))
            result = new(Pose, (header, new(Position, position), new(Quaternion, orientation)))
            mapped.append(new(Localization, (feature_id, quality, photo_index, result)))
        return mapped


class _HomogeneousBlocks:
    """Converts points to homogeneous coordinates (u, v, 1), block by block.

    The two coordinates of a point are copied as one complex number, in a sixth of the time.

    Args:
        points: (N, 2), or (N, 3) which is used as it is.
    """

    def __init__(self, points: Array) -> None:
        self._points = np.ascontiguousarray(points)
        self._is_spatial = points.shape[1] == 3
        if not self._is_spatial:
            self._pairs = self._points.view(np.complex128)[:, 0]
            self._buffer = np.ones((min(POINTS_PER_BLOCK, len(points)), 3))
            self._coordinates: NDArray[np.complex128] = np.ndarray(
                (len(self._buffer),), np.complex128, self._buffer, strides=(24,)
            )

    def block(self, start: int) -> Array:
        """Return the block (n, 3) that begins at a point, contiguous, valid until the next call."""
        if self._is_spatial:
            return self._points[start : start + POINTS_PER_BLOCK]
        pairs = self._pairs[start : start + POINTS_PER_BLOCK]
        self._coordinates[: len(pairs)] = pairs
        return self._buffer[: len(pairs)]


def _check_mapped(points: Array, result: Array) -> None:
    """Raise NOT_FINITE if a finite point has no finite result; map other points to NaN."""
    is_finite = np.isfinite(points).all(axis=1)
    result[~is_finite] = np.nan
    is_wrong = is_finite & ~np.isfinite(result).all(axis=1)
    if is_wrong.any():
        row = int(np.argmax(is_wrong))
        raise not_finite_error(f"point {points[row].tolist()}", result[row].tolist())


def _check_out(out: Array, count: int) -> Array:
    has_layout = out.shape == (count, 3) and out.dtype == np.float64 and out.flags.c_contiguous
    if not (has_layout and out.flags.writeable):
        raise Code.SHAPE.error(
            f"out: expected a contiguous float64 array of shape ({count}, 3), "
            f"got {out.dtype} of shape {out.shape}",
            (count, 3),
            out.shape,
        )
    return out


def _robot_header(camera_header: Header, robot_frame: str, camera_frame: str | None) -> Header:
    if camera_frame is not None and camera_header.frame_id != camera_frame:
        raise Code.WRONG_FRAME.error(
            f"expected poses in the frame {camera_frame!r}, got one in {camera_header.frame_id!r}",
            camera_frame,
            camera_header.frame_id,
        )
    header: Header = _new_tuple(Header, (camera_header.seq, camera_header.stamp, robot_frame))
    return header


def _out_of_plane_error(pose: Pose) -> CalibrationError:
    return Code.OUT_OF_PLANE.error(
        "expected a pose in the camera's plane (z = 0, turned about z only), "
        f"got {tuple(pose.position)} turned by {tuple(pose.orientation)}",
        0.0,
        pose.position.z,
    )


def _behind_horizon_error(point: list[float]) -> CalibrationError:
    return Code.OUT_OF_FIELD.error(
        f"expected points that the camera can see of the plane, got {point}: behind its horizon",
        "a point before the horizon",
        point,
    )
