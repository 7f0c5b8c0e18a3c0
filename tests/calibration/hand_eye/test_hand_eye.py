"""The place of a camera on a robot, or beside it."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from smartcam.calibration import (
    CameraModel,
    Checkerboard,
    HandEyeCalibration,
    RobotSigmas,
    TargetView,
    Transform,
    calibrate_hand_eye,
    calibrate_hand_eye_from_poses,
    calibrate_stereo,
    locate,
)
from smartcam.calibration.simulation import hand_eye_scene, view
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code, exp_rotation
from tests.calibration.inside import Setup, half_turned
from tests.calibration.scenes import CAMERA, SHEET, refused, scene

SETUPS: list[Setup] = ["eye-in-hand", "eye-to-hand"]
ONE_LONG = ["eye-in-hand", pytest.param("eye-to-hand", marks=pytest.mark.long)]
EXACT = RobotSigmas(0.0, 0.0)
NOISE = RobotSigmas(math.radians(0.02), 1e-4)

Pairs = tuple[list[Transform], "list[TargetView]"]


def measured(setup: Setup, pixel_sigma: float, robot_sigmas: RobotSigmas, **options: Any) -> Pairs:
    truth = scene(setup, **options)
    return truth.simulate_measurements(
        pixel_sigma=pixel_sigma, robot_sigmas=robot_sigmas, random=np.random.default_rng(11)
    )


@functools.cache
def calibrated(setup: Setup) -> HandEyeCalibration:
    """Return what exact samples give."""
    poses, views = measured(setup, 0.0, EXACT)
    return calibrate_hand_eye(poses, views, setup=setup, camera=CAMERA)


@functools.cache
def calibrated_from_poses(setup: Setup) -> HandEyeCalibration:
    truth = scene(setup, poses=6)
    seen = [truth.target_in_camera(pose) for pose in truth.robot_poses]
    return calibrate_hand_eye_from_poses(truth.robot_poses, seen, setup=setup)


@pytest.fixture(scope="module", params=ONE_LONG)
def exact(request: pytest.FixtureRequest) -> HandEyeCalibration:
    return calibrated(request.param)


@pytest.fixture(scope="module", params=ONE_LONG)
def noisy(request: pytest.FixtureRequest) -> HandEyeCalibration:
    poses, views = measured(request.param, 0.1, NOISE, poses=12)
    return calibrate_hand_eye(poses, views, setup=request.param, camera=CAMERA)


def test_hand_eye_without_noise_is_exact(exact: HandEyeCalibration) -> None:
    truth = scene(exact.setup)
    turn, shift = truth.errors(exact.camera_pose)
    assert turn < 1e-9
    assert shift < 1e-9
    assert exact.target_pose.label == truth.target_pose.label
    np.testing.assert_allclose(
        exact.target_pose.translation, truth.target_pose.translation, atol=1e-9
    )
    assert exact.held_out_error is not None
    assert exact.held_out_error < 1e-9
    assert exact.target_scale == 1.0
    assert exact.warnings == ()


def test_hand_eye_with_noise_is_as_good_as_it_expects(noisy: HandEyeCalibration) -> None:
    truth = scene(noisy.setup, poses=12)
    bound = truth.cramer_rao_bound(pixel_sigma=0.1, robot_sigmas=NOISE)
    turn, shift = truth.errors(noisy.camera_pose)
    assert turn < 2.5 * bound.rotation
    assert shift < 2.5 * bound.translation
    assert noisy.rotation_error == pytest.approx(bound.rotation, rel=0.6)
    assert noisy.translation_error == pytest.approx(bound.translation, rel=0.6)


def test_hand_eye_with_noise_takes_the_method_that_accounts_for_it(
    noisy: HandEyeCalibration,
) -> None:
    assert noisy.method == "robot"
    assert noisy.robot_sigmas is not None
    assert noisy.robot_sigmas.rotation == pytest.approx(NOISE.rotation, rel=0.6)
    assert noisy.robot_sigmas.translation == pytest.approx(NOISE.translation, rel=0.6)
    assert noisy.held_out_error == noisy.candidate_errors[noisy.method]
    assert {"robot", "reprojection", "robot, scale"} <= set(noisy.candidate_errors)


def test_hand_eye_held_out_errors_are_larger_than_errors(noisy: HandEyeCalibration) -> None:
    assert noisy.held_out_error is not None
    assert noisy.held_out_error > math.sqrt(float((noisy.errors**2).mean()))
    assert noisy.worst == int(np.argmax(noisy.leave_one_out))


@pytest.mark.long
@pytest.mark.parametrize("setup", SETUPS)
def test_hand_eye_does_not_depend_on_the_order(setup: Setup) -> None:
    poses, views = measured(setup, 0.1, NOISE)
    order = np.random.default_rng(3).permutation(len(poses))
    first, later = (
        calibrate_hand_eye(
            [poses[i] for i in some],
            [views[i] for i in some],
            setup=setup,
            camera=CAMERA,
            adjust="nothing",
        )
        for some in (range(len(poses)), order)
    )
    assert later.method == first.method
    np.testing.assert_allclose(
        later.camera_pose.translation, first.camera_pose.translation, atol=1e-12
    )
    np.testing.assert_allclose(later.camera_pose.rotation, first.camera_pose.rotation, atol=1e-12)
    np.testing.assert_allclose(later.leave_one_out, first.leave_one_out[order], atol=1e-12)
    np.testing.assert_allclose(later.errors, first.errors[order], atol=1e-12)


@pytest.mark.judged
def test_hand_eye_takes_poses_of_a_controller() -> None:
    poses, views = measured("eye-in-hand", 0.0, EXACT, poses=5)
    noon = datetime(2026, 3, 4, 12, tzinfo=UTC)
    said = [dataclasses.replace(pose, at=noon).pose() for pose in poses]
    found = calibrate_hand_eye(said, views, setup="eye-in-hand", camera=CAMERA, method="park")
    assert found.camera_pose.label == "T_flange_camera"
    assert scene("eye-in-hand", poses=5).errors(found.camera_pose)[1] < 1e-6


@pytest.mark.long
def test_hand_eye_finds_the_scale_of_a_print() -> None:
    """A sheet that was printed at 98 %: the robot's motions tell."""
    poses, views = measured("eye-in-hand", 0.1, NOISE, poses=9)
    said = Checkerboard(columns=5, rows=4, square=0.03 / 0.98)
    thought = [dataclasses.replace(one, target=said) for one in views]
    found = calibrate_hand_eye(poses, thought, setup="eye-in-hand", camera=CAMERA)
    assert found.method.endswith("scale")
    assert found.target_scale == pytest.approx(0.98, abs=0.002)
    assert [one.code for one in found.warnings] == [Code.SCALE_MISMATCH]
    assert "0.98" in found.warnings[0].text
    assert "poses and errors are those of a target of that size" in found.warnings[0].text
    assert found.target == Checkerboard(columns=5, rows=4, square=0.03 / 0.98 * found.target_scale)
    truth = scene("eye-in-hand", poses=9)
    kept = calibrate_hand_eye(
        poses, thought, setup="eye-in-hand", camera=CAMERA, adjust="nothing", method="robot"
    )
    assert truth.errors(found.camera_pose)[1] < truth.errors(kept.camera_pose)[1] / 3


