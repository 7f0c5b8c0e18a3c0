"""Solvers: transformations that lead, one after the other, from camera to robot coordinates.

Each solver does one part of the transformation and does not depend on the others; a :class:`Chain`
applies several in order. All solvers map :class:`Poses` to :class:`Poses`: arrays of points and
orientations. A localization of the camera is a pose on its own plane: ``z`` is 0 and the
orientation a turn about ``z``.

The solvers :class:`CameraPosition2D` and :class:`RealWorldPosition` come from the thesis with which
smartcam began. Its description is wrong in three points, which are corrected here: the origin is
subtracted before turning, the origin's angle is subtracted from the part's, and the plane has a
direction within itself in addition to its normal.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol, overload, runtime_checkable

import numpy as np

from smartcam._argument_checks import a_finite_number, a_list, check_arguments, numbers, of_class
from smartcam.calibration._homography import apply_homography, derivatives, tangent_frames
from smartcam.calibration._plane.validation import check_positive
from smartcam.geometry import Transform
from smartcam.geometry._inside import (
    Code,
    as_points,
    as_vector,
    check_finite,
    frame_from_axes,
    matrix_from_quaternion,
    quaternion_about_z,
    quaternion_from_matrix,
    quaternion_multiply,
    rotate,
)
from smartcam.models import Localization, Pose, Position, Quaternion

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import ArrayLike

    from smartcam.calibration._plane.calibration import PlaneCalibration
    from smartcam.geometry._inside import Array


class Poses(NamedTuple):
    """Positions and orientations of several objects.

    Attributes:
        points: (N, 3) float64.
        quaternions: (N, 4) float64, ``x, y, z, w``, of unit length.
    """

    points: Array
    quaternions: Array

    @classmethod
    def planar(cls, points: ArrayLike, thetas: ArrayLike | None = None) -> Poses:
        """Return poses on a plane.

        Args:
            points: (N, 2), in any unit.
            thetas: (N,), radians, counter-clockwise; None is 0 for each.

        Raises:
            CalibrationError: ``SHAPE``.
        """
        flat = np.atleast_2d(np.asarray(points, dtype=np.float64))
        angles = np.zeros(len(flat)) if thetas is None else np.asarray(thetas, dtype=np.float64)
        if flat.shape != (len(angles), 2):
            raise Code.SHAPE.error_with_value(
                f"poses on a plane: expected points of shape ({len(angles)}, 2)",
                (len(angles), 2),
                flat.shape,
            )
        return cls(np.column_stack([flat, np.zeros(len(flat))]), quaternion_about_z(angles))

    @classmethod
    def of(cls, localizations: Iterable[Localization]) -> Poses:
        """Return the poses of localizations."""
        poses = [part.pose for part in localizations]
        points = np.array([pose.position for pose in poses], dtype=np.float64)
        quaternions = np.array([pose.orientation for pose in poses], dtype=np.float64)
        return cls(points.reshape(-1, 3), quaternions.reshape(-1, 4))

    def moved(self, rotation: Array, translation: Array) -> Poses:
        """Return the poses after one rigid motion, given in the frame of the poses.

        Args:
            rotation: (3, 3).
            translation: (3,).
        """
        turned = quaternion_multiply(quaternion_from_matrix(rotation), self.quaternions)
        return Poses(self.points @ rotation.T + translation, turned)

    def replace_poses_of(self, localizations: Iterable[Localization]) -> list[Localization]:
        """Return the localizations with these poses, in the same order, and their own headers."""
        rows = zip(localizations, self.points.tolist(), self.quaternions.tolist(), strict=True)
        return [
            part._replace(pose=Pose(part.pose.header, Position(*position), Quaternion(*quaternion)))
            for part, position, quaternion in rows
        ]


@runtime_checkable
class Solver(Protocol):
    """One step of a coordinate transformation."""

    def solve(self, poses: Poses) -> Poses:
        """Return the poses after this step; the given ones are not changed."""
        ...


class CameraPosition2D:
    """Solver from the camera's coordinates to those of the origin mark on its plane.

    ``p' = scale R(-theta) (p - origin)``, and ``theta`` is subtracted from each orientation. A
    height above the camera's plane is only scaled.

    Args:
        origin: (2,), the origin mark in the camera's coordinates.
        theta: angle of the origin mark in the camera's coordinates, radians, counter-clockwise with
            y up.
        scale: metres per unit of the camera; 1 if the camera gives metres.

    Raises:
        CalibrationError: ``SHAPE``, or ``NOT_FINITE``, also for a scale that is not positive.

    Source: the thesis' ``solver_camera_2D_position``, 3.2.5.1; the subtraction of the origin before
    the turn is derived: the origin must become zero.
    """

    def __init__(self, origin: ArrayLike, theta: float = 0.0, scale: float = 1.0) -> None:
        check_positive(scale, "scale", "metres in one of the camera's units")
        self.origin: Array = as_vector(origin, 2, "origin mark").copy()
        self.theta: float = float(as_vector([theta], 1, "theta of the origin mark")[0])
        self.scale: float = float(scale)
        cos, sin = np.cos(self.theta), np.sin(self.theta)
        self._rotation = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])

    def solve(self, poses: Poses) -> Poses:
        """Return the poses relative to the origin mark, metres."""
        # subtract before turning, so that the origin becomes zero
        centred = poses.points - np.array([*self.origin, 0.0])
        return Poses(self.scale * centred, poses.quaternions).moved(self._rotation, np.zeros(3))


class RealWorldPosition:
    """Solver from the plane of the origin mark to the robot's space: ``p' = rotation p + origin``.

    Args:
        origin: (3,), place at which the robot touched the origin mark, metres.
        rotation: (3, 3), whose columns are the plane's x, y and normal in the robot's frame.

    Raises:
        CalibrationError: ``NOT_RIGID``: the matrix is no rotation.

    Source: the thesis' ``solver_real_world_position``, 3.2.5.1. Point, normal and scale do not
    determine the turn about the normal, so the whole rotation is given.
    """

    def __init__(self, origin: ArrayLike, rotation: ArrayLike) -> None:
        transform = Transform(
            "robot",
            "plane",
            np.asarray(rotation, dtype=np.float64),
            np.asarray(origin, dtype=np.float64),
        )
        self.origin: Array = transform.translation
        self.rotation: Array = transform.rotation

    @classmethod
    def from_touches(cls, origin: ArrayLike, on_a: ArrayLike, on_b: ArrayLike) -> RealWorldPosition:
        """Return the plane of three touches: x is along ray A, the normal along A cross B.

        Args:
            origin: (3,), the origin mark, metres.
            on_a: (3,), anywhere on ray A.
            on_b: (3,), on ray B, or anywhere on its side of ray A.

        Raises:
            CalibrationError: ``COINCIDENT``; ``COLLINEAR``: the rays are less than 10 degrees
                apart.
        """
        o, a, b = (np.asarray(point, dtype=np.float64) for point in (origin, on_a, on_b))
        return cls(o, frame_from_axes(a - o, b - o))

    def solve(self, poses: Poses) -> Poses:
        """Return the poses in the robot's frame."""
        return poses.moved(self.rotation, self.origin)


