"""Convert the filled buffers of a device to frames, and count buffers without a picture."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames._frame import Frame
from smartcam.frames._v4l2 import abi, system
from smartcam.frames._v4l2.buffers import Buffers
from smartcam.frames._v4l2.device import device_error
from smartcam.frames._v4l2.stamps import BufferStamps

if TYPE_CHECKING:
    from smartcam.frames._driver import FrameSink
    from smartcam.frames._v4l2.buffers import FilledBuffer
    from smartcam.frames._v4l2.device import CaptureDevice, Setting

MAX_CONSECUTIVE_BAD: Final = 30
"""Number of consecutive buffers without a whole picture after which the stream fails."""

MAX_CONSECUTIVE_EMPTY: Final = 1000
"""Number of times in a row that the system may report a filled buffer although there is none."""

HALF_SEQUENCE_RANGE: Final = 1 << 31
"""Half of the range of 32-bit frame numbers; a larger step forwards counts as a step backwards."""


class CaptureStream:
    """The stream of a device with an applied setting.

    Args:
        device: device with its setting applied, which then belongs to this stream.
        setting: setting of the device.
        buffers: number of buffers to ask for.
        name: name of the camera.

    Raises:
        FrameSourceError: the device does not stream; the caller must close it.
    """

    def __init__(self, device: CaptureDevice, setting: Setting, buffers: int, name: str) -> None:
        self.device = device
        self._name = name
        layout = setting.layout
        period = None if setting.rate is None else 1 / setting.rate
        self._format, self._width, self._height = setting.format, layout.width, layout.height
        self._stride = 0 if setting.format.compressed else layout.stride
        self._min_bytes = (
            1
            if setting.format.compressed
            else setting.format.size(layout.width, layout.height, layout.stride)
        )
        self._stamps = BufferStamps(name, period, system.now())
        self._buffers = Buffers(device, buffers)
        self._sequence: int | None = None  # driver's number of the last frame
        self._unwrapped_sequence = 0
        # consecutive buffers without a whole picture, and consecutive calls without a filled buffer
        self._bad_count = self._empty_count = 0

    def close(self) -> None:
        """Stop the stream, release the buffers, and close the device."""
        self._buffers.release()
        self.device.close()

    def drain(self, sink: FrameSink) -> None:
        """Pass all available frames to the sink.

        Raises:
            FrameSourceError: no more frames will come.
        """
        for _ in range(len(self._buffers)):
            try:
                filled = self._buffers.take_picture()
            except BlockingIOError:
                self._stamps.record_empty_queue(system.now())
                self._count_empty()
                return
            except OSError as exc:
                raise device_error(self._name, "taking a picture", exc) from exc
            self._empty_count = 0
            frame = self._to_frame(filled, sink)
            if frame is not None:
                sink.frame(frame)
                if self._stamps.is_newest:
                    return

    def _to_frame(self, filled: FilledBuffer, sink: FrameSink) -> Frame | None:
        """Return the frame in a buffer; count a buffer without a whole picture as lost."""
        step = self._advance_sequence(filled.sequence)
        if len(filled.data) < self._min_bytes:
            sink.lost(step)
            self._bad_count += 1
            if self._bad_count >= MAX_CONSECUTIVE_BAD:
                raise self._no_pictures_error(filled)
            return None
        self._bad_count = 0
        now, utc = system.now(), time.time()
        stamp = self._stamps.frame_stamp(filled.stamp, filled.flags, self._unwrapped_sequence, now)
        return Frame(
            data=filled.data,
            format=self._format,
            width=self._width,
            height=self._height,
            stride=self._stride,
            captured=stamp.captured,
            utc=utc - (now - stamp.captured),
            moment=stamp.moment,
            duration=stamp.duration,
            device_time=stamp.device_time,
            sequence=self._unwrapped_sequence,
            lost=step - 1,
            source=self._name,
        )

    def _count_empty(self) -> None:
        self._empty_count += 1
        if self._empty_count > MAX_CONSECUTIVE_EMPTY:
            raise FrameSourceError(
                f"{self._name}: the driver reports a picture, but has none",
                source=self._name,
            )

    def _advance_sequence(self, sequence: int) -> int:
        """Record a frame's number; return its step, which is 1 for a driver that does not count."""
        last, self._sequence = self._sequence, sequence
        if last is None:
            self._unwrapped_sequence = sequence
            return 1
        step = (sequence - last) % (2 * HALF_SEQUENCE_RANGE)
        step = step if 0 < step < HALF_SEQUENCE_RANGE else 1
        self._unwrapped_sequence += step
        return step

    def _no_pictures_error(self, filled: FilledBuffer) -> FrameFormatError:
        content = (
            "an error of the device"
            if filled.flags & abi.BUF_ERROR
            else f"{filled.used_bytes} bytes"
        )
        return FrameFormatError(
            f"{self._name}: expected {self._format.name} {self._width}x{self._height}, "
            f"{self._min_bytes} bytes or more, got {content} {self._bad_count} times in a row",
            source=self._name,
        )
