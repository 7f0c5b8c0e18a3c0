"""A camera, a sheet and robots that carry them."""

from __future__ import annotations

import math
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import pytest

from smartcam.calibration.imaging.cameras import CameraModel
from smartcam.calibration.imaging.simulation import HandEyeScene, hand_eye_scene
from smartcam.calibration.imaging.targets import Checkerboard
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.calibration.imaging.hand_eye_fit import Setup

CAMERA = CameraModel(
    size=(1280, 960),
    matrix=np.array([[1200.0, 0, 640], [0, 1190, 470], [0, 0, 1]]),
    distortion=np.array([-0.1, 0.02, 0.0005, -0.0003, 0.0]),
)
SHEET = Checkerboard(columns=5, rows=4, square=0.03)


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


@contextmanager
def refused(code: str, *texts: str) -> Iterator[None]:
    """See that a calibration is refused with ``code``, and a text that holds ``texts``."""
    with pytest.raises(CalibrationError) as caught:
        yield
    assert caught.value.code == code
    for text in texts:
        assert text in str(caught.value)
