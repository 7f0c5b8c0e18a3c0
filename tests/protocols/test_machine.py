"""The state machine: every state with every input, policies, counters, answers."""

from __future__ import annotations

import dataclasses
import itertools
import random
import struct
from typing import Any

import pytest

from smartcam.exceptions import (
    FrameError,
    LocalProtocolError,
    MessageError,
    RemoteProtocolError,
    UnsupportedError,
)
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
from smartcam.protocols._inside import (
    DEFAULT_MAX_LENGTH,
    HANDBOOK,
    Counters,
    Event,
    Policy,
    ResultBurst,
)
from tests.machines import (
    B16,
    BID,
    BIG_ENDIAN_NUMBER,
    CODE,
    DIALECTS,
    EVERYTHING,
    EXAMPLES,
    NO_ID,
    THESIS,
    TRANSITIONS,
    camera,
    carried,
    client,
    examples,
    feed,
    label,
    machine,
    request_for,
)
from tests.strategies import over

MAX_KNOWN_MESSAGES = 64


TCP, UDP = Transport.TCP, Transport.UDP
CLIENT, CAMERA = m.Sender.CLIENT, m.Sender.CAMERA
LIVE = [state for state in State if state not in {State.CLOSED, State.FAILED}]

MAGIC = bytes.fromhex("50535642")
STATUS = bytes.fromhex("50535642 08000000 12000000 80020000 00000000")
STATUS_MESSAGE = m.StatusReport(status=Status(0x280))
QUERY = bytes.fromhex("50535642 00000000 30000000")
QUERY_ANSWER = bytes.fromhex("50535642 04000000 30000000 15000000")
TRIGGER = bytes.fromhex("50535642 00000000 40000000")

MALFORMED = m.MalformedMessage(message_id=0x40, payload=b"!")
CANDIDATES = (B16, BID, CODE)
BID_OR_CODE = (BID, CODE)

each_dialect = pytest.mark.parametrize("dialect", DIALECTS, ids=label)
each_state = over("state", State)
each_transport = pytest.mark.parametrize("transport", Transport)


def header(length: int, message_id: int = 0x20) -> bytes:
    return MAGIC + struct.pack("<II", length, message_id)


def failure(events: list[Event]) -> RemoteProtocolError:
    """Return the error of the only event."""
    (event,) = events
    assert isinstance(event, LinkFailed)
    return event.error


# ---------------------------------------------------------------------- the table


def test_transitions_camera_says_nothing_without_a_session() -> None:
    idle = [key[2] for key in TRANSITIONS if key[:2] == (State.IDLE, CAMERA)]
    assert idle == [m.DisconnectAnswer]  # to the Disconnect that goes before a Connect
    connecting = {key[2] for key in TRANSITIONS if key[:2] == (State.CONNECTING, CAMERA)}
    assert connecting == {m.ConnectAnswer, m.DisconnectAnswer}


def test_transitions_answer_to_disconnect_changes_nothing() -> None:
    for state in LIVE:
        assert TRANSITIONS[state, CAMERA, m.DisconnectAnswer] is state


def test_transitions_ended_links_take_nothing() -> None:
    assert {state for state, _, _ in TRANSITIONS} == set(LIVE)
    assert set(TRANSITIONS.values()) == set(LIVE)


def test_transitions_disconnect_is_legal_in_every_live_state_and_connect_too() -> None:
    for state in LIVE:
        following = State.CONNECTED if state is State.CONNECTED else State.CONNECTING
        assert TRANSITIONS[state, CLIENT, m.Connect] is following
        ends = State.IDLE if state is State.IDLE else State.DISCONNECTED
        assert TRANSITIONS[state, CLIENT, m.Disconnect] is ends


def test_transitions_senders_are_those_of_the_messages() -> None:
    for _, sender, message in TRANSITIONS:
        if message not in {m.UnknownMessage, m.MalformedMessage}:
            assert message.sender is sender


def test_transitions_every_message_has_a_place() -> None:
    assert {message for _, _, message in TRANSITIONS} == {
        *(type(one) for one in EXAMPLES),
        m.MalformedMessage,
    }


# ---------------------------------------------------------------------- state x input


@each_state
@over("dialect, message", [*EVERYTHING, *((one, MALFORMED) for one in DIALECTS)], label)
@pytest.mark.parametrize("role", Role)
def test_send_in_every_state_follows_the_table_or_changes_nothing(
    role: Role, dialect: FramedDialect, message: m.Message, state: State
) -> None:
    made = machine(role, state, dialect=dialect)
    following = TRANSITIONS.get((state, role.sends, type(message)))
    if following is not None:
        made.send(message)
        assert made.state is following
        assert made.data_to_send() == [dialect.encode(message)]
        assert made.counters.frames_sent == 1
        return
    with pytest.raises(LocalProtocolError) as caught:
        made.send(message)
    assert str(caught.value) == (
        f"{type(message).__name__} cannot be sent by the {role.value} in state {state.value}"
    )
    assert (made.state, made.data_to_send(), made.counters) == (state, [], Counters())


@over(
    "dialect, message",
    [(dialect, one) for dialect in DIALECTS for one in EXAMPLES[:-1] if not dialect.has(type(one))],
    label,
)
def test_send_what_the_dialect_lacks_is_unsupported_and_changes_nothing(
    dialect: FramedDialect, message: m.Message
) -> None:
    made = (client if message.sender is CLIENT else camera)(dialect)
    before = dataclasses.replace(made.counters)
    with pytest.raises(UnsupportedError, match=f"^dialect {dialect.name} has no"):
        made.send(message)
    assert (made.state, made.data_to_send(), made.counters) == (State.CONNECTED, [], before)


@each_state
@each_transport
@over(
    "role, dialect, message",
    [
        (role, dialect, one)
        for role in Role
        for dialect, one in EVERYTHING
        if getattr(one, "sender", role.receives) is role.receives
    ],
    label,
)
def test_receive_in_every_state_follows_the_table_or_the_policy(
    role: Role, transport: Transport, dialect: FramedDialect, message: m.Message, state: State
) -> None:
    made = machine(role, state, dialect=dialect, transport=transport)
    following = TRANSITIONS.get((state, role.receives, type(message)))
    events = feed(made, dialect.encode(message))
    if state in {State.CLOSED, State.FAILED}:
        assert (events, made.state, made.counters) == ([], state, Counters())
    elif following is not None:
        assert (made.state, made.counters.ignored_frames) == (following, 0)
        unasked = made.counters.unexpected_messages
        assert events == ([] if unasked else [message])
        assert not unasked or role is Role.CLIENT
    elif role is Role.CLIENT and transport is TCP:
        assert f"came in state {state.value}, where it is not expected" in str(failure(events))
        assert made.state is State.FAILED
    else:
        assert (events, made.state, made.counters.ignored_frames) == ([], state, 1)


