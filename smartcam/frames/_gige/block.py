"""Collect the packets of one frame."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.exceptions import MessageError
from smartcam.frames._gige.gvsp import (
    EXTENDED_HEADER_BYTES,
    HEADER_BYTES,
    PayloadType,
    bits_of,
    decode_leader,
    decode_trailer,
)

if TYPE_CHECKING:
    from smartcam.frames._gige.gvsp import ImpliedPicture, Leader, Trailer

PAYLOAD_KIND: Final = 0x03000000
"""Kind of a payload packet in the upper bits of its header's second word."""

PACKET_ID_BITS: Final = 0xFFFFFF
"""Bits of the packet's id in the header's second word."""


class WholePicture(NamedTuple):
    """A complete frame.

    Attributes:
        number: number of the block, which continues when ids restart.
        lost: number of frames that were lost before this frame and that no earlier picture counts.
        leader: contents of the first packet.
        rows: number of rows that the camera sent.
        stride: number of bytes of a row.
        data: ``stride * rows`` bytes, which no other picture uses.
        arrived_at: time of the first packet's arrival.
        payload: all bytes of the block if it has chunk data; else None.
        block_id: id of the block on the wire.
    """

    number: int
    lost: int
    leader: Leader
    rows: int
    stride: int
    data: memoryview
    arrived_at: float
    payload: memoryview | None = None
    block_id: int = 0


