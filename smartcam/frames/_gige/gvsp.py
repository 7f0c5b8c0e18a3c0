"""Decode GVSP, the stream protocol of GigE Vision: packet headers, leader and trailer.

A frame is a *block*: a leader, the payload in packets of one size, with a shorter last packet, and
a trailer. Packet ids count from the leader's 0. Block ids have 16 bits, go from 1 to 65535 and
continue at 1; or they have 64 bits if a bit of each header announces extended ids.

Chunk data of the standard's first version (payload type 4) has a leader without the picture's size;
the size is in the camera's features. Its payload begins with the picture's chunk.

Source: GigE Vision 2.0, chapters 23 to 25.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

from smartcam.exceptions import MessageError

IP_UDP_BYTES: Final = 28
"""Bytes of the IP and UDP headers, which a camera's packet size includes."""

HEADER_BYTES: Final = 8
EXTENDED_HEADER_BYTES: Final = 20
"""Bytes of the header of a packet with extended ids."""

EXTENDED_FLAG: Final = 0x80
"""Bit in the byte of the packet's kind: block ids have 64 bits, packet ids 32."""

_SHORT: Final = struct.Struct(">HHI")
_LONG: Final = struct.Struct(">HHIQI")
_LEADER: Final = struct.Struct(">HHQ")
_IMAGE: Final = struct.Struct(">IIIIIHH")
_TRAILER: Final = struct.Struct(">HHI")
_CHUNK_TRAILER: Final = struct.Struct(">HHII")


def bits_of(pixel_format: int) -> int:
    """Return the number of bits of a pixel, which is part of PFNC's number."""
    return pixel_format >> 16 & 0xFF


class PacketKind(IntEnum):
    """The kind of a packet."""

    LEADER = 1
    TRAILER = 2
    PAYLOAD = 3


class PayloadType(IntEnum):
    """The kind of data in a block."""

    IMAGE = 0x0001
    RAW = 0x0002
    FILE = 0x0003
    CHUNK = 0x0004
    EXTENDED_CHUNK = 0x0005
    JPEG = 0x0006
    JPEG2000 = 0x0007
    H264 = 0x0008
    MULTI_ZONE = 0x0009
    MULTI_PART = 0x000A
    IMAGE_WITH_CHUNKS = 0x4001


PICTURES: Final = (
    PayloadType.IMAGE,
    PayloadType.IMAGE_WITH_CHUNKS,
    PayloadType.CHUNK,
    PayloadType.EXTENDED_CHUNK,
)
"""Payload types that hold an uncompressed picture."""


class PacketHeader(NamedTuple):
    """The header of a packet.

    Attributes:
        status: 0, or an error code.
        block: id of the block.
        kind: one of :class:`PacketKind`, or another number.
        packet: id of the packet in the block.
        size: number of bytes of the header.
    """

    status: int
    block: int
    kind: int
    packet: int
    size: int


class Leader(NamedTuple):
    """The contents of a block's first packet.

    Attributes:
        payload_type: member of :class:`PayloadType`.
        ticks: reading of the camera's clock, ticks.
        pixel_format: PFNC's number.
        width: width in pixels.
        height: height in pixels.
        padding_x: number of padding bytes after each row.
        padding_y: number of padding bytes after the last row.
    """

    payload_type: int
    ticks: int
    pixel_format: int
    width: int
    height: int
    padding_x: int
    padding_y: int

    @property
    def has_chunks(self) -> bool:
        """True if chunk data follows the picture, which is then a chunk itself."""
        return self.payload_type != PayloadType.IMAGE


class ImpliedPicture(NamedTuple):
    """A picture's format and size from the camera's features, for leaders that lack them.

    Attributes:
        pixel_format: PFNC's number.
        width: width in pixels.
        height: height in pixels.
    """

    pixel_format: int
    width: int
    height: int


class Trailer(NamedTuple):
    """The contents of a block's last packet.

    Attributes:
        payload_type: a value of :class:`PayloadType`.
        rows: number of rows that were sent; 0: not given.
        length: number of bytes of the payload; 0: not given.
    """

    payload_type: int
    rows: int
    length: int = 0


def decode_header(data: bytes | bytearray | memoryview, size: int) -> PacketHeader | None:
    """Decode the header of a packet of ``size`` bytes; None if it is too short."""
    if size < HEADER_BYTES:
        return None
    status, block, word = _SHORT.unpack_from(data)
    kind = word >> 24
    if not kind & EXTENDED_FLAG:
        return PacketHeader(status, block, kind, word & 0xFFFFFF, HEADER_BYTES)
    if size < EXTENDED_HEADER_BYTES:
        return None
    status, _, word, block, packet = _LONG.unpack_from(data)
    return PacketHeader(status, block, kind & 0x7F, packet, EXTENDED_HEADER_BYTES)


def decode_leader(payload: bytes, implied: ImpliedPicture | None = None) -> Leader:
    """Decode a leader without its packet header.

    Args:
        payload: bytes of the leader.
        implied: picture size for a leader without a size; None: such a leader is an error.

    Raises:
        MessageError: the leader is too short, or of no image.
    """
    if len(payload) < _LEADER.size:
        raise MessageError(f"leader: expected 12 bytes or more, got {len(payload)}", data=payload)
    _, payload_type, ticks = _LEADER.unpack_from(payload)
    if payload_type not in PICTURES:
        raise _no_picture_error(payload, payload_type)
    if payload_type == PayloadType.CHUNK and implied is not None:
        return Leader(payload_type, ticks, *implied, 0, 0)
    if len(payload) < _LEADER.size + _IMAGE.size:
        raise MessageError(f"leader of an image: expected 36 bytes, got {len(payload)}")
    pixel_format, width, height, _, _, padding_x, padding_y = _IMAGE.unpack_from(
        payload, _LEADER.size
    )
    return Leader(payload_type, ticks, pixel_format, width, height, padding_x, padding_y)


def _no_picture_error(payload: bytes, payload_type: int) -> MessageError:
    try:
        name = PayloadType(payload_type).name
    except ValueError:
        name = "unknown"
    return MessageError(
        f"leader: expected an image (0x0001), or one with chunks (0x4001, 0x0004 or 0x0005), "
        f"got payload type {payload_type:#06x} ({name})",
        offset=2,
        data=payload,
    )


def decode_trailer(payload: bytes) -> Trailer:
    """Decode a trailer without its packet header.

    Raises:
        MessageError: the trailer is too short.
    """
    if len(payload) < _TRAILER.size:
        raise MessageError(f"trailer: expected 8 bytes, got {len(payload)}", data=payload)
    _, payload_type, number = _TRAILER.unpack_from(payload)
    if payload_type == PayloadType.CHUNK:
        return Trailer(payload_type, 0, number)
    if payload_type != PayloadType.EXTENDED_CHUNK:
        return Trailer(payload_type, number)
    if len(payload) < _CHUNK_TRAILER.size:
        raise MessageError(
            f"trailer of chunk data: expected 12 bytes or more, got {len(payload)}", data=payload
        )
    return Trailer(payload_type, _CHUNK_TRAILER.unpack_from(payload)[3], number)
