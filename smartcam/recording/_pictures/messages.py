"""Pictures as Foxglove's messages of Protocol Buffers, with the other attributes of a frame.

A viewer reads ``foxglove.RawImage``, ``CompressedImage`` or ``CompressedVideo``. Fields from 100 on
are smartcam's, and part of the schema in the file: the PFNC name of the pixel format, the source's
times, the number, the lost frames. So the frame that is read equals the frame that was written.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from smartcam.exceptions import FrameFormatError
from smartcam.frames import Frame, Moment, find_format
from smartcam.recording._mcap.form import MAX_CAPTURE_TIME, MAX_NAME_CHARACTERS, RecordedPicture
from smartcam.recording._pictures.protobuf import (
    BYTES,
    TIMESTAMP,
    Fields,
    WireField,
    encode_field,
    encode_message,
    encode_timestamp,
    file_descriptor_set,
    parse_message,
    tag,
    varint,
)

if TYPE_CHECKING:
    from smartcam.frames._inside import Drawing, PixelFormat

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
"""Foxglove's encodings, by smartcam's formats; the encoding of another format is its name."""

_COMPRESSIONS: Final = {"MJPEG": "jpeg", "PNG": "png", "JPEGXL": "jxl", "H264": "h264"}

_STAMP = WireField(1, "message", TIMESTAMP)

_SMARTCAM_FIELDS: Final = {
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
    "annotations_number": WireField(117, "uint64"),
}
"""smartcam's fields: attributes of a frame, pictures that the recorder left out before it, number
and arrival of its result, and the number of the message in ``/CAMERA/annotations`` with its
marks."""

SCHEMAS: Final[dict[str, Fields]] = {
    RAW: {
        "timestamp": _STAMP,
        "frame_id": WireField(7, "string"),
        "width": WireField(2, "fixed32"),
        "height": WireField(3, "fixed32"),
        "encoding": WireField(4, "string"),
        "step": WireField(5, "fixed32"),
        "data": WireField(6, "bytes"),
        **_SMARTCAM_FIELDS,
    },
    COMPRESSED: {
        "timestamp": _STAMP,
        "frame_id": WireField(4, "string"),
        "data": WireField(2, "bytes"),
        "format": WireField(3, "string"),
        **_SMARTCAM_FIELDS,
    },
    VIDEO: {
        "timestamp": _STAMP,
        "frame_id": WireField(2, "string"),
        "data": WireField(3, "bytes"),
        "format": WireField(4, "string"),
        **_SMARTCAM_FIELDS,
    },
}
"""Messages of pictures by their names, and their fields."""


# ---------------------------------------------------------------------- writing


def schema_of(picture: RecordedPicture) -> str:
    """Return the name of the schema of a picture's message."""
    pixel_format = picture.frame.format
    if not pixel_format.compressed:
        return RAW
    return VIDEO if pixel_format.name == "H264" else COMPRESSED


def check_readable(frame: Frame) -> None:
    """Check that the message of a frame is within the bounds for reading.

    Raises:
        FrameFormatError: the message could not be read, and neither could the rest of the
            recording.
    """
    problem, form = "", find_format(frame.format.name)
    if not (1 <= frame.width <= MAX_SIDE_PX and 1 <= frame.height <= MAX_SIDE_PX):
        problem = (
            f"{frame.width}x{frame.height}, expected 1 to {MAX_SIDE_PX} pixels along each side"
        )
    elif not (math.isfinite(frame.captured) and math.isfinite(frame.device_time or 0.0)):
        problem = f"captured {frame.captured}, {frame.device_time} of the device, expected seconds"
    elif not 0 <= frame.utc <= MAX_CAPTURE_TIME:
        problem = f"captured {frame.utc} s after 1970, expected 0 to {MAX_CAPTURE_TIME:.0f}"
    elif not frame.duration >= 0:
        problem = f"duration {frame.duration}, expected 0 or more seconds"
    elif not 0 <= frame.stride < 1 << 32:
        problem = f"stride {frame.stride}, expected bytes in 32 bits"
    elif not (frame.sequence < 1 << 64 and 0 <= frame.lost < 1 << 64):
        problem = f"number {frame.sequence}, {frame.lost} lost, expected numbers of 64 bits"
    if problem:
        raise FrameFormatError(
            f"{frame.source}: a picture cannot be recorded: {problem}", source=frame.source
        )
    form.check(frame.data, frame.width, frame.height, frame.stride)


