"""Corners of checkerboards, refined."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from drawnkit import STRAIGHT, drawn

from smartcam.calibration.detection.corners import UNREFINED, refine_corners
from smartcam.calibration.detection.image import grey_image
from smartcam.calibration.targets import Checkerboard

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


def test_refine_corners_where_none_is_keeps_its_start_with_a_large_covariance() -> None:
    picture = drawn(BOARD, camera=STRAIGHT)
    u, v = np.rint(picture.pixels[4]).astype(int)
    cv2.rectangle(picture.image, (int(u) - 20, int(v) - 20), (int(u) + 20, int(v) + 20), 128, -1)
    corners = refine_corners(grey_image(picture.image), picture.pixels, WAYS)
    assert np.flatnonzero(~corners.fitted).tolist() == [4]
    np.testing.assert_array_equal(corners.covariance[4], UNREFINED**2 * np.eye(2))
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
