"""Refine corners of checkerboards, and dots."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from smartcam.calibration import CameraModel, Checkerboard, CircleGrid, find_target
from smartcam.calibration._detection.dots import UNREFINED_SIGMA_PX as UNREFINED_DOT
from smartcam.calibration._detection.dots import GridMap, refine_dots
from smartcam.geometry._inside import Code
from tests.calibration.inside import (
    UNREFINED_SIGMA_PX,
    apply_homography,
    fit_homography,
    grey_image,
    refine_corners,
)
from tests.calibration.scenes import BENT, STRAIGHT, drawn, facing, refused

BOARD = Checkerboard(columns=9, rows=6, square=0.025)
STEP = 600 * 0.025 / 0.45
WAYS = 0.45 * STEP * np.tile(np.array([[1.0, 0.0], [0.0, -1.0]]), (54, 1, 1))


def bound(noise: float, blur: float, contrast: float, half: int) -> float:
    """Return the least standard deviation of a coordinate, pixels, of two upright edges.

    With unknown angles, blur, gain and offset, from all pixels of a square window.
    """
    span = np.arange(-half, half + 1)
    y, x = (side.ravel() for side in np.meshgrid(span, span, indexing="ij"))
    # the slope of erf(x / (sqrt(2) blur)), and the edges' saturated shape beside it
    slope = np.sqrt(2 / np.pi) / blur * np.exp(-(np.arange(-half, half + 1) ** 2) / (2 * blur**2))
    shape = np.cumsum(slope) - slope / 2
    shape -= shape[half]
    across, down = np.meshgrid(shape, shape)
    by_x, by_y = np.meshgrid(slope, slope)
    first, second = (by_x * down).ravel(), (by_y * across).ravel()
    product = (across * down).ravel()
    columns = [first, second, first * y, second * x, first * x + second * y]
    jacobian = np.array([contrast / 2 * one for one in columns] + [product, np.ones(x.size)])
    return float(noise * np.sqrt(np.linalg.inv(jacobian @ jacobian.T)[0, 0]))


@pytest.mark.parametrize(
    ("noise", "blur"),
    [(1.0, 0.7), *(pytest.param(one, 1.5, marks=pytest.mark.long) for one in (2.0, 5.0))],
)
def test_refine_corners_errors_are_near_the_bound(noise: float, blur: float) -> None:
    squares = []
    for away in (0.45, 0.46, 0.47):
        picture = drawn(BOARD, camera=STRAIGHT, roll=1.0, away=away, blur=blur, noise=noise)
        corners = refine_corners(grey_image(picture.image), np.rint(picture.pixels), WAYS)
        assert corners.fitted.all()
        squares.append((corners.points - picture.pixels) ** 2)
    # a pixel's own square blurs, too; its window is cut to 13 pixels to each side
    least = bound(noise, np.hypot(blur, np.sqrt(1 / 12)), 180, 13)
    assert np.sqrt(np.mean(squares)) < 1.15 * least


def test_refine_corners_gains_are_positive_between_the_two_ways() -> None:
    picture = drawn(BOARD, camera=STRAIGHT)
    gains = refine_corners(grey_image(picture.image), picture.pixels, WAYS).gains.reshape(6, 9)
    assert gains[0, 0] == pytest.approx(90, abs=1)
    assert gains[0, 1] == pytest.approx(-90, abs=1)
    assert gains[1, 1] == pytest.approx(90, abs=1)


def test_refine_corners_without_a_corner_keeps_its_start_with_a_large_covariance() -> None:
    picture = drawn(BOARD, camera=STRAIGHT)
    u, v = np.rint(picture.pixels[4]).astype(int)
    cv2.rectangle(picture.image, (int(u) - 20, int(v) - 20), (int(u) + 20, int(v) + 20), 128, -1)
    corners = refine_corners(grey_image(picture.image), picture.pixels, WAYS)
    assert np.flatnonzero(~corners.fitted).tolist() == [4]
    np.testing.assert_array_equal(corners.covariance[4], UNREFINED_SIGMA_PX**2 * np.eye(2))
    assert np.linalg.norm(corners.points[4] - picture.pixels[4]) < 6


def test_refine_corners_in_noise_alone_fits_none() -> None:
    noise = np.random.default_rng(3).integers(0, 255, size=(480, 640), dtype=np.uint8)
    points = drawn(BOARD, camera=STRAIGHT).pixels
    assert not refine_corners(grey_image(noise), points, WAYS).fitted.any()


def test_refine_corners_at_the_rim_uses_the_pixels_that_are_there() -> None:
    picture = drawn(BOARD, camera=STRAIGHT)
    corner = np.floor(picture.pixels.min(axis=0)).astype(int) - 4
    cut = np.ascontiguousarray(picture.image[corner[1] :, corner[0] :])
    corners = refine_corners(grey_image(cut), picture.pixels - corner, WAYS)
    assert corners.fitted.all()
    assert np.abs(corners.points + corner - picture.pixels).max() < 0.01


# ----------------------------------------------------------------------
# Refined dots, and the shift of their middles by perspective.


GRID = CircleGrid(columns=8, rows=6, spacing=0.03, diameter=0.02)
FLAT = GRID.points[:, :2]


def ellipse_shift(matrix: np.ndarray, x: float, y: float, radius: float) -> np.ndarray:
    """Return the shift of a circle's image against its centre's, by its dual conic."""
    centre = np.array([x, y, 1.0])
    dual = radius**2 * np.diag([1.0, 1.0, 0.0]) - np.outer(centre, centre)
    seen = matrix @ dual @ matrix.T
    middle = matrix @ centre
    return np.asarray(seen[:2, 2] / seen[2, 2] - middle[:2] / middle[2])


def test_grid_map_shift_without_distortion_is_that_of_the_conic() -> None:
    picture = drawn(GRID, camera=STRAIGHT, tilt=40)
    matrix = fit_homography(FLAT, picture.pixels)
    assert matrix is not None
    shifts = GridMap(FLAT, picture.pixels).shifts(FLAT, np.full(48, 0.02))
    exact = [ellipse_shift(matrix, x, y, 0.01) for x, y in FLAT]
    np.testing.assert_allclose(shifts, exact, atol=1e-4)
    assert np.linalg.norm(shifts, axis=1).max() > 0.2


def test_grid_map_follows_the_bend_of_a_lens() -> None:
    picture = drawn(GRID, camera=BENT, tilt=20)
    matrix = fit_homography(FLAT, picture.pixels)
    assert matrix is not None
    straight = np.abs(apply_homography(matrix, FLAT) - picture.pixels).max()
    bent = np.abs(GridMap(FLAT, picture.pixels)(FLAT) - picture.pixels).max()
    assert straight > 0.5
    assert bent < 0.1


def test_grid_map_of_few_points_is_a_homography() -> None:
    flat = FLAT[[0, 3, 7, 16, 24, 40, 44, 47]]
    seen = GridMap(flat, 1000 * flat + 100)
    np.testing.assert_allclose(seen(FLAT), 1000 * FLAT + 100, atol=1e-6)


def test_refine_dots_has_middles_areas_and_covariance() -> None:
    picture = drawn(GRID, camera=STRAIGHT, noise=3)
    ways = 600 / 0.45 * np.tile(np.array([[1.0, 0.0], [0.0, -1.0]]), (48, 1, 1))
    dots = refine_dots(
        grey_image(picture.image), np.rint(picture.pixels), 0.008 * ways, 0.0125 * ways
    )
    assert dots.fitted.all()
    off = dots.points - picture.pixels
    assert np.abs(off).max() < 0.05
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(dots.covariance), off)
    assert 0.5 < squares.mean() / 2 < 1.5
    np.testing.assert_allclose(dots.areas, np.pi * (0.01 / 0.45) ** 2 * 600 * 602, rtol=0.01)


def test_refine_dots_without_a_dot_keeps_its_start() -> None:
    empty = grey_image(np.full((480, 640), 200, dtype=np.uint8))
    ways = np.tile(10 * np.eye(2), (2, 1, 1))
    start = np.array([[100.25, 90.0], [300.0, 200.5]])
    dots = refine_dots(empty, start, ways, 1.5 * ways)
    assert not dots.fitted.any()
    np.testing.assert_array_equal(dots.points, start)
    np.testing.assert_array_equal(dots.covariance[1], UNREFINED_DOT**2 * np.eye(2))
    np.testing.assert_allclose(dots.areas, np.pi * 100)


@pytest.mark.parametrize("tilt", [0, 30, 50])
def test_ellipse_shift_grows_with_the_tilt(tilt: int) -> None:
    pose = facing(GRID, tilt)
    points = GRID.points @ pose.rotation.T + pose.translation
    shifts = GridMap(FLAT, STRAIGHT.project(points)).shifts(FLAT, np.full(48, 0.02))
    low, high = {0: (0.0, 0.01), 30: (0.1, 0.5), 50: (0.2, 2.0)}[tilt]
    assert low <= np.linalg.norm(shifts, axis=1).max() < high


@pytest.mark.long
def test_refine_dots_of_large_dots_is_as_exact() -> None:
    large = CameraModel(size=(1280, 960), matrix=np.diag([2, 2, 1]) @ STRAIGHT.matrix)
    few = CircleGrid(columns=4, rows=3, spacing=0.06, diameter=0.045)
    picture = drawn(few, camera=large, tilt=20, noise=3, blur=1.5)
    view = find_target(picture.image, few)
    assert picture.off(view).max() < 0.1
    assert 0.001 < np.median(view.sigmas) < 0.02


def test_circle_grid_with_dots_that_touch_is_refused() -> None:
    with refused(Code.SHAPE, "dots that do not touch each other at a distance of 0.02 m", "0.0205"):
        CircleGrid(columns=5, rows=4, spacing=0.02, diameter=0.015, origin_diameter=0.026)
    CircleGrid(columns=5, rows=4, spacing=0.02, diameter=0.01, origin_diameter=0.02)
