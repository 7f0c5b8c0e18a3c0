"""Make images and scenes with known truth, for tests."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.calibration.simulation._images import render
    from smartcam.calibration.simulation._scenes import hand_eye_scene, poses_around, view

__all__ = [
    "hand_eye_scene",
    "poses_around",
    "render",
    "view",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_images": "render",
            "_scenes": "poses_around hand_eye_scene view",
        },
    )
