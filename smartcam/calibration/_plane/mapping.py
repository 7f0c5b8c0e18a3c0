"""Map points between a camera's plane and the robot's space, and poses to the robot's space.

The heading of a part in the plane is its direction in the image, mapped at that place. For a
similarity that is the frame of the plane times the turn about z; a tilted camera changes angles a
little, by the derivative of the map.
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
    not_finite,
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
and calls are few (blocks of 16,384 points take half as long again, of 10^6 a quarter; measured)."""

# takes half the time of the NamedTuples' own; the cast is needed since a bare tuple is generic
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
        self._most = 3.0 * float(np.abs(matrix).max())
        self.projective: bool = bool(matrix[3, :2].any())
        """True if parallel lines may meet, as under a homography."""
        with np.errstate(all="ignore"):
            self._prepare(matrix, centre)
        known = [self.origin, self.frame, self._flat, self._back]
        if not (all(np.isfinite(array).all() for array in known) and 0 < self.scale < math.inf):
            raise not_finite("plane's matrix", matrix.tolist())

    def _prepare(self, matrix: Array, centre: Array) -> None:
        self.origin: Array = apply_homography(matrix, centre[None])[0]
        """Position (3,) of the centre, metres."""
        derivative = derivatives(matrix, centre[None])[0]
        self.scale: float = math.sqrt(np.linalg.norm(np.cross(derivative[:, 0], derivative[:, 1])))
        """Metres per unit of the camera at the centre."""
        self.frame: Array = tangent_frames(derivative[None], np.array([[1.0, 0.0]]))[0]
        """Rotation (3, 3): x as the camera's x at the centre, z the plane's normal."""
        inside = self.frame[:, :2].T
        self._flat = np.vstack(
            [inside @ matrix[:3] - np.outer(inside @ self.origin, matrix[3]), matrix[3]]
        )
        try:
            self._back = np.asarray(np.linalg.inv(self._flat), dtype=np.float64)
        except np.linalg.LinAlgError as exc:
            raise not_finite("plane's matrix", matrix.tolist()) from exc
        self._turn = Quaternion(*quaternion_from_matrix(self.frame).tolist())

    def transform(self, points: ArrayLike, out: Array | None = None) -> Array:
        """Map camera points to the robot's space, (N, 3); see ``PlaneCalibration.transform``."""
        given = np.asarray(points, dtype=np.float64)
        if given.ndim != 2 or given.shape[1] not in {2, 3}:
            given = as_points(points, 2, "camera points")
        result = np.empty((len(given), 3)) if out is None else _checked(out, len(given))
        if len(given) <= MAX_POINTS_OF_NUMPY:
            self._check_horizon(given)
            with np.errstate(all="ignore"):
                mapped = given[:, :2] @ self.matrix[:, :2].T + self.matrix[:, 2]
                np.divide(mapped[:, :3], mapped[:, 3:], out=result)
            if not np.isfinite(result).all():
                _check_mapped(given, result)
            return result
        source = _Homogeneous(given)
        for begin in range(0, len(given), POINTS_PER_BLOCK):
            block = given[begin : begin + POINTS_PER_BLOCK]
            farthest = self._farthest(block)
            least = self._least_depth(farthest)
            if not least > 0:
                self._check_horizon(block)
            self._fill(source.block(begin), result[begin : begin + POINTS_PER_BLOCK])
            if not (least > 0 and self._most * max(farthest, 1.0) / least < MAX_COORDINATE):
                _check_mapped(block, result[begin : begin + POINTS_PER_BLOCK])
        return result

    def _farthest(self, points: Array) -> float:
        """Return the largest coordinate; NaN if there is a NaN that must not pass for 0."""
        if self.projective:  # OpenCV divides by NaN, and gives 0
            return max(float(points.max()), -float(points.min()))
        cv2 = load("cv2")
        size: float = cv2.norm(points.reshape(-1, 1), cv2.NORM_INF)
        return size

    def _least_depth(self, farthest: float) -> float:
        """Return the least ``w`` of points whose coordinates are at most ``farthest``."""
        u, v, constant = self._depth
        return constant - (abs(u) + abs(v)) * farthest

    def _fill(self, homogeneous: Array, result: Array) -> None:
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
        """Raise if a point lies behind the plane's horizon; NaN passes."""
        if not self.projective or not len(points):
            return
        w = points[:, :2] @ self.matrix[3, :2] + self.matrix[3, 2]
        if (w <= 0).any():
            raise _behind_horizon_error(points[int(np.argmin(w)), :2].tolist())

    def inverse(self, points: ArrayLike) -> Array:
        """Map robot points (N, 3), projected onto the plane, to the camera's (N, 2)."""
        given = as_points(points, 3, "robot points")
        inside = (given - self.origin) @ self.frame[:, :2]
        seen = inside @ self._back[:, :2].T + self._back[:, 2]
        if (seen[:, 2] <= 0).any():
            raise _behind_horizon_error(given[int(np.argmin(seen[:, 2]))].tolist())
        with np.errstate(all="ignore"):
            image: Array = seen[:, :2] / seen[:, 2:]
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
        (a, b, c), (d, e, f), (p, q, constant) = self._flat.tolist()
        (xx, yx, _), (xy, yy, _), (xz, yz, _) = self.frame.tolist()
        ox, oy, oz = self.origin.tolist()
        tx, ty, tz, tw = self._turn
        projective, isfinite = self.projective, math.isfinite
        last: Header | None = None
        header: Header | None = None
        mapped: list[Localization] = []
        for feature_id, quality, photo_index, pose in localizations:
            seen, (u, v, height), (qx, qy, qz, qw) = pose
            if height or qx or qy:
                raise _out_of_plane_error(pose)
            if seen is not last:
                header = _header(seen, robot_frame, camera_frame)
                last = seen
            # in the plane, relative to its origin
            x, y = a * u + b * v + c, d * u + e * v + f
            direction_u, direction_v = qw * qw - qz * qz, 2.0 * qz * qw
            along, across = a * direction_u + b * direction_v, d * direction_u + e * direction_v
            if projective:
                w = p * u + q * v + constant
                if w <= 0:
                    raise _behind_horizon_error([u, v])
                x, y = x / w, y / w
                turned = p * direction_u + q * direction_v
                along, across = along - x * turned, across - y * turned
            half = 0.5 * atan2(across, along)
            s, k = sin(half), cos(half)
            # the plane's turn times the turn about z
            i, j = tx * k + ty * s, ty * k - tx * s
            m, r = tz * k + tw * s, tw * k - tz * s
            orientation = (r, m, -j, -i) if flip else (i, j, m, r)
            position = (ox + xx * x + yx * y, oy + xy * x + yy * y, oz + xz * x + yz * y)
            # the sum of all numbers is one operation, and is not finite if one of them is not
            if not isfinite(sum(position) + (i + j + m + r)):
                raise not_finite(f"pose of {feature_id!r:.60}", (*position, *orientation))
            result = new(Pose, (header, new(Position, position), new(Quaternion, orientation)))
            mapped.append(new(Localization, (feature_id, quality, photo_index, result)))
        return mapped


