"""From what a camera sees to where a robot goes.

::

    calibration = fit_plane(camera_points, robot_points, touch_sigma=0.0002)
    result = await camera.trigger()
    for part in calibration.to_robot(result.value):
        ...

:func:`fit_plane` takes points that both have seen, :func:`fit_touches` the origin mark and touches
of the sheet's rays. What begins with images is in :mod:`smartcam.calibration.imaging`; its four
main functions can be taken from here, too. The room knows points and poses, no sockets. It needs
the extra ``calibration``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from smartcam.calibration.codes import Code, Remark
from smartcam.calibration.plane import Drift, PlaneCalibration, fit_plane
from smartcam.calibration.touches import fit_touches

if TYPE_CHECKING:
    from smartcam.calibration.imaging import (
        calibrate_hand_eye,
        calibrate_intrinsics,
        calibrate_stereo,
        find_target,
    )

__all__ = [
    "Code",
    "Drift",
    "PlaneCalibration",
    "Remark",
    "calibrate_hand_eye",
    "calibrate_intrinsics",
    "calibrate_stereo",
    "find_target",
    "fit_plane",
    "fit_touches",
]

_FROM_IMAGES = frozenset(
    {"calibrate_hand_eye", "calibrate_intrinsics", "calibrate_stereo", "find_target"}
)


def __getattr__(name: str) -> Any:
    if name not in _FROM_IMAGES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module("smartcam.calibration.imaging"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
