"""Turn a frame of any pixel format into a JPEG with 8 bits per colour, for viewers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._extras import load
from smartcam.exceptions import FrameFormatError
from smartcam.frames._inside import Planes, YuvPairs, decode_frame, to_jpeg, with_pixels

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.frames import Frame

JPEG_START: Final = b"\xff\xd8"
HUFFMAN_TABLES: Final = b"\xff\xc4"
"""Marker of a JPEG's Huffman tables. Many webcams leave the tables out; few programs can read such
a JPEG."""

HEAD_BYTES: Final = 4096
"""Number of bytes at the start of a JPEG in which the Huffman tables are looked for."""

DIRECT_FORMATS: Final = frozenset({"Mono8", "RGB8", "BGR8", "MJPEG"})
"""Formats that can be encoded as a JPEG without a conversion, in addition to YUV formats."""


def jpeg(frame: Frame, quality: int) -> bytes:
    """Return a frame as a JPEG; a frame that is a whole JPEG is returned unchanged.

    Pixels of more than 8 bits are scaled, so that the brightest one becomes white. This takes
    milliseconds: call it in a thread.

    Args:
        frame: frame to encode.
        quality: 1 to 100.

    Raises:
        FrameFormatError: the frame's bytes are wrong, or it is too large for a JPEG.
        MissingExtraError: a package that decodes the frame or makes the JPEG is not installed.
    """
    if is_whole_jpeg(frame):
        return bytes(frame.data)
    if not _can_encode_directly(frame):
        return encode_pixels(frame, scale_to_8_bits(pixels_to_show(frame)), quality)
    return _encode(frame, quality)


def encode_pixels(frame: Frame, pixels: NDArray[np.uint8], quality: int) -> bytes:
    """Return pixels of a frame, (H, W) or (H, W, 3) with red first, as a JPEG.

    Raises:
        FrameFormatError: the size is too large for a JPEG.
        MissingExtraError: the extra ``frames`` is not installed.
    """
    return _encode(with_pixels(frame, pixels, "Mono8" if pixels.ndim == 2 else "RGB8"), quality)


def require_encoder() -> None:
    """Check that JPEGs can be made.

    Raises:
        MissingExtraError: the extra ``frames`` is not installed.
    """
    load("simplejpeg")


def is_whole_jpeg(frame: Frame) -> bool:
    """Return True if a frame is already a JPEG that any program can read."""
    head = bytes(frame.data[:HEAD_BYTES])
    return frame.format.name == "MJPEG" and head.startswith(JPEG_START) and HUFFMAN_TABLES in head


def pixels_to_show(frame: Frame, *, grey: bool = False) -> NDArray[Any]:
    """Return the pixels to show: (H, W, 3), red first; (H, W) for a frame without colours.

    Raises:
        FrameFormatError: the frame's bytes are wrong, or ``grey`` is set and the format has no
            brightness.
        MissingExtraError: a codec of a compressed format or a Bayer pattern is not installed.
    """
    if frame.format.name in {"PNG", "JPEGXL"}:
        frame = decode_frame(frame, "")
    if frame.format.name.startswith("Coord3D") and not grey:
        return frame.array()
    return frame.grey() if grey or frame.format.name.startswith("Mono") else frame.rgb()


def scale_to_8_bits(levels: NDArray[Any]) -> NDArray[np.uint8]:
    """Return levels at 8 bits; levels of more bits are scaled so that the largest becomes 255."""
    if levels.dtype == np.uint8:
        return levels
    top = max(1, int(levels.max()))
    return (levels.astype(np.uint32) * 255 // top).astype(np.uint8)


def _can_encode_directly(frame: Frame) -> bool:
    return frame.format.name in DIRECT_FORMATS or isinstance(frame.format.layout, YuvPairs | Planes)


def _encode(frame: Frame, quality: int) -> bytes:
    try:
        return bytes(to_jpeg(frame, quality).data)
    except ValueError as exc:
        raise FrameFormatError(
            f"{frame.source}: no JPEG of {frame.width}x{frame.height} pixels: {exc}",
            source=frame.source,
        ) from exc
