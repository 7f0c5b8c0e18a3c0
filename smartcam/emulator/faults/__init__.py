"""Faults: exact misbehaviour of an emulated camera and its wire, as data.

A fault names the message that it waits for, and its effect. Give a list of faults to
:class:`~smartcam.emulator.EmulatedCamera`, or inject them while it runs::

    EmulatedCamera(faults=[faults.Drop(on="QueryAnswer"), {"kind": "reset", "on": "Trigger"}])

Which message: ``on`` names its type, or gives its id on the wire. Each fault counts the messages
that fit, from the moment it was given, independently of other faults: their effects do not
change the count, and inserted or duplicated messages are not counted. The fault applies to the
``nth`` message and to those directly after it, ``times`` in all. If several faults apply to one
message, they act in the order in which they were given, each on the result of the one before.

*Wire faults* change the messages on the wire. A fault on messages of the camera counts its messages
to one client, a fault on messages of a client counts whole frames of all clients, before the camera
receives them. *Device faults* are events of the camera. They count the messages that its device
handles: a Connect, and the messages of the session.

Nothing depends on chance: the same list and the same messages give the same bytes.

To add a fault, write a class here, with a ``kind``, and list it in ``__all__`` and in one of the
unions below. Add its effect as a row to ``_CHANGES`` (of one transmission) or ``_REBUILDS`` (of all
transmissions of a message) in ``_wire_effects.py``, or to ``_ACTIONS`` in ``_device_effects.py``.
Then write the schema again (``smartcam-emulator --schema``); ``docs/emulator.md`` shows the
docstrings.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeAlias, get_args

from pydantic import (
    Field,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from smartcam._arguments import check_iterable
from smartcam.emulator._data import Seconds
from smartcam.emulator.faults._base import (
    MAX_BYTES,
    MESSAGE_NAMES,
    BaseFault,
    CameraWireFault,
    DeviceFault,
    EndingFault,
    FaultBytes,
    MessageName,
    WireFault,
    known_name,
)
from smartcam.exceptions import ConfigurationError
from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.settings import validation_text

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

__all__ = [
    "BusyForEver",
    "ChangeByteOrder",
    "ClearFaults",
    "Close",
    "Coalesce",
    "Condition",
    "Corrupt",
    "Delay",
    "DigitalInput",
    "Drop",
    "Duplicate",
    "ExtraResult",
    "HalfOpen",
    "Insert",
    "LateResult",
    "MovePart",
    "NoResult",
    "OperatorStart",
    "OperatorStop",
    "OperatorSwitch",
    "Overtrigger",
    "PowerCycle",
    "Refuse",
    "RemovePart",
    "Reset",
    "SecondClient",
    "Split",
    "Truncate",
]

MAX_FAULTS = 10_000
"""Largest number of faults that wait at one time, as every message is compared with all of them."""

MAX_FIRED = 1000
"""Largest number of records kept of faults that have happened; the oldest are dropped first."""


# ---------------------------------------------------------------------- on the wire


class Delay(WireFault):
    """The message comes later.

    On TCP everything after it waits too, unless ``overtaken``. On UDP only this datagram waits.
    """

    kind: Literal["delay"] = "delay"
    seconds: Seconds = Field(
        description="How much later, s, counted from when it was sent. Several delays add up."
    )
    overtaken: bool = Field(
        default=False,
        description=(
            "TCP: later messages pass it. A network never does that to a stream; a camera with "
            "several tasks might (inferred)."
        ),
    )


class Split(CameraWireFault):
    """The message comes in two pieces: two writes on TCP, two datagrams on UDP."""

    kind: Literal["split"] = "split"
    after: int = Field(
        ge=1,
        le=MAX_BYTES,
        description="Bytes in the first piece, header included. Shorter messages stay whole.",
    )
    pause: Seconds = Field(
        default=0.0,
        description=(
            "Between the pieces, s. At 0 they are two writes one right after the other, which a "
            "client may still read at once."
        ),
    )


class Coalesce(CameraWireFault):
    """The message waits for those after it; they come in one write, or one datagram.

    Source: several messages may come in one TCP segment (newest SC manual p. 40, published).
    """

    kind: Literal["coalesce"] = "coalesce"
    count: int = Field(default=1, ge=1, le=1000, description="Messages it waits for.")
    seconds: Seconds = Field(
        default=1.0, description="How long it waits for them at most, s, before it goes without."
    )


class Truncate(CameraWireFault):
    """Only the beginning of the message comes."""

    kind: Literal["truncate"] = "truncate"
    keep: int = Field(
        ge=0,
        le=MAX_BYTES,
        description="Bytes that come, header included. A shorter message comes whole.",
    )
    then: Literal["close", "reset", "stall", "continue"] = Field(
        default="close",
        description=(
            "What follows: `close` and `reset` end the connection as the faults of that name do; "
            "`stall`: nothing more is sent on it, while the camera goes on reading; "
            "`continue`: the next message as if nothing was missing."
        ),
    )


class Corrupt(WireFault):
    """One byte of the message is changed; exactly one of ``xor`` and ``value`` is given."""

    kind: Literal["corrupt"] = "corrupt"
    offset: int = Field(
        ge=-MAX_BYTES,
        le=MAX_BYTES,
        description=(
            "Which byte, from the first one of the header; negative: from the end, -1 the last. "
            "A message without that byte stays as it is."
        ),
    )
    xor: int | None = Field(default=None, ge=1, le=255, description="Bits to invert.")
    value: int | None = Field(default=None, ge=0, le=255, description="New value of the byte.")

    @model_validator(mode="after")
    def _check_change(self) -> Corrupt:
        if (self.xor is None) is (self.value is None):
            raise ValueError("expected exactly one of xor and value")
        return self


class Drop(WireFault):
    """The message is lost.

    Source: UDP does not guarantee delivery (newest SC manual p. 40, published).
    """

    kind: Literal["drop"] = "drop"


class Duplicate(WireFault):
    """The message comes more than once, one right after the other."""

    kind: Literal["duplicate"] = "duplicate"
    copies: int = Field(default=1, ge=1, le=100, description="How many more times.")


class Insert(CameraWireFault):
    """A message or bytes that the camera did not send: exactly one of ``message`` and ``data``.

    Later faults in the list do not change what was inserted, unless it is inserted instead of the
    message.
    """

    kind: Literal["insert"] = "insert"
    data: FaultBytes | None = Field(
        default=None, description="The bytes; hex digits in a file. They need not make a frame."
    )
    message: MessageName | None = Field(
        default=None, description="A message, in the dialect spoken: name or class of its type."
    )
    fields: dict[str, int | str] = Field(
        default_factory=dict[str, int | str],
        description="The message's fields: all without a default; `data` as hex digits.",
    )
    where: Literal["before", "after", "instead"] = Field(
        default="before", description="Its place: beside the message or in place of it."
    )

    @field_validator("message")
    @classmethod
    def _check_message(cls, value: str | None) -> str | None:
        return None if value is None else known_name(value)

    @field_validator("fields")
    @classmethod
    def _check_fields(
        cls, value: dict[str, int | str], info: ValidationInfo
    ) -> dict[str, int | str]:
        name = info.data.get("message")
        if value and name is None:
            raise ValueError("fields belong to a message")
        if name is not None:
            _build(name, value)
        return value

    @model_validator(mode="after")
    def _check_one(self) -> Insert:
        if (self.data is None) is (self.message is None):
            raise ValueError("exactly one of data and message is inserted")
        if isinstance(self.message, str):
            _build(self.message, self.fields)
        return self

    @property
    def inserted(self) -> m.Message | None:
        """The message that is inserted, None for bytes."""
        return _build(self.message, self.fields) if isinstance(self.message, str) else None


def _wire_value(where: str, wire: m.Wire, value: int | str) -> bytes | int:
    if wire is m.Wire.DATA and isinstance(value, str):
        return bytes.fromhex(value)
    if wire is not m.Wire.DATA and isinstance(value, int):
        return value
    raise ValueError(f"{where} is {'hex digits' if wire is m.Wire.DATA else 'a number'}")


def _build(name: str, fields: Mapping[str, int | str]) -> m.Message:
    """Return a message.

    Raises:
        ValueError: a field is missing, unknown, or of another type.
    """
    kind = MESSAGE_NAMES[name]
    wire = dict(m.wire_fields(kind))
    values: dict[str, Any] = {}
    for key, value in fields.items():
        if key not in wire:
            raise ValueError(f"{name} has no field {key!r}; it has {', '.join(wire) or 'none'}")
        values[key] = _wire_value(f"{name}.{key}", wire[key], value)
    if isinstance(values.get("status"), int):
        values["status"] = Status(values["status"])
    try:
        return kind(**values)
    except TypeError:
        needed = [f.name for f in dataclasses.fields(kind) if f.default is dataclasses.MISSING]
        missing = ", ".join(key for key in needed if key not in values)
        raise ValueError(f"{name} needs values for {missing}") from None


class HalfOpen(EndingFault):
    """Nothing is sent and nothing is read on the connection from this message on.

    The connection stays open, as when a cable is pulled; it keeps the session until another client
    connects. It ends with a reset after ``seconds``, when the emulator stops or when the faults are
    cleared; until then it counts among the connections, of which there are 32 at most. On UDP
    datagrams in both directions are lost for that time.
    """

    kind: Literal["half_open"] = "half_open"
    seconds: Seconds | None = Field(
        default=None, description="How long, s; None: until the emulator stops."
    )


class Reset(EndingFault):
    """The connection ends by a reset (RST). On UDP the camera forgets the session silently.

    The client may lose bytes that it has not read when the reset comes.
    """

    kind: Literal["reset"] = "reset"


class Close(EndingFault):
    """The connection is closed normally (FIN). On UDP the camera forgets the session silently."""

    kind: Literal["close"] = "close"


# ---------------------------------------------------------------------- of the device

SceneNumber = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]


class Refuse(DeviceFault):
    """The port is closed: new connections are refused. Open connections stay.

    On UDP the session stays, and datagrams in both directions are lost; the client's system may be
    told that the port is closed.
    """

    kind: Literal["refuse"] = "refuse"
    seconds: Seconds = Field(description="How long no connection is taken, s.")


class BusyForEver(DeviceFault):
    """BUSY is set and stays, and no inspection begins; everything else continues as usual."""

    kind: Literal["busy_for_ever"] = "busy_for_ever"
    seconds: Seconds | None = Field(
        default=None,
        description="How long, s; None: until a reboot, or until the faults are cleared.",
    )


class Overtrigger(DeviceFault):
    """Triggers are dropped as if the last image were still being analysed: Overtriggered is set.

    Source: SC manual p. 30 (published for a trigger during an inspection).
    """

    kind: Literal["overtrigger"] = "overtrigger"
    count: int = Field(default=1, ge=1, le=1_000_000, description="Triggers, from the next one on.")


class SecondClient(DeviceFault):
    """Another client connects and gets the session by the camera's own rules.

    On TCP the first client's connection is closed, unless the quirk ``second_client`` refuses
    newcomers; on UDP the first client is not informed. The camera sends to the second client until
    another client connects, or until the faults are cleared.

    Source: the newcomer wins (SC manual p. 28, published for UDP; inferred for TCP).
    """

    kind: Literal["second_client"] = "second_client"


class PowerCycle(DeviceFault):
    """The camera restarts, as by its power switch."""

    kind: Literal["reboot"] = "reboot"
    seconds: Seconds | None = Field(
        default=None, description="Until it is up again, s; None: the quirk `reboot_time`."
    )


class OperatorSwitch(DeviceFault):
    """An operator loads another application without the client's knowledge."""

    kind: Literal["switch_application"] = "switch_application"
    application: int = Field(ge=1, le=0xFFFFFFFF, description="Id of the application.")
    running: bool = Field(default=False, description="Camera is in run mode afterwards.")


