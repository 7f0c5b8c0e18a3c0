"""Faults of the device, and events around it: what happens to the camera."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from smartcam.emulator.faults.base import DeviceFault, Seconds

__all__ = [
    "BusyForEver",
    "ByteOrder",
    "ClearFaults",
    "Condition",
    "DigitalInput",
    "ExtraResult",
    "LateResult",
    "MovePart",
    "NoResult",
    "Overtrigger",
    "Reboot",
    "Refuse",
    "RemovePart",
    "SecondClient",
    "Start",
    "Stop",
    "SwitchApplication",
]

Place = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]


class Refuse(DeviceFault):
    """The port is closed: who connects is refused. Connections that are open stay.

    On UDP the session stays, and datagrams in both directions are lost; the client's system may be
    told that nobody listens.
    """

    kind: Literal["refuse"] = "refuse"
    seconds: Seconds = Field(description="How long, s.")


class BusyForEver(DeviceFault):
    """BUSY is set and stays, and no inspection begins; everything else goes on as ever."""

    kind: Literal["busy_for_ever"] = "busy_for_ever"
    seconds: Seconds | None = Field(
        default=None,
        description="How long, s; None: until a reboot, or until the faults are cleared.",
    )


class Overtrigger(DeviceFault):
    """Triggers are dropped as if the last image were still analysed: Overtriggered rises.

    Source: SC manual p. 30 (published for a trigger during an inspection).
    """

    kind: Literal["overtrigger"] = "overtrigger"
    count: int = Field(default=1, ge=1, le=1_000_000, description="Triggers, from the next one on.")


class SecondClient(DeviceFault):
    """Another client connects and gets the session by the camera's own rules.

    On TCP the first one's connection is closed, unless the quirk ``second_client`` refuses
    newcomers; on UDP it is told nothing. The camera talks to the other one until a client connects,
    or until the faults are cleared.

    Source: the newcomer wins (SC manual p. 28, published for UDP; inferred for TCP).
    """

    kind: Literal["second_client"] = "second_client"


class Reboot(DeviceFault):
    """The camera restarts, as by its power switch."""

    kind: Literal["reboot"] = "reboot"
    seconds: Seconds | None = Field(
        default=None, description="Until it is up again, s; None: the quirk `reboot_time`."
    )


class SwitchApplication(DeviceFault):
    """An operator loads another application behind the client's back."""

    kind: Literal["switch_application"] = "switch_application"
    application: int = Field(ge=1, le=0xFFFFFFFF, description="Its id.")
    running: bool = Field(default=False, description="Whether it runs when it is loaded.")


class Stop(DeviceFault):
    """An operator stops the application."""

    kind: Literal["stop"] = "stop"


class Start(DeviceFault):
    """An operator starts the application."""

    kind: Literal["start"] = "start"


class Condition(DeviceFault):
    """System Error or Overheat comes or goes.

    Source: SC manual p. 30 and p. 33 (published).
    """

    kind: Literal["condition"] = "condition"
    condition: Literal["system_error", "overheat"] = Field(description="Which of the two.")
    active: bool = Field(default=True, description="Whether it comes or goes.")


class LateResult(DeviceFault):
    """An inspection takes longer: the one under way, else the next that begins."""

    kind: Literal["late_result"] = "late_result"
    seconds: Seconds = Field(description="How much longer, s.")


class NoResult(DeviceFault):
    """An inspection sends nothing: the one under way, else the next that begins."""

    kind: Literal["no_result"] = "no_result"


class ExtraResult(DeviceFault):
    """An inspection sends its container more than once: the one under way, else the next.

    Source: a program may have several "send results" tools (inferred).
    """

    kind: Literal["extra_result"] = "extra_result"
    count: int = Field(default=1, ge=1, le=100, description="How often beside the first time.")


class DigitalInput(DeviceFault):
    """A sensor triggers the camera by its digital input."""

    kind: Literal["digital_input"] = "digital_input"


class ByteOrder(DeviceFault):
    """Result containers and input data are in another byte order from now on."""

    kind: Literal["byte_order"] = "byte_order"
    endian: int = Field(
        ge=0, le=0xFFFFFFFF, description="The status message's field: 0 little, 1 big (inferred)."
    )


class MovePart(DeviceFault):
    """A part of the scene lies somewhere else; a new name is a new part."""

    kind: Literal["move_part"] = "move_part"
    part: str = Field(min_length=1, max_length=200, description="Its name.")
    x: Place = Field(description="To the right, m.")
    y: Place = Field(description="Away from the table's front, m.")
    theta: Place = Field(default=0.0, description="Counter-clockwise, rad.")


class RemovePart(DeviceFault):
    """A part is taken from the scene."""

    kind: Literal["remove_part"] = "remove_part"
    part: str = Field(min_length=1, max_length=200, description="Its name.")


class ClearFaults(DeviceFault):
    """Faults that wait are forgotten and those that last end, as by ``clear_faults()``."""

    kind: Literal["clear_faults"] = "clear_faults"
