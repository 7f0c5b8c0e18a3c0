"""Properties of any message, any bytes and any way of cutting them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from smartcam.exceptions import FrameError, LocalProtocolError, MessageError
from smartcam.models import Status
from smartcam.protocols import (
    Frame,
    FramedDialect,
    LinkEnded,
    LinkFailed,
    Machine,
    Role,
    State,
    Transport,
)
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK, Event, Framer, Policy
from tests.machines import DIALECTS, camera, client, feed, label, machine, one_by_one
from tests.strategies import bodies, chunkings, garbage, messages, split, streams

MAX_LENGTH = 64
STATUS = bytes.fromhex("50535642 08000000 12000000 80020000 00000000")

each_dialect = pytest.mark.parametrize("dialect", DIALECTS, ids=label)
each_with_magic = pytest.mark.parametrize(
    "dialect", [one for one in DIALECTS if one.header.magic], ids=lambda one: one.name
)
each_role = pytest.mark.parametrize("role", Role)


class Outcome(NamedTuple):
    """Events without what may depend on how the bytes were cut: an error's text."""

    events: Sequence[object]
    state: State
    buffered: int


def session(role: Role, dialect: FramedDialect, **options: Any) -> Machine:
    return (client if role is Role.CLIENT else camera)(dialect, max_length=MAX_LENGTH, **options)


def outcome(made: Machine, chunks: list[bytes]) -> Outcome:
    events = [
        type(event.error) if isinstance(event, LinkFailed) else event
        for event in feed(made, *chunks)
    ]
    return Outcome(events, made.state, made.buffered)


# ---------------------------------------------------------------------- round trips


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize(
    ("dialect", "message_type"),
    [
        pytest.param(dialect, row.type, id=f"{dialect.label}-{row.type.__name__}")
        for dialect in DIALECTS
        for row in dialect.table
        if not dialect.quirks or any(row in one.rows for one in dialect.wire_quirks.values())
    ],
)
@given(data=st.data())
def test_decode_of_encode_is_the_message(
    dialect: FramedDialect, message_type: type[m.Message], data: st.DataObject
) -> None:
    message = data.draw(bodies(dialect, message_type))
    framer = Framer(dialect.header)
    framer.feed(dialect.encode(message))
    frame = framer.next_frame()
    assert frame == dialect.to_frame(message)
    assert frame is not None
    assert dialect.decode(message.sender, frame) == message
    assert framer.buffered == 0


@each_dialect
@given(message_id=st.integers(0, 0xFFFF), payload=st.binary(max_size=64))
def test_frame_of_its_bytes_is_the_frame(
    dialect: FramedDialect, message_id: int, payload: bytes
) -> None:
    framer = Framer(dialect.header)
    framer.feed(dialect.encode_frame(Frame(message_id, payload)))
    assert framer.next_frame() == Frame(message_id, payload)
    assert framer.next_frame() is None


@each_dialect
@given(value=st.integers())
def test_any_integer_is_encoded_and_decoded_or_refused(dialect: FramedDialect, value: int) -> None:
    message = m.SwitchApplication(application=value)
    fits = 0 <= value < 1 << {"I": 32, "H": 16}[dialect.word]
    if fits:
        assert dialect.decode(m.Sender.CLIENT, dialect.to_frame(message)) == message
    else:
        with pytest.raises(LocalProtocolError):
            dialect.to_frame(message)


# ---------------------------------------------------------------------- chunking


@pytest.mark.sampled(every=3)
@each_dialect
@each_role
@given(data=st.data())
def test_any_cutting_of_messages_gives_the_same_events(
    role: Role, dialect: FramedDialect, data: st.DataObject
) -> None:
    sequence = data.draw(st.lists(messages(dialect, role.receives, max_data=40), max_size=6))
    stream = b"".join(dialect.encode(one) for one in sequence)
    cuts = data.draw(chunkings(len(stream)))
    whole = outcome(session(role, dialect), [stream])
    assert outcome(session(role, dialect), split(stream, cuts)) == whole
    assert outcome(session(role, dialect), [bytes([one]) for one in stream]) == whole


@each_with_magic  # without one, what is dropped is what was there: it depends on the cuts
@each_role
@given(data=st.data())
def test_any_cutting_of_any_bytes_gives_the_same_events(
    role: Role, dialect: FramedDialect, data: st.DataObject
) -> None:
    drops = Policy(fatal=(), exact_length=role is Role.CAMERA)
    stream = data.draw(streams(dialect, role.receives))
    chunks = split(stream, data.draw(chunkings(len(stream))))
    whole = outcome(session(role, dialect, policy=drops), [stream])
    assert outcome(session(role, dialect, policy=drops), chunks) == whole


@pytest.mark.sampled(every=3)
@each_dialect
@given(data=st.data())
def test_client_on_tcp_fails_alike_however_the_bytes_are_cut(
    dialect: FramedDialect, data: st.DataObject
) -> None:
    stream = data.draw(streams(dialect, m.Sender.CAMERA))
    whole = outcome(session(Role.CLIENT, dialect), [stream])
    chunks = split(stream, data.draw(chunkings(len(stream))))
    assert outcome(session(Role.CLIENT, dialect), chunks) == whole


