"""Send the results of all cameras of an agent in one message (a *bundle*).

To send a message takes much more time than to encode the result in it. So for programs that receive
the results of all cameras, an agent also publishes bundles under one key, while that key has a
subscriber. Bundles are numbered: a program that misses a bundle asks the agent for the number of
each camera's next result, and then for the missing results.
"""

from __future__ import annotations

import asyncio
import math
import struct
from typing import TYPE_CHECKING, NamedTuple

from smartcam.exceptions import RemoteProtocolError

if TYPE_CHECKING:
    from smartcam.fleet._bus.bus import Bus, Publisher
    from smartcam.fleet._bus.keys import Keys

BUNDLE_INTERVAL = 0.005
"""Least seconds between two bundles."""

FULL_BUNDLE_BYTES = 1 << 15
"""Number of collected bytes of results at which a bundle is sent without waiting for
BUNDLE_INTERVAL."""

REMINDER_DELAYS = (0.05, 0.2, 1.0, 5.0)
"""Delays, seconds, of the empty bundles that follow a bundle. An empty bundle has the number of the
next bundle, by which a program notices that it has missed the last one."""

_HEAD = struct.Struct("<4sQQQI")
_PART = struct.Struct("<HI")
_MAGIC = b"scb1"


class ResultBundle(NamedTuple):
    """A decoded bundle.

    Attributes:
        epoch: number of the agent's start.
        number: number of the bundle; an empty bundle has that of the next bundle with results.
        next_number: number of the next bundle with results.
        parts: name of each camera, and its results in the form of :func:`encode_groups`.
    """

    epoch: int
    number: int
    next_number: int
    parts: list[tuple[str, bytes]]


def decode_bundle(payload: bytes, label: str) -> ResultBundle:
    """Return the bundle in ``payload``.

    Raises:
        RemoteProtocolError: the payload is not valid; the text names ``label``.
    """
    try:
        magic, epoch, number, next_number, count = _HEAD.unpack_from(payload)
        if magic != _MAGIC:
            raise ValueError(f"it begins with {magic!r}, not {_MAGIC!r}")
        position, parts = _HEAD.size, list[tuple[str, bytes]]()
        for _ in range(count):
            name_size, size = _PART.unpack_from(payload, position)
            start = position + _PART.size + name_size
            position = start + size
            if position > len(payload):
                raise ValueError(f"{position} bytes were announced, {len(payload)} came")
            parts.append(
                (str(payload[start - name_size : start], "utf-8"), payload[start:position])
            )
        if position != len(payload):
            raise ValueError(f"{len(payload) - position} bytes are left over")
    except (ValueError, struct.error) as exc:
        raise RemoteProtocolError(f"{label} is broken: {exc}") from exc
    return ResultBundle(epoch, number, next_number, parts)


class AgentBundle:
    """Sends the bundles of one agent.

    Args:
        agent: the agent's name.
        epoch: number of the agent's start.
        keys: keys of the fleet.
        bus: the agent's connection to the bus.
    """

    def __init__(self, agent: str, epoch: int, keys: Keys, bus: Bus) -> None:
        self._key, self._epoch, self._bus = keys.bundle(agent), epoch, bus
        self._publisher: Publisher | None = None
        self._unsent_parts: list[bytes] = []
        self._camera_count, self._unsent_bytes, self._next_number = 0, 0, 1
        self._sent_at = -math.inf
        self._flush_handle: asyncio.Handle | None = None
        self._reminder: asyncio.TimerHandle | None = None

    def open(self) -> None:
        """Start to check whether the key has subscribers."""
        self._publisher = self._bus.publisher(self._key, self._on_subscribers)

    def close(self) -> None:
        """Send the results that were not sent yet, and stop sending. Idempotent."""
        self.flush()
        publisher, self._publisher = self._publisher, None
        self._cancel_reminder()
        if publisher is not None:
            publisher.close()

    @property
    def has_subscribers(self) -> bool:
        """True if a program subscribes to the bundles."""
        return self._publisher is not None and self._publisher.has_subscribers

    def add(self, camera: str, encoded_results: bytes) -> None:
        """Add a camera's results to the next bundle, which is sent soon."""
        name = camera.encode()
        self._unsent_parts += (_PART.pack(len(name), len(encoded_results)), name, encoded_results)
        self._camera_count += 1
        self._unsent_bytes += len(encoded_results)
        if self._unsent_bytes >= FULL_BUNDLE_BYTES:
            self.flush()
        elif self._flush_handle is None:
            loop = asyncio.get_running_loop()
            send_at = self._sent_at + BUNDLE_INTERVAL
            self._flush_handle = (
                loop.call_at(send_at, self.flush)
                if send_at > loop.time()
                else loop.call_soon(self.flush)
            )

    def flush(self) -> None:
        """Send a bundle of the results that were added since the last bundle."""
        if self._flush_handle is not None:
            self._flush_handle.cancel()
            self._flush_handle = None
        if self._unsent_parts and self._publisher is not None:
            self._sent_at = asyncio.get_running_loop().time()
            parts, count = self._unsent_parts, self._camera_count
            self._unsent_parts, self._camera_count, self._unsent_bytes = [], 0, 0
            number, self._next_number = self._next_number, self._next_number + 1
            self._send_bundle(number, count, parts)
            self._schedule_reminder(0)

    def _send_bundle(self, number: int, count: int, parts: list[bytes]) -> None:
        if self._publisher is not None:
            head = _HEAD.pack(_MAGIC, self._epoch, number, self._next_number, count)
            self._publisher.put(b"".join((head, *parts)))

    def _on_subscribers(self, has_subscribers: bool) -> None:
        if has_subscribers:
            self._schedule_reminder(0)

    def _cancel_reminder(self) -> None:
        if self._reminder is not None:
            self._reminder.cancel()
            self._reminder = None

    def _schedule_reminder(self, step: int) -> None:
        """Send an empty bundle later; ``step``: number of empty bundles since the last full one."""
        self._cancel_reminder()
        if step < len(REMINDER_DELAYS):
            loop = asyncio.get_running_loop()
            self._reminder = loop.call_later(REMINDER_DELAYS[step], self._send_reminder, step + 1)

    def _send_reminder(self, step: int) -> None:
        self._reminder = None
        if self.has_subscribers:
            self._send_bundle(self._next_number, 0, [])
            self._schedule_reminder(step)
