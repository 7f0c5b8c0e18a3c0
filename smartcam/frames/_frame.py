"""One picture of a camera, with when it was taken and what was lost before it."""

from __future__ import annotations

import dataclasses
import enum
import operator
import time
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Final, cast

from smartcam.frames._pixels.apart import JoinedOnUse

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from smartcam.frames._features import FeatureValue
    from smartcam.frames._pixels.formats import PixelFormat
    from smartcam.geometry import CameraModel


class Moment(enum.Enum):
    """The moment that a frame's capture time stands for."""

    EXPOSURE_START = "start of exposure"
    """The sensor began to see."""
    FRAME_END = "end of frame"
    """The last pixel was there: exposure and readout are over."""
    ARRIVAL = "arrival"
    """The frame was here; when it was taken nobody said."""


@dataclass(frozen=True, slots=True)
class FrameTrigger:
    """The trigger that caused a frame.

    Attributes:
        number: number of the trigger, counted by its source.
        fired: time right before it was sent, seconds of ``time.monotonic()``.
        evidence: reasons why the frame is the one that this trigger caused, for people.
    """

    number: int
    fired: float
    evidence: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One picture as its camera gave it.

    Attributes:
        data: bytes of the picture, as they came: nothing is converted, and nobody else writes into
            them.
        format: format of the bytes.
        width: pixels.
        height: pixels.
        stride: bytes from one row to the next one; 0 where the format is compressed.
        captured: time of the capture, seconds of ``time.monotonic()``.
        utc: time of the capture, seconds since 1970.
        moment: moment of the capture that these times are of.
        duration: longest time from the start of the exposure to ``captured``, seconds: 0 where
            that is the start; else what the source knows of its frame time and of its way here.
        device_time: seconds of the camera's own clock; None: the camera has none, or sent no time.
            A driver that knows the device's time gives the arrival as ``captured``, which the
            source replaces by the device's time on our clock.
        sequence: the camera's number of the frame; it counts lost ones, too.
        lost: frames that were lost between the last one and this one, on the way or in the camera.
        source: name of the camera.
        camera_info: lens of the camera, if it was given; else None.
        remark: remark of the decoder that made this frame of a compressed one, such as bytes that
            belong to nothing, on a picture that is whole all the same; mostly empty. So it tells
            chunk data that could not be read.
        chunks: values that the camera sent with the picture, by the name of their feature, such as
            ``ChunkExposureTime``; empty where it sends none.
        trigger: trigger of :meth:`FrameSource.trigger` that caused the frame; None: no trigger did.
    """

    data: bytes | bytearray | memoryview
    format: PixelFormat
    width: int
    height: int
    stride: int
    captured: float
    utc: float
    moment: Moment
    duration: float = 0.0
    device_time: float | None = None
    sequence: int
    lost: int = 0
    source: str
    camera_info: CameraModel | None = None
    remark: str = ""
    chunks: Mapping[str, FeatureValue] = field(default_factory=dict)
    trigger: FrameTrigger | None = None

    @property
    def age(self) -> float:
        """Seconds since ``captured``."""
        return time.monotonic() - self.captured

    @property
    def began(self) -> float:
        """Earliest time at which the exposure began, seconds of ``time.monotonic()``."""
        return self.captured - self.duration

    def array(self) -> NDArray[Any]:
        """Return the pixels as the format has them; nothing is converted, only unpacked.

        Returns:
            (H, W) or (H, W, C), uint8 or uint16, read-only; of a format of several planes, such as
            NV12, and of a compressed one the bytes, (N,).

        Raises:
            FrameFormatError: there are fewer bytes than the format asks for.
        """
        return self.format.array(self.data, self.width, self.height, self.stride)

    def grey(self) -> NDArray[Any]:
        """Return the brightness: the plane that the camera sent, where it sent one.

        Of RGB it is made, BT.601's Y, and of a Bayer pattern by demosaicing:
        :attr:`PixelFormat.grey_is_sent` tells. Of YUV it is Y with the range it came in.

        Returns:
            (H, W), uint8 or uint16, read-only where it is the camera's own plane.

        Raises:
            FrameFormatError: the format has no brightness, or its bytes are wrong.
            MissingExtraError: a compressed format, and its codec is not installed.
        """
        return self.format.grey(_data.held(self), self.width, self.height, self.stride)

    def rgb(self) -> NDArray[Any]:
        """Return the colours, (H, W, 3), red first; Bayer patterns are demosaiced.

        YUV is BT.601 of limited range, unless the format's name says ``709``, ``2020`` or
        ``full``; grey is given three times. No value is more than one level from the formulas'.

        Raises:
            FrameFormatError: the format has no colours, or its bytes are wrong.
            MissingExtraError: a compressed format, and its codec is not installed.
        """
        return self.format.rgb(self.data, self.width, self.height, self.stride)


_data: Final = JoinedOnUse(vars(Frame)["data"])
setattr(Frame, "data", _data)  # noqa: B010 - checkers know the attribute as it is read
_NAMES: Final = tuple(one.name for one in fields(Frame))
_OTHERS: Final = tuple(name for name in _NAMES if name != "data")
_values_of: Final[Callable[[Frame], tuple[object, ...]]] = operator.attrgetter(*_OTHERS)
_setters: Final = tuple(getattr(Frame, name).__set__ for name in _OTHERS)


def amend(frame: Frame, **changes: object) -> Frame:
    """Return a frame that nobody else has yet, with some attributes changed in it."""
    for name, value in changes.items():
        object.__setattr__(frame, name, value)
    return frame


def changed(frame: Frame, **changes: object) -> Frame:
    """Return a frame with some attributes changed, in half the time of ``dataclasses.replace``.

    Args:
        frame: frame that stays as it is; one of a derived class keeps its class, in the usual time.
        **changes: new values by the names of the attributes.
    """
    if type(frame) is not Frame:
        return dataclasses.replace(frame, **cast("Any", changes))
    made = object.__new__(Frame)
    _data.__set__(made, _data.held(frame))
    for put, value in zip(_setters, _values_of(frame), strict=True):
        put(made, value)
    return amend(made, **changes)
