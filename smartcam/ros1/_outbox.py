"""A bounded queue of operations and messages for a rosbridge, which drops the oldest messages."""

from __future__ import annotations

import asyncio
import collections
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from smartcam.ros1._json_messages import Part

MAX_WAITING_OPERATIONS = 256
"""Number of waiting operations at which reading from the bridge pauses."""
MAX_WAITING_BYTES = 32 << 20
"""Largest number of bytes that the waiting messages of one topic may have together; one message may
have more."""


class Lane:
    """The waiting messages of one topic.

    Attributes:
        dropped: messages that were not sent: no bridge, or newer ones came.
        sent: messages that were passed to the WebSocket.
        waiting_bytes: bytes of the messages that wait.
    """

    def __init__(self, depth: int, *, latched: bool) -> None:
        self.latched = latched
        self.dropped: int = 0
        self.sent: int = 0
        self._depth = depth
        self._waiting: collections.deque[tuple[Part, ...]] = collections.deque()
        self.waiting_bytes: int = 0
        # last message of a latched topic, for the next bridge
        self._last: tuple[Part, ...] | None = None

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, parts: tuple[Part, ...], *, connected: bool) -> None:
        """Queue a message; without a bridge keep only a latched topic's last one."""
        if self.latched:
            self._last = parts
        elif not connected:
            self.dropped += 1
        if not connected:
            return
        self._waiting.append(parts)
        self.waiting_bytes += sum(map(len, parts))
        while len(self._waiting) > self._depth or (
            self.waiting_bytes > MAX_WAITING_BYTES and len(self._waiting) > 1
        ):
            self.take()
            self.dropped += 1

    def take(self) -> tuple[Part, ...]:
        """Remove and return the oldest message."""
        parts = self._waiting.popleft()
        self.waiting_bytes -= sum(map(len, parts))
        return parts

    def clear(self) -> None:
        """Drop waiting messages, since the bridge is lost."""
        self.dropped += 0 if self.latched else len(self._waiting)
        self._waiting.clear()
        self.waiting_bytes = 0

    def repeat(self) -> None:
        """Queue a latched topic's last message for a new bridge."""
        if self._last is not None and not self._waiting:
            self.put(self._last, connected=True)


class Outbox:
    """Returns operations first, in order, then messages of the topics in turn."""

    def __init__(self) -> None:
        self._operations: collections.deque[tuple[Part, ...]] = collections.deque()
        self._lanes: collections.deque[Lane] = collections.deque()
        self._ready = asyncio.Event()
        self._room = asyncio.Event()
        self._room.set()
        self._flushed = asyncio.Event()

    def add_operation(self, parts: tuple[Part, ...]) -> None:
        """Queue an operation."""
        self._operations.append(parts)
        self.wake()
        if len(self._operations) >= MAX_WAITING_OPERATIONS:
            self._room.clear()

    def add(self, lane: Lane) -> None:
        """Include the messages of a lane."""
        self._lanes.append(lane)

    def remove(self, lane: Lane) -> None:
        """Exclude the messages of a lane."""
        self._lanes.remove(lane)

    def wake(self) -> None:
        """Wake the sender, since a message waits."""
        self._ready.set()
        self._flushed.clear()

    def clear(self) -> None:
        """Drop all waiting operations and messages."""
        self._operations.clear()
        for lane in self._lanes:
            lane.clear()
        self._ready.clear()
        self._room.set()

    @property
    def full(self) -> bool:
        """True if more operations wait than the bound."""
        return not self._room.is_set()

    async def room(self) -> None:
        """Wait while more operations wait than the bound."""
        await self._room.wait()

    async def flushed(self) -> None:
        """Wait until the sender has taken everything, and has sent it."""
        await self._flushed.wait()

    async def take(self) -> tuple[Part, ...]:
        """Return the next operation or message, and wait until there is one."""
        while True:
            if self._operations:
                self._room.set()
                return self._operations.popleft()
            for _ in range(len(self._lanes)):
                lane = self._lanes[0]
                self._lanes.rotate(-1)
                if lane:
                    lane.sent += 1
                    return lane.take()
            self._ready.clear()
            self._flushed.set()
            await self._ready.wait()
