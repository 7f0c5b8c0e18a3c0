from __future__ import annotations

import numpy as np
import pytest
from lenskit import FISHEYE, LEFT, RIG, RIGHT

from smartcam.calibration.geometry.rotations import Array
from smartcam.calibration.stereo.triangulation import epipolar_distances, triangulate

POINTS = np.array(
    [[0.05, -0.04, 0.4], [-0.1, 0.08, 0.5], [0.0, 0.0, 0.3], [0.12, 0.1, 0.6], [0.1, -0.1, 1.5]]
)
Both = tuple[Array, Array]


def _seen(points: Array) -> Both:
    return LEFT.project(points), RIGHT.project(RIG.apply(points))


def _alike(count: int, sigma: float = 1.0) -> Both:
    each = np.tile(sigma**2 * np.eye(2), (count, 1, 1))
    return each, each


def test_triangulate_of_exact_pixels_gives_the_points() -> None:
    found = triangulate(LEFT, RIGHT, RIG, _seen(POINTS), _alike(5))
    np.testing.assert_allclose(found.points, POINTS, atol=1e-9)


def test_triangulate_of_fisheyes_gives_the_points() -> None:
    pixels = FISHEYE.project(POINTS), FISHEYE.project(RIG.apply(POINTS))
    found = triangulate(FISHEYE, FISHEYE, RIG, pixels, _alike(5))
    np.testing.assert_allclose(found.points, POINTS, atol=1e-9)


def test_triangulate_covariance_is_that_of_its_errors() -> None:
    random, sigma = np.random.default_rng(1), 0.2
    many = np.tile(POINTS[:1], (2000, 1))
    left, right = _seen(many)
    pixels = (
        left + sigma * random.normal(size=left.shape),
        right + sigma * random.normal(size=right.shape),
    )
    found = triangulate(LEFT, RIGHT, RIG, pixels, _alike(2000, sigma))
    np.testing.assert_allclose(
        np.cov((found.points - many).T), found.covariance[0], rtol=0.1, atol=1e-9
    )


def test_triangulate_trusts_the_sharper_pixel() -> None:
    left, right = _seen(POINTS)
    blurred = right + np.array([0.0, 3.0])
    wide, narrow = _alike(5, 3.0)[0], _alike(5, 0.01)[0]
    found = triangulate(LEFT, RIGHT, RIG, (left, blurred), (narrow, wide)).points
    np.testing.assert_allclose(LEFT.project(found), left, atol=0.001)
    other = triangulate(LEFT, RIGHT, RIG, (left, blurred), (wide, narrow)).points
    assert np.abs(LEFT.project(other) - left).max() > 1.0


def test_triangulate_of_rays_that_part_gives_nan_alone() -> None:
    left, right = _seen(POINTS)
    right[1, 0] += 300.0
    found = triangulate(LEFT, RIGHT, RIG, (left, right), _alike(5))
    np.testing.assert_array_equal(
        np.isnan(found.points).any(axis=1), [False, True, False, False, False]
    )
    assert np.isnan(found.covariance[1]).all()
    np.testing.assert_allclose(found.points[2:], POINTS[2:], atol=1e-9)


def test_triangulate_of_no_points_gives_none() -> None:
    nothing = np.zeros((0, 2))
    found = triangulate(LEFT, RIGHT, RIG, (nothing, nothing), _alike(0))
    assert found.points.shape == (0, 3)


def test_epipolar_distances_of_partners_are_zero() -> None:
    found = epipolar_distances(LEFT, RIGHT, RIG, _seen(POINTS))
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


def test_epipolar_distances_are_what_a_pixel_is_off_across_the_line() -> None:
    left, right = _seen(POINTS[2:3])
    found = epipolar_distances(LEFT, RIGHT, RIG, (left, right + np.array([0.0, 1.0])))
    assert found[0] == pytest.approx([1.0, 1.0], abs=0.1)
    along = epipolar_distances(LEFT, RIGHT, RIG, (left, right + np.array([1.0, 0.0])))
    assert along.max() < 0.1
