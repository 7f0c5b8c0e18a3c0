"""Targets in real images, where they are on this computer.

OpenCV's pairs with odd numbers are here; the others, ``left02.jpg`` to ``right14.jpg``, are looked
for where SMARTCAM_PAIRS says or Debian's package opencv-doc puts them. SMARTCAM_DATA has
ROS-Industrial's ``test_set_10x10`` and ``test_set_charuco`` under it.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from smartcam.calibration.imaging.detection import find_target
from smartcam.calibration.imaging.homography import apply_homography, fit_homography
from smartcam.calibration.imaging.targets import Charuco, Checkerboard, CircleGrid

if TYPE_CHECKING:
    from smartcam.calibration.imaging.views import TargetView

PAIRS = Path(os.environ.get("SMARTCAM_PAIRS", "/usr/share/doc/opencv-doc/examples/data"))
ODD_PAIRS = Path(__file__).parents[2] / "data" / "opencv_pairs"
DATA = os.environ.get("SMARTCAM_DATA")

BOARD = Checkerboard(columns=9, rows=6, square=0.025)
DOTS = CircleGrid(
    columns=10, rows=10, spacing=0.0254, diameter=0.0127, origin_diameter=0.0254
)  # fmt: skip
CHARUCO = Charuco(
    columns=5, rows=7, square=0.036195, marker=0.018256, dictionary="DICT_6X6_250"
)  # fmt: skip


def image(path: Path) -> np.ndarray:
    if not path.is_file():
        pytest.skip(f"{path.name} is not in {path.parent}")
    return np.asarray(cv2.imread(str(path)))


def recorded(folder: str, number: int) -> np.ndarray:
    if DATA is None:
        pytest.skip("SMARTCAM_DATA names no folder with ROS-Industrial's images")
    there = next(Path(DATA).rglob(f"{folder}/images"), Path(DATA) / folder / "images")
    return image(there / f"{number}.png")


def off_plane(view: TargetView) -> float:
    """Return the rms distance of points from a flat sheet seen without distortion, pixels."""
    flat = view.object_points[:, :2]
    matrix = fit_homography(flat, view.points)
    assert matrix is not None
    off = apply_homography(matrix, flat) - view.points
    return float(np.sqrt((off**2).sum(axis=1).mean()))


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14])
def test_find_target_in_a_pair_has_the_same_origin_in_both(number: int) -> None:
    folder = ODD_PAIRS if number % 2 else PAIRS
    left = find_target(image(folder / f"left{number:02}.jpg"), BOARD)
    right = find_target(image(folder / f"right{number:02}.jpg"), BOARD)
    apart = left.points - right.points
    # the cameras stand side by side: rows agree, columns differ alike
    assert np.ptp(apart[:, 1]) < 40
    assert (apart[:, 0] > 60).all()
    assert np.median(left.sigmas) < 0.03
    assert off_plane(left) < 4


@pytest.mark.parametrize("number", range(15))
def test_find_target_of_recorded_dots_has_its_origin_at_the_lower_left(number: int) -> None:
    view = find_target(recorded("test_set_10x10", number), DOTS)
    assert view.margin is not None
    assert view.margin > 150
    assert view.points[9, 0] - view.points[0, 0] > 80
    assert view.points[0, 1] - view.points[90, 1] > 80
    assert off_plane(view) < 1.0


@pytest.mark.parametrize("number", range(16))
def test_find_target_of_recorded_charuco_has_all_corners(number: int) -> None:
    view = find_target(recorded("test_set_charuco", number), CHARUCO)
    assert view.ids.tolist() == list(range(24))
    assert off_plane(view) < 1.0
