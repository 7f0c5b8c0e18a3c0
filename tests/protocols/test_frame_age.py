"""A frame that does not become whole: refused for its length, its age, or what is in it."""

from __future__ import annotations

import pytest

from smartcam.exceptions import FrameError
from smartcam.models import Status
from smartcam.protocols import FramedDialect, LinkFailed, Machine, State, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._framed.dialect import MAX_SURPLUS_BYTES
from smartcam.protocols._inside import DEFAULT_MAX_LENGTH, HANDBOOK, Event
from tests.machines import B16, DIALECTS, THESIS, camera, client, label
from tests.protocols.inside import FRAME_TIME, HINT_TIME, MIN_BYTES_PER_SECOND, UnfinishedFrame
from tests.strategies import over

RESULT, UNKNOWN = 0x20, 0x77
STATUS = m.StatusReport(status=Status(0x280))

each_dialect = pytest.mark.parametrize("dialect", DIALECTS, ids=label)
with_magic = pytest.mark.parametrize("dialect", [HANDBOOK, THESIS], ids=label)
FIXED = [
    (dialect, number, lengths)
    for dialect in DIALECTS
    for number, lengths in dialect.lengths(m.Sender.CAMERA).by_id.items()
    if lengths.stop <= DEFAULT_MAX_LENGTH
]
"""Messages with a documented length: dialect, id, lengths that are accepted."""


def read(made: Machine, data: bytes, now: float) -> list[Event]:
    """Make it read bytes as a transport does, all at one time."""
    events: list[Event] = []
    while data and made.state is not State.FAILED:
        room = made.get_buffer()
        count = min(len(room), len(data))
        room[:count] = data[:count]
        data = data[count:]
        if made.buffer_updated(count, now):
            events += made.events()
    return events


def failure(events: list[Event]) -> str:
    """Return the text of the error that is the only event."""
    (event,) = events
    assert isinstance(event, LinkFailed)
    assert isinstance(event.error, FrameError)
    return str(event.error)


def whole(dialect: FramedDialect, data: bytes) -> bytes:
    return dialect.encode(m.ResultContainer(application=7, data=data))


def large(dialect: FramedDialect) -> int:
    """Return a payload's size that is as large as a header can say and is accepted."""
    return min(DEFAULT_MAX_LENGTH, dialect.header.max_payload)


# ---------------------------------------------------------------------- its length


@over("dialect, number, lengths", FIXED)
def test_length_far_beyond_the_documented_one_is_refused_at_the_header(
    dialect: FramedDialect, number: int, lengths: range
) -> None:
    longest = lengths.stop - 1
    assert longest - MAX_SURPLUS_BYTES in range(2, 33)
    assert read(client(dialect), dialect.header.pack(number, longest), 0.0) == []
    head = dialect.header.pack(number, longest + 1)
    for body in (b"", bytes(longest + 1)):
        assert failure(read(client(dialect), head + body, 0.0)) == (
            f"a frame of message {number:#04x} announces {longest + 1} bytes of payload; "
            f"0 to {longest} are accepted"
        )


def test_messages_with_a_documented_length_are_all_but_the_result_container() -> None:
    handbook = [number for dialect, number, _ in FIXED if dialect is HANDBOOK]
    assert sorted(handbook) == [0x01, 0x12, 0x30, 0x31, 0x32]


@pytest.mark.parametrize("pieces", [1, 2])
def test_length_within_the_slack_is_accepted_and_counted(pieces: int) -> None:
    made, data = client(), HANDBOOK.encode(STATUS)[12:].ljust(8 + MAX_SURPLUS_BYTES, b"\0")
    frame = HANDBOOK.header.pack(0x12, len(data)) + data
    cut = len(frame) // pieces
    assert read(made, frame[:cut], 0.0) + read(made, frame[cut:], 0.0) == [STATUS]
    assert made.counters.long_bodies == 1


@each_dialect
@pytest.mark.parametrize("number", [RESULT, UNKNOWN])
def test_length_that_is_not_documented_may_be_what_is_accepted_of_any(
    dialect: FramedDialect, number: int
) -> None:
    assert read(client(dialect), dialect.header.pack(number, large(dialect)), 0.0) == []


def test_length_beyond_the_documented_one_is_dropped_from_datagrams() -> None:
    made = client(HANDBOOK, Transport.UDP)
    size = 8 + MAX_SURPLUS_BYTES + 1
    made.receive_data(HANDBOOK.header.pack(0x12, size) + bytes(size))
    assert (made.events(), made.counters.ignored_frames) == ([], 1)
    made.receive_data(HANDBOOK.encode(STATUS))
    assert made.events() == [STATUS]


@each_dialect
def test_camera_awaits_whatever_is_announced(dialect: FramedDialect) -> None:
    made = camera(dialect)
    size = min(large(dialect), 9999)
    assert read(made, dialect.header.pack(0x40, size), 0.0) == []
    for now in range(1, 1000):
        assert read(made, b"\0", now) == []
    assert read(made, bytes(size - 999), 1000.0) == []
    assert (made.counters.ignored_frames, made.buffered) == (1, 0)


# ---------------------------------------------------------------------- its age


@each_dialect
@pytest.mark.parametrize("number", [RESULT, UNKNOWN])
@pytest.mark.parametrize("size", [100, None])
def test_frame_that_trickles_is_refused_in_the_end(
    dialect: FramedDialect, number: int, size: int | None
) -> None:
    size = size or large(dialect)
    made, bound = client(dialect), FRAME_TIME + (size + dialect.header.size) / MIN_BYTES_PER_SECOND
    begun = dialect.encode(STATUS) + dialect.header.pack(number, size)
    assert read(made, begun, 100.0) == [STATUS]
    events: list[Event] = []
    steps = 0
    while not events:
        steps += 1
        events = read(made, b"\0", 100.0 + steps / 4)
    # the longest pause, which is a quarter of a second, does not count
    assert bound < steps / 4 - 0.25 <= bound + 0.25
    there = f"{dialect.header.size + steps} of {dialect.header.size + size} bytes are there after"
    text = failure(events)
    assert text.startswith(f"a frame of message {number:#04x} does not become whole: {there} ")
    assert made.state is State.FAILED
    assert read(made, b"\0", 200.0) == []


