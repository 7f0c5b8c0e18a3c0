"""Apply device faults to the simulated device of an emulated camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from smartcam.emulator import faults as f
from smartcam.emulator._scene import TablePose
from smartcam.emulator.faults._base import DeviceFault
from smartcam.models import Status

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


_CONDITIONS = {"system_error": Status.SYSTEM_ERROR, "overheat": Status.OVERHEAT}


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultTargets:
    """The device that faults change, and the camera's functions for faults beyond the device."""

    device: Any
    refuse: Callable[[float], None]  # closes the port for a number of seconds
    let_second_client_in: Callable[[], None]  # lets another client connect
    clear: Callable[[], None]  # forgets waiting faults, and ends lasting ones


def _condition(targets: FaultTargets, fault: f.Condition) -> None:
    targets.device.set_condition(_CONDITIONS[fault.condition], fault.active)


def _switch(targets: FaultTargets, fault: f.OperatorSwitch) -> None:
    targets.device.switch_application(fault.application, running=fault.running)


def _move(targets: FaultTargets, fault: f.MovePart) -> None:
    targets.device.scene.pieces[fault.part] = TablePose(fault.x, fault.y, fault.theta)


_ACTIONS: Mapping[type[DeviceFault], Callable[[FaultTargets, Any], object]] = {
    f.Refuse: lambda targets, fault: targets.refuse(fault.seconds),
    f.BusyForEver: lambda targets, fault: targets.device.hold_busy(fault.seconds),
    f.Overtrigger: lambda targets, fault: targets.device.drop_triggers(fault.count),
    f.SecondClient: lambda targets, _: targets.let_second_client_in(),
    f.PowerCycle: lambda targets, fault: targets.device.reboot(fault.seconds),
    f.OperatorSwitch: _switch,
    f.OperatorStop: lambda targets, _: targets.device.stop(),
    f.OperatorStart: lambda targets, _: targets.device.start(),
    f.Condition: _condition,
    f.LateResult: lambda targets, fault: targets.device.change_inspection(late=fault.seconds),
    f.NoResult: lambda targets, _: targets.device.change_inspection(no_result=True),
    f.ExtraResult: lambda targets, fault: targets.device.change_inspection(extra=fault.count),
    f.DigitalInput: lambda targets, _: targets.device.trigger(),
    f.ChangeByteOrder: lambda targets, fault: targets.device.set_endian(fault.endian),
    f.MovePart: _move,
    f.RemovePart: lambda targets, fault: targets.device.scene.pieces.pop(fault.part, None),
    f.ClearFaults: lambda targets, _: targets.clear(),
}


_NEEDED_ATTRIBUTES: Mapping[type[DeviceFault], str] = {
    f.BusyForEver: "hold_busy",
    f.Overtrigger: "drop_triggers",
    f.SecondClient: "disconnect",  # the camera calls it to free its session
    f.PowerCycle: "reboot",
    f.OperatorSwitch: "switch_application",
    f.OperatorStop: "stop",
    f.OperatorStart: "start",
    f.Condition: "set_condition",
    f.LateResult: "change_inspection",
    f.NoResult: "change_inspection",
    f.ExtraResult: "change_inspection",
    f.DigitalInput: "trigger",
    f.ChangeByteOrder: "set_endian",
    f.MovePart: "scene",
    f.RemovePart: "scene",
}
"""Attribute that a device must have for a fault; other faults need none."""


def supported_faults(device: object) -> frozenset[str]:
    """Return the kinds of faults that a camera with this kind of device supports."""
    return frozenset(
        kind
        for kind, fault in f.FAULTS.items()
        if not issubclass(fault, DeviceFault)
        or fault not in _NEEDED_ATTRIBUTES
        or hasattr(device, _NEEDED_ATTRIBUTES[fault])
    )


def apply_fault(targets: FaultTargets, fault: DeviceFault) -> None:
    """Apply a device fault."""
    _ACTIONS[type(fault)](targets, fault)
