"""Convert between FFmpeg's frames and smartcam's: pixel formats and layouts of bytes."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import numpy as np

from smartcam._extras import load
from smartcam.exceptions import FrameFormatError
from smartcam.frames._pixels.apart import SeparatePlanes
from smartcam.frames._pixels.colours import MATRICES, yuv_to_rgb
from smartcam.frames._pixels.formats import PIXEL_FORMATS, find_format, with_matrix
from smartcam.frames._pixels.layouts import Planes, YuvPairs

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.frames._frame import Frame
    from smartcam.frames._pixels.formats import PixelFormat


_GREY_RGB_BAYER: Final = {
    "gray": "Mono8",
    "gray10le": "Mono10",
    "gray12le": "Mono12",
    "gray14le": "Mono14",
    "gray16le": "Mono16",
    "rgb24": "RGB8",
    "bgr24": "BGR8",
    "rgb48le": "RGB16",
    "rgba": "RGBa8",
    "bgra": "BGRa8",
    "rgba64le": "RGBa16",
    "bayer_rggb8": "BayerRG8",
    "bayer_bggr8": "BayerBG8",
    "bayer_gbrg8": "BayerGB8",
    "bayer_grbg8": "BayerGR8",
    "bayer_rggb16le": "BayerRG16",
    "bayer_bggr16le": "BayerBG16",
    "bayer_gbrg16le": "BayerGB16",
    "bayer_grbg16le": "BayerGR16",
}
"""FFmpeg's other formats with the same bytes as a format of smartcam."""

_SUBSAMPLING: Final = {(2, 2): "420", (2, 1): "422", (1, 1): "444"}
"""Names of chroma subsampling, by the numbers of columns and rows that share U and V."""

_YUV: Final = {
    f"{prefix}{digits}p{suffix}": f"I{digits}{our_suffix}"
    for digits in _SUBSAMPLING.values()
    for prefix, suffix, our_suffix in (
        ("yuv", "", ""),
        ("yuvj", "", "_full"),
        *(("yuv", f"{depth}le", f"_{depth}") for depth in (10, 12, 16)),
    )
} | {"nv12": "NV12", "yuyv422": "YUV422_8", "uyvy422": "YUV422_8_UYVY"}
"""FFmpeg's formats of Y, U and V with the same bytes as a format of smartcam."""

_TRANSPARENT: Final = {"yuva420p": "yuv420p", "yuva422p": "yuv422p", "yuva444p": "yuv444p"}
"""FFmpeg's formats with alpha after Y, U and V, and the same formats without alpha."""

CONVERTIBLE: Final = {"RGB8": "rgb24", "BGR8": "bgr24", "Mono8": "gray"}
"""Formats to which pixels are converted on request, with FFmpeg's names."""

LIMITED, FULL = 1, 2  # AVCOL_RANGE_MPEG, AVCOL_RANGE_JPEG
_RANGES: Final = {LIMITED: "MPEG", FULL: "JPEG"}  # PyAV's names
BT709, BT601, BT2020 = 1, 6, 9  # AVCOL_SPC_BT709, AVCOL_SPC_SMPTE170M, AVCOL_SPC_BT2020_NCL

MATRIX_OF_SPACE: Final = {
    BT709: "709", 2: "601", 3: "601", 4: "601", 5: "601", BT601: "601", BT2020: "2020",
}  # fmt: skip
"""Matrix of an AVColorSpace. An unspecified space (2) is read as BT.601, as in FFmpeg; the FCC's
(4) equals BT.601 within a third of a grey level; 0 means RGB."""


class Pixels(NamedTuple):
    """The pixels of a decoded frame, in one of smartcam's formats.

    Attributes:
        format: format of the pixels.
        width: pixels.
        height: pixels.
        stride: bytes from row to row.
        data: the decoder's bytes if their layout fits, else a copy.
    """

    format: PixelFormat
    width: int
    height: int
    stride: int
    data: bytes | memoryview


