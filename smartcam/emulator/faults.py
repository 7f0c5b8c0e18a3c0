"""Faults: exact misbehaviour of an emulated camera and its wire, as data.

A fault says which message it waits for and what happens then. Give a list of them to
:class:`~smartcam.emulator.EmulatedCamera`, or inject them while it runs::

    EmulatedCamera(faults=[faults.Drop(on="QueryAnswer"), {"kind": "reset", "on": "Trigger"}])

Which message: ``on`` names its type, or gives its id on the wire. Each fault counts the messages
that fit, from the moment it was given and for itself alone: what other faults do to them does not
change the count, and what faults insert or duplicate is not counted. It applies to the ``nth`` one
and to those directly behind it, ``times`` in all. Where several apply to one message, they act in
the order in which they were given, each on what the one before has left of it.

*Wire faults* change what passes the wire. Those on messages of the camera count what it says to a
client, those on messages of a client count whole frames of any client, before the camera hears
them. *Device faults* are things that happen to the camera. They count what its device handles: a
Connect, and the messages of the session.

There is no chance in any of it: the same list and the same messages give the same bytes.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, TypeAlias, get_args

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
    model_validator,
)

from smartcam.exceptions import ConfigurationError
from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.protocols.bvs import BVS
from smartcam.settings import validation_text

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

__all__ = [
    "FAULTS",
    "MAX_BYTES",
    "MAX_FAULTS",
    "MAX_FIRED",
    "MESSAGE_NAMES",
    "BaseFault",
    "BusyForEver",
    "Close",
    "Coalesce",
    "Condition",
    "Corrupt",
    "Delay",
    "DeviceFault",
    "Drop",
    "Duplicate",
    "ExtraResult",
    "Fault",
    "FiredFault",
    "HalfOpen",
    "Insert",
    "LateResult",
    "NoResult",
    "Overtrigger",
    "Reboot",
    "Refuse",
    "Reset",
    "SecondClient",
    "Split",
    "Start",
    "Stop",
    "SwitchApplication",
    "Truncate",
    "WireFault",
    "make_faults",
]

MAX_FAULTS = 10_000
"""Faults that wait at one time; every message is compared with all of them."""

MAX_FIRED = 1000
"""Records kept of faults that have happened; the oldest go first."""

MAX_BYTES = 1 << 16
"""Bytes that one fault inserts: about as many as the largest container has."""

MESSAGE_NAMES: Mapping[str, type[m.Message]] = {
    row.type.__name__: row.type for dialect in BVS.dialects.values() for row in dialect.table
}
"""The messages that a fault can name, by the name of their class."""

_SENDERS = {sender.value: sender for sender in m.Sender}


def _message_name(value: object) -> object:
    """Return the name of a message class, and anything else as it is."""
    if isinstance(value, bool):
        raise ValueError("a message's name or id")  # noqa: TRY004  pydantic wants a ValueError
    return value.__name__ if isinstance(value, type) else value


def _known_name(value: str) -> str:
    if value not in MESSAGE_NAMES:
        raise ValueError(f"no message is called {value!r}; there are {', '.join(MESSAGE_NAMES)}")
    return value


def _from_hex(value: object) -> object:
    return bytes.fromhex(value) if isinstance(value, str) else value


def _to_hex(value: bytes) -> str:
    return value.hex()


_Seconds = Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)]
_Bytes = Annotated[
    bytes,
    BeforeValidator(_from_hex),
    PlainSerializer(_to_hex, return_type=str, when_used="json"),
    WithJsonSchema({"type": "string", "format": "hex"}),
    Field(min_length=1, max_length=MAX_BYTES),
]
_On = Annotated[
    str | int | type[m.Message] | None,
    BeforeValidator(_message_name),
    WithJsonSchema({"anyOf": [{"enum": list(MESSAGE_NAMES)}, {"type": "integer"}]}),
]
_Name = Annotated[
    str | type[m.Message],
    BeforeValidator(_message_name),
    WithJsonSchema({"enum": list(MESSAGE_NAMES)}),
]


# ---------------------------------------------------------------------- what all have


class BaseFault(BaseModel):
    """Base of all faults: which message it waits for."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")

    default_sender: ClassVar[m.Sender]
    """Whose messages are meant where neither name nor ``sender`` says so."""
    senders: ClassVar[frozenset[m.Sender]] = frozenset(m.Sender)
    """Whose messages it can wait for."""
    can_act_at_once: ClassVar[bool]
    """Whether it acts at once where it is given nothing to wait for."""

    on: _On = Field(
        default=None,
        description=(
            "The message it waits for: name or class of a message type, or a message id. None is "
            "the next one of the sender; for a device fault without a sender: at once."
        ),
    )
    sender: Literal["camera", "client"] | None = Field(
        default=None,
        description=(
            "Who sends that message, where a message id or nothing stands in `on`. Default: the "
            "camera for wire faults, the client for device faults."
        ),
    )
    nth: int = Field(
        default=1,
        ge=1,
        le=1_000_000,
        description="The first message it applies to: 1 is the next that fits.",
    )
    times: int | None = Field(
        default=1,
        ge=1,
        description="To how many messages it applies, one directly after the other; None: always.",
    )

    @model_validator(mode="before")
    @classmethod
    def _read_on(cls, data: Any) -> Any:
        """YAML 1.1 reads a bare ``on`` as true, also where it is a key."""
        if isinstance(data, dict) and True in data and "on" not in data:
            return {"on" if key is True else key: value for key, value in data.items()}
        return data

    @field_validator("on")
    @classmethod
    def _check_on(cls, value: str | int | None) -> str | int | None:
        if isinstance(value, str):
            cls._check_sender_fits(MESSAGE_NAMES[_known_name(value)].sender)
        elif value is not None and not 0 <= value <= 0xFFFFFFFF:
            raise ValueError("a message id has 32 bits")
        return value

    @field_validator("sender")
    @classmethod
    def _check_sender(cls, value: str | None, info: ValidationInfo) -> str | None:
        name = info.data.get("on")
        if value is None:
            return None
        if isinstance(name, str) and MESSAGE_NAMES[name].sender.value != value:
            raise ValueError(f"{name} is a message of the {MESSAGE_NAMES[name].sender.value}")
        cls._check_sender_fits(_SENDERS[value])
        return value

    @field_validator("nth", "times")
    @classmethod
    def _check_count(cls, value: int | None, info: ValidationInfo) -> int | None:
        at_once = info.data.get("on") is None and info.data.get("sender") is None
        if cls.can_act_at_once and at_once and value != 1:
            raise ValueError("without a message to wait for it happens once, at once")
        return value

    @classmethod
    def _check_sender_fits(cls, sender: m.Sender) -> None:
        if sender not in cls.senders:
            raise ValueError(f"{cls.__name__} cannot act on messages of the {sender.value}")

    @property
    def speaker(self) -> m.Sender | None:
        """Who sends the message it waits for, None where it acts at once."""
        if isinstance(self.on, str):
            return MESSAGE_NAMES[self.on].sender
        if self.sender is not None:
            return _SENDERS[self.sender]
        return None if self.on is None and self.can_act_at_once else self.default_sender

    def fits(self, name: str, message_id: int) -> bool:
        """Whether it waits for such a message of its speaker."""
        return self.on is None or self.on == name or self.on == message_id


