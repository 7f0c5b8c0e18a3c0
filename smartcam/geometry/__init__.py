"""Values that several packages share: motions between frames, and the lens of a camera.

Calibrations find these values; frames, depth, the fleet and ROS use them without a calibration.
Right-handed frames, metres, Hamilton quaternions ``x, y, z, w``. :mod:`smartcam.calibration` gives
the same names to those who calibrate.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.geometry._camera_model import CameraModel
    from smartcam.geometry._places import PlacePattern
    from smartcam.geometry._transforms import PoseHistory, Transform

__all__ = ["CameraModel", "PlacePattern", "PoseHistory", "Transform"]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_camera_model": "CameraModel",
            "_places": "PlacePattern",
            "_transforms": "PoseHistory Transform",
        },
    )
