"""Assemble packets of a stream into frames, and count incomplete frames as lost.

A block is the packets of one frame: a leader, the payload, and a trailer. The module uses no socket
and no clock: its caller passes packets with their time. It returns pictures in the order of their
blocks, and requests for missing packets. At most :data:`MAX_OPEN_BLOCKS` blocks are kept.

A block with missing packets waits while they are requested, and later blocks wait for it. The block
is lost when the camera no longer has the packets, when they have not come after
:data:`MAX_REQUESTS` requests, or when too many are missing.

The time in a leader distinguishes restarted block ids from late packets: a late leader is older
than the newest block's. Without such times, a second of silence means that the ids restarted.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam.exceptions import MessageError
from smartcam.frames._gige.block import PACKET_ID_BITS, Block
from smartcam.frames._gige.gvcp import GvcpStatus
from smartcam.frames._gige.gvsp import HEADER_BYTES, PacketKind, decode_header

if TYPE_CHECKING:
    from smartcam.frames._gige.block import WholePicture
    from smartcam.frames._gige.gvsp import ImpliedPicture, PacketHeader

MAX_OPEN_BLOCKS: Final = 4
"""Largest number of blocks that wait for packets or an earlier block: 40 ms at 100 frames/s."""

REORDER_GRACE: Final = 0.003
"""Seconds for which a packet may come later than its successors before it is requested."""

SILENCE_TIMEOUT: Final = 0.05
"""Seconds of silence in a block after which the rest counts as missing."""

RESEND_INTERVAL: Final = 0.03
"""Seconds until missing packets are requested again."""

MAX_REQUESTS: Final = 4
"""Largest number of requests for the packets of one block."""

MAX_MISSING_PACKETS: Final = 64
"""Largest number of a block's missing packets that are always requested. More are requested only if
they are at most a quarter of the block."""

MAX_GAPS_PER_BLOCK: Final = 1000
"""Largest number of gaps in a block; each gap needs its own request."""

LEADER_TIMEOUT: Final = 10.0
"""Seconds after a leader until its pixels must come: some cameras send it before the exposure."""

RESTART_TIMEOUT: Final = 1.0
"""Seconds without a useful packet after which a leader with an old id restarts the count."""

MAX_FRAME_RATE: Final = 2000.0
"""Highest plausible frame rate, frames per second: if ids advance faster, they were restarted."""

MAX_SHORT_ID: Final = 65535
"""Largest block id of 16 bits; the ids begin at 1."""

_SHORT_HEADER: Final = struct.Struct(">HHI")
_NOT_AVAILABLE: Final = {
    GvcpStatus.PACKET_UNAVAILABLE,
    GvcpStatus.PACKET_REMOVED_FROM_MEMORY,
    GvcpStatus.PACKET_AND_PREV_REMOVED_FROM_MEMORY,
}


class Resend(NamedTuple):
    """A request that the camera sends the packets ``first`` to ``last`` of a block again."""

    block: int
    first: int
    last: int
    extended: bool


@dataclass(slots=True)
class PacketCounts:
    """Counts of packets and frames by their outcome.

    Attributes:
        pictures: complete pictures.
        lost: frames lost because of missing packets.
        late: packets of blocks that were already finished.
        doubled: packets that came twice.
        malformed: datagrams that are no packets, or packets that do not fit their block.
        refused: packets that only have an error code.
        requested: packets that were requested again.
        restarts: number of restarts of the ids.
    """

    pictures: int = 0
    lost: int = 0
    late: int = 0
    doubled: int = 0
    malformed: int = 0
    refused: int = 0
    requested: int = 0
    restarts: int = 0


class Assembler:
    """The packets of one stream.

    Args:
        payload_size: largest number of bytes of a frame, the camera's ``PayloadSize``.
        datagram_bytes: bytes of a full packet with its GVSP header, without IP and UDP.
        resend: whether missing packets are requested from the camera.
        starts_at_one: whether the ids start at 1, so that blocks before the first received block
            count as lost; otherwise those blocks belong to an earlier stream.
        implied_picture: picture size for leaders without a size; None: such leaders are an error.
    """

    def __init__(
        self,
        payload_size: int,
        datagram_bytes: int,
        *,
        resend: bool = True,
        starts_at_one: bool = True,
        implied_picture: ImpliedPicture | None = None,
    ) -> None:
        self.counts = PacketCounts()
        self.fault: MessageError | None = None
        """Error of unreadable blocks, such as a payload type that is no picture."""
        self._payload_size, self._datagram_bytes, self._resend = (
            payload_size,
            datagram_bytes,
            resend,
        )
        self._implied_picture = implied_picture
        self._blocks: dict[int, Block] = {}
        self._current: Block | None = None  # block of the last packet
        self._newest_number = self._closed_number = 0
        self._number_offset = 0  # difference between a block's number and its id
        self._has_started, self._starts_at_one = False, starts_at_one
        self._ticks = 0  # largest clock reading of any leader
        self._accepted_at = -math.inf
        self._ready_pictures: list[WholePicture] = []
        self._uncounted_lost = 0

    def feed(self, data: memoryview, size: int, now: float, arrived_at: float) -> None:
        """Process the packet in the first ``size`` bytes of ``data``, which are copied.

        Args:
            data: buffer of at least ``size`` bytes.
            size: size of the packet.
            now: present time, seconds, on the clock of the deadlines.
            arrived_at: time of arrival; a picture gets the time of its first packet.
        """
        current = self._current
        if current is not None and size == self._datagram_bytes:
            status, block_id, word = _SHORT_HEADER.unpack_from(data)
            if (
                word == current.expected
                and block_id == current.block_id
                and status == 0
                and current.store_next(word & PACKET_ID_BITS, data[HEADER_BYTES:size], now)
            ):
                self._accepted_at = now
                return
        header = decode_header(data, size)
        if header is None or not header.block:
            self.counts.malformed += 1
            return
        block = self._block_of(header, data, size, now)
        if block is not None:
            if block.arrived_at is None:
                block.arrived_at = arrived_at
            self._store_packet(block, header, data[header.size : size], now)

    def pictures(self) -> list[WholePicture]:
        """Return new complete pictures in order."""
        pictures, self._ready_pictures = self._ready_pictures, []
        return pictures

    @property
    def uncounted_lost(self) -> int:
        """Number of lost frames that no picture has counted yet."""
        return self._uncounted_lost

    def take_lost(self) -> int:
        """Return the number of lost frames that no picture has counted, and reset it."""
        lost, self._uncounted_lost = self._uncounted_lost, 0
        return lost

    def next_deadline(self) -> float | None:
        """Return the time at which to call :meth:`handle_timeout`; None: after the next packet."""
        return min(map(self._deadline, self._open_blocks()), default=None)

    def handle_timeout(self, now: float) -> list[Resend]:
        """Give up overdue blocks, or request their packets; return the requests to send."""
        requests: list[Resend] = []
        for block in self._open_blocks():
            if self._deadline(block) <= now:
                self._handle_overdue(block, now, requests)
        self._close_finished()
        self.counts.requested += sum(span.last - span.first + 1 for span in requests)
        return requests

    def _open_blocks(self) -> list[Block]:
        return [
            block for block in self._blocks.values() if not (block.is_complete or block.is_lost)
        ]

    def _deadline(self, block: Block) -> float:
        if block.missing_since < math.inf:
            return max(block.missing_since + REORDER_GRACE, block.requested_at + RESEND_INTERVAL)
        if block.highest_packet or block.trailer_packet is not None:
            return block.progress_at + SILENCE_TIMEOUT
        return block.progress_at + LEADER_TIMEOUT

    def _handle_overdue(self, block: Block, now: float, requests: list[Resend]) -> None:
        if block.missing_since == math.inf:
            block.missing_since = now - REORDER_GRACE
            block.has_ended = True
            if not block.highest_packet and block.trailer_packet is None:
                block.is_lost = True
                return
        gaps = block.gaps(MAX_GAPS_PER_BLOCK + 1)
        if not gaps:  # no gaps: only the rest of the block is missing
            block.missing_since = math.inf
            return
        if not self._resend:
            block.is_lost = block.progress_at + SILENCE_TIMEOUT <= now
            block.missing_since = block.progress_at + SILENCE_TIMEOUT
            return
        missing = sum(last - first + 1 for first, last in gaps)
        too_many = (
            missing > max(MAX_MISSING_PACKETS, block.max_packets // 4)
            or len(gaps) > MAX_GAPS_PER_BLOCK
        )
        if block.request_count >= MAX_REQUESTS or too_many:
            block.is_lost = True
            return
        is_fully_sent = (
            block.has_ended
            or block.trailer_packet is not None
            or block.progress_at + SILENCE_TIMEOUT <= now
        )
        # while other packets of the block come, a request does not count
        block.request_count += is_fully_sent
        block.requested_at = now
        requests += [Resend(block.block_id, *gap, block.extended) for gap in gaps]

    # packets

    def _block_of(
        self, header: PacketHeader, data: memoryview, size: int, now: float
    ) -> Block | None:
        """Return the block of a packet; None: the block is finished."""
        extended = header.size != HEADER_BYTES
        if not self._has_started:
            self._has_started = True
            # unless the ids start at 1, earlier blocks belong to an earlier stream
            if not self._starts_at_one or header.block > MAX_OPEN_BLOCKS:
                self._newest_number = self._closed_number = header.block - 1
        number = self._number_of(header.block, extended)
        advance = number - self._newest_number
        if header.kind == PacketKind.LEADER and self._shows_restart(
            number, bytes(data[header.size : size])
        ):
            number = self._restart_ids(header.block)
        elif advance > MAX_OPEN_BLOCKS + MAX_FRAME_RATE * min(now - self._accepted_at, 1e6):
            if header.kind != PacketKind.LEADER:
                self.counts.late += 1
                return None
            number = self._restart_ids(header.block)
        elif number <= self._closed_number:
            if header.kind != PacketKind.LEADER or now - self._accepted_at < RESTART_TIMEOUT:
                self.counts.late += 1
                return None
            number = self._restart_ids(header.block)
        self._accepted_at = now
        block = self._blocks.get(number)
        if block is None:
            block = self._open_block(number, extended, now)
        if block.extended != extended:
            self.counts.malformed += 1
            return None
        self._current = block
        return block

    def _number_of(self, block_id: int, extended: bool) -> int:
        """Return the number of a block: its id with wraps and restarts counted."""
        if extended:
            return block_id + self._number_offset
        advance = (block_id + self._number_offset - self._newest_number) % MAX_SHORT_ID
        if advance > MAX_SHORT_ID // 2:
            advance -= MAX_SHORT_ID
        return self._newest_number + advance

    def _shows_restart(self, number: int, leader: bytes) -> bool:
        """Return True if a leader shows that the camera restarted its block ids."""
        if len(leader) < 12:
            return False
        ticks = int.from_bytes(leader[4:12], "big")
        if number <= self._closed_number:
            return bool(self._ticks) and ticks > self._ticks
        block = self._blocks.get(number)
        return block is not None and block.leader is not None and block.leader.ticks != ticks

    def _restart_ids(self, block_id: int) -> int:
        """Restart the count, and return the block's number; open blocks are lost."""
        self.counts.restarts += 1
        self._count_lost(self._newest_number - self._closed_number)
        self._blocks.clear()
        self._current = None
        self._closed_number = self._newest_number
        self._ticks = 0
        self._number_offset = (
            self._newest_number
            if block_id <= MAX_OPEN_BLOCKS
            else self._newest_number + 1 - block_id
        )
        return block_id + self._number_offset

    def _open_block(self, number: int, extended: bool, now: float) -> Block:
        """Open a block, and earlier blocks of which no packet came."""
        for opened in self._blocks.values():
            if opened.number < number and not opened.has_ended:
                opened.has_ended = True
                opened.missing_since = min(opened.missing_since, now)
        for missing in range(max(self._newest_number + 1, number - MAX_OPEN_BLOCKS + 1), number):
            self._new_block(missing, extended, now).has_ended = True
            self._blocks[missing].missing_since = now
        block = self._blocks.get(number) or self._new_block(number, extended, now)
        self._newest_number = max(self._newest_number, number)
        self._close_finished()
        return block

    def _new_block(self, number: int, extended: bool, now: float) -> Block:
        block_id = number - self._number_offset
        if not extended:
            block_id = (block_id - 1) % MAX_SHORT_ID + 1
        block = Block(
            number,
            block_id,
            extended=extended,
            datagram_bytes=self._datagram_bytes,
            payload_size=self._payload_size,
            now=now,
            implied_picture=self._implied_picture,
        )
        self._blocks[number] = block
        return block

    def _store_packet(
        self, block: Block, header: PacketHeader, payload: memoryview, now: float
    ) -> None:
        """Store a packet in its block, or count why it is not stored."""
        packet = header.packet
        if block.is_lost or block.is_complete:
            self.counts.late += 1
            return
        if header.status >= 0x8000:
            self.counts.refused += 1
            if header.status in _NOT_AVAILABLE:
                block.is_lost = True
                self._close_finished()
            return
        if packet < len(block.received) and block.received[packet]:
            self.counts.doubled += 1
            return
        if not self._store_contents(block, header, payload):
            self.counts.malformed += 1
            return
        block.progress_at = now
        if packet > block.highest_packet + 1 and block.missing_since == math.inf:
            block.missing_since = now
        block.highest_packet = max(block.highest_packet, packet)
        block.mark_received(packet)
        if block.is_complete:
            self._close_finished()

    def _store_contents(self, block: Block, header: PacketHeader, payload: memoryview) -> bool:
        """Store a packet's contents; return False if they do not fit into the block."""
        try:
            if header.kind == PacketKind.PAYLOAD:
                return block.store_payload(header.packet, payload)
            if header.kind == PacketKind.LEADER and header.packet == 0:
                block.store_leader(bytes(payload))
                if block.leader is not None:
                    self._ticks = max(self._ticks, block.leader.ticks)
                return True
            if header.kind == PacketKind.TRAILER:
                return block.store_trailer(header.packet, bytes(payload))
        except MessageError as exc:
            self.fault = self.fault or exc
        return False

    # blocks

    def _close_finished(self) -> None:
        """Close finished blocks, the oldest first, up to the first unfinished block."""
        while self._closed_number < self._newest_number:
            number = self._closed_number + 1
            oldest = self._blocks.get(number)
            if oldest is None:
                number = min(self._blocks) if self._blocks else self._newest_number + 1
                self._count_lost(number - 1 - self._closed_number)
                self._closed_number = number - 1
                continue
            if (
                not oldest.is_complete
                and not oldest.is_lost
                and len(self._blocks) <= MAX_OPEN_BLOCKS
            ):
                return
            picture = oldest.picture(self._uncounted_lost) if oldest.is_complete else None
            if picture is None:
                self._count_lost(1)
            else:
                self.counts.pictures += 1
                self._uncounted_lost = 0
                self._ready_pictures.append(picture)
            del self._blocks[number]
            self._closed_number = number

    def _count_lost(self, count: int) -> None:
        self.counts.lost += count
        self._uncounted_lost += count
