"""Find out how a camera's results are interpreted: by what interpreter, in which frame and unit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam._client._inside import (
    camera_interpreter,
    has_pixel_positions,
    localizations_of,
    name_if_poseless,
)
from smartcam.interpreters import resolve

if TYPE_CHECKING:
    from smartcam._client._inside import Interpretation
    from smartcam.camera import Camera
    from smartcam.models import Localization, Result
    from smartcam.settings import Address


def interpretation_of(camera: Camera[Any]) -> Interpretation:
    """Return the camera's interpretation, which holds unless a trigger asks for another one."""
    return camera._default  # noqa: SLF001 - smartcam's own


def address_of(camera: Camera[Any]) -> Address:
    """Return the address of the camera itself, even if an agent of a fleet is connected to it."""
    return camera._camera_address  # noqa: SLF001 - smartcam's own


def calibrations_by_application(setting: Any) -> dict[int | None, Any]:
    """Return the calibrations of the setting ``calibration``; None is the key for all others."""
    if hasattr(setting, "items") and not hasattr(setting, "to_robot"):
        return {number: value for number, value in setting.items() if value is not None}
    return {} if setting is None else {None: setting}


def calibration_of(setting: Any, application: int) -> Any:
    """Return an application's calibration of the setting ``calibration``; None without one."""
    calibrations = calibrations_by_application(setting)
    return calibrations.get(application, calibrations.get(None))


def robot_frame_of(calibration: Any) -> str:
    """Return the frame of a calibration's poses; empty if the calibration has no name for it."""
    frame = getattr(calibration, "robot_frame", None) or getattr(calibration, "frame", None)
    return frame if isinstance(frame, str) else ""


def is_calibrated(camera: Camera[Any], application: int) -> bool:
    """Return True if an application has a calibration to a robot's frame."""
    return calibration_of(camera.settings.calibration, application) is not None


def localizations_in_metres(
    camera: Camera[Any], result: Result[Any], spec: str | None = None
) -> list[Localization] | None:
    """Return a result's localizations; None if it has none, or they are in pixels.

    Args:
        camera: the camera.
        result: a result of the camera.
        spec: name of the interpreter of the result; None for the camera's own.
    """
    parts = localizations_of(result.value)
    if parts is None or is_calibrated(camera, result.application):
        return parts
    reader = camera_interpreter(camera, result.application) if spec is None else resolve(spec)
    if has_pixel_positions(reader):
        return None
    # an empty list may be one of texts or records, from an interpreter without poses
    is_other_list = not parts and reader is not None and name_if_poseless(reader) is not None
    return None if is_other_list else parts