class PlaneProjection:
    """Solver for a camera that is tilted, or whose two axes have different scales.

    ``w (x, y, z, 1) = matrix (u, v, 1)``. The x axis of an orientation is mapped at its place; its
    z axis is the plane's normal.

    Args:
        matrix: (4, 3), metres; ``w`` is positive in the camera's field.

    Raises:
        CalibrationError: ``SHAPE`` or ``NOT_FINITE``; in :meth:`solve`: ``OUT_OF_FIELD``: a point
            behind the plane's horizon; ``OUT_OF_PLANE``: a pose that is not in the camera's plane.
    """

    def __init__(self, matrix: ArrayLike) -> None:
        rows = as_points(matrix, 3, "projection")
        if len(rows) != 4:
            raise Code.SHAPE.error_with_value(
                "projection: expected shape (4, 3)", (4, 3), rows.shape
            )
        self.matrix: Array = rows.copy()

    def solve(self, poses: Poses) -> Poses:
        """Return the poses in the robot's frame."""
        points, (x, y, z, w) = poses.points, poses.quaternions.T
        if points[:, 2].any() or x.any() or y.any():
            raise Code.OUT_OF_PLANE.error(
                "projection: expected poses in the camera's plane, turned about its z, got some "
                "with a height or a tilt"
            )
        camera_points = points[:, :2]
        depth = camera_points @ self.matrix[3, :2] + self.matrix[3, 2]
        if not np.all(depth > 0):
            hidden_point = camera_points[int(np.argmin(depth))].tolist()
            raise Code.OUT_OF_FIELD.error(
                f"projection: expected points that the camera can see, got {hidden_point}: behind "
                "the plane's horizon",
                got=hidden_point,
            )
        # The x axis (cos, sin) = (w^2 - z^2, 2 z w) goes where the map's derivative takes it; the
        # plane is spanned by the derivative's columns.
        directions = np.column_stack([w * w - z * z, 2.0 * z * w])
        axes = tangent_frames(derivatives(self.matrix, camera_points), directions)
        return Poses(apply_homography(self.matrix, camera_points), quaternion_from_matrix(axes))


