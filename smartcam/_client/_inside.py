"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam._client.attempts import (
        Attempt,
        Reason,
        SessionRefusedError,
        explain,
        reason_for,
        reason_values,
    )
    from smartcam._client.camera_state import CameraState
    from smartcam._client.counters import ClientCounters
    from smartcam._client.deadline import DeadlineTimer
    from smartcam._client.doorbell import AnyFuture, make_doorbell
    from smartcam._client.handshake import Session, attempt, dialect_names, dialect_remarks
    from smartcam._client.interpretation import (
        Interpretation,
        Interpreted,
        camera_interpreter,
        has_pixel_positions,
        localizations_of,
        name_if_poseless,
        new_tuple,
    )
    from smartcam._client.listeners import Listeners
    from smartcam._client.triggering import TriggerRequest

__all__ = [
    "AnyFuture",
    "Attempt",
    "CameraState",
    "ClientCounters",
    "DeadlineTimer",
    "Interpretation",
    "Interpreted",
    "Listeners",
    "Reason",
    "Session",
    "SessionRefusedError",
    "TriggerRequest",
    "attempt",
    "camera_interpreter",
    "dialect_names",
    "dialect_remarks",
    "explain",
    "has_pixel_positions",
    "localizations_of",
    "make_doorbell",
    "name_if_poseless",
    "new_tuple",
    "reason_for",
    "reason_values",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "attempts": "Reason SessionRefusedError Attempt explain reason_for reason_values",
            "camera_state": "CameraState",
            "counters": "ClientCounters",
            "deadline": "DeadlineTimer",
            "doorbell": "AnyFuture make_doorbell",
            "handshake": "Session attempt dialect_names dialect_remarks",
            "interpretation": "Interpretation Interpreted has_pixel_positions localizations_of "
            "new_tuple camera_interpreter name_if_poseless",
            "listeners": "Listeners",
            "triggering": "TriggerRequest",
        },
    )