def printed(setup: Setup, factor: float) -> tuple[list[Any], list[Any]]:
    """Return poses and views of a target that is said to be ``factor`` times as large as it is."""
    poses, views = measured(setup, 0.1, NOISE, poses=10)
    said = Checkerboard(columns=5, rows=4, square=0.03 * factor)
    return poses, [dataclasses.replace(one, target=said) for one in views]


def ratio(count: int, *, known: bool, bent: float = 0.0, board: Checkerboard = SHEET) -> float:
    """Return the rms expected error of the camera's place over the rms of those found.

    ``known``: whether the lens is given. ``bent``: rms height of a sheet, metres, which bends anew
    in each view where the lens is given, and else once.
    """
    expected, found = [], []
    for seed in range(count):
        random = np.random.default_rng([seed, 41])
        setup = SETUPS[seed % 2]
        truth = hand_eye_scene(
            board, CAMERA, setup=setup, poses=12, tilt=0.6, distance=0.5, random=random
        )
        poses, views = truth.simulate_measurements(
            pixel_sigma=0.1, robot_sigmas=NOISE, random=random
        )
        if bent:
            heights = random.normal(0.0, bent, 12 if known else 1)
            views = [bowed(one, heights[i % len(heights)]) for i, one in enumerate(views)]
        one = calibrate_hand_eye(
            poses,
            views,
            setup=setup,
            camera=CAMERA if known else None,
            adjust="nothing" if known else "auto",
        )
        expected.append(one.translation_error)
        found.append(truth.errors(one.camera_pose)[1])
    return math.sqrt(float(np.mean(np.square(expected)) / np.mean(np.square(found))))


def bowed(view: TargetView, height: float) -> TargetView:
    """Return a view of the sheet as it looks when its middle is lifted."""
    pose = locate(view, CAMERA).transform
    flat = view.object_points
    across = (flat[:, :2] - flat[:, :2].mean(axis=0)) / np.ptp(flat[:, :2], axis=0).max()
    lifted = flat + np.outer(height * (4.0 * (across**2).sum(axis=1) - 1.0), [0.0, 0.0, 1.0])
    moved = CAMERA.project(pose.apply(lifted)) - CAMERA.project(pose.apply(flat))
    return dataclasses.replace(view, points=view.points + moved)


@pytest.mark.long
@pytest.mark.parametrize(("known", "bent"), [(True, 0.0), (True, 5e-4), (False, 0.0)])
def test_hand_eye_expects_the_errors_that_are_found(known: bool, bent: float) -> None:
    """Noise, a sheet that bends anew, and a lens from the same views; sixteen give 18 % or so."""
    assert 0.65 < ratio(16, known=known, bent=bent) < 1.5


