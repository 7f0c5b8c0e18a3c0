"""Packets in any order, some missing, give whole frames or losses."""

import random

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from smartcam.exceptions import MessageError
from smartcam.frames._gige.block import WholePicture
from tests.frames.gige.packets import FULL, frame, header, leader, payload, trailer
from tests.frames.inside import MAX_OPEN_BLOCKS, Assembler, Resend
from tests.frames.inside import assembler as _assembler

START = 100.0


class Stream:
    """An assembler whose clock advances by 1 ms a packet."""

    def __init__(self, *, extended: bool = False, resend: bool = True) -> None:
        self.inside = Assembler(256, FULL + (20 if extended else 8), resend=resend)
        self.now = START
        self.pictures: list[WholePicture] = []
        self.wanted: list[Resend] = []

    def feed(self, *packets: bytes, step: float = 0.001) -> None:
        for one in packets:
            self.now += step
            self.inside.feed(memoryview(one), len(one), self.now, self.now)
            self._settle()

    def _settle(self) -> None:
        deadline = self.inside.next_deadline()
        if deadline is not None and deadline <= self.now:
            self.wanted += self.inside.handle_timeout(self.now)
        for one in self.inside.pictures():
            assert len(set(bytes(one.data))) == 1, "pixels of two frames"
            assert len(one.data) == 256
            assert one.data[0] == one.leader.ticks % 256
            self.pictures.append(one)
        assert len(self.inside._blocks) <= MAX_OPEN_BLOCKS

    def wait(self, seconds: float) -> None:
        """Advance the time, as a timer does."""
        end = self.now + seconds
        for _ in range(1000):
            deadline = self.inside.next_deadline()
            if deadline is None or deadline > end:
                self.now = end
                return
            assert deadline >= self.now - 1 or not self.pictures
            self.now = max(self.now, deadline)
            self._settle()
        raise AssertionError("a deadline that does not pass")

    @property
    def numbers(self) -> list[int]:
        return [one.leader.ticks for one in self.pictures]

    @property
    def lost(self) -> int:
        return self.inside.counts.lost


def wire_id(start: int, number: int, extended: bool) -> int:
    block = start + number - 1
    return block if extended else (block - 1) % 65535 + 1


def seen_id(packet: bytes, extended: bool) -> int:
    return int.from_bytes(packet[8:16] if extended else packet[2:4], "big")


@st.composite
def mishaps(draw: st.DrawFn) -> tuple[int, bool, bool, int, int, float, float]:
    return (
        draw(st.sampled_from([1, 2, 3, 1000, 65530, 65535])),
        draw(st.booleans()),
        draw(st.booleans()),
        draw(st.integers(0, 1 << 30)),
        draw(st.sampled_from([0, 1, 3, 10, 40])),
        draw(st.sampled_from([0.0, 0.02, 0.1, 0.5])),
        draw(st.sampled_from([0.0, 0.1, 1.0])),
    )


@given(mishaps())
@example((65530, False, False, 7, 40, 0.1, 1.0))
def test_each_frame_is_whole_or_lost(
    mishap: tuple[int, bool, bool, int, int, float, float],
) -> None:
    start, extended, resend, seed, reorder, drop, double = mishap
    dice = random.Random(seed)  # noqa: S311 - it is to come again
    stream = Stream(extended=extended, resend=resend)
    kept = []
    for number in range(1, 25):
        for at, one in enumerate(
            frame(wire_id(start, number, extended), number, extended=extended)
        ):
            times = (dice.random() >= drop) * (1 + (dice.random() < double))
            kept += [(7 * number + at + dice.uniform(0, reorder), one) for _ in range(times)]
    kept.sort(key=lambda pair: pair[0])
    stream.feed(*(one for _, one in kept), step=0.0005)
    stream.wait(60)
    assert not stream.inside._blocks
    assert stream.numbers == sorted(set(stream.numbers))
    if kept and not stream.inside.counts.restarts:
        begun = seen_id(kept[0][1], extended)
        spanned = stream.inside._newest_number - (0 if begun <= MAX_OPEN_BLOCKS else begun - 1)
        assert len(stream.pictures) + stream.lost == spanned
    reported = sum(one.lost for one in stream.pictures) + stream.inside.take_lost()
    assert reported == stream.lost
    if not drop and reorder <= 3:
        assert len(stream.pictures) >= 24 - (MAX_OPEN_BLOCKS if start > MAX_OPEN_BLOCKS else 0)


