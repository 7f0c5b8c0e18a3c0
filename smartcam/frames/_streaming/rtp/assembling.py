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
        lost_packets: number of packets lost since the last complete frame.
        damaged_frames: number of incomplete frames since the last complete one.
        arrived_at: time of arrival of the first packet; 0.0: unknown.
        starts_stream: whether this is the first complete frame of a stream.
    """

    data: bytes
    timestamp: int
    lost_packets: int = 0
    damaged_frames: int = 0
    arrived_at: float = 0.0
    starts_stream: bool = False


class OpenUnit(ABC):
    """An access unit whose packets are still coming.

    Args:
        timestamp: ticks of 90 kHz.
        has_first_packet: whether the unit's first packet has arrived.
        arrived_at: time of arrival of the first packet.

    Attributes:
        is_intact: whether no packet is missing and every payload is valid so far.
        has_picture: whether picture data came, and not only parameters.
        parts: received bytes, in order.
    """

    def __init__(self, timestamp: int, has_first_packet: bool, arrived_at: float) -> None:
        self.timestamp, self.is_intact, self.arrived_at = timestamp, has_first_packet, arrived_at
        self.parts: list[bytes] = []
        self.size = 0
        self.has_picture = False

    def add(self, payload: bytes) -> None:
        """Add a packet's payload; an invalid payload makes the unit damaged."""
        if self.is_intact:
            self.size += len(payload) + len(START_CODE)
            self.is_intact = self.size <= MAX_ACCESS_UNIT_BYTES and (
                not payload or self._add_payload(payload)
            )
        if not self.is_intact:
            self.parts.clear()

    def is_complete(self) -> bool:
        """Return True if the unit is complete."""
        return self.is_intact and bool(self.parts)

    def data(self) -> bytes:
        """Return the bytes of the encoded frame."""
        return b"".join(self.parts)

    @abstractmethod
    def _add_payload(self, payload: bytes) -> bool:
        """Add a payload that is not empty; return False if the payload is not valid."""


class PayloadFormat(Protocol):
    """An RTP payload format: where an access unit starts, and how it is assembled."""

    def new_unit(self, timestamp: int, has_first_packet: bool, arrived_at: float, /) -> OpenUnit:
        """Return a new access unit."""
        ...

    def certainly_starts_frame(self, payload: bytes, /) -> bool:
        """Return True if a packet is certainly the first of a frame."""
        ...


class NalAccessUnit(OpenUnit):
    """An access unit that consists of NAL units.

    A packet carries one NAL unit, several of them, or a fragment of one.
    """

    HEADER_SIZE: ClassVar[int]
    """Number of bytes of a NAL unit's header."""
    AGGREGATION: ClassVar[int]
    """Type of a packet with several NAL units."""
    FRAGMENT: ClassVar[int]
    """Type of a packet with a fragment of a NAL unit."""

    def __init__(self, timestamp: int, has_first_packet: bool, arrived_at: float) -> None:
        super().__init__(timestamp, has_first_packet, arrived_at)
        self._fragmented_type = -1  # type of the NAL unit whose fragments come now; -1: none

    @staticmethod
    @abstractmethod
    def unit_type(head: int) -> int:
        """Return a NAL unit's type, which its first byte holds; -1: not valid."""

    @staticmethod
    @abstractmethod
    def is_picture(unit_type: int) -> bool:
        """Return True if NAL units of this type have picture data."""

    @classmethod
    @abstractmethod
    def fragmented_header(cls, payload: bytes) -> bytes:
        """Return the header of the NAL unit whose fragment is in a packet."""

    @classmethod
    def leading_units(cls, access_unit: bytes) -> Iterator[bytes]:
        """Yield the NAL units before a frame's picture, and the header of the picture's first unit.

        Start codes are left out.
        """
        offset = access_unit.find(b"\0\0\1")
        while offset >= 0:
            head = access_unit[offset + 3 : offset + 3 + cls.HEADER_SIZE]
            unit_type = cls.unit_type(head[0]) if len(head) == cls.HEADER_SIZE else -1
            if cls.is_picture(unit_type):  # its end is not needed, and searching it takes long
                yield head
                return
            next_start = access_unit.find(b"\0\0\1", offset + 3)
            if unit_type >= 0:
                end = next_start if next_start >= 0 else len(access_unit)
                yield access_unit[offset + 3 : end].rstrip(b"\0")
            offset = next_start

    def is_complete(self) -> bool:
        """Return True if the unit is complete."""
        return super().is_complete() and self._fragmented_type < 0

    def _add_payload(self, payload: bytes) -> bool:
        unit_type = self.unit_type(payload[0])
        if unit_type == self.FRAGMENT:
            return self._add_fragment(payload)
        if self._fragmented_type >= 0:
            return False
        if unit_type == self.AGGREGATION:
            return self._add_aggregate(payload)
        return self._add_nal_unit(payload)

    def _add_nal_unit(self, unit: bytes) -> bool:
        unit_type = self.unit_type(unit[0]) if len(unit) >= self.HEADER_SIZE else -1
        if not 0 <= unit_type < self.AGGREGATION:
            return False
        self.has_picture |= self.is_picture(unit_type)
        self.parts += (START_CODE, unit)
        return True

    def _add_aggregate(self, payload: bytes) -> bool:
        offset = self.HEADER_SIZE
        while offset < len(payload):
            end = offset + 2 + int.from_bytes(payload[offset : offset + 2], "big")
            if end > len(payload) or not self._add_nal_unit(payload[offset + 2 : end]):
                return False
            offset = end
        return len(payload) > self.HEADER_SIZE

    def _add_fragment(self, payload: bytes) -> bool:
        if len(payload) < self.HEADER_SIZE + 2:
            return False
        head = self.fragmented_header(payload)
        fragment_header, unit_type = payload[self.HEADER_SIZE], self.unit_type(head[0])
        is_start = bool(fragment_header & START)
        if is_start != (self._fragmented_type < 0) or (is_start and fragment_header & END):
            return False
        if not 0 <= unit_type < self.AGGREGATION:
            return False
        if not is_start and unit_type != self._fragmented_type:
            return False
        if is_start:
            self.has_picture |= self.is_picture(unit_type)
            self.parts += (START_CODE, head)
        self.parts.append(payload[self.HEADER_SIZE + 1 :])
        self._fragmented_type = -1 if fragment_header & END else unit_type
        return True
