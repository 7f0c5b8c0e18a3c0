"""What lies between two ways of solving, and how far."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from benchmarks import robots
from benchmarks.robots import Kind
from smartcam.calibration._codes import Code
from smartcam.calibration._geometry.frames import Transform
from smartcam.calibration._geometry.rigid import Rigid, exp_rotation
from smartcam.calibration._hand_eye.calibration import (
    calibrate_hand_eye,
    calibrate_hand_eye_from_poses,
)
from smartcam.calibration._hand_eye.closed_forms import second_turn, second_turns
from smartcam.calibration._hand_eye.equations import RobotPoses, RobotSigmas
from smartcam.calibration._hand_eye.model_selection import BETWEEN, _part
from smartcam.calibration._hand_eye.sights import locate_all
from smartcam.calibration._lens.poses import locate
from tests.calibration.scenes import CAMERA, scene

NOISE = RobotSigmas(math.radians(0.02), 1e-4)


def test_part_of_a_way_that_every_pose_gains_by_is_all_of_it() -> None:
    along = np.linspace(1.0, 1.2, 12)
    assert _part(along, along) == pytest.approx(1.0)
    assert _part(along, 2.0 * along) == pytest.approx(0.0)  # half of it; the whole gains nothing
    assert _part(along, 0.5 * along) == 1.0  # beyond the other method nothing is known
    assert _part(along, 1.25 * along) == pytest.approx(0.8)


def test_part_of_a_way_that_leads_off_is_none() -> None:
    along = np.linspace(-1.2, -1.0, 12)
    assert _part(along, -along) == 0.0
    assert _part(np.zeros(12), np.zeros(12)) == 0.0


def test_part_that_chance_gives_is_shrunk() -> None:
    squares = np.full(12, 1.0)
    along = np.array([6.0, *[0.5] * 11])  # one pose gains, the others neither gain nor lose
    assert _part(along, squares) == 0.0
    two = np.array([3.0, 3.0, 3.0, *[0.5] * 9])
    assert 0.0 < _part(two, squares) < float(two.sum() / squares.sum())


@pytest.mark.long
def test_calibration_of_a_robot_that_errs_by_more_than_noise_goes_between() -> None:
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
    assert auto.method in {BETWEEN, "reprojection"}
    assert held_out["auto"] < 0.9 * held_out["robot"]
    assert held_out["auto"] < 1.15 * held_out["reprojection"]
    assert held_out["auto"] < held_out["park"]
    assert auto.candidates["robot"] == pytest.approx(held_out["robot"], rel=1e-6)
    assert np.isfinite(auto.covariance).all()


def test_poses_of_all_views_at_once_are_those_of_each() -> None:
    _, views = scene("eye-in-hand", poses=6).measured(
        pixel_sigma=0.3, robot_sigmas=NOISE, random=np.random.default_rng(4)
    )
    # some points are missing, and one view has more noise than its covariance says
    views[2] = dataclasses.replace(
        views[2],
        ids=views[2].ids[3:],
        points=views[2].points[3:],
        covariance=views[2].covariance[3:],
    )
    views[4] = dataclasses.replace(views[4], covariance=views[4].covariance / 100.0)
    for found, one in zip(locate_all(views, CAMERA), views, strict=True):
        alone = locate(one, CAMERA)
        assert found.rms == pytest.approx(alone.rms, rel=1e-4)
        assert found.ambiguity == pytest.approx(alone.ambiguity, rel=1e-2)
        assert float(found.transform.rigid.angle_to(alone.transform.rigid)) < 1e-5
        np.testing.assert_allclose(found.covariance, alone.covariance, rtol=1e-2)
    assert locate_all([], CAMERA) == []


def test_second_turns_are_those_without_each_pose() -> None:
    robot = RobotPoses(Rigid.stacked(one.rigid for one in scene("eye-in-hand").robot_poses), True)
    found = second_turns(robot)
    for number in range(len(found)):
        some = np.delete(np.arange(len(found)), number)
        assert found[number] == pytest.approx(second_turn(robot.taken(some)), rel=1e-9)
    few = robot.taken(np.arange(3))
    np.testing.assert_allclose(second_turns(few), second_turn(few))


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
        seen = [truth.seen(pose) for pose in some]
        found = calibrate_hand_eye_from_poses(some, seen, setup="eye-in-hand", method="shah")
        codes = {one.code for one in found.warnings}
        assert (Code.INSUFFICIENT_ROTATION in codes) == told
