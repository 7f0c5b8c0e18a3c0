from __future__ import annotations

import math
import pickle

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from smartcam import CalibrationError
from smartcam.geometry import _inside as rotations
from smartcam.geometry._inside import (
    IDENTITY,
    Rigid,
    cross_matrix,
    exp_rotation,
    log_rotation,
    right_jacobian,
)

angles = st.floats(-math.pi, math.pi)
vectors = st.tuples(*[st.floats(-10, 10)] * 3)
quaternions = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .filter(lambda values: math.hypot(*values) > 0.1)
    .map(lambda values: np.array(values) / math.hypot(*values))
)


def test_rotate_ccw_quarter_turn_takes_x_to_y() -> None:
    assert rotations.rotate_ccw([[1, 0], [0, 1]], math.pi / 2) == pytest.approx(
        np.array([[0, 1], [-1, 0]])
    )


@given(quaternions, quaternions)
def test_quaternion_multiply_equals_scipy(first: rotations.Array, second: rotations.Array) -> None:
    ours = rotations.matrix_from_quaternion(rotations.quaternion_multiply(first, second))
    theirs = (Rotation.from_quat(first) * Rotation.from_quat(second)).as_matrix()
    assert ours == pytest.approx(theirs, abs=1e-12)


@given(quaternions, vectors)
def test_rotate_equals_scipy(quaternion: rotations.Array, vector: tuple[float, ...]) -> None:
    expected = Rotation.from_quat(quaternion).apply(vector)
    assert rotations.rotate(quaternion, vector) == pytest.approx(expected, abs=1e-12)
    back = rotations.rotate(quaternion * [-1, -1, -1, 1], expected)
    assert back == pytest.approx(np.array(vector), abs=1e-12)


@given(quaternions)
def test_quaternion_from_matrix_gives_the_rotation_back(quaternion: rotations.Array) -> None:
    matrix = rotations.matrix_from_quaternion(quaternion)
    again = rotations.quaternion_from_matrix(matrix)
    assert abs(again @ quaternion) == pytest.approx(1.0, abs=1e-12)
    assert again[np.argmax(np.abs(again))] > 0


def test_quaternions_of_many_matrices_equal_those_of_each() -> None:
    quaternions = Rotation.from_quat(
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 4]]
    ).as_quat()
    many = rotations.quaternion_from_matrix(rotations.matrix_from_quaternion(quaternions))
    assert many == pytest.approx(quaternions)


def test_quaternion_about_z_of_half_a_turn_has_no_real_part() -> None:
    assert rotations.quaternion_about_z(math.pi) == pytest.approx(np.array([0, 0, 1, 0]))


def test_frame_from_axes_skewed_keeps_the_first() -> None:
    frame = rotations.frame_from_axes([0, 0, 2], [0, 3, 1])
    assert frame == pytest.approx(np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]]))


@pytest.mark.parametrize(
    ("first", "second", "code", "text"),
    [
        ([1, 0, 0], [0, 0, 0], "COINCIDENT", "a vector of length 0"),
        ([1, 0, 0], [-1, 0, 0.17], "COLLINEAR", "at least 10 degrees between them, got 9.6"),
        ([1, 0, 0], [0, math.nan, 0], "NOT_FINITE", "second axis: expected finite numbers"),
        ([1, 0], [0, 1, 0], "SHAPE", r"first axis: expected shape \(N, 3\), got \(1, 2\)"),
    ],
)
def test_frame_from_axes_that_span_no_plane_raises(
    first: list[float], second: list[float], code: str, text: str
) -> None:
    with pytest.raises(CalibrationError, match=text) as caught:
        rotations.frame_from_axes(first, second)
    assert caught.value.code == code
    assert pickle.loads(pickle.dumps(caught.value)).code == code  # noqa: S301  our own


def test_as_points_of_words_raises() -> None:
    with pytest.raises(CalibrationError, match=r"marks: expected numbers of shape \(N, 2\)"):
        rotations.as_points([["a", "b"]], 2, "marks")


# ---------------------------------------------------------------------- rigid motions


three_numbers = st.tuples(*[st.floats(-1.7, 1.7)] * 3).map(np.array)
RANDOM = np.random.default_rng(1)
MANY = Rigid(exp_rotation(RANDOM.uniform(-1.5, 1.5, (4, 3))), RANDOM.normal(size=(4, 3)))
STEPS = RANDOM.uniform(-0.5, 0.5, (4, 6))


@given(three_numbers)
def test_rotations_by_vectors_are_opencvs(vector: np.ndarray) -> None:
    np.testing.assert_allclose(exp_rotation(vector), cv2.Rodrigues(vector)[0], atol=1e-12)
    np.testing.assert_allclose(log_rotation(exp_rotation(vector)), vector, atol=1e-9)


def test_cross_matrix_of_many_is_the_cross_product() -> None:
    crossed = cross_matrix(MANY.translation) @ STEPS[:, :3, None]
    np.testing.assert_allclose(crossed[..., 0], np.cross(MANY.translation, STEPS[:, :3]))


@pytest.mark.parametrize("length", [1.0, 1e-3, 1e-6, 0.0])
def test_right_jacobian_moves_the_exponential(length: float) -> None:
    vector, small = length * np.array([0.6, 0.0, -0.8]), 1e-6 * np.array([1.0, -2.0, 3.0])
    there = exp_rotation(vector).T @ exp_rotation(vector + small)
    np.testing.assert_allclose(
        log_rotation(there), right_jacobian(vector) @ small, atol=1e-11, rtol=1e-5
    )


def test_product_of_motions_maps_points_in_order() -> None:
    first, second = MANY.subset(0), MANY.subset(1)
    points = RANDOM.normal(size=(5, 3))
    np.testing.assert_allclose(
        (second @ first).apply(points), second.apply(first.apply(points)), atol=1e-12
    )


def test_rigid_inverse_of_many_leads_back() -> None:
    back = MANY @ MANY.inverse()
    for found, expected in zip(back, IDENTITY, strict=True):
        np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=1e-12)


def test_stack_of_no_motions_is_empty() -> None:
    assert (Rigid.stack([]).size, Rigid.stack([IDENTITY]).size) == (0, 1)


def test_rigid_turned_after_turns_in_the_frame_it_leads_to() -> None:
    moved = MANY.turned_in_target(STEPS)
    np.testing.assert_allclose(moved.rotation, exp_rotation(STEPS[:, :3]) @ MANY.rotation)
    np.testing.assert_allclose(moved.translation, MANY.translation + STEPS[:, 3:])
    np.testing.assert_allclose(MANY.target_steps_to(moved), STEPS, atol=1e-12)


def test_rigid_turned_before_turns_in_the_frame_it_comes_from() -> None:
    moved = MANY.turned_in_source(STEPS)
    np.testing.assert_allclose(moved.rotation, MANY.rotation @ exp_rotation(STEPS[:, :3]))
    np.testing.assert_allclose(MANY.source_steps_to(moved), STEPS, atol=1e-12)
    np.testing.assert_allclose(MANY.angle_to(moved), np.linalg.norm(STEPS[:, :3], axis=1))
