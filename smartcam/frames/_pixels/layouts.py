"""Make arrays of a frame's bytes: by samples, by planes, or through a codec."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from smartcam.exceptions import FrameFormatError
from smartcam.frames._codecs.jpeg import decode_jpeg
from smartcam.frames._pixels.apart import PlanesApart
from smartcam.frames._pixels.colours import MATRICES, Colours, yuv_to_rgb
from smartcam.frames._pixels.compiled import pairs_to_rgb
from smartcam.frames._pixels.unpacking import Packing, unpack

logger: logging.Logger = logging.getLogger("smartcam.frames")

if TYPE_CHECKING:
    from numpy.typing import NDArray


class RawPicture(NamedTuple):
    """The bytes of a frame and their declared format and size.

    Attributes:
        format: name of the format, for errors.
        data: bytes of the picture; for the brightness alone also :class:`PlanesApart`.
        width: pixels.
        height: pixels.
        stride: bytes from one row to the next.
    """

    format: str
    data: Any
    width: int
    height: int
    stride: int

    def wrong(self, expected: str, got: str) -> FrameFormatError:
        """Return the error of bytes that are no such picture."""
        return FrameFormatError(
            f"{self.format} {self.width}x{self.height}: expected {expected}, got {got}"
        )


class PixelLayout(ABC):
    """The layout of a format's pixels."""

    @property
    def grey_is_sent(self) -> bool:
        """True if :meth:`grey` is a part of what was sent."""
        return True

    @abstractmethod
    def least_stride(self, width: int) -> int:
        """Return the bytes of a row that nothing follows; 0: it has no rows."""

    @abstractmethod
    def size(self, width: int, height: int, stride: int) -> int:
        """Return the bytes of a picture at the least; 0: it is compressed."""

    @abstractmethod
    def array(self, picture: RawPicture) -> NDArray[Any]:
        """Return the pixels as they are."""

    @abstractmethod
    def grey(self, picture: RawPicture) -> NDArray[Any]:
        """Return the brightness."""

    @abstractmethod
    def rgb(self, picture: RawPicture) -> NDArray[Any]:
        """Return the colours."""

    def planes(self, picture: RawPicture) -> tuple[NDArray[np.uint8], ...]:
        """Return Y, U and V, where they are what was sent."""
        raise picture.wrong("a format of Y, U and V", "one without")

    def check(self, picture: RawPicture) -> None:
        """See that the bytes can be such a picture."""
        _, data, width, height, stride = picture
        if width < 1 or height < 1:
            raise picture.wrong("a width and a height of 1 or more", f"{width}x{height}")
        least = self.least_stride(width)
        if stride < least:
            raise picture.wrong(f"{least} bytes or more from row to row", str(stride))
        size = self.size(width, height, stride)
        came = memoryview(data).nbytes
        if came < size:
            raise picture.wrong(f"{size} bytes", str(came))


def _view(
    picture: RawPicture,
    dtype: str,
    shape: tuple[int, ...],
    strides: tuple[int, ...],
    offset: int = 0,
) -> NDArray[Any]:
    view: NDArray[Any] = np.ndarray(shape, dtype, picture.data, offset, strides)
    view.flags.writeable = False
    return view


