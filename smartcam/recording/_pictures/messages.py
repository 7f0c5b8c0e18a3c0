"""Pictures as Foxglove's messages of Protocol Buffers, with the other attributes of a frame.

A viewer reads ``foxglove.RawImage``, ``CompressedImage`` or ``CompressedVideo``. Fields from 100 on
are smartcam's, and part of the schema in the file: the PFNC name of the pixel format, the source's
times, the number, the lost frames. So the frame that is read equals the frame that was written.
"""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime
from functools import cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam.exceptions import FrameFormatError
from smartcam.frames import Frame, Moment, find_format
from smartcam.recording._mcap.form import MAX_CAPTURE_TIME, MAX_NAME_CHARACTERS, RecordedPicture

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.frames import PixelFormat

MAX_SIDE_PX: Final = 1 << 20
"""Largest number of pixels along a side of a picture that is written or read."""

MAX_FIELDS: Final = 1000
"""Largest number of fields of a message that is read; smartcam's have fewer than 30."""

RAW: Final = "foxglove.RawImage"
COMPRESSED: Final = "foxglove.CompressedImage"
VIDEO: Final = "foxglove.CompressedVideo"

_ENCODINGS: Final = {
    "Mono8": "mono8",
    **{f"Mono{bits}": "mono16" for bits in (10, 12, 14, 16)},
    "Coord3D_C16": "16UC1",
    "RGB8": "rgb8",
    "BGR8": "bgr8",
    "RGBa8": "rgba8",
    "BGRa8": "bgra8",
    "BayerRG8": "bayer_rggb8",
    "BayerBG8": "bayer_bggr8",
    "BayerGB8": "bayer_gbrg8",
    "BayerGR8": "bayer_grbg8",
    "YUV422_8": "yuyv",
    "YUV422_8_UYVY": "uyvy",
}
"""Foxglove's encodings, by smartcam's formats; others have the name of the format itself."""

_COMPRESSIONS: Final = {"MJPEG": "jpeg", "PNG": "png", "JPEGXL": "jxl", "H264": "h264"}

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # wire types

_TYPES: Final = {"double": 1, "uint64": 4, "fixed32": 7, "string": 9, "message": 11, "bytes": 12}
"""Types of fields, by Protocol Buffers' numbers."""


class WireField(NamedTuple):
    """A field of a message: its number, its type, and for a message the type's name."""

    number: int
    type: str
    of: str = ""


_STAMP = WireField(1, "message", ".google.protobuf.Timestamp")

_OURS: Final = {
    "pixel_format": WireField(101, "string"),
    "picture_width": WireField(102, "fixed32"),
    "picture_height": WireField(103, "fixed32"),
    "captured": WireField(104, "double"),
    "utc": WireField(105, "double"),
    "moment": WireField(106, "string"),
    "duration": WireField(107, "double"),
    "device_time": WireField(108, "double"),
    "sequence": WireField(109, "uint64"),
    "lost": WireField(110, "uint64"),
    "left_out": WireField(111, "uint64"),
    "source": WireField(112, "string"),
    "remark": WireField(113, "string"),
    "result_number": WireField(114, "uint64"),
    "stride": WireField(115, "fixed32"),
    "result_received": WireField(116, "double"),
}
"""smartcam's fields: attributes of a frame, pictures that the recorder left out before it, number
and arrival of its result."""

SCHEMAS: Final[dict[str, dict[str, WireField]]] = {
    RAW: {
        "timestamp": _STAMP,
        "frame_id": WireField(7, "string"),
        "width": WireField(2, "fixed32"),
        "height": WireField(3, "fixed32"),
        "encoding": WireField(4, "string"),
        "step": WireField(5, "fixed32"),
        "data": WireField(6, "bytes"),
        **_OURS,
    },
    COMPRESSED: {
        "timestamp": _STAMP,
        "frame_id": WireField(4, "string"),
        "data": WireField(2, "bytes"),
        "format": WireField(3, "string"),
        **_OURS,
    },
    VIDEO: {
        "timestamp": _STAMP,
        "frame_id": WireField(2, "string"),
        "data": WireField(3, "bytes"),
        "format": WireField(4, "string"),
        **_OURS,
    },
}
"""Messages of pictures by their names, and their fields."""


