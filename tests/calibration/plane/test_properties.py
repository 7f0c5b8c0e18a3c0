"""Properties of every plane, in all eight octants and any unit of the camera.

Planes are drawn with their origin up to 10 m off in each direction, any turn, normals along and
against z and x among them, and 10^-6 to 10^3 metres for each unit of the camera. Every property has
a number, which is in the names of its tests, here and elsewhere:

====  ===============================================================================
p1    the camera's origin mark maps to the touched origin
p2    a point on ray A maps onto ray A
p3    distances are multiplied by the scale
p4    every result lies in the plane
p5    the inverse gives the point back
p6    the frame is right-handed
p7    a part along ray A heads along ray A, and its heading turns as the part turns
p8    a rigid change of the robot's base commutes with calibrating
p9    so does one of the camera
p10   the order of the points is irrelevant
p11   the zero vector is finite
p12   mirrored input is reported
p13   points in a line and points that are the same are refused
p14 many points map like single ones
p15   a moving camera is the static one calibrated anew at the new pose
p16   stored and loaded, it is the same bit by bit
====  ===============================================================================
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam import CalibrationError
from smartcam.calibration import (
    MovingCamera,
    PlaneCalibration,
    Transform,
    chain_of,
    fit_plane,
    fit_touches,
)
from smartcam.geometry._inside import (
    Array,
    matrix_from_quaternion,
    quaternion_about_z,
    quaternion_multiply,
    rotate_ccw,
)
from smartcam.models import Localization
from tests.calibration.plane.planekit import GRID, SIGMA, Scene, part, scenes, spread
from tests.geometry.rigid import FEW, rotations, transforms, yaw

CLOSE = 1e-9
"""Metres."""

places = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
angles = st.floats(-math.pi, math.pi)
seeds = st.integers(0, 2**32 - 1)


def calibrated(scene: Scene, seed: int | None = None) -> PlaneCalibration:
    touches = scene.robot(GRID) if seed is None else scene.touched(GRID, seed)
    return fit_plane(
        scene.camera(GRID), touches, model="similarity", touch_sigma=SIGMA, tool_z=-scene.turn[:, 2]
    )


def sheet(scene: Scene, place: tuple[float, float], theta: float) -> PlaneCalibration:
    """Return the calibration from the origin mark and three touches of the sheet's rays."""
    marks = np.array(place) + rotate_ccw([[0.0, 0.0], [0.2, 0.0], [0.0, 0.15]], theta)
    seen = scene.camera(marks[:1])[0]
    touches = scene.robot(marks)
    origin = part(seen[0], seen[1], theta)
    return fit_touches(origin, *touches, nominal_scale=scene.scale, tool_z=-scene.turn[:, 2])


def turn_of(localization: Localization) -> Array:
    return matrix_from_quaternion(localization.pose.orientation)


@given(scenes(), places, angles)
def test_plane_p1_origin_maps_to_touched_origin(
    scene: Scene, place: tuple[float, float], theta: float
) -> None:
    found = sheet(scene, place, theta)
    marks = np.array([place])
    assert spread(found.transform(scene.camera(marks)), scene.robot(marks)) < CLOSE


@given(scenes(), places, angles, st.floats(0.01, 0.5))
def test_plane_p2_points_of_ray_a_map_onto_ray_a(
    scene: Scene, place: tuple[float, float], theta: float, along: float
) -> None:
    found = sheet(scene, place, theta)
    marks = np.array(place) + rotate_ccw([[along, 0.0], [0.0, along]], theta)
    assert spread(found.transform(scene.camera(marks)), scene.robot(marks)) < CLOSE


@given(scenes(), places, places)
def test_plane_p3_distances_are_scaled(
    scene: Scene, first: tuple[float, float], second: tuple[float, float]
) -> None:
    found, marks = calibrated(scene), np.array([first, second])
    mapped = found.transform(scene.camera(marks))
    expected = np.linalg.norm(marks[0] - marks[1])
    assert np.linalg.norm(mapped[0] - mapped[1]) == pytest.approx(expected, abs=CLOSE)
    assert found.scale == pytest.approx(scene.scale, rel=CLOSE)


@given(scenes(), places, seeds)
def test_plane_p4_every_result_lies_in_the_plane(
    scene: Scene, place: tuple[float, float], seed: int
) -> None:
    found = calibrated(scene, seed)
    height = (found.transform(scene.camera(np.array([place]))) - found.origin) @ found.normal
    assert abs(height[0]) < CLOSE


