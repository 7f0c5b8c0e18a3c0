"""Bytes that a transport writes into a buffer: any read is the same as if they were fed.

Most tests make buffers small: where frames are large, where reads begin and where they end to grow
then lie within what Hypothesis tries. What is written is read over junk, so whatever still looks
into the transport's memory after its time sees that.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from itertools import cycle
from typing import Any
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import FrameError, LocalProtocolError, MessageError
from smartcam.models import Status
from smartcam.protocols import Frame, FramedDialect, HeaderLayout, LinkFailed, Machine, State
from smartcam.protocols import messages as m
from smartcam.protocols._inside import DEFAULT_MAX_LENGTH, HANDBOOK, Framer, Policy, ResultBurst
from tests.machines import DIALECTS, THESIS, client, label, one_by_one
from tests.protocols.inside import framing, machine

LARGE, FIRST_READ, MAX_READ, ALIKE = 32, 32, 128, 3
SIZES = st.one_of(
    st.integers(0, 40),
    st.integers(0, 300),
    *(st.integers(size - 16, size + 2) for size in (LARGE, 2 * FIRST_READ, MAX_READ)),
)
LIMITS = st.sampled_from([0, 24, LARGE, 100, MAX_READ, 300])
CLEAR = 0
"""Drop everything kept, instead of a read of no bytes."""
READS = st.lists(
    st.one_of(st.integers(1, 9), st.integers(1, 300), st.just(1 << 20)), min_size=1, max_size=6
)
PATTERN = bytes(range(1, 252)) * 8_400

each_dialect = pytest.mark.parametrize("dialect", DIALECTS, ids=label)
each_header = pytest.mark.parametrize(
    "dialect", [one for one in DIALECTS if not one.quirks], ids=label
)


@contextlib.contextmanager
def small_buffers() -> Iterator[None]:
    with mock.patch.multiple(
        framing,
        MIN_OWN_BUFFER_BYTES=LARGE,
        FIRST_READ_BYTES=FIRST_READ,
        MAX_READ_BYTES=MAX_READ,
        FRAMES_PER_CUT=ALIKE,
    ):
        yield


def payload(size: int) -> bytes:
    """Return bytes that tell their place, and are no magic number."""
    return PATTERN[size % 7 :][:size]


def read_into(taker: Framer | Machine, data: bytes, most: int) -> int:
    """Read as a transport does; return how many of the bytes it took."""
    room = taker.get_buffer()
    count = min(most, len(room), len(data))
    assert room
    room[:] = b"\xee" * len(room)
    room[:count] = data[:count]
    taker.buffer_updated(count)
    return count


# ---------------------------------------------------------------------- the framer


def streams(header: HeaderLayout, limit: int) -> st.SearchStrategy[bytes]:
    """Frames of any size, and now and then what makes none."""
    ids = st.integers(0, 0x50)
    frame = st.builds(
        lambda number, size: header.pack(number, size) + payload(size), ids, SIZES.map(int)
    )
    too_long = st.builds(header.pack, ids, st.integers(limit + 1, min(header.max_payload, 9999)))
    wrong = st.one_of(
        too_long,
        st.builds(header.pack, ids, st.integers(-header.length_includes, 0)),
        st.builds(lambda data, end: data[:end], frame, st.integers(0, 60)),
        st.binary(max_size=60),
    )
    pieces = st.one_of(frame, frame, frame, wrong)
    return st.lists(pieces, max_size=8).map(b"".join)


def taken(framer: Framer) -> list[Any]:
    """Return everything that comes: frames, and what an error tells and how many bytes it costs."""
    found: list[Any] = []
    while True:
        try:
            frame = framer.next_frame()
        except FrameError as error:
            what = (str(error), error.offset, error.data, framer.unfinished_bytes)
            found += [what, framer.resync()]
        else:
            if frame is None:
                return found
            found.append(frame)


@each_header
@given(data=st.data(), limit=LIMITS, reads=READS)
def test_written_bytes_give_the_frames_and_errors_of_fed_ones(
    dialect: FramedDialect, limit: int, reads: list[int], data: st.DataObject
) -> None:
    header = dialect.header
    stream = data.draw(streams(header, limit))
    turns = cycle(data.draw(st.permutations([*reads, *data.draw(st.sampled_from([[], [CLEAR]]))])))
    most_kept = max(MAX_READ, header.size + limit)
    with small_buffers():
        written, fed = Framer(header, limit), Framer(header, limit)
        all_written: list[Any] = []
        all_fed: list[Any] = []
        while stream:
            size = next(turns)
            if size == CLEAR:
                written.clear()
                fed.clear()
                size = next(turns)
            count = read_into(written, stream, size)
            fed.feed(stream[:count])
            stream = stream[count:]
            all_written += taken(written)
            all_fed += taken(fed)
            assert all_written == all_fed
            assert (written.buffered, written.unfinished_bytes) == (
                fed.buffered,
                fed.unfinished_bytes,
            )
            assert written.buffered <= header.size + limit
            assert len(written._store) <= most_kept
            assert len(written.buffer) <= most_kept + LARGE
    for one in all_written:
        assert not isinstance(one, Frame) or type(one.payload) is bytes


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize("most", [1460, 1 << 16, 1 << 30])
@pytest.mark.parametrize("dialect", [HANDBOOK, THESIS], ids=lambda one: one.name)
def test_written_frames_around_every_limit_come_out_whole(
    dialect: FramedDialect, most: int
) -> None:
    limits = (framing.MIN_OWN_BUFFER_BYTES, framing.MAX_READ_BYTES, DEFAULT_MAX_LENGTH - 1)
    sizes = [size + more for size in limits for more in (-13, -12, -1, 0, 1)]
    sizes += [8] * 2000
    frames = [Frame(0x20, payload(size)) for size in sizes]
    frames += reversed(frames)
    stream = b"".join(map(dialect.encode_frame, frames))
    framer, found, at = Framer(dialect.header), list[Frame](), 0
    while at < len(stream):
        at += read_into(framer, stream[at : at + framing.DEFAULT_MAX_LENGTH + 99], most)
        found += iter(framer.next_frame, None)
    assert found == frames
    assert framer.buffered == 0
    assert len(framer.get_buffer()) <= dialect.header.size + DEFAULT_MAX_LENGTH


@each_header
@pytest.mark.parametrize("size", [framing.MIN_OWN_BUFFER_BYTES - 1, framing.MIN_OWN_BUFFER_BYTES])
def test_written_large_frame_is_not_copied_and_small_ones_are_at_once(
    dialect: FramedDialect, size: int
) -> None:
    framer = Framer(dialect.header)
    for _ in range(2):  # the second read has room for the whole frame
        read_into(framer, dialect.encode_frame(Frame(0x20, payload(size)))[:4096], 1 << 30)
        large = size == framing.MIN_OWN_BUFFER_BYTES
        assert type(framer.buffer) is (memoryview if large else bytes)
        assert framer.next_frame() is None
        framer.clear()


def test_written_reads_grow_while_they_are_filled_and_stop() -> None:
    framer, stream, rooms = Framer(HANDBOOK.header), HANDBOOK.encode(m.Connect()) * 99_999, []
    while stream:
        rooms.append(len(framer.get_buffer()))
        stream = stream[read_into(framer, stream, 1 << 30) :]
        assert taken(framer)
    doublings = (framing.MAX_READ_BYTES // framing.FIRST_READ_BYTES).bit_length()
    growing = [framing.FIRST_READ_BYTES << turn for turn in range(doublings)]
    assert rooms[:doublings] == growing
    assert {*rooms[doublings:]} == {framing.MAX_READ_BYTES}
    read_into(framer, b"P", 1)
    assert len(framer.get_buffer()) == framing.MAX_READ_BYTES


def test_written_reads_never_keep_more_than_the_longest() -> None:
    limit = framing.MAX_READ_BYTES - 1000  # a frame leaves that much room, which a read may fill
    framer = Framer(HANDBOOK.header, limit)
    stream = HANDBOOK.encode_frame(Frame(0x20, payload(limit)))
    stream += HANDBOOK.encode(m.Connect()) * limit
    while stream:
        stream = stream[read_into(framer, stream, 1 << 30) :]
        taken(framer)
        assert len(framer.get_buffer()) <= len(framer._store) <= framing.MAX_READ_BYTES


@pytest.mark.parametrize("write", [True, False], ids=["written", "fed"])
@pytest.mark.parametrize("drop", ["clear", "resync"])
def test_unfinished_large_frame_is_dropped_and_the_next_comes(drop: str, write: bool) -> None:
    """Resync looks for a magic number in what is there of it, as in any unfinished frame."""
    begun = HANDBOOK.header.pack(0x20, 9000) + payload(4000)
    whole = HANDBOOK.encode(m.QueryAnswer(application=21))
    framer = Framer(HANDBOOK.header)
    for data in (begun, whole[:5]):
        if write:
            assert read_into(framer, data, len(data)) == len(data)
        else:
            framer.feed(data)
        assert framer.next_frame() is None
    assert framer.buffered == len(begun) + 5
    if drop == "clear":
        framer.clear()
        framer.feed(whole[:5])
    else:
        assert framer.resync() == len(begun)
    assert framer.unfinished_bytes == whole[:5]
    framer.feed(whole[5:])
    assert framer.next_frame() == HANDBOOK.to_frame(m.QueryAnswer(application=21))


# ---------------------------------------------------------------------- the machine


def words(dialect: FramedDialect, limit: int) -> st.SearchStrategy[bytes]:
    """Return messages of a camera that runs free: results of two applications, others between."""

    def framed(message_id: int, body: bytes) -> bytes:
        return dialect.header.pack(message_id, len(body)) + body

    size = dialect.encoder(m.ResultContainer).size
    last = framed(0x20, b"")[:1]  # what of the next frame stands behind a body that is too short
    words = [bytes([number]).ljust(size - 1, b"\0") + last for number in (5, 5, 5, 6)]
    word = st.sampled_from(words)
    results = st.builds(
        lambda word, count: framed(0x20, word + payload(count)),
        word,
        SIZES.map(lambda count: count % (limit - size + 1)),
    )
    other = st.one_of(
        st.builds(
            lambda number, word, more: framed(number, word + more),
            st.sampled_from([0x01, 0x12, 0x30, 0x77]),  # in every state, asked for or not
            word,
            st.binary(min_size=4, max_size=9),
        ),
        st.builds(lambda word, end: framed(0x20, word[:end]), word, st.integers(0, size)),
        st.builds(
            lambda word, more: framed(0x20, word + payload(more)), word, st.integers(limit, 320)
        ),
        results.map(lambda frame: b"?" + frame[1:]),
    )
    alike = st.builds(
        lambda word, count, times: b"".join(
            framed(0x20, word + bytes([number]) * count) for number in range(times)
        ),
        word,
        st.integers(0, 9),
        st.integers(ALIKE - 1, 3 * ALIKE + 2),
    )
    statuses = [m.StatusReport(status=Status(bits)) for bits in (0x80, 0x280)]
    again = st.sampled_from(
        [dialect.encode(one) for one in (*statuses, m.QueryAnswer(application=5))]
    )
    runs = st.lists(st.one_of(results, alike, again), min_size=1, max_size=6).map(b"".join)
    return st.lists(st.one_of(runs, runs, other), max_size=6).map(b"".join)


def outcome(made: Machine, events: list[Any]) -> tuple[Any, ...]:
    """Return all that must not depend on how bytes came; an error's text and bytes may."""
    plain = [type(one.error) if isinstance(one, LinkFailed) else one for one in events]
    counters = dataclasses.replace(made.counters)
    if made.state is State.FAILED:
        counters.bytes_received = 0  # none is counted after the failure
    return plain, made.state, made.buffered, counters


