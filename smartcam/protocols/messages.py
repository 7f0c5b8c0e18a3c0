"""The words that client and camera exchange, whatever the wire looks like.

Each message is a frozen dataclass that declares its body once: a field's annotation says what it is
on the wire (:data:`Word`, :data:`UInt32`, :data:`Data`). A dialect's table (``protocols/bvs.py``)
says which message has which id; codecs, construct views and the documentation are made from both.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, get_type_hints

from smartcam.models import Status

__all__ = [
    "ClockAnswer",
    "Connect",
    "ConnectAnswer",
    "Data",
    "Disconnect",
    "GetClock",
    "Message",
    "Query",
    "QueryAnswer",
    "Reboot",
    "ResultContainer",
    "Sender",
    "SetClock",
    "SetInput",
    "SetSequenceNumber",
    "Start",
    "StatusReport",
    "Stop",
    "SwitchAnswer",
    "SwitchApplication",
    "Trigger",
    "UInt32",
    "UnknownMessage",
    "Wire",
    "Word",
    "wire_fields",
]


class Sender(enum.Enum):
    """Who sends a message."""

    CLIENT = "client"
    CAMERA = "camera"


class Wire(enum.Enum):
    """What a field is on the wire."""

    WORD = "word"
    """An unsigned integer of the dialect's word size: UINT32 or UINT16."""
    UINT32 = "uint32"
    """Four bytes in every dialect."""
    DATA = "data"
    """Every byte to the end of the frame; the last field only."""


Word = Annotated[int, Wire.WORD]
UInt32 = Annotated[int, Wire.UINT32]
Data = Annotated[bytes, Wire.DATA]
StatusWord = Annotated[Status, Wire.WORD]


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """Base of all messages.

    Attributes:
        sender: who may send it.
    """

    sender: ClassVar[Sender]


@dataclass(frozen=True, slots=True, kw_only=True)
class Request(Message):
    """A message from client to camera.

    Attributes:
        answer: the message type the camera answers with, None where it never does.
    """

    sender: ClassVar[Sender] = Sender.CLIENT
    answer: ClassVar[type[Message] | None] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Report(Message):
    """A message from camera to client: an answer, or sent by itself."""

    sender: ClassVar[Sender] = Sender.CAMERA


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectAnswer(Report):
    """The session is there. ``version`` counts up with the protocol; 1 is the only one known."""

    version: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusReport(Report):
    """The status word; sent after Connect and after every change.

    Attributes:
        status: the bits.
        endian: byte order of result containers and input data: 0 little (published), 1 big
            (inferred). It does not affect headers and messages.
    """

    status: StatusWord
    endian: Word = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultContainer(Report):
    """What an inspection sent: the id of its application and bytes without types or names."""

    application: Word
    data: Data


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryAnswer(Report):
    """Id of the active application."""

    application: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class SwitchAnswer(Report):
    """Comes after the switch. ``code`` 0: done, 1: id invalid; ``application`` is active now."""

    code: Word
    application: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockAnswer(Report):
    """The camera's clock; it carries no time zone."""

    year: Word
    month: Word
    day: Word
    hour: Word
    minute: Word
    second: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class Connect(Request):
    """Start a session; the answer and a status follow."""

    answer: ClassVar[type[Message] | None] = ConnectAnswer


@dataclass(frozen=True, slots=True, kw_only=True)
class Disconnect(Request):
    """End the session: neither results nor status after it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Query(Request):
    """Ask for the active application."""

    answer: ClassVar[type[Message] | None] = QueryAnswer


@dataclass(frozen=True, slots=True, kw_only=True)
class SwitchApplication(Request):
    """Load another application; the active one must be stopped."""

    answer: ClassVar[type[Message] | None] = SwitchAnswer

    application: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class GetClock(Request):
    """Ask for the clock."""

    answer: ClassVar[type[Message] | None] = ClockAnswer


@dataclass(frozen=True, slots=True, kw_only=True)
class SetClock(Request):
    """Set the clock; invalid values may be dropped or converted."""

    year: Word
    month: Word
    day: Word
    hour: Word
    minute: Word
    second: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class SetInput(Request):
    """Input data for the next inspection, laid out as its "Receive data" tool says."""

    data: Data


@dataclass(frozen=True, slots=True, kw_only=True)
class SetSequenceNumber(Request):
    """Number of the next run."""

    number: UInt32


@dataclass(frozen=True, slots=True, kw_only=True)
class Trigger(Request):
    """Run a triggered application once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Start(Request):
    """Enter run mode."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop(Request):
    """Leave run mode."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reboot(Request):
    """Restart the camera. The manual's name is "Trigger reset"; it clears no trigger."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnknownMessage(Message):
    """A whole frame with an id that the dialect does not know, or one sent as raw bytes."""

    message_id: int
    payload: bytes


def wire_fields(message_type: type[Message]) -> tuple[tuple[str, Wire], ...]:
    """Return name and wire type of each field of a message's body, in order."""
    hints: dict[str, Any] = get_type_hints(message_type, include_extras=True)
    return tuple(
        (name, hint.__metadata__[0])
        for name, hint in hints.items()
        if hasattr(hint, "__metadata__") and isinstance(hint.__metadata__[0], Wire)
    )
