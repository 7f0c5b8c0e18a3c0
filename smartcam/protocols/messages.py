"""The words that client and camera exchange, whatever the wire looks like.

Each message is a frozen dataclass that declares its body once: a field's annotation says what it is
on the wire (:data:`Word`, :data:`UInt32`, :data:`Data`). A dialect's table
(``protocols/_bvs.py``) says which message has which id, and which of its fields the dialect leaves
out; codecs, construct views and the documentation are made from both. When a message may come is
said in ``protocols/_framed/machine.py``: a request or report that is new stands among those of a
session there.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, NamedTuple, get_type_hints

from smartcam.models import Status

__all__ = [
    "Acknowledgement",
    "CellValue",
    "ClockAnswer",
    "Connect",
    "ConnectAnswer",
    "Data",
    "Disconnect",
    "DisconnectAnswer",
    "EndTrigger",
    "GetClock",
    "GetStatus",
    "Image",
    "LoadFile",
    "MalformedMessage",
    "Message",
    "Notice",
    "Query",
    "QueryAnswer",
    "ReadImage",
    "Reboot",
    "Report",
    "Request",
    "ResetErrors",
    "ResetErrorsAnswer",
    "ResultContainer",
    "Sender",
    "SetClock",
    "SetClockAnswer",
    "SetInput",
    "SetInputAnswer",
    "SetSequenceNumber",
    "Start",
    "StartAnswer",
    "StatusReport",
    "Stop",
    "StopAnswer",
    "SwitchAnswer",
    "SwitchApplication",
    "Trigger",
    "TriggerAnswer",
    "UInt32",
    "UnknownMessage",
    "Word",
]


class Sender(enum.Enum):
    """The side that sends a message."""

    __hash__ = object.__hash__  # each is one object; enum's own is a function in Python

    CLIENT = "client"
    CAMERA = "camera"


class Wire(enum.Enum):
    """The form of a field on the wire."""

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

    One without fields of its own is what its base makes of it, and no dataclass by itself: making
    one takes as long as importing a module.

    Attributes:
        sender: side of the link that may send the message.
    """

    sender: ClassVar[Sender]


class Request(Message):
    """A message from client to camera.

    Attributes:
        answer: the message type the camera answers with in a dialect that has it, None if it never
            does.
    """

    __slots__ = ()
    sender: ClassVar[Sender] = Sender.CLIENT
    answer: ClassVar[type[Message] | None] = None


class Report(Message):
    """A message from camera to client: an answer, or sent by itself."""

    __slots__ = ()
    sender: ClassVar[Sender] = Sender.CAMERA


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledgement(Report):
    """The answer to a command in a dialect with result codes; which code means what it says.

    Attributes:
        code: what became of the request; a dialect without result codes leaves it out: 0.
    """

    code: Word = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectAnswer(Acknowledgement):
    """The session is there. ``version`` counts up with the protocol; 1 is the only one known."""

    version: Word


class DisconnectAnswer(Acknowledgement):
    """The session is over."""

    __slots__ = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusReport(Report):
    """The status word; sent after Connect and after every change.

    Attributes:
        status: the bits.
        endian: byte order of result containers and input data: 0 little (published), 1 big
            (inferred). It does not affect headers and messages. Where a dialect leaves it out
            everything is little endian.
    """

    status: StatusWord
    endian: Word = 0


UNNAMED_APPLICATION = -1
"""Application of a result container that does not say whose it is, or that has no id."""


class CellValue(NamedTuple):
    """A value as text: the name of its cell, and the text, None for a cell that has none."""

    cell: str
    text: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultContainer(Report):
    """The result of an inspection: its application's id, and bytes without types or names.

    Attributes:
        application: id of the application.
        data: bytes of the values.
        cells: the values that ``data`` was put together from, where the protocol has them as
            texts. The fields of a layout are these values, in order.
        fault: reason why the values cannot come from one inspection, None if nothing speaks against
            it.
        asked: whether the wire says that it answers a trigger of this client, the one that is under
            way or was given up last, or that it answers none; None if the wire does not say so.
    """

    application: Word = UNNAMED_APPLICATION
    data: Data
    cells: tuple[CellValue, ...] | None = None
    fault: str | None = None
    asked: bool | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Notice(Report):
    """A remark of the camera's own that is neither a status nor a result.

    Attributes:
        kind: ``"error"``, ``"notification"`` or ``"debug"``.
        code: the camera's number of it, 0 where it has none.
        text: what the camera says.
    """

    kind: str = "error"
    code: int = 0
    text: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryAnswer(Acknowledgement):
    """Id of the active application."""

    application: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class SwitchAnswer(Acknowledgement):
    """Comes after the switch. ``code`` says what became of it; ``application`` is active now."""

    application: Word


class TriggerAnswer(Acknowledgement):
    """The trigger was understood; not whether an inspection began."""

    __slots__ = ()