@pytest.mark.parametrize(
    ("dialect", "needs"), [(HANDBOOK, 4), (THESIS, 4), (B16, 2), (CODE, 4), (BID, 4)], ids=str
)
def test_client_that_hears_its_own_connect_fails(dialect: FramedDialect, needs: int) -> None:
    made = machine(Role.CLIENT, dialect=dialect)
    made.send(m.Connect())
    error = failure(feed(made, *made.data_to_send()))
    assert str(error) == f"ConnectAnswer (0x01) came with 0 bytes, it needs {needs}: "


@each_state
@pytest.mark.parametrize("role", Role)
def test_receive_eof_in_every_state_closes_once(role: Role, state: State) -> None:
    made = machine(role, state)
    made.receive_data(MAGIC[:3])
    made.receive_eof()
    made.receive_eof()
    if state in {State.CLOSED, State.FAILED}:
        assert (made.events(), made.state) == ([], state)
        return
    assert made.events() == [LinkEnded(pending=3)]
    assert (made.state, made.buffered) == (State.CLOSED, 0)
    assert feed(made, STATUS) == []


def test_receive_eof_between_frames_leaves_nothing_pending() -> None:
    made = client()
    made.receive_data(STATUS)
    made.receive_eof()
    assert made.events() == [STATUS_MESSAGE, LinkEnded(pending=0)]


# ---------------------------------------------------------------------- the client's policy


@pytest.mark.parametrize(
    ("data", "kind", "text", "offset"),
    [
        (b"HTTP", FrameError, "wrong magic number: 48 54 54 50 came", 0),
        (header(0xFFFFFFFF), FrameError, "announces 4294967295 bytes", 4),
        (header(DEFAULT_MAX_LENGTH + 1), FrameError, "announces 1048577 bytes", 4),
        (header(7, 0x12) + bytes(7), MessageError, "StatusReport (0x12) came with 7 bytes", 12),
    ],
)
def test_client_on_tcp_fails_the_link_and_keeps_the_error(
    data: bytes, kind: type[RemoteProtocolError], text: str, offset: int
) -> None:
    made = client()
    events = feed(made, STATUS + data + STATUS)
    assert events[0] == STATUS_MESSAGE
    error = failure(events[1:])
    assert type(error) is kind
    assert text in str(error)
    assert error.offset == offset
    assert (made.state, made.error, made.buffered) == (State.FAILED, error, 0)
    assert feed(made, STATUS) == []
    assert made.counters.ignored_frames == 0


def test_client_on_tcp_status_before_the_connect_answer_fails() -> None:
    made = machine(Role.CLIENT)
    made.send(m.Connect())
    error = failure(feed(made, STATUS))
    assert str(error) == ("StatusReport (0x12) came in state connecting, where it is not expected")
    assert error.data == STATUS[12:]


@pytest.mark.parametrize(
    "data",
    [b"", b"H", b"GET / HTTP/1.1", header(0xFFFFFFFF), header(7, 0x12) + bytes(7), STATUS[:-1]],
)
def test_client_on_udp_drops_a_broken_datagram_and_counts_it(data: bytes) -> None:
    made = client(transport=UDP)
    assert feed(made, data) == []
    assert made.counters.ignored_frames == 1
    assert (made.state, made.buffered) == (State.CONNECTED, 0)
    assert feed(made, STATUS) == [STATUS_MESSAGE]


@pytest.mark.parametrize("role", Role)
def test_udp_datagram_of_two_frames_is_dropped_whole(role: Role) -> None:
    made = client(transport=UDP) if role is Role.CLIENT else camera(transport=UDP)
    one = STATUS if role is Role.CLIENT else QUERY
    assert feed(made, one + one) == []
    assert made.counters.ignored_frames == 1
    assert len(feed(made, one)) == 1


def test_udp_client_that_shall_fail_tells_what_the_datagram_was() -> None:
    strict = Policy(fatal=(FrameError, MessageError), exact_length=True)
    made = client(transport=UDP, policy=strict)
    error = failure(feed(made, STATUS + b"\xaa\xbb"))
    assert str(error) == "a datagram is not one whole frame: aa bb"
    assert (made.state, made.buffered) == (State.FAILED, 0)


@each_transport
def test_client_longer_body_is_accepted_and_counted(transport: Transport) -> None:
    made = client(transport=transport)
    assert feed(made, header(10, 0x12) + STATUS[12:] + b"\xaa\xbb") == [STATUS_MESSAGE]
    assert made.counters.long_bodies == 1
    assert made.counters.ignored_frames == 0


def test_client_longer_body_at_the_wrong_time_is_not_counted_as_one() -> None:
    made = machine(Role.CLIENT, transport=UDP)
    assert feed(made, header(10, 0x12) + STATUS[12:] + b"\xaa\xbb") == []
    assert (made.counters.long_bodies, made.counters.ignored_frames) == (0, 1)


def test_client_second_connect_answer_is_counted_only() -> None:
    made = client()
    assert feed(made, HANDBOOK.encode(m.ConnectAnswer(version=1)) + STATUS) == [STATUS_MESSAGE]
    assert made.counters.unexpected_messages == 1


# ---------------------------------------------------------------------- the camera's policy


def test_camera_requests_after_a_connect_in_the_same_bytes_are_heard_in_order() -> None:
    made = Machine(HANDBOOK, Role.CAMERA, Transport.TCP)
    requests = [m.Connect(), m.Query(), m.Connect(), m.Trigger()]
    assert feed(made, b"".join(HANDBOOK.encode(one) for one in requests)) == requests
    made.send(m.ConnectAnswer(version=1))
    made.send(m.QueryAnswer(application=7))
    made.send(m.ConnectAnswer(version=1))
    assert [data[8] for data in made.data_to_send()] == [0x01, 0x30, 0x01]


@pytest.mark.parametrize(
    ("noise", "ignored"),
    [
        (b"noise", 1),
        (b"noise" + MAGIC[:2], 1),
        (header(0xFFFFFFFF), 1),
        (header(DEFAULT_MAX_LENGTH + 1), 1),
        (header(3, 0x31) + b"\x05\0\0", 1),
        (header(5, 0x31) + b"\x05\0\0\0\0", 1),
        (header(4, 0x01) + b"\x01\0\0\0", 1),
        (header(0, 0x12), 0),
    ],
)
def test_camera_on_tcp_skips_what_is_broken_and_takes_the_next_frame(
    noise: bytes, ignored: int
) -> None:
    made = camera()
    events = feed(made, TRIGGER + noise + QUERY)
    assert [one for one in events if not isinstance(one, m.UnknownMessage)] == [
        m.Trigger(),
        m.Query(),
    ]
    assert made.counters.ignored_frames == ignored
    assert made.state is State.CONNECTED


def test_camera_on_tcp_broken_bytes_in_pieces_find_the_next_magic() -> None:
    made = camera()
    data = b"noise" + header(0xFFFFFFFF) + MAGIC[:3] + QUERY
    events = feed(made, *[bytes([byte]) for byte in data])
    assert events == [m.Query()]
    assert made.buffered == 0


