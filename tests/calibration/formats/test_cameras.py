from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from smartcam import CalibrationError
from smartcam.calibration import CameraModel, calibrate_intrinsics
from smartcam.calibration._inside import parse_camera_info, rectify
from smartcam.calibration.formats import CameraChain, read_cameras, write_camera_info, write_cameras
from smartcam.geometry._inside import Code
from tests.calibration.inside import (
    FORMS,
    CameraForm,
    compose_camchain,
    compose_camera_info,
    compose_opencv,
    parse_opencv,
)
from tests.calibration.lenskit import FISHEYE, LEFT, RIG, RIGHT, WIDE, poses, seen

FOUR = dataclasses.replace(LEFT, distortion=np.array([-0.28, 0.07, 1e-3, -5e-4, 0.0]))
ONE = CameraChain(cameras=(FOUR,), names=("camera",))
TWO = CameraChain(
    cameras=(FOUR, dataclasses.replace(FOUR, matrix=RIGHT.matrix)),
    transforms=(RIG,),
    names=("left", "right"),
)


def _same(one: CameraModel, other: CameraModel) -> None:
    assert tuple(one.size) == tuple(other.size)
    assert one.distortion_model == other.distortion_model
    assert one.matrix.tolist() == other.matrix.tolist()
    assert one.distortion.tolist() == other.distortion.tolist()


@pytest.mark.parametrize("camera", [LEFT, WIDE, FISHEYE], ids=lambda one: one.distortion_model)
@pytest.mark.parametrize("form", ["camera_info", "opencv"])
def test_written_camera_is_read_bit_by_bit(
    tmp_path: Path, form: CameraForm, camera: CameraModel
) -> None:
    write_cameras(tmp_path / "file", form, CameraChain(cameras=(camera,), names=("left_1",)))
    _same(read_cameras(tmp_path / "file", form).cameras[0], camera)


@pytest.mark.parametrize("form", ["kalibr", "opencv"])
def test_written_pair_is_read_with_its_transform(tmp_path: Path, form: CameraForm) -> None:
    write_cameras(tmp_path / "file", form, TWO)
    found = read_cameras(tmp_path / "file", form)
    for one, other in zip(found.cameras, TWO.cameras, strict=True):
        _same(one, other)
    np.testing.assert_array_equal(found.transforms[0].translation, RIG.translation)
    np.testing.assert_allclose(found.transforms[0].rotation, RIG.rotation, atol=1e-12)


def test_chain_of_a_calibration_has_its_camera() -> None:
    found = calibrate_intrinsics(seen(LEFT, poses(4)), sheet="exact")
    chain = CameraChain.of(found)
    assert chain.names == ("camera",)
    _same(chain.cameras[0], found.camera)


def test_camera_info_is_read_by_ros() -> None:
    data = yaml.safe_load(compose_camera_info(WIDE, "wide: 1"))
    assert (data["image_width"], data["image_height"]) == (640, 480)
    assert data["camera_name"] == "wide: 1"
    assert data["distortion_model"] == "rational_polynomial"
    coefficients = data["distortion_coefficients"]
    assert (coefficients["rows"], coefficients["cols"]) == (1, 8)
    assert coefficients["data"] == WIDE.distortion.tolist()
    assert data["camera_matrix"]["data"] == WIDE.matrix.ravel().tolist()
    assert data["rectification_matrix"]["data"] == np.eye(3).ravel().tolist()
    assert data["projection_matrix"]["data"][3::4] == [0.0, 0.0, 0.0]


def test_camera_info_of_a_rectified_pair_has_its_projection(tmp_path: Path) -> None:
    found = rectify(LEFT, RIGHT, RIG)
    write_camera_info(
        tmp_path / "right.yaml",
        RIGHT,
        name="right",
        rectification=found.rotations[1],
        projection=found.projections[1],
    )
    info = parse_camera_info((tmp_path / "right.yaml").read_text())
    assert info.name == "right"
    assert info.rectification.tolist() == found.rotations[1].tolist()
    assert info.projection.tolist() == found.projections[1].tolist()
    baseline = -info.projection[0, 3] / info.projection[0, 0]
    assert baseline == pytest.approx(np.linalg.norm(RIG.translation))


