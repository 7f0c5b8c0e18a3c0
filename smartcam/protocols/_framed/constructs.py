"""Describe a dialect's frames field by field, with the package construct.

The descriptions are generated from the dialect's message table. People read them (``smartcam
decode``, the documentation), and tests compare them with the codecs, which are faster and which
clients use. The package construct has no type hints, so only this module imports it.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, NamedTuple

import construct as c

from smartcam.exceptions import MessageError, hex_excerpt
from smartcam.protocols._base import Verdict
from smartcam.protocols.messages import Wire

if TYPE_CHECKING:
    from smartcam.protocols._framed.dialect import FramedDialect
    from smartcam.protocols.messages import Sender

# bytes by which a body is longer than documented
_SURPLUS: Any = c.Default(c.RawCopy(c.GreedyBytes), {"value": b""})


class FieldView(NamedTuple):
    """One field of a frame.

    Attributes:
        name: name of the field in the message, or ``magic``, ``length``, ``message_id``.
        offset: offset of the field's first byte in the frame.
        raw: bytes of the field.
        value: an integer, or the bytes.
    """

    name: str
    offset: int
    raw: bytes
    value: Any


@functools.cache
def frame_view(dialect: FramedDialect, sender: Sender) -> c.Construct:
    """Return a construct for whole frames from one sender; it parses and builds."""
    integer = {"I": c.Int32ul, "H": c.Int16ul}
    types = {
        "<": {Wire.WORD: integer[dialect.word], Wire.UINT32: c.Int32ul, Wire.DATA: c.GreedyBytes},
        ">": {Wire.UINT32: c.Int32ub},
    }
    bodies = {
        row.message_id: c.Struct(
            *[name / c.RawCopy(types[row.byte_order][wire]) for name, wire in row.fields],
            "surplus" / _SURPLUS,
        )
        for row in dialect.table
        if row.type.sender is sender
    }
    good = [code for code, (_, verdict) in dialect.codes.items() if verdict is Verdict.DONE]
    refusal = c.Struct("code" / c.RawCopy(c.NoneOf(integer[dialect.word], good)), c.Terminated)
    for row in dialect.table:
        if row.type.sender is sender and dialect.encoder(row.type).may_be_code_only:
            bodies[row.message_id] = c.Select(bodies[row.message_id], refusal)
    header = dialect.header
    size = c.this.length.value - header.length_includes
    names = ("length", "message_id") if header.order == "length, id" else ("message_id", "length")
    return c.Struct(
        *(["magic" / c.RawCopy(c.Const(header.magic))] if header.magic else []),
        *[name / c.RawCopy(integer[header.code]) for name in names],
        "body"
        / c.FixedSized(
            size,
            c.Switch(
                c.this.message_id.value,
                bodies,
                default=c.Struct("payload" / c.RawCopy(c.GreedyBytes)),
            ),
        ),
        c.Terminated,
    )


def view_fields(dialect: FramedDialect, sender: Sender, data: bytes) -> list[FieldView]:
    """Return every field of one whole frame, in order, and surplus bytes as ``surplus``.

    Raises MessageError: the bytes are no complete frame of this dialect from this sender.
    """
    try:
        parsed = frame_view(dialect, sender).parse(data)
    except c.ConstructError as exc:
        raise MessageError(
            f"no whole {dialect.name} frame from the {sender.value}: {hex_excerpt(data)}: {exc}",
            data=data,
        ) from exc
    body = parsed.pop("body")
    return [
        FieldView(name, field.offset1, field.data, field.value)
        for part in (parsed, body)
        for name, field in part.items()
        if name != "_io" and (name != "surplus" or field.data)
    ]
