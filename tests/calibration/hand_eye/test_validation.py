"""Poses of a robot and views that do not belong together."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from smartcam.calibration import (
    Checkerboard,
    HandEyeCalibration,
    RobotSigmas,
    TargetView,
    Transform,
    calibrate_hand_eye,
    calibrate_hand_eye_from_poses,
)
from smartcam.calibration._hand_eye.model_selection import Problem
from smartcam.calibration._hand_eye.validation import (
    check_poses,
    expected_error,
    find_agreement,
    max_plausible_error,
)
from smartcam.calibration.simulation import hand_eye_scene
from smartcam.geometry._inside import Code, Rigid
from tests.calibration.inside import PoseObservations, RobotPoses, Setup
from tests.calibration.scenes import CAMERA, SHEET, refused, scene

SETUPS: list[Setup] = ["eye-in-hand", "eye-to-hand"]
ONE_LONG = [pytest.param("eye-in-hand", marks=pytest.mark.long), "eye-to-hand"]
NOISE = RobotSigmas(math.radians(0.02), 1e-4)
PUSHED = np.array([0.06, 0.03, 0.0])
"""A fixture that was pushed, metres."""

Pairs = tuple[list[Transform], "list[TargetView]"]


def measured(setup: Setup, *, poses: int = 10, sigmas: RobotSigmas = NOISE) -> Pairs:
    random = np.random.default_rng(11)
    return scene(setup, poses=poses).simulate_measurements(
        pixel_sigma=0.1, robot_sigmas=sigmas, random=random
    )


def calibrated(
    poses: list[Transform],
    views: list[TargetView],
    setup: Setup = "eye-in-hand",
    *,
    drop_bad: bool = True,
) -> HandEyeCalibration:
    return calibrate_hand_eye(
        poses, views, setup=setup, camera=CAMERA, adjust="nothing", drop_bad=drop_bad
    )


def problem(poses: list[Transform], setup: Setup) -> Problem:
    """Return exact poses of the target, of the scene, and poses of the robot."""
    truth = scene(setup, poses=len(poses))
    seen, said = (
        Rigid.stack(one.rigid for one in some)
        for some in ([truth.target_in_camera(pose) for pose in truth.robot_poses], poses)
    )
    white = np.broadcast_to(np.eye(6), (len(poses), 6, 6))
    return Problem(RobotPoses(said, setup == "eye-in-hand"), PoseObservations(white, seen), seen)


@pytest.mark.parametrize("setup", ONE_LONG)
def test_hand_eye_of_shuffled_poses_is_refused(setup: Setup) -> None:
    poses, views = measured(setup)
    order = np.random.default_rng(2).permutation(len(poses))
    with refused("POOR_FIT", "in their order and in metres", "mm at most expected"):
        calibrated([poses[i] for i in order], views, setup)


@pytest.mark.parametrize("setup", ONE_LONG)
def test_hand_eye_of_transposed_rotations_is_refused(setup: Setup) -> None:
    poses, views = measured(setup)
    turned = [dataclasses.replace(one, rotation=one.rotation.T) for one in poses]
    with refused("WRONG_FRAME", "mm off if read with rotations transposed"):
        calibrated(turned, views, setup)


@pytest.mark.judged
def test_hand_eye_of_poses_in_millimetres_is_refused() -> None:
    poses, views = measured("eye-in-hand")
    wrong = [dataclasses.replace(one, translation=1e3 * one.translation) for one in poses]
    with refused("POOR_FIT", "mm off if read as millimetres: expected metres"):
        calibrated(wrong, views)
    truth = scene("eye-in-hand", poses=10)
    seen = [truth.target_in_camera(one) for one in truth.robot_poses]
    with refused("POOR_FIT", "as millimetres"):
        calibrate_hand_eye_from_poses(wrong, seen, setup="eye-in-hand")


def test_hand_eye_of_a_target_in_millimetres_is_refused() -> None:
    with refused("UNIT_UNKNOWN", "square to be a length of 1 m at most, got 30.0 m"):
        dataclasses.replace(SHEET, square=1e3 * SHEET.square)


@pytest.mark.long
def test_hand_eye_of_two_exchanged_poses_leaves_both_out() -> None:
    poses, views = measured("eye-in-hand")
    found = calibrated([poses[1], poses[0], *poses[2:]], views)
    assert found.used == (False, False, *[True] * 8)
    rest = calibrated(poses[2:], views[2:])
    np.testing.assert_allclose(
        found.camera_pose.translation, rest.camera_pose.translation, rtol=1e-7
    )
    assert [one.code for one in found.warnings] == [Code.BAD_VIEW] * 2
    assert "it was paired with a wrong view, or its view" in found.warnings[0].text


@pytest.mark.judged
def test_hand_eye_of_six_poses_leaves_one_of_another_view_out() -> None:
    poses, views = measured("eye-in-hand", poses=6)
    found = calibrated([*poses[:5], poses[0]], views)
    assert found.used == (*[True] * 5, False)
    assert found.leave_one_out[5] > 0.02
    assert scene("eye-in-hand", poses=6).errors(found.camera_pose)[1] < 3e-3


@pytest.mark.long
def test_hand_eye_told_to_keep_a_pose_of_another_view_says_how_poor_it_is() -> None:
    poses, views = measured("eye-in-hand")
    found = calibrated([poses[1], *poses[1:]], views, drop_bad=False)
    assert all(found.used)
    assert [one.code for one in found.warnings] == [Code.POOR_FIT, Code.BAD_VIEW]
    texts = {one.code: one.text for one in found.warnings}
    assert texts[Code.POOR_FIT].startswith("expected a held-out error of ")
    assert texts[Code.BAD_VIEW].endswith("it is used all the same")


@pytest.mark.long
@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("moved", ["target", "camera"])
def test_hand_eye_of_what_moved_before_the_last_views_is_not_good(setup: Setup, moved: str) -> None:
    """The views that were left out agree with each other: they are how things stand now."""
    poses, views = measured(setup, poses=13)
    on_base = (moved == "target") == (setup == "eye-in-hand")
    frame = "base" if on_base else "flange"
    push = Transform(frame, frame, np.eye(3), PUSHED)
    shifted = [push @ one if on_base else one @ push for one in poses[-3:]]
    found = calibrated([*poses[:-3], *shifted], views, setup)
    assert sum(found.used) == 10
    assert found.verdict.level == "poor"
    assert "moved or slipped" in found.verdict.text
    assert any(f"the {moved} seems to have moved by 67" in one.text for one in found.warnings)


@pytest.mark.judged
@pytest.mark.parametrize(("number", "level"), [(-1, "unknown"), (-2, "good")])
def test_hand_eye_of_which_the_last_view_does_not_fit_is_not_good(number: int, level: str) -> None:
    poses, views = measured("eye-in-hand", poses=9)
    poses[number] = Transform("base", "base", np.eye(3), PUSHED) @ poses[number]
    found = calibrated(poses, views)
    assert not found.used[number]
    assert found.verdict.level == level


@pytest.mark.judged
def test_hand_eye_whose_camera_has_no_sure_place_says_where_it_is_good() -> None:
    found = calibrated(*measured("eye-in-hand", poses=9))
    unsure = dataclasses.replace(found, covariance=0.01**2 * np.eye(12))
    assert unsure.verdict.level == found.verdict.level == "good"
    assert unsure.verdict.text.startswith(f"{found.verdict.text}. Only while the hand is turned")
    assert "the camera's place is known to 17 mm" in unsure.verdict.text


@pytest.mark.long
def test_hand_eye_of_a_robot_that_stood_for_half_of_the_views_is_refused() -> None:
    """The fits end where nothing is determined, with a target in the camera."""
    truth = hand_eye_scene(
        Checkerboard(columns=9, rows=6, square=0.025),
        CAMERA,
        setup="eye-in-hand",
        poses=14,
        tilt=math.radians(30),
        distance=0.5,
        random=np.random.default_rng(3),
    )
    poses, views = truth.simulate_measurements(
        pixel_sigma=0.1, robot_sigmas=NOISE, random=np.random.default_rng(4)
    )
    with refused("POOR_FIT"):
        calibrate_hand_eye([*poses[:7], *[poses[7]] * 7], views, setup="eye-in-hand", camera=CAMERA)


@pytest.mark.judged
def test_hand_eye_of_a_poor_robot_says_so() -> None:
    poses, views = measured("eye-in-hand", sigmas=RobotSigmas(math.radians(0.5), 4e-3))
    found = calibrated(poses, views)
    assert [one.code for one in found.warnings] == [Code.POOR_FIT]
    assert "of a robot that is 2 mm and 0.25 deg off" in found.warnings[0].text


@pytest.mark.judged
def test_hand_eye_of_four_poses_expects_no_error() -> None:
    poses, views = measured("eye-in-hand", poses=5)
    assert math.isnan(calibrated(poses[:4], views[:4]).translation_error)
    assert 1e-4 < calibrated(poses, views).translation_error < 1e-2


@pytest.mark.parametrize("setup", SETUPS)
def test_agreement_is_that_of_most_poses(setup: Setup) -> None:
    poses = list(scene(setup, poses=10).robot_poses)
    poses[2], poses[5], poses[8] = poses[5], poses[8], poses[2]
    asked = problem(poses, setup)
    found = find_agreement(asked)
    assert found is not None
    assert found.median < 1e-9
    assert found.gross_error_indices(max_plausible_error(asked)).tolist() == [2, 5, 8]
    camera = Transform("x", "camera", *found.camera)
    np.testing.assert_allclose(
        camera.translation, scene(setup, poses=10).camera_pose.translation, atol=1e-9
    )


@pytest.mark.judged
def test_check_poses_that_belong_together_tells_no_gross_ones() -> None:
    asked = problem(list(scene("eye-in-hand", poses=8).robot_poses), "eye-in-hand")
    assert check_poses(asked).gross_error_indices(max_plausible_error(asked)).tolist() == []


def test_expected_error_grows_with_the_distance() -> None:
    asked = problem(list(scene("eye-in-hand", poses=8).robot_poses), "eye-in-hand")
    far = dataclasses.replace(asked, target_poses=asked.target_poses.scaled(2.0))
    assert expected_error(asked, RobotSigmas(0.0, 1e-3)) == pytest.approx(math.sqrt(2) * 1e-3)
    turn = RobotSigmas(1e-3, 0.0)
    assert expected_error(far, turn) == pytest.approx(2 * expected_error(asked, turn))
