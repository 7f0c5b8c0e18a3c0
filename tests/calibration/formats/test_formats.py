"""Formats of other programs are written, read by other programs, and read back."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import re
import shlex
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from smartcam.calibration import Chain, PlaneCalibration, PlaneProjection, Transform, fit_plane
from smartcam.calibration.formats import (
    SAMPLES,
    TRAJECTORIES,
    TRANSFORMS,
    HandEyeSample,
    compose_plane_frame,
    plane_frame,
    read_matrix,
    read_samples,
    read_trajectory,
    read_transform,
    write_samples,
    write_trajectory,
    write_transform,
)
from smartcam.calibration.formats._opencv import PlaneMatrix, compose_matrix
from smartcam.calibration.wizards import CalibrationService
from tests import ROOT
from tests.calibration.inside import PlaneModel, format_real, write
from tests.geometry.rigid import (
    FEW,
    NOON,
    after,
    close,
    refused,
    rotation_about,
    transforms,
)

MOVEIT = ROOT / "tests/data/moveit_calibration/pose_samples.json"

WRITTEN = [name for name, form in TRANSFORMS.items() if form.compose is not None]
"""Formats of transforms that can be written."""

TURNED = Transform(
    "base",
    "cam/optical",
    rotation_about(np.array([0.1, -0.7, -0.7]), 2.1),
    np.array([0.4, -1e-7, 1]),
)


def written(tmp_path: Path, form: str, transform: Transform = TURNED) -> str:
    """Return the transform in a file."""
    write_transform(tmp_path / "file", form, transform)
    return (tmp_path / "file").read_text()


def read(tmp_path: Path, form: str, text: str, **names: Any) -> Transform:
    (tmp_path / "file").write_text(text)
    return read_transform(tmp_path / "file", form, **names)


def table(model: PlaneModel = "similarity", scale: float = 0.001) -> PlaneCalibration:
    """Return a calibration of a turned table; the camera sees it ``scale`` metres a unit."""
    seen = np.array([(u, v) for u in (-200.0, 0.0, 300.0) for v in (-150.0, 40.0, 260.0)])
    frame = rotation_about(np.array([0.1, -0.2, 0.97]), 0.6)
    bent = np.ones(9) if model != "homography" else 1 + seen @ (1e-4, -2e-4)
    squeezed = seen * ((1.0, 1.1) if model == "affine" else (1.0, 1.0))
    robot = (0.5, 0.1, 0.02) + scale * squeezed @ frame[:, :2].T / bent[:, None]
    return fit_plane(
        seen, robot, model=model, touch_sigma=1e-4, robot_frame="base", nominal_scale=scale
    )


# ---------------------------------------------------------------------- transforms


@pytest.mark.parametrize("form", WRITTEN)
@FEW
@given(transform=transforms("base", "cam"))
def test_transform_written_and_read_is_the_same(
    tmp_path_factory: Any, form: str, transform: Transform
) -> None:
    path = tmp_path_factory.getbasetemp() / f"transform{TRANSFORMS[form].suffix}"
    write_transform(path, form, transform)
    back = read_transform(path, form, target="base", source="cam")
    assert back.translation.tolist() == transform.translation.tolist()
    assert close(back, transform, 4e-15)


def test_easy_handeye_file_has_the_fields_that_its_program_reads(tmp_path: Path) -> None:
    data = yaml.safe_load(written(tmp_path, "easy_handeye"))
    assert data["parameters"] == {
        "eye_on_hand": False, "move_group": "manipulator", "move_group_namespace": "/",
        "namespace": "/smartcam/", "robot_base_frame": "base", "robot_effector_frame": "",
        "tracking_base_frame": "cam/optical", "tracking_marker_frame": "",
    }  # fmt: skip
    pose = data["transformation"]
    assert (pose["x"], pose["y"], pose["z"]) == (0.4, -1e-7, 1.0)
    assert [pose[key] for key in ("qx", "qy", "qz", "qw")] == TURNED.quaternion.tolist()


def test_easy_handeye2_file_has_the_fields_that_its_program_reads(tmp_path: Path) -> None:
    data = yaml.safe_load(written(tmp_path, "easy_handeye2_in_hand"))
    assert data["parameters"] == {
        "name": "smartcam", "calibration_type": "eye_in_hand", "robot_base_frame": "",
        "robot_effector_frame": "base", "tracking_base_frame": "cam/optical",
        "tracking_marker_frame": "", "freehand_robot_movement": True, "move_group_namespace": "/",
        "move_group": "manipulator",
    }  # fmt: skip
    assert data["transform"]["translation"] == {"x": 0.4, "y": -1e-7, "z": 1.0}
    assert [data["transform"]["rotation"][key] for key in "xyzw"] == TURNED.quaternion.tolist()


@pytest.mark.parametrize(
    ("in_hand", "target"), [("true", "tool0"), ("false", "base_link"), ("yes", "tool0")]
)
def test_easy_handeye_names_the_frame_that_the_camera_is_fixed_to(
    tmp_path: Path, in_hand: str, target: str
) -> None:
    # keys in the order of yaml.dump; a number that YAML 1.1 takes for a text
    text = f"""parameters:
  eye_on_hand: {in_hand}
  freehand_robot_movement: false
  namespace: /ur_eye_on_hand/
  robot_base_frame: base_link
  robot_effector_frame: tool0
  tracking_base_frame: camera_color_optical_frame
  tracking_marker_frame: aruco