@given(scenes(), places, seeds)
def test_plane_p5_inverse_gives_the_point_back(
    scene: Scene, place: tuple[float, float], seed: int
) -> None:
    found, seen = calibrated(scene, seed), scene.camera(np.array([place]))
    assert found.inverse(found.transform(seen)) * scene.scale == pytest.approx(
        np.array([place]), abs=CLOSE
    )


@given(scenes(), seeds)
def test_plane_p6_frame_is_right_handed(scene: Scene, seed: int) -> None:
    found = calibrated(scene, seed)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert found.rotation.T @ found.rotation == pytest.approx(np.eye(3), abs=1e-12)
    assert found.normal @ scene.turn[:, 2] > 0.99


@given(scenes(), places, angles, angles)
def test_plane_p7_heading_follows_the_part(
    scene: Scene, place: tuple[float, float], theta: float, turn: float
) -> None:
    found = sheet(scene, place, theta)
    seen = scene.camera(np.array([place]))[0]
    ray = scene.turn[:, :2] @ [math.cos(theta), math.sin(theta)]
    assert turn_of(found.to_robot(part(seen[0], seen[1], theta)))[:, 0] == pytest.approx(
        ray, abs=CLOSE
    )
    once = found.to_robot(part(seen[0], seen[1], theta)).pose.orientation
    turned = turn_of(found.to_robot(part(seen[0], seen[1], theta + turn)))
    expected = matrix_from_quaternion(quaternion_multiply(once, quaternion_about_z(turn)))
    assert turned == pytest.approx(expected, abs=CLOSE)


@FEW
@given(scenes(), scenes(), places, seeds)
def test_plane_p8_moving_the_robot_base_moves_results(
    scene: Scene, base: Scene, place: tuple[float, float], seed: int
) -> None:
    touches, seen = scene.touched(GRID, seed), scene.camera(np.array([place]))
    here = fit_plane(scene.camera(GRID), touches, touch_sigma=SIGMA, model="similarity")
    moved = touches @ base.turn.T + base.origin
    there = fit_plane(scene.camera(GRID), moved, touch_sigma=SIGMA, model="similarity")
    expected = here.transform(seen) @ base.turn.T + base.origin
    assert spread(there.transform(seen), expected) < CLOSE


@FEW
@given(scenes(), places, angles, st.floats(-3, 3), seeds)
def test_plane_p9_moving_the_camera_changes_nothing(
    scene: Scene, place: tuple[float, float], yaw: float, shift: float, seed: int
) -> None:
    touches, marks = scene.touched(GRID, seed), np.array([place])
    here = fit_plane(scene.camera(GRID), touches, touch_sigma=SIGMA, model="similarity")
    moved = [scene.camera(rotate_ccw(points, yaw) + shift) for points in (GRID, marks)]
    there = fit_plane(moved[0], touches, touch_sigma=SIGMA, model="similarity")
    assert spread(there.transform(moved[1]), here.transform(scene.camera(marks))) < CLOSE


@FEW
@given(scenes(), st.permutations(range(9)), seeds)
def test_plane_p10_order_of_points_is_irrelevant(scene: Scene, order: list[int], seed: int) -> None:
    seen, touches = scene.camera(GRID), scene.touched(GRID, seed)
    first = fit_plane(seen, touches, touch_sigma=SIGMA)
    second = fit_plane(seen[order], touches[order], touch_sigma=SIGMA)
    assert second.model == first.model
    assert spread(second.transform(seen), first.transform(seen)) < CLOSE
    assert second.residuals == pytest.approx(first.residuals[order], abs=CLOSE)


@given(scenes(), angles)
def test_plane_p11_zero_vector_is_finite(scene: Scene, theta: float) -> None:
    found = sheet(scene, (0.0, 0.0), theta)
    assert np.isfinite(found.transform([[0.0, 0.0]])).all()
    pose = found.to_robot(part(0.0, 0.0, theta)).pose
    assert np.isfinite([*pose.position, *pose.orientation]).all()


@given(scenes(), seeds)
def test_plane_p12_mirrored_input_is_reported(scene: Scene, seed: int) -> None:
    mirrored, touches = scene.camera(GRID) * (1, -1), scene.touched(GRID, seed)
    with pytest.raises(CalibrationError, match="y axis points the wrong way") as caught:
        fit_plane(mirrored, touches, touch_sigma=SIGMA, tool_z=-scene.turn[:, 2])
    assert caught.value.code == "MIRRORED"


