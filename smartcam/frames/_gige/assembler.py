"""Assemble packets of a stream into frames, each of which is complete or counted as lost.

There is no socket and no clock here: packets go in with their time; pictures come out in the order
of their blocks, together with the packets that the camera should send again. At most
:data:`MAX_OPEN_BLOCKS` blocks are kept.

A block whose packets are missing waits for them while the camera is asked, and blocks behind it
wait for it. It is lost when the camera says that it no longer has them, when it has not sent them
after :data:`MAX_REQUESTS` requests, or when too many are missing to ask for.

The camera's clock distinguishes ids that begin anew from late packets: the time of a late leader is
before that of the newest block, that of a new one after it. Without a clock, a second of silence
means that the ids begin anew.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam.exceptions import MessageError
from smartcam.frames._gige.block import PACKET, Block
from smartcam.frames._gige.gvcp import GvcpStatus
from smartcam.frames._gige.gvsp import HEADER, PacketKind, decode_header

if TYPE_CHECKING:
    from smartcam.frames._gige.block import WholePicture
    from smartcam.frames._gige.gvsp import ImpliedPicture, PacketHeader

MAX_OPEN_BLOCKS: Final = 4
"""At most this many blocks wait for packets or for an earlier block: at 100 frames/s that is 40
ms."""

REORDER_GRACE: Final = 0.003
"""Seconds that a packet may come after its successors before it is requested."""

SILENCE_TIMEOUT: Final = 0.05
"""Seconds without a packet in the middle of a block after which the rest counts as missing."""

RESEND_INTERVAL: Final = 0.03
"""Seconds until missing packets are requested again."""

MAX_REQUESTS: Final = 4
"""The packets of one block are requested at most this many times."""

MAX_MISSING_PACKETS: Final = 64
"""Up to this many missing packets of a block are always requested; more only if they are less than
a quarter."""

MAX_GAPS_PER_BLOCK: Final = 1000
"""A block with more gaps than this is lost, since each gap takes a request of its own."""

LEADER_TIMEOUT: Final = 10.0
"""Seconds that a leader waits for its pixels: some cameras send it before a long exposure."""

RESTART_TIMEOUT: Final = 1.0
"""Seconds without a useful packet after which a leader with an old id begins a new count."""

FASTEST: Final = 2000.0
"""Highest plausible frame rate, frames per second: ids that advance faster show a new count, and no
gap."""

SHORT_IDS: Final = 65535
"""Block ids of 16 bits: 1 to 65535."""

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
    """Counts of packets and frames by what happened to them.

    Attributes:
        pictures: complete pictures.
        lost: frames that are lost, since packets are missing.
        late: packets of blocks that were already finished.
        doubled: packets that came a second time.
        malformed: datagrams that are no packets, or packets that do not fit their block.
        refused: packets that the camera sent as an error code only.
        requested: packets that were requested again.
        restarts: times that the ids began anew.
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
        begins_low: whether blocks before the first one, if its id is low, count as lost; otherwise
            they belong to an earlier stream, and must not be requested.
        implied: picture of blocks that do not say its size; None: such blocks are an error.
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
        """Error for blocks that cannot be read at all, such as a payload type that is no
        picture."""
        self._most, self._datagram, self._resend = payload_size, datagram, resend
        self._implied = implied
        self._blocks: dict[int, Block] = {}
        self._current: Block | None = None  # block of the last packet
        self._newest = self._closed = 0
        self._offset = 0  # a number's distance from its id
        self._begun, self._begins_low = False, begins_low
        self._ticks = 0
        self._accepted = -math.inf
        self._pictures: list[WholePicture] = []
        self._untold = 0

    def feed(self, data: memoryview, size: int, now: float, arrived: float) -> None:
        """Take the packet in the first ``size`` bytes of ``data``; they are copied.

        Args:
            data: buffer of at least ``size`` bytes.
            size: size of the packet.
            now: present time, seconds, on the clock of the deadlines.
            arrived: time of arrival; that of its first packet becomes the picture's.
        """
        current = self._current
        if current is not None and size == self._datagram:
            status, block_id, word = _SHORT.unpack_from(data)
            if (
                word == current.expected
                and block_id == current.block_id
                and status == 0
                and current.take_next(word & PACKET, data[HEADER:size], now)
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
        """Return the pictures that are complete, in order, each once."""
        done, self._pictures = self._pictures, []
        return done

    @property
    def untold(self) -> int:
        """Lost frames that no picture has counted yet."""
        return self._untold

    def take_lost(self) -> int:
        """Return the number of lost frames that no picture has counted, and forget it."""
        lost, self._untold = self._untold, 0
        return lost

    def next_deadline(self) -> float | None:
        """Return the time to call :meth:`handle_timeout`; None: only after a new packet."""
        return min(map(self._deadline, self._open_blocks()), default=None)

    def handle_timeout(self, now: float) -> list[Resend]:
        """Give up packets that will not come any more; return the requests to send."""
        wanted: list[Resend] = []
        for block in self._open_blocks():
            if self._deadline(block) <= now:
                self._overdue(block, now, wanted)
        self._settle()
        self.counts.requested += sum(one.last - one.first + 1 for one in wanted)
        return wanted

    def _open_blocks(self) -> list[Block]:
        return [one for one in self._blocks.values() if not (one.complete or one.dead)]

    def _deadline(self, block: Block) -> float:
        if block.evident < math.inf:
            return max(block.evident + REORDER_GRACE, block.asked + RESEND_INTERVAL)
        if block.highest or block.trailer is not None:
            return block.progress + SILENCE_TIMEOUT
        return block.progress + LEADER_TIMEOUT

    def _overdue(self, block: Block, now: float, wanted: list[Resend]) -> None:
        if block.evident == math.inf:
            block.evident = now - REORDER_GRACE
            block.over = True
            if not block.highest and block.trailer is None:
                block.dead = True
                return
        holes = block.holes(MAX_GAPS_PER_BLOCK + 1)
        if not holes:  # the missing packets came; the rest of the block is still to come
            block.evident = math.inf
            return
        if not self._resend:
            block.dead = block.progress + SILENCE_TIMEOUT <= now
            block.evident = block.progress + SILENCE_TIMEOUT
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
        # packets that are requested while others come are requested again later
        block.tries += past
        block.asked = now
        wanted += [Resend(block.block_id, *hole, block.extended) for hole in holes]

    # packets

    def _block_of(
        self, header: PacketHeader, data: memoryview, size: int, now: float
    ) -> Block | None:
        """Return the block that a packet belongs to; None: its block is finished."""
        extended = header.size != HEADER
        if not self._begun:
            self._begun = True
            if (
                not self._begins_low or header.block > MAX_OPEN_BLOCKS
            ):  # otherwise the blocks before it were lost, or come later
                self._newest = self._closed = header.block - 1
        number = self._number(header.block, extended)
        ahead = number - self._newest
        if header.kind == PacketKind.LEADER and self._restarted(
            number, bytes(data[header.size : size])
        ):
            number = self._restart(header.block)
        elif ahead > MAX_OPEN_BLOCKS + FASTEST * min(now - self._accepted, 1e6):
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
        """Return a block's number: its id, counted on past the wrap."""
        if extended:
            return block_id + self._offset
        ahead = (block_id + self._offset - self._newest) % SHORT_IDS
        if ahead > SHORT_IDS // 2:
            ahead -= SHORT_IDS
        return self._newest + ahead

    def _restarted(self, number: int, leader: bytes) -> bool:
        """Return True if a leader shows that the camera began to count its blocks anew."""
        if len(leader) < 12:
            return False
        ticks = int.from_bytes(leader[4:12], "big")
        if number <= self._closed:
            return bool(self._ticks) and ticks > self._ticks
        block = self._blocks.get(number)
        return block is not None and block.leader is not None and block.leader.ticks != ticks

    def _restart(self, block_id: int) -> int:
        """Begin to count anew, and return the block's number; open blocks are lost."""
        self.counts.restarts += 1
        self._lose(self._newest - self._closed)
        self._blocks.clear()
        self._current = None
        self._closed = self._newest
        self._ticks = 0
        self._offset = self._newest if block_id <= MAX_OPEN_BLOCKS else self._newest + 1 - block_id
        return block_id + self._offset

    def _open(self, number: int, extended: bool, now: float) -> Block:
        """Open a block, and those before it of which no packet came yet."""
        for one in self._blocks.values():
            if one.number < number and not one.over:
                one.over = True
                one.evident = min(one.evident, now)
        for missing in range(max(self._newest + 1, number - MAX_OPEN_BLOCKS + 1), number):
            self._make(missing, extended, now).over = True
            self._blocks[missing].evident = now
        block = self._blocks.get(number) or self._make(number, extended, now)
        self._newest = max(self._newest, number)
        self._settle()
        return block

    def _make(self, number: int, extended: bool, now: float) -> Block:
        block_id = number - self._offset
        if not extended:
            block_id = (block_id - 1) % SHORT_IDS + 1
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
        """Put a packet into its block."""
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
        if packet < len(block.seen) and block.seen[packet]:
            self.counts.doubled += 1
            return
        if not self._fits(block, header, payload):
            self.counts.malformed += 1
            return
        block.progress = now
        if packet > block.highest + 1 and block.evident == math.inf:
            block.evident = now
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
