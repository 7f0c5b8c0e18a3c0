"""The states that an emulated camera can enter."""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

from smartcam.models import Status

if TYPE_CHECKING:
    from collections.abc import Mapping


class DeviceState(enum.Enum):
    """The states that a camera can enter: a mode, an inspection, a session, a status bit."""

    STOPPED = "stopped"
    RUNNING = "running"
    SWITCHING = "switching"
    REBOOTING = "rebooting"
    INSPECTING = "inspecting"
    CONNECTED = "connected"
    DISCONNECTED = "disconnected"
    BUSY = "busy"
    WAITING_FOR_TRIGGER = "waiting_for_trigger"
    OVERTRIGGERED = "overtriggered"
    OVERHEAT = "overheat"
    SYSTEM_ERROR = "system_error"
    INPUT_CONTAINER = "input_container"


_BITS: Mapping[int, DeviceState] = {
    bit.value: DeviceState[bit.name or ""]
    for bit in (
        Status.BUSY,
        Status.WAITING_FOR_TRIGGER,
        Status.OVERTRIGGERED,
        Status.OVERHEAT,
        Status.SYSTEM_ERROR,
        Status.INPUT_CONTAINER,
    )
}
"""Bits of the status word that are states."""


def risen_states(new_bits: int) -> list[DeviceState]:
    """Return the states of the bits of a status word that were not set before."""
    return [state for bit, state in _BITS.items() if new_bits & bit]
