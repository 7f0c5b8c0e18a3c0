"""Files of other programs that are only read: their structure, and missing facts."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from smartcam.calibration import CameraModel, Transform
from smartcam.calibration._inside import read_lenses
from smartcam.calibration.formats import (
    pose_from,
    read_cameras,
    read_samples,
    read_trajectory,
    read_transform,
)
from smartcam.geometry._inside import Code
from tests.calibration.inside import CameraForm
from tests.calibration.scenes import refused

EIGHT = [-0.31, 0.12, 2e-4, -3e-4, 0.02, 0.05, -0.06, 0.01]

COLMAP = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 1
1 OPENCV 1280 960 1200.5 1201.25 640.5 470.25 -0.1 0.02 0.0005 -0.0003
"""
MRCAL = """\
# generated on a Sunday
{
    'lensmodel':  'LENSMODEL_OPENCV8',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 1200.5, 1201.25, 640.0, 469.75,-0.31,0.12,2e-4,-3e-4,0.02,0.05,-0.06,0.01,],

    'extrinsics': [ 0, 0, 0, 1., 2, -3., ],
    'imagersize': [ 1280, 960 ],
    'icam_intrinsics': 0,
}
"""
ROS_INI = """\
# oST version 5.0 parameters


[image]

width
1280

height
960

[narrow_stereo/left]

camera matrix
1200.500000 0.000000 640.000000
0.000000 1201.250000 469.750000
0.000000 0.000000 1.000000

distortion
-0.100000 0.020000 0.000500 -0.000300 0.000000

rectification
1.000000 0.000000 0.000000
0.000000 1.000000 0.000000
0.000000 0.000000 1.000000

projection
1190.0 0.000000 640.000000 0.000000
0.000000 1190.0 470.000000 0.000000
0.000000 0.000000 1.000000 0.000000
"""
SENSOR = """\
# General sensor definitions.
sensor_type: camera
comment: a camera

T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, -0.0216,
         1.0, 0.0, 0.0, -0.0647,
         0.0, 0.0, 1.0, 0.0098,
         0.0, 0.0, 0.0, 1.0]

rate_hz: 20
resolution: [1280, 960]
camera_model: pinhole
intrinsics: [1200.5, 1201.25, 640.0, 469.75] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.02, 0.0005, -0.0003]
"""


def basalt(kind: str = "kb4", names: tuple[str, ...] = ("k1", "k2", "k3", "k4")) -> dict[str, Any]:
    lens = {"fx": 1200.5, "fy": 1201.25, "cx": 640.0, "cy": 469.75}
    lens |= {name: 0.01 * (place + 1) for place, name in enumerate(names)}
    pose = {"px": 0.0, "py": 0.0, "pz": 0.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}
    cameras = [{"camera_type": kind, "intrinsics": lens}] * 2
    poses = [pose, {**pose, "px": 0.11}]
    return {"value0": {"T_imu_cam": poses, "intrinsics": cameras, "resolution": [[1280, 960]] * 2}}


def multical() -> dict[str, Any]:
    matrix = [[1200.5, 0.0, 640.0], [0.0, 1201.25, 469.75], [0.0, 0.0, 1.0]]
    lens = {"model": "standard", "image_size": [1280, 960], "K": matrix}
    lens["dist"] = [[-0.1, 0.02, 0.0005, -0.0003, 0.0]]
    turn = np.eye(3).tolist()
    return {
        "cameras": {"left": lens, "right": lens},
        "camera_poses": {
            "left": {"R": turn, "T": [0.0, 0.0, 0.0]},
            "right_to_left": {"R": turn, "T": [-61.7, 0.0, 0.0]},
        },
        "image_sets": {"rgb": []},
    }


ONE: list[tuple[CameraForm, str, str, list[float]]] = [
    ("colmap", COLMAP, "plumb_bob", [-0.1, 0.02, 0.0005, -0.0003, 0.0]),
    ("mrcal", MRCAL, "rational_polynomial", EIGHT),
    ("ros_ini", ROS_INI, "plumb_bob", [-0.1, 0.02, 0.0005, -0.0003, 0.0]),
    ("euroc", SENSOR, "plumb_bob", [-0.1, 0.02, 0.0005, -0.0003, 0.0]),
]