@dataclass(frozen=True, slots=True)
class SampleLayout(PixelLayout):
    """One or more samples a pixel, one pixel after the other.

    A packed format with a stride of 0 has rows that follow each other within a byte.

    Attributes:
        colours: what they mean.
        size_of: bytes of a sample; unpacked to, where they are packed.
        channels: samples of a pixel.
        packing: how they share bytes.
    """

    colours: Colours
    size_of: int = 1
    channels: int = 1
    packing: Packing | None = None

    @property
    def grey_is_sent(self) -> bool:
        """True if the samples are the brightness."""
        return self.colours.is_grey

    def least_stride(self, width: int) -> int:
        """Return the bytes of a row."""
        if self.packing is None:
            return width * self.channels * self.size_of
        return -(-width * self.packing.size // len(self.packing.pixels))

    def size(self, width: int, height: int, stride: int) -> int:
        """Return the bytes up to the last pixel."""
        if self.packing is not None and stride == 0:
            return self.least_stride(width * height)
        return stride * (height - 1) + self.least_stride(width)

    def check(self, picture: RawPicture) -> None:
        """See that the bytes can be such a picture."""
        if self.packing is not None and picture.stride == 0:
            width = picture.width * picture.height
            picture = picture._replace(width=width, height=1, stride=self.least_stride(width))
        PixelLayout.check(self, picture)

    def array(self, picture: RawPicture) -> NDArray[Any]:
        """Return (H, W) or (H, W, C), a view; packed ones unpacked to uint16."""
        self.check(picture)
        _, _, width, height, stride = picture
        if self.packing is None:
            shape = (height, width, self.channels)
            strides = (stride, self.channels * self.size_of, self.size_of)
            view = _view(picture, f"<u{self.size_of}", shape, strides)
            return view if self.channels > 1 else view[..., 0]
        rows, row = (height, width) if stride else (1, width * height)
        bytes_of = _view(picture, "u1", (rows, self.least_stride(row)), (stride, 1))
        unpacked = unpack(bytes_of, row, self.packing).reshape(height, width)
        unpacked.flags.writeable = False
        return unpacked

    def grey(self, picture: RawPicture) -> NDArray[Any]:
        """Return the brightness; of colours BT.601's Y, of a Bayer pattern a demosaiced one."""
        if self.colours.grey is None:
            raise picture.wrong("a format with brightness", "distances")
        return self.colours.grey(self.array(picture))

    def rgb(self, picture: RawPicture) -> NDArray[Any]:
        """Return the colours; of a grey format its grey three times."""
        if self.colours.rgb is None:
            raise picture.wrong("a format with colours", "distances")
        return self.colours.rgb(self.array(picture))


@dataclass(frozen=True, slots=True)
class YuvPairs(PixelLayout):
    """Two pixels in four bytes: each has its Y, both share U and V.

    Attributes:
        y: where in a pixel's two bytes Y is; U and V stand in the other.
        matrix: what they mean, by the name in ``MATRICES``.
    """

    y: int
    matrix: str

    def least_stride(self, width: int) -> int:
        """Return the bytes of all pairs of a row."""
        return (width + 1) // 2 * 4

    def size(self, width: int, height: int, stride: int) -> int:
        """Return the bytes up to the last pair."""
        return stride * (height - 1) + self.least_stride(width)

    def array(self, picture: RawPicture) -> NDArray[Any]:
        """Return (H, W, 2): Y and, by turns, U and V, in the order of the format."""
        self.check(picture)
        _, _, width, height, stride = picture
        return _view(picture, "u1", (height, width, 2), (stride, 2, 1))

    def planes(self, picture: RawPicture) -> tuple[NDArray[np.uint8], ...]:
        """Return (H, W), (H, W/2) and (H, W/2), views."""
        self.check(picture)
        _, _, width, height, stride = picture
        pairs = (height, (width + 1) // 2)
        y = _view(picture, "u1", (height, width), (stride, 2), self.y)
        u, v = (_view(picture, "u1", pairs, (stride, 4), 1 - self.y + more) for more in (0, 2))
        return y, u, v

    def grey(self, picture: RawPicture) -> NDArray[Any]:
        """Return Y, a view."""
        return self.planes(picture)[0]

    def rgb(self, picture: RawPicture) -> NDArray[Any]:
        """Return the colours."""
        pairs = self.array(picture)
        usual = self.matrix == "601" and picture.width % 2 == 0
        made = pairs_to_rgb(pairs, self.y) if usual else None
        if made is not None:
            return made
        y, *_ = self.planes(picture)
        _, _, width, height, stride = picture
        shape = (height, (width + 1) // 2, 2)
        chroma = _view(picture, "u1", shape, (stride, 4, 2), 1 - self.y)
        return yuv_to_rgb(y, [chroma], MATRICES[self.matrix])


@dataclass(frozen=True, slots=True)
class Planes(PixelLayout):
    """Y, then U and V of every pixel, pair or four; the rows of all follow from Y's stride.

    Attributes:
        across: pixels along a row that share a U and a V.
        down: rows that do.
        woven: U and V stand in one plane by turns, whose stride is Y's; else each has its own.
        matrix: what they mean, by the name in ``MATRICES``.
        depth: bits of a sample; more than 8 stand in two bytes, the low one first.
    """

    across: int
    down: int
    woven: bool
    matrix: str
    depth: int = 8

    @property
    def size_of(self) -> int:
        """Bytes of a sample."""
        return 1 if self.depth == 8 else 2

    def least_stride(self, width: int) -> int:
        """Return the bytes of a row of Y, or of U and V where these have more."""
        return self.size_of * (-(-width // self.across) * 2 if self.woven else width)

    def _chroma(self, width: int, height: int, stride: int) -> tuple[int, int, int]:
        """Return the width, height and stride of U and V."""
        return -(-width // self.across), -(-height // self.down), self.chroma_stride(stride)

    def chroma_stride(self, stride: int) -> int:
        """Return the bytes from row to row of U and V."""
        samples = stride // self.size_of
        return stride if self.woven else self.size_of * -(-samples // self.across)

    def size(self, width: int, height: int, stride: int) -> int:
        """Return the bytes of all planes."""
        _, rows, own = self._chroma(width, height, stride)
        return stride * height + own * rows * (1 if self.woven else 2)

    def array(self, picture: RawPicture) -> NDArray[Any]:
        """Return the bytes, (N,)."""
        self.check(picture)
        size = self.size(picture.width, picture.height, picture.stride)
        return _view(picture, "u1", (size,), (1,))

    def planes(self, picture: RawPicture) -> tuple[NDArray[np.uint8], ...]:
        """Return Y, U and V, views."""
        self.check(picture)
        _, _, width, height, stride = picture
        across, down, own = self._chroma(width, height, stride)
        size, kind = self.size_of, f"<u{self.size_of}"
        y = _view(picture, kind, (height, width), (stride, size))
        begin, step = stride * height, size * (2 if self.woven else 1)
        apart = size if self.woven else own * down
        u, v = (
            _view(picture, kind, (down, across), (own, step), begin + place) for place in (0, apart)
        )
        return y, u, v

    def grey(self, picture: RawPicture) -> NDArray[Any]:
        """Return Y, a view."""
        if isinstance(picture.data, PlanesApart):  # a decoder's: it has all planes
            picture = picture._replace(data=picture.data.first)
        else:
            self.check(picture)
        _, _, width, height, stride = picture
        return _view(picture, f"<u{self.size_of}", (height, width), (stride, self.size_of))

    def rgb(self, picture: RawPicture) -> NDArray[Any]:
        """Return the colours."""
        y, *chroma = self.planes(picture)
        if self.woven:
            shape, strides = (*chroma[0].shape, 2), (*chroma[0].strides, self.size_of)
            begin = picture.stride * picture.height
            chroma = [_view(picture, f"<u{self.size_of}", shape, strides, begin)]
        return yuv_to_rgb(y, chroma, MATRICES[self.matrix], self.depth)


@dataclass(frozen=True, slots=True)
class Compressed(PixelLayout):
    """Bytes that only a codec reads.

    Attributes:
        reader: name of what reads the bytes, for errors.
    """

    reader: str

    @property
    def grey_is_sent(self) -> bool:
        """No."""
        return False

    def least_stride(self, width: int) -> int:
        """Return 0."""
        return 0

    def size(self, width: int, height: int, stride: int) -> int:
        """Return 0."""
        return 0

    def array(self, picture: RawPicture) -> NDArray[Any]:
        """Return the bytes, (N,)."""
        return _view(picture, "u1", (memoryview(picture.data).nbytes,), (1,))

    def grey(self, picture: RawPicture) -> NDArray[Any]:
        """Raise."""
        raise picture.wrong(f"pixels, which {self.reader} makes", "compressed bytes")

    def rgb(self, picture: RawPicture) -> NDArray[Any]:
        """Raise."""
        raise picture.wrong(f"pixels, which {self.reader} makes", "compressed bytes")


@dataclass(frozen=True, slots=True)
class Jpeg(Compressed):
    """JPEG: its luma is what it was sent for grey."""

    reader: str = "Codecs.decode"

    @property
    def grey_is_sent(self) -> bool:
        """Always True: the luma is read, and no colour made."""
        return True

    def grey(self, picture: RawPicture) -> NDArray[Any]:
        """Return the luma."""
        return self._decoded(picture, "GRAY")[..., 0]

    def rgb(self, picture: RawPicture) -> NDArray[Any]:
        """Return the colours."""
        return self._decoded(picture, "RGB")

    def _decoded(self, picture: RawPicture, colours: str) -> NDArray[np.uint8]:
        size = (picture.width, picture.height)
        decoded = decode_jpeg(picture.data, colours, size, picture.format)
        if decoded.remark:
            logger.debug("%s %dx%d: %s", picture.format, *size, decoded.remark)
        return decoded.pixels
