"""Convert a frame's bytes to arrays: from samples, from planes, or through a codec."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from smartcam.exceptions import FrameFormatError
from smartcam.frames._codecs.jpeg import decode_jpeg
from smartcam.frames._pixels.apart import SeparatePlanes
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
        data: bytes of the picture; the brightness is also read from :class:`SeparatePlanes`.
        width: pixels.
        height: pixels.
        stride: bytes from one row to the next.
    """

    format: str
    data: Any
    width: int
    height: int
    stride: int

    def format_error(self, expected: str, actual: str) -> FrameFormatError:
        """Return the error for bytes that do not fit the format."""
        return FrameFormatError(
            f"{self.format} {self.width}x{self.height}: expected {expected}, got {actual}"
        )


class PixelLayout(ABC):
    """The layout of a format's pixels."""

    @property
    def grey_is_sent(self) -> bool:
        """True if the sent bytes contain the brightness, which :meth:`grey` returns."""
        return True

    @abstractmethod
    def min_stride(self, width: int) -> int:
        """Return the number of bytes of a row without padding; 0 if there are no rows."""

    @abstractmethod
    def size(self, width: int, height: int, stride: int) -> int:
        """Return the least number of bytes of a picture; 0 if it is compressed."""

    @abstractmethod
    def array(self, picture: RawPicture) -> NDArray[Any]:
        """Return the pixels without conversion."""

    @abstractmethod
    def grey(self, picture: RawPicture) -> NDArray[Any]:
        """Return the brightness."""

    @abstractmethod
    def rgb(self, picture: RawPicture) -> NDArray[Any]:
        """Return the colours."""

    def planes(self, picture: RawPicture) -> tuple[NDArray[np.uint8], ...]:
        """Return Y, U and V, if they were sent."""
        raise picture.format_error("a format of Y, U and V", "a format without them")

    def check(self, picture: RawPicture) -> None:
        """Check that the bytes can be a picture of this layout."""
        _, data, width, height, stride = picture
        if width < 1 or height < 1:
            raise picture.format_error("a width and a height of 1 or more", f"{width}x{height}")
        min_stride = self.min_stride(width)
        if stride < min_stride:
            raise picture.format_error(f"{min_stride} bytes or more from row to row", str(stride))
        size = self.size(width, height, stride)
        length = memoryview(data).nbytes
        if length < size:
            raise picture.format_error(f"{size} bytes", str(length))


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
    """One or more samples per pixel, one pixel after the other.

    With a stride of 0, packed rows have no padding, so a row may begin within a byte.

    Attributes:
        colours: conversions of the samples.
        sample_bytes: number of bytes of a sample, after unpacking if it is packed.
        channels: samples of a pixel.
        packing: positions of packed samples in shared bytes; None: the samples are not packed.
    """

    colours: Colours
    sample_bytes: int = 1
    channels: int = 1
    packing: Packing | None = None

    @property
    def grey_is_sent(self) -> bool:
        """True if the samples are the brightness."""
        return self.colours.is_grey

    def min_stride(self, width: int) -> int:
        """Return the bytes of a row."""
        if self.packing is None:
            return width * self.channels * self.sample_bytes
        return -(-width * self.packing.size // len(self.packing.pixels))

    def size(self, width: int, height: int, stride: int) -> int:
        """Return the bytes up to the last pixel."""
        if self.packing is not None and stride == 0:
            return self.min_stride(width * height)
        return stride * (height - 1) + self.min_stride(width)

    def check(self, picture: RawPicture) -> None:
        """Check that the bytes can be a picture of this layout."""
        if self.packing is not None and picture.stride == 0:
            width = picture.width * picture.height
            picture = picture._replace(width=width, height=1, stride=self.min_stride(width))
        PixelLayout.check(self, picture)

    def array(self, picture: RawPicture) -> NDArray[Any]:
        """Return (H, W) or (H, W, C), as a view, or for packed samples as uint16."""
        self.check(picture)
        _, _, width, height, stride = picture
        if self.packing is None:
            shape = (height, width, self.channels)
            strides = (stride, self.channels * self.sample_bytes, self.sample_bytes)
            view = _view(picture, f"<u{self.sample_bytes}", shape, strides)
            return view if self.channels > 1 else view[..., 0]
        row_count, row_width = (height, width) if stride else (1, width * height)
        packed = _view(picture, "u1", (row_count, self.min_stride(row_width)), (stride, 1))
        unpacked = unpack(packed, row_width, self.packing).reshape(height, width)
        unpacked.flags.writeable = False
        return unpacked

    def grey(self, picture: RawPicture) -> NDArray[Any]:
        """Return the brightness: Y of BT.601 for colours, demosaiced for Bayer patterns."""
        if self.colours.grey is None:
            raise picture.format_error("a format with brightness", "distances")
        return self.colours.grey(self.array(picture))

    def rgb(self, picture: RawPicture) -> NDArray[Any]:
        """Return the colours; for a grey format, three equal channels."""
        if self.colours.rgb is None:
            raise picture.format_error("a format with colours", "distances")
        return self.colours.rgb(self.array(picture))


@dataclass(frozen=True, slots=True)
class YuvPairs(PixelLayout):
    """Two pixels in four bytes: each pixel has its own Y, and both share U and V.

    Attributes:
        y: index of Y in a pixel's two bytes; the other is U or V.
        matrix: name of the matrix in ``MATRICES``.
    """

    y: int
    matrix: str

    def min_stride(self, width: int) -> int:
        """Return the bytes of all pairs of a row."""
        return (width + 1) // 2 * 4

    def size(self, width: int, height: int, stride: int) -> int:
        """Return the bytes up to the last pair."""
        return stride * (height - 1) + self.min_stride(width)

    def array(self, picture: RawPicture) -> NDArray[Any]:
        """Return (H, W, 2): Y and alternating U and V, in the order of the format."""
        self.check(picture)
        _, _, width, height, stride = picture
        return _view(picture, "u1", (height, width, 2), (stride, 2, 1))

    def planes(self, picture: RawPicture) -> tuple[NDArray[np.uint8], ...]:
        """Return (H, W), (H, W/2) and (H, W/2), views."""
        self.check(picture)
        _, _, width, height, stride = picture
        pairs = (height, (width + 1) // 2)
        y = _view(picture, "u1", (height, width), (stride, 2), self.y)
        u, v = (_view(picture, "u1", pairs, (stride, 4), 1 - self.y + shift) for shift in (0, 2))
        return y, u, v

    def grey(self, picture: RawPicture) -> NDArray[Any]:
        """Return Y, a view."""
        return self.planes(picture)[0]

    def rgb(self, picture: RawPicture) -> NDArray[Any]:
        """Return the colours."""
        pairs = self.array(picture)
        is_convertible = self.matrix == "601" and picture.width % 2 == 0
        colours = pairs_to_rgb(pairs, self.y) if is_convertible else None
        if colours is not None:
            return colours
        y, *_ = self.planes(picture)
        _, _, width, height, stride = picture
        shape = (height, (width + 1) // 2, 2)
        chroma = _view(picture, "u1", shape, (stride, 4, 2), 1 - self.y)
        return yuv_to_rgb(y, [chroma], MATRICES[self.matrix])


@dataclass(frozen=True, slots=True)
class Planes(PixelLayout):
    """Planes of Y, U and V; up to four pixels share U and V. All strides follow from Y's stride.

    Attributes:
        chroma_x: pixels along a row that share a U and a V.
        chroma_y: rows that share a U and a V.
        interleaved: whether U and V alternate in one plane with the stride of Y; else they have
            separate planes.
        matrix: name of the matrix in ``MATRICES``.
        depth: bits of a sample; a sample of more than 8 bits takes two bytes, the low byte first.
    """

    chroma_x: int
    chroma_y: int
    interleaved: bool
    matrix: str
    depth: int = 8

    @property
    def sample_bytes(self) -> int:
        """Bytes of a sample."""
        return 1 if self.depth == 8 else 2

    def min_stride(self, width: int) -> int:
        """Return the number of bytes of a row of Y, or of U and V if that is larger."""
        return self.sample_bytes * (-(-width // self.chroma_x) * 2 if self.interleaved else width)

    def _chroma_shape(self, width: int, height: int, stride: int) -> tuple[int, int, int]:
        """Return the width, height and stride of U and V."""
        rows = -(-height // self.chroma_y)
        return -(-width // self.chroma_x), rows, self.chroma_stride(stride)

    def chroma_stride(self, stride: int) -> int:
        """Return the bytes from row to row of U and V."""
        samples = stride // self.sample_bytes
        return stride if self.interleaved else self.sample_bytes * -(-samples // self.chroma_x)

    def size(self, width: int, height: int, stride: int) -> int:
        """Return the bytes of all planes."""
        _, rows, chroma_stride = self._chroma_shape(width, height, stride)
        return stride * height + chroma_stride * rows * (1 if self.interleaved else 2)

    def array(self, picture: RawPicture) -> NDArray[Any]:
        """Return the bytes, (N,)."""
        self.check(picture)
        size = self.size(picture.width, picture.height, picture.stride)
        return _view(picture, "u1", (size,), (1,))

    def planes(self, picture: RawPicture) -> tuple[NDArray[np.uint8], ...]:
        """Return Y, U and V, views."""
        self.check(picture)
        _, _, width, height, stride = picture
        columns, rows, chroma_stride = self._chroma_shape(width, height, stride)
        size, dtype = self.sample_bytes, f"<u{self.sample_bytes}"
        y = _view(picture, dtype, (height, width), (stride, size))
        begin, step = stride * height, size * (2 if self.interleaved else 1)
        v_offset = size if self.interleaved else chroma_stride * rows
        u, v = (
            _view(picture, dtype, (rows, columns), (chroma_stride, step), begin + offset)
            for offset in (0, v_offset)
        )
        return y, u, v

    def grey(self, picture: RawPicture) -> NDArray[Any]:
        """Return Y, a view."""
        if isinstance(picture.data, SeparatePlanes):  # a decoder's planes are complete
            picture = picture._replace(data=picture.data.first)
        else:
            self.check(picture)
        _, _, width, height, stride = picture
        size = self.sample_bytes
        return _view(picture, f"<u{size}", (height, width), (stride, size))

    def rgb(self, picture: RawPicture) -> NDArray[Any]:
        """Return the colours."""
        y, *chroma = self.planes(picture)
        if self.interleaved:
            shape, strides = (*chroma[0].shape, 2), (*chroma[0].strides, self.sample_bytes)
            begin = picture.stride * picture.height
            chroma = [_view(picture, f"<u{self.sample_bytes}", shape, strides, begin)]
        return yuv_to_rgb(y, chroma, MATRICES[self.matrix], self.depth)


@dataclass(frozen=True, slots=True)
class Compressed(PixelLayout):
    """Bytes that only a codec can read.

    Attributes:
        reader: name of the codec, for errors.
    """

    reader: str

    @property
    def grey_is_sent(self) -> bool:
        """Always False."""
        return False

    def min_stride(self, width: int) -> int:
        """Return 0."""
        return 0

    def size(self, width: int, height: int, stride: int) -> int:
        """Return 0."""
        return 0

    def array(self, picture: RawPicture) -> NDArray[Any]:
        """Return the bytes, (N,)."""
        return _view(picture, "u1", (memoryview(picture.data).nbytes,), (1,))

    def grey(self, picture: RawPicture) -> NDArray[Any]:
        """Raise, since brightness needs a codec."""
        raise picture.format_error(f"pixels, which {self.reader} makes", "compressed bytes")

    def rgb(self, picture: RawPicture) -> NDArray[Any]:
        """Raise, since colours need a codec."""
        raise picture.format_error(f"pixels, which {self.reader} makes", "compressed bytes")


@dataclass(frozen=True, slots=True)
class Jpeg(Compressed):
    """JPEG, whose luma is the brightness."""

    reader: str = "Codecs.decode"

    @property
    def grey_is_sent(self) -> bool:
        """Always True: only the luma is decoded."""
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
