"""A bounded queue of operations and messages for a rosbridge, which drops the oldest messages."""

from __future__ import annotations

import asyncio
import collections
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from smartcam.ros1._json_messages import TextPart

MAX_WAITING_OPERATIONS = 256
"""Number of operations waiting to be sent at which nothing more is read from the bridge."""
MAX_WAITING_BYTES = 32 << 20
"""Largest number of bytes of all waiting messages of one topic; a single message may have more."""


class TopicQueue:
    """The waiting messages of one topic.

    Attributes:
        dropped: number of messages that were not sent: no bridge, or newer messages came.
        sent: number of messages that were passed to the WebSocket.
        waiting_bytes: number of bytes of the waiting messages.
    """

    def __init__(self, depth: int, *, latched: bool) -> None:
        self.latched = latched
        self.dropped: int = 0
        self.sent: int = 0
        self._depth = depth
        self._waiting: collections.deque[tuple[TextPart, ...]] = collections.deque()
        self.waiting_bytes: int = 0
        # last message of a latched topic, for the next bridge
        self._last_message: tuple[TextPart, ...] | None = None

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, parts: tuple[TextPart, ...], *, connected: bool) -> None:
        """Queue a message; without a bridge keep only a latched topic's last one."""
        if self.latched:
            self._last_message = parts
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

    def take(self) -> tuple[TextPart, ...]:
        """Remove and return the oldest message."""
        parts = self._waiting.popleft()
        self.waiting_bytes -= sum(map(len, parts))
        return parts

    def clear(self) -> None:
        """Drop waiting messages, since the bridge is lost."""
        self.dropped += 0 if self.latched else len(self._waiting)
        self._waiting.clear()
        self.waiting_bytes = 0

    def repeat_last(self) -> None:
        """Queue a latched topic's last message for a new bridge."""
        if self._last_message is not None and not self._waiting:
            self.put(self._last_message, connected=True)


class Outbox:
    """Queues for a bridge; operations are sent first, then messages of the topics in turn."""

    def __init__(self) -> None:
        self._operations: collections.deque[tuple[TextPart, ...]] = collections.deque()
        self._queues: collections.deque[TopicQueue] = collections.deque()
        self._ready = asyncio.Event()
        self._has_room = asyncio.Event()
        self._has_room.set()
        self._flushed = asyncio.Event()

    def add_operation(self, parts: tuple[TextPart, ...]) -> None:
        """Queue an operation."""
        self._operations.append(parts)
        self.wake()
        if len(self._operations) >= MAX_WAITING_OPERATIONS:
            self._has_room.clear()

    def add_queue(self, queue: TopicQueue) -> None:
        """Also send the messages of a queue."""
        self._queues.append(queue)

    def remove_queue(self, queue: TopicQueue) -> None:
        """Stop sending the messages of a queue."""
        self._queues.remove(queue)

    def wake(self) -> None:
        """Wake the sender, since a message waits."""
        self._ready.set()
        self._flushed.clear()

    def clear(self) -> None:
        """Drop all waiting operations and messages."""
        self._operations.clear()
        for queue in self._queues:
            queue.clear()
        self._ready.clear()
        self._has_room.set()

    @property
    def is_full(self) -> bool:
        """True if ``MAX_WAITING_OPERATIONS`` or more operations wait."""
        return not self._has_room.is_set()

    async def wait_for_room(self) -> None:
        """Wait while ``MAX_WAITING_OPERATIONS`` or more operations wait."""
        await self._has_room.wait()

    async def wait_flushed(self) -> None:
        """Wait until the sender has sent everything."""
        await self._flushed.wait()

    async def take(self) -> tuple[TextPart, ...]:
        """Wait for an operation or message, remove it and return it."""
        while True:
            if self._operations:
                self._has_room.set()
                return self._operations.popleft()
            for _ in range(len(self._queues)):
                queue = self._queues[0]
                self._queues.rotate(-1)
                if queue:
                    queue.sent += 1
                    return queue.take()
            self._ready.clear()
            self._flushed.set()
            await self._ready.wait()
