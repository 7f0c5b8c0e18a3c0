"""The equations of a camera and a robot, their derivatives, and what no method can make up for."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.calibration import CameraModel, RobotSigmas
from smartcam.calibration._hand_eye.robot_noise import adjust_with_noise
from smartcam.geometry._inside import Rigid, exp_rotation
from tests.calibration.inside import (
    OPENCV_METHODS,
    Observations,
    PixelObservations,
    PoseObservations,
    RobotNoise,
    RobotPoses,
    Solution,
    adjust,
    bend_heights,
    check_motion,
    leave_each_out,
    predicted_views,
    solve_closed_form,
    view_products,
)
from tests.calibration.scenes import CAMERA, SHEET, refused, scene

vectors = st.tuples(*[st.floats(-1.7, 1.7)] * 3).map(np.array)


def problem(in_hand: bool, seed: int = 5, poses: int = 7) -> tuple[RobotPoses, Rigid, Rigid, Rigid]:
    """Return a robot, the camera, the target, and the views' poses."""
    truth = scene("eye-in-hand" if in_hand else "eye-to-hand", seed=seed, poses=poses)
    robot = RobotPoses(Rigid.stack(one.rigid for one in truth.robot_poses), in_hand)
    camera, target = truth.camera_pose.rigid, truth.target_pose.rigid
    return robot, camera, target, predicted_views(camera, robot, target)


def pixels(
    seen: Rigid, model: CameraModel = CAMERA, free: tuple[int, ...] = ()
) -> PixelObservations:
    points = np.broadcast_to(SHEET.points, (len(seen.translation), len(SHEET.points), 3))
    before = points @ np.swapaxes(seen.rotation, 1, 2) + seen.translation[:, None]
    shown = model.project(before.reshape(-1, 3)).reshape(*points.shape[:2], 2)
    white = np.broadcast_to(np.eye(2) / 0.1, (*points.shape[:2], 2, 2))
    given = np.ones(points.shape[:2], dtype=np.bool_)
    return PixelObservations(
        white, model, points, shown, bend_heights(points, given), free_parameters=free
    )


def poses(seen: Rigid, free: tuple[int, ...] = ()) -> PoseObservations:
    white = np.broadcast_to(np.diag([1e3] * 6), (len(seen.translation), 6, 6))
    return PoseObservations(white, seen, free_parameters=free)


@pytest.mark.parametrize("in_hand", [True, False])
@pytest.mark.parametrize(
    ("kind", "free"),
    [("pixels", ()), ("pixels", (0, 1, 2, 3, 4, 5, 8, 10, 11, 12)), ("poses", ()), ("poses", (0,))],
)
def test_derivatives_are_those_of_small_steps(
    in_hand: bool, kind: str, free: tuple[int, ...]
) -> None:
    robot, camera, target, seen = problem(in_hand)
    observed: Any = pixels(seen, free=free) if kind == "pixels" else poses(seen, free)
    # away from the truth, and with corrections
    random = np.random.default_rng(1)
    near = Solution(camera.turned_in_source(random.normal(scale=2e-3, size=6)), target)
    start = adjust(robot, observed, near, RobotNoise(RobotSigmas(1e-2, 1e-3)))
    at = dataclasses.replace(
        start,
        corrections=random.normal(scale=1e-2, size=start.corrections.shape),
        camera=camera.turned_in_source(random.normal(scale=2e-3, size=6)),
    )
    total = view_products(robot, observed, at)[0]
    unknown = 12 + observed.extra_count

    def cost(steps: Any, own: Any) -> float:
        corrected = RobotPoses(robot.poses.turned_in_source(at.corrections + own), in_hand)
        moved = predicted_views(
            at.camera.turned_in_source(steps[:6]),
            corrected,
            at.target.turned_in_source(steps[6:12]),
        )
        return float((observed.evaluate(moved, at.change + steps[12:])[0] ** 2).sum())

    right = total[:, :, -1] + (total[:, :, :6] @ at.corrections[..., None])[..., 0]
    scale = np.full(unknown, 1e-6)
    scale[13:17] = 1e-3
    for index in range(unknown):
        step = np.zeros(unknown)
        step[index] = scale[index] if observed.extra_count else 1e-6
        slope = (cost(step, 0.0) - cost(-step, 0.0)) / (4 * step[index])
        assert slope == pytest.approx(right[:, 6 + index].sum(), rel=1e-4, abs=1e-2)
    for index in range(6):
        own = np.zeros_like(at.corrections)
        own[2, index] = 1e-6
        slope = (cost(np.zeros(unknown), own) - cost(np.zeros(unknown), -own)) / 4e-6
        assert slope == pytest.approx(right[2, index], rel=1e-4, abs=1e-2)