@pytest.mark.long
@pytest.mark.parametrize("bent", [1.5e-4, 5e-4])
def test_hand_eye_expects_what_a_sheet_does_that_is_bent_once(bent: float) -> None:
    """With the lens from the same views; taken as exact where views tell no more: 0.42, 0.49."""
    board = Checkerboard(columns=9, rows=6, square=0.02)
    assert 0.7 < ratio(16, known=False, bent=bent, board=board) < 1.4


@pytest.mark.judged
def test_lens_of_the_views_themselves_is_never_said_to_be_another_camera_s() -> None:
    """A bent sheet leaves more residuals than a lens that is fitted to it as flat."""
    random = np.random.default_rng([0, 41])
    board = Checkerboard(columns=9, rows=6, square=0.02)
    truth = hand_eye_scene(
        board, CAMERA, setup=SETUPS[0], poses=12, tilt=0.6, distance=0.5, random=random
    )
    poses, views = truth.simulate_measurements(pixel_sigma=0.1, robot_sigmas=NOISE, random=random)
    views = [bowed(one, 2e-3) for one in views]
    found = calibrate_hand_eye(poses, views, setup=SETUPS[0], adjust="nothing")
    assert {one.code for one in found.warnings} == {Code.SHEET_NOT_EXACT}


@pytest.mark.filterwarnings("error")
def test_hand_eye_of_four_points_with_its_own_lens_is_not_suspected() -> None:
    """Four corners show one bend of the target; with two more nothing could be solved."""
    board = Checkerboard(columns=9, rows=6, square=0.03)
    truth = hand_eye_scene(
        board,
        CAMERA,
        setup=SETUPS[0],
        poses=12,
        tilt=0.5,
        distance=0.6,
        random=np.random.default_rng(1),
    )
    poses, whole = truth.simulate_measurements(
        pixel_sigma=0.05, robot_sigmas=NOISE, random=np.random.default_rng(3)
    )
    corners = [0, 7, 32, 39]
    views = [
        dataclasses.replace(
            one,
            ids=one.ids[corners],
            points=one.points[corners],
            covariance=one.covariance[corners],
        )
        for one in whole
    ]
    assert not calibrate_hand_eye(poses, views, setup=SETUPS[0]).warnings


@pytest.mark.judged
@pytest.mark.parametrize("setup", ONE_LONG)
@pytest.mark.parametrize("known", [True, pytest.param(False, marks=pytest.mark.long)])
def test_hand_eye_numbers_a_target_that_looks_alike_after_half_a_turn(
    setup: Setup, known: bool
) -> None:
    board = Checkerboard(columns=8, rows=6, square=0.02)
    random = np.random.default_rng(3)
    truth = hand_eye_scene(
        board, CAMERA, setup=setup, poses=9, tilt=0.6, distance=0.5, random=random
    )
    poses, views = truth.simulate_measurements(pixel_sigma=0.1, robot_sigmas=NOISE, random=random)
    said = [half_turned(one) if number in (1, 4, 8) else one for number, one in enumerate(views)]
    camera = CAMERA if known else None
    found = calibrate_hand_eye(poses, said, setup=setup, camera=camera, adjust="nothing")
    assert found.warnings == ()
    assert truth.errors(found.camera_pose)[1] < 3.0 * found.translation_error
    assert [one.ids[0] for one in found.views] == [one.ids[0] for one in views]
    off, as_numbered = found.point_errors(poses, said), found.point_errors(poses, views)
    np.testing.assert_allclose(off[4], as_numbered[4][::-1], rtol=1e-9)


@pytest.mark.long
def test_hand_eye_of_a_bent_sheet_does_not_bend_its_lens() -> None:
    """A sheet that is bent by 0.7 mm; taken as exact it puts cameras 12 mm off, rms (measured)."""
    off = []
    for seed in range(6):
        random = np.random.default_rng([seed, 44])
        truth = hand_eye_scene(
            SHEET, CAMERA, setup=SETUPS[seed % 2], poses=12, tilt=0.6, distance=0.5, random=random
        )
        poses, views = truth.simulate_measurements(
            pixel_sigma=0.1, robot_sigmas=NOISE, random=random
        )
        bent = [bowed(one, 7e-4) for one in views]
        found = calibrate_hand_eye(poses, bent, setup=truth.setup, adjust="nothing")
        assert Code.SHEET_NOT_EXACT in {one.code for one in found.warnings}
        off.append(truth.errors(found.camera_pose)[1])
    assert math.sqrt(float(np.mean(np.square(off)))) < 5e-3


