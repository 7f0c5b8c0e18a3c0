"""Encode a frame as a file by its suffix; refuse a loss that the user did not ask for."""

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
"""Least number of digits of the number in the name of one file of several."""


@dataclass(frozen=True, slots=True)
class Encoding:
    """The way frames become files.

    Attributes:
        suffix: a key of :data:`SUFFIXES`.
        quality: quality of a JPEG, 1 to 100.
        grey: whether only the brightness is kept.
        eight: True for the upper 8 bits of deeper pixels.
    """

    suffix: str
    quality: int
    grey: bool = False
    eight: bool = False

    def encode(self, frame: Frame) -> bytes:
        """Return a file's bytes; this takes milliseconds, so call it in a thread.

        Raises:
            ConfigurationError: bits would be lost without the user's consent.
            FrameFormatError: the frame's bytes are wrong.
            MissingExtraError: a codec is not installed.
        """
        return SUFFIXES[self.suffix](frame, self)


def numbered(file: str, count: int) -> list[str]:
    """Return the names of ``count`` files: ``x-0001.png``; a single file keeps its name."""
    if count == 1:
        return [file]
    path, digits = Path(file), max(MIN_NUMBER_DIGITS, len(str(count)))
    names = [f"{path.stem}-{number:0{digits}}" for number in range(1, count + 1)]
    return [str(path.with_stem(name)) for name in names]


def _levels(frame: Frame, how: Encoding) -> NDArray[Any]:
    import numpy as np

    from smartcam.web._inside import picture

    seen = picture(frame, grey=how.grey)
    if how.eight and seen.dtype != np.uint8:
        seen = (seen >> (frame.format.depth - 8)).astype(np.uint8)
    return seen


def _raw(frame: Frame, _how: Encoding) -> bytes:
    return bytes(frame.data)


def _npy(frame: Frame, how: Encoding) -> bytes:
    import numpy as np

    levels = _levels(frame, how) if how.grey or how.eight else frame.array()
    stream = io.BytesIO()
    np.save(stream, levels, allow_pickle=False)
    return stream.getvalue()


def _jpeg(frame: Frame, how: Encoding) -> bytes:
    import numpy as np

    from smartcam.web._inside import encoded, is_whole_jpeg

    if not how.grey and is_whole_jpeg(frame):
        return bytes(frame.data)
    levels = _levels(frame, how)
    if levels.dtype != np.uint8:
        raise ConfigurationError(
            f"{frame.source} sends {frame.format.name}, and a JPEG has 8 bits: expected a name "
            "that ends with .png, .jxl, .npy or .raw, which keep all bits, or --8-bit, which keeps "
            "the upper 8"
        )
    return encoded(frame, levels, how.quality)


def _png(frame: Frame, how: Encoding) -> bytes:
    return _lossless(frame, how, "PNG", "png_encode")


def _jxl(frame: Frame, how: Encoding) -> bytes:
    return _lossless(frame, how, "JPEGXL", "jpegxl_encode", lossless=True)


def _lossless(frame: Frame, how: Encoding, format: str, encode: str, **options: Any) -> bytes:
    import numpy as np

    from smartcam._extras import load

    if frame.format.name == format and not (how.grey or how.eight):
        return bytes(frame.data)
    levels = np.ascontiguousarray(_levels(frame, how))
    made: bytes = getattr(load("imagecodecs"), encode)(levels, **options)
    return made


SUFFIXES: Mapping[str, Callable[[Frame, Encoding], bytes]] = {
    ".jpeg": _jpeg,
    ".jpg": _jpeg,
    ".jxl": _jxl,
    ".npy": _npy,
    ".png": _png,
    ".raw": _raw,
}
"""The function that makes a file, by the suffix of its name in lower case."""
