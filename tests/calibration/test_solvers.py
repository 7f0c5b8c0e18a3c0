"""Solvers: each part of the way from the camera to the robot, and the chain of them.

The figures are those of the traps in the thesis' text: what its sentences, taken literally, give.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from smartcam.calibration import (
    Chain,
    Height,
    PlaneProjection,
    ToolOffset,
    Transform,
    chain_of,
    fit_plane,
)
from tests.calibration.inside import CameraPosition2D, PlaneModel, Poses, RealWorldPosition, Solver
from tests.geometry.rigid import (
    angles,
    localization,
    refused,
    rotation_about,
    rotations,
    transforms,
    yaw,
)

points = st.lists(st.tuples(*[st.floats(-1, 1)] * 2), min_size=1, max_size=8)
UP = np.array([0.0, 0.0, 1.0])


def heading(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where the x axis of an orientation points, by its textbook matrix."""
    x, y, z, w = quaternion
    return np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])


# ---------------------------------------------------------------------- the thesis' first solver


def test_camera_position_origin_becomes_zero_and_its_angle_nothing() -> None:
    origin, theta = (0.12, -0.07), 0.4
    found = CameraPosition2D(origin, theta).solve(Poses.planar([origin], [theta]))
    np.testing.assert_allclose(found.points, [[0, 0, 0]], atol=1e-17)
    np.testing.assert_allclose(found.quaternions, [[0, 0, 0, 1]], atol=1e-16)


def test_camera_position_subtracts_before_it_turns() -> None:
    origin, theta, on_sheet = np.array([0.12, -0.07]), math.radians(30), np.array([0.1, 0.05])
    seen = yaw(theta)[:2, :2] @ on_sheet + origin
    found = CameraPosition2D(origin, theta).solve(Poses.planar([seen]))
    np.testing.assert_allclose(found.points[0], [0.1, 0.05, 0], atol=1e-16)


def test_camera_position_scale_comes_last() -> None:
    solver = CameraPosition2D((100, 200), math.pi / 2, scale=0.00025)
    found = solver.solve(Poses.planar([(100, 600), (500, 200)]))
    np.testing.assert_allclose(found.points, [[0.1, 0, 0], [0, -0.1, 0]], atol=1e-16)


@given(points, angles, angles)
def test_camera_position_turning_the_camera_changes_nothing(
    places: list[tuple[float, float]], theta: float, turn: float
) -> None:
    seen = np.array(places)
    thetas = np.linspace(-3, 3, len(seen))
    still = CameraPosition2D((0.3, 0.1), theta).solve(Poses.planar(seen, thetas))
    r = yaw(turn)[:2, :2]
    turned = CameraPosition2D(r @ [0.3, 0.1], theta + turn)
    found = turned.solve(Poses.planar(seen @ r.T, thetas + turn))
    np.testing.assert_allclose(found.points, still.points, atol=1e-14)
    same = np.abs(np.sum(found.quaternions * still.quaternions, axis=1))
    np.testing.assert_allclose(same, 1, atol=1e-14)


# ---------------------------------------------------------------------- the thesis' second solver


@given(transforms(), points)
def test_real_world_position_is_the_rigid_motion(
    truth: Transform, places: list[tuple[float, float]]
) -> None:
    found = RealWorldPosition(truth.translation, truth.rotation).solve(Poses.planar(places))
    flat = np.column_stack([np.array(places), np.zeros(len(places))])
    np.testing.assert_allclose(found.points, truth.apply(flat), atol=1e-14)


def test_real_world_position_of_a_turned_sheet_keeps_its_turn() -> None:
    """Point and normal alone leave it open: 103.5 mm at 200 mm for 30 degrees."""
    rotation = yaw(math.radians(30))
    o = np.array([0.4, 0.1, 0.02])
    solver = RealWorldPosition.from_touches(o, o + rotation[:, 0] * 0.2, o + rotation[:, 1] * 0.1)
    found = solver.solve(Poses.planar([(0.2, 0.0)], [math.radians(135)]))
    np.testing.assert_allclose(found.points[0], o + 0.2 * rotation[:, 0], atol=1e-16)
    x, y, _ = heading(found.quaternions[0])
    assert math.degrees(math.atan2(y, x)) == pytest.approx(165)


