"""Dialects as data: messages to frames and back, and who may do what with broken ones."""

from __future__ import annotations

import dataclasses

import pytest
from machines import DIALECTS, EXAMPLES, SIXTEEN

from smartcam.exceptions import FrameError, LocalProtocolError, MessageError
from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.protocols.base import MAX_KNOWN, POLICIES, Dialect, Policy, Role, Transport
from smartcam.protocols.bvs import HANDBOOK, MESSAGES, THESIS
from smartcam.protocols.framing import Frame

CAMERA, CLIENT = m.Sender.CAMERA, m.Sender.CLIENT
KNOWN = EXAMPLES[:-1]

each_dialect = pytest.mark.parametrize("dialect", DIALECTS, ids=lambda one: one.name)
each_message = pytest.mark.parametrize("message", KNOWN, ids=lambda one: type(one).__name__)

WITHOUT_SWITCH = dataclasses.replace(
    HANDBOOK,
    name="small",
    table=tuple(row for row in MESSAGES if row.type is not m.SwitchApplication),
)


# ---------------------------------------------------------------------- roles and policies


def test_role_sends_as_itself_and_receives_from_the_other() -> None:
    assert (Role.CLIENT.sends, Role.CLIENT.receives) == (CLIENT, CAMERA)
    assert (Role.CAMERA.sends, Role.CAMERA.receives) == (CAMERA, CLIENT)


def test_policies_only_a_client_on_tcp_fails_and_only_a_camera_wants_exact_lengths() -> None:
    assert dict(POLICIES) == {
        (Role.CLIENT, Transport.TCP): Policy(fatal=(FrameError, MessageError), exact_length=False),
        (Role.CLIENT, Transport.UDP): Policy(fatal=(), exact_length=False),
        (Role.CAMERA, Transport.TCP): Policy(fatal=(), exact_length=True),
        (Role.CAMERA, Transport.UDP): Policy(fatal=(), exact_length=True),
    }


# ---------------------------------------------------------------------- messages


def test_wire_fields_are_what_the_annotations_say_in_order() -> None:
    assert m.wire_fields(m.StatusReport) == (("status", m.Wire.WORD), ("endian", m.Wire.WORD))
    assert m.wire_fields(m.ResultContainer) == (
        ("application", m.Wire.WORD),
        ("data", m.Wire.DATA),
    )
    assert m.wire_fields(m.SetSequenceNumber) == (("number", m.Wire.UINT32),)
    assert m.wire_fields(m.Connect) == ()
    assert m.wire_fields(m.UnknownMessage) == ()


@each_message
def test_message_is_frozen_and_has_no_other_attributes(message: m.Message) -> None:
    assert not hasattr(message, "__dict__")
    names = [field.name for field in dataclasses.fields(message)] or ["sender"]
    with pytest.raises((dataclasses.FrozenInstanceError, TypeError, AttributeError)):
        setattr(message, names[0], 1)


@each_message
def test_message_sender_is_the_clients_for_requests_only(message: m.Message) -> None:
    assert message.sender is (CLIENT if isinstance(message, m.Request) else CAMERA)


# ---------------------------------------------------------------------- ids


@each_dialect
def test_message_type_and_id_are_each_others_inverse(dialect: Dialect) -> None:
    for row in dialect.table:
        assert dialect.message_type(row.type.sender, row.message_id) is row.type
        assert dialect.message_id(row.type) == row.message_id
    for message in EXAMPLES:
        assert dialect.message_id(message) == dialect.to_frame(message).message_id


def test_message_type_unknown_id_or_wrong_sender_is_an_unknown_message() -> None:
    assert HANDBOOK.message_type(CAMERA, 0x77) is m.UnknownMessage
    assert HANDBOOK.message_type(CLIENT, 0x20) is m.UnknownMessage
    assert HANDBOOK.message_type(CAMERA, 0x40) is m.UnknownMessage
    assert HANDBOOK.knows(CLIENT, 0x40)
    assert not HANDBOOK.knows(CAMERA, 0x40)


@pytest.mark.parametrize(
    ("request_id", "answer_id"),
    [(0x01, 0x01), (0x30, 0x30), (0x31, 0x31), (0x32, 0x32)]
    + [(silent, None) for silent in (0x02, 0x33, 0x34, 0x35, 0x40, 0x41, 0x42, 0x43)]
    + [(0x77, 0x77)],
)
def test_answer_id_is_the_requests_where_it_is_answered(
    request_id: int, answer_id: int | None
) -> None:
    assert HANDBOOK.answer_id(request_id) == answer_id


# ---------------------------------------------------------------------- encoding


def test_encode_word_is_as_wide_as_the_dialects_and_uint32_always_four_bytes() -> None:
    switch, number = m.SwitchApplication(application=5), m.SetSequenceNumber(number=7)
    assert HANDBOOK.encode(switch).hex() == "505356420400000031000000" + "05000000"
    assert THESIS.encode(switch).hex() == "425653500800000031000000" + "05000000"
    assert SIXTEEN.encode(switch).hex() == "31000200" + "0500"
    assert SIXTEEN.encode(number).hex() == "35000400" + "07000000"


def test_encode_unknown_message_writes_its_payload_under_its_id() -> None:
    message = m.UnknownMessage(message_id=0x77, payload=b"\x01\x02")
    assert HANDBOOK.to_frame(message) == Frame(0x77, b"\x01\x02")
    assert SIXTEEN.encode(message).hex() == "770002000102"


