"""Frames of FFmpeg, and ours: which pixel format is which, and whose bytes are whose."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam.exceptions import FrameFormatError
from smartcam.frames._layouts import Planes
from smartcam.frames._optional_imports import load
from smartcam.frames._pixels import find_format

if TYPE_CHECKING:
    from smartcam.frames._frame import Frame
    from smartcam.frames._pixels import PixelFormat


_SAMPLES: Final = {
    "gray": "Mono8",
    "gray10le": "Mono10",
    "gray12le": "Mono12",
    "gray16le": "Mono16",
    "rgb24": "RGB8",
    "bgr24": "BGR8",
}
_YUV: Final = {
    "yuv420p": "I420",
    "yuv422p": "I422",
    "yuv444p": "I444",
    "nv12": "NV12",
    "yuvj420p": "I420_full",
    "yuvj422p": "I422_full",
    "yuvj444p": "I444_full",
}
_OF_OURS: Final = {
    "YUV422_8": "yuyv422",
    "YUV422_8_UYVY": "uyvy422",
    "YCbCr422_8": "yuyv422",
    "YCbCr422_8_CbYCrY": "uyvy422",
    "YCbCr601_422_8": "yuyv422",
    "YCbCr601_422_8_CbYCrY": "uyvy422",
    "YCbCr709_422_8": "yuyv422",
    "YCbCr709_422_8_CbYCrY": "uyvy422",
    "RGB8": "rgb24",
    "BGR8": "bgr24",
    "NV12": "nv12",
    "I420": "yuv420p",
    "I422": "yuv422p",
    "I444": "yuv444p",
}
"""What FFmpeg calls ours; the range and the matrix stand beside it there."""

CONVERTIBLE: Final = {"RGB8": "rgb24", "BGR8": "bgr24", "Mono8": "gray"}
"""Formats that FFmpeg converts to for who asks, and what it calls them."""

LIMITED, FULL = 1, 2  # AVCOL_RANGE_MPEG, AVCOL_RANGE_JPEG
_RANGES: Final = {LIMITED: "MPEG", FULL: "JPEG"}  # as PyAV calls them
BT709, BT601 = 1, 6  # AVCOL_SPC_BT709, AVCOL_SPC_SMPTE170M


class Pixels(NamedTuple):
    """What of a decoded frame becomes one of ours.

    Attributes:
        format: of the pixels.
        width: pixels.
        height: pixels.
        stride: bytes from row to row.
        data: the decoder's own where its layout is ours, else a copy.
    """

    format: PixelFormat
    width: int
    height: int
    stride: int
    data: bytes | memoryview


def format_of(name: str, colour_range: int, space: int) -> PixelFormat:
    """Return our format of one of FFmpeg's.

    Args:
        name: as ``yuv420p``.
        colour_range: AVColorRange; 0, which is unknown, is the limited one.
        space: AVColorSpace; BT.709 if it says so, else BT.601, as FFmpeg takes it.

    Raises:
        FrameFormatError: we have none.
    """
    found = _SAMPLES.get(name)
    if found is None and name in _YUV:
        base, _, full = _YUV[name].partition("_")
        ends = ("709" if space == BT709 else "", "full" if full or colour_range == FULL else "")
        found = "_".join(filter(None, (base, *ends)))
    if found is None:
        known = (*_SAMPLES, *_YUV)
        raise FrameFormatError(
            f"FFmpeg's pixel format {name}: expected one of {', '.join(known)}", available=known
        )
    return find_format(found)


def from_video(video: Any) -> Pixels:
    """Return a decoded frame's pixels.

    Raises:
        FrameFormatError: we have no such format.
    """
    found = format_of(video.format.name, video.color_range, video.colorspace)
    planes = video.planes
    stride = planes[0].line_size
    if len(planes) == 1:
        data = memoryview(planes[0]).toreadonly()
        return Pixels(found, video.width, video.height, stride, data)
    layout = found.layout
    fits = isinstance(layout, Planes) and all(
        plane.line_size == (stride if layout.woven else -(-stride // layout.across))
        for plane in planes[1:]
    )
    joined = b"".join(planes) if fits else b"".join(_tight(plane, found) for plane in planes)
    if not fits:
        stride = found.stride(video.width)
    return Pixels(found, video.width, video.height, stride, joined)


def _tight(plane: Any, found: PixelFormat) -> bytes:
    """Return the rows of a plane without padding."""
    rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
    return rows[
        :, : plane.width * (2 if found.name.startswith("NV") and plane.index else 1)
    ].tobytes()


def colour_properties(found: PixelFormat) -> tuple[int, int]:
    """Return AVColorRange and AVColorSpace of a format."""
    full = found.name in ("Mono8", "RGB8", "BGR8", "YCbCr422_8", "YCbCr422_8_CbYCrY")
    space = BT709 if "709" in found.name else BT601
    return FULL if full or found.name.endswith("_full") else LIMITED, space


def to_video(frame: Frame) -> Any:
    """Return a frame for an encoder of 4:2:0: its Y as it is; U and V of more pixels averaged.

    Grey gets a U and a V without colour. RGB becomes BT.601 of limited range.

    Raises:
        FrameFormatError: the encoder knows no way from this format, or the size is odd.
    """
    name = frame.format.name
    base = name.split("_")[0] if name.startswith(("I4", "NV")) else name
    if name != "Mono8" and base not in _OF_OURS:
        known = ("Mono8", *_OF_OURS)
        raise FrameFormatError(
            f"{frame.source}: {name} cannot become video as it is; what can: {', '.join(known)}; "
            "see Codecs.converted",
            source=frame.source,
            available=known,
        )
    if frame.width % 2 or frame.height % 2:
        raise FrameFormatError(
            f"{frame.source}: video wants an even width and height, got "
            f"{frame.width}x{frame.height}",
            source=frame.source,
        )
    if name == "Mono8":
        return _from_grey(frame)
    video = _filled(frame, _OF_OURS[base])
    if base in ("I420", "NV12"):
        return video
    kept, space = colour_properties(frame.format)
    to = LIMITED if name in ("RGB8", "BGR8") else kept
    made = video.reformat(
        format="yuv420p", src_color_range=_RANGES[kept], dst_color_range=_RANGES[to]
    )
    made.color_range, made.colorspace = to, space
    return made


def _new(width: int, height: int, name: str) -> Any:
    return load("av").VideoFrame(width, height, name)


def _from_grey(frame: Frame) -> Any:
    video = _new(frame.width, frame.height, "yuv420p")
    _fill(video.planes[0], frame.array())
    for plane in video.planes[1:]:
        plane.update(b"\x80" * plane.buffer_size)
    video.color_range, video.colorspace = colour_properties(frame.format)
    return video


def _filled(frame: Frame, name: str) -> Any:
    video = _new(frame.width, frame.height, name)
    layout = frame.format.layout
    if isinstance(layout, Planes):
        y, u, v = frame.format.planes(frame.data, frame.width, frame.height, frame.stride)
        parts = [y, np.stack((u, v), axis=-1)] if layout.woven else [y, u, v]
    else:
        parts = [frame.array()]
    for plane, part in zip(video.planes, parts, strict=True):
        _fill(plane, part.reshape(part.shape[0], -1))
    video.color_range, video.colorspace = colour_properties(frame.format)
    return video


def _fill(plane: Any, rows: Any) -> None:
    whole = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
    whole[: rows.shape[0], : rows.shape[1]] = rows
