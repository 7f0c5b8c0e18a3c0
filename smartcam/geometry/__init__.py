"""Values that several packages share: motions between coordinate frames, and a camera's lens.

Calibrations find these values; the packages ``frames``, ``depth``, ``fleet`` and ``ros2`` use them
without a calibration. Frames are right-handed, lengths are metres, and quaternions are Hamilton's
``x, y, z, w``. :mod:`smartcam.calibration` exports the same classes.
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