@pytest.mark.parametrize("in_hand", [True, False])
@pytest.mark.parametrize("noise", [None, RobotNoise(RobotSigmas(1e-3, 1e-3))])
def test_adjust_of_exact_samples_finds_the_truth(in_hand: bool, noise: RobotNoise | None) -> None:
    robot, camera, target, seen = problem(in_hand)
    observed: Observations
    for observed in (pixels(seen), poses(seen)):
        step = np.array([0.05, -0.04, 0.03, 0.01, 0.02, -0.01])
        start = Solution(camera.turned_in_source(step), target.turned_in_source(-step))
        found = adjust(robot, observed, start, noise)
        assert found.cost < 1e-9
        np.testing.assert_allclose(found.camera.translation, camera.translation, atol=1e-8)
        np.testing.assert_allclose(found.target.translation, target.translation, atol=1e-8)
        np.testing.assert_allclose(found.corrections, 0.0, atol=1e-8)


def test_adjust_of_a_bent_target_finds_its_bends() -> None:
    robot, camera, target, seen = problem(in_hand=True)
    observed = pixels(seen, free=(10, 11, 12))
    made = np.array([4e-4, -2e-4, 1e-4])
    x, y = ((SHEET.points[:, :2] - SHEET.points[:, :2].mean(axis=0)) / [0.12, 0.09]).T
    raised = np.column_stack([x * x, x * y, y * y]) @ made
    bent = SHEET.points + np.outer(raised - raised.mean(), [0.0, 0.0, 1.0])
    shown = [CAMERA.project(bent @ turn.T + shift) for turn, shift in zip(*seen, strict=True)]
    found = adjust(
        robot, dataclasses.replace(observed, pixels=np.array(shown)), Solution(camera, target)
    )
    assert found.cost < 1e-9
    np.testing.assert_allclose(found.change, made, atol=1e-9)


@pytest.mark.parametrize(
    ("columns", "rows", "count"), [(2, 2, 1), (3, 2, 2), (2, 3, 2), (3, 3, 3), (9, 6, 3)]
)
def test_bends_that_points_do_not_show_are_left_out(columns: int, rows: int, count: int) -> None:
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    points = np.tile(np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) * 0.02, (4, 1, 1))
    turned = points @ exp_rotation(np.array([0.0, 0.0, 0.3])).T
    for one, least in ((points, count), (turned, min(count, 3))):
        heights = bend_heights(one, np.ones(one.shape[:2], dtype=np.bool_))
        flat = np.column_stack([np.ones(one[0].shape[0]), one[0][:, :2], heights[0]])
        assert heights.shape[2] == least
        assert np.linalg.matrix_rank(flat) == 3 + least


def test_adjust_that_begins_behind_the_camera_has_no_cost() -> None:
    robot, camera, target, seen = problem(in_hand=True)
    turned = camera.turned_in_source(np.array([math.pi, 0, 0, 0, 0, 0]))
    found = adjust(robot, pixels(seen), Solution(turned, target))
    assert found.cost == math.inf


