"""How a camera's results are read, for what has to know that before they can be said to ROS."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.interpreters._base import resolve
from smartcam.layout._text import UNITS

if TYPE_CHECKING:
    from smartcam.camera import Camera
    from smartcam.interpreters._base import Interpreter


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


def says_metres(camera: Camera[Any], application: int, spec: object = None) -> bool:
    """Return whether localizations of an application are in metres.

    Args:
        camera: whose.
        application: its id.
        spec: how they are read; None: as the camera's always are.
    """
    if calibrated(camera, application):
        return True
    reader = own_interpreter(camera, application) if spec is None else resolve(spec)
    return not in_pixels(reader)
