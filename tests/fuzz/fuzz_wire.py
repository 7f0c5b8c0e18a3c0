"""What the message tables say of a frame, counted by hand: the fuzz targets' second opinion."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, NamedTuple

from smartcam.exceptions import MessageError
from smartcam.protocols import messages as m
from smartcam.protocols.framed.framing import Frame

if TYPE_CHECKING:
    from smartcam.protocols.framed.dialect import FramedDialect

__all__ = ["Body", "body_of", "check_decoding"]


class Body(NamedTuple):
    """What a message's body must be: bytes at least, and whether more of them mean something."""

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
