"""Convert between FFmpeg's frames and smartcam's: pixel formats and layouts of bytes."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import numpy as np

from smartcam._extras import load
from smartcam.exceptions import FrameFormatError
from smartcam.frames._pixels.apart import PlanesApart
from smartcam.frames._pixels.colours import MATRICES, yuv_to_rgb
from smartcam.frames._pixels.formats import PIXEL_FORMATS, find_format, with_matrix
from smartcam.frames._pixels.layouts import Planes, YuvPairs

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.frames._frame import Frame
    from smartcam.frames._pixels.formats import PixelFormat


_SAMPLES: Final = {
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
_SUBSAMPLING: Final = {(2, 2): "420", (2, 1): "422", (1, 1): "444"}
"""Names of chroma subsampling, by pixels along a row and rows with common U and V."""

_YUV: Final = {
    f"{begin}{digits}p{end}": f"I{digits}{ours}"
    for digits in _SUBSAMPLING.values()
    for begin, end, ours in (
        ("yuv", "", ""),
        ("yuvj", "", "_full"),
        *(("yuv", f"{depth}le", f"_{depth}") for depth in (10, 12, 16)),
    )
} | {"nv12": "NV12", "yuyv422": "YUV422_8", "uyvy422": "YUV422_8_UYVY"}
"""FFmpeg's formats of Y, U and V with the same bytes as a format of smartcam."""

_TRANSPARENT: Final = {"yuva420p": "yuv420p", "yuva422p": "yuv422p", "yuva444p": "yuv444p"}
"""FFmpeg's formats with alpha after Y, U and V, and the same formats without alpha."""

CONVERTIBLE: Final = {"RGB8": "rgb24", "BGR8": "bgr24", "Mono8": "gray"}
"""Formats of conversion on request, with FFmpeg's names."""

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
    if name in _SAMPLES:
        return find_format(_SAMPLES[name])
    if name not in _YUV:
        known = (*_SAMPLES, *_YUV)
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


def from_video(video: Any, *, apart: bool = False) -> Pixels:
    """Return a decoded frame's pixels in their own format, or in one without loss.

    A palette is converted to colours, planes of red, green and blue to samples, and unsupported
    chroma subsampling is expanded.

    Args:
        video: frame of FFmpeg.
        apart: whether planes may stay in the decoder's buffers, as :class:`PlanesApart`.

    Raises:
        FrameFormatError: no format holds the pixels without loss; the text names the loss.
    """
    name = video.format.name
    if name in _TRANSPARENT and not _opaque(video):
        return _with_alpha(video)
    if name not in _SAMPLES and name not in _YUV:
        video = _repacked(video)
    pixel_format = format_of(video.format.name, video.color_range, video.colorspace)
    planes = video.planes
    stride = planes[0].line_size
    if len(planes) == 1:
        data = memoryview(planes[0]).toreadonly()
        return Pixels(pixel_format, video.width, video.height, stride, data)
    layout = pixel_format.layout
    fits = isinstance(layout, Planes) and all(
        plane.line_size == layout.chroma_stride(stride) for plane in planes[1:]
    )
    if fits:
        joined: Any = PlanesApart(planes) if apart else b"".join(planes)
        return Pixels(pixel_format, video.width, video.height, stride, joined)
    joined = b"".join(_tight(plane, pixel_format) for plane in planes)
    return Pixels(pixel_format, video.width, video.height, pixel_format.stride(video.width), joined)


def _repacked(video: Any) -> Any:
    """Return the frame in a supported format without loss, or unchanged."""
    kind = video.format
    parts = kind.components
    deep = max(part.bits for part in parts)
    alpha = any(part.is_alpha for part in parts)
    if deep > 16 or kind.name.startswith(("xyz", "bayer")):
        return video
    if kind.has_palette or kind.is_rgb or len(parts) == 2:
        to = ("rgba" if alpha or kind.has_palette else "rgb24", "rgba64le" if alpha else "rgb48le")
        return converted(video, to[deep > 8])
    if len(parts) == 1:
        return converted(video, _wider_grey(kind.name, deep))
    return _with_supported_subsampling(video, deep, alpha=alpha)


def _wider_grey(name: str, deep: int) -> str:
    little = f"{name.removesuffix('be')}le"
    return "gray" if deep <= 8 else little if little in _SAMPLES else "gray16le"


