"""The choice between two ways of solving."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks import robots
from benchmarks.robots import Kind
from smartcam.calibration import (
    RobotSigmas,
    Transform,
    calibrate_hand_eye,
    calibrate_hand_eye_from_poses,
)
from smartcam.calibration.simulation import hand_eye_scene
from smartcam.geometry._inside import Code, Rigid, exp_rotation
from tests.calibration.inside import RobotPoses, left_out_second_axis_turns, second_axis_turn
from tests.calibration.scenes import CAMERA, SHEET, scene

NOISE = RobotSigmas(math.radians(0.02), 1e-4)


@pytest.mark.long
def test_calibration_of_a_robot_that_errs_by_more_than_noise_takes_its_poses_as_said() -> None:
    """Its joints are off by a tenth of a degree, which no noise of single poses explains."""
    arm = Kind("offsets", offsets=0.1).measured("eye-in-hand", 1009)
    poses, views = ([some[i] for i in arm.used] for some in (arm.poses, arm.views))
    found = {
        method: calibrate_hand_eye(
            poses,
            views,
            setup="eye-in-hand",
            camera=robots.CAMERA,
            adjust="nothing",
            method=method,
        )
        for method in ("auto", "robot", "reprojection", "park")
    }
    held_out = {name: one.held_out_error or math.nan for name, one in found.items()}
    auto = found["auto"]
    assert auto.method == "reprojection"
    assert held_out["auto"] < 0.9 * held_out["robot"]
    assert held_out["auto"] < held_out["park"]
    assert auto.candidate_errors["robot"] == pytest.approx(held_out["robot"], rel=1e-6)
    assert np.isfinite(auto.covariance).all()


@pytest.mark.judged
@pytest.mark.parametrize("seed", [0, 8])
def test_hand_eye_expects_what_another_choice_of_values_would_change(seed: int) -> None:
    """Joints are off, and the lens by 1 %, but with another lens poses are predicted no better."""
    arm = Kind("narrow", poses=10, cone=12, focal=0.01, offsets=0.1).measured("eye-in-hand", seed)
    poses, views = ([some[i] for i in arm.used] for some in (arm.poses, arm.views))
    found = calibrate_hand_eye(poses, views, setup="eye-in-hand", camera=robots.CAMERA)
    off = float(np.linalg.norm(found.camera_pose.translation - arm.camera.translation))
    assert found.method == "robot"
    assert off < 1.5 * found.translation_error


@pytest.mark.judged
def test_hand_eye_that_takes_noise_for_another_error_expects_the_difference() -> None:
    """By chance the robot's poses as they are predict the others better by a standard error."""
    random = np.random.default_rng([43, 41])
    truth = hand_eye_scene(
        SHEET, CAMERA, setup="eye-to-hand", poses=12, tilt=0.6, distance=0.5, random=random
    )
    poses, views = truth.simulate_measurements(pixel_sigma=0.1, robot_sigmas=NOISE, random=random)
    found = calibrate_hand_eye(poses, views, setup="eye-to-hand", camera=CAMERA, adjust="nothing")
    assert found.method == "reprojection"
    assert truth.errors(found.camera_pose)[1] < 1.5 * found.translation_error


def test_second_turns_are_those_without_each_pose() -> None:
    robot = RobotPoses(Rigid.stack(one.rigid for one in scene("eye-in-hand").robot_poses), True)
    found = left_out_second_axis_turns(robot)
    for number in range(len(found)):
        some = np.delete(np.arange(len(found)), number)
        assert found[number] == pytest.approx(second_axis_turn(robot.subset(some)), rel=1e-9)
    few = robot.subset(np.arange(3))
    np.testing.assert_allclose(left_out_second_axis_turns(few), second_axis_turn(few))


def _nodding(rms: float) -> list[Transform]:
    """Return poses that turn much about one axis and by an rms (degrees) about another."""
    random = np.random.default_rng(5)
    first = scene("eye-in-hand").robot_poses[0]
    poses = []
    for number in range(10):
        turn = exp_rotation(np.array([0.0, 0.0, 0.08 * number])) @ exp_rotation(
            np.array([math.radians(rms) * (1 if number % 2 else -1), 0.0, 0.0])
        )
        shift = random.uniform(-0.03, 0.03, 3)
        poses.append(Transform("base", "flange", first.rotation @ turn, first.translation + shift))
    return poses


@pytest.mark.long
@pytest.mark.parametrize(("rms", "told"), [(2.5, True), (12.0, False)])
def test_remark_on_rotation_does_not_come_and_go_with_a_pose(rms: float, told: bool) -> None:
    truth, poses = scene("eye-in-hand"), _nodding(rms)
    for out in (None, 0, 5):
        some = [pose for number, pose in enumerate(poses) if number != out]
        seen = [truth.target_in_camera(pose) for pose in some]
        found = calibrate_hand_eye_from_poses(some, seen, setup="eye-in-hand", method="shah")
        codes = {one.code for one in found.warnings}
        assert (Code.INSUFFICIENT_ROTATION in codes) == told
