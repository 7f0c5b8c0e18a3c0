"""Simulated calibrations of a lens, many and fast: least squares by chords from the truth."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration import CameraModel, IntrinsicCalibration, Transform
from smartcam.geometry._inside import Rigid, exp_rotation
from tests.calibration import lenskit
from tests.calibration.inside import Coverage, ViewFit, linearize, pixels_by_pose

if TYPE_CHECKING:
    from smartcam.calibration import TargetView
    from smartcam.geometry._inside import Array

SIGMA = 0.05


def spread_poses(camera: CameraModel, count: int, *, seed: int = 5) -> list[Transform]:
    """Return poses of the board all over the image, near and far, tilted."""
    random, size = np.random.default_rng(seed), np.array(camera.size)
    points = lenskit.BOARD.points
    found: list[Transform] = []
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    while len(found) < count:
        turn = exp_rotation(random.uniform(-0.6, 0.6, 3)) @ np.diag([1.0, -1.0, -1.0])
        ahead = np.append(camera.directions([random.uniform(0.1 * size, 0.9 * size)])[0], 1.0)
        shift = ahead * random.uniform(0.25, 0.5) - turn @ centre
        pose = Transform("camera", "target", turn, shift)
        pixels = camera.project(pose.apply(points))
        if ((pixels > 0) & (pixels < size - 1)).all(axis=1).sum() >= 20:
            found.append(pose)
    return found


class Bench:
    """A set of poses in front of a camera; calibrations differ by their noise."""

    def __init__(self, camera: CameraModel, poses: list[Transform], sigma: float = SIGMA) -> None:
        self.camera, self.poses, self.sigma = camera, poses, sigma
        self.values = 4 + len(camera.distortion)

    @functools.cached_property
    def views(self) -> list[TargetView]:
        """The view without noise."""
        return lenskit.seen(self.camera, self.poses, sigma=1e-9)

    @functools.cached_property
    def back(self) -> Array:
        """The derivatives of all unknowns by each coordinate of a pixel."""
        rows = []
        for number, (pose, view) in enumerate(zip(self.poses, self.views, strict=True)):
            at = linearize(pose.apply(view.object_points), self.camera)
            row = np.zeros((2 * len(view.ids), self.values + 6 * len(self.poses)))
            row[:, : self.values] = at.by_lens.reshape(-1, self.values)
            place = self.values + 6 * number
            turned = view.object_points @ pose.rotation.T
            row[:, place : place + 6] = pixels_by_pose(at.by_point, turned).reshape(-1, 6)
            rows.append(row)
        jacobian = np.concatenate(rows)
        scale = np.linalg.norm(jacobian, axis=0)
        found: Array = np.linalg.pinv(jacobian / scale) / scale[:, None]
        return found

    @functools.cached_property
    def covariance(self) -> Array:
        """The calibration of the lens."""
        found: Array = (self.sigma**2 * self.back @ self.back.T)[: self.values, : self.values]
        return found

    @functools.cached_property
    def gauge(self) -> Array:
        """The visible points, in the camera's frame."""
        return np.concatenate(
            [
                pose.apply(one.object_points)
                for pose, one in zip(self.poses, self.views, strict=True)
            ]
        )

    @functools.cache  # noqa: B019 - benches are few, and live as long as the tests
    def lens(self, seed: int) -> CameraModel:
        """Return the estimated lens under some noise."""
        (fx, _, cx), (_, fy, cy), _ = self.camera.matrix
        lens = np.concatenate([[fx, fy, cx, cy], self.camera.distortion])
        poses = Rigid.stack(one.rigid for one in self.poses)
        seen = np.concatenate([one.points.reshape(-1) for one in self.views])
        seen = seen + self.sigma * np.random.default_rng(seed).normal(size=len(seen))
        camera = self.camera
        for _ in range(3):
            off = seen - np.concatenate(
                [
                    camera.project(poses.subset(number).apply(view.object_points)).reshape(-1)
                    for number, view in enumerate(self.views)
                ]
            )
            step = self.back @ off
            lens = lens + step[: self.values]
            poses = poses.turned_in_target(step[self.values :].reshape(-1, 6))
            fx, fy, cx, cy = lens[:4]
            camera = CameraModel(
                size=camera.size,
                matrix=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
                distortion=lens[4:],
                distortion_model=camera.distortion_model,
            )
        return camera

    def calibration(self, seed: int | None = None) -> IntrinsicCalibration:
        """Return a calibration; without a seed there is no noise."""
        fits = [
            ViewFit(
                view=view,
                used=True,
                transform=pose,
                residuals=np.zeros_like(view.points),
                rms=self.sigma,
                held_out=1.1 * self.sigma,
            )
            for view, pose in zip(
                lenskit.seen(self.camera, self.poses, sigma=self.sigma), self.poses, strict=True
            )
        ]
        return IntrinsicCalibration(
            camera=self.camera if seed is None else self.lens(seed),
            covariance=self.covariance,
            views=tuple(fits),
            rms=self.sigma,
            sigma=0.0,
            held_out=1.1 * self.sigma,
            coverage=Coverage(1.0, 1.0, 1.0, 1.0),
            sheet=None,
            warnings=(),
        )


def rms(values: Array) -> float:
    """Return the root of the mean square."""
    return math.sqrt(float((values**2).mean()))