def test_real_world_position_orientation_on_a_wall_stands_on_the_wall() -> None:
    wall = RealWorldPosition.from_touches((0.5, 0, 0.3), (0.5, 0.2, 0.3), (0.5, 0, 0.5))
    found = wall.solve(Poses.planar([(0, 0)], [0.7]))
    np.testing.assert_allclose(
        heading(found.quaternions[0]), [0, math.cos(0.7), math.sin(0.7)], atol=1e-15
    )
    x, y, z, w = found.quaternions[0]
    normal = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    np.testing.assert_allclose(normal, [1, 0, 0], atol=1e-15)


def test_real_world_position_touches_that_give_no_plane_are_refused() -> None:
    with refused("COLLINEAR", "10 degrees"):
        RealWorldPosition.from_touches((0, 0, 0), (0.2, 0, 0), (0.3, 0.01, 0))
    with refused("COINCIDENT"):
        RealWorldPosition.from_touches((0, 0, 0), (0, 0, 0), (0, 0.1, 0))
    with refused("NOT_RIGID"):
        RealWorldPosition((0, 0, 0), np.diag([1, 1, -1]))


# ---------------------------------------------------------------------- height


def test_height_moves_along_the_ray_to_the_camera() -> None:
    """20 mm high and 150 mm aside of a camera 500 mm above: seen 6.25 mm too far out."""
    solver = Height(0.02, viewpoint=(0, 0, 0.5))
    found = solver.solve(Poses.planar([(0.15 * 0.5 / 0.48, 0)]))
    np.testing.assert_allclose(found.points, [[0.15, 0, 0.02]], atol=1e-16)
    assert pytest.approx(0.00625) == 0.15 * 0.5 / 0.48 - 0.15


@given(transforms(), points, st.floats(-0.05, 0.2), st.floats(0.3, 1))
def test_height_is_exact_in_any_frame(
    truth: Transform, places: list[tuple[float, float]], height: float, above: float
) -> None:
    tops = np.column_stack([np.array(places), np.full(len(places), height)])
    camera = np.array([0.1, -0.2, above])
    seen = tops + (tops - camera) * height / (above - height)  # where the rays meet the plane
    in_plane = Height(height, viewpoint=camera)
    in_robot = Height(height, 3 * truth.rotation[:, 2], truth.apply(camera))
    real = RealWorldPosition(truth.translation, truth.rotation)
    for chain in (Chain([in_plane, real]), Chain([real, in_robot])):
        found = chain.solve(Poses.planar(seen[:, :2]))
        np.testing.assert_allclose(found.points, truth.apply(tops), atol=1e-9)


def test_height_without_a_viewpoint_goes_along_the_normal() -> None:
    found = Height(0.02, normal=(0, 2, 0)).solve(Poses.planar([(0.1, 0.2)]))
    np.testing.assert_allclose(found.points, [[0.1, 0.22, 0]], atol=1e-16)


def test_height_above_the_camera_and_without_a_normal_is_refused() -> None:
    with refused("SHORT_LEVER", "more than 0.6 m above each point, got 0.5 m"):
        Height(0.6, viewpoint=(0, 0, 0.5)).solve(Poses.planar([(0, 0)]))
    with refused("SHORT_LEVER", "expected a normal"):
        Height(0.1, normal=(0, 0, 0))


# ---------------------------------------------------------------------- tools


@given(transforms("base", "part"), transforms("part", "tool"))
def test_tool_offset_is_the_product_of_transforms(part: Transform, tool: Transform) -> None:
    poses = Poses(part.translation[None], part.quaternion[None])
    found = ToolOffset(tool.translation, tool.quaternion).solve(poses)
    whole = part @ tool
    np.testing.assert_allclose(found.points[0], whole.translation, atol=1e-11)
    assert abs(float(found.quaternions[0] @ whole.quaternion)) == pytest.approx(1, abs=1e-13)


def test_tool_facing_points_into_the_plane_with_the_same_heading() -> None:
    found = ToolOffset.facing().solve(Poses.planar([(0.1, 0.2)], [0.6]))
    np.testing.assert_allclose(
        heading(found.quaternions[0]), [math.cos(0.6), math.sin(0.6), 0], atol=1e-15
    )
    x, y, _, _ = found.quaternions[0]
    assert 1 - 2 * (x * x + y * y) == pytest.approx(-1)  # z of its z axis