def test_camera_on_udp_ignores_a_longer_body() -> None:
    made = camera(transport=UDP)
    assert feed(made, header(5, 0x31) + bytes(5)) == []
    assert feed(made, header(4, 0x31) + b"\x05\0\0\0") == [m.SwitchApplication(application=5)]
    assert made.counters.ignored_frames == 1


def test_camera_before_connect_ignores_requests_and_takes_connect() -> None:
    made = machine(Role.CAMERA)
    connect = HANDBOOK.encode(m.Connect())
    assert feed(made, QUERY + TRIGGER + header(1, 0x77) + b"x" + connect) == [m.Connect()]
    assert made.counters.ignored_frames == 3


def test_camera_with_a_failing_policy_ends_the_link() -> None:
    made = camera(policy=Policy(fatal=(FrameError, MessageError), exact_length=True))
    error = failure(feed(made, header(1, 0x40) + b"x"))
    assert str(error) == "message 0x40 is 1 bytes too long"
    assert made.state is State.FAILED
    with pytest.raises(LocalProtocolError, match="in state failed"):
        made.send(STATUS_MESSAGE)


def test_camera_takes_a_second_connect_and_answers_it() -> None:
    made = camera()
    query, connect = HANDBOOK.encode(m.Query()), HANDBOOK.encode(m.Connect())
    assert feed(made, query + connect) == [m.Query(), m.Connect()]
    answers = [m.QueryAnswer(application=7), m.ConnectAnswer(version=1), STATUS_MESSAGE]
    for answer in answers:  # what was asked in front of it in the same bytes is answered too
        made.send(answer)
    assert made.data_to_send() == [HANDBOOK.encode(answer) for answer in answers]


# ---------------------------------------------------------------------- limits


@pytest.mark.parametrize("length", [0xFFFFFFFF, 101])
def test_length_bomb_is_refused_before_any_payload_is_kept(length: int) -> None:
    made = client(max_length=100)
    assert feed(made, header(length)[:11]) == []
    assert made.buffered == 11
    assert f"announces {length} bytes" in str(failure(feed(made, header(length)[11:])))
    made.receive_data(bytes(1 << 16))
    assert made.buffered == 0


@each_transport
@pytest.mark.parametrize("dialect", [B16, BID], ids=label)
def test_payload_as_long_as_sixteen_bits_can_say_is_sent_and_taken_one_more_is_refused(
    dialect: FramedDialect, transport: Transport
) -> None:
    one, other = client(dialect, transport), camera(dialect, transport)
    whole = m.SetInput(data=bytes(range(255)) * 257)
    assert len(whole.data) == 0xFFFF
    sent = dataclasses.replace(one.counters)
    with pytest.raises(LocalProtocolError) as caught:
        one.send(m.SetInput(data=bytes(0x10000)))
    assert str(caught.value).startswith(
        f"message 0x34 with 65536 bytes of payload does not fit the {dialect.name} header: "
    )
    assert (one.data_to_send(), one.counters) == ([], sent)
    one.send(whole)
    (data,) = one.data_to_send()
    assert feed(other, data) == [whole]


def test_payload_of_exactly_the_limit_is_taken_and_never_more_is_kept() -> None:
    made = client(max_length=100)
    data = header(100) + b"\x07\0\0\0" + bytes(96)
    assert feed(made, *[data[i : i + 1] for i in range(111)]) == []
    assert made.buffered == 111
    assert feed(made, data[111:]) == [m.ResultContainer(application=7, data=bytes(96))]


def test_wrong_magic_fails_on_the_first_byte() -> None:
    made = client()
    error = failure(feed(made, b"\x42"))
    assert str(error) == "wrong magic number: 42 came, 50 53 56 42 was expected"


# ---------------------------------------------------------------------- requests and answers


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        (m.Query(), m.QueryAnswer(application=21)),
        (m.SwitchApplication(application=5), m.SwitchAnswer(code=1, application=1)),
        (m.GetClock(), m.ClockAnswer(year=2016, month=6, day=25, hour=10, minute=11, second=12)),
    ],
    ids=lambda one: type(one).__name__,
)
def test_client_one_open_request_per_id(request_: m.Request, answer: m.Message) -> None:
    made = client()
    made.send(request_)
    sent = dataclasses.replace(made.counters)
    with pytest.raises(LocalProtocolError) as caught:
        made.send(request_)
    message_id = HANDBOOK.message_id(request_)
    assert str(caught.value) == (
        f"an answer to message {message_id:#04x} is still owed; only one request of an id may be "
        "open at a time"
    )
    assert (made.data_to_send(), made.counters) == ([HANDBOOK.encode(request_)], sent)
    assert feed(made, STATUS, HANDBOOK.encode(answer)) == [STATUS_MESSAGE, answer]
    made.send(request_)


@pytest.mark.parametrize("trace", [None, lambda *_: None], ids=["plain", "traced"])
@pytest.mark.parametrize("together", [True, False])
def test_client_query_that_is_sent_again_is_answered_twice(*, together: bool, trace: Any) -> None:
    """One stands before a trigger and one after it; a third one is refused."""
    made = client(trace=trace)
    for turn in range(1, 4):  # what came before is known by its bytes
        made.send(m.Query(), again=True)
        made.send(m.Trigger(), again=True)
        made.send(m.Query(), again=True)
        with pytest.raises(LocalProtocolError, match="0x30 is still owed"):
            made.send(m.Query(), again=True)
        pieces = [QUERY_ANSWER * 3] if together else [QUERY_ANSWER] * 3
        assert feed(made, *pieces) == [m.QueryAnswer(application=21)] * 2
        assert made.counters.unexpected_messages == turn


def test_client_second_query_is_refused_while_one_of_two_is_open() -> None:
    made = client()
    made.send(m.Query(), again=True)
    made.send(m.Query(), again=True)
    assert feed(made, QUERY_ANSWER) == [m.QueryAnswer(application=21)]
    with pytest.raises(LocalProtocolError, match="0x30 is still owed"):
        made.send(m.Query())
    assert feed(made, QUERY_ANSWER) == [m.QueryAnswer(application=21)]
    made.send(m.Query())


def test_client_requests_of_different_ids_are_open_together() -> None:
    made = client()
    made.send(m.Query())
    made.send(m.GetClock())
    made.send(m.Trigger())
    made.send(m.Trigger())
    assert feed(made, QUERY_ANSWER) == [m.QueryAnswer(application=21)]


def test_client_unsolicited_answer_is_counted_and_not_delivered() -> None:
    made = client()
    assert feed(made, QUERY_ANSWER) == []
    assert made.counters.unexpected_messages == 1
    made.send(m.Query())
    assert feed(made, QUERY_ANSWER + QUERY_ANSWER) == [m.QueryAnswer(application=21)]
    assert made.counters.unexpected_messages == 2
    assert made.state is State.CONNECTED


