"""Interpret a driver's time stamps: which moment a stamp means, and whether it is plausible."""

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
    on its flags. If the stamp is the end, the exposure began at most two frame periods earlier: one
    of exposure and one of readout. Stamps of other clocks and implausible stamps are not used. A
    frame with such a stamp began at most two periods before the queue of filled buffers was last
    empty.

    Args:
        name: name of the camera, for the log.
        period: period of a frame, seconds; None: unknown. If frames come slower, as in the dark,
            their measured period is used.
        started_at: when the device began to stream, seconds of ``time.monotonic()``.

    Source: V4L2 documentation, buffer flags (published); two periods: derived.
    """

    def __init__(self, name: str, period: float | None, started_at: float) -> None:
        self._name = name
        self._nominal_period = period
        self._last_empty_at = started_at  # when the queue of filled buffers was last empty
        # time stamp and number of the last frame; before the first frame, a time before the stream
        self._last: tuple[float, int | None] = (started_at - 2 * (period or DEFAULT_DURATION), None)
        self.is_newest = False  # whether the last frame is so new that no newer one waits
        self._has_warned = False

    def record_empty_queue(self, now: float) -> None:
        """Record that no filled buffer waits now."""
        self._last_empty_at = now

    def frame_stamp(self, seconds: float, flags: int, number: int, now: float) -> BufferStamp:
        """Return the time of a frame.

        Args:
            seconds: time stamp, seconds.
            flags: flags of the buffer.
            number: number of the frame, lost frames included.
            now: present time, seconds of ``time.monotonic()``.
        """
        self.is_newest = False
        clock = flags & abi.TIMESTAMP_MASK
        if clock != abi.TIMESTAMP_MONOTONIC:
            return self._arrival_stamp(now, seconds if clock == abi.TIMESTAMP_COPY else None)
        is_start = flags & abi.TSTAMP_SRC_MASK == abi.TSTAMP_SRC_SOE
        period = self._nominal_period or DEFAULT_DURATION
        last, last_number = self._last
        if not last < seconds <= (now if is_start else now + period):
            self._warn_implausible(seconds, now)
            return self._arrival_stamp(now, seconds)
        self._last = (seconds, number)
        self.is_newest = now - seconds < (self._nominal_period or 0.0)
        if self.is_newest:
            self._last_empty_at = now
        if is_start:
            return BufferStamp(seconds, Moment.EXPOSURE_START, 0.0, None)
        if last_number is not None:
            measured = (seconds - last) / max(1, number - last_number)
            period = max(self._nominal_period or 0.0, measured)
        # some drivers stamp with the expected end; a received frame has ended
        return BufferStamp(min(seconds, now), Moment.FRAME_END, 2 * period, None)

    def _arrival_stamp(self, now: float, device_time: float | None) -> BufferStamp:
        duration = now - self._last_empty_at + 2 * (self._nominal_period or DEFAULT_DURATION)
        return BufferStamp(now, Moment.ARRIVAL, duration, device_time)

    def _warn_implausible(self, seconds: float, now: float) -> None:
        if not self._has_warned:
            _log.warning(
                "%s: a time stamp is %+.3f s from now, which is not plausible; using the arrival",
                self._name,
                seconds - now,
            )
        self._has_warned = True
