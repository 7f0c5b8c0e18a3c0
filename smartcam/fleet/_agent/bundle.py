"""Send results of all cameras of an agent in one message, for programs that receive all.

A message for each result costs much more than the result itself. An agent therefore also publishes
the results of all its cameras together on one key, while that key has a subscriber. Bundles are
numbered: a program that misses one asks the agent for the next number of each camera.
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
"""Bytes of results with which a bundle is sent at once."""

REMINDER_DELAYS = (0.05, 0.2, 1.0, 5.0)
"""Delays, seconds, of the empty bundles after a bundle; each repeats the next bundle's number."""

_HEAD = struct.Struct("<4sQQQI")
_PART = struct.Struct("<HI")
_MAGIC = b"scb1"


class Bundled(NamedTuple):
    """A bundle.

    Attributes:
        epoch: number of the agent's start.
        number: number of the bundle; an empty bundle has the number of the next one.
        following: number of the next bundle.
        parts: cameras, and their results in the form of :func:`encode_runs`.
    """

    epoch: int
    number: int
    following: int
    parts: list[tuple[str, bytes]]


def decode_bundle(payload: bytes, label: str) -> Bundled:
    """Return the bundle in ``payload``.

    Raises:
        RemoteProtocolError: the payload is not valid; the text names ``label``.
    """
    try:
        magic, epoch, number, following, count = _HEAD.unpack_from(payload)
        if magic != _MAGIC:
            raise ValueError(f"it begins with {magic!r}, not {_MAGIC!r}")
        place, parts = _HEAD.size, list[tuple[str, bytes]]()
        for _ in range(count):
            name_size, size = _PART.unpack_from(payload, place)
            begin = place + _PART.size + name_size
            place = begin + size
            if place > len(payload):
                raise ValueError(f"{place} bytes were announced, {len(payload)} came")
            parts.append((str(payload[begin - name_size : begin], "utf-8"), payload[begin:place]))
        if place != len(payload):
            raise ValueError(f"{len(payload) - place} bytes are left over")
    except (ValueError, struct.error) as exc:
        raise RemoteProtocolError(f"{label} is broken: {exc}") from exc
    return Bundled(epoch, number, following, parts)


class AgentBundle:
    """Sends the results of an agent's cameras together.

    Args:
        agent: the agent's name.
        epoch: number of the agent's start.
        keys: keys of the fleet.
        bus: the agent's end of the bus.
    """

    def __init__(self, agent: str, epoch: int, keys: Keys, bus: Bus) -> None:
        self._key, self._epoch, self._bus = keys.bundle(agent), epoch, bus
        self._out: Publisher | None = None
        self._fresh: list[bytes] = []
        self._count, self._bytes, self._number = 0, 0, 1
        self._sent_at = -math.inf
        self._due: asyncio.Handle | None = None
        self._reminder: asyncio.TimerHandle | None = None

    def open(self) -> None:
        """Start to check for subscribers."""
        self._out = self._bus.publisher(self._key, self._on_subscribers)

    def close(self) -> None:
        """Send the results that are left, and stop sending. Idempotent."""
        self.flush()
        out, self._out = self._out, None
        self._end_reminding()
        if out is not None:
            out.close()

    @property
    def has_subscribers(self) -> bool:
        """True if the bundles have a subscriber."""
        return self._out is not None and self._out.has_subscribers

    def add(self, camera: str, encoded_results: bytes) -> None:
        """Add a camera's results, which are sent soon with results of other cameras."""
        name = camera.encode()
        self._fresh += (_PART.pack(len(name), len(encoded_results)), name, encoded_results)
        self._count += 1
        self._bytes += len(encoded_results)
        if self._bytes >= FULL_BUNDLE_BYTES:
            self.flush()
        elif self._due is None:
            loop = asyncio.get_running_loop()
            at = self._sent_at + BUNDLE_INTERVAL
            self._due = (
                loop.call_at(at, self.flush) if at > loop.time() else loop.call_soon(self.flush)
            )

    def flush(self) -> None:
        """Send the results that were added and not sent yet."""
        if self._due is not None:
            self._due.cancel()
            self._due = None
        if self._fresh and self._out is not None:
            self._sent_at = asyncio.get_running_loop().time()
            fresh, count = self._fresh, self._count
            self._fresh, self._count, self._bytes = [], 0, 0
            number, self._number = self._number, self._number + 1
            self._put(number, count, fresh)
            self._remind(0)

    def _put(self, number: int, count: int, parts: list[bytes]) -> None:
        if self._out is not None:
            head = _HEAD.pack(_MAGIC, self._epoch, number, self._number, count)
            self._out.put(b"".join((head, *parts)))

    def _on_subscribers(self, has_subscribers: bool) -> None:
        if has_subscribers:
            self._remind(0)

    def _end_reminding(self) -> None:
        if self._reminder is not None:
            self._reminder.cancel()
            self._reminder = None

    def _remind(self, step: int) -> None:
        """Send the next number again later; stop after the last reminder."""
        self._end_reminding()
        if step < len(REMINDER_DELAYS):
            loop = asyncio.get_running_loop()
            self._reminder = loop.call_later(REMINDER_DELAYS[step], self._send_number, step + 1)

    def _send_number(self, step: int) -> None:
        self._reminder = None
        if self.has_subscribers:
            self._put(self._number, 0, [])
            self._remind(step)
