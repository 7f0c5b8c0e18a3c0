"""Carry out commands to a camera that come in through an outlet, such as a trigger over MQTT."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_application, check_seconds
from smartcam._suggestions import did_you_mean
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.camera import Camera

MAX_TIMEOUT = 300.0
"""Largest timeout of a command, seconds."""

_FIELDS = {
    "trigger": ("timeout",),
    "switch": ("application", "timeout"),
    "start": ("timeout",),
    "stop": ("timeout",),
}
_DEFAULT_TIMEOUTS = {"trigger": 5.0, "switch": 10.0, "start": 10.0, "stop": 10.0}


async def do_command(
    camera: Camera[Any], verb: str, arguments: Mapping[str, Any]
) -> dict[str, Any]:
    """Carry out a command and return the fields of the answer.

    Args:
        camera: camera that is open.
        verb: ``trigger``, ``switch``, ``start`` or ``stop``.
        arguments: fields of the command: ``timeout`` in seconds; for a switch ``application``.

    Raises:
        ConfigurationError: a field is wrong or unknown.
        SmartCamError: the command failed.
    """
    known = _FIELDS[verb]
    for name in arguments:
        if name not in known:
            raise ConfigurationError(
                f"{verb}: there is no field {name!r:.60}; known are {', '.join(known)}"
                f"{did_you_mean(name, known)}"
            )
    timeout = check_seconds(arguments.get("timeout", _DEFAULT_TIMEOUTS[verb]), "timeout", verb)
    if timeout > MAX_TIMEOUT:
        raise ConfigurationError(f"{verb}: timeout: expected {MAX_TIMEOUT:g} s at most")
    if verb == "trigger":
        result = await camera.trigger(timeout=timeout)
        fields = result._asdict()
        del fields["raw"]
        return {"result": fields}
    if verb in ("start", "stop"):
        await (camera.start if verb == "start" else camera.stop)(timeout=timeout)
        return {}
    application = check_application(arguments.get("application"), "application", verb)
    await camera.switch_application(application, timeout=timeout)
    return {"application": application}