@pytest.mark.parametrize("number", [0, 1, 2])
def test_evaluate_of_no_lens_and_no_target_is_nan(number: int) -> None:
    *_, seen = problem(True)
    observed = pixels(seen, free=(0, 1, 2))
    change = np.zeros(3)
    change[number] = -2000.0
    off, slopes = observed.evaluate(seen, change)
    fits = observed.evaluate(seen, np.zeros(3))
    assert np.isnan(off).all()
    assert np.isnan(slopes).all()
    assert [off.shape, slopes.shape] == [one.shape for one in fits]


def test_adjust_corrects_a_robot_that_is_off() -> None:
    robot, camera, target, seen = problem(in_hand=False, poses=12)
    off = np.random.default_rng(2).normal(scale=[1e-3] * 3 + [3e-4] * 3, size=(12, 6))
    said = RobotPoses(robot.poses.turned_in_source(off), in_hand=False)
    truth = Solution(camera, target)
    found = adjust(said, pixels(seen), truth, RobotNoise(RobotSigmas(1e-3, 3e-4)))
    plain = adjust(said, pixels(seen), truth)
    kept = [np.linalg.norm(one.camera.translation - camera.translation) for one in (found, plain)]
    assert kept[0] < kept[1] / 1.5
    assert np.corrcoef(found.corrections[:, :3].ravel(), -off[:, :3].ravel())[0, 1] > 0.6


def test_noise_of_the_robot_is_told() -> None:
    robot, camera, target, seen = problem(in_hand=True, poses=30)
    random = np.random.default_rng(3)
    sigmas = RobotSigmas(4e-4, 2e-4)
    off = random.normal(scale=np.repeat(sigmas, 3), size=(30, 6))
    said = RobotPoses(robot.poses.turned_in_source(off), in_hand=True)
    observed = pixels(seen)
    noise = 0.1 * random.normal(size=observed.pixels.shape)
    blurred = dataclasses.replace(observed, pixels=observed.pixels + noise)
    found = adjust_with_noise(said, blurred, Solution(camera, target))
    assert found.noise is not None
    np.testing.assert_allclose(found.noise.robot, sigmas, rtol=0.3)
    assert found.noise.view_error_factor == pytest.approx(1.0, abs=0.8)


@pytest.mark.parametrize("free", [(), (0,), (1, 2, 3, 4)])
@pytest.mark.parametrize("noise", [None, RobotNoise(RobotSigmas(1e-3, 3e-4), 2.0)])
def test_without_each_view_is_what_the_others_give(
    noise: RobotNoise | None, free: tuple[int, ...]
) -> None:
    robot, camera, target, seen = problem(in_hand=True, poses=9)
    random = np.random.default_rng(6)
    off = random.normal(scale=[1e-3] * 3 + [3e-4] * 3, size=(9, 6))
    said = RobotPoses(robot.poses.turned_in_source(off), in_hand=True)
    observed = pixels(seen, free=free)
    whole = adjust(said, observed, Solution(camera, target), noise)
    found = leave_each_out(said, observed, whole)
    for number in (0, 4, 8):
        some = np.delete(np.arange(9), number)
        again = adjust(said.subset(some), observed.subset(some), whole, noise)
        moved = float(np.linalg.norm(again.camera.translation - whole.camera.translation))
        assert moved > 1e-5
        left = found.camera.translation[number] - again.camera.translation
        assert float(np.linalg.norm(left)) < 0.05 * moved
        np.testing.assert_allclose(found.change[number], again.change, rtol=0.4, atol=1e-4)


def test_closed_forms_of_many_poses_begin_with_some_of_them() -> None:
    robot, camera, _, seen = problem(in_hand=True, poses=60)
    off = np.random.default_rng(7).normal(scale=1e-4, size=(60, 6))
    said = RobotPoses(robot.poses.turned_in_source(off), in_hand=True)
    for name in ("park", "shah"):
        some, whole = (
            solve_closed_form(name, said, seen, use_all_views=one) for one in (False, True)
        )
        assert some is not None
        assert whole is not None
        same = np.array_equal(some[0].translation, whole[0].translation)
        assert same == (name == "shah")
        np.testing.assert_allclose(some[0].translation, camera.translation, atol=1e-3)


