"""Convert frames to JPEG, PNG and JPEG XL and back, by functions that block."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._extras import load
from smartcam.exceptions import FrameFormatError
from smartcam.frames._codecs.jpeg import decode_jpeg, jpeg_header
from smartcam.frames._pixels.compiled import apply_table
from smartcam.frames._pixels.formats import find_format
from smartcam.frames._pixels.layouts import Planes, SampleLayout, YuvPairs

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from smartcam.frames._frame import Frame
    from smartcam.frames._pixels.formats import PixelFormat


def with_pixels(frame: Frame, pixels: NDArray[Any], format_name: str) -> Frame:
    """Return the frame with other pixels and the same other attributes."""
    height, width = pixels.shape[:2]
    contiguous = np.ascontiguousarray(pixels)
    return replace(
        frame,
        data=contiguous.data.toreadonly().cast("B"),
        format=find_format(format_name),
        width=width,
        height=height,
        stride=contiguous.nbytes // height,
    )


def _with_bytes(frame: Frame, data: bytes, format_name: str) -> Frame:
    return replace(frame, data=data, format=find_format(format_name), stride=0)


def convert_frame(frame: Frame, format_name: str) -> Frame:
    """Return the frame in grey or in colours: ``Mono8``, ``Mono16``, ``RGB8`` or ``RGB16``."""
    pixels = frame.rgb() if format_name.startswith("RGB") else frame.grey()
    wanted = find_format(format_name)
    if pixels.dtype.itemsize * 8 != wanted.depth:
        depth = frame.format.depth
        if wanted.depth == 8:
            pixels = (pixels >> (depth - wanted.depth)).astype(np.uint8)
        else:
            pixels = pixels.astype(np.uint16)
    return with_pixels(frame, pixels, format_name)


# JPEG


def to_jpeg(frame: Frame, quality: int) -> Frame:
    """Return the frame as a JPEG."""
    layout = frame.format.layout
    if frame.format.depth != 8:
        raise _no_conversion_error(
            frame, "JPEG, which has 8 bits a sample", "png, jpegxl or converted"
        )
    if isinstance(layout, YuvPairs | Planes):
        data = _planes_to_jpeg(frame, layout.matrix, quality)
    elif isinstance(layout, SampleLayout) and frame.format.name in _JPEG_COLOURS:
        pixels = frame.array()
        pixels = pixels if pixels.ndim == 3 else pixels[..., None]
        data = _samples_to_jpeg(pixels, _JPEG_COLOURS[frame.format.name], quality)
    elif frame.format.name == "MJPEG":
        *_, has_colours = jpeg_header(frame.data, "MJPEG")
        pixels = frame.rgb() if has_colours else frame.grey()[..., None]
        data = _samples_to_jpeg(pixels, "RGB" if has_colours else "GRAY", quality)
    else:
        raise _no_conversion_error(frame, "JPEG", "converted")
    return _with_bytes(frame, data, "MJPEG")


_JPEG_COLOURS: Final = {"Mono8": "GRAY", "RGB8": "RGB", "BGR8": "BGR"}


def _samples_to_jpeg(pixels: NDArray[np.uint8], colours: str, quality: int) -> bytes:
    if pixels.strides[1:] != (pixels.shape[2], 1):
        pixels = np.ascontiguousarray(pixels)
    subsampling = "Gray" if colours == "GRAY" else "420"
    data: bytes = load("simplejpeg").encode_jpeg(pixels, quality, colours, subsampling)
    return data


def _planes_to_jpeg(frame: Frame, matrix: str, quality: int) -> bytes:
    """Encode Y, U and V, which JPEG requires in full range of BT.601."""
    if not matrix.startswith("601"):
        return _samples_to_jpeg(frame.rgb(), "RGB", quality)
    planes = frame.format.planes(frame.data, frame.width, frame.height, frame.stride)
    if matrix == "601":
        y, chroma = _full_range_tables()
        tables = (y, chroma, chroma)
        full_range = [
            apply_table(table, plane) for table, plane in zip(tables, planes, strict=True)
        ]
    else:
        full_range = [np.ascontiguousarray(plane) for plane in planes]
    data: bytes = load("simplejpeg").encode_jpeg_yuv_planes(*full_range, quality)
    return data


@lru_cache(maxsize=1)
def _full_range_tables() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the full-range value for each limited-range value of Y, and of U and V."""
    value = np.arange(256.0)
    exact = ((value - 16) * 255 / 219, (value - 128) * 255 / 224 + 128)
    y, chroma = (np.clip(np.rint(table), 0, 255).astype(np.uint8) for table in exact)
    return y, chroma