@pytest.mark.sampled(every=3)
@each_dialect
@given(data=st.data(), limit=st.sampled_from([24, 100, 300]), reads=READS, strict=st.booleans())
def test_bursts_and_what_came_before_are_the_frames_that_come_one_by_one(
    dialect: FramedDialect, limit: int, reads: list[int], strict: bool, data: st.DataObject
) -> None:
    parts = data.draw(st.lists(words(dialect, limit), min_size=1, max_size=3))
    # where frames that are broken are dropped, nothing else may be: how often depends on the cuts
    fatal = (FrameError, MessageError) if strict else (FrameError,)
    options: Any = {"max_length": limit, "policy": Policy(fatal=fatal, exact_length=False)}
    traced: list[Any] = []
    with small_buffers():
        alone, fed, written = (client(dialect, **options) for _ in range(3))
        looked_at = client(dialect, trace=lambda *what: traced.append(what), **options)
        machines = (alone, fed, written, looked_at)
        events: list[list[Any]] = [[], [], [], []]
        turns = cycle(reads)
        for part in parts:
            for made in machines:
                with contextlib.suppress(LocalProtocolError):  # it is still owed, or has failed
                    made.send(m.Query())
            for place in range(len(part)):
                alone.receive_data(part[place : place + 1])
                events[0] += alone.events()
            at = 0
            while at < len(part):
                count = read_into(written, part[at:], next(turns))
                fed.receive_data(part[at : at + count])
                looked_at.receive_data(part[at : at + count])
                at += count
                for made, seen in zip(machines[1:], events[1:], strict=True):
                    seen += made.events()
    assert not any(isinstance(one, ResultBurst) for one in events[0])
    expected = outcome(alone, events[0])
    assert outcome(fed, one_by_one(events[1])) == expected
    assert outcome(written, one_by_one(events[2])) == expected
    assert outcome(looked_at, one_by_one(events[3])) == expected
    heard = [what for sender, what in traced if sender is m.Sender.CAMERA]
    frames = [what for what in heard if isinstance(what, Frame)]
    assert len(frames) == looked_at.counters.frames_received
    frames = frames[1:]  # without the answer to Connect
    assert b"".join(parts).startswith(b"".join(map(dialect.encode_frame, frames)))


SMALL = m.ResultContainer(application=5, data=bytes(40))
STATUS = m.StatusReport(status=Status.RUNNING)


@pytest.mark.parametrize(
    ("message", "most"),
    [(SMALL, machine.MAX_FRAMES_PER_READ), (STATUS, machine.MAX_EVENTS_PER_READ)],
    ids=["results", "statuses"],
)
def test_reads_shrink_until_they_have_no_more_frames_than_one_turn_takes(
    message: m.Message, most: int
) -> None:
    made, frame = client(HANDBOOK), HANDBOOK.encode(message)
    stream, counts = frame * 20_000, list[int]()
    while stream:
        before = made.counters.frames_received
        stream = stream[read_into(made, stream, 1 << 30) :]
        counts.append(made.counters.frames_received - before)
        made.events()
    grown = framing.MAX_READ_BYTES.bit_length()
    assert max(counts[:grown]) > most
    assert most // 4 < max(counts[grown:]) <= most
    assert len(made.get_buffer()) < framing.MAX_READ_BYTES