def test_camchain_is_read_by_kalibr() -> None:
    data = yaml.safe_load(compose_camchain(TWO))
    assert list(data) == ["cam0", "cam1"]
    assert data["cam0"]["intrinsics"] == [530.0, 531.0, 325.0, 236.0]
    assert data["cam0"]["distortion_coeffs"] == FOUR.distortion[:4].tolist()
    assert data["cam0"]["distortion_model"] == "radtan"
    assert "T_cn_cnm1" not in data["cam0"]
    rows = np.array(data["cam1"]["T_cn_cnm1"])
    np.testing.assert_array_equal(rows[:3, 3], RIG.translation)
    assert data["cam1"]["resolution"] == [640, 480]
    assert data["cam1"]["rostopic"] == "/right/image_raw"


@pytest.mark.parametrize("chain", [ONE, TWO])
def test_opencv_file_is_read_by_opencv_and_pyyaml(tmp_path: Path, chain: CameraChain) -> None:
    write_cameras(tmp_path / "file.yml", "opencv", chain)
    storage = cv2.FileStorage(str(tmp_path / "file.yml"), cv2.FILE_STORAGE_READ)
    single = len(chain.cameras) == 1
    names = ["camera_matrix", "distortion_coefficients"] if single else ["M2", "D2"]
    matrix, coefficients = (storage.getNode(name).mat() for name in names)
    assert matrix.tolist() == chain.cameras[-1].matrix.tolist()
    assert coefficients.ravel().tolist() == chain.cameras[-1].distortion.tolist()
    assert storage.getNode("image_width").real() == 640
    if not single:
        assert storage.getNode("T").mat().ravel().tolist() == RIG.translation.tolist()
    storage.release()
    assert parse_opencv(compose_opencv(chain)).value.cameras[0].distortion_model == "plumb_bob"


