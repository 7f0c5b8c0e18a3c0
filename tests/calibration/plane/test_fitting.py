from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from smartcam import CalibrationError
from smartcam.geometry._inside import Array
from tests.calibration.inside import (
    MODELS,
    ModelName,
    Normalization,
    Pairs,
    apply_homography,
    element_derivatives,
    fit,
    held_out,
)
from tests.calibration.plane.planekit import GRID, SPECIAL, Scene, grid

SCENE = Scene(SPECIAL[3], np.array([1.0, -2.0, 0.5]))
NAMES: list[ModelName] = ["rigid", "similarity", "affine", "homography"]
WEIGHTS = np.array([1.0, 4.0, 1.0, 0.25, 1.0, 2.0, 1.0, 1.0, 9.0])


def noisy(weights: Array | None = None, marks: Array = GRID) -> Pairs:
    touched = SCENE.touched(marks, 1, 0.01) - SCENE.origin
    return Pairs(marks, touched, np.ones(len(marks)) if weights is None else weights)


def tilted() -> Pairs:
    matrix = np.concatenate([SCENE.turn[:, [0, 1, 2]] * [1.0, 1.1, 0.0], [[0.3, -0.2, 1.0]]])
    matrix[:3, 2] = SCENE.turn[:, 0] * 0.05
    return Pairs(GRID, apply_homography(matrix, GRID), np.ones(9))


def test_fit_similarity_equals_opencv() -> None:
    pairs = noisy()
    flat = np.column_stack([pairs.camera, np.zeros(9)])
    theirs, scale = cv2.estimateAffine3D(flat, pairs.robot, force_rotation=True)
    matrix = fit("similarity", pairs).matrix
    assert matrix[:3, :2] == pytest.approx(scale * theirs[:, :2], abs=1e-12)
    assert matrix[:3, 2] == pytest.approx(theirs[:, 3], abs=1e-12)


def test_fit_rigid_with_weights_equals_scipy() -> None:
    pairs = noisy(WEIGHTS)
    near = pairs.camera - np.average(pairs.camera, axis=0, weights=WEIGHTS)
    far = pairs.robot - np.average(pairs.robot, axis=0, weights=WEIGHTS)
    theirs, _ = Rotation.align_vectors(far, np.column_stack([near, np.zeros(9)]), weights=WEIGHTS)
    ours = fit("rigid", pairs, 1.0).matrix
    assert ours[:3, :2] == pytest.approx(theirs.as_matrix()[:, :2], abs=1e-9)


def test_fit_affine_equals_linear_regression() -> None:
    pairs = noisy()
    expected = np.linalg.lstsq(pairs.homogeneous, pairs.robot, rcond=None)[0].T
    assert fit("affine", pairs).matrix[:3] == pytest.approx(expected, abs=1e-12)