class SetClockAnswer(Acknowledgement):
    """The clock is set, or why not."""

    __slots__ = ()


class SetInputAnswer(Acknowledgement):
    """The input data (BVS ID: the reference value) is taken, or why not."""

    __slots__ = ()


class ResetErrorsAnswer(Acknowledgement):
    """The error bits are reset; a status follows."""

    __slots__ = ()


class StartAnswer(Acknowledgement):
    """Run mode is entered, or why not."""

    __slots__ = ()


class StopAnswer(Acknowledgement):
    """Run mode is left, or why not."""

    __slots__ = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Image(Acknowledgement):
    """A picture, in the file format that the camera has."""

    data: Data


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockAnswer(Acknowledgement):
    """The camera's clock; it carries no time zone."""

    year: Word
    month: Word
    day: Word
    hour: Word
    minute: Word
    second: Word


class Connect(Request):
    """Start a session; the answer and a status follow."""

    __slots__ = ()
    answer: ClassVar[type[Message] | None] = ConnectAnswer


class Disconnect(Request):
    """End the session: neither results nor status after it."""

    __slots__ = ()


class GetStatus(Request):
    """Ask for the status."""

    __slots__ = ()
    answer: ClassVar[type[Message] | None] = StatusReport


class ResetErrors(Request):
    """Clear the error bits that stay set until then; a status follows the answer."""

    __slots__ = ()
    answer: ClassVar[type[Message] | None] = ResetErrorsAnswer


class Query(Request):
    """Ask for the active application."""

    __slots__ = ()
    answer: ClassVar[type[Message] | None] = QueryAnswer


@dataclass(frozen=True, slots=True, kw_only=True)
class SwitchApplication(Request):
    """Load another application; the active one must be stopped."""

    answer: ClassVar[type[Message] | None] = SwitchAnswer

    application: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadFile(Request):
    """Load the application of a file's name; the active one must be stopped."""

    answer: ClassVar[type[Message] | None] = SwitchAnswer

    name: Data


class ReadImage(Request):
    """Ask for the last picture."""

    __slots__ = ()
    answer: ClassVar[type[Message] | None] = Image


class GetClock(Request):
    """Ask for the clock."""

    __slots__ = ()
    answer: ClassVar[type[Message] | None] = ClockAnswer


@dataclass(frozen=True, slots=True, kw_only=True)
class SetClock(Request):
    """Set the clock; invalid values may be dropped or converted."""

    answer: ClassVar[type[Message] | None] = SetClockAnswer

    year: Word
    month: Word
    day: Word
    hour: Word
    minute: Word
    second: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class SetInput(Request):
    """Input data for the next inspection, laid out as its "Receive data" tool says.

    On BVS ID it is the reference value, filled with zeros to its configured length.
    """

    answer: ClassVar[type[Message] | None] = SetInputAnswer

    data: Data


@dataclass(frozen=True, slots=True, kw_only=True)
class SetSequenceNumber(Request):
    """Number of the next run."""

    number: UInt32


class Trigger(Request):
    """Run a triggered application once."""

    __slots__ = ()
    answer: ClassVar[type[Message] | None] = TriggerAnswer


class EndTrigger(Request):
    """End the trigger under way now: what the camera has by then is its result."""

    __slots__ = ()


class Start(Request):
    """Enter run mode."""

    __slots__ = ()
    answer: ClassVar[type[Message] | None] = StartAnswer


class Stop(Request):
    """Leave run mode."""

    __slots__ = ()
    answer: ClassVar[type[Message] | None] = StopAnswer


class Reboot(Request):
    """Restart the camera. The manual's name is "Trigger reset"; it clears no trigger."""

    __slots__ = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class UnknownMessage(Message):
    """A whole frame with an id that the dialect does not know, or one sent as raw bytes."""

    message_id: int
    payload: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class MalformedMessage(Message):
    """A whole frame with a known id whose body is too short or too long.

    A camera that answers with result codes gets it; elsewhere such a frame is dropped.
    """

    message_id: int
    payload: bytes


def wire_fields(message_type: type[Message]) -> tuple[tuple[str, Wire], ...]:
    """Return name and wire type of each field of a message's body, in order.

    They are all that any dialect has; a dialect's row says which of them are on its wire.
    """
    found = _WIRE_FIELDS.get(message_type)
    if found is None:
        hints: dict[str, Any] = get_type_hints(message_type, include_extras=True)
        found = _WIRE_FIELDS[message_type] = tuple(
            (name, hint.__metadata__[0])
            for name, hint in hints.items()
            if hasattr(hint, "__metadata__") and isinstance(hint.__metadata__[0], Wire)
        )
    return found


_WIRE_FIELDS: dict[type[Message], tuple[tuple[str, Wire], ...]] = {}  # hints are slow to read