@pytest.mark.long
def test_hand_eye_without_a_lens_has_the_robots_motions_tell_it() -> None:
    """A sheet that bends anew in each view spoils the lens that the views alone give."""
    board = Checkerboard(columns=9, rows=6, square=0.02)
    off: list[list[float]] = []
    for seed in range(6):
        random = np.random.default_rng([seed, 45])
        truth = hand_eye_scene(
            board, CAMERA, setup=SETUPS[seed % 2], poses=12, tilt=0.6, distance=0.5, random=random
        )
        poses, views = truth.simulate_measurements(
            pixel_sigma=0.1, robot_sigmas=NOISE, random=random
        )
        bent = [bowed(one, float(random.normal(0.0, 5e-4))) for one in views]
        both = [
            calibrate_hand_eye(poses, bent, setup=truth.setup, adjust=adjust)
            for adjust in ("auto", "nothing")
        ]
        off.append([truth.errors(one.camera_pose)[1] for one in both])
    together, views_alone = np.sqrt(np.mean(np.square(off), axis=0))
    assert together < 0.6 * views_alone


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("setup", ONE_LONG)
@pytest.mark.parametrize("factor", [0.5, 0.8, 1.27, 2.0])
def test_hand_eye_refuses_a_print_of_quite_another_size(setup: Setup, factor: float) -> None:
    poses, views = printed(setup, factor)
    with pytest.raises(CalibrationError, match="times as large by the robot's motions") as caught:
        calibrate_hand_eye(poses, views, setup=setup, camera=CAMERA)
    assert caught.value.code == Code.SCALE_MISMATCH
    assert caught.value.got == pytest.approx(1 / factor, rel=0.01)


@pytest.mark.judged
@pytest.mark.parametrize("setup", ONE_LONG)
def test_hand_eye_finds_a_print_of_any_size_that_is_allowed(setup: Setup) -> None:
    poses, views = printed(setup, 1.27)
    found = calibrate_hand_eye(poses, views, setup=setup, camera=CAMERA, max_scale_error=0.3)
    assert found.target_scale == pytest.approx(1 / 1.27, rel=0.01)
    assert Code.SCALE_MISMATCH in {one.code for one in found.warnings}
    assert scene(setup, poses=10).errors(found.camera_pose)[1] < 2e-3


@pytest.mark.judged
@pytest.mark.parametrize(("factor", "told"), [(1.0, False), (1.05, True)])
def test_hand_eye_tells_a_size_that_was_not_to_be_adjusted(factor: float, told: bool) -> None:
    poses, views = printed("eye-in-hand", factor)
    ways: list[dict[str, Any]] = [{"adjust": "nothing"}, {"method": "park"}]
    for options in ways:
        found = calibrate_hand_eye(poses, views, setup="eye-in-hand", camera=CAMERA, **options)
        assert (Code.SCALE_MISMATCH in {one.code for one in found.warnings}) == told
        assert found.target_scale == 1.0


@pytest.mark.long
def test_hand_eye_does_not_take_noise_for_a_scale() -> None:
    """Of few poses and much noise: a chi-square test would have the sheet 0.9 % larger."""
    random = np.random.default_rng([27, 3])
    camera = CameraModel(
        size=(1280, 960), matrix=np.array([[1200.0, 0, 640], [0, 1200, 480], [0, 0, 1]])
    )
    truth = hand_eye_scene(
        Checkerboard(columns=9, rows=6, square=0.02),
        camera,
        setup="eye-in-hand",
        poses=10,
        tilt=math.radians(30.0),
        distance=0.5,
        random=random,
    )
    sigmas = RobotSigmas(math.radians(0.05), 3e-4)
    poses, views = truth.simulate_measurements(pixel_sigma=0.3, robot_sigmas=sigmas, random=random)
    found = calibrate_hand_eye(poses, views, setup="eye-in-hand", camera=camera)
    assert found.target_scale == 1.0
    assert truth.errors(found.camera_pose)[1] < 1e-3


@pytest.mark.judged
def test_second_camera_on_the_hand_is_where_the_pair_has_it() -> None:
    truth, random = scene("eye-in-hand", poses=9), np.random.default_rng(5)
    poses, views = measured("eye-in-hand", 0.1, NOISE)
    turn, shift = exp_rotation(np.array([0, -0.1, 0])), np.array([-0.06, 0, 0])
    beside = Transform("right", "camera", turn, shift)
    seen = [(beside @ truth.target_in_camera(pose)).rigid for pose in truth.robot_poses]
    placed = [Transform("camera", "target", *one) for one in seen]
    others = [view(SHEET, CAMERA, one, sigma=0.1, random=random) for one in placed]
    hand = calibrate_hand_eye(poses, views, setup="eye-in-hand", camera=CAMERA, adjust="nothing")
    pair = calibrate_stereo(views, others, left=CAMERA, right=CAMERA, sheet="exact")
    first = Transform("camera", "left", np.eye(3), np.zeros(3))
    second = hand.camera_pose @ first @ pair.transform.inverse()
    assert second.label == "T_flange_right"
    off = second.translation - (truth.camera_pose @ beside.inverse()).translation
    assert np.linalg.norm(off) < 3.0 * hand.translation_error


def test_hand_eye_without_a_camera_calibrates_it_from_the_views() -> None:
    poses, views = measured("eye-in-hand", 0.05, EXACT, poses=8, tilt=40.0)
    found = calibrate_hand_eye(
        poses, views, setup="eye-in-hand", adjust="nothing", method="reprojection"
    )
    assert found.camera is not None
    assert found.camera.matrix[0, 0] == pytest.approx(1200, rel=0.01)
    assert scene("eye-in-hand", poses=8, tilt=40.0).errors(found.camera_pose)[1] < 2e-3


