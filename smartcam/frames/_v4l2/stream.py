"""Stream from a device: turn full buffers into frames, and count broken ones."""

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

MAX_BAD_IN_A_ROW: Final = 30
"""Number of buffers in a row without a picture, after which the stream fails."""

MAX_EMPTY_IN_A_ROW: Final = 1000
"""Number of times that the system may report a filled buffer without having one."""

HALF_OF_NUMBERS: Final = 1 << 31
"""Half of the range of 32-bit frame numbers: a larger step forwards is a step backwards."""


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
        self._bad = self._empty = 0

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
                full = self._buffers.take()
            except BlockingIOError:
                self._stamps.note_queue_empty(system.now())
                self._none_was_there()
                return
            except OSError as exc:
                raise device_error(self._name, "taking a picture", exc) from exc
            self._empty = 0
            frame = self._frame(full, sink)
            if frame is not None:
                sink.frame(frame)
                if self._stamps.is_newest:
                    return

    def _frame(self, full: FilledBuffer, sink: FrameSink) -> Frame | None:
        """Return the frame in a buffer; count a buffer without a whole picture as lost."""
        steps = self._steps(full.sequence)
        if len(full.data) < self._min_bytes:
            sink.lost(steps)
            self._bad += 1
            if self._bad >= MAX_BAD_IN_A_ROW:
                raise self._no_pictures_error(full)
            return None
        self._bad = 0
        now, utc = system.now(), time.time()
        stamp = self._stamps.read(full.seconds, full.flags, self._unwrapped_sequence, now)
        return Frame(
            data=full.data,
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
            lost=steps - 1,
            source=self._name,
        )

    def _none_was_there(self) -> None:
        self._empty += 1
        if self._empty > MAX_EMPTY_IN_A_ROW:
            raise FrameSourceError(
                f"{self._name}: the driver reports a picture, but has none",
                source=self._name,
            )

    def _steps(self, sequence: int) -> int:
        """Return the step of the frame number; 1 for a driver that does not count."""
        last, self._sequence = self._sequence, sequence
        if last is None:
            self._unwrapped_sequence = sequence
            return 1
        steps = (sequence - last) % (2 * HALF_OF_NUMBERS)
        steps = steps if 0 < steps < HALF_OF_NUMBERS else 1
        self._unwrapped_sequence += steps
        return steps

    def _no_pictures_error(self, full: FilledBuffer) -> FrameFormatError:
        content = "an error of the device" if full.flags & abi.BUF_ERROR else f"{full.used} bytes"
        return FrameFormatError(
            f"{self._name}: expected {self._format.name} {self._width}x{self._height}, "
            f"{self._min_bytes} bytes or more, got {content} {self._bad} times in a row",
            source=self._name,
        )
