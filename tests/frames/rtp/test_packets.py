"""RTP and RTCP against bytes written by hand from the layouts in RFC 3550 and RFC 4585."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import MessageError
from tests.frames.inside import packets

PLAIN = bytes.fromhex("80 e0 fffe 00015f90 deadbeef 0102")
PACKET = packets.RtpPacket(True, 96, 0xFFFE, 90000, 0xDEADBEEF, b"\1\2")

BLOCK = "00000007 40 fffffd 00010002 00000005 11112222 00008000"
A_BLOCK = packets.ReportBlock(7, 64, -3, 0x10002, 5, 0x11112222, 0x8000)

GOLDEN: list[tuple[str, packets.Report]] = [
    (
        f"81 c8 000c 00000001 83aa7e80 80000000 00015f90 00000003 00000fa0 {BLOCK}",
        packets.SenderReport(1, 0x83AA7E80_80000000, 90000, 3, 4000, (A_BLOCK,)),
    ),
    (f"81 c9 0007 00000002 {BLOCK}", packets.ReceiverReport(2, (A_BLOCK,))),
    ("80 c9 0001 00000002", packets.ReceiverReport(2)),
    ("81 ca 0003 00000002 01 03 612e62 000000", packets.SourceDescription(2, "a.b")),
    ("81 ca 0002 00000002 01 01 61 00", packets.SourceDescription(2, "a")),
    ("82 cb 0003 00000001 00000002 02 6f6b 00", packets.Goodbye((1, 2), "ok")),
    ("81 cb 0001 00000001", packets.Goodbye((1,))),
    ("81 cd 0003 00000002 00000001 fffe 8005", packets.PacketsMissing(2, 1, (65534, 65535, 1, 14))),
    ("81 ce 0002 00000002 00000001", packets.PictureLost(2, 1)),
]


def test_packet_is_what_the_layout_says() -> None:
    assert PACKET.pack() == PLAIN
    assert packets.RtpPacket.parse(PLAIN) == PACKET
    assert packets.RtpPacket.parse(memoryview(PLAIN)) == PACKET


@pytest.mark.parametrize(
    "data",
    [
        "82 e0 fffe 00015f90 deadbeef 0000000a 0000000b 0102",  # two contributing sources
        "90 e0 fffe 00015f90 deadbeef bede0001 aabbccdd 0102",  # an extension of one word
        "90 e0 fffe 00015f90 deadbeef bede0000 0102",  # and an empty one
        "a0 e0 fffe 00015f90 deadbeef 0102 000003",  # padding
        "b1 e0 fffe 00015f90 deadbeef 0000000a bede0001 aabbccdd 0102 01",  # all of it
    ],
)
def test_what_stands_around_the_payload_is_taken_off(data: str) -> None:
    assert packets.RtpPacket.parse(bytes.fromhex(data)) == PACKET


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ("80 e0 fffe 00015f90 deadbe", "expected 12 bytes or more, got 11"),
        ("40 e0 fffe 00015f90 deadbeef 0102", "expected version 2, got 1"),
        ("82 e0 fffe 00015f90 deadbeef 0000000a", "expected 20 bytes or more, got 16"),
        ("90 e0 fffe 00015f90 deadbeef bede", "extension: expected 16 bytes"),
        ("90 e0 fffe 00015f90 deadbeef bede0002 aabbccdd", "expected 24 bytes or more, got 20"),
        ("a0 e0 fffe 00015f90 deadbeef 0102 00", "expected 1 to 3 bytes, got 0"),
        ("a0 e0 fffe 00015f90 deadbeef 0102 04", "expected 1 to 3 bytes, got 4"),
    ],
)
def test_what_is_no_packet_is_told(data: str, said: str) -> None:
    with pytest.raises(MessageError, match=said):
        packets.RtpPacket.parse(bytes.fromhex(data))


@pytest.mark.parametrize(("data", "report"), GOLDEN)
def test_report_is_what_the_layout_says(data: str, report: packets.Report) -> None:
    assert report.pack() == bytes.fromhex(data)
    assert packets.parse_rtcp(bytes.fromhex(data)) == [report]
    assert packets.is_rtcp(bytes.fromhex(data))
    assert not packets.is_rtcp(PLAIN)


def test_compound_is_read_in_order_and_unknown_kinds_are_left_out() -> None:
    reports = [report for _, report in GOLDEN]
    other = bytes.fromhex("80 cc 0002 00000001 41424344")  # APP
    other += bytes.fromhex("8f cd 0002 00000001 00000002")  # feedback of another kind
    unnamed = bytes.fromhex("81 ca 0003 00000002 06 03 612e62 000000")  # SDES TOOL
    assert packets.parse_rtcp(other + packets.compound(*reports) + unnamed) == reports


def test_padding_of_the_last_report_is_taken_off() -> None:
    padded = "a1 cb 0002 00000001 00000004"
    assert packets.parse_rtcp(bytes.fromhex("80 c9 0001 00000002" + padded)) == [
        packets.ReceiverReport(2),
        packets.Goodbye((1,)),
    ]
    for wrong in (padded + "80 c9 0001 00000002", padded[:-1] + "3", padded[:-1] + "c"):
        with pytest.raises(MessageError, match="padding"):
            packets.parse_rtcp(bytes.fromhex(wrong))


@pytest.mark.parametrize(
    "data",
    [
        "",
        "80 c9 00",
        "40 c9 0001 00000002",
        "80 60 0001 00000002",
        "80 c9 0002 00000002",  # longer than the datagram
        "80 c9 0000",  # no SSRC
        "82 c9 0007 00000002" + BLOCK,  # two blocks said, one there
        "81 c8 0006 00000001 83aa7e80 80000000 00015f90 00000003 00000fa0",
        "81 ca 0002 00000002 01 09 61 00",
        "81 ca 0002 00000002 01 02 61 62",  # no end of the list
        "82 cb 0001 00000001",
        "81 cb 0002 00000001 09 6f6b 00",
        "81 cd 0002 00000002 0000",
        "81 ce 0001 00000002",
    ],
)
def test_report_that_does_not_fit_is_told(data: str) -> None:
    with pytest.raises(MessageError):
        packets.parse_rtcp(bytes.fromhex(data))


@given(st.lists(st.integers(0, 0xFFFF), max_size=60, unique=True))
def test_all_that_is_missing_is_asked_for_and_nothing_else(sequences: list[int]) -> None:
    (found,) = packets.parse_rtcp(packets.PacketsMissing(1, 2, tuple(sequences)).pack())
    assert isinstance(found, packets.PacketsMissing)
    assert sorted(found.sequences) == sorted(sequences)


@given(st.binary(max_size=80))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    for head in (b"", b"\x81\xc8\x00\x06", b"\x81\xca\x00\x03", b"\x82\xcb\x00\x02", b"\xbf"):
        for read in (packets.RtpPacket.parse, packets.parse_rtcp):
            with contextlib.suppress(MessageError):
                assert read(head + data) is not None


def test_a_loss_beyond_its_field_is_held_within() -> None:
    for lost, kept in ((1 << 30, (1 << 23) - 1), (-(1 << 30), -(1 << 23))):
        assert packets.ReportBlock.parse(packets.ReportBlock(1, 0, lost, 0, 0).pack()).lost == kept


def test_too_many_sources_are_refused() -> None:
    with pytest.raises(ValueError, match="31"):
        packets.Goodbye(tuple(range(32))).pack()