@pytest.mark.parametrize("setup", ONE_LONG)
def test_hand_eye_from_poses_without_noise_is_exact(setup: Setup) -> None:
    truth = scene(setup, poses=6)
    found = calibrated_from_poses(setup)
    assert truth.errors(found.camera_pose)[1] < 1e-9
    assert found.camera is None
    assert found.views == ()
    with refused("NO_CALIBRATION", "a calibration with the camera's lens"):
        found.to_plane([[1, 2]], plane=truth.target_pose, robot_pose=truth.robot_poses[0])


def _with_a_wrong_pose(setup: Setup, poses: int = 12) -> Pairs:
    """Return poses of which number 4 is 10 mm and 2 degrees off."""
    said, views = measured(setup, 0.1, NOISE, poses=poses)
    turn = exp_rotation(np.array([math.radians(2.0), 0, 0]))
    said[4] = said[4] @ Transform("flange", "flange", turn, np.array([0, 0.01, 0]))
    return said, views


@pytest.mark.long
@pytest.mark.parametrize("setup", SETUPS)
def test_hand_eye_names_a_wrong_pose_and_leaves_it_out(setup: Setup) -> None:
    poses, views = _with_a_wrong_pose(setup)
    found = calibrate_hand_eye(
        poses, views, setup=setup, camera=CAMERA, adjust="nothing", method="robot"
    )
    assert [number for number, used in enumerate(found.used) if not used] == [4]
    assert found.worst == 4
    assert [one.code for one in found.warnings] == [Code.BAD_VIEW]
    assert found.warnings[0].text.startswith("view 4 is ")
    assert found.warnings[0].text.endswith(
        "its pose of the robot or its image is wrong; it was not used"
    )
    some = [number for number in range(12) if number != 4]
    rest = calibrate_hand_eye(
        [poses[i] for i in some],
        [views[i] for i in some],
        setup=setup,
        camera=CAMERA,
        adjust="nothing",
        method="robot",
    )
    np.testing.assert_allclose(
        found.camera_pose.translation, rest.camera_pose.translation, atol=1e-9
    )
    assert found.held_out_error == pytest.approx(rest.held_out_error, rel=1e-6)
    np.testing.assert_allclose(found.leave_one_out[some], rest.leave_one_out, rtol=1e-6)
    assert found.errors[4] == found.leave_one_out[4] > 5e-3
    assert HandEyeCalibration.from_data(found.to_data()).used == found.used


@pytest.mark.judged
def test_hand_eye_told_to_keep_a_wrong_pose_names_it_only() -> None:
    poses, views = _with_a_wrong_pose("eye-in-hand")
    found = calibrate_hand_eye(
        poses,
        views,
        setup="eye-in-hand",
        camera=CAMERA,
        adjust="nothing",
        method="robot",
        drop_bad=False,
    )
    assert all(found.used)
    assert found.worst == 4
    assert [one.code for one in found.warnings] == [Code.BAD_VIEW]
    assert found.warnings[0].text.endswith("it is used all the same")


@pytest.mark.judged
def test_hand_eye_of_few_poses_keeps_a_wrong_one() -> None:
    poses, views = _with_a_wrong_pose("eye-in-hand", poses=8)
    found = calibrate_hand_eye(
        poses, views, setup="eye-in-hand", camera=CAMERA, adjust="nothing", method="robot"
    )
    assert all(found.used)
    assert Code.BAD_VIEW in {one.code for one in found.warnings}


def test_hand_eye_from_poses_leaves_a_wrong_one_out() -> None:
    truth = scene("eye-to-hand", poses=9)
    seen = [truth.target_in_camera(pose) for pose in truth.robot_poses]
    shift = Transform("camera", "camera", np.eye(3), np.array([0.0, 0.01, 0.0]))
    seen[7] = shift @ seen[7]
    found = calibrate_hand_eye_from_poses(truth.robot_poses, seen, setup="eye-to-hand")
    assert found.used.index(False) == 7
    assert found.errors[7] == pytest.approx(0.01, rel=1e-3)
    assert found.warnings[0].text.startswith("pose 7 is ")
    assert truth.errors(found.camera_pose)[1] < 1e-6


@pytest.mark.parametrize("setup", SETUPS)
def test_hand_eye_with_inverted_poses_is_refused(setup: Setup) -> None:
    poses, views = measured(setup, 0.1, NOISE)
    inverted = [Transform("base", "flange", *_parts(pose.inverse())) for pose in poses]
    with refused("WRONG_FRAME", "they are inverted, or the camera is on the other side"):
        calibrate_hand_eye(inverted, views, setup=setup, camera=CAMERA, adjust="nothing")


def _parts(transform: Transform) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return transform.rotation, transform.translation


