"""Cameras on robots whose truth is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from imaging_scenes import CAMERA, SHEET, refused, scene

from smartcam.calibration.geometry.frames import Transform
from smartcam.calibration.hand_eye.equations import RobotSigmas, Setup
from smartcam.calibration.simulation.scenes import around, view

SETUPS: list[Setup] = ["eye-in-hand", "eye-to-hand"]
EXACT = RobotSigmas(0.0, 0.0)


def before(distance: float) -> Transform:
    """Return the sheet, upright, centred and facing the camera."""
    return Transform("camera", "target", np.diag([1.0, -1.0, -1.0]), np.array([0, 0, distance]))


def test_view_without_noise_shows_points_where_they_are() -> None:
    seen = view(SHEET, CAMERA, before(0.5), sigma=0.0, random=np.random.default_rng(1), name="one")
    np.testing.assert_array_equal(seen.points, CAMERA.project(before(0.5).apply(SHEET.points)))
    assert seen.ids.tolist() == list(range(len(SHEET.points)))
    assert (seen.name, seen.size) == ("one", CAMERA.size)


def test_view_noise_has_the_sigma_that_its_covariance_says() -> None:
    random = np.random.default_rng(2)
    views = [view(SHEET, CAMERA, before(0.5), sigma=0.2, random=random) for _ in range(60)]
    off = np.concatenate(
        [one.points - CAMERA.project(before(0.5).apply(SHEET.points)) for one in views]
    )
    assert off.std() == pytest.approx(0.2, rel=0.06)
    np.testing.assert_allclose(views[0].sigmas, 0.2)


def test_view_of_a_sheet_half_outside_has_the_points_inside() -> None:
    seen = view(SHEET, CAMERA, before(0.12), sigma=0.0, random=np.random.default_rng(1))
    whole = CAMERA.project(before(0.12).apply(SHEET.points))
    width, height = CAMERA.size
    inside = (
        (whole >= -0.5).all(axis=1) & (whole[:, 0] < width - 0.5) & (whole[:, 1] < height - 0.5)
    )
    assert 4 <= inside.sum() < len(SHEET.points)
    np.testing.assert_array_equal(seen.ids, np.flatnonzero(inside))


def test_view_of_a_sheet_behind_the_camera_is_refused() -> None:
    with refused("OUT_OF_FIELD", "at least 4 points of the target in the image, got 0 of 20"):
        view(SHEET, CAMERA, before(-0.5), sigma=0.0, random=np.random.default_rng(1))


def test_around_looks_at_the_centre_from_within_the_cone() -> None:
    looks = around(SHEET, 20, tilt=math.radians(30), distance=0.5, random=np.random.default_rng(3))
    centre = SHEET.points.max(axis=0) / 2
    for look in looks:
        seen = look.inverse().apply(centre)
        np.testing.assert_allclose(seen[:2], 0.0, atol=1e-12)
        assert 0.4 <= seen[2] <= 0.6
        assert math.degrees(math.acos(-look.rotation[2, 2])) <= 30.0


@pytest.mark.parametrize("setup", SETUPS)
def test_scene_without_noise_says_what_is_so(setup: Setup) -> None:
    truth = scene(setup)
    poses, views = truth.measured(
        pixel_sigma=0.0, robot_sigmas=EXACT, random=np.random.default_rng(1)
    )
    assert [pose.label for pose in poses] == ["T_base_flange"] * len(poses)
    for pose, said, seen in zip(truth.robot_poses, poses, views, strict=True):
        np.testing.assert_allclose(said.rotation, pose.rotation, atol=1e-15)
        expected = CAMERA.project(truth.seen(pose).apply(SHEET.points))
        np.testing.assert_allclose(seen.points, expected[seen.ids], atol=1e-12)


@pytest.mark.parametrize("setup", SETUPS)
def test_scene_noise_of_the_robot_has_its_sigmas(setup: Setup) -> None:
    truth, random = scene(setup), np.random.default_rng(4)
    turns, shifts = [], []
    for _ in range(40):
        poses, _ = truth.measured(
            pixel_sigma=0.0, robot_sigmas=RobotSigmas(1e-3, 2e-4), random=random
        )
        for pose, said in zip(truth.robot_poses, poses, strict=True):
            off = pose.rotation.T @ said.rotation
            turns.append([off[2, 1], off[0, 2], off[1, 0]])
            shifts.append(said.translation - pose.translation)
    assert np.std(turns) == pytest.approx(1e-3, rel=0.05)
    assert np.std(shifts) == pytest.approx(2e-4, rel=0.05)


def test_bound_is_in_proportion_to_the_pixels_of_an_exact_robot() -> None:
    truth = scene("eye-in-hand")
    one = truth.bound(pixel_sigma=0.1, robot_sigmas=EXACT)
    three = truth.bound(pixel_sigma=0.3, robot_sigmas=EXACT)
    np.testing.assert_allclose(np.array(three), 3.0 * np.array(one), rtol=1e-9)


@pytest.mark.parametrize("setup", SETUPS)
def test_bound_of_exact_pixels_is_that_of_the_robot_alone(setup: Setup) -> None:
    """Where the views are exact, errors are in proportion to the robot's noise."""
    truth = scene(setup)
    one = truth.bound(pixel_sigma=1e-3, robot_sigmas=RobotSigmas(1e-4, 1e-4))
    two = truth.bound(pixel_sigma=1e-3, robot_sigmas=RobotSigmas(2e-4, 2e-4))
    np.testing.assert_allclose(np.array(two), 2.0 * np.array(one), rtol=1e-2)


def test_errors_of_a_pose_are_its_turn_and_shift() -> None:
    truth = scene("eye-to-hand")
    off = Transform("camera", "camera", np.diag([-1.0, -1.0, 1.0]), np.array([0.003, 0, 0.004]))
    turn, shift = truth.errors(truth.camera_pose @ off)
    assert turn == pytest.approx(math.pi)
    assert shift == pytest.approx(0.005)
    turn, shift = truth.errors(truth.camera_pose)
    assert turn == pytest.approx(0.0, abs=1e-9)
    assert shift == 0.0
