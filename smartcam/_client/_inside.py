"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam._client.attempts import (
        Reason,
        SessionRefusedError,
        Try,
        explain,
        reason_for,
        words,
    )
    from smartcam._client.camera_state import CameraState
    from smartcam._client.counters import ClientCounters
    from smartcam._client.deadline import DeadlineTimer
    from smartcam._client.doorbell import Outcome, make_doorbell
    from smartcam._client.handshake import Session, attempt, names_of, remarks
    from smartcam._client.interpretation import (
        Interpretation,
        Interpreted,
        in_pixels,
        localizations_of,
        new_tuple,
        own_interpreter,
        without_poses,
    )
    from smartcam._client.listeners import Listeners
    from smartcam._client.triggering import TriggerRequest

__all__ = [
    "CameraState",
    "ClientCounters",
    "DeadlineTimer",
    "Interpretation",
    "Interpreted",
    "Listeners",
    "Outcome",
    "Reason",
    "Session",
    "SessionRefusedError",
    "TriggerRequest",
    "Try",
    "attempt",
    "explain",
    "in_pixels",
    "localizations_of",
    "make_doorbell",
    "names_of",
    "new_tuple",
    "own_interpreter",
    "reason_for",
    "remarks",
    "without_poses",
    "words",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "attempts": "Reason SessionRefusedError Try explain reason_for words",
            "camera_state": "CameraState",
            "counters": "ClientCounters",
            "deadline": "DeadlineTimer",
            "doorbell": "Outcome make_doorbell",
            "handshake": "Session attempt names_of remarks",
            "interpretation": "Interpretation Interpreted in_pixels localizations_of "
            "new_tuple own_interpreter without_poses",
            "listeners": "Listeners",
            "triggering": "TriggerRequest",
        },
    )
