"""Send an agent's frames, never more bytes at a time than a program's window allows.

Each program has a window of sent bytes that it has not confirmed. It confirms received bytes, and
then gets more. So a program that is slow, stopped or dead fills only its own queue, delays no other
program, and skips frames that it does not take in time. There is no task for it: each confirmation
sends the next part.
"""

from __future__ import annotations

import asyncio
import collections
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from smartcam.fleet._frames.wire import FramePart, encode_part

if TYPE_CHECKING:
    from smartcam.fleet._bus.bus import Bus, Data
    from smartcam.fleet._bus.keys import Keys

PART_BYTES = 1 << 17
"""Bytes of a part: the loop takes less than 0.1 ms to pass them to the engine."""

WINDOW_BYTES = 3 * PART_BYTES
"""Unconfirmed bytes of one program. The engine's queue has room for 16 packets of 64 kB, and drops
further ones; two programs that are connected through one router share that queue."""

MAX_UNCOUNTED_BYTES = 1 << 16
"""Largest number of bytes of a frame that is one packet, and not counted, since it is not
confirmed."""

MAX_WAITING_BYTES = 1 << 26
"""Largest number of bytes of frames that may wait for one program; beyond it the oldest frame that
was not begun is dropped."""

STALE_AFTER = 10.0
"""Seconds without a confirmation after which a frame is dropped."""


@dataclass(eq=False)
class _Transfer:
    """A frame that is being sent."""

    call: int
    data: memoryview
    moved_at: float
    sent: int = 0
    come: int = 0

    @property
    def under_way(self) -> int:
        return self.sent - self.come


@dataclass(eq=False)
class _Window:
    """All frames that are being sent to one program, oldest first."""

    transfers: collections.OrderedDict[int, _Transfer] = field(
        default_factory=collections.OrderedDict[int, _Transfer]
    )

    @property
    def under_way(self) -> int:
        return sum(transfer.under_way for transfer in self.transfers.values())

    @property
    def waiting(self) -> int:
        return sum(len(transfer.data) for transfer in self.transfers.values())


class FrameSender:
    """Sends frames to programs.

    Args:
        bus: the agent's end of the bus.
        keys: keys of the fleet.
    """

    def __init__(self, bus: Bus, keys: Keys) -> None:
        self._bus, self._keys = bus, keys
        self._windows: dict[str, _Window] = {}

    @property
    def ahead(self) -> float:
        """Lead of the agent's clock over the clock of frames, seconds.

        If all ends are in one process, frames keep their time.
        """
        if self._bus.local:
            return 0.0
        return asyncio.get_running_loop().time() - time.monotonic()

    def send(self, program: str, call: int, data: Data) -> None:
        """Send a frame's bytes as the answer to a call, as far as there is room now."""
        total = len(data)
        if self._bus.local or total <= MAX_UNCOUNTED_BYTES:
            self._put(program, FramePart(call, 0, total), data)
            return
        window = self._windows.setdefault(program, _Window())
        now = asyncio.get_running_loop().time()
        for transfer in [*window.transfers.values()]:
            # a frame that was begun stays, unless it is old
            full = window.waiting + total > MAX_WAITING_BYTES and not transfer.under_way
            if full or now - transfer.moved_at > STALE_AFTER:
                del window.transfers[transfer.call]
        window.transfers[call] = _Transfer(call, memoryview(data), now)
        self._push(program, window)

    def come(self, program: str, call: int, offset: int | None) -> None:
        """Note the confirmed bytes of a frame; None: all, or no more are wanted."""
        window = self._windows.get(program)
        transfer = None if window is None else window.transfers.get(call)
        if window is None or transfer is None:
            return
        transfer.moved_at = asyncio.get_running_loop().time()
        transfer.come = max(transfer.come, min(offset or 0, transfer.sent))
        if offset is None or transfer.come == len(transfer.data):
            del window.transfers[call]
        if window.transfers:
            self._push(program, window)
        else:
            del self._windows[program]

    def forget(self, program: str) -> None:
        """Drop the frames of a lost program."""
        self._windows.pop(program, None)

    def close(self) -> None:
        """Stop sending."""
        self._windows.clear()

    def _push(self, program: str, window: _Window) -> None:
        """Send parts while there is room, the oldest frame's first."""
        room = WINDOW_BYTES - window.under_way
        for transfer in window.transfers.values():
            while transfer.sent < len(transfer.data):
                part = transfer.data[transfer.sent : transfer.sent + PART_BYTES]
                if len(part) > room:
                    return
                room -= len(part)
                self._put(
                    program, FramePart(transfer.call, transfer.sent, len(transfer.data)), part
                )
                transfer.sent += len(part)

    def _put(self, program: str, part: FramePart, data: Data) -> None:
        self._bus.put_part(self._keys.frames(program), encode_part(part), data)
