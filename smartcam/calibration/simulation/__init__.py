"""Make images and scenes with known truth, for tests."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.calibration.simulation._images import render
    from smartcam.calibration.simulation._scenes import around, hand_eye_scene, view

__all__ = [
    "around",
    "hand_eye_scene",
    "render",
    "view",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_images": "render",
            "_scenes": "around hand_eye_scene view",
        },
    )
