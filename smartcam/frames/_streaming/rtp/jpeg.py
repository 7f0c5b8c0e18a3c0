"""Assemble JPEGs from RTP packets (RFC 2435)."""

from __future__ import annotations

import struct
from typing import Final

from smartcam.frames._streaming.rtp.assembling import OpenUnit

HEAD_BYTES: Final = 8
"""Number of bytes of the JPEG header in each packet, before its piece of the picture."""

RESTARTS: Final = range(64, 128)
"""Types of pictures with restart markers."""

MAX_QUANTIZATION_TABLES: Final = 64
"""Largest number of remembered sets of quantization tables, one for each quality."""

_LUMA: Final = (
    "16 11 12 14 12 10 16 14 13 14 18 17 16 19 24 40 26 24 22 22 24 49 35 37 29 40 58 51 61 60 57 "
    "51 56 55 64 72 92 78 64 68 87 69 55 56 80 109 81 87 95 98 103 104 103 62 77 113 121 112 100 "
    "120 92 101 103 99"
)
_CHROMA: Final = (
    "17 18 18 24 21 24 47 26 26 47 99 66 56 66 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 "
    "99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 "
    "99 99"
)
"""Quantization tables of quality 50 in zigzag order (ITU-T T.81, annex K.1)."""

_HUFFMAN: Final = tuple(
    (table_id, bytes.fromhex(counts), bytes.fromhex(values))
    for table_id, counts, values in (
        (0x00, "00010501010101010100000000000000", "000102030405060708090a0b"),
        (
            0x10,
            "0002010303020403050504040000017d",
            "01020300041105122131410613516107227114328191a1082342b1c11552d1f02433627282090a161718191a"
            "25262728292a3435363738393a434445464748494a535455565758595a636465666768696a73747576777879"
            "7a838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9"
            "cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa",
        ),
        (0x01, "00030101010101010101010000000000", "000102030405060708090a0b"),
        (
            0x11,
            "00020102040403040705040400010277",
            "0001020311040521310612415107617113223281081442 91a1b1c109233352f0156272d10a162434e1"
            "25f11718191a262728292a35363738393a434445464748494a535455565758595a636465666768696a737475767778"
            "797a82838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7"
            "c8c9cad2d3d4d5d6d7d8d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa",
        ),
    )
)
"""Huffman tables of all JPEGs over RTP (annex K.3): class and id, counts, values."""


class JpegPayloadFormat:
    """The RTP payload format of JPEG; it remembers tables that a sender sends only once.

    Args:
        size: width and height of pictures with a side above 2040 pixels, which do not fit into the
            packets' header; None: the header has the size.
    """

    def __init__(self, size: tuple[int, int] | None = None) -> None:
        self.size = size
        self.tables: dict[int, tuple[bytes, ...]] = {}

    def new_unit(self, timestamp: int, has_first_packet: bool, arrived_at: float) -> JpegAccessUnit:
        """Return a new picture."""
        return JpegAccessUnit(self, timestamp, has_first_packet, arrived_at)

    @staticmethod
    def certainly_starts_frame(payload: bytes) -> bool:
        """Return True if a packet has the first piece of a picture."""
        return len(payload) > HEAD_BYTES and payload[1:4] == b"\0\0\0"


