from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from lenskit import FISHEYE, LEFT, WIDE, poses, seen

from smartcam import CalibrationError
from smartcam.calibration import Code
from smartcam.calibration.lens.bundle import lens_values
from smartcam.calibration.lens.start import fit_lens, lens_basis, parameter_names

if TYPE_CHECKING:
    from smartcam.calibration.lens.model import CameraModel


@pytest.mark.parametrize(
    ("camera", "tilt", "distance"),
    [
        (LEFT, 0.6, 0.35),
        pytest.param(WIDE, 0.7, 0.25, marks=pytest.mark.long),
        (FISHEYE, 0.9, 0.12),
    ],
)
def test_fit_lens_of_views_without_noise_finds_the_lens(
    camera: CameraModel, tilt: float, distance: float
) -> None:
    views = seen(camera, poses(10, tilt=tilt, distance=distance), sigma=0.0)
    found = fit_lens(views, camera.distortion_model).bundle.cameras[0]
    assert found.distortion_model == camera.distortion_model
    rays = camera.directions([[120.0, 100.0], [camera.size[0] - 90.0, 200.0], [300.0, 350.0]])
    flat = np.column_stack([rays, np.ones(3)])
    np.testing.assert_allclose(found.project(flat), camera.project(flat), atol=0.01)


def test_fit_lens_with_fixed_coefficients_leaves_them_at_zero() -> None:
    views = seen(LEFT, poses(8))
    lens = fit_lens(views, "plumb_bob", ["k3", "p1", "aspect"]).bundle.cameras[0]
    assert lens.distortion[[2, 4]].tolist() == [0.0, 0.0]
    assert lens.distortion[0] < -0.2
    assert lens.matrix[0, 0] == lens.matrix[1, 1]


def test_lens_basis_has_a_column_for_each_unknown() -> None:
    assert lens_basis("plumb_bob").shape == (9, 9)
    basis = lens_basis("equidistant", ["aspect", "k4"])
    assert basis.shape == (8, 6)
    np.testing.assert_array_equal(basis[:, 0], [1, 1, 0, 0, 0, 0, 0, 0])


def test_lens_basis_of_an_unknown_coefficient_raises() -> None:
    with pytest.raises(CalibrationError, match="got k4") as caught:
        lens_basis("plumb_bob", ["k4"])
    assert caught.value.code == Code.SHAPE
    assert "k1, k2, p1, p2, k3" in str(caught.value)


def test_parameter_names_are_those_of_the_values() -> None:
    named = dict(zip(parameter_names("plumb_bob"), lens_values(LEFT), strict=True))
    assert (named["fx"], named["cy"], named["p1"], named["k3"]) == (530.0, 236.0, 1e-3, 0.02)
