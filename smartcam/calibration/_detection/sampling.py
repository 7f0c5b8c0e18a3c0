"""Interpolate grey levels between pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from smartcam.calibration._detection.image import GreyImage
    from smartcam.geometry._inside import Array


def mean_level(image: GreyImage, points: Array) -> float:
    """Return the mean grey level at points (N, 2); the image's rim is continued outside."""
    cv2 = load("cv2")
    coordinates = points.astype(np.float32)[None]
    levels = cv2.remap(
        image.levels, coordinates, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return float(levels.mean())
