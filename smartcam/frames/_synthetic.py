"""Synthetic frames without a camera, with number and time drawn into the picture."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._extras import load
from smartcam.frames._driver import StreamFormat, TaskDriver
from smartcam.frames._frame import Frame, Moment
from smartcam.frames._pixels.formats import find_format

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from smartcam.frames._address import FrameAddress
    from smartcam.frames._driver import FrameSink
    from smartcam.frames._pixels.formats import PixelFormat


STAMP_BITS: Final = 64
"""Number of bits of each of the two numbers in a stamp."""

BIT_SIDE_PX: Final = 4
"""Side of the square that shows a bit, pixels."""

MIN_SIZE_PX: Final = (STAMP_BITS * BIT_SIDE_PX, 4 * BIT_SIDE_PX)
"""Width and height, in pixels, of the smallest picture that has room for a stamp."""


class SyntheticDriver(TaskDriver):
    """Moving stripes with a stamp: ``synthetic://?size=640x480&fps=30&format=YUYV``.

    Formats are Mono8, YUYV, RGB8, Z16 (distances in millimetres) and MJPEG.

    The stamp is squares in the upper left corner, one for each bit of two numbers: the frame's
    number, and ``time.monotonic_ns()`` at its capture. :func:`read_stamp` reads the stamp, also
    after a lossy codec.
    """

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        parameters = address.parameters(["size", "fps", "name", "format"])
        self._size = address.size(parameters.get("size", "640x480"))
        if self._size[0] < MIN_SIZE_PX[0] or self._size[1] < MIN_SIZE_PX[1]:
            raise address.wrong(
                "size",
                f"{MIN_SIZE_PX[0]}x{MIN_SIZE_PX[1]} or more, room for the stamp",
                parameters["size"],
            )
        self._format = _format(address, parameters.get("format", "Mono8"))
        self._rate = address.number("fps", parameters.get("fps", "30"), 0.01, 10_000)
        self._name = parameters.get("name", "synthetic")
        self._sequence = 0

    @property
    def name(self) -> str:
        """Name from the URL."""
        return self._name

    async def open(self) -> StreamFormat:
        """Return the format, size and rate of the pictures drawn.

        Raises:
            MissingExtraError: the format is MJPEG, and the extra ``frames`` is not installed.
        """
        _FORMATS[self._format.name](stripes(*self._size))
        return StreamFormat(self._format, *self._size, (self._rate,))

    async def deliver(self, sink: FrameSink) -> None:
        """Draw pictures."""
        width, height = self._size
        picture = stripes(width, height)
        encode = _FORMATS[self._format.name]
        loop = asyncio.get_running_loop()
        started_at, count = loop.time(), 0
        while True:
            count += 1
            await asyncio.sleep(started_at + count / self._rate - loop.time())
            self._sequence += 1
            missed = int((loop.time() - started_at) * self._rate) - count  # not drawn in time
            if missed > 0:
                count += missed
                self._sequence += missed
            now = time.monotonic_ns()
            stamped = np.roll(picture, self._sequence % width, axis=1)
            write_stamp(stamped, self._sequence, now)
            sink.frame(
                Frame(
                    data=encode(stamped),
                    format=self._format,
                    width=width,
                    height=height,
                    stride=self._format.stride(width),
                    captured=now / 1e9,
                    utc=time.time() - (time.monotonic_ns() - now) / 1e9,
                    moment=Moment.EXPOSURE_START,
                    sequence=self._sequence,
                    lost=max(0, missed),
                    source=self.name,
                )
            )


def _to_yuyv(picture: NDArray[np.uint8]) -> bytes:
    even = np.pad(picture, ((0, 0), (0, picture.shape[1] % 2)))
    return np.stack((even, np.full_like(even, 128)), axis=-1).tobytes()


def _to_jpeg(picture: NDArray[np.uint8]) -> bytes:
    data: bytes = load("simplejpeg").encode_jpeg(picture[..., None], 85, "GRAY", "Gray")
    return data


_FORMATS: Final[dict[str, Callable[[NDArray[np.uint8]], bytes | memoryview]]] = {
    "Mono8": lambda picture: picture.data.toreadonly().cast("B"),
    "YUV422_8": _to_yuyv,
    "RGB8": lambda picture: np.repeat(picture[..., None], 3, axis=2).tobytes(),
    "Coord3D_C16": lambda picture: (picture.astype("<u2") * 16).tobytes(),
    "MJPEG": _to_jpeg,
}
"""Functions that convert a grey picture to a format's bytes."""


def _format(address: FrameAddress, name: str) -> PixelFormat:
    pixel_format = find_format(name)
    if pixel_format.name not in _FORMATS:
        raise address.wrong("format", f"one of {', '.join(_FORMATS)}", name)
    return pixel_format


def stripes(width: int, height: int) -> NDArray[np.uint8]:
    """Return a picture of soft stripes, (height, width)."""
    row = 128 + 80 * np.sin(np.arange(width) * (2 * np.pi * 8 / width))
    fade = np.linspace(1.0, 0.4, height)[:, None]
    picture: NDArray[np.uint8] = (row * fade).astype(np.uint8)
    return picture


def write_stamp(picture: NDArray[np.uint8], number: int, nanoseconds: int) -> None:
    """Draw a stamp into the upper left corner of (H, W) or (H, W, C)."""
    for row, value in enumerate((number, nanoseconds)):
        for half, encoded in enumerate((value, ~value)):  # the complement reveals a torn stamp
            bits = (encoded >> np.arange(STAMP_BITS, dtype=object)) & 1
            cells = np.repeat(np.array(bits, np.uint8) * 219 + 16, BIT_SIDE_PX)
            top = (2 * row + half) * BIT_SIDE_PX
            band = picture[top : top + BIT_SIDE_PX, : STAMP_BITS * BIT_SIDE_PX]
            band[...] = cells if picture.ndim == 2 else cells[:, None]


def read_stamp(picture: NDArray[Any]) -> tuple[int, int] | None:
    """Return the number and the ``time.monotonic_ns()`` that a picture was stamped with.

    Args:
        picture: (H, W) or (H, W, C), also after a lossy codec; for depth the distances.

    Returns:
        None if there is no stamp, or it is damaged.
    """
    if picture.shape[0] < MIN_SIZE_PX[1] or picture.shape[1] < MIN_SIZE_PX[0]:
        return None
    grey = picture if picture.ndim == 2 else picture.mean(axis=2)
    cells = grey[: 4 * BIT_SIDE_PX, : STAMP_BITS * BIT_SIDE_PX].reshape(
        4, BIT_SIDE_PX, STAMP_BITS, BIT_SIDE_PX
    )
    means = cells[:, 1:-1, :, 1:-1].mean(axis=(1, 3))
    bits = means > (means.min() + means.max()) / 2
    if (bits[0::2] == bits[1::2]).any():
        return None
    weights = [1 << bit for bit in range(STAMP_BITS)]
    number, nanoseconds = (
        sum(weight for weight, square in zip(weights, row, strict=True) if square)
        for row in bits[0::2]
    )
    return number, nanoseconds
