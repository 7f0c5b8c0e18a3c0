"""A camera's state as ROS messages, as far as a recorder is told of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.models import Status
from smartcam.ros2._camera_status import ERROR, OK, STALE, TROUBLES
from smartcam.ros2._messages import EPOCH, utf8

if TYPE_CHECKING:
    from datetime import datetime

STATUS = "smartcam_msgs/msg/CameraStatus"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


def health(status: Status | None, *, connected: bool, why: str) -> tuple[int, str]:
    """Return how a camera is: a level of diagnostics, and in words.

    ``status`` is None as long as there is none, ``why`` is why there is no session.
    """
    if not connected:
        return (ERROR, why) if why else (STALE, "there was no session yet")
    found = [TROUBLES[bit] for bit in TROUBLES if status is not None and bit in status]
    if found:
        return max(level for level, _ in found), found[0][1]
    return OK, "connected"


def status_fields(
    camera: str, stamp: datetime, *, connected: bool, status: Status | None, application: int | None
) -> dict[str, Any]:
    """Return a ``smartcam_msgs/msg/CameraStatus`` but for its error."""
    bits = Status(0) if status is None or not connected else status
    busy, running = Status.BUSY in bits, Status.RUNNING in bits
    return {
        "header": {"stamp": time_fields(stamp), "frame_id": camera},
        "camera_name": utf8(camera),
        "connected": connected,
        "ready": connected and running and not busy and Status.SYSTEM_ERROR not in bits,
        "busy": busy,
        "running": running,
        "application_id": max(0, application or 0) if connected else 0,
        "status": bits.value,
        "status_names": list(bits.names),
    }


def diagnostics(
    name: str, hardware: str, stamp: datetime, level: int, message: str, **values: object
) -> dict[str, Any]:
    """Return a ``diagnostic_msgs/msg/DiagnosticArray`` with the state of one camera."""
    status = {
        "level": level,
        "name": f"{name}: camera",
        "message": utf8(message),
        "hardware_id": utf8(hardware),
        "values": [
            {"key": key, "value": utf8(str(value))}
            for key, value in values.items()
            if value is not None
        ],
    }
    return {"header": {"stamp": time_fields(stamp), "frame_id": ""}, "status": [status]}


def time_fields(at: datetime) -> dict[str, int]:
    """Return a ``builtin_interfaces/msg/Time``."""
    since = at - EPOCH
    return {"sec": since.days * 86_400 + since.seconds, "nanosec": since.microseconds * 1000}
