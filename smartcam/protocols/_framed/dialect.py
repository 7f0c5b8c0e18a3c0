"""Define a dialect of binary frames by data: header layout, message table, result codes.

A :class:`FramedDialect` joins a header layout and a message table and compiles them to codecs.
"""

from __future__ import annotations

import contextlib
import dataclasses
import struct
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from smartcam._forks import cached_property
from smartcam.exceptions import (
    ConfigurationError,
    LocalProtocolError,
    MessageError,
    RemoteProtocolError,
    UnsupportedError,
    hex_excerpt,
)
from smartcam.models import Capabilities, Status, as_status, jsonable
from smartcam.protocols import messages as m
from smartcam.protocols._base import (
    UNDOCUMENTED,
    CodeMeaning,
    Dialect,
    RawRequest,
    ReadableFrame,
    Verdict,
)
from smartcam.protocols._framed.framing import Buffer, Framer, HeaderLayout, Lengths
from smartcam.protocols._machine import Frame
from smartcam.protocols.messages import (
    Acknowledgement,
    ConnectAnswer,
    MalformedMessage,
    Message,
    Request,
    Sender,
    StatusReport,
    TriggerAnswer,
    UnknownMessage,
    Wire,
    wire_fields,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping


class MessageRow(NamedTuple):
    """One row of a dialect's message table.

    Attributes:
        message_id: id on the wire.
        type: the message.
        title: the message's name in the manual.
        source: document that describes the message, and whether that is published, derived or
            inferred.
        omits: fields of the message that are not on this dialect's wire; they have defaults.
        byte_order: ``struct`` code of the body's byte order.
    """

    message_id: int
    type: type[Message]
    title: str
    source: str
    omits: tuple[str, ...] = ()
    byte_order: Literal["<", ">"] = "<"

    @property
    def fields(self) -> tuple[tuple[str, Wire], ...]:
        """Name and wire type of each field of the body, in order."""
        return tuple(pair for pair in wire_fields(self.type) if pair[0] not in self.omits)


NO_STATUS = Status(0)


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusBits:
    """The meaning of the bits in a dialect's status word; by default, the meaning of Status.

    With ``unnamed_shift`` 0 the word is a Status as it is, and nothing else is used.

    Attributes:
        named: bit on the wire to the status bit that means the same.
        inverted: bit on the wire to the status bit that means its absence.
        always: status bits that are always set, since no bit on the wire shows them.
        unnamed_shift: number of bits by which all other bits of the wire are shifted up.
    """

    named: Mapping[int, Status] = field(default_factory=dict[int, Status])
    inverted: Mapping[int, Status] = field(default_factory=dict[int, Status])
    always: Status = NO_STATUS
    unnamed_shift: int = 0

    def read(self, word: int) -> Status:
        """Return the status for a word on the wire."""
        if not self.unnamed_shift:
            return as_status(word)
        status, remaining = int(self.always), word
        for bit, meaning in self.named.items():
            status |= meaning if word & bit else 0
            remaining &= ~bit
        for bit, meaning in self.inverted.items():
            status |= 0 if word & bit else meaning
            remaining &= ~bit
        return Status(status | remaining << self.unnamed_shift)

    def write(self, status: Status) -> int:
        """Return the word on the wire; bits that are not there are left out."""
        if not self.unnamed_shift:
            return int(status)
        bits = int(status)
        word = bits >> self.unnamed_shift
        for bit, meaning in self.named.items():
            word = word & ~bit | (bit if bits & meaning else 0)
        for bit, meaning in self.inverted.items():
            word = word & ~bit | (0 if bits & meaning else bit)
        return word


MAX_CACHED_MESSAGES = 256
"""Largest number of decoded messages that a codec caches. A camera sends few different ones, but a
peer could send any number."""


MAX_SURPLUS_BYTES = 1 << 12
"""Largest number of bytes by which a body of fixed length may be longer than documented. Newer
firmware may append a few words; more bytes mean a wrong length."""


class Codec:
    """Encodes and decodes one message type of one dialect.

    Attributes:
        type: class of the message.
        message_id: id of the message on the wire.
        size: bytes of the fields of fixed size together.
        has_data: True if the bytes after these fields are a field, too.
        names: names of all fields.
    """

    __slots__ = (
        *("_body", "_code", "_data", "_fields", "_setters", "_header_size"),
        *("_messages", "_meaning", "_defaults", "_status"),
        *("has_data", "message_id", "names", "size", "type"),
    )

    def __init__(self, row: MessageRow, dialect: FramedDialect) -> None:
        fields = row.fields
        codes = {Wire.WORD: dialect.word, Wire.UINT32: "I"}
        self.type: type[Message] = row.type
        self.message_id: int = row.message_id
        self.names: tuple[str, ...] = tuple(name for name, _ in fields)
        self._header_size = dialect.header.size
        self._status = dialect.status_bits if row.type is StatusReport else None
        self._fields = tuple(name for name, wire in fields if wire is not Wire.DATA)
        self._data = next((name for name, wire in fields if wire is Wire.DATA), None)
        self._body = struct.Struct(
            row.byte_order + "".join(codes[wire] for _, wire in fields if wire is not Wire.DATA)
        )
        self.size: int = self._body.size
        self.has_data: bool = self._data is not None
        # if each answer begins with a code, a refusal may consist of the code only; not the answer
        # to Connect: there two bytes may be the version of another dialect
        is_answer = issubclass(row.type, Acknowledgement) and row.type is not ConnectAnswer
        coded = is_answer and dialect.coded and "code" in self._fields
        self._code = struct.Struct(row.byte_order + codes[Wire.WORD]) if coded else None
        self._meaning = dialect.code
        self._messages: dict[bytes, Message] = {}  # received bodies; messages are immutable
        # setting the slots of a frozen message takes half the time of its constructor
        self._setters = [_slot_setter(row.type, name) for name in self.names]
        self._defaults = [
            (_slot_setter(row.type, slot.name), slot.default)
            for slot in dataclasses.fields(row.type)
            if slot.name not in self.names
        ]

    @property
    def may_be_code_only(self) -> bool:
        """True if a refusal may consist of the result code only."""
        return self._code is not None and self._code.size < self.size

    @property
    def lengths(self) -> range:
        """The accepted lengths of a body."""
        shortest = self.size if self._code is None else min(self._code.size, self.size)
        return range(shortest, sys.maxsize if self.has_data else self.size + MAX_SURPLUS_BYTES + 1)

    def fits(self, size: int) -> bool:
        """Return True if a body has the documented length."""
        return size >= self.size if self.has_data else size == self.size

    def _refuses(self, payload: bytes) -> bool:
        """Return True if a body that is too short for the message is just a refusal's code."""
        code = self._code
        if code is None or len(payload) != code.size:
            return False
        return self._meaning(code.unpack(payload)[0]).verdict is not Verdict.DONE

    def encode(self, message: Message) -> bytes:
        """Return a message's body."""
        values = [getattr(message, name) for name in self._fields]
        if self._status is not None:
            values[0] = self._status.write(values[0])
        body = self._body.pack(*values)
        return body + getattr(message, self._data) if self._data is not None else body

    def decode(self, buffer: Buffer, begin: int, end: int) -> Message:
        """Return the message whose body is between two offsets; surplus bytes are ignored.

        A refusal that consists of the code only is accepted; its other fields are 0. Raises
        MessageError: the body is shorter than its message.
        """
        if end - begin < self.size:
            payload = bytes(buffer[begin:end])
            if not self._refuses(payload):
                raise MessageError(
                    f"{self.type.__name__} ({self.message_id:#04x}) came with {len(payload)} bytes,"
                    f" it needs {self.size}: {hex_excerpt(payload)}",
                    offset=self._header_size,
                    data=payload,
                )
            buffer, begin, end = payload.ljust(self.size, b"\0"), 0, self.size
        data_begin = begin + self.size
        if self.has_data:
            data = bytes(buffer[data_begin:end])
            return self._make((*self._body.unpack_from(buffer, begin), data))
        body = bytes(buffer[begin:data_begin])
        message = self._messages.get(body)
        if message is None:
            values = self._body.unpack(body)
            if self._status is not None:
                values = (self._status.read(values[0]), *values[1:])
            message = self._make(values)
            if len(self._messages) < MAX_CACHED_MESSAGES:
                self._messages[body] = message
        return message

    def readable_fields(self, body: bytes) -> dict[str, Any]:
        """Return the fields of a body with data as JSON values; the body must be long enough.

        To be fast, no message object is made.
        """
        fields: dict[str, Any] = dict(zip(self.names, self._body.unpack_from(body), strict=False))
        fields[self.names[-1]] = body[self.size :].hex()
        return fields

    def make_copier(self, message: Message) -> Callable[[bytes], Message]:
        """Return a function that gets data and returns a copy of a message with this data."""
        new, kind, data_name = object.__new__, self.type, self._data or ""
        names = [slot.name for slot in dataclasses.fields(kind) if slot.name != data_name]
        shared = [(_slot_setter(kind, name), getattr(message, name)) for name in names]
        fill_data = _slot_setter(kind, data_name)

        def make(data: bytes) -> Message:
            copy = new(kind)
            for set_slot, value in shared:
                set_slot(copy, value)
            fill_data(copy, data)
            return copy

        if len(shared) != 4:
            return make
        (fill_1, value_1), (fill_2, value_2), (fill_3, value_3), (fill_4, value_4) = shared

        def make_result(data: bytes) -> Message:  # same result as make(), without a loop
            copy = new(kind)
            fill_1(copy, value_1)
            fill_2(copy, value_2)
            fill_3(copy, value_3)
            fill_4(copy, value_4)
            fill_data(copy, data)
            return copy

        return make_result

    def _make(self, values: tuple[Any, ...]) -> Message:
        message = object.__new__(self.type)
        for index, set_slot in enumerate(self._setters):
            set_slot(message, values[index])
        for set_slot, value in self._defaults:
            set_slot(message, value)
        return message


def _slot_setter(message_type: type[Message], name: str) -> Callable[[Message, Any], None]:
    """Return the setter of a field's slot, from the class that declares the slot."""
    owner = next(base for base in message_type.__mro__ if name in vars(base))
    set_slot: Callable[[Message, Any], None] = vars(owner)[name].__set__
    return set_slot


class WireQuirk(NamedTuple):
    """A deviation from a dialect, where the documents are not clear.

    Attributes:
        about: one line for people.
        source: document that describes the deviation, and whether that is published, derived or
            inferred.
        rows: rows of the messages that differ.
        codes: meanings of the result codes, if they differ.
    """

    about: str
    source: str
    rows: tuple[MessageRow, ...]
    codes: Mapping[int, CodeMeaning] | None = None


SHOWS_TRIGGERS = "shows_triggers"
"""Parameter of a URL: ``no`` for a camera whose status does not show each accepted trigger."""

_ABILITIES: Mapping[str, type[Message]] = {
    "switch": m.SwitchApplication,
    "load_file": m.LoadFile,
    "start_stop": m.Start,
    "reboot": m.Reboot,
    "get_clock": m.GetClock,
    "set_clock": m.SetClock,
    "input_data": m.SetInput,
    "sequence_number": m.SetSequenceNumber,
    "get_status": m.GetStatus,
    "reset_errors": m.ResetErrors,
    "read_image": m.ReadImage,
}
"""The message that each ability needs."""

SWITCH_CODES: Mapping[int, CodeMeaning] = {
    0: CodeMeaning("done", Verdict.DONE),
    1: CodeMeaning("id invalid", Verdict.REFUSED),
}
"""Meanings of the answer to a switch, if no other answer has a code (SC manual p. 34,
published)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FramedDialect(Dialect):
    """A dialect of binary frames, as data.

    Args:
        name, about, source, quirks, shows_triggers: as those of
            :class:`~smartcam.protocols.Dialect`.
        header: layout of a frame's header.
        word: ``struct`` code of the bodies' ordinary integers: ``I`` or ``H``.
        table: rows of the dialect's messages.
        status_bits: meaning of the bits of the status word.
        codes: meaning of the codes in answers.
        unasked_status: True if the camera sends its status with the session and at every change.
        wire_quirks: deviations by their names.
    """

    header: HeaderLayout
    word: Literal["I", "H"]
    table: tuple[MessageRow, ...]
    status_bits: StatusBits = StatusBits()
    codes: Mapping[int, CodeMeaning] = field(default_factory=lambda: SWITCH_CODES)
    unasked_status: bool = True
    wire_quirks: Mapping[str, WireQuirk] = field(default_factory=dict[str, WireQuirk])

    # made at their first use; most dialects of a protocol are never used

    @cached_property
    def _encoders(self) -> dict[type[Message], Codec]:
        return {row.type: Codec(row, self) for row in self.table}

    @cached_property
    def _decoders(self) -> dict[Sender, dict[int, Codec]]:
        decoders: dict[Sender, dict[int, Codec]] = {sender: {} for sender in Sender}
        for row in self.table:
            decoders[row.type.sender][row.message_id] = self._encoders[row.type]
        return decoders

    @cached_property
    def _lengths(self) -> dict[Sender, Lengths]:
        return {
            sender: Lengths({number: codec.lengths for number, codec in codecs.items()})
            for sender, codecs in self._decoders.items()
        }

    @cached_property
    def _answers(self) -> dict[int, int | None]:
        answers: dict[int, int | None] = {}
        for row in self.table:
            if issubclass(row.type, Request):
                answer = self._encoders.get(row.type.answer) if row.type.answer else None
                answers[row.message_id] = None if answer is None else answer.message_id
        return answers

    @cached_property
    def bodiless_frames(self) -> dict[type[Message], tuple[bytes, int, int | None]]:
        """Messages without a body: the whole frame, its id, the id of the answer."""
        frames: dict[type[Message], tuple[bytes, int, int | None]] = {}
        for row in self.table:
            if not row.fields:
                frame = self.encode_frame(self.to_frame(row.type()))
                frames[row.type] = frame, row.message_id, self.answer_id(row.message_id)
        return frames

    @cached_property
    def _variants(self) -> dict[tuple[str, ...], FramedDialect]:
        return {}

    def with_quirks(self, names: Iterable[str]) -> FramedDialect:
        """Return the dialect with these deviations; the same names always give the same object.

        Raises:
            ConfigurationError: the dialect knows no such deviation.
        """
        key = tuple(sorted({*names, *self.quirks}))
        unknown = [name for name in key if name not in self.wire_quirks]
        if unknown:
            known = ", ".join(self.wire_quirks) or "none"
            raise ConfigurationError(
                f"dialect {self.name} has no quirk {unknown[0]!r}; it has {known}"
            )
        if key == self.quirks:
            return self
        variant = self._variants.get(key)
        if variant is None:
            changes = [self.wire_quirks[name] for name in key]
            changed_rows = {row.type: row for quirk in changes for row in quirk.rows}
            codes = [quirk.codes for quirk in changes if quirk.codes is not None]
            variant = self._variants[key] = dataclasses.replace(
                self,
                table=tuple(changed_rows.get(row.type, row) for row in self.table),
                codes=codes[0] if codes else self.codes,
                quirks=key,
            )
            vars(variant)["_variants"] = self._variants  # shared by all variants
        return variant

    def with_parameters(self, parameters: Mapping[str, str]) -> FramedDialect:
        """Return the dialect with the URL's ``shows_triggers``; equal calls give the same object.

        Raises:
            ConfigurationError: the value is neither ``yes`` nor ``no``.
        """
        value = parameters.get(SHOWS_TRIGGERS, "yes")
        if value not in {"yes", "no"}:
            raise ConfigurationError(f"{SHOWS_TRIGGERS}: yes or no, not {value!r}")
        if value == "yes" or not self.shows_triggers:
            return self
        key = (*self.quirks, f"?{SHOWS_TRIGGERS}=no")
        variant = self._variants.get(key)
        if variant is None:
            variant = self._variants[key] = dataclasses.replace(self, shows_triggers=False)
        return variant

    @property
    def coded(self) -> bool:
        """True if each answer begins with a result code."""
        return any(row.type is ConnectAnswer and "code" not in row.omits for row in self.table)

    @property
    def capabilities(self) -> Capabilities:
        """Abilities of a camera in this dialect."""
        return self._capabilities

    @cached_property
    def _capabilities(self) -> Capabilities:
        return Capabilities(
            dialect=self.name,
            unasked_status=self.unasked_status,
            unasked_results=True,
            result_codes=self.has(TriggerAnswer),
            **{name: self.has(message_type) for name, message_type in _ABILITIES.items()},
        )

    @property
    def application_ids(self) -> range:
        """The ids that applications may have: 0 is not allowed (SC manual p. 34, published)."""
        return range(1, 1 << 8 * struct.calcsize("<" + self.word))

    def code(self, code: int, request: type[Message] | None = None) -> CodeMeaning:
        """Return the meaning of a result code; an undocumented code is a refusal."""
        return self.codes.get(code, UNDOCUMENTED)

    def has(self, message_type: type[Message]) -> bool:
        """Return True if the dialect has a message of this type."""
        return message_type in self._encoders

    def fields(self, message_type: type[Message]) -> tuple[str, ...]:
        """Return the names of the fields that a message has on the wire."""
        codec = self._encoders.get(message_type)
        return codec.names if codec is not None else ()

    def message_id(self, message: Message | type[Message]) -> int:
        """Return the id of a message in this dialect.

        Raises:
            UnsupportedError: the dialect has no such message.
        """
        if isinstance(message, (UnknownMessage, MalformedMessage)):
            return message.message_id
        return self.encoder(message if isinstance(message, type) else type(message)).message_id

    def reinterpret_status(self, report: StatusReport, source_dialect: Dialect) -> StatusReport:
        """Return a status, decoded by ``source_dialect``, as this dialect decodes the same bits."""
        if not isinstance(source_dialect, FramedDialect):
            return report
        word = source_dialect.status_bits.write(report.status)
        return dataclasses.replace(report, status=self.status_bits.read(word))

    def data_begins(self, sender: Sender, message_id: int) -> int | None:
        codec = self.decoders(sender).get(message_id)
        return codec.size if codec is not None and codec.has_data else None

    def make_readable(self, sender: Sender, frame: Frame) -> ReadableFrame:
        """Return a frame in readable form, for a trace; it never raises."""
        fields: dict[str, Any] | None = None
        codec = self.decoders(sender).get(frame.message_id)
        if codec is not None and codec.has_data and len(frame.payload) >= codec.size:
            fields = codec.readable_fields(frame.payload)
        else:
            with contextlib.suppress(RemoteProtocolError):  # the trace shows the error next
                message = self.decode(sender, frame)
                names = self.fields(type(message))
                fields = {name: jsonable(getattr(message, name)) for name in names}
        name = UnknownMessage.__name__ if codec is None else codec.type.__name__
        return ReadableFrame(frame.message_id, name, fields, self.encode_frame(frame))

    def raw_request(self, message_id: int | str, payload: bytes) -> RawRequest:
        """Return a request by its id, for users who know a message that the dialect lacks.

        Raises:
            LocalProtocolError: Connect and Disconnect.
            UnsupportedError: the id is no number.
        """
        if isinstance(message_id, str):
            raise UnsupportedError(f"dialect {self.name}: a message id is a number: {message_id!r}")
        known = self.message_type(Sender.CLIENT, message_id)
        if known in {m.Connect, m.Disconnect}:
            raise LocalProtocolError("only the client itself sends Connect and Disconnect")
        answer = self.message_type(Sender.CAMERA, message_id)
        return RawRequest(
            self._named_message(Frame(message_id, payload)),
            message_id if answer is UnknownMessage else answer,
            expects_answer=self.answer_id(message_id) is not None,
            known=known is not UnknownMessage,
        )

    def _named_message(self, frame: Frame) -> Message:
        """Return a frame's message; UnknownMessage if a known one would be sent as other bytes."""
        with contextlib.suppress(RemoteProtocolError):
            message = self.decode(Sender.CLIENT, frame)
            if self.to_frame(message) == frame:
                return message
        return UnknownMessage(message_id=frame.message_id, payload=frame.payload)

    def body(self, answer: Message) -> bytes:
        """Return an answer's bytes after the header."""
        return self.to_frame(answer).payload

    def message_type(self, sender: Sender, message_id: int) -> type[Message]:
        """Return the message with this id from this sender, :class:`UnknownMessage` if none."""
        codec = self.decoders(sender).get(message_id)
        return codec.type if codec is not None else UnknownMessage

    def encoder(self, message_type: type[Message]) -> Codec:
        """Return the codec of a message.

        Raises:
            UnsupportedError: the dialect has no such message.
        """
        codec = self._encoders.get(message_type)
        if codec is None:
            raise self.unsupported(message_type)
        return codec

    def decoders(self, sender: Sender) -> dict[int, Codec]:
        """Return the codecs of one sender's messages, by their ids."""
        return self._decoders[sender]

    def lengths(self, sender: Sender) -> Lengths:
        """Return the lengths that the bodies of one sender's messages may have."""
        return self._lengths[sender]

    def knows(self, sender: Sender, message_id: int) -> bool:
        """Return True if this sender has a message with this id."""
        return message_id in self.decoders(sender)

    def answer_id(self, request_id: int) -> int | None:
        """Return the id of the answer to a request, None if the camera never answers it.

        An unknown request is expected to be answered under its own id.
        """
        return self._answers.get(request_id, request_id)

    def framer(self, max_length: int) -> Framer:
        """Return a new framer of this dialect; a longer payload breaks the protocol."""
        return Framer(self.header, max_length)

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
            UnsupportedError: the dialect has no such message.
            LocalProtocolError: a field does not fit.
        """
        if isinstance(message, (UnknownMessage, MalformedMessage)):
            return Frame(message.message_id, message.payload)
        codec = self.encoder(type(message))
        try:
            return Frame(codec.message_id, codec.encode(message))
        except (struct.error, TypeError) as exc:
            raise LocalProtocolError(f"{message} does not fit its fields: {exc}") from exc

    def encode(self, message: Message) -> bytes:
        """Return a message's bytes on the wire; raises as :meth:`to_frame`."""
        encoded = self.bodiless_frames.get(type(message))
        return self.encode_frame(self.to_frame(message)) if encoded is None else encoded[0]

    def surplus(self, sender: Sender, frame: Frame) -> int:
        """Return by how many bytes a known message's body is longer than documented."""
        codec = self.decoders(sender).get(frame.message_id)
        if codec is None or codec.has_data:
            return 0
        return len(frame.payload) - codec.size

    def decode(self, sender: Sender, frame: Frame) -> Message:
        """Return a frame's message; a longer body than documented is cut.

        Raises:
            MessageError: the body is shorter than its message.
        """
        codec = self.decoders(sender).get(frame.message_id)
        if codec is None:
            return UnknownMessage(message_id=frame.message_id, payload=frame.payload)
        return codec.decode(frame.payload, 0, len(frame.payload))
