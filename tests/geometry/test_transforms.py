"""Transforms, their directions, and poses by their times."""

from __future__ import annotations

import math
import pickle
from datetime import datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from smartcam.calibration import PoseHistory, Transform
from tests.geometry.rigid import (
    NOON,
    after,
    close,
    refused,
    rotations,
    transforms,
    translations,
    yaw,
)


def shift(target: str, source: str, x: float, at: datetime | None = None) -> Transform:
    return Transform(target, source, np.eye(3), np.array([x, 0.0, 0.0]), at)


# ---------------------------------------------------------------------- one transform


@given(transforms("a", "b"), transforms("b", "c"), transforms("c", "d"))
def test_transform_products_are_a_group(ab: Transform, bc: Transform, cd: Transform) -> None:
    assert close((ab @ bc) @ cd, ab @ (bc @ cd), 1e-11)
    assert close(ab @ ab.inverse(), Transform("a", "a", np.eye(3), np.zeros(3)), 1e-11)
    point = np.array([0.1, -0.2, 0.3])
    np.testing.assert_allclose((ab @ bc).apply(point), ab.apply(bc.apply(point)), atol=1e-11)


@given(rotations(), translations())
def test_transform_quaternion_there_and_back_is_the_same(
    rotation: NDArray[np.float64], translation: NDArray[np.float64]
) -> None:
    one = Transform("a", "b", rotation, translation)
    again = Transform.from_quaternion("a", "b", translation, one.quaternion)
    assert close(one, again, 1e-14)
    scipys = Rotation.from_matrix(rotation).as_quat()
    assert abs(abs(float(one.quaternion @ scipys)) - 1) < 1e-14


def test_transform_pose_there_and_back_keeps_frame_and_time() -> None:
    one = Transform("base", "flange", yaw(0.5), np.ones(3), NOON)
    pose = one.pose(seq=4)
    assert (pose.header.seq, pose.header.stamp, pose.header.frame_id) == (4, NOON, "base")
    assert pose.orientation.theta == pytest.approx(0.5)
    assert close(Transform.from_pose(pose, "flange"), one, 1e-15)


def test_transform_turn_is_the_product_of_quaternions() -> None:
    one = Transform("a", "b", yaw(0.5), np.zeros(3))
    turned = one.apply_to_orientations([[0.0, 0.0, 1.0, 0.0]])
    np.testing.assert_allclose(turned, [[0, 0, math.cos(0.25), -math.sin(0.25)]], atol=1e-15)


def test_transform_without_a_time_has_no_pose() -> None:
    with refused("BAD_TIME", "T_a_b", "got none"):
        shift("a", "b", 1.0).pose()


@pytest.mark.parametrize(
    "rotation",
    [np.diag([1.0, 1.0, -1.0]), 1.01 * np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan)],
    ids=["mirrored", "scaled", "zero", "nan"],
)
def test_transform_that_is_not_rigid_is_refused(rotation: NDArray[np.float64]) -> None:
    with refused("NOT_RIGID", "T_a_b: expected a rotation"):
        Transform("a", "b", rotation, np.zeros(3))


def test_transform_of_wrong_shape_or_infinite_is_refused() -> None:
    with refused("NOT_RIGID", "got (2, 2) and (3,)"):
        Transform("a", "b", np.eye(2), np.zeros(3))
    with refused("NOT_RIGID", "[inf, 0.0, 0.0]"):
        Transform("a", "b", np.eye(3), np.array([np.inf, 0, 0]))


def test_transform_quaternion_of_few_digits_is_made_one() -> None:
    one = Transform.from_quaternion("a", "b", [0, 0, 0], [0.0, 0.0, 0.71, 0.71])
    np.testing.assert_allclose(one.apply([1, 0, 0]), [0, 1, 0], atol=1e-15)


@pytest.mark.parametrize(
    "quaternion", [[0, 0, 0, 0], [0, 0, 0, 1.02], [0, 0, 1], [0, 0, 0, np.nan]]
)
def test_transform_of_no_quaternion_is_refused(quaternion: list[float]) -> None:
    with refused("NOT_RIGID", "expected a quaternion x, y, z, w of length 1"):
        Transform.from_quaternion("a", "b", [0, 0, 0], quaternion)


def test_transform_wrong_way_round_is_refused() -> None:
    with refused("WRONG_FRAME", "T_base_camera @ T_part_camera", "into 'camera'", "into 'part'"):
        shift("base", "camera", 1.0) @ shift("part", "camera", 1.0)


