"""Frames out of bytes, by the length field only."""

from __future__ import annotations

import struct
from collections.abc import Callable

import pytest

from smartcam.exceptions import FrameError
from smartcam.protocols import Frame, FramedDialect, HeaderLayout
from smartcam.protocols._inside import DEFAULT_MAX_LENGTH, HANDBOOK, Framer
from tests.machines import B16, BID, DIALECTS, THESIS

MAGIC = bytes.fromhex("50535642")
STATUS = bytes.fromhex("50535642 08000000 12000000 80020000 00000000")
STATUS_FRAME = Frame(0x12, bytes.fromhex("8002000000000000"))
QUERY = bytes.fromhex("50535642 00000000 30000000")
SEGMENT = 1460

# the quirks have the headers of their dialects
each_dialect = pytest.mark.parametrize(
    "dialect", [one for one in DIALECTS if not one.quirks], ids=lambda one: one.name
)


def header(length: int, message_id: int = 0x20) -> bytes:
    return MAGIC + struct.pack("<II", length, message_id)


def fed(*chunks: bytes, max_length: int = DEFAULT_MAX_LENGTH) -> Framer:
    framer = Framer(HANDBOOK.header, max_length)
    for chunk in chunks:
        framer.feed(chunk)
    return framer


def unpacked(layout: HeaderLayout, buffer: bytes, offset: int) -> tuple[int, int]:
    """Message id and payload size of the header at ``offset``."""
    magic, first, second = layout.reader()(buffer, offset)
    assert magic == layout.magic
    message_id, length = (first, second) if layout.id_first else (second, first)
    return message_id, length - layout.length_includes


# ---------------------------------------------------------------------- the header as data


@pytest.mark.parametrize(
    ("dialect", "size", "max_payload", "packed"),
    [
        (HANDBOOK, 12, 0xFFFFFFFF, "50535642 05000000 20000000"),
        (THESIS, 12, 0xFFFFFFFB, "42565350 09000000 20000000"),
        (B16, 4, 0xFFFF, "2000 0500"),
        (BID, 4, 0xFFFF, "2000 0500"),
    ],
    ids=["handbook", "thesis", "b16", "bid"],
)
def test_header_layout_is_packed_and_read_as_documented(
    dialect: FramedDialect, size: int, max_payload: int, packed: str
) -> None:
    layout, data = dialect.header, bytes.fromhex(packed)
    assert (layout.size, layout.max_payload) == (size, max_payload)
    assert layout.pack(0x20, 5) == data
    assert unpacked(layout, b"before" + data, 6) == (0x20, 5)


def test_header_layout_without_arguments_is_length_first_without_magic() -> None:
    layout = HeaderLayout()
    assert layout.pack(1, 2) == struct.pack("<II", 2, 1)
    assert layout == HeaderLayout(magic=b"", code="I", order="length, id")


@each_dialect
def test_header_layout_largest_payload_fits_and_one_more_does_not(dialect: FramedDialect) -> None:
    layout = dialect.header
    header = layout.pack(1, layout.max_payload)
    assert unpacked(layout, header, 0) == (1, layout.max_payload)
    with pytest.raises(struct.error):
        layout.pack(1, layout.max_payload + 1)


def test_header_layout_length_below_what_it_must_count_is_negative() -> None:
    header = bytes.fromhex("42565350 03000000 01000000")
    assert unpacked(THESIS.header, header, 0) == (1, -1)


# ---------------------------------------------------------------------- whole frames


def test_framer_one_frame_gives_it_and_keeps_nothing() -> None:
    framer = fed(STATUS)
    assert framer.next_frame() == STATUS_FRAME
    assert framer.next_frame() is None
    assert (framer.buffered, framer.unfinished_bytes) == (0, b"")


def test_framer_trailing_bytes_belong_to_the_next_frame() -> None:
    framer = fed(STATUS + QUERY[:7])
    assert framer.next_frame() == STATUS_FRAME
    assert framer.next_frame() is None
    assert framer.unfinished_bytes == QUERY[:7]
    framer.feed(QUERY[7:])
    assert framer.next_frame() == Frame(0x30, b"")


def test_framer_many_frames_in_one_chunk_come_in_order_without_a_copy() -> None:
    chunk = (STATUS + QUERY) * 50
    framer = fed(chunk)
    frames = iter(framer.next_frame, None)
    assert list(frames) == [STATUS_FRAME, Frame(0x30, b"")] * 50
    assert framer.buffer is chunk


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_framer_any_buffer_kind_is_taken_and_may_change_later(
    kind: type[bytes | bytearray | memoryview],
) -> None:
    framer = Framer(HANDBOOK.header)
    source = bytearray(STATUS)
    framer.feed(kind(source[:15]))
    framer.feed(kind(source[15:]))
    source[:] = bytes(len(source))
    frame = framer.next_frame()
    assert frame == STATUS_FRAME
    assert type(frame.payload) is bytes