class JpegAccessUnit(OpenUnit):
    """One picture."""

    def __init__(
        self,
        payload_format: JpegPayloadFormat,
        timestamp: int,
        has_first_packet: bool,
        arrived_at: float,
    ) -> None:
        super().__init__(timestamp, has_first_packet, arrived_at)
        self._payload_format = payload_format
        self._next_offset = 0  # offset of the next piece in the picture

    def data(self) -> bytes:
        """Return the picture as a file."""
        end = b"" if self.parts[-1].endswith(b"\xff\xd9") else b"\xff\xd9"
        return b"".join((*self.parts, end))

    def _add_payload(self, payload: bytes) -> bool:
        if len(payload) <= HEAD_BYTES or int.from_bytes(payload[1:4], "big") != self._next_offset:
            return False
        offset = HEAD_BYTES
        restart_interval = b""
        if payload[4] in RESTARTS:
            restart_interval, offset = payload[offset : offset + 2], offset + 4
        if not self._next_offset:
            found = self._read_tables(payload, offset)
            if found is None or payload[4] & 0x3F > 1 or payload[0] not in (0, 3):
                return False
            offset, tables = found
            self.parts.append(self._jpeg_header(payload, tables, restart_interval))
        piece = payload[offset:]
        self._next_offset += len(piece)
        self.parts.append(piece)
        self.has_picture = True
        return bool(piece)

    def _read_tables(self, payload: bytes, offset: int) -> tuple[int, tuple[bytes, ...]] | None:
        """Return the offset after the tables, and the tables; None: the tables are unknown."""
        quality = payload[5]
        if quality < 128:
            return (offset, scaled_tables(quality)) if 1 <= quality < 100 else None
        if len(payload) < offset + 4:
            return None
        _, wide_bits, length = struct.unpack_from("!BBH", payload, offset)
        offset += 4
        if not length:
            remembered = self._payload_format.tables.get(quality)
            return None if remembered is None else (offset, remembered)
        tables = split_tables(payload[offset : offset + length], wide_bits)
        if len(tables) < 1 or offset + length > len(payload):
            return None
        if quality < 255 and len(self._payload_format.tables) < MAX_QUANTIZATION_TABLES:
            self._payload_format.tables[quality] = tables
        return offset + length, tables

    def _jpeg_header(
        self, payload: bytes, tables: tuple[bytes, ...], restart_interval: bytes
    ) -> bytes:
        width, height = payload[6] * 8, payload[7] * 8
        if self._payload_format.size is not None and not (width and height):
            width, height = self._payload_format.size
        parts = [b"\xff\xd8"]
        for number, table in enumerate(tables[:2]):
            is_wide = len(table) > 64
            parts.append(_segment(0xDB, bytes((is_wide << 4 | number,)) + table))
        if any(restart_interval):
            parts.append(_segment(0xDD, restart_interval))
        sampling = 0x22 if payload[4] & 1 else 0x21
        chroma = min(1, len(tables) - 1)
        frame = struct.pack("!BHHB", 8, height, width, 3)
        parts.append(_segment(0xC0, frame + bytes((1, sampling, 0, 2, 17, chroma, 3, 17, chroma))))
        for table_id, counts, values in _HUFFMAN:
            parts.append(_segment(0xC4, bytes((table_id,)) + counts + values))
        parts.append(_segment(0xDA, bytes((3, 1, 0, 2, 0x11, 3, 0x11, 0, 63, 0))))
        return b"".join(parts)


def scaled_tables(quality: int) -> tuple[bytes, ...]:
    """Return the quantization tables of a quality from 1 to 99."""
    factor = 5000 // quality if quality < 50 else 200 - 2 * quality
    return tuple(
        bytes(min(255, max(1, (int(number) * factor + 50) // 100)) for number in table.split())
        for table in (_LUMA, _CHROMA)
    )


def split_tables(data: bytes, wide_bits: int) -> tuple[bytes, ...]:
    """Return the tables in ``data``: each has 64 bytes, or 128 if its bit in ``wide_bits`` is set.

    The result is empty if a table is cut off.
    """
    tables: list[bytes] = []
    while data and len(tables) < 4:
        size = 128 if wide_bits >> len(tables) & 1 else 64
        if len(data) < size:
            return ()
        tables.append(data[:size])
        data = data[size:]
    return tuple(tables)


def size_in(picture: bytes) -> tuple[int, int] | None:
    """Return the size from the header of an assembled picture."""
    offset = picture.find(b"\xff\xc0\0\x11\x08")
    if offset < 0 or len(picture) < offset + 9:
        return None
    height, width = struct.unpack_from("!HH", picture, offset + 5)
    return (width, height) if width and height else None


def _segment(kind: int, data: bytes) -> bytes:
    return bytes((0xFF, kind)) + (len(data) + 2).to_bytes(2, "big") + data