@given(scenes(), angles)
def test_plane_p13_points_in_a_line_are_refused(scene: Scene, yaw: float) -> None:
    line = rotate_ccw(np.column_stack([np.linspace(0, 0.3, 5), np.zeros(5)]), yaw)
    with pytest.raises(CalibrationError) as caught:
        fit_plane(scene.camera(line), scene.robot(line))
    assert caught.value.code == "COLLINEAR"
    with pytest.raises(CalibrationError) as caught:
        fit_plane(scene.camera(GRID[[1, 1, 1, 1]]), scene.robot(GRID[:4]))
    assert caught.value.code == "COINCIDENT"


@given(scenes(), st.lists(st.tuples(places, angles), min_size=1, max_size=5), seeds)
def test_plane_p14_many_points_map_like_single_ones(
    scene: Scene, lying: list[tuple[tuple[float, float], float]], seed: int
) -> None:
    found = calibrated(scene, seed)
    marks = np.array([place for place, _ in lying])
    seen = scene.camera(marks)
    parts = [part(u, v, theta) for (u, v), (_, theta) in zip(seen, lying, strict=True)]
    many = found.to_robot(parts)
    assert many == [found.to_robot(one) for one in parts]
    positions = np.array([one.pose.position for one in many])
    assert spread(positions, found.transform(seen)) < CLOSE
    repeated = found.transform(np.tile(seen, (1000, 1)))[-len(seen) :]
    assert spread(repeated, found.transform(seen)) < CLOSE


@FEW
@given(scenes(), seeds, st.sampled_from(["auto", "rigid", "similarity", "affine", "homography"]))
def test_plane_p16_stored_data_give_the_same_bits(scene: Scene, seed: int, model: str) -> None:
    found = fit_plane(
        scene.camera(GRID),
        scene.touched(GRID, seed),
        model=model,  # type: ignore[arg-type]  # one of them
        nominal_scale=scene.scale,
    )
    again = PlaneCalibration.from_data(json.loads(json.dumps(found.to_data())))
    assert again.to_data() == found.to_data()
    seen = scene.camera(GRID)
    assert again.transform(seen).tobytes() == found.transform(seen).tobytes()
    assert again.predicted_error(seen).tobytes() == found.predicted_error(seen).tobytes()


@FEW
@given(scenes(), transforms("base", "flange"), rotations(), angles, places, places, angles)
def test_plane_p15_moving_camera_is_the_static_one_calibrated_anew(
    scene: Scene,
    flange: Transform,
    camera: Array,
    turn: float,
    shift: tuple[float, float],
    place: tuple[float, float],
    theta: float,
) -> None:
    """The camera sees the same picture before and after; ``camera`` is how it is on the flange."""
    plane = Transform("base", "table", scene.turn, scene.origin)
    motion = Transform("table", "table", yaw(turn), np.array([*shift, 0.0]))
    mounted = Transform("flange", "flange", camera, np.array([0.1, 0.0, 0.2]))
    now = plane @ motion @ plane.inverse() @ flange
    moved = plane @ motion
    anew = calibrated(Scene(moved.rotation, moved.translation, scene.scale))
    there = calibrated(scene)
    carried = MovingCamera(chain_of(there), flange @ mounted, field=there.robot_points)
    seen = scene.camera(np.array([place]))[0]
    one = carried.at_pose(now @ mounted).to_robot([part(seen[0], seen[1], theta)])[0].pose
    other = anew.to_robot(part(seen[0], seen[1], theta)).pose
    assert one.position == pytest.approx(other.position, abs=CLOSE)
    assert abs(np.dot(one.orientation, other.orientation)) == pytest.approx(1.0)


@given(scenes(), places, angles)
def test_plane_touches_and_points_agree(
    scene: Scene, place: tuple[float, float], theta: float
) -> None:
    seen = scene.camera(np.array([place]))[0]
    one = sheet(scene, place, theta).to_robot(part(seen[0], seen[1], 0.3)).pose
    other = calibrated(scene).to_robot(part(seen[0], seen[1], 0.3)).pose
    assert one.position == pytest.approx(other.position, abs=CLOSE)
    assert abs(np.dot(one.orientation, other.orientation)) == pytest.approx(1.0)


def test_plane_properties_each_number_has_a_test() -> None:
    tests = Path(__file__).parent.glob("test_*.py")
    found = {
        int(number)
        for path in tests
        for number in re.findall(r"^def test_\w+?_p(\d+)_", path.read_text("utf-8"), re.MULTILINE)
    }
    listed = re.findall(r"^p(\d+) ", __doc__ or "", re.MULTILINE)
    assert found == set(range(1, 17)) == set(map(int, listed))
