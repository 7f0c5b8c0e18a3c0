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

KINDS: Final = {
    abi.CTRL_INTEGER: "integer",
    abi.CTRL_BOOLEAN: "boolean",
    abi.CTRL_MENU: "menu",
    abi.CTRL_BUTTON: "button",
    abi.CTRL_BITMASK: "bitmask",
    abi.CTRL_INTEGER_MENU: "menu",
}
"""Supported types of controls; 64-bit numbers, texts and structures are not supported."""

SWITCHES: Final = {"on": 1, "true": 1, "yes": 1, "off": 0, "false": 0, "no": 0}


@dataclass(frozen=True, slots=True)
class DeviceControl:
    """A control of a device.

    Attributes:
        name: label in lower case with underscores: ``white_balance_automatic``.
        number: id of the control in V4L2.
        kind: integer, boolean, menu, button or bitmask.
        least: smallest value.
        most: largest value.
        step: difference between two values.
        default: the driver's initial value.
        value: present value; None: the value cannot be read.
        menu: label of each value, for a menu.
        flags: flags of V4L2.
    """

    name: str
    number: int
    kind: str
    least: int
    most: int
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
            return "anything: it is a button"
        if self.kind == "boolean":
            return "0 (off), 1 (on)"
        if self.kind == "bitmask":
            return f"bits of {self.most & 0xFFFFFFFF:#x}"
        step = f" in steps of {self.step}" if self.step > 1 else ""
        return f"{self.least} to {self.most}{step}"

    def __str__(self) -> str:
        """Return the control as a line of lists and error texts."""
        now = "" if self.value is None else f", now {self.value}"
        return f"{self.name}: {self.range}; default {self.default}{now}"

    def number_of(self, value: int | str) -> int | None:
        """Return the number of a value; None if the device does not accept it."""
        number = self._read(value)
        if number is None or self.kind == "button":
            return number
        if self.menu:
            return number if number in self.menu else None
        if self.kind == "bitmask":
            return number if 0 <= number <= self.most & 0xFFFFFFFF else None
        fits = self.least <= number <= self.most and (number - self.least) % max(1, self.step) == 0
        return number if fits else None

    def _read(self, value: int | str) -> int | None:
        if not isinstance(value, str):
            return int(value)
        text = value.strip()
        if self.kind == "boolean" and text.lower() in SWITCHES:
            return SWITCHES[text.lower()]
        for number, label in self.menu.items():
            if simple(label) == simple(text) and not text.isdigit():
                return number
        try:
            return int(text, 0)
        except ValueError:
            return None


def simple(label: str) -> str:
    """Return a label in lower case, with underscores for blanks and punctuation."""
    return re.sub(r"[^a-z0-9]+", "_", label.lower()).strip("_")


def list_controls(device: CaptureDevice) -> dict[str, DeviceControl]:
    """Return the controls by their names, in the driver's order."""
    return {name: _control(device, answer) for name, answer in _described(device).items()}


def set_control(device: CaptureDevice, name: str, value: int | str) -> int:
    """Set a control.

    Returns:
        The device's new value.

    Raises:
        FrameFeatureError: there is no control of that name, it cannot be set, or does not accept
            the value; the text lists the controls or the range.
    """
    answer = _described(device).get(simple(name))
    if answer is None:
        raise _unknown_control_error(device, name)
    control = _control(device, answer)
    number = control.number_of(value)
    if number is None or control.flags & abi.CTRL_READ_ONLY:
        expected = control.range if number is None else "nothing, since it is read-only"
        raise _refused_error(device, control, f"expected {expected}, got {value!r}")
    try:
        device.try_to(abi.S_CTRL, control.number, number & 0xFFFFFFFF)
    except OSError as exc:
        raise device_error(device.path, f"setting {control.name} to {value!r}", exc) from exc
    actual = _value(device, control.number, control.flags)
    if actual is None or control.kind == "button":
        return number
    if actual != number and not control.flags & (abi.CTRL_VOLATILE | abi.CTRL_EXECUTE_ON_WRITE):
        raise _refused_error(device, control, f"set to {number}, the device has it at {actual}")
    return actual


def _described(device: CaptureDevice) -> dict[str, tuple[Any, ...]]:
    """Return the driver's descriptions by name, without values, which may be slow to read."""
    described: dict[str, tuple[Any, ...]] = {}
    number = 0
    while True:
        try:
            answer = device.try_to(abi.QUERY_EXT_CTRL, number | abi.CTRL_NEXT)
        except OSError as exc:
            if exc.errno in (errno.EINVAL, errno.ENOTTY):  # end of the list
                return described
            raise device_error(device.path, "listing its controls", exc) from exc
        if answer[0] <= number:  # the driver repeats controls
            return described
        number = answer[0]
        if answer[1] in KINDS and not answer[7] & abi.CTRL_DISABLED:
            described.setdefault(simple(abi.text(answer[2])), answer)


def _unknown_control_error(device: CaptureDevice, name: str) -> FrameFeatureError:
    controls = list_controls(device)
    return FrameFeatureError(
        f"{device.path}: no control {name!r}; it has {', '.join(controls) or 'none'}"
        f"{did_you_mean(simple(name), list(controls))}",
        source=device.path,
        available=tuple(map(str, controls.values())),
    )


def _refused_error(device: CaptureDevice, control: DeviceControl, text: str) -> FrameFeatureError:
    return FrameFeatureError(
        f"{device.path}: control {control.name}: {text}",
        source=device.path,
        available=(str(control),),
    )


def _control(device: CaptureDevice, answer: tuple[Any, ...]) -> DeviceControl:
    number, kind, label, least, most, step, default, flags = answer[:8]
    menu: dict[int, str] = {}
    if KINDS[kind] == "menu":
        menu = _menu(device, number, kind, range(least, min(most, least + 255) + 1))
    return DeviceControl(
        simple(abi.text(label)),
        number,
        KINDS[kind],
        least,
        most,
        step,
        default,
        _value(device, number, flags),
        menu,
        flags,
    )


def _menu(device: CaptureDevice, number: int, kind: int, places: range) -> dict[int, str]:
    items: dict[int, str] = {}
    for place in places:
        try:
            _, _, raw = device.try_to(abi.QUERYMENU, number, place)
        except OSError as exc:
            if exc.errno == errno.EINVAL:  # a menu may have gaps
                continue
            raise device_error(device.path, "listing a menu", exc) from exc
        value = int.from_bytes(raw[:8], sys.byteorder, signed=True)
        items[place] = abi.text(raw) if kind == abi.CTRL_MENU else str(value)
    return items


def _value(device: CaptureDevice, number: int, flags: int) -> int | None:
    if flags & abi.CTRL_WRITE_ONLY:
        return None
    try:
        value: int = device.try_to(abi.G_CTRL, number)[1]
    except OSError as exc:
        if exc.errno == errno.ENODEV:
            raise device_error(device.path, "reading a control", exc) from exc
        return None
    return value
