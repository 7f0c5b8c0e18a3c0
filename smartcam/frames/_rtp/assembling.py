"""Encoded frames of payloads (RFC 6184): whole ones, or none."""

from __future__ import annotations

from typing import Final, NamedTuple

STAP_A, FU_A = 24, 28
"""Kinds of payloads: several units in a packet, and a part of one."""

START, END = 0x80, 0x40
"""Bits of a part's second byte."""

START_CODE: Final = b"\0\0\0\1"

MOST_BYTES: Final = 16 << 20
"""Bytes of an access unit: one that is larger is damaged."""


class AccessUnit(NamedTuple):
    """One encoded frame that came whole.

    Attributes:
        data: as in a file (annex B).
        timestamp: ticks of 90 kHz.
        lost: packets that were lost since the last one that came whole.
        damaged: frames since then that did not come whole, as far as one saw something of them.
        arrived: when its first packet did, as it was told; 0.0 where it was not.
        begins: whether it is the first one of a stream: nothing before it belongs to that.
    """

    data: bytes
    timestamp: int
    lost: int = 0
    damaged: int = 0
    arrived: float = 0.0
    begins: bool = False


class OpenUnit:
    """An access unit that packets are still to come for."""

    def __init__(self, timestamp: int, whole: bool, arrived: float) -> None:
        self.timestamp, self.whole, self.arrived = timestamp, whole, arrived
        self.parts: list[bytes] = []
        self.size = 0
        self._kind = -1  # of the unit whose parts come
        self._last_sequence = False

    def add(self, payload: bytes) -> None:
        """Take what a packet has; what cannot be makes it damaged."""
        if self.whole:
            self.size += len(payload) + len(START_CODE)
            self.whole = self.size <= MOST_BYTES and self._added(payload)
        if not self.whole:
            self.parts.clear()

    def ended(self) -> bool:
        """Return whether nothing is missing."""
        return self.whole and self._kind < 0 and bool(self.parts)

    def _added(self, payload: bytes) -> bool:
        if not payload:
            return True  # keeps a way through a firewall open
        kind = payload[0] & 0x1F
        if payload[0] & 0x80:
            return False
        if kind == FU_A:
            return self._part(payload)
        if self._kind >= 0:
            return False
        if kind == STAP_A:
            return self._several(payload)
        self.parts += (START_CODE, payload)
        return 1 <= kind < STAP_A

    def _several(self, payload: bytes) -> bool:
        place = 1
        while place < len(payload):
            end = place + 2 + int.from_bytes(payload[place : place + 2], "big")
            unit = payload[place + 2 : end]
            if end > len(payload) or not unit or not 1 <= unit[0] & 0x9F < STAP_A:
                return False
            self.parts += (START_CODE, unit)
            place = end
        return len(payload) > 1

    def _part(self, payload: bytes) -> bool:
        if len(payload) < 3:
            return False
        second = payload[1]
        start, kind = bool(second & START), second & 0x1F
        if start != (self._kind < 0) or (second & START and second & END):
            return False
        if not 1 <= kind < STAP_A or (not start and kind != self._kind):
            return False
        if start:
            self.parts += (START_CODE, bytes((payload[0] & 0x60 | kind,)))
        self.parts.append(payload[2:])
        self._kind = -1 if second & END else kind
        return True
