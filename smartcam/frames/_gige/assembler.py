"""Assemble packets of a stream into frames, and count incomplete frames as lost.

The module uses no socket and no clock: it gets packets with their time, and returns pictures in the
order of their blocks, and requests for missing packets. At most :data:`MAX_OPEN_BLOCKS` blocks are
kept.

A block with missing packets waits while they are requested, and later blocks wait for it. The block
is lost when the camera no longer has the packets, when they have not come after
:data:`MAX_REQUESTS` requests, or when too many are missing.

The camera's clock distinguishes restarted ids from late packets: the time of a late leader is
before that of the newest block. Without a clock, a second of silence means that the ids restarted.
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
"""Seconds by which a packet may come after its successors before it is requested."""

SILENCE_TIMEOUT: Final = 0.05
"""Seconds of silence in a block after which the rest counts as missing."""

RESEND_INTERVAL: Final = 0.03
"""Seconds until missing packets are requested again."""

MAX_REQUESTS: Final = 4
"""Largest number of requests for the packets of one block."""

MAX_MISSING_PACKETS: Final = 64
"""Number of missing packets of a block that is always requested; more, only up to a quarter of the
block."""

MAX_GAPS_PER_BLOCK: Final = 1000
"""Largest number of gaps in a block; each gap needs its own request."""

LEADER_TIMEOUT: Final = 10.0
"""Seconds after a leader until its pixels must come: some cameras send it before the exposure."""

RESTART_TIMEOUT: Final = 1.0
"""Seconds without a useful packet after which a leader with an old id restarts the count."""

MAX_FRAME_RATE: Final = 2000.0
"""Highest plausible frame rate, frames per second: ids that advance faster were restarted."""

MAX_SHORT_ID: Final = 65535
"""Largest block id of 16 bits; the ids begin at 1."""

_SHORT: Final = struct.Struct(">HHI")
_GONE: Final = {
    GvcpStatus.PACKET_UNAVAILABLE,
    GvcpStatus.PACKET_REMOVED_FROM_MEMORY,
    GvcpStatus.PACKET_AND_PREV_REMOVED_FROM_MEMORY,
}


class Resend(NamedTuple):
    """A request to send again the packets ``first`` to ``last`` of a block."""

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
        datagram: bytes of a full packet with its GVSP header, without IP and UDP.
        resend: whether missing packets are requested from the camera.
        begins_low: whether the ids begin at 1, so that blocks before the first received block count
            as lost; otherwise they belong to an earlier stream.
        implied: picture size for leaders without a size; None: such leaders are an error.
    """

    def __init__(
        self,
        payload_size: int,
        datagram: int,
        *,
        resend: bool = True,
        begins_low: bool = True,
        implied: ImpliedPicture | None = None,
    ) -> None:
        self.counts = PacketCounts()
        self.fault: MessageError | None = None
        """Error of unreadable blocks, such as a payload type that is no picture."""
        self._most, self._datagram, self._resend = payload_size, datagram, resend
        self._implied = implied
        self._blocks: dict[int, Block] = {}
        self._current: Block | None = None  # block of the last packet
        self._newest = self._closed = 0
        self._offset = 0  # difference between a block's number and its id
        self._begun, self._begins_low = False, begins_low
        self._ticks = 0
        self._accepted = -math.inf
        self._pictures: list[WholePicture] = []
        self._untold = 0

    def feed(self, data: memoryview, size: int, now: float, arrived: float) -> None:
        """Process the packet in the first ``size`` bytes of ``data``, which are copied.

        Args:
            data: buffer of at least ``size`` bytes.
            size: size of the packet.
            now: present time, seconds, on the clock of the deadlines.
            arrived: time of arrival; the first packet's becomes the picture's.
        """
        current = self._current
        if current is not None and size == self._datagram:
            status, block_id, word = _SHORT.unpack_from(data)
            if (
                word == current.expected
                and block_id == current.block_id
                and status == 0
                and current.take_next(word & PACKET_ID_BITS, data[HEADER_BYTES:size], now)
            ):
                self._accepted = now
                return
        header = decode_header(data, size)
        if header is None or not header.block:
            self.counts.malformed += 1
            return
        block = self._block_of(header, data, size, now)
        if block is not None:
            if block.arrived is None:
                block.arrived = arrived
            self._put(block, header, data[header.size : size], now)

    def pictures(self) -> list[WholePicture]:
        """Return new complete pictures in order."""
        done, self._pictures = self._pictures, []
        return done

    @property
    def untold(self) -> int:
        """Number of lost frames that no picture has counted yet."""
        return self._untold

    def take_lost(self) -> int:
        """Return the number of lost frames that no picture has counted, and reset it."""
        lost, self._untold = self._untold, 0
        return lost

    def next_deadline(self) -> float | None:
        """Return the time at which to call :meth:`handle_timeout`; None: after the next packet."""
        return min(map(self._deadline, self._open_blocks()), default=None)

    def handle_timeout(self, now: float) -> list[Resend]:
        """Drop overdue packets; return the requests to send."""
        wanted: list[Resend] = []
        for block in self._open_blocks():
            if self._deadline(block) <= now:
                self._overdue(block, now, wanted)
        self._settle()
        self.counts.requested += sum(span.last - span.first + 1 for span in wanted)
        return wanted

    def _open_blocks(self) -> list[Block]:
        return [block for block in self._blocks.values() if not (block.complete or block.dead)]

    def _deadline(self, block: Block) -> float:
        if block.missing_since < math.inf:
            return max(block.missing_since + REORDER_GRACE, block.requested_at + RESEND_INTERVAL)
        if block.highest or block.trailer is not None:
            return block.progress + SILENCE_TIMEOUT
        return block.progress + LEADER_TIMEOUT

    def _overdue(self, block: Block, now: float, wanted: list[Resend]) -> None:
        if block.missing_since == math.inf:
            block.missing_since = now - REORDER_GRACE
            block.over = True
            if not block.highest and block.trailer is None:
                block.dead = True
                return
        holes = block.holes(MAX_GAPS_PER_BLOCK + 1)
        if not holes:  # no gaps: only the rest of the block is missing
            block.missing_since = math.inf
            return
        if not self._resend:
            block.dead = block.progress + SILENCE_TIMEOUT <= now
            block.missing_since = block.progress + SILENCE_TIMEOUT
            return
        missing = sum(last - first + 1 for first, last in holes)
        too_many = (
            missing > max(MAX_MISSING_PACKETS, block.packets // 4)
            or len(holes) > MAX_GAPS_PER_BLOCK
        )
        if block.tries >= MAX_REQUESTS or too_many:
            block.dead = True
            return
        past = block.over or block.trailer is not None or block.progress + SILENCE_TIMEOUT <= now
        # while other packets come, the next request is delayed
        block.tries += past
        block.requested_at = now
        wanted += [Resend(block.block_id, *hole, block.extended) for hole in holes]

    # packets

    def _block_of(
        self, header: PacketHeader, data: memoryview, size: int, now: float
    ) -> Block | None:
        """Return the block of a packet; None: the block is finished."""
        extended = header.size != HEADER_BYTES
        if not self._begun:
            self._begun = True
            if (
                not self._begins_low or header.block > MAX_OPEN_BLOCKS
            ):  # otherwise blocks before were lost, or come later
                self._newest = self._closed = header.block - 1
        number = self._number(header.block, extended)
        ahead = number - self._newest
        if header.kind == PacketKind.LEADER and self._restarted(
            number, bytes(data[header.size : size])
        ):
            number = self._restart(header.block)
        elif ahead > MAX_OPEN_BLOCKS + MAX_FRAME_RATE * min(now - self._accepted, 1e6):
            if header.kind != PacketKind.LEADER:
                self.counts.late += 1
                return None
            number = self._restart(header.block)
        elif number <= self._closed:
            if header.kind != PacketKind.LEADER or now - self._accepted < RESTART_TIMEOUT:
                self.counts.late += 1
                return None
            number = self._restart(header.block)
        self._accepted = now
        block = self._blocks.get(number)
        if block is None:
            block = self._open(number, extended, now)
        if block.extended != extended:
            self.counts.malformed += 1
            return None
        self._current = block
        return block

    def _number(self, block_id: int, extended: bool) -> int:
        """Return a block's number: its id with wraps counted."""
        if extended:
            return block_id + self._offset
        ahead = (block_id + self._offset - self._newest) % MAX_SHORT_ID
        if ahead > MAX_SHORT_ID // 2:
            ahead -= MAX_SHORT_ID
        return self._newest + ahead

    def _restarted(self, number: int, leader: bytes) -> bool:
        """Return True if a leader shows that the camera restarted its block ids."""
        if len(leader) < 12:
            return False
        ticks = int.from_bytes(leader[4:12], "big")
        if number <= self._closed:
            return bool(self._ticks) and ticks > self._ticks
        block = self._blocks.get(number)
        return block is not None and block.leader is not None and block.leader.ticks != ticks

    def _restart(self, block_id: int) -> int:
        """Restart the count, and return the block's number; open blocks are lost."""
        self.counts.restarts += 1
        self._lose(self._newest - self._closed)
        self._blocks.clear()
        self._current = None
        self._closed = self._newest
        self._ticks = 0
        self._offset = self._newest if block_id <= MAX_OPEN_BLOCKS else self._newest + 1 - block_id
        return block_id + self._offset

    def _open(self, number: int, extended: bool, now: float) -> Block:
        """Open a block, and earlier blocks of which no packet came."""
        for opened in self._blocks.values():
            if opened.number < number and not opened.over:
                opened.over = True
                opened.missing_since = min(opened.missing_since, now)
        for missing in range(max(self._newest + 1, number - MAX_OPEN_BLOCKS + 1), number):
            self._make(missing, extended, now).over = True
            self._blocks[missing].missing_since = now
        block = self._blocks.get(number) or self._make(number, extended, now)
        self._newest = max(self._newest, number)
        self._settle()
        return block

    def _make(self, number: int, extended: bool, now: float) -> Block:
        block_id = number - self._offset
        if not extended:
            block_id = (block_id - 1) % MAX_SHORT_ID + 1
        block = Block(
            number,
            block_id,
            extended=extended,
            datagram=self._datagram,
            most=self._most,
            now=now,
            implied=self._implied,
        )
        self._blocks[number] = block
        return block

    def _put(self, block: Block, header: PacketHeader, payload: memoryview, now: float) -> None:
        """Store a packet in its block."""
        packet = header.packet
        if block.dead or block.complete:
            self.counts.late += 1
            return
        if header.status >= 0x8000:
            self.counts.refused += 1
            if header.status in _GONE:
                block.dead = True
                self._settle()
            return
        if packet < len(block.received) and block.received[packet]:
            self.counts.doubled += 1
            return
        if not self._fits(block, header, payload):
            self.counts.malformed += 1
            return
        block.progress = now
        if packet > block.highest + 1 and block.missing_since == math.inf:
            block.missing_since = now
        block.highest = max(block.highest, packet)
        block.mark(packet)
        if block.complete:
            self._settle()

    def _fits(self, block: Block, header: PacketHeader, payload: memoryview) -> bool:
        try:
            if header.kind == PacketKind.PAYLOAD:
                return block.take_payload(header.packet, payload)
            if header.kind == PacketKind.LEADER and header.packet == 0:
                block.take_leader(bytes(payload))
                if block.leader is not None:
                    self._ticks = max(self._ticks, block.leader.ticks)
                return True
            if header.kind == PacketKind.TRAILER:
                return block.take_trailer(header.packet, bytes(payload))
        except MessageError as exc:
            self.fault = self.fault or exc
        return False

    # blocks

    def _settle(self) -> None:
        """Close finished blocks, from the oldest on."""
        while self._closed < self._newest:
            number = self._closed + 1
            head = self._blocks.get(number)
            if head is None:
                number = min(self._blocks) if self._blocks else self._newest + 1
                self._lose(number - 1 - self._closed)
                self._closed = number - 1
                continue
            if not head.complete and not head.dead and len(self._blocks) <= MAX_OPEN_BLOCKS:
                return
            picture = head.picture(self._untold) if head.complete else None
            if picture is None:
                self._lose(1)
            else:
                self.counts.pictures += 1
                self._untold = 0
                self._pictures.append(picture)
            del self._blocks[number]
            self._closed = number

    def _lose(self, count: int) -> None:
        self.counts.lost += count
        self._untold += count
