"""Features of a device by their names: exposure time, gain, trigger mode, commands, user sets.

Source: GenICam SFNC 2.7 (names and units; ``UserSetSelector``, ``UserSetLoad``, ``UserSetSave``,
``UserSetDefault``).
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

from smartcam._arguments import as_plain_value, check_number, check_text, wrong_argument
from smartcam.exceptions import FrameSourceError, FrameTimeoutError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

FeatureValue: TypeAlias = "bool | int | float | str"
"""Value of a feature; for an enumeration, the name of the entry."""

FeatureKind: TypeAlias = Literal["integer", "float", "boolean", "enumeration", "string", "command"]

FEATURE_TIMEOUT: Final = 10.0
"""Seconds for reading or setting a feature, unless the caller says otherwise."""

MAX_FEATURE_TIMEOUT: Final = 3600.0

MAX_VALUE_LENGTH: Final = 4096
"""Largest number of characters of a feature's name or text value."""


@dataclass(frozen=True, slots=True)
class Feature:
    """The description of a feature, with its present range and value.

    Attributes:
        name: name of the feature, mostly one of GenICam's SFNC, such as ``ExposureTime``.
        kind: kind of the feature.
        access: ``rw``, ``ro`` or ``wo``; ``""``: not available now, which may depend on another
            feature.
        value: value of the feature; None: not readable now, or a command.
        minimum: smallest value; None: no number, or unknown.
        maximum: largest value; None: no number, or unknown.
        step: difference between two neighbouring values; None: no number, or no steps.
        unit: unit of the value, such as ``us``; ``""``: no unit.
        entries: names of the values that an enumeration can have now.
        selectors: features that select which instance of this feature is meant, such as
            ``TriggerSelector``.
        description: text by the device's maker.
        problem: reason why value or range could not be read; ``""``: no problem.
    """

    name: str
    kind: FeatureKind
    access: Literal["rw", "ro", "wo", ""]
    value: FeatureValue | None = None
    minimum: float | None = None
    maximum: float | None = None
    step: float | None = None
    unit: str = ""
    entries: tuple[str, ...] = ()
    selectors: tuple[str, ...] = ()
    description: str = ""
    problem: str = ""

    @property
    def range(self) -> str:
        """Range of the feature as a text, such as ``10 to 10000 us in steps of 5``."""
        if self.kind == "boolean":
            return "true or false"
        if self.entries:
            return ", ".join(self.entries)
        if self.minimum is None and self.maximum is None:
            return {"command": "a command", "string": "text"}.get(self.kind, "any number")
        limits = f"{_number_text(self.minimum)} to {_number_text(self.maximum)}"
        step = f" in steps of {_number_text(self.step)}" if self.step not in (None, 0, 1) else ""
        return f"{limits}{f' {self.unit}' if self.unit else ''}{step}"

    def __str__(self) -> str:
        """Return the feature as a line of a list."""
        value = "" if self.value is None else f" = {as_text(self.value)}"
        value += f" {self.unit}" if self.value is not None and self.unit else ""
        access = {"rw": "", "": "; not available now"}.get(self.access, f"; {self.access}")
        problem = f"; {self.problem}" if self.problem else ""
        return f"{self.name}{value} ({self.range}{access}{problem})"


def _number_text(value: float | None) -> str:
    if value is None:
        return "any"
    return str(value) if isinstance(value, int) else f"{value:g}"


def as_text(value: FeatureValue) -> str:
    """Return a value as in URLs and lists: ``true``, ``5000``, ``Mono8``."""
    return str(value).lower() if isinstance(value, bool) else str(value)