@pytest.mark.parametrize(("form", "text", "model", "coefficients"), ONE)
def test_camera_of_another_program_is_read(
    tmp_path: Path, form: CameraForm, text: str, model: str, coefficients: list[float]
) -> None:
    (tmp_path / "file").write_text(text)
    (camera,) = read_cameras(tmp_path / "file", form).cameras
    assert camera.size == (1280, 960)
    assert camera.distortion_model == model
    assert camera.distortion.tolist() == coefficients
    # COLMAP counts from the corner of the upper left pixel: half a pixel is taken off
    wanted = [[1200.5, 0, 640.0], [0, 1201.25, 469.75], [0, 0, 1]]
    assert camera.matrix.tolist() == wanted
    (lens,) = read_lenses(tmp_path / "file").lenses
    assert lens.camera.matrix.tolist() == wanted


@pytest.mark.parametrize(
    ("said", "numbers", "model", "coefficients"),
    [
        ("SIMPLE_PINHOLE", "900 640.5 480.5", "plumb_bob", [0, 0, 0, 0, 0]),
        ("RADIAL", "900 640.5 480.5 0.1 0.2", "plumb_bob", [0.1, 0.2, 0, 0, 0]),
        ("RADIAL_FISHEYE", "900 640.5 480.5 0.1 0.2", "equidistant", [0.1, 0.2, 0, 0]),
        ("OPENCV_FISHEYE", "900 900 640.5 480.5 1 2 3 4", "equidistant", [1, 2, 3, 4]),
        ("FULL_OPENCV", "900 900 640.5 480.5 1 2 3 4 5 6 7 8", "rational_polynomial", None),
    ],
)
def test_colmap_models_have_their_coefficients(
    tmp_path: Path, said: str, numbers: str, model: str, coefficients: list[float] | None
) -> None:
    (tmp_path / "cameras.txt").write_text(f"7 {said} 1280 960 {numbers}\n")
    (camera,) = read_cameras(tmp_path / "cameras.txt", "colmap").cameras
    assert camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == [900, 900, 640, 480]
    assert camera.distortion_model == model
    assert camera.distortion.tolist() == (coefficients or [1, 2, 3, 4, 5, 6, 7, 8])


def test_mrcal_model_with_the_inputs_of_its_solver_is_read(tmp_path: Path) -> None:
    data = base64.b85encode(bytes(range(256)) * 8000).decode()
    (tmp_path / "file").write_text(MRCAL.replace("}", f" 'optimization_inputs': b'{data}',\n}}"))
    (camera,) = read_cameras(tmp_path / "file", "mrcal").cameras
    assert camera.distortion.tolist() == EIGHT


def test_basalt_pair_leads_from_the_first_camera_to_the_second(tmp_path: Path) -> None:
    (tmp_path / "calibration.json").write_text(json.dumps(basalt()))
    chain = read_cameras(tmp_path / "calibration.json", "basalt")
    assert chain.transforms[0].label == "T_cam1_cam0"
    np.testing.assert_allclose(chain.transforms[0].translation, [-0.11, 0, 0], atol=1e-15)
    assert chain.cameras[1].distortion_model == "equidistant"
    assert chain.cameras[1].distortion.tolist() == [0.01, 0.02, 0.03, 0.04]


def test_multical_pair_wants_the_unit_of_its_board(tmp_path: Path) -> None:
    (tmp_path / "calibration.json").write_text(json.dumps(multical()))
    with refused(Code.UNIT_UNKNOWN, "lengths: expected to know the unit", 'unit="mm"'):
        read_cameras(tmp_path / "calibration.json", "multical")
    chain = read_cameras(tmp_path / "calibration.json", "multical", unit="mm")
    assert chain.names == ("left", "right")
    assert chain.transforms[0].label == "T_right_left"
    np.testing.assert_allclose(chain.transforms[0].translation, [-0.0617, 0, 0], atol=1e-15)


