"""The result of a hand-eye calibration, which maps pixels to the robot's base."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np

from smartcam.calibration._files import storage
from smartcam.calibration._hand_eye.equations import RobotSigmas, Setup
from smartcam.calibration._hand_eye.model_selection import errors_in_plane, intersect_plane
from smartcam.calibration._lens.poses import CAMERA, TARGET, PoseInCamera, check_view, half_turned
from smartcam.calibration._targets import resized
from smartcam.calibration._verdict import (
    VIEW_CURES,
    AdvisedVerdict,
    Allowed,
    CalibrationVerdict,
    judge,
)
from smartcam.calibration._views import TargetView
from smartcam.geometry import CameraModel, Transform
from smartcam.geometry._inside import Array, Code, as_motion, as_points, check_finite
from smartcam.models import Pose

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

    from smartcam.calibration._targets import Target

KIND = "hand-eye"
"""Kind of these calibrations, as their files name it."""


def _frames(context: storage.Context, subject: str) -> tuple[str, str]:
    """Return the names of the two frames of the pose of a flange, camera or target."""
    base, flange = context.get("frames", ("", ""))
    on_flange = (subject == CAMERA) == (context.get("setup") == "eye-in-hand")
    return (base, flange) if subject == "flange" else (flange if on_flange else base, subject)


FlangePose = Annotated[Transform, storage.motion(lambda known: _frames(known, "flange"))]
CameraPlace = Annotated[Transform, storage.motion(lambda known: _frames(known, CAMERA))]
TargetPlace = Annotated[Transform, storage.motion(lambda known: _frames(known, TARGET))]
NullableNumbers = Annotated[Array, storage.rows(storage.Number | None, min_length=3, nulls=True)]
FrameNames = Annotated[tuple[str, str], storage.row(tuple[str, str])]
SIGMAS_FORM = storage.row(tuple[storage.Number, storage.Number], RobotSigmas._make)
COVARIANCE_FORM = storage.Form(
    list[list[storage.Number]] | None,
    lambda rows, _: np.full((12, 12), np.nan) if rows is None else storage.as_array(rows),
    lambda rows: rows.tolist() if np.isfinite(rows).all() else None,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class HandEyeCalibration(storage.SavedCalibration):
    """The result of :func:`~smartcam.calibration.calibrate_hand_eye`; immutable.

    Attributes:
        setup: ``eye-in-hand`` or ``eye-to-hand``.
        camera_pose: ``T_flange_camera``; ``T_base_camera`` for a camera beside the robot.
        target_pose: ``T_base_target``; ``T_flange_target`` for a camera beside the robot. It is
            that of a target with ``target_scale`` applied, see :attr:`target`.
        camera: the camera; None if poses of the target were given instead of views.
        target_scale: size of the target over the nominal one, as the robot's motions show it; 1 if
            it was not adjusted. ``camera_pose``, ``target_pose`` and all errors are those of the
            target of this size; a remark ``SCALE_MISMATCH`` says that it is more than half a
            percent off the nominal one. If a ruler shows that the target has its nominal size, the
            lengths of the robot or of the lens are off by this factor.
        method: name of the chosen candidate: ``robot`` or ``reprojection``, or a closed form; after
            a comma, the adjusted values.
        candidate_errors: RMS held-out error of each candidate on the target, metres; None for a
            candidate without one.
        errors: (V,), RMS error of each pose on the target, metres, with the solution from all used
            poses; NaN for a bad pose in which the target would be behind the camera.
        mean_error: mean error over all points of the used poses, metres, which others publish as 3D
            error.
        leave_one_out: (V,), RMS error of each pose, metres, with a calibration from the other poses
            and the robot's pose as given; NaN if there is none.
        held_out_error: RMS of the left-out errors over all points of the used poses, metres; None
            if there is none. It is the error to expect in picking.
        covariance: (12, 12), of small steps of ``camera_pose`` (turn about its own axes, rad; shift
            along the axes of flange or base, m) and of ``target_pose``, from the scatter of the
            solutions without each pose; if another candidate is as likely, it is included. A
            given lens is taken as exact unless it was adjusted; the error of a lens calibrated from
            the same views is included. NaN with fewer than 5 poses.
        robot_sigmas: standard deviations of each axis of the robot's poses, as given or estimated;
            None if the poses were taken as exact.
        robot_poses: ``T_base_flange``, as given.
        used: whether each pose was used; False for a bad pose.
        views: views as given, but all numbered from the same end of a target that looks the same
            after half a turn; empty if poses were given.
        target_poses: ``T_camera_target`` of each pose, from its own view or as given.
        allowed_error: largest error, metres, that the user allows for 95 of 100 points on the
            target; None: :attr:`verdict` takes a hundredth of the target's distance.
        warnings: remarks to read before using the calibration.
    """

    kind: ClassVar[str] = KIND
    _label: ClassVar[str] = "hand-eye calibration"
    _keys: ClassVar[storage.Keys] = {"candidate_errors": "candidates"}
    _extra_keys: ClassVar[storage.ExtraKeys] = {
        "frames": (
            FrameNames,
            lambda result: (result.robot_poses[0].target, result.robot_poses[0].source),
        ),
        "target": (
            storage.StoredTarget | None,
            lambda result: result.views[0].target if result.views else None,
        ),
    }
    _context_keys: ClassVar[frozenset[str]] = frozenset({"frames", "setup", "target"})
    _optional_keys: ClassVar[frozenset[str]] = frozenset({"allowed_error"})

    setup: Setup
    camera_pose: CameraPlace
    target_pose: TargetPlace
    camera: CameraModel | None
    target_scale: storage.Positive
    method: str
    candidate_errors: dict[str, storage.Number | None]
    errors: NullableNumbers
    mean_error: storage.NonNegative
    leave_one_out: NullableNumbers
    held_out_error: storage.Number | None
    covariance: Annotated[Array, COVARIANCE_FORM]
    robot_sigmas: Annotated[RobotSigmas, SIGMAS_FORM] | None
    robot_poses: Annotated[tuple[FlangePose, ...], storage.AsList(3)]
    used: Annotated[tuple[bool, ...], storage.AsList(3)]
    views: Annotated[tuple[TargetView, ...], storage.AsList()] = ()
    target_poses: Annotated[tuple[PoseInCamera, ...], storage.AsList(3)] = ()
    allowed_error: storage.Positive | None = None
    warnings: storage.Remarks = ()

    def __post_init__(self) -> None:
        for array in (self.errors, self.leave_one_out, self.covariance):
            array.flags.writeable = False

    def _check(self, fields: Mapping[str, Any], label: str) -> None:
        count = len(self.robot_poses)
        names = ("errors", "leave_one_out", "used", "target_poses")
        storage.check_counts(fields, names, count, label)
        if self.views and (fields["target"] is None or len(self.views) != count):
            raise storage.invalid_data_error(
                label, f"views: expected {count}, and their target", len(self.views)
            )
        if self.covariance.shape != (12, 12):
            rows = len(self.covariance)
            raise storage.invalid_data_error(label, "covariance: expected 12 rows of 12", rows)

    @property
    def target(self) -> Target | None:
        """Target with ``target_scale`` applied; None if poses of it were given."""
        return resized(self.views[0].target, self.target_scale) if self.views else None

    @property
    def verdict(self) -> CalibrationVerdict:
        """Verdict on the calibration's quality, the millimetres it is good for, and the cure."""
        return self.judged().verdict

    @property
    def allowed(self) -> Allowed:
        """Largest allowed error, as the user gave it or from the target's distance."""
        distances = [float(np.linalg.norm(pose.translation)) for pose in self.target_poses]
        return Allowed.of(self.allowed_error, self.target_scale * float(np.median(distances)))

    def judged(self) -> AdvisedVerdict:
        """Return the verdict and the advice; unknown with few poses, whose error says nothing."""
        held_out, codes = self.held_out_error, {warning.code for warning in self.warnings}
        unused = [str(number) for number, used in enumerate(self.used, 1) if not used]
        plural = "s" * (len(unused) > 1)
        judgement = judge(
            None if held_out is None or Code.TOO_FEW in codes else 1e3 * held_out,
            [
                warning
                for warning in self.warnings
                if not (unused and warning.code == Code.BAD_VIEW)
            ],
            worst=1 + self.worst,
            allowed=self.allowed,
            cures=VIEW_CURES,
            advice="take more views",
            where=f" without view{plural} {', '.join(unused)}" if unused else "",
        )
        if judgement.verdict.level != "good":
            return judgement
        if not self.used[-1]:
            text = (
                "Not known how good: the last view does not fit, and may show that something "
                "moved: take more views"
            )
            return AdvisedVerdict(CalibrationVerdict("unknown", text), option="more")
        position_error = 1e3 * self.translation_error
        if position_error > self.allowed.error:
            text = (
                f"{judgement.verdict.text}. Only while the hand is turned as in these views: the "
                f"camera's place is known to {position_error:.2g} mm, so points seen at other "
                "orientations may be that far off; views with larger turns show the place better"
            )
            return judgement._replace(verdict=CalibrationVerdict("good", text))
        return judgement

    @property
    def rotation_error(self) -> float:
        """Expected rms error of the camera's orientation, all axes together, radians, or NaN."""
        return math.sqrt(float(np.trace(self.covariance[:3, :3])))

    @property
    def translation_error(self) -> float:
        """Expected rms error of the camera's position, all axes together, metres, or NaN."""
        return math.sqrt(float(np.trace(self.covariance[3:6, 3:6])))

    @property
    def worst(self) -> int:
        """Index of the pose with the largest held-out error; if one has none, the largest error."""
        errors = self.errors if np.isnan(self.leave_one_out).any() else self.leave_one_out
        return int(np.argmax(errors))

    def camera_at(self, robot_pose: Transform | Pose | None = None) -> Transform:
        """Return ``T_base_camera``.

        Args:
            robot_pose: ``T_base_flange``; not needed for a camera beside the robot.

        Raises:
            CalibrationError: ``WRONG_FRAME``: there is no pose, or it is in other frames.
        """
        if self.setup == "eye-to-hand":
            return self.camera_pose
        if robot_pose is None:
            raise Code.WRONG_FRAME.error(
                "eye-in-hand: expected the robot's pose when the image was taken, got none",
                "a pose of the robot",
            )
        return as_transform(robot_pose, self.camera_pose.target) @ self.camera_pose

    def to_plane(
        self,
        pixels: ArrayLike,
        *,
        plane: Transform,
        robot_pose: Transform | Pose | None = None,
        height: float = 0.0,
    ) -> Array:
        """Map pixels to a plane, at any pose of the robot.

        Args:
            pixels: (N, 2).
            plane: ``T_base_plane``; the plane is its z = 0. For a camera on the hand
                ``target_pose`` is one.
            robot_pose: ``T_base_flange`` when the image was taken; not needed for a camera beside
                the robot.
            height: height of the features over the plane, along its z, metres.

        Returns:
            (N, 3), in the robot's base, metres.

        Raises:
            CalibrationError: SHAPE or NOT_FINITE; WRONG_FRAME; OUT_OF_FIELD: a ray does not meet
                the plane in front of the camera; NO_CALIBRATION: the calibration has no lens.
        """
        lens, pixel_array = self._lens("to_plane"), as_points(pixels, 2, "pixels")
        mapped = _intersect_rays(
            lens, pixel_array, self.camera_at(robot_pose).inverse() @ plane, height, "to_plane"
        )
        places = plane.apply(mapped)
        check_finite(places, "to_plane: points")
        return places

    def point_errors(
        self,
        robot_poses: Sequence[Transform | Pose],
        views: Sequence[TargetView | Transform],
    ) -> tuple[Array, ...]:
        """Return the errors of the calibration on the target, at any poses of the robot.

        Poses and views that it was not made from show how good it is. The error of a point is the
        distance, in the target's plane, between its ray and its place by the robot's pose.

        Args:
            robot_poses: ``T_base_flange``.
            views: views of the same target in the same place, one for each pose; or
                ``T_camera_target``, whose error is that of the target's origin.

        Returns:
            For each view (N,), for each pose of the target (1,), metres; infinite if a ray does not
            meet the target's plane in front of the camera.

        Raises:
            CalibrationError: SHAPE: the numbers of poses and views differ; ``WRONG_FRAME``: poses
                are in other frames; ``DIFFERENT_TARGETS``; ``NO_CALIBRATION``: there are views, but
                the calibration has no lens; and those of
                :func:`~smartcam.calibration._lens.poses.check_view`.
        """
        if len(robot_poses) != len(views):
            raise Code.SHAPE.error(
                f"point_errors: expected as many views as poses of the robot, got {len(views)} and "
                f"{len(robot_poses)}",
                len(robot_poses),
                len(views),
            )
        return tuple(
            self._view_errors(as_transform(pose, self._flange_frame).undated(), view)
            for pose, view in zip(robot_poses, views, strict=True)
        )

    def _view_errors(self, robot_pose: Transform, view: TargetView | Transform) -> Array:
        in_hand = self.setup == "eye-in-hand"
        carrier_motion = robot_pose.inverse() if in_hand else robot_pose
        target_pose = self.camera_pose.inverse() @ carrier_motion @ self.target_pose
        if isinstance(view, Transform):
            offset = target_pose.translation - self.target_scale * view.translation
            return np.array([float(np.linalg.norm(offset))])
        lens = self._lens("point_errors")
        check_view(view, lens.size)
        if self.views and view.target != self.views[0].target:
            raise Code.DIFFERENT_TARGETS.error(
                f"point_errors: expected views of {self.views[0].target}, got one of {view.target}",
                self.views[0].target,
                view.target,
            )
        numberings = (view, half_turned(view)) if view.target.half_turn_symmetric else (view,)
        errors_of_numberings = [
            errors_in_plane(
                lens,
                target_pose.rigid,
                numbered_view.points,
                self.target_scale * numbered_view.object_points,
            )
            for numbered_view in numberings
        ]
        errors = min(errors_of_numberings, key=lambda view_errors: float(np.median(view_errors)))
        return errors if errors is errors_of_numberings[0] else errors[::-1]

    @property
    def _flange_frame(self) -> str:
        return (self.camera_pose if self.setup == "eye-in-hand" else self.target_pose).target

    def predicted_error(
        self,
        pixels: ArrayLike,
        *,
        plane: Transform,
        robot_pose: Transform | Pose | None = None,
    ) -> Array:
        """Return the RMS error to expect of :meth:`to_plane` from the camera's pose alone.

        The robot's own error at ``robot_pose`` and that of the pixels are not included, nor is that
        of the lens unless it was adjusted.

        Args:
            pixels: (N, 2).
            plane: as for :meth:`to_plane`.
            robot_pose: as for :meth:`to_plane`.

        Returns:
            (N,), metres; NaN if :attr:`covariance` is.

        Raises:
            CalibrationError: as for :meth:`to_plane`.
        """
        lens, pixel_array = self._lens("predicted_error"), as_points(pixels, 2, "pixels")
        carrier_pose = self.camera_at(robot_pose) @ self.camera_pose.inverse()
        # J by central differences over steps of the camera's pose; the covariance is J C J^T.
        slopes, step = [], 1e-6
        for axis in range(6):
            shifted_points = []
            for shift in (-step, step):
                moved_pose = self.camera_pose.rigid.turned_in_source(shift * np.eye(6)[axis])
                camera_pose = carrier_pose @ Transform(
                    self.camera_pose.target, self.camera_pose.source, *moved_pose
                )
                shifted_points.append(
                    _intersect_rays(
                        lens, pixel_array, camera_pose.inverse() @ plane, 0.0, "predicted_error"
                    )
                )
            slopes.append((shifted_points[1] - shifted_points[0]) / (2 * step))
        jacobian = np.stack(slopes, axis=-1)
        joint = jacobian @ self.covariance[:6, :6] @ np.swapaxes(jacobian, 1, 2)
        error: Array = np.sqrt(np.trace(joint, axis1=1, axis2=2))
        return error

    def _lens(self, label: str) -> CameraModel:
        if self.camera is None:
            raise Code.NO_CALIBRATION.error(
                f"{label}: expected a calibration with the camera's lens, got one from poses of "
                "the target",
                "camera",
            )
        return self.camera