def test_framer_bytearray_changed_after_feed_does_not_change_the_frame() -> None:
    source = bytearray(STATUS)
    framer = Framer(HANDBOOK.header)
    framer.feed(source)
    source[12] = 0xEE
    assert framer.next_frame() == STATUS_FRAME


@each_dialect
def test_framer_frame_cut_at_every_length_waits_for_the_rest(dialect: FramedDialect) -> None:
    data = dialect.encode_frame(Frame(0x20, b"0123456789"))
    for cut in range(len(data)):
        framer = Framer(dialect.header)
        framer.feed(data[:cut])
        assert framer.next_frame() is None, cut
        assert framer.buffered == cut
        framer.feed(data[cut:])
        assert framer.next_frame() == Frame(0x20, b"0123456789"), cut


def test_framer_header_split_five_and_seven_is_one_header() -> None:
    framer = fed(STATUS[:5])
    assert framer.next_frame() is None
    framer.feed(STATUS[5:12])
    assert framer.next_frame() is None
    framer.feed(STATUS[12:])
    assert framer.next_frame() == STATUS_FRAME


@each_dialect
def test_framer_magic_inside_a_payload_is_payload_wherever_segments_end(
    dialect: FramedDialect,
) -> None:
    payload = b"<" + 3 * (MAGIC + bytes.fromhex("42565350")) + b">"
    data = dialect.encode_frame(Frame(0x20, payload))
    for cut in range(len(data)):
        framer = Framer(dialect.header)
        framer.feed(data[:cut])
        assert framer.next_frame() is None
        framer.feed(data[cut:] + data)
        assert framer.next_frame() == Frame(0x20, payload), cut
        assert framer.next_frame() == Frame(0x20, payload), cut


def test_framer_clear_drops_everything() -> None:
    framer = fed(STATUS[:15])
    framer.clear()
    assert framer.buffered == 0
    framer.feed(QUERY)
    assert framer.next_frame() == Frame(0x30, b"")


# ---------------------------------------------------------------------- limits


@pytest.mark.parametrize("length", [0xFFFFFFFF, DEFAULT_MAX_LENGTH + 1])
def test_framer_length_above_the_limit_is_refused_with_the_header(length: int) -> None:
    framer = fed(header(length)[:11])
    assert framer.next_frame() is None
    framer.feed(header(length)[11:])
    with pytest.raises(FrameError) as caught:
        framer.next_frame()
    assert str(caught.value) == (
        f"a frame of message 0x20 announces {length} bytes of payload; "
        f"0 to {DEFAULT_MAX_LENGTH} are accepted"
    )
    assert (caught.value.offset, caught.value.data) == (4, header(length))
    assert framer.buffered == 12


def test_framer_length_exactly_the_limit_is_accepted() -> None:
    payload = bytes(range(100))
    framer = fed(header(100) + payload, max_length=100)
    assert framer.next_frame() == Frame(0x20, payload)


def test_framer_length_less_than_the_id_it_counts_is_refused() -> None:
    framer = Framer(THESIS.header)
    framer.feed(bytes.fromhex("42565350 03000000 01000000"))
    with pytest.raises(FrameError, match=r"announces -1 bytes of payload"):
        framer.next_frame()


def test_framer_five_megabytes_in_segments_are_collected_in_place() -> None:
    payload = bytes(range(256)) * 20_000
    data = header(len(payload)) + payload
    framer = fed(data[:SEGMENT], max_length=len(payload))
    assert framer.next_frame() is None
    framer.feed(data[SEGMENT : 2 * SEGMENT])
    large = framer._large
    assert large is not None
    assert len(large) == len(data)
    for start in range(2 * SEGMENT, len(data), SEGMENT):
        assert framer.next_frame() is None
        framer.feed(data[start : start + SEGMENT])
    assert framer.buffer == large
    assert framer.next_frame() == Frame(0x20, payload)
    assert framer.buffered == 0


# ---------------------------------------------------------------------- wrong magic, and after it


@pytest.mark.parametrize("size", [1, 3, 4, 11, 12, 20, 100])
def test_framer_wrong_magic_is_reported_at_once_even_on_part_of_a_header(size: int) -> None:
    data = b"GET / HTTP/1.1\r\n".ljust(100, b"x")[:size]
    framer = fed(data)
    with pytest.raises(FrameError) as caught:
        framer.next_frame()
    assert str(caught.value) == (
        f"wrong magic number: {data[:4].hex(' ')} came, 50 53 56 42 was expected"
    )
    assert (caught.value.offset, caught.value.data) == (0, data[:64])
    assert framer.buffered == size


def test_framer_wrong_last_byte_of_a_magic_is_reported_with_that_byte() -> None:
    framer = fed(MAGIC[:3])
    assert framer.next_frame() is None
    framer.feed(b"\x43")
    with pytest.raises(FrameError, match="50 53 56 43 came"):
        framer.next_frame()


