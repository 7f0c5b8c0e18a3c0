"""Pixel formats by their names in GenICam's PFNC and in V4L2, and how their bytes become arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import FrameFormatError

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """How the pixels of a frame lie in its bytes.

    Attributes:
        name: of PFNC, as ``Mono8``; where PFNC has none the usual one, as ``NV12`` or ``MJPEG``.
        fourcc: of V4L2, as ``GREY``, or "" where V4L2 has none.
        bits: of a pixel; 0: it is compressed.
    """

    name: str
    fourcc: str
    bits: int

    def array(
        self, data: bytes | bytearray | memoryview, width: int, height: int, stride: int
    ) -> NDArray[Any]:
        """Return the pixels as they are; see :meth:`smartcam.frames.Frame.array`."""
        if len(data) < stride * height:
            raise FrameFormatError(
                f"{self.name} {width}x{height}: expected {stride * height} bytes, got {len(data)}"
            )
        rows = np.frombuffer(data, np.uint8, stride * height).reshape(height, stride)
        return rows[:, : width * self.bits // 8]

    def grey(
        self, data: bytes | bytearray | memoryview, width: int, height: int, stride: int
    ) -> NDArray[Any]:
        """Return the brightness; see :meth:`smartcam.frames.Frame.grey`."""
        return self.array(data, width, height, stride)

    def rgb(
        self, data: bytes | bytearray | memoryview, width: int, height: int, stride: int
    ) -> NDArray[Any]:
        """Return the colours; see :meth:`smartcam.frames.Frame.rgb`."""
        return np.repeat(self.array(data, width, height, stride)[..., None], 3, axis=2)


PIXEL_FORMATS = (
    PixelFormat("Mono8", "GREY", 8),
    PixelFormat("YUV422_8", "YUYV", 16),
    PixelFormat("YUV422_8_UYVY", "UYVY", 16),
)
"""All formats that are known."""


def find_format(name: str) -> PixelFormat:
    """Return the format that PFNC, or V4L2, calls so; small letters do, too.

    Raises:
        FrameFormatError: there is none; the text lists the known ones.
    """
    for one in PIXEL_FORMATS:
        if name.upper() in (one.name.upper(), one.fourcc.upper()):
            return one
    known = [one.name for one in PIXEL_FORMATS]
    raise FrameFormatError(
        f"unknown pixel format {name!r}; known are {', '.join(known)}{did_you_mean(name, known)}",
        available=tuple(known),
    )
