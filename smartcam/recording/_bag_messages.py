"""Results and states as the fields of ROS messages: metres, radians, axes as REP-103 has them.

Each function gives the fields of one message as nested mappings, with the names of its definition.
"""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

from smartcam.models import Localization, Status, jsonable
from smartcam.recording._form import nanoseconds

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime

    from smartcam.models import Pose, Result

POSE_ARRAY = "geometry_msgs/msg/PoseArray"
DETECTIONS = "vision_msgs/msg/Detection3DArray"
RESULT = "smartcam_msgs/msg/Result"
STATUS = "smartcam_msgs/msg/CameraStatus"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

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
    result: Result, frame_id: str, stamp: datetime, interpreter: str = ""
) -> dict[str, Any]:
    """Return a ``smartcam_msgs/msg/Result``; ``interpreter``: how it was read, "" where not."""
    text = json.dumps(jsonable(result.value), separators=(",", ":")) if interpreter else ""
    return {
        "header": _header(frame_id, stamp),
        "camera_name": result.camera,
        "application_id": max(0, result.application),  # one may have no name
        "result_id": result.number,
        "interpreter": interpreter,
        "json": text,
        "data": result.raw,
    }


def status_fields(
    camera: str,
    stamp: datetime,
    *,
    connected: bool,
    status: Status | None,
    application: int | None,
    error: str,
) -> dict[str, Any]:
    """Return a ``smartcam_msgs/msg/CameraStatus``; ``error``: why it is not connected."""
    bits = Status(0) if status is None else status
    busy, running = Status.BUSY in bits, Status.RUNNING in bits
    return {
        "header": _header(camera, stamp),
        "camera_name": camera,
        "connected": connected,
        "ready": connected and running and not busy and Status.SYSTEM_ERROR not in bits,
        "busy": busy,
        "running": running,
        "application_id": max(0, application or 0),
        "status": bits.value,
        "status_names": list(bits.names),
        "error": error,
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


def _time(at: datetime) -> dict[str, int]:
    seconds, rest = divmod(nanoseconds(at), 1_000_000_000)
    return {"sec": seconds, "nanosec": rest}


def _header(frame_id: str, stamp: datetime) -> dict[str, Any]:
    return {"stamp": _time(stamp), "frame_id": frame_id}


def _pose(pose: Pose) -> dict[str, Any]:
    place, turn = pose.position, pose.orientation
    return {
        "position": {"x": place.x, "y": place.y, "z": place.z},
        "orientation": {"x": turn.x, "y": turn.y, "z": turn.z, "w": turn.w},
    }
