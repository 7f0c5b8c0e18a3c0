"""Target ``framing``: any bytes in any chunks, against a plain model of what frames are in them.

Input: header, limit, kind of buffer, number of chunk sizes, the sizes, then the stream.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fuzz_input import Choices
from machines import DIALECTS

from smartcam.exceptions import FrameError
from smartcam.protocols.framing import Frame, Framer, HeaderLayout

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

__all__ = ["HEADERS", "check"]

HEADERS = (
    *(dialect.header for dialect in DIALECTS),
    # a magic number that overlaps itself, and a length that counts the header
    HeaderLayout(magic=b"\x50\x50\x53", code="H", order="id, length", length_includes=7),
)
KINDS = (bytes, bytearray, memoryview)


def check(data: bytes) -> None:
    """Cut a stream into frames by chunks and compare with what :func:`expected` finds in it."""
    choices = Choices(data)
    header, limit, kind = choices.pick(HEADERS), choices.byte(), choices.pick(KINDS)
    sizes = choices.take(choices.byte() % 8)
    stream = choices.rest()
    frames, rest = expected(header, limit, stream)

    framer = Framer(header, limit)
    found: list[Frame] = []
    fed = done = 0
    for chunk in chunks(stream, sizes):
        framer.feed(kind(chunk))
        fed += len(chunk)
        while True:
            try:
                frame = framer.next_frame()
            except FrameError as error:
                before = stream[done:fed]
                assert framer.pending == before, "a FrameError consumed something"
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
    assert framer.pending == rest
    for frame in found:
        again = Framer(header, limit)
        again.feed(header.pack(frame.message_id, len(frame.payload)) + frame.payload)
        assert again.next_frame() == frame


def chunks(stream: bytes, sizes: Sequence[int]) -> Iterator[bytes]:
    """Cut ``stream`` into chunks of these sizes, over and over; whole where there are none."""
    if not any(sizes):
        yield stream
        return
    at = turn = 0
    while at < len(stream):
        size = sizes[turn % len(sizes)]
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
