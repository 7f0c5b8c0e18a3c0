"""Request, map, queue and release the buffers into which a driver writes pictures."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam.exceptions import FrameSourceError
from smartcam.frames._v4l2 import abi, system

if TYPE_CHECKING:
    import mmap

    from smartcam.frames._v4l2.device import CaptureDevice

MIN_BUFFERS: Final = 2
"""Least number of buffers: one is written while another is read."""


_unpack: Final = abi.FULL_BUFFER.unpack_from


class FilledBuffer(NamedTuple):
    """The contents of a filled buffer.

    Attributes:
        data: copy of the bytes; empty for a buffer with an error.
        used: number of bytes that the driver reports as written.
        flags: flags of V4L2.
        seconds: seconds of its time stamp.
        sequence: the driver's number of the frame.
    """

    data: bytes
    used: int
    flags: int
    seconds: float
    sequence: int


class Buffers:
    """The buffers of a streaming device; making them starts the stream.

    Args:
        device: device with its format set.
        count: requested number of buffers; the driver may give more or fewer.

    Raises:
        FrameSourceError: the device is in use, or has no memory; nothing streams.
    """

    def __init__(self, device: CaptureDevice, count: int) -> None:
        self._device = device
        self._pages: list[mmap.mmap] = []
        self._argument = abi.new_buffer(0)  # reused by all calls
        try:
            given = device.ask(
                abi.REQBUFS, count, abi.CAPTURE, abi.MEMORY_MMAP, tried="asking for buffers"
            )[0]
            if given < MIN_BUFFERS:
                raise FrameSourceError(
                    f"{device.path}: expected {MIN_BUFFERS} buffers or more, got {given}",
                    source=device.path,
                )
            for index in range(given):
                self._prepare(index)
            device.ask(abi.STREAMON, abi.CAPTURE, tried="starting the stream")
        except BaseException:
            self.release()
            raise

    def __len__(self) -> int:
        return len(self._pages)

    def take(self) -> FilledBuffer:
        """Return the oldest picture, and give its buffer back to the driver.

        Raises:
            BlockingIOError: there is no picture.
            OSError: the device is gone, or its driver gave up.
        """
        argument, number, ioctl = self._argument, self._device.number, system.ioctl
        ioctl(number, abi.DQBUF, argument)
        place, used, flags, seconds, microseconds, sequence = _unpack(argument)
        data = b"" if flags & abi.BUF_ERROR else self._pages[place][:used]
        ioctl(number, abi.QBUF, argument)
        return FilledBuffer(data, used, flags, seconds + microseconds / 1e6, sequence)

    def release(self) -> None:
        """Stop the stream and release the buffers, so that other programs can use the device."""
        with suppress(FrameSourceError):  # the device may be gone
            self._device.ask(abi.STREAMOFF, abi.CAPTURE)
        while self._pages:
            self._pages.pop().close()
        with suppress(FrameSourceError):
            self._device.ask(abi.REQBUFS, 0, abi.CAPTURE, abi.MEMORY_MMAP)

    def _prepare(self, index: int) -> None:
        """Map and queue a buffer."""
        device = self._device
        argument = abi.new_buffer(index)
        try:
            system.ioctl(device.number, abi.QUERYBUF, argument)
            offset, length = abi.offset_and_length(argument)
            self._pages.append(system.pages(device.number, length, offset))
            system.ioctl(device.number, abi.QBUF, argument)
        except (OSError, ValueError) as exc:
            raise FrameSourceError(
                f"{device.path}: buffer {index}: {exc}", source=device.path
            ) from exc