@pytest.mark.long
def test_hand_eye_with_a_wrong_lens_adjusts_it_and_says_so() -> None:
    poses, views = measured("eye-in-hand", 0.1, NOISE, poses=9, tilt=40.0)
    matrix = CAMERA.matrix.copy()
    matrix[0, 0] = matrix[1, 1] = 1150.0
    wrong = dataclasses.replace(CAMERA, matrix=matrix)
    found = calibrate_hand_eye(poses, views, setup="eye-in-hand", camera=wrong)
    assert found.camera is not None
    assert found.camera.matrix[0, 0] == pytest.approx(1200, rel=0.005)
    assert [one.code for one in found.warnings] == [Code.WRONG_LENS]
    assert "px instead of 1150.0 px" in found.warnings[0].text


def test_hand_eye_of_few_poses_says_that_they_are_few() -> None:
    poses, views = measured("eye-in-hand", 0.0, EXACT, poses=3)
    found = calibrate_hand_eye(poses, views, setup="eye-in-hand", camera=CAMERA, adjust="nothing")
    assert scene("eye-in-hand", poses=3).errors(found.camera_pose)[1] < 1e-6
    assert found.held_out_error is None
    assert np.isnan(found.leave_one_out).all()
    assert {Code.TOO_FEW, Code.NOT_HELD_OUT} <= {one.code for one in found.warnings}


def test_hand_eye_of_two_poses_is_refused() -> None:
    poses, views = measured("eye-in-hand", 0.0, EXACT)
    with refused("TOO_FEW", "at least 3 poses with a view, got 2"):
        calibrate_hand_eye(poses[:2], views[:2], setup="eye-in-hand", camera=CAMERA)


def test_hand_eye_of_pure_shifts_is_refused() -> None:
    truth = scene("eye-in-hand")
    first = truth.robot_poses[0]
    poses = [
        Transform(
            "base", "flange", first.rotation, first.translation + 0.01 * np.array([i, i % 2, 0])
        )
        for i in range(6)
    ]
    seen = [truth.target_in_camera(pose) for pose in poses]
    with refused("POSES_TOO_SIMILAR", "0.5 deg apart or more, got 1: pure shifts do not tell"):
        calibrate_hand_eye_from_poses(poses, seen, setup="eye-in-hand")


def test_hand_eye_of_turns_about_one_axis_is_refused() -> None:
    truth = scene("eye-in-hand")
    first = truth.robot_poses[0]
    poses = [
        Transform(
            "base",
            "flange",
            exp_rotation(np.array([0, 0, 0.3 * i])) @ first.rotation,
            first.translation + 0.02 * np.array([i % 2, i % 3, i]),
        )
        for i in range(8)
    ]
    seen = [truth.target_in_camera(pose) for pose in poses]
    with refused("INSUFFICIENT_ROTATION", "2 deg rms about the second one, got"):
        calibrate_hand_eye_from_poses(poses, seen, setup="eye-in-hand")


def test_hand_eye_of_wrong_inputs_is_refused() -> None:
    poses, views = measured("eye-in-hand", 0.0, EXACT)
    with refused("SHAPE", "as many views as poses of the robot, got 8 and 9"):
        calibrate_hand_eye(poses, views[:-1], setup="eye-in-hand", camera=CAMERA)
    with refused("SHAPE", "setup: expected one of", "got 'hand'"):
        calibrate_hand_eye(poses, views, setup="hand", camera=CAMERA)  # type: ignore[arg-type]
    with refused("SHAPE", "method: expected one of ['auto', ", "got 'best'"):
        calibrate_hand_eye(poses, views, setup="eye-in-hand", camera=CAMERA, method="best")
    with refused("SHAPE", "adjust: expected one of ['auto', ", "got 'robot'"):
        calibrate_hand_eye(
            poses,
            views,
            setup="eye-in-hand",
            camera=CAMERA,
            adjust="robot",  # type: ignore[arg-type]
        )
    with refused("NOT_FINITE", "robot_sigmas: expected two positive numbers"):
        calibrate_hand_eye(
            poses, views, setup="eye-in-hand", camera=CAMERA, robot_sigmas=RobotSigmas(0.0, 1e-4)
        )
    other = dataclasses.replace(views[1], target=Checkerboard(columns=5, rows=4, square=0.02))
    with refused("DIFFERENT_TARGETS", "views of one target"):
        calibrate_hand_eye(poses, [other, *views[1:]], setup="eye-in-hand", camera=CAMERA)
    world = Transform("world", "flange", *_parts(poses[0]))
    with refused("WRONG_FRAME", "all poses of the robot to be T_world_flange, got T_base_flange"):
        calibrate_hand_eye([world, *poses[1:]], views, setup="eye-in-hand", camera=CAMERA)


