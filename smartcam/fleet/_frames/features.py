"""Read and set features of a shared camera's device through its agent."""

from __future__ import annotations

import asyncio
import dataclasses
import math
from typing import TYPE_CHECKING, Any, Final, cast

from smartcam.exceptions import RemoteProtocolError
from smartcam.frames import DeviceFeatures, Feature

if TYPE_CHECKING:
    from smartcam.fleet._program.caller import Caller
    from smartcam.frames._inside import FeatureValue

CALL_TIMEOUT: Final = 60.0
"""Seconds for a call, unless the caller has an earlier deadline."""

MAX_FEATURES: Final = 10_000

_KINDS: Final = ("integer", "float", "boolean", "enumeration", "string", "command")
_ACCESS: Final = ("rw", "ro", "wo", "")


def feature_fields(feature: Feature) -> dict[str, Any]:
    """Return a feature as JSON; a number that JSON does not have becomes null."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in dataclasses.asdict(feature).items()
    }


def read_feature(data: object, owner: str) -> Feature:
    """Return the feature that an agent's fields describe.

    Raises:
        RemoteProtocolError: the fields are not a valid feature.
    """
    try:
        fields = cast("dict[str, Any]", data)
        kind, access, value = fields["kind"], fields["access"], fields["value"]
        if kind not in _KINDS or access not in _ACCESS:
            raise ValueError(f"kind {kind!r:.40}, access {access!r:.40}")
        if value is not None:
            value = read_value(value, owner)
        read: dict[str, Any] = {"kind": kind, "access": access, "value": value}
        for name in ("minimum", "maximum", "step"):
            read[name] = None if fields[name] is None else _number(fields[name])
        for name in ("name", "unit", "description", "problem"):
            read[name] = str(fields[name])
        for name in ("entries", "selectors"):
            read[name] = tuple(map(str, fields[name]))
        return Feature(**read)
    except (KeyError, TypeError, ValueError) as exc:
        raise RemoteProtocolError(f"{owner}: the agent's feature is not valid: {exc!r}") from exc


def read_value(value: object, owner: str) -> FeatureValue:
    """Return a value in an agent's reply.

    Raises:
        RemoteProtocolError: the value is not valid.
    """
    if isinstance(value, (bool, int, float, str)):
        return value
    raise RemoteProtocolError(
        f"{owner}: the agent's value of a feature is not valid: {value!r:.80}"
    )


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{value!r:.40} is no number")
    return value


class FleetFeatures(DeviceFeatures):
    """The features of a camera's device, through its agent.

    Args:
        name: name of the camera.
        caller: caller of the agent.
    """

    def __init__(self, name: str, caller: Caller) -> None:
        self._name, self._caller = name, caller

    async def _call(self, do: str, **arguments: Any) -> dict[str, Any]:
        deadline = asyncio.get_running_loop().time() + CALL_TIMEOUT
        reply = await self._caller.call(do, deadline, arguments)
        return cast("dict[str, Any]", reply.fields["answer"])

    async def names(self) -> list[str]:
        """Return the names of all features."""
        answer = await self._call("features", names_only=True)
        return [str(name) for name in self._list(answer, "names")]

    async def describe_all(self) -> dict[str, Feature]:
        """Return all features with their current values and ranges."""
        return {feature.name: feature for feature in await self._describe()}

    async def describe(self, name: str) -> Feature:
        """Return a feature with its current value and range."""
        features = await self._describe(name=name)
        if len(features) != 1:
            raise RemoteProtocolError(f"{self._name}: expected one feature, got {len(features)}")
        return features[0]

    async def _describe(self, **arguments: Any) -> list[Feature]:
        answer = await self._call("features", **arguments)
        return [read_feature(feature, self._name) for feature in self._list(answer, "features")]

    def _list(self, answer: dict[str, Any], name: str) -> list[Any]:
        """Return the items of an agent's list.

        Raises:
            RemoteProtocolError: the list is not valid, or has too many items.
        """
        entries = answer.get(name)
        if not isinstance(entries, list) or len(entries) > MAX_FEATURES:
            raise RemoteProtocolError(f"{self._name}: the agent's list of {name} is not valid")
        return entries

    async def get(self, name: str) -> FeatureValue:
        """Return the value of a feature."""
        answer = await self._call("features", name=name, value_only=True)
        return read_value(answer.get("value"), self._name)

    async def set(self, name: str, value: FeatureValue) -> FeatureValue:
        """Set a feature; return the device's new value."""
        answer = await self._call("set_feature", name=name, value=value)
        return read_value(answer.get("value"), self._name)

    async def execute(self, name: str) -> None:
        """Execute a command, and wait until the device has done it."""
        await self._call("execute_feature", name=name)