class OperatorStop(DeviceFault):
    """An operator stops the application."""

    kind: Literal["stop"] = "stop"


class OperatorStart(DeviceFault):
    """An operator starts the application."""

    kind: Literal["start"] = "start"


class Condition(DeviceFault):
    """System Error or Overheat is set or cleared.

    Source: SC manual p. 30 and p. 33 (published).
    """

    kind: Literal["condition"] = "condition"
    condition: Literal["system_error", "overheat"] = Field(description="Bit of the status.")
    active: bool = Field(default=True, description="True sets the bit, false clears it.")


class LateResult(DeviceFault):
    """An inspection takes longer: the running one, or else the next."""

    kind: Literal["late_result"] = "late_result"
    seconds: Seconds = Field(description="How much longer the inspection takes, s.")


class NoResult(DeviceFault):
    """An inspection sends nothing: the running one, or else the next."""

    kind: Literal["no_result"] = "no_result"


class ExtraResult(DeviceFault):
    """An inspection sends its container more than once: the running one, or else the next.

    Source: a program may have several "send results" tools (inferred).
    """

    kind: Literal["extra_result"] = "extra_result"
    count: int = Field(default=1, ge=1, le=100, description="How many more times.")


class DigitalInput(DeviceFault):
    """A sensor triggers the camera by its digital input."""

    kind: Literal["digital_input"] = "digital_input"


