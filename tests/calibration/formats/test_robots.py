"""Compare poses in robots' conventions with SciPy's rotations and the makers' formulas."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from smartcam.calibration import Transform
from smartcam.calibration._inside import ROBOTS
from smartcam.calibration.formats import pose_from, pose_to
from smartcam.calibration.formats._robots import angles_zyx, rotation_zyx
from tests.geometry.rigid import FEW, angles, close, refused, transforms

EULER = {"kuka": "ZYX", "fanuc": "xyz", "meca500": "XYZ"}
"""SciPy's names: capitals turn about axes that move, small letters about axes that stand."""

X, Y, Z = np.eye(3)


def scipy_rotation() -> Any:
    return pytest.importorskip("scipy.spatial.transform", reason="needs SciPy").Rotation


@pytest.mark.parametrize("robot", EULER)
@FEW
@given(turns=st.tuples(angles, angles, angles))
@example(turns=(0.3, math.pi / 2, -1.2))
@example(turns=(0.3, -math.pi / 2, -1.2))
def test_pose_from_angles_is_the_rotation_of_scipy(
    robot: str, turns: tuple[float, float, float]
) -> None:
    degrees = np.degrees(turns)
    pose = pose_from(robot, [400.0, -120.0, 35.5, *degrees])
    expected = scipy_rotation().from_euler(EULER[robot], degrees, degrees=True).as_matrix()
    assert np.allclose(pose.rotation, expected, rtol=0, atol=1e-14)
    assert pose.translation.tolist() == [0.4, -0.12, 0.0355]


@pytest.mark.parametrize("robot", EULER)
@FEW
@given(pose=transforms("base", "tool"))
def test_pose_to_angles_gives_angles_of_the_same_rotation_in_scipy(
    robot: str, pose: Transform
) -> None:
    values = pose_to(robot, pose)
    made = scipy_rotation().from_euler(EULER[robot], values[3:], degrees=True).as_matrix()
    assert np.allclose(made, pose.rotation, rtol=0, atol=4e-15)
    assert values[:3] == (1000 * pose.translation).tolist()
    assert abs(values[4]) <= 90


@given(pose=transforms("base", "tool"))
def test_rotation_vector_is_that_of_scipy(pose: Transform) -> None:
    vector = scipy_rotation().from_matrix(np.array(pose.rotation)).as_rotvec()
    found = pose_to("ur", pose)[3:]
    half_turn = math.isclose(float(np.linalg.norm(vector)), math.pi, abs_tol=1e-6)
    assert np.allclose(found, vector, rtol=0, atol=1e-7) or (
        half_turn and np.allclose(found, -vector, rtol=0, atol=1e-7)
    )
    back = scipy_rotation().from_rotvec(found).as_matrix()
    assert np.allclose(back, pose.rotation, rtol=0, atol=4e-15)


@pytest.mark.parametrize("robot", ROBOTS)
@FEW
@given(pose=transforms("base", "tool"))
def test_pose_written_and_read_is_the_same(robot: str, pose: Transform) -> None:
    values = pose_to(robot, pose)
    assert len(values) == len(ROBOTS[robot].numbers)
    assert close(pose_from(robot, values), pose, 1e-14)


@pytest.mark.parametrize(
    ("robot", "turn", "x_goes_to", "y_goes_to"),
    [
        ("kuka", [90, 0, 0], Y, -X),  # a is about z
        ("kuka", [0, 0, 90], X, Z),  # c is about x
        ("fanuc", [90, 0, 0], X, Z),  # w is about x
        ("fanuc", [0, 0, 90], Y, -X),  # r is about z
        ("meca500", [90, 90, 0], Y, Z),  # x first, then the turned y
        ("fanuc", [90, 90, 0], -Z, X),  # x first, then the fixed y
        ("ur", [0, 0, math.pi / 2], Y, -X),
        ("abb", [math.sqrt(0.5), 0, 0, math.sqrt(0.5)], Y, -X),
        ("wxyz", [math.sqrt(0.5), math.sqrt(0.5), 0, 0], X, Z),
        ("xyzw", [math.sqrt(0.5), 0, 0, math.sqrt(0.5)], X, Z),
    ],
)
def test_pose_from_angles_turns_the_axes_by_the_maker_s_convention(
    robot: str, turn: list[float], x_goes_to: Any, y_goes_to: Any
) -> None:
    rotation = pose_from(robot, [0, 0, 0, *turn]).rotation
    assert np.allclose(rotation[:, 0], x_goes_to, atol=1e-15)
    assert np.allclose(rotation[:, 1], y_goes_to, atol=1e-15)


@pytest.mark.parametrize("off", [0.0, 1e-17, 1e-12, 1e-9, 1e-6])
@pytest.mark.parametrize("side", [1, -1])
def test_angles_close_to_a_quarter_turn_are_the_rotation_all_the_same(
    off: float, side: int
) -> None:
    rotation = rotation_zyx(0.7, side * (math.pi / 2 - off), -2.1)
    assert np.allclose(rotation_zyx(*angles_zyx(rotation)), rotation, rtol=0, atol=1e-15)


def test_vector_of_no_turn_is_zero_and_a_tiny_one_is_kept() -> None:
    assert pose_to("ur", pose_from("ur", [1, 2, 3, 0, 0, 0])) == [1, 2, 3, 0, 0, 0]
    tiny = pose_to("ur", pose_from("ur", [0, 0, 0, 1e-9, 0, -2e-9]))
    assert np.allclose(tiny[3:], [1e-9, 0, -2e-9], rtol=1e-6, atol=0)


def test_vector_longer_than_half_a_turn_comes_back_as_the_shorter_way() -> None:
    vector = pose_to("ur", pose_from("ur", [0, 0, 0, 0, 0, 1.5 * math.pi]))[3:]
    assert np.allclose(vector, [0, 0, -0.5 * math.pi], atol=1e-15)


@pytest.mark.parametrize(
    ("robot", "values", "code", "text"),
    [
        ("puma", [0] * 6, "UNKNOWN_FORMAT", "'puma'; expected one of ur, abb, kuka, fanuc"),
        ("kuka", [0] * 7, "SHAPE", "pose of kuka (x, y, z, a, b, c)"),
        ("ur", "p[0, 0]", "SHAPE", "expected"),
        ("fanuc", [0, 0, 0, 0, 0, math.nan], "NOT_FINITE", "expected finite numbers"),
        ("fanuc", [0, 0, 0, 0, 0, 1e30], "NOT_FINITE", "at most 1e+09"),
        ("abb", [0, 0, 0, 0.6, 0.6, 0, 0], "NOT_RIGID", "a quaternion of length 1"),
        ("xyzw", [0] * 7, "NOT_RIGID", "of length 0"),
    ],
)
def test_pose_from_invalid_values_is_refused(robot: str, values: Any, code: str, text: str) -> None:
    with refused(code, text):
        pose_from(robot, values)


def test_pose_to_an_unknown_robot_is_refused() -> None:
    with refused("UNKNOWN_FORMAT", "'Kuka'"):
        pose_to("Kuka", pose_from("ur", [0] * 6))