# ---------------------------------------------------------------------- writing


def schema_of(picture: RecordedPicture) -> str:
    """Return the name of the schema of a picture's message."""
    found = picture.frame.format
    if not found.compressed:
        return RAW
    return VIDEO if found.name == "H264" else COMPRESSED


def check_readable(frame: Frame) -> None:
    """Check that the message of a frame can be read again.

    Raises:
        FrameFormatError: the message could not be read, and neither could the rest of the
            recording.
    """
    said, form = "", find_format(frame.format.name)
    if not (1 <= frame.width <= MAX_SIDE_PX and 1 <= frame.height <= MAX_SIDE_PX):
        said = f"{frame.width}x{frame.height}, expected 1 to {MAX_SIDE_PX} pixels along each side"
    elif not (math.isfinite(frame.captured) and math.isfinite(frame.device_time or 0.0)):
        said = f"captured {frame.captured}, {frame.device_time} of the device, expected seconds"
    elif not 0 <= frame.utc <= MAX_CAPTURE_TIME:
        said = f"captured {frame.utc} s after 1970, expected 0 to {MAX_CAPTURE_TIME:.0f}"
    elif not frame.duration >= 0:
        said = f"duration {frame.duration}, expected 0 or more seconds"
    elif not 0 <= frame.stride < 1 << 32:
        said = f"stride {frame.stride}, expected bytes in 32 bits"
    elif not (frame.sequence < 1 << 64 and 0 <= frame.lost < 1 << 64):
        said = f"number {frame.sequence}, {frame.lost} lost, expected numbers of 64 bits"
    if said:
        raise FrameFormatError(
            f"{frame.source}: a picture cannot be recorded: {said}", source=frame.source
        )
    form.check(frame.data, frame.width, frame.height, frame.stride)


def picture_message(picture: RecordedPicture) -> bytes:
    """Return the message of a picture.

    Raises:
        FrameFormatError: the message could not be read again.
    """
    check_readable(picture.frame)
    frame, received = picture.frame, picture.result_received_at
    name = schema_of(picture)
    data = memoryview(frame.data).cast("B")
    values: dict[str, Any] = {
        "timestamp": _stamp(frame.utc),
        "frame_id": picture.camera,
        "pixel_format": frame.format.name,
        "picture_width": frame.width,
        "picture_height": frame.height,
        "captured": frame.captured,
        "utc": frame.utc,
        "moment": frame.moment.name,
        "duration": frame.duration,
        "device_time": frame.device_time,
        "sequence": max(0, frame.sequence),
        "lost": frame.lost,
        "left_out": picture.left_out,
        "source": frame.source[:MAX_NAME_CHARACTERS],
        "remark": frame.remark[:MAX_NAME_CHARACTERS],
        "result_number": picture.result_number,
        "stride": frame.stride,
        "result_received": received and received.timestamp(),
    }
    padding = b""
    if name == RAW:
        encoding = _ENCODINGS.get(frame.format.name, frame.format.name)
        values |= {"width": frame.width, "height": frame.height, "step": frame.stride}
        values["encoding"] = encoding
        if frame.format.name in _ENCODINGS:  # the last row may lack its padding
            padding = bytes(max(0, frame.stride * frame.height - data.nbytes))
    else:
        values["format"] = _COMPRESSIONS.get(frame.format.name, frame.format.name)
    fields = SCHEMAS[name]
    parts = [
        _field(fields[key], value) for key, value in values.items() if value not in (None, 0, "")
    ]
    if frame.device_time == 0:
        parts.append(_field(fields["device_time"], 0.0))
    size = _varint(data.nbytes + len(padding))
    return b"".join((*parts, _tag(fields["data"].number, _BYTES), size, data, padding))