class WireFault(BaseFault):
    """Base of the faults on the wire."""

    default_sender: ClassVar[m.Sender] = m.Sender.CAMERA
    can_act_at_once: ClassVar[bool] = False


class _CameraWireFault(WireFault):
    """Base of those that act on what the camera says only."""

    senders: ClassVar[frozenset[m.Sender]] = frozenset({m.Sender.CAMERA})


class _EndingFault(WireFault):
    """Base of those that end a connection."""

    when: Literal["before", "after"] = Field(
        default="before",
        description=(
            "`before`: in place of the message, which does not pass. `after`: right behind it; a "
            "message of the client is then heard, and what the camera says to it at once goes out."
        ),
    )


class DeviceFault(BaseFault):
    """Base of the faults of the device."""

    default_sender: ClassVar[m.Sender] = m.Sender.CLIENT
    can_act_at_once: ClassVar[bool] = True

    when: Literal["before", "after"] = Field(
        default="before",
        description=(
            "Before the device handles the client's message, or after it did. On a message of the "
            "camera: what the camera says because of the fault goes out before it, or behind it."
        ),
    )


# ---------------------------------------------------------------------- on the wire


class Delay(WireFault):
    """The message comes later.

    On TCP everything behind it waits too, unless ``overtaken``. On UDP it is this datagram alone.
    """

    kind: Literal["delay"] = "delay"
    seconds: _Seconds = Field(
        description="How much later, s, counted from when it was sent. Several delays add up."
    )
    overtaken: bool = Field(
        default=False,
        description=(
            "TCP: later messages pass it. A network never does that to a stream; a camera with "
            "several tasks might (inferred)."
        ),
    )


