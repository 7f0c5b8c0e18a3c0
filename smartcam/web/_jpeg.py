"""A frame as a JPEG, for pages and files; the one place here that knows how one is made."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam.exceptions import FrameFormatError, MissingExtraError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.frames import Frame

START: Final = b"\xff\xd8"
TABLES: Final = b"\xff\xc4"
"""Marker of a JPEG's Huffman tables; many a webcam leaves them out, and few programs read that."""

HEAD: Final = 4096
"""Bytes in which the tables are looked for: they stand in front of the picture."""


def jpeg(frame: Frame, quality: int, *, grey: bool = False) -> bytes:
    """Return a frame as a JPEG; one that is a whole JPEG already as it came, its quality too.

    More than 8 bits are scaled, so that the brightest pixel becomes white: to be looked at.

    Args:
        frame: it; it takes milliseconds, and belongs into a thread.
        quality: 1 to 100.
        grey: the brightness alone.

    Raises:
        FrameFormatError: its bytes are wrong.
        MissingExtraError: the extra ``frames`` is not installed.
    """
    if not grey and is_whole_jpeg(frame):
        return bytes(frame.data)
    return encoded(stretched(picture(frame, grey=grey)), quality)


def is_whole_jpeg(frame: Frame) -> bool:
    """Tell whether a frame came as a JPEG that any program can read."""
    head = bytes(frame.data[:HEAD])
    return frame.format.compressed and head.startswith(START) and TABLES in head


def picture(frame: Frame, *, grey: bool = False) -> NDArray[Any]:
    """Return what is to be seen: (H, W, 3), red first; (H, W) where there is no colour.

    Raises:
        FrameFormatError: its bytes are wrong, or it has no brightness, which ``grey`` asks for.
        MissingExtraError: a compressed format or a Bayer pattern, and its codec is not installed.
    """
    if frame.format.name.startswith("Coord3D") and not grey:
        return frame.array()
    return frame.grey() if grey or frame.format.name.startswith("Mono") else frame.rgb()


def stretched(levels: NDArray[Any]) -> NDArray[np.uint8]:
    """Return levels of 8 bits; of more the brightest becomes 255."""
    if levels.dtype == np.uint8:
        return levels
    top = max(1, int(levels.max()))
    return (levels.astype(np.uint32) * 255 // top).astype(np.uint8)


def encoded(levels: NDArray[np.uint8], quality: int) -> bytes:
    """Return (H, W) or (H, W, 3), red first, as a JPEG.

    Raises:
        FrameFormatError: a JPEG cannot be so large.
        MissingExtraError: the extra ``frames`` is not installed.
    """
    try:
        simplejpeg = importlib.import_module("simplejpeg")
    except ImportError as exc:
        raise MissingExtraError(
            'a JPEG needs simplejpeg: pip install "smartcam[frames]"', extra="frames"
        ) from exc
    space = "GRAY" if levels.ndim == 2 else "RGB"
    shaped = np.ascontiguousarray(levels[..., None] if levels.ndim == 2 else levels)
    try:
        made: bytes = simplejpeg.encode_jpeg(
            shaped,
            quality=quality,
            colorspace=space,
            colorsubsampling="Gray" if space == "GRAY" else "420",
        )
    except ValueError as exc:
        height, width = levels.shape[:2]
        raise FrameFormatError(f"no JPEG of {width}x{height} pixels: {exc}") from exc
    return made
