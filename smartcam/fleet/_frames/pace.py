"""Choose the next frame of a stream, so that no frame waits for a busy network link.

A frame that the camera gives while the link is busy would have to wait, up to one frame period. So
this frame is skipped, and the following frame is sent as soon as the camera gives it. This lowers
the frame rate, but each frame is delayed only by its own transfer.
"""

from __future__ import annotations

import math

MAX_WAIT_SHARE = 0.04
"""Largest wait of a frame before it is sent, as a fraction of its transfer time."""

MIN_ALLOWED_WAIT = 0.002
"""Wait of a frame before it is sent that is always allowed, seconds."""

MAX_WAIT_PERIODS = 1.25
"""Number of periods to wait for the next frame; after that, the newest one is sent."""


class FramePace:
    """Chooses the frames of one stream. All times are from one clock."""

    def __init__(self) -> None:
        self._sent_at: float | None = None
        self._transit_times = (0.0, 0.0)  # transfer times of the last two frames, seconds
        self._last_taken: tuple[float, int] | None = None
        self._period = 0.0  # period of the source; 0: unknown
        self._next_due_at = -math.inf
        self._min_interval = 0.0

    def choose_window(
        self, now: float, arrived_at: float, min_interval: float = 0.0
    ) -> tuple[float, float]:
        """Return the earliest arrival time of the next frame to send, and the end of the wait.

        If no such frame arrives until the end of the wait, an older one is sent.

        Args:
            now: time of the request for the next frame; the program has then got the last one.
            arrived_at: time at which the newest frame arrived from the camera.
            min_interval: least number of seconds from one frame to the next.
        """
        if self._sent_at is not None:
            self._transit_times = (self._transit_times[1], now - self._sent_at)
            self._sent_at = None
        self._min_interval = min_interval
        transit = min(self._transit_times)
        oldest_arrival, wait_until = now - max(MIN_ALLOWED_WAIT, MAX_WAIT_SHARE * transit), now
        if 0 < self._period <= transit:  # the link is busy for a period or more
            wait_until = arrived_at + MAX_WAIT_PERIODS * self._period
        if min_interval and now < self._next_due_at:
            oldest_arrival = max(oldest_arrival, self._next_due_at - self._period / 2)
            wait_until = max(wait_until, self._next_due_at + MAX_WAIT_PERIODS * self._period)
        return oldest_arrival, wait_until

    def note_taken(self, arrived_at: float, offered: int) -> None:
        """Note which frame was taken.

        Args:
            arrived_at: time at which the frame arrived from the camera.
            offered: number of frames that the source had given at that time.
        """
        if self._last_taken is not None and offered > self._last_taken[1]:
            self._period = (arrived_at - self._last_taken[0]) / (offered - self._last_taken[1])
        self._last_taken = arrived_at, offered
        self._next_due_at = (
            max(self._next_due_at, arrived_at - self._min_interval) + self._min_interval
        )

    def note_sent(self, now: float) -> None:
        """Note that the frame is sent now."""
        self._sent_at = now
