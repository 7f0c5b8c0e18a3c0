"""Read the records of an MCAP file within bounds, since any length in a file may be wrong.

Chunks are inflated piece by piece within a bound, lengths are compared with the available bytes,
and indexes and attachments are skipped. If a file says how many messages it has, the number must
be right: damage can make a chunk look like a record that is skipped.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING, Any, NamedTuple, TypeAlias

from smartcam.exceptions import RecordingError
from smartcam.recording._mcap.form import MAX_MESSAGE_BYTES, load_extra

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

MAX_RECORD_BYTES = 1 << 28
"""Largest number of bytes of one record of a file. smartcam's records have about 1 MiB; a damaged
length may be any number."""

MAX_CHUNK_BYTES = MAX_MESSAGE_BYTES + (1 << 21)
"""Largest number of bytes to which a chunk may unpack. A recorder ends its chunk after 1 MiB, so
the largest chunk has 1 MiB and one more message. 2 kB of zstd can unpack to as much as this."""

MAX_METADATA_BYTES = 1 << 20
"""Largest number of bytes of a record of metadata or statistics; smartcam's have 2 kB."""

RECORD_ALLOWANCE = 10_000
"""Number of records that a file of any size may have; a larger file may have as many as it has
bytes. A recorder indexes each message with 16 bytes after its chunk, and a chunk of 1 MiB has fewer
records."""

UNPACKED_BYTES_ALLOWANCE = 1 << 29
"""Number of bytes to which the chunks of a file of any size may unpack: seconds of work."""

UNPACKED_PER_BYTE = 10_000
"""Number of bytes to which a larger file may unpack for each byte of the file. Containers of zeros
reach 6,000; a decompression bomb reaches 30,000."""

PIECE_BYTES = 1 << 18
"""Number of bytes that are read or inflated at once."""

MAGIC = b"\x89MCAP0\r\n"

_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x03, 0x04, 0x05, 0x06
_STATISTICS, _METADATA, _DATA_END, _FOOTER = 0x0B, 0x0C, 0x0F, 0x02
_NONE = 0x00

_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")


class CutOffError(Exception):
    """The file ends before its last record."""


class Schema(NamedTuple):
    """A schema of messages."""

    id: int
    name: str


class Channel(NamedTuple):
    """A channel, with the id of its messages' schema."""

    id: int
    schema_id: int


class McapMessage(NamedTuple):
    """A message with its channel and its number in the channel; ``data`` is a view of the chunk."""

    channel_id: int
    sequence: int
    data: memoryview


class Metadata(NamedTuple):
    """A metadata record: texts by their keys, under a name."""

    name: str
    texts: dict[str, str]


Record: TypeAlias = Schema | Channel | McapMessage | Metadata


