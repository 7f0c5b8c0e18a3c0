"""JPEGs cut from the parts of a web camera's stream, each as soon as its last byte is there.

A picture ends where its own markers say so. Boundaries and lengths are not relied on: cameras put
boundaries before or behind a part, leave them out, or say one and write another. A length helps
where a picture has no end of its own.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import MessageError

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_PICTURE_BYTES: Final = 32 << 20

MAX_BETWEEN_BYTES: Final = 1 << 20
"""Bytes in a row that belong to no picture, after which it is no stream of pictures."""

MAX_HEAD_BYTES: Final = 8 << 10
"""Largest number of bytes before a picture in which its length is looked for."""

MAX_STRAY_BYTES: Final = 4 << 10
"""Bytes between two segments of a picture's head that belong to neither."""

START, END = b"\xff\xd8", b"\xff\xd9"
BEGINS: Final = START + b"\xff"
"""Bytes that a picture begins with, and no segment but a thumbnail's has in it."""

SCAN, MIN_SEGMENT = 0xDA, 0xC0
"""Markers of a scan, and the first one that a segment can have."""

BOUNDARY_BEGINS: Final = (b"\r\n", b"--", b"\n-")
"""Bytes that follow a picture in its part."""

ALONE: Final = frozenset((0x01, *range(0xD0, 0xD8)))
"""Markers without a segment."""

_NEXT_MARKER: Final = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_LENGTH: Final = re.compile(rb"(?i)content-length[ \t]*:[ \t]*([0-9]{1,9})[ \t\r]*\n")


class PictureCutter:
    """Cuts pictures from bytes that come in any pieces.

    Attributes:
        damaged: pictures that began and are not whole, since the last whole one.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._data = bytearray()
        self._seen = 0  # bytes of what is no picture, or of a picture, that were looked at
        self._between = 0
        self._begun = self._in_scan = self._over = False
        self._length: int | None = None  # length of the current picture, by the head of its part

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Take bytes, and yield the pictures that are whole with them.

        Raises:
            MessageError: a picture without an end, or too much between two.
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
            self._seen = 0

    def _begins(self) -> bool:
        """Find the next picture; what is before it is thrown away."""
        place = self._data.find(START, self._seen)
        if place < 0:
            self._seen = max(0, len(self._data) - 1)
            surplus = max(0, self._seen - MAX_HEAD_BYTES)
            self._drop(surplus)
            self._seen -= surplus
            return False
        found = _LENGTH.findall(self._data[max(0, place - MAX_HEAD_BYTES) : place])
        self._length = int(found[-1]) if found else None
        self._drop(place)
        self._begun, self._in_scan, self._seen = True, False, len(START)
        return True

    def _drop(self, count: int) -> None:
        self._between += count
        del self._data[:count]
        if self._between > MAX_BETWEEN_BYTES:
            raise MessageError(f"{self._between} bytes came that belong to no picture")

    def _end(self) -> int | None:
        """Return the end of the picture; None: that did not come yet.

        Below 0 it is not one, and the next one may begin at that place.
        """
        while (after := self._segment()) is not None:
            if self._length is not None and abs(after) > self._length and self._ends_at_length():
                return self._length
            if after < 0 or self._over:
                return after
            self._seen = after
        if self._length is not None and self._ends_at_length():
            return self._length
        if len(self._data) > MAX_PICTURE_BYTES:
            raise MessageError(f"a picture: expected {MAX_PICTURE_BYTES} bytes at most, got more")
        return None

    def _ends_at_length(self) -> bool:
        """Return True if a boundary follows where the picture ends by its length."""
        place = self._length or 0
        return place > len(START) and bytes(self._data[place : place + 2]) in BOUNDARY_BEGINS

    def _segment(self) -> int | None:
        """Return the end of the next segment; None: that did not come yet; below 0: none is there.

        What is encoded behind the head of a scan is passed over.
        """
        data, at = self._data, self._seen
        if self._in_scan:
            found = _NEXT_MARKER.search(data, at)
            self._seen = at = found.start() if found else max(at, len(data) - 1)
            self._in_scan = found is None
            if found is None:
                return None
        while data[at : at + 2] == b"\xff\xff":
            at += 1
        if len(data) > at + 1 and (data[at] != 0xFF or not data[at + 1]):  # as some webcams send
            if data.find(BEGINS, len(START), at + len(BEGINS) - 1) >= 0:
                return -at  # a segment that was cut short went on into another picture
            found = _NEXT_MARKER.search(data, at, at + MAX_STRAY_BYTES)
            if found is None:
                return None if len(data) < at + MAX_STRAY_BYTES else -at
            at = found.start()
        self._seen = at
        self._over = data[at : at + 2] == END
        if self._over:
            return at + 2
        if len(data) < at + 4:
            return None
        kind = data[at + 1]
        if kind in ALONE:
            return at + 2
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at] != 0xFF or kind < MIN_SEGMENT or kind == 0xD8 or end < at + 4:
            return -at
        if len(data) < end:
            return None
        self._in_scan = kind == SCAN
        return end
