"""Cut JPEGs from a web camera's multipart stream, each as soon as its last byte has come.

The markers in a JPEG show where it ends. Boundaries and lengths are not reliable: cameras put a
boundary before or after a part, omit it, or announce another boundary. A length is used if a
picture has no end marker.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import MessageError

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_PICTURE_BYTES: Final = 32 << 20

MAX_BYTES_BETWEEN: Final = 1 << 20
"""Largest number of consecutive bytes outside of pictures."""

MAX_HEAD_BYTES: Final = 8 << 10
"""Number of bytes before a picture that are searched for its length."""

MAX_STRAY_BYTES: Final = 4 << 10
"""Largest number of surplus bytes between two segments of a picture's header."""

START, END = b"\xff\xd8", b"\xff\xd9"
PICTURE_START: Final = START + b"\xff"
"""First bytes of a picture, which otherwise occur only in thumbnails."""

SCAN, MIN_SEGMENT = 0xDA, 0xC0
"""Marker of a scan, and the first marker of a segment."""

AFTER_PICTURE: Final = (b"\r\n", b"--", b"\n-")
"""First two bytes of a boundary, which may follow a picture."""

MARKERS_WITHOUT_SEGMENT: Final = frozenset((0x01, *range(0xD0, 0xD8)))
"""Markers without a segment."""

_NEXT_MARKER: Final = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_LENGTH: Final = re.compile(rb"(?i)content-length[ \t]*:[ \t]*([0-9]{1,9})[ \t\r]*\n")


class PictureCutter:
    """Cut pictures from a stream of bytes.

    Attributes:
        damaged: number of incomplete pictures since the last complete one.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._data = bytearray()
        self._searched_bytes = 0  # number of bytes that were examined
        self._bytes_between = 0
        self._has_start = self._in_scan = self._at_end_marker = False
        self._length: int | None = None  # length of the current picture from the header of its part

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Add bytes, and yield the pictures that they complete.

        Raises:
            MessageError: a picture has no end, or too many bytes lie between two.
        """
        self._data += data
        while self._has_start or self._find_start():
            end = self._find_end()
            if end is None:
                return
            self._has_start = False
            if end > 0:
                picture = bytes(self._data[:end])
                del self._data[:end]
                self._bytes_between = 0
                yield picture
            else:
                self.damaged += 1
                del self._data[: max(-end, len(START))]
            self._searched_bytes = 0

    def _find_start(self) -> bool:
        """Find the next picture, and drop the bytes before it; return False if none has come."""
        start = self._data.find(START, self._searched_bytes)
        if start < 0:
            self._searched_bytes = max(0, len(self._data) - 1)
            surplus = max(0, self._searched_bytes - MAX_HEAD_BYTES)
            self._drop(surplus)
            self._searched_bytes -= surplus
            return False
        lengths = _LENGTH.findall(self._data[max(0, start - MAX_HEAD_BYTES) : start])
        self._length = int(lengths[-1]) if lengths else None
        self._drop(start)
        self._has_start, self._in_scan, self._searched_bytes = True, False, len(START)
        return True

    def _drop(self, count: int) -> None:
        self._bytes_between += count
        del self._data[:count]
        if self._bytes_between > MAX_BYTES_BETWEEN:
            raise MessageError(f"{self._bytes_between} bytes came that belong to no picture")

    def _find_end(self) -> int | None:
        """Return the end of the picture; None: the end has not come yet.

        A negative result means that this is no picture; its absolute value is where the next
        picture may begin.
        """
        while (end := self._next_segment_end()) is not None:
            if self._length is not None and abs(end) > self._length and self._ends_at_length():
                return self._length
            if end < 0 or self._at_end_marker:
                return end
            self._searched_bytes = end
        if self._length is not None and self._ends_at_length():
            return self._length
        if len(self._data) > MAX_PICTURE_BYTES:
            raise MessageError(f"a picture: expected {MAX_PICTURE_BYTES} bytes at most, got more")
        return None

    def _ends_at_length(self) -> bool:
        """Return True if a boundary follows the picture's end by its length."""
        end = self._length or 0
        return end > len(START) and bytes(self._data[end : end + 2]) in AFTER_PICTURE

    def _next_segment_end(self) -> int | None:
        """Return the end of the next segment; None: the end has not come yet.

        A negative result means that there is no segment at its absolute value. Encoded data after
        the header of a scan are skipped.
        """
        data, offset = self._data, self._searched_bytes
        if self._in_scan:
            match = _NEXT_MARKER.search(data, offset)
            self._searched_bytes = offset = match.start() if match else max(offset, len(data) - 1)
            self._in_scan = match is None
            if match is None:
                return None
        while data[offset : offset + 2] == b"\xff\xff":
            offset += 1
        if len(data) > offset + 1 and (
            data[offset] != 0xFF or not data[offset + 1]
        ):  # some webcams send stray bytes between segments
            if data.find(PICTURE_START, len(START), offset + len(PICTURE_START) - 1) >= 0:
                return -offset  # a cut segment ran into another picture
            match = _NEXT_MARKER.search(data, offset, offset + MAX_STRAY_BYTES)
            if match is None:
                return None if len(data) < offset + MAX_STRAY_BYTES else -offset
            offset = match.start()
        self._searched_bytes = offset
        self._at_end_marker = data[offset : offset + 2] == END
        if self._at_end_marker:
            return offset + 2
        if len(data) < offset + 4:
            return None
        marker = data[offset + 1]
        if marker in MARKERS_WITHOUT_SEGMENT:
            return offset + 2
        end = offset + 2 + int.from_bytes(data[offset + 2 : offset + 4], "big")
        if data[offset] != 0xFF or marker < MIN_SEGMENT or marker == 0xD8 or end < offset + 4:
            return -offset
        if len(data) < end:
            return None
        self._in_scan = marker == SCAN
        return end
