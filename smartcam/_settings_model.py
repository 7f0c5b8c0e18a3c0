"""Check the options of a connection with pydantic.

:class:`~smartcam.settings.CameraSettings` accepts the usual values itself, since importing pydantic
takes longer than connecting. It uses this module for any other value.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict, Field, InstanceOf, create_model

from smartcam._arguments import (
    MAX_APPLICATION_ID,
    MAX_CONNECT_ATTEMPTS,
    MAX_DATA_BYTES,
    MAX_NAME_CHARACTERS,
    MAX_OPTION_SECONDS,
    MIN_PAYLOAD_LIMIT_BYTES,
    as_plain_value,
)
from smartcam.backoff import Backoff

PLAIN = BeforeValidator(as_plain_value)
"""Lets a strict type accept numbers and texts of any class, such as numpy's."""


def _integer(minimum: int, maximum: int) -> Any:
    return Annotated[int, Field(strict=True, ge=minimum, le=maximum), PLAIN]


Seconds = Annotated[
    float, Field(strict=True, gt=0, le=MAX_OPTION_SECONDS, allow_inf_nan=False), PLAIN
]
ApplicationId = Annotated[int, Field(strict=True, ge=0, le=MAX_APPLICATION_ID), PLAIN]
Text = Annotated[str, Field(strict=True), PLAIN]
Flag = Annotated[bool, Field(strict=True), PLAIN]

OPTIONS: dict[str, tuple[Any, str]] = {
    "name": (
        Annotated[str, Field(strict=True, max_length=MAX_NAME_CHARACTERS), PLAIN],
        "name in logs and results; default HOST:PORT",
    ),
    "application": (ApplicationId | None, "id of the application to load and run, or its name"),
    "application_names": (
        Annotated[dict[Text, ApplicationId], Field(max_length=1000)],
        "names of applications and their ids; a name may replace any id",
    ),
    "interpret_as": (Any, "interpretation of result containers"),
    "calibration": (
        Any,
        "transforms localizations into the robot's frame: one for all applications, or a mapping "
        "from application id to one, or to None to leave its values as they are",
    ),
    "y_down": (Flag, "the camera's y axis points down; it is reversed, so that poses have y up"),
    "lenient": (Flag, "any byte but 0 counts as true in a bool"),
    "connect_timeout": (Seconds, "longest wait for a session, all attempts"),
    "connect_attempts": (_integer(1, MAX_CONNECT_ATTEMPTS), "number of attempts for each dialect"),
    "switch_timeout": (Seconds, "longest wait for a change of the application"),
    "request_timeout": (Seconds, "longest wait for the answer to a request"),
    "close_timeout": (Seconds, "longest wait for the camera to close the connection"),
    "liveness_timeout": (
        Seconds | None,
        "longest wait for the answer to a check of the connection; None: no end",
    ),
    "reconnect": (InstanceOf[Backoff] | None, "delays before each reconnect; None: never"),
    "restore": (
        Flag,
        "after a reconnect, restore the application and the run state that this client requested; "
        "else leave them as they are",
    ),
    "max_length": (
        _integer(MIN_PAYLOAD_LIMIT_BYTES, MAX_DATA_BYTES),
        "largest size of a payload that is accepted, bytes",
    ),
}
"""Type of each option, and its description."""

_FIELDS: dict[str, Any] = {option: (kind, None) for option, (kind, _) in OPTIONS.items()}
_CONFIG = ConfigDict(extra="forbid", arbitrary_types_allowed=True)
SettingsModel = create_model("SettingsModel", __config__=_CONFIG, **_FIELDS)
"""Model of all options; each may be missing, and is None then."""
