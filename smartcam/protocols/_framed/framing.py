"""Cut received bytes into frames, by the length field only.

A frame is a header (a magic number in some dialects, a length, a message id) and a payload. The
form of the header is data: :class:`HeaderLayout`. A length above the general limit, or above
the limit of its message, is refused as soon as the header is received, so no more than one header
and one payload of the permitted size is ever kept.

Frames are found in a received chunk by offset; a large chunk is not copied. A large unfinished
frame has its own buffer, into which the transport may write.
"""

from __future__ import annotations

import functools
import struct
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from smartcam.exceptions import FrameError, hex_excerpt
from smartcam.protocols._machine import Frame

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

DEFAULT_MAX_LENGTH = 1 << 20
"""Largest number of bytes of payload accepted by default. The camera sends about 64 kB (HALCON
script manual, p. 35); 1 MiB leaves room for its successors and refuses a length bomb."""


MIN_OWN_BUFFER_BYTES = 1 << 12
"""Least number of bytes of a frame that gets its own buffer while it is unfinished. The bytes of a
smaller frame are copied in front of the next chunk, which costs less."""

Buffer: TypeAlias = bytes | memoryview
Read: TypeAlias = "Callable[[Buffer, int], tuple[Any, ...]]"
"""Function that reads fields at an offset of a buffer."""


FIRST_READ_BYTES = 1 << 12
"""Bytes of the first buffer for reads. The buffer doubles after each read that filled it."""

MAX_READ_BYTES = 1 << 15
"""Largest number of bytes of a read, except while a large frame is received. This many bytes of
results fit into a subscriber's queue if each result has at least 16 bytes, so a subscriber that
keeps up loses nothing."""


MIN_READ_BYTES = 1 << 10
"""Least number of bytes to which the size of reads is reduced while frames are many and small."""


FRAMES_PER_CUT = 16
"""Number of frames that are cut together if they begin with the same bytes, length included."""


@dataclass(frozen=True, kw_only=True)
class HeaderLayout:
    """The header of a dialect, as data; its integers are little endian.

    Args:
        magic: the magic number's bytes on the wire, empty for a dialect without one.
        code: ``struct`` code of length and message id: ``I`` or ``H``.
        order: order of length and message id on the wire.
        length_includes: number of bytes that the length field counts in addition to the payload: 4
            if it counts the message id.
    """

    magic: bytes = b""
    code: Literal["I", "H"] = "I"
    order: Literal["length, id", "id, length"] = "length, id"
    length_includes: int = 0
    size: int = field(init=False)
    max_payload: int = field(init=False)
    id_first: bool = field(init=False, repr=False)
    _fields: struct.Struct = field(init=False, repr=False, compare=False)
    _readers: dict[int, Read] = field(
        init=False, repr=False, compare=False, default_factory=dict[int, "Read"]
    )

    def __post_init__(self) -> None:
        fields = struct.Struct("<" + 2 * self.code)
        object.__setattr__(self, "_fields", fields)
        object.__setattr__(self, "id_first", self.order == "id, length")
        object.__setattr__(self, "size", len(self.magic) + fields.size)
        largest = (1 << (4 * fields.size)) - 1
        object.__setattr__(self, "max_payload", largest - self.length_includes)

    def pack(self, message_id: int, payload_size: int) -> bytes:
        """Return the header of a frame.

        Raises:
            struct.error: a number does not fit its field.
        """
        length = payload_size + self.length_includes
        if self.order == "length, id":
            return self.magic + self._fields.pack(length, message_id)
        return self.magic + self._fields.pack(message_id, length)

    def reader(self, more: int = 0) -> Read:
        """Return a reader of headers: magic, the two numbers, and ``more`` bytes after them."""
        reader = self._readers.get(more)
        if reader is None:
            extra_bytes = f"{more}s" if more else ""
            form = struct.Struct(f"<{len(self.magic)}s{2 * self.code}{extra_bytes}")
            reader = self._readers[more] = form.unpack_from
        return reader


class Lengths:
    """The lengths that the payloads of one sender's messages may have.

    Args:
        by_id: lengths of a message's payload, by its id.

    Attributes:
        always_allowed: the smallest of the messages' upper bounds: up to it, none is too long.
    """

    def __init__(self, by_id: Mapping[int, range]) -> None:
        self.by_id = by_id
        self.always_allowed: int = min(
            (length.stop - 1 for length in by_id.values()), default=sys.maxsize
        )


