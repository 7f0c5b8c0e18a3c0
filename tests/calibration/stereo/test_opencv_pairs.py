"""OpenCV's 13 pairs of images, from SMARTCAM_PAIRS or Debian's package opencv-doc."""

from __future__ import annotations

import functools
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from smartcam.calibration import TargetView, calibrate_intrinsics, calibrate_stereo, find_target
from tests.calibration.scenes import PAIRS_BOARD, check_pair

FOLDER = Path(os.environ.get("SMARTCAM_PAIRS", "/usr/share/doc/opencv-doc/examples/data"))
NUMBERS = [number for number in range(1, 15) if number != 10]
BOARD = PAIRS_BOARD

pytestmark = pytest.mark.long

if not (FOLDER / "left02.jpg").is_file():
    pytest.skip(
        "needs OpenCV's left01.jpg to right14.jpg: Debian's package opencv-doc, "
        "or SMARTCAM_PAIRS names their folder",
        allow_module_level=True,
    )


@functools.cache
def _views(side: str) -> list[TargetView]:
    images = [cv2.imread(str(FOLDER / f"{side}{n:02d}.jpg"), cv2.IMREAD_GRAYSCALE) for n in NUMBERS]
    return [find_target(np.asarray(image, dtype=np.uint8), BOARD) for image in images]


def _tutorial(side: str) -> list[TargetView]:
    """Return corners refined as in OpenCV's tutorial, in a window of 23 x 23 pixels."""
    views = []
    for number in NUMBERS:
        image = cv2.imread(str(FOLDER / f"{side}{number:02d}.jpg"), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        found, corners = cv2.findChessboardCorners(image, (9, 6))
        assert found
        corners = cv2.cornerSubPix(image, corners, (11, 11), (-1, -1), (3, 30, 1e-3))
        points = corners.reshape(6, 9, 2)[::-1].reshape(-1, 2).astype(np.float64)
        views.append(
            TargetView(
                target=BOARD,
                size=(640, 480),
                ids=np.arange(54),
                points=points,
                covariance=np.tile(0.01 * np.eye(2), (54, 1, 1)),
                name=f"{side}{number:02d}",
            )
        )
    return views


def test_find_target_in_every_pair_has_the_same_origin_in_both() -> None:
    for number in NUMBERS:
        left, right = (
            np.asarray(cv2.imread(str(FOLDER / f"{side}{number:02}.jpg")), dtype=np.uint8)
            for side in ("left", "right")
        )
        check_pair(left, right, f"pair {number}")


def test_pairs_left_out_have_squares_of_a_tenth_of_a_millimetre() -> None:
    found = calibrate_stereo(_views("left"), _views("right"))
    assert found.held_out <= 0.105e-3
    assert found.held_out_epipolar < 0.11
    assert np.linalg.norm(found.transform.translation) == pytest.approx(0.0833, abs=2e-4)


def test_rectified_pairs_lose_an_eighth_of_their_pixels() -> None:
    found = calibrate_stereo(_views("left")[::2], _views("right")[::2], sheet="exact")
    assert found.rectify(0.0).kept == pytest.approx((0.87, 0.87), abs=0.02)
    assert found.rectify(1.0).invalid == pytest.approx((0.21, 0.21), abs=0.03)


def test_lens_of_the_left_camera_is_that_of_opencv() -> None:
    found = calibrate_intrinsics(_views("left"), sheet="exact")
    points = [BOARD.points.astype(np.float32)] * 13
    pixels = [view.points.astype(np.float32) for view in _views("left")]
    _, matrix, *_ = cv2.calibrateCamera(points, pixels, (640, 480), np.eye(3), np.zeros(5))
    np.testing.assert_allclose(found.camera.matrix, matrix, atol=1.0)


def test_corners_of_the_tutorial_have_bad_points_in_left02() -> None:
    found = calibrate_intrinsics(_tutorial("left"), sheet="exact")
    assert found.bad_views == ()  # its other points are as good as those of the other pairs
    assert "0 in left02 (6.3" in found.warnings[0].text
