"""Apply wire faults to one message: make the transmissions that replace it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from smartcam.emulator import faults as f
from smartcam.emulator.faults._delay_line import Ending, Transmission
from smartcam.exceptions import FrameError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.protocols import Frame, MessageRow
    from smartcam.protocols import messages as m


class WireFramer(Protocol):
    """Cuts received bytes into frames."""

    @property
    def unfinished_bytes(self) -> bytes:
        """Bytes of an unfinished frame."""
        ...

    def feed(self, data: bytes) -> None:
        """Add received bytes."""

    def next_frame(self) -> Frame | None:
        """Return the next frame, None if it is incomplete; FrameError: the bytes are no frame."""
        ...

    def resync(self) -> int:
        """Continue where a frame may begin; return the number of skipped bytes."""
        ...


class WireCodec(Protocol):
    """The messages on a wire, for links, faults and the log; each framed dialect is a codec."""

    @property
    def label(self) -> str:
        """The codec's name, for people."""
        ...

    @property
    def table(self) -> tuple[MessageRow, ...]:
        """The messages that have ids."""
        ...

    def __hash__(self) -> int: ...

    def framer(self, max_length: int) -> WireFramer:
        """Return a new framer that cuts a client's bytes into frames."""
        ...

    def has(self, message_type: type[m.Message], /) -> bool:
        """Return True if the dialect has a message of this type."""
        ...

    def message_id(self, message: m.Message, /) -> int:
        """Return a message's id."""
        ...

    def message_type(self, sender: m.Sender, message_id: int) -> type[m.Message]:
        """Return the type of the message with an id."""
        ...

    def encode(self, message: m.Message) -> bytes:
        """Return a message's bytes; UnsupportedError or LocalProtocolError if it has none."""
        ...

    def encode_frame(self, frame: Frame) -> bytes:
        """Return a frame's bytes."""
        ...

    def to_frame(self, message: m.Message) -> Frame:
        """Return a message as a frame."""
        ...

    def decode(self, sender: m.Sender, frame: Frame) -> m.Message:
        """Return a frame's message; MessageError: the body does not fit."""
        ...

    def surplus(self, sender: m.Sender, frame: Frame) -> int:
        """Return the number of bytes by which a frame is too long."""
        ...


@dataclass(slots=True, eq=False, kw_only=True)
class WireMessage(Transmission):
    """A message on its way, or an insertion."""

    content: Frame | bytes  # the frame before faults, or bytes that make no frame
    original: bytes  # original bytes of the message
    changeable: bool = True  # whether later faults act on the message
    passed_bytes: bytearray = field(default_factory=bytearray)  # bytes that have passed

    @classmethod
    def of(cls, content: Frame | bytes, data: bytes) -> WireMessage:
        """Return a message that passes unchanged."""
        return cls([data], content=content, original=data)

    @property
    def wire(self) -> bytes | None:
        """The bytes that passed, None if no fault changed them."""
        return None if self.passed_bytes == self.original else bytes(self.passed_bytes)

    def find_byte(self, offset: int) -> tuple[int, int]:
        """Return the index of the part with the byte at ``offset``, and the byte's offset in it."""
        ends = list(accumulate(map(len, self.parts)))
        part_index = next(index for index, end in enumerate(ends) if offset < end)
        return part_index, offset - (ends[part_index] - len(self.parts[part_index]))

    def drop(self) -> None:
        """Drop all bytes of the message; later faults do not act on it."""
        self.parts.clear()
        self.pauses.clear()
        self.changeable = False

    def copy(self) -> WireMessage:
        """Return a copy of the message."""
        return replace(
            self,
            parts=list(self.parts),
            pauses=list(self.pauses),
            effects=list(self.effects),
            passed_bytes=bytearray(),
        )


# ---------------------------------------------------------------------- single effects


def _delay(fault: f.Delay, message: WireMessage) -> None:
    message.delay += fault.seconds
    message.overtaken |= fault.overtaken


def _split(fault: f.Split, message: WireMessage) -> None:
    if fault.after >= message.size:
        return
    part_index, byte_index = message.find_byte(fault.after)
    if byte_index:  # otherwise it is cut there already
        part = message.parts[part_index]
        message.parts[part_index : part_index + 1] = [part[:byte_index], part[byte_index:]]
        message.pauses.insert(part_index, fault.pause)


def _coalesce(fault: f.Coalesce, message: WireMessage) -> None:
    message.gather = (fault.count, fault.seconds)