def test_transform_times_that_differ_are_refused_and_undated_ones_not() -> None:
    first, second = shift("a", "b", 1.0, NOON), shift("b", "c", 2.0, after(1))
    with refused("NOT_SIMULTANEOUS", "12:00:00", "12:00:01"):
        first @ second
    assert (first @ second.undated()).at == NOON
    assert (first.undated() @ second).at == after(1)


def test_transform_time_without_a_zone_is_refused() -> None:
    with refused("BAD_TIME", "time zone"):
        shift("a", "b", 1.0, datetime(2026, 3, 4))  # noqa: DTZ001


def test_transform_arrays_are_its_own_and_read_only() -> None:
    translation = np.zeros(3)
    one = Transform("a", "b", np.eye(3), translation)
    translation[0] = 1.0
    assert one.translation[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        one.rotation[0, 0] = 2.0
    assert close(pickle.loads(pickle.dumps(one)), one, 0.0)  # noqa: S301


@given(transforms(), transforms(), st.floats(0, 1))
def test_transform_between_is_scipys_slerp(
    first: Transform, second: Transform, part: float
) -> None:
    early = Transform("base", "part", first.rotation, first.translation, NOON)
    late = Transform("base", "part", second.rotation, second.translation, after(10))
    at = after(10 * part)
    found = early.between(late, at)
    part = (at - NOON).total_seconds() / 10
    slerp = Slerp([0, 1], Rotation.from_matrix(np.array([first.rotation, second.rotation])))
    both = slerp(part).as_matrix()
    half_turn = np.trace(first.rotation.T @ second.rotation) < -1 + 1e-6  # either way is right
    if not half_turn:
        np.testing.assert_allclose(found.rotation, both, atol=1e-7)
    way = (1 - part) * first.translation + part * second.translation
    np.testing.assert_allclose(found.translation, way, atol=1e-12)
    assert found.at == at


def test_transform_between_refuses_other_frames_and_times() -> None:
    first, second = shift("a", "b", 0.0, NOON), shift("a", "b", 1.0, after(1))
    with refused("BAD_TIME", "12:00:02"):
        first.between(second, after(2))
    with refused("WRONG_FRAME", "T_a_b", "T_a_c"):
        first.between(shift("a", "c", 1.0, after(1)), NOON)
    assert first.between(shift("a", "b", 5.0, NOON), NOON) is first


# ---------------------------------------------------------------------- a history


def test_history_is_interpolated_in_any_order_of_arrival() -> None:
    flange = PoseHistory()
    for seconds in (0.1, 0.0, 0.05):
        flange.add(shift("base", "flange", seconds, after(seconds)))
    found = flange.at(after(0.07)) @ shift("flange", "camera", 1.0)
    assert found.translation[0] == pytest.approx(1.07)
    assert found.at == after(0.07)
    flange.add(shift("base", "flange", 5.0, after(0.05)))
    assert flange.at(after(0.05)).translation[0] == 5.0


def test_history_of_other_frames_or_without_a_time_is_refused() -> None:
    history = PoseHistory()
    with refused("BAD_TIME", "T_a_b: expected a time, got none"):
        history.add(shift("a", "b", 1.0))
    history.add(shift("a", "b", 1.0, NOON))
    with refused("WRONG_FRAME", "expected T_a_b as before, got T_a_c"):
        history.add(shift("a", "c", 1.0, NOON))


@pytest.mark.parametrize("seconds", [-0.001, 0.201], ids=["before", "after"])
def test_history_is_not_extrapolated(seconds: float) -> None:
    history = PoseHistory()
    with refused("BAD_TIME", "the pose history is empty"):
        history.at(NOON)
    for at in (0.0, 0.1, 0.2):
        history.add(shift("a", "b", at, after(at)))
    with refused("BAD_TIME", "from 2026-03-04 12:00:00+00:00", "nothing is extrapolated"):
        history.at(after(seconds))


def test_history_gap_that_is_too_long_is_refused() -> None:
    history = PoseHistory(max_gap=0.05)
    for at in (0.0, 0.06):
        history.add(shift("a", "b", at, after(at)))
    with refused("BAD_TIME", "at most 0.05 s apart", "got 0.06 s"):
        history.at(after(0.03))
    assert history.at(after(0.06)).translation[0] == 0.06


def test_history_is_bounded() -> None:
    history = PoseHistory(size=3)
    for number in range(10):
        history.add(shift("a", "b", number, after(0.01 * number)))
    assert history.at(after(0.07)).translation[0] == 7
    with refused("BAD_TIME", "nothing is extrapolated"):
        history.at(after(0.06))