@given(transforms("base", "part"), transforms("flange", "tip"))
def test_tool_flange_puts_the_tip_onto_the_part(part: Transform, tip: Transform) -> None:
    poses = Poses(part.translation[None], part.quaternion[None])
    found = ToolOffset.flange(tip.translation, tip.quaternion).solve(poses)
    flange = Transform.from_quaternion("base", "flange", found.points[0], found.quaternions[0])
    reached = flange @ tip
    np.testing.assert_allclose(reached.translation, part.translation, atol=1e-9)
    np.testing.assert_allclose(reached.rotation, part.rotation, atol=1e-12)


# ---------------------------------------------------------------------- the chain


def test_chain_is_a_solver_and_the_empty_one_changes_nothing() -> None:
    poses = Poses.planar([(1, 2)], [0.3])
    assert isinstance(Chain([]), Solver)
    assert Chain([]).solve(poses) is poses
    assert not isinstance(object(), Solver)


def test_chain_applies_in_order_and_then_adds_behind() -> None:
    first, second = CameraPosition2D((1, 0)), CameraPosition2D((0, 0), math.pi / 2)
    chain = Chain([first], frame="table").then(second)
    np.testing.assert_allclose(chain.transform([(2, 0)]), [[0, -1, 0]], atol=1e-16)
    assert chain.frame == "table"
    nested = Chain([Chain([first]), second])
    np.testing.assert_array_equal(nested.transform([(2, 5)]), chain.transform([(2, 5)]))


@given(rotations(), points)
def test_chain_of_many_is_that_of_each_alone(
    rotation: NDArray[np.float64], places: list[tuple[float, float]]
) -> None:
    chain = Chain([CameraPosition2D((0.1, 0.2), 0.3), RealWorldPosition((1, 2, 3), rotation)])
    alone = [chain.transform([place])[0] for place in places]
    np.testing.assert_allclose(chain.transform(places), alone, rtol=0, atol=1e-15)


def test_chain_to_robot_keeps_what_is_not_the_pose() -> None:
    rotation = rotation_about(UP, 0.0)
    chain = Chain([RealWorldPosition((1, 2, 3), rotation)], frame="base")
    part = localization(0.1, 0.2, 0.3, "square")
    (found,) = chain.to_robot([part])
    assert (found.feature_id, found.quality, found.photo_index) == ("square", 0.9, 1)
    assert found.pose.header == part.pose.header._replace(frame_id="base")
    np.testing.assert_allclose(
        found.pose.position, rotation @ [0.1, 0.2, 0] + [1, 2, 3], atol=1e-15
    )
    assert type(found.pose.position.x) is float
    assert chain.to_robot([]) == []
    assert chain.to_robot(part) == found


def test_chain_zero_vector_is_finite() -> None:
    chain = Chain([CameraPosition2D((0, 0)), RealWorldPosition((0, 0, 0), np.eye(3))])
    found = chain.solve(Poses.planar([(0, 0)]))
    np.testing.assert_array_equal(found.points, [[0, 0, 0]])
    np.testing.assert_array_equal(found.quaternions, [[0, 0, 0, 1]])


# ---------------------------------------------------------------------- a calibration as a chain

GRID = np.array([(x, y) for x in (0.0, 0.1, 0.2, 0.3) for y in (0.0, 0.1, 0.2)])


def tilted(places: NDArray[np.float64], tilt: float) -> NDArray[np.float64]:
    """Return where a camera with some tilt sees points of its plane."""
    return places / (1 + places @ [[tilt], [-0.3 * tilt]])


@given(transforms(), st.sampled_from(["rigid", "similarity", "affine", "homography"]))
def test_chain_of_a_calibration_says_what_the_calibration_says(
    truth: Transform, model: Any
) -> None:
    noise = np.random.default_rng(5).normal(0, 1e-4, (len(GRID), 3))
    touched = truth.apply(np.column_stack([GRID, np.zeros(len(GRID))])) + noise
    seen = GRID if model == "rigid" else tilted(GRID, 0.5)
    calibration = fit_plane(seen, touched, model=model, robot_frame="base")
    parts = [localization(x, y, 5 * x - 3 * y) for x, y in GRID + 0.03]
    chain = chain_of(calibration, origin=(0.1, 0.2), theta=0.3)
    for ours, theirs in zip(chain.to_robot(parts), calibration.to_robot(parts), strict=True):
        assert ours.pose.header == theirs.pose.header
        np.testing.assert_allclose(ours.pose.position, theirs.pose.position, rtol=0, atol=1e-12)
        same = abs(np.dot(ours.pose.orientation, theirs.pose.orientation))
        assert same == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(chain.transform(GRID), calibration.transform(GRID), atol=1e-12)
    facing = chain.then(ToolOffset.facing()).to_robot(parts)
    for ours, theirs in zip(facing, calibration.to_robot(parts, tool_flip=True), strict=True):
        same = abs(np.dot(ours.pose.orientation, theirs.pose.orientation))
        assert same == pytest.approx(1, abs=1e-14)