class DeviceFeatures(ABC):
    """The features of one driver's device.

    A name may be written in snake_case: ``exposure_time`` is ``ExposureTime``. An unknown name
    raises a :exc:`~smartcam.exceptions.FrameFeatureError` that lists the known ones.
    """

    @abstractmethod
    async def names(self) -> list[str]:
        """Return the names of all features."""

    @abstractmethod
    async def describe(self, name: str) -> Feature:
        """Return a feature with its present value and range."""

    async def describe_all(self) -> dict[str, Feature]:
        """Return all features with their present values and ranges."""
        return {name: await self.describe(name) for name in await self.names()}

    @abstractmethod
    async def get(self, name: str) -> FeatureValue:
        """Return the value of a feature."""

    @abstractmethod
    async def set(self, name: str, value: FeatureValue) -> FeatureValue:
        """Set a feature; return the device's new value."""

    @abstractmethod
    async def execute(self, name: str) -> None:
        """Execute a command, and wait until it is done."""


def spelling_key(name: str) -> str:
    """Return a name's letters and digits in lower case, which all spellings of a name share."""
    return "".join(character for character in name.lower() if character.isalnum())


class FrameFeatures:
    """The features of a source's device, by name: ``await source.features["Gain"].set(6.0)``.

    Args:
        get_features: function that returns the driver's features, or raises the error that explains
            why there are none now.
        on_change: function that is called after each change of a feature.
    """

    def __init__(
        self, get_features: Callable[[], DeviceFeatures], on_change: Callable[[], Awaitable[None]]
    ) -> None:
        self._get_features, self._on_change = get_features, on_change

    def __getitem__(self, name: str) -> FrameFeature:
        """Return the feature of a name, which the device checks only when it is used.

        Raises:
            ConfigurationError: the name is no text.
        """
        checked = check_text(name, "name", "features", most=MAX_VALUE_LENGTH)
        return FrameFeature(checked, self._get_features, self._on_change)

    async def names(self, *, timeout: float = FEATURE_TIMEOUT) -> list[str]:
        """Return the names of all features.

        Raises:
            UnsupportedError: a source of this kind has no features.
            FrameSourceError: the device does not return them, or not within ``timeout``.

        Cancellation: safe.
        """
        async with _time_limit(timeout, "the list of features"):
            return await self._get_features().names()

    async def describe(self, *, timeout: float = 6 * FEATURE_TIMEOUT) -> dict[str, Feature]:
        """Return all features with their present values and ranges, by name; there may be hundreds.

        Raises:
            UnsupportedError: a source of this kind has no features.
            FrameSourceError: the device does not return them, or not within ``timeout``.

        Cancellation: safe.
        """
        async with _time_limit(timeout, "all features"):
            return await self._get_features().describe_all()

    async def load(self, user_set: str, *, timeout: float = 3 * FEATURE_TIMEOUT) -> None:
        """Load the device's features from a user set, such as ``UserSet1``.

        Args:
            user_set: entry of ``UserSetSelector``; ``Default`` has the maker's values.
            timeout: time limit, seconds.

        Raises:
            FrameFeatureError: there is no such set, or the device does not load it now.

        Cancellation: the device may have loaded it.
        """
        await self._execute_with_set(user_set, "UserSetLoad", timeout)

    async def save(self, user_set: str, *, timeout: float = 3 * FEATURE_TIMEOUT) -> None:
        """Save the device's present features in a user set.

        Args:
            user_set: entry of ``UserSetSelector`` that can be written.
            timeout: time limit, seconds.

        Raises:
            FrameFeatureError: there is no such set, or the device does not save it.

        Cancellation: the device may have saved it.
        """
        await self._execute_with_set(user_set, "UserSetSave", timeout)

    async def load_at_power_on(self, user_set: str, *, timeout: float = FEATURE_TIMEOUT) -> None:
        """Set the user set that the device loads when it is switched on (``UserSetDefault``).

        Raises:
            FrameFeatureError: there is no such set, or the device has no default set.

        Cancellation: the device may have set it.
        """
        checked = check_text(user_set, "user_set", "load_at_power_on", most=MAX_VALUE_LENGTH)
        features = {spelling_key(name): name for name in await self.names(timeout=timeout)}
        name = features.get(
            "usersetdefault", features.get("usersetdefaultselector", "UserSetDefault")
        )
        await self[name].set(checked, timeout=timeout)

    async def _execute_with_set(self, user_set: str, command: str, timeout: float) -> None:
        checked = check_text(user_set, "user_set", "features", most=MAX_VALUE_LENGTH)
        await self["UserSetSelector"].set(checked, timeout=timeout)
        await self[command].execute(timeout=timeout)


