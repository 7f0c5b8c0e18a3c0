"""Limit the time from a frame's first byte to its last.

A frame with a wrong length swallows the bytes of the next messages, so that no message is received
any more. The age is checked only when bytes arrive: a peer that stops sending is detected by the
liveness check.
"""

from __future__ import annotations

FRAME_TIME = 5.0
"""Seconds that a frame on TCP may take, in addition to the transfer time of its bytes. A camera
writes a frame at once; TCP replaces lost segments within one or two seconds."""

MIN_BYTES_PER_SECOND = 1 << 16
"""Rate of the slowest line that is allowed for: half a megabit. Then the 64 kB that a camera sends
at most may take 6 s; the 1 MiB that is accepted by default, 21 s."""

HINT_TIME = 1.0
"""Seconds after which another header inside an unfinished frame shows that the frame's length is
wrong. Before, a frame may contain any bytes."""


class UnfinishedFrame:
    """The age of the frame that is being received.

    The longest pause between two arrivals is not counted: perhaps this side did not read.

    Attributes:
        searched: number of the frame's bytes that were searched for another header.
    """

    __slots__ = ("_frame", "_pause", "_received_at", "searched")

    def __init__(self) -> None:
        self._frame = -1
        self._received_at = self._pause = 0.0
        self.searched: int = 0

    def age(self, frame: int, since: float, now: float) -> float:
        """Return the seconds since a frame's first bytes arrived; call it whenever bytes arrive.

        ``frame``: number of the frame. ``since``, ``now``: arrival of its first and last bytes.
        """
        if frame != self._frame:
            self._frame, self._received_at, self._pause, self.searched = frame, since, 0.0, 0
        self._pause = max(self._pause, now - self._received_at)
        self._received_at = now
        return now - since - self._pause
