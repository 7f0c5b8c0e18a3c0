"""Two calibrations of one lens, or of two."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from smartcam.calibration import CameraModel, Transform, compare_lenses
from smartcam.calibration._inside import Lens, compare_estimates, rig_difference
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import IDENTITY, Code, exp_rotation
from tests.calibration import lenskit
from tests.calibration.lens.estimates import Bench, rms, spread_poses

LENS = lenskit.LEFT
FIRST = Bench(LENS, spread_poses(LENS, 12))
SECOND = Bench(LENS, spread_poses(LENS, 10, seed=6))


def longer(camera: CameraModel, pixels: float) -> CameraModel:
    matrix = camera.matrix.copy()
    matrix[[0, 1], [0, 1]] += pixels
    return dataclasses.replace(camera, matrix=matrix)


@pytest.mark.parametrize("distance", [None, 0.4])
def test_calibrations_of_one_lens_are_the_same_within_their_noise(distance: float | None) -> None:
    found = compare_lenses(FIRST.calibration(1), SECOND.calibration(2), distance=distance)
    assert found.same
    assert found.ratio is not None
    assert 0.4 < found.ratio < 1.6
    assert found.predicted is not None
    assert 0.3 < found.observed.rms / found.predicted.rms < 3.0
    assert found.verdict.startswith("the same within their noise: ")


def test_another_lens_differs_by_more_than_noise() -> None:
    moved = Bench(longer(LENS, 3.0), SECOND.poses).calibration(2)
    found = compare_lenses(FIRST.calibration(1), moved)
    assert found.same is False
    assert found.chance is not None
    assert found.chance < 1e-5
    assert found.verdict.startswith("they differ by more than their noise explains: ")


def test_lens_of_another_model_differs_by_a_part_that_no_values_explain() -> None:
    bent = dataclasses.replace(LENS, distortion=LENS.distortion + np.array([0, 0, 0.002, 0, 0]))
    exact = dataclasses.replace(FIRST.calibration(1), covariance=1e-8 * FIRST.covariance)
    other = dataclasses.replace(exact, camera=bent)
    assert compare_lenses(exact, other).same is False


def test_bare_lenses_are_compared_without_a_verdict() -> None:
    found = compare_lenses(FIRST.calibration(1), SECOND.lens(2))
    assert (found.same, found.ratio, found.chance, found.expected) == (None, None, None, None)
    assert found.predicted is None
    assert found.verdict.startswith("no verdict: ")
    assert 0.0 < found.observed.rms < 0.3


def test_turned_camera_is_no_difference() -> None:
    # a principal point that is 5 pixels off is a turn of half a degree
    matrix = LENS.matrix.copy()
    matrix[0, 2] += 5.0
    straight = CameraModel(size=(640, 480), matrix=LENS.matrix)
    other = CameraModel(size=(640, 480), matrix=matrix)
    found = compare_lenses(straight, other)
    turn = float(found.motion.rigid.angle_to(IDENTITY))
    assert turn == pytest.approx(5.0 / 530.0, rel=0.15)
    assert found.observed.centre < 0.5
    assert np.abs(found.motion.translation).max() == 0.0


def test_difference_of_a_lens_and_itself_is_none() -> None:
    found = compare_lenses(FIRST.calibration(), FIRST.calibration(), distance=1.0)
    assert found.observed.worst < 1e-9
    assert found.same
    assert found.chance == 1.0


def test_corners_that_no_view_saw_do_not_move_the_camera() -> None:
    middle = Bench(LENS, lenskit.poses(10))
    bent = dataclasses.replace(LENS, distortion=LENS.distortion + np.array([0, 0, 0, 0, 0.05]))
    found = compare_estimates(
        Lens(LENS, points=middle.gauge), Lens(bent, points=middle.gauge), distance=0.4
    )
    assert np.linalg.norm(found.motion.translation) < 0.0005
    assert found.observed.corners > 1.0


def test_places_beyond_a_model_have_no_difference() -> None:
    folding = dataclasses.replace(LENS, distortion=np.array([-0.5, 0, 0, 0, 0]))
    found = compare_lenses(folding, folding)
    assert np.isnan(found.difference[0, 0]).all()
    assert found.observed.rms < 1e-4


def test_images_of_two_sizes_are_refused() -> None:
    other = dataclasses.replace(LENS, size=(1280, 960))
    with pytest.raises(CalibrationError, match="got 640 x 480 and 1280 x 960 pixels") as caught:
        compare_lenses(LENS, other)
    assert caught.value.code == Code.WRONG_SIZE


def test_calibration_without_a_lens_is_refused() -> None:
    with pytest.raises(CalibrationError, match="expected calibrations of lenses") as caught:
        compare_lenses(LENS, LENS.matrix)  # type: ignore[arg-type]
    assert caught.value.code == Code.SHAPE


def test_pair_is_compared_by_the_places_of_its_cameras() -> None:
    same = compare_lenses(LENS, LENS)
    turned = Transform(
        "right",
        "left",
        exp_rotation(np.array([0.0, 0.001, 0.0])) @ lenskit.RIG.rotation,
        lenskit.RIG.translation + np.array([0.0, 0.0, 0.002]),
    )
    turn, shift = rig_difference(lenskit.RIG, turned, same, same)
    assert [turn, shift] == pytest.approx([0.001, 0.002])


@pytest.mark.long
def test_chance_is_one() -> None:
    found = [
        compare_lenses(
            FIRST.calibration(seed),
            SECOND.calibration(1000 + seed),
            shape=(7, 9),
        )
        for seed in range(150)
    ]
    chances = np.array([one.chance for one in found])
    # few views estimate the noise badly, so the comparison errs to the safe side
    assert (chances < 0.05).mean() <= 0.05
    assert 0.2 < (chances < 0.5).mean() < 0.6
    assert (chances < 0.01).mean() <= 0.03
    assert 0.9 < rms(np.array([one.ratio for one in found])) < 1.15