def picture_bytes(leader: Leader, rows: int) -> int:
    """Return the number of bytes of ``rows`` rows of a picture."""
    bits = bits_of(leader.pixel_format)
    if leader.padding_x:
        return ((leader.width * bits + 7) // 8 + leader.padding_x) * rows
    return (leader.width * rows * bits + 7) // 8


class Block:
    """The received packets of one block. Memory is allocated with the first packet.

    Args:
        number: number of the block, with wraps of the ids counted.
        block_id: id of the block in its packets.
        extended: whether the ids have 64 bits.
        datagram_bytes: bytes of a full packet with its header.
        payload_size: largest size of the payload, bytes.
        now: present time, seconds.
        implied_picture: picture size for a leader without a size.
    """

    __slots__ = (
        "arrived_at",
        "block_id",
        "buffer",
        "expected",
        "extended",
        "full_bytes",
        "has_ended",
        "header_bytes",
        "highest_packet",
        "implied_picture",
        "is_complete",
        "is_lost",
        "last_size",
        "leader",
        "max_packets",
        "missing_since",
        "number",
        "payload_count",
        "progress_at",
        "received",
        "request_count",
        "requested_at",
        "short_packet",
        "trailer_content",
        "trailer_packet",
    )

    def __init__(
        self,
        number: int,
        block_id: int,
        *,
        extended: bool,
        datagram_bytes: int,
        payload_size: int,
        now: float,
        implied_picture: ImpliedPicture | None = None,
    ) -> None:
        self.number, self.block_id, self.extended = number, block_id, extended
        self.header_bytes = EXTENDED_HEADER_BYTES if extended else HEADER_BYTES
        self.full_bytes = datagram_bytes - self.header_bytes
        self.max_packets = -(-payload_size // self.full_bytes)
        self.buffer: memoryview | None = None
        self.received = bytearray(self.max_packets + 2)
        self.payload_count = self.highest_packet = 0
        self.expected = PAYLOAD_KIND | 1  # second word of the next packet's header
        self.leader: Leader | None = None
        self.implied_picture = implied_picture
        self.trailer_packet: int | None = None
        self.trailer_content: Trailer | None = None  # contents of the trailer
        self.short_packet: int | None = None
        self.last_size = self.full_bytes
        self.arrived_at: float | None = None
        self.progress_at = now
        self.missing_since = math.inf  # time from which packets are known to be missing
        self.requested_at, self.request_count = -math.inf, 0
        self.has_ended = False  # whether the camera has sent later blocks, or is silent
        self.is_complete = self.is_lost = False

    def store_next(self, packet: int, data: memoryview, now: float) -> bool:
        """Store a full packet if it comes in order and is not the last; else return False.

        This is the fast path of nearly all packets; :meth:`store_payload` stores any packet.
        """
        buffer = self.buffer
        if (
            buffer is None
            or not self.highest_packet < packet < self.max_packets
            or self.trailer_packet is not None
            or self.short_packet is not None
        ):
            return False
        begin = (packet - 1) * self.full_bytes
        buffer[begin : begin + self.full_bytes] = data
        self.received[packet] = 1
        self.payload_count += 1
        self.highest_packet = packet
        self.expected += 1
        self.progress_at = now
        return True

    def store_payload(self, packet: int, data: memoryview) -> bool:
        """Store the bytes of a payload packet; return False if they do not fit into the block."""
        size = len(data)
        end = self.trailer_packet if self.trailer_packet is not None else self.max_packets + 1
        if not (0 < packet < end and 0 < size <= self.full_bytes):
            return False
        if size < self.full_bytes:
            lowest = self.highest_packet if self.trailer_packet is None else self.trailer_packet - 1
            if self.short_packet not in (None, packet) or packet < lowest:
                return False  # only the last packet may be short
            self.short_packet, self.last_size = packet, size
        elif self.short_packet is not None and packet > self.short_packet:
            return False
        if self.buffer is None:
            # memory grows with the packets, so a single packet does not allocate a whole frame
            self.buffer = np.empty(self.max_packets * self.full_bytes, np.uint8).data
        begin = (packet - 1) * self.full_bytes
        self.buffer[begin : begin + size] = data
        self.payload_count += 1
        return True

    def store_leader(self, payload: bytes) -> None:
        """Store the leader.

        Raises:
            MessageError: the leader belongs to no picture, or the picture is too large.
        """
        leader = decode_leader(payload, self.implied_picture)
        needed_bytes = picture_bytes(leader, leader.height)
        max_bytes = self.max_packets * self.full_bytes
        if needed_bytes > max_bytes:
            raise MessageError(
                f"leader: a picture of {leader.width}x{leader.height} pixels has {needed_bytes} "
                f"bytes, the camera's PayloadSize has room for {max_bytes}",
                data=payload,
            )
        self.leader = leader

    def store_trailer(self, packet: int, payload: bytes) -> bool:
        """Store the trailer; return False if its id does not follow the received packets."""
        if not self.highest_packet < packet <= self.max_packets + 1:
            return False
        if self.short_packet is not None and packet != self.short_packet + 1:
            return False
        self.trailer_content = decode_trailer(payload)
        self.trailer_packet = packet
        return True

    def mark_received(self, packet: int) -> None:
        """Mark a packet as received."""
        self.received[packet] = 1
        if packet == self.expected & PACKET_ID_BITS or (packet == 0 and self.highest_packet == 0):
            following = self.received.find(0, packet + 1 if packet else 1)
            self.expected = PAYLOAD_KIND | (max(0, following))
        self.is_complete = (
            self.trailer_packet is not None
            and self.leader is not None
            and self.payload_count == self.trailer_packet - 1
        )

    def gaps(self, limit: int) -> list[tuple[int, int]]:
        """Return the ranges (first, last) of missing packets, at most ``limit`` of them."""
        end = self.highest_packet
        if self.trailer_packet is not None:
            end = self.trailer_packet
        elif self.has_ended:
            end = self._expected_packets() + 1
        gaps: list[tuple[int, int]] = []
        first = self.received.find(0, 0, end + 1)
        while first >= 0 and len(gaps) < limit:
            next_received = self.received.find(1, first, end + 1)
            last = end if next_received < 0 else next_received - 1
            gaps.append((first, last))
            first = self.received.find(0, last + 1, end + 1)
        return gaps

    def _expected_packets(self) -> int:
        if self.short_packet is not None:
            return self.short_packet
        if self.leader is None or self.leader.has_chunks:
            return self.max_packets
        needed_bytes = picture_bytes(self.leader, self.leader.height) + self.leader.padding_y
        return max(self.highest_packet, min(self.max_packets, -(-needed_bytes // self.full_bytes)))

    def picture(self, lost: int) -> WholePicture | None:
        """Return the complete frame; None if bytes are missing."""
        leader, trailer_content = self.leader, self.trailer_content
        if leader is None or self.trailer_packet is None or trailer_content is None:
            return None
        rows = min(trailer_content.rows or leader.height, leader.height)
        needed_bytes = picture_bytes(leader, rows)
        available = (self.trailer_packet - 1) * self.full_bytes
        if self.trailer_packet > 1 and self.received[self.trailer_packet - 1]:
            available += self.last_size - self.full_bytes
        available = min(available, trailer_content.length or available)
        if not rows or not leader.width or self.buffer is None:
            return None
        if needed_bytes > available and leader.payload_type != PayloadType.CHUNK:
            # for chunk data the size is from the features: a wrong size is reported, not counted as
            # lost
            return None
        stride = (leader.width * bits_of(leader.pixel_format) + 7) // 8 + leader.padding_x
        data = self.buffer[: min(needed_bytes, available)]
        arrived_at = self.arrived_at if self.arrived_at is not None else 0.0
        payload = self.buffer[:available] if leader.has_chunks else None
        return WholePicture(
            self.number, lost, leader, rows, stride, data, arrived_at, payload, self.block_id
        )
