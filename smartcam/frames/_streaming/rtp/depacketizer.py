"""Assemble the packets of one stream into encoded frames in order, without duplicates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from smartcam.frames._streaming.rtp.assembling import AccessUnit
from smartcam.frames._streaming.rtp.h264 import H264Units

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.frames._streaming.rtp.assembling import OpenUnit, UnitKind
    from smartcam.frames._streaming.rtp.packets import RtpPacket


MAX_WAITING_PACKETS: Final = 64
"""Largest number of packets that wait for a missing earlier packet."""

MAX_PACKETS_AHEAD, MAX_PACKETS_LATE = 3000, 500
"""Largest distance of a sequence number ahead or late; two consecutive numbers beyond it show a
restarted stream."""

MARKER_PROOFS: Final = 2
"""Number of frames with a right marker, after which markers are trusted."""


class Depacketizer:
    """Assemble complete encoded frames from one stream's packets, in order, without duplicates.

    Packets may come late, twice, or never. A missing packet is awaited until ``window`` packets
    have come after it, or until the caller drops it by :meth:`give_up`. Another SSRC is a new
    stream.

    A frame ends with the packet that has the marker. Some senders mark each slice or unit: with
    ``wary``, markers are trusted only after :data:`MARKER_PROOFS` frames with right markers, or by
    :meth:`end_marked`; after a wrong marker, frames end at the next timestamp. Parameters without a
    picture always belong to the next frame.

    Args:
        window: largest number of packets after a missing one.
        kind: kind of the payloads.
        wary: whether markers are trusted only after proofs.

    Attributes:
        lost: number of lost packets.
        duplicates: packets that came more than once, or too late.
        damaged: number of incomplete frames.
        streams: number of streams so far.
        proofs: number of frames whose marker was right; :data:`MARKER_PROOFS` are enough.
    """

    def __init__(
        self, window: int = MAX_WAITING_PACKETS, kind: UnitKind | None = None, *, wary: bool = False
    ) -> None:
        self._window, self._kind = window, kind or H264Units()
        self._wary = wary
        self.proofs = 0 if wary else MARKER_PROOFS
        self.lost = self.duplicates = self.damaged = self.streams = 0
        self._ssrc: int | None = None
        self._reported = (0, 0)  # lost and damaged when the last unit was returned
        self._begin()

    def _begin(self) -> None:
        self._next: int | None = None  # next expected sequence number with wraps counted
        self._held: dict[int, tuple[RtpPacket, float]] = {}
        self._open: OpenUnit | None = None
        self._unbroken = False  # whether no packet is missing before the next one
        self._closed: int | None = None  # timestamp of the last ended frame
        self._begins = True  # whether the stream has had no complete frame yet
        self._after_jump: int | None = None  # sequence number that would confirm a restarted stream
        # time of the open frame's untrusted marker
        self._marked_at: float | None = None
        self._marked = False  # whether the last ended frame had a marker
        self._marks_lie = False
        self._parameters: OpenUnit | None = None  # parameters without a picture

    def take(self, packet: RtpPacket, now: float = 0.0) -> list[AccessUnit]:
        """Add a packet, and return the frames that it completes.

        Args:
            packet: packet of the stream.
            now: time of the packet's arrival.
        """
        if packet.ssrc != self._ssrc:
            self._damage_open()
            if self._wary and self._ssrc is not None:
                self.proofs = 0
            self._ssrc = packet.ssrc
            self.streams += 1
            self._begin()
        place = self._place(packet.sequence)
        if place is None:
            self.duplicates += 1
            return []
        self._held[place] = (packet, now)
        return self._ready(len(self._held) > self._window)

    def missing(self) -> list[int]:
        """Return the sequence numbers of missing packets."""
        if not self._held or self._next is None:
            return []
        gone = (number for number in range(self._next, max(self._held)) if number not in self._held)
        return [number & 0xFFFF for number in gone]

    def tail(self) -> int | None:
        """Return the next sequence number of the open frame.

        None: no frame is open, or earlier packets are missing.
        """
        if self._open is None or not self._open.whole or self._held or self._next is None:
            return None
        if self._marked_at is not None:
            return None
        return self._next & 0xFFFF

    @property
    def marked_at(self) -> float | None:
        """Time of the open frame's untrusted marker; None: no such marker."""
        return None if self._held else self._marked_at

    def end_marked(self, before: float) -> list[AccessUnit]:
        """Return the open frame if its marker came before a moment and no packet followed."""
        marked = self.marked_at
        return list(self._end()) if marked is not None and marked < before else []

    def waits_since(self) -> float | None:
        """Return the arrival of the first packet that waits for a missing one; None: none waits."""
        return min((now for _, now in self._held.values()), default=None)

    def give_up(self, before: float) -> list[AccessUnit]:
        """Stop waiting for packets missing since before a moment; return the complete frames."""
        made: list[AccessUnit] = []
        while (since := self.waits_since()) is not None and since < before:
            made += self._ready(True)
        return made

    def _place(self, sequence: int) -> int | None:
        """Return a packet's number with wraps counted; None for a duplicate or late packet."""
        if self._next is None:
            self._next = sequence
        distance = (sequence - self._next + 0x8000 & 0xFFFF) - 0x8000
        if not -MAX_PACKETS_LATE <= distance <= MAX_PACKETS_AHEAD:
            if sequence != self._after_jump:
                self._after_jump = sequence + 1 & 0xFFFF
                return None
            self._damage_open()
            self._begin()
            self.streams += 1
            self._next, distance = sequence, 0
        self._after_jump = None
        place = self._next + distance
        return None if distance < 0 or place in self._held else place

    def _ready(self, at_once: bool) -> list[AccessUnit]:
        """Return the frames of the packets before the first missing one."""
        made: list[AccessUnit] = []
        while self._held and self._next is not None:
            if self._next not in self._held:
                if not at_once:
                    break
                first = min(self._held)
                self.lost += first - self._next
                self._gap()
                self._next = first
            at_once = False
            made += self._follow(*self._held.pop(self._next))
            self._next += 1
        return made

    def _gap(self) -> None:
        if self._open is not None:
            self._open.whole = False
        self._unbroken, self._parameters = False, None

    def _follow(self, packet: RtpPacket, now: float) -> Iterator[AccessUnit]:
        if self._open is not None and self._open.timestamp != packet.timestamp:
            yield from self._end()
        elif self._open is not None and self._marked_at is not None and packet.payload:
            self._marks_lie, self._marked_at, self.proofs = True, None, 0
        if self._open is None:
            self._open = self._opened(packet, now)
        self._open.add(packet.payload)
        self._unbroken = True
        over = self._open.has_picture or not self._open.parts
        if packet.marker and over and not self._marks_lie:
            self._marked_at = now
            if self.proofs >= MARKER_PROOFS:
                yield from self._end()

    def _opened(self, packet: RtpPacket, now: float) -> OpenUnit:
        again = packet.timestamp == self._closed  # the frame had not ended
        self.proofs += self._marked and self._unbroken and not again
        if again and self._unbroken and packet.payload:
            self._marks_lie, self.proofs = True, 0
        unbroken = (self._unbroken or self._kind.begins(packet.payload)) and not again
        opened = self._kind.new_unit(packet.timestamp, unbroken, now)
        before, self._parameters = self._parameters, None
        if before is not None and self._unbroken:
            opened.parts, opened.size, opened.arrived = before.parts, before.size, before.arrived
        return opened

    def _end(self) -> Iterator[AccessUnit]:
        ended, self._open = self._open, None
        self._marked, self._marked_at = self._marked_at is not None, None
        if ended is None:
            return
        if ended.ended() and not ended.has_picture:
            self._parameters = ended
            return
        self._closed = ended.timestamp
        if not ended.ended():
            self.damaged += 1
            return
        lost, damaged = self._reported
        self._reported = (self.lost, self.damaged)
        since, begins, self._begins = (
            (self.lost - lost, self.damaged - damaged),
            self._begins,
            False,
        )
        yield AccessUnit(ended.data(), ended.timestamp, *since, ended.arrived, begins)

    def _damage_open(self) -> None:
        if self._open is not None:
            self._open = None
            self.damaged += 1