def test_client_unknown_id_is_delivered_and_counted() -> None:
    made = client()
    expected = m.UnknownMessage(message_id=0x77, payload=b"abc")
    assert feed(made, header(3, 0x77) + b"abc") == [expected]
    assert (made.counters.unknown_ids, made.counters.unexpected_messages) == (1, 0)


def test_client_unknown_request_awaits_an_answer_under_its_id() -> None:
    made = client()
    unknown = m.UnknownMessage(message_id=0x77, payload=b"")
    made.send(unknown)
    with pytest.raises(LocalProtocolError, match="0x77 is still owed"):
        made.send(unknown)
    assert feed(made, header(1, 0x77) + b"!") == [m.UnknownMessage(message_id=0x77, payload=b"!")]
    made.send(unknown)


def test_client_request_told_to_be_unanswered_leaves_nothing_owed() -> None:
    made = client()
    unknown = m.UnknownMessage(message_id=0x77, payload=b"")
    made.send(unknown, answered=False)
    made.send(unknown, answered=False)
    assert len(made.data_to_send()) == 2


def test_client_raw_request_told_to_be_answered_owes_one_under_its_id() -> None:
    made = client()
    raw = m.UnknownMessage(message_id=0x40, payload=b"")
    made.send(raw, answered=True)
    with pytest.raises(LocalProtocolError, match="0x40 is still owed"):
        made.send(raw, answered=True)
    made.send(raw)
    assert feed(made, header(0, 0x40)) == [m.UnknownMessage(message_id=0x40, payload=b"")]


def test_client_raw_query_is_answered_as_a_query() -> None:
    made = client()
    made.send(m.UnknownMessage(message_id=0x30, payload=b""))
    assert feed(made, QUERY_ANSWER) == [m.QueryAnswer(application=21)]


def test_client_late_answer_after_disconnect_still_comes() -> None:
    made = client()
    made.send(m.Query())
    made.send(m.Disconnect())
    assert feed(made, STATUS + QUERY_ANSWER) == [STATUS_MESSAGE, m.QueryAnswer(application=21)]
    assert made.state is State.DISCONNECTED


def test_camera_owes_nothing_and_may_answer_twice() -> None:
    made = camera()
    made.send(m.QueryAnswer(application=1))
    made.send(m.QueryAnswer(application=1))
    assert len(made.data_to_send()) == 2


def test_send_field_that_does_not_fit_changes_nothing() -> None:
    made = client()
    sent = dataclasses.replace(made.counters)
    with pytest.raises(LocalProtocolError, match="does not fit its fields"):
        made.send(m.SwitchApplication(application=-1))
    with pytest.raises(LocalProtocolError, match="does not fit the handbook header"):
        made.send(m.UnknownMessage(message_id=1 << 32, payload=b""))
    assert (made.data_to_send(), made.counters) == ([], sent)
    made.send(m.SwitchApplication(application=1))


# ---------------------------------------------------------------------- counters and trace


def test_counters_tell_frames_and_bytes_of_both_directions() -> None:
    made = client()
    made.send(m.Query())
    made.send(m.Trigger())
    feed(made, STATUS[:5], STATUS[5:] + QUERY_ANSWER)
    assert made.counters == Counters(
        frames_received=3, frames_sent=3, bytes_received=16 + 20 + 16, bytes_sent=12 + 12 + 12
    )


@pytest.mark.parametrize("role", Role)
@each_dialect
def test_trace_sees_each_frame_of_both_directions(role: Role, dialect: FramedDialect) -> None:
    seen: list[tuple[m.Sender, Frame | RemoteProtocolError]] = []
    made = Machine(dialect, role, TCP, trace=lambda sender, frame: seen.append((sender, frame)))
    made.state = State.CONNECTED
    theirs: m.Message = STATUS_MESSAGE if role is Role.CLIENT else m.Trigger()
    ours: m.Message = m.Trigger() if role is Role.CLIENT else STATUS_MESSAGE
    made.send(ours)
    made.receive_data(dialect.encode(theirs))
    assert seen == [(role.sends, dialect.to_frame(ours)), (role.receives, dialect.to_frame(theirs))]


def test_trace_sees_the_error_for_bytes_that_make_no_frame() -> None:
    seen: list[tuple[m.Sender, Frame | RemoteProtocolError]] = []
    made = client(trace=lambda sender, frame: seen.append((sender, frame)))
    del seen[:]
    made.receive_data(b"noise")
    assert seen == [(CAMERA, made.error)]


def test_trace_sees_a_frame_that_was_refused_and_why() -> None:
    seen: list[Frame | RemoteProtocolError] = []
    made = camera(trace=lambda sender, frame: seen.append(frame))
    del seen[:]
    made.receive_data(header(1, 0x40) + b"x")
    frame, error = seen
    assert frame == Frame(0x40, b"x")
    assert str(error) == "message 0x40 is 1 bytes too long"


def test_trace_says_nothing_of_what_could_not_be_sent() -> None:
    seen: list[Frame | RemoteProtocolError] = []
    made = machine(Role.CLIENT, trace=lambda sender, frame: seen.append(frame))
    with pytest.raises(LocalProtocolError):
        made.send(m.Trigger())
    assert seen == []


# ---------------------------------------------------------------------- messages that came before


@pytest.mark.parametrize("told", [True, False], ids=["traced", "plain"])
@each_transport
@each_dialect
def test_camera_hears_a_chunk_that_came_before_as_one_that_did_not(
    dialect: FramedDialect, transport: Transport, told: bool
) -> None:
    chance = random.Random(dialect.label)  # noqa: S311
    requests = [one for one in examples(dialect) if isinstance(one, m.Request)]
    answers = [one for one in examples(dialect) if isinstance(one, m.Report)]
    answers += [one for one in answers if isinstance(one, m.ResultContainer)]
    seen: tuple[list[Any], list[Any]] = ([], [])

    def hearing(log: list[Any]) -> Machine:
        def trace(sender: m.Sender, what: Frame | RemoteProtocolError) -> None:
            log.append((sender, what if isinstance(what, Frame) else str(what)))

        return Machine(dialect, Role.CAMERA, transport, trace=trace if told else None)

    fast, slow = map(hearing, seen)
    chunks = [dialect.encode(one) for one in requests] * 3
    chunks += [b"".join(chance.sample(chunks, 2)) for _ in range(6)]
    if dialect.header.magic or transport is UDP:  # else nothing is heard behind a broken frame
        chunks += [chance.choice(chunks)[: chance.randint(1, 15)] for _ in range(2)]
        chunks += [header(1, 0x40) + b"x", b"noise"]
    for _ in range(500):
        data = chance.choice(chunks)
        fast.receive_data(data)
        slow.receive_data(bytearray(data))  # that is always looked at
        assert fast.events() == slow.events()
        for one in chance.choices(answers, k=2):
            said = [_said(made, one) for made in (fast, slow)]
            assert said[0] == said[1]
            if said[0] is not None:
                assert b"".join(said[0]) == dialect.encode(one)
        assert (fast.state, fast.unfinished_bytes, fast.counters) == (
            slow.state,
            slow.unfinished_bytes,
            slow.counters,
        )
    assert seen[0] == seen[1]
    assert fast.counters.frames_received > 250