@lru_cache(maxsize=256)  # called for each frame
def format_of(name: str, colour_range: int, space: int) -> PixelFormat:
    """Return smartcam's format for one of FFmpeg's.

    Args:
        name: name such as ``yuv420p``.
        colour_range: AVColorRange; 0 (unknown) is read as limited.
        space: AVColorSpace.

    Raises:
        FrameFormatError: there is no such format, or the colour space is not supported.
    """
    if name in _GREY_RGB_BAYER:
        return find_format(_GREY_RGB_BAYER[name])
    if name not in _YUV:
        known = (*_GREY_RGB_BAYER, *_YUV)
        raise FrameFormatError(
            f"FFmpeg's pixel format {name}: expected one that converts without loss to one of "
            f"{', '.join(known)}",
            available=known,
        )
    matrix = MATRIX_OF_SPACE.get(space)
    if matrix is None:
        raise FrameFormatError(
            f"FFmpeg's pixel format {name}: expected Y, U and V by BT.601, BT.709 or BT.2020, got "
            f"those of AVColorSpace {space}"
        )
    full = name.startswith("yuvj") or colour_range == FULL
    base = find_format(_YUV[name].removesuffix("_full"))
    return with_matrix(base, f"{matrix} full" if full else matrix)


def from_av_frame(av_frame: Any, *, keep_planes: bool = False) -> Pixels:
    """Return a decoded frame's pixels in their own format, or in one without loss.

    A palette is converted to colours, planes of red, green and blue to samples, and unsupported
    chroma subsampling is expanded.

    Args:
        av_frame: frame of FFmpeg.
        keep_planes: whether the planes may stay in the decoder's buffers without a copy, as
            :class:`SeparatePlanes`.

    Raises:
        FrameFormatError: no format holds the pixels without loss; the text names the loss.
    """
    name = av_frame.format.name
    if name in _TRANSPARENT and not _is_opaque(av_frame):
        return _to_rgba(av_frame)
    if name not in _GREY_RGB_BAYER and name not in _YUV:
        av_frame = _with_supported_format(av_frame)
    pixel_format = format_of(av_frame.format.name, av_frame.color_range, av_frame.colorspace)
    planes = av_frame.planes
    stride = planes[0].line_size
    if len(planes) == 1:
        data = memoryview(planes[0]).toreadonly()
        return Pixels(pixel_format, av_frame.width, av_frame.height, stride, data)
    layout = pixel_format.layout
    fits = isinstance(layout, Planes) and all(
        plane.line_size == layout.chroma_stride(stride) for plane in planes[1:]
    )
    if fits:
        joined: Any = SeparatePlanes(planes) if keep_planes else b"".join(planes)
        return Pixels(pixel_format, av_frame.width, av_frame.height, stride, joined)
    joined = b"".join(_without_padding(plane, pixel_format) for plane in planes)
    stride = pixel_format.stride(av_frame.width)
    return Pixels(pixel_format, av_frame.width, av_frame.height, stride, joined)


def _with_supported_format(av_frame: Any) -> Any:
    """Return the frame in a supported format without loss, or unchanged if there is none."""
    kind = av_frame.format
    components = kind.components
    depth = max(component.bits for component in components)
    has_alpha = any(component.is_alpha for component in components)
    if depth > 16 or kind.name.startswith(("xyz", "bayer")):
        return av_frame
    if kind.has_palette or kind.is_rgb or len(components) == 2:
        if depth > 8:
            return reformatted(av_frame, "rgba64le" if has_alpha else "rgb48le")
        return reformatted(av_frame, "rgba" if has_alpha or kind.has_palette else "rgb24")
    if len(components) == 1:
        return reformatted(av_frame, _supported_grey(kind.name, depth))
    return _with_supported_subsampling(av_frame, depth, has_alpha=has_alpha)


def _supported_grey(name: str, depth: int) -> str:
    little_endian = f"{name.removesuffix('be')}le"
    if depth <= 8:
        return "gray"
    return little_endian if little_endian in _GREY_RGB_BAYER else "gray16le"


