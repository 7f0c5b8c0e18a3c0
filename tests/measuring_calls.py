"""Every public function of calibration and depth, and what users make, with arguments that work."""

from __future__ import annotations

import functools
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import numpy as np

from smartcam import calibration, depth, frames
from tests.argument_table import ODD
from tests.calibration import lenskit, scenes
from tests.calibration.sheetkit import localized

Call = tuple[Callable[..., Any], dict[str, Any]]

NOON = datetime(2026, 3, 4, 12, tzinfo=UTC)

ODD_MEASURED: dict[str, Any] = {
    **ODD,
    "no points": np.empty((0, 2)),
    "array of nan": np.full((3, 3), np.nan),
    "array of objects": np.array([None, object()], dtype=object),
    "array of texts": np.array(["a", "b"]),
    "complex array": np.array([[1j, 0.0], [0.0, 1.0]]),
    "list of None": [None, None, None],
    "list of lists": [[1.0], [1.0, 2.0]],
    "pair of odd ones": ("a", None),
    "pair of nan": (float("nan"), float("nan")),
}
"""Odd values, by their names: also those that only look like points, images or lists."""

RETURNED = frozenset(
    {
        *("Code", "DepthFrame", "Drift", "HandEyeCalibration", "IntrinsicCalibration"),
        *("PlaneCalibration", "Remark", "RobotSigmas", "Sheet", "SheetCalibration"),
        *("StereoCalibration", "TargetView"),
    }
)
"""Classes that functions return, with fields that nobody gives odd values or that files hold."""