@pytest.mark.parametrize(
    ("form", "text", "code", "said"),
    [
        ("colmap", "1 FOV 10 10 1 2 3 4 5", Code.MALFORMED, "lens model: expected one of SIMPLE_"),
        ("colmap", "1 OPENCV 10 10 1 2 3", Code.MALFORMED, "8 parameters of OPENCV (fx, fy, cx"),
        ("colmap", COLMAP + COLMAP, Code.MALFORMED, "one camera, since it has no poses, got '2'"),
        ("colmap", "# nothing\n", Code.MALFORMED, "expected 1 to 64 cameras, got '0'"),
        ("mrcal", MRCAL.replace("OPENCV8", "CAHVOR"), Code.MALFORMED, "LENSMODEL_PINHOLE"),
        (
            "mrcal",
            MRCAL.replace("0.01,]", "0.01+x,]"),
            Code.MALFORMED,
            "expected a number, got '0.01+x'",
        ),
        ("mrcal", "__import__('os').abort()", Code.MALFORMED, "file: expected a mapping"),
        ("ros_ini", ROS_INI.replace("640.0", "640.0 1"), Code.MALFORMED, "expected a list of 9"),
        ("ros_ini", ROS_INI.replace("0.000000 1201", "0.5 1201"), Code.MALFORMED, "[[fx, 0, cx]"),
        ("ros_ini", ROS_INI + ROS_INI, Code.MALFORMED, "expected one camera, got \"'width' twice"),
        ("euroc", SENSOR.replace("pinhole", "omni"), Code.MALFORMED, "camera_model: expected pin"),
        ("euroc", SENSOR.replace("radial-t", "t"), Code.MALFORMED, "none, radial-tangential"),
        (
            "euroc",
            SENSOR.replace("resolution", "other"),
            Code.WRONG_SIZE,
            "give them as size=(width, height)",
        ),
        ("basalt", json.dumps(basalt("ds")), Code.MALFORMED, "pinhole-radtan8, kb4, got 'ds'"),
        ("basalt", '{"value0": {"intrinsics": []}}', Code.MALFORMED, "1 to 64 cameras"),
        ("basalt", json.dumps(basalt()).replace("0.11", "99"), Code.UNIT_UNKNOWN, "got 99 m"),
    ],
)
def test_damaged_camera_of_another_program_is_refused_with_the_fault(
    tmp_path: Path, form: CameraForm, text: str, code: Code, said: str
) -> None:
    (tmp_path / "file").write_text(text)
    with refused(code, said):
        read_cameras(tmp_path / "file", form)


def test_format_that_is_only_read_is_not_written(tmp_path: Path) -> None:
    from smartcam.calibration.formats import write_cameras

    (tmp_path / "file").write_text(COLMAP)
    chain = read_cameras(tmp_path / "file", "colmap")
    with refused(Code.UNKNOWN_FORMAT, "colmap: expected a format that can be written"):
        write_cameras(tmp_path / "other", "colmap", chain)


# ---------------------------------------------------------------------- OpenCV's own programs

K = np.array([[535.0, 0, 330.5], [0, 536.0, 233.25], [0, 0, 1]])
D = np.array([[-0.28, 0.1, 1e-4, 2e-4, -0.2]])
D14 = np.column_stack([D, np.zeros((1, 9))])
TURN = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]


