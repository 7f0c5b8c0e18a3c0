"""Assemble complete encoded frames from the payloads of packets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, Final, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator


START, END = 0x80, 0x40
"""Bits of a fragment's header for the first and the last fragment of a unit."""

START_CODE: Final = b"\0\0\0\1"

MAX_ACCESS_UNIT_BYTES: Final = 16 << 20
"""Largest number of bytes of an access unit; a larger unit counts as damaged."""


class AccessUnit(NamedTuple):
    """A complete encoded frame.

    Attributes:
        data: bytes as in a file (annex B, or a JPEG).
        timestamp: ticks of 90 kHz.
        lost: number of packets lost since the last complete frame.
        damaged: number of incomplete frames since then.
        arrived: time of arrival of the first packet; 0.0: unknown.
        begins: whether the first packet is the first of a stream.
    """

    data: bytes
    timestamp: int
    lost: int = 0
    damaged: int = 0
    arrived: float = 0.0
    begins: bool = False


class OpenUnit(ABC):
    """An access unit whose packets are still coming.

    Attributes:
        whole: whether no packet is missing so far.
        has_picture: whether picture data came, and not only parameters.
        parts: received bytes, in order.
    """

    def __init__(self, timestamp: int, unbroken: bool, arrived: float) -> None:
        self.timestamp, self.whole, self.arrived = timestamp, unbroken, arrived
        self.parts: list[bytes] = []
        self.size = 0
        self.has_picture = False

    def add(self, payload: bytes) -> None:
        """Add a packet's payload; an invalid payload makes the unit damaged."""
        if self.whole:
            self.size += len(payload) + len(START_CODE)
            self.whole = self.size <= MAX_ACCESS_UNIT_BYTES and (
                not payload or self._added(payload)
            )
        if not self.whole:
            self.parts.clear()

    def ended(self) -> bool:
        """Return True if the unit is complete."""
        return self.whole and bool(self.parts)

    def data(self) -> bytes:
        """Return the bytes of the encoded frame."""
        return b"".join(self.parts)

    @abstractmethod
    def _added(self, payload: bytes) -> bool:
        """Add a payload that is not empty; return False if it is not valid."""


class UnitKind(Protocol):
    """Rules by which the access units in a stream's payloads begin and are assembled."""

    def new_unit(self, timestamp: int, unbroken: bool, arrived: float, /) -> OpenUnit:
        """Return a new access unit."""
        ...

    def begins(self, payload: bytes, /) -> bool:
        """Return True if a packet is certainly the first of a frame."""
        ...


class NalUnit(OpenUnit):
    """An access unit of NAL units, several in a packet or one in fragments."""

    HEADER_SIZE: ClassVar[int]
    """Number of bytes of a unit's header."""
    AGGREGATION: ClassVar[int]
    """Kind of a packet with several units."""
    FRAGMENT: ClassVar[int]
    """Kind of a packet with a fragment of a unit."""

    def __init__(self, timestamp: int, unbroken: bool, arrived: float) -> None:
        super().__init__(timestamp, unbroken, arrived)
        self._part_of = -1  # kind of the current fragmented unit; -1: none

    @staticmethod
    @abstractmethod
    def kind_of(head: int) -> int:
        """Return a unit's kind by its first byte; -1: not valid."""

    @staticmethod
    @abstractmethod
    def is_picture(kind: int) -> bool:
        """Return True if units of a kind have picture data."""

    @classmethod
    @abstractmethod
    def whole_head(cls, payload: bytes) -> bytes:
        """Return the header of the unit whose fragment is in a packet."""

    @classmethod
    def leading(cls, access_unit: bytes) -> Iterator[bytes]:
        """Yield the units before a frame's picture, without start codes, and its header."""
        place = access_unit.find(b"\0\0\1")
        while place >= 0:
            head = access_unit[place + 3 : place + 3 + cls.HEADER_SIZE]
            kind = cls.kind_of(head[0]) if len(head) == cls.HEADER_SIZE else -1
            if cls.is_picture(kind):  # the search for its end would be long and is not needed
                yield head
                return
            after = access_unit.find(b"\0\0\1", place + 3)
            if kind >= 0:
                end = after if after >= 0 else len(access_unit)
                yield access_unit[place + 3 : end].rstrip(b"\0")
            place = after

    def ended(self) -> bool:
        """Return True if the unit is complete."""
        return super().ended() and self._part_of < 0

    def _added(self, payload: bytes) -> bool:
        kind = self.kind_of(payload[0])
        if kind == self.FRAGMENT:
            return self._part(payload)
        if self._part_of >= 0:
            return False
        if kind == self.AGGREGATION:
            return self._several(payload)
        return self._unit(payload)

    def _unit(self, unit: bytes) -> bool:
        kind = self.kind_of(unit[0]) if len(unit) >= self.HEADER_SIZE else -1
        if not 0 <= kind < self.AGGREGATION:
            return False
        self.has_picture |= self.is_picture(kind)
        self.parts += (START_CODE, unit)
        return True

    def _several(self, payload: bytes) -> bool:
        place = self.HEADER_SIZE
        while place < len(payload):
            end = place + 2 + int.from_bytes(payload[place : place + 2], "big")
            if end > len(payload) or not self._unit(payload[place + 2 : end]):
                return False
            place = end
        return len(payload) > self.HEADER_SIZE

    def _part(self, payload: bytes) -> bool:
        if len(payload) < self.HEADER_SIZE + 2:
            return False
        head = self.whole_head(payload)
        second, kind = payload[self.HEADER_SIZE], self.kind_of(head[0])
        start = bool(second & START)
        if start != (self._part_of < 0) or (start and second & END):
            return False
        if not 0 <= kind < self.AGGREGATION or (not start and kind != self._part_of):
            return False
        if start:
            self.has_picture |= self.is_picture(kind)
            self.parts += (START_CODE, head)
        self.parts.append(payload[self.HEADER_SIZE + 1 :])
        self._part_of = -1 if second & END else kind
        return True
