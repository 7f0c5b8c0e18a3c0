"""A camera, a sheet and robots that carry them; images of targets whose points are known."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from smartcam.calibration import CameraModel, Checkerboard, Transform, find_target
from smartcam.calibration.simulation import HandEyeScene, hand_eye_scene, render
from tests.calibration.inside import apply_homography, fit_homography
from tests.geometry.rigid import refused as refused

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration import TargetView
    from smartcam.calibration._inside import Target
    from smartcam.geometry._inside import Array
    from tests.calibration.inside import Setup

CAMERA = CameraModel(
    size=(1280, 960),
    matrix=np.array([[1200.0, 0, 640], [0, 1190, 470], [0, 0, 1]]),
    distortion=np.array([-0.1, 0.02, 0.0005, -0.0003, 0.0]),
)
SHEET = Checkerboard(columns=5, rows=4, square=0.03)
PAIRS_BOARD = Checkerboard(columns=9, rows=6, square=0.025)
"""In OpenCV's pairs."""


def scene(setup: Setup, *, poses: int = 9, tilt: float = 30.0, seed: int = 5) -> HandEyeScene:
    """Return a robot with a camera; ``tilt`` of the outermost views in degrees."""
    return hand_eye_scene(
        SHEET,
        CAMERA,
        setup=setup,
        poses=poses,
        tilt=math.radians(tilt),
        distance=0.5,
        random=np.random.default_rng(seed),
    )


def off_plane(view: TargetView) -> float:
    """Return the rms distance of points from a flat sheet seen without distortion, pixels."""
    flat = view.object_points[:, :2]
    matrix = fit_homography(flat, view.points)
    assert matrix is not None
    off = apply_homography(matrix, flat) - view.points
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def check_pair(left_image: NDArray[np.uint8], right_image: NDArray[np.uint8], name: str) -> None:
    """See that one of OpenCV's pairs has the same origin in both images."""
    left, right = (find_target(image, PAIRS_BOARD) for image in (left_image, right_image))
    apart = left.points - right.points
    # the cameras stand side by side: rows agree, columns differ alike
    assert np.ptp(apart[:, 1]) < 40, name
    assert (apart[:, 0] > 60).all(), name
    assert np.median(left.sigmas) < 0.03, name
    assert off_plane(left) < 4, name


# ---------------------------------------------------------------------- images of targets


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
