"""H.265 in RTP packets (RFC 7798), without interleaving (DON fields)."""

from __future__ import annotations

from typing import Final

from smartcam.frames._streaming.rtp.assembling import NalUnit
from smartcam.frames._streaming.rtp.parameters import SUBSAMPLING, FieldBits, checked_size

VPS, SPS, PPS, DELIMITER = 32, 33, 34, 35
"""Types of NAL units (ITU-T H.265, table 7-1)."""

KEYS: Final = range(16, 24)
"""Types of slices of key frames."""


class H265Unit(NalUnit):
    """An access unit of H.265."""

    HEADER_SIZE = 2
    AGGREGATION = 48
    FRAGMENT = 49

    @staticmethod
    def kind_of(head: int) -> int:
        """Return a unit's kind."""
        return -1 if head & 0x80 else head >> 1 & 0x3F

    @staticmethod
    def is_picture(kind: int) -> bool:
        """Return True for slices."""
        return 0 <= kind < 32

    @classmethod
    def whole_head(cls, payload: bytes) -> bytes:
        """Return the header of the unit whose fragment is in a packet."""
        return bytes((payload[0] & 0x81 | (payload[2] & 0x3F) << 1, payload[1]))


class H265Units:
    """Rules by which access units of H.265 begin and are assembled."""

    new_unit = H265Unit

    @staticmethod
    def begins(payload: bytes) -> bool:
        """Return True if a packet has a unit that can only begin a frame."""
        kind = H265Unit.kind_of(payload[0]) if payload else -1
        if kind == H265Unit.AGGREGATION and len(payload) > 4:
            payload = payload[4:]
            kind = H265Unit.kind_of(payload[0])
        elif kind == H265Unit.FRAGMENT and len(payload) > 3 and payload[2] & 0x80:
            payload = H265Unit.whole_head(payload) + payload[3:]
            kind = H265Unit.kind_of(payload[0])
        if kind in KEYS:  # first_slice_segment_in_pic_flag is the first bit
            return len(payload) > 2 and bool(payload[2] & 0x80)
        return kind in (VPS, SPS, DELIMITER)


def picture_size(sps: bytes) -> tuple[int, int]:
    """Return the width and the height of the pictures, in pixels.

    Args:
        sps: sequence parameter set, with its header of two bytes.

    Raises:
        FrameFormatError: the parameters are not valid.
    """
    return checked_size("H265", sps, lambda: _size(FieldBits(sps[2:257])))


def _size(bits: FieldBits) -> tuple[int, int]:
    bits.fixed(4)
    layers = bits.fixed(3)
    bits.fixed(1 + 96)
    flags = [(bits.fixed(1), bits.fixed(1)) for _ in range(layers)]
    bits.fixed(2 * (8 - layers) if layers else 0)
    for profile, level in flags:
        bits.fixed(88 * profile + 8 * level)
    bits.unsigned()
    chroma_format = bits.unsigned()
    if chroma_format == 3:
        bits.fixed(1)
    width, height = bits.unsigned(), bits.unsigned()
    crop = [bits.unsigned() for _ in range(4)] if bits.fixed(1) else [0] * 4
    across, down = SUBSAMPLING[chroma_format]
    return width - across * (crop[0] + crop[1]), height - down * (crop[2] + crop[3])


def size_in(access_unit: bytes) -> tuple[int, int] | None:
    """Return the size of the pictures; None if an encoded frame has no parameters.

    Raises:
        FrameFormatError: the parameters are not valid.
    """
    for unit in H265Unit.leading(access_unit):
        if H265Unit.kind_of(unit[0]) == SPS:
            return picture_size(unit)
    return None