def test_noise_that_a_views_points_share_is_told() -> None:
    """Each view is shifted as a whole by ten times what its points' noise explains."""
    robot, camera, target, seen = problem(in_hand=True, poses=20)
    random = np.random.default_rng(4)
    observed = pixels(seen)
    points = len(SHEET.points)
    shift = random.normal(scale=0.1 * 10 / math.sqrt(points), size=(20, 6))
    from_pixels = np.array([1 / 1200 / 0.05] * 3 + [0.5 / 1200] * 3)
    moved = Rigid(
        exp_rotation(shift[:, :3] * from_pixels[:3]) @ seen.rotation,
        seen.translation + shift[:, 3:] * from_pixels[3:],
    )
    shown = pixels(moved).pixels + 0.1 * random.normal(size=observed.pixels.shape)
    blurred = dataclasses.replace(observed, pixels=shown)
    found = adjust_with_noise(robot, blurred, Solution(camera, target))
    assert found.noise is not None
    assert found.noise.view_error_factor > 3.0
    assert found.noise.robot.translation < 2e-4


@pytest.mark.parametrize("in_hand", [True, False])
@pytest.mark.parametrize("name", OPENCV_METHODS)
def test_closed_forms_of_exact_samples_find_the_truth(name: str, in_hand: bool) -> None:
    robot, camera, target, seen = problem(in_hand)
    found = solve_closed_form(name, robot, seen)
    assert found is not None
    np.testing.assert_allclose(found[0].rotation, camera.rotation, atol=1e-6)
    np.testing.assert_allclose(found[0].translation, camera.translation, atol=1e-6)
    np.testing.assert_allclose(found[1].translation, target.translation, atol=1e-6)


def test_closed_forms_are_the_ones_that_were_named() -> None:
    """OpenCV takes a method without its name for an output, and always solves by Tsai."""
    robot, _, _, seen = problem(in_hand=True)
    shaken = RobotPoses(
        robot.poses.turned_in_source(np.random.default_rng(5).normal(scale=1e-3, size=(7, 6))), True
    )
    found = {name: solve_closed_form(name, shaken, seen) for name in OPENCV_METHODS}
    places = {tuple(one[0].translation.round(9)) for one in found.values() if one is not None}
    assert len(places) >= 6
    trap = cv2.calibrateHandEye(  # type: ignore[call-overload]
        list(shaken.poses.rotation),
        list(shaken.poses.translation),
        list(seen.rotation),
        list(seen.translation),
        cv2.CALIB_HAND_EYE_PARK,
    )
    tsai = found["tsai"]
    assert tsai is not None
    np.testing.assert_allclose(trap[1].ravel(), tsai[0].translation, atol=1e-12)


def test_closed_forms_that_give_no_rotation_give_nothing() -> None:
    robot, _, _, seen = problem(in_hand=True)
    same = RobotPoses(Rigid(robot.poses.rotation[[0] * 7], robot.poses.translation), True)
    still = Rigid(seen.rotation[[0] * 7], seen.translation)
    with np.errstate(all="ignore"):
        for name in OPENCV_METHODS:
            found = solve_closed_form(name, same, still)
            if found is not None:
                assert np.isfinite(found[0].translation).all()


@given(st.floats(0.0, 2 * math.pi), vectors)
def test_motion_about_any_single_axis_is_refused(angle: float, axis: Any) -> None:
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])
    turns = exp_rotation(np.outer(angle + 0.2 * np.arange(6), axis))
    with refused("INSUFFICIENT_ROTATION", "turns about two axes or more"):
        check_motion(RobotPoses(Rigid(turns, np.random.default_rng(1).normal(size=(6, 3))), True))