class Split(_CameraWireFault):
    """The message comes in two pieces: two writes on TCP, two datagrams on UDP."""

    kind: Literal["split"] = "split"
    after: int = Field(
        ge=1,
        le=MAX_BYTES,
        description="Bytes in the first piece, header included. Shorter messages stay whole.",
    )
    pause: _Seconds = Field(
        default=0.0,
        description=(
            "Between the pieces, s. At 0 they are two writes one right after the other, which a "
            "client may still read at once."
        ),
    )


class Coalesce(_CameraWireFault):
    """The message waits for those behind it; they come in one write, or one datagram.

    Source: several messages may come in one TCP segment (newest SC manual p. 40, published).
    """

    kind: Literal["coalesce"] = "coalesce"
    count: int = Field(default=1, ge=1, le=1000, description="Messages it waits for.")
    seconds: _Seconds = Field(
        default=1.0, description="How long it waits for them at most, s, before it goes without."
    )


class Truncate(_CameraWireFault):
    """Only the message's beginning comes."""

    kind: Literal["truncate"] = "truncate"
    keep: int = Field(
        ge=0, le=MAX_BYTES, description="Bytes that come, header included. A shorter one is whole."
    )
    then: Literal["close", "reset", "stall", "continue"] = Field(
        default="close",
        description=(
            "What follows: `close` and `reset` end the connection as the faults of that name do; "
            "`stall`: nothing more is said on it, while the camera goes on listening; "
            "`continue`: the next message as if nothing was missing."
        ),
    )


class Corrupt(WireFault):
    """One byte of the message is another; exactly one of ``xor`` and ``value`` says which."""

    kind: Literal["corrupt"] = "corrupt"
    offset: int = Field(
        ge=-MAX_BYTES,
        le=MAX_BYTES,
        description=(
            "Which byte, from the first one of the header; negative: from the end, -1 the last. "
            "A message without that byte stays as it is."
        ),
    )
    xor: int | None = Field(default=None, ge=1, le=255, description="Bits that are turned over.")
    value: int | None = Field(default=None, ge=0, le=255, description="What stands there instead.")

    @model_validator(mode="after")
    def _check_change(self) -> Corrupt:
        if (self.xor is None) is (self.value is None):
            raise ValueError("exactly one of xor and value says what stands there")
        return self


class Drop(WireFault):
    """The message is lost.

    Source: UDP does not guarantee delivery (newest SC manual p. 40, published).
    """

    kind: Literal["drop"] = "drop"


class Duplicate(WireFault):
    """The message comes more than once, one right behind the other."""

    kind: Literal["duplicate"] = "duplicate"
    copies: int = Field(default=1, ge=1, le=100, description="How often beside the first time.")


