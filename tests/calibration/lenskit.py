"""Cameras with known lenses, and their views of a target."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from smartcam.calibration import CameraModel, Checkerboard, TargetView, Transform
from tests.calibration.inside import _scenes as scenes

if TYPE_CHECKING:
    from smartcam.calibration._inside import Target
    from smartcam.geometry._inside import Array

__all__ = ["BOARD", "FISHEYE", "LEFT", "RIG", "RIGHT", "TURNED", "WIDE", "pairs", "poses", "seen"]

BOARD = Checkerboard(columns=9, rows=6, square=0.025)

LEFT = CameraModel(
    size=(640, 480),
    matrix=np.array([[530.0, 0.0, 325.0], [0.0, 531.0, 236.0], [0.0, 0.0, 1.0]]),
    distortion=np.array([-0.28, 0.07, 1e-3, -5e-4, 0.02]),
)
RIGHT = CameraModel(
    size=(640, 480),
    matrix=np.array([[541.0, 0.0, 317.0], [0.0, 540.0, 244.0], [0.0, 0.0, 1.0]]),
    distortion=np.array([-0.29, 0.1, -7e-4, 3e-4, 0.0]),
)
WIDE = CameraModel(
    size=(640, 480),
    matrix=np.array([[420.0, 0.0, 321.0], [0.0, 420.5, 242.0], [0.0, 0.0, 1.0]]),
    distortion=np.array([0.4, 0.1, 1e-4, -2e-4, 0.01, 0.75, 0.2, 0.02]),
    distortion_model="rational_polynomial",
)
FISHEYE = CameraModel(
    size=(800, 800),
    matrix=np.array([[260.0, 0.0, 400.0], [0.0, 260.0, 398.0], [0.0, 0.0, 1.0]]),
    distortion=np.array([0.02, -0.005, 0.001, 0.0]),
    distortion_model="equidistant",
)

TURNED = Rotation.from_euler("xyz", [math.pi - 0.3, 0.4, 0.1]).as_matrix()
"""R_camera_target of a sheet that faces the camera."""

RIG = Transform(
    "right",
    "left",
    Rotation.from_rotvec([0.01, -0.05, 0.02]).as_matrix(),
    np.array([-0.08, 0.001, 0.002]),
)


def poses(
    count: int, *, seed: int = 0, tilt: float = 0.6, distance: float = 0.35, name: str = "camera"
) -> list[Transform]:
    """Return poses of a target in front of a camera."""
    around = scenes.poses_around(
        BOARD, count, tilt=tilt, distance=distance, random=np.random.default_rng(seed)
    )
    found = [one.inverse() for one in around]
    return [Transform(name, "target", one.rotation, one.translation) for one in found]


def seen(
    camera: CameraModel,
    transforms: list[Transform],
    *,
    sigma: float = 0.05,
    seed: int = 1,
    target: Target = BOARD,
    points: Array | None = None,
) -> list[TargetView]:
    """Return views with noise; ``points``: places of the sheet's points, if not nominal."""
    random = np.random.default_rng(seed)
    views = []
    for number, transform in enumerate(transforms):
        pixels = camera.project(transform.apply(target.points if points is None else points))
        pixels = pixels + sigma * random.normal(size=pixels.shape)
        inside = ((pixels > 0) & (pixels < np.array(camera.size) - 1)).all(axis=1)
        views.append(
            TargetView(
                target=target,
                size=camera.size,
                ids=np.flatnonzero(inside),
                points=pixels[inside],
                covariance=np.tile(sigma**2 * np.eye(2), (int(inside.sum()), 1, 1)),
                name=f"{number:02d}",
            )
        )
    return views


def pairs(
    count: int, *, sigma: float = 0.05, seed: int = 0, points: Array | None = None
) -> tuple[list[TargetView], list[TargetView]]:
    """Return the views of both cameras of the rig."""
    lefts = poses(count, seed=seed, name="left")
    rights = [RIG @ one for one in lefts]
    return (
        seen(LEFT, lefts, sigma=sigma, seed=seed + 1, points=points),
        seen(RIGHT, rights, sigma=sigma, seed=seed + 2, points=points),
    )