def _with_supported_subsampling(video: Any, deep: int, *, alpha: bool) -> Any:
    """Return the frame with a supported chroma subsampling."""
    kind, size = video.format, (video.width, video.height)
    across, down = (round(side / part) for side, part in zip(size, _chroma(video), strict=True))
    bits = next(bits for bits in (8, 10, 12, 16) if deep <= bits)
    end = "" if bits == 8 else f"{bits}le"
    digits = _SUBSAMPLING.get((across, down))
    if alpha and kind.name not in _TRANSPARENT:
        return video
    if digits is not None:
        return _same_colours(video, f"yuv{digits}p{end}")
    if bits > 8 or not kind.is_planar or len(video.planes) < 3:
        return video
    made = _new(*size, "yuv444p")
    for to, plane in zip(made.planes, video.planes, strict=False):
        rows = _rows(plane)
        for axis, times in enumerate((-(-size[1] // plane.height), -(-size[0] // plane.width))):
            rows = np.repeat(rows, times, axis=axis)
        _fill(to, rows[: size[1], : size[0]])
    return _with_colour_properties(made, video, full=kind.name.startswith("yuvj"))


def _chroma(video: Any) -> tuple[float, float]:
    """Return the ratios of the sizes of U and V to Y, measured on a large picture."""
    kind, side = video.format, 1 << 10
    return (
        video.width * kind.chroma_width(side) / side,
        video.height * kind.chroma_height(side) / side,
    )


def _same_colours(video: Any, name: str) -> Any:
    """Return a frame with the same samples in another layout."""
    full = video.format.name.startswith("yuvj")
    return _with_colour_properties(converted(video, name), video, full=full)


def _with_colour_properties(made: Any, video: Any, *, full: bool) -> Any:
    made.color_range = FULL if full else video.color_range
    made.colorspace = video.colorspace
    return made


def converted(video: Any, name: str) -> Any:
    """Return a frame in another pixel format of FFmpeg.

    Args:
        video: frame of FFmpeg.
        name: name of the format, such as ``rgb24``.

    Raises:
        FrameFormatError: FFmpeg does not convert between these formats.
    """
    kind, width = video.format, video.width
    wide = -(-width // RIGHT_WIDTH) * RIGHT_WIDTH
    padded = (
        wide != width and not kind.has_palette and max(part.bits for part in kind.components) > 8
    )
    try:
        made = (_resized(video, wide) if padded else video).reformat(format=name)
    except (OSError, ValueError) as exc:
        raise FrameFormatError(
            f"FFmpeg's pixel format {kind.name}: no conversion to {name}: {exc}"
        ) from exc
    return _resized(made, width) if padded else made


RIGHT_WIDTH: Final = 32
"""Multiple of pixels at which FFmpeg converts wide rows of more than 8 bits right. In other widths
it writes 8 samples of colour into Y, as measured with p010le of 641 x 481 in FFmpeg 8 (PyAV 18)."""


def _resized(video: Any, width: int) -> Any:
    """Return a copy with the rows cut off or filled up with zeros on the right."""
    made = _new(width, video.height, video.format.name)
    for to, plane in zip(made.planes, video.planes, strict=True):
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        _fill(to, rows[:, : min(to.line_size, plane.line_size)])
    return _with_colour_properties(made, video, full=False)


def _opaque(video: Any) -> bool:
    """Return True if the last plane, alpha, is fully opaque."""
    return bool((_rows(video.planes[3]) == 255).all())


def _with_alpha(video: Any) -> Pixels:
    """Return Y, U, V and alpha as red, green, blue and alpha."""
    meant = format_of(_TRANSPARENT[video.format.name], video.color_range, video.colorspace)
    matrix = MATRICES[cast("Planes", meant.layout).matrix]
    y, u, v, alpha = (_rows(plane) for plane in video.planes)
    data = np.dstack([yuv_to_rgb(y, (u, v), matrix), alpha]).tobytes()
    return Pixels(find_format("RGBa8"), video.width, video.height, 4 * video.width, data)


def _rows(plane: Any) -> NDArray[np.uint8]:
    """Return the samples of a plane of 8 bits, a view."""
    rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
    return rows[:, : plane.width]


def _tight(plane: Any, pixel_format: PixelFormat) -> bytes:
    """Return the rows of a plane without padding."""
    layout: Any = pixel_format.layout
    size = layout.size_of * (2 if layout.interleaved and plane.index else 1)
    rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
    return rows[:, : plane.width * size].tobytes()


@lru_cache(maxsize=256)  # called for each frame
def colour_properties(pixel_format: PixelFormat) -> tuple[int, int]:
    """Return AVColorRange and AVColorSpace of a format."""
    matrix = getattr(pixel_format.layout, "matrix", "601 full")  # without a matrix: grey or RGB
    space = next((space for space in (BT709, BT2020) if MATRIX_OF_SPACE[space] in matrix), BT601)
    return FULL if matrix.endswith("full") else LIMITED, space


def to_video(frame: Frame, before: Any = None) -> Any:
    """Return a frame for an encoder of 4:2:0, with Y unchanged and U and V averaged.

    Grey gets neutral U and V. RGB is converted to BT.601 with limited range.

    Args:
        frame: frame to encode.
        before: earlier returned frame that the encoder no longer uses; it is reused for grey of the
            same size.

    Raises:
        FrameFormatError: this format cannot be converted, or the size is odd.
    """
    name = _encodable(frame.format)
    if name is None:
        known = tuple(
            pixel_format.name
            for pixel_format in PIXEL_FORMATS
            if _encodable(pixel_format) is not None
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
        return _from_grey(frame, before)
    video = _filled(frame, name)
    if name in ("yuv420p", "nv12"):
        return video
    range_, space = colour_properties(frame.format)
    to = LIMITED if name in ("rgb24", "bgr24") else range_
    made = video.reformat(
        format="yuv420p", src_color_range=_RANGES[range_], dst_color_range=_RANGES[to]
    )
    made.color_range, made.colorspace = to, space
    return made


def to_lossless_video(frame: Frame) -> Any:
    """Return a frame for the lossless encoder FFV1, with each value unchanged.

    Packed samples are unpacked, Y, U and V are separated, and RGB is reordered.

    Raises:
        FrameFormatError: a video cannot express the format: a Bayer pattern, distances, or
            compressed bytes.
    """
    name = _lossless(frame.format)
    if name is None:
        known = tuple(
            pixel_format.name
            for pixel_format in PIXEL_FORMATS
            if _lossless(pixel_format) is not None
        )
        raise FrameFormatError(
            f"{frame.source}: {frame.format.name} cannot become a video without loss; what can: "
            f"{', '.join(known)}",
            source=frame.source,
            available=known,
        )
    video = _filled(frame, name)
    to = _REPACKED.get(name, name)
    if to == name:
        return video
    made = video.reformat(format=to)
    made.color_range, made.colorspace = colour_properties(frame.format)
    return made


_REPACKED: Final = {
    "rgb24": "bgr0",
    "bgr24": "bgr0",
    "rgba": "bgra",
    "nv12": "yuv420p",
    "yuyv422": "yuv422p",
    "uyvy422": "yuv422p",
}
"""Formats of FFV1 that hold the same values in another order."""


def _lossless(pixel_format: PixelFormat) -> str | None:
    """Return FFmpeg's name for the unpacked values of a format, if a video can express them."""
    layout = pixel_format.layout
    if pixel_format.name.startswith("Mono"):
        return "gray" if pixel_format.depth == 8 else f"gray{_DEPTHS[pixel_format.depth]}le"
    if isinstance(layout, Planes) and layout.depth > 8:
        digits = _SUBSAMPLING[layout.across, layout.down]
        return f"yuv{digits}p{layout.depth}le"
    if pixel_format.name in ("RGBa8", "BGRa8"):
        return "rgba" if pixel_format.name == "RGBa8" else "bgra"
    return _encodable(pixel_format)


_DEPTHS: Final = {10: 10, 12: 12, 14: 16, 16: 16}
"""Bits of FFV1's grey format, by bits of a sample."""


def _encodable(pixel_format: PixelFormat) -> str | None:
    """Return FFmpeg's name for the bytes of a format that can become video, or None."""
    layout = pixel_format.layout
    if isinstance(layout, YuvPairs):
        return "uyvy422" if layout.y else "yuyv422"
    if isinstance(layout, Planes) and layout.depth == 8:
        return "nv12" if layout.interleaved else f"yuv{_SUBSAMPLING[layout.across, layout.down]}p"
    return {"Mono8": "gray", "RGB8": "rgb24", "BGR8": "bgr24"}.get(pixel_format.name)


def _new(width: int, height: int, name: str) -> Any:
    return load("av").VideoFrame(width, height, name)


def _from_grey(frame: Frame, before: Any) -> Any:
    size = frame.width, frame.height, *colour_properties(frame.format)
    if before is not None and size == (
        *(before.width, before.height),
        *(before.color_range, before.colorspace),
    ):
        _fill(before.planes[0], frame.array())  # a new array would cost a page fault per 4 kB
        return before
    video = _new(frame.width, frame.height, "yuv420p")
    _fill(video.planes[0], frame.array())
    for plane in video.planes[1:]:
        plane.update(_without_colour(plane.buffer_size))
    video.color_range, video.colorspace = colour_properties(frame.format)
    return video


@lru_cache(maxsize=16)
def _without_colour(size: int) -> bytes:
    return b"\x80" * size


def _filled(frame: Frame, name: str) -> Any:
    video = _new(frame.width, frame.height, name)
    layout = frame.format.layout
    if isinstance(layout, Planes):
        y, u, v = frame.format.planes(frame.data, frame.width, frame.height, frame.stride)
        parts = [y, np.stack((u, v), axis=-1)] if layout.interleaved else [y, u, v]
    else:
        parts = [frame.array()]
    for plane, part in zip(video.planes, parts, strict=True):
        rows = part.reshape(part.shape[0], -1)
        _fill(plane, rows if rows.itemsize == 1 else np.ascontiguousarray(rows).view(np.uint8))
    video.color_range, video.colorspace = colour_properties(frame.format)
    return video


def _fill(plane: Any, rows: Any) -> None:
    if rows.flags.c_contiguous and rows.nbytes == plane.buffer_size:
        plane.update(rows)  # a single copy
        return
    plane_rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
    plane_rows[: rows.shape[0], : rows.shape[1]] = rows