class FrameFeature:
    """One feature of a source's device. Made by ``source.features[NAME]``.

    Attributes:
        name: name as the caller gave it.
    """

    def __init__(
        self,
        name: str,
        get_features: Callable[[], DeviceFeatures],
        on_change: Callable[[], Awaitable[None]],
    ) -> None:
        self.name: str = name
        self._get_features, self._on_change = get_features, on_change

    async def get(self, *, timeout: float = FEATURE_TIMEOUT) -> FeatureValue:
        """Return the value.

        Raises:
            FrameFeatureError: there is no such feature, or it cannot be read now.
            FrameTimeoutError: the device did not answer within ``timeout``.
            UnsupportedError: a source of this kind has no features.

        Cancellation: safe.
        """
        async with _time_limit(timeout, f"feature {self.name}"):
            return await self._get_features().get(self.name)

    async def describe(self, *, timeout: float = FEATURE_TIMEOUT) -> Feature:
        """Return the feature with its present value, range, unit, entries and access.

        Raises:
            FrameFeatureError: there is no such feature.
            FrameTimeoutError: the device did not answer within ``timeout``.
            UnsupportedError: a source of this kind has no features.

        Cancellation: safe.
        """
        async with _time_limit(timeout, f"feature {self.name}"):
            return await self._get_features().describe(self.name)

    async def set(self, value: FeatureValue, *, timeout: float = FEATURE_TIMEOUT) -> FeatureValue:
        """Set the feature; return the device's new value, perhaps rounded.

        Args:
            value: value, or its text: an entry's name, ``true``, a number.
            timeout: time limit, seconds.

        Raises:
            ConfigurationError: no feature can have a value of this type.
            FrameFeatureError: there is no such feature, it cannot be set now, or the value is out
                of its range, which the text names.
            FrameTimeoutError: the device did not answer within ``timeout``.
            UnsupportedError: a source of this kind has no features.

        Cancellation: the device may have set the value.
        """
        checked = checked_value(value)
        async with _time_limit(timeout, f"feature {self.name} to be set"):
            new_value = await self._get_features().set(self.name, checked)
            await self._on_change()
            return new_value

    async def execute(self, *, timeout: float = 3 * FEATURE_TIMEOUT) -> None:
        """Execute the command, and wait until it is done.

        Raises:
            FrameFeatureError: there is no such command, or the device refuses it now.
            FrameTimeoutError: the command was not done within ``timeout``.
            UnsupportedError: a source of this kind has no features.

        Cancellation: the device may have executed it.
        """
        async with _time_limit(timeout, f"command {self.name} to be done"):
            await self._get_features().execute(self.name)
            await self._on_change()


def checked_value(value: object) -> FeatureValue:
    """Return a value that a feature may have, as a plain Python value.

    Raises:
        ConfigurationError: the value is not valid.
    """
    checked = as_plain_value(value)
    if isinstance(checked, str):
        return check_text(checked, "value", "set", most=MAX_VALUE_LENGTH)
    if isinstance(checked, (bool, int)) or (isinstance(checked, float) and math.isfinite(checked)):
        return checked
    raise wrong_argument("value", "a finite number, True or False, or a text", value, "set")


@contextlib.asynccontextmanager
async def _time_limit(timeout: object, expected: str) -> AsyncIterator[None]:
    """Limit the time of a block; raise FrameTimeoutError that names what was expected."""
    seconds = check_number(timeout, "timeout", 0, MAX_FEATURE_TIMEOUT, unit="seconds")
    try:
        async with asyncio.timeout(seconds):
            yield
    except FrameSourceError:
        raise
    except TimeoutError as exc:
        raise FrameTimeoutError(f"expected {expected} within {seconds:g} s, got no answer") from exc