class ChangeByteOrder(DeviceFault):
    """Result containers and input data are in another byte order from now on."""

    kind: Literal["byte_order"] = "byte_order"
    endian: int = Field(
        ge=0, le=0xFFFFFFFF, description="The status message's field: 0 little, 1 big (inferred)."
    )


class MovePart(DeviceFault):
    """A workpiece of the scene moves; a new name adds one."""

    kind: Literal["move_part"] = "move_part"
    part: str = Field(min_length=1, max_length=200, description="Name of the workpiece.")
    x: SceneNumber = Field(description="To the right, m.")
    y: SceneNumber = Field(description="Away from the table's front, m.")
    theta: SceneNumber = Field(default=0.0, description="Counter-clockwise, rad.")


class RemovePart(DeviceFault):
    """A workpiece is removed from the scene."""

    kind: Literal["remove_part"] = "remove_part"
    part: str = Field(min_length=1, max_length=200, description="Name of the workpiece.")


class ClearFaults(DeviceFault):
    """Waiting faults are forgotten and lasting ones end, as by ``clear_faults()``."""

    kind: Literal["clear_faults"] = "clear_faults"


# ---------------------------------------------------------------------- all faults

_OnMessage: TypeAlias = Delay | Split | Coalesce | Truncate | Corrupt | Drop | Duplicate | Insert
_OnConnection: TypeAlias = HalfOpen | Reset | Close
_OfState: TypeAlias = (
    Refuse | BusyForEver | Overtrigger | SecondClient | PowerCycle | OperatorSwitch
)
_ByOperator: TypeAlias = OperatorStop | OperatorStart | Condition
_OfRun: TypeAlias = LateResult | NoResult | ExtraResult | DigitalInput | ChangeByteOrder
_OfScene: TypeAlias = MovePart | RemovePart
_Any: TypeAlias = (
    _OnMessage | _OnConnection | _OfState | _ByOperator | _OfRun | _OfScene | ClearFaults
)