def test_framer_without_magic_looks_at_lengths_only() -> None:
    framer = Framer(B16.header, max_length=16)
    framer.feed(bytes.fromhex("01000000 20001100"))
    assert framer.next_frame() == Frame(1, b"")
    with pytest.raises(FrameError, match="announces 17 bytes") as caught:
        framer.next_frame()
    assert caught.value.offset == 0


@pytest.mark.parametrize(
    ("data", "skipped", "left"),
    [
        (b"noise" + STATUS, 5, STATUS),
        (b"x" + STATUS, 1, STATUS),
        (b"noise" + MAGIC[:3], 5, MAGIC[:3]),
        (b"noise" + MAGIC[:1], 5, MAGIC[:1]),
        (b"PSVxPSV", 4, b"PSV"),
        (b"noise", 5, b""),
        (b"x", 1, b""),
        (b"P", 1, b""),
        (MAGIC + STATUS, 4, STATUS),
        (b"", 0, b""),
    ],
)
def test_resync_skips_to_what_may_begin_a_frame(data: bytes, skipped: int, left: bytes) -> None:
    framer = fed(data)
    assert framer.resync() == skipped
    assert framer.unfinished_bytes == left
    assert framer.buffered == len(left)


def test_resync_after_a_taken_frame_keeps_its_place() -> None:
    framer = fed(STATUS + b"??" + QUERY)
    assert framer.next_frame() == STATUS_FRAME
    with pytest.raises(FrameError):
        framer.next_frame()
    assert framer.resync() == 2
    assert framer.next_frame() == Frame(0x30, b"")


@pytest.mark.parametrize("data", [b"", b"\xff" * 9])
def test_resync_without_magic_drops_everything(data: bytes) -> None:
    framer = Framer(B16.header, max_length=4)
    framer.feed(data)
    assert framer.resync() == len(data)
    assert framer.buffered == 0


# ---------------------------------------------------------------------- frames in a row


def followers(framer: Framer, dialect: FramedDialect, size: int) -> tuple[list[bytes], bytes]:
    """Return what :meth:`Framer.following` gives behind the first frame, and the rest."""
    found = framer.cut()
    assert found is not None
    like = found[1] - dialect.header.size
    return framer.following(dialect.header.reader(size), like, size), framer.unfinished_bytes


def frame_of(dialect: FramedDialect, payload: bytes, message_id: int = 0x20) -> bytes:
    return dialect.header.pack(message_id, len(payload)) + payload


@pytest.mark.sampled(every=4)
@each_dialect
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 32, 40])
@pytest.mark.parametrize(
    "then",
    [
        lambda dialect: b"",
        lambda dialect: frame_of(dialect, b"\1\2\3\4 another id", 0x12),
        lambda dialect: frame_of(dialect, b"\1\2\3\5 number of another"),
        lambda dialect: frame_of(dialect, b"\1\2\3\4 result")[:-1],
        lambda dialect: frame_of(dialect, b"\1\2\3\4 result")[:3],
    ],
    ids=["nothing", "another id", "another beginning", "a part", "a part of a header"],
)
def test_following_takes_those_that_begin_alike_and_no_more(
    dialect: FramedDialect, count: int, then: Callable[[FramedDialect], bytes]
) -> None:
    payloads = [b"\1\2\3\4 result %3d" % number for number in range(count + 1)]
    behind = then(dialect)
    framer = Framer(dialect.header)
    framer.feed(b"".join(frame_of(dialect, one) for one in payloads) + behind)
    assert followers(framer, dialect, 4) == ([one[4:] for one in payloads[1:]], behind)


def test_following_takes_frames_of_other_lengths_and_goes_on_after_them() -> None:
    lengths = [5] * 20 + [9] + [5] * 33 + [4, 100] + [5] * 16
    payloads = [b"\1\2\3\4" + bytes(length - 4) for length in lengths]
    framer = fed(b"".join(header(len(one)) + one for one in payloads))
    found, left = followers(framer, HANDBOOK, 4)
    assert (found, left) == ([one[4:] for one in payloads[1:]], b"")


def test_following_is_not_misled_by_headers_within_payloads() -> None:
    one = b"\1\2\3\4" + 3 * (header(52) + b"\1\2\3\4")
    assert len(one) == 52
    framer = fed((header(52) + one) * 40)
    assert followers(framer, HANDBOOK, 4) == ([one[4:]] * 39, b"")


def test_following_stops_where_the_length_is_above_the_limit() -> None:
    framer = fed((header(8) + bytes(8)) * 20 + (header(9) + bytes(9)) * 20, max_length=8)
    found, left = followers(framer, HANDBOOK, 4)
    assert (found, len(left)) == ([bytes(4)] * 19, 20 * 21)
