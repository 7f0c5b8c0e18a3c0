"""For any contents of other programs' files, the error has a code."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.calibration import Transform
from smartcam.calibration.formats import (
    SAMPLES,
    TRAJECTORIES,
    read_matrix,
    read_samples,
    read_trajectory,
    read_transform,
    write_transform,
)
from smartcam.exceptions import CalibrationError, MissingExtraError
from smartcam.geometry._inside import Code
from tests.calibration.inside import MAX_TEXT_BYTES, load_json, load_yaml
from tests.geometry.rigid import FEW, refused
from tests.layout.bombs import laughs, merges

PARSED = ["ros2", "ros_industrial", "easy_handeye", "easy_handeye2", "opencv"]
"""A format of a transform for each reader."""

LOADERS = ["ros2", "ros_industrial", "moveit", "asl"]
"""A format for each parser of text."""

READERS: dict[str, tuple[Callable[..., object], str | None]] = {
    **{form: (read_transform, form) for form in PARSED},
    **{form: (read_samples, form) for form in SAMPLES},
    **{form: (read_trajectory, form) for form in TRAJECTORIES},
    "matrix": (read_matrix, None),
}


def refusal(path: Path, form: str) -> CalibrationError | None:
    """Return the error of a file; None: the file is read."""
    try:
        read(path, form)
    except CalibrationError as error:
        return error
    return None


WORDS = [
    "x: 1\n", "qw: ", "1e308", "nan", "- ", "[", "]", "{", "}", "&a ", "*a ", ", ", ": ", "\n  ",
    "transformation:", "parameters:", "eye_on_hand: true\n", "rows: 4\n", "cols: 4\n", "data: [",
    "%YAML:1.0\n---\n", "!!opencv-matrix", "--x 1 ", "--frame-id a ", "0 0 0 0 0 0 1 a b", "'", '"',
    "<launch>", '<node type="static_transform_publisher" args="', "<!--", "-->", "t,x,y,z,qx,qy,",
    "qz,qw\n", "1,0,0,0,0,0,0,1\n", "effector_wrt_world", "[[1,0,0,0],", "\x00", "\ud7ff", "1_0",
    "!!python/object:os.system", "? ", "| \n", "1:30:00", "2001-01-01", "~", "<<: *a\n", "\\",
]  # fmt: skip


def read(path: Path, form: str) -> object:
    reader, name = READERS[form]
    return reader(path) if name is None else reader(path, name)


@pytest.mark.parametrize("form", READERS)
@FEW
@given(
    body=st.one_of(
        st.binary(max_size=200),
        st.lists(st.sampled_from(WORDS), max_size=20).map(lambda words: "".join(words).encode()),
    )
)
def test_random_file_gives_a_value_or_an_error_with_a_code(
    tmp_path_factory: Any, form: str, body: bytes
) -> None:
    judge(tmp_path_factory.getbasetemp() / "random", form, body)


def judge(path: Path, form: str, body: bytes) -> None:
    path.write_bytes(body)
    error = refusal(path, form)
    if error is not None:
        assert error.code in list(Code)
        assert str(path) in str(error)
        assert len(str(error)) < 1000
        assert len(repr(error.got)) < 300


@pytest.mark.parametrize(
    "form",
    [
        *LOADERS,
        *(pytest.param(one, marks=pytest.mark.long) for one in READERS if one not in LOADERS),
    ],
)
def test_deep_or_long_file_gives_an_error_with_a_code(tmp_path: Path, form: str) -> None:
    for body in (b"", b"[" * 2000, b"{a: " * 2000, b"- " * 2000, b"1" * 5000, b"!!int "):
        judge(tmp_path / "file", form, body)
    judge(tmp_path / "file", form, b'"\\UFFFFFFFF"')


@pytest.mark.parametrize("form", PARSED)
@FEW
@given(data=st.data())
def test_changed_file_gives_a_transform_or_an_error_with_a_code(
    tmp_path_factory: Any, form: str, data: st.DataObject
) -> None:
    path: Path = tmp_path_factory.getbasetemp() / "changed"
    write_transform(path, form, Transform("base", "cam", np.eye(3), np.array([0.1, 2, -3e-7])))
    body = path.read_bytes()
    at = data.draw(st.integers(0, len(body)))
    put = data.draw(st.sampled_from(WORDS)).encode()
    path.write_bytes(body[:at] + put + body[at + data.draw(st.integers(0, 20)) :])
    with suppress(CalibrationError):
        found = read_transform(path, form)
        assert np.isfinite(found.translation).all()


def test_file_that_is_too_large_is_refused_unread(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"#" * (MAX_TEXT_BYTES + 1))
    with refused("MALFORMED", "easy_handeye, ROS 1", "expected 65536 bytes at most"):
        read(tmp_path / "file", "easy_handeye")


def test_line_that_is_too_long_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text(f"t,x,y,z,qx,qy,qz,qw{',a' * 2100}\n")
    with refused("MALFORMED", "line 1: expected 4096 characters at most, got 4219"):
        read(tmp_path / "file", "asl")


def test_launch_file_of_nothing_but_beginnings_is_refused_in_no_time(tmp_path: Path) -> None:
    begin = '<launch><node type="static_transform_publisher" '
    (tmp_path / "file").write_text((begin + "<!-- ") * (MAX_TEXT_BYTES // 60))
    with refused("MALFORMED", "file: expected XML"):
        read(tmp_path / "file", "ros2")


def test_file_that_is_not_there_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "file", "ros2")


def test_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"x: \xff")
    with refused("MALFORMED", "expected UTF-8 (invalid start byte at byte 3)"):
        read(tmp_path / "file", "ros_industrial")


@pytest.mark.parametrize("call", [read_transform, read_samples, read_trajectory])
def test_format_that_there_is_not_is_refused(tmp_path: Path, call: Any) -> None:
    with refused("UNKNOWN_FORMAT", "no format is called 'xacro'; expected one of"):
        call(tmp_path / "file", "xacro")


POSE = "x: 1\ny: 2\nz: 3\nqx: 0\nqy: 0\nqz: 0\nqw: 1\n"


@pytest.mark.parametrize(
    ("text", "code", "said"),
    [
        ("", "MALFORMED", "file: expected a mapping"),
        ("- 1", "MALFORMED", "file: expected a mapping, got a list of 1"),
        ("a: 1\nb: 2", "MALFORMED", "expected one pose, got 'a, b'"),
        ("a: 1", "MALFORMED", "a: expected a mapping, got '1'"),
        ("x: 1", "MALFORMED", "the keys x, y, z, qx, qy, qz, qw, got 'x'"),
        (POSE + "roll: 1", "MALFORMED", "the keys x, y, z, qx, qy, qz, qw alone"),
        (POSE + "x: 2", "MALFORMED", "line 1: expected keys that are texts, each once, got 'x'"),
        (POSE.replace("2", "two"), "MALFORMED", "pose.y: expected a number, got 'two'"),
        (POSE.replace("2", "1:30"), "MALFORMED", "pose.y: expected a number, got '1:30'"),
        (POSE.replace("2", "[2]"), "MALFORMED", "pose.y: expected a number, got a list of 1"),
        (POSE.replace("2", ".nan"), "NOT_FINITE", "a number of at most 1e+09, got '.nan'"),
        (POSE.replace("2", "-inf"), "NOT_FINITE", "got '-inf'"),
        (POSE.replace("2", "1e400"), "NOT_FINITE", "got '1e400'"),
        (POSE.replace("qw: 1", "qw: 0"), "NOT_RIGID", "of length 0"),
        (POSE.replace("qw: 1", "qw: 1.02"), "NOT_RIGID", "of length 1.02"),
        ("a: &a [1]\nb: *a", "MALFORMED", "line 1: expected no alias"),
        ("a: &a\n  b: *a", "MALFORMED", "expected no alias"),
        ("? [a]\n: 1", "MALFORMED", "keys that are texts"),
        ("a: " + "[" * 17 + "]" * 17, "MALFORMED", "at most 16 lists in lists"),
        ("a: 1\n---\na: 2", "MALFORMED", "file: expected YAML ("),
        ("a: \x00", "MALFORMED", "file: expected YAML ("),
    ],
)
def test_yaml_that_is_no_pose_is_refused(tmp_path: Path, text: str, code: str, said: str) -> None:
    (tmp_path / "file").write_text(text)
    with refused(code, said):
        read(tmp_path / "file", "ros_industrial")


def test_aliases_that_would_grow_without_end_are_refused_at_once() -> None:
    lines = ["a0: &a0 [x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 40)]
    with refused("MALFORMED", "expected no alias"):
        load_yaml("\n".join(lines))


@pytest.mark.parametrize(
    ("form", "text", "said"),
    [
        ("easy_handeye", "parameters: {}", "file: expected the keys transformation"),
        ("easy_handeye", "transformation: {}", "parameters: expected the keys eye_on_hand"),
        (
            "easy_handeye",
            f"eye_on_hand: maybe\ntransformation: {{{POSE.strip().replace(chr(10), ', ')}}}",
            "parameters.eye_on_hand: expected true or false, got 'maybe'",
        ),
        (
            "easy_handeye",
            f"eye_on_hand: true\ntransformation: {{{POSE.strip().replace(chr(10), ', ')}}}",
            "expected the keys robot_effector_frame, tracking_base_frame",
        ),
        (
            "easy_handeye2",
            "parameters: {calibration_type: eye_on_nose}\n"
            "transform: {translation: {x: 0, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0, w: 1}}",
            "calibration_type: expected eye_on_base or eye_in_hand, got 'eye_on_nose'",
        ),
        ("opencv", "a: 1", "expected one matrix of 4 rows and 4 cols, got 'none'"),
        ("opencv", "M: {rows: 4, cols: 4}", "the keys rows, cols, data"),
        ("opencv", "M: {rows: 4, cols: 4, data: [1]}", "M: expected a list of 16, got a list of 1"),
        ("moveit", '[{"a": 1}]', "sample 0: expected a list of 2, got a mapping of 1"),
        ("moveit", "[[[], []]]", "sample 0: expected a list of 4"),
        ("moveit", "{", "file: expected JSON ("),
        ("moveit_yaml", "- a: 1", "sample 0: expected the keys effector_wrt_world, object_wrt"),
        ("matrix", "rows: 4", "file: expected the keys model, robot_frame, camera_frame, rows"),
        (
            "matrix",
            "{model: [], robot_frame: a, camera_frame: b, rows: 4, cols: 3, data: []}",
            "model: expected a text, got a list of 0",
        ),
        (
            "matrix",
            "{model: a, robot_frame: a, camera_frame: b, rows: 3, cols: 4, data: []}",
            "matrix: expected 4 rows and 3 cols, got '3 4'",
        ),
        ("ros2", "", "expected x y z, qx qy qz qw or yaw pitch roll, frame, child, and perhaps a"),
        ("ros2", "1 2 3 4 5 6 7", "got '7 words'"),
        ("ros2", "1 2 3 0 0 0 1 2 3", "expected a quaternion and two frames, or three angles"),
        ("ros2", "1 2 3 0 0 0 a b c", "expected a quaternion and two frames, or three angles"),
        ("ros2", "1 2 3 0 0 0 1 a b c", "period: expected a number, got 'c'"),
        ("ros2", "1 2 three 0 0 0 1 a b", "argument 3: expected a number, got 'three'"),
        ("ros2", "1 2 3 0 0 0 1 a 'b", "expected words as on a command line (No closing"),
        ("ros2", "--x 1", "--frame-id and --child-frame-id, and a quaternion or angles"),
        ("ros2", "--frame-id a --child-frame-id b --yaw 1 --qw 1", "not both"),
        ("ros2", "--frame-id a --child-frame-id b --X 1", "each once, got '--X'"),
        ("ros2", "--frame-id a --frame-id b", "each once, got '--frame-id'"),
        ("ros2", "--frame-id a --child-frame-id", "each once, got '--child-frame-id'"),
        ("ros2", "--frame-id a --child-frame-id b 1", "each once, got '1'"),
        ("ros2", "<launch></launch>", "expected one node of type static_transform_publisher"),
    ],
)  # fmt: skip
def test_file_that_is_not_of_its_format_is_refused(
    tmp_path: Path, form: str, text: str, said: str
) -> None:
    (tmp_path / "file").write_text(text)
    with refused("MALFORMED", said):
        read(tmp_path / "file", form)


@pytest.mark.parametrize("name", ["", "my camera", "[a]"])
def test_frame_whose_name_is_none_is_refused(tmp_path: Path, name: str) -> None:
    pose = POSE.strip().replace("\n", ", ")
    (tmp_path / "file").write_text(
        f"eye_on_hand: false\nrobot_base_frame: base\ntracking_base_frame: {name or chr(34) * 2}\n"
        f"transformation: {{{pose}}}\n"
    )
    with refused("BAD_NAME", "parameters.tracking_base_frame: expected a frame's name"):
        read(tmp_path / "file", "easy_handeye")


ROTATION = [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]


@pytest.mark.parametrize(
    ("rotation", "last", "code", "said"),
    [
        (np.diag([1.0, 1, -1]), [0, 0, 0, 1], "NOT_RIGID", "determinant -1"),
        (2 * np.eye(3), [0, 0, 0, 1], "NOT_RIGID", "determinant 8"),
        (np.diag([1.0, 1, 1.001]), [0, 0, 0, 1], "NOT_RIGID", "off by 0.002"),
        (np.diag([1.0, 1, -1.00001]), [0, 0, 0, 1], "NOT_RIGID", "determinant -1"),
        (np.eye(3), [0, 0, 0, 1000], "MALFORMED", "a last row 0 0 0 1, got '0 0 0 1000'"),
        (np.eye(3), [0.1, 0, 0, 1], "MALFORMED", "sample 0, hand: expected a last row"),
    ],
)
def test_matrix_that_is_no_rigid_motion_is_refused(
    tmp_path: Path, rotation: Any, last: list[float], code: str, said: str
) -> None:
    matrix = np.vstack([np.column_stack([rotation, [1, 2, 3]]), last]).tolist()
    (tmp_path / "file").write_text(json.dumps([[matrix, matrix]]))
    with refused(code, said):
        read(tmp_path / "file", "moveit")


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e999", "true", "null", "[]", "1" * 5000])
def test_json_with_values_that_are_no_numbers_is_refused(tmp_path: Path, number: str) -> None:
    row = f"[{number}, 0, 0, 0]"
    (tmp_path / "file").write_text(
        f"[[[{row}, {row}, {row}, {row}], [{row}, {row}, {row}, {row}]]]"
    )
    with refused("NOT_FINITE" if number[0] in "NI" or "999" in number else "MALFORMED", "sample 0"):
        read(tmp_path / "file", "moveit")


def test_matrix_that_maps_to_a_line_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text(
        "model: a\nrobot_frame: b\ncamera_frame: c\nrows: 4\ncols: 3\n"
        "data: [1, 1, 0, 1, 1, 0, 1, 1, 0, 0, 0, 1]\n"
    )
    with refused("COLLINEAR", "expected one of rank 3"):
        read(tmp_path / "file", "matrix")


def test_json_that_is_too_deep_is_refused() -> None:
    with refused("MALFORMED", "expected JSON"):
        load_json("[" * 100_000)


def test_yaml_without_pyyaml_names_the_missing_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MissingExtraError, match=r'pip install "smartcam\[yaml\]"'):
        load_yaml("a: 1")


def test_calibration_formats_bombs_are_refused() -> None:
    for text in (laughs(30), merges(40)):
        with pytest.raises(CalibrationError) as told:
            load_yaml(text)
        assert told.value.code == "MALFORMED"
