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
        lost: number of frames lost before this frame that no earlier picture counts.
        leader: contents of the first packet.
        rows: number of rows that the camera sent.
        stride: number of bytes of a row.
        data: ``stride * rows`` bytes of its own.
        arrived: time of the first packet's arrival.
        payload: all bytes of the block if it has chunk data; else None.
        block_id: id of the block on the wire.
    """

    number: int
    lost: int
    leader: Leader
    rows: int
    stride: int
    data: memoryview
    arrived: float
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
        datagram: bytes of a full packet with its header.
        most: largest size of the payload, bytes.
        now: present time, seconds.
        implied: picture size for a leader without a size.
    """

    __slots__ = (
        "arrived",
        "block_id",
        "buffer",
        "complete",
        "dead",
        "expected",
        "extended",
        "full",
        "header",
        "highest",
        "implied",
        "last_size",
        "leader",
        "missing_since",
        "number",
        "over",
        "packets",
        "payloads",
        "progress",
        "received",
        "requested_at",
        "short",
        "trailer",
        "trailer_content",
        "tries",
    )

    def __init__(
        self,
        number: int,
        block_id: int,
        *,
        extended: bool,
        datagram: int,
        most: int,
        now: float,
        implied: ImpliedPicture | None = None,
    ) -> None:
        self.number, self.block_id, self.extended = number, block_id, extended
        self.header = EXTENDED_HEADER_BYTES if extended else HEADER_BYTES
        self.full = datagram - self.header
        self.packets = -(-most // self.full)
        self.buffer: memoryview | None = None
        self.received = bytearray(self.packets + 2)
        self.payloads = self.highest = 0
        self.expected = PAYLOAD_KIND | 1  # second word of the next packet's header
        self.leader: Leader | None = None
        self.implied = implied
        self.trailer: int | None = None
        self.trailer_content: Trailer | None = None  # contents of the trailer
        self.short: int | None = None
        self.last_size = self.full
        self.arrived: float | None = None
        self.progress = now
        self.missing_since = math.inf  # time from which packets are known to be missing
        self.requested_at, self.tries = -math.inf, 0
        self.over = False  # whether the camera has sent later blocks, or is silent
        self.complete = self.dead = False

    def take_next(self, packet: int, data: memoryview, now: float) -> bool:
        """Store a full packet if it is next in order and not the last; return whether it was.

        This is the fast path of nearly all packets; :meth:`take_payload` stores any packet.
        """
        buffer = self.buffer
        if (
            buffer is None
            or not self.highest < packet < self.packets
            or self.trailer is not None
            or self.short is not None
        ):
            return False
        begin = (packet - 1) * self.full
        buffer[begin : begin + self.full] = data
        self.received[packet] = 1
        self.payloads += 1
        self.highest = packet
        self.expected += 1
        self.progress = now
        return True

    def take_payload(self, packet: int, data: memoryview) -> bool:
        """Store the bytes of a payload packet; return whether they fit into the block."""
        size = len(data)
        past = self.trailer if self.trailer is not None else self.packets + 1
        if not (0 < packet < past and 0 < size <= self.full):
            return False
        if size < self.full:
            least = self.highest if self.trailer is None else self.trailer - 1
            if self.short not in (None, packet) or packet < least:
                return False  # only the last packet may be short
            self.short, self.last_size = packet, size
        elif self.short is not None and packet > self.short:
            return False
        if self.buffer is None:
            # memory grows with the packets, so a single packet does not allocate a whole frame
            self.buffer = np.empty(self.packets * self.full, np.uint8).data
        begin = (packet - 1) * self.full
        self.buffer[begin : begin + size] = data
        self.payloads += 1
        return True

    def take_leader(self, payload: bytes) -> None:
        """Store the leader.

        Raises:
            MessageError: the leader is of no picture, or the picture is too large.
        """
        leader = decode_leader(payload, self.implied)
        need = picture_bytes(leader, leader.height)
        if need > self.packets * self.full:
            raise MessageError(
                f"leader: a picture of {leader.width}x{leader.height} pixels has {need} bytes, "
                f"the camera's PayloadSize has room for {self.packets * self.full}",
                data=payload,
            )
        self.leader = leader

    def take_trailer(self, packet: int, payload: bytes) -> bool:
        """Store the trailer; return whether its id is after all received packets."""
        if not self.highest < packet <= self.packets + 1:
            return False
        if self.short is not None and packet != self.short + 1:
            return False
        self.trailer_content = decode_trailer(payload)
        self.trailer = packet
        return True

    def mark(self, packet: int) -> None:
        """Mark a packet as received."""
        self.received[packet] = 1
        if packet == self.expected & PACKET_ID_BITS or (packet == 0 and self.highest == 0):
            following = self.received.find(0, packet + 1 if packet else 1)
            self.expected = PAYLOAD_KIND | (max(0, following))
        self.complete = (
            self.trailer is not None
            and self.leader is not None
            and self.payloads == self.trailer - 1
        )

    def holes(self, most: int) -> list[tuple[int, int]]:
        """Return at most ``most`` ranges (first, last) of missing packets."""
        end = self.highest
        if self.trailer is not None:
            end = self.trailer
        elif self.over:
            end = self._expected_packets() + 1
        holes: list[tuple[int, int]] = []
        first = self.received.find(0, 0, end + 1)
        while first >= 0 and len(holes) < most:
            past = self.received.find(1, first, end + 1)
            last = end if past < 0 else past - 1
            holes.append((first, last))
            first = self.received.find(0, last + 1, end + 1)
        return holes

    def _expected_packets(self) -> int:
        if self.short is not None:
            return self.short
        if self.leader is None or self.leader.has_chunks:
            return self.packets
        need = picture_bytes(self.leader, self.leader.height) + self.leader.padding_y
        return max(self.highest, min(self.packets, -(-need // self.full)))

    def picture(self, lost: int) -> WholePicture | None:
        """Return the complete frame; None if bytes are missing."""
        leader, trailer_content = self.leader, self.trailer_content
        if leader is None or self.trailer is None or trailer_content is None:
            return None
        rows = min(trailer_content.rows or leader.height, leader.height)
        need = picture_bytes(leader, rows)
        available = (self.trailer - 1) * self.full
        if self.trailer > 1 and self.received[self.trailer - 1]:
            available += self.last_size - self.full
        available = min(available, trailer_content.length or available)
        if not rows or not leader.width or self.buffer is None:
            return None
        if need > available and leader.payload_type != PayloadType.CHUNK:
            # for chunk data the size is from the features: a wrong size is reported, not counted as
            # lost
            return None
        stride = (leader.width * bits_of(leader.pixel_format) + 7) // 8 + leader.padding_x
        data = self.buffer[: min(need, available)]
        arrived = self.arrived if self.arrived is not None else 0.0
        payload = self.buffer[:available] if leader.has_chunks else None
        return WholePicture(
            self.number, lost, leader, rows, stride, data, arrived, payload, self.block_id
        )