@dataclass(eq=False)
class RecordReader:
    """Reads a file from its beginning to its end, once."""

    _stream: IO[bytes]  # stream at the beginning of the file
    _name: object  # name of the file, for errors

    def __post_init__(self) -> None:
        self.offset: int = 0  # number of bytes read so far
        self._record_count = 0  # records read
        self._message_count = 0  # messages read
        self._unpacked_bytes = 0  # unpacked bytes of chunks, and bytes of results from frames
        self._crc = 0

    def records(self) -> Iterator[Record]:
        """Yield the records that a recording needs, in the order of the file.

        Raises:
            CutOffError: the file ends before its last record.
            RecordingError: the file exceeds a bound.
            ValueError: the file is damaged at this offset.
        """
        self._check_magic()
        while True:
            crc = self._crc
            opcode, length = _HEAD.unpack(self._read(_HEAD.size))
            self._count_record()
            if length > MAX_RECORD_BYTES:
                raise ValueError(f"a record of {length} bytes, expected {MAX_RECORD_BYTES} at most")
            if opcode == _CHUNK:
                yield from self._unpack(memoryview(self._read(length)))
            elif opcode == _FOOTER:
                self._skip(length)
                self._check_magic()
                return
            elif opcode == _DATA_END:
                expected = _FieldReader(memoryview(self._read(_checked_length(length)))).number(4)
                if expected not in {0, crc}:
                    raise ValueError(f"the data's checksum is {crc:08x}, expected {expected:08x}")
            elif opcode == _STATISTICS:
                expected = _FieldReader(memoryview(self._read(_checked_length(length)))).number(8)
                if expected != self._message_count:
                    raise ValueError(f"{self._message_count} of {expected} messages are there")
            elif opcode == _NONE:
                raise ValueError("a record of the kind 0, which does not exist")
            elif opcode == _METADATA:
                yield _metadata(_FieldReader(memoryview(self._read(_checked_length(length)))))
            elif opcode in _PARSERS:
                self._message_count += opcode == _MESSAGE
                yield _PARSERS[opcode](memoryview(self._read(length)))
            else:
                self._skip(length)

    def count_unpacked(self, size: int) -> None:
        """Count unpacked bytes.

        Raises:
            RecordingError: their sum exceeds the bound.
        """
        self._unpacked_bytes += size
        if self._unpacked_bytes > max(UNPACKED_BYTES_ALLOWANCE, UNPACKED_PER_BYTE * self.offset):
            raise RecordingError(
                f"recording {self._name}: the first {self.offset} bytes of the file unpack to "
                f"{self._unpacked_bytes}, expected {UNPACKED_PER_BYTE} for each at most, or "
                f"{UNPACKED_BYTES_ALLOWANCE}"
            )

    def _unpack(self, body: memoryview) -> Iterator[Record]:
        """Yield the records of a chunk; its unpacked bytes are kept until the last record."""
        data = self._unpack_chunk(body)
        offset = 0
        while offset < len(data):
            if len(data) - offset < _HEAD.size:
                raise ValueError("a record in a chunk is cut off")
            opcode, length = _HEAD.unpack_from(data, offset)
            offset += _HEAD.size
            if length > len(data) - offset:
                raise ValueError(f"a record of {length} bytes in the last {len(data) - offset}")
            self._count_record()
            if opcode in _PARSERS:
                self._message_count += opcode == _MESSAGE
                yield _PARSERS[opcode](data[offset : offset + length])
            offset += length

    def _unpack_chunk(self, body: memoryview) -> memoryview:
        """Unpack a chunk."""
        fields = _FieldReader(body)
        _, _, unpacked_size, crc = _CHUNK_HEAD.unpack(fields.read(_CHUNK_HEAD.size))
        compression = fields.text()
        packed = fields.read(fields.number(8))
        if compression in {"zstd", "lz4"}:
            data = memoryview(self._inflate_all((_zstd if compression == "zstd" else _lz4)(packed)))
        elif compression:
            raise ValueError(
                f"a chunk is packed as {compression!r:.40}, expected zstd, lz4 or nothing"
            )
        else:
            data = packed
        if len(data) != unpacked_size:
            raise ValueError(f"a chunk unpacks to {len(data)} bytes, expected {unpacked_size}")
        if crc not in {0, zlib.crc32(data)}:
            raise ValueError(f"a chunk's checksum is not {crc:08x}")
        return data

    def _inflate_all(self, inflate: Callable[[int], bytes]) -> bytearray:
        """Join inflated pieces, up to the bound."""
        data = bytearray()
        while piece := inflate(PIECE_BYTES):
            data += piece
            self.count_unpacked(len(piece))
            if len(data) > MAX_CHUNK_BYTES:
                raise RecordingError(
                    f"recording {self._name}: a chunk unpacks to more than {len(data) - 1} bytes, "
                    f"expected {MAX_CHUNK_BYTES} at most"
                )
        return data

    def _count_record(self) -> None:
        self._record_count += 1
        if self._record_count > RECORD_ALLOWANCE and self._record_count > self.offset:
            raise RecordingError(
                f"recording {self._name}: {self._record_count} records in the first {self.offset} "
                f"bytes of the file, expected one a byte at most, or {RECORD_ALLOWANCE}"
            )

    # ------------------------------------------------------------------ the file

    def _check_magic(self) -> None:
        magic = self._read(len(MAGIC))
        if magic != MAGIC:
            raise ValueError(f"{magic.hex(' ')} is not MCAP's magic, {MAGIC.hex(' ')}")

    def _read(self, size: int) -> bytes:
        """Return the next bytes; allocate memory as they come, since the size may be wrong."""
        if size <= PIECE_BYTES:
            return self._read_piece(size)
        data = bytearray()
        while len(data) < size:
            data += self._read_piece(min(PIECE_BYTES, size - len(data)))
        return bytes(data)

    def _skip(self, size: int) -> None:
        while size:
            size -= len(self._read_piece(min(PIECE_BYTES, size)))

    def _read_piece(self, size: int) -> bytes:
        data = self._stream.read(size)
        self.offset += len(data)
        self._crc = zlib.crc32(data, self._crc)
        if len(data) < size:
            raise CutOffError("the file ends here")
        return data