def stored(path: Path, **values: Any) -> Path:
    """Return a file that OpenCV has written."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value)
    storage.release()
    return path


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize(
    ("names", "bent"),
    [
        (("image_width", "image_height", "camera_matrix", "distortion_coefficients"), D.T),
        (("image_Width", "image_Height", "Camera_Matrix", "Distortion_Coefficients"), D),
        (("imageWidth", "imageHeight", "cameraMatrix", "distCoeffs"), D14),
        (("image_width", "image_height", "K", "D"), D[:, :4] * 1.0),
    ],
)
def test_camera_that_opencv_writes_is_read(
    tmp_path: Path, suffix: str, names: tuple[str, ...], bent: np.ndarray[Any, Any]
) -> None:
    width, height, matrix, coefficients = names
    values = {width: 640, height: 480, matrix: K, coefficients: bent}
    path = stored(tmp_path / f"file.{suffix}", flags=0, avg_reprojection_error=0.25, **values)
    (camera,) = read_cameras(path, "opencv").cameras
    wanted = np.zeros(5)
    wanted[: min(5, bent.size)] = bent.ravel()[:5]
    _check(camera, wanted)
    (lens,) = read_lenses(path).lenses
    _check(lens.camera, wanted)


def _check(camera: CameraModel, coefficients: np.ndarray[Any, Any]) -> None:
    assert camera.size == (640, 480)
    assert camera.distortion_model == "plumb_bob"
    assert camera.matrix.tolist() == K.tolist()
    assert camera.distortion.tolist() == coefficients.tolist()


@pytest.mark.parametrize("suffix", ["yml", "xml"])
def test_pair_of_stereo_calib_is_read_of_its_two_files(tmp_path: Path, suffix: str) -> None:
    lenses = stored(tmp_path / f"intrinsics.{suffix}", M1=K, D1=D14, M2=K, D2=D14)
    pose = stored(tmp_path / f"extrinsics.{suffix}", R=TURN, T=np.array([[-61.7], [0.2], [0.1]]))
    with refused(Code.WRONG_SIZE, "size=(width, height)"):
        read_cameras(lenses, "opencv")
    with refused(Code.MALFORMED, "extrinsics="):
        read_cameras(lenses, "opencv", size=(640, 480))
    with refused(Code.UNIT_UNKNOWN, 'unit="mm"'):
        read_cameras(lenses, "opencv", size=(640, 480), extrinsics=pose)
    chain = read_cameras(lenses, "opencv", size=(640, 480), extrinsics=pose, unit="mm")
    np.testing.assert_allclose(chain.transforms[0].translation, [-0.0617, 0.0002, 0.0001])
    np.testing.assert_allclose(chain.transforms[0].rotation, TURN, atol=1e-12)
    for camera in chain.cameras:
        _check(camera, D.ravel())


def test_size_that_is_given_has_to_be_the_files(tmp_path: Path) -> None:
    path = stored(tmp_path / "a.yml", image_width=640, image_height=480, K=K, D=D)
    with refused(Code.WRONG_SIZE, "the file says 640 x 480, got 1280 x 960"):
        read_cameras(path, "opencv", size=(1280, 960))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<opencv_storage><a>1</a><a>2</a></opencv_storage>", "each name once, got 'a'"),
        ("<storage/>", "expected <opencv_storage>, got '<storage>'"),
        (
            "<!DOCTYPE a [<!ENTITY b 'c'>]><opencv_storage/>",
            "file: expected XML without a document type",
        ),
        ("<opencv_storage>" + 30 * "<a>", "nested 16 deep at most"),
        ("<opencv_storage>", "expected XML (no element found"),
    ],
)
def test_xml_that_is_no_storage_is_refused(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "a.xml").write_text(text)
    with refused(Code.MALFORMED, said):
        read_cameras(tmp_path / "a.xml", "opencv")


# ---------------------------------------------------------------------- transforms

ROWS = [[0.0, -1.0, 0.0, 612.5], [1.0, 0.0, 0.0, -40.2], [0.0, 0.0, 1.0, 930.8], [0.0, 0, 0, 1]]
LINES = "\n".join(" ".join(map(str, row)) for row in ROWS)
ZIVID = f"__version__:\n  serializer: 1\n  data: 1\nFloatMatrix:\n  Data: {ROWS}\n"
URDF = """\
<?xml version="1.0"?>
<robot name="cell">
  <link name="flange"/>
  <joint name="axis_1" type="revolute"><parent link="base"/><child link="arm"/>
    <origin xyz="0 0 0.4" rpy="0 0 0"/></joint>
  <joint name="mount" type="fixed">
    <!-- where the camera sits -->
    <origin xyz="0.6125 -0.0402 0.9308" rpy="0 0 1.5707963267948966"/>
    <parent link="flange"/><child link="camera"/>
  </joint>
