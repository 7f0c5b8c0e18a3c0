"""Reading of a target's input: small choices from the front, the bytes for them from behind."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from smartcam.exceptions import MessageError
from smartcam.protocols import Frame
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.protocols import FramedDialect

T = TypeVar("T")


class Choices:
    """Takes choices from bytes, one byte each; where the bytes end, every choice is the first.

    Nothing is ever refused, so whatever a mutator does to an input, it stays one.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def byte(self) -> int:
        """Return the next byte, 0 at the end."""
        taken = self.take(1)
        return taken[0] if taken else 0

    def pick(self, options: Sequence[T]) -> T:
        """Return one of ``options``."""
        return options[self.byte() % len(options)]

    def take(self, count: int) -> bytes:
        """Return the next ``count`` bytes, fewer at the end."""
        taken = self._data[self._at : self._at + count]
        self._at += len(taken)
        return taken

    def rest(self) -> bytes:
        """Return everything that is left."""
        return self.take(len(self._data))


def text_of(data: bytes) -> str:
    """Return bytes as a text; what is no UTF-8 becomes lone surrogates, as a ``str`` may have."""
    return data.decode("utf-8", "surrogateescape")


class Body(NamedTuple):
    """The body of a message: its least size, and whether more bytes mean something."""

    size: int
    open_end: bool


@functools.cache
def body_of(dialect: FramedDialect, sender: m.Sender, message_id: int) -> Body:
    """Return what the body of a frame must be; an unknown id's may be anything."""
    word = {"I": 4, "H": 2}[dialect.word]
    sizes = {m.Wire.WORD: word, m.Wire.UINT32: 4, m.Wire.DATA: 0}
    for row in dialect.table:
        if row.message_id == message_id and row.type.sender is sender:
            wires = [wire for name, wire in m.wire_fields(row.type) if name not in row.omits]
            return Body(sum(sizes[wire] for wire in wires), m.Wire.DATA in wires)
    return Body(0, open_end=True)


def check_decoding(dialect: FramedDialect, sender: m.Sender, frame: Frame) -> m.Message | None:
    """Decode a frame and encode what comes of it; return the message, None for a short body."""
    body = body_of(dialect, sender, frame.message_id)
    too_many = 0 if body.open_end else max(0, len(frame.payload) - body.size)
    try:
        message = dialect.decode(sender, frame)
    except MessageError as error:
        assert len(frame.payload) < body.size, "a body that is not short was refused"
        assert error.data == frame.payload[:64]
        return None
    missing = max(0, body.size - len(frame.payload))
    if missing:  # a result code that refuses may come alone
        assert isinstance(message, m.Acknowledgement), "a short body was accepted"
        assert len(frame.payload) == 2, "a short body was accepted"
        assert message.code, "a short body was accepted"
        frame = Frame(frame.message_id, frame.payload + bytes(missing))
    assert dialect.surplus(sender, frame) == too_many
    assert dialect.message_id(message) == frame.message_id
    encoded = dialect.to_frame(message)
    assert encoded.message_id == frame.message_id
    assert encoded.payload == frame.payload[: len(frame.payload) - too_many]
    if not too_many:
        assert dialect.encode(message) == dialect.encode_frame(frame)
    return message
