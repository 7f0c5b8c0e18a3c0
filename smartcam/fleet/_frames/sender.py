"""Send an agent's frames in parts, and bound the bytes that are on the way to each program.

A program confirms received bytes. Its *window* is the largest number of sent bytes that it has not
confirmed yet; at this number, sending waits. So a program that is slow, stopped or dead fills only
its own queue, delays no other program, and skips frames that it does not take in time. There is no
task for this: each received confirmation sends the next part.
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
"""Bytes of a part. The loop takes less than 0.1 ms to pass a part to Zenoh."""

WINDOW_BYTES = 3 * PART_BYTES
"""Largest number of unconfirmed bytes of one program. Zenoh's queue has room for 16 packets of
64 kB, and drops further ones; two programs that are connected through one router share that
queue."""

MAX_UNCOUNTED_BYTES = 1 << 16
"""Largest number of bytes of a frame that is sent as one packet. Such a frame is neither confirmed
nor counted in the window."""

MAX_WAITING_BYTES = 1 << 26
"""Largest number of bytes of frames that may wait for one program. If there are more, the oldest
frame of which no part was sent is dropped."""

CONFIRMATION_TIMEOUT = 10.0
"""Seconds without a confirmation after which a frame is dropped."""


@dataclass(eq=False)
class _Transfer:
    """A frame that is being sent."""

    call: int
    data: memoryview
    confirmed_at: float
    sent_bytes: int = 0
    confirmed_bytes: int = 0

    @property
    def unconfirmed_bytes(self) -> int:
        return self.sent_bytes - self.confirmed_bytes


@dataclass(eq=False)
class _Window:
    """All frames that are being sent to one program, oldest first."""

    transfers: collections.OrderedDict[int, _Transfer] = field(
        default_factory=collections.OrderedDict[int, _Transfer]
    )

    @property
    def unconfirmed_bytes(self) -> int:
        return sum(transfer.unconfirmed_bytes for transfer in self.transfers.values())

    @property
    def waiting_bytes(self) -> int:
        return sum(len(transfer.data) for transfer in self.transfers.values())


class FrameSender:
    """Sends frames to programs.

    Args:
        bus: the agent's connection to the bus.
        keys: keys of the fleet.
    """

    def __init__(self, bus: Bus, keys: Keys) -> None:
        self._bus, self._keys = bus, keys
        self._windows: dict[str, _Window] = {}

    @property
    def clock_lead(self) -> float:
        """Seconds by which the loop's clock is ahead of ``time.monotonic()``, the clock of frames.

        0 if all programs are in this process: the times of frames then need no conversion.
        """
        if self._bus.local:
            return 0.0
        return asyncio.get_running_loop().time() - time.monotonic()

    def send(self, program: str, call: int, data: Data) -> None:
        """Send a frame's bytes as the answer to a call: now as many as the window allows."""
        total = len(data)
        if self._bus.local or total <= MAX_UNCOUNTED_BYTES:
            self._send_part(program, FramePart(call, 0, total), data)
            return
        window = self._windows.setdefault(program, _Window())
        now = asyncio.get_running_loop().time()
        for transfer in [*window.transfers.values()]:
            # a frame that was sent in part stays, unless its confirmation is overdue
            is_dropped = (
                window.waiting_bytes + total > MAX_WAITING_BYTES and not transfer.unconfirmed_bytes
            )
            if is_dropped or now - transfer.confirmed_at > CONFIRMATION_TIMEOUT:
                del window.transfers[transfer.call]
        window.transfers[call] = _Transfer(call, memoryview(data), now)
        self._send_parts(program, window)

    def confirm(self, program: str, call: int, offset: int | None) -> None:
        """Note how many bytes of a frame the program has; None: it wants no more of them."""
        window = self._windows.get(program)
        transfer = None if window is None else window.transfers.get(call)
        if window is None or transfer is None:
            return
        transfer.confirmed_at = asyncio.get_running_loop().time()
        transfer.confirmed_bytes = max(
            transfer.confirmed_bytes, min(offset or 0, transfer.sent_bytes)
        )
        if offset is None or transfer.confirmed_bytes == len(transfer.data):
            del window.transfers[call]
        if window.transfers:
            self._send_parts(program, window)
        else:
            del self._windows[program]

    def forget_program(self, program: str) -> None:
        """Drop the frames of a program that has left the bus."""
        self._windows.pop(program, None)

    def close(self) -> None:
        """Stop sending."""
        self._windows.clear()

    def _send_parts(self, program: str, window: _Window) -> None:
        """Send parts while the window allows it; those of the oldest frame first."""
        room = WINDOW_BYTES - window.unconfirmed_bytes
        for transfer in window.transfers.values():
            while transfer.sent_bytes < len(transfer.data):
                part = transfer.data[transfer.sent_bytes : transfer.sent_bytes + PART_BYTES]
                if len(part) > room:
                    return
                room -= len(part)
                self._send_part(
                    program, FramePart(transfer.call, transfer.sent_bytes, len(transfer.data)), part
                )
                transfer.sent_bytes += len(part)

    def _send_part(self, program: str, part: FramePart, data: Data) -> None:
        self._bus.put_part(self._keys.frames(program), encode_part(part), data)
