"""Define pixel formats by their names in GenICam's PFNC and in V4L2."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

from smartcam._arguments import check_integer, check_text
from smartcam._suggestions import did_you_mean
from smartcam.exceptions import FrameFormatError
from smartcam.frames._pixels.colours import COLOURS
from smartcam.frames._pixels.layouts import (
    Compressed,
    Jpeg,
    PixelLayout,
    Planes,
    RawPicture,
    SampleLayout,
    YuvPairs,
)
from smartcam.frames._pixels.unpacking import PACKINGS

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """The format of a frame's pixels in its bytes.

    Attributes:
        name: name in PFNC, such as ``Mono8``; without one, the usual name, such as ``NV12`` or
            ``MJPEG``.
        fourcc: four letters of V4L2, such as ``GREY``, without blanks at the end; "": not in V4L2.
        bits: number of bits of a pixel, unused ones included; 0 for a compressed format.
        code: PFNC's code of 32 bits, as in GigE Vision; 0: not in PFNC.
        depth: number of significant bits of a sample.
        layout: layout of the bytes.
    """

    name: str
    fourcc: str
    bits: int
    code: int = 0
    depth: int = 8
    layout: PixelLayout = field(kw_only=True, repr=False, compare=False)

    def __reduce__(self) -> tuple[Callable[[str], PixelFormat], tuple[str]]:
        """Return a function and the name by which another process finds the format."""
        return find_format, (self.name,)

    @property
    def compressed(self) -> bool:
        """True if only a codec reads the format."""
        return self.bits == 0

    @property
    def grey_is_sent(self) -> bool:
        """True if the camera sends the brightness; else :meth:`Frame.grey` computes it."""
        return self.layout.grey_is_sent

    def stride(self, width: int) -> int:
        """Return the bytes of a row without padding; 0: the format is compressed."""
        return self.layout.min_stride(width)

    def size(self, width: int, height: int, stride: int | None = None) -> int:
        """Return the bytes of a picture; 0: the format is compressed.

        Args:
            width: pixels.
            height: pixels.
            stride: bytes from one row to the next; None: no padding. The last row may lack its
                padding if the format has only one plane.
        """
        return self.layout.size(width, height, self.stride(width) if stride is None else stride)

    def check(
        self, data: bytes | bytearray | memoryview, width: int, height: int, stride: int
    ) -> None:
        """Check that there are enough bytes.

        Raises:
            FrameFormatError: there are too few bytes.
        """
        self.layout.check(RawPicture(self.name, data, width, height, stride))

    def array(
        self, data: bytes | bytearray | memoryview, width: int, height: int, stride: int
    ) -> NDArray[Any]:
        """Return the pixels without conversion; see :meth:`smartcam.frames.Frame.array`."""
        return self.layout.array(RawPicture(self.name, data, width, height, stride))

    def planes(
        self, data: bytes | bytearray | memoryview, width: int, height: int, stride: int
    ) -> tuple[NDArray[np.uint8], ...]:
        """Return Y, U and V of a format that has them, as views; U and V keep their size.

        Raises:
            FrameFormatError: the format has no such planes, or there are too few bytes.
        """
        return self.layout.planes(RawPicture(self.name, data, width, height, stride))

    def grey(
        self, data: bytes | bytearray | memoryview, width: int, height: int, stride: int
    ) -> NDArray[Any]:
        """Return the brightness; see :meth:`smartcam.frames.Frame.grey`."""
        return self.layout.grey(RawPicture(self.name, data, width, height, stride))

    def rgb(
        self, data: bytes | bytearray | memoryview, width: int, height: int, stride: int
    ) -> NDArray[Any]:
        """Return the colours; see :meth:`smartcam.frames.Frame.rgb`."""
        return self.layout.rgb(RawPicture(self.name, data, width, height, stride))


def _samples(
    name: str, fourcc: str, code: int, depth: int, colours: str, channels: int = 1
) -> PixelFormat:
    """Return a format of samples in whole bytes."""
    size = (depth + 7) // 8
    layout = SampleLayout(COLOURS[colours], size, channels)
    return PixelFormat(name, fourcc, 8 * size * channels, code, depth, layout=layout)


def _packed(name: str, code: int, colours: str) -> PixelFormat:
    """Return a format of packed samples; the second byte of the code has the bits per pixel."""
    packing = PACKINGS[next(suffix for suffix in PACKINGS if name.endswith(suffix))]
    depth = 10 if "10" in name else 12
    layout = SampleLayout(COLOURS[colours], 2, packing=packing)
    return PixelFormat(name, "", code >> 16 & 0xFF, code, depth, layout=layout)


def _pairs(name: str, fourcc: str, code: int, y: int, matrix: str) -> PixelFormat:
    return PixelFormat(name, fourcc, 16, code, layout=YuvPairs(y, matrix))


def _planes(
    name: str, fourcc: str, chroma_x: int, chroma_y: int, matrix: str, depth: int = 8
) -> PixelFormat:
    """Return a format of planes; U and V are interleaved if its name begins with NV."""
    layout = Planes(chroma_x, chroma_y, name.startswith("NV"), matrix, depth)
    bits = 8 * layout.sample_bytes * (chroma_x * chroma_y + 2) // (chroma_x * chroma_y)
    return PixelFormat(name, fourcc, bits, 0, depth, layout=layout)


_MATRIX_SUFFIXES: Final = (
    ("", "601"),
    ("_full", "601 full"),
    ("_709", "709"),
    ("_709_full", "709 full"),
    ("_2020", "2020"),
    ("_2020_full", "2020 full"),
)
"""Suffixes of names, each with its matrix and range."""


_BAYER: Final = {
    "GR": ("GRBG", "BA10", "BA12", "GR16"),
    "RG": ("RGGB", "RG10", "RG12", "RG16"),
    "GB": ("GBRG", "GB10", "GB12", "GB16"),
    "BG": ("BA81", "BG10", "BG12", "BYR2"),
}
"""V4L2's names of 8, 10, 12 and 16 bits, in the order of PFNC's codes."""

_BAYER_CODES: Final = ((8, 0x01080008), (10, 0x0110000C), (12, 0x01100010), (16, 0x0110002E))
"""Bits per sample, and the code of the first of the four patterns."""

_BAYER_PACKED: Final = (
    ("10Packed", {"GR": 0x010C0026, "RG": 0x010C0027, "GB": 0x010C0028, "BG": 0x010C0029}),
    ("12Packed", {"GR": 0x010C002A, "RG": 0x010C002B, "GB": 0x010C002C, "BG": 0x010C002D}),
    ("10p", {"GR": 0x010A0056, "RG": 0x010A0058, "GB": 0x010A0054, "BG": 0x010A0052}),
    ("12p", {"GR": 0x010C0057, "RG": 0x010C0059, "GB": 0x010C0055, "BG": 0x010C0053}),
)

PIXEL_FORMATS: Final = (
    _samples("Mono8", "GREY", 0x01080001, 8, "grey"),
    _samples("Mono10", "Y10", 0x01100003, 10, "grey"),
    _samples("Mono12", "Y12", 0x01100005, 12, "grey"),
    _samples("Mono14", "Y14", 0x01100025, 14, "grey"),
    _samples("Mono16", "Y16", 0x01100007, 16, "grey"),
    _packed("Mono10Packed", 0x010C0004, "grey"),
    _packed("Mono12Packed", 0x010C0006, "grey"),
    _packed("Mono10p", 0x010A0046, "grey"),
    _packed("Mono12p", 0x010C0047, "grey"),
    *(
        _samples(f"Bayer{pattern}{depth}", fourccs[column], code + row, depth, pattern)
        for row, (pattern, fourccs) in enumerate(_BAYER.items())
        for column, (depth, code) in enumerate(_BAYER_CODES)
    ),
    *(
        _packed(f"Bayer{pattern}{suffix}", code, pattern)
        for suffix, codes in _BAYER_PACKED
        for pattern, code in codes.items()
    ),
    _samples("RGB8", "RGB3", 0x02180014, 8, "rgb", 3),
    _samples("BGR8", "BGR3", 0x02180015, 8, "bgr", 3),
    _samples("RGB8_limited", "", 0, 8, "rgb limited", 3),
    _samples("BGR8_limited", "", 0, 8, "bgr limited", 3),
    _samples("RGB16", "", 0x02300033, 16, "rgb", 3),
    _samples("RGBa8", "AB24", 0x02200016, 8, "rgba", 4),
    _samples("BGRa8", "AR24", 0x02200017, 8, "bgra", 4),
    _samples("RGBa16", "", 0x02400064, 16, "rgba", 4),
    _samples("Coord3D_C16", "Z16", 0x011000B8, 16, "depth"),
    _pairs("YUV422_8", "YUYV", 0x02100032, 0, "601"),
    _pairs("YUV422_8_UYVY", "UYVY", 0x0210001F, 1, "601"),
    _pairs("YCbCr422_8", "", 0x0210003B, 0, "601 full"),
    _pairs("YCbCr422_8_CbYCrY", "", 0x02100043, 1, "601 full"),
    _pairs("YCbCr601_422_8", "", 0x0210003E, 0, "601"),
    _pairs("YCbCr601_422_8_CbYCrY", "", 0x02100044, 1, "601"),
    _pairs("YCbCr709_422_8", "", 0x02100041, 0, "709"),
    _pairs("YCbCr709_422_8_CbYCrY", "", 0x02100045, 1, "709"),
    *(
        _pairs(f"{name}{suffix}", "", 0, y, matrix)
        for name, y in (("YUV422_8", 0), ("YUV422_8_UYVY", 1))
        for suffix, matrix in _MATRIX_SUFFIXES[3:]
    ),
    *(
        _planes(f"{name}{suffix}", "" if suffix else fourcc, chroma_x, chroma_y, matrix)
        for name, fourcc, chroma_x, chroma_y in (
            ("NV12", "NV12", 2, 2),
            ("I420", "YU12", 2, 2),
            ("I422", "422P", 2, 1),
            ("I444", "", 1, 1),
        )
        for suffix, matrix in _MATRIX_SUFFIXES
    ),
    *(
        _planes(f"{name}_{depth}{suffix}", "", chroma_x, chroma_y, matrix, depth)
        for name, chroma_x, chroma_y in (("I420", 2, 2), ("I422", 2, 1), ("I444", 1, 1))
        for depth in (10, 12, 16)
        for suffix, matrix in _MATRIX_SUFFIXES
    ),
    PixelFormat("MJPEG", "MJPG", 0, layout=Jpeg()),
    PixelFormat("PNG", "", 0, 0, 16, layout=Compressed("Codecs.decode")),
    PixelFormat("JPEGXL", "", 0, 0, 16, layout=Compressed("Codecs.decode")),
    PixelFormat("H264", "H264", 0, layout=Compressed("Codecs.h264_decoder")),
)
"""All known formats.

