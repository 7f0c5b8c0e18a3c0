"""Target ``framing``: any bytes in any chunks, against a plain model of what frames are in them.

Input: header, limit, kind of buffer, number of chunk sizes, the sizes, then the stream. The last
kind is a transport that writes into the framer's own buffer. Buffers are small, so that an input
fills them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from smartcam.exceptions import FrameError
from smartcam.protocols import Frame, HeaderLayout, Machine
from smartcam.protocols._inside import Framer
from tests.fuzz.fuzz_input import Choices
from tests.machines import DIALECTS
from tests.protocols.frame_times import small_reads

HEADERS = (
    *(dialect.header for dialect in DIALECTS),
    # a magic number that overlaps itself, and a length that counts the header
    HeaderLayout(magic=b"\x50\x50\x53", code="H", order="id, length", length_includes=7),
)
KINDS = (bytes, bytearray, memoryview, None)
MAX_READ = 128


def check(data: bytes) -> None:
    """Cut a stream into frames by chunks and compare with what :func:`expected` finds in it."""
    with small_reads(FIRST_READ_BYTES=16, MAX_READ_BYTES=MAX_READ):
        check_framer(data)


def check_framer(data: bytes) -> None:
    """As :func:`check`."""
    choices = Choices(data)
    header, limit, kind = choices.pick(HEADERS), choices.byte(), choices.pick(KINDS)
    sizes = choices.take(choices.byte() % 8)
    stream = choices.rest()
    frames, rest = expected(header, limit, stream)

    framer = Framer(header, limit)
    found: list[Frame] = []
    fed = done = 0
    left = iter(chunks(stream, sizes))
    chunk = next(left, b"")
    while chunk:
        count = len(chunk)
        if kind is None:
            count = write(framer, chunk)
            assert len(framer.get_buffer()) <= max(MAX_READ, header.size + limit)
        else:
            framer.feed(kind(chunk))
        fed += count
        chunk = chunk[count:] or next(left, b"")
        while True:
            try:
                frame = framer.next_frame()
            except FrameError as error:
                before = stream[done:fed]
                assert framer.unfinished_bytes == before, "a FrameError consumed something"
                assert 0 <= error.offset < header.size
                assert error.data == before[: len(error.data)]
                assert len(error.data) <= 64
                if not header.magic:  # no place to go on from: a client drops the link
                    assert found == frames
                    return
                skipped = framer.resync()
                assert skipped > 0
                done += skipped
                continue
            if frame is None:
                break
            found.append(frame)
            done += header.size + len(frame.payload)
        assert framer.buffered == fed - done
        assert framer.buffered < header.size + max(limit, 1), "more is kept than one frame"
    assert found == frames
    assert framer.unfinished_bytes == rest
    for frame in found:
        again = Framer(header, limit)
        again.feed(header.pack(frame.message_id, len(frame.payload)) + frame.payload)
        assert again.next_frame() == frame


def write(taker: Framer | Machine, data: bytes) -> int:
    """Read as a transport does, over junk; return how many bytes there was room for."""
    room = taker.get_buffer()
    count = min(len(room), len(data))
    room[:] = b"\xee" * len(room)
    room[:count] = data[:count]
    taker.buffer_updated(count)
    return count


def chunks(stream: bytes, sizes: Sequence[int]) -> Iterator[bytes]:
    """Cut ``stream`` into chunks of these sizes, over and over; whole where there are none."""
    if not any(sizes):
        yield stream
        return
    at = turn = 0
    while at < len(stream):
        size = sizes[turn % len(sizes)]
        if size:
            yield stream[at : at + size]
        at, turn = at + size, turn + 1


def expected(header: HeaderLayout, limit: int, stream: bytes) -> tuple[list[Frame], bytes]:
    """Return the frames of a whole stream and the bytes behind them, by plain search."""
    frames: list[Frame] = []
    magic, width = header.magic, (header.size - len(header.magic)) // 2
    at = 0
    while True:
        left = stream[at:]
        good = magic.startswith(left[: len(magic)])
        if good and len(left) < header.size:
            return frames, left
        if good:
            first, second = (
                int.from_bytes(left[len(magic) + i * width :][:width], "little") for i in (0, 1)
            )
            length, message_id = (
                (first, second) if header.order == "length, id" else (second, first)
            )
            end = header.size + length - header.length_includes
            good = header.size <= end <= header.size + limit
            if good and len(left) < end:
                return frames, left
            if good:
                frames.append(Frame(message_id, left[header.size : end]))
                at += end
                continue
        if not magic:
            return frames, left
        places = range(at + 1, len(stream) + 1)
        at = next(at for at in places if magic.startswith(stream[at : at + len(magic)]))
