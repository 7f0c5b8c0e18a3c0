"""The BVS protocol's facts, each as the documents give it."""

from __future__ import annotations

from typing import cast

import pytest

from smartcam.protocols import BVS, FramedDialect, HeaderLayout, Protocol, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._inside import DEFAULT_PORT, HANDBOOK, MessageId
from smartcam.registry import PROTOCOLS
from tests.machines import (
    B16,
    BID,
    BIG_ENDIAN_NUMBER,
    CODE,
    DIALECTS,
    MESSAGES,
    NO_ID,
    THESIS,
    camera,
    client,
    label,
)

each_dialect = pytest.mark.parametrize("dialect", DIALECTS, ids=label)


def test_bvs_is_what_its_name_loads() -> None:
    assert isinstance(BVS, Protocol)
    assert PROTOCOLS.load("bvs") is BVS
    assert BVS.name == "bvs"


def test_bvs_port_models_and_transports() -> None:
    assert BVS.default_port == DEFAULT_PORT == 36701
    assert BVS.models == ("BVS002C",)
    assert BVS.schemes == {"bvs": Transport.TCP, "bvs+udp": Transport.UDP}


def test_bvs_dialects_by_name_with_the_handbooks_first() -> None:
    assert list(BVS.dialects.items()) == [
        ("handbook", HANDBOOK),
        ("thesis", THESIS),
        ("b16", B16),
        ("bid", BID),
    ]


def test_bvs_headers_differ_in_magic_and_in_what_the_length_counts() -> None:
    number = (1347638850).to_bytes(4, "little")
    assert THESIS.header.magic == number
    assert HANDBOOK.header.magic == number[::-1] == (0x42565350).to_bytes(4, "little")
    assert (HANDBOOK.header.length_includes, THESIS.header.length_includes) == (0, 4)
    assert HANDBOOK.header.size == THESIS.header.size == 12


def test_bvs_dialects_with_a_magic_number_share_one_message_table() -> None:
    assert HANDBOOK.table is THESIS.table is MESSAGES
    assert (HANDBOOK.word, THESIS.word) == ("I", "I")


@pytest.mark.parametrize("dialect", [B16, BID, CODE], ids=label)
def test_bvs_narrow_dialects_have_one_header_the_id_first(dialect: FramedDialect) -> None:
    assert dialect.header == HeaderLayout(magic=b"", code="H", order="id, length")
    assert (dialect.header.size, dialect.header.max_payload, dialect.word) == (4, 0xFFFF, "H")


def test_bvs_message_ids_are_the_documents() -> None:
    assert [int(one) for one in MessageId] == [
        *(0x01, 0x02, 0x12, 0x16, 0x20),
        *(0x30, 0x31, 0x32, 0x33, 0x34, 0x35),
        *(0x40, 0x41, 0x42, 0x43),
    ]


@pytest.mark.parametrize(
    ("dialect", "without"),
    [(HANDBOOK, {0x16}), (THESIS, {0x16}), (B16, {0x16}), (BID, {0x35, 0x41, 0x42, 0x43})],
    ids=label,
)
def test_bvs_dialects_have_the_documents_ids(dialect: FramedDialect, without: set[int]) -> None:
    assert {row.message_id for row in dialect.table} == {*MessageId} - without


@each_dialect
def test_bvs_table_has_each_message_once_with_title_and_graded_source(
    dialect: FramedDialect,
) -> None:
    table = dialect.table
    assert len({row.type for row in table}) == len(table)
    assert len({(row.type.sender, row.message_id) for row in table}) == len(table)
    for row in table:
        assert row.title
        assert row.source.endswith(("published", "derived", "inferred"))
    assert dialect.about
    assert dialect.source.endswith(("published", "derived", "inferred"))


@each_dialect
def test_bvs_answers_have_the_ids_of_their_requests(dialect: FramedDialect) -> None:
    answered: dict[type[m.Message], type[m.Message]] = {
        row.type: row.type.answer
        for row in dialect.table
        if issubclass(row.type, m.Request) and row.type.answer and dialect.has(row.type.answer)
    }
    everywhere: dict[type[m.Message], type[m.Message]] = {
        m.Connect: m.ConnectAnswer,
        m.Query: m.QueryAnswer,
        m.SwitchApplication: m.SwitchAnswer,
        m.GetClock: m.ClockAnswer,
    }
    in_bid: dict[type[m.Message], type[m.Message]] = {
        m.GetStatus: m.StatusReport,
        m.ResetErrors: m.ResetErrorsAnswer,
        m.SetClock: m.SetClockAnswer,
        m.SetInput: m.SetInputAnswer,
        m.Trigger: m.TriggerAnswer,
    }
    assert answered == everywhere | (in_bid if dialect is BID else {})
    for request, answer in answered.items():
        assert dialect.message_id(request) == dialect.message_id(answer)


def test_bvs_every_request_of_bid_is_answered() -> None:
    silent = [
        row.type
        for row in BID.table
        if issubclass(row.type, m.Request) and not BID.answers(row.type)
    ]
    assert silent == [m.Disconnect]  # its answer is one that nobody waits for
    assert BID.has(m.DisconnectAnswer)


@pytest.mark.parametrize(
    ("dialect", "bodies"),
    [
        (HANDBOOK, {m.ConnectAnswer: 4, m.StatusReport: 8, m.QueryAnswer: 4, m.ClockAnswer: 24}),
        (B16, {m.ConnectAnswer: 2, m.StatusReport: 2, m.QueryAnswer: 2, m.ClockAnswer: 12}),
        (CODE, {m.ConnectAnswer: 4, m.StatusReport: 2, m.QueryAnswer: 4, m.ClockAnswer: 14}),
        (BID, {m.ConnectAnswer: 4, m.StatusReport: 2, m.QueryAnswer: 4, m.ClockAnswer: 14}),
        (NO_ID, {m.ResultContainer: 0, m.SetSequenceNumber: 4, m.SwitchAnswer: 4}),
        (BIG_ENDIAN_NUMBER, {m.ResultContainer: 2, m.SetSequenceNumber: 4, m.SwitchAnswer: 4}),
    ],
    ids=label,
)
def test_bvs_bodies_are_as_long_as_documented(
    dialect: FramedDialect, bodies: dict[type[m.Message], int]
) -> None:
    assert {one: dialect.encoder(one).size for one in bodies} == bodies


def test_bvs_detection_has_every_dialect_once_and_those_alike_together() -> None:
    for transport in Transport:
        groups = BVS.detection[transport]
        assert [one for group in groups for one in group if not one.quirks] == [
            one for group in groups for one in group if one in BVS.dialects.values()
        ]
        assert {one.name for group in groups for one in group} == {*BVS.dialects}
        for group in groups:
            assert len({cast("FramedDialect", one).encode(m.Connect()) for one in group}) == 1


@each_dialect
def test_bvs_two_machines_understand_each_other(dialect: FramedDialect) -> None:
    one, other = client(dialect), camera(dialect)
    one.send(m.SwitchApplication(application=5))
    other.receive_data(b"".join(one.data_to_send()))
    assert other.events() == [m.SwitchApplication(application=5)]
    other.send(m.SwitchAnswer(code=0, application=5))
    one.receive_data(b"".join(other.data_to_send()))
    assert one.events() == [m.SwitchAnswer(code=0, application=5)]
