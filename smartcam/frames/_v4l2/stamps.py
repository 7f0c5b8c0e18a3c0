"""Interpret a driver's time stamps: their moment of the frame, and whether they are plausible."""

from __future__ import annotations

import logging
from typing import Final, NamedTuple

from smartcam.frames._frame import Moment
from smartcam.frames._v4l2 import abi

_log = logging.getLogger("smartcam.frames")

DEFAULT_DURATION: Final = 1.0
"""Assumed duration of a frame, seconds, if driver and frames do not give it."""


class BufferStamp(NamedTuple):
    """The time of a frame, as in :class:`smartcam.frames.Frame`."""

    captured: float
    moment: Moment
    duration: float
    device_time: float | None


class BufferStamps:
    """The time stamps of one stream.

    A stamp of the monotonic clock is the start of the exposure or the end of the frame, depending
    on its flags. With the end stamped, the exposure began at most two periods before: one of
    exposure, one of readout. Other and implausible stamps are not used: such a frame began at most
    two periods before the queue of filled buffers was last empty.

    Args:
        name: name of the camera, for the log.
        period: period of a frame, seconds; None: unknown. If frames come slower, as in the dark,
            their measured period is used.
        began: when the device began to stream, seconds of ``time.monotonic()``.

    Source: V4L2 documentation, buffer flags (published); two periods: derived.
    """

    def __init__(self, name: str, period: float | None, began: float) -> None:
        self._name = name
        self._given_period = period
        self._began = self._empty = began
        # stamp and number of the frame before; at first, from before the stream
        self._last: tuple[float, int | None] = (began - 2 * (period or DEFAULT_DURATION), None)
        self.is_newest = False  # whether the last frame is so young that no later one can wait
        self._doubted = False

    def note_queue_empty(self, now: float) -> None:
        """Note that no filled buffer waits."""
        self._empty = now

    def read(self, seconds: float, flags: int, number: int, now: float) -> BufferStamp:
        """Return the time of a frame.

        Args:
            seconds: time stamp, seconds.
            flags: flags of the buffer.
            number: number of the frame, lost frames included.
            now: present time, seconds of ``time.monotonic()``.
        """
        self.is_newest = False
        kind = flags & abi.TIMESTAMP_MASK
        if kind != abi.TIMESTAMP_MONOTONIC:
            return self._arrived(now, seconds if kind == abi.TIMESTAMP_COPY else None)
        starts = flags & abi.TSTAMP_SRC_MASK == abi.TSTAMP_SRC_SOE
        period = self._given_period or DEFAULT_DURATION
        last, then = self._last
        if not last < seconds <= (now if starts else now + period):
            self._doubt(seconds, now)
            return self._arrived(now, seconds)
        self._last = (seconds, number)
        self.is_newest = now - seconds < (self._given_period or 0.0)
        if self.is_newest:
            self._empty = now
        if starts:
            return BufferStamp(seconds, Moment.EXPOSURE_START, 0.0, None)
        if then is not None:
            period = max(self._given_period or 0.0, (seconds - last) / max(1, number - then))
        # some drivers stamp with the expected end; a received frame has ended
        return BufferStamp(min(seconds, now), Moment.FRAME_END, 2 * period, None)

    def _arrived(self, now: float, device_time: float | None) -> BufferStamp:
        duration = now - self._empty + 2 * (self._given_period or DEFAULT_DURATION)
        return BufferStamp(now, Moment.ARRIVAL, duration, device_time)

    def _doubt(self, seconds: float, now: float) -> None:
        if not self._doubted:
            _log.warning(
                "%s: a time stamp is %+.3f s from now, which is not plausible; using the arrival",
                self._name,
                seconds - now,
            )
        self._doubted = True
