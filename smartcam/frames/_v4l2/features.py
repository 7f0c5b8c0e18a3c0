"""Offer a V4L2 device's controls as features, with names and units of SFNC where it has them.

A control that SFNC lacks has its own name: its label in lower case with underscores. A control that
SFNC has is found by both names.

Source: V4L2 documentation, user, camera and image process control classes (numbers and units:
``V4L2_CID_EXPOSURE_ABSOLUTE`` counts 100 us); SFNC 2.7 (names; entries of ``...Auto``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import FrameFeatureError
from smartcam.frames._features import DeviceFeatures, Feature, FeatureValue, spelling_key
from smartcam.frames._v4l2 import abi

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Literal

    from smartcam.frames._features import FeatureKind
    from smartcam.frames._v4l2.controls import DeviceControl
    from smartcam.frames._v4l2.driver import V4L2Driver


class SfncFeature(NamedTuple):
    """The feature of SFNC that corresponds to a control.

    Attributes:
        name: name of the feature.
        unit: unit of the feature.
        factor: the feature's value divided by the control's number; 1: the value is a whole number.
        entries: SFNC's names of the control's values; empty: the control's own names.
    """

    name: str
    unit: str = ""
    factor: int = 1
    entries: Mapping[int, str] = {}


_SWITCH: Final[Mapping[int, str]] = {0: "Off", 1: "Continuous"}

SFNC: Final = {
    0x009A0902: SfncFeature("ExposureTime", "us", 100),
    0x009A0901: SfncFeature("ExposureAuto", entries={1: "Off", 0: "Continuous"}),
    0x00980913: SfncFeature("Gain"),
    0x00980912: SfncFeature("GainAuto", entries=_SWITCH),
    0x0098090C: SfncFeature("BalanceWhiteAuto", entries=_SWITCH),
    0x00980914: SfncFeature("ReverseX"),
    0x00980915: SfncFeature("ReverseY"),
    0x009F0903: SfncFeature("TestPattern"),
}
"""Features of SFNC by the id of the control in V4L2."""

APERTURE_PRIORITY: Final = 3
"""V4L2_EXPOSURE_APERTURE_PRIORITY: automatic exposure time with manual iris, which most webcams use
in place of V4L2_EXPOSURE_AUTO."""

_KINDS: Final[Mapping[str, FeatureKind]] = {
    "integer": "integer",
    "bitmask": "integer",
    "boolean": "boolean",
    "menu": "enumeration",
    "button": "command",
}


class ControlFeature:
    """One control as a feature.

    Args:
        control: control of the device.
    """

    def __init__(self, control: DeviceControl) -> None:
        self.control = control
        self._sfnc = SFNC.get(control.id) or SfncFeature(control.name)
        entries = dict(self._sfnc.entries)
        if self.name == "ExposureAuto" and 0 not in control.menu:
            entries[APERTURE_PRIORITY] = entries.pop(0)
        values = control.menu or entries
        self._entries = {value: entries.get(value, label) for value, label in values.items()}

    @property
    def name(self) -> str:
        """Name of the feature."""
        return self._sfnc.name

    @property
    def spellings(self) -> set[str]:
        """Names by which the feature is found, reduced to letters and digits."""
        return {spelling_key(self.name), spelling_key(self.control.name)}

    def to_value(self, number: int | None) -> FeatureValue | None:
        """Return the feature's value for a number of the control."""
        if number is None or self.control.kind == "button":
            return None
        if self._entries:
            return self._entries.get(number, str(number))
        if self.control.kind == "boolean":
            return bool(number)
        return number if self._sfnc.factor == 1 else float(number * self._sfnc.factor)

    def to_number(self, value: FeatureValue) -> int | None:
        """Return the control's number for a value; None: the device has no such value."""
        if self._entries:
            wanted = spelling_key(str(value))
            names = self._entries.items()
            return next((number for number, name in names if spelling_key(name) == wanted), None)
        if isinstance(value, float) and self._sfnc.factor == 1:
            return self.control.parse_value(int(value)) if value.is_integer() else None
        if not isinstance(value, float) and self._sfnc.factor == 1:
            return self.control.parse_value(value)
        try:
            number = round(float(value) / self._sfnc.factor)
        except (ValueError, OverflowError):
            return None
        minimum, step = self.control.minimum, max(1, self.control.step)
        if not minimum <= number <= self.control.maximum:
            return None
        return minimum + (number - minimum) // step * step

    def to_feature(self) -> Feature:
        """Return the feature with its range and its present value."""
        control = self.control
        access: Literal["rw", "ro", "wo"] = "rw"
        if control.flags & abi.CTRL_READ_ONLY:
            access = "ro"
        elif control.flags & abi.CTRL_WRITE_ONLY or control.kind == "button":
            access = "wo"
        kind: FeatureKind = "enumeration" if self._entries else _KINDS[control.kind]
        factor = self._sfnc.factor
        if factor != 1:
            kind = "float"
        has_range = kind in ("integer", "float") and control.kind != "bitmask"
        return Feature(
            self.name,
            kind,
            access,
            value=self.to_value(control.value),
            minimum=control.minimum * factor if has_range else None,
            maximum=control.maximum * factor if has_range else None,
            step=max(1, control.step) * factor if has_range else None,
            unit=self._sfnc.unit,
            entries=tuple(self._entries.values()),
            description=f"V4L2 control {control.name}",
        )


