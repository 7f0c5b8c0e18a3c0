"""The structures and numbers of ``linux/videodev2.h``.

A structure is a :class:`struct.Struct` in the machine's own layout; ``0P`` pads to the alignment of
a pointer, like the header's unions. An ioctl's number contains its structure's size, so a kernel
with another layout refuses the call.

Source: linux/videodev2.h, asm-generic/ioctl.h.
"""

from __future__ import annotations

from struct import Struct
from typing import Final, NamedTuple

WRITE: Final = 1
READ: Final = 2


class Ioctl(NamedTuple):
    """An ioctl.

    Attributes:
        name: name in the header, without its ``VIDIOC_``.
        number: number of the ioctl.
        layout: layout of its argument.
    """

    name: str
    number: int
    layout: Struct


def _ioctl(name: str, number: int, direction: int, layout: Struct) -> Ioctl:
    return Ioctl(name, direction << 30 | layout.size << 16 | ord("V") << 8 | number, layout)


POINTER: Final = Struct("P").size

_CAPABILITY = Struct("16s32s32sIII12x")
_FORMAT_DESCRIPTION = Struct("III32sII12x")
_FORMAT = Struct("I0P12I152x0P")
_REQUEST_BUFFERS = Struct("IIIIB3x")
_BUFFER = Struct("IIIII0lll16xII0LI0LI8x0l")
_INTEGER = Struct("i")
_PARAMETERS = Struct("I10I160x")
_CONTROL = Struct("Ii")
_QUERY_CONTROL = Struct("II32sqqQqIIII4I128x")
_QUERY_MENU = Struct("=II32s4x")
_FRAME_SIZE = Struct("III6I8x")
_FRAME_INTERVAL = Struct("IIIII6I8x")

QUERYCAP: Final = _ioctl("QUERYCAP", 0, READ, _CAPABILITY)
ENUM_FMT: Final = _ioctl("ENUM_FMT", 2, READ | WRITE, _FORMAT_DESCRIPTION)
G_FMT: Final = _ioctl("G_FMT", 4, READ | WRITE, _FORMAT)
S_FMT: Final = _ioctl("S_FMT", 5, READ | WRITE, _FORMAT)
REQBUFS: Final = _ioctl("REQBUFS", 8, READ | WRITE, _REQUEST_BUFFERS)
QUERYBUF: Final = _ioctl("QUERYBUF", 9, READ | WRITE, _BUFFER)
QBUF: Final = _ioctl("QBUF", 15, READ | WRITE, _BUFFER)
DQBUF: Final = _ioctl("DQBUF", 17, READ | WRITE, _BUFFER)
STREAMON: Final = _ioctl("STREAMON", 18, WRITE, _INTEGER)
STREAMOFF: Final = _ioctl("STREAMOFF", 19, WRITE, _INTEGER)
G_PARM: Final = _ioctl("G_PARM", 21, READ | WRITE, _PARAMETERS)
S_PARM: Final = _ioctl("S_PARM", 22, READ | WRITE, _PARAMETERS)
G_CTRL: Final = _ioctl("G_CTRL", 27, READ | WRITE, _CONTROL)
S_CTRL: Final = _ioctl("S_CTRL", 28, READ | WRITE, _CONTROL)
QUERYMENU: Final = _ioctl("QUERYMENU", 37, READ | WRITE, _QUERY_MENU)
ENUM_FRAMESIZES: Final = _ioctl("ENUM_FRAMESIZES", 74, READ | WRITE, _FRAME_SIZE)
ENUM_FRAMEINTERVALS: Final = _ioctl("ENUM_FRAMEINTERVALS", 75, READ | WRITE, _FRAME_INTERVAL)
QUERY_EXT_CTRL: Final = _ioctl("QUERY_EXT_CTRL", 103, READ | WRITE, _QUERY_CONTROL)

CAPTURE: Final = 1
"""V4L2_BUF_TYPE_VIDEO_CAPTURE."""

MEMORY_MMAP: Final = 1

CAP_VIDEO_CAPTURE: Final = 0x00000001
CAP_VIDEO_CAPTURE_MPLANE: Final = 0x00001000
CAP_VIDEO_M2M_MPLANE: Final = 0x00004000
CAP_VIDEO_M2M: Final = 0x00008000
CAP_META_CAPTURE: Final = 0x00800000
CAP_STREAMING: Final = 0x04000000
CAP_DEVICE_CAPS: Final = 0x80000000
CAP_TIMEPERFRAME: Final = 0x1000