# PNG and JPEG XL


def to_png(frame: Frame) -> Frame:
    """Return the frame as a PNG, without loss."""
    samples = _lossless_samples(frame, "PNG")
    return _with_bytes(frame, load("imagecodecs").png_encode(samples, level=1), "PNG")


def to_jpegxl(frame: Frame) -> Frame:
    """Return the frame as a JPEG XL, without loss."""
    samples = _lossless_samples(frame, "JPEG XL")
    data: bytes = load("imagecodecs").jpegxl_encode(samples, effort=1, lossless=True)
    return _with_bytes(frame, data, "JPEGXL")


def _lossless_samples(frame: Frame, to: str) -> NDArray[Any]:
    """Return the samples as a file format without loss stores them."""
    if not isinstance(frame.format.layout, SampleLayout):
        raise _no_conversion_error(frame, to, "converted")
    name, pixels = frame.format.name, frame.array()
    if name.endswith("_limited"):
        pixels = frame.rgb()  # the file formats have no entry for that range
    elif name.startswith("BGR"):
        pixels = pixels[..., [2, 1, 0, *range(3, pixels.shape[2])]]
    return np.ascontiguousarray(pixels)


def _no_conversion_error(frame: Frame, to: str, instead: str) -> FrameFormatError:
    return FrameFormatError(
        f"{frame.source}: {frame.format.name} cannot become {to} as it is; see Codecs.{instead}",
        source=frame.source,
    )


# decoding


def decode_frame(frame: Frame, format_name: str) -> Frame:
    """Decode a JPEG, PNG or JPEG XL to pixels of a format; "": the format of its contents."""
    if frame.format.name not in _DECODERS:
        readable = ", ".join(_DECODERS)
        raise FrameFormatError(
            f"{frame.source}: expected one of {readable}, got {frame.format.name}",
            source=frame.source,
            available=tuple(_DECODERS),
        )
    return _DECODERS[frame.format.name](frame, format_name)


def _from_jpeg(frame: Frame, format_name: str) -> Frame:
    *_, has_colours = jpeg_header(frame.data, "MJPEG")
    format_name = find_format(format_name or ("RGB8" if has_colours else "Mono8")).name
    colours = {"Mono8": "GRAY", "RGB8": "RGB", "BGR8": "BGR"}
    if format_name not in colours:
        raise _mismatch_error(frame, "Mono8, RGB8 or BGR8", format_name)
    size = (frame.width, frame.height)
    pixels, remark = decode_jpeg(frame.data, colours[format_name], size, "MJPEG")
    picture = with_pixels(frame, pixels[..., 0] if format_name == "Mono8" else pixels, format_name)
    return replace(picture, remark=remark) if remark else picture


