"""Unpack pixels of 10 and 12 bits that share bytes, into two bytes each.

PFNC packs ``10p`` and ``12p`` as one stream of bits, the lowest first. GigE Vision's older
``10Packed`` and ``12Packed`` put two pixels into three bytes: the high bits into the outer bytes,
the low bits of both into the middle byte.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class PixelBits(NamedTuple):
    """Bits of a pixel in one byte: ``(byte >> right_shift & mask) << left_shift``."""

    byte: int
    right_shift: int
    mask: int
    left_shift: int


class Packing(NamedTuple):
    """A repeating pattern of pixels' bits in bytes.

    Attributes:
        size: number of bytes of the pattern.
        pixels: bits of each pixel in the pattern.
    """

    size: int
    pixels: tuple[tuple[PixelBits, ...], ...]


PACKINGS: Final = {
    "10p": Packing(
        5,
        (
            (PixelBits(0, 0, 0xFF, 0), PixelBits(1, 0, 0x03, 8)),
            (PixelBits(1, 2, 0x3F, 0), PixelBits(2, 0, 0x0F, 6)),
            (PixelBits(2, 4, 0x0F, 0), PixelBits(3, 0, 0x3F, 4)),
            (PixelBits(3, 6, 0x03, 0), PixelBits(4, 0, 0xFF, 2)),
        ),
    ),
    "12p": Packing(
        3,
        (
            (PixelBits(0, 0, 0xFF, 0), PixelBits(1, 0, 0x0F, 8)),
            (PixelBits(1, 4, 0x0F, 0), PixelBits(2, 0, 0xFF, 4)),
        ),
    ),
    "10Packed": Packing(
        3,
        (
            (PixelBits(0, 0, 0xFF, 2), PixelBits(1, 0, 0x03, 0)),
            (PixelBits(2, 0, 0xFF, 2), PixelBits(1, 4, 0x03, 0)),
        ),
    ),
    "12Packed": Packing(
        3,
        (
            (PixelBits(0, 0, 0xFF, 4), PixelBits(1, 0, 0x0F, 0)),
            (PixelBits(2, 0, 0xFF, 4), PixelBits(1, 4, 0x0F, 0)),
        ),
    ),
}
"""Packings by the ending of a format's name. Source: PFNC, "packed pixel formats"; GigE Vision
1.2."""


def unpack(rows: NDArray[np.uint8], width: int, packing: Packing) -> NDArray[np.uint16]:
    """Return the pixels of rows of bytes.

    Args:
        rows: (H, N), at least the bytes of ``width`` pixels in each row.
        width: number of pixels in a row.
        packing: positions of the pixels' bits.

    Returns:
        (H, width).
    """
    height, pixels = rows.shape[0], len(packing.pixels)
    groups = -(-width // pixels)
    missing = groups * packing.size - rows.shape[1]
    if missing > 0:  # the row ends within a group
        rows = np.pad(rows, ((0, 0), (0, missing)))
    grouped = rows[:, : groups * packing.size].reshape(height, groups, packing.size)
    unpacked = np.zeros((height, groups, pixels), np.uint16)
    for index, parts in enumerate(packing.pixels):
        for part in parts:
            bits = (grouped[..., part.byte] >> part.right_shift) & part.mask
            unpacked[..., index] |= bits.astype(np.uint16) << part.left_shift
    return unpacked.reshape(height, -1)[:, :width]
