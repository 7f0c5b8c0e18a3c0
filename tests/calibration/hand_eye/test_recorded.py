"""Recorded robots under the folder that SMARTCAM_DATA names; what is not there is skipped."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from benchmarks.hand_eye import MAX_BEHIND, RECORDED, Recorded, find
from benchmarks.recorded_robots import SETS, RecordedSet, read_poses, read_set
from benchmarks.robots_judge import OURS, folds, judged, rms
from smartcam.calibration import (
    CameraModel,
    HandEyeCalibration,
    TargetView,
    Transform,
    calibrate_hand_eye,
    calibrate_hand_eye_from_poses,
    calibrate_intrinsics,
)
from smartcam.geometry._inside import Code
from tests.calibration.inside import OPENCV_METHODS

pytestmark = pytest.mark.long

DOTS, CHARUCO = RECORDED
MOVEIT = "pose_samples.json"

Pairs = tuple[list[Transform], list[TargetView]]


@functools.cache
def recorded(one: Recorded) -> Pairs:
    folder = find(one.name)
    if folder is None:
        pytest.skip(f"needs {one.name}, see docs/benchmarks.md")
    return read_set(folder, one.target)


def best_closed_form(one: Recorded) -> float:
    poses, views = recorded(one)
    camera = calibrate_intrinsics(views, sheet="exact").camera
    errors = [
        calibrate_hand_eye(
            poses, views, setup=one.setup, camera=camera, method=name, drop_bad=False
        ).held_out_error
        for name in OPENCV_METHODS
    ]
    return min(error for error in errors if error is not None)


def found(one: Recorded, **options: object) -> HandEyeCalibration:
    poses, views = recorded(one)
    return calibrate_hand_eye(poses, views, setup=one.setup, **options)  # type: ignore[arg-type]


def test_mean_error_of_the_published_lens_is_the_published_one() -> None:
    matrix = np.array([[550.0, 0, 320], [0, 550, 240], [0, 0, 1]])
    camera = CameraModel(size=(640, 480), matrix=matrix)
    same = found(DOTS, camera=camera, adjust="nothing", method="reprojection")
    assert 1e3 * same.mean_error == pytest.approx(2.899, abs=0.02)


def test_dots_with_the_nominal_target_reach_the_goal_of_the_mean_error() -> None:
    lens = calibrate_intrinsics(recorded(DOTS)[1], sheet="exact").camera
    nominal = found(DOTS, camera=lens, adjust="nothing")
    assert 1e3 * nominal.mean_error <= 2.26
    assert nominal.target_scale == 1.0


def test_dots_reach_the_goal_of_the_held_out_error() -> None:
    adjusted = found(DOTS)
    assert adjusted.held_out_error is not None
    assert adjusted.held_out_error <= 0.41 * best_closed_form(DOTS)
    assert adjusted.target_scale == pytest.approx(0.978, abs=0.002)
    assert Code.SCALE_MISMATCH in {one.code for one in adjusted.warnings}


def test_charuco_reaches_the_goal_of_the_held_out_error() -> None:
    adjusted = found(CHARUCO)
    assert adjusted.held_out_error is not None
    assert adjusted.held_out_error <= 0.61 * best_closed_form(CHARUCO)


def test_poses_of_moveit_are_as_good_as_the_best_closed_form() -> None:
    path = find(MOVEIT)
    if path is None:
        pytest.skip(f"needs {MOVEIT}, see docs/benchmarks.md")
    poses, seen = read_poses(path)
    errors = {
        method: calibrate_hand_eye_from_poses(
            poses[::2], seen[::2], setup="eye-to-hand", method=method
        ).held_out_error
        for method in ("auto", *OPENCV_METHODS)
    }
    ours = errors.pop("auto")
    assert ours is not None
    assert ours <= 1.02 * min(one for one in errors.values() if one is not None)


@pytest.mark.parametrize("one", SETS[-4:], ids=lambda one: one.name)
def test_unseen_robots_are_as_good_as_the_best_closed_form(one: RecordedSet) -> None:
    folder = find(one.folder)
    if folder is None:
        pytest.skip(f"needs {one.folder}, see docs/benchmarks.md")
    poses, seen = one.read(folder)
    views = [view for view in seen if isinstance(view, TargetView)]
    camera = calibrate_intrinsics(views, sheet="exact").camera if views else None
    errors = rms([judged(poses, seen, one.setup, camera, split) for split in folds(len(poses))])
    assert errors.pop(OURS) <= MAX_BEHIND * min(errors.values())
