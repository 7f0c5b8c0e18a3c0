"""The base classes of faults, which define the message that a fault waits for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import (
    BeforeValidator,
    Field,
    PlainSerializer,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
    model_validator,
)

from smartcam.emulator._data import EmulatorData
from smartcam.protocols import BVS
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Mapping

MAX_BYTES = 1 << 16
"""Largest number of bytes that one fault inserts: about as many as the largest container has."""

MESSAGE_NAMES: Mapping[str, type[m.Message]] = {
    row.type.__name__: row.type for dialect in BVS.dialects.values() for row in dialect.table
}
"""The messages that a fault can name, by the name of their class."""

_SENDERS = {sender.value: sender for sender in m.Sender}


def message_name(value: object) -> object:
    """Return the name of a message class; anything else unchanged, but no bool."""
    if isinstance(value, bool):
        raise ValueError("expected a message's name or id")  # noqa: TRY004  pydantic wants a ValueError
    return value.__name__ if isinstance(value, type) else value


def known_name(value: str) -> str:
    """Return the name of a message.

    Raises:
        ValueError: no message has this name.
    """
    if value not in MESSAGE_NAMES:
        raise ValueError(f"no message is called {value!r}; there are {', '.join(MESSAGE_NAMES)}")
    return value


def _from_hex(value: object) -> object:
    return bytes.fromhex(value) if isinstance(value, str) else value


def _to_hex(value: bytes) -> str:
    return value.hex()


FaultBytes = Annotated[
    bytes,
    BeforeValidator(_from_hex),
    PlainSerializer(_to_hex, return_type=str, when_used="json"),
    WithJsonSchema({"type": "string", "format": "hex"}),
    Field(min_length=1, max_length=MAX_BYTES),
]
On = Annotated[
    str | int | type[m.Message] | None,
    BeforeValidator(message_name),
    WithJsonSchema({"anyOf": [{"enum": list(MESSAGE_NAMES)}, {"type": "integer"}]}),
]
MessageName = Annotated[
    str | type[m.Message],
    BeforeValidator(message_name),
    WithJsonSchema({"enum": list(MESSAGE_NAMES)}),
]


class BaseFault(EmulatorData):
    """Base of all faults: the choice of the message that a fault waits for."""

    default_sender: ClassVar[m.Sender]
    """Sender if neither ``on`` nor ``sender`` names one."""
    senders: ClassVar[frozenset[m.Sender]] = frozenset(m.Sender)
    """Senders whose messages the fault can wait for."""
    can_act_at_once: ClassVar[bool]
    """True if a fault without a message to wait for acts at once."""

    on: On = Field(
        default=None,
        description=(
            "The message it waits for: name or class of a message type, or a message id. None is "
            "the next one of the sender; for a device fault without a sender: at once."
        ),
    )
    sender: Literal["camera", "client"] | None = Field(
        default=None,
        description=(
            "Sender of that message, if a message id or nothing stands in `on`. Default: the "
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
        """Restore the key ``on``, which YAML 1.1 reads as true."""
        if isinstance(data, dict) and True in data and "on" not in data:
            return {"on" if key is True else key: value for key, value in data.items()}
        return data

    @field_validator("on")
    @classmethod
    def _check_on(cls, value: str | int | None) -> str | int | None:
        if isinstance(value, str):
            cls._check_sender_fits(MESSAGE_NAMES[known_name(value)].sender)
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
            raise ValueError("a fault that waits for no message happens once, at once")
        return value

    @classmethod
    def _check_sender_fits(cls, sender: m.Sender) -> None:
        if sender not in cls.senders:
            raise ValueError(f"{cls.__name__} cannot act on messages of the {sender.value}")

    @property
    def awaited_sender(self) -> m.Sender | None:
        """Sender of the message that the fault waits for, None if it acts at once."""
        if isinstance(self.on, str):
            return MESSAGE_NAMES[self.on].sender
        if self.sender is not None:
            return _SENDERS[self.sender]
        return None if self.on is None and self.can_act_at_once else self.default_sender

    def fits(self, name: str, message_id: int) -> bool:
        """Return True if the fault waits for this kind of message of its sender."""
        return self.on is None or self.on == name or self.on == message_id


class WireFault(BaseFault):
    """Base of the faults on the wire."""

    default_sender: ClassVar[m.Sender] = m.Sender.CAMERA
    can_act_at_once: ClassVar[bool] = False


class CameraWireFault(WireFault):
    """Base of the faults that act on the camera's messages only."""

    senders: ClassVar[frozenset[m.Sender]] = frozenset({m.Sender.CAMERA})


class EndingFault(WireFault):
    """Base of the faults that end a connection."""

    when: Literal["before", "after"] = Field(
        default="before",
        description=(
            "`before`: instead of the message, which is not delivered. `after`: right after it; a "
            "message of the client is then received, and the camera's first answer is sent."
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
            "camera: messages that the fault causes are sent before it, or after it."
        ),
    )
