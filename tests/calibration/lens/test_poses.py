from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartcam import CalibrationError
from smartcam.calibration import Transform, locate
from smartcam.geometry._inside import Code, exp_rotation
from tests.calibration.inside import excess_variance, linearize, pixels_by_pose, whitening
from tests.calibration.lenskit import BOARD, FISHEYE, LEFT, TURNED, WIDE, poses, seen

if TYPE_CHECKING:
    from smartcam.calibration import CameraModel
    from smartcam.geometry._inside import Array

NEAR = Transform("camera", "target", TURNED, np.array([-0.1, 0.06, 0.5]))


def _off(found: Transform, truth: Transform) -> Array:
    turn = Rotation.from_matrix(found.rotation @ truth.rotation.T).as_rotvec()
    return np.concatenate([turn, found.translation - truth.translation])


@pytest.mark.parametrize("camera", [LEFT, WIDE, FISHEYE], ids=lambda one: one.distortion_model)
def test_locate_of_a_view_without_noise_is_exact(camera: CameraModel) -> None:
    found = locate(seen(camera, [NEAR], sigma=0.0)[0], camera)
    assert (found.transform.target, found.transform.source) == ("camera", "target")
    np.testing.assert_allclose(_off(found.transform, NEAR), 0.0, atol=1e-8)
    assert found.rms < 1e-6


@pytest.mark.long
def test_locate_covariance_is_that_of_its_errors() -> None:
    squares = []
    for seed in range(60):
        found = locate(seen(LEFT, [NEAR], sigma=0.1, seed=seed)[0], LEFT)
        off = _off(found.transform, NEAR)
        squares.append(off @ np.linalg.solve(found.covariance, off))
    assert np.mean(squares) == pytest.approx(6.0, abs=1.5)  # chi-square, 3 sigma of the mean


def test_locate_weights_points_by_their_covariance() -> None:
    view = seen(LEFT, [NEAR], sigma=0.0)[0]
    sigma = np.where(np.arange(54) % 2, 3.0, 0.01)
    points = view.points + sigma[:, None] * np.random.default_rng(5).normal(size=(54, 2))
    covariance = sigma[:, None, None] ** 2 * np.eye(2)
    noisy = dataclasses.replace(view, points=points, covariance=covariance)
    assert np.linalg.norm(_off(locate(noisy, LEFT).transform, NEAR)[3:]) < 1e-4
    alike = dataclasses.replace(noisy, covariance=np.tile(np.eye(2), (54, 1, 1)))
    assert np.linalg.norm(_off(locate(alike, LEFT).transform, NEAR)[3:]) > 5e-4


def test_locate_covariance_grows_with_residuals_beyond_the_points_covariance() -> None:
    view = seen(LEFT, [NEAR], sigma=0.2)[0]
    bold = dataclasses.replace(view, covariance=view.covariance * 1e-4)
    ratio = np.diag(locate(bold, LEFT).covariance) / np.diag(locate(view, LEFT).covariance)
    np.testing.assert_allclose(ratio, 1.0, atol=0.5)


def test_locate_of_a_far_plane_reports_the_ambiguity() -> None:
    turn = Rotation.from_euler("xyz", [np.pi - 0.15, 0.1, 0.1]).as_matrix()
    far = Transform("camera", "target", turn, np.array([-0.1, 0.06, 3.0]))
    found = locate(seen(LEFT, [far], sigma=0.2)[0], LEFT)
    assert 0.9 < found.ambiguity <= 1.0
    assert found.other is not None
    best = min((found.transform, found.other), key=lambda one: np.abs(_off(one, far)).max())
    np.testing.assert_allclose(best.translation, far.translation, atol=0.02)


def test_locate_of_a_near_plane_has_one_pose() -> None:
    found = locate(seen(LEFT, [NEAR], sigma=0.05)[0], LEFT)
    assert found.ambiguity < 0.5


def test_locate_of_a_part_of_the_points_uses_their_ids() -> None:
    view = seen(LEFT, [NEAR], sigma=0.0)[0]
    some = np.array([3, 4, 13, 21, 40])
    part = dataclasses.replace(
        view, ids=some, points=view.points[some], covariance=view.covariance[some]
    )
    np.testing.assert_allclose(_off(locate(part, LEFT).transform, NEAR), 0.0, atol=1e-7)


@pytest.mark.parametrize(
    ("changes", "code", "text"),
    [
        ({"ids": [0, 1, 9]}, Code.TOO_FEW, "expected 4 points or more, got 3"),
        ({"ids": [0, 1, 2, 3, 4]}, Code.COLLINEAR, "points that are not on one line, got 5"),
        ({"size": (800, 600)}, Code.WRONG_SIZE, "an image of 640 x 480 pixels, got 800 x 600"),
        ({"points": np.full((54, 2), np.nan)}, Code.NOT_FINITE, "expected finite numbers"),
    ],
)
def test_locate_of_points_that_leave_the_pose_open_raises(
    changes: dict[str, Any], code: Code, text: str
) -> None:
    view = seen(LEFT, [NEAR], sigma=0.0)[0]
    if "ids" in changes:
        some = np.array(changes["ids"])
        changes = {"ids": some, "points": view.points[some], "covariance": view.covariance[some]}
    with pytest.raises(CalibrationError, match=text) as caught:
        locate(dataclasses.replace(view, **changes), LEFT)
    assert caught.value.code == code
    assert "in 00" in str(caught.value)


def test_locate_of_points_that_no_pose_explains_raises() -> None:
    view = seen(LEFT, [NEAR], sigma=0.0)[0]
    points = np.tile([320.0, 240.0], (54, 1))
    with pytest.raises(CalibrationError, match="expected one in front of the camera") as caught:
        locate(dataclasses.replace(view, points=points), LEFT)
    assert caught.value.code == Code.POOR_FIT
    assert len(BOARD.points) == 54


def test_locate_of_exact_rays_survives_the_solver() -> None:
    pose = poses(10, tilt=0.9, distance=0.12)[0]  # for which OpenCV's solver gives NaN
    found = locate(seen(FISHEYE, [pose], sigma=0.0)[0], FISHEYE)
    np.testing.assert_allclose(_off(found.transform, pose), 0.0, atol=1e-7)


# ---------------------------------------------------------------------- projection


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
    from tests.calibration.inside import lens_values, with_lens

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
    found = pixels_by_pose(linearize(near + shift, LEFT).by_point, near)
    for axis, step in enumerate(STEP * np.eye(6)):
        there, back = (
            LEFT.project(
                POINTS @ (exp_rotation(sign * step[:3]) @ rotation).T + shift + sign * step[3:]
            )
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
    found = excess_variance(residuals, sigma[:, None, None] ** 2 * np.eye(2), 4000)
    assert found == pytest.approx(0.04, rel=0.05)


@pytest.mark.parametrize("freedom", [0, 100])
def test_excess_is_zero_if_noise_explains_all(freedom: int) -> None:
    residuals = 0.1 * np.random.default_rng(4).normal(size=(50, 2))
    assert excess_variance(residuals, np.tile(0.01 * np.eye(2), (50, 1, 1)), freedom) == 0.0