def _field(field: WireField, value: Any) -> bytes:
    if field.type == "double":
        return _tag(field.number, _FIXED64) + struct.pack("<d", value)
    if field.type == "fixed32":
        return _tag(field.number, _FIXED32) + struct.pack("<I", value)
    if field.type == "uint64":
        return _tag(field.number, _VARINT) + _varint(value)
    data: bytes = value.encode("utf-8", "replace") if field.type == "string" else value
    return _tag(field.number, _BYTES) + _varint(len(data)) + data


def _stamp(utc: float) -> bytes:
    """Return a time as google.protobuf.Timestamp."""
    seconds, nanoseconds = divmod(max(0, round(utc * 1e9)), 1_000_000_000)
    return _tag(1, _VARINT) + _varint(seconds) + _tag(2, _VARINT) + _varint(nanoseconds)


def _tag(number: int, wire: int) -> bytes:
    return _varint(number << 3 | wire)


def _varint(value: int) -> bytes:
    data = bytearray()
    while value > 0x7F:
        data.append(value & 0x7F | 0x80)
        value >>= 7
    data.append(value)
    return bytes(data)


# ---------------------------------------------------------------------- schemas


@cache
def schema_data(name: str) -> bytes:
    """Return the schema of a message for MCAP: a FileDescriptorSet."""
    package, _, short = name.partition(".")
    stamp = _file(
        "google/protobuf/timestamp.proto",
        "google.protobuf",
        "Timestamp",
        [("seconds", 1, 3, ""), ("nanos", 2, 5, "")],
    )
    fields = [
        (called, one.number, _TYPES[one.type], one.of) for called, one in SCHEMAS[name].items()
    ]
    path = f"{package}/{short}.proto"
    main = _file(path, package, short, fields, "google/protobuf/timestamp.proto")
    return _bytes(1, stamp) + _bytes(1, main)


def _file(
    path: str, package: str, name: str, fields: list[tuple[str, int, int, str]], needs: str = ""
) -> bytes:
    """Return a FileDescriptorProto with one message."""
    message = _bytes(1, name.encode())
    for called, number, kind, of in fields:
        told = _bytes(1, called.encode()) + _tag(3, _VARINT) + _varint(number)
        told += _tag(4, _VARINT) + _varint(1) + _tag(5, _VARINT) + _varint(kind)
        message += _bytes(2, told + (_bytes(6, of.encode()) if of else b""))
    needed = _bytes(3, needs.encode()) if needs else b""
    head = _bytes(1, path.encode()) + _bytes(2, package.encode()) + needed
    return head + _bytes(4, message) + _bytes(12, b"proto3")


def _bytes(number: int, data: bytes) -> bytes:
    return _tag(number, _BYTES) + _varint(len(data)) + data


# ---------------------------------------------------------------------- reading


def picture_of(schema: str, data: memoryview) -> RecordedPicture:
    """Return the picture of a message; its pixels are a view of ``data``.

    Raises:
        ValueError: the message is not valid, or lacks a field of its format.
    """
    values = _values(schema, data)
    said = _Values(values)
    try:
        found = find_format(said.text("pixel_format", 100))
        frame = _frame(said, found)
        found.check(frame.data, frame.width, frame.height, frame.stride)
        at = datetime.fromtimestamp(frame.utc, UTC)
        received = said.result_received_at()
    except (FrameFormatError, OverflowError, OSError) as exc:
        raise ValueError(f"a picture: {exc!s:.300}") from exc
    camera = said.text("frame_id", MAX_NAME_CHARACTERS)
    made = said.number_of_result(), received
    return RecordedPicture(camera, at, frame, said.whole("left_out"), *made)


def _frame(said: _Values, found: PixelFormat) -> Frame:
    moment = said.text("moment", 100)
    if moment not in Moment.__members__:
        raise ValueError(f"moment: {moment!r:.60} came, expected {', '.join(Moment.__members__)}")
    duration = said.real("duration", endless=True)
    if duration < 0:
        raise ValueError(f"duration: {duration} came, expected 0 or more seconds")
    width, height = said.side("picture_width"), said.side("picture_height")
    return Frame(
        data=said.data(),
        format=found,
        width=width,
        height=height,
        stride=said.whole("stride"),
        captured=said.real("captured"),
        utc=said.real("utc"),
        moment=Moment[moment],
        duration=duration,
        device_time=said.real("device_time") if said.has("device_time") else None,
        sequence=said.whole("sequence"),
        lost=said.whole("lost"),
        source=said.text("source", MAX_NAME_CHARACTERS),
        remark=said.text("remark", MAX_NAME_CHARACTERS),
    )