Y, U and V have BT.601 and limited range, the default of V4L2, unless the name says ``full`` range,
``709`` (BT.709) or ``2020`` (BT.2020). Red, green and blue have the full range, unless the name
says ``limited``. Source: PFNC 2.1 and its list of values, videodev2.h.
"""


def with_matrix(pixel_format: PixelFormat, matrix: str) -> PixelFormat:
    """Return the format with the same layout and another matrix of Y, U and V.

    Args:
        pixel_format: format with Y, U and V.
        matrix: name in ``MATRICES``, with the range.
    """
    layout: Any = pixel_format.layout
    wanted = replace(layout, matrix=matrix)
    return (
        pixel_format
        if wanted == layout
        else next(candidate for candidate in PIXEL_FORMATS if candidate.layout == wanted)
    )


_BY_EXACT_NAME: Final = {pixel_format.name: pixel_format for pixel_format in PIXEL_FORMATS}

_VARIANT_SUFFIXES: Final = ("_709", "_2020", "_full")

_ALIASES: Final = {"JPEG": "MJPEG", "YUY2": "YUV422_8"}

_BY_NAME: Final[dict[str | int, PixelFormat]] = {
    key: pixel_format
    for pixel_format in reversed(PIXEL_FORMATS)
    for key in (pixel_format.fourcc.upper(), pixel_format.code, pixel_format.name.upper())
    if key
}


def find_format(name: str | int) -> PixelFormat:
    """Return a format by its name in PFNC or V4L2, or by its code in PFNC.

    Args:
        name: name, in any case and with or without blanks at the end; or PFNC's code.

    Raises:
        FrameFormatError: there is no such format; the text lists the known ones.
    """
    exact = _BY_EXACT_NAME.get(name) if type(name) is str else None
    if exact is not None:
        return exact
    if isinstance(name, str):
        name = check_text(name, "pixel format")
    else:
        name = check_integer(name, "pixel format", 0, 0xFFFFFFFF)
    key = name if isinstance(name, int) else name.strip().upper()
    pixel_format = _BY_NAME.get(_ALIASES.get(key, key) if isinstance(key, str) else key)
    if pixel_format is not None:
        return pixel_format
    known = [pixel_format.name for pixel_format in PIXEL_FORMATS]
    listed = [
        format_name
        for format_name in known
        if not format_name.endswith((*_VARIANT_SUFFIXES, "_10", "_12", "_16"))
    ]
    shown, guess = (f"{name:#010x}", "") if isinstance(name, int) else (repr(name), None)
    raise FrameFormatError(
        f"unknown pixel format {shown}; known are {', '.join(listed)}, those "
        f"of Y, U and V also with _10, _12 or _16 and {', '.join(_VARIANT_SUFFIXES)} at the end"
        f"{did_you_mean(str(name), known) if guess is None else guess}",
        available=tuple(known),
    )
