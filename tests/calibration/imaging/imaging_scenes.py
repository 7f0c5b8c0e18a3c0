"""A camera, a sheet and robots that carry them."""

from __future__ import annotations

import math
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import pytest

from smartcam.calibration.detection.find import find_target
from smartcam.calibration.geometry.homography import apply_homography, fit_homography
from smartcam.calibration.lens.model import CameraModel
from smartcam.calibration.simulation.scenes import HandEyeScene, hand_eye_scene
from smartcam.calibration.targets import Checkerboard
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smartcam.calibration.hand_eye.equations import Setup
    from smartcam.calibration.views import TargetView

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


@contextmanager
def refused(code: str, *texts: str) -> Iterator[None]:
    """See that a calibration is refused with ``code``, and a text that holds ``texts``."""
    with pytest.raises(CalibrationError) as caught:
        yield
    assert caught.value.code == code
    for text in texts:
        assert text in str(caught.value)
