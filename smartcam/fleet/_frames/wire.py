"""Encode and decode frames on the bus: their fields, and the parts of their bytes.

The reply to a call for a frame has all fields of the frame, but not its bytes. The bytes are sent
separately under another key, in parts, since Zenoh drops messages that are longer than its
queue. If the queue is full, a part is dropped: sending a part never waits.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from smartcam.exceptions import ConfigurationError, RemoteProtocolError
from smartcam.fleet._frames.features import read_value
from smartcam.frames import Frame, FrameTrigger, Moment

if TYPE_CHECKING:
    from smartcam.fleet._bus.bus import Data
    from smartcam.frames._inside import RateStatistics
    from smartcam.geometry import CameraModel

MAX_FRAME_BYTES = 1 << 28
"""Largest number of bytes of a frame: 13,000 x 10,000 pixels of 16 bits."""

ENCODINGS = ("raw", "jpeg", "png", "jpegxl")
"""Encodings of frames; raw: the camera's own encoding."""


VIDEO = "h264"
"""Encoding that only streams can have, since its frames depend on each other."""

MIN_BITRATE, MAX_BITRATE = 10_000, 1_000_000_000
"""Smallest and largest bit rate of H.264, bits per second."""


class FrameForm(NamedTuple):
    """The requested form of frames.

    Attributes:
        name: one of :data:`ENCODINGS`, or :data:`VIDEO`.
        quality: quality of JPEG, 1 to 100; None for the codec's default.
        bitrate: bit rate of H.264, bits per second; None for constant quality.
    """

    name: str = "raw"
    quality: int | None = None
    bitrate: int | None = None

    @classmethod
    def checked(
        cls,
        name: object,
        quality: object,
        caller: str,
        *,
        bitrate: object = None,
        stream: bool = False,
    ) -> FrameForm:
        """Check arguments, and return the form of frames that they describe.

        Args:
            name: the encoding.
            quality: quality of a JPEG; None for the codec's default.
            caller: name of the caller, for error texts.
            bitrate: bits per second; None for constant quality.
            stream: whether the request is for a stream; only streams may have :data:`VIDEO`.

        Raises:
            ConfigurationError: an argument is unknown, out of range, or not for this encoding.
        """
        known = (*ENCODINGS, VIDEO) if stream else ENCODINGS
        if name not in known:
            reason = ": it is for streams only, since its frames depend on each other"
            raise ConfigurationError(
                f"{caller}: encoding: expected {', '.join(known)}, got {name!r:.40}"
                f"{reason if name == VIDEO else ''}"
            )
        for option, value, needed, low, high in (
            ("quality", quality, "jpeg", 1, 100),
            ("bitrate", bitrate, VIDEO, MIN_BITRATE, MAX_BITRATE),
        ):
            if value is None:
                continue
            if name != needed:
                raise ConfigurationError(f"{caller}: {option}: {name} has none, got {value!r:.40}")
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise ConfigurationError(
                    f"{caller}: {option}: expected {low} to {high}, got {value!r:.40}"
                )
        return cls(str(name), cast("int | None", quality), cast("int | None", bitrate))

    def fields(self) -> dict[str, Any]:
        """Return the form as arguments of a call."""
        fields = {"encoding": self.name, "quality": self.quality}
        return fields if self.bitrate is None else {**fields, "bitrate": self.bitrate}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FleetFrame(Frame):
    """A frame that came over the bus.

    Attributes:
        encoding_time: seconds that the agent took to encode this frame; 0 if it has the camera's
            own encoding, or was already encoded for another program.
        rate: state of the control of the stream's bit rate or latency; None without control.
    """

    encoding_time: float = 0.0
    rate: RateStatistics | None = None


def to_fields(
    frame: Frame, clock_lead: float, encoding_time: float, lens_number: int
) -> dict[str, Any]:
    """Return the fields that describe a frame, for JSON.

    Args:
        frame: the frame.
        clock_lead: seconds by which the agent's clock is ahead of ``time.monotonic()``.
        encoding_time: as in :class:`FleetFrame`.
        lens_number: number of the frame's ``camera_info``; 0 for none.
    """
    return {
        "format": frame.format.name,
        "width": frame.width,
        "height": frame.height,
        "stride": frame.stride,
        "captured": frame.captured + clock_lead,
        "utc": frame.utc,
        "moment": frame.moment.name,
        "duration": frame.duration,
        "device_time": frame.device_time,
        "sequence": frame.sequence,
        "lost": frame.lost,
        "age": frame.age,
        "size": len(frame.data),
        "encoding_time": encoding_time,
        "lens": lens_number,
        **_optional_fields(frame, clock_lead),
    }


