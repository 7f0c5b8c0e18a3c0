"""How a camera's results are read, for what has to know that before they can be said to ROS."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam._client.interpretation import without_poses
from smartcam.interpreters._base import resolve
from smartcam.layout._text import UNITS
from smartcam.ros2._messages import localizations_of

if TYPE_CHECKING:
    from smartcam.camera import Camera
    from smartcam.interpreters._base import Interpreter
    from smartcam.models import Localization, Result


def own_interpreter(camera: Camera[Any], application: int | None) -> Interpreter | None:
    """Return what reads a camera's results, None where nothing is known of the application."""
    way = camera._default._way(application)  # noqa: SLF001 - smartcam's own
    return None if way is None else way.interpreter


def in_pixels(interpreter: Interpreter | None) -> bool:
    """Return whether places are read as pixels, which no message of ROS in metres may have."""
    layout = None if interpreter is None else interpreter.layout
    return layout is not None and any(
        field.unit is not None and UNITS[field.unit].quantity == "pixels"
        for field in layout.fields
        if field.name in {"x", "y", "z"}
    )


def calibrated(camera: Camera[Any], application: int) -> bool:
    """Return whether a calibration brings an application's localizations into a robot's frame."""
    given = camera.settings.calibration
    if hasattr(given, "items") and not hasattr(given, "to_robot"):
        given = given.get(application)
    return given is not None


def localizations_in_metres(
    camera: Camera[Any], result: Result[Any], spec: str | None = None
) -> list[Localization] | None:
    """Return a result's localizations; None where it has none, or has them in pixels.

    Args:
        camera: whose.
        result: of it.
        spec: how it was read; None: as the camera's always are.
    """
    parts = localizations_of(result.value)
    if parts is None or calibrated(camera, result.application):
        return parts
    reader = own_interpreter(camera, result.application) if spec is None else resolve(spec)
    if in_pixels(reader):
        return None
    other = not parts and reader is not None and without_poses(reader) is not None
    return None if other else parts  # an empty list may be of texts, or of records
