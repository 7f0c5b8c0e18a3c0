"""Read and write images of PCIC: chunks with a header of numbers and a picture."""

from __future__ import annotations

import struct
from typing import NamedTuple

from smartcam.exceptions import FrameError

JPEG, MONO8 = 260, 251
"""Types of chunks: a JPEG file; grey levels of one byte each."""

HEADER = struct.Struct("<12i")
"""Header of a chunk: type, size, size of the header, version, width, height, pixel format,
microseconds, count, status, seconds and nanoseconds. JSON with a zero byte at its end follows."""

MIN_HEADER_SIZE, VERSION = 0x40, 3


class ImageChunk(NamedTuple):
    """One picture of a device.

    Attributes:
        type: 260 for a JPEG file, 251 for grey levels, or another number of the device.
        width: width in pixels.
        height: height in pixels.
        number: number of the picture since the device was started.
        time: seconds since 1970 by the device's clock.
        data: bytes of the picture.
    """

    type: int
    width: int
    height: int
    number: int
    time: float
    data: bytes

    @property
    def file(self) -> bytes:
        """The picture as a file: JPEG unchanged, grey levels as PGM, other types as bytes."""
        if self.type == MONO8 and len(self.data) == self.width * self.height:
            return b"P5\n%d %d\n255\n" % (self.width, self.height) + self.data
        return self.data

    @property
    def encoded(self) -> bytes:
        """The chunk as a device sends it."""
        header_size = MIN_HEADER_SIZE
        seconds, nanoseconds = divmod(round(self.time * 1e9), 1_000_000_000)
        numbers = (
            *(self.type, header_size + len(self.data), header_size, VERSION, self.width),
            *(
                self.height,
                0,
                nanoseconds // 1000,
                self.number,
                0,
                seconds & 0x7FFFFFFF,
                nanoseconds,
            ),
        )
        return (HEADER.pack(*numbers) + b"{}").ljust(header_size, b"\0") + self.data


def read_chunks(data: bytes) -> list[ImageChunk]:
    """Return the pictures of an answer to ``I01?`` or ``I02?``: nine digits of length, then chunks.

    Raises:
        FrameError: the chunks do not fit together.
    """
    body = data[9:]
    if not data[:9].isdigit() or int(data[:9]) != len(body):
        raise FrameError(f"{data[:16]!r} is not the beginning of a PCIC image", data=data[:64])
    chunks: list[ImageChunk] = []
    offset = 0
    while offset < len(body):
        if len(body) - offset < MIN_HEADER_SIZE:
            raise FrameError(
                f"{len(body) - offset} bytes are no image chunk", data=body[offset : offset + 64]
            )
        chunk_type, size, header_size, _, width, height, _, _, count, _, seconds, nanoseconds = (
            HEADER.unpack_from(body, offset)
        )
        if not MIN_HEADER_SIZE <= header_size <= size <= len(body) - offset:
            raise FrameError(
                f"an image chunk of {size} bytes with a header of {header_size} came, "
                f"{len(body) - offset} are there",
                data=body[offset : offset + 64],
            )
        picture = body[offset + header_size : offset + size]
        chunks.append(
            ImageChunk(chunk_type, width, height, count, seconds + nanoseconds / 1e9, picture)
        )
        offset += size
    return chunks
