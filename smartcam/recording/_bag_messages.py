"""Results and states as the fields of ROS messages: metres, radians, axes as REP-103 has them.

Each function gives the fields of one message as nested mappings, with the names of its definition.
"""

from __future__ import annotations

import json
import math
import re
from typing import TYPE_CHECKING, Any

from smartcam.models import Localization, jsonable
from smartcam.recording._form import nanoseconds

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from datetime import datetime

    from smartcam.models import Pose, Result, Status

POSE_ARRAY = "geometry_msgs/msg/PoseArray"
DETECTIONS = "vision_msgs/msg/Detection3DArray"
RESULT = "smartcam_msgs/msg/Result"
STATUS = "smartcam_msgs/msg/CameraStatus"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

DEFINITIONS: Mapping[str, str] = {
    RESULT: (
        "std_msgs/Header header\n"
        "int64 application\n"
        "bool has_sequence\n"
        "int64 sequence\n"
        "uint64 number\n"
        "bool was_triggered\n"
        "builtin_interfaces/Time triggered_at\n"
        "builtin_interfaces/Time received_at\n"
        "float64 latency\n"
        "uint8[] raw\n"
        "string value\n"
        "string error\n"
    ),
    STATUS: (
        "std_msgs/Header header\n"
        "bool connected\n"
        "string url\n"
        "string[] status\n"
        "bool has_application\n"
        "int64 application\n"
        "string message\n"
    ),
}
"""Definitions of the types that are nowhere else."""

OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of a diagnostic status."""


def ros_name(camera: str) -> str:
    """Return a camera's name as names of topics can have it: ``camera_10_0_0_7`` of 10.0.0.7.

    Letters, digits and ``_``, none twice, nor at an end, in parts divided by ``/``.
    """
    parts = [re.sub(r"[^A-Za-z0-9]+", "_", part).strip("_") for part in camera.split("/")]
    named = [f"camera_{part}" if part[0].isdigit() else part for part in parts if part]
    return "/".join(named) or "camera"


def parts_of(value: object) -> list[Localization] | None:
    """Return a result's value where it is a list of nothing but localizations, else None."""
    if not isinstance(value, list):
        return None
    parts: list[Any] = value
    return parts if all(isinstance(part, Localization) for part in parts) else None


def localizations(parts: Sequence[Localization], frame_id: str, stamp: datetime) -> dict[str, Any]:
    """Return a ``geometry_msgs/msg/PoseArray``."""
    return {"header": _header(frame_id, stamp), "poses": [_pose(part.pose) for part in parts]}


def detections(parts: Sequence[Localization], frame_id: str, stamp: datetime) -> dict[str, Any]:
    """Return a ``vision_msgs/msg/Detection3DArray``: the class is the feature's id."""
    header = _header(frame_id, stamp)
    found = [
        {
            "header": header,
            "results": [
                {
                    "hypothesis": {"class_id": part.feature_id, "score": float(part.quality)},
                    "pose": {"pose": _pose(part.pose)},
                }
            ],
            "bbox": {"center": _pose(part.pose)},
        }
        for part in parts
    ]
    return {"header": header, "detections": found}


def result_fields(
    result: Result, frame_id: str, stamp: datetime, error: str = ""
) -> dict[str, Any]:
    """Return a ``smartcam_msgs/msg/Result``; ``error``: why its value could not be read."""
    triggered = result.triggered_at
    return {
        "header": _header(frame_id, stamp),
        "application": result.application,
        "has_sequence": result.sequence is not None,
        "sequence": result.sequence or 0,
        "number": result.number,
        "was_triggered": triggered is not None,
        "triggered_at": time_fields(triggered),
        "received_at": time_fields(result.received_at),
        "latency": math.nan if result.latency is None else float(result.latency),
        "raw": result.raw,
        "value": "" if error else json.dumps(jsonable(result.value), separators=(",", ":")),
        "error": error,
    }


def status_fields(
    *,
    frame_id: str,
    stamp: datetime,
    connected: bool,
    url: str,
    status: Status | None,
    application: int | None,
    message: str,
) -> dict[str, Any]:
    """Return a ``smartcam_msgs/msg/CameraStatus``."""
    return {
        "header": _header(frame_id, stamp),
        "connected": connected,
        "url": url,
        "status": [] if status is None else list(status.names),
        "has_application": application is not None,
        "application": application or 0,
        "message": message,
    }


def diagnostics(
    name: str, hardware: str, stamp: datetime, level: int, message: str, **values: object
) -> dict[str, Any]:
    """Return a ``diagnostic_msgs/msg/DiagnosticArray`` with the state of one camera."""
    status = {
        "level": level,
        "name": name,
        "message": message,
        "hardware_id": hardware,
        "values": [
            {"key": key, "value": str(value)} for key, value in values.items() if value is not None
        ],
    }
    return {"header": _header("", stamp), "status": [status]}


def time_fields(at: datetime | None) -> dict[str, int]:
    """Return a ``builtin_interfaces/msg/Time``; 0 for no time."""
    seconds, rest = divmod(0 if at is None else nanoseconds(at), 1_000_000_000)
    return {"sec": seconds, "nanosec": rest}


def _header(frame_id: str, stamp: datetime) -> dict[str, Any]:
    return {"stamp": time_fields(stamp), "frame_id": frame_id}


def _pose(pose: Pose) -> dict[str, Any]:
    place, turn = pose.position, pose.orientation
    return {
        "position": {"x": place.x, "y": place.y, "z": place.z},
        "orientation": {"x": turn.x, "y": turn.y, "z": turn.z, "w": turn.w},
    }