@pytest.mark.parametrize("application", [-1, 0x1_0000_0000, "5"])
def test_encode_field_that_does_not_fit_is_refused(application: int) -> None:
    message = m.SwitchApplication(application=application)
    with pytest.raises(LocalProtocolError, match=r"SwitchApplication\(.*does not fit its fields"):
        HANDBOOK.encode(message)


def test_encode_message_that_the_dialect_lacks_is_refused() -> None:
    with pytest.raises(LocalProtocolError) as caught:
        WITHOUT_SWITCH.encode(m.SwitchApplication(application=1))
    assert str(caught.value) == "dialect small has no message SwitchApplication"


def test_encode_payload_longer_than_the_header_can_say_is_refused() -> None:
    with pytest.raises(
        LocalProtocolError, match="0x34 with 65536 bytes of payload does not fit the sixteen header"
    ):
        SIXTEEN.encode(m.SetInput(data=bytes(0x10000)))
    assert len(SIXTEEN.encode(m.SetInput(data=bytes(0xFFFF)))) == 0xFFFF + 4


def test_encode_id_that_does_not_fit_the_header_is_refused() -> None:
    with pytest.raises(LocalProtocolError, match="message 0x12345 with 0 bytes of payload"):
        SIXTEEN.encode(m.UnknownMessage(message_id=0x12345, payload=b""))


# ---------------------------------------------------------------------- decoding


@each_dialect
@each_message
def test_decode_whole_body_gives_the_message(dialect: Dialect, message: m.Message) -> None:
    frame = dialect.to_frame(message)
    assert dialect.decode(message.sender, frame) == message
    assert dialect.surplus(message.sender, frame) == 0


@each_dialect
@each_message
def test_decode_body_cut_at_every_length_is_a_message_error(
    dialect: Dialect, message: m.Message
) -> None:
    frame = dialect.to_frame(message)
    needed = dialect.encoder(type(message)).size
    for size in range(needed):
        cut = frame._replace(payload=frame.payload[:size])
        with pytest.raises(MessageError) as caught:
            dialect.decode(message.sender, cut)
        assert str(caught.value).startswith(
            f"{type(message).__name__} ({frame.message_id:#04x}) came with {size} bytes, "
            f"it needs {needed}: {cut.payload.hex(' ')}"
        )
        assert caught.value.offset == dialect.header.size
        assert caught.value.data == cut.payload


@each_dialect
@each_message
def test_decode_trailing_bytes_are_data_or_cut_and_counted(
    dialect: Dialect, message: m.Message
) -> None:
    frame = dialect.to_frame(message)
    longer = frame._replace(payload=frame.payload + b"\xaa\xbb\xcc")
    decoded = dialect.decode(message.sender, longer)
    if isinstance(message, (m.ResultContainer, m.SetInput)):
        assert decoded == dataclasses.replace(message, data=message.data + b"\xaa\xbb\xcc")
        assert dialect.surplus(message.sender, longer) == 0
    else:
        assert decoded == message
        assert dialect.surplus(message.sender, longer) == 3


def test_decode_unknown_id_keeps_the_payload() -> None:
    frame = Frame(0x77, b"whatever")
    assert HANDBOOK.decode(CAMERA, frame) == m.UnknownMessage(message_id=0x77, payload=b"whatever")
    assert HANDBOOK.surplus(CAMERA, frame) == 0


def test_decode_status_keeps_unknown_bits() -> None:
    frame = Frame(0x12, bytes.fromhex("48000000 01000000"))
    assert HANDBOOK.decode(CAMERA, frame) == m.StatusReport(status=Status(0x48), endian=1)


def test_decode_empty_data_is_empty() -> None:
    assert HANDBOOK.decode(CLIENT, Frame(0x34, b"")) == m.SetInput(data=b"")
    container = HANDBOOK.decode(CAMERA, Frame(0x20, b"\x03\0\0\0"))
    assert container == m.ResultContainer(application=3, data=b"")


@each_dialect
def test_decode_ever_new_bodies_gives_their_messages_and_keeps_a_bounded_number(
    dialect: Dialect,
) -> None:
    fresh = dataclasses.replace(dialect, name="fresh")
    reports = [m.StatusReport(status=Status(word), endian=1) for word in range(3 * MAX_KNOWN)]
    for _ in range(2):
        for report in (*reports, *reports[::-1]):
            frame = fresh.to_frame(report)
            assert fresh.decode(CAMERA, frame) == report
            assert fresh.decode(CAMERA, Frame(frame.message_id, frame.payload + b"more")) == report
    codec = fresh.encoder(m.StatusReport)
    assert len(codec._known) == MAX_KNOWN
    first = fresh.to_frame(reports[0])
    assert fresh.decode(CAMERA, first) is fresh.decode(CAMERA, first)


@each_dialect
def test_decode_containers_and_unknown_messages_are_not_kept(dialect: Dialect) -> None:
    fresh = dataclasses.replace(dialect, name="fresh")
    for message in (m.ResultContainer(application=1, data=b"x"), EXAMPLES[-1]):
        frame = fresh.to_frame(message)
        assert fresh.decode(CAMERA, frame) == message
        assert fresh.decode(CAMERA, frame) is not fresh.decode(CAMERA, frame)