class Framer:
    """Cuts received bytes into frames.

    :meth:`feed` bytes, then call :meth:`cut` or :meth:`next_frame` until it returns None. After a
    :exc:`FrameError` the stream has no frame boundary any more: drop the link, or call
    :meth:`resync`, which skips to the next magic number.

    Args:
        header: form of the headers.
        max_length: largest payload accepted, bytes.
    """

    __slots__ = (
        *("buffer", "start", "_always_allowed", "_filled", "_header", "_large", "_lengths"),
        *("_max_length", "_max_read", "_read", "_store", "_read_buffer"),
    )

    def __init__(self, header: HeaderLayout, max_length: int = DEFAULT_MAX_LENGTH) -> None:
        self._header = header
        self._max_length = max_length
        self._lengths: Mapping[int, range] = {}
        self._always_allowed = max_length  # length that any message may have
        self._read = header.reader()
        # a received chunk, or one large frame; cut() returns offsets in it
        self.buffer: Buffer = b""
        self.start: int = 0  # offset of the next frame
        self._large: memoryview | None = None  # buffer for the whole of an unfinished large frame
        self._filled = 0
        # buffer into which a transport writes; a large frame stays there
        self._store = memoryview(b"")
        self._read_buffer = self._store  # part of it for the next read
        self._max_read = MAX_READ_BYTES  # largest size of a read

    def limit_lengths(self, lengths: Lengths) -> None:
        """Refuse a payload that is longer than its message allows, even if it is below the limit.

        Messages that are not in ``lengths`` may have any length up to ``max_length``.
        """
        self._lengths = lengths.by_id
        self._always_allowed = min(self._max_length, lengths.always_allowed)

    @property
    def buffered(self) -> int:
        """Number of bytes kept for the next frame."""
        return self._filled if self._large is not None else len(self.buffer) - self.start

    @property
    def unfinished_bytes(self) -> bytes:
        """Copy of the bytes kept, for traces and error texts."""
        if self._large is not None:
            return bytes(self._large[: self._filled])
        return bytes(self.buffer[self.start :])

    def feed(self, data: bytes | bytearray | memoryview) -> None:
        """Add received bytes; call :meth:`cut` or :meth:`next_frame` until it returns None."""
        large = self._large
        if large is None:
            buffer, start = self.buffer, self.start
            unread = bytes(buffer[start:]) if start < len(buffer) else b""
            self.buffer, self.start = unread + data if unread else bytes(data), 0
            return
        filled_size, missing = self._filled, len(large) - self._filled
        if len(data) <= missing:
            large[filled_size : filled_size + len(data)] = data
            self._count_large_bytes(len(data))
            return
        self.buffer, self.start, self._large = b"".join((large[:filled_size], data)), 0, None

    def get_buffer(self) -> memoryview:
        """Return the buffer for a transport's next bytes; call :meth:`buffer_updated` next.

        It is the remaining part of a large frame, or a buffer that grows whenever it is full: so
        an idle camera has a small buffer, and a fast camera needs few reads.
        """
        if self._large is not None:
            return self._large[self._filled :]
        if not self._store:
            self._read_buffer = self._store = memoryview(bytearray(FIRST_READ_BYTES))
        return self._read_buffer

    def buffer_updated(self, count: int) -> bool:
        """Accept ``count`` bytes that were written into :meth:`get_buffer`, like :meth:`feed`.

        Returns False if a large frame is unfinished, so that there is nothing to cut yet.
        """
        if self._large is not None:
            self._count_large_bytes(count)
            return self._large is None
        data = self._read_buffer[:count]
        if count < len(self._read_buffer):
            self._max_read = MAX_READ_BYTES
        elif count < self._max_read:
            self._read_buffer = self._store = memoryview(bytearray(min(2 * count, MAX_READ_BYTES)))
        if self.start < len(self.buffer):
            self.feed(data)
        elif count >= MIN_OWN_BUFFER_BYTES and self._header_at(data, 0)[1] >= MIN_OWN_BUFFER_BYTES:
            # not copied: the frame is cut before the next bytes come
            self.buffer, self.start = data, 0
            self._read_buffer = self._store
        else:
            self.buffer, self.start = bytes(data), 0
            if len(self._read_buffer) > MAX_READ_BYTES:
                self._read_buffer = self._store[:MAX_READ_BYTES]
        return True

    def halve_reads(self) -> None:
        """Halve the size of reads: the last read had too many frames for one turn of the loop.

        The size grows again when a read does not fill the buffer.
        """
        self._max_read = max(MIN_READ_BYTES, min(len(self._read_buffer), MAX_READ_BYTES) // 2)
        self._read_buffer = self._store[: self._max_read]

    def cut(self) -> tuple[int, int, int] | None:
        """Return id, and offsets of the payload's begin and end, of the next whole frame, or None.

        :meth:`take` returns the bytes between these offsets, before the next :meth:`feed`. Raises
        FrameError: wrong magic, or a length that is impossible or above the limit; no bytes are
        consumed.
        """
        if self._large is not None:
            return None
        header, buffer, start = self._header, self.buffer, self.start
        available = len(buffer) - start
        if available < header.size:
            if available:
                self._check_magic(start, available)
            self._copy_view(start)
            return None
        magic, message_id, length = self._read(buffer, start)
        if magic != header.magic:
            self._check_magic(start, available)
        if not header.id_first:
            message_id, length = length, message_id
        size = length - header.length_includes
        if not 0 <= size <= self._always_allowed:
            self._check_length(message_id, size)
        begin = start + header.size
        end = begin + size
        if end > len(buffer):
            if header.size + size >= MIN_OWN_BUFFER_BYTES:
                self._start_large_frame(header.size + size)
            else:
                self._copy_view(start)
            return None
        self.start = end
        return message_id, begin, end

    def take(self, begin: int, end: int) -> bytes:
        """Return the bytes between two offsets from :meth:`cut`."""
        return bytes(self.buffer[begin:end])

    def following(self, read: Read, model_start: int, size: int) -> list[bytes]:
        """Cut the next whole frames that are like the frame that begins at ``model_start``.

        They must have the same id and the same first ``size`` bytes of payload; the remaining bytes
        of each payload are returned. The first frame that differs, or is wrong, ends the list.
        ``read``: function that reads a header and ``size`` more bytes.
        """
        header, buffer, start = self._header, self.buffer, self.start
        payloads: list[bytes] = []
        available, id_first, header_size = len(buffer), header.id_first, header.size
        least, last = header_size + size, available - header_size - size
        if start > last or isinstance(buffer, memoryview):
            return payloads
        magic, wanted_id, wanted_length, first = read(buffer, model_start)
        if not id_first:
            wanted_id, wanted_length = wanted_length, wanted_id
        length_to_size = header_size - header.length_includes
        longest = self._max_length + header.length_includes
        length = length_to_size + wanted_length
        if (
            start + FRAMES_PER_CUT * length <= available
            and length >= least
            and wanted_length <= longest
        ):
            head, end = (
                buffer[model_start : model_start + least],
                start + (FRAMES_PER_CUT - 1) * length,
            )
            if buffer[start : start + least] == head == buffer[end : end + least]:
                start = _cut_alike(buffer, start, head, length, payloads)
        while start <= last:
            next_magic, message_id, length, next_first = read(buffer, start)
            if not id_first:
                message_id, length = length, message_id
            end = start + length_to_size + length
            if (
                message_id != wanted_id
                or next_first != first
                or next_magic != magic
                or length > longest
                or end > available
                or end < start + least
            ):
                break
            payloads.append(buffer[start + least : end])
            start = end
        self.start = start
        return payloads

    def unfinished(self) -> tuple[int, int] | None:
        """Return message id and size, header included, of the frame that is partly received.

        None if its header is incomplete. Call it when :meth:`cut` has returned None.
        """
        buffer, start = (self.buffer, self.start) if self._large is None else (self._large, 0)
        if self.buffered < self._header.size:
            return None
        message_id, size = self._header_at(buffer, start)
        return message_id, self._header.size + size

    def header_within(self, begin: int) -> int | None:
        """Return the offset of another header in the unfinished frame; None if there is none.

        A header has the magic number, an expected message id and a length allowed for it. Without a
        magic number none is found. ``begin``: offset in the frame at which the search begins.
        """
        header = self._header
        buffer, start = (self.buffer, self.start) if self._large is None else (self._large, 0)
        begin = max(begin, header.size)
        data = bytes(buffer[start + begin : start + self.buffered])
        offset = data.find(header.magic) if header.magic else -1
        while 0 <= offset <= len(data) - header.size:
            message_id, size = self._header_at(data, offset)
            if size in self._lengths.get(message_id, ()) and size <= self._max_length:
                return begin + offset
            offset = data.find(header.magic, offset + 1)
        return None

    def next_frame(self) -> Frame | None:
        """Return the next whole frame, None if there is none yet; raise as :meth:`cut`."""
        frame = self.cut()
        if frame is None:
            return None
        message_id, begin, end = frame
        return Frame(message_id, self.take(begin, end))

    def resync(self) -> int:
        """Skip to the magic number after the present one; return the number of skipped bytes.

        If there is none in the buffer, only bytes that may be its beginning are kept. A dialect
        without a magic number drops everything.
        """
        magic = self._header.magic
        if self._large is not None:
            self.buffer, self.start, self._large = self.unfinished_bytes, 0, None
        self._copy_view(self.start)  # otherwise each search would copy the view
        begin = self.start
        begin_of_next = bytes(self.buffer).find(magic, begin + 1) if magic else -1
        if begin_of_next < 0:
            kept = min(len(magic) - 1, max(self.buffered - 1, 0)) if magic else 0
            while kept and not magic.startswith(bytes(self.buffer[-kept:])):
                kept -= 1
            begin_of_next = len(self.buffer) - kept
        self.start = begin_of_next
        return begin_of_next - begin

    def clear(self) -> None:
        """Drop all bytes that are kept."""
        self.buffer, self.start, self._large = b"", 0, None

    def _count_large_bytes(self, count: int) -> None:
        """Count received bytes of a large frame, and finish it if it is complete."""
        self._filled += count
        large = self._large
        if large is not None and self._filled == len(large):
            self.buffer, self.start, self._large = large, 0, None

    def _header_at(self, buffer: Buffer, offset: int) -> tuple[int, int]:
        """Return message id and payload size from the header at an offset."""
        _, message_id, length = self._read(buffer, offset)
        if not self._header.id_first:
            message_id, length = length, message_id
        return message_id, length - self._header.length_includes

    def _copy_view(self, start: int) -> None:
        """Copy the remaining part of a chunk if the chunk is a view."""
        if isinstance(self.buffer, memoryview):
            self.buffer, self.start = bytes(self.buffer[start:]), 0

    def _start_large_frame(self, size: int) -> None:
        """Collect a large frame of ``size`` bytes in the transport's buffer from now on."""
        first_bytes = self.buffer[self.start :]
        in_place = isinstance(first_bytes, memoryview) and first_bytes.obj is self._store.obj
        if len(self._store) < size:
            self._read_buffer = self._store = memoryview(bytearray(size))
            in_place = False
        if not in_place or self.start:
            self._store[: len(first_bytes)] = first_bytes
        self._large, self._filled = self._store[:size], len(first_bytes)
        self.buffer, self.start = b"", 0

    def _check_length(self, message_id: int, size: int) -> None:
        longest = self._max_length
        if message_id in self._lengths:
            longest = min(longest, self._lengths[message_id].stop - 1)
        if not 0 <= size <= longest:
            header, start = self._header, self.start
            raise FrameError(
                f"a frame of message {message_id:#04x} announces {size} bytes of payload; "
                f"0 to {longest} are accepted",
                offset=len(header.magic),
                data=bytes(self.buffer[start : start + header.size]),
            )

    def _check_magic(self, start: int, available: int) -> None:
        magic = self._header.magic
        if not magic:
            return
        begin = bytes(self.buffer[start : start + min(available, len(magic))])
        if not magic.startswith(begin):
            raise FrameError(
                f"wrong magic number: {hex_excerpt(begin)} came, {magic.hex(' ')} was expected",
                data=bytes(self.buffer[start : start + 64]),
            )


def _cut_alike(buffer: bytes, start: int, head: bytes, length: int, pieces: list[bytes]) -> int:
    """Cut frames of ``length`` bytes that begin with ``head``, which includes that length.

    Sixteen frames are cut together, or none of them if one differs, since it may have another
    length. The bytes after the heads are added to ``pieces``.

    Returns:
        The offset of the next frame.
    """
    cut = _cutter(FRAMES_PER_CUT, len(head), length - len(head))
    last = len(buffer) - FRAMES_PER_CUT * length
    while start <= last:
        parts = cut(buffer, start)
        if parts[::2].count(head) < FRAMES_PER_CUT:
            break
        pieces += parts[1::2]
        start += FRAMES_PER_CUT * length
    return start


@functools.lru_cache(maxsize=64)
def _cutter(count: int, head: int, body: int) -> Read:
    """Return a function that unpacks ``count`` frames into alternating headers and bodies."""
    return struct.Struct(f"{head}s{body}s" * count).unpack_from
