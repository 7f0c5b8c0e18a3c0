from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from lenskit import FISHEYE, LEFT, WIDE
from scipy.spatial.transform import Rotation

from smartcam.calibration.lens.projection import (
    excess,
    linearize,
    pose_changes,
    turned,
    whitening,
)

if TYPE_CHECKING:
    from smartcam.calibration.lens.model import CameraModel

POINTS = np.array([[0.05, -0.04, 0.4], [-0.1, 0.08, 0.5], [0.0, 0.0, 0.3], [0.12, 0.1, 0.6]])
STEP = 1e-6


@pytest.mark.parametrize("camera", [LEFT, WIDE, FISHEYE], ids=lambda one: one.distortion_model)
def test_linearize_of_each_model_gives_the_derivatives(camera: CameraModel) -> None:
    found = linearize(POINTS, camera)
    np.testing.assert_allclose(found.pixels, camera.project(POINTS), atol=1e-9)
    for axis, step in enumerate(STEP * np.eye(3)):
        there, back = camera.project(POINTS + step), camera.project(POINTS - step)
        np.testing.assert_allclose(
            found.by_point[..., axis], (there - back) / (2 * STEP), rtol=1e-5, atol=1e-4
        )


@pytest.mark.parametrize("camera", [LEFT, WIDE, FISHEYE], ids=lambda one: one.distortion_model)
def test_linearize_of_each_model_gives_the_derivatives_by_the_lens(camera: CameraModel) -> None:
    from smartcam.calibration.lens.bundle import lens_values, with_lens

    found, values = linearize(POINTS, camera).by_lens, lens_values(camera)
    for number, step in enumerate(STEP * np.eye(len(values))):
        there, back = (with_lens(camera, values + sign * step).project(POINTS) for sign in (1, -1))
        np.testing.assert_allclose(
            found[..., number], (there - back) / (2 * STEP), rtol=1e-5, atol=1e-4
        )


def test_linearize_of_a_point_behind_the_camera_gives_nan() -> None:
    assert np.isnan(linearize(np.array([[0.0, 0.0, -1.0]]), LEFT).pixels).all()


def test_pose_changes_are_those_of_a_turn_and_a_shift() -> None:
    rotation, shift = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0, 0, 0.4])
    near = POINTS @ rotation.T
    found = pose_changes(linearize(near + shift, LEFT).by_point, near)
    for axis, step in enumerate(STEP * np.eye(6)):
        there, back = (
            LEFT.project(POINTS @ turned(sign * step[:3], rotation).T + shift + sign * step[3:])
            for sign in (1, -1)
        )
        np.testing.assert_allclose(
            found[..., axis], (there - back) / (2 * STEP), rtol=1e-5, atol=1e-4
        )


def test_whitening_makes_residuals_independent_of_variance_one() -> None:
    covariance = np.array([[[0.04, 0.01], [0.01, 0.09]]])
    white = whitening(covariance, 0.25)[0]
    np.testing.assert_allclose(
        white @ (covariance[0] + 0.25 * np.eye(2)) @ white.T, np.eye(2), atol=1e-12
    )


def test_excess_is_the_variance_that_the_covariance_does_not_explain() -> None:
    random = np.random.default_rng(3)
    sigma = random.uniform(0.01, 0.1, 2000)
    residuals = random.normal(size=(2000, 2)) * np.sqrt(sigma**2 + 0.2**2)[:, None]
    found = excess(residuals, sigma[:, None, None] ** 2 * np.eye(2), 4000)
    assert found == pytest.approx(0.04, rel=0.05)


@pytest.mark.parametrize("freedom", [0, 100])
def test_excess_is_zero_where_nothing_is_left_to_explain(freedom: int) -> None:
    residuals = 0.1 * np.random.default_rng(4).normal(size=(50, 2))
    assert excess(residuals, np.tile(0.01 * np.eye(2), (50, 1, 1)), freedom) == 0.0
