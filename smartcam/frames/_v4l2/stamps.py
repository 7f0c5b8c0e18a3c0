"""Judge a driver's time stamps: the moment that they mean, and whether they can be believed."""

from __future__ import annotations

import logging
from typing import Final, NamedTuple

from smartcam.frames._frame import Moment
from smartcam.frames._v4l2 import abi

_log = logging.getLogger("smartcam.frames")

UNKNOWN_DURATION: Final = 1.0
"""Seconds that a frame is taken to last where neither driver nor frames tell."""


class BufferStamp(NamedTuple):
    """The time at which a frame was taken, as in :class:`smartcam.frames.Frame`."""

    captured: float
    moment: Moment
    duration: float
    device_time: float | None


class BufferStamps:
    """The time stamps of one stream.

    A stamp of the monotonic clock is the start of the exposure or the end of the frame, as its
    flags say. A frame whose end is stamped began to be exposed at most two periods before: one of
    exposure, and one in which the rows are read. Any other stamp, and one that cannot be right, is
    not used: such a frame was taken after the queue of full buffers was last seen empty, less
    those two periods.

    Args:
        name: name of the camera, for the log.
        period: period of a frame, seconds; None: unknown. Where frames come slower, as in the dark,
            what is seen of them counts.
        began: when the device began to stream, seconds of ``time.monotonic()``.

    Source: V4L2 documentation, buffer flags (published); two periods: derived.
    """

    def __init__(self, name: str, period: float | None, began: float) -> None:
        self._name = name
        self._told = period
        self._began = self._empty = began
        # stamp and number of the frame before; none is from long before the stream began
        self._last: tuple[float, int | None] = (began - 2 * (period or UNKNOWN_DURATION), None)
        self.is_newest = False  # the last one that was read: no later one can be there yet
        self._doubted = False

    def queue_is_empty(self, now: float) -> None:
        """Note that all frames so far were taken out."""
        self._empty = now

    def read(self, seconds: float, flags: int, number: int, now: float) -> BufferStamp:
        """Return when the frame with that number was taken.

        Args:
            seconds: seconds of its stamp.
            flags: flags of its buffer.
            number: number of the frame, counted on over lost ones.
            now: seconds of ``time.monotonic()``.
        """
        self.is_newest = False
        kind = flags & abi.TIMESTAMP_MASK
        if kind != abi.TIMESTAMP_MONOTONIC:
            return self._arrived(now, seconds if kind == abi.TIMESTAMP_COPY else None)
        starts = flags & abi.TSTAMP_SRC_MASK == abi.TSTAMP_SRC_SOE
        period = self._told or UNKNOWN_DURATION
        last, then = self._last
        if not last < seconds <= (now if starts else now + period):
            self._doubt(seconds, now)
            return self._arrived(now, seconds)
        self._last = (seconds, number)
        self.is_newest = now - seconds < (self._told or 0.0)
        if self.is_newest:
            self._empty = now
        if starts:
            return BufferStamp(seconds, Moment.EXPOSURE_START, 0.0, None)
        if then is not None:
            period = max(self._told or 0.0, (seconds - last) / max(1, number - then))
        # some drivers stamp with the end that they expect; a frame that is here has ended
        return BufferStamp(min(seconds, now), Moment.FRAME_END, 2 * period, None)

    def _arrived(self, now: float, device_time: float | None) -> BufferStamp:
        duration = now - self._empty + 2 * (self._told or UNKNOWN_DURATION)
        return BufferStamp(now, Moment.ARRIVAL, duration, device_time)

    def _doubt(self, seconds: float, now: float) -> None:
        if not self._doubted:
            _log.warning(
                "%s: a time stamp is %+.3f s from now, which cannot be; arrival is taken instead",
                self._name,
                seconds - now,
            )
        self._doubted = True