FIELD_NONE: Final = 1
WHOLE_FIELDS: Final = frozenset((0, FIELD_NONE, 4, 8, 9))
"""Values of ``enum v4l2_field`` whose buffers have all rows in order: any, none, interlaced."""

DISCRETE: Final = 1
"""V4L2_FRMSIZE_TYPE_DISCRETE and V4L2_FRMIVAL_TYPE_DISCRETE."""

BUF_ERROR: Final = 0x00000040
TIMESTAMP_MASK: Final = 0x0000E000
TIMESTAMP_MONOTONIC: Final = 0x00002000
TIMESTAMP_COPY: Final = 0x00004000
TSTAMP_SRC_MASK: Final = 0x00070000
TSTAMP_SRC_EOF: Final = 0x00000000
TSTAMP_SRC_SOE: Final = 0x00010000

CTRL_INTEGER, CTRL_BOOLEAN, CTRL_MENU, CTRL_BUTTON = 1, 2, 3, 4
CTRL_BITMASK, CTRL_INTEGER_MENU = 8, 9
CTRL_DISABLED: Final = 0x0001
CTRL_READ_ONLY: Final = 0x0004
CTRL_INACTIVE: Final = 0x0010
CTRL_WRITE_ONLY: Final = 0x0040
CTRL_VOLATILE: Final = 0x0080
CTRL_EXECUTE_ON_WRITE: Final = 0x0200
CTRL_NEXT: Final = 0x80000000


class Capability(NamedTuple):
    """``struct v4l2_capability``."""

    driver: bytes
    card: bytes
    bus_info: bytes
    version: int
    capabilities: int
    device_caps: int


class BufferLayout(NamedTuple):
    """The used fields of ``struct v4l2_format`` of one plane."""

    width: int
    height: int
    fourcc: int
    field: int
    stride: int
    size: int
    colorspace: int = 0
    private: int = 0
    flags: int = 0
    ycbcr_enc: int = 0
    quantization: int = 0


PRIVATE_MAGIC: Final = 0xFEEDCAFE
"""V4L2_PIX_FMT_PRIV_MAGIC: the fields after ``private`` are valid."""

COLORSPACE_JPEG: Final = 7

MATRIX_OF_COLORSPACE: Final = {2: "240M", 3: "709", 10: "2020", 12: "709"}
"""``V4L2_MAP_YCBCR_ENC_DEFAULT``: SMPTE 240M, Rec. 709, BT.2020, DCI-P3; otherwise BT.601."""

MATRIX_OF_ENCODING: Final = {
    1: "601", 2: "709", 3: "601", 4: "709", 5: "601", 6: "2020",
    7: "2020 of constant luminance", 8: "240M",
}  # fmt: skip
"""``enum v4l2_ycbcr_encoding``; 0 is the color space's default."""

FULL_RANGE, LIMITED_RANGE = 1, 2
"""``enum v4l2_quantization``; 0 means full range for RGB and for JPEG's color space."""


FULL_BUFFER: Final = Struct("I4xII4x0lll16xI0l")
"""A filled buffer: its index, bytes, flags, seconds, microseconds, and frame number."""


def new_buffer(index: int) -> bytearray:
    """Return an argument for the ioctls that concern a buffer."""
    argument = bytearray(_BUFFER.size)
    _BUFFER.pack_into(argument, 0, index, CAPTURE, 0, 0, 0, 0, 0, 0, MEMORY_MMAP, 0, 0)
    return argument


def offset_and_length(argument: bytearray) -> tuple[int, int]:
    """Return a buffer's offset for mmap and its length, in bytes."""
    offset, length = _BUFFER.unpack(argument)[9:11]
    return offset, length


def decode_text(raw: bytes) -> str:
    """Return a text from the kernel, which ends at its first zero byte."""
    return raw.split(b"\0", 1)[0].decode("utf-8", "replace")


def fourcc(name: str) -> int:
    """Return the fourcc number of up to four characters, which are padded with spaces."""
    return int.from_bytes(name.ljust(4).encode("latin-1"), "little")


def fourcc_text(code: int) -> str:
    """Return a format's four characters without spaces at the end; ``-BE`` is big endian."""
    name = (code & 0x7FFFFFFF).to_bytes(4, "little").decode("latin-1").rstrip()
    printable = "".join(character if character.isprintable() else "?" for character in name)
    return printable + ("-BE" if code >> 31 else "")
