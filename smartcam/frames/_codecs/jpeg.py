"""Decode JPEG by libjpeg-turbo."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam._extras import load
from smartcam.exceptions import FrameFormatError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


DAMAGE_WARNINGS: Final = (
    "premature end",
    "bad huffman code",
    "bad arithmetic code",
    "instead of rst",
    "inconsistent progression",
    "too many scanlines",
)
"""Texts in libjpeg's warnings (``jerror.h``) that mean that a part of the picture is grey or wrong.
After other warnings, such as surplus bytes or an unknown revision, the picture is intact. Common
webcams send such pictures, and other decoders show them."""

_JFIF: Final = (b"JFIF\0\x01", b"JFXX\0\x10", b"JFXX\0\x11", b"JFXX\0\x13")

_RESTART: Final = re.compile(rb"\xff([\xd0-\xd7])")


class DecodedJpeg(NamedTuple):
    """The pixels of a JPEG.

    Attributes:
        pixels: samples, (H, W, C).
        remark: warning of the decoder about a picture that is whole nevertheless; mostly empty.
    """

    pixels: NDArray[np.uint8]
    remark: str


def jpeg_header(data: bytes | bytearray | memoryview, label: str) -> tuple[int, int, bool]:
    """Return width and height, and whether the JPEG has colours, without decoding it.

    Raises:
        FrameFormatError: the picture is no JPEG.
        MissingExtraError: simplejpeg is not installed.
    """
    simplejpeg = load("simplejpeg")
    try:
        height, width, colours, _ = simplejpeg.decode_jpeg_header(data, strict=False)
    except (ValueError, KeyError) as exc:  # a KeyError means unknown kinds of colours
        raise _jpeg_error(label, data, exc) from exc
    return width, height, colours != "Gray"


def decode_jpeg(
    data: bytes | bytearray | memoryview, colours: str, size: tuple[int, int], label: str
) -> DecodedJpeg:
    """Return the pixels, and a remark on faults that the decoder skipped.

    Args:
        data: a JPEG; also without Huffman tables, as cameras on USB send it.
        colours: ``GRAY`` for the luma as it is in the file, or ``RGB``.
        size: expected width and height; no memory is allocated for a picture of another size.
        label: name of the picture for errors.

    Raises:
        FrameFormatError: the picture is cut off, damaged, of another size, or no JPEG.
        MissingExtraError: simplejpeg is not installed.
    """
    width, height, _ = jpeg_header(data, label)
    if (width, height) != size:
        raise FrameFormatError(
            f"{label} {size[0]}x{size[1]}: expected a JPEG of that size, got {width}x{height}"
        )
    decode = load("simplejpeg").decode_jpeg
    try:
        return DecodedJpeg(decode(data, colours), "")
    except ValueError as exc:
        remark = str(exc)
        if not remark.strip() or any(text in remark.lower() for text in DAMAGE_WARNINGS):
            raise _jpeg_error(label, data, exc) from exc
        _check_restarts(data, label, exc)
        return DecodedJpeg(_decode_tolerantly(decode, data, colours, label), remark)


def _decode_tolerantly(
    decode: Any, data: bytes | bytearray | memoryview, colours: str, label: str
) -> Any:
    try:
        return decode(_without_surplus_bytes(bytes(data)), colours, strict=False)
    except ValueError as exc:
        raise _jpeg_error(label, data, exc) from exc


def _without_surplus_bytes(data: bytes) -> bytes:
    """Return a JPEG without surplus bytes between the segments before its first scan.

    Even in its tolerant mode simplejpeg 1.9 refuses such bytes, and a JFIF segment of an unknown
    revision, which does not affect the pixels.
    """
    segments, end = [data[:2]], 2
    while end + 4 <= len(data):
        start = data.find(b"\xff", end)
        if start < 0 or data[start + 1 : start + 2] in (b"", b"\xda"):
            break
        if data[start + 1] in (0, 0xFF):  # a surplus byte, or a fill byte
            end = start + 1
            continue
        end = start + 2 + int.from_bytes(data[start + 2 : start + 4], "big")
        if not data[start:].startswith(b"\xff\xe0") or data[start + 4 : start + 10] in _JFIF:
            segments.append(data[start:end])
    scan = data.find(b"\xff\xda", end)
    return b"".join([*segments, data[scan:]]) if scan >= 0 else data


def _check_restarts(data: bytes | bytearray | memoryview, label: str, warning: Exception) -> None:
    """Check the restart markers: libjpeg's last warning may have hidden that one is missing.

    Raises:
        FrameFormatError: the markers are not in sequence, or the end marker is missing.
    """
    octets = bytes(data)
    scan = octets.rfind(b"\xff\xda")
    numbers = [marker[0] - 0xD0 for marker in _RESTART.findall(octets, max(scan, 0))]
    if scan < 0 or b"\xff\xd9" not in octets[scan:]:
        raise _jpeg_error(label, data, warning)
    if numbers != [index % 8 for index in range(len(numbers))]:
        raise _jpeg_error(label, data, ValueError(f"a restart mark is missing; {warning}"))


def _jpeg_error(
    label: str, data: bytes | bytearray | memoryview, exc: Exception
) -> FrameFormatError:
    return FrameFormatError(
        f"{label}: expected a whole JPEG, got {len(data)} bytes that "
        f"begin with {bytes(data[:4]).hex(' ')}: {exc}"
    )
