"""Dialects of binary frames: messages to frames and back, status bits, quirks."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from smartcam.exceptions import (
    ConfigurationError,
    LocalProtocolError,
    MessageError,
    UnsupportedError,
)
from smartcam.models import Status
from smartcam.protocols import CodeMeaning, Frame, FramedDialect, RawRequest, StatusBits, Verdict
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK, ReadableFrame, ResultCode
from tests.machines import (
    B16,
    BID,
    BIG_ENDIAN_NUMBER,
    CODE,
    CODES,
    DIALECTS,
    EVERYTHING,
    EXAMPLES,
    MESSAGES,
    NO_ID,
    THESIS,
    label,
)
from tests.protocols.inside import UNDOCUMENTED
from tests.strategies import over

CAMERA, CLIENT = m.Sender.CAMERA, m.Sender.CLIENT
KNOWN = [(dialect, message) for dialect, message in EVERYTHING if message is not EXAMPLES[-1]]

each_dialect = pytest.mark.parametrize("dialect", DIALECTS, ids=label)
each_message = over("dialect, message", KNOWN, label)

WITHOUT_SWITCH = dataclasses.replace(
    HANDBOOK,
    name="small",
    table=tuple(row for row in MESSAGES if row.type is not m.SwitchApplication),
)


# ---------------------------------------------------------------------- ids


@each_dialect
def test_message_type_and_id_are_each_others_inverse(dialect: FramedDialect) -> None:
    for row in dialect.table:
        assert dialect.message_type(row.type.sender, row.message_id) is row.type
        assert dialect.message_id(row.type) == row.message_id
        assert dialect.has(row.type)


@over("dialect, message", EVERYTHING, label)
def test_message_id_is_the_frames(dialect: FramedDialect, message: m.Message) -> None:
    assert dialect.message_id(message) == dialect.to_frame(message).message_id


def test_message_type_unknown_id_or_wrong_sender_is_an_unknown_message() -> None:
    assert HANDBOOK.message_type(CAMERA, 0x77) is m.UnknownMessage
    assert HANDBOOK.message_type(CLIENT, 0x20) is m.UnknownMessage
    assert HANDBOOK.message_type(CAMERA, 0x40) is m.UnknownMessage
    assert BID.message_type(CAMERA, 0x40) is m.TriggerAnswer
    assert BID.message_type(CLIENT, 0x41) is m.UnknownMessage
    assert HANDBOOK.knows(CLIENT, 0x40)
    assert not HANDBOOK.knows(CAMERA, 0x40)
    assert BID.knows(CAMERA, 0x40)


@over("dialect", [HANDBOOK, THESIS, B16, CODE], label)
@over(
    "request_id, answer_id",
    [(0x01, 0x01), (0x30, 0x30), (0x31, 0x31), (0x32, 0x32)]
    + [(silent, None) for silent in (0x02, 0x33, 0x34, 0x35, 0x40, 0x41, 0x42, 0x43)]
    + [(0x77, 0x77)],
)
def test_answer_id_is_the_requests_where_it_is_answered(
    request_id: int, answer_id: int | None, dialect: FramedDialect
) -> None:
    assert dialect.answer_id(request_id) == answer_id


def test_answer_id_in_bid_is_always_the_requests_but_nobody_waits_for_disconnect() -> None:
    for row in BID.table:
        if issubclass(row.type, m.Request):
            waits = row.type is not m.Disconnect  # one document has an answer, one has none
            assert BID.answer_id(row.message_id) == (row.message_id if waits else None)
            assert BID.answers(row.type) == waits
    assert not B16.answers(m.Trigger)
    assert not HANDBOOK.answers(m.Disconnect)


# ---------------------------------------------------------------------- encoding


def test_encode_word_is_as_wide_as_the_dialects_and_uint32_always_four_bytes() -> None:
    switch, number = m.SwitchApplication(application=5), m.SetSequenceNumber(number=7)
    assert HANDBOOK.encode(switch).hex() == "505356420400000031000000" + "05000000"
    assert THESIS.encode(switch).hex() == "425653500800000031000000" + "05000000"
    assert B16.encode(switch).hex() == "31000200" + "0500"
    assert B16.encode(number).hex() == "35000400" + "07000000"
    assert BIG_ENDIAN_NUMBER.encode(number).hex() == "35000400" + "00000007"


def test_encode_field_that_the_dialect_leaves_out_is_not_on_the_wire() -> None:
    report = m.StatusReport(status=Status(0x280), endian=1)
    assert B16.encode(report).hex() == "12000200" + "8002"
    assert NO_ID.encode(m.ResultContainer(application=21, data=b"!")).hex() == "20000100" + "21"
    assert B16.encode(m.ConnectAnswer(code=7, version=1)).hex() == "01000200" + "0100"
    assert CODE.encode(m.ConnectAnswer(code=7, version=1)).hex() == "01000400" + "07000100"


def test_encode_unknown_and_malformed_messages_write_their_payload_under_their_id() -> None:
    message = m.UnknownMessage(message_id=0x77, payload=b"\x01\x02")
    assert HANDBOOK.to_frame(message) == Frame(0x77, b"\x01\x02")
    assert B16.encode(message).hex() == "770002000102"
    malformed = m.MalformedMessage(message_id=0x40, payload=b"\x01")
    assert BID.encode(malformed).hex() == "4000010001"
    assert BID.message_id(malformed) == 0x40


@pytest.mark.parametrize("application", [-1, 0x1_0000_0000, "5"])
def test_encode_field_that_does_not_fit_is_refused(application: int) -> None:
    message = m.SwitchApplication(application=application)
    with pytest.raises(LocalProtocolError, match=r"SwitchApplication\(.*does not fit its fields"):
        HANDBOOK.encode(message)


@pytest.mark.parametrize("dialect", [B16, BID], ids=label)
def test_encode_id_of_more_than_sixteen_bits_is_refused_by_the_narrow_dialects(
    dialect: FramedDialect,
) -> None:
    assert dialect.encode(m.SwitchApplication(application=0xFFFF)).hex() == "31000200ffff"
    with pytest.raises(LocalProtocolError, match="does not fit its fields"):
        dialect.encode(m.SwitchApplication(application=0x10000))
    assert dialect.application_ids == range(1, 0x10000)
    assert HANDBOOK.application_ids == range(1, 1 << 32)


@pytest.mark.parametrize("dialect", [B16, BID], ids=label)
def test_encode_payload_longer_than_the_header_can_say_is_refused(dialect: FramedDialect) -> None:
    message = f"0x34 with 65536 bytes of payload does not fit the {dialect.name} header"
    with pytest.raises(LocalProtocolError, match=message):
        dialect.encode(m.SetInput(data=bytes(0x10000)))
    whole = dialect.encode(m.SetInput(data=bytes(0xFFFF)))
    assert (len(whole), whole[:4]) == (0xFFFF + 4, bytes.fromhex("3400 ffff"))


def test_encode_container_of_the_most_bytes_counts_its_id() -> None:
    assert len(B16.encode(m.ResultContainer(application=1, data=bytes(0xFFFD)))) == 0xFFFF + 4
    with pytest.raises(LocalProtocolError, match="0x20 with 65536 bytes"):
        B16.encode(m.ResultContainer(application=1, data=bytes(0xFFFE)))
    assert len(NO_ID.encode(m.ResultContainer(data=bytes(0xFFFF)))) == 0xFFFF + 4


def test_encode_id_that_does_not_fit_the_header_is_refused() -> None:
    with pytest.raises(LocalProtocolError, match="message 0x12345 with 0 bytes of payload"):
        B16.encode(m.UnknownMessage(message_id=0x12345, payload=b""))


# ---------------------------------------------------------------------- what a dialect cannot do


def test_encode_message_that_the_dialect_lacks_is_unsupported() -> None:
    with pytest.raises(UnsupportedError) as caught:
        WITHOUT_SWITCH.encode(m.SwitchApplication(application=1))
    assert str(caught.value) == (
        "dialect small has no SwitchApplication; it can: start_stop, reboot, get_clock, set_clock, "
        "input_data, sequence_number, unasked_status, unasked_results"
    )


@over(
    "dialect, message",
    [(dialect, one) for dialect in DIALECTS for one in EXAMPLES[:-1] if not dialect.has(type(one))],
    label,
)
def test_every_message_that_a_dialect_lacks_is_unsupported_by_name(
    dialect: FramedDialect, message: m.Message
) -> None:
    can = ", ".join(dialect.capabilities.names)
    text = f"dialect {dialect.name} has no {type(message).__name__}; it can: {can}"
    for ask in (dialect.encode, dialect.to_frame, dialect.message_id):
        with pytest.raises(UnsupportedError) as caught:
            ask(message)
        assert str(caught.value) == text
    assert dialect.fields(type(message)) == ()


BVS_SC = ["switch", "start_stop", "reboot", "get_clock", "set_clock", "input_data"]


@pytest.mark.parametrize(
    ("dialect", "names"),
    [
        *(
            (one, [*BVS_SC, "sequence_number", "unasked_status", "unasked_results"])
            for one in DIALECTS
            if one is not BID
        ),
        (
            BID,
            [
                *("switch", "get_clock", "set_clock", "input_data", "result_codes"),
                *("get_status", "reset_errors", "unasked_results"),
            ],
        ),
    ],
    ids=label,
)
def test_capabilities_are_what_the_table_has(dialect: FramedDialect, names: list[str]) -> None:
    assert dialect.capabilities.names == names
    assert dialect.capabilities.dialect == dialect.name


# ---------------------------------------------------------------------- decoding


@each_message
def test_decode_whole_body_gives_the_message(dialect: FramedDialect, message: m.Message) -> None:
    frame = dialect.to_frame(message)
    assert dialect.decode(message.sender, frame) == message
    assert dialect.surplus(message.sender, frame) == 0


@each_message
def test_decode_body_cut_at_every_length_is_a_message_error(
    dialect: FramedDialect, message: m.Message
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


@each_message
def test_decode_trailing_bytes_are_data_or_cut_and_counted(
    dialect: FramedDialect, message: m.Message
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


@each_message
def test_codec_fits_is_the_documented_length(dialect: FramedDialect, message: m.Message) -> None:
    codec = dialect.encoder(type(message))
    fitting = [size for size in range(codec.size + 3) if codec.fits(size)]
    more = [codec.size + 1, codec.size + 2] if codec.has_data else []
    assert fitting == [codec.size, *more]


def test_decode_field_that_the_dialect_leaves_out_has_its_default() -> None:
    status = B16.decode(CAMERA, Frame(0x12, bytes.fromhex("8002")))
    assert status == m.StatusReport(status=Status(0x280), endian=0)
    assert NO_ID.decode(CAMERA, Frame(0x20, b"ab")) == m.ResultContainer(application=-1, data=b"ab")
    assert B16.decode(CAMERA, Frame(0x30, b"\x15\0")) == m.QueryAnswer(code=0, application=21)
    assert CODE.decode(CAMERA, Frame(0x30, b"\x02\0\x15\0")) == m.QueryAnswer(
        code=2, application=21
    )


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
    assert NO_ID.decode(CAMERA, Frame(0x20, b"")) == m.ResultContainer(data=b"")


@each_dialect
def test_decode_ever_new_bodies_gives_their_messages_and_keeps_a_bounded_number(
    dialect: FramedDialect,
) -> None:
    fresh = dataclasses.replace(dialect, name="fresh")
    read = fresh.status_bits.read
    reports = [m.StatusReport(status=read(word)) for word in range(3 * 256)]
    for _ in range(2):
        for report in (*reports, *reports[::-1]):
            frame = fresh.to_frame(report)
            assert fresh.decode(CAMERA, frame) == report
            assert fresh.decode(CAMERA, Frame(frame.message_id, frame.payload + b"more")) == report
    codec = fresh.encoder(m.StatusReport)
    assert len(codec._messages) == 256
    first = fresh.to_frame(reports[0])
    assert fresh.decode(CAMERA, first) is fresh.decode(CAMERA, first)


@each_dialect
def test_decode_containers_and_unknown_messages_are_not_kept(dialect: FramedDialect) -> None:
    fresh = dataclasses.replace(dialect, name="fresh")
    for frame in (Frame(0x20, b"\1\0\0\0x"), Frame(0x77, b"what")):
        assert fresh.decode(CAMERA, frame) == fresh.decode(CAMERA, frame)
        assert fresh.decode(CAMERA, frame) is not fresh.decode(CAMERA, frame)


# ---------------------------------------------------------------------- status bits

BITS = BID.status_bits


def test_status_bits_of_bid_every_word_comes_back() -> None:
    for word in range(1 << 16):
        assert BITS.write(BITS.read(word)) == word


@pytest.mark.parametrize("dialect", [HANDBOOK, B16], ids=label)
def test_status_bits_without_any_are_those_of_status(dialect: FramedDialect) -> None:
    assert dialect.status_bits == StatusBits()
    for word in (0, 0x280, 0x48, 0xFFFF):
        assert dialect.status_bits.read(word) == Status(word)
        assert dialect.status_bits.write(Status(word)) == word


@pytest.mark.parametrize("waiting", [Status(0), Status.WAITING_FOR_TRIGGER])
@pytest.mark.parametrize("error", [Status(0), Status.OVERTRIGGERED])
@pytest.mark.parametrize("busy", [Status(0), Status.BUSY])
@pytest.mark.parametrize("more", [Status(0), Status.SIMULATION_MODE, Status(0xF01E << 32)])
def test_status_bits_of_bid_every_meaningful_status_comes_back(
    waiting: Status, error: Status, busy: Status, more: Status
) -> None:
    status = Status.RUNNING | waiting | error | busy | more
    assert BITS.write(status) <= 0xFFFF
    assert BITS.read(BITS.write(status)) == status


@pytest.mark.parametrize(
    ("word", "status"),
    [
        (0x0000, Status.RUNNING | Status.BUSY),
        (0x0020, Status.RUNNING),
        (0x0021, Status.RUNNING | Status.WAITING_FOR_TRIGGER),
        (0x0120, Status.RUNNING | Status.OVERTRIGGERED),
        (0x0028, Status.RUNNING | Status.SIMULATION_MODE),
        (0x1020, Status.RUNNING | Status(0x1000 << 32)),
        (0x0101, Status.RUNNING | Status.BUSY | Status(0x300)),
    ],
)
def test_status_bits_of_bid_are_the_documents(word: int, status: Status) -> None:
    assert BITS.read(word) == status
    assert BITS.write(status) == word


def test_status_bits_of_bid_bits_without_a_place_are_left_out() -> None:
    alike = Status.RUNNING | Status.OVERHEAT | Status.SYSTEM_ERROR | Status.INPUT_CONTAINER
    assert BITS.write(alike) == BITS.write(Status.RUNNING) == BITS.write(Status(0)) == 0x0020


def test_status_bits_of_bid_higher_bits_do_not_pass_for_named_ones() -> None:
    assert BITS.write(Status.RUNNING | Status.BUSY | Status(0x121 << 32)) == 0x0000
    assert BITS.write(Status.RUNNING | Status(0x121 << 32)) == 0x0020


def test_restate_reads_the_word_of_a_kin_as_its_own() -> None:
    frame = Frame(0x12, bytes.fromhex("2001"))
    read = B16.decode(CAMERA, frame)
    assert read == m.StatusReport(status=Status(0x120))
    assert isinstance(read, m.StatusReport)
    assert BID.reinterpret_status(read, B16) == BID.decode(CAMERA, frame)
    assert CODE.reinterpret_status(read, B16) is not read
    assert CODE.reinterpret_status(read, B16) == read


@pytest.mark.long
def test_restate_there_and_back_keeps_every_word() -> None:
    for word in range(1 << 16):
        read = m.StatusReport(status=BITS.read(word))
        assert B16.reinterpret_status(read, BID) == m.StatusReport(status=Status(word))
        assert BID.reinterpret_status(B16.reinterpret_status(read, BID), B16) == read


# ---------------------------------------------------------------------- quirks


def test_with_quirks_same_names_give_the_same_dialect_in_any_order() -> None:
    both = B16.with_quirks(["no_id", "code"])
    assert both is B16.with_quirks(("code", "no_id", "code"))
    assert both is not B16.with_quirks(["code"])
    assert both.quirks == ("code", "no_id")
    assert both.with_quirks(["code"]) is both
    assert B16.with_quirks([]) is B16
    assert B16.quirks == ()


def test_with_quirks_one_after_the_other_has_both() -> None:
    both = B16.with_quirks(["code"]).with_quirks(["no_id"])
    assert both.quirks == ("code", "no_id")
    assert both.table == B16.with_quirks(["code", "no_id"]).table
    assert both.codes == CODES


def test_with_quirks_changes_its_own_messages_and_nothing_else() -> None:
    for name, quirk in B16.wire_quirks.items():
        dialect = B16.with_quirks([name])
        changed = {row.type for row in quirk.rows}
        assert [row.type for row in dialect.table] == [row.type for row in B16.table]
        assert {row for row in dialect.table if row not in B16.table} == {*quirk.rows}
        assert {row.type for row in dialect.table if row in B16.table}.isdisjoint(changed)
        assert (dialect.name, dialect.header, dialect.word) == ("b16", B16.header, "H")
        assert dialect.capabilities == B16.capabilities


@pytest.mark.parametrize(
    ("dialect", "text"),
    [
        (B16, "dialect b16 has no quirk 'loud'; it has code, no_id, big_endian_number"),
        (BID, "dialect bid has no quirk 'loud'; it has none"),
        (HANDBOOK, "dialect handbook has no quirk 'loud'; it has none"),
    ],
    ids=label,
)
def test_with_quirks_unknown_one_is_reported_with_those_there_are(
    dialect: FramedDialect, text: str
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        dialect.with_quirks(["loud"])
    assert str(caught.value) == text


def test_with_quirks_unknown_one_among_known_ones_is_named() -> None:
    with pytest.raises(ConfigurationError, match="no quirk 'loud'"):
        B16.with_quirks(["code", "loud"])


def test_label_is_the_name_and_the_quirks() -> None:
    assert B16.label == "b16"
    assert CODE.label == "b16 with quirk code"
    assert B16.with_quirks(["no_id", "code"]).label == "b16 with quirk code, no_id"


def test_quirks_have_a_line_for_people_and_a_graded_source() -> None:
    for quirk in B16.wire_quirks.values():
        assert quirk.about
        assert quirk.source.endswith(("published", "inferred"))
        for row in quirk.rows:
            assert row.source.endswith(("published", "inferred"))


# ---------------------------------------------------------------------- result codes


@pytest.mark.parametrize(
    ("code", "text", "verdict"),
    [
        (0x00, "OK: executed", Verdict.DONE),
        (0x02, "OK Inspection ID", Verdict.DONE),
        (0x06, "OK Date Time", Verdict.DONE),
        (
            0x10,
            "NOK Error: transfer or execution failed, e.g. wrong format or length",
            Verdict.REFUSED,
        ),
        (0x13, "NOK Invalid Command: unknown command code", Verdict.UNKNOWN),
        (0x16, "NOK Busy: Ready status is not set", Verdict.BUSY),
        (0x1A, "NOK Inspection Error: program change failed", Verdict.REFUSED),
    ],
)
@pytest.mark.parametrize("dialect", [BID, CODE], ids=label)
def test_code_of_bid_and_of_the_quirk_is_the_documents(
    dialect: FramedDialect, code: int, text: str, verdict: Verdict
) -> None:
    assert dialect.code(code) == CodeMeaning(text, verdict)
    assert ResultCode(code) in CODES


@pytest.mark.parametrize("dialect", DIALECTS, ids=label)
def test_code_that_no_document_has_refuses(dialect: FramedDialect) -> None:
    assert dialect.code(0x99) is UNDOCUMENTED
    assert UNDOCUMENTED.verdict is Verdict.REFUSED
    assert UNDOCUMENTED.text == "not documented"


@pytest.mark.parametrize("dialect", [HANDBOOK, THESIS, B16, NO_ID, BIG_ENDIAN_NUMBER], ids=label)
def test_code_elsewhere_is_that_of_a_switch(dialect: FramedDialect) -> None:
    assert [*dialect.codes] == [0, 1]
    assert dialect.code(0) == CodeMeaning("done", Verdict.DONE)
    assert dialect.code(1) == CodeMeaning("id invalid", Verdict.REFUSED)


# ---------------------------------------------------------------------- in words


@pytest.mark.parametrize(
    ("dialect", "sender", "frame", "spelled"),
    [
        (
            BID,
            CAMERA,
            Frame(0x31, bytes.fromhex("1a000100")),
            (0x31, "SwitchAnswer", {"code": 0x1A, "application": 1}),
        ),
        (B16, CAMERA, Frame(0x30, b"\x15\0"), (0x30, "QueryAnswer", {"application": 21})),
        (NO_ID, CAMERA, Frame(0x20, b"\xff"), (0x20, "ResultContainer", {"data": "ff"})),
        (B16, CLIENT, Frame(0x77, b"\xff"), (0x77, "UnknownMessage", {})),
        (B16, CAMERA, Frame(0x30, b"\x15"), (0x30, "QueryAnswer", None)),
    ],
)
def test_spell_has_the_fields_on_the_wire_and_none_where_they_cannot_be_read(
    dialect: FramedDialect,
    sender: m.Sender,
    frame: Frame,
    spelled: tuple[int, str, dict[str, object] | None],
) -> None:
    assert dialect.make_readable(sender, frame) == ReadableFrame(
        *spelled, data=dialect.encode_frame(frame)
    )


def test_spell_status_has_the_names_of_its_bits() -> None:
    fields = BID.make_readable(CAMERA, Frame(0x12, bytes.fromhex("2001"))).fields
    assert fields is not None
    assert fields == {"status": ["RUNNING", "OVERTRIGGERED"]}


@each_message
def test_spell_every_message_has_the_dialects_fields(
    dialect: FramedDialect, message: m.Message
) -> None:
    spelled = dialect.make_readable(message.sender, dialect.to_frame(message))
    assert spelled.message == type(message).__name__
    assert spelled.fields is not None
    assert tuple(spelled.fields) == dialect.fields(type(message))
    assert spelled.data == dialect.encode(message)


# ---------------------------------------------------------------------- raw requests


@pytest.mark.parametrize(
    ("dialect", "message_id", "payload", "message", "answer", "answered", "known"),
    [  # no message: its bytes are sent as an unknown one
        (HANDBOOK, 0x30, b"", m.Query(), m.QueryAnswer, True, True),
        (B16, 0x40, b"", m.Trigger(), 0x40, False, True),
        (BID, 0x40, b"", m.Trigger(), m.TriggerAnswer, True, True),
        (BID, 0x12, b"", m.GetStatus(), m.StatusReport, True, True),
        (BID, 0x41, b"", None, 0x41, True, False),
        (B16, 0x31, b"\x05\0", m.SwitchApplication(application=5), m.SwitchAnswer, True, True),
        (B16, 0x31, b"\x05", None, m.SwitchAnswer, True, True),
        (B16, 0x31, b"\x05\0!", None, m.SwitchAnswer, True, True),
    ],
)
def test_raw_request_is_the_message_where_it_is_one_and_its_bytes_elsewhere(
    dialect: FramedDialect,
    message_id: int,
    payload: bytes,
    message: Any,
    answer: Any,
    answered: bool,
    known: bool,
) -> None:
    sent = message or m.UnknownMessage(message_id=message_id, payload=payload)
    expected = RawRequest(sent, answer, expects_answer=answered, known=known)
    assert dialect.raw_request(message_id, payload) == expected
    assert dialect.to_frame(sent) == Frame(message_id, payload)


@each_dialect
def test_raw_request_of_the_session_is_refused(dialect: FramedDialect) -> None:
    for message_id in (0x01, 0x02):
        with pytest.raises(LocalProtocolError) as caught:
            dialect.raw_request(message_id, b"")
        assert str(caught.value) == "only the client itself sends Connect and Disconnect"


def test_raw_request_with_a_word_for_an_id_is_unsupported() -> None:
    with pytest.raises(UnsupportedError) as caught:
        BID.raw_request("SO1", b"")
    assert str(caught.value) == "dialect bid: a message id is a number: 'SO1'"


@each_message
def test_body_is_an_answers_bytes_after_the_header(
    dialect: FramedDialect, message: m.Message
) -> None:
    assert dialect.body(message) == dialect.encode(message)[dialect.header.size :]


@pytest.mark.parametrize("dialect", [BID, CODE], ids=label)
def test_answer_that_is_only_a_refusing_code_is_taken_for_one(dialect: FramedDialect) -> None:
    refused = dialect.decode(m.Sender.CAMERA, Frame(0x31, b"\x1a\x00"))
    assert refused == m.SwitchAnswer(code=ResultCode.INSPECTION_ERROR, application=0)
    busy = dialect.decode(m.Sender.CAMERA, Frame(0x30, b"\x16\x00"))
    assert busy == m.QueryAnswer(code=ResultCode.BUSY, application=0)


@pytest.mark.parametrize(
    ("dialect", "frame"),
    [
        (BID, Frame(0x31, b"\x00\x00")),  # a good code promises the rest
        (BID, Frame(0x31, b"\x1a")),
        (BID, Frame(0x31, b"\x1a\x00\x05")),
        (BID, Frame(0x01, b"\x01\x00")),  # the version, in another dialect
        (B16, Frame(0x31, b"\x01\x00")),
        (HANDBOOK, Frame(0x31, b"\x01\x00\x00\x00")),
    ],
)
def test_answer_that_is_too_short_otherwise_is_an_error(
    dialect: FramedDialect, frame: Frame
) -> None:
    with pytest.raises(MessageError, match="it needs"):
        dialect.decode(m.Sender.CAMERA, frame)


def test_with_quirks_one_after_the_other_is_the_same_object() -> None:
    both = B16.with_quirks(["code", "no_id"])
    assert B16.with_quirks(["code"]).with_quirks(["no_id"]) is both
    assert both.with_quirks([]) is both


# ---------------------------------------------------------------------- words


each_example = pytest.mark.parametrize("message", EXAMPLES[:-1], ids=label)


def test_wire_fields_are_what_the_annotations_say_in_order() -> None:
    assert m.wire_fields(m.StatusReport) == (("status", m.Wire.WORD), ("endian", m.Wire.WORD))
    assert m.wire_fields(m.ResultContainer) == (
        ("application", m.Wire.WORD),
        ("data", m.Wire.DATA),
    )
    assert m.wire_fields(m.SetSequenceNumber) == (("number", m.Wire.UINT32),)
    assert m.wire_fields(m.Connect) == ()
    assert m.wire_fields(m.UnknownMessage) == ()


@each_example
def test_message_is_frozen_and_has_no_other_attributes(message: m.Message) -> None:
    assert not hasattr(message, "__dict__")
    names = [field.name for field in dataclasses.fields(message)] or ["sender"]
    with pytest.raises((dataclasses.FrozenInstanceError, TypeError, AttributeError)):
        setattr(message, names[0], 1)


@each_example
def test_message_sender_is_the_clients_for_requests_only(message: m.Message) -> None:
    assert message.sender is (CLIENT if isinstance(message, m.Request) else CAMERA)


def test_wire_fields_of_an_acknowledgement_begin_with_its_code() -> None:
    assert m.wire_fields(m.TriggerAnswer) == (("code", m.Wire.WORD),)
    assert m.wire_fields(m.Image) == (("code", m.Wire.WORD), ("data", m.Wire.DATA))
    assert [name for name, _ in m.wire_fields(m.ClockAnswer)][:2] == ["code", "year"]
    assert m.wire_fields(m.MalformedMessage) == ()


def test_fields_that_a_dialect_may_leave_out_have_defaults() -> None:
    assert m.StatusReport(status=Status(0)).endian == 0
    assert m.ResultContainer(data=b"").application == m.UNNAMED_APPLICATION == -1
    assert m.ConnectAnswer(version=1).code == m.QueryAnswer(application=1).code == 0


@each_example
def test_message_answer_is_a_report_of_the_camera(message: m.Message) -> None:
    if isinstance(message, m.Request) and message.answer is not None:
        assert issubclass(message.answer, m.Report)