def _truncate(fault: f.Truncate, message: WireMessage) -> None:
    if fault.keep == 0:
        message.drop()
    elif fault.keep < message.size:
        part_index, byte_index = message.find_byte(fault.keep - 1)
        message.parts[part_index:] = [message.parts[part_index][: byte_index + 1]]
        del message.pauses[part_index:]
    if fault.then != "continue":
        message.end = Ending(fault.then, fault.kind)


def _corrupt(fault: f.Corrupt, message: WireMessage) -> None:
    size = message.size
    offset = fault.offset if fault.offset >= 0 else size + fault.offset
    if not 0 <= offset < size:
        return
    part_index, byte_index = message.find_byte(offset)
    part = bytearray(message.parts[part_index])
    part[byte_index] = part[byte_index] ^ (fault.xor or 0) if fault.value is None else fault.value
    message.parts[part_index] = bytes(part)


_CHANGES: Mapping[type[object], Callable[[Any, WireMessage], None]] = {
    f.Delay: _delay,
    f.Split: _split,
    f.Coalesce: _coalesce,
    f.Truncate: _truncate,
    f.Corrupt: _corrupt,
    f.Drop: lambda _, message: message.drop(),
}
"""Faults that act on each transmission of a message separately."""


# ---------------------------------------------------------------------- all together

_Sent: TypeAlias = "list[WireMessage]"


def _duplicate(fault: f.Duplicate, sent: _Sent, dialect: WireCodec) -> _Sent:
    result: _Sent = []
    for message in sent:
        result.append(message)
        if message.changeable:
            message.effects.append(fault.kind)
            result += [message.copy() for _ in range(fault.copies)]
    return result


def _insert(fault: f.Insert, sent: _Sent, dialect: WireCodec) -> _Sent:
    indices = [index for index, message in enumerate(sent) if message.changeable]
    if not indices:
        return sent
    inserted = fault.inserted
    data = dialect.encode(inserted) if inserted is not None else fault.data or b""
    insertion = parse_one(data, dialect)
    insertion.effects.append(fault.kind)
    insertion.changeable = fault.where == "instead"
    if insertion.changeable:
        for index in indices:
            sent[index].drop()
            sent[index].effects.append(fault.kind)
    insert_at = indices[0] if fault.where == "before" else indices[-1] + 1
    return [*sent[:insert_at], insertion, *sent[insert_at:]]


def _end(fault: f.HalfOpen | f.Reset | f.Close, sent: _Sent, dialect: WireCodec) -> _Sent:
    seconds = fault.seconds if isinstance(fault, f.HalfOpen) else None
    if fault.when == "before":
        for message in sent:
            if message.changeable:
                message.drop()
                message.effects.append(fault.kind)
    sent[-1].end = sent[-1].end or Ending(fault.kind, fault.kind, seconds)
    return sent


_REBUILDS: Mapping[type[object], Callable[[Any, _Sent, WireCodec], _Sent]] = {
    f.Duplicate: _duplicate,
    f.Insert: _insert,
    f.HalfOpen: _end,
    f.Reset: _end,
    f.Close: _end,
}
"""Faults that act on all transmissions of a message together."""


def apply_faults(message: WireMessage, faults: Sequence[f.Fault], dialect: WireCodec) -> _Sent:
    """Apply wire faults one after the other; return the messages that pass, in order."""
    sent = [message]
    for fault in faults:
        rebuild = _REBUILDS.get(type(fault))
        if rebuild is not None:
            sent = rebuild(fault, sent, dialect)
            continue
        for sent_message in sent:
            if sent_message.changeable:
                sent_message.effects.append(fault.kind)
                _CHANGES[type(fault)](fault, sent_message)
    return sent


def parse(data: bytes, framer: WireFramer, dialect: WireCodec) -> list[WireMessage]:
    """Return the messages that are complete with these bytes: frames, and bytes between them.

    The framer keeps the bytes of an unfinished frame.
    """
    framer.feed(data)
    messages: list[WireMessage] = []
    while True:
        try:
            frame = framer.next_frame()
        except FrameError:
            before = framer.unfinished_bytes
            skipped = before[: framer.resync()]
            messages.append(WireMessage.of(skipped, skipped))
            continue
        if frame is None:
            return messages
        messages.append(WireMessage.of(frame, dialect.encode_frame(frame)))


def parse_one(data: bytes, dialect: WireCodec) -> WireMessage:
    """Return a datagram as a message, with its frame if the bytes are exactly one frame."""
    messages = parse(data, dialect.framer(len(data)), dialect)
    is_one_frame = [message.original for message in messages] == [data]
    return messages[0] if is_one_frame else WireMessage.of(data, data)