def _optional_fields(frame: Frame, clock_lead: float) -> dict[str, Any]:
    """Return the fields that only some frames have."""
    more: dict[str, Any] = {}
    chunks = {
        name: value
        for name, value in frame.chunks.items()
        if not isinstance(value, float) or math.isfinite(value)
    }
    if chunks:
        more["chunks"] = chunks
    if frame.remark:
        more["remark"] = frame.remark
    if frame.trigger is not None:
        more["trigger"] = {
            "number": frame.trigger.number,
            "fired": frame.trigger.fired + clock_lead,
            "evidence": [*frame.trigger.evidence],
        }
    return more


def _read_optional_fields(fields: dict[str, Any], captured: float, caller: str) -> dict[str, Any]:
    """Read the fields from :func:`_optional_fields`; their times become times of this program."""
    chunks, remark, trigger = (
        fields.get("chunks", {}),
        fields.get("remark", ""),
        fields.get("trigger"),
    )
    if not isinstance(chunks, dict):
        raise TypeError("its chunks are not valid")
    read: dict[str, Any] = {
        "chunks": {
            str(name): read_value(value, caller)
            for name, value in cast("dict[str, Any]", chunks).items()
        },
        "remark": str(remark),
    }
    if trigger is not None:
        fired = float(trigger["fired"]) - float(fields["captured"]) + captured
        evidence = tuple(map(str, trigger["evidence"]))
        read["trigger"] = FrameTrigger(int(trigger["number"]), fired, evidence)
    return read


def from_fields(
    sent: dict[str, Any],
    data: Data,
    *,
    captured: float,
    uncertainty: float,
    lost: int,
    source: str,
    camera_info: CameraModel | None,
) -> FleetFrame:
    """Return the frame that an agent's fields and these arguments describe.

    Args:
        sent: fields from :func:`to_fields`.
        data: bytes of the frame.
        captured: time of the capture by this program's ``time.monotonic()``.
        uncertainty: seconds by which ``captured`` may be wrong.
        lost: number of frames lost before this one.
        source: the camera's name.
        camera_info: model of the camera's lens; None for none.

    Raises:
        RemoteProtocolError: the fields are not valid.
        FrameFormatError: this version does not know the pixel format.
    """
    from smartcam.frames import find_format  # imports numpy, which not every program needs

    try:
        width, height, stride = int(sent["width"]), int(sent["height"]), int(sent["stride"])
        duration, device = float(sent["duration"]), sent["device_time"]
        pixels = str(sent["format"])
        if width <= 0 or height <= 0 or stride < 0 or not 0 <= duration < math.inf:
            raise ValueError(f"{width}x{height}, rows of {stride} bytes")
        fields: dict[str, Any] = {
            "moment": Moment[str(sent["moment"])],
            "utc": float(sent["utc"]),
            "device_time": None if device is None else float(device),
            "sequence": int(sent["sequence"]),
            "encoding_time": float(sent["encoding_time"]),
            **_read_optional_fields(sent, captured, source),
        }
    except (KeyError, TypeError, ValueError) as exc:
        raise RemoteProtocolError(f"{source}: the agent's frame is not valid: {exc!r}") from exc
    return FleetFrame(
        data=data,
        format=find_format(pixels),
        width=width,
        height=height,
        stride=stride,
        captured=captured,
        duration=duration + uncertainty,  # the capture is in this time
        lost=lost,
        source=source,
        camera_info=camera_info,
        **fields,
    )


_PART_HEAD = struct.Struct("<4sQQQ")
_PART_MAGIC = b"scf1"


class FramePart(NamedTuple):
    """The position of a part in its frame.

    Attributes:
        call: number of the call that the frame answers.
        offset: index of the part's first byte in the frame's bytes.
        total: number of bytes of the whole frame.
    """

    call: int
    offset: int
    total: int


def encode_part(part: FramePart) -> bytes:
    """Return the head of a part as bytes."""
    return _PART_HEAD.pack(_PART_MAGIC, *part)


def decode_part(head: bytes) -> FramePart:
    """Return the position of a part from its head.

    Raises:
        RemoteProtocolError: the head is not valid.
    """
    try:
        magic, call, offset, total = _PART_HEAD.unpack(head)
    except struct.error as exc:
        raise RemoteProtocolError(f"a part of a frame is broken: {exc}") from exc
    if magic != _PART_MAGIC or total > MAX_FRAME_BYTES:
        raise RemoteProtocolError(f"a part of a frame of {total} bytes begins with {magic!r}")
    return FramePart(call, offset, total)
