"""Targets in images of ROS-Industrial's, ``test_set_10x10`` and ``test_set_charuco``."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from smartcam.calibration import Charuco, CircleGrid, find_target
from tests.calibration.scenes import off_plane

DATA = os.environ.get("SMARTCAM_DATA")

pytestmark = pytest.mark.long

if DATA is None:
    pytest.skip(
        "needs ROS-Industrial's test_set_10x10 and test_set_charuco (docs/benchmarks.md says where "
        "they are from) in a folder that SMARTCAM_DATA names",
        allow_module_level=True,
    )

DOTS = CircleGrid(columns=10, rows=10, spacing=0.0254, diameter=0.0127, origin_diameter=0.0254)
CHARUCO = Charuco(columns=5, rows=7, square=0.036195, marker=0.018256, dictionary="DICT_6X6_250")


def recorded(folder: str, number: int) -> np.ndarray:
    there = next(Path(str(DATA)).rglob(f"{folder}/images"), Path(str(DATA)) / folder / "images")
    return np.asarray(cv2.imread(str(there / f"{number}.png")))


def test_find_target_of_recorded_dots_has_its_origin_at_the_lower_left() -> None:
    for number in range(15):
        view = find_target(recorded("test_set_10x10", number), DOTS)
        assert view.margin is not None, number
        assert view.margin > 150, number
        assert view.points[9, 0] - view.points[0, 0] > 80, number
        assert view.points[0, 1] - view.points[90, 1] > 80, number
        assert off_plane(view) < 1.0, number


def test_find_target_of_recorded_charuco_has_all_corners() -> None:
    for number in range(16):
        view = find_target(recorded("test_set_charuco", number), CHARUCO)
        assert view.ids.tolist() == list(range(24)), number
        assert off_plane(view) < 1.0, number