# ---------------------------------------------------------------------- any bytes


@pytest.mark.sampled(every=3)
@each_dialect
@each_role
@given(state=st.sampled_from(State), transport=st.sampled_from(Transport), data=st.data())
def test_any_bytes_in_any_state_give_events_or_a_failed_link(
    role: Role, transport: Transport, state: State, dialect: FramedDialect, data: st.DataObject
) -> None:
    made = machine(role, state, dialect=dialect, transport=transport, max_length=MAX_LENGTH)
    stream = data.draw(streams(dialect, role.receives))
    events: list[Event] = []
    for chunk in split(stream, data.draw(chunkings(len(stream)))):
        made.receive_data(chunk)
        assert 0 <= made.buffered <= dialect.header.size + MAX_LENGTH
        assert transport is Transport.TCP or made.buffered == 0
        events += one_by_one(made.events())
    check_order(made, events)
    made.receive_eof()
    check_order(made, events + made.events())
    assert made.state in {State.CLOSED, State.FAILED}


def check_order(made: Machine, events: list[Event]) -> None:
    """Nothing comes after an end, and a failure is the client's on TCP alone."""
    ends = [one for one in events if isinstance(one, (LinkFailed, LinkEnded))]
    assert ends == events[len(events) - len(ends) :]
    assert len(ends) <= 1
    failures = [one.error for one in ends if isinstance(one, LinkFailed)]
    assert failures == ([made.error] if made.error is not None else [])
    if failures:
        assert isinstance(made.error, (FrameError, MessageError))
        assert (made.role, made.transport) == (Role.CLIENT, Transport.TCP)
        assert made.state is State.FAILED


@each_role
@given(data=st.data())
def test_after_the_link_failed_nothing_comes(role: Role, data: st.DataObject) -> None:
    made = session(
        role, HANDBOOK, policy=Policy(fatal=(FrameError, MessageError), exact_length=True)
    )
    (event,) = feed(made, b"broken")
    assert isinstance(event, LinkFailed)
    counted = made.counters.bytes_received
    made.receive_data(data.draw(streams(HANDBOOK, role.receives)))
    made.receive_eof()
    assert (made.events(), made.state, made.buffered) == ([], State.FAILED, 0)
    assert made.counters.bytes_received == counted


# ---------------------------------------------------------------------- after garbage


@each_with_magic
@given(data=st.data())
def test_camera_understands_a_good_frame_after_any_garbage(
    dialect: FramedDialect, data: st.DataObject
) -> None:
    made = camera(dialect, max_length=MAX_LENGTH)
    noise = data.draw(garbage(dialect))
    message = data.draw(messages(dialect, m.Sender.CLIENT, max_data=40))
    stream = noise + dialect.encode(message)
    assert feed(made, *split(stream, data.draw(chunkings(len(stream))))) == [message]
    assert made.buffered == 0


@each_with_magic
@given(data=st.data(), length=st.integers(MAX_LENGTH + 5, 0xFFFFFFFF))
def test_camera_understands_a_good_frame_after_a_length_bomb(
    dialect: FramedDialect, data: st.DataObject, length: int
) -> None:
    made = camera(dialect, max_length=MAX_LENGTH)
    bomb = dialect.header.magic + length.to_bytes(4, "little") + b"\x31\0\0\0"
    stream = bomb + dialect.encode(m.Trigger())
    assert feed(made, *split(stream, data.draw(chunkings(len(stream))))) == [m.Trigger()]
    assert made.counters.ignored_frames >= 1


@given(datagram=streams(HANDBOOK, m.Sender.CAMERA))
@example(datagram=STATUS)
@example(datagram=STATUS + STATUS)
@example(datagram=b"")
def test_udp_datagram_gives_one_message_or_is_counted(datagram: bytes) -> None:
    made = client(transport=Transport.UDP, max_length=MAX_LENGTH)
    events = feed(made, datagram)
    counters = made.counters
    assert len(events) + counters.ignored_frames + counters.unexpected_messages == 1
    assert feed(made, STATUS) == [m.StatusReport(status=Status(0x280))]


# ---------------------------------------------------------------------- resync as a plain search


@each_with_magic
@given(data=st.data())
def test_resync_is_a_search_for_the_next_magic(dialect: FramedDialect, data: st.DataObject) -> None:
    magic = dialect.header.magic
    piece = st.one_of(st.binary(max_size=5), st.sampled_from([magic, magic[:3], magic[:1]]))
    noise = b"".join(data.draw(st.lists(piece, max_size=8)))
    framer = Framer(dialect.header)
    framer.feed(noise)
    skipped = framer.resync()
    places = range(1, len(noise) + 1)
    expected = next((at for at in places if magic.startswith(noise[at : at + 4])), 0)
    assert (skipped, framer.unfinished_bytes) == (expected, noise[expected:])