def picture_message(picture: RecordedPicture, annotations_number: int | None = None) -> bytes:
    """Return the message of a picture.

    Args:
        picture: the picture.
        annotations_number: number of the message with its marks, which is right before it.

    Raises:
        FrameFormatError: the message exceeds the bounds for reading.
    """
    check_readable(picture.frame)
    frame, received = picture.frame, picture.result_received_at
    name = schema_of(picture)
    data = memoryview(frame.data).cast("B")
    values: dict[str, Any] = {
        "timestamp": encode_timestamp(frame.utc),
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
        "annotations_number": annotations_number,
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
    fields_bytes = encode_message(fields, values)
    if frame.device_time == 0:  # a valid time, but encoding leaves out zeros
        fields_bytes += encode_field(fields["device_time"], 0.0)
    fields_bytes += tag(fields["data"].number, BYTES) + varint(data.nbytes + len(padding))
    return b"".join((fields_bytes, data, padding))


# ---------------------------------------------------------------------- schemas


@cache
def schema_data(name: str) -> bytes:
    """Return the schema of a message for MCAP: a FileDescriptorSet."""
    return file_descriptor_set(name, {name.partition(".")[2]: SCHEMAS[name]}, {})


# ---------------------------------------------------------------------- reading


def picture_of(
    schema: str, data: memoryview, number: int = 0, drawings: tuple[Drawing, ...] = ()
) -> RecordedPicture:
    """Return the picture of a message; its pixels are a view of ``data``.

    Args:
        schema: name of the message.
        data: bytes of the message.
        number: number of the last message of annotations; 0: there was none.
        drawings: marks in that message; the picture gets the marks if it names this number.

    Raises:
        ValueError: the message is not valid, or lacks a field of its format.
    """
    values = parse_message(SCHEMAS[schema], data, MAX_FIELDS)
    fields = _Values(values)
    try:
        pixel_format = find_format(fields.text("pixel_format", 100))
        marks = drawings if number and fields.integer("annotations_number") == number else ()
        frame = _new_frame(fields, pixel_format, marks)
        pixel_format.check(frame.data, frame.width, frame.height, frame.stride)
        at = datetime.fromtimestamp(frame.utc, UTC)
        received = fields.result_received_at()
    except (FrameFormatError, OverflowError, OSError) as exc:
        raise ValueError(f"a picture: {exc!s:.300}") from exc
    camera = fields.text("frame_id", MAX_NAME_CHARACTERS)
    link = fields.number_of_result(), received
    return RecordedPicture(camera, at, frame, fields.integer("left_out"), *link)


def _new_frame(fields: _Values, pixel_format: PixelFormat, drawings: tuple[Drawing, ...]) -> Frame:
    moment = fields.text("moment", 100)
    if moment not in Moment.__members__:
        raise ValueError(f"moment: {moment!r:.60} came, expected {', '.join(Moment.__members__)}")
    duration = fields.real("duration", allow_infinite=True)
    if duration < 0:
        raise ValueError(f"duration: {duration} came, expected 0 or more seconds")
    width, height = fields.side("picture_width"), fields.side("picture_height")
    return Frame(
        data=fields.data(),
        format=pixel_format,
        width=width,
        height=height,
        stride=fields.integer("stride"),
        captured=fields.real("captured"),
        utc=fields.real("utc"),
        moment=Moment[moment],
        duration=duration,
        device_time=fields.real("device_time") if fields.has("device_time") else None,
        sequence=fields.integer("sequence"),
        lost=fields.integer("lost"),
        source=fields.text("source", MAX_NAME_CHARACTERS),
        remark=fields.text("remark", MAX_NAME_CHARACTERS),
        drawings=drawings,
    )


class _Values:
    """The values of a message by the names of its fields, checked on access."""

    def __init__(self, values: dict[str, Any]) -> None:
        self._values = values

    def has(self, name: str) -> bool:
        return name in self._values

    def data(self) -> memoryview:
        data: memoryview = self._values.get("data", memoryview(b""))
        return data

    def text(self, name: str, max_characters: int) -> str:
        text = self._values.get(name, memoryview(b""))
        if len(text) > 4 * max_characters:
            raise ValueError(f"{name}: {len(text)} bytes, expected {4 * max_characters} at most")
        return str(text, "utf-8")

    def integer(self, name: str) -> int:
        number: int = self._values.get(name, 0)
        return number

    def side(self, name: str) -> int:
        side = self.integer(name)
        if not 1 <= side <= MAX_SIDE_PX:
            raise ValueError(f"{name}: {side} came, expected 1 to {MAX_SIDE_PX} pixels")
        return side

    def real(self, name: str, *, allow_infinite: bool = False) -> float:
        number: float = self._values.get(name, 0.0)
        if math.isnan(number) or (math.isinf(number) and not allow_infinite):
            raise ValueError(f"{name}: {number} came, expected seconds")
        return number

    def number_of_result(self) -> int | None:
        return self.integer("result_number") or None

    def result_received_at(self) -> datetime | None:
        seconds = self.real("result_received")
        return datetime.fromtimestamp(seconds, UTC) if seconds else None
