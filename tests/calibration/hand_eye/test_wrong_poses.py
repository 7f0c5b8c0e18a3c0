"""Poses of a robot that are none, or not what they seem: each a typed error or a remark by name."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam.calibration import (
    RobotSigmas,
    Transform,
    calibrate_hand_eye,
    calibrate_hand_eye_from_poses,
    fit_tool_tip,
)
from smartcam.geometry._inside import Code
from tests.calibration.scenes import CAMERA, refused, scene

if TYPE_CHECKING:
    from smartcam.calibration import TargetView
    from tests.calibration.inside import Setup

TRUTH = scene("eye-in-hand", poses=6)
NOISE = RobotSigmas(math.radians(0.02), 1e-4)
SEEN = [TRUTH.target_in_camera(one) for one in TRUTH.robot_poses]
ROBOT = TRUTH.robot_poses
MIRRORS = [np.diag(one) for one in ([1.0, -1, 1], [1.0, 1, -1], [-1.0, -1, -1])]
IMAGE = np.zeros((480, 640), dtype=np.uint8)


def matrix(pose: Transform) -> Any:
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = pose.rotation, pose.translation
    return whole


def views() -> list[TargetView]:
    return TRUTH.simulate_measurements(
        pixel_sigma=0.1, robot_sigmas=NOISE, random=np.random.default_rng(1)
    )[1]


def from_poses(robot: Any, seen: Any = SEEN, **options: Any) -> None:
    calibrate_hand_eye_from_poses(robot, seen, **{"setup": "eye-in-hand", **options})


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize(
    "mirror", [MIRRORS[0], *(pytest.param(one, marks=pytest.mark.long) for one in MIRRORS[1:])]
)
@pytest.mark.parametrize("setup", ["eye-in-hand", "eye-to-hand"])
def test_hand_eye_of_a_left_handed_base_is_refused(setup: Setup, mirror: Any) -> None:
    truth = scene(setup, poses=6)
    seen = [truth.target_in_camera(one) for one in truth.robot_poses]
    robot = [
        Transform(one.target, one.source, mirror @ one.rotation @ mirror, mirror @ one.translation)
        for one in truth.robot_poses
    ]
    with refused("MIRRORED", "if read in a left-handed base"):
        calibrate_hand_eye_from_poses(robot, seen, setup=setup)


def test_transform_of_a_reflection_says_what_it_is() -> None:
    with refused("NOT_RIGID", "a reflection: one of the frames is left-handed"):
        Transform("base", "flange", MIRRORS[0] @ ROBOT[0].rotation, ROBOT[0].translation)


@pytest.mark.parametrize(
    ("robot", "text"),
    [
        ([matrix(one) for one in ROBOT], 'write Transform("base", "flange", M[:3, :3], M[:3, 3])'),
        ([None] * 6, "got None"),
        (None, "pose of the robot: expected a list"),
        (np.array([matrix(one) for one in ROBOT]), "pose of the robot: expected a list"),
        ({}, "pose of the robot: expected a list"),
        (ROBOT[:5], "as many poses of the target as poses of the robot"),
        ([], "as many poses of the target as poses of the robot"),
        (views(), "got TargetView"),
    ],
)
def test_hand_eye_of_no_robot_poses_is_refused(robot: Any, text: str) -> None:
    with refused("SHAPE", text):
        from_poses(robot)


@pytest.mark.parametrize(
    ("seen", "code", "text"),
    [
        ([matrix(one) for one in SEEN], "SHAPE", 'write Transform("camera", "target", '),
        ([None] * 6, "SHAPE", "got None"),
        (None, "SHAPE", "pose of the target: expected a list"),
        (views(), "SHAPE", "got TargetView"),
        ([one.inverse() for one in SEEN], "WRONG_FRAME", "expected T_camera_target, got T_target"),
        ([*SEEN[:5], ROBOT[5]], "WRONG_FRAME", "pose of the target 5: expected T_camera_target"),
    ],
)
def test_hand_eye_of_no_poses_of_the_target_is_refused(seen: Any, code: str, text: str) -> None:
    with refused(code, text):
        from_poses(ROBOT, seen)


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"setup": np.zeros(3)}, "SHAPE"),
        pytest.param({"method": []}, "SHAPE", marks=pytest.mark.long),
        ({"adjust": np.eye(2)}, "SHAPE"),
        ({"robot_sigmas": 1e-3}, "SHAPE"),
        ({"robot_sigmas": (1e-3, 1e-3, 1e-3)}, "SHAPE"),
        ({"robot_sigmas": ("a", "b")}, "SHAPE"),
        ({"robot_sigmas": (0.0, 1e-3)}, "NOT_FINITE"),
    ],
)
def test_hand_eye_of_wrong_options_is_refused(options: dict[str, Any], code: str) -> None:
    with refused(code):
        from_poses(ROBOT, **options)


@pytest.mark.parametrize("given", [None, IMAGE, [IMAGE] * 6, SEEN, [None] * 6])
def test_hand_eye_of_no_views_is_refused(given: Any) -> None:
    with refused("SHAPE", "hand-eye: view"):
        calibrate_hand_eye(ROBOT, given, setup="eye-in-hand", camera=CAMERA)


@pytest.mark.long
def test_hand_eye_names_points_that_are_off_and_leaves_them_out() -> None:
    given = views()
    for number, view in enumerate(given):
        points = view.points.copy()
        points[3 * number] += [0.0, 3.0]
        given[number] = dataclasses.replace(view, points=points)
    found = calibrate_hand_eye(
        ROBOT, given, setup="eye-in-hand", camera=CAMERA, method="park", adjust="nothing"
    )
    (remark,) = [one for one in found.warnings if one.code == Code.OUTLIER]
    assert remark.text.count("pixels)") == 5
    assert "and 1 more: each was not used" in remark.text
    clean = calibrate_hand_eye(
        ROBOT, views(), setup="eye-in-hand", camera=CAMERA, method="park", adjust="nothing"
    )
    assert clean.held_out_error is not None
    assert found.held_out_error == pytest.approx(clean.held_out_error, rel=0.2)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: ROBOT[0] @ matrix(ROBOT[0]), "expected a Transform, which knows its frames"),
        (lambda: ROBOT[0].apply(np.eye(4)), r"expected shape (..., 3), got (4, 4)"),
        (lambda: ROBOT[0].apply_to_orientations([0.0, 1.0]), r"expected shape (..., 4), got (2,)"),
        (lambda: Transform.from_pose(matrix(ROBOT[0]), "flange"), "expected a Pose, got ndarray"),
        (lambda: fit_tool_tip([matrix(one) for one in ROBOT]), "tool tip: pose 0: expected a Tra"),
        (lambda: fit_tool_tip(matrix(ROBOT[0])), "tool tip: pose: expected a list"),
    ],
)
def test_matrices_in_place_of_transforms_are_refused(make: Any, text: str) -> None:
    with refused("SHAPE", text):
        make()


@pytest.mark.judged
def test_poses_visited_thrice_tell_no_more_than_once() -> None:
    robot, seen = TRUTH.simulate_measurements(
        pixel_sigma=0.1, robot_sigmas=NOISE, random=np.random.default_rng(1)
    )
    options: dict[str, Any] = {"setup": "eye-in-hand", "camera": TRUTH.camera, "method": "robot"}
    once = calibrate_hand_eye(robot, seen, **options)
    again = [view for number in (2, 3) for view in more_views(number)]
    thrice = calibrate_hand_eye(3 * robot, [*seen, *again], **options)
    assert thrice.translation_error > 0.6 * once.translation_error
    (few,) = [one.text for one in thrice.warnings if one.code == Code.TOO_FEW]
    assert few.endswith("got 6 that are different, of 18")
    assert thrice.verdict.level == "unknown"


def more_views(seed: int) -> list[TargetView]:
    random = np.random.default_rng(seed)
    return TRUTH.simulate_measurements(pixel_sigma=0.1, robot_sigmas=NOISE, random=random)[1]