def test_opencv_file_of_its_own_storage_is_read(tmp_path: Path) -> None:
    storage = cv2.FileStorage(str(tmp_path / "theirs.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", LEFT.matrix)
    storage.write("distortion_coefficients", LEFT.distortion[:4])
    storage.release()
    found = read_cameras(tmp_path / "theirs.yml", "opencv").cameras[0]
    _same(found, FOUR)


def test_camera_info_without_distortion_is_one_of_zeros() -> None:
    text = compose_camera_info(FOUR).replace("cols: 5", "cols: 0")
    values = text[text.index("[", text.index("distortion_coefficients")) :].partition("]")[0]
    found = parse_camera_info(text.replace(values + "]", "[]")).camera
    assert found.distortion.tolist() == [0.0] * 5


def test_camera_info_with_more_coefficients_than_its_model_has_must_have_zeros() -> None:
    more = dataclasses.replace(WIDE, distortion=np.array([-0.28, 0.07, 0, 0, 0.1, 0, 0, 0]))
    text = compose_camera_info(more).replace("rational_polynomial", "plumb_bob")
    assert parse_camera_info(text).camera.distortion.tolist() == [-0.28, 0.07, 0.0, 0.0, 0.1]
    with pytest.raises(CalibrationError, match="expected 5 coefficients, got 8"):
        parse_camera_info(compose_camera_info(WIDE).replace("rational_polynomial", "plumb_bob"))


@pytest.mark.parametrize(
    ("form", "chain", "text"),
    [
        ("camera_info", TWO, "camera_info: expected one camera, .* got 2"),
        ("kalibr", CameraChain(cameras=(LEFT,), names=("a",)), r"k3 = 0 .* got 0.02"),
        ("kalibr", CameraChain(cameras=(WIDE,), names=("a",)), "got rational_polynomial"),
        (
            "opencv",
            CameraChain(cameras=(LEFT, FISHEYE), transforms=(RIG,), names=("a", "b")),
            "plumb_bob.* and equidistant",
        ),
        (
            "opencv",
            CameraChain(cameras=(LEFT,) * 3, transforms=(RIG,) * 2, names=("a", "b", "c")),
            "one camera or two.* got 3",
        ),
    ],
)
def test_write_cameras_of_values_that_a_format_cannot_store_raises(
    tmp_path: Path, form: CameraForm, chain: CameraChain, text: str
) -> None:
    with pytest.raises(CalibrationError, match=text) as caught:
        write_cameras(tmp_path / "file", form, chain)
    assert caught.value.code == Code.SHAPE
    assert not (tmp_path / "file").exists()


def test_chain_without_a_transform_between_cameras_raises() -> None:
    with pytest.raises(CalibrationError, match="2 cameras, 1 names and 0 transforms"):
        CameraChain(cameras=(LEFT, RIGHT), names=("a",))


@pytest.mark.parametrize(
    ("form", "old", "new", "code", "text"),
    [
        ("camera_info", "image_width: 640", "", Code.MALFORMED, "a list of 2"),
        ("camera_info", "640", "-640", Code.MALFORMED, "size of the images: expected a whole num"),
        ("camera_info", "640", "0", Code.MALFORMED, "size of the images: expected 1 to 1000000"),
        (
            "camera_info",
            "cols: 5",
            "cols: 4",
            Code.MALFORMED,
            "expected a list of 4, got a list of 5",
        ),
        ("camera_info", "plumb_bob", "fov", Code.MALFORMED, "distortion_model: expected plumb_bob"),
        ("camera_info", "530.0", ".nan", Code.NOT_FINITE, "camera_matrix"),
        ("camera_info", "530.0", "-530.0", Code.SHAPE, "positive focal lengths"),
        ("camera_info", "rows: 3", "rows: 2", Code.MALFORMED, "camera_matrix: expected"),
        ("camera_info", '"camera"', "[a]", Code.MALFORMED, "camera_name: expected a text"),
        ("kalibr", "pinhole", "omni", Code.MALFORMED, "cam0.camera_model: expected pinhole"),
        ("kalibr", "radtan", "fov", Code.MALFORMED, "one of radtan, equidistant, none, got 'fov'"),
        ("kalibr", "cam1", "cam7", Code.MALFORMED, "the keys cam0, cam1"),
        ("kalibr", "T_cn_cnm1", "T_other", Code.MALFORMED, "the keys T_cn_cnm1"),
        ("kalibr", "[ 530.0, ", "[ ", Code.MALFORMED, "cam0.intrinsics: expected a list of 4"),
        ("opencv", "image_height", "height", Code.MALFORMED, "size: expected a list of 2"),
        ("opencv", "M2", "M3", Code.MALFORMED, r"cameramatrix2 \(or"),
        ("opencv", "D2", "M_2", Code.MALFORMED, "each name once, got 'M_2'"),
        ("opencv", "R:", "Q:", Code.MALFORMED, "R and T from the first camera to the second"),
        ("opencv", "rows: 3\n   cols: 1", "rows: 1\n   cols: 2", Code.MALFORMED, "T: expected"),
    ],
)
def test_read_cameras_of_a_spoiled_file_raises(
    tmp_path: Path, form: CameraForm, old: str, new: str, code: Code, text: str
) -> None:
    chain = ONE if form == "camera_info" else TWO
    whole = FORMS[form].to_text(chain)
    assert old in whole
    (tmp_path / "file").write_text(whole.replace(old, new, 1))
    with pytest.raises(CalibrationError, match=text) as caught:
        read_cameras(tmp_path / "file", form)
    assert caught.value.code == code
    assert str(caught.value).startswith(f"{tmp_path / 'file'}: {form}: ")


@pytest.mark.parametrize(
    ("content", "text"), [(b"\xff\xfe\xff", "UTF-8"), (b"a" * (1 << 20) + b"b", "1048576 bytes")]
)
def test_read_cameras_of_binary_files_raises(tmp_path: Path, content: bytes, text: str) -> None:
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(CalibrationError, match=text):
        read_cameras(tmp_path / "file", "opencv")


def test_camchain_of_too_many_cameras_raises() -> None:
    with pytest.raises(CalibrationError, match="64 cameras at most, got '65'"):
        FORMS["kalibr"].parse("".join(f"cam{number}: {{}}\n" for number in range(65)))


def test_read_cameras_in_a_format_of_no_name_raises(tmp_path: Path) -> None:
    form: Any = "xml"
    with pytest.raises(CalibrationError, match="'xml'; expected one of camera_info") as caught:
        read_cameras(tmp_path / "file", form)
    assert caught.value.code == Code.UNKNOWN_FORMAT
