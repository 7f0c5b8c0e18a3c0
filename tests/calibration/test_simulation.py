"""Simulated cameras on robots and images of targets, with known truth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from smartcam.calibration import (
    CameraModel,
    Charuco,
    Checkerboard,
    CircleGrid,
    RobotSigmas,
    Transform,
)
from smartcam.calibration.simulation import poses_around, render, view
from smartcam.geometry._inside import Code
from tests.calibration.inside import Setup, charuco_board
from tests.calibration.scenes import BENT, CAMERA, FACING, SHEET, STRAIGHT, facing, refused, scene

SETUPS: list[Setup] = ["eye-in-hand", "eye-to-hand"]
EXACT = RobotSigmas(0.0, 0.0)


def before(distance: float) -> Transform:
    """Return the sheet, upright, centred and facing the camera."""
    return Transform("camera", "target", np.diag([1.0, -1.0, -1.0]), np.array([0, 0, distance]))


def test_view_without_noise_has_points_at_their_true_places() -> None:
    seen = view(SHEET, CAMERA, before(0.5), sigma=0.0, random=np.random.default_rng(1), name="one")
    np.testing.assert_array_equal(seen.points, CAMERA.project(before(0.5).apply(SHEET.points)))
    assert seen.ids.tolist() == list(range(len(SHEET.points)))
    assert (seen.name, seen.size) == ("one", CAMERA.size)


def test_view_noise_has_the_sigma_of_its_covariance() -> None:
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
    looks = poses_around(
        SHEET, 20, tilt=math.radians(30), distance=0.5, random=np.random.default_rng(3)
    )
    centre = SHEET.points.max(axis=0) / 2
    for look in looks:
        seen = look.inverse().apply(centre)
        np.testing.assert_allclose(seen[:2], 0.0, atol=1e-12)
        assert 0.4 <= seen[2] <= 0.6
        assert math.degrees(math.acos(-look.rotation[2, 2])) <= 30.0


@pytest.mark.parametrize("setup", SETUPS)
def test_scene_without_noise_gives_the_truth(setup: Setup) -> None:
    truth = scene(setup)
    poses, views = truth.simulate_measurements(
        pixel_sigma=0.0, robot_sigmas=EXACT, random=np.random.default_rng(1)
    )
    assert [pose.label for pose in poses] == ["T_base_flange"] * len(poses)
    for pose, said, seen in zip(truth.robot_poses, poses, views, strict=True):
        np.testing.assert_allclose(said.rotation, pose.rotation, atol=1e-15)
        expected = CAMERA.project(truth.target_in_camera(pose).apply(SHEET.points))
        np.testing.assert_allclose(seen.points, expected[seen.ids], atol=1e-12)


@pytest.mark.parametrize("setup", SETUPS)
def test_scene_noise_of_the_robot_has_its_sigmas(setup: Setup) -> None:
    truth, random = scene(setup), np.random.default_rng(4)
    turns, shifts = [], []
    for _ in range(40):
        poses, _ = truth.simulate_measurements(
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
    one = truth.cramer_rao_bound(pixel_sigma=0.1, robot_sigmas=EXACT)
    three = truth.cramer_rao_bound(pixel_sigma=0.3, robot_sigmas=EXACT)
    np.testing.assert_allclose(np.array(three), 3.0 * np.array(one), rtol=1e-9)


@pytest.mark.parametrize("setup", SETUPS)
def test_bound_of_exact_pixels_is_that_of_the_robot_alone(setup: Setup) -> None:
    """Errors are in proportion to the robot's noise where the views are exact."""
    truth = scene(setup)
    one = truth.cramer_rao_bound(pixel_sigma=1e-3, robot_sigmas=RobotSigmas(1e-4, 1e-4))
    two = truth.cramer_rao_bound(pixel_sigma=1e-3, robot_sigmas=RobotSigmas(2e-4, 2e-4))
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


# ----------------------------------------------------------------------
# Compare images of targets with their geometry.


UNIT = CameraModel(size=(60, 50), matrix=np.array([[1000, 0, 0], [0, 1000, 0], [0, 0, 1.0]]))
"""A pixel is a millimetre at a metre."""


def upright(left: float, down: float) -> Transform:
    """Return a sheet a metre away, and the pixel of its origin in ``UNIT``."""
    return Transform("camera", "target", FACING, np.array([left, down, 1e3]) / 1e3)


def test_render_edge_covers_its_share_of_a_pixel() -> None:
    board = Checkerboard(columns=3, rows=3, square=0.01)
    image = render(board, UNIT, upright(20.25, 30.0), blur=0, black=0, white=200)
    # pixel 20 reaches from 19.5 to 20.5: three quarters of it lie left of the edge
    assert image[26, 17:24].tolist() == [200, 200, 200, 150, 0, 0, 0]
    assert image[34, 17:24].tolist() == [0, 0, 0, 50, 200, 200, 200]


def test_render_outline_and_paper_are_at_their_true_places() -> None:
    board = Checkerboard(columns=3, rows=3, square=0.01)
    image = render(board, UNIT, upright(20.5, 29.5), blur=0, black=0, white=200, background=90)
    # the outermost square is black, then comes paper as wide as a square
    assert image[34, 0] == 90 or image[34, 0] == 200
    assert image[34, 8:12].tolist() == [200, 200, 200, 0]
    assert image[35, 18:23].tolist() == [0, 0, 0, 200, 200]
    assert image[39, 15] == 0
    assert image[40, 15] == 200