@dataclass(slots=True, eq=False)
class _FieldReader:
    """A reader of a record's fields, one after the other."""

    _data: memoryview
    _offset: int = 0

    @property
    def remaining(self) -> int:
        """Number of remaining bytes."""
        return len(self._data) - self._offset

    def read(self, size: int) -> memoryview:
        """Return the next bytes."""
        if size > self.remaining:
            raise ValueError(f"a field of {size} bytes in the last {self.remaining} of a record")
        self._offset += size
        return self._data[self._offset - size : self._offset]

    def number(self, size: int) -> int:
        """Return the next number."""
        return int.from_bytes(self.read(size), "little")

    def text(self) -> str:
        """Return the next text, which follows its length."""
        return str(self.read(self.number(4)), "utf-8")


def _checked_length(length: int) -> int:
    if length > MAX_METADATA_BYTES:
        raise ValueError(f"a record of {length} bytes, expected {MAX_METADATA_BYTES} at most")
    return length


def _schema(data: memoryview) -> Schema:
    fields = _FieldReader(data)
    return Schema(fields.number(2), fields.text()[:200])  # another program's name may be long


def _channel(data: memoryview) -> Channel:
    fields = _FieldReader(data)
    return Channel(fields.number(2), fields.number(2))


def _message(data: memoryview) -> McapMessage:
    if len(data) < _MESSAGE_HEAD.size:
        raise ValueError(f"a message of {len(data)} bytes, expected {_MESSAGE_HEAD.size} at least")
    channel, sequence, *_ = _MESSAGE_HEAD.unpack_from(data)
    return McapMessage(channel, sequence, data[_MESSAGE_HEAD.size :])


def _metadata(fields: _FieldReader) -> Metadata:
    name = fields.text()
    pairs = _FieldReader(fields.read(fields.number(4)))
    texts: dict[str, str] = {}
    while pairs.remaining:
        key = pairs.text()
        texts[key] = pairs.text()
    return Metadata(name, texts)


_PARSERS: dict[int, Callable[[memoryview], Record]] = {
    _SCHEMA: _schema,
    _CHANNEL: _channel,
    _MESSAGE: _message,
}


# ---------------------------------------------------------------------- inflating


def _zstd(packed: memoryview) -> Callable[[int], bytes]:
    """Return a function that unpacks the next bytes; a zstd window is limited to a chunk's size."""
    library: Any = load_extra("zstandard")
    inflater = library.ZstdDecompressor(max_window_size=1 << (MAX_CHUNK_BYTES - 1).bit_length())
    stream = inflater.stream_reader(packed)

    def inflate(size: int) -> bytes:
        try:
            data: bytes = stream.read(size)
        except library.ZstdError as exc:
            raise ValueError(f"a chunk is no zstd: {exc}") from exc
        return data

    return inflate


def _lz4(packed: memoryview) -> Callable[[int], bytes]:
    library: Any = load_extra("lz4.frame")
    inflater = library.LZ4FrameDecompressor()
    pending = bytes(packed)

    def inflate(size: int) -> bytes:
        nonlocal pending
        if inflater.eof:
            return b""
        try:
            data: bytes = inflater.decompress(pending, max_length=size)
        except RuntimeError as exc:
            raise ValueError(f"a chunk is no lz4: {exc}") from exc
        pending = b""  # the decompressor keeps unused bytes
        return data

    return inflate
