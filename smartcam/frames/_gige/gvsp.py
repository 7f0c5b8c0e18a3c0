"""GVSP, the stream protocol of GigE Vision: packet headers, leader and trailer.

A frame is a *block*: a leader, the payload cut into packets of one size, the last one shorter, and
a trailer. Packet ids count from 0, the leader's. Block ids have 16 bits, go from 1 to 65535 and
then on at 1; or 64 bits where the camera sends extended ids, which a bit of each header says.

Source: GigE Vision 2.0, chapters 23 to 25.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

from smartcam.exceptions import MessageError

IP_UDP: Final = 28
"""Bytes of the IP and UDP headers, which a camera's packet size counts."""

HEADER: Final = 8
EXTENDED_HEADER: Final = 20
"""Bytes."""

EXTENDED: Final = 0x80
"""Bit in the byte of the packet's kind: ids have 64 and 32 bits."""

_SHORT: Final = struct.Struct(">HHI")
_LONG: Final = struct.Struct(">HHIQI")
_LEADER: Final = struct.Struct(">HHQ")
_IMAGE: Final = struct.Struct(">IIIIIHH")
_TRAILER: Final = struct.Struct(">HHI")


def bits_of(pixel_format: int) -> int:
    """Return the bits of a pixel, which stand in PFNC's number."""
    return pixel_format >> 16 & 0xFF


class PacketKind(IntEnum):
    """The kind of a packet."""

    LEADER = 1
    TRAILER = 2
    PAYLOAD = 3


class PayloadType(IntEnum):
    """The kind of data that a block has."""

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


class PacketHeader(NamedTuple):
    """A packet's header.

    Attributes:
        status: 0, or the code of what is wrong.
        block: id of the block.
        kind: one of :class:`PacketKind`, or another number.
        packet: id of the packet in the block.
        size: bytes of the header.
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
        width: pixels.
        height: pixels.
        padding_x: bytes behind each row.
        padding_y: bytes behind the last row.
    """

    payload_type: int
    ticks: int
    pixel_format: int
    width: int
    height: int
    padding_x: int
    padding_y: int


def decode_header(data: bytes | bytearray | memoryview, size: int) -> PacketHeader | None:
    """Read the header of a packet of ``size`` bytes; None where it is too short for one."""
    if size < HEADER:
        return None
    status, block, word = _SHORT.unpack_from(data)
    kind = word >> 24
    if not kind & EXTENDED:
        return PacketHeader(status, block, kind, word & 0xFFFFFF, HEADER)
    if size < EXTENDED_HEADER:
        return None
    status, _, word, block, packet = _LONG.unpack_from(data)
    return PacketHeader(status, block, kind & 0x7F, packet, EXTENDED_HEADER)


def decode_leader(payload: bytes) -> Leader:
    """Read a leader, without its header.

    Raises:
        MessageError: it is too short, or none of an image.
    """
    if len(payload) < _LEADER.size:
        raise MessageError(f"leader: expected 12 bytes or more, got {len(payload)}", data=payload)
    _, payload_type, ticks = _LEADER.unpack_from(payload)
    if payload_type not in (PayloadType.IMAGE, PayloadType.IMAGE_WITH_CHUNKS):
        try:
            name = PayloadType(payload_type).name
        except ValueError:
            name = "unknown"
        raise MessageError(
            f"leader: expected an image (0x0001), or one with chunks (0x4001), "
            f"got payload type {payload_type:#06x} ({name})",
            offset=2,
            data=payload,
        )
    if len(payload) < _LEADER.size + _IMAGE.size:
        raise MessageError(f"leader of an image: expected 36 bytes, got {len(payload)}")
    pixel_format, width, height, _, _, padding_x, padding_y = _IMAGE.unpack_from(
        payload, _LEADER.size
    )
    return Leader(payload_type, ticks, pixel_format, width, height, padding_x, padding_y)


def decode_trailer(payload: bytes) -> int:
    """Read a trailer, without its header: the rows that were sent.

    Raises:
        MessageError: it is too short.
    """
    if len(payload) < _TRAILER.size:
        raise MessageError(f"trailer: expected 8 bytes, got {len(payload)}", data=payload)
    rows: int = _TRAILER.unpack_from(payload)[2]
    return rows
