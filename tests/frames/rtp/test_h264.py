"""H.264 in packets: by hand from RFC 6184, and any frames over any bad link."""

from __future__ import annotations

import contextlib
import itertools
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import ConfigurationError, FrameFormatError
from smartcam.frames import Codecs
from tests.frames.inside import (
    MAX_PACKETS_AHEAD,
    AccessUnit,
    Depacketizer,
    H264Packetizer,
    RtpPacket,
    parameter_sets,
    picture_size,
    units,
)
from tests.frames.inside import parameters_description as description
from tests.frames.inside import parameters_size_in as size_in
from tests.frames.pictures import frame_of

SPS, PPS = b"\x67\x42\xc0\x1e\xa6", b"\x68\xce\x0f\xc8"
SEI, SLICE, KEY = b"\x06\x06\x01\x84\x80", b"\x41\x9a\x20", b"\x65\x88\x84"
MTU = 64


def annex_b(*found: bytes) -> bytes:
    return b"".join(b"\0\0\0\1" + one for one in found)


def packet(payload: bytes | str, sequence: int, stamp: int = 0, last: bool = False) -> RtpPacket:
    data = bytes.fromhex(payload) if isinstance(payload, str) else payload
    return RtpPacket(last, 96, sequence & 0xFFFF, stamp, 1, data)


def took(depacketizer: Depacketizer, *packets: RtpPacket) -> list[AccessUnit]:
    return [made for one in packets for made in depacketizer.add_packet(one)]


def begun() -> Depacketizer:
    """Return a depacketizer after a whole frame: the next sequence number is 1."""
    made = Depacketizer(window=8)
    first = made.add_packet(packet(KEY, 0, 77, last=True))
    assert [one.starts_stream for one in first] == [True]
    return made


# units


def test_units_are_the_bytes_between_start_codes() -> None:
    data = b"\0\0\0\0\1" + SPS + b"\0\0\1" + PPS + b"\0\0\0\1" + SLICE + b"\0\0"
    assert units(data) == [SPS, PPS, SLICE]
    assert parameter_sets(data) == (SPS, PPS)
    assert parameter_sets(annex_b(SPS, SLICE)) is None


@pytest.mark.parametrize(
    "data", [b"", SLICE, b"\1\0\0\1" + SLICE, b"\0\0\1", b"\0\0\1\x80", b"\0\0\1\x7c\1"]
)
def test_bytes_without_units_are_refused(data: bytes) -> None:
    with pytest.raises(FrameFormatError, match="annex B"):
        units(data)


# packets by hand


def test_small_units_go_together_and_the_last_packet_has_the_marker() -> None:
    made = H264Packetizer(97, 0x01020304, 0xFFFF).packets(
        annex_b(SPS, PPS, SEI, SLICE), 1 << 33 | 5
    )
    together = "78 0005 6742c01ea6 0004 68ce0fc8 0005 0606018480"
    assert made == [
        bytes.fromhex("80 61 ffff 00000005 01020304" + together),
        bytes.fromhex("80 e1 0000 00000005 01020304") + SLICE,
    ]


def test_a_large_unit_is_cut_into_parts() -> None:
    packetizer = H264Packetizer(96, 1, 5, mtu_payload=64)
    large = b"\x65" + bytes(range(1, 131))
    made = [RtpPacket.parse(one) for one in packetizer.packets(annex_b(large), 9)]
    assert [one.payload[:2].hex() for one in made] == ["7c85", "7c05", "7c45"]
    assert b"".join(one.payload[2:] for one in made) == large[1:]
    assert [len(one.payload) for one in made] == [64, 64, 8]
    assert [one.marker for one in made] == [False, False, True]
    assert (packetizer.sequence, packetizer.packets_made, packetizer.octets_made) == (8, 3, 136)
    made = [RtpPacket.parse(one) for one in packetizer.packets(annex_b(large[:64]), 9)]
    assert [one.payload for one in made] == [large[:64]]
    made = [RtpPacket.parse(one) for one in packetizer.packets(annex_b(large[:65]), 9)]
    assert [one.payload[:2].hex() for one in made] == ["7c85", "7c45"]


