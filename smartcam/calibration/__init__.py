"""Calibrate cameras, and map what they see to poses for a robot.

::

    calibration = fit_plane(camera_points, robot_points, touch_sigma=0.0002)
    result = await camera.trigger()
    for part in calibration.to_robot(result.value):
        ...

:func:`fit_plane` takes points that camera and robot have both measured. :func:`fit_touches` takes
the seen origin mark of a sheet, and points that the robot touched on the lines printed on it. Other
calibrations begin with images::

    board = Checkerboard(columns=9, rows=6, square=0.025, origin_mark=True)
    views = [find_target(image, board) for image in images]
    lens = calibrate_intrinsics(views)
    lens.held_out                              # rms error, pixels, in views that were left out

Pixels and images are arrays: the caller takes the pictures, and talks to cameras and robots. The
package needs the extra ``calibration``, whose libraries are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.calibration._detection.find import find_target
    from smartcam.calibration._drawing.draw import draw_scene, draw_uncertainty, draw_views
    from smartcam.calibration._files.directory import Folder
    from smartcam.calibration._files.load import load_calibration
    from smartcam.calibration._hand_eye.calibration import (
        calibrate_hand_eye,
        calibrate_hand_eye_from_poses,
    )
    from smartcam.calibration._hand_eye.equations import RobotSigmas
    from smartcam.calibration._hand_eye.result import HandEyeCalibration
    from smartcam.calibration._hand_eye.time_offset import estimate_time_offset
    from smartcam.calibration._lens.comparison import compare_lenses
    from smartcam.calibration._lens.guide import suggest_views
    from smartcam.calibration._lens.intrinsics import IntrinsicCalibration, calibrate_intrinsics
    from smartcam.calibration._lens.poses import locate
    from smartcam.calibration._plane.calibration import PlaneCalibration, fit_plane
    from smartcam.calibration._plane.moving_camera import MovingCamera
    from smartcam.calibration._plane.tool import fit_tool_tip
    from smartcam.calibration._plane.touches import fit_touches
    from smartcam.calibration._printing.sheets import make_sheet, scale_target
    from smartcam.calibration._sheet.calibration import (
        SheetCalibration,
        calibrate_sheet,
        fit_corners,
    )
    from smartcam.calibration._solvers import Chain, Height, PlaneProjection, ToolOffset, chain_of
    from smartcam.calibration._stereo.calibration import StereoCalibration, calibrate_stereo
    from smartcam.calibration._targets import (
        Charuco,
        Checkerboard,
        CircleGrid,
        MarkerGrid,
        target_from_data,
        target_to_data,
    )
    from smartcam.calibration._views import TargetView
    from smartcam.geometry import CameraModel, PlacePattern, PoseHistory, Transform

__all__ = [
    "CameraModel",
    "Chain",
    "Charuco",
    "Checkerboard",
    "CircleGrid",
    "Folder",
    "HandEyeCalibration",
    "Height",
    "IntrinsicCalibration",
    "MarkerGrid",
    "MovingCamera",
    "PlacePattern",
    "PlaneCalibration",
    "PlaneProjection",
    "PoseHistory",
    "RobotSigmas",
    "SheetCalibration",
    "StereoCalibration",
    "TargetView",
    "ToolOffset",
    "Transform",
    "calibrate_hand_eye",
    "calibrate_hand_eye_from_poses",
    "calibrate_intrinsics",
    "calibrate_sheet",
    "calibrate_stereo",
    "chain_of",
    "compare_lenses",
    "draw_scene",
    "draw_uncertainty",
    "draw_views",
    "estimate_time_offset",
    "find_target",
    "fit_corners",
    "fit_plane",
    "fit_tool_tip",
    "fit_touches",
    "load_calibration",
    "locate",
    "make_sheet",
    "scale_target",
    "suggest_views",
    "target_from_data",
    "target_to_data",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_detection.find": "find_target",
            "_drawing.draw": "draw_scene draw_uncertainty draw_views",
            "_files.directory": "Folder",
            "_files.load": "load_calibration",
            "_hand_eye.calibration": "calibrate_hand_eye calibrate_hand_eye_from_poses",
            "_hand_eye.equations": "RobotSigmas",
            "_hand_eye.result": "HandEyeCalibration",
            "_hand_eye.time_offset": "estimate_time_offset",
            "_lens.comparison": "compare_lenses",
            "_lens.guide": "suggest_views",
            "_lens.intrinsics": "IntrinsicCalibration calibrate_intrinsics",
            "_lens.poses": "locate",
            "_plane.calibration": "PlaneCalibration fit_plane",
            "_plane.moving_camera": "MovingCamera",
            "_plane.tool": "fit_tool_tip",
            "_plane.touches": "fit_touches",
            "_printing.sheets": "make_sheet scale_target",
            "_sheet.calibration": "SheetCalibration calibrate_sheet fit_corners",
            "_solvers": "Chain Height PlaneProjection ToolOffset chain_of",
            "_stereo.calibration": "StereoCalibration calibrate_stereo",
            "_targets": "Charuco Checkerboard CircleGrid MarkerGrid target_from_data "
            "target_to_data",
            "_views": "TargetView",
            "smartcam.geometry": "CameraModel PlacePattern PoseHistory Transform",
        },
    )
