"""Read bitmap files, in which smart cameras send their pictures."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam.exceptions import FrameFormatError

if TYPE_CHECKING:
    from numpy.typing import NDArray


FILE_HEADER: Final = struct.Struct("<2sIHHI")
INFO_HEADER: Final = struct.Struct("<IiiHHIIiiII")
MAX_PIXEL_BYTES: Final = 1 << 28
"""Largest number of bytes of a bitmap's pixels; no camera sends more."""


def read_bitmap(data: bytes) -> NDArray[np.uint8]:
    """Return the pixels of a BMP file: (H, W) if it is grey, else (H, W, 3), red first.

    The file may have 8 bits with a palette, or 24 or 32 bits, uncompressed, with the upper or the
    lower row first.

    Raises:
        FrameFormatError: the file is cut off, compressed, has other numbers of bits, or is no
            bitmap.
    """
    if len(data) < FILE_HEADER.size + INFO_HEADER.size or data[:2] != b"BM":
        raise FrameFormatError(
            f"expected a bitmap file, got {len(data)} bytes that begin with {data[:8].hex(' ')}"
        )
    offset = FILE_HEADER.unpack_from(data)[4]
    header_size, width, rows, _, bits, compression, _, _, _, palette_size, _ = (
        INFO_HEADER.unpack_from(data, FILE_HEADER.size)
    )
    height = abs(rows)
    if header_size < INFO_HEADER.size or compression or bits not in (8, 24, 32):
        raise FrameFormatError(
            f"expected an uncompressed bitmap of 8, 24 or 32 bits, got one of {bits} bits, "
            f"compression {compression}, with a head of {header_size} bytes"
        )
    stride = (width * bits // 8 + 3) & ~3
    size = stride * height
    if width < 1 or height < 1 or size > MAX_PIXEL_BYTES or len(data) < offset + size:
        raise FrameFormatError(
            f"bitmap of {width}x{height}: expected {stride * height} bytes of pixels from byte "
            f"{offset} on, got {max(len(data) - offset, 0)}"
        )
    pixels = np.ndarray((height, width, bits // 8), np.uint8, data, offset, (stride, bits // 8, 1))
    if rows > 0:
        pixels = pixels[::-1]
    if bits == 8:
        return _apply_palette(
            pixels[..., 0], data[FILE_HEADER.size + header_size :][: 4 * (palette_size or 256)]
        )
    return np.ascontiguousarray(pixels[..., 2::-1])


def _apply_palette(pixels: NDArray[Any], palette: bytes) -> NDArray[np.uint8]:
    """Return the palette's colours for indices; an index beyond the palette is black."""
    colours = np.zeros((256, 4), np.uint8)
    entries = np.frombuffer(palette[: len(palette) // 4 * 4], np.uint8).reshape(-1, 4)[:256]
    colours[: len(entries)] = entries
    if (colours[:, :1] == colours[:, 1:3]).all():
        grey: NDArray[np.uint8] = colours[:, 0][pixels]
        return grey
    coloured: NDArray[np.uint8] = colours[:, 2::-1][pixels]
    return coloured
