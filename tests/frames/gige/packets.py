"""Make packets of a stream by hand, from the standard."""

import struct


def header(kind: int, block: int, packet: int, status: int = 0, *, extended: bool = False) -> bytes:
    if extended:
        return struct.pack(">HHIQI", status, 0, (kind | 0x80) << 24, block, packet)
    return struct.pack(">HHI", status, block, kind << 24 | packet)


def leader(
    block: int,
    ticks: int,
    size: tuple[int, int] = (16, 16),
    *,
    kind: int = 1,
    pixels: int = 0x01080001,
    extended: bool = False,
) -> bytes:
    body = struct.pack(">HHQIIIIIHH", 0, kind, ticks, pixels, *size, 0, 0, 0, 0)
    return header(1, block, 0, extended=extended) + body


def payload(block: int, packet: int, data: bytes, *, extended: bool = False) -> bytes:
    return header(3, block, packet, extended=extended) + data


def trailer(block: int, packet: int, rows: int = 16, *, extended: bool = False) -> bytes:
    return header(2, block, packet, extended=extended) + struct.pack(">HHI", 0, 1, rows)


FULL = 60
"""Bytes of pixels in a full packet: a frame of 16x16 has four full packets, and one of 16 bytes."""


def frame(block: int, number: int, *, extended: bool = False) -> list[bytes]:
    """Return the packets of a frame of 16x16 pixels, whose values are all the number."""
    data = bytes([number % 256]) * 256
    parts = [data[at : at + FULL] for at in range(0, 256, FULL)]
    return [
        leader(block, number, extended=extended),
        *(payload(block, 1 + at, part, extended=extended) for at, part in enumerate(parts)),
        trailer(block, len(parts) + 1, extended=extended),
    ]
