"""Predicted errors of a lens' projection, against simulated calibrations."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from smartcam.calibration import CameraModel, calibrate_intrinsics
from smartcam.calibration._inside import Lens, compare_estimates
from smartcam.calibration._lens.uncertainty import figures, uncertainty
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code
from tests.calibration import lenskit
from tests.calibration.lens.estimates import Bench, spread_poses

BENCH = Bench(lenskit.LEFT, spread_poses(lenskit.LEFT, 12))
CALIBRATION = BENCH.calibration()


def test_map_reaches_from_corner_to_corner_and_has_its_figures() -> None:
    found = CALIBRATION.uncertainty(distance=0.5, shape=(5, 7))
    assert found.pixels.shape == (5, 7, 2)
    assert found.pixels[0, 0].tolist() == [0.0, 0.0]
    assert found.pixels[-1, -1].tolist() == [639.0, 479.0]
    assert found.sigma.shape == found.across.shape == (5, 7)
    assert found.figures.centre == found.sigma[2, 3]
    assert found.figures.worst == found.sigma.max()
    assert found.figures.rms == pytest.approx(math.sqrt((found.sigma**2).mean()))
    assert 3 * found.figures.centre < found.figures.corners < found.figures.worst * 1.0001


def test_uncertainty_is_least_at_the_target_and_ends_at_infinity() -> None:
    means = [CALIBRATION.uncertainty(distance=one).figures.rms for one in (0.4, 1.0, 3.0, 1e6)]
    assert means == sorted(means)
    assert CALIBRATION.uncertainty().figures.rms == pytest.approx(means[-1], rel=1e-4)


def test_across_converts_pixels_to_metres_at_the_distance() -> None:
    found = CALIBRATION.uncertainty(distance=2.0)
    focal = lenskit.LEFT.matrix[0, 0]
    assert found.across[12, 16] == pytest.approx(found.sigma[12, 16] * 2.0 / focal, rel=0.02)
    angle = CALIBRATION.uncertainty()
    assert angle.across[12, 16] == pytest.approx(angle.sigma[12, 16] / focal, rel=0.02)


def test_error_of_the_principal_point_is_compensated_by_a_turn() -> None:
    straight = CameraModel(size=(640, 480), matrix=lenskit.LEFT.matrix)
    only_cx = np.zeros((9, 9))
    only_cx[2, 2] = 1.0  # pixel^2
    found = uncertainty(straight, only_cx, BENCH.gauge).figures
    # a coordinate's share of 1 pixel is 0.71; a turn compensates all but the perspective's part
    assert found.worst < 0.25


def test_known_values_have_no_uncertainty() -> None:
    known = dataclasses.replace(CALIBRATION, covariance=np.zeros((9, 9)))
    assert known.uncertainty().figures.worst == 0.0


def test_corner_that_the_model_does_not_reach_has_no_number() -> None:
    folding = CameraModel(
        size=(640, 480), matrix=lenskit.LEFT.matrix, distortion=np.array([-0.5, 0, 0, 0, 0])
    )
    found = uncertainty(folding, BENCH.covariance, BENCH.gauge)
    assert np.isnan(found.sigma[0, 0])
    assert np.isnan(found.figures.corners)  # the view reaches none of them
    assert np.isfinite(found.sigma[12, 16])
    assert np.isfinite(found.figures.rms)


def test_corners_that_are_reached_have_a_mean() -> None:
    sigma = np.full((3, 3), 2.0)
    sigma[0, 0] = np.nan
    assert figures(sigma) == (2.0, 2.0, 2.0, 2.0)


@pytest.mark.parametrize("distance", [0.0, -1.0, math.nan, math.inf])
def test_invalid_distance_is_refused(distance: float) -> None:
    with pytest.raises(CalibrationError, match="distance: expected a positive number") as caught:
        CALIBRATION.uncertainty(distance=distance)
    assert caught.value.code == Code.NOT_FINITE


@pytest.mark.parametrize("shape", [(1, 9), (9, 501), (9,), (0, 0)])
def test_invalid_shape_is_refused(shape: tuple[int, int]) -> None:
    with pytest.raises(CalibrationError, match="shape of a map: expected rows") as caught:
        CALIBRATION.uncertainty(shape=shape)
    assert caught.value.code == Code.SHAPE


def test_map_of_a_calibration_is_that_of_its_bound() -> None:
    poses = spread_poses(lenskit.LEFT, 25)
    found = calibrate_intrinsics(lenskit.seen(lenskit.LEFT, poses)).uncertainty(distance=0.5)
    bound = Bench(lenskit.LEFT, poses).calibration().uncertainty(distance=0.5)
    assert found.figures.rms == pytest.approx(bound.figures.rms, rel=0.3)


@pytest.mark.long
@pytest.mark.parametrize("distance", [None, 0.4])
def test_predicted_uncertainty_is_observed(distance: float | None) -> None:
    truth = Lens(lenskit.LEFT, points=BENCH.gauge)
    squares = [
        compare_estimates(truth, Lens(BENCH.lens(seed)), distance=distance, shape=(7, 9)).lengths
        ** 2
        for seed in range(300)
    ]
    observed = np.sqrt(np.mean(squares, axis=0))
    ratio = CALIBRATION.uncertainty(distance=distance, shape=(7, 9)).sigma / observed
    assert 0.95 < ratio.mean() < 1.05
    assert ratio.min() > 0.85
    assert ratio.max() < 1.15


def test_lens_model_that_ends_before_the_image_has_a_remark_and_figures() -> None:
    views = lenskit.seen(lenskit.FISHEYE, lenskit.poses(10, distance=0.2), seed=1)
    found = calibrate_intrinsics(views, sheet="exact")
    (remark,) = [one for one in found.warnings if one.code == Code.OUT_OF_FIELD]
    assert "the model plumb_bob is not valid in" in remark.text
    known = found.uncertainty(distance=0.2).figures
    assert math.isfinite(known.worst)
    assert math.isfinite(known.rms)
