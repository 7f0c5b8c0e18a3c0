"""Map pixels to the robot by a picture of a sheet: errors as predicted, and refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import smartcam
from smartcam.calibration import (
    CameraModel,
    PlaneCalibration,
    SheetCalibration,
    TargetView,
    calibrate_sheet,
    fit_corners,
    load_calibration,
)
from smartcam.calibration.wizards import CalibrationService
from smartcam.exceptions import ConfigurationError
from smartcam.geometry._inside import Array
from smartcam.models import PoseSigma
from tests.calibration.inside import _scenes as scenes
from tests.calibration.inside import write
from tests.calibration.scenes import refused
from tests.calibration.sheetkit import (
    CAMERA,
    LIES,
    SEEN,
    SIGMA,
    STRAIGHT,
    TARGET,
    TOOL_Z,
    field,
    localized,
    truth,
)

CORNERS = [0, 8, 45, 53, 22]


def seen(camera: CameraModel = CAMERA, sigma: float = 0.0, seed: int = 1) -> TargetView:
    return scenes.view(TARGET, camera, SEEN, sigma=sigma, random=np.random.default_rng(seed))


def touched(sigma: float = 0.0, seed: int = 1, scale: float = 1.0) -> PlaneCalibration:
    noise = np.random.default_rng(seed).normal(0.0, sigma, (len(CORNERS), 3))
    touches = LIES.apply(scale * TARGET.points[CORNERS]) + noise
    return fit_corners(TARGET, CORNERS, touches, touch_sigma=SIGMA, tool_z=TOOL_Z)


@pytest.mark.parametrize("camera", [CAMERA, STRAIGHT])
def test_sheet_without_noise_maps_pixels_exactly(camera: CameraModel) -> None:
    lens = camera if camera is CAMERA else None  # a pinhole is a homography
    found = calibrate_sheet(seen(camera), touched(), camera=lens)
    pixels = field(border=0.0) - [0.5, 0.5]
    assert np.abs(found.transform(pixels) - truth(pixels, camera)).max() < 1e-8
    assert np.abs(found.inverse(found.transform(pixels)) - pixels).max() < 1e-6


@pytest.mark.long
@pytest.mark.parametrize(("camera", "touch"), [(CAMERA, 0.0), (CAMERA, SIGMA), (STRAIGHT, SIGMA)])
def test_sheet_errors_over_the_field_are_as_predicted(camera: CameraModel, touch: float) -> None:
    lens = camera if camera is CAMERA else None
    pixels = field(5)
    expected = truth(pixels, camera)
    squares, predicted = [], []
    for seed in range(60):
        plane = replace(touched(touch, seed), touch_sigma=max(touch, 1e-9))
        found = calibrate_sheet(seen(camera, 0.5, seed), plane, camera=lens)
        squares.append(((found.transform(pixels) - expected) ** 2).sum())
        predicted.append((found.predicted_error(pixels) ** 2).sum())
    assert np.sqrt(np.mean(squares) / np.mean(predicted)) == pytest.approx(1.0, abs=0.15)


def test_sheet_pose_turns_with_the_part_and_the_chain_agrees() -> None:
    found = calibrate_sheet(seen(), touched(), camera=CAMERA, camera_frame="camera")
    part = localized(300.0, 200.0, theta=0.4)
    pose = found.to_robot(part).pose
    ends = truth(np.array([[300.0, 200.0], [300 + 0.1 * np.cos(0.4), 200 - 0.1 * np.sin(0.4)]]))
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    axes = Rotation.from_quat(pose.orientation).as_matrix()
    assert np.allclose(pose.position, ends[0], atol=1e-9)
    assert np.allclose(axes[:, 0], along, atol=1e-3)
    assert np.allclose(axes[:, 2], -TOOL_Z, atol=1e-9)
    by_chain = found.chain.to_robot(part).pose
    assert np.allclose(by_chain.position, pose.position, atol=1e-12)
    assert np.allclose(by_chain.orientation, pose.orientation, atol=1e-12)
    both = found.to_robot([part, part])
    assert [one.pose.header.frame_id for one in both] == ["robot", "robot"]
    assert np.allclose(both[1].pose.position, pose.position, atol=1e-12)
    assert found.to_robot([]) == []
    flipped = found.to_robot(part, tool_flip=True).pose.orientation
    assert np.allclose(Rotation.from_quat(flipped).as_matrix()[:, 2], TOOL_Z, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("camera", [CAMERA, STRAIGHT])
def test_sigma_of_a_pose_is_that_of_many_sheets(camera: CameraModel) -> None:
    lens = camera if camera is CAMERA else None
    random = np.random.default_rng(3)
    sigma = PoseSigma(0.2, 0.1, 2e-3, 0.5)
    own = np.array([[0.04, 0.01, 0], [0.01, 0.01, 0], [0, 0, 4e-6]])
    found, said = [], []
    for seed in range(150):
        calibration = calibrate_sheet(
            seen(camera, 0.5, seed), touched(SIGMA, seed + 1000), camera=lens
        )
        u, v_up, theta = random.multivariate_normal((250.0, -200.0, 0.4), own)
        part = localized(u, -v_up, theta)
        one = calibration.to_robot(part._replace(pose=part.pose.with_sigma(sigma))).pose
        turn = LIES.rotation.T @ Rotation.from_quat(one.orientation).as_matrix()
        found.append((*one.position, np.arctan2(turn[1, 0], turn[0, 0])))
        assert one.sigma is not None
        said.append(one.sigma)
    assert calibration.to_robot(part).pose.sigma is None
    mean = [np.mean([getattr(one, name) for one in said]) for name in ("x", "y", "z", "theta")]
    # 150 of them: a standard deviation is known to 6 %
    np.testing.assert_allclose(mean, np.std(found, axis=0), rtol=0.2)


def test_sigma_in_pixels_becomes_metres_of_the_robot() -> None:
    calibration = calibrate_sheet(seen(), touched(), camera=CAMERA)
    part = localized(300.0, 200.0)
    assert calibration.to_robot(part).pose.sigma is None
    sharp = part._replace(pose=part.pose.with_sigma(PoseSigma(0.0, 0.0, 0.0)))
    known = calibration.to_robot(sharp).pose.sigma
    covariance = calibration.covariance_at([[300.0, 200.0]])[0]
    assert known is not None
    assert known.z is not None
    np.testing.assert_allclose([known.x, known.y, known.z], np.sqrt(np.diag(covariance)), rtol=1e-6)
    half = part._replace(pose=part.pose.with_sigma(PoseSigma(0.5, 0.5, 0.01)))
    seen_half = calibration.to_robot(half).pose.sigma
    assert seen_half is not None
    # half a pixel is a third of a millimetre there
    beyond = np.sqrt(seen_half.worst_xy**2 - known.worst_xy**2)
    assert 0.8 < beyond / (0.5 * 0.5 / 750) < 1.3
    assert 0.009 < seen_half.theta < 0.012


def test_sheet_with_a_wrong_y_axis_is_refused_instead_of_mirrored() -> None:
    found = calibrate_sheet(seen(), touched(), camera=CAMERA)
    with pytest.raises(ConfigurationError, match="y_down=True, so with y_down=False"):
        smartcam.connect("bvs://127.0.0.1", interpret_as="localizations", calibration=found)
    smartcam.connect(
        "bvs://127.0.0.1", interpret_as="localizations", calibration=found, y_down=True
    )
    unturned = localized(300.0, -200.0)
    with refused("OUT_OF_FIELD", "pixels of an image of 800 x 600, v down, got [300.0, -200.0]"):
        found.to_robot(unturned)


def test_sheet_refuses_poses_of_another_frame_or_out_of_the_image_plane() -> None:
    found = calibrate_sheet(seen(), touched(), camera=CAMERA, camera_frame="camera")
    with refused("WRONG_FRAME", "'camera', got some in 'other'"):
        found.to_robot(localized(300.0, 200.0, frame="other"))
    part = localized(300.0, 200.0)
    raised = part._replace(pose=part.pose._replace(position=smartcam.Position(300, -200, 0.1)))
    with refused("OUT_OF_PLANE", "some with a height or a tilt"):
        found.to_robot(raised)
    with refused("NOT_FINITE", "pixels"):
        found.transform([[np.nan, 1.0]])


def test_sheet_without_a_lens_has_a_remark() -> None:
    found = calibrate_sheet(seen(sigma=0.05), touched())
    assert [one.code for one in found.remarks] == ["LENS_UNKNOWN", "POOR_FIT"]
    assert "the distortion of its lens is not" in found.remarks[0].text
    assert "the lens distorts, or the sheet is not flat" in found.remarks[1].text
    pixels = field()
    lost = np.linalg.norm(found.transform(pixels) - truth(pixels), axis=1)
    assert lost.max() > 0.003


def test_sheet_in_a_mirror_is_refused() -> None:
    view = seen()
    flipped = replace(view, points=np.array([799.0, 0.0]) + view.points * [-1.0, 1.0])
    with refused("MIRRORED", "a view as in a mirror"):
        calibrate_sheet(flipped, touched(), camera=CAMERA)


def test_sheet_with_a_lens_of_another_size_is_refused() -> None:
    with refused("WRONG_SIZE", "640 x 480"):
        calibrate_sheet(seen(), touched(), camera=replace(CAMERA, size=(640, 480)))


def test_sheet_with_four_points_needs_a_lens() -> None:
    view = seen()
    few = replace(
        view,
        ids=view.ids[[0, 8, 45, 53]],
        points=view.points[[0, 8, 45, 53]],
        covariance=view.covariance[[0, 8, 45, 53]],
    )
    with refused("TOO_FEW", "expected 5 points or more without a lens, got 4"):
        calibrate_sheet(few, touched())
    error = calibrate_sheet(few, touched(), camera=CAMERA).transform(field()) - truth(field())
    assert np.abs(error).max() < 1e-6


def test_corners_of_a_wrong_print_have_a_remark_and_are_followed() -> None:
    plane = touched(SIGMA, scale=0.97)
    assert plane.model == "similarity"
    assert plane.scale == pytest.approx(0.97, abs=0.005)
    remarks = [one.text for one in plane.warnings if one.code == "SCALE_MISMATCH"]
    assert len(remarks) == 1
    assert "the print, the units or the height are other than thought" in remarks[0]
    with refused("SCALE_MISMATCH", "scale: expected 1 m"):
        touched(scale=0.8)


def test_corners_that_a_sheet_cannot_have_are_refused() -> None:
    with refused("SHAPE", "numbers from 0 to 53, got 54"):
        fit_corners(TARGET, [0, 8, 54], np.zeros((3, 3)))


def test_corners_of_a_bent_sheet_keep_one_scale() -> None:
    ids = [0, 4, 8, 18, 22, 26, 45, 49, 53]
    points: Array = TARGET.points[ids] * [1.0, 1.01, 1.0]
    plane = fit_corners(TARGET, ids, LIES.apply(points), touch_sigma=1e-5, tool_z=TOOL_Z)
    assert plane.model == "similarity"
    assert "NOT_SIMILAR" in [one.code for one in plane.warnings]


def test_sheet_saved_and_loaded_is_the_same(tmp_path: Path) -> None:
    found = calibrate_sheet(seen(sigma=0.1), touched(SIGMA), camera=CAMERA, camera_frame="camera")
    found.save(tmp_path / "table.json")
    for loaded in (
        SheetCalibration.load(tmp_path / "table.json"),
        load_calibration(tmp_path / "table.json"),
    ):
        assert loaded.to_data() == found.to_data()
        assert np.array_equal(loaded.transform(field()), found.transform(field()))
        assert np.array_equal(loaded.predicted_error(field()), found.predicted_error(field()))


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("matrix", [[0.0] * 3] * 3, "expected one that can be inverted"),
        ("covariance", [[0.0]] * 9, "expected 9 rows of 9"),
        ("lens_covariance", [[1.0]], "lens_covariance: expected shape (9, 9)"),
        ("rms", -1.0, "rms: Input should be greater than or equal to 0"),
        ("target", {"kind": "moon"}, "expected a kind of"),
        ("plane", {}, "stored plane calibration"),
    ],
)
def test_sheet_from_invalid_data_is_refused(name: str, value: object, text: str) -> None:
    data = json.loads(json.dumps(calibrate_sheet(seen(), touched(), camera=CAMERA).to_data()))
    with refused("SHAPE", text):
        SheetCalibration.from_data({**data, name: value})


def test_errors_of_the_lens_are_in_those_that_are_predicted(tmp_path: Path) -> None:
    covariance = np.diag([4.0, 4.0, 1.0, 1.0, 1e-6, 1e-6, 1e-8, 1e-8, 0.0])
    view, plane = seen(sigma=0.01), touched(SIGMA)
    alone = calibrate_sheet(view, plane, camera=CAMERA)
    known = calibrate_sheet(view, plane, camera=CAMERA, lens_covariance=covariance)
    assert len(known.lens_planes) == 8
    assert (known.predicted_error(field()) > alone.predicted_error(field())).all()
    known.save(tmp_path / "table.json")
    loaded = SheetCalibration.load(tmp_path / "table.json")
    assert np.array_equal(loaded.predicted_error(field()), known.predicted_error(field()))
    older = alone.to_data()
    del older["lens_covariance"]
    assert SheetCalibration.from_data(older).lens_covariance is None
    with refused("SHAPE", "lens_covariance: expected shape (0, 0)"):
        calibrate_sheet(view, plane, lens_covariance=covariance)
    with refused("NOT_FINITE", "lens_covariance"):
        calibrate_sheet(view, plane, camera=CAMERA, lens_covariance=covariance * np.nan)


def test_service_loads_copies_and_transforms_by_a_sheet(tmp_path: Path) -> None:
    service = CalibrationService(tmp_path)
    found = calibrate_sheet(seen(), touched(), camera=CAMERA)
    found.save(service.folder.calibration("table"))
    service.load("table")
    pose = service.transform(300.0, -200.0)  # y upwards
    assert np.allclose(pose.position, truth(np.array([[300.0, 200.0]]))[0], atol=1e-9)
    assert service.export("table", "copy.json") == "exports/copy.json"
    assert service.load("exports/copy.json").to_data() == found.to_data()
    with refused("WRONG_KIND", "table.json: holds 'sheet', expected 'plane'"):
        service.export("table", "table.yaml")


def test_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "other.json", "lens", {})
    with refused("WRONG_KIND", "other.json: holds 'lens', expected 'plane' or 'sheet'"):
        load_calibration(tmp_path / "other.json")
