"""Bound the time that a frame may take to become whole.

A length that is wrong makes a frame of what comes behind it, and nothing else is heard meanwhile.
A peer that breaks off sends nothing more, which liveness finds. So it is enough to look whenever
bytes come.
"""

from __future__ import annotations

FRAME_TIME = 5.0
"""Seconds that a frame of a stream may take to become whole, beside those of its length. A camera
writes it at once; TCP makes good for lost segments within one or two."""

FRAME_RATE = 1 << 16
"""Bytes a second of the slowest line: half a megabit. The 64 kB that a camera sends at most may
take 6 s, the 1 MiB that is accepted by default 21 s."""

HINT_TIME = 1.0
"""Seconds from which on a header inside an unfinished frame says that its length is wrong. A frame
that comes without delay may hold any bytes."""


class Unfinished:
    """The age of the frame that is being received.

    The longest pause in it does not count: it may have been this side that did not read.

    Attributes:
        searched: bytes of it in which no other header begins.
    """

    __slots__ = ("_frame", "_heard", "_pause", "searched")

    def __init__(self) -> None:
        self._frame = -1
        self._heard = self._pause = 0.0
        self.searched: int = 0

    def age(self, frame: int, since: float, now: float) -> float:
        """Return for how many seconds bytes of a frame have come; to be asked each time some come.

        ``frame``: its number. The first came at ``since``, the last ``now``.
        """
        if frame != self._frame:
            self._frame, self._heard, self._pause, self.searched = frame, since, 0.0, 0
        self._pause = max(self._pause, now - self._heard)
        self._heard = now
        return now - since - self._pause
