"""Encode a frame by its file's suffix; refuse a loss of bits that no option allows."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from smartcam.frames import Frame

MIN_NUMBER_DIGITS: Final = 4
"""Least number of digits of the numbers in the names of several files."""


@dataclass(frozen=True, slots=True)
class Encoding:
    """The options by which frames become files.

    Attributes:
        suffix: a key of :data:`SUFFIXES`.
        quality: quality of a JPEG, 1 to 100.
        grey: whether only the brightness is kept.
        eight_bits: whether only the upper 8 bits of deeper pixels are kept.
    """

    suffix: str
    quality: int
    grey: bool = False
    eight_bits: bool = False

    def encode(self, frame: Frame) -> bytes:
        """Return a file's bytes; this takes milliseconds, so call it in a thread.

        Raises:
            ConfigurationError: the format would lose bits, and no option allows that.
            FrameFormatError: the frame's bytes are wrong.
            MissingExtraError: a codec is not installed.
        """
        return SUFFIXES[self.suffix](frame, self)


def numbered_names(file: str, count: int) -> list[str]:
    """Return the names of ``count`` files: ``x-0001.png``; a single file keeps its name."""
    if count == 1:
        return [file]
    path, digits = Path(file), max(MIN_NUMBER_DIGITS, len(str(count)))
    names = [f"{path.stem}-{number:0{digits}}" for number in range(1, count + 1)]
    return [str(path.with_stem(name)) for name in names]


def _encoded_pixels(frame: Frame, encoding: Encoding) -> NDArray[Any]:
    import numpy as np

    from smartcam.web._inside import pixels_to_show

    pixels = pixels_to_show(frame, grey=encoding.grey)
    if encoding.eight_bits and pixels.dtype != np.uint8:
        pixels = (pixels >> (frame.format.depth - 8)).astype(np.uint8)
    return pixels


def _raw(frame: Frame, _encoding: Encoding) -> bytes:
    return bytes(frame.data)


def _npy(frame: Frame, encoding: Encoding) -> bytes:
    import numpy as np

    pixels = (
        _encoded_pixels(frame, encoding) if encoding.grey or encoding.eight_bits else frame.array()
    )
    stream = io.BytesIO()
    np.save(stream, pixels, allow_pickle=False)
    return stream.getvalue()


def _jpeg(frame: Frame, encoding: Encoding) -> bytes:
    import numpy as np

    from smartcam.web._inside import encode_pixels, is_whole_jpeg

    if not encoding.grey and is_whole_jpeg(frame):
        return bytes(frame.data)
    pixels = _encoded_pixels(frame, encoding)
    if pixels.dtype != np.uint8:
        raise ConfigurationError(
            f"{frame.source} sends {frame.format.name}, and a JPEG has 8 bits: expected a name "
            "that ends with .png, .jxl, .npy or .raw, which keep all bits, or --8-bit, which keeps "
            "the upper 8"
        )
    return encode_pixels(frame, pixels, encoding.quality)


def _png(frame: Frame, encoding: Encoding) -> bytes:
    return _lossless(frame, encoding, "PNG", "png_encode")


def _jxl(frame: Frame, encoding: Encoding) -> bytes:
    return _lossless(frame, encoding, "JPEGXL", "jpegxl_encode", lossless=True)


def _lossless(frame: Frame, encoding: Encoding, format: str, encode: str, **options: Any) -> bytes:
    import numpy as np

    from smartcam._extras import load

    if frame.format.name == format and not (encoding.grey or encoding.eight_bits):
        return bytes(frame.data)
    pixels = np.ascontiguousarray(_encoded_pixels(frame, encoding))
    data: bytes = getattr(load("imagecodecs"), encode)(pixels, **options)
    return data


SUFFIXES: Mapping[str, Callable[[Frame, Encoding], bytes]] = {
    ".jpeg": _jpeg,
    ".jpg": _jpeg,
    ".jxl": _jxl,
    ".npy": _npy,
    ".png": _png,
    ".raw": _raw,
}
"""The function that encodes a frame, by the suffix of the file's name in lower case."""
