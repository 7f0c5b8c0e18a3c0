"""One picture of a camera, with its times and the number of frames lost before it."""

from __future__ import annotations

import dataclasses
import enum
import operator
import time
from dataclasses import dataclass, field, fields
from functools import partial
from typing import TYPE_CHECKING, Any, Final, cast

from smartcam.frames._pixels.apart import JoinedPlanes

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from smartcam.frames._features import FeatureValue
    from smartcam.frames._marks import Drawing
    from smartcam.frames._pixels.formats import PixelFormat
    from smartcam.geometry import CameraModel


class Moment(enum.Enum):
    """The moment that a frame's capture time stands for."""

    EXPOSURE_START = "start of exposure"
    """The start of the sensor's exposure."""
    FRAME_END = "end of frame"
    """The last pixel was read: exposure and readout are over."""
    ARRIVAL = "arrival"
    """The arrival of the frame; the time of its capture is not known."""


@dataclass(frozen=True, slots=True)
class FrameTrigger:
    """The trigger that caused a frame.

    Attributes:
        number: number of the trigger, counted by its source.
        fired: time right before it was sent, seconds of ``time.monotonic()``.
        evidence: sentences that say why this trigger must have caused the frame.
    """

    number: int
    fired: float
    evidence: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One picture as its camera sent it.

    Attributes:
        data: bytes of the picture without conversion, which do not change.
        format: format of the bytes.
        width: width in pixels.
        height: height in pixels.
        stride: bytes from one row to the next; 0 if the format is compressed.
        captured: time of the capture, seconds of ``time.monotonic()``.
        utc: time of the capture, seconds since 1970.
        moment: moment of the capture that ``captured`` and ``utc`` refer to.
        duration: longest possible time from the start of the exposure to ``captured``, seconds: 0
            if ``captured`` is the start; else computed from the known exposure, readout and
            transfer times.
        device_time: seconds of the camera's own clock; None: the camera has no clock, or sent no
            time. A driver with a device time gives the arrival as ``captured``; the source replaces
            it by the device time, converted to the host's clock.
        sequence: the camera's number of the frame, which also counts lost frames.
        lost: number of frames lost, on the way or in the camera, since the previous frame.
        source: name of the camera.
        camera_info: lens of the camera; None: not given.
        remark: decoder's warning about a picture that is usable nevertheless (such as surplus
            bytes), or a problem with chunk data; mostly empty.
        chunks: values that the camera sent with the picture, by the name of their feature, such as
            ``ChunkExposureTime``; empty if it sends none.
        trigger: trigger by :meth:`FrameSource.trigger` that caused the frame; None: no trigger.
        drawings: marks of the tools of the software camera that judged the picture, each a
            :class:`smartcam.inspection.Drawing`; mostly empty. An agent shares frames without them.
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
    drawings: tuple[Drawing, ...] = ()

    def __reduce__(self) -> tuple[Callable[[], Frame], tuple[()]]:
        """Return a function that makes a copy with its own bytes, also in another process."""
        values = {attribute.name: getattr(self, attribute.name) for attribute in fields(self)}
        return partial(type(self), **(values | {"data": bytes(self.data)})), ()

    @property
    def age(self) -> float:
        """Seconds since ``captured``."""
        return time.monotonic() - self.captured

    @property
    def began(self) -> float:
        """Earliest time at which the exposure began, seconds of ``time.monotonic()``."""
        return self.captured - self.duration

    def array(self) -> NDArray[Any]:
        """Return the pixels in the frame's own format, unpacked but not converted.

        Returns:
            (H, W) or (H, W, C), uint8 or uint16, read-only; for formats with several planes, such
            as NV12, and compressed formats, the bytes, (N,).

        Raises:
            FrameFormatError: there are fewer bytes than the format needs.
        """
        return self.format.array(self.data, self.width, self.height, self.stride)

    def grey(self) -> NDArray[Any]:
        """Return the brightness: the camera's own plane if it sent one.

        For RGB it is computed as Y of BT.601, for a Bayer pattern by demosaicing;
        :attr:`PixelFormat.grey_is_sent` says whether it was sent. For YUV it is Y in its original
        range.

        Returns:
            (H, W), uint8 or uint16, read-only if it is the camera's own plane.

        Raises:
            FrameFormatError: the format has no brightness, or its bytes are wrong.
            MissingExtraError: the codec of a compressed format is not installed.
        """
        return self.format.grey(_data.stored_value(self), self.width, self.height, self.stride)

    def rgb(self) -> NDArray[Any]:
        """Return the colours, (H, W, 3), red first; Bayer patterns are demosaiced.

        YUV is taken as BT.601 with limited range, unless the format's name says ``709``, ``2020``
        or ``full``; grey is repeated three times. No value differs from the exact formula by more
        than one level.

        Raises:
            FrameFormatError: the format has no colours, or its bytes are wrong.
            MissingExtraError: the codec of a compressed format is not installed.
        """
        return self.format.rgb(self.data, self.width, self.height, self.stride)


_data: Final = JoinedPlanes(vars(Frame)["data"])  # `Frame.data` joins planes, grey() does not
setattr(Frame, "data", _data)  # noqa: B010 - type checkers use the field
_NAMES: Final = tuple(attribute.name for attribute in fields(Frame))
_NAMES_WITHOUT_DATA: Final = tuple(name for name in _NAMES if name != "data")
_values_of: Final[Callable[[Frame], tuple[object, ...]]] = operator.attrgetter(*_NAMES_WITHOUT_DATA)
_setters: Final = tuple(getattr(Frame, name).__set__ for name in _NAMES_WITHOUT_DATA)


def amend(frame: Frame, **changes: object) -> Frame:
    """Change some attributes of a new frame in place, and return it."""
    for name, value in changes.items():
        object.__setattr__(frame, name, value)
    return frame


def copy_with(frame: Frame, **changes: object) -> Frame:
    """Return a frame with some attributes changed, in half the time of ``dataclasses.replace``.

    Args:
        frame: frame to copy; a frame of a derived class keeps its class, but takes the usual time.
        **changes: new values by the names of the attributes.
    """
    if type(frame) is not Frame:
        return dataclasses.replace(frame, **cast("Any", changes))
    copy = object.__new__(Frame)
    _data.__set__(copy, _data.stored_value(frame))
    for set_value, value in zip(_setters, _values_of(frame), strict=True):
        set_value(copy, value)
    return amend(copy, **changes)