def _said(made: Machine, message: m.Message) -> list[bytes] | None:
    """Return the bytes of a sent message, None if it is forbidden."""
    try:
        made.send(message)
    except LocalProtocolError:
        return None
    return made.data_to_send()


def test_camera_says_of_many_messages_what_each_one_is() -> None:
    made, sizes = camera(), range(3 * MAX_KNOWN_MESSAGES)
    for _ in range(2):
        for number in sizes:  # an object that is gone may have left its id to the next
            for one in (m.StatusReport(status=Status(number)), result(b"%d" % number, 5)):
                made.send(one)
                made.send(one)
                assert made.data_to_send() == 2 * [HANDBOOK.encode(one)]


@pytest.mark.parametrize("dialect", DIALECTS, ids=label)
def test_statuses_that_repeat_come_whole_and_in_order(dialect: FramedDialect) -> None:
    busy, done = (m.StatusReport(status=Status(bits)) for bits in (0x90, 0x80))
    said = [busy, done, result(b"a", 5), done, busy, busy, result(b"b", 5), done, done]
    data = b"".join(map(dialect.encode, said))
    told = [carried(dialect, one) for one in said]
    made = client(dialect)
    for turn in range(1, 3):
        made.receive_data(data)
        assert made.events() == told
        assert made.counters.frames_received == 1 + turn * len(said)
    for cut in range(len(data)):
        made.receive_data(data[:cut])
        first = made.events()
        made.receive_data(data[cut:])
        assert first + made.events() == told


def test_status_that_came_before_is_one_only_where_it_is_whole_and_as_long() -> None:
    made = client()
    assert feed(made, STATUS * 2) == [STATUS_MESSAGE] * 2
    long = header(12, 0x12) + STATUS[12:] + bytes(4)
    assert feed(made, STATUS, long, STATUS) == [STATUS_MESSAGE] * 3
    assert made.counters.long_bodies == 1
    assert feed(made, STATUS + b"PSVX") == [STATUS_MESSAGE, LinkFailed(error=made.error)]  # type: ignore[arg-type]


def test_status_that_was_asked_for_by_its_id_is_its_answer_though_it_came_before() -> None:
    made = client()
    feed(made, STATUS * 2)
    request = m.UnknownMessage(message_id=0x12, payload=b"")
    made.send(request, answered=True)
    with pytest.raises(LocalProtocolError):
        made.send(request, answered=True)
    feed(made, STATUS)
    made.send(request, answered=True)


def test_status_that_came_before_is_refused_if_none_may_come() -> None:
    made = client()
    feed(made, STATUS * 2)
    made.send(m.Disconnect())
    assert feed(made, STATUS * 2) == [STATUS_MESSAGE] * 2
    made.send(m.Connect())
    made.receive_data(STATUS)
    assert "where it is not expected" in str(failure(made.events()))


def test_statuses_of_many_kinds_are_all_told() -> None:
    made = client()
    said = [m.StatusReport(status=Status(0x80), endian=number) for number in range(200)] * 2
    made.receive_data(b"".join(map(HANDBOOK.encode, said)))
    assert made.events() == said
    assert len(made._known_messages[0x12]) == MAX_KNOWN_MESSAGES


TOLD_UNASKED_TOO = (m.ConnectAnswer, m.DisconnectAnswer, m.StatusReport)
ANSWERS = [
    (dialect, answer)
    for dialect, answer in EVERYTHING
    if request_for(answer, dialect) is not None and type(answer) not in TOLD_UNASKED_TOO
]


@pytest.mark.parametrize(
    ("dialect", "answer"),
    ANSWERS,
    ids=[f"{dialect.label}-{label(answer)}" for dialect, answer in ANSWERS],
)
def test_answer_that_came_before_is_reported_once_a_request_and_else_counted(
    dialect: FramedDialect, answer: m.Message
) -> None:
    request = request_for(answer, dialect)
    assert request is not None
    made, frame = client(dialect), dialect.encode(answer)
    for turn in range(1, 4):
        made.send(request)
        with pytest.raises(LocalProtocolError, match="still owed"):
            made.send(request)
        made.receive_data(frame * 2)
        assert made.events() == [answer]
        assert made._pending_ids == ()
        assert made.counters.unexpected_messages == turn
        assert made.counters.frames_received == 1 + 2 * turn


def test_message_that_another_link_knows_is_refused_where_it_is_above_the_limit() -> None:
    feed(client(), STATUS * 2)
    made = client(max_length=7)
    made.receive_data(STATUS)
    assert "announces 8 bytes of payload; 0 to 7 are accepted" in str(failure(made.events()))


def test_answer_that_came_before_is_refused_if_none_may_come() -> None:
    made = client()
    made.send(m.Query())
    assert feed(made, QUERY_ANSWER) == [m.QueryAnswer(application=21)]
    made.send(m.Disconnect())
    assert feed(made, QUERY_ANSWER) == []
    made.send(m.Connect())
    made.receive_data(QUERY_ANSWER)
    assert "where it is not expected" in str(failure(made.events()))


def test_answer_that_came_before_waits_for_its_last_byte() -> None:
    made = client()
    made.send(m.Query())
    assert feed(made, QUERY_ANSWER) == [m.QueryAnswer(application=21)]
    for cut in range(1, len(QUERY_ANSWER)):
        made.send(m.Query())
        assert feed(made, QUERY_ANSWER[:cut]) == []
        assert made.unfinished_bytes == QUERY_ANSWER[:cut]
        assert feed(made, QUERY_ANSWER[cut:]) == [m.QueryAnswer(application=21)]


def test_answer_that_refuses_is_not_taken_for_what_stood_in_front_of_it() -> None:
    """It is a code alone: a frame as long as the answer's begins in the one before it."""
    made = client(BID)
    made.send(m.GetClock())
    refusal = bytes.fromhex("3200 0200 1a00")
    frame = BID.header.pack(0x32, 14) + bytes(8) + refusal
    made.receive_data(BID.encode(result(frame.removesuffix(refusal))) + refusal)
    assert isinstance(made.events()[1], m.ClockAnswer)
    made.send(m.GetClock())
    made.receive_data(frame)
    assert made.events() == [BID.decode(CAMERA, Frame(0x32, frame[4:]))]


def test_status_that_came_before_is_traced_each_time() -> None:
    seen: list[object] = []
    made = client(trace=lambda sender, frame: seen.append(frame))
    before = len(seen)
    feed(made, STATUS * 3)
    assert seen[before:] == [Frame(0x12, STATUS[12:])] * 3