@functools.cache
def measuring_calls() -> dict[str, Call]:
    """Return the calls by name."""
    views = lenskit.seen(lenskit.LEFT, lenskit.poses(8))
    lefts, rights = lenskit.pairs(6)
    lens = calibration.calibrate_intrinsics(views)
    pair = calibration.calibrate_stereo(lefts, rights)
    flanges, seen = scenes.scene("eye-in-hand").simulate_measurements(
        pixel_sigma=0.05,
        robot_sigmas=calibration.RobotSigmas(1e-4, 1e-4),
        random=np.random.default_rng(1),
    )
    targets = [calibration.locate(one, scenes.CAMERA).transform for one in seen]
    corners = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0], [100.0, 90.0], [40.0, 50.0]])
    touched = np.column_stack([corners * 1e-3, np.zeros(5)])
    plane = calibration.fit_plane(corners, touched)
    static = calibration.chain_of(plane)
    still = calibration.Transform("base", "flange", np.eye(3), np.zeros(3), at=NOON)
    found = localized(10.0, 20.0)
    cloud = depth.Cloud(np.random.default_rng(1).normal(size=(200, 3)))
    flat = np.full((40, 50), 1000, dtype=np.uint16)
    mask = np.zeros((40, 50), dtype=bool)
    mask[10:20, 10:30] = True
    (region,) = depth.find_regions(mask)
    eyes = {"left": frames.open("synthetic://"), "right": frames.open("synthetic://")}
    hand_eye = {
        "setup": "eye-in-hand",
        "method": "auto",
        "adjust": "auto",
        "robot_sigmas": None,
        "drop_bad": True,
        "allowed_error": None,
        "max_scale_error": 0.2,
    }
    lenses = {"distortion_model": "plumb_bob", "fixed": (), "sheet": "auto", "drop_bad": True}
    grid = {"columns": 5, "rows": 4}
    area = {"region": region, "scale": 0.001}
    smoothing = {"alpha": 0.5, "delta": 0.02}
    of_lens = {
        "size": (640, 480),
        "matrix": lenskit.LEFT.matrix,
        "distortion": lenskit.LEFT.distortion,
        "distortion_model": "plumb_bob",
    }
    return {
        "CameraModel": (calibration.CameraModel, of_lens),
        "Chain": (
            calibration.Chain,
            {"solvers": [static], "frame": "robot", "camera_frame": None, "y_down": None},
        ),
        "Charuco": (
            calibration.Charuco,
            {**grid, "square": 0.03, "marker": 0.02, "dictionary": "DICT_5X5_250"}
            | {"legacy_pattern": False},
        ),
        "Checkerboard": (
            calibration.Checkerboard,
            {**grid, "square": 0.03, "origin_mark": False},
        ),
        "CircleGrid": (
            calibration.CircleGrid,
            {**grid, "spacing": 0.03, "diameter": 0.02, "asymmetric": False}
            | {"origin_diameter": None},
        ),
        "Folder": (calibration.Folder, {}),
        "Height": (
            calibration.Height,
            {"height": 0.1, "normal": (0.0, 0.0, 1.0), "viewpoint": None},
        ),
        "MarkerGrid": (
            calibration.MarkerGrid,
            {**grid, "marker": 0.03, "gap": 0.01, "dictionary": "DICT_4X4_50", "border": 1}
            | {"first_id": 0, "kalibr": False},
        ),
        "MovingCamera": (
            calibration.MovingCamera,
            {"static": static, "calibration_pose": still, "field": corners}
            | {"tolerance": 0.0002, "max_lag": 0.001},
        ),
        "PlacePattern": (
            calibration.PlacePattern,
            {"frame": still, "rows": 2, "columns": 2, "layers": 1, "pitch": (0.1, 0.1, 0.0)},
        ),
        "PlaneProjection": (calibration.PlaneProjection, {"matrix": np.eye(3)}),
        "PoseHistory": (calibration.PoseHistory, {"size": 10, "max_gap": 0.1}),
        "ToolOffset": (
            calibration.ToolOffset,
            {"translation": (0.0, 0.0, 0.0), "quaternion": (0.0, 0.0, 0.0, 1.0)},
        ),
        "Transform": (
            calibration.Transform,
            {"target": "a", "source": "b", "rotation": np.eye(3), "translation": np.zeros(3)}
            | {"at": None},
        ),
        "calibrate_hand_eye": (
            calibration.calibrate_hand_eye,
            {"robot_poses": flanges, "views": seen, **hand_eye, "camera": scenes.CAMERA},
        ),
        "calibrate_hand_eye_from_poses": (
            calibration.calibrate_hand_eye_from_poses,
            {"robot_poses": flanges, "target_poses": targets, **hand_eye},
        ),
        "calibrate_intrinsics": (calibration.calibrate_intrinsics, {"views": views, **lenses}),
        "calibrate_sheet": (
            calibration.calibrate_sheet,
            {"view": views[0], "plane": plane, "camera": lenskit.LEFT, "camera_frame": None},
        ),
        "calibrate_stereo": (
            calibration.calibrate_stereo,
            {"left_views": lefts, "right_views": rights, "left": None, "right": None, **lenses},
        ),
        "chain_of": (
            calibration.chain_of,
            {"calibration": plane, "origin": (0.0, 0.0), "theta": 0.0},
        ),
        "compare_lenses": (
            calibration.compare_lenses,
            {"a": lens, "b": lens.camera, "distance": 0.5, "shape": (5, 5)},
        ),
        "draw_scene": (calibration.draw_scene, {"calibration": lens, "title": ""}),
        "draw_uncertainty": (
            calibration.draw_uncertainty,
            {"shown": lens, "distance": None, "title": ""},
        ),
        "draw_views": (calibration.draw_views, {"calibration": pair, "title": ""}),
        "estimate_time_offset": (
            calibration.estimate_time_offset,
            {"history": calibration.PoseHistory(), "target_poses": targets}
            | {"setup": "eye-in-hand", "max_offset": 0.2},
        ),
        "find_target": (
            calibration.find_target,
            {"image": np.full((60, 80), 255, dtype=np.uint8), "target": lenskit.BOARD, "name": ""},
        ),
        "fit_corners": (
            calibration.fit_corners,
            {"target": lenskit.BOARD, "ids": [0, 8, 45, 53], "touches": touched[:4]}
            | {"touch_sigma": None, "tool_z": None, "robust": False, "robot_frame": "robot"},
        ),
        "fit_plane": (
            calibration.fit_plane,
            {"camera_points": corners, "robot_points": touched, "model": "auto"}
            | {"touch_sigma": None, "weights": None, "nominal_scale": None, "tool_z": None}
            | {"robust": False, "robot_frame": "robot", "camera_frame": None, "y_down": None}
            | {"allowed_error": None},
        ),
        "fit_tool_tip": (calibration.fit_tool_tip, {"flanges": flanges}),
        "fit_touches": (
            calibration.fit_touches,
            {"origin": found, "o": (0.0, 0.0, 0.0), "a": (0.1, 0.0, 0.0), "b": (0.0, 0.1, 0.0)}
            | {"nominal_scale": 1.0, "touch_sigma": None, "theta_sigma": 0.0, "tool_z": None}
            | {"robot_frame": "robot", "camera_frame": None, "y_down": None},
        ),
        "load_calibration": (calibration.load_calibration, {"path": "nowhere.json"}),
        "locate": (calibration.locate, {"view": views[0], "camera": lenskit.LEFT}),
        "make_sheet": (calibration.make_sheet, {"target": lenskit.BOARD, "page": "A4"}),
        "scale_target": (
            calibration.scale_target,
            {"target": lenskit.BOARD, "measured_ruler": (0.1, 0.1)},
        ),
        "suggest_views": (
            calibration.suggest_views,
            {"calibration": lens, "distance": None, "roll": 0.0, "target": None},
        ),
        "target_from_data": (
            calibration.target_from_data,
            {"data": calibration.target_to_data(lenskit.BOARD)},
        ),
        "target_to_data": (calibration.target_to_data, {"target": lenskit.BOARD}),
        "Cloud": (
            depth.Cloud,
            {"points": cloud.points, "colours": None, "sigma": None},
        ),
        "ColourRange": (
            depth.ColourRange,
            {"hue": (0, 9), "saturation": (0, 255), "value": (0, 255)},
        ),
        "SpatialFilter": (depth.SpatialFilter, {**smoothing, "iterations": 2}),
        "StereoDepth": (
            depth.StereoDepth,
            {**eyes, "calibration": pair, "matcher": None, "size": None, "alpha": 0.0}
            | {"colour": True, "focal_sigma": 0.0, "within": None, "timeout": 5.0},
        ),
        "StereoMatcher": (
            depth.StereoMatcher,
            {"algorithm": "sgbm", "left_right": 1.0, "refine": 9, "wls": None},
        ),
        "TemporalFilter": (depth.TemporalFilter, {**smoothing, "persistence": 3}),
        "crop_box": (
            depth.crop_box,
            {"cloud": cloud, "low": (-1.0, -1.0, -1.0), "high": (1.0, 1.0, 1.0)},
        ),
        "equalize_depth": (depth.equalize_depth, {"depth": flat, **area}),
        "fill_holes": (
            depth.fill_holes,
            {"depth": flat, "how": "farthest", "reach": 8, "scale": 0.001},
        ),
        "find_regions": (
            depth.find_regions,
            {"mask": mask, "area": (1, 1e9), "ratio": (1, 9.0), "fullness": 0.0}
            | {"whole": False, "max_regions": 1000},
        ),
        "load_cloud": (depth.load_cloud, {"path": "nowhere.ply", "unit": None}),
        "pass_through": (
            depth.pass_through,
            {"cloud": cloud, "axis": "x", "low": -1.0, "high": 1.0},
        ),
        "read_camera_infos": (
            depth.read_camera_infos,
            {"left": "nowhere.yaml", "right": "nowhere.yaml"},
        ),
        "region_depth": (depth.region_depth, {"depth": flat, **area, "correlated_pixels": 1.0}),
        "register": (
            depth.register,
            {"source": cloud, "target": cloud, "method": "icp", "voxel": None}
            | {"max_distance": 0.05, "initial": None, "min_overlap": 0.3},
        ),
        "remove_radius_outliers": (
            depth.remove_radius_outliers,
            {"cloud": cloud, "radius": 0.5, "neighbours": 5},
        ),
        "remove_statistical_outliers": (
            depth.remove_statistical_outliers,
            {"cloud": cloud, "neighbours": 20, "ratio": 2.0},
        ),
        "save_cloud": (
            depth.save_cloud,
            {"path": "nowhere/cloud.ply", "cloud": cloud, "text": False},
        ),
        "voxel_grid": (depth.voxel_grid, {"cloud": cloud, "size": 0.5}),
    }