@each_dialect
def test_header_that_trickles_is_refused_in_the_end(dialect: FramedDialect) -> None:
    made, head = client(dialect), dialect.header.pack(RESULT, 100)
    assert read(made, head[:1], 0.0) == []
    assert read(made, head[1:2], 6.0) == []
    assert failure(read(made, head[2:3], 12.0)).startswith("a header does not become whole: 3 of ")


@each_dialect
def test_frame_may_take_the_time_of_its_length(dialect: FramedDialect) -> None:
    made, data = client(dialect), bytes(large(dialect) - 4)
    frame = whole(dialect, data)
    step = MIN_BYTES_PER_SECOND // 4
    for place in range(0, len(frame) - step, step):
        assert read(made, frame[place : place + step], place / MIN_BYTES_PER_SECOND) == []
    last = len(frame) - 1 - (len(frame) - 1) % step
    assert len(read(made, frame[last:], last / MIN_BYTES_PER_SECOND + FRAME_TIME)) == 1


@each_dialect
def test_frames_that_are_each_cut_have_each_their_own_time(dialect: FramedDialect) -> None:
    made = client(dialect)
    frame = dialect.encode(STATUS)
    (status,) = read(made, frame, 0.0)
    rest = b""
    for now in range(1000):
        assert read(made, rest + frame[:5], now) == ([status] if rest else [])
        rest = frame[5:]


def test_one_pause_does_not_count_it_may_have_been_ours() -> None:
    made, frame = client(), whole(HANDBOOK, bytes(99_999))
    assert read(made, frame[:5000], 0.0) == []
    assert read(made, frame[5000:9000], 1000.0) == []
    assert read(made, frame[9000:10_000], 1000.5) == []
    assert len(read(made, frame[10_000:], 1006.0)) == 1


def test_age_is_the_time_since_the_first_bytes_without_the_longest_pause() -> None:
    begun = UnfinishedFrame()
    assert [begun.age(1, 10.0, now) for now in (11.0, 11.5, 14.5, 15.5)] == [0, 0.5, 1.5, 2.5]
    begun.searched = 99
    assert [begun.age(2, 16.0, now) for now in (16.5, 17.0)] == [0, 0.5]
    assert begun.searched == 0


# ---------------------------------------------------------------------- what is in it


@with_magic
@pytest.mark.parametrize("size", [500, 1 << 20])
def test_header_in_a_frame_that_takes_long_says_that_its_length_is_wrong(
    dialect: FramedDialect, size: int
) -> None:
    made, status = client(dialect), dialect.encode(STATUS)
    assert read(made, dialect.header.pack(RESULT, size) + status, 0.0) == []
    assert read(made, status, HINT_TIME / 2) == []
    assert read(made, status, HINT_TIME) == []
    events = read(made, status, 1.5 * HINT_TIME)
    assert failure(events) == (
        f"a frame of message 0x20 holds another header at byte 12; "
        f"92 of {12 + size} bytes are there after {HINT_TIME:.1f} s"
    )


@with_magic
def test_header_is_found_where_it_came_in_pieces_and_after_what_was_searched(
    dialect: FramedDialect,
) -> None:
    made, status = client(dialect), dialect.encode(STATUS)
    seen = [read(made, dialect.header.pack(RESULT, 1 << 20) + bytes(9000), 0.0)]
    seen += [read(made, bytes(9000), now * HINT_TIME) for now in (0.5, 1.0, 1.5, 2.0)]
    seen += [read(made, bytes([byte]), 2.0 * HINT_TIME) for byte in status[:11]]
    assert not any(seen)
    assert "holds another header at byte 45012;" in failure(read(made, status[11:], 3.0))


@with_magic
def test_header_in_a_frame_that_comes_without_delay_is_data(dialect: FramedDialect) -> None:
    made, status = client(dialect), dialect.encode(STATUS)
    frame = whole(dialect, (status * 50_000)[: (1 << 20) - 4])
    step, seen = 100_000, list[Event]()
    for count, place in enumerate(range(0, len(frame), step)):
        seen += read(made, frame[place : place + step], count * HINT_TIME / 20)
    assert seen == [m.ResultContainer(application=7, data=frame[16:])]


@with_magic
@pytest.mark.parametrize(
    ("number", "size"),
    [(UNKNOWN, 8), (0x12, 7), (0x12, 8 + MAX_SURPLUS_BYTES + 1), (RESULT, 3), (RESULT, 1 << 21)],
)
def test_magic_number_alone_is_no_header(dialect: FramedDialect, number: int, size: int) -> None:
    made, inside = client(dialect), dialect.header.pack(number, size)
    frame = whole(dialect, inside * 1000)
    for count in range(8):
        assert read(made, frame[count * 1000 : (count + 1) * 1000], count * HINT_TIME / 2) == []
    assert len(read(made, frame[8000:], 4 * HINT_TIME)) == 1


def test_dialect_without_a_magic_number_has_no_such_hint() -> None:
    made, status = client(B16), B16.encode(STATUS)
    assert read(made, B16.header.pack(RESULT, 60_000), 0.0) == []
    for count in range(1, 8):
        assert read(made, status, count * HINT_TIME / 2) == []
