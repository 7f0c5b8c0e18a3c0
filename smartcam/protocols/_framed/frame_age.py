"""Bound the time that a frame may take to be received.

A wrong length swallows the bytes that follow, and no other message is received meanwhile. A peer
that breaks off sends nothing more, which the liveness check finds. So it is enough to check the age
whenever bytes come.
"""

from __future__ import annotations

FRAME_TIME = 5.0
"""Seconds that a frame of a stream may take, plus the time for its length. A camera writes it at
once; TCP replaces lost segments within one or two seconds."""

FRAME_RATE = 1 << 16
"""Bytes a second of the slowest line: half a megabit. The 64 kB that a camera sends at most may
take 6 s, the 1 MiB that is accepted by default 21 s."""

HINT_TIME = 1.0
"""Seconds after which another header inside an unfinished frame shows that the frame's length is
wrong. A frame that comes without delay may hold any bytes."""


class Unfinished:
    """The age of the frame that is being received.

    The longest pause in it does not count, since perhaps this side did not read.

    Attributes:
        searched: number of its bytes that were searched for another header.
    """

    __slots__ = ("_frame", "_pause", "_received_at", "searched")

    def __init__(self) -> None:
        self._frame = -1
        self._received_at = self._pause = 0.0
        self.searched: int = 0

    def age(self, frame: int, since: float, now: float) -> float:
        """Return the seconds since a frame's first bytes came; call it whenever bytes come.

        ``frame``: number of the frame. Its first bytes came at ``since``, the last at ``now``.
        """
        if frame != self._frame:
            self._frame, self._received_at, self._pause, self.searched = frame, since, 0.0, 0
        self._pause = max(self._pause, now - self._received_at)
        self._received_at = now
        return now - since - self._pause