class Height:
    """Solver for parts higher than the plane: from their apparent place to their true place.

    A point at ``height`` above the plane seems to lie where the ray through the point meets the
    plane: too far from the place right below the camera. Without ``viewpoint`` the rays are taken
    as parallel to the normal, as with a telecentric lens: then only the height is added.

    Args:
        height: metres above the plane, in the direction of ``normal``; negative is below.
        normal: (3,), the plane's, of any length.
        viewpoint: (3,), the camera's centre of projection, metres. It is in the frame of the poses,
            as ``normal`` is.

    Raises:
        CalibrationError: ``SHAPE`` or ``NOT_FINITE``; ``SHORT_LEVER``: a normal without a length;
            in :meth:`solve`, a viewpoint that is not above the points by more than the height.
    """

    def __init__(
        self,
        height: float,
        normal: ArrayLike = (0.0, 0.0, 1.0),
        viewpoint: ArrayLike | None = None,
    ) -> None:
        direction = as_vector(normal, 3, "normal")
        length = float(np.linalg.norm(direction))
        if not length > 0:
            raise Code.SHORT_LEVER.error(
                f"height: expected a normal, got {direction.tolist()}", "a length above 0", length
            )
        self.height: float = float(as_vector([height], 1, "height")[0])
        self.normal: Array = direction / length
        self.viewpoint: Array | None = (
            None if viewpoint is None else as_vector(viewpoint, 3, "viewpoint").copy()
        )

    def solve(self, poses: Poses) -> Poses:
        """Return the poses at the height of the features that were seen."""
        points = poses.points
        if self.viewpoint is None:
            return Poses(points + self.height * self.normal, poses.quaternions)
        # On the ray p + s (v - p) the height over the plane is s n (v - p), which is h for
        # s = h / n (v - p).
        rays = self.viewpoint - points
        distances = rays @ self.normal
        if not np.all(distances > max(self.height, 0.0)):
            raise Code.SHORT_LEVER.error(
                f"height: expected the viewpoint more than {max(self.height, 0.0):g} m above each "
                f"point, got {float(distances.min()):g} m",
                self.height,
                float(distances.min()),
            )
        return Poses(points + rays * (self.height / distances)[:, None], poses.quaternions)


class ToolOffset:
    """Solver from the pose of a part to the pose that a tool must take at it.

    ``T_robot_tool = T_robot_part @ T_part_tool``. With the inverse of the tip's pose on the flange,
    the result is the flange's pose that puts the tip onto the part.

    Args:
        translation: (3,), metres, in the part's frame.
        quaternion: (4,), the tool's orientation in the part's frame, ``x, y, z, w``.

    Raises:
        CalibrationError: ``NOT_RIGID``: the numbers are no quaternion.
    """

    def __init__(
        self,
        translation: ArrayLike = (0.0, 0.0, 0.0),
        quaternion: ArrayLike = (0.0, 0.0, 0.0, 1.0),
    ) -> None:
        offset = Transform.from_quaternion("part", "tool", translation, quaternion)
        self.translation: Array = offset.translation
        self.quaternion: Array = offset.quaternion

    @classmethod
    def facing(cls) -> ToolOffset:
        """Return the half turn about x, for a tool whose z points into the plane."""
        return cls(quaternion=(1.0, 0.0, 0.0, 0.0))

    @classmethod
    def flange(cls, tip: ArrayLike, quaternion: ArrayLike = (0.0, 0.0, 0.0, 1.0)) -> ToolOffset:
        """Return the transform from the tip's pose to the flange's.

        Args:
            tip: (3,), the tip in the flange's frame, metres.
            quaternion: (4,), the tool's orientation in the flange's frame.

        Raises:
            CalibrationError: ``NOT_RIGID``.
        """
        # T_base_flange = T_base_tip T_flange_tip^-1
        flange_in_tip = Transform.from_quaternion("flange", "tip", tip, quaternion).inverse()
        return cls(flange_in_tip.translation, flange_in_tip.quaternion)

    def solve(self, poses: Poses) -> Poses:
        """Return the tool's poses, in the frame of the given poses."""
        return Poses(
            poses.points + rotate(poses.quaternions, self.translation),
            quaternion_multiply(poses.quaternions, self.quaternion),
        )


