"""Read files of JPEG XL, which PyAV's FFmpeg does not read."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames._codecs.pictures import convert_frame, decode_frame, jpegxl_size
from smartcam.frames._frame import Frame, Moment, amend
from smartcam.frames._pixels.formats import find_format
from smartcam.frames._video.frames import Pixels

if TYPE_CHECKING:
    from smartcam.frames._pixels.formats import PixelFormat

SUFFIX: Final = ".jxl"

MAX_FILE_BYTES: Final = 1 << 30
"""Largest size of a file, bytes; a larger file is refused."""

MAX_PICTURE_PIXELS: Final = 1 << 28
"""Largest number of pixels of a picture; a larger one is refused before it takes memory."""


def is_jpegxl(path: str) -> bool:
    """Return True if a file has the suffix of JPEG XL."""
    return Path(path).suffix.lower() == SUFFIX


def read_jpegxl(path: str, wanted: PixelFormat | None) -> Pixels:
    """Return the pixels of a file, unchanged or converted.

    Raises:
        FrameFormatError: the file holds no whole JPEG XL, or too large a picture.
        FrameSourceError: the file cannot be read.
        MissingExtraError: the extra ``frames`` is not installed.
    """
    try:
        if (size := Path(path).stat().st_size) > MAX_FILE_BYTES:
            raise FrameFormatError(
                f"{path}: expected {MAX_FILE_BYTES} bytes at most, got {size}", source=path
            )
        data = Path(path).read_bytes()
    except OSError as exc:
        raise FrameSourceError(f"{path}: cannot be read: {exc.strerror}", source=path) from exc
    frame = Frame(
        data=data,
        format=find_format("JPEGXL"),
        width=0,
        height=0,
        stride=0,
        captured=0.0,
        utc=0.0,
        moment=Moment.ARRIVAL,
        sequence=0,
        source=path,
    )
    width, height = jpegxl_size(frame)
    if width * height > MAX_PICTURE_PIXELS:
        raise FrameFormatError(
            f"{path}: expected {MAX_PICTURE_PIXELS} pixels at most, got {width}x{height}",
            source=path,
        )
    picture = decode_frame(amend(frame, width=width, height=height), "")
    if wanted is not None and wanted is not picture.format:
        picture = _convert_to(picture, wanted)
    return Pixels(picture.format, width, height, picture.stride, bytes(picture.data))


def _convert_to(frame: Frame, wanted: PixelFormat) -> Frame:
    if wanted.compressed:
        raise FrameFormatError(
            f"{frame.source}: expected {wanted.name}, got JPEGXL", source=frame.source
        )
    if wanted.name == "BGR8":
        picture = convert_frame(frame, "RGB8")
        return amend(picture, data=picture.array()[..., ::-1].tobytes(), format=wanted)
    return convert_frame(frame, wanted.name)