class _Values:
    """The values of a message by the names of its fields, checked on access."""

    def __init__(self, values: dict[str, Any]) -> None:
        self._values = values

    def has(self, name: str) -> bool:
        return name in self._values

    def data(self) -> memoryview:
        found: memoryview = self._values.get("data", memoryview(b""))
        return found

    def text(self, name: str, most: int) -> str:
        found = self._values.get(name, memoryview(b""))
        if len(found) > 4 * most:
            raise ValueError(f"{name}: {len(found)} bytes, expected {4 * most} at most")
        return str(found, "utf-8")

    def whole(self, name: str) -> int:
        found: int = self._values.get(name, 0)
        return found

    def side(self, name: str) -> int:
        found = self.whole(name)
        if not 1 <= found <= MAX_SIDE_PX:
            raise ValueError(f"{name}: {found} came, expected 1 to {MAX_SIDE_PX} pixels")
        return found

    def real(self, name: str, *, endless: bool = False) -> float:
        found: float = self._values.get(name, 0.0)
        if math.isnan(found) or (math.isinf(found) and not endless):
            raise ValueError(f"{name}: {found} came, expected seconds")
        return found

    def number_of_result(self) -> int | None:
        return self.whole("result_number") or None

    def result_received_at(self) -> datetime | None:
        seconds = self.real("result_received")
        return datetime.fromtimestamp(seconds, UTC) if seconds else None


def _values(schema: str, data: memoryview) -> dict[str, Any]:
    """Return the values of the known fields, with checked types; ignore others."""
    known = {one.number: (name, one) for name, one in SCHEMAS[schema].items()}
    found: dict[str, Any] = {}
    for count, (number, wire, value) in enumerate(_pieces(data)):
        if count >= MAX_FIELDS:
            raise ValueError(f"a message of more than {MAX_FIELDS} fields")
        name, field = known.get(number, ("", None))
        if field is None:
            continue
        expected, read = _READERS[field.type]
        if wire != expected:
            raise ValueError(f"{name}: wire type {wire} came, expected {expected}")
        found[name] = read(value)
    return found


_READERS: Final[dict[str, tuple[int, Callable[[Any], Any]]]] = {
    "double": (_FIXED64, lambda value: struct.unpack("<d", value)[0]),
    "fixed32": (_FIXED32, lambda value: struct.unpack("<I", value)[0]),
    "uint64": (_VARINT, lambda value: value),
    "string": (_BYTES, lambda value: value),
    "bytes": (_BYTES, lambda value: value),
    "message": (_BYTES, lambda value: value),
}


def _pieces(data: memoryview) -> Iterator[tuple[int, int, Any]]:
    """Yield the number, wire type and value of each field."""
    place = 0
    while place < len(data):
        tag, place = _read_varint(data, place)
        wire = tag & 7
        if wire == _VARINT:
            value, place = _read_varint(data, place)
            yield tag >> 3, wire, value
            continue
        if wire == _BYTES:
            size, place = _read_varint(data, place)
        elif wire in (_FIXED32, _FIXED64):
            size = 4 if wire == _FIXED32 else 8
        else:
            raise ValueError(f"a field of wire type {wire}")
        if size > len(data) - place:
            raise ValueError(f"a field of {size} bytes in the last {len(data) - place}")
        yield tag >> 3, wire, data[place : place + size]
        place += size


def _read_varint(data: memoryview, place: int) -> tuple[int, int]:
    """Return the number at a place, and the place after it."""
    value = 0
    for shift in range(0, 64, 7):
        if place >= len(data):
            raise ValueError("a number is cut off")
        byte = data[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFF_FFFF_FFFF_FFFF, place
    raise ValueError("a number of more than 64 bits")
