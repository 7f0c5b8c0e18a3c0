"""Calibration from images: printed targets, lenses, pairs of cameras, cameras on robots.

::

    board = Checkerboard(columns=9, rows=6, square=0.025, origin_mark=True)
    views = [find_target(image, board) for image in images]
    lens = calibrate_intrinsics(views)
    lens.held_out                              # pixels, of views that were left out

Pixels are points, and images are arrays: who takes them is the user's business. It needs the extra
``calibration``, which is imported where it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from smartcam.calibration.imaging.cameras import CameraModel
    from smartcam.calibration.imaging.detection import find_target
    from smartcam.calibration.imaging.hand_eye import (
        HandEyeCalibration,
        calibrate_hand_eye,
        calibrate_hand_eye_from_poses,
    )
    from smartcam.calibration.imaging.intrinsics import IntrinsicCalibration, calibrate_intrinsics
    from smartcam.calibration.imaging.poses import TargetPose, locate
    from smartcam.calibration.imaging.stereo import StereoCalibration, calibrate_stereo
    from smartcam.calibration.imaging.targets import Charuco, Checkerboard, CircleGrid
    from smartcam.calibration.imaging.views import TargetView

__all__ = [
    "CameraModel",
    "Charuco",
    "Checkerboard",
    "CircleGrid",
    "HandEyeCalibration",
    "IntrinsicCalibration",
    "StereoCalibration",
    "TargetPose",
    "TargetView",
    "calibrate_hand_eye",
    "calibrate_hand_eye_from_poses",
    "calibrate_intrinsics",
    "calibrate_stereo",
    "find_target",
    "locate",
]

_HOMES = {
    "CameraModel": "cameras",
    "Charuco": "targets",
    "Checkerboard": "targets",
    "CircleGrid": "targets",
    "HandEyeCalibration": "hand_eye",
    "IntrinsicCalibration": "intrinsics",
    "StereoCalibration": "stereo",
    "TargetPose": "poses",
    "TargetView": "views",
    "calibrate_hand_eye": "hand_eye",
    "calibrate_hand_eye_from_poses": "hand_eye",
    "calibrate_intrinsics": "intrinsics",
    "calibrate_stereo": "stereo",
    "find_target": "detection",
    "locate": "poses",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