# ---------------------------------------------------------------------- bursts


APPLICATION = b"\x15\0\0" + MAGIC[:1]
"""An id that the first bytes, with the next frame after them, are read as."""


TOLD = m.StatusReport, m.ResultContainer


def result(data: bytes, application: int = 21) -> m.ResultContainer:
    return m.ResultContainer(application=application, data=data)


@pytest.mark.parametrize("dialect", DIALECTS, ids=label)
def test_result_as_there_was_one_before_has_its_own_data(dialect: FramedDialect) -> None:
    made, traced = client(dialect), client(dialect, trace=lambda *_: None)
    told = (b"abcd", b"efgh", b"abcd", b"", bytes(200), b"ij", b"", b"efgh"), (21, 22)
    said = [result(data, one) for data, one in itertools.product(*told)] * 3
    for one in said:
        for message in (STATUS_MESSAGE, one, STATUS_MESSAGE), (one,), (one, STATUS_MESSAGE):
            heard = b"".join(map(dialect.encode, message))
            assert feed(made, heard) == feed(traced, heard)
    assert made.counters == traced.counters
    assert len(made._known_results) == (0 if dialect is NO_ID else 8)


@pytest.mark.parametrize("dialect", DIALECTS, ids=label)
def test_datagram_as_there_was_one_before_is_read_as_if_it_were_the_first(
    dialect: FramedDialect,
) -> None:
    made, traced = (
        Machine(dialect, Role.CLIENT, UDP, trace=trace) for trace in (None, lambda *_: None)
    )
    told: list[m.Message] = [STATUS_MESSAGE, m.StatusReport(status=Status(0x88), endian=1)]
    told += [
        result(data, one) for data, one in itertools.product((b"", b"abcd", b"efgh"), (21, 22))
    ]
    frames = [*map(dialect.encode, told)]
    wrong = [b"", frames[0][:-1], frames[3] + b"\0", frames[0] * 2, frames[3] + frames[0]]
    connect = dialect.encode(m.ConnectAnswer(code=0, version=1))
    asked = [m.UnknownMessage(message_id=dialect.message_id(kind), payload=b"") for kind in TOLD]
    chance = random.Random(1)  # noqa: S311
    for each in made, traced:
        each.send(m.Connect())
        each.receive_data(connect)
    for step in range(2000):
        if step == 1000:  # in another state nothing is known
            for each in made, traced:
                each.send(m.Disconnect())
        elif step < 1000 and not step % 7:
            request = chance.choice(asked)
            if not made._pending_ids:
                for each in made, traced:
                    each.send(request, answered=True)
        datagram = chance.choice(frames if chance.random() < 0.8 else wrong)
        for each in made, traced:
            each.receive_data(datagram)
        assert made.events() == traced.events()
        assert made._pending_ids == traced._pending_ids
    assert made.counters == traced.counters
    assert made.counters.ignored_frames > 100


def test_result_as_there_was_one_before_waits_for_its_last_byte() -> None:
    made, other = client(), HANDBOOK.encode(result(b"efgh"))
    assert feed(made, STATUS, HANDBOOK.encode(result(b"abcd"))) == [STATUS_MESSAGE, result(b"abcd")]
    for cut in range(1, len(other)):
        assert feed(made, other[:cut]) == []
        assert made.unfinished_bytes == other[:cut]
        assert feed(made, other[cut:] + STATUS) == [result(b"efgh"), STATUS_MESSAGE]


def test_result_as_there_was_one_before_is_refused_if_none_may_come() -> None:
    made, frame = client(), HANDBOOK.encode(result(b"abcd"))
    feed(made, frame, frame)
    made.send(m.Disconnect())
    assert feed(made, frame) == [result(b"abcd")]
    made.send(m.Connect())
    made.receive_data(frame)
    assert "where it is not expected" in str(failure(made.events()))


def test_result_as_there_was_one_before_is_told_to_who_asked_for_it() -> None:
    made, frame = client(), HANDBOOK.encode(result(b"abcd"))
    request = m.UnknownMessage(message_id=0x20, payload=b"")
    for _ in range(3):
        made.send(request, answered=True)
        feed(made, frame)
        assert made._pending_ids == ()


def test_results_of_many_kinds_are_all_told() -> None:
    made = client()
    said = [result(b"abcd", number) for number in range(200)] * 2
    for one in said:
        assert feed(made, HANDBOOK.encode(one)) == [one]
    assert len(made._known_results) == MAX_KNOWN_MESSAGES


@pytest.mark.parametrize("dialect", [one for one in DIALECTS if one is not NO_ID], ids=label)
def test_burst_is_of_containers_of_one_application_right_after_one_another(
    dialect: FramedDialect,
) -> None:
    said = [*(result(one) for one in (b"a", b"", b"ccc")), STATUS_MESSAGE, result(b"d")]
    said += [result(b"e", 5), result(b"f", 5), result(b"g")]
    made = client(dialect)
    made.receive_data(b"".join(map(dialect.encode, said)) + dialect.encode(said[0])[:-1])
    assert made.events() == [
        ResultBurst(application=21, data=[b"a", b"", b"ccc"], size=4),
        STATUS_MESSAGE,
        result(b"d"),
        ResultBurst(application=5, data=[b"e", b"f"], size=2),
        result(b"g"),
    ]
    assert made.counters.frames_received == 1 + len(said)
    assert made.buffered == len(dialect.encode(said[0])) - 1
    made.receive_data(dialect.encode(said[0])[-1:])
    assert made.events() == [result(b"a")]


@pytest.mark.parametrize(
    ("behind", "text"),
    [
        (header(105) + APPLICATION + bytes(101), "announces 105 bytes"),
        (header(3) + APPLICATION[:3], "came with 3 bytes, it needs 4"),
        (b"PSVX" + header(8)[4:] + APPLICATION, "wrong magic number: 50 53 56 58 came"),
    ],
)
def test_burst_in_front_of_what_breaks_the_protocol_comes_before_the_failure(
    behind: bytes, text: str
) -> None:
    made = client(max_length=104)
    number = int.from_bytes(APPLICATION, "little")
    long = result(bytes(100), number)  # as long as may be
    made.receive_data(HANDBOOK.encode(long) * 2 + behind + HANDBOOK.encode(long))
    burst, failed = made.events()
    assert burst == ResultBurst(application=number, data=[bytes(100)] * 2, size=200)
    assert text in str(failure([failed]))
    assert made.counters.frames_received == 1 + 2 + (text.startswith("came"))


def test_burst_ends_at_another_message_of_the_same_application() -> None:
    made = client()
    made.send(m.Query())
    made.receive_data(HANDBOOK.encode(result(b"")) * 2 + QUERY_ANSWER)
    burst = ResultBurst(application=21, data=[b"", b""], size=0)
    assert made.events() == [burst, m.QueryAnswer(application=21)]


