"""Frames on their way over the bus: what is said of one, and the parts that its bytes come in.

The reply to a call for a frame says all of it but its bytes. These come under a key of their own,
in parts, since the engine drops what is longer than its queue; a part is dropped where there is no
room, and never waited for.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import ConfigurationError, RemoteProtocolError
from smartcam.frames import Frame, Moment

if TYPE_CHECKING:
    from smartcam.calibration._lens.model import CameraModel
    from smartcam.fleet._bus import Data

MOST_FRAME = 1 << 28
"""Bytes of a frame at most: 14,000 x 10,000 pixels of 16 bits."""

ENCODINGS = ("raw", "jpeg", "png", "jpegxl")
"""What frames may be encoded as; raw is as the camera gave them."""


class FrameForm(NamedTuple):
    """How frames are to come.

    Attributes:
        name: one of :data:`ENCODINGS`.
        quality: of JPEG, 1 to 100; None: the codec's own.
    """

    name: str = "raw"
    quality: int | None = None

    @classmethod
    def checked(cls, name: object, quality: object, who: str) -> FrameForm:
        """Return it.

        Raises:
            ConfigurationError: there is no such encoding, or it has no such quality; ``who`` asks.
        """
        if name not in ENCODINGS:
            raise ConfigurationError(
                f"{who}: encoding: expected {', '.join(ENCODINGS)}, got {name!r:.40}"
            )
        if quality is None:
            return cls(str(name))
        if name != "jpeg":
            raise ConfigurationError(f"{who}: quality: {name} has none, got {quality!r:.40}")
        if isinstance(quality, bool) or not isinstance(quality, int) or not 1 <= quality <= 100:
            raise ConfigurationError(f"{who}: quality: expected 1 to 100, got {quality!r:.40}")
        return cls(str(name), quality)

    def fields(self) -> dict[str, Any]:
        """Return it as arguments of a call."""
        return {"encoding": self.name, "quality": self.quality}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FleetFrame(Frame):
    """A frame that came over the bus.

    Attributes:
        encoding_time: seconds that its agent took to encode it; 0 where it is as the camera gave
            it, or was encoded for somebody else before.
    """

    encoding_time: float = 0.0


def to_fields(frame: Frame, ahead: float, encoding_time: float, lens: int) -> dict[str, Any]:
    """Return what there is to say of a frame, as JSON.

    Args:
        frame: the frame.
        ahead: seconds that the agent's clock is ahead of ``time.monotonic()``.
        encoding_time: as :class:`FleetFrame` has it.
        lens: number of its ``camera_info``; 0: it has none.
    """
    return {
        "format": frame.format.name,
        "width": frame.width,
        "height": frame.height,
        "stride": frame.stride,
        "captured": frame.captured + ahead,
        "utc": frame.utc,
        "moment": frame.moment.name,
        "duration": frame.duration,
        "device_time": frame.device_time,
        "sequence": frame.sequence,
        "lost": frame.lost,
        "age": frame.age,
        "size": len(frame.data),
        "encoding_time": encoding_time,
        "lens": lens,
    }


def from_fields(
    said: dict[str, Any],
    data: Data,
    *,
    captured: float,
    doubt: float,
    lost: int,
    source: str,
    camera_info: CameraModel | None,
) -> FleetFrame:
    """Return the frame that an agent said; what was not said with it is given beside.

    Args:
        said: by :func:`to_fields`.
        data: its bytes.
        captured: when it was taken, by this side's ``time.monotonic()``.
        doubt: how far off that may be, seconds.
        lost: how many were lost before it.
        source: the camera's name.
        camera_info: its lens.

    Raises:
        RemoteProtocolError: it is no frame.
        FrameFormatError: pixels that this version does not know.
    """
    from smartcam.frames import find_format  # with numpy, which not everybody needs

    try:
        width, height, stride = int(said["width"]), int(said["height"]), int(said["stride"])
        duration, device = float(said["duration"]), said["device_time"]
        pixels = str(said["format"])
        if width <= 0 or height <= 0 or stride < 0 or not 0 <= duration < math.inf:
            raise ValueError(f"{width}x{height}, rows of {stride} bytes")
        fields: dict[str, Any] = {
            "moment": Moment[str(said["moment"])],
            "utc": float(said["utc"]),
            "device_time": None if device is None else float(device),
            "sequence": int(said["sequence"]),
            "encoding_time": float(said["encoding_time"]),
        }
    except (KeyError, TypeError, ValueError) as exc:
        raise RemoteProtocolError(f"{source}: what the agent says of a frame: {exc!r}") from exc
    return FleetFrame(
        data=data,
        format=find_format(pixels),
        width=width,
        height=height,
        stride=stride,
        captured=captured,
        duration=duration + doubt,
        lost=lost,
        source=source,
        camera_info=camera_info,
        **fields,
    )


_PART = struct.Struct("<4sQQQ")
_IS_PART = b"scf1"


class FramePart(NamedTuple):
    """Which part of which frame.

    Attributes:
        call: number of the call that it answers.
        offset: of its first byte in the frame's.
        total: bytes of the frame.
    """

    call: int
    offset: int
    total: int


def encode_part(part: FramePart) -> bytes:
    """Return it as bytes."""
    return _PART.pack(_IS_PART, *part)


def decode_part(head: bytes) -> FramePart:
    """Return which part this is.

    Raises:
        RemoteProtocolError: it is none.
    """
    try:
        magic, call, offset, total = _PART.unpack(head)
    except struct.error as exc:
        raise RemoteProtocolError(f"a part of a frame is broken: {exc}") from exc
    if magic != _IS_PART or total > MOST_FRAME:
        raise RemoteProtocolError(f"a part of a frame of {total} bytes begins with {magic!r}")
    return FramePart(call, offset, total)