def test_packet_without_a_frame_uses_no_number() -> None:
    packetizer = H264Packetizer(sequence=5)
    with pytest.raises(FrameFormatError):
        packetizer.packets(b"nothing", 0)
    assert packetizer.sequence == 5
    for wrong in ({"payload_type": 128}, {"ssrc": -1}, {"sequence": 65536}, {"mtu_payload": 63}):
        with pytest.raises(ConfigurationError, match=next(iter(wrong))):
            H264Packetizer(**wrong)


# back


def test_packets_of_every_kind_become_a_frame() -> None:
    (made,) = took(
        begun(),
        packet("78 0005 6742c01ea6 0004 68ce0fc8", 1, 9),
        packet("7c 85 aabb", 2, 9),
        packet("", 3, 9),
        packet("7c 05 cc", 4, 9),
        packet("7c 45 dd", 5, 9),
        packet(SLICE, 6, 9, last=True),
    )
    assert made == (annex_b(SPS, PPS, b"\x65\xaa\xbb\xcc\xdd", SLICE), 9, 0, 0, 0.0, False)


@pytest.mark.parametrize(
    "payloads",
    [
        ["7c 05 aa"],  # a fragment without a beginning
        ["7c 85 aa"],  # a fragment without an end
        ["7c 85 aa", "7c 41 bb"],  # a fragment of another kind
        ["7c 85 aa", "7c 85 bb"],  # begun twice
        ["7c 85 aa", "419a20"],  # interrupted by another unit
        ["7c c5 aa"],  # begin and end in one fragment
        ["7c 85"],
        ["7c 98 aa", "7c 58 bb"],  # a fragment of no unit
        ["78"],
        ["78 0005 67"],
        ["78 0000"],
        ["78 0001 fc"],
        ["79 0000 0001 67"],  # STAP-B
        ["e1 00"],  # the forbidden bit
        ["60 00"],
        [""],
    ],
)
def test_impossible_unit_damages_its_frame_and_no_later_one(payloads: list[str]) -> None:
    depacketizer = begun()
    last = len(payloads)
    for number, payload in enumerate(payloads, 1):
        assert took(depacketizer, packet(payload, number, 9, number == last)) == []
    assert depacketizer.damaged == 1
    (after,) = took(depacketizer, packet(SLICE, last + 1, 12, last=True))
    assert after == (annex_b(SLICE), 12, 0, 1, 0.0, False)


def test_a_frame_without_marker_ends_with_the_next_one() -> None:
    made = took(begun(), packet(SLICE, 1, 9), packet(PPS, 2, 12), packet(SLICE, 3, 12, last=True))
    assert [one.data for one in made] == [annex_b(SLICE), annex_b(PPS, SLICE)]


def test_packet_after_a_marker_is_no_frame_of_its_own() -> None:
    depacketizer = begun()
    assert len(took(depacketizer, packet(SLICE, 1, 9, last=True))) == 1
    assert took(depacketizer, packet(SLICE, 2, 9, last=True)) == []
    (after,) = took(depacketizer, packet(SLICE, 3, 12, last=True), packet(SLICE, 4, 15))
    assert (after, depacketizer.damaged) == ((annex_b(SLICE), 12, 0, 1, 0.0, False), 1)


def wary() -> Depacketizer:
    return Depacketizer(window=8, verify_markers=True)


def test_marker_ends_frames_only_after_it_proved_reliable() -> None:
    depacketizer = wary()
    taken = [took(depacketizer, packet(KEY, number, number, True)) for number in range(6)]
    made = [[one.timestamp for one in some] for some in taken]
    assert made == [[], [0], [1, 2], [3], [4], [5]]


def test_marker_of_another_stream_has_to_prove_reliable_again() -> None:
    depacketizer = wary()
    took(depacketizer, *(packet(KEY, number, number, True) for number in range(4)))
    assert depacketizer.correct_markers == 3
    assert took(depacketizer, packet(KEY, 9, 9, True)._replace(ssrc=2)) == []
    assert depacketizer.correct_markers == 0
    took(depacketizer, packet(SLICE, 10, 9, True)._replace(ssrc=2))
    assert took(depacketizer, packet(KEY, 11, 10, True)._replace(ssrc=2))[0].data == annex_b(
        KEY, SLICE
    )


