"""Images of targets whose points are known."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from smartcam.calibration.geometry.frames import Transform
from smartcam.calibration.lens.model import CameraModel
from smartcam.calibration.simulation.images import render

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.targets import Target
    from smartcam.calibration.views import TargetView

STRAIGHT = CameraModel(
    size=(640, 480), matrix=np.array([[600, 0, 318.3], [0, 602, 241.7], [0, 0, 1]])
)
BENT = CameraModel(
    size=(640, 480),
    matrix=STRAIGHT.matrix,
    distortion=np.array([-0.2, 0.08, 0.001, -0.0005, 0.0]),
)
FACING = np.diag([1.0, -1.0, -1.0])
"""The rotation of a sheet that stands upright before the camera."""


class Drawn(NamedTuple):
    """An image of a target.

    Attributes:
        image: (H, W).
        target: what it shows.
        pixels: (N, 2), where its points are.
    """

    image: NDArray[np.uint8]
    target: Target
    pixels: Array

    def off(self, view: TargetView) -> Array:
        """Return (N,): how far from the truth a view has its points, pixels."""
        off: Array = np.linalg.norm(view.points - self.pixels[view.ids], axis=1)
        return off


def facing(target: Target, tilt: float = 0.0, roll: float = 0.0, away: float = 0.45) -> Transform:
    """Return a pose, its middle before the camera; tilted to the left and back, then rolled."""
    turn = Rotation.from_euler("z", roll, degrees=True).as_matrix()
    turn = turn @ Rotation.from_rotvec([0.6 * tilt, 0.8 * tilt, 0], degrees=True).as_matrix()
    middle = turn @ FACING @ target.points.mean(axis=0)
    return Transform("camera", "target", turn @ FACING, np.array([0, 0, away]) - middle)


_drawn: dict[tuple[object, ...], tuple[CameraModel, NDArray[np.uint8]]] = {}


def drawn(
    target: Target,
    *,
    camera: CameraModel = BENT,
    tilt: float = 0.0,
    roll: float = 0.0,
    away: float = 0.45,
    blur: float = 0.7,
    noise: float = 0.0,
) -> Drawn:
    """Return an image of a target; angles in degrees, metres, pixels, grey levels."""
    pose = facing(target, tilt, roll, away)
    key = (target, id(camera), tilt, roll, away, blur, noise)
    if key not in _drawn:  # with its camera, whose id is then no other's
        _drawn[key] = camera, render(target, camera, pose, blur=blur, noise=noise)
    pixels = camera.project(target.points @ pose.rotation.T + pose.translation)
    return Drawn(_drawn[key][1].copy(), target, pixels)