class _Homogeneous:
    """Points with a third component 1, converted block by block.

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
            self._places: NDArray[np.complex128] = np.ndarray(
                (len(self._buffer),), np.complex128, self._buffer, strides=(24,)
            )

    def block(self, begin: int) -> Array:
        """Return the next points (n, 3), contiguous, valid until the next call."""
        if self._is_spatial:
            return self._points[begin : begin + POINTS_PER_BLOCK]
        pairs = self._pairs[begin : begin + POINTS_PER_BLOCK]
        self._places[: len(pairs)] = pairs
        return self._buffer[: len(pairs)]


def _check_mapped(given: Array, result: Array) -> None:
    """Raise if a point of finite numbers was mapped to none; NaN may give NaN."""
    finite = np.isfinite(given).all(axis=1)
    result[~finite] = np.nan
    wrong = finite & ~np.isfinite(result).all(axis=1)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise not_finite(f"point {given[row].tolist()}", result[row].tolist())


def _checked(out: Array, count: int) -> Array:
    fits = out.shape == (count, 3) and out.dtype == np.float64 and out.flags.c_contiguous
    if not (fits and out.flags.writeable):
        raise Code.SHAPE.refusal(
            f"out: expected a contiguous float64 array of shape ({count}, 3), "
            f"got {out.dtype} of shape {out.shape}",
            (count, 3),
            out.shape,
        )
    return out


def _header(seen: Header, robot_frame: str, camera_frame: str | None) -> Header:
    if camera_frame is not None and seen.frame_id != camera_frame:
        raise Code.WRONG_FRAME.refusal(
            f"expected poses in the frame {camera_frame!r}, got one in {seen.frame_id!r}",
            camera_frame,
            seen.frame_id,
        )
    header: Header = _new_tuple(Header, (seen.seq, seen.stamp, robot_frame))
    return header


def _out_of_plane_error(pose: Pose) -> CalibrationError:
    return Code.OUT_OF_PLANE.refusal(
        "expected a pose in the camera's plane (z = 0, turned about z only), "
        f"got {tuple(pose.position)} turned by {tuple(pose.orientation)}",
        0.0,
        pose.position.z,
    )


def _behind_horizon_error(point: list[float]) -> CalibrationError:
    return Code.OUT_OF_FIELD.refusal(
        f"expected points that the camera can see of the plane, got {point}: behind its horizon",
        "a point before the horizon",
        point,
    )