Fault: TypeAlias = Annotated[_Any, Field(discriminator="kind")]
"""Any fault; as a field's type in pydantic it takes mappings with ``kind``."""

FAULTS: Mapping[str, type[WireFault | DeviceFault]] = {
    kind.model_fields["kind"].default: kind for kind in get_args(_Any)
}
"""Every fault by its ``kind``."""

_ADAPTER: TypeAdapter[Fault] = TypeAdapter(Fault)


class FiredFault(NamedTuple):
    """A fault that has happened.

    Attributes:
        time: seconds of the emulator's clock.
        fault: the fault, as it was given.
        message: the message that the fault applied to, before the fault; None if the fault
            waited for none.
    """

    time: float
    fault: Fault
    message: m.Message | None


def make_faults(given: Iterable[BaseFault | Mapping[str, Any]]) -> tuple[Fault, ...]:
    """Return faults; mappings become faults by their ``kind``.

    Raises:
        ConfigurationError: one of the faults is wrong; the text gives its number, from 1, and
            the field.
    """
    converted: list[Fault] = []
    faults = check_iterable(given, "faults", "a list of faults", "emulator")
    for number, fault in enumerate(faults, start=1):
        try:
            converted.append(_ADAPTER.validate_python(fault))
        except ValidationError as exc:
            raise ConfigurationError(f"fault {number}: {validation_text(exc)}") from exc
    return tuple(converted)
