"""Check images of the emulated In-Sight camera, 8 bit grey, and make bitmap files of them."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam._arguments import wrong_argument
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_PIXELS = 1 << 23
"""Largest number of pixels of an image; larger ones are refused. Real sensors have up to 5
megapixels."""

_FILE_HEADER = struct.Struct("<2sIHHI")
_INFO_HEADER = struct.Struct("<IiiHHIIiiII")
_PALETTE = b"".join(bytes((grey, grey, grey, 0)) for grey in range(256))


def grey_pattern(width: int = 64, height: int = 48) -> NDArray[np.uint8]:
    """Return a picture that shows its orientation: grey levels rise to the right and downwards."""
    columns = np.linspace(0, 191, width)
    rows_down = np.linspace(0, 64, height)
    return (columns[np.newaxis, :] + rows_down[:, np.newaxis]).astype(np.uint8)


def check_image(image: Any) -> NDArray[np.uint8]:
    """Return a copy of an 8 bit grey image.

    Raises:
        ConfigurationError: the image is not valid, is empty, or has more than 8 megapixels.
    """
    try:
        array: NDArray[Any] = np.asarray(image)
    except Exception as exc:
        raise wrong_argument("image", "a 2-D array of uint8", image) from exc
    if array.dtype != np.uint8 or array.ndim != 2:
        raise ConfigurationError(
            f"an image is a 2-D array of uint8, got {array.ndim} axes of {array.dtype}"
        )
    if not 0 < array.size <= MAX_PIXELS:
        raise ConfigurationError(f"an image has 1 to {MAX_PIXELS} pixels, got {array.size}")
    return array.copy()


def bitmap(image: NDArray[np.uint8]) -> bytes:
    """Return an image as a BMP file: 8 bits per pixel, a palette of greys, the last row first.

    The documents say that the camera sends a standard BMP; these details are inferred.
    """
    height, width = image.shape
    rows = np.pad(image[::-1], ((0, 0), (0, -width % 4))).tobytes()
    offset = _FILE_HEADER.size + _INFO_HEADER.size + len(_PALETTE)
    return (
        _FILE_HEADER.pack(b"BM", offset + len(rows), 0, 0, offset)
        + _INFO_HEADER.pack(
            _INFO_HEADER.size, width, height, 1, 8, 0, len(rows), 2835, 2835, 256, 256
        )
        + _PALETTE
        + rows
    )
