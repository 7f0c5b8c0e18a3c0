"""From what a camera sees to where a robot goes.

::

    calibration = fit_plane(camera_points, robot_points, touch_sigma=0.0002)
    result = await camera.trigger()
    for part in calibration.to_robot(result.value):
        ...

:func:`fit_plane` takes points that both have seen, :func:`fit_touches` the origin mark and touches
of the sheet's rays. Other ways begin with images::

    board = Checkerboard(columns=9, rows=6, square=0.025, origin_mark=True)
    views = [find_target(image, board) for image in images]
    lens = calibrate_intrinsics(views)
    lens.held_out                              # pixels, of views that were left out

Pixels are points, and images are arrays: who takes them is the user's business, as are the sockets
of cameras and robots. It needs the extra ``calibration``, which is imported where it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from smartcam.calibration.codes import Code, Remark
    from smartcam.calibration.detection.find import find_target
    from smartcam.calibration.hand_eye.calibration import (
        HandEyeCalibration,
        calibrate_hand_eye,
        calibrate_hand_eye_from_poses,
    )
    from smartcam.calibration.lens.intrinsics import IntrinsicCalibration, calibrate_intrinsics
    from smartcam.calibration.lens.model import CameraModel
    from smartcam.calibration.lens.poses import TargetPose, locate
    from smartcam.calibration.plane.calibration import Drift, PlaneCalibration, fit_plane
    from smartcam.calibration.plane.touches import fit_touches
    from smartcam.calibration.stereo.calibration import StereoCalibration, calibrate_stereo
    from smartcam.calibration.targets import Charuco, Checkerboard, CircleGrid
    from smartcam.calibration.views import TargetView

__all__ = [
    "CameraModel",
    "Charuco",
    "Checkerboard",
    "CircleGrid",
    "Code",
    "Drift",
    "HandEyeCalibration",
    "IntrinsicCalibration",
    "PlaneCalibration",
    "Remark",
    "StereoCalibration",
    "TargetPose",
    "TargetView",
    "calibrate_hand_eye",
    "calibrate_hand_eye_from_poses",
    "calibrate_intrinsics",
    "calibrate_stereo",
    "find_target",
    "fit_plane",
    "fit_touches",
    "locate",
]

_HOMES = {
    "CameraModel": "lens.model",
    "Charuco": "targets",
    "Checkerboard": "targets",
    "CircleGrid": "targets",
    "Code": "codes",
    "Drift": "plane.calibration",
    "HandEyeCalibration": "hand_eye.calibration",
    "IntrinsicCalibration": "lens.intrinsics",
    "PlaneCalibration": "plane.calibration",
    "Remark": "codes",
    "StereoCalibration": "stereo.calibration",
    "TargetPose": "lens.poses",
    "TargetView": "views",
    "calibrate_hand_eye": "hand_eye.calibration",
    "calibrate_hand_eye_from_poses": "hand_eye.calibration",
    "calibrate_intrinsics": "lens.intrinsics",
    "calibrate_stereo": "stereo.calibration",
    "find_target": "detection.find",
    "fit_plane": "plane.calibration",
    "fit_touches": "plane.touches",
    "locate": "lens.poses",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
