"""Target ``messages``: any frame's body to a message and back, beside construct's reading of it.

Input: dialect, sender, message id (of the table, or any), then the body.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from smartcam.models import jsonable
from smartcam.protocols import Frame
from smartcam.protocols import messages as m
from smartcam.protocols._inside import view_fields
from tests.fuzz.fuzz_input import Choices, check_decoding
from tests.machines import DIALECTS

if TYPE_CHECKING:
    from smartcam.protocols import FramedDialect

ANY_ID = 0xFF


def check(data: bytes) -> None:
    """Decode one frame; whatever comes of it must go back to the same bytes."""
    choices = Choices(data)
    dialect, sender = choices.pick(DIALECTS), choices.pick(tuple(m.Sender))
    frame = Frame(_message_id(choices, dialect), choices.rest())
    message = check_decoding(dialect, sender, frame)
    if message is None:
        return
    assert isinstance(message, dialect.message_type(sender, frame.message_id))
    again = dialect.decode(sender, dialect.to_frame(message))
    assert again == message
    assert repr(again) == repr(message)
    json.dumps(jsonable(message), allow_nan=False)
    _check_view(dialect, sender, frame, message)


def _message_id(choices: Choices, dialect: FramedDialect) -> int:
    number = choices.byte()
    if number == ANY_ID:
        return int.from_bytes(choices.take((dialect.header.code == "I" and 4) or 2), "little")
    return dialect.table[number % len(dialect.table)].message_id


def _check_view(dialect: FramedDialect, sender: m.Sender, frame: Frame, message: m.Message) -> None:
    """Hold construct's reading of the same bytes against the message."""
    raw = dialect.encode_frame(frame)
    fields = view_fields(dialect, sender, raw)
    offset = 0
    for view in fields:
        assert (view.offset, view.raw) == (offset, raw[offset : offset + len(view.raw)])
        offset += len(view.raw)
    assert offset == len(raw)
    seen = {view.name: view.value for view in fields}
    surplus = dialect.surplus(sender, frame)
    assert len(seen.pop("surplus", b"")) == max(0, surplus)
    assert seen.pop("message_id") == frame.message_id
    assert seen.pop("length") == len(frame.payload) + dialect.header.length_includes
    assert seen.pop("magic", b"") == dialect.header.magic
    names = dialect.fields(type(message)) or (
        ("payload",) if isinstance(message, m.UnknownMessage) else ()
    )
    if surplus < 0:
        names = ("code",)  # one that refuses, alone
    expected = {name: getattr(message, name) for name in names}
    if isinstance(message, m.StatusReport):  # the view has the wire's bits
        expected["status"] = dialect.status_bits.write(message.status)
    assert seen == expected
