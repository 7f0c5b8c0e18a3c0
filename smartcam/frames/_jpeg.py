"""JPEG by libjpeg-turbo."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from smartcam.exceptions import FrameFormatError
from smartcam.frames._optional_imports import load

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


HARMLESS: Final = "extraneous bytes before marker 0xd9"
"""What libjpeg says of bytes between the whole picture and its end mark; some cameras send them."""


def jpeg_header(data: bytes | bytearray | memoryview, what: str) -> tuple[int, int, bool]:
    """Return width and height, and whether there are colours; nothing is decoded.

    Raises:
        FrameFormatError: it is no JPEG.
        MissingExtraError: simplejpeg is not installed.
    """
    simplejpeg = load("simplejpeg")
    try:
        height, width, colours, _ = simplejpeg.decode_jpeg_header(data, strict=False)
    except (ValueError, KeyError) as exc:  # the second of what has no known kind of colours
        raise _wrong(what, data, exc) from exc
    return width, height, colours != "Gray"


def decode_jpeg(
    data: bytes | bytearray | memoryview, colours: str, size: tuple[int, int], what: str
) -> NDArray[np.uint8]:
    """Return the pixels, (H, W, C).

    Args:
        data: a JPEG; also without Huffman tables, as cameras on USB send it.
        colours: ``GRAY`` for its luma as it stands, or ``RGB``.
        size: width and height that it is expected to have; another costs no memory.
        what: its name for errors.

    Raises:
        FrameFormatError: it is cut off, damaged, of another size, or none.
        MissingExtraError: simplejpeg is not installed.
    """
    width, height, _ = jpeg_header(data, what)
    if (width, height) != size:
        raise FrameFormatError(
            f"{what} {size[0]}x{size[1]}: expected a JPEG of that size, got {width}x{height}"
        )
    decode = load("simplejpeg").decode_jpeg
    try:
        pixels: NDArray[np.uint8] = _strictly(decode, data, colours)
    except ValueError as exc:
        raise _wrong(what, data, exc) from exc
    return pixels


def _strictly(decode: Any, data: bytes | bytearray | memoryview, colours: str) -> Any:
    try:
        return decode(data, colours)
    except ValueError as exc:
        if HARMLESS not in str(exc):
            raise
        return decode(data, colours, strict=False)


def _wrong(what: str, data: bytes | bytearray | memoryview, exc: Exception) -> FrameFormatError:
    return FrameFormatError(
        f"{what}: expected a whole JPEG, got {len(data)} bytes that are none "
        f"(they begin with {bytes(data[:4]).hex(' ')}): {exc}"
    )
