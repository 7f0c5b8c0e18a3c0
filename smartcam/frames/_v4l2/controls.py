"""Read and set a device's controls, such as exposure and gain, with their ranges."""

from __future__ import annotations

import errno
import re
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import FrameFeatureError
from smartcam.frames._v4l2 import abi
from smartcam.frames._v4l2.device import device_error

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.frames._v4l2.device import CaptureDevice

CONTROL_TYPES: Final = {
    abi.CTRL_INTEGER: "integer",
    abi.CTRL_BOOLEAN: "boolean",
    abi.CTRL_MENU: "menu",
    abi.CTRL_BUTTON: "button",
    abi.CTRL_BITMASK: "bitmask",
    abi.CTRL_INTEGER_MENU: "menu",
}
"""Supported types of controls; 64-bit numbers, texts and structures are not supported."""

BOOLEAN_WORDS: Final = {"on": 1, "true": 1, "yes": 1, "off": 0, "false": 0, "no": 0}


@dataclass(frozen=True, slots=True)
class DeviceControl:
    """A control of a device.

    Attributes:
        name: label in lower case with underscores: ``white_balance_automatic``.
        id: id of the control in V4L2.
        kind: integer, boolean, menu, button or bitmask.
        minimum: smallest value.
        maximum: largest value.
        step: difference between two values.
        default: the driver's initial value.
        value: present value; None: the value cannot be read.
        menu: label of each value, for a menu.
        flags: flags of V4L2.
    """

    name: str
    id: int
    kind: str
    minimum: int
    maximum: int
    step: int
    default: int
    value: int | None
    menu: Mapping[int, str] = field(default_factory=dict[int, str])
    flags: int = 0

    @property
    def range(self) -> str:
        """Range of the control as a text."""
        if self.menu:
            return ", ".join(f"{value} ({label})" for value, label in self.menu.items())
        if self.kind == "button":
            return "any value: it is a button"
        if self.kind == "boolean":
            return "0 (off), 1 (on)"
        if self.kind == "bitmask":
            return f"bits of {self.maximum & 0xFFFFFFFF:#x}"
        step = f" in steps of {self.step}" if self.step > 1 else ""
        return f"{self.minimum} to {self.maximum}{step}"

    def __str__(self) -> str:
        """Return the control as a line of lists and error texts."""
        current = "" if self.value is None else f", now {self.value}"
        return f"{self.name}: {self.range}; default {self.default}{current}"

    def parse_value(self, value: int | str) -> int | None:
        """Return the number for a value; None if the device does not accept the value."""
        number = self._parse(value)
        if number is None or self.kind == "button":
            return number
        if self.menu:
            return number if number in self.menu else None
        if self.kind == "bitmask":
            return number if 0 <= number <= self.maximum & 0xFFFFFFFF else None
        is_in_range = self.minimum <= number <= self.maximum
        is_on_step = (number - self.minimum) % max(1, self.step) == 0
        return number if is_in_range and is_on_step else None

    def _parse(self, value: int | str) -> int | None:
        if not isinstance(value, str):
            return int(value)
        text = value.strip()
        if self.kind == "boolean" and text.lower() in BOOLEAN_WORDS:
            return BOOLEAN_WORDS[text.lower()]
        for number, label in self.menu.items():
            if normalized_name(label) == normalized_name(text) and not text.isdigit():
                return number
        try:
            return int(text, 0)
        except ValueError:
            return None


def normalized_name(label: str) -> str:
    """Return a label in lower case, with underscores for blanks and punctuation."""
    return re.sub(r"[^a-z0-9]+", "_", label.lower()).strip("_")


def list_controls(device: CaptureDevice) -> dict[str, DeviceControl]:
    """Return the controls by their names, in the driver's order."""
    return {name: _read_control(device, answer) for name, answer in _query_controls(device).items()}


