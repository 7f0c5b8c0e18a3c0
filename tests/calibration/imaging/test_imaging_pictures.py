"""Targets in real images: OpenCV's pairs with odd numbers, which are here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from imaging_scenes import check_pair

ODD_PAIRS = Path(__file__).parents[2] / "data" / "opencv_pairs"


def test_find_target_in_a_pair_has_the_same_origin_in_both() -> None:
    for number in range(1, 15, 2):
        left, right = (
            np.asarray(cv2.imread(str(ODD_PAIRS / f"{side}{number:02}.jpg")), dtype=np.uint8)
            for side in ("left", "right")
        )
        check_pair(left, right, f"pair {number}")
