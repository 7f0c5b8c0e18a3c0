"""The construct views: a second reading of the same tables, field by field."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import MessageError, ProtocolError
from smartcam.models import Status
from smartcam.protocols import FramedDialect
from smartcam.protocols import messages as m
from smartcam.protocols._framed.constructs import FieldView, frame_view
from smartcam.protocols._inside import HANDBOOK, Framer, view_fields
from tests.machines import (
    B16,
    BID,
    BIG_ENDIAN_NUMBER,
    DIALECTS,
    EVERYTHING,
    EXAMPLES,
    THESIS,
    label,
)
from tests.strategies import messages, over, streams

CAMERA = m.Sender.CAMERA
HEADER = {"magic", "length", "message_id"}

each_dialect = pytest.mark.parametrize("dialect", DIALECTS, ids=label)


def body(dialect: FramedDialect, sender: m.Sender, data: bytes) -> dict[str, object]:
    return {
        view.name: view.value
        for view in view_fields(dialect, sender, data)
        if view.name not in HEADER
    }


def test_view_fields_tells_each_field_with_its_place() -> None:
    data = bytes.fromhex("42565350 0c000000 31000000 01000000 03000000")
    assert view_fields(THESIS, CAMERA, data) == [
        FieldView("magic", 0, b"BVSP", b"BVSP"),
        FieldView("length", 4, b"\x0c\0\0\0", 12),
        FieldView("message_id", 8, b"\x31\0\0\0", 0x31),
        FieldView("code", 12, b"\x01\0\0\0", 1),
        FieldView("application", 16, b"\x03\0\0\0", 3),
    ]


def test_view_fields_of_bid_begin_with_the_id_and_have_the_wires_bits() -> None:
    data = bytes.fromhex("12000200 2001")
    assert view_fields(BID, CAMERA, data) == [
        FieldView("message_id", 0, b"\x12\0", 0x12),
        FieldView("length", 2, b"\x02\0", 2),
        FieldView("status", 4, b"\x20\x01", 0x120),
    ]
    data = bytes.fromhex("31000400 1a00 0100")
    assert body(BID, CAMERA, data) == {"code": 0x1A, "application": 1}


def test_view_fields_of_the_number_are_in_the_quirks_byte_order() -> None:
    data = bytes.fromhex("35000400 0357b000")
    assert body(BIG_ENDIAN_NUMBER, m.Sender.CLIENT, data) == {"number": 0x0357B000}
    assert body(B16, m.Sender.CLIENT, data) == {"number": 0x00B05703}


def test_view_fields_unknown_id_is_one_payload() -> None:
    data = bytes.fromhex("50535642 02000000 77000000 abcd")
    assert view_fields(HANDBOOK, CAMERA, data)[3:] == [
        FieldView("payload", 12, b"\xab\xcd", b"\xab\xcd")
    ]


@over("dialect, message", [one for one in EVERYTHING if one[1] is not EXAMPLES[-1]], label)
def test_view_fields_cover_every_byte_in_order(dialect: FramedDialect, message: m.Message) -> None:
    data = dialect.encode(message)
    views = view_fields(dialect, message.sender, data)
    assert b"".join(view.raw for view in views) == data
    assert [view.offset for view in views] == [
        sum(len(view.raw) for view in views[:number]) for number in range(len(views))
    ]


@pytest.mark.sampled(every=3)
@each_dialect
@pytest.mark.parametrize("sender", m.Sender)
@given(data=st.data())
def test_view_fields_are_what_decode_gives(
    dialect: FramedDialect, sender: m.Sender, data: st.DataObject
) -> None:
    message = data.draw(messages(dialect, sender))
    expected = {name: getattr(message, name) for name in dialect.fields(type(message))}
    if isinstance(message, m.StatusReport):  # the view has the wire's bits
        expected["status"] = dialect.status_bits.write(message.status)
    assert body(dialect, sender, dialect.encode(message)) == expected


@pytest.mark.sampled(every=3)
@each_dialect
@pytest.mark.parametrize("sender", m.Sender)
@given(data=st.data())
def test_view_fields_any_bytes_are_a_frame_for_both_readings_or_for_none(
    dialect: FramedDialect, sender: m.Sender, data: st.DataObject
) -> None:
    stream = data.draw(streams(dialect, sender))
    if is_whole(dialect, sender, stream):
        assert view_fields(dialect, sender, stream)
        return
    with pytest.raises(MessageError) as caught:
        view_fields(dialect, sender, stream)
    assert caught.value.data == stream[:64]


def is_whole(dialect: FramedDialect, sender: m.Sender, data: bytes) -> bool:
    """Return True if the framer and the codecs take the bytes as one frame."""
    framer = Framer(dialect.header)
    framer.feed(data)
    try:
        frame = framer.next_frame()
        if frame is None or framer.buffered:
            return False
        dialect.decode(sender, frame)
    except ProtocolError:
        return False
    return True


@pytest.mark.parametrize(
    "data",
    [
        b"",
        bytes.fromhex("50535642 08000000 12000000 80020000 000000"),
        bytes.fromhex("50535642 08000000 12000000 80020000 00000000 00"),
        bytes.fromhex("50535642 04000000 12000000 80020000"),
        bytes.fromhex("42565350 0c000000 12000000 80020000 00000000"),
    ],
    ids=["empty", "cut", "trailing", "too short", "other magic"],
)
def test_view_fields_what_is_no_whole_frame_is_a_message_error(data: bytes) -> None:
    with pytest.raises(MessageError) as caught:
        view_fields(HANDBOOK, CAMERA, data)
    assert str(caught.value).startswith(
        f"no whole handbook frame from the camera: {data.hex(' ')}: "
    )
    assert caught.value.data == data


def test_view_fields_longer_body_ends_with_the_surplus() -> None:
    data = bytes.fromhex("50535642 0a000000 12000000 80020000 00000000 abcd")
    last = view_fields(HANDBOOK, CAMERA, data)[-1]
    assert (last.name, last.offset, last.raw) == ("surplus", 20, b"\xab\xcd")


def test_frame_view_builds_the_same_bytes() -> None:
    view = frame_view(HANDBOOK, CAMERA)
    status = {"status": {"value": Status(0x280)}, "endian": {"value": 0}}
    built = view.build(
        {
            "magic": {"value": b"PSVB"},
            "length": {"value": 8},
            "message_id": {"value": 0x12},
            "body": status,
        }
    )
    assert built == bytes.fromhex("50535642 08000000 12000000 80020000 00000000")
    assert frame_view(HANDBOOK, CAMERA) is view