def test_a_marker_on_each_slice_ends_no_frame() -> None:
    depacketizer, made = wary(), []
    for number in range(12):
        made += took(
            depacketizer, packet(KEY if number % 3 == 0 else SLICE, number, number // 3, True)
        )
    assert [one.data for one in made] == [annex_b(KEY, SLICE, SLICE)] * 3
    assert depacketizer.damaged == 0


def test_a_marker_on_parameters_ends_no_frame_whatever_their_timestamp() -> None:
    for depacketizer in (wary(), Depacketizer(window=8)):
        made = took(depacketizer, packet(SPS, 0, 7, True), packet(PPS, 1, 8, True))
        made += took(depacketizer, packet(KEY, 2, 9, True), packet(SLICE, 3, 10, True))
        assert made[0].data == annex_b(SPS, PPS, KEY)
        assert depacketizer.damaged == 0


def test_frame_with_an_unreliable_marker_ends_after_a_time() -> None:
    depacketizer = wary()
    assert depacketizer.add_packet(packet(KEY, 0, 7, last=True), 5.0) == []
    assert (depacketizer.marked_at, depacketizer.next_of_open_frame()) == (5.0, None)
    assert depacketizer.end_marked(5.0) == []
    (made,) = depacketizer.end_marked(5.1)
    assert (made.data, depacketizer.marked_at) == (annex_b(KEY), None)
    assert depacketizer.end_marked(9.0) == []


def test_a_marker_before_a_gap_proves_nothing() -> None:
    depacketizer = wary()
    assert took(depacketizer, packet(KEY, 0, 7, True), packet(SLICE, 2, 8, True)) == []
    assert depacketizer.give_up(1.0) == []
    assert (depacketizer.lost, depacketizer.damaged) == (1, 1)


def test_a_frame_whose_beginning_may_be_missing_is_damaged() -> None:
    first = Depacketizer()
    assert took(first, packet(SLICE, 4, 9, last=True)) == []
    assert first.damaged == 1
    after_loss = begun()
    made = took(after_loss, *(packet(SLICE, 2 + one, 9 + one, last=True) for one in range(9)))
    assert [one.timestamp for one in made] == [*range(10, 18)]
    assert (made[0].lost_packets, made[0].damaged_frames) == (1, 1)
    assert all((one.lost_packets, one.damaged_frames) == (0, 0) for one in made[1:])


def test_parameters_can_only_begin_a_frame() -> None:
    depacketizer = begun()
    begins = (packet("78 0005 6742c01ea6 0004 68ce0fc8", 3, 9), packet(SLICE, 4, 9, last=True))
    assert took(depacketizer, *begins) == []
    (made,) = depacketizer.give_up(1.0)
    assert (made.data, made.lost_packets, made.damaged_frames) == (annex_b(SPS, PPS, SLICE), 2, 0)


def test_waiting_depacketizer_reports_its_first_missing_packet() -> None:
    depacketizer = begun()
    assert (depacketizer.missing_sequences(), depacketizer.waiting_since()) == ([], None)
    assert depacketizer.add_packet(packet(SLICE, 4, 12, last=True), 5.0) == []
    assert depacketizer.add_packet(packet(SLICE, 2, 9, last=True), 6.0) == []
    assert (depacketizer.missing_sequences(), depacketizer.waiting_since()) == ([1, 3], 5.0)
    assert depacketizer.give_up(5.0) == []
    assert depacketizer.add_packet(packet(SLICE, 1, 8, last=True), 7.0)[0].arrived_at == 7.0
    assert depacketizer.missing_sequences() == [3]
    assert depacketizer.give_up(5.1) == []  # frame 4: its beginning may have been in packet 3
    assert (depacketizer.lost, depacketizer.damaged) == (1, 1)
    assert depacketizer.add_packet(packet(SLICE, 3, 10, last=True), 8.0) == []
    assert depacketizer.duplicates == 1


def test_incomplete_frame_reports_its_next_packet() -> None:
    depacketizer = begun()
    assert depacketizer.next_of_open_frame() is None
    assert took(depacketizer, packet(PPS, 1, 9)) == []
    assert depacketizer.next_of_open_frame() == 2
    assert took(depacketizer, packet(SLICE, 3, 9, last=True)) == []
    assert (depacketizer.next_of_open_frame(), depacketizer.missing_sequences()) == (None, [2])
    assert len(took(depacketizer, packet(SLICE, 2, 9))) == 1
    assert depacketizer.next_of_open_frame() is None


def test_another_ssrc_is_a_new_stream() -> None:
    depacketizer = begun()
    assert took(depacketizer, packet("7c 85 aa", 1, 9)) == []
    other = [one._replace(ssrc=2) for one in (packet(SPS, 900, 9), packet(SLICE, 901, 9, True))]
    (made,) = took(depacketizer, *other)
    assert (made.data, made.starts_stream, made.damaged_frames) == (annex_b(SPS, SLICE), True, 1)
    assert depacketizer.streams == 2


def test_second_packet_confirms_a_jump_of_numbers() -> None:
    for jump in (MAX_PACKETS_AHEAD + 100, -5000):
        depacketizer = begun()
        assert took(depacketizer, packet(KEY, jump, 9, last=True)) == []
        (here,) = took(depacketizer, packet(SLICE, 1, 8, last=True))
        assert not here.starts_stream  # a single packet is a stray
        strays = [packet(KEY, jump + one, 20 + one, last=True) for one in range(3)]
        made = took(depacketizer, *strays)
        assert [(one.timestamp, one.starts_stream) for one in made] == [(21, True), (22, False)]


def test_memory_is_bounded() -> None:
    depacketizer = Depacketizer(window=8)
    part = bytes(60_000)
    made = took(depacketizer, packet(b"\x67", 0), packet(b"\x7c\x85" + part, 1))
    for number in range(400):
        made += took(depacketizer, packet(b"\x7c\x05" + part, 2 + number))
    made += took(depacketizer, packet(b"\x7c\x45" + part, 402, last=True))
    assert (made, depacketizer.damaged) == ([], 1)
    for number in range(0, 100, 2):
        took(depacketizer, packet(SLICE, 404 + number, number))
        assert len(depacketizer.missing_sequences()) <= 8


# any frames, any link

UNITS = st.builds(
    lambda kind, body: bytes((0x40 | kind,)) + bytes(1 + byte % 255 for byte in body),
    st.sampled_from([1, 6, 8]),
    st.binary(min_size=1, max_size=300),
)
FRAMES = st.lists(
    st.lists(UNITS, max_size=3).map(lambda units: [*units, SLICE]), min_size=2, max_size=20
)


@given(FRAMES, st.integers(0, 0xFFFF), st.randoms(use_true_random=False))
def test_any_frames_come_back(
    frames: list[list[bytes]], sequence: int, chance: random.Random
) -> None:
    packetizer, depacketizer = H264Packetizer(96, 1, sequence, MTU), Depacketizer(window=16)
    frames[0].insert(0, SPS)
    sent = []
    for number, one in enumerate(frames):
        made = packetizer.packets(annex_b(*one), 3000 * number)
        assert all(len(data) <= 12 + MTU for data in made)
        sent += [RtpPacket.parse(data) for data in made]
    late = sorted(range(1, len(sent)), key=lambda place: place + chance.random() * 8)
    got = took(depacketizer, sent[0], *(sent[place] for place in late))
    assert [one.data for one in got] == [annex_b(*one) for one in frames]
    assert [one.timestamp for one in got] == [3000 * number for number in range(len(frames))]
    assert (depacketizer.lost, depacketizer.damaged, depacketizer.duplicates) == (0, 0, 0)


@given(FRAMES, st.integers(0, 0xFFFF), st.randoms(use_true_random=False), st.floats(0, 0.4))
def test_only_whole_frames_come_in_order_and_losses_are_counted(
    frames: list[list[bytes]], sequence: int, chance: random.Random, loss: float
) -> None:
    packetizer, depacketizer = H264Packetizer(96, 1, sequence, MTU), Depacketizer(window=8)
    frames[0].insert(0, SPS)
    sent = [
        RtpPacket.parse(data)
        for number, one in enumerate(frames)
        for data in packetizer.packets(annex_b(*one), 3000 * number)
    ]
    ways = [place for place in range(1, len(sent)) if chance.random() >= loss]
    ways += [place for place in ways if chance.random() < 0.2]  # twice
    ways.sort(key=lambda place: place + chance.random() * 12)
    got = took(depacketizer, sent[0], *(sent[place] for place in ways))
    got += depacketizer.give_up(1.0)
    expected = {3000 * number: annex_b(*one) for number, one in enumerate(frames)}
    assert all(expected[one.timestamp] == one.data for one in got)
    stamps = [one.timestamp for one in got]
    assert stamps == sorted(set(stamps))
    arrived = {sent[0].sequence, *(sent[place].sequence for place in ways)}
    order = [one.sequence for one in sent]
    seen = order[: 1 + max(order.index(one) for one in arrived)]
    never = len(set(seen) - arrived)
    assert depacketizer.lost >= never
    assert depacketizer.lost + depacketizer.duplicates >= len(seen) - len(arrived)
    told = sum(one.lost_packets for one in got)
    assert told <= depacketizer.lost
    for before, after in itertools.pairwise(got):
        if after.timestamp - before.timestamp > 3000:
            assert after.lost_packets or after.damaged_frames


@given(st.lists(st.binary(max_size=8), max_size=30), st.randoms(use_true_random=False))
def test_any_payloads_are_accepted(payloads: list[bytes], chance: random.Random) -> None:
    depacketizer = Depacketizer(window=4)
    for payload in payloads:
        number, stamp = chance.randrange(40), chance.randrange(3)
        made = depacketizer.add_packet(packet(payload, number, stamp, chance.random() < 0.3))
        assert all(units(one.data) is not None for one in made if b"\0\0\1" not in payload)
    depacketizer.give_up(1.0)
    assert depacketizer.waiting_since() is None


# parameters


@pytest.mark.parametrize("size", [(640, 480), (322, 242), (256, 16), (1920, 1080)])
async def test_size_is_read_from_the_parameters(size: tuple[int, int]) -> None:
    async with Codecs(threads=1) as codecs:
        frame = frame_of(np.zeros(size[::-1], np.uint8), "Mono8", 1)
        data = bytes((await codecs.h264_encoder().encode(frame)).data)
        found = parameter_sets(data)
        assert found is not None
        assert picture_size(found[0]) == size
        assert size_in(data) == size
        assert size_in(b"\0\0\0\1\x09\xf0" + data) == size


def golomb(number: int) -> str:
    """ue(v)."""
    bits = f"{number + 1:b}"
    return "0" * (len(bits) - 1) + bits


def test_size_of_interlaced_pictures_and_of_a_high_profile() -> None:
    fields = f"{100:08b}{0:08b}{40:08b}"
    fields += golomb(0) + golomb(1) + golomb(0) + golomb(0) + "0"  # 4:2:0, 8 bits
    fields += "1" + "1" + golomb(16) + "0" * 7  # a list of scales that ends at once (-8)
    fields += golomb(0) + golomb(1) + "0" + golomb(0) + golomb(0) + golomb(1) + golomb(5)
    fields += golomb(4) + "0" + golomb(119) + golomb(33)
    fields += "0" + "1" + "1"  # in fields
    fields += "1" + golomb(0) + golomb(0) + golomb(0) + golomb(2) + "01"
    size = -(-len(fields) // 8)
    data = int(fields.ljust(8 * size, "0"), 2).to_bytes(size, "big")
    assert picture_size(b"\x67" + data) == (1920, 1080)


@given(st.binary(max_size=60))
def test_any_parameters_are_read_or_refused(data: bytes) -> None:
    for head in (b"\x67", b"\x67\x64\0\x28"):
        with contextlib.suppress(FrameFormatError):
            assert min(picture_size(head + data)) > 0


def test_description_has_all_fields_of_a_player() -> None:
    text = description("239.1.2.3", 5004, 97, session=8, ttl=3, sets=(SPS, PPS), name="a\r\nb")
    assert text == (
        "v=0\r\no=- 8 0 IN IP4 239.1.2.3\r\ns=a b\r\nc=IN IP4 239.1.2.3/3\r\nt=0 0\r\n"
        "m=video 5004 RTP/AVP 97\r\na=rtpmap:97 H264/90000\r\n"
        "a=fmtp:97 packetization-mode=1; profile-level-id=42c01e; "
        "sprop-parameter-sets=Z0LAHqY=,aM4PyA==\r\n"
    )
    assert "c=IN IP6 ::1\r\n" in description("::1", 5004, 96, ttl=None)