@given(st.permutations(range(7)), st.booleans())
def test_the_packets_of_one_frame_in_any_order(order: list[int], extended: bool) -> None:
    stream = Stream(extended=extended)
    packets = frame(1, 9, extended=extended)
    stream.feed(*(packets[at] for at in order), step=0.0001)
    assert stream.numbers == [9]
    assert stream.lost == 0
    assert stream.pictures[0].arrived_at == START + 0.0001


@given(st.sets(st.integers(0, 6), min_size=1, max_size=6))
def test_exactly_the_missing_packets_are_requested(missing: set[int]) -> None:
    stream = Stream()
    packets = frame(1, 1)
    stream.feed(*(one for at, one in enumerate(packets) if at not in missing), *frame(2, 2))
    stream.wait(0.04)
    asked = {at for one in stream.wanted for at in range(one.first, one.last + 1)}
    assert asked == missing
    assert all(one.block == 1 for one in stream.wanted)
    assert not stream.pictures  # the second frame waits for the first one
    stream.feed(*(packets[at] for at in missing))
    assert stream.numbers == [1, 2]
    assert stream.lost == 0


@given(st.lists(st.binary(max_size=100), max_size=30), st.integers(0, 2**32))
def test_random_bytes_make_no_picture_of_two_and_raise_nothing(
    noise: list[bytes], seed: int
) -> None:
    dice = random.Random(seed)  # noqa: S311 - it is to come again
    stream = Stream()
    packets = [one for number in range(1, 6) for one in frame(number, number)]
    mixed = [one for one in noise if one[4:5] not in (b"\x03", b"\x83")]  # the pixels count
    for one in mixed:
        packets.insert(dice.randrange(len(packets)), one)
    stream.feed(*packets)
    stream.wait(60)
    assert not stream.inside._blocks


@given(st.lists(st.binary(max_size=100), max_size=60))
def test_random_packets_raise_nothing(noise: list[bytes]) -> None:
    inside = Assembler(256, FULL + 8)
    for at, one in enumerate(noise):
        inside.feed(memoryview(one), len(one), at / 100, 0.0)
        inside.handle_timeout(at / 100)
        inside.pictures()
        assert len(inside._blocks) <= MAX_OPEN_BLOCKS


def test_frame_without_resent_packets_is_lost_after_all_tries() -> None:
    stream = Stream()
    first, second = frame(1, 1), frame(2, 2)
    stream.feed(*first[:3], *first[4:], *second)
    stream.wait(1)
    assert [(one.first, one.last) for one in stream.wanted] == [(3, 3)] * _assembler.MAX_REQUESTS
    assert stream.numbers == [2]
    assert stream.pictures[0].lost == 1


def test_packet_gone_from_the_camera_loses_its_frame_at_once() -> None:
    stream = Stream()
    first = frame(1, 1)
    stream.feed(*first[:3], *first[4:], *frame(2, 2), header(3, 1, 3, 0x800C))
    assert stream.numbers == [2]
    assert stream.inside.counts.refused == 1


def test_packet_not_sent_yet_is_requested_again() -> None:
    stream = Stream()
    first = frame(1, 1)
    stream.feed(*first[:3], *first[4:], *frame(2, 2))
    stream.wait(0.01)
    stream.feed(header(3, 1, 3, 0x8010))
    stream.wait(0.05)
    stream.feed(first[3])
    assert stream.numbers == [1, 2]


def test_rest_of_the_last_frame_is_requested_after_a_silence() -> None:
    stream = Stream()
    packets = frame(1, 1)
    stream.feed(*packets[:4])
    stream.wait(0.06)
    assert stream.wanted == [Resend(1, 4, 6, extended=False)]
    stream.feed(*packets[4:])
    assert stream.numbers == [1]


def test_frame_with_too_many_missing_packets_is_lost() -> None:
    inside = Assembler(FULL * 1000, FULL + 8)
    one = leader(1, 1, (60, 1000))
    inside.feed(memoryview(one), len(one), 0.0, 0.0)
    last = payload(1, 500, bytes(FULL))
    inside.feed(memoryview(last), len(last), 0.0, 0.0)
    assert inside.handle_timeout(0.01) == []
    assert inside.counts.lost == 1


def test_leader_may_come_long_before_its_pixels() -> None:
    stream = Stream()
    packets = frame(1, 1)
    stream.feed(packets[0])
    stream.wait(5)
    stream.feed(*packets[1:])
    assert stream.numbers == [1]
    assert stream.pictures[0].arrived_at == START + 0.001


