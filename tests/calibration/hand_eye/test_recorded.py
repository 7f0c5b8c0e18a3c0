"""Recorded robots: ROS-Industrial's and MoveIt's, under the folder that SMARTCAM_DATA names."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from benchmarks.hand_eye import RECORDED, Recorded, find, read_poses, read_set
from smartcam.calibration._codes import Code
from smartcam.calibration._hand_eye.calibration import (
    calibrate_hand_eye,
    calibrate_hand_eye_from_poses,
)
from smartcam.calibration._hand_eye.closed_forms import LINEAR
from smartcam.calibration._lens.model import CameraModel

if TYPE_CHECKING:
    from smartcam.calibration._hand_eye.result import HandEyeCalibration

pytestmark = pytest.mark.long

DOTS, CHARUCO = RECORDED
MOVEIT = "pose_samples.json"
LACKING = [name for name in (DOTS.name, CHARUCO.name, MOVEIT) if find(name) is None]

if LACKING:
    pytest.skip(
        f"needs {', '.join(LACKING)} (docs/benchmarks.md says where they are from) in a folder "
        "that SMARTCAM_DATA names",
        allow_module_level=True,
    )


def recorded(one: Recorded, **options: object) -> HandEyeCalibration:
    folder = find(one.name)
    assert folder is not None
    poses, views = read_set(folder, one.target)
    return calibrate_hand_eye(poses, views, setup=one.setup, **options)  # type: ignore[arg-type]


def best_closed_form(found: HandEyeCalibration) -> float:
    return min(value for name in LINEAR if (value := found.candidates[name]) is not None)


def test_mean_error_of_the_published_lens_is_the_published_one() -> None:
    matrix = np.array([[550.0, 0, 320], [0, 550, 240], [0, 0, 1]])
    camera = CameraModel(size=(640, 480), matrix=matrix)
    found = recorded(DOTS, camera=camera, adjust="nothing", method="reprojection")
    assert 1e3 * found.mean_error == pytest.approx(2.899, abs=0.02)


def test_dots_with_the_nominal_target_reach_the_goal_of_the_mean_error() -> None:
    found = recorded(DOTS, adjust="nothing")
    assert 1e3 * found.mean_error <= 2.26
    assert found.target_scale == 1.0


def test_dots_reach_the_goal_of_the_held_out_error() -> None:
    found = recorded(DOTS)
    assert found.held_out_error is not None
    assert found.held_out_error <= 0.41 * best_closed_form(found)
    assert found.target_scale == pytest.approx(0.978, abs=0.002)
    assert Code.SCALE_MISMATCH in {one.code for one in found.warnings}


def test_charuco_reaches_the_goal_of_the_held_out_error() -> None:
    found = recorded(CHARUCO)
    assert found.held_out_error is not None
    assert found.held_out_error <= 0.61 * best_closed_form(found)


def test_poses_of_moveit_are_as_good_as_the_best_closed_form() -> None:
    path = find(MOVEIT)
    assert path is not None
    poses, seen = read_poses(path)
    found = calibrate_hand_eye_from_poses(poses[::2], seen[::2], setup="eye-to-hand")
    assert found.held_out_error is not None
    assert found.held_out_error <= 1.02 * best_closed_form(found)