def test_to_plane_of_a_moving_camera_is_where_the_part_is() -> None:
    """The thesis' open point: an image from any pose of the robot, against the truth."""
    truth = scene("eye-in-hand", poses=5)
    poses, views = measured("eye-in-hand", 0.0, EXACT, poses=5)
    found = calibrate_hand_eye(
        poses, views, setup="eye-in-hand", camera=CAMERA, adjust="nothing", method="robot"
    )
    random = np.random.default_rng(8)
    parts = truth.target_pose.apply(
        np.column_stack([random.uniform(0, 0.12, (30, 2)), np.zeros(30)])
    )
    for pose in truth.robot_poses:
        lifted = dataclasses.replace(
            pose, translation=pose.translation + random.uniform(0, 0.03, 3)
        )
        camera = lifted @ truth.camera_pose
        pixels = CAMERA.project(camera.inverse().apply(parts))
        where = found.to_plane(pixels, plane=found.target_pose, robot_pose=lifted)
        np.testing.assert_allclose(where, parts, rtol=0, atol=1e-9)


@pytest.mark.judged
def test_to_plane_of_raised_features_is_where_they_are() -> None:
    truth = scene("eye-to-hand", poses=5)
    poses, views = measured("eye-to-hand", 0.0, EXACT, poses=5)
    found = calibrate_hand_eye(
        poses, views, setup="eye-to-hand", camera=CAMERA, adjust="nothing", method="robot"
    )
    table = poses[0] @ truth.target_pose
    parts = table.apply([[0.02, 0.03, 0.015], [0.1, 0.05, 0.015]])
    pixels = CAMERA.project(truth.camera_pose.inverse().apply(parts))
    np.testing.assert_allclose(found.to_plane(pixels, plane=table, height=0.015), parts, atol=1e-9)


def test_to_plane_that_cannot_be_is_refused(exact: HandEyeCalibration) -> None:
    pose = exact.robot_poses[0]
    away = exact.camera_at(pose) @ Transform("camera", "plane", np.eye(3), np.array([0, 0, -0.5]))
    text = "expected pixels whose rays meet the plane in front of the camera, got [5.0, 6.0]"
    with refused("OUT_OF_FIELD", f"to_plane: {text}"):
        exact.to_plane([[5, 6]], plane=away, robot_pose=pose)
    with refused("OUT_OF_FIELD", f"predicted_error: {text}"):
        exact.predicted_error([[5, 6]], plane=away, robot_pose=pose)
    if exact.setup == "eye-in-hand":
        with refused("WRONG_FRAME", "the robot's pose when the image was taken, got none"):
            exact.to_plane([[5, 6]], plane=away)


def test_predicted_error_is_of_the_size_of_the_cameras(noisy: HandEyeCalibration) -> None:
    pose, pixels = noisy.robot_poses[0], CAMERA.matrix[None, :2, 2]
    plane = noisy.target_pose if noisy.setup == "eye-in-hand" else pose @ noisy.target_pose
    (found,) = noisy.predicted_error(pixels, plane=plane, robot_pose=pose)
    assert 0.1 * noisy.translation_error < found < 10 * noisy.translation_error


@pytest.mark.long
def test_predicted_error_is_that_of_many_calibrations() -> None:
    truth = scene("eye-in-hand", poses=9)
    plane, pose = truth.target_pose, truth.robot_poses[0]
    centre = plane.apply([[0.06, 0.045, 0.0]])
    pixels = CAMERA.project((pose @ truth.camera_pose).inverse().apply(centre))
    random, off, predicted = np.random.default_rng(9), [], []
    for _ in range(9):
        poses, views = truth.simulate_measurements(
            pixel_sigma=0.1, robot_sigmas=NOISE, random=random
        )
        found = calibrate_hand_eye(
            poses, views, setup="eye-in-hand", camera=CAMERA, adjust="nothing", method="robot"
        )
        off.append(found.to_plane(pixels, plane=plane, robot_pose=pose) - centre)
        predicted.append(found.predicted_error(pixels, plane=plane, robot_pose=pose))
    observed = math.sqrt(float((np.array(off) ** 2).sum(axis=2).mean()))
    assert math.sqrt(float((np.array(predicted) ** 2).mean())) == pytest.approx(observed, rel=0.5)


def test_point_errors_of_its_own_poses_are_its_errors(noisy: HandEyeCalibration) -> None:
    found = noisy.point_errors(noisy.robot_poses, noisy.views)
    assert np.concatenate(found).mean() == pytest.approx(noisy.mean_error, rel=1e-12)
    rms = [math.sqrt(float((one**2).mean())) for one in found]
    np.testing.assert_allclose(rms, noisy.errors, rtol=1e-9)


@pytest.mark.judged
def test_point_errors_of_a_target_of_another_size_are_those_of_the_adjusted_one() -> None:
    poses, views = measured("eye-in-hand", 0.0, EXACT, poses=6)
    said = Checkerboard(columns=5, rows=4, square=0.03 / 0.98)
    thought = [dataclasses.replace(one, target=said) for one in views]
    found = calibrate_hand_eye(
        poses, thought, setup="eye-in-hand", camera=CAMERA, adjust="scale", method="robot"
    )
    assert np.concatenate(found.point_errors(poses, thought)).max() < 1e-8
    nominal = dataclasses.replace(found, target_scale=1.0)
    assert np.concatenate(nominal.point_errors(poses, thought)).mean() > 1e-3