def set_control(device: CaptureDevice, name: str, value: int | str) -> int:
    """Set a control.

    Returns:
        The device's new value.

    Raises:
        FrameFeatureError: there is no control of that name, it cannot be set, or does not accept
            the value; the text lists the controls or the range.
    """
    answer = _query_controls(device).get(normalized_name(name))
    if answer is None:
        raise _unknown_control_error(device, name)
    control = _read_control(device, answer)
    number = control.parse_value(value)
    if number is None or control.flags & abi.CTRL_READ_ONLY:
        expected = control.range if number is None else "nothing, since it is read-only"
        raise _refused_error(device, control, f"expected {expected}, got {value!r}")
    try:
        device.ioctl(abi.S_CTRL, control.id, number & 0xFFFFFFFF)
    except OSError as exc:
        raise device_error(device.path, f"setting {control.name} to {value!r}", exc) from exc
    actual = _read_value(device, control.id, control.flags)
    if actual is None or control.kind == "button":
        return number
    if actual != number and not control.flags & (abi.CTRL_VOLATILE | abi.CTRL_EXECUTE_ON_WRITE):
        raise _refused_error(device, control, f"set to {number}, the device has it at {actual}")
    return actual


def _query_controls(device: CaptureDevice) -> dict[str, tuple[Any, ...]]:
    """Return the driver's description of each control, without its value, which may be slow."""
    descriptions: dict[str, tuple[Any, ...]] = {}
    number = 0
    while True:
        try:
            answer = device.ioctl(abi.QUERY_EXT_CTRL, number | abi.CTRL_NEXT)
        except OSError as exc:
            if exc.errno in (errno.EINVAL, errno.ENOTTY):  # end of the list
                return descriptions
            raise device_error(device.path, "listing its controls", exc) from exc
        if answer[0] <= number:  # the driver repeats controls
            return descriptions
        number = answer[0]
        if answer[1] in CONTROL_TYPES and not answer[7] & abi.CTRL_DISABLED:
            descriptions.setdefault(normalized_name(abi.decode_text(answer[2])), answer)


def _unknown_control_error(device: CaptureDevice, name: str) -> FrameFeatureError:
    controls = list_controls(device)
    return FrameFeatureError(
        f"{device.path}: no control {name!r}; it has {', '.join(controls) or 'none'}"
        f"{did_you_mean(normalized_name(name), list(controls))}",
        source=device.path,
        available=tuple(map(str, controls.values())),
    )


def _refused_error(device: CaptureDevice, control: DeviceControl, text: str) -> FrameFeatureError:
    return FrameFeatureError(
        f"{device.path}: control {control.name}: {text}",
        source=device.path,
        available=(str(control),),
    )


def _read_control(device: CaptureDevice, answer: tuple[Any, ...]) -> DeviceControl:
    number, kind, label, minimum, maximum, step, default, flags = answer[:8]
    menu: dict[int, str] = {}
    if CONTROL_TYPES[kind] == "menu":
        menu = _read_menu(device, number, kind, range(minimum, min(maximum, minimum + 255) + 1))
    return DeviceControl(
        normalized_name(abi.decode_text(label)),
        number,
        CONTROL_TYPES[kind],
        minimum,
        maximum,
        step,
        default,
        _read_value(device, number, flags),
        menu,
        flags,
    )


def _read_menu(device: CaptureDevice, number: int, kind: int, values: range) -> dict[int, str]:
    items: dict[int, str] = {}
    for index in values:
        try:
            _, _, raw = device.ioctl(abi.QUERYMENU, number, index)
        except OSError as exc:
            if exc.errno == errno.EINVAL:  # a menu may have gaps
                continue
            raise device_error(device.path, "listing a menu", exc) from exc
        integer = int.from_bytes(raw[:8], sys.byteorder, signed=True)
        items[index] = abi.decode_text(raw) if kind == abi.CTRL_MENU else str(integer)
    return items


def _read_value(device: CaptureDevice, number: int, flags: int) -> int | None:
    if flags & abi.CTRL_WRITE_ONLY:
        return None
    try:
        value: int = device.ioctl(abi.G_CTRL, number)[1]
    except OSError as exc:
        if exc.errno == errno.ENODEV:
            raise device_error(device.path, "reading a control", exc) from exc
        return None
    return value
