"""Cut JPEGs from a web camera's multipart stream, each as soon as its last byte has come.

A picture's own markers give its end. Boundaries and lengths are not reliable: cameras put
boundaries before or after a part, omit them, or announce another one. A length is used if a picture
has no end marker.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import MessageError

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_PICTURE_BYTES: Final = 32 << 20

MAX_BETWEEN_BYTES: Final = 1 << 20
"""Largest number of bytes in a row outside of pictures."""

MAX_HEAD_BYTES: Final = 8 << 10
"""Number of bytes before a picture that are searched for its length."""

MAX_STRAY_BYTES: Final = 4 << 10
"""Largest number of surplus bytes between two segments of a picture's header."""

START, END = b"\xff\xd8", b"\xff\xd9"
PICTURE_START: Final = START + b"\xff"
"""First bytes of a picture, which otherwise occur only in thumbnails."""

SCAN, MIN_SEGMENT = 0xDA, 0xC0
"""Marker of a scan, and the first marker of a segment."""

BOUNDARY_BEGINS: Final = (b"\r\n", b"--", b"\n-")
"""Possible bytes after a picture."""

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
        self._searched = 0  # number of examined bytes
        self._between = 0
        self._begun = self._in_scan = self._over = False
        self._length: int | None = None  # length of the current picture from the header of its part

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Add bytes, and yield the pictures that they complete.

        Raises:
            MessageError: a picture has no end, or too many bytes lie between two.
        """
        self._data += data
        while self._begun or self._begins():
            end = self._end()
            if end is None:
                return
            self._begun = False
            if end > 0:
                picture = bytes(self._data[:end])
                del self._data[:end]
                self._between = 0
                yield picture
            else:
                self.damaged += 1
                del self._data[: max(-end, len(START))]
            self._searched = 0

    def _begins(self) -> bool:
        """Find the next picture; bytes before it are dropped."""
        place = self._data.find(START, self._searched)
        if place < 0:
            self._searched = max(0, len(self._data) - 1)
            surplus = max(0, self._searched - MAX_HEAD_BYTES)
            self._drop(surplus)
            self._searched -= surplus
            return False
        lengths = _LENGTH.findall(self._data[max(0, place - MAX_HEAD_BYTES) : place])
        self._length = int(lengths[-1]) if lengths else None
        self._drop(place)
        self._begun, self._in_scan, self._searched = True, False, len(START)
        return True

    def _drop(self, count: int) -> None:
        self._between += count
        del self._data[:count]
        if self._between > MAX_BETWEEN_BYTES:
            raise MessageError(f"{self._between} bytes came that belong to no picture")

    def _end(self) -> int | None:
        """Return the end of the picture; None: the end has not come yet.

        A negative number means that it is no picture, and that the next may begin at its magnitude.
        """
        while (after := self._segment()) is not None:
            if self._length is not None and abs(after) > self._length and self._ends_at_length():
                return self._length
            if after < 0 or self._over:
                return after
            self._searched = after
        if self._length is not None and self._ends_at_length():
            return self._length
        if len(self._data) > MAX_PICTURE_BYTES:
            raise MessageError(f"a picture: expected {MAX_PICTURE_BYTES} bytes at most, got more")
        return None

    def _ends_at_length(self) -> bool:
        """Return True if a boundary follows the picture's end by its length."""
        place = self._length or 0
        return place > len(START) and bytes(self._data[place : place + 2]) in BOUNDARY_BEGINS

    def _segment(self) -> int | None:
        """Return the end of the next segment; None: the end has not come yet; negative: no segment.

        Encoded data after the header of a scan are skipped.
        """
        data, at = self._data, self._searched
        if self._in_scan:
            match = _NEXT_MARKER.search(data, at)
            self._searched = at = match.start() if match else max(at, len(data) - 1)
            self._in_scan = match is None
            if match is None:
                return None
        while data[at : at + 2] == b"\xff\xff":
            at += 1
        if len(data) > at + 1 and (data[at] != 0xFF or not data[at + 1]):  # as some webcams send
            if data.find(PICTURE_START, len(START), at + len(PICTURE_START) - 1) >= 0:
                return -at  # a cut segment ran into another picture
            match = _NEXT_MARKER.search(data, at, at + MAX_STRAY_BYTES)
            if match is None:
                return None if len(data) < at + MAX_STRAY_BYTES else -at
            at = match.start()
        self._searched = at
        self._over = data[at : at + 2] == END
        if self._over:
            return at + 2
        if len(data) < at + 4:
            return None
        kind = data[at + 1]
        if kind in MARKERS_WITHOUT_SEGMENT:
            return at + 2
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at] != 0xFF or kind < MIN_SEGMENT or kind == 0xD8 or end < at + 4:
            return -at
        if len(data) < end:
            return None
        self._in_scan = kind == SCAN
        return end
