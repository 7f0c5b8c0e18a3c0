"""Golden vectors from the documents, in both directions and through both roles."""

from __future__ import annotations

import re
import tomllib
from typing import Any, NamedTuple

import pytest

from smartcam.models import Status
from smartcam.protocols import Frame, FramedDialect, Machine, Role, State, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK, Framer
from tests import ROOT
from tests.machines import (
    B16,
    BID,
    BIG_ENDIAN_NUMBER,
    CODE,
    DIALECTS,
    NO_ID,
    THESIS,
    TRANSITIONS,
    camera,
    client,
    feed,
    receiver_of,
)
from tests.strategies import over

ROWS = tomllib.loads((ROOT / "tests" / "data" / "vectors.toml").read_text(encoding="utf-8"))
TABLES = {
    "bvs_handbook": HANDBOOK,
    "bvs_thesis": THESIS,
    "bvs_b16": B16,
    "bvs_b16_code": CODE,
    "bvs_b16_no_id": NO_ID,
    "bvs_b16_big_endian_number": BIG_ENDIAN_NUMBER,
    "bvs_bid": BID,
}
PUBLISHED = {
    "bvs_handbook": {"A-1"},
    "bvs_b16": {"B-1", "B-2", "B-3", "B-4"},
    "bvs_b16_no_id": {"B-5"},
    "bvs_b16_big_endian_number": {"B-6"},
    "bvs_bid": {f"I-{number}" for number in range(1, 12)},
}
"""The published vectors that the tables hold; the others hold none."""

HEADER_SIZES = {"handbook": 12, "thesis": 12, "b16": 4, "bid": 4}
ID_PLACES = {"handbook": 8, "thesis": 8, "b16": 0, "bid": 0}


class Vector(NamedTuple):
    """One frame of a document."""

    dialect: FramedDialect
    name: str
    sender: m.Sender
    data: bytes
    message: m.Message
    meaning: str
    grade: str


def read_vectors(name: str) -> list[Vector]:
    return [read_vector(TABLES[name], row) for row in ROWS[name]]


def read_vector(dialect: FramedDialect, row: dict[str, Any]) -> Vector:
    assert row.keys() == {
        "name", "sender", "hex", "message", "fields", "meaning", "source", "grade"
    }  # fmt: skip
    message_type: type[m.Message] = getattr(m, row["message"])
    fields: dict[str, Any] = {**row["fields"]}
    for name, wire in m.wire_fields(message_type):
        if name in fields and wire is m.Wire.DATA:
            fields[name] = bytes.fromhex(fields[name])
        elif name == "status":
            fields[name] = Status(fields[name])
    return Vector(
        dialect,
        row["name"],
        m.Sender(row["sender"]),
        bytes.fromhex(row["hex"]),
        message_type(**fields),
        row["meaning"],
        row["grade"],
    )


VECTORS = [vector for name in TABLES for vector in read_vectors(name)]

each_vector = over("vector", VECTORS, lambda one: f"{one.dialect.label}: {one.name}")
each_table = pytest.mark.parametrize("name", TABLES)


def test_vectors_have_a_table_for_each_dialect_and_quirk() -> None:
    assert {*ROWS} == {*TABLES}
    assert {*TABLES.values()} == {*DIALECTS}


@each_table
def test_vectors_of_a_dialect_hold_every_message_of_its_table(name: str) -> None:
    """Those of a quirk hold what differs by it."""
    dialect = TABLES[name]
    rows = {*dialect.table} - ({*B16.table} if dialect.quirks else set())
    vectors = read_vectors(name)
    switch = {m.SwitchAnswer} if dialect is CODE else set()  # the codes differ, not the layout
    assert {type(one.message) for one in vectors} == {row.type for row in rows} | switch
    assert len({one.name for one in vectors}) == len(vectors)