def test_chain_of_a_calibration_for_one_camera_refuses_another_ones_poses() -> None:
    touched = np.column_stack([GRID, np.zeros(len(GRID))])
    models: tuple[PlaneModel, ...] = ("similarity", "affine")
    for model in models:
        calibration = fit_plane(GRID, touched, model=model, camera_frame="left")
        chain = chain_of(calibration).then(ToolOffset.facing())
        with refused("WRONG_FRAME", "expected poses in the frame 'left', got some in 'camera'"):
            chain.to_robot(localization(0.1, 0.1))
        assert chain.to_robot([]) == []


@pytest.mark.parametrize("y_down", [True, False, None])
@pytest.mark.parametrize("model", ["similarity", "affine"])
def test_chain_of_a_calibration_knows_its_y_down(model: PlaneModel, y_down: bool | None) -> None:
    touched = np.column_stack([GRID, np.zeros(len(GRID))])
    chain = chain_of(fit_plane(GRID, touched, model=model, y_down=y_down))
    assert (chain.y_down, chain.then(ToolOffset.facing()).y_down) == (y_down, y_down)


def test_chain_with_a_height_says_what_a_raised_calibration_says() -> None:
    rotation = rotation_about(np.array([0.2, -0.1, 1]), 0.7)
    touched = GRID @ rotation[:, :2].T + [0.5, -0.4, 0.1]
    calibration = fit_plane(GRID, touched, model="similarity")
    camera = np.array([0.5, -0.4, 0.1]) + rotation @ [0.15, 0.1, 0.6]
    chain = chain_of(calibration).then(Height(0.02, calibration.normal, camera))
    raised = calibration.at_height(0.02, camera)
    np.testing.assert_allclose(chain.transform(GRID), raised.transform(GRID), atol=1e-13)


def test_projection_outside_its_field_and_plane_is_refused() -> None:
    projection = PlaneProjection([[1, 0, 0], [0, 1, 0], [0, 0, 0], [-2, 0, 1]])
    assert projection.solve(Poses.planar([(0.25, 0)])).points[0, 0] == 0.5
    with refused("OUT_OF_FIELD", "[0.6, 0.1]: behind the plane's horizon"):
        projection.solve(Poses.planar([(0, 0), (0.6, 0.1)]))
    with refused("OUT_OF_PLANE", "with a height or a tilt"):
        projection.solve(Poses(np.array([[0, 0, 0.1]]), np.array([[0, 0, 0, 1.0]])))


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan])
def test_camera_position_with_an_impossible_scale_is_refused(scale: float) -> None:
    with refused("NOT_FINITE", "scale: expected a positive number of metres"):
        CameraPosition2D((0.0, 0.0), scale=scale)


def test_height_that_is_no_number_is_refused() -> None:
    with refused("NOT_FINITE", "height: expected finite numbers"):
        Height(np.nan)


def test_projection_of_another_shape_is_refused() -> None:
    with refused("SHAPE", r"projection: expected shape (N, 3), got (4, 4)"):
        PlaneProjection(np.eye(4))
    with refused("SHAPE", r"projection: expected shape (4, 3), got (3, 3)"):
        PlaneProjection(np.eye(3))


def test_transform_of_points_in_space_is_refused_and_not_read_as_others() -> None:
    with refused("SHAPE", r"expected points of shape (2, 2), got (2, 3)"):
        Chain([]).transform([(0.1, 0.2, 0.0), (0.3, 0.4, 0.0)])


def test_planar_poses_without_an_angle_for_each_are_refused() -> None:
    with refused("SHAPE", r"expected points of shape (2, 2), got (1, 2)"):
        Poses.planar([(0.1, 0.2)], [0.0, 1.0])