</robot>
"""
LAUNCH = """\
import os
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    raise SystemExit("this file is read, not run")
    return LaunchDescription([
        Node(package="other", executable="driver", arguments=["--x", "1"]),
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            arguments=["--x", "0.6125", "--y", str_or_number, "--z", "0.9308",
                       "--yaw", "1.5707963267948966",
                       "--frame-id", "flange", "--child-frame-id", "camera"],
        ),
    ])
""".replace("str_or_number", '"-0.0402"')
POSITIONS = LAUNCH.replace('"--x", "1"', "").replace(
    LAUNCH[LAUNCH.index('arguments=["--x", "0.6') : LAUNCH.index("        ),\n    ])")],
    "arguments=[0.6125, -0.0402, 0.9308, 1.5707963267948966, 0, 0, 'flange', 'camera'],\n",
)
ROS2_XML = (
    '<launch><node pkg="tf2_ros" exec="static_transform_publisher" name="a" '
    'args="--x 0.6125 --y -0.0402 --z 0.9308 --yaw 1.5707963267948966 --frame-id flange '
    '--child-frame-id camera"/></launch>'
)


@pytest.mark.parametrize(
    ("form", "text", "unit"),
    [
        ("matrix", LINES, "mm"),
        ("matrix", LINES.replace(" ", ", "), "mm"),
        ("matrix", json.dumps(ROWS), "mm"),
        ("matrix", str(np.array(ROWS)), "mm"),
        ("zivid", ZIVID, None),
        ("urdf", URDF, None),
        ("ros2", LAUNCH, None),
        ("ros2", POSITIONS, None),
        ("ros2", ROS2_XML, None),
    ],
)
def test_pose_of_another_program_is_read(tmp_path: Path, form: str, text: str, unit: Any) -> None:
    (tmp_path / "file").write_text(text)
    pose = read_transform(tmp_path / "file", form, target="flange", source="camera", unit=unit)
    assert pose.label == "T_flange_camera"
    np.testing.assert_allclose(pose.translation, [0.6125, -0.0402, 0.9308])
    np.testing.assert_allclose(pose.rotation, np.array(ROWS)[:3, :3], atol=1e-12)


def test_sensor_of_euroc_sits_on_its_body(tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    pose = read_transform(tmp_path / "sensor.yaml", "euroc_sensor", target="body", source="cam0")
    assert pose.label == "T_body_cam0"
    assert pose.translation.tolist() == [-0.0216, -0.0647, 0.0098]


@pytest.mark.parametrize(
    ("form", "text", "code", "said"),
    [
        ("matrix", LINES, Code.UNIT_UNKNOWN, 'give it as unit="m" or unit="mm"'),
        ("matrix", LINES.partition("\n")[2], Code.MALFORMED, "four rows of four, got '12'"),
        ("urdf", URDF.replace('"camera"', '"lens"'), Code.MALFORMED, "base to arm, flange to lens"),
        ("urdf", URDF.replace("0.9308", "930.8"), Code.UNIT_UNKNOWN, "is it in millimetres?"),
        ("urdf", URDF.replace("1.57079", "90.0"), Code.UNIT_UNKNOWN, "are they in degrees?"),
        ("urdf", URDF.replace("0 0 0.4", "x"), None, ""),
        ("ros2", LAUNCH.replace('"0.6125"', "X"), Code.MALFORMED, "no variables or calls"),
        ("ros2", LAUNCH.replace("static_", "moving_"), Code.MALFORMED, "one Node of executable"),
        ("ros2", LAUNCH + "(", Code.MALFORMED, "launch file: expected Python"),
    ],
)
def test_damaged_pose_of_another_program_is_refused_with_the_fault(
    tmp_path: Path, form: str, text: str, code: Code | None, said: str
) -> None:
    (tmp_path / "file").write_text(text)
    if code is None:  # another joint's origin does not count
        assert read_transform(tmp_path / "file", form, target="flange").source == "camera"
        return
    with refused(code, said):
        read_transform(tmp_path / "file", form, target="flange")


# ---------------------------------------------------------------------- units


def test_pose_that_is_too_far_for_metres_asks_for_its_unit(tmp_path: Path) -> None:
    path = tmp_path / "tf.txt"
    path.write_text("static_transform_publisher 612.5 -40.2 930.8 0 0 0 base camera\n")
    with refused(Code.UNIT_UNKNOWN, "camera from base", "got 1114.97 m", 'unit="mm"'):
        read_transform(path, "tf2")
    assert read_transform(path, "tf2", unit="mm").translation.tolist() == pytest.approx(
        [0.6125, -0.0402, 0.9308]
    )
    assert read_transform(path, "tf2", unit="m").translation[2] == 930.8


def test_angles_of_more_than_a_turn_are_no_radians(tmp_path: Path) -> None:
    (tmp_path / "tf.txt").write_text("static_transform_publisher 0.4 0.1 0.2 90 0 180 base cam\n")
    with refused(Code.UNIT_UNKNOWN, "angles in radians", "got 180", "degrees"):
        read_transform(tmp_path / "tf.txt", "tf2")


def test_unit_of_a_file_is_used_unless_the_user_gives_another(tmp_path: Path) -> None:
    text = '%YAML:1.0\n---\nunit: "mm"\nPose: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n'
    flat = ", ".join(str(value) for row in ROWS for value in row)
    (tmp_path / "a.yaml").write_text(f"{text}   data: [ {flat} ]\n")
    assert read_transform(tmp_path / "a.yaml", "opencv").translation[2] == pytest.approx(0.9308)
    cm = read_transform(tmp_path / "a.yaml", "opencv", unit="cm")
    assert cm.translation[2] == pytest.approx(9.308)
    unit: Any = "ell"
    with refused(Code.UNIT_UNKNOWN, "expected a unit of length of m, cm, mm, inch, got 'ell'"):
        read_transform(tmp_path / "a.yaml", "opencv", unit=unit)


def test_samples_in_millimetres_ask_for_their_unit(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps([[ROWS, ROWS]]))
    with refused(Code.UNIT_UNKNOWN, "distance of effector from base"):
        read_samples(tmp_path / "a.json", "moveit")
    (sample,) = read_samples(tmp_path / "a.json", "moveit", unit="mm")
    assert isinstance(sample.hand, Transform)
    assert sample.seen.translation[2] == pytest.approx(0.9308)


@pytest.mark.parametrize(
    ("unit", "place"), [(" [m]", 930.8), (" [mm]", 0.9308), (" []", None), ("", None)]
)
def test_trajectory_has_the_unit_of_its_header(
    tmp_path: Path, unit: str, place: float | None
) -> None:
    head = f"#t [s],x{unit},y{unit},z{unit},qx [],qy [],qz [],qw []\n"
    (tmp_path / "a.csv").write_text(f"{head}1.5,0,0,930.8,0,0,0,1\n")
    if place is None:
        with refused(Code.UNIT_UNKNOWN, "got 930.8 m"):
            read_trajectory(tmp_path / "a.csv", "asl")
        place = 0.9308
        (pose,) = read_trajectory(tmp_path / "a.csv", "asl", unit="mm")
    else:
        (pose,) = read_trajectory(tmp_path / "a.csv", "asl")
    assert pose.translation[2] == pytest.approx(place)


def test_pose_of_a_controller_in_another_unit_is_asked_for() -> None:
    with refused(Code.UNIT_UNKNOWN, "pose of ur", "is it in millimetres?"):
        pose_from("ur", [612.5, -40.2, 930.8, 0, 0, 1.5])
    assert pose_from("ur", [612.5, 0, 0, 0, 0, 1.5], unit="mm").translation[0] == 0.6125
    with refused(Code.UNIT_UNKNOWN, "in degrees?"):
        pose_from("ur", [0.6125, 0, 0, 0, 0, 90])
