"""Faults on the wire: what happens to a message on its way."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from smartcam.emulator.faults.base import (
    MAX_BYTES,
    MESSAGE_NAMES,
    CameraWireFault,
    EndingFault,
    FaultBytes,
    MessageName,
    Seconds,
    WireFault,
    known_name,
)
from smartcam.models import Status
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = [
    "Close",
    "Coalesce",
    "Corrupt",
    "Delay",
    "Drop",
    "Duplicate",
    "HalfOpen",
    "Insert",
    "Reset",
    "Split",
    "Truncate",
]


class Delay(WireFault):
    """The message comes later.

    On TCP everything behind it waits too, unless ``overtaken``. On UDP it is this datagram alone.
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
    """The message waits for those behind it; they come in one write, or one datagram.

    Source: several messages may come in one TCP segment (newest SC manual p. 40, published).
    """

    kind: Literal["coalesce"] = "coalesce"
    count: int = Field(default=1, ge=1, le=1000, description="Messages it waits for.")
    seconds: Seconds = Field(
        default=1.0, description="How long it waits for them at most, s, before it goes without."
    )


class Truncate(CameraWireFault):
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


class Insert(CameraWireFault):
    """Something that the camera did not say; exactly one of ``data`` and ``message`` is it.

    Faults behind it in the list leave what stands before or after the message alone; what stands
    instead of it counts as the message.
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
        default="before", description="Where it stands: beside the message or in place of it."
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


class HalfOpen(EndingFault):
    """From that message on nothing is sent and nothing is read on this connection.

    It stays open, as when a cable is pulled; the session stays with it until another client
    connects. It ends with a reset after ``seconds``, when the emulator stops or when the faults are
    cleared; so long it counts among the connections, of which there are 32 at most. On UDP
    datagrams in both directions are lost for that time.
    """

    kind: Literal["half_open"] = "half_open"
    seconds: Seconds | None = Field(
        default=None, description="How long, s; None: until the emulator stops."
    )


class Reset(EndingFault):
    """The connection ends by a reset (RST). On UDP the camera forgets the session in silence.

    What the client has not read when the reset comes may be lost to it.
    """

    kind: Literal["reset"] = "reset"


class Close(EndingFault):
    """The connection ends in order (FIN). On UDP the camera forgets the session in silence."""

    kind: Literal["close"] = "close"