def test_fit_homography_equals_scipy_least_squares() -> None:
    pairs = noisy(WEIGHTS)

    def residuals(elements: Array) -> Array:
        matrix = np.append(elements, 1.0).reshape(4, 3)
        weighted: Array = np.sqrt(WEIGHTS)[:, None] * (
            pairs.robot - apply_homography(matrix, pairs.camera)
        )
        return weighted.ravel()

    fitted = fit("homography", pairs)
    start = fitted.matrix.ravel()[:11] + 0.01
    theirs = least_squares(residuals, start, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    # SciPy's has numerical derivatives, and the limits of the oldest SciPy
    assert fitted.matrix.ravel()[:11] == pytest.approx(theirs.x, abs=1e-6)
    assert (residuals(fitted.matrix.ravel()[:11]) ** 2).sum() == pytest.approx(2 * theirs.cost)


def test_fit_homography_without_noise_is_exact() -> None:
    assert fit("homography", tilted()).residuals == pytest.approx(np.zeros((9, 3)), abs=1e-14)


@pytest.mark.parametrize("seed", [82, 113, 332])
def test_fit_homography_whose_horizon_runs_into_the_points_raises(seed: int) -> None:
    random, marks = np.random.default_rng(seed), (grid(3, 2) - (0.15, 0.12)) / 0.15
    touched = np.column_stack([marks, np.zeros(6)]) + 0.4 * random.normal(size=(6, 3))
    pairs = Pairs(marks, touched - touched.mean(axis=0), np.ones(6))
    with pytest.raises(CalibrationError, match="determine all 11 parameters") as caught:
        fit("homography", pairs)
    assert caught.value.code == "COLLINEAR"


@pytest.mark.parametrize("name", NAMES)
def test_fit_covariance_equals_numerical_derivatives(name: ModelName) -> None:
    pairs = noisy(WEIGHTS)
    fitted = fit(name, pairs)
    tangent = MODELS[name].tangent(fitted.matrix)
    columns = []
    for direction in tangent.T.reshape(-1, 4, 3):
        ahead, behind = (fitted.matrix + step * direction for step in (1e-6, -1e-6))
        columns.append(
            (apply_homography(ahead, GRID) - apply_homography(behind, GRID)).ravel() / 2e-6
        )
    jacobian = np.column_stack(columns)
    information = jacobian.T @ (np.repeat(WEIGHTS, 3)[:, None] * jacobian)
    expected = tangent @ np.linalg.inv(information) @ tangent.T
    assert fitted.unit_covariance == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert fitted.freedom == 27 - MODELS[name].parameters


@pytest.mark.parametrize("weights", [None, WEIGHTS])
@pytest.mark.parametrize("name", NAMES)
def test_held_out_equals_a_new_fit(name: ModelName, weights: Array | None) -> None:
    pairs = noisy(weights)
    found = held_out(fit(name, pairs), pairs)
    for index in range(9):
        others = fit(name, pairs.leave_out(index)).matrix
        expected = pairs.robot[index] - apply_homography(others, pairs.camera[index : index + 1])[0]
        assert found[index] == pytest.approx(expected, abs=1e-8)  # the limit of rounding


def test_held_out_of_many_points_nearly_equals_a_new_fit() -> None:
    pairs = noisy(marks=grid(15, 15))
    found = held_out(fit("homography", pairs), pairs)
    others = fit("homography", pairs.leave_out(0)).matrix
    expected = pairs.robot[0] - apply_homography(others, pairs.camera[:1])[0]
    assert found[0] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("name", NAMES)
def test_held_out_of_the_fewest_points_is_none(name: ModelName) -> None:
    few = MODELS[name].min_points
    pairs = noisy(marks=grid(2, 2)[:few])
    assert np.isnan(held_out(fit(name, pairs), pairs)).all()


@pytest.mark.parametrize("name", ["similarity", "affine"])
def test_held_out_of_the_one_point_beside_a_line_is_none(name: ModelName) -> None:
    pairs = noisy(marks=np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0], [0.1, 0.2]]))
    missing = np.isnan(held_out(fit(name, pairs), pairs)).any(axis=1)
    assert missing.tolist() == [False, False, False, True]


def test_held_out_of_a_homography_is_none_where_the_others_lie_in_a_line() -> None:
    marks = np.array([[0, 0], [0.1, 0], [0.2, 0], [0.1, 0.2], [0.2, 0.2]])
    pairs = noisy(marks=marks)
    missing = np.isnan(held_out(fit("homography", pairs), pairs)).any(axis=1)
    assert missing.tolist() == [False, False, False, True, True]


def test_fit_homography_of_points_in_a_line_raises() -> None:
    marks = np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0], [0.3, 0.0], [0.1, 0.2]])
    with pytest.raises(CalibrationError, match="determine all 11 parameters") as caught:
        fit("homography", noisy(marks=marks))
    assert caught.value.code == "COLLINEAR"


def test_sensitivity_equals_numerical_derivatives() -> None:
    matrix = fit("homography", tilted()).matrix
    found = element_derivatives(matrix, GRID)
    for element in range(12):
        step = np.zeros(12)
        step[element] = 1e-6
        ahead, behind = (matrix + sign * step.reshape(4, 3) for sign in (1, -1))
        expected = (apply_homography(ahead, GRID) - apply_homography(behind, GRID)) / 2e-6
        assert found[:, :, element] == pytest.approx(expected, abs=1e-8)


def test_frame_outward_and_inward_undo_each_other() -> None:
    frame = Normalization(np.array([320.0, 240.0]), 150.0, np.array([1.0, -2.0, 0.5]), 0.2)
    matrix = fit("homography", tilted()).matrix
    outward = frame.to_original(matrix)
    mapped = apply_homography(outward, frame.camera_centre + frame.camera_size * GRID)
    assert mapped == pytest.approx(
        frame.robot_centre + frame.robot_size * apply_homography(matrix, GRID)
    )
    assert frame.to_normalized(outward) == pytest.approx(matrix, abs=1e-12)