class Chain:
    """Solvers that are applied one after the other; a chain is itself a solver.

    Args:
        solvers: solvers in the order in which they are applied.
        frame: name of the frame that the chain leads to, which :meth:`to_robot` writes into
            headers.
        camera_frame: name of the frame that localizations must come in; None for any.
        y_down: whether the camera's own y axis points down; the chain takes localizations with the
            opposite y, as :func:`smartcam.connect` gives them (it checks this value); None: not
            known.
    """

    @check_arguments(solvers=a_list)
    def __init__(
        self,
        solvers: Sequence[Solver],
        *,
        frame: str = "robot",
        camera_frame: str | None = None,
        y_down: bool | None = None,
    ) -> None:
        self.solvers: tuple[Solver, ...] = tuple(solvers)
        self.frame: str = frame
        self.camera_frame: str | None = camera_frame
        self.y_down: bool | None = y_down

    def then(self, *solvers: Solver) -> Chain:
        """Return a chain with further solvers after those of this one."""
        return Chain(
            [*self.solvers, *solvers],
            frame=self.frame,
            camera_frame=self.camera_frame,
            y_down=self.y_down,
        )

    def solve(self, poses: Poses) -> Poses:
        """Return the poses after the last solver.

        Raises:
            CalibrationError: ``NOT_FINITE``: a pose has a value that is no finite number; and the
                errors of the solvers.
        """
        with np.errstate(all="ignore"):
            for solver in self.solvers:
                poses = solver.solve(poses)
        check_finite(poses.points, "chain: positions")
        check_finite(poses.quaternions, "chain: orientations")
        return poses

    def transform(self, points: ArrayLike) -> Array:
        """Map points of the camera (N, 2) to the robot's frame, (N, 3), metres."""
        return self.solve(Poses.planar(points)).points

    @overload
    def to_robot(self, localizations: Localization) -> Localization: ...
    @overload
    def to_robot(self, localizations: Iterable[Localization]) -> list[Localization]: ...
    def to_robot(
        self, localizations: Localization | Iterable[Localization]
    ) -> Localization | list[Localization]:
        """Return one or many localizations with their poses in the robot's frame.

        Names, qualities, numbers and times are those of the given localizations.

        Raises:
            CalibrationError: ``WRONG_FRAME``: a localization is in another frame than
                ``camera_frame``; and the errors of the solvers.
        """
        if isinstance(localizations, Localization):
            return self._map_localizations([localizations])[0]
        return self._map_localizations(list(localizations))

    def _map_localizations(self, parts: list[Localization]) -> list[Localization]:
        check_frames(parts, self.camera_frame, "chain: ")
        mapped = []
        for part in self.solve(Poses.of(parts)).replace_poses_of(parts):
            header = part.pose.header._replace(frame_id=self.frame)
            mapped.append(part._replace(pose=part.pose._replace(header=header)))
        return mapped


def check_frames(
    localizations: Sequence[Localization], frame: str | None, prefix: str = ""
) -> None:
    """Raise WRONG_FRAME if a localization is in another frame than ``frame``; None allows any.

    ``prefix`` begins the message.
    """
    frames = {part.pose.header.frame_id for part in localizations}
    if frame is not None and not frames <= {frame}:
        others = ", ".join(sorted(frames - {frame}))
        raise Code.WRONG_FRAME.error(
            f"{prefix}expected poses in the frame {frame!r}, got some in {others!r}", frame, others
        )


@check_arguments(calibration=of_class("PlaneCalibration"), origin=numbers, theta=a_finite_number)
def chain_of(
    calibration: PlaneCalibration, *, origin: ArrayLike = (0.0, 0.0), theta: float = 0.0
) -> Chain:
    """Return the chain of solvers that is equivalent to a plane's calibration.

    Args:
        calibration: calibration from :func:`~smartcam.calibration.fit_plane`.
        origin: (2,), the camera's point that becomes the plane's origin between the two solvers; it
            does not change results in the robot's frame, but it is the origin for solvers that are
            put in between.
        theta: the angle of the plane's x axis in the camera's coordinates, radians.

    Returns:
        The thesis' two solvers for ``rigid``, ``similarity`` and ``touches``; one
        :class:`PlaneProjection` for ``affine`` and ``homography``, where ``origin`` and ``theta``
        are ignored.

    Raises:
        CalibrationError: ``SHAPE`` or ``NOT_FINITE``: the origin is not valid.
    """
    frame, camera_frame = calibration.robot_frame, calibration.camera_frame
    y_down = calibration.y_down
    if calibration.model in {"affine", "homography"}:
        projection = PlaneProjection(calibration.matrix)
        return Chain([projection], frame=frame, camera_frame=camera_frame, y_down=y_down)
    origin_point = as_vector(origin, 2, "origin")
    rotation = matrix_from_quaternion(quaternion_about_z(theta))
    return Chain(
        [
            CameraPosition2D(origin_point, theta, calibration.scale),
            RealWorldPosition(
                calibration.transform([origin_point])[0], calibration.rotation @ rotation
            ),
        ],
        frame=frame,
        camera_frame=camera_frame,
        y_down=y_down,
    )
