"""Apply device faults to the camera's device."""

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
class Stage:
    """The object that faults act on."""

    device: Any
    refuse: Callable[[float], None]  # closes the port for a number of seconds
    let_second_client_in: Callable[[], None]  # lets another client connect
    clear: Callable[[], None]  # forgets waiting faults, and ends lasting ones


def _condition(stage: Stage, fault: f.Condition) -> None:
    stage.device.set_condition(_CONDITIONS[fault.condition], fault.active)


def _switch(stage: Stage, fault: f.OperatorSwitch) -> None:
    stage.device.switch_application(fault.application, running=fault.running)


def _move(stage: Stage, fault: f.MovePart) -> None:
    stage.device.scene.pieces[fault.part] = TablePose(fault.x, fault.y, fault.theta)


_ACTIONS: Mapping[type[DeviceFault], Callable[[Stage, Any], object]] = {
    f.Refuse: lambda stage, fault: stage.refuse(fault.seconds),
    f.BusyForEver: lambda stage, fault: stage.device.hold_busy(fault.seconds),
    f.Overtrigger: lambda stage, fault: stage.device.drop_triggers(fault.count),
    f.SecondClient: lambda stage, _: stage.let_second_client_in(),
    f.PowerCycle: lambda stage, fault: stage.device.reboot(fault.seconds),
    f.OperatorSwitch: _switch,
    f.OperatorStop: lambda stage, _: stage.device.stop(),
    f.OperatorStart: lambda stage, _: stage.device.start(),
    f.Condition: _condition,
    f.LateResult: lambda stage, fault: stage.device.change_run(late=fault.seconds),
    f.NoResult: lambda stage, _: stage.device.change_run(silent=True),
    f.ExtraResult: lambda stage, fault: stage.device.change_run(extra=fault.count),
    f.DigitalInput: lambda stage, _: stage.device.trigger(),
    f.ChangeByteOrder: lambda stage, fault: stage.device.set_endian(fault.endian),
    f.MovePart: _move,
    f.RemovePart: lambda stage, fault: stage.device.scene.pieces.pop(fault.part, None),
    f.ClearFaults: lambda stage, _: stage.clear(),
}


_NEEDS: Mapping[type[DeviceFault], str] = {
    f.BusyForEver: "hold_busy",
    f.Overtrigger: "drop_triggers",
    f.SecondClient: "disconnect",
    f.PowerCycle: "reboot",
    f.OperatorSwitch: "switch_application",
    f.OperatorStop: "stop",
    f.OperatorStart: "start",
    f.Condition: "set_condition",
    f.LateResult: "change_run",
    f.NoResult: "change_run",
    f.ExtraResult: "change_run",
    f.DigitalInput: "trigger",
    f.ChangeByteOrder: "set_endian",
    f.MovePart: "scene",
    f.RemovePart: "scene",
}
"""Methods that a device needs for a fault, by name; other faults need no methods."""


def kinds_of(device: object) -> frozenset[str]:
    """Return the kinds of faults that a camera with this kind of device supports."""
    return frozenset(
        kind
        for kind, fault in f.FAULTS.items()
        if not issubclass(fault, DeviceFault)
        or fault not in _NEEDS
        or hasattr(device, _NEEDS[fault])
    )


def act(stage: Stage, fault: DeviceFault) -> None:
    """Apply a device fault."""
    _ACTIONS[type(fault)](stage, fault)
