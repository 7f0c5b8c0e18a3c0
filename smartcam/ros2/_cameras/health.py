"""Convert a camera's health to ROS: its status, and its diagnostics.

A node publishes the health of its camera, a bag the health of a recorded camera.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import SmartCamError
from smartcam.models import Status
from smartcam.ros2._cameras.messages import EPOCH, utf8

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from datetime import datetime

    from smartcam.camera import Camera
    from smartcam.settings import Address

STATUS_TYPE = "smartcam_msgs/msg/CameraStatus"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

MAX_ERROR_CHARACTERS = 1000
"""Largest number of characters of an error in a message; a longer one is cut."""

OK, WARN, ERROR, STALE = range(4)
"""Levels of ``diagnostic_msgs/msg/DiagnosticStatus``."""

TROUBLES: Mapping[Status, tuple[int, str]] = {
    Status.SYSTEM_ERROR: (ERROR, "System Error: the camera needs a reboot at least"),
    Status.OVERHEAT: (WARN, "Overheat: the camera is too hot, inspections may get worse"),
    Status.INPUT_CONTAINER: (WARN, "Input Container: input data and inspections are out of step"),
    Status.OVERTRIGGERED: (WARN, "Overtriggered: a trigger was dropped"),
}
"""Level and text of each error bit of the status, the worst first."""


class KnownState(NamedTuple):
    """The known state of a camera.

    Attributes:
        name: the camera's name.
        connected: whether there is a session with the camera.
        status: status that the camera sent in this session; None if it sent none.
        application: the id of the active application; None if that is not known.
        failure: reason why there is no session; empty before the first attempt.
    """

    name: str
    connected: bool = False
    status: Status | None = None
    application: int | None = None
    failure: str = ""

    @classmethod
    def of(cls, camera: Camera[Any]) -> KnownState:
        """Return the current state of a camera."""
        if not camera.connected:
            return cls(camera.name, failure=str(camera.trouble or ""))
        try:
            status = camera.status
        except SmartCamError:
            status = None
        return cls(camera.name, True, status, camera.active_application)

    @property
    def bits(self) -> Status:
        """The status of the current session; no bits if none was sent."""
        return self.status if self.connected and self.status is not None else Status(0)


class Health(NamedTuple):
    """The health of a camera: a level of diagnostics, the reason, and the set error bits."""

    level: int
    text: str
    errors: tuple[str, ...] = ()


def health(known: KnownState, *, session_alive: bool = True) -> Health:
    """Return the health of a camera.

    Args:
        known: known state of the camera.
        session_alive: whether the program that has the session with the camera is alive.
    """
    if not known.connected:
        text = known.failure[:MAX_ERROR_CHARACTERS] or "there was no session yet"
        return Health(ERROR if session_alive else STALE, text)
    status = known.bits
    bits = [bit for bit in TROUBLES if bit in status]
    if bits:
        level, text = TROUBLES[bits[0]]
        return Health(level, text, tuple(bit.name or "" for bit in bits))
    if known.status is None:
        return Health(OK, "connected")
    if status.loading:
        return Health(OK, "an application is being loaded")
    if Status.RUNNING not in status:
        return Health(WARN, "stopped: the camera is not in run mode")
    return Health(OK, "busy" if Status.BUSY in status else "ready")


def status_fields(known: KnownState) -> dict[str, Any]:
    """Return the fields of ``smartcam_msgs/msg/CameraStatus`` except the header."""
    connected, status, camera_health = known.connected, known.bits, health(known)
    is_unusable = Status.BUSY in status or Status.SYSTEM_ERROR in status
    application = known.application if connected else None
    return {
        "camera_name": utf8(known.name),
        "connected": connected,
        "ready": connected and Status.RUNNING in status and not is_unusable,
        "busy": Status.BUSY in status,
        "running": Status.RUNNING in status,
        "application_id": max(0, application or 0),  # a camera that does not report it has -1
        "status": status.value,
        "status_names": list(status.names),
        "error": utf8(camera_health.text) if camera_health.errors or not connected else "",
    }


def diagnostic_fields(
    node: str, hardware_id: str, level: int, message: str, values: Iterable[tuple[str, object]]
) -> dict[str, Any]:
    """Return the fields of ``diagnostic_msgs/msg/DiagnosticStatus`` for the camera of a node."""
    return {
        "level": level,
        "name": f"{node.lstrip('/')}: camera",
        "message": utf8(message),
        "hardware_id": utf8(hardware_id),
        "values": [
            {"key": key.replace("_", " "), "value": utf8(str(value))} for key, value in values
        ],
    }


def hardware_id(address: Address) -> str:
    """Return the hardware id of a camera for diagnostics: its address, without a password."""
    path = f"/{address.path}" if address.path else ""
    return f"{address.host}:{address.port}{path}"


def header_fields(at: datetime, frame_id: str) -> dict[str, Any]:
    """Return the fields of ``std_msgs/msg/Header``."""
    elapsed = at - EPOCH
    seconds = elapsed.days * 86_400 + elapsed.seconds
    return {"stamp": {"sec": seconds, "nanosec": elapsed.microseconds * 1000}, "frame_id": frame_id}