def _with_supported_subsampling(av_frame: Any, depth: int, *, has_alpha: bool) -> Any:
    """Return the frame with a supported chroma subsampling."""
    kind, size = av_frame.format, (av_frame.width, av_frame.height)
    across, down = (
        round(length / chroma_length)
        for length, chroma_length in zip(size, _chroma_size(av_frame), strict=True)
    )
    bits = next(bits for bits in (8, 10, 12, 16) if depth <= bits)
    suffix = "" if bits == 8 else f"{bits}le"
    digits = _SUBSAMPLING.get((across, down))
    if has_alpha and kind.name not in _TRANSPARENT:
        return av_frame
    if digits is not None:
        return _reformatted_yuv(av_frame, f"yuv{digits}p{suffix}")
    if bits > 8 or not kind.is_planar or len(av_frame.planes) < 3:
        return av_frame
    expanded = _new_av_frame(*size, "yuv444p")
    for target, plane in zip(expanded.planes, av_frame.planes, strict=False):
        rows = _rows(plane)
        for axis, times in enumerate((-(-size[1] // plane.height), -(-size[0] // plane.width))):
            rows = np.repeat(rows, times, axis=axis)
        _fill_plane(target, rows[: size[1], : size[0]])
    return _with_colour_properties(expanded, av_frame, full=kind.name.startswith("yuvj"))


def _chroma_size(av_frame: Any) -> tuple[float, float]:
    """Return width and height of U and V without rounding, from the ratios in a large picture."""
    kind, side = av_frame.format, 1 << 10
    return (
        av_frame.width * kind.chroma_width(side) / side,
        av_frame.height * kind.chroma_height(side) / side,
    )


def _reformatted_yuv(av_frame: Any, name: str) -> Any:
    """Return a frame of Y, U and V with the same samples in another layout."""
    full = av_frame.format.name.startswith("yuvj")
    return _with_colour_properties(reformatted(av_frame, name), av_frame, full=full)


def _with_colour_properties(target: Any, av_frame: Any, *, full: bool) -> Any:
    """Copy range and colour space of a frame to another, which is returned."""
    target.color_range = FULL if full else av_frame.color_range
    target.colorspace = av_frame.colorspace
    return target


def reformatted(av_frame: Any, name: str) -> Any:
    """Return a frame in another pixel format of FFmpeg.

    Args:
        av_frame: frame of FFmpeg.
        name: name of the format, such as ``rgb24``.

    Raises:
        FrameFormatError: FFmpeg does not convert between these formats.
    """
    kind, width = av_frame.format, av_frame.width
    padded_width = -(-width // CORRECT_WIDTH_MULTIPLE) * CORRECT_WIDTH_MULTIPLE
    depth = max(component.bits for component in kind.components)
    must_pad = padded_width != width and not kind.has_palette and depth > 8
    try:
        result = (_resized(av_frame, padded_width) if must_pad else av_frame).reformat(format=name)
    except (OSError, ValueError) as exc:
        raise FrameFormatError(
            f"FFmpeg's pixel format {kind.name}: no conversion to {name}: {exc}"
        ) from exc
    return _resized(result, width) if must_pad else result


CORRECT_WIDTH_MULTIPLE: Final = 32
"""FFmpeg converts samples of more than 8 bits correctly if the width is a multiple of this number
of pixels. In other widths it writes 8 samples of colour into Y, as measured with p010le of 641 x
481 in FFmpeg 8 (PyAV 18)."""


def _resized(av_frame: Any, width: int) -> Any:
    """Return a copy with the rows cut off or filled up with zeros on the right."""
    resized = _new_av_frame(width, av_frame.height, av_frame.format.name)
    for target, plane in zip(resized.planes, av_frame.planes, strict=True):
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        _fill_plane(target, rows[:, : min(target.line_size, plane.line_size)])
    return _with_colour_properties(resized, av_frame, full=False)


def _is_opaque(av_frame: Any) -> bool:
    """Return True if the last plane, alpha, is fully opaque."""
    return bool((_rows(av_frame.planes[3]) == 255).all())


def _to_rgba(av_frame: Any) -> Pixels:
    """Return Y, U, V and alpha as red, green, blue and alpha."""
    without_alpha = format_of(
        _TRANSPARENT[av_frame.format.name], av_frame.color_range, av_frame.colorspace
    )
    matrix = MATRICES[cast("Planes", without_alpha.layout).matrix]
    y, u, v, alpha = (_rows(plane) for plane in av_frame.planes)
    data = np.dstack([yuv_to_rgb(y, (u, v), matrix), alpha]).tobytes()
    return Pixels(find_format("RGBa8"), av_frame.width, av_frame.height, 4 * av_frame.width, data)


def _rows(plane: Any) -> NDArray[np.uint8]:
    """Return the samples of a plane of 8 bits, a view."""
    rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
    return rows[:, : plane.width]


def _without_padding(plane: Any, pixel_format: PixelFormat) -> bytes:
    """Return the rows of a plane without padding."""
    layout: Any = pixel_format.layout
    size = layout.sample_bytes * (2 if layout.interleaved and plane.index else 1)
    rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
    return rows[:, : plane.width * size].tobytes()


@lru_cache(maxsize=256)  # called for each frame
def colour_properties(pixel_format: PixelFormat) -> tuple[int, int]:
    """Return AVColorRange and AVColorSpace of a format."""
    matrix = getattr(pixel_format.layout, "matrix", "601 full")  # without a matrix: grey or RGB
    space = next((space for space in (BT709, BT2020) if MATRIX_OF_SPACE[space] in matrix), BT601)
    return FULL if matrix.endswith("full") else LIMITED, space


def to_av_frame(frame: Frame, reusable: Any = None) -> Any:
    """Return a frame for an encoder of 4:2:0, with Y unchanged and U and V averaged.

    Grey gets neutral U and V. RGB is converted to BT.601 with limited range.

    Args:
        frame: frame to encode.
        reusable: earlier returned frame that the encoder no longer uses; it is reused for grey of
            the same size.

    Raises:
        FrameFormatError: this format cannot be converted, or the size is odd.
    """
    name = _encodable_name(frame.format)
    if name is None:
        known = tuple(
            pixel_format.name
            for pixel_format in PIXEL_FORMATS
            if _encodable_name(pixel_format) is not None
        )
        raise FrameFormatError(
            f"{frame.source}: {frame.format.name} cannot become video as it is; what can: "
            f"{', '.join(known)}; see Codecs.converted",
            source=frame.source,
            available=known,
        )
    if frame.width % 2 or frame.height % 2:
        raise FrameFormatError(
            f"{frame.source}: video wants an even width and height, got "
            f"{frame.width}x{frame.height}",
            source=frame.source,
        )
    if name == "gray":
        return _grey_av_frame(frame, reusable)
    av_frame = _filled_av_frame(frame, name)
    if name in ("yuv420p", "nv12"):
        return av_frame
    range_, space = colour_properties(frame.format)
    new_range = LIMITED if name in ("rgb24", "bgr24") else range_
    result = av_frame.reformat(
        format="yuv420p", src_color_range=_RANGES[range_], dst_color_range=_RANGES[new_range]
    )
    result.color_range, result.colorspace = new_range, space
    return result


def to_lossless_av_frame(frame: Frame) -> Any:
    """Return a frame for the lossless encoder FFV1, with each value unchanged.

    Packed samples are unpacked, Y, U and V are separated, and RGB is reordered.

    Raises:
        FrameFormatError: a video cannot express the format: a Bayer pattern, distances, or
            compressed bytes.
    """
    name = _lossless_name(frame.format)
    if name is None:
        known = tuple(
            pixel_format.name
            for pixel_format in PIXEL_FORMATS
            if _lossless_name(pixel_format) is not None
        )
        raise FrameFormatError(
            f"{frame.source}: {frame.format.name} cannot become a video without loss; what can: "
            f"{', '.join(known)}",
            source=frame.source,
            available=known,
        )
    av_frame = _filled_av_frame(frame, name)
    ffv1_name = _FFV1_FORMATS.get(name, name)
    if ffv1_name == name:
        return av_frame
    result = av_frame.reformat(format=ffv1_name)
    result.color_range, result.colorspace = colour_properties(frame.format)
    return result


_FFV1_FORMATS: Final = {
    "rgb24": "bgr0",
    "bgr24": "bgr0",
    "rgba": "bgra",
    "nv12": "yuv420p",
    "yuyv422": "yuv422p",
    "uyvy422": "yuv422p",
}
"""Formats that FFV1 needs instead; they hold the same values in another order."""


def _lossless_name(pixel_format: PixelFormat) -> str | None:
    """Return FFmpeg's name for the unpacked values of a format, if a video can express them."""
    layout = pixel_format.layout
    if pixel_format.name.startswith("Mono"):
        return "gray" if pixel_format.depth == 8 else f"gray{_DEPTHS[pixel_format.depth]}le"
    if isinstance(layout, Planes) and layout.depth > 8:
        digits = _SUBSAMPLING[layout.chroma_x, layout.chroma_y]
        return f"yuv{digits}p{layout.depth}le"
    if pixel_format.name in ("RGBa8", "BGRa8"):
        return "rgba" if pixel_format.name == "RGBa8" else "bgra"
    return _encodable_name(pixel_format)


_DEPTHS: Final = {10: 10, 12: 12, 14: 16, 16: 16}
"""Bits of FFV1's grey format, by bits of a sample."""


def _encodable_name(pixel_format: PixelFormat) -> str | None:
    """Return FFmpeg's name for the bytes of a format that can become video, or None."""
    layout = pixel_format.layout
    if isinstance(layout, YuvPairs):
        return "uyvy422" if layout.y else "yuyv422"
    if isinstance(layout, Planes) and layout.depth == 8:
        digits = _SUBSAMPLING[layout.chroma_x, layout.chroma_y]
        return "nv12" if layout.interleaved else f"yuv{digits}p"
    return {"Mono8": "gray", "RGB8": "rgb24", "BGR8": "bgr24"}.get(pixel_format.name)


def _new_av_frame(width: int, height: int, name: str) -> Any:
    return load("av").VideoFrame(width, height, name)


def _grey_av_frame(frame: Frame, reusable: Any) -> Any:
    properties = frame.width, frame.height, *colour_properties(frame.format)
    if reusable is not None and properties == (
        *(reusable.width, reusable.height),
        *(reusable.color_range, reusable.colorspace),
    ):
        _fill_plane(
            reusable.planes[0], frame.array()
        )  # a new array would cost a page fault per 4 kB
        return reusable
    av_frame = _new_av_frame(frame.width, frame.height, "yuv420p")
    _fill_plane(av_frame.planes[0], frame.array())
    for plane in av_frame.planes[1:]:
        plane.update(_neutral_chroma(plane.buffer_size))
    av_frame.color_range, av_frame.colorspace = colour_properties(frame.format)
    return av_frame


@lru_cache(maxsize=16)
def _neutral_chroma(size: int) -> bytes:
    return b"\x80" * size


def _filled_av_frame(frame: Frame, name: str) -> Any:
    av_frame = _new_av_frame(frame.width, frame.height, name)
    layout = frame.format.layout
    if isinstance(layout, Planes):
        y, u, v = frame.format.planes(frame.data, frame.width, frame.height, frame.stride)
        arrays = [y, np.stack((u, v), axis=-1)] if layout.interleaved else [y, u, v]
    else:
        arrays = [frame.array()]
    for plane, array in zip(av_frame.planes, arrays, strict=True):
        rows = array.reshape(array.shape[0], -1)
        _fill_plane(
            plane, rows if rows.itemsize == 1 else np.ascontiguousarray(rows).view(np.uint8)
        )
    av_frame.color_range, av_frame.colorspace = colour_properties(frame.format)
    return av_frame


def _fill_plane(plane: Any, rows: Any) -> None:
    if rows.flags.c_contiguous and rows.nbytes == plane.buffer_size:
        plane.update(rows)  # a single copy
        return
    plane_rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
    plane_rows[: rows.shape[0], : rows.shape[1]] = rows