def test_render_origin_mark_is_a_dot_outside_of_the_origin() -> None:
    board = Checkerboard(columns=3, rows=3, square=0.01, origin_mark=True)
    image = render(board, UNIT, upright(20, 30), blur=0, black=0, white=200)
    u, v = 20 - 13, 30 + 13
    assert image[v, u] == 0
    near = image[v - 2 : v + 3, u - 2 : u + 3]
    assert (1 - near / 200).sum() == pytest.approx(np.pi * 1.5**2, rel=0.03)


@pytest.mark.parametrize("asymmetric", [False, True])
def test_render_dots_have_their_areas_and_centroids(*, asymmetric: bool) -> None:
    grid = CircleGrid(
        columns=3, rows=4, spacing=0.01, diameter=0.004, asymmetric=asymmetric,
        origin_diameter=0.006,
    )  # fmt: skip
    image = render(grid, UNIT, upright(15.3, 38.6), blur=0.5, black=0, white=200)
    pattern_shapes = 1 - image.astype(float) / 200
    for point, diameter in zip(grid.points, [6] + [4] * 11, strict=True):
        u, v = 15.3 + 1e3 * point[0], 38.6 - 1e3 * point[1]
        y, x = np.mgrid[:50, :60]
        near = pattern_shapes * (np.hypot(x - u, y - v) < 3.6 + (diameter - 4) / 2)
        if not asymmetric or diameter == 4:
            assert near.sum() == pytest.approx(np.pi * diameter**2 / 4, rel=0.05)
            assert (near * x).sum() / near.sum() == pytest.approx(u, abs=0.05)
            assert (near * y).sum() / near.sum() == pytest.approx(v, abs=0.05)


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize(
    ("rows", "legacy"),
    [
        (5, False),
        (6, True),
        *(pytest.param(*one, marks=pytest.mark.long) for one in [(6, False), (5, True)]),
    ],
)
def test_render_charuco_is_the_board_that_opencv_draws(rows: int, *, legacy: bool) -> None:
    target = Charuco(columns=4, rows=rows, square=0.012, marker=0.006, legacy_pattern=legacy)
    camera = CameraModel(
        size=(4 * 84, rows * 84), matrix=np.array([[7000, 0, 0], [0, 7000, 0], [0, 0, 1.0]])
    )
    # 84 pixels a square, of which the first begins at -0.5
    away = Transform("camera", "target", FACING, np.array([83.5, rows * 84 - 84.5, 7000]) / 7000)
    image = render(target, camera, away, blur=0, black=0, white=255)
    expected = charuco_board(target).generateImage(camera.size, marginSize=0)
    assert np.abs(image.astype(int) - expected).mean() < 0.5


@pytest.mark.parametrize("camera", [STRAIGHT, BENT])
def test_render_edges_are_where_the_camera_projects_them(camera: CameraModel) -> None:
    board = Checkerboard(columns=9, rows=6, square=0.025)
    pose = facing(board, tilt=30, roll=5)
    image = render(board, camera, pose, blur=0.5, black=0, white=200).astype(float)
    # along an edge that runs upwards, the mean over a row of pixels is at the row's middle
    ends = board.points[13] + np.array([[0, 0.008, 0], [0, 0.017, 0]])
    (u0, v0), (u1, v1) = camera.project(ends @ pose.rotation.T + pose.translation)
    for row in range(int(v1) + 1, int(v0)):
        expected = u0 + (row - v0) / (v1 - v0) * (u1 - u0)
        left = int(expected) - 6
        part = image[row, left : left + 13]
        share = (part - part[-1]).sum() / (part[0] - part[-1])
        assert left - 0.5 + share == pytest.approx(expected, abs=0.01)


def test_render_noise_has_the_given_sigma_and_is_reproducible() -> None:
    board = Checkerboard(columns=3, rows=3, square=0.001)
    first = render(board, UNIT, upright(20, 30), noise=5)
    assert first[:20].std() == pytest.approx(5, rel=0.1)
    np.testing.assert_array_equal(first, render(board, UNIT, upright(20, 30), noise=5))
    other = render(board, UNIT, upright(20, 30), noise=5, random=np.random.default_rng(1))
    assert (first != other).any()


def test_render_of_sheet_outside_of_the_image_is_background() -> None:
    board = Checkerboard(columns=3, rows=3, square=0.001)
    assert (render(board, UNIT, upright(500, 30), background=77) == 77).all()


def test_render_from_behind_is_refused() -> None:
    board = Checkerboard(columns=3, rows=3, square=0.01)
    behind = Transform("camera", "target", np.eye(3), np.array([0, 0, 1.0]))
    with refused(Code.MIRRORED, "T_camera_target: expected the sheet's front"):
        render(board, UNIT, behind)


def test_render_of_sheet_behind_the_camera_is_refused() -> None:
    board = Checkerboard(columns=3, rows=3, square=0.01)
    grazing = facing(board, tilt=85, away=0.01)
    with refused(Code.OUT_OF_FIELD, "the sheet in front of the camera, got a corner at z = -"):
        render(board, STRAIGHT, grazing)