transformation: {{qw: 0.70710678, qx: 0, qy: 0, qz: 0.70710678, x: -3.1e-2, y: 5e-05, z: 1}}
"""
    found = read(tmp_path, "easy_handeye", text)
    assert (found.target, found.source) == (target, "camera_color_optical_frame")
    assert found.translation.tolist() == [-0.031, 5e-5, 1.0]
    assert np.allclose(found.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)


def test_easy_handeye_of_an_old_version_is_read(tmp_path: Path) -> None:
    text = (
        "eye_on_hand: false\nrobot_base_frame: world\ntracking_base_frame: cam\n"
        "transformation: {x: 1, y: 2, z: 3, qx: 1, qy: 0, qz: 0, qw: 0}\n"
    )
    found = read(tmp_path, "easy_handeye", text)
    assert (found.label, found.translation.tolist()) == ("T_world_cam", [1, 2, 3])


@pytest.mark.parametrize(
    ("text", "label"),
    [
        ("1 2 3 0 0 0.6 0.8 base cam 100", "T_base_cam"),  # tf
        ("1 2 3 0 0 0.6 0.8 base cam", "T_base_cam"),  # tf2_ros
        ("1 2 3 1.2870022175866 0 0 base cam 100", "T_base_cam"),
        ("1 2 3 1.2870022175866 0 0 base cam", "T_base_cam"),
        ("rosrun tf static_transform_publisher 1 2 3 0 0 .6 .8 /base /cam 1e2", "T_/base_/cam"),
        ("--x 1 --y 2 --z 3 --qz 0.6 --qw 0.8 --frame-id base --child-frame-id c", "T_base_c"),
        ("--frame-id a --child-frame-id b --z 3 --y 2 --x 1 --yaw 1.2870022175866", "T_a_b"),
        ("# a remark\n1 2 3 0 0 0.6 0.8 'base' \"cam\"  # and one more\n", "T_base_cam"),
        (
            '<launch>\n  <!-- xyz="1 2 3" args="9 9" -->\n  <node pkg="tf2_ros" '
            'type="static_transform_publisher" name="camera_link_broadcaster"\n'
            '      args="1 2 3   0 0 0.6 0.8 panda_hand cam" />\n</launch>\n',
            "T_panda_hand_cam",
        ),
    ],
)
def test_arguments_of_every_publisher_are_read(tmp_path: Path, text: str, label: str) -> None:
    found = read(tmp_path, "ros2", text)
    assert (found.label, found.translation.tolist()) == (label, [1, 2, 3])
    assert np.allclose(found.rotation[:, 0], [0.28, 0.96, 0], atol=1e-12)


def test_options_that_are_left_out_are_zero(tmp_path: Path) -> None:
    found = read(tmp_path, "ros2", "--frame-id a --child-frame-id b")
    assert close(found, Transform("a", "b", np.eye(3), np.zeros(3)))


def test_yaw_pitch_and_roll_are_about_axes_that_stand(tmp_path: Path) -> None:
    rotation = pytest.importorskip("scipy.spatial.transform", reason="needs SciPy").Rotation
    found = read(tmp_path, "tf2", "0 0 0 0.3 -0.4 2.5 a b")
    assert np.allclose(
        found.rotation, rotation.from_euler("xyz", [2.5, -0.4, 0.3]).as_matrix(), atol=1e-15
    )


@pytest.mark.parametrize(
    ("form", "words"),
    [("tf", 11), ("tf_ypr", 10), ("tf2", 10), ("tf2_ypr", 9), ("ros2", 19), ("ros2_ypr", 17)],
)
def test_arguments_are_one_line_of_that_many_words(tmp_path: Path, form: str, words: int) -> None:
    text = written(tmp_path, form)
    assert text.count("\n") == 1
    assert len(shlex.split(text)) == words
    assert text.startswith("static_transform_publisher ")


@pytest.mark.parametrize("name", ["", "base_to_camera_guess:\n  "])
def test_pose_of_ros_industrial_is_read_with_and_without_a_name(tmp_path: Path, name: str) -> None:
    # robot_cal_tools, rct_examples/data/test_set_10x10/poses/0.yaml
    lines = [
        "x: 0.7169496300523684", "y: 0.00330346692205527", "z: 0.853313460465923",
        "qx: -0.01709391593413424", "qy: 0.99974825023776", "qz: -0.01437638468984423",
        "qw: -0.002133951223335981",
    ]  # fmt: skip
    found = read(
        tmp_path, "ros_industrial", name + "\n  ".join(lines) if name else "\n".join(lines),
        target="base_link", source="tool0",
    )  # fmt: skip
    assert found.label == "T_base_link_tool0"
    assert found.translation[0] == 0.7169496300523684
    assert np.allclose(found.quaternion[1], 0.99974825023776, atol=1e-12)


def test_pose_of_ros_industrial_is_read_by_yaml_as_numbers(tmp_path: Path) -> None:
    data = yaml.safe_load(written(tmp_path, "ros_industrial"))
    assert list(data) == ["x", "y", "z", "qx", "qy", "qz", "qw"]
    assert all(type(value) is float for value in data.values())


def test_opencv_reads_the_matrix_bit_by_bit(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="needs the extra calibration")
    write_transform(tmp_path / "t.yaml", "opencv", TURNED)
    storage = cv2.FileStorage(str(tmp_path / "t.yaml"), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("transform").mat()
    names = [storage.getNode(name).string() for name in ("target", "source")]
    storage.release()
    assert matrix[:3, :3].tolist() == TURNED.rotation.tolist()
    assert matrix[:, 3].tolist() == [0.4, -1e-7, 1.0, 1.0]
    assert names == ["base", "cam/optical"]


def test_matrix_that_opencv_writes_is_read(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="needs the extra calibration")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = TURNED.rotation, TURNED.translation
    storage = cv2.FileStorage(str(tmp_path / "t.yaml"), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.eye(3))
    storage.write("T_base_cam", matrix)
    storage.release()
    found = read_transform(tmp_path / "t.yaml", "opencv", target="base", source="cam", unit="m")
    assert found.rotation.tolist() == TURNED.rotation.tolist()
    assert (found.label, found.translation.tolist()) == ("T_base_cam", [0.4, -1e-7, 1.0])


@pytest.mark.parametrize("decimals", [5, 6, 9])
def test_rotation_printed_with_few_decimals_is_made_one(tmp_path: Path, decimals: int) -> None:
    rows = [*np.column_stack([TURNED.rotation, TURNED.translation]).round(decimals), [0, 0, 0, 1]]
    data = ", ".join(str(value) for row in rows for value in row)
    text = f"%YAML:1.0\n---\nM: !!opencv-matrix {{rows: 4, cols: 4, dt: d, data: [{data}]}}\n"
    found = read(tmp_path, "opencv", text + "unit: m\n")
    assert np.allclose(found.rotation, TURNED.rotation, rtol=0, atol=2 * 10.0**-decimals)
    assert np.allclose(found.rotation @ found.rotation.T, np.eye(3), rtol=0, atol=1e-6)


@given(value=st.floats(allow_nan=False, allow_infinity=False))
def test_real_is_a_number_to_yaml(value: float) -> None:
    read_back = yaml.safe_load(format_real(value))
    assert type(read_back) is float
    assert (read_back, math.copysign(1, read_back)) == (value, math.copysign(1, value))


@pytest.mark.parametrize("name", ["", "my camera", "a:b", 'a"', "-x", "$HOME", "n" * 256, "a#b"])
@pytest.mark.parametrize("form", ["easy_handeye", "easy_handeye2", "tf", "ros2", "opencv"])
def test_frame_whose_name_no_file_can_hold_is_refused(tmp_path: Path, form: str, name: str) -> None:
    for names in ((name, "cam"), ("base", name)):
        with refused("BAD_NAME", "expected a frame's name of letters, digits"):
            write_transform(tmp_path / "file", form, Transform(*names, np.eye(3), np.zeros(3)))
    assert not (tmp_path / "file").exists()


# ---------------------------------------------------------------------- samples


def same(first: HandEyeSample, second: HandEyeSample, tolerance: float = 0.0) -> bool:
    pairs = zip(first, second, strict=True)
    return all(close(one.undated(), other, tolerance) for one, other in pairs)


def moved() -> list[HandEyeSample]:
    rng = np.random.default_rng(5)

    def pose(target: str, source: str) -> Transform:
        rotation = rotation_about(rng.normal(size=3), rng.uniform(-3, 3))
        return Transform(target, source, rotation, rng.normal(size=3))

    return [HandEyeSample(pose("base", "effector"), pose("camera", "object")) for _ in range(4)]


@pytest.mark.parametrize("form", SAMPLES)
@pytest.mark.parametrize("count", [0, 1, 4])
def test_samples_written_and_read_are_the_same_bit_by_bit(
    tmp_path: Path, form: str, count: int
) -> None:
    given_samples = moved()[:count]
    write_samples(tmp_path / "file", form, given_samples)
    back = read_samples(tmp_path / "file", form)
    assert len(back) == count
    assert all(same(one, other) for one, other in zip(given_samples, back, strict=True))


def test_samples_of_moveit_are_read_and_written(tmp_path: Path) -> None:
    found = read_samples(MOVEIT, "moveit")
    assert len(found) == 50
    assert (found[0].hand.label, found[0].seen.label) == ("T_base_effector", "T_camera_object")
    write_samples(tmp_path / "again.json", "moveit", found)
    again = json.loads((tmp_path / "again.json").read_text())
    assert np.array_equal(again, json.loads(MOVEIT.read_text()))


def test_samples_of_moveit_give_the_camera_pose_of_its_own_test() -> None:
    cv2 = pytest.importorskip("cv2", reason="needs the extra calibration")
    found = read_samples(MOVEIT, "moveit")
    rotation, shift = cv2.calibrateHandEye(
        [one.hand.inverse().rotation for one in found],
        [one.hand.inverse().translation for one in found],
        [one.seen.rotation for one in found],
        [one.seen.translation for one in found],
        method=cv2.CALIB_HAND_EYE_DANIILIDIS,
    )
    camera = Transform("base", "camera", rotation, shift.ravel())
    # the target is fixed to the hand: in the hand's frame its place is constant
    places = [(one.hand.inverse() @ camera @ one.seen).translation for one in found]
    assert np.std(places, axis=0).max() < 0.02


def test_samples_of_moveit_in_yaml_are_16_numbers_row_by_row(tmp_path: Path) -> None:
    write_samples(tmp_path / "s.yaml", "moveit_yaml", moved())
    data = yaml.safe_load((tmp_path / "s.yaml").read_text())
    assert data[1]["effector_wrt_world"][3] == moved()[1].hand.translation[0]
    assert data[1]["object_wrt_sensor"][12:] == [0, 0, 0, 1]


def test_samples_between_other_frames_are_refused(tmp_path: Path) -> None:
    first, second, *_ = moved()
    with refused("WRONG_FRAME", "sample 1, hand: expected T_base_effector", "got T_camera_object"):
        write_samples(tmp_path / "file", "moveit", [first, HandEyeSample(second.seen, second.hand)])


# ---------------------------------------------------------------------- trajectories


EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z [], v_RS_R_x [m s^-1], b_w_RS_S_x [rad s^-1]\r\n"
    "1403636580838555648,4.688319,-1.786938,0.783338,0.534108,-0.153029,-0.827383,-0.082152,"
    "-0.027876,-0.003172\r\n"
)


def times(count: int) -> list[Transform]:
    return [
        Transform("world", "body", one.hand.rotation, one.hand.translation, after(0.1 * index))
        for index, one in enumerate(itertools.islice(itertools.cycle(moved()), count))
    ]


@pytest.mark.parametrize("form", TRAJECTORIES)
@FEW
@example(microseconds=[10**17], transform=Transform("world", "body", np.eye(3), np.zeros(3)))
@given(
    microseconds=st.lists(st.integers(0, 10**17), max_size=3), transform=transforms("world", "body")
)
def test_trajectory_written_and_read_is_the_same(
    tmp_path_factory: Any, form: str, microseconds: list[int], transform: Transform
) -> None:
    path = tmp_path_factory.getbasetemp() / "trajectory.csv"
    start = NOON.replace(year=1970, month=1, day=1, hour=0)
    moments = [start + timedelta(microseconds=one) for one in microseconds]
    poses = [
        Transform("world", "body", transform.rotation, transform.translation, at) for at in moments
    ]
    write_trajectory(path, form, poses)
    back = read_trajectory(path, form)
    assert [one.at for one in back] == moments
    assert all(close(one, other, 4e-15) for one, other in zip(poses, back, strict=True))


def test_trajectory_of_euroc_has_the_real_part_first_and_nanoseconds(tmp_path: Path) -> None:
    (tmp_path / "data.csv").write_bytes(EUROC.encode())
    (found,) = read_trajectory(tmp_path / "data.csv", "asl", target="R", source="S")
    assert found.label == "T_R_S"
    assert found.at is not None
    assert found.at.isoformat() == "2014-06-24T19:03:00.838556+00:00"  # ...555648 ns
    assert np.allclose(
        found.quaternion * -1, [-0.153029, -0.827383, -0.082152, 0.534108], atol=1e-6
    )
    assert found.translation.tolist() == [4.688319, -1.786938, 0.783338]


@pytest.mark.parametrize(("form", "order"), [("asl", slice(4, 8)), ("euroc", [5, 6, 7, 4])])
def test_trajectory_is_read_by_numpy(tmp_path: Path, form: str, order: Any) -> None:
    poses = times(5)
    write_trajectory(tmp_path / "t.csv", form, poses)
    rows: NDArray[np.float64] = np.loadtxt(tmp_path / "t.csv", delimiter=",")
    assert rows.shape == (5, 8)
    assert np.array_equal(rows[:, 1:4], [one.translation for one in poses])
    assert np.array_equal(rows[:, order], [one.quaternion for one in poses])
    assert np.allclose(np.diff(rows[:, 0]), 0.1 if form == "asl" else 1e8, rtol=1e-5)


@pytest.mark.parametrize(
    ("head", "time"),
    [
        ("t,x,y,z,qx,qy,qz,qw", "10.25"),
        ("# t, x, y, z, q_x, q_y, q_z, q_w", "1.025e1"),
        ("t [ms],p_x,p_y,p_z,q_x,q_y,q_z,q_w", "10250"),
        ("Timestamp [us],x [m],y [m],z [m],qx,qy,qz,qw", "10250000"),
        ("# a remark\n#time [ns],x,y,z,qx,qy,qz,qw", "10250000000"),
    ],
)
def test_trajectory_goes_by_its_header(tmp_path: Path, head: str, time: str) -> None:
    (tmp_path / "t.csv").write_text(f"{head}\n# remark\n{time}, 1,2,3, 0,0,0.6,0.8\n\n")
    (found,) = read_trajectory(tmp_path / "t.csv", "euroc")
    assert found.at is not None
    assert found.at.timestamp() == 10.25
    assert np.allclose(found.quaternion, [0, 0, 0.6, 0.8])


@pytest.mark.parametrize(
    "head",
    [
        "",
        "10.25,1,2,3,0,0,0.6,0.8",
        "timestamp,x,y,z,qx,qy,qz,qw",  # seconds or nanoseconds?
        "t [h],x,y,z,qx,qy,qz,qw",
        "t,x,y,z,roll,pitch,yaw,w",
        "t,x,y,z,x,qx,qy,qz,qw",
    ],
)
def test_trajectory_with_an_incomplete_header_is_refused(tmp_path: Path, head: str) -> None:
    (tmp_path / "t.csv").write_text(f"{head}\n10.25,1,2,3,0,0,0.6,0.8\n")
    with refused("MALFORMED", "header: expected #t [s],x [m]", "with the unit of time in brackets"):
        read_trajectory(tmp_path / "t.csv", "asl")


@pytest.mark.parametrize(
    ("row", "code", "text"),
    [
        ("1,2,3,4,0,0,0", "MALFORMED", "line 2: expected 8 columns as in the header, got '7'"),
        ("1,2,x,4,0,0,0,1", "MALFORMED", "line 2: expected a number, got 'x'"),
        ("1,2,nan,4,0,0,0,1", "NOT_FINITE", "line 2: expected a number of at most 1e+09"),
        ("1,2,3,4,1,0,0,1", "NOT_RIGID", "line 2: T_world_body: expected a quaternion"),
        ("-1,2,3,4,0,0,0,1", "BAD_TIME", "line 2: expected a time since 1970"),
        ("1e99,2,3,4,0,0,0,1", "BAD_TIME", "got '1e99'"),
        ("253402300800,2,3,4,0,0,0,1", "BAD_TIME", "before the year 10000"),
    ],
)
def test_trajectory_with_an_invalid_row_is_refused(
    tmp_path: Path, row: str, code: str, text: str
) -> None:
    (tmp_path / "t.csv").write_text(f"t,x,y,z,qx,qy,qz,qw\n{row}\n")
    with refused(code, text, "t.csv"):
        read_trajectory(tmp_path / "t.csv", "asl")


def test_trajectory_of_poses_without_a_time_is_refused(tmp_path: Path) -> None:
    with refused("BAD_TIME", "pose 1: expected a time since 1970, got None"):
        write_trajectory(tmp_path / "t.csv", "asl", [times(1)[0], times(1)[0].undated()])


# ---------------------------------------------------------------------- planes


@pytest.mark.parametrize("model", ["rigid", "similarity"])
def test_plane_frame_and_scale_map_as_the_calibration_does(model: PlaneModel) -> None:
    calibration = table(model)
    transform, scale = plane_frame(calibration)
    assert transform.label == "T_base_plane"
    seen = np.array([(0.0, 0.0), (120.0, -30.0), (-900.0, 2000.0)])
    flat = scale * np.column_stack([seen, np.zeros(3)])
    assert np.allclose(transform.apply(flat), calibration.transform(seen), rtol=0, atol=1e-12)
    assert math.isclose(scale, 0.001, rel_tol=1e-9)


def test_plane_frame_at_a_height_maps_as_the_calibration_does() -> None:
    raised = table().at_height(0.02, (0.4, 0.2, 1.5))
    transform, scale = plane_frame(raised, name="parts")
    assert transform.label == "T_base_parts"
    expected = raised.transform([(100.0, 200.0)])[0]
    assert np.allclose(transform.apply((scale * 100, scale * 200, 0)), expected, atol=1e-12)


@pytest.mark.parametrize("model", ["affine", "homography"])
def test_plane_frame_of_a_map_that_has_none_is_refused(model: PlaneModel) -> None:
    with refused("NOT_SIMILAR", f"{model}: expected one scale", "export the matrix"):
        plane_frame(table(model))


@pytest.mark.parametrize("form", WRITTEN)
def test_plane_in_every_format_has_its_scale_in_a_comment(tmp_path: Path, form: str) -> None:
    calibration = table(scale=0.00025)
    text = compose_plane_frame(form, calibration)
    found = read(tmp_path, form, text, target="base", source="plane")
    assert close(found, plane_frame(calibration).transform, 4e-15)
    said = re.search(r"# multiply coordinates of plane by (\S+) to have metres", text)
    assert said is not None
    assert float(said[1]) == calibration.scale
    assert f"expected a name that ends in {TRANSFORMS[form].suffix}" in wrong_suffix(form)


def test_plane_whose_frame_would_end_the_comment_is_refused() -> None:
    calibration = dataclasses.replace(table(), camera_frame="cam\nx: 5")
    with refused("BAD_NAME", "expected a frame's name"):
        compose_plane_frame("ros_industrial", calibration)


def wrong_suffix(form: str) -> str:
    with pytest.raises(ValueError, match=r"got \.doc") as caught:
        compose_plane_frame(form, table(), suffix=".doc")
    return str(caught.value)


def test_matrix_of_a_plane_comes_back_bit_by_bit(tmp_path: Path) -> None:
    calibration = table("homography")
    (tmp_path / "m.yaml").write_text(compose_matrix(PlaneMatrix.of(calibration), "mm"))
    found = read_matrix(tmp_path / "m.yaml")
    assert found.matrix.tolist() == calibration.matrix.tolist()
    assert found[1:] == ("homography", "base", "")


def test_matrix_of_a_plane_maps_as_the_calibration_does(tmp_path: Path) -> None:
    calibration = table("homography")
    path = exported(tmp_path, calibration, "m.yaml")
    chain = Chain([PlaneProjection(read_matrix(path).matrix)], frame="base")
    seen = [(0.0, 0.0), (120.0, -30.0)]
    assert np.allclose(chain.transform(seen), calibration.transform(seen), rtol=0, atol=1e-15)


# ---------------------------------------------------------------------- service


def exported(
    folder: Path, calibration: PlaneCalibration, target: str, form: str | None = None
) -> Path:
    """Save a calibration into a folder and export it."""
    service = CalibrationService(folder)
    write(service.folder.calibration("table"), "plane", calibration.to_data())
    return folder / service.export("table", target, form)


@pytest.mark.parametrize("form", ["easy_handeye", "opencv", "ros_industrial"])
def test_export_in_a_format_is_the_frame_of_the_plane(tmp_path: Path, form: str) -> None:
    path = exported(tmp_path, table(), "frame.yaml", form)
    found = read_transform(path, form, target="base", source="plane")
    assert close(found, plane_frame(table()).transform, 4e-15)
    assert "# multiply coordinates of plane by 0.00" in path.read_text()


@pytest.mark.parametrize(
    ("model", "target", "form", "code", "text"),
    [
        ("homography", "a.yaml", "opencv", "NOT_SIMILAR", "homography: expected one scale"),
        ("rigid", "a.yaml", "xacro", "UNKNOWN_FORMAT", "no format is called 'xacro'"),
        ("rigid", "a.txt", "matrix", "UNKNOWN_FORMAT", "a bare matrix"),
        ("rigid", "a.json", "opencv", "BAD_NAME", "a name that ends in .yaml, got .json"),
        ("rigid", "a.yaml", "tf", "BAD_NAME", "a name that ends in .txt, got .yaml"),
    ],
)
def test_export_that_would_be_wrong_writes_nothing(
    tmp_path: Path, model: PlaneModel, target: str, form: str, code: str, text: str
) -> None:
    with refused(code, text):
        exported(tmp_path, table(model), target, form)
    assert not (tmp_path / "exports" / target).exists()