@pytest.mark.parametrize("clock", [True, False])
def test_block_ids_may_restart(clock: bool) -> None:
    stream = Stream()
    tick = 1 if clock else 0

    def sent(block: int, number: int) -> list[bytes]:
        packets = frame(block, number if clock else 0)
        packets[0] = leader(block, number * tick)
        return packets

    for number in range(1, 9):
        stream.feed(*sent(number, number))
    stream.wait(2)
    for block, number in ((1, 9), (2, 10), (3, 11)):
        stream.feed(*sent(block, number))
    assert len(stream.pictures) == 11
    assert [one.number for one in stream.pictures] == list(range(1, 12))
    assert stream.inside.counts.restarts == 1
    assert stream.lost == 0


def test_restarted_block_ids_mix_no_frames() -> None:
    stream = Stream()
    stream.feed(*frame(1, 1), *frame(2, 2)[:4])
    stream.feed(*frame(2, 12))  # the same id, another picture
    stream.feed(*frame(3, 13))
    stream.wait(1)
    assert stream.numbers == [1, 12, 13]
    assert stream.lost == 2  # the old frame 2, and the new frame 1, of which no packet came


def test_late_and_doubled_packets_of_done_frames_are_ignored() -> None:
    stream = Stream()
    first = frame(1, 1)
    stream.feed(*first, *first, *frame(2, 2), *first[1:])
    stream.wait(1)
    assert stream.numbers == [1, 2]
    assert stream.inside.counts.late == 7 + 6
    assert stream.inside.counts.restarts == 0


def test_a_gap_of_many_frames_is_counted() -> None:
    stream = Stream()
    stream.feed(*frame(1, 1))
    stream.now += 10
    stream.feed(*frame(501, 501 % 256))
    stream.wait(1)
    assert len(stream.pictures) == 2
    assert stream.lost == 499


def test_oldest_open_frame_is_given_up_at_the_limit() -> None:
    stream = Stream()
    for number in range(1, MAX_OPEN_BLOCKS + 3):
        packets = frame(number, number)
        stream.feed(*packets[:3], *packets[4:], step=0.00001)
    assert len(stream.inside._blocks) == MAX_OPEN_BLOCKS
    assert stream.lost == 2


@pytest.mark.parametrize(
    "wrong",
    [
        payload(1, 2, bytes(FULL - 1)),  # short, and not the last one
        payload(1, 9, bytes(FULL)),  # after the frame's end
        trailer(1, 2),  # before the received packets
        payload(1, 4, bytes(FULL), extended=True),
        header(7, 1, 4),
    ],
)
def test_a_packet_that_does_not_fit_is_dropped(wrong: bytes) -> None:
    stream = Stream()
    packets = frame(1, 1)
    stream.feed(*packets[:2], packets[3], wrong, packets[2], *packets[4:])
    assert stream.numbers == [1]
    assert stream.inside.counts.malformed == 1


def test_a_frame_with_too_few_bytes_is_lost() -> None:
    stream = Stream()
    stream.feed(leader(1, 1), payload(1, 1, bytes([1]) * FULL), trailer(1, 2), *frame(2, 2))
    assert stream.numbers == [2]
    assert stream.lost == 1


def test_a_camera_that_sends_fewer_rows_gives_a_lower_picture() -> None:
    inside = Assembler(256, FULL + 8)
    for one in (leader(1, 1), payload(1, 1, bytes([1]) * 48), trailer(1, 2, rows=3)):
        inside.feed(memoryview(one), len(one), 0.0, 0.0)
    (picture,) = inside.pictures()
    assert (picture.rows, picture.stride, len(picture.data)) == (3, 16, 48)


@pytest.mark.parametrize(
    ("first", "text"),
    [
        (leader(1, 1, (64, 64)), "64x64 pixels has 4096 bytes"),
        (leader(1, 1, kind=6), "0x0006 .JPEG."),
        (leader(1, 1, kind=0x1234), "unknown"),
        (leader(1, 1)[:30], "expected 36 bytes"),
        (leader(1, 1)[:12], "expected 12 bytes"),
    ],
)
def test_unreadable_leader_is_an_error(first: bytes, text: str) -> None:
    stream = Stream()
    stream.feed(first)
    assert isinstance(stream.inside.fault, MessageError)
    with pytest.raises(MessageError, match=text):
        raise stream.inside.fault