class Insert(_CameraWireFault):
    """Something that the camera did not say; exactly one of ``data`` and ``message`` is it.

    Faults behind it in the list leave what stands before or after the message alone; what stands
    instead of it counts as the message.
    """

    kind: Literal["insert"] = "insert"
    data: _Bytes | None = Field(
        default=None, description="The bytes; hex digits in a file. They need not make a frame."
    )
    message: _Name | None = Field(
        default=None, description="A message, in the dialect spoken: name or class of its type."
    )
    fields: dict[str, int | str] = Field(
        default_factory=dict[str, int | str],
        description="The message's fields: all without a default; `data` as hex digits.",
    )
    where: Literal["before", "after", "instead"] = Field(
        default="before", description="Where it stands: beside the message or in place of it."
    )

    @field_validator("message")
    @classmethod
    def _check_message(cls, value: str | None) -> str | None:
        return None if value is None else _known_name(value)

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
    def word(self) -> m.Message | None:
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


class HalfOpen(_EndingFault):
    """From that message on nothing is sent and nothing is read on this connection.

    It stays open, as when a cable is pulled; the session stays with it until another client
    connects. It ends with a reset after ``seconds``, when the emulator stops or when the faults are
    cleared; so long it counts among the connections, of which there are 32 at most. On UDP
    datagrams in both directions are lost for that time.
    """

    kind: Literal["half_open"] = "half_open"
    seconds: _Seconds | None = Field(
        default=None, description="How long, s; None: until the emulator stops."
    )


class Reset(_EndingFault):
    """The connection ends by a reset (RST). On UDP the camera forgets the session in silence.

    What the client has not read when the reset comes may be lost to it.
    """

    kind: Literal["reset"] = "reset"


class Close(_EndingFault):
    """The connection ends in order (FIN). On UDP the camera forgets the session in silence."""

    kind: Literal["close"] = "close"


# ---------------------------------------------------------------------- the device


class Refuse(DeviceFault):
    """The port is closed: who connects is refused. Connections that are open stay.

    On UDP the session stays, and datagrams in both directions are lost; the client's system may be
    told that nobody listens.
    """

    kind: Literal["refuse"] = "refuse"
    seconds: _Seconds = Field(description="How long, s.")


class BusyForEver(DeviceFault):
    """BUSY is set and stays, and no inspection begins; everything else goes on as ever."""

    kind: Literal["busy_for_ever"] = "busy_for_ever"
    seconds: _Seconds | None = Field(
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
    seconds: _Seconds | None = Field(
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
    seconds: _Seconds = Field(description="How much longer, s.")


class NoResult(DeviceFault):
    """An inspection sends nothing: the one under way, else the next that begins."""

    kind: Literal["no_result"] = "no_result"


class ExtraResult(DeviceFault):
    """An inspection sends its container more than once: the one under way, else the next.

    Source: a program may have several "send results" tools (inferred).
    """

    kind: Literal["extra_result"] = "extra_result"
    count: int = Field(default=1, ge=1, le=100, description="How often beside the first time.")


# ---------------------------------------------------------------------- any of them

_Any: TypeAlias = (
    Delay
    | Split
    | Coalesce
    | Truncate
    | Corrupt
    | Drop
    | Duplicate
    | Insert
    | HalfOpen
    | Reset
    | Close
    | Refuse
    | BusyForEver
    | Overtrigger
    | SecondClient
    | Reboot
    | SwitchApplication
    | Stop
    | Start
    | Condition
    | LateResult
    | NoResult
    | ExtraResult
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
        time: of the emulator's clock, seconds.
        fault: which one, as it was given.
        message: the message it applied to, as its sender meant it; None where it waited for none.
    """

    time: float
    fault: Fault
    message: m.Message | None


def make_faults(given: Iterable[BaseFault | Mapping[str, Any]]) -> tuple[Fault, ...]:
    """Return faults; mappings are made to them by their ``kind``.

    Raises:
        ConfigurationError: one is wrong; the text says which, counted from 1, and names the field.
    """
    made: list[Fault] = []
    for number, one in enumerate(given, start=1):
        try:
            made.append(_ADAPTER.validate_python(one))
        except ValidationError as exc:
            raise ConfigurationError(f"fault {number}: {validation_text(exc)}") from exc
    return tuple(made)
