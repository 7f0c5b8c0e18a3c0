"""The BVS protocol's facts, each as the documents give it."""

from __future__ import annotations

import pytest
from machines import camera, client

from smartcam.protocols import messages as m
from smartcam.protocols.base import Dialect, Protocol, Transport
from smartcam.protocols.bvs import BVS, DEFAULT_PORT, HANDBOOK, MESSAGES, THESIS, MessageId
from smartcam.registry import PROTOCOLS


def test_bvs_is_what_its_name_loads() -> None:
    assert isinstance(BVS, Protocol)
    assert PROTOCOLS.load("bvs") is BVS
    assert BVS.name == "bvs"


def test_bvs_port_models_and_transports() -> None:
    assert BVS.default_port == DEFAULT_PORT == 36701
    assert BVS.models == ("BVS002C",)
    assert BVS.schemes == {"bvs": Transport.TCP, "bvs+udp": Transport.UDP}


def test_bvs_dialects_by_name_with_the_handbooks_first() -> None:
    assert list(BVS.dialects.items()) == [("handbook", HANDBOOK), ("thesis", THESIS)]


def test_bvs_headers_differ_in_magic_and_in_what_the_length_counts() -> None:
    number = (1347638850).to_bytes(4, "little")
    assert THESIS.header.magic == number
    assert HANDBOOK.header.magic == number[::-1] == (0x42565350).to_bytes(4, "little")
    assert (HANDBOOK.header.length_includes, THESIS.header.length_includes) == (0, 4)
    assert HANDBOOK.header.size == THESIS.header.size == 12


def test_bvs_both_dialects_share_one_message_table() -> None:
    assert HANDBOOK.table is THESIS.table is MESSAGES
    assert (HANDBOOK.word, THESIS.word) == ("I", "I")


def test_bvs_message_ids_are_the_documents() -> None:
    assert [int(one) for one in MessageId] == [
        *(0x01, 0x02, 0x12, 0x20),
        *(0x30, 0x31, 0x32, 0x33, 0x34, 0x35),
        *(0x40, 0x41, 0x42, 0x43),
    ]
    assert {row.message_id for row in MESSAGES} == set(MessageId)


def test_bvs_table_has_each_message_once_with_title_and_graded_source() -> None:
    assert len({row.type for row in MESSAGES}) == len(MESSAGES)
    assert len({(row.type.sender, row.message_id) for row in MESSAGES}) == len(MESSAGES)
    for row in MESSAGES:
        assert row.title
        assert row.source.endswith(("published", "derived", "inferred"))


@pytest.mark.parametrize("dialect", [HANDBOOK, THESIS], ids=lambda one: one.name)
def test_bvs_answers_have_the_ids_of_their_requests(dialect: Dialect) -> None:
    answered = {
        row.type: row.type.answer
        for row in dialect.table
        if issubclass(row.type, m.Request) and row.type.answer is not None
    }
    assert answered == {
        m.Connect: m.ConnectAnswer,
        m.Query: m.QueryAnswer,
        m.SwitchApplication: m.SwitchAnswer,
        m.GetClock: m.ClockAnswer,
    }
    for request, answer in answered.items():
        assert dialect.message_id(request) == dialect.message_id(answer)


@pytest.mark.parametrize("dialect", [HANDBOOK, THESIS], ids=lambda one: one.name)
def test_bvs_two_machines_understand_each_other(dialect: Dialect) -> None:
    one, other = client(dialect), camera(dialect)
    one.send(m.SwitchApplication(application=5))
    other.receive_data(b"".join(one.data_to_send()))
    assert other.events() == [m.SwitchApplication(application=5)]
    other.send(m.SwitchAnswer(code=0, application=5))
    one.receive_data(b"".join(other.data_to_send()))
    assert one.events() == [m.SwitchAnswer(code=0, application=5)]
