"""Write MCAP: chunks of messages compressed by zstd, their indexes, and the summary at the end.

The bytes are those of the mcap library's ``Writer`` for the same calls, in a fifth of its time per
message, which is most of the cost of a small message.
"""

from __future__ import annotations

import struct
import zlib
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

MAGIC = b"\x89MCAP0\r\n"

_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX = range(0x01, 0x08)
_CHUNK_INDEX, _STATISTICS, _METADATA, _METADATA_INDEX = 0x08, 0x0B, 0x0C, 0x0D
_ATTACHMENT_INDEX, _SUMMARY_OFFSET, _DATA_END = 0x0A, 0x0E, 0x0F

_HEAD = struct.Struct("<BQ")  # opcode, length of the record's content
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_pack_head, _MESSAGE_BEGINS = _MESSAGE_HEAD.pack, _MESSAGE_HEAD.size
_MESSAGE_FIELDS = _MESSAGE_HEAD.size - _HEAD.size
_CHUNK_FIELDS = struct.Struct("<QQQI")
_COUNT = struct.Struct("<HQ")
_OFFSET = struct.Struct("<BQQ")

_ZSTD = "zstd"


class McapWriter:
    """Writes a file from its beginning to its end, in one thread.

    After an error nothing more may be written: the file could not be read.

    Args:
        stream: the file, open.
        compress: function that compresses a chunk, such as ``zstandard.compress``.
        chunk_size: number of bytes at which a chunk is ended.
    """

    def __init__(
        self, stream: IO[bytes], compress: Callable[[bytes], bytes], chunk_size: int
    ) -> None:
        self._stream = stream
        self._compress = compress
        self._chunk_size = chunk_size
        self._parts: list[bytes] = []  # parts of the chunk that is being filled
        self._packs = True  # whether the chunk will be compressed
        self._size = 0  # number of bytes of the parts
        # times and offsets in the chunk by channel, alternating
        self._places: dict[int, list[int]] = {}
        self._first = self._last = 0  # first and last time of its messages
        self._counts: dict[int, int] = {}  # number of messages of each channel
        self._began = self._ended = 0  # first and last time of all messages
        self._chunks = 0
        # records to repeat at the end
        self._schema_records: list[bytes] = []
        self._channel_records: list[bytes] = []
        self._chunk_indexes: list[bytes] = []
        self._metadata_indexes: list[bytes] = []

    def start(self, profile: str, library: str) -> None:
        """Write the beginning of the file."""
        self._stream.write(MAGIC + _record(_HEADER, _text(profile), _text(library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Write a schema; return its number."""
        number = len(self._schema_records) + 1
        size = len(data).to_bytes(4, "little")
        named = number.to_bytes(2, "little"), _text(name), _text(encoding)
        self._schema_records.append(_record(_SCHEMA, *named, size, data))
        self._put(self._schema_records[-1])
        return number

    def register_channel(
        self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]
    ) -> int:
        """Write a channel; return its number."""
        number = len(self._channel_records) + 1
        numbers = struct.pack("<HH", number, schema)
        record = _record(_CHANNEL, numbers, _text(topic), _text(encoding), _map(metadata))
        self._channel_records.append(record)
        self._put(record)
        return number

    def add_message(
        self, channel: int, at: int, data: bytes, sequence: int, *, packs: bool = True
    ) -> None:
        """Write a message.

        Args:
            channel: number of the channel.
            at: time of the message, nanoseconds since 1970, UTC.
            data: bytes of the message.
            sequence: the channel's own count.
            packs: whether the message should be compressed; a chunk with a message that should not
                be is written uncompressed.
        """
        if not packs:
            self._packs = False
        places = self._places.get(channel)
        if places is None:
            if not self._places:
                self._first = self._last = at
            places = self._places[channel] = []
        if at < self._first:
            self._first = at
        elif at > self._last:
            self._last = at
        size, before = len(data), self._size
        head = _pack_head(_MESSAGE, _MESSAGE_FIELDS + size, channel, sequence, at, at)
        places += (at, before)
        self._parts += (head, data)
        self._size = before = before + _MESSAGE_BEGINS + size
        if before > self._chunk_size:
            self.end_chunk()

    def add_metadata(self, name: str, facts: Mapping[str, str]) -> None:
        """Write facts under a name, before the chunk that is being filled."""
        record = _record(_METADATA, _text(name), _map(facts))
        place = struct.pack("<QQ", self._stream.tell(), len(record))
        self._metadata_indexes.append(_record(_METADATA_INDEX, place, _text(name)))
        self._stream.write(record)

    def flush(self) -> None:
        """End the chunk if it has a message, and pass everything to the system."""
        self.end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write the index and the end of the file."""
        self.end_chunk()
        self._stream.write(_record(_DATA_END, bytes(4)))
        start = place = self._stream.tell()
        parts: list[bytes] = []
        offsets: list[bytes] = []
        for kind, records in (
            (_SCHEMA, self._schema_records),
            (_CHANNEL, self._channel_records),
            (_STATISTICS, [self._statistics()]),
            (_CHUNK_INDEX, self._chunk_indexes),
            (_ATTACHMENT_INDEX, []),
            (_METADATA_INDEX, self._metadata_indexes),
        ):
            size = sum(map(len, records))
            offsets.append(_record(_SUMMARY_OFFSET, _OFFSET.pack(kind, place, size)))
            parts += records
            place += size
        summary = b"".join((*parts, *offsets))
        footer = _HEAD.pack(_FOOTER, 20) + struct.pack("<QQ", start, place)
        crc = zlib.crc32(footer, zlib.crc32(summary))
        self._stream.write(b"".join((summary, footer, crc.to_bytes(4, "little"), MAGIC)))

    # ------------------------------------------------------------------ inside

    def _put(self, record: bytes) -> None:
        self._parts.append(record)
        self._size += len(record)
        if self._size > self._chunk_size:
            self.end_chunk()

    def end_chunk(self) -> None:
        """Write the chunk, unless it has no messages."""
        if not self._places:
            return
        data = b"".join(self._parts)
        packed, how = (self._compress(data), _ZSTD) if self._packs else (data, "")
        times = self._first, self._last
        chunk = (
            _CHUNK_FIELDS.pack(*times, len(data), zlib.crc32(data)),
            _text(how),
            len(packed).to_bytes(8, "little"),
        )
        start, length = self._stream.tell(), sum(map(len, chunk)) + len(packed) + _HEAD.size
        place = start + length
        indexes: list[bytes] = []
        places: list[bytes] = []
        for channel, places_of_channel in self._places.items():
            indexes.append(_index_record(channel, places_of_channel))
            places.append(_COUNT.pack(channel, place))
            place += len(indexes[-1])
            self._counts[channel] = self._counts.get(channel, 0) + len(places_of_channel) // 2
        self._stream.write(_HEAD.pack(_CHUNK, length - _HEAD.size) + b"".join(chunk))
        self._stream.write(packed)
        self._stream.write(b"".join(indexes))
        self._chunk_indexes.append(
            _record(
                _CHUNK_INDEX,
                struct.pack("<QQQQI", *times, start, length, _COUNT.size * len(places)),
                *places,
                (place - start - length).to_bytes(8, "little"),
                _text(how),
                struct.pack("<QQ", len(packed), len(data)),
            )
        )
        self._began = min(self._began, self._first) if self._chunks else self._first
        self._ended = max(self._ended, self._last)
        self._chunks += 1
        self._parts, self._size, self._places = [], 0, {}
        self._packs = True

    def _statistics(self) -> bytes:
        counts = self._counts
        totals = (
            *(sum(counts.values()), len(self._schema_records), len(self._channel_records)),
            *(0, len(self._metadata_indexes), self._chunks),  # no attachments
        )
        return _record(
            _STATISTICS,
            struct.pack("<QHIIII", *totals),
            struct.pack("<QQI", self._began, self._ended, _COUNT.size * len(counts)),
            *(_COUNT.pack(channel, count) for channel, count in counts.items()),
        )


def _record(opcode: int, *parts: bytes) -> bytes:
    return b"".join((_HEAD.pack(opcode, sum(map(len, parts))), *parts))


def _text(text: str) -> bytes:
    data = text.encode()
    return len(data).to_bytes(4, "little") + data


def _map(texts: Mapping[str, str]) -> bytes:
    data = b"".join(_text(name) + _text(text) for name, text in texts.items())
    return len(data).to_bytes(4, "little") + data


def _index_record(channel: int, places: list[int]) -> bytes:
    data = struct.pack(f"<{len(places)}Q", *places)
    return _record(_MESSAGE_INDEX, struct.pack("<HI", channel, len(data)), data)