def test_burst_pays_for_one_answer_where_containers_were_asked_for() -> None:
    made = client()
    request = m.UnknownMessage(message_id=0x20, payload=b"")
    made.send(request, answered=True)
    made.receive_data(HANDBOOK.encode(result(b"a")) * 2)
    made.send(request, answered=True)
    with pytest.raises(LocalProtocolError, match="still owed"):
        made.send(request, answered=True)


def test_trace_sees_each_container_of_a_burst() -> None:
    seen: list[Frame | RemoteProtocolError] = []
    made = client(trace=lambda sender, frame: seen.append(frame))
    del seen[:]
    made.receive_data(HANDBOOK.encode(result(b"a")) * 3)
    assert made.events() == [ResultBurst(application=21, data=[b"a"] * 3, size=3)]
    assert seen == [HANDBOOK.to_frame(result(b"a"))] * 3


@pytest.mark.parametrize("transport", Transport)
def test_camera_and_datagrams_give_messages_one_by_one(transport: Transport) -> None:
    made = camera(transport=transport)
    frames = [TRIGGER, TRIGGER] if transport is UDP else [TRIGGER * 2]
    for one in frames:
        made.receive_data(one)
    assert made.events() == [m.Trigger(), m.Trigger()]


@each_transport
def test_containers_without_an_id_come_one_by_one_without_an_application(
    transport: Transport,
) -> None:
    made = client(NO_ID, transport)
    frame = bytes.fromhex("20000100 21")
    for data in [frame] * 3 if transport is UDP else [frame * 3]:
        made.receive_data(data)
    assert made.events() == [m.ResultContainer(application=-1, data=b"!")] * 3
    assert made.counters.frames_received == 1 + 3


# ---------------------------------------------------------------------- what bid adds


@pytest.mark.parametrize("before", [0, 1, 2])
def test_bid_answer_to_disconnect_may_come_anywhere_and_is_expected(before: int) -> None:
    """Before the session, while it is made, and after it; once for each or more often."""
    answer = bytes.fromhex("02000200 0000")
    made = machine(Role.CLIENT, dialect=BID)
    steps = (m.Disconnect(), m.Connect(), m.Disconnect())
    for said in steps[: before + 1]:
        made.send(said)
        if said == m.Connect() and before > 1:
            feed(made, BID.encode(m.ConnectAnswer(version=1)))
    state = made.state
    assert feed(made, answer, answer) == [m.DisconnectAnswer()] * 2
    assert made.state is state is (State.IDLE, State.CONNECTING, State.DISCONNECTED)[before]
    assert made.counters.unexpected_messages == 0


def test_bid_disconnect_that_is_never_answered_may_be_said_again() -> None:
    made = client(BID)
    made.send(m.Disconnect())
    made.send(m.Disconnect())
    made.send(m.Connect())
    assert len(made.data_to_send()) == 3


def test_bid_status_answers_get_status_whether_it_was_meant_so_or_not() -> None:
    made = client(BID)
    status = bytes.fromhex("12000200 2000")
    report = m.StatusReport(status=Status.RUNNING)
    assert feed(made, status) == [report]
    made.send(m.GetStatus())
    with pytest.raises(LocalProtocolError, match="0x12 is still owed"):
        made.send(m.GetStatus())
    assert feed(made, BID.encode(result(b"!")), status) == [result(b"!"), report]
    made.send(m.GetStatus())
    assert made.counters.unexpected_messages == 0


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        (m.Trigger(), m.TriggerAnswer(code=0x16)),
        (m.ResetErrors(), m.ResetErrorsAnswer()),
        (m.SetInput(data=b"Hello"), m.SetInputAnswer(code=0x10)),
        (m.SetClock(year=1, month=2, day=3, hour=4, minute=5, second=6), m.SetClockAnswer()),
    ],
    ids=label,
)
def test_bid_acknowledgement_is_owed_and_an_unasked_one_is_counted_only(
    request_: m.Request, answer: m.Message
) -> None:
    made = client(BID)
    assert feed(made, BID.encode(answer)) == []
    assert made.counters.unexpected_messages == 1
    made.send(request_)
    with pytest.raises(LocalProtocolError, match="is still owed"):
        made.send(request_)
    assert feed(made, BID.encode(answer)) == [answer]
    made.send(request_)


def test_bid_answer_to_an_unknown_request_comes_under_its_id() -> None:
    made = client(BID)
    made.send(m.UnknownMessage(message_id=0x41, payload=b""))
    assert feed(made, bytes.fromhex("41000200 1300")) == [
        m.UnknownMessage(message_id=0x41, payload=b"\x13\0")
    ]


# ---------------------------------------------------------------------- bodies of a wrong length

TELLING = Policy(fatal=(), exact_length=True, reports_malformed=True)


@each_transport
@pytest.mark.parametrize(
    ("dialect", "data", "payload"),
    [
        (BID, "40000100 21", b"!"),
        (BID, "31000100 05", b"\x05"),
        (BID, "31000300 050021", b"\x05\0!"),
        (BID, "33000200 e007", b"\xe0\x07"),
        (HANDBOOK, "50535642 01000000 40000000 21", b"!"),
    ],
)
def test_camera_that_tells_gets_a_body_of_a_wrong_length(
    dialect: FramedDialect, data: str, payload: bytes, transport: Transport
) -> None:
    made = camera(dialect, transport, policy=TELLING)
    frame = bytes.fromhex(data)
    message_id = frame[8] if dialect is HANDBOOK else frame[0]
    assert feed(made, frame) == [m.MalformedMessage(message_id=message_id, payload=payload)]
    assert (made.counters.ignored_frames, made.counters.long_bodies) == (0, 0)
    assert feed(made, dialect.encode(m.Trigger())) == [m.Trigger()]


@each_dialect
def test_camera_that_tells_takes_right_and_unknown_bodies_as_ever(dialect: FramedDialect) -> None:
    said = [one for one in examples(dialect) if getattr(one, "sender", CLIENT) is CLIENT]
    said.sort(key=lambda one: isinstance(one, m.Disconnect))  # nothing is heard behind it
    made = camera(dialect, policy=TELLING)
    assert feed(made, b"".join(dialect.encode(one) for one in said)) == said


def test_camera_that_tells_ignores_a_wrong_length_without_a_session() -> None:
    made = machine(Role.CAMERA, dialect=BID, policy=TELLING)
    assert feed(made, bytes.fromhex("40000100 21"), bytes.fromhex("01000100 21")) == []
    assert (made.state, made.counters.ignored_frames) == (State.IDLE, 2)


def test_camera_that_does_not_tell_drops_a_wrong_length() -> None:
    made = camera(BID)
    assert feed(made, bytes.fromhex("40000100 21"), bytes.fromhex("31000100 05")) == []
    assert made.counters.ignored_frames == 2


