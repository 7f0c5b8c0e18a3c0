from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from smartcam import CalibrationError
from smartcam.calibration.geometry import rotations

angles = st.floats(-math.pi, math.pi)
vectors = st.tuples(*[st.floats(-10, 10)] * 3)
quaternions = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .filter(lambda values: math.hypot(*values) > 0.1)
    .map(rotations.quaternion_normalize)
)


def test_wrap_angle_beyond_a_turn_gives_half_open_range() -> None:
    assert rotations.wrap_angle([0.0, math.pi, -math.pi, 3.0 * math.pi]).tolist() == [
        0.0,
        math.pi,
        math.pi,
        math.pi,
    ]


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
    back = rotations.rotate(rotations.quaternion_conjugate(quaternion), expected)
    assert back == pytest.approx(np.array(vector), abs=1e-12)


@given(quaternions)
def test_quaternion_from_matrix_gives_the_rotation_back(quaternion: rotations.Array) -> None:
    matrix = rotations.matrix_from_quaternion(quaternion)
    again = rotations.quaternion_from_matrix(matrix)
    assert abs(again @ quaternion) == pytest.approx(1.0, abs=1e-12)
    assert again[np.argmax(np.abs(again))] > 0


def test_quaternion_from_matrix_of_many_equals_one_by_one() -> None:
    quaternions = rotations.quaternion_normalize(
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 4]]
    )
    many = rotations.quaternion_from_matrix(rotations.matrix_from_quaternion(quaternions))
    assert many == pytest.approx(quaternions)


def test_quaternion_about_z_of_half_a_turn_has_no_real_part() -> None:
    assert rotations.quaternion_about_z(math.pi) == pytest.approx(np.array([0, 0, 1, 0]))


def test_quaternion_normalize_extreme_lengths_gives_length_1() -> None:
    result = rotations.quaternion_normalize([[0, 0, 0, 1e-300], [3e300, 0, 4e300, 0]])
    assert result == pytest.approx(np.array([[0, 0, 0, 1], [0.6, 0, 0.8, 0]]))


@pytest.mark.parametrize("bad", [(0, 0, 0, 0), (math.nan, 0, 0, 1), (math.inf, 0, 0, 1)])
def test_quaternion_normalize_without_direction_raises(bad: tuple[float, ...]) -> None:
    with pytest.raises(CalibrationError, match="got zeros, NaN or infinity") as caught:
        rotations.quaternion_normalize(bad)
    assert caught.value.code == "NOT_FINITE"


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
