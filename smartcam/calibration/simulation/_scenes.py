"""Simulate cameras on robots, with noise, and compute the least possible error of calibrations.

No images are drawn: the points of a target are projected. Tests compare the result of a calibration
with the truth, and its error with the Cramer-Rao bound, which no unbiased estimate can beat.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration._hand_eye.equations import (
    PixelObservations,
    RobotNoise,
    RobotPoses,
    RobotSigmas,
    Solution,
    fisher_information,
)
from smartcam.calibration._views import TargetView
from smartcam.geometry import Transform
from smartcam.geometry._inside import Code, Rigid, exp_rotation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration._hand_eye.equations import Setup
    from smartcam.calibration._targets import Target
    from smartcam.geometry import CameraModel

MIN_VISIBLE_POINTS = 4
"""A view must have at least this many points in the image."""

GOLDEN_ANGLE_RADIANS = math.pi * (3.0 - math.sqrt(5.0))
"""Angle between neighbours of a spiral that covers a disc evenly, radians."""

EXACT_SIGMA_PX = 1e-9
"""Standard deviation, pixels, of the points in views without noise."""


def view(
    target: Target,
    camera: CameraModel,
    transform: Transform,
    *,
    sigma: float,
    random: np.random.Generator,
    name: str = "",
) -> TargetView:
    """Return a camera's view of a target.

    Args:
        target: target on the sheet.
        camera: the camera.
        transform: ``T_camera_target``.
        sigma: standard deviation of a coordinate of a point, pixels.
        random: source of the noise.
        name: name of the view, for messages.

    Returns:
        The points inside of the image.

    Raises:
        CalibrationError: ``OUT_OF_FIELD``: fewer than 4 points are inside of the image.
    """
    pixels = camera.project(transform.apply(target.points))
    pixels = pixels + sigma * random.normal(size=pixels.shape)
    is_inside = ((pixels >= -0.5) & (pixels < np.array(camera.size) - 0.5)).all(axis=1)
    ids = np.flatnonzero(is_inside)
    if len(ids) < MIN_VISIBLE_POINTS:
        raise Code.OUT_OF_FIELD.error(
            f"view: expected at least {MIN_VISIBLE_POINTS} points of the target in the image, got "
            f"{len(ids)} of {len(pixels)}",
            MIN_VISIBLE_POINTS,
            len(ids),
        )
    variance = max(sigma, EXACT_SIGMA_PX) ** 2
    covariance = np.broadcast_to(variance * np.eye(2), (len(ids), 2, 2)).copy()
    return TargetView(
        target=target,
        size=camera.size,
        ids=ids,
        points=pixels[ids],
        covariance=covariance,
        name=name,
    )


def poses_around(
    target: Target, count: int, *, tilt: float, distance: float, random: np.random.Generator
) -> list[Transform]:
    """Return poses of a camera that looks at a target's centre from points in a cone above it.

    Args:
        target: target that the camera looks at.
        count: number of poses.
        tilt: tilt of the outermost poses against the target's normal, radians.
        distance: mean distance from the target's centre, metres; distances vary by up to a fifth.
        random: source of the distances, and of the turns about the optical axis, up to 90 degrees.

    Returns:
        ``T_target_camera``, one for each pose.
    """
    centre = (target.points.min(axis=0) + target.points.max(axis=0)) / 2.0
    poses = []
    for index in range(count):
        polar = tilt * math.sqrt((index + 0.5) / count)
        azimuth = index * GOLDEN_ANGLE_RADIANS
        outwards = np.array(
            [
                math.sin(polar) * math.cos(azimuth),
                math.sin(polar) * math.sin(azimuth),
                math.cos(polar),
            ]
        )
        side = np.cross([0.0, 1.0, 0.0], -outwards)
        side /= np.linalg.norm(side)
        facing = np.column_stack([side, np.cross(-outwards, side), -outwards])
        roll = random.uniform(-math.pi / 2, math.pi / 2)
        rotation = facing @ exp_rotation(np.array([0.0, 0.0, roll]))
        pose_distance = distance * random.uniform(0.8, 1.2)
        poses.append(Transform("target", "camera", rotation, centre + pose_distance * outwards))
    return poses


class Bound(NamedTuple):
    """The least rms error that an unbiased calibration can have.

    Attributes:
        rotation: bound of the camera's orientation, all axes together, radians.
        translation: bound of the camera's position, all axes together, metres.
    """

    rotation: float
    translation: float


@dataclass(frozen=True, kw_only=True, eq=False)
class HandEyeScene:
    """The true poses of a robot, a camera and a target.

    Attributes:
        setup: place of the camera.
        camera: the camera.
        target: the target.
        camera_pose: ``T_flange_camera``; ``T_base_camera`` for a camera beside the robot.
        target_pose: ``T_base_target``; ``T_flange_target`` for a camera beside the robot.
        robot_poses: ``T_base_flange`` of each view.
    """

    setup: Setup
    camera: CameraModel
    target: Target
    camera_pose: Transform
    target_pose: Transform
    robot_poses: Sequence[Transform]

    def target_in_camera(self, robot_pose: Transform) -> Transform:
        """Return ``T_camera_target`` at a pose of the robot."""
        # T_flange_base, or T_base_flange: from the target's carrier to the camera's
        carrier_pose = robot_pose.inverse() if self.setup == "eye-in-hand" else robot_pose
        return self.camera_pose.inverse() @ carrier_pose @ self.target_pose

    def simulate_measurements(
        self, *, pixel_sigma: float, robot_sigmas: RobotSigmas, random: np.random.Generator
    ) -> tuple[list[Transform], list[TargetView]]:
        """Return the robot's poses with its controller's noise, and the views.

        Args:
            pixel_sigma: standard deviation of a coordinate, pixels.
            robot_sigmas: standard deviations of each axis of the robot's poses.
            random: source of the noise.

        Raises:
            CalibrationError: ``OUT_OF_FIELD``: the target is outside of an image.
        """
        views = [
            view(
                self.target,
                self.camera,
                self.target_in_camera(pose),
                sigma=pixel_sigma,
                random=random,
                name=f"view {number}",
            )
            for number, pose in enumerate(self.robot_poses)
        ]
        poses = [self._add_noise(pose, robot_sigmas, random) for pose in self.robot_poses]
        return poses, views

    def cramer_rao_bound(self, *, pixel_sigma: float, robot_sigmas: RobotSigmas) -> Bound:
        """Return the Cramer-Rao bound of the camera's pose.

        The target's pose and the robot's true poses are unknown, too. A sigma of 0 means values
        without noise, known to be exact.
        """
        # No unbiased estimate has a covariance below the inverse of Fisher's information,
        # J^T C^-1 J of the pixels; the robot's true poses are eliminated from it. Source: Kay,
        # Fundamentals of Statistical Signal Processing: Estimation Theory (1993), chapter 3.
        points = [self.target.points] * len(self.robot_poses)
        count = len(self.target.points)
        whitening = np.broadcast_to(np.eye(2) / pixel_sigma, (len(points), count, 2, 2))
        transforms = [self.target_in_camera(pose) for pose in self.robot_poses]
        pixels = [
            self.camera.project(transform.apply(self.target.points)) for transform in transforms
        ]
        no_heights = np.zeros((len(points), count, 0))
        observations = PixelObservations(
            whitening, self.camera, np.stack(points), np.stack(pixels), no_heights
        )
        poses = Rigid.stack(pose.rigid for pose in self.robot_poses)
        noise = RobotNoise(robot_sigmas) if max(robot_sigmas) > 0 else None
        truth = Solution(self.camera_pose.rigid, self.target_pose.rigid, noise=noise)
        information = fisher_information(
            RobotPoses(poses, self.setup == "eye-in-hand"), observations, truth
        )
        variances = np.diag(np.linalg.inv(information))
        return Bound(math.sqrt(variances[:3].sum()), math.sqrt(variances[3:6].sum()))

    def errors(self, camera_pose: Transform) -> tuple[float, float]:
        """Return the errors of a pose of the camera, in radians and metres."""
        turn = float(self.camera_pose.rigid.angle_to(camera_pose.rigid))
        return turn, float(np.linalg.norm(camera_pose.translation - self.camera_pose.translation))

    def _add_noise(
        self, pose: Transform, sigmas: RobotSigmas, random: np.random.Generator
    ) -> Transform:
        step = np.repeat(sigmas, 3) * random.normal(size=6)
        return Transform(pose.target, pose.source, *pose.rigid.turned_in_source(step))


def hand_eye_scene(
    target: Target,
    camera: CameraModel,
    *,
    setup: Setup,
    poses: int,
    tilt: float,
    distance: float,
    random: np.random.Generator,
) -> HandEyeScene:
    """Return a scene with a camera that looks at a target from points on a cone above it.

    Args:
        target: target that the camera looks at.
        camera: the camera.
        setup: place of the camera. A camera beside the robot is fixed, and the target moves.
        poses: number of poses of the robot.
        tilt: tilt of the outermost views against the target's normal, radians.
        distance: mean distance of camera and target, metres; distances vary by up to a fifth.
        random: source of the poses, and of the places of camera and target.
    """
    view_poses = poses_around(target, poses, tilt=tilt, distance=distance, random=random)
    tool_rotation = exp_rotation(random.uniform(-1.5, 1.5, size=3))
    tool_position = random.uniform(-0.1, 0.1, size=3)
    world_rotation = exp_rotation(random.uniform(-1.5, 1.5, size=3))
    world_position = random.uniform(-0.6, 0.6, size=3)
    if setup == "eye-in-hand":
        camera_pose = Transform("flange", "camera", tool_rotation, tool_position)
        target_pose = Transform("base", "target", world_rotation, world_position)
        robot = [target_pose @ view_pose @ camera_pose.inverse() for view_pose in view_poses]
    else:
        camera_pose = Transform("base", "camera", world_rotation, world_position)
        target_pose = Transform("flange", "target", tool_rotation, tool_position)
        robot = [
            camera_pose @ view_pose.inverse() @ target_pose.inverse() for view_pose in view_poses
        ]
    return HandEyeScene(
        setup=setup,
        camera=camera,
        target=target,
        camera_pose=camera_pose,
        target_pose=target_pose,
        robot_poses=robot,
    )
