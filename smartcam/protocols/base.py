"""What a protocol is made of: dialects as data, roles with their policies, the entry point.

A :class:`Dialect` joins a header layout and a message table and compiles them to codecs. Who may do
what with broken input is a :class:`Policy`, chosen by role and transport.
"""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import FrameError, LocalProtocolError, MessageError, hex_excerpt
from smartcam.models import as_status
from smartcam.protocols.framing import Buffer, Frame, HeaderLayout
from smartcam.protocols.messages import (
    Message,
    Request,
    Sender,
    StatusReport,
    UnknownMessage,
    Wire,
    wire_fields,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.exceptions import RemoteProtocolError

__all__ = ["POLICIES", "Codec", "Dialect", "MessageRow", "Policy", "Protocol", "Role", "Transport"]


class Role(enum.Enum):
    """Which side of the wire a machine plays."""

    CLIENT = "client"
    CAMERA = "camera"

    @property
    def sends(self) -> Sender:
        """The sender of this side's messages."""
        return Sender(self.value)

    @property
    def receives(self) -> Sender:
        """The sender of the other side's messages."""
        return Sender.CAMERA if self is Role.CLIENT else Sender.CLIENT


class Transport(enum.Enum):
    """What carries the frames: a stream of bytes, or a datagram each."""

    TCP = "tcp"
    UDP = "udp"


@dataclass(frozen=True, slots=True, kw_only=True)
class Policy:
    """What one role does with broken input.

    Attributes:
        fatal: which errors end the link: :exc:`~smartcam.exceptions.FrameError` for bytes that
            make no frame, :exc:`~smartcam.exceptions.MessageError` for a short body or a message
            at the wrong time. Others are dropped and counted.
        exact_length: a known message must have exactly its documented length; otherwise a longer
            body is accepted and counted.
    """

    fatal: tuple[type[RemoteProtocolError], ...]
    exact_length: bool


POLICIES: Mapping[tuple[Role, Transport], Policy] = {
    (Role.CLIENT, Transport.TCP): Policy(fatal=(FrameError, MessageError), exact_length=False),
    (Role.CLIENT, Transport.UDP): Policy(fatal=(), exact_length=False),
    # the camera ignores invalid messages silently (SC manual p. 28: published)
    (Role.CAMERA, Transport.TCP): Policy(fatal=(), exact_length=True),
    (Role.CAMERA, Transport.UDP): Policy(fatal=(), exact_length=True),
}


class MessageRow(NamedTuple):
    """One row of a dialect's message table.

    Attributes:
        message_id: id on the wire.
        type: the message.
        title: the manual's name.
        source: where it stands, with its grade.
    """

    message_id: int
    type: type[Message]
    title: str
    source: str


MAX_KNOWN = 256
"""Messages kept of each kind; statuses and answers are few, and a peer could send any."""


class Codec:
    """One message of one dialect, compiled.

    Attributes:
        type: the message.
        message_id: its id.
        size: of the fields that have one, bytes.
        has_data: whether every byte behind them is a field.
    """

    __slots__ = (
        *("_body", "_data", "_fields", "_fill", "_header_size", "_known"),
        *("has_data", "message_id", "size", "type"),
    )

    def __init__(self, row: MessageRow, word: str, header_size: int) -> None:
        fields = wire_fields(row.type)
        codes = {Wire.WORD: word, Wire.UINT32: "I"}
        self.type: type[Message] = row.type
        self.message_id: int = row.message_id
        self._header_size = header_size
        self._fields = tuple(name for name, wire in fields if wire is not Wire.DATA)
        self._data = next((name for name, wire in fields if wire is Wire.DATA), None)
        self._body = struct.Struct(
            "<" + "".join(codes[wire] for _, wire in fields if wire is not Wire.DATA)
        )
        self.size: int = self._body.size
        self.has_data: bool = self._data is not None
        # what fills the slots of a frozen message, in half the time of its own constructor
        self._known: dict[bytes, Message] = {}  # bodies that came before: messages are immutable
        self._fill = [vars(row.type)[name].__set__ for name, _ in fields]

    def encode(self, message: Message) -> bytes:
        """Return a message's body."""
        body = self._body.pack(*[getattr(message, name) for name in self._fields])
        return body + getattr(message, self._data) if self._data is not None else body

    def decode(self, buffer: Buffer, begin: int, end: int) -> Message:
        """Return the message whose body is at a place; bytes behind it are ignored.

        Raises:
            MessageError: the body is shorter than its message.
        """
        if end - begin < self.size:
            payload = bytes(buffer[begin:end])
            raise MessageError(
                f"{self.type.__name__} ({self.message_id:#04x}) came with {len(payload)} bytes, "
                f"it needs {self.size}: {hex_excerpt(payload)}",
                offset=self._header_size,
                data=payload,
            )
        behind = begin + self.size
        if self.has_data:
            data = bytes(buffer[behind:end])
            return self._make((*self._body.unpack_from(buffer, begin), data))
        body = bytes(buffer[begin:behind])
        message = self._known.get(body)
        if message is None:
            values = self._body.unpack(body)
            if self.type is StatusReport:
                values = (as_status(values[0]), *values[1:])
            message = self._make(values)
            if len(self._known) < MAX_KNOWN:
                self._known[body] = message
        return message

    def _make(self, values: tuple[Any, ...]) -> Message:
        message = object.__new__(self.type)
        for fill, value in zip(self._fill, values, strict=True):
            fill(message, value)
        return message


@dataclass(frozen=True, kw_only=True, eq=False)
class Dialect:
    """One wire variant of a protocol, as data.

    Args:
        name: as in ``?dialect=``.
        header: what a frame's header looks like.
        word: ``struct`` code of the bodies' ordinary integers: ``I`` or ``H``.
        table: its messages.
        about: one line for people.
        source: where it is described, with its grade.
    """

    name: str
    header: HeaderLayout
    word: str
    table: tuple[MessageRow, ...]
    about: str
    source: str
    _encoders: dict[type[Message], Codec] = field(
        init=False, repr=False, default_factory=dict[type[Message], Codec]
    )
    _decoders: dict[tuple[Sender, int], Codec] = field(
        init=False, repr=False, default_factory=dict[tuple[Sender, int], Codec]
    )

    _answers: dict[int, int | None] = field(
        init=False, repr=False, default_factory=dict[int, int | None]
    )
    # whole frames of the messages that have no body
    _constant: dict[type[Message], bytes] = field(
        init=False, repr=False, default_factory=dict[type[Message], bytes]
    )

    def __post_init__(self) -> None:
        for row in self.table:
            codec = Codec(row, self.word, self.header.size)
            self._encoders[row.type] = codec
            self._decoders[row.type.sender, row.message_id] = codec
            if not wire_fields(row.type):
                self._constant[row.type] = self.encode(row.type())
        for row in self.table:
            if issubclass(row.type, Request):
                answer = row.type.answer
                self._answers[row.message_id] = None if answer is None else self.message_id(answer)

    def message_id(self, message: Message | type[Message]) -> int:
        """Return the id of a message in this dialect."""
        if isinstance(message, UnknownMessage):
            return message.message_id
        return self._encoders[message if isinstance(message, type) else type(message)].message_id

    def message_type(self, sender: Sender, message_id: int) -> type[Message]:
        """Return the message with this id from this sender, :class:`UnknownMessage` if none."""
        codec = self._decoders.get((sender, message_id))
        return codec.type if codec is not None else UnknownMessage

    def encoder(self, message_type: type[Message]) -> Codec:
        """Return what encodes a message.

        Raises:
            LocalProtocolError: the dialect has no such message.
        """
        codec = self._encoders.get(message_type)
        if codec is None:
            raise LocalProtocolError(f"dialect {self.name} has no message {message_type.__name__}")
        return codec

    def decoders(self, sender: Sender) -> dict[int, Codec]:
        """Return what decodes the messages of one sender, by their ids."""
        return {
            row.message_id: self._encoders[row.type]
            for row in self.table
            if row.type.sender is sender
        }

    def knows(self, sender: Sender, message_id: int) -> bool:
        """Whether there is a message with this id from this sender."""
        return (sender, message_id) in self._decoders

    def answer_id(self, request_id: int) -> int | None:
        """Return the id of the answer to a request, None if the camera never answers it.

        An unknown request is expected to be answered under its own id.
        """
        return self._answers.get(request_id, request_id)

    def encode_frame(self, frame: Frame) -> bytes:
        """Return a frame's bytes.

        Raises:
            LocalProtocolError: id or payload do not fit the header.
        """
        try:
            return self.header.pack(frame.message_id, len(frame.payload)) + frame.payload
        except struct.error as exc:
            raise LocalProtocolError(
                f"message {frame.message_id:#x} with {len(frame.payload)} bytes of payload does not"
                f" fit the {self.name} header: {exc}"
            ) from exc

    def to_frame(self, message: Message) -> Frame:
        """Return a message as a frame.

        Raises:
            LocalProtocolError: the dialect has no such message, or a field does not fit.
        """
        if isinstance(message, UnknownMessage):
            return Frame(message.message_id, message.payload)
        codec = self.encoder(type(message))
        try:
            return Frame(codec.message_id, codec.encode(message))
        except (struct.error, TypeError) as exc:
            raise LocalProtocolError(f"{message} does not fit its fields: {exc}") from exc

    def encode(self, message: Message) -> bytes:
        """Return a message's bytes on the wire; raises as :meth:`to_frame`."""
        constant = self._constant.get(type(message))
        return self.encode_frame(self.to_frame(message)) if constant is None else constant

    def surplus(self, sender: Sender, frame: Frame) -> int:
        """Return how many bytes a known message's body is longer than documented."""
        codec = self._decoders.get((sender, frame.message_id))
        if codec is None or codec.has_data:
            return 0
        return len(frame.payload) - codec.size

    def decode(self, sender: Sender, frame: Frame) -> Message:
        """Return a frame's message; a longer body than documented is cut.

        Raises:
            MessageError: the body is shorter than its message.
        """
        codec = self._decoders.get((sender, frame.message_id))
        if codec is None:
            return UnknownMessage(message_id=frame.message_id, payload=frame.payload)
        return codec.decode(frame.payload, 0, len(frame.payload))


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """A family of dialects under one name: what an entry point ``smartcam.protocols`` gives.

    Attributes:
        name: its name.
        schemes: URL scheme to transport.
        default_port: port where a URL names none.
        models: camera models that speak it.
        dialects: its dialects by name, the most probable first: the order in which a client that
            was told none tries them.
    """

    name: str
    schemes: Mapping[str, Transport]
    default_port: int
    models: tuple[str, ...]
    dialects: Mapping[str, Dialect]
