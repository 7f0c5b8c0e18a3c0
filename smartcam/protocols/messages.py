"""Define the messages that client and camera exchange, independent of their form on the wire.

Each message is a frozen dataclass that declares its body once: a field's annotation is its form
on the wire (:data:`Word`, :data:`UInt32`, :data:`Data`). A dialect's table
(``protocols/_bvs.py``) gives each message its id, and lists the fields that the dialect leaves
out; codecs, construct views and the documentation are made from both. ``TRANSITIONS`` in
``protocols/_framed/machine.py`` lists the states in which each message may come; a new request or
report must be added to the lists from which it is made.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, get_type_hints

from smartcam.models import Status

__all__ = [
    "CellValue",
    "ClockAnswer",
    "Connect",
    "ConnectAnswer",
    "Disconnect",
    "DisconnectAnswer",
    "EndTrigger",
    "GetClock",
    "GetStatus",
    "Image",
    "LoadFile",
    "Message",
    "Notice",
    "Query",
    "QueryAnswer",
    "ReadImage",
    "Reboot",
    "Request",
    "ResetErrors",
    "ResetErrorsAnswer",
    "ResultContainer",
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
    "UnknownMessage",
]


class Sender(enum.Enum):
    """The side that sends a message."""

    if not TYPE_CHECKING:
        __hash__ = object.__hash__  # faster than Enum.__hash__, which is written in Python

    CLIENT = "client"
    CAMERA = "camera"


class Wire(enum.Enum):
    """The form of a field on the wire."""

    WORD = "word"
    """An unsigned integer of the dialect's word size: UINT32 or UINT16."""
    UINT32 = "uint32"
    """Four bytes in every dialect."""
    DATA = "data"
    """All bytes to the end of the frame; only the last field may have this form."""


Word = Annotated[int, Wire.WORD]
UInt32 = Annotated[int, Wire.UINT32]
Data = Annotated[bytes, Wire.DATA]
StatusWord = Annotated[Status, Wire.WORD]


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """Base of all messages.

    A message without fields of its own is no dataclass, since making a dataclass takes as long as
    importing a module.

    Attributes:
        sender: side of the link that may send the message.
    """

    sender: ClassVar[Sender]


class Request(Message):
    """A message from client to camera.

    Attributes:
        answer: message type of the camera's answer, if the dialect has this type; None if the
            camera never answers.
    """

    __slots__ = ()
    sender: ClassVar[Sender] = Sender.CLIENT
    answer: ClassVar[type[Message] | None] = None


class Report(Message):
    """A message from camera to client: an answer, or a message that it sends by itself."""

    __slots__ = ()
    sender: ClassVar[Sender] = Sender.CAMERA


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledgement(Report):
    """The answer to a command in a dialect with result codes; the dialect explains the codes.

    Attributes:
        code: outcome of the request; 0 in a dialect without result codes.
    """

    code: Word = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectAnswer(Acknowledgement):
    """The session has begun. ``version`` counts up with the protocol; only 1 is known."""

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
            (inferred). It does not affect headers and messages. In a dialect without this field
            everything is little endian.
    """

    status: StatusWord
    endian: Word = 0


UNNAMED_APPLICATION = -1
"""Application of a result container that does not name its application, or that has no id."""


class CellValue(NamedTuple):
    """A value as text: the name of its cell, and the text, None for a cell without a value."""

    cell: str
    text: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultContainer(Report):
    """The result of an inspection: its application's id, and bytes without types or names.

    Attributes:
        application: id of the application.
        data: bytes of the values.
        cells: the values of which ``data`` was made, if the protocol sends them as texts. The
            fields of a layout are these values, in order.
        fault: reason why the values cannot come from one inspection, None if there is none.
        requested: True if the wire shows that the container answers a trigger of this client, the
            running one or the last one that was given up; False if it answers no trigger of this
            client; None if the wire does not show it.
    """

    application: Word = UNNAMED_APPLICATION
    data: Data
    cells: tuple[CellValue, ...] | None = None
    fault: str | None = None
    requested: bool | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Notice(Report):
    """A notice of the camera that is neither a status nor a result.

    Attributes:
        kind: ``"error"``, ``"notification"`` or ``"debug"``.
        code: the camera's number of the notice, 0 without one.
        text: the camera's text.
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
    """The switch is finished: ``code`` is its outcome, and ``application`` is active now."""

    application: Word


class TriggerAnswer(Acknowledgement):
    """The trigger was understood; an inspection may not have begun."""

    __slots__ = ()


class SetClockAnswer(Acknowledgement):
    """The clock is set, or the code gives the reason why not."""

    __slots__ = ()


class SetInputAnswer(Acknowledgement):
    """The input data (BVS ID: the reference value) is taken, or the code gives the reason."""

    __slots__ = ()


class ResetErrorsAnswer(Acknowledgement):
    """The error bits are reset; a status follows."""

    __slots__ = ()


class StartAnswer(Acknowledgement):
    """Run mode is entered, or the code gives the reason why not."""

    __slots__ = ()


class StopAnswer(Acknowledgement):
    """Run mode is left, or the code gives the reason why not."""

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
    """End the session; neither results nor statuses follow."""

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
    """Load an application by the name of its file; the active one must be stopped."""

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
    """Send input data for the next inspection, in the form that its "Receive data" tool expects.

    On BVS ID the data is the reference value, filled with zeros to its configured length.
    """

    answer: ClassVar[type[Message] | None] = SetInputAnswer

    data: Data


@dataclass(frozen=True, slots=True, kw_only=True)
class SetSequenceNumber(Request):
    """Set the number of the next inspection."""

    number: UInt32


class Trigger(Request):
    """Run a triggered application once."""

    __slots__ = ()
    answer: ClassVar[type[Message] | None] = TriggerAnswer


class EndTrigger(Request):
    """End the running trigger now: its result has the codes that were read by then."""

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

    The machine of a camera with result codes reports it; other machines drop such a frame.
    """

    message_id: int
    payload: bytes


def wire_fields(message_type: type[Message]) -> tuple[tuple[str, Wire], ...]:
    """Return name and wire type of each field of a message's body, in order.

    These are the fields of all dialects; a dialect's row lists the fields that it leaves out.
    """
    fields = _WIRE_FIELDS.get(message_type)
    if fields is None:
        hints: dict[str, Any] = get_type_hints(message_type, include_extras=True)
        fields = _WIRE_FIELDS[message_type] = tuple(
            (name, hint.__metadata__[0])
            for name, hint in hints.items()
            if hasattr(hint, "__metadata__") and isinstance(hint.__metadata__[0], Wire)
        )
    return fields


_WIRE_FIELDS: dict[
    type[Message], tuple[tuple[str, Wire], ...]
] = {}  # cached, since get_type_hints is slow