def _intersect_rays(
    camera: CameraModel, pixels: Array, plane: Transform, height: float, label: str
) -> Array:
    """Return the points at which pixels' rays meet a plane, in its frame; raise OUT_OF_FIELD.

    ``plane``: ``T_camera_plane``; the rays meet it at ``height`` above its z = 0, metres.
    ``label`` names the caller.
    """
    rays = np.column_stack([camera.directions(pixels), np.ones(len(pixels))])
    raised_origin = plane.rotation[:, 2] * height + plane.translation
    points = intersect_plane(rays, plane.rotation, raised_origin)
    is_missed = ~np.isfinite(points).all(axis=1)
    if is_missed.any():
        row = int(np.argmax(is_missed))
        raise Code.OUT_OF_FIELD.error(
            f"{label}: expected pixels whose rays meet the plane in front of the camera, got "
            f"{pixels[row].tolist()} in row {row}, whose ray does not",
            got=pixels[row].tolist(),
        )
    in_plane: Array = points + np.array([0.0, 0.0, height])
    return in_plane


def as_transform(pose: Transform | Pose, flange: str) -> Transform:
    """Return ``T_base_flange`` of a pose of the robot, in whichever form it is given.

    Raises SHAPE if the form is unknown.
    """
    if isinstance(pose, Pose):
        return Transform.from_pose(pose, flange)
    return as_motion(pose, "pose of the robot", "base", flange)
