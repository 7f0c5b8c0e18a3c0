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
        used_bytes: number of bytes that the driver reports as written.
        flags: flags of V4L2.
        stamp: time stamp, seconds.
        sequence: the driver's number of the frame.
    """

    data: bytes
    used_bytes: int
    flags: int
    stamp: float
    sequence: int


class Buffers:
    """The buffers of a device, whose stream starts when this object is made.

    Args:
        device: device with its format set.
        count: requested number of buffers; the driver may give more or fewer.

    Raises:
        FrameSourceError: the device is in use, or has no memory; nothing streams.
    """

    def __init__(self, device: CaptureDevice, count: int) -> None:
        self._device = device
        self._maps: list[mmap.mmap] = []
        self._argument = abi.new_buffer(0)  # reused by all calls
        try:
            actual_count = device.checked_ioctl(
                abi.REQBUFS, count, abi.CAPTURE, abi.MEMORY_MMAP, action="asking for buffers"
            )[0]
            if actual_count < MIN_BUFFERS:
                raise FrameSourceError(
                    f"{device.path}: expected {MIN_BUFFERS} buffers or more, got {actual_count}",
                    source=device.path,
                )
            for index in range(actual_count):
                self._map_and_queue(index)
            device.checked_ioctl(abi.STREAMON, abi.CAPTURE, action="starting the stream")
        except BaseException:
            self.release()
            raise

    def __len__(self) -> int:
        return len(self._maps)

    def take_picture(self) -> FilledBuffer:
        """Return a copy of the oldest picture, and give its buffer back to the driver.

        Raises:
            BlockingIOError: there is no picture.
            OSError: the device is gone, or its driver gave up.
        """
        argument, descriptor, ioctl = self._argument, self._device.descriptor, system.ioctl
        ioctl(descriptor, abi.DQBUF, argument)
        index, used_bytes, flags, seconds, microseconds, sequence = _unpack(argument)
        data = b"" if flags & abi.BUF_ERROR else self._maps[index][:used_bytes]
        ioctl(descriptor, abi.QBUF, argument)
        return FilledBuffer(data, used_bytes, flags, seconds + microseconds / 1e6, sequence)

    def release(self) -> None:
        """Stop the stream and release the buffers, so that other programs can use the device."""
        with suppress(FrameSourceError):  # the device may be gone
            self._device.checked_ioctl(abi.STREAMOFF, abi.CAPTURE)
        while self._maps:
            self._maps.pop().close()
        with suppress(FrameSourceError):
            self._device.checked_ioctl(abi.REQBUFS, 0, abi.CAPTURE, abi.MEMORY_MMAP)

    def _map_and_queue(self, index: int) -> None:
        """Map and queue a buffer."""
        device = self._device
        argument = abi.new_buffer(index)
        try:
            system.ioctl(device.descriptor, abi.QUERYBUF, argument)
            offset, length = abi.offset_and_length(argument)
            self._maps.append(system.pages(device.descriptor, length, offset))
            system.ioctl(device.descriptor, abi.QBUF, argument)
        except (OSError, ValueError) as exc:
            raise FrameSourceError(
                f"{device.path}: buffer {index}: {exc}", source=device.path
            ) from exc
