"""Golden vectors from the documents, in both directions and through both roles."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from machines import feed, receiver_of

from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.protocols.base import Dialect, Role, Transport
from smartcam.protocols.bvs import BVS
from smartcam.protocols.framing import Frame, Framer
from smartcam.protocols.machine import TRANSITIONS, Machine, State

FOLDER = Path(__file__).parent.parent / "vectors"
DIALECTS = ("handbook", "thesis")


class Vector(NamedTuple):
    """One frame of a document."""

    dialect: Dialect
    name: str
    sender: m.Sender
    data: bytes
    message: m.Message
    grade: str


def read_vectors(dialect: str) -> list[Vector]:
    text = (FOLDER / f"bvs_{dialect}.toml").read_text(encoding="utf-8")
    return [read_vector(BVS.dialects[dialect], row) for row in tomllib.loads(text)["vector"]]


def read_vector(dialect: Dialect, row: dict[str, Any]) -> Vector:
    assert row.keys() == {
        "name", "sender", "hex", "message", "fields", "meaning", "source", "grade"
    }  # fmt: skip
    message_type: type[m.Message] = getattr(m, row["message"])
    fields: dict[str, Any] = row["fields"]
    for name, wire in m.wire_fields(message_type):
        if wire is m.Wire.DATA:
            fields[name] = bytes.fromhex(fields[name])
        elif name == "status":
            fields[name] = Status(fields[name])
    return Vector(
        dialect,
        row["name"],
        m.Sender(row["sender"]),
        bytes.fromhex(row["hex"]),
        message_type(**fields),
        row["grade"],
    )


VECTORS = [vector for name in DIALECTS for vector in read_vectors(name)]

each_vector = pytest.mark.parametrize(
    "vector", VECTORS, ids=[f"{one.dialect.name}: {one.name}" for one in VECTORS]
)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_vectors_of_a_dialect_hold_every_message_of_its_table(dialect: str) -> None:
    vectors = read_vectors(dialect)
    assert {type(one.message) for one in vectors} == {
        row.type for row in BVS.dialects[dialect].table
    }
    assert len({one.name for one in vectors}) == len(vectors)
    published = [one.name for one in vectors if one.grade == "published"]
    assert published == (["set clock"] if dialect == "handbook" else [])
    assert {one.grade for one in vectors} <= {"published", "derived"}


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
    frame = vector.dialect.to_frame(vector.message)
    assert frame == Frame(vector.data[8], vector.data[12:])
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
    assert feed(machine, vector.data + vector.data[:5]) == [vector.message]
    assert machine.buffered == 5


@each_vector
def test_receive_vector_of_the_other_dialect_is_refused(vector: Vector) -> None:
    other = next(one for one in BVS.dialects.values() if one is not vector.dialect)
    machine = receiver_of(vector.message, other)
    feed(machine, vector.data)
    broken = machine.error is not None
    assert broken or machine.counters.ignored_frames == 1
    assert broken is (machine.role is Role.CLIENT)
