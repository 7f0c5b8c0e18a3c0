"""Use a camera that the robot carries from another pose than the one it was calibrated at.

The calibration holds for the robot's pose at which it was made, ``T_cal``. At another pose,
``T_now``, the camera and everything that it sees have moved by the rigid motion ``T_now T_cal^-1``
in the robot's frame. So this motion is applied *after* the static chain. The thesis with
which smartcam began, 3.2.5.2, applies the motion before the chain. That would be right only if the
camera's place on the robot were known, which a plane's calibration does not determine.

This is right as long as the camera sees the plane of the parts at its calibrated place: the motion
must map the plane onto itself, as shifts within the plane and turns about its normal do. After a
camera is raised or tilted, the same pixels show other places, so such poses are refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration._solvers import Chain, Poses, Solver
from smartcam.geometry._inside import Code, as_points

if TYPE_CHECKING:
    from datetime import datetime

    from numpy.typing import ArrayLike

    from smartcam.geometry import Transform
    from smartcam.geometry._inside import Array


@dataclass(eq=False)
class RigidMotion:
    """A solver that moves all poses by one rigid motion, in the frame of the poses."""

    motion: Transform  # motion from the robot's frame into the robot's frame

    def solve(self, poses: Poses) -> Poses:
        """Return the poses after the motion."""
        return poses.moved(self.motion.rotation, self.motion.translation)


class MovingCamera:
    """A calibrated camera on a robot that moves.

    Args:
        static: solver from the camera, at the pose of its calibration, to the robot's frame.
        calibration_pose: pose of the robot at the calibration, ``T_base_flange``, or that of any
            part of the robot to which the camera is fixed.
        field: (N, 3), three points or more in the plane, in the robot's frame, metres: the touched
            ones. The plane must not move at these points.
        tolerance: largest distance that the plane may move out of itself at any point of the field,
            metres. A touch by hand is accurate to a fifth of a millimetre.
        max_lag: longest time between a pose of the robot and the image, seconds. At 250 mm/s the
            robot moves 5 mm in 20 ms, 0.25 mm in 1 ms.

    Raises:
        CalibrationError: ``SHAPE``, ``NOT_FINITE``, ``TOO_FEW`` or ``COLLINEAR`` points of the
            field.
    """

    def __init__(
        self,
        static: Solver,
        calibration_pose: Transform,
        *,
        field: ArrayLike,
        tolerance: float = 2e-4,
        max_lag: float = 1e-3,
    ) -> None:
        points = as_points(field, 3, "moving camera: points of the field")
        if len(points) < 3:
            raise Code.TOO_FEW.error_with_value(
                "moving camera: expected 3 points of the field or more", 3, len(points)
            )
        self._static = static
        self._calibration_pose = calibration_pose
        self._tolerance = tolerance
        self._max_lag = timedelta(seconds=max_lag)
        self._centre: Array = points.mean(axis=0)
        _, spread, axes = np.linalg.svd(points - self._centre)
        if not spread[1] > 1e-6 * spread[0]:
            raise Code.COLLINEAR.error(
                "moving camera: expected points of the field that are not on one line, got "
                f"{spread[1]:.3g} m across it",
                got=float(spread[1]),
            )
        self._normal: Array = axes[2]
        heights = (points - self._centre) @ self._normal
        self._field = points - np.outer(heights, self._normal)  # without the touches' noise

    def at_pose(self, pose: Transform, image_at: datetime | None = None) -> Chain:
        """Return the chain of solvers for an image that was taken at a pose.

        Args:
            pose: the robot's pose at the image, in the same frames as ``calibration_pose``.
                :meth:`~smartcam.calibration.PoseHistory.at` gives the pose at the time of an image
                from those before and after it.
            image_at: time of the image. A localization's header has the time of its arrival, which
                is later; ``Result.triggered_at`` is nearer. None if the robot stood still between
                the image and the pose.

        Raises:
            CalibrationError: ``WRONG_FRAME``: a pose of other frames; ``NOT_SIMULTANEOUS``: pose
                and image are more than ``max_lag`` apart, or the pose has no time; ``BAD_TIME``:
                the time of the image has no time zone; ``PLANE_MOVED``: the plane of the parts
                would not be where the camera saw it.
        """
        self._check_frames(pose)
        if image_at is not None:
            self._check_time(pose, image_at)
        motion = pose.undated() @ self._calibration_pose.undated().inverse()
        self._check_plane(motion)
        chain = self._static if isinstance(self._static, Chain) else Chain([self._static])
        return Chain(
            [self._static, RigidMotion(motion)],
            frame=pose.target,
            camera_frame=chain.camera_frame,
            y_down=chain.y_down,
        )

    def _check_frames(self, pose: Transform) -> None:
        expected = self._calibration_pose
        if (pose.target, pose.source) != (expected.target, expected.source):
            raise Code.WRONG_FRAME.error_with_value(
                f"moving camera: expected {expected.label}, as it was calibrated",
                expected.label,
                pose.label,
            )

    def _check_time(self, pose: Transform, image_at: datetime) -> None:
        if pose.at is None:
            raise Code.NOT_SIMULTANEOUS.error(
                f"moving camera: expected the time of {pose.label}, to compare it with the "
                "image's, got none",
                image_at,
            )
        if image_at.tzinfo is None:
            raise Code.BAD_TIME.error_with_value(
                "moving camera: expected an image's time with its time zone",
                "a time with its time zone",
                image_at,
            )
        lag = abs(pose.at - image_at)
        if lag > self._max_lag:
            raise Code.NOT_SIMULTANEOUS.error(
                f"moving camera: expected a pose within {1e3 * self._max_lag.total_seconds():g} ms "
                f"of the image, got one {1e3 * lag.total_seconds():g} ms from it",
                self._max_lag,
                lag,
            )

    def _check_plane(self, motion: Transform) -> None:
        """Raise PLANE_MOVED if a motion shifts, tilts or flips the plane."""
        distance = float(np.abs((motion.apply(self._field) - self._centre) @ self._normal).max())
        cosine = float((motion.rotation @ self._normal) @ self._normal)
        if distance <= self._tolerance and cosine > 0:
            return
        rise = abs(float((motion.apply(self._centre) - self._centre) @ self._normal))
        sine = float(np.linalg.norm(np.cross(motion.rotation @ self._normal, self._normal)))
        tilt = math.degrees(math.atan2(sine, cosine))
        raise Code.PLANE_MOVED.error(
            f"moving camera: expected a motion that keeps the plane of the parts within "
            f"{1e3 * self._tolerance:g} mm, got one that shifts it by {1e3 * rise:.2f} mm along "
            f"its normal and tilts it by {tilt:.2f} deg: {1e3 * distance:.2f} mm at the worst "
            "point of the field. A camera that is raised or tilted needs a calibration of its own "
            "there",
            self._tolerance,
            distance,
        )