@pytest.mark.long
@pytest.mark.parametrize("setup", SETUPS)
def test_point_errors_of_other_poses_are_the_held_out_error(setup: Setup) -> None:
    poses, views = measured(setup, 0.1, NOISE, poses=30)
    found = calibrate_hand_eye(
        poses[::2], views[::2], setup=setup, camera=CAMERA, adjust="nothing", method="robot"
    )
    other = np.concatenate(found.point_errors(poses[1::2], views[1::2]))
    assert found.held_out_error is not None
    # 14 seeds: 1.03 in all, each off by a fifth
    assert math.sqrt(float((other**2).mean())) == pytest.approx(found.held_out_error, rel=0.6)


@pytest.mark.parametrize("setup", ONE_LONG)
def test_point_errors_of_poses_of_the_target_are_its_origins(setup: Setup) -> None:
    truth = scene(setup, poses=6)
    seen = [truth.target_in_camera(pose) for pose in truth.robot_poses]
    found = calibrated_from_poses(setup)
    up = Transform("camera", "camera", np.eye(3), np.array([0.0, 0.003, 0.004]))
    errors = found.point_errors(truth.robot_poses, [up @ one for one in seen])
    np.testing.assert_allclose(np.concatenate(errors), 0.005, rtol=1e-6)


def test_point_errors_behind_the_camera_are_infinite() -> None:
    poses, views = measured("eye-to-hand", 0.0, EXACT, poses=5)
    found = calibrate_hand_eye(
        poses, views, setup="eye-to-hand", camera=CAMERA, adjust="nothing", method="park"
    )
    ahead = found.camera_pose.rotation[:, 2]
    away = dataclasses.replace(poses[0], translation=poses[0].translation - 2.0 * ahead)
    assert np.isinf(found.point_errors([away], views[:1])[0]).all()


def test_point_errors_of_what_does_not_belong_together_is_refused(
    exact: HandEyeCalibration,
) -> None:
    poses, views = list(exact.robot_poses), list(exact.views)
    with refused("SHAPE", "as many views as poses of the robot, got 9 and 8"):
        exact.point_errors(poses[:-1], views)
    other = dataclasses.replace(views[0], target=Checkerboard(columns=5, rows=4, square=0.02))
    with refused("DIFFERENT_TARGETS", "square=0.03", "square=0.02"):
        exact.point_errors(poses[:1], [other])
    with refused("WRONG_SIZE", "an image of 1280 x 960 pixels, got 640 x 480"):
        exact.point_errors(poses[:1], [dataclasses.replace(views[0], size=(640, 480))])
    with refused("WRONG_FRAME", "world"):
        exact.point_errors([Transform("world", "flange", *_parts(poses[0]))], views[:1])
    blind = dataclasses.replace(exact, camera=None)
    with refused("NO_CALIBRATION", "point_errors: expected a calibration with the camera's lens"):
        blind.point_errors(poses[:1], views[:1])


def test_hand_eye_is_stored_bit_by_bit(noisy: HandEyeCalibration, tmp_path: Path) -> None:
    noisy.save(tmp_path / "hand.json")
    again = HandEyeCalibration.load(tmp_path / "hand.json")
    assert again.to_data() == noisy.to_data()
    assert again.camera_pose.label == noisy.camera_pose.label
    assert again.views[3].target == SHEET
    assert again.target == noisy.target
    np.testing.assert_array_equal(again.covariance, noisy.covariance)


def test_hand_eye_from_poses_is_stored_bit_by_bit() -> None:
    truth = scene("eye-to-hand", poses=3)
    seen = [truth.target_in_camera(pose) for pose in truth.robot_poses]
    found = calibrate_hand_eye_from_poses(truth.robot_poses, seen, setup="eye-to-hand")
    data = json.loads(json.dumps(found.to_data()))
    assert HandEyeCalibration.from_data(data).to_data() == found.to_data()
    assert data["camera"] is None


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("setup", "beside", "setup: Input should be"),
        ("errors", [0.0, 0.0, 0.0], "errors: expected 9"),
        ("used", [True, True, True], "used: expected 9"),
        ("covariance", [[0.0]], "covariance: expected 12 rows of 12"),
        ("views", [], ""),
        ("target", None, "target: expected the target of the view"),
    ],
)
def test_hand_eye_from_other_data_is_refused(
    exact: HandEyeCalibration, name: str, value: Any, text: str
) -> None:
    data = exact.to_data() | {name: value}
    if not text:
        assert HandEyeCalibration.from_data(data).views == ()
        return
    with refused("SHAPE", f"stored hand-eye calibration: {text}"):
        HandEyeCalibration.from_data(data)


@pytest.mark.long
def test_hand_eye_of_more_than_200_poses_is_as_good_as_it_expects() -> None:
    poses, views = measured("eye-in-hand", 0.1, NOISE, poses=240)
    found = calibrate_hand_eye(poses, views, setup="eye-in-hand", camera=CAMERA, adjust="nothing")
    shift = scene("eye-in-hand", poses=240).errors(found.camera_pose)[1]
    assert shift < 3 * found.translation_error < 3e-4