class V4L2Features(DeviceFeatures):
    """The controls of a V4L2 device as features.

    Args:
        driver: driver of the device.
    """

    def __init__(self, driver: V4L2Driver) -> None:
        self._driver = driver

    async def _control_features(self) -> list[ControlFeature]:
        return [ControlFeature(control) for control in (await self._driver.controls()).values()]

    async def names(self) -> list[str]:
        """Return the names of all features."""
        return [feature.name for feature in await self._control_features()]

    async def describe_all(self) -> dict[str, Feature]:
        """Return all features with their current values and ranges."""
        return {feature.name: feature.to_feature() for feature in await self._control_features()}

    async def describe(self, name: str) -> Feature:
        """Return a feature with its current value and range."""
        return (await self._feature_named(name)).to_feature()

    async def get(self, name: str) -> FeatureValue:
        """Return the value of a feature."""
        feature = await self._feature_named(name)
        value = feature.to_value(feature.control.value)
        if value is None:
            raise self._feature_error(feature, "it has no value that can be read")
        return value

    async def set(self, name: str, value: FeatureValue) -> FeatureValue:
        """Set a feature; return the device's new value."""
        feature = await self._feature_named(name)
        if feature.control.kind == "button":
            raise self._feature_error(feature, "it is a command: execute it")
        number = feature.to_number(value)
        if number is None:
            raise self._feature_error(
                feature, f"expected {feature.to_feature().range}, got {value!r}"
            )
        new_number = await self._driver.set_control(feature.control.name, number)
        actual = feature.to_value(new_number)
        return value if actual is None else actual

    async def execute(self, name: str) -> None:
        """Execute a command."""
        feature = await self._feature_named(name)
        if feature.control.kind != "button":
            raise self._feature_error(feature, "it is no command: set it")
        await self._driver.set_control(feature.control.name, 1)

    async def _feature_named(self, name: str) -> ControlFeature:
        features = await self._control_features()
        wanted = spelling_key(name)
        for feature in features:
            if wanted in feature.spellings:
                return feature
        names = [feature.name for feature in features]
        raise FrameFeatureError(
            f"{self._driver.name}: it has no feature {name!r}{did_you_mean(name, names)}; it has "
            f"{', '.join(names) or 'none'}",
            source=self._driver.name,
            available=tuple(names),
        )

    def _feature_error(self, feature: ControlFeature, text: str) -> FrameFeatureError:
        return FrameFeatureError(
            f"{self._driver.name}: feature {feature.name}: {text}",
            source=self._driver.name,
            available=(str(feature.to_feature()),),
        )
