from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam import CalibrationError
from smartcam.calibration import (
    CameraModel,
    IntrinsicCalibration,
    StereoCalibration,
    TargetView,
    calibrate_intrinsics,
    calibrate_stereo,
)
from smartcam.geometry._inside import Code, motion_from_data, motion_to_data
from tests.calibration.lenskit import BOARD, LEFT, pairs, poses, seen


@functools.cache
def _camera(count: int = 5, *, bent: bool = False) -> IntrinsicCalibration:
    points = BOARD.points + 3e-4 * np.random.default_rng(1).normal(size=(54, 3)) if bent else None
    return calibrate_intrinsics(seen(LEFT, poses(count, seed=3), points=points), sheet="auto")


@functools.cache
def _stereo() -> StereoCalibration:
    left, right = pairs(5)
    return calibrate_stereo([*left, None, None], [*right[:4], None, right[4], None])


@pytest.mark.parametrize(("count", "bent"), [(5, False), (3, False), (7, True)])
def test_saved_camera_is_loaded_bit_by_bit(tmp_path: Path, count: int, bent: bool) -> None:
    saved = _camera(count, bent=bent)
    saved.save(tmp_path / "camera.json")
    loaded = IntrinsicCalibration.load(tmp_path / "camera.json")
    assert (saved.sheet is not None) == bent
    assert loaded.to_data() == saved.to_data()
    assert json.loads(json.dumps(loaded.to_data(), allow_nan=False)) == saved.to_data()
    assert loaded.views[1].view.target == BOARD
    assert loaded.deviations == saved.deviations


def test_saved_stereo_is_loaded_bit_by_bit(tmp_path: Path) -> None:
    _stereo().save(tmp_path / "stereo.json")
    loaded = StereoCalibration.load(tmp_path / "stereo.json")
    assert loaded.to_data() == _stereo().to_data()
    assert [one.used for one in loaded.pairs] == [one.used for one in _stereo().pairs]
    pixels = np.array([[300.0, 200.0]]), np.array([[210.0, 205.0]])
    np.testing.assert_array_equal(loaded.triangulate(*pixels), _stereo().triangulate(*pixels))


def test_load_of_the_other_kind_raises(tmp_path: Path) -> None:
    _stereo().save(tmp_path / "stereo.json")
    with pytest.raises(CalibrationError, match="holds 'stereo', expected 'camera'") as caught:
        IntrinsicCalibration.load(tmp_path / "stereo.json")
    assert caught.value.code == Code.WRONG_KIND


def test_camera_from_data_of_its_data_is_the_same() -> None:
    assert CameraModel.from_data(LEFT.to_data()).to_data() == LEFT.to_data()


def test_view_and_motion_from_data_of_their_data_are_the_same() -> None:
    view = _camera().views[0].view
    again = TargetView.from_data(json.loads(json.dumps(view.to_data())), target=BOARD)
    assert again.to_data() == view.to_data()
    assert again.target == BOARD
    with pytest.raises(
        CalibrationError, match="stored view: target: expected the target of the view"
    ):
        TargetView.from_data(view.to_data())
    one = _stereo().transform
    same = motion_from_data(motion_to_data(one), one.target, one.source)
    assert (same.label, same.rotation.tolist()) == (one.label, one.rotation.tolist())
    with pytest.raises(CalibrationError, match="stored motion: translation: Field required"):
        motion_from_data({"rotation": np.eye(3).tolist()}, "a", "b")


def _changed(data: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    copy: dict[str, Any] = json.loads(json.dumps(data))
    *way, last = path.split(".")
    place: Any = copy
    for step in way:
        place = place[int(step) if step.isdecimal() else step]
    place[int(last) if last.isdecimal() else last] = value
    return copy


@pytest.mark.parametrize(
    ("path", "value", "text"),
    [
        ("rms", -1.0, "rms: .*greater than or equal to 0"),
        ("rms", float("nan"), "rms: .*finite"),
        ("more", 1, "more: Extra"),
        ("covariance", [[1.0]], r"covariance: expected shape \(9, 9\)"),
        ("covariance", [[1.0], [1.0, 2.0]], r"covariance: expected shape \(9, 9\)"),
        ("camera.distortion", [0.0], "expected 5 coefficients, got 1"),
        ("camera.distortion_model", "fov", "camera.distortion_model"),
        ("views.0.view.ids.3", 54, "ids: expected less than 54"),
        ("views.0.view.ids", [0, 1], r"points: expected shape \(2, 2\)"),
        ("views.0.residuals", [], r"residuals: expected shape"),
        ("target", {"kind": "cube"}, "expected a kind of"),
        ("views", [], "views: List should have at least 1"),
        ("sheet", [[0.0, 0.0, 0.0]], r"sheet: expected shape \(54, 3\)"),
    ],
)
def test_camera_of_broken_data_raises(path: str, value: Any, text: str) -> None:
    data = _changed(_camera().to_data(), path, value)
    with pytest.raises(CalibrationError, match=text) as caught:
        IntrinsicCalibration.from_data(data)
    assert caught.value.code == Code.SHAPE


@pytest.mark.parametrize(
    ("path", "value", "code"),
    [
        ("transform.rotation.0.0", 2.0, Code.NOT_RIGID),
        ("pairs.0.used", [True], Code.SHAPE),
        ("pairs.0.left.points.0", [1.0], Code.SHAPE),
        ("covariance.0", [], Code.SHAPE),
    ],
)
def test_stereo_of_broken_data_raises(path: str, value: Any, code: Code) -> None:
    with pytest.raises(CalibrationError) as caught:
        StereoCalibration.from_data(_changed(_stereo().to_data(), path, value))
    assert caught.value.code == code
