"""Convert pictures to ROS' messages and back, without a node.

The names of encodings are from ``sensor_msgs/image_encodings``; depth is as in REP-118: 16UC1
in millimetres, 0 for no depth, or 32FC1 in metres, NaN for no depth.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np

from smartcam.exceptions import FrameFormatError
from smartcam.frames import Frame, Moment, find_format
from smartcam.frames._inside import jpeg_header

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.frames._inside import PixelFormat
    from smartcam.geometry import CameraModel

BILLION: Final = 1_000_000_000

UNKNOWN_DURATION: Final = 1.0
"""Seconds before its stamp in which another node's picture is assumed to have been exposed."""

_BAYER: Final = {"GR": "grbg", "RG": "rggb", "GB": "gbrg", "BG": "bggr"}

ENCODINGS: Final[dict[str, str]] = {
    "Mono8": "mono8",
    **{f"Mono{bits}": "mono16" for bits in (10, 12, 14, 16)},
    "RGB8": "rgb8",
    "BGR8": "bgr8",
    "RGB16": "rgb16",
    "RGBa8": "rgba8",
    "BGRa8": "bgra8",
    "RGBa16": "rgba16",
    **{f"Bayer{ours}8": f"bayer_{ros_name}8" for ours, ros_name in _BAYER.items()},
    **{
        f"Bayer{ours}{bits}": f"bayer_{ros_name}16"
        for ours, ros_name in _BAYER.items()
        for bits in (10, 12, 16)
    },
    "Coord3D_C16": "16UC1",
    # the names that all distributions know; newer ones call them yuyv and uyvy as well
    "YUV422_8": "yuv422_yuy2",
    "YUV422_8_UYVY": "yuv422",
    "YCbCr601_422_8": "yuv422_yuy2",
    "YCbCr601_422_8_CbYCrY": "yuv422",
}
"""Encodings of ROS by the names of the pixel formats that are sent unchanged.

Pixels of 10, 12 and 14 bits are sent with 16 bits and the same values. Frames of other formats are
converted to ``rgb8`` or unpacked first: see :func:`to_ros_format`.
"""

_FORMATS: Final[dict[str, str]] = {
    **{
        ros_name: ours
        for ours, ros_name in reversed(ENCODINGS.items())
        if ours not in {"Mono10", "Mono12", "Mono14"} and not ours.endswith(("10", "12"))
    },
    "8UC1": "Mono8",
    "8UC3": "BGR8",
    "8UC4": "BGRa8",
    "16UC1": "Coord3D_C16",
    "yuyv": "YUV422_8",
    "uyvy": "YUV422_8_UYVY",
    "nv12": "NV12",
}

_DTYPES: Final = {"U": "u", "S": "i", "F": "f"}


# ---------------------------------------------------------------------- to ROS