def _from_png(frame: Frame, format_name: str) -> Frame:
    head = bytes(frame.data[:24])
    if head[:8] != b"\x89PNG\r\n\x1a\n" or len(head) < 24:
        raise _mismatch_error(frame, "a PNG", f"bytes that begin with {head[:8].hex(' ')}")
    size = (int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big"))
    return _decode_lossless(frame, format_name, size, "png_decode")


def _from_jpegxl(frame: Frame, format_name: str) -> Frame:
    return _decode_lossless(frame, format_name, jpegxl_size(frame), "jpegxl_decode")


def _decode_lossless(frame: Frame, format_name: str, size: tuple[int, int], decoder: str) -> Frame:
    """Decode a picture if it has the stated size; no memory is allocated for another size."""
    if size != (frame.width, frame.height):
        raise _mismatch_error(frame, f"{frame.width}x{frame.height}", f"{size[0]}x{size[1]}")
    try:
        pixels: NDArray[Any] = getattr(load("imagecodecs"), decoder)(frame.data)
    except (ValueError, RuntimeError) as exc:
        raise _mismatch_error(frame, "a whole picture", f"{len(frame.data)} bytes: {exc}") from exc
    if pixels.ndim == 3 and pixels.shape[2] == 2:  # grey with alpha is returned with colours
        pixels = pixels[..., [0, 0, 0, 1]]
    wanted = _format_of_samples(format_name, pixels)
    if wanted is None:
        raise _mismatch_error(
            frame, format_name or "grey or RGB", f"{pixels.dtype} of shape {pixels.shape}"
        )
    return with_pixels(frame, pixels[..., ::-1] if wanted.name == "BGR8" else pixels, wanted.name)


def _format_of_samples(name: str, pixels: NDArray[Any]) -> PixelFormat | None:
    """Return the named format, or the default one; None if the pixels do not fit it."""
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    wanted = find_format(name or _DEFAULT_FORMATS.get((channels, pixels.dtype.itemsize), "RGB8"))
    layout = wanted.layout
    if not isinstance(layout, SampleLayout) or layout.packing is not None:
        return None
    fits = (layout.sample_bytes, layout.channels) == (pixels.dtype.itemsize, channels)
    return wanted if fits and pixels.dtype.kind == "u" else None


_DEFAULT_FORMATS: Final = {
    (1, 1): "Mono8",
    (1, 2): "Mono16",
    (3, 1): "RGB8",
    (3, 2): "RGB16",
    (4, 1): "RGBa8",
    (4, 2): "RGBa16",
}
"""Default format by the number of samples per pixel and the number of bytes per sample."""


def jpegxl_size(frame: Frame) -> tuple[int, int]:
    """Return the width and height that a JPEG XL begins with (ISO/IEC 18181-1, SizeHeader).

    Raises:
        FrameFormatError: the bytes do not begin as a JPEG XL.
    """
    stream = _jpegxl_codestream(bytes(frame.data[:4096]))
    if stream[:2] != b"\xff\x0a":
        raise _mismatch_error(frame, "a JPEG XL", f"bytes that begin with {stream[:8].hex(' ')}")
    bits, offset = int.from_bytes(stream[2:14], "little"), 0

    def read_bits(count: int) -> int:
        nonlocal offset
        offset += count
        return bits >> (offset - count) & ((1 << count) - 1)

    is_small = read_bits(1)

    def read_size() -> int:
        return (read_bits(5) + 1) * 8 if is_small else read_bits((9, 13, 18, 30)[read_bits(2)]) + 1

    height = read_size()
    ratio = read_bits(3)
    if not ratio:
        return read_size(), height
    numerator, denominator = _JPEGXL_RATIOS[ratio]
    return height * numerator // denominator, height


_JPEGXL_RATIOS: Final = ((0, 0), (1, 1), (12, 10), (4, 3), (3, 2), (16, 9), (5, 4), (2, 1))


def _jpegxl_codestream(data: bytes) -> bytes:
    """Return the codestream in the boxes of a file (ISO/IEC 18181-2), or the bytes unchanged."""
    offset = 0 if data[4:8] == b"JXL " else len(data)
    while offset + 8 <= len(data):
        size, kind = int.from_bytes(data[offset : offset + 4], "big"), data[offset + 4 : offset + 8]
        if kind in (b"jxlc", b"jxlp"):
            return data[offset + (8 if kind == b"jxlc" else 12) :]
        offset += max(size, 8)
    return data


def _mismatch_error(frame: Frame, expected: str, actual: str) -> FrameFormatError:
    return FrameFormatError(
        f"{frame.source}: {frame.format.name}: expected {expected}, got {actual}",
        source=frame.source,
    )


_DECODERS: Final[dict[str, Callable[[Frame, str], Frame]]] = {
    "MJPEG": _from_jpeg,
    "PNG": _from_png,
    "JPEGXL": _from_jpegxl,
}
