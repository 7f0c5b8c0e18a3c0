"""A flat target as a camera without distortion sees it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration.optional_imports import load

if TYPE_CHECKING:
    from smartcam.calibration.geometry.rotations import Array

__all__ = ["apply_homography", "fit_homography", "local_steps"]


def fit_homography(flat: Array, pixels: Array) -> Array | None:
    """Return the (3, 3) matrix from points of a plane to pixels; None where nothing fits.

    Args:
        flat: (N, 2), at least four of them, metres.
        pixels: (N, 2).
    """
    cv2 = load("cv2")
    found = cv2.findHomography(flat, pixels)[0]
    return None if found is None else np.array(found, dtype=np.float64)


def apply_homography(matrix: Array, points: Array) -> Array:
    """Return where points (N, 2) are mapped to, (N, 2)."""
    mapped = points @ matrix[:, :2].T + matrix[:, 2]
    flat: Array = mapped[:, :2] / mapped[:, 2:]
    return flat


def local_steps(matrix: Array, points: Array, step: float) -> Array:
    """Return how far ``step`` along x and along y leads in the image.

    Args:
        matrix: (3, 3), from the plane to pixels.
        points: (N, 2), on the plane.
        step: in the plane's unit.

    Returns:
        (N, 2, 2): for each point the way along x and the way along y, pixels.
    """
    ways = [
        (apply_homography(matrix, points + way) - apply_homography(matrix, points - way)) / 2
        for way in step * np.eye(2)
    ]
    return np.stack(ways, axis=1)
