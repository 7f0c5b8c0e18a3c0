"""H.265 in RTP packets (RFC 7798), without interleaving (DON fields)."""

from __future__ import annotations

from typing import Final

from smartcam.frames._streaming.rtp.assembling import NalAccessUnit
from smartcam.frames._streaming.rtp.parameters import SUBSAMPLING, FieldBits, checked_size

VPS, SPS, PPS, DELIMITER = 32, 33, 34, 35
"""Types of NAL units (ITU-T H.265, table 7-1)."""

KEY_SLICES: Final = range(16, 24)
"""Types of slices of key frames."""


class H265AccessUnit(NalAccessUnit):
    """An access unit of H.265."""

    HEADER_SIZE = 2
    AGGREGATION = 48
    FRAGMENT = 49

    @staticmethod
    def unit_type(head: int) -> int:
        """Return a NAL unit's type; -1: not valid."""
        return -1 if head & 0x80 else head >> 1 & 0x3F

    @staticmethod
    def is_picture(unit_type: int) -> bool:
        """Return True for slices."""
        return 0 <= unit_type < 32

    @classmethod
    def fragmented_header(cls, payload: bytes) -> bytes:
        """Return the header of the NAL unit whose fragment is in a packet."""
        return bytes((payload[0] & 0x81 | (payload[2] & 0x3F) << 1, payload[1]))


class H265PayloadFormat:
    """The RTP payload format of H.265."""

    new_unit = H265AccessUnit

    @staticmethod
    def certainly_starts_frame(payload: bytes) -> bool:
        """Return True if a packet begins with a NAL unit that can only begin a frame."""
        unit_type = H265AccessUnit.unit_type(payload[0]) if payload else -1
        if unit_type == H265AccessUnit.AGGREGATION and len(payload) > 4:
            payload = payload[4:]
            unit_type = H265AccessUnit.unit_type(payload[0])
        elif unit_type == H265AccessUnit.FRAGMENT and len(payload) > 3 and payload[2] & 0x80:
            payload = H265AccessUnit.fragmented_header(payload) + payload[3:]
            unit_type = H265AccessUnit.unit_type(payload[0])
        if unit_type in KEY_SLICES:  # first_slice_segment_in_pic_flag is the first bit
            return len(payload) > 2 and bool(payload[2] & 0x80)
        return unit_type in (VPS, SPS, DELIMITER)


def picture_size(sps: bytes) -> tuple[int, int]:
    """Return the width and the height of the pictures, in pixels.

    Args:
        sps: sequence parameter set, with its header of two bytes.

    Raises:
        FrameFormatError: the parameters are not valid.
    """
    return checked_size("H265", sps, lambda: _size(FieldBits(sps[2:257])))


def _size(bits: FieldBits) -> tuple[int, int]:
    bits.read_bits(4)
    layers = bits.read_bits(3)
    bits.read_bits(1 + 96)
    flags = [(bits.read_bits(1), bits.read_bits(1)) for _ in range(layers)]
    bits.read_bits(2 * (8 - layers) if layers else 0)
    for has_profile, has_level in flags:
        bits.read_bits(88 * has_profile + 8 * has_level)
    bits.read_unsigned()
    chroma_format = bits.read_unsigned()
    if chroma_format == 3:
        bits.read_bits(1)
    width, height = bits.read_unsigned(), bits.read_unsigned()
    crop = [bits.read_unsigned() for _ in range(4)] if bits.read_bits(1) else [0] * 4
    horizontal, vertical = SUBSAMPLING[chroma_format]
    return width - horizontal * (crop[0] + crop[1]), height - vertical * (crop[2] + crop[3])


def size_in(access_unit: bytes) -> tuple[int, int] | None:
    """Return the size of the pictures; None if the encoded frame has no parameter set.

    Raises:
        FrameFormatError: the parameters are not valid.
    """
    for unit in H265AccessUnit.leading_units(access_unit):
        if H265AccessUnit.unit_type(unit[0]) == SPS:
            return picture_size(unit)
    return None