def stamp_fields(utc: float) -> dict[str, int]:
    """Return a time in seconds since 1970 as the fields of ``builtin_interfaces/Time``."""
    seconds = int(max(utc, 0.0))
    # separate from the seconds, since a sum would lose digits
    nanoseconds = round(max(utc - seconds, 0.0) * BILLION)
    return {"sec": seconds + nanoseconds // BILLION, "nanosec": nanoseconds % BILLION}


def header_fields_at(utc: float, frame_id: str) -> dict[str, Any]:
    """Return the fields of ``std_msgs/Header``."""
    return {"stamp": stamp_fields(utc), "frame_id": frame_id}


def to_ros_format(frame: Frame) -> Frame:
    """Return the frame in a pixel format for which ROS has a name; blocks.

    A frame in such a format is returned unchanged. Samples that share bytes are unpacked to 16
    bits. Formats of Y, U and V that ROS has no names for (in planes, or of full range, or of BT.709
    or BT.2020) become RGB8 or RGB16. A JPEG, PNG or JPEG XL is decoded first.

    Raises:
        FrameFormatError: the format cannot be converted, or the frame's bytes are wrong.
        MissingExtraError: the extra that reads the format is not installed.
    """
    from smartcam.frames._inside import convert_frame, decode_frame, with_pixels

    name = frame.format.name
    if name in ENCODINGS:
        return frame
    if name.startswith(("Mono", "Bayer")):
        format_name = "Mono16" if name.startswith("Mono") else f"{name[:7]}16"
        return with_pixels(frame, frame.array(), format_name)
    if frame.format.compressed:
        return to_ros_format(decode_frame(frame, ""))
    return convert_frame(frame, "RGB16" if frame.format.depth > 8 else "RGB8")


def image_fields(frame: Frame, frame_id: str) -> dict[str, Any]:
    """Return the fields of ``sensor_msgs/Image``; the pixels are not copied.

    Raises:
        FrameFormatError: ROS has no name for the format (:func:`to_ros_format` converts it), or
            there are too few bytes.
    """
    encoding = ENCODINGS.get(frame.format.name)
    if encoding is None:
        raise FrameFormatError(
            f"{frame.source}: ROS has no encoding for {frame.format.name}; expected one of "
            f"{', '.join(ENCODINGS)}",
            source=frame.source,
        )
    frame.format.check(frame.data, frame.width, frame.height, frame.stride)
    return {
        "header": header_fields_at(frame.utc, frame_id),
        "height": frame.height,
        "width": frame.width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": frame.stride,
        "data": _whole_rows(frame),
    }


def _whole_rows(frame: Frame) -> memoryview:
    """Return the bytes of all rows; the last row may have no padding."""
    data, size = memoryview(frame.data).cast("B"), frame.stride * frame.height
    if data.nbytes >= size:
        return data[:size]
    return memoryview(bytes(data).ljust(size, b"\0"))


def array_fields(pixels: NDArray[Any], encoding: str, header: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of ``sensor_msgs/Image`` of an array (H, W) or (H, W, C)."""
    contiguous = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
    height, width = contiguous.shape[:2]
    return {
        "header": header,
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": contiguous.nbytes // max(height, 1),
        "data": contiguous.reshape(-1).view(np.uint8),
    }


class Compression(NamedTuple):
    """The steps from a frame to ``sensor_msgs/CompressedImage``.

    Attributes:
        codec: ``jpeg``, ``png``, or "" for a JPEG that is sent unchanged.
        convert_to: the format to which the frame is converted before; "": no conversion.
        encoding: encoding of the pixels after decoding.
    """

    codec: Literal["jpeg", "png", ""]
    convert_to: Literal["Mono8", "RGB8", ""]
    encoding: str

    def format_text(self) -> str:
        """Return the message's ``format``."""
        decoded = "bgr8" if self.encoding in {"rgb8", "bgr8"} else self.encoding
        file_type = "png" if self.codec == "png" else "jpeg"
        return f"{self.encoding}; {file_type} compressed {decoded}"


def choose_compression(frame: Frame) -> Compression:
    """Return the compression of a frame: PNG, without loss, for depth, JPEG for all others.

    For JPEG, samples are cut to their highest 8 bits, and a Bayer pattern becomes colours.

    Raises:
        FrameFormatError: the frame is of H.264.
        MissingExtraError: the codecs are not installed.
    """
    name = frame.format.name
    if name == "MJPEG":
        coloured = jpeg_header(frame.data, name)[2]
        return Compression("", "", "bgr8" if coloured else "mono8")
    if name == "Coord3D_C16":
        return Compression("png", "", "16UC1")
    if name in {"Mono8", "RGB8", "BGR8"}:
        return Compression("jpeg", "", ENCODINGS[name])
    if name.startswith("Mono"):
        return Compression("jpeg", "Mono8", "mono8")
    if name.startswith("Bayer"):
        return Compression("jpeg", "RGB8", "bgr8")
    if name == "H264":
        raise FrameFormatError(
            f"{frame.source}: expected a picture, got H264: read it decoded", source=frame.source
        )
    return Compression("jpeg", "", "bgr8")


def compressed_fields(frame: Frame, format_text: str, frame_id: str) -> dict[str, Any]:
    """Return the fields of ``sensor_msgs/CompressedImage``."""
    return {
        "header": header_fields_at(frame.utc, frame_id),
        "format": format_text,
        "data": memoryview(frame.data).cast("B"),
    }


# ---------------------------------------------------------------------- from ROS


def utc_of(header: Any) -> float:
    """Return a header's time in seconds since 1970."""
    return float(header.stamp.sec) + float(header.stamp.nanosec) / BILLION


def frame_from(
    message: Any,
    *,
    source: str = "",
    sequence: int = 0,
    duration: float = UNKNOWN_DURATION,
    camera_info: CameraModel | None = None,
) -> Frame:
    """Return the frame of a ``sensor_msgs/Image`` or ``sensor_msgs/CompressedImage``.

    The pixels are not copied if the message has smartcam's format. The time is the header's.

    Args:
        message: message of either type.
        source: name of the camera; "": the header's ``frame_id``.
        sequence: number of the frame, such as that of the subscription's ``attachment``.
        duration: seconds before the stamp within which the frame may have been exposed.
        camera_info: model of the lens; None: not known.

    Raises:
        FrameFormatError: an encoding without a pixel format, fewer bytes than the size requires, or
            no JPEG or PNG.
        MissingExtraError: the message is compressed and the extra ``frames`` is not installed.
    """
    if hasattr(message, "encoding"):
        pixel_format, width, height, step, data = _read_image(message)
    else:
        pixel_format, width, height, step, data = _read_compressed(message)
    pixel_format.check(data, width, height, step)
    utc = utc_of(message.header)
    now = time.monotonic()
    return Frame(
        data=data,
        format=pixel_format,
        width=width,
        height=height,
        stride=step,
        captured=min(now, now - (time.time() - utc)),
        utc=utc,
        moment=Moment.ARRIVAL,
        duration=duration,
        sequence=sequence,
        source=source or message.header.frame_id,
        camera_info=camera_info,
    )


def _read_image(message: Any) -> tuple[PixelFormat, int, int, int, memoryview]:
    width, height, step, encoding = message.width, message.height, message.step, message.encoding
    data = memoryview(message.data).cast("B")
    name = _FORMATS.get(encoding)
    if name is None:
        raise FrameFormatError(
            f"ROS image: expected one of the encodings {', '.join(_FORMATS)}, got "
            f"{encoding!r:.40}; pixels_from() reads encodings of numbers such as 32FC1"
        )
    pixel_format = find_format(name)
    if message.is_bigendian and pixel_format.depth > 8:
        swapped = np.ascontiguousarray(pixels_from(message), "<u2")
        return pixel_format, width, height, pixel_format.stride(width), swapped.data.cast("B")
    return pixel_format, width, height, step, data


def _read_compressed(message: Any) -> tuple[PixelFormat, int, int, int, memoryview]:
    data = memoryview(message.data).cast("B")
    first_bytes = bytes(data[:24])
    if first_bytes[:8] == b"\x89PNG\r\n\x1a\n" and len(first_bytes) == 24:
        width, height = (int.from_bytes(first_bytes[at : at + 4], "big") for at in (16, 20))
        return find_format("PNG"), width, height, 0, data
    if first_bytes[:2] != b"\xff\xd8":
        raise FrameFormatError(
            f"ROS compressed image {message.format!r:.60}: expected a JPEG or PNG, got "
            f"{len(data)} bytes that begin with {first_bytes[:8].hex(' ') or 'none'}"
        )
    width, height, _ = jpeg_header(data, "MJPEG")
    return find_format("MJPEG"), width, height, 0, data


def pixels_from(message: Any) -> NDArray[Any]:
    """Return the pixels of a ``sensor_msgs/Image`` as numbers, without a conversion.

    Returns:
        (H, W) or (H, W, C), for 8UC1, 32FC1 and similar ones and for all named encodings, except
        of Y, U and V; a view, unless the message has another byte order than this machine.

    Raises:
        FrameFormatError: there is no such encoding, or fewer bytes than the size requires.
    """
    sample_type, channels = _sample_type(message.encoding)
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(f"{order}{sample_type}")
    width, height, step = message.width, message.height, message.step
    row = width * channels * dtype.itemsize
    data = memoryview(message.data).cast("B")
    if height and width and (step < row or len(data) < step * (height - 1) + row):
        raise FrameFormatError(
            f"ROS image {width}x{height} {message.encoding}: expected {row} bytes or more from row "
            f"to row and {step * (height - 1) + row} in all, got {step} and {len(data)}"
        )
    shape = (height, width, channels)
    strides = (step, channels * dtype.itemsize, dtype.itemsize)
    view: NDArray[Any] = np.ndarray(shape, dtype, data, 0, strides)
    view = view if channels > 1 else view[..., 0]
    return view if dtype.isnative else view.astype(dtype.newbyteorder("="))


def _sample_type(encoding: str) -> tuple[str, int]:
    """Return numpy's type of an encoding's numbers, and the count of numbers in a pixel."""
    bits, _, count = encoding.partition("C")
    if bits[:-1] in {"8", "16", "32", "64"} and bits[-1:] in _DTYPES and count in {*"1234", ""}:
        return f"{_DTYPES[bits[-1]]}{int(bits[:-1]) // 8}", int(count or 1)
    for name, channels in (("mono", 1), ("bayer_", 1), ("rgba", 4), ("bgra", 4), ("rgb", 3)):
        if encoding.startswith(name) and encoding.endswith(("8", "16")):
            return ("u2" if encoding.endswith("16") else "u1"), channels
    if encoding in {"bgr8", "bgr16"}:
        return ("u2" if encoding == "bgr16" else "u1"), 3
    raise FrameFormatError(
        f"ROS image: expected an encoding of numbers, such as mono8 or 32FC1, got {encoding!r:.40}"
    )