@each_table
def test_vectors_hold_what_is_published_and_say_what_is_not(name: str) -> None:
    vectors = read_vectors(name)
    assert {one.grade for one in vectors} <= {"published", "derived", "inferred"}
    numbers = {one.name: re.findall(r"\b[ABI]-\d+", one.meaning) for one in vectors}
    assert {one.name for one in vectors if one.grade == "published"} == {
        name for name, numbers in numbers.items() if numbers
    }
    assert {number for found in numbers.values() for number in found} == PUBLISHED.get(name, set())


@each_vector
def test_decode_vector_gives_its_message(vector: Vector) -> None:
    framer = Framer(vector.dialect.header)
    framer.feed(vector.data)
    frame = framer.next_frame()
    assert frame is not None
    assert framer.buffered == 0
    assert vector.dialect.decode(vector.sender, frame) == vector.message


@each_vector
def test_encode_vectors_message_gives_its_bytes(vector: Vector) -> None:
    assert vector.dialect.encode(vector.message) == vector.data
    frame, name = vector.dialect.to_frame(vector.message), vector.dialect.name
    assert frame == Frame(vector.data[ID_PLACES[name]], vector.data[HEADER_SIZES[name] :])
    assert vector.dialect.encode_frame(frame) == vector.data


@each_vector
def test_send_vectors_message_writes_its_bytes(vector: Vector) -> None:
    role = Role(vector.sender.value)
    machine = Machine(vector.dialect, role, Transport.TCP)
    states = (State.IDLE, State.CONNECTED, State.CONNECTING)
    machine.state = next(
        state for state in states if (state, role.sends, type(vector.message)) in TRANSITIONS
    )
    machine.send(vector.message)
    assert machine.data_to_send() == [vector.data]


@each_vector
@pytest.mark.parametrize("transport", Transport)
def test_receive_vector_whole_gives_its_message(vector: Vector, transport: Transport) -> None:
    machine = receiver_of(vector.message, vector.dialect, transport)
    assert feed(machine, vector.data) == [vector.message]
    assert machine.counters.unexpected_messages == 0
    assert machine.buffered == 0


@each_vector
def test_receive_vector_byte_by_byte_gives_its_message_with_the_last(vector: Vector) -> None:
    machine = receiver_of(vector.message, vector.dialect)
    *first, last = [bytes([byte]) for byte in vector.data]
    assert feed(machine, *first) == []
    assert machine.buffered == len(first)
    assert feed(machine, last) == [vector.message]


@each_vector
def test_receive_vector_cut_anywhere_gives_its_message(vector: Vector) -> None:
    for cut in range(len(vector.data) + 1):
        machine = receiver_of(vector.message, vector.dialect)
        assert feed(machine, vector.data[:cut], vector.data[cut:]) == [vector.message], cut


@each_vector
def test_receive_vector_with_the_next_ones_start_keeps_it(vector: Vector) -> None:
    machine = receiver_of(vector.message, vector.dialect)
    assert feed(machine, vector.data + vector.data[:3]) == [vector.message]
    assert machine.buffered == 3


@each_vector
def test_receive_vector_in_a_dialect_with_another_magic_number_is_refused(vector: Vector) -> None:
    for other in {HANDBOOK, THESIS} - {vector.dialect}:
        machine = (camera if vector.sender is m.Sender.CLIENT else client)(other)
        feed(machine, vector.data)
        broken = machine.error is not None
        assert broken or machine.counters.ignored_frames == 1
        assert broken is (machine.role is Role.CLIENT)


@pytest.mark.parametrize("dialect", [B16, BID], ids=lambda one: one.name)
@pytest.mark.parametrize("other", [HANDBOOK, THESIS], ids=lambda one: one.name)
def test_receive_connect_with_a_magic_number_without_one_waits_for_more(
    dialect: FramedDialect, other: FramedDialect
) -> None:
    machine = Machine(dialect, Role.CAMERA, Transport.TCP)
    assert feed(machine, other.encode(m.Connect())) == []
    assert (machine.buffered, machine.state) == (12, State.IDLE)