# ---------------------------------------------------------------------- dialects that begin alike


def asking(
    transport: Transport = TCP, *, candidates: tuple[FramedDialect, ...] = CANDIDATES
) -> Machine:
    """Return a client that has sent Disconnect and Connect to a camera of unknown dialect."""
    made = Machine(candidates[0], Role.CLIENT, transport, candidates=candidates)
    made.send(m.Disconnect())
    made.send(m.Connect())
    assert made.data_to_send() == [b"\x02\0\0\0", b"\x01\0\0\0"]
    return made


def test_kin_of_a_machine_that_knows_is_its_dialect() -> None:
    assert Machine(BID, Role.CLIENT, TCP).candidates == (BID,)
    assert asking().candidates == CANDIDATES
    assert asking().dialect is B16


@each_transport
@pytest.mark.parametrize(
    ("answer", "candidates"),
    [("01000200 0100", (B16,)), ("01000400 0000 0100", BID_OR_CODE)],
    ids=["two bytes", "four bytes"],
)
def test_kin_are_narrowed_by_the_length_of_the_answer_to_connect(
    answer: str, candidates: tuple[FramedDialect, ...], transport: Transport
) -> None:
    made = asking(transport)
    assert feed(made, bytes.fromhex(answer)) == [m.ConnectAnswer(code=0, version=1)]
    assert (made.candidates, made.dialect, made.state) == (
        candidates,
        candidates[0],
        State.CONNECTED,
    )


def test_kin_are_narrowed_by_the_first_byte_wise_too() -> None:
    made = asking()
    data = bytes.fromhex("01000400 0000 0100")
    assert feed(made, *[bytes([byte]) for byte in data]) == [m.ConnectAnswer(version=1)]
    assert made.candidates == BID_OR_CODE


def test_kin_are_narrowed_by_an_answer_to_disconnect() -> None:
    made = asking()
    assert feed(made, bytes.fromhex("02000200 0000")) == [m.DisconnectAnswer()]
    assert (made.candidates, made.dialect, made.state) == ((BID,), BID, State.CONNECTING)
    assert feed(made, bytes.fromhex("01000400 0000 0100")) == [m.ConnectAnswer(version=1)]
    assert feed(made, bytes.fromhex("12000200 2000")) == [m.StatusReport(status=Status.RUNNING)]


@pytest.mark.parametrize(
    ("answer", "taken"),
    [("01000600 0100 0000 0000", True), ("01000100 01", False), ("01000000", False)],
    ids=["longer than any", "one byte", "no byte"],
)
def test_kin_that_an_answer_of_no_known_length_leaves_are_all(answer: str, taken: bool) -> None:
    made = asking()
    events = feed(made, bytes.fromhex(answer))
    assert made.candidates == CANDIDATES
    if taken:
        assert events == [m.ConnectAnswer(version=1)]
        assert made.counters.long_bodies == 1
    else:
        assert "ConnectAnswer (0x01) came with" in str(failure(events))


def test_kin_are_narrowed_before_the_trace_sees_the_frame() -> None:
    """Whoever shows a frame in words shows it in those of the dialect that it narrowed to."""
    seen: list[str] = []

    def trace(sender: m.Sender, frame: Frame | RemoteProtocolError) -> None:
        seen.append(made.dialect.name)

    made = Machine(B16, Role.CLIENT, TCP, candidates=CANDIDATES, trace=trace)
    made.send(m.Connect())
    feed(made, bytes.fromhex("01000400 0000 0100"))
    assert seen == ["b16", "bid"]


def test_kin_are_left_alone_by_what_comes_in_the_session() -> None:
    made = asking()
    feed(made, bytes.fromhex("01000400 0000 0100"))
    made.send(m.Query())
    assert feed(made, bytes.fromhex("12000200 2001"), bytes.fromhex("30000400 0200 1500")) == [
        m.StatusReport(status=Status.RUNNING | Status.OVERTRIGGERED),
        m.QueryAnswer(code=2, application=21),
    ]
    assert made.candidates == BID_OR_CODE


@pytest.mark.parametrize("dialect", BID_OR_CODE, ids=label)
def test_adopt_one_of_the_kin_reads_as_it_from_then_on(dialect: FramedDialect) -> None:
    made = asking()
    feed(made, bytes.fromhex("01000400 0000 0100"))
    made.adopt(dialect)
    assert (made.candidates, made.dialect) == ([dialect], dialect)
    (report,) = feed(made, bytes.fromhex("12000200 2001"))
    assert report == dialect.decode(CAMERA, Frame(0x12, b"\x20\x01"))
    if dialect is BID:
        made.send(m.GetStatus())
    else:
        with pytest.raises(UnsupportedError, match="dialect b16 has no GetStatus"):
            made.send(m.GetStatus())


def test_adopt_a_stranger_is_refused() -> None:
    made = asking()
    feed(made, bytes.fromhex("01000400 0000 0100"))
    for stranger in (HANDBOOK, B16, BIG_ENDIAN_NUMBER):
        with pytest.raises(LocalProtocolError) as caught:
            made.adopt(stranger)
        assert str(caught.value) == f"{stranger.name} is none of ['bid', 'b16']"
    assert (made.candidates, made.dialect) == (BID_OR_CODE, BID)


def test_adopt_bid_has_containers_in_bursts_as_before() -> None:
    made = asking()
    feed(made, bytes.fromhex("01000400 0000 0100"))
    made.adopt(BID)
    made.receive_data(BID.encode(result(b"a")) * 2)
    assert made.events() == [ResultBurst(application=21, data=[b"a", b"a"], size=2)]


def test_kin_of_the_other_header_are_not_told_apart_by_it() -> None:
    """A frame with a magic number is waited for, as one of 16,982 bytes."""
    made = asking()
    assert feed(made, HANDBOOK.encode(m.ConnectAnswer(version=1))) == []
    assert (made.candidates, made.buffered) == (CANDIDATES, 16)


@pytest.mark.parametrize("dialect", [*CANDIDATES, NO_ID], ids=label)
@pytest.mark.parametrize("transport", Transport)
def test_session_of_a_narrow_dialect_from_connect_to_disconnect(
    dialect: FramedDialect, transport: Transport
) -> None:
    one, other = client(dialect, transport), camera(dialect, transport)
    status = m.StatusReport(status=Status.RUNNING)
    heard = [m.QueryAnswer(application=3), status, carried(dialect, result(b"!", 3))]
    for said in (m.Query(), m.Trigger()):
        one.send(said)
    for data in one.data_to_send():
        other.receive_data(data)
    assert other.events() == [m.Query(), m.Trigger()]
    for answer in heard:
        other.send(answer)
    assert feed(one, *other.data_to_send()) == heard
    one.send(m.Disconnect())
    assert feed(other, *one.data_to_send()) == [m.Disconnect()]
    assert (one.state, other.state) == (State.DISCONNECTED, State.DISCONNECTED)
