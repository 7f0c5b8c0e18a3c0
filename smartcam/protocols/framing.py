"""Cutting frames out of bytes, by the length field only.

A frame is a header (a magic number in some dialects, a length, a message id) and a payload. What
the header looks like is data: :class:`HeaderLayout`. A length above the limit is refused as soon as
the header is there, so no more than one header and one payload of the permitted size is ever kept.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from smartcam.exceptions import FrameError, hex_excerpt

__all__ = ["DEFAULT_MAX_LENGTH", "Frame", "Framer", "HeaderLayout"]

DEFAULT_MAX_LENGTH = 1 << 20
"""Bytes of payload accepted by default. The camera sends about 64 kB at most (HALCON script
manual, p. 35); 1 MiB leaves room for its successors and refuses a length bomb."""


class Frame(NamedTuple):
    """One frame: message id and the bytes behind the header."""

    message_id: int
    payload: bytes


@dataclass(frozen=True, kw_only=True)
class HeaderLayout:
    """The header of a dialect, as data; its integers are little endian.

    Args:
        magic: the magic number's bytes on the wire, empty for a dialect without one.
        code: ``struct`` code of length and message id: ``I`` or ``H``.
        order: which of the two comes first.
        length_includes: bytes that the length field counts beside the payload (4 where it counts
            the message id).
    """

    magic: bytes = b""
    code: Literal["I", "H"] = "I"
    order: Literal["length, id", "id, length"] = "length, id"
    length_includes: int = 0
    size: int = field(init=False)
    max_payload: int = field(init=False)
    _fields: struct.Struct = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        fields = struct.Struct("<" + 2 * self.code)
        object.__setattr__(self, "_fields", fields)
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

    def unpack(self, buffer: bytes | bytearray, offset: int) -> tuple[int, int]:
        """Return message id and payload size of the header at ``offset``.

        The payload size is negative where the length field is less than what it must count.
        The magic is not looked at.
        """
        first, second = self._fields.unpack_from(buffer, offset + len(self.magic))
        if self.order == "length, id":
            return second, first - self.length_includes
        return first, second - self.length_includes


class Framer:
    """Bytes in, frames out.

    :meth:`feed` bytes, then call :meth:`next_frame` until it returns None. After a
    :exc:`FrameError` the stream has no frame boundary any more: drop the link, or call
    :meth:`resync`, which skips to the next magic number.

    Args:
        header: what a header looks like.
        max_length: largest payload accepted, bytes.
    """

    __slots__ = ("_buffer", "_header", "_max_length", "_start")

    def __init__(self, header: HeaderLayout, max_length: int = DEFAULT_MAX_LENGTH) -> None:
        self._header = header
        self._max_length = max_length
        # While whole frames come in whole chunks the buffer is the chunk itself, uncopied.
        self._buffer: bytes | bytearray = b""
        self._start = 0

    @property
    def buffered(self) -> int:
        """Bytes kept for the next frame."""
        return len(self._buffer) - self._start

    @property
    def pending(self) -> bytes:
        """Copy of the bytes kept, for traces and error texts."""
        return bytes(self._buffer[self._start :])

    def feed(self, data: bytes | bytearray | memoryview) -> None:
        """Take bytes; call :meth:`next_frame` next."""
        if not self.buffered:
            self._buffer, self._start = bytes(data), 0
            return
        if not isinstance(self._buffer, bytearray):
            self._buffer = bytearray(self._buffer)
        del self._buffer[: self._start]  # cut at the front: moves a pointer, not the bytes
        self._start = 0
        self._buffer += data

    def next_frame(self) -> Frame | None:
        """Return the next whole frame, or None for "more bytes".

        Raises:
            FrameError: wrong magic, or a length that is impossible or above the limit. Nothing is
                consumed.
        """
        start, header = self._start, self._header
        available = len(self._buffer) - start
        if available < header.size:
            self._check_magic(start, available)
            return None
        self._check_magic(start, available)
        message_id, size = header.unpack(self._buffer, start)
        if size < 0 or size > self._max_length:
            raise FrameError(
                f"a frame of message {message_id:#04x} announces {size} bytes of payload; "
                f"0 to {self._max_length} are accepted",
                offset=len(header.magic),
                data=self._buffer[start : start + header.size],
            )
        end = start + header.size + size
        if len(self._buffer) < end:
            return None
        self._start = end
        return Frame(message_id, bytes(self._buffer[start + header.size : end]))

    def resync(self) -> int:
        """Skip to the next magic number behind the present place; return the bytes skipped.

        Without one in the buffer, only the bytes that may begin one are kept. A dialect without a
        magic number has no such place: everything is dropped.
        """
        magic = self._header.magic
        begin = self._start
        found = self._buffer.find(magic, begin + 1) if magic else -1
        if found < 0:
            keep = min(len(magic) - 1, max(self.buffered - 1, 0)) if magic else 0
            while keep and not magic.startswith(self._buffer[-keep:]):
                keep -= 1
            found = len(self._buffer) - keep
        self._start = found
        return found - begin

    def clear(self) -> None:
        """Drop everything kept."""
        self._buffer, self._start = b"", 0

    def _check_magic(self, start: int, available: int) -> None:
        magic = self._header.magic
        if not magic:
            return
        seen = self._buffer[start : start + min(available, len(magic))]
        if not magic.startswith(seen):
            raise FrameError(
                f"wrong magic number: {hex_excerpt(seen)} came, {magic.hex(' ')} was expected",
                data=self._buffer[start : start + 64],
            )
