"""Assemble the packets of one stream into encoded frames in order, without duplicates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from smartcam.frames._streaming.rtp.assembling import AccessUnit
from smartcam.frames._streaming.rtp.h264 import H264PayloadFormat

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.frames._streaming.rtp.assembling import OpenUnit, PayloadFormat
    from smartcam.frames._streaming.rtp.packets import RtpPacket


MAX_WAITING_PACKETS: Final = 64
"""Largest number of packets that wait for a missing earlier packet."""

MAX_PACKETS_AHEAD, MAX_PACKETS_LATE = 3000, 500
"""Largest distance of a packet's sequence number from the expected one, forwards and backwards. Two
consecutive numbers that are farther away show a restarted stream."""

MIN_CORRECT_MARKERS: Final = 2
"""Number of frames with a correct marker after which markers are trusted."""


class Depacketizer:
    """Assemble complete encoded frames from one stream's packets, in order, without duplicates.

    Packets may come late, twice, or never. A missing packet is awaited until ``window`` packets
    have come after it, or until the caller drops it by :meth:`give_up`. Another SSRC is a new
    stream.

    A frame ends with the packet that has the marker. Some senders mark each slice or unit: with
    ``verify_markers``, a marker ends a frame only after :data:`MIN_CORRECT_MARKERS` frames with
    correct markers, or if the caller calls :meth:`end_marked`. After a wrong marker, frames end at
    the next timestamp. Parameters without a picture always belong to the next frame.

    Args:
        window: largest number of packets that wait for a missing one.
        payload_format: format of the payloads; None: H.264.
        verify_markers: whether markers are trusted only after frames with correct markers.

    Attributes:
        lost: number of lost packets.
        duplicates: packets that came more than once, or too late.
        damaged: number of incomplete frames.
        streams: number of streams so far.
        correct_markers: number of frames whose marker was correct; :data:`MIN_CORRECT_MARKERS` are
            enough to trust markers.
    """

    def __init__(
        self,
        window: int = MAX_WAITING_PACKETS,
        payload_format: PayloadFormat | None = None,
        *,
        verify_markers: bool = False,
    ) -> None:
        self._window, self._payload_format = window, payload_format or H264PayloadFormat()
        self._verify_markers = verify_markers
        self.correct_markers = 0 if verify_markers else MIN_CORRECT_MARKERS
        self.lost = self.duplicates = self.damaged = self.streams = 0
        self._ssrc: int | None = None
        self._reported = (0, 0)  # lost and damaged when the last unit was returned
        self._reset_stream()

    def _reset_stream(self) -> None:
        self._next: int | None = None  # next expected sequence number with wraps counted
        self._held: dict[int, tuple[RtpPacket, float]] = {}
        self._open: OpenUnit | None = None
        self._unbroken = False  # whether no packet is missing right before the next one
        self._last_timestamp: int | None = None  # timestamp of the last ended frame
        self._is_stream_start = True  # whether the stream has had no complete frame yet
        self._after_jump: int | None = None  # sequence number that would confirm a restarted stream
        # time of the open frame's untrusted marker
        self._marked_at: float | None = None
        self._last_had_marker = False  # whether the last ended frame had a marker
        self._markers_are_wrong = False
        self._parameters: OpenUnit | None = None  # parameters without a picture

    def add_packet(self, packet: RtpPacket, now: float = 0.0) -> list[AccessUnit]:
        """Add a packet, and return the frames that it completes.

        Args:
            packet: packet of the stream.
            now: time of the packet's arrival.
        """
        if packet.ssrc != self._ssrc:
            self._drop_open_frame()
            if self._verify_markers and self._ssrc is not None:
                self.correct_markers = 0
            self._ssrc = packet.ssrc
            self.streams += 1
            self._reset_stream()
        sequence = self._unwrapped_sequence(packet.sequence)
        if sequence is None:
            self.duplicates += 1
            return []
        self._held[sequence] = (packet, now)
        return self._process_held(skip_missing=len(self._held) > self._window)

    def missing_sequences(self) -> list[int]:
        """Return the sequence numbers of missing packets."""
        if not self._held or self._next is None:
            return []
        numbers = range(self._next, max(self._held))
        missing = (number for number in numbers if number not in self._held)
        return [number & 0xFFFF for number in missing]

    def next_of_open_frame(self) -> int | None:
        """Return the sequence number of the open frame's next packet.

        None: no frame is open, or earlier packets are missing.
        """
        if self._open is None or not self._open.is_intact or self._held or self._next is None:
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
        return list(self._end_frame()) if marked is not None and marked < before else []

    def waiting_since(self) -> float | None:
        """Return the arrival time of the first packet that waits for a missing one.

        None: no packet waits.
        """
        return min((now for _, now in self._held.values()), default=None)

    def give_up(self, before: float) -> list[AccessUnit]:
        """Stop waiting for packets that are missing since before a moment.

        Returns:
            The frames that are complete then.
        """
        completed: list[AccessUnit] = []
        while (since := self.waiting_since()) is not None and since < before:
            completed += self._process_held(skip_missing=True)
        return completed

    def _unwrapped_sequence(self, sequence: int) -> int | None:
        """Return a sequence number with wraps counted; None for a duplicate or late packet."""
        if self._next is None:
            self._next = sequence
        distance = (sequence - self._next + 0x8000 & 0xFFFF) - 0x8000
        if not -MAX_PACKETS_LATE <= distance <= MAX_PACKETS_AHEAD:
            if sequence != self._after_jump:
                self._after_jump = sequence + 1 & 0xFFFF
                return None
            self._drop_open_frame()
            self._reset_stream()
            self.streams += 1
            self._next, distance = sequence, 0
        self._after_jump = None
        unwrapped = self._next + distance
        return None if distance < 0 or unwrapped in self._held else unwrapped

    def _process_held(self, *, skip_missing: bool) -> list[AccessUnit]:
        """Process the packets before the first missing one, and return the completed frames.

        Args:
            skip_missing: whether to give up the packets that are missing now, and continue up to
                the next missing one.
        """
        completed: list[AccessUnit] = []
        while self._held and self._next is not None:
            if self._next not in self._held:
                if not skip_missing:
                    break
                first = min(self._held)
                self.lost += first - self._next
                self._mark_gap()
                self._next = first
            skip_missing = False
            completed += self._add_next(*self._held.pop(self._next))
            self._next += 1
        return completed

    def _mark_gap(self) -> None:
        if self._open is not None:
            self._open.is_intact = False
        self._unbroken, self._parameters = False, None

    def _add_next(self, packet: RtpPacket, now: float) -> Iterator[AccessUnit]:
        if self._open is not None and self._open.timestamp != packet.timestamp:
            yield from self._end_frame()
        elif self._open is not None and self._marked_at is not None and packet.payload:
            self._markers_are_wrong, self._marked_at, self.correct_markers = True, None, 0
        if self._open is None:
            self._open = self._new_open_unit(packet, now)
        self._open.add(packet.payload)
        self._unbroken = True
        can_end = self._open.has_picture or not self._open.parts
        if packet.marker and can_end and not self._markers_are_wrong:
            self._marked_at = now
            if self.correct_markers >= MIN_CORRECT_MARKERS:
                yield from self._end_frame()

    def _new_open_unit(self, packet: RtpPacket, now: float) -> OpenUnit:
        ended_early = packet.timestamp == self._last_timestamp
        self.correct_markers += self._last_had_marker and self._unbroken and not ended_early
        if ended_early and self._unbroken and packet.payload:
            self._markers_are_wrong, self.correct_markers = True, 0
        starts_here = self._unbroken or self._payload_format.certainly_starts_frame(packet.payload)
        has_first_packet = starts_here and not ended_early
        opened = self._payload_format.new_unit(packet.timestamp, has_first_packet, now)
        parameters, self._parameters = self._parameters, None
        if parameters is not None and self._unbroken:
            opened.parts, opened.size = parameters.parts, parameters.size
            opened.arrived_at = parameters.arrived_at
        return opened

    def _end_frame(self) -> Iterator[AccessUnit]:
        ended, self._open = self._open, None
        self._last_had_marker, self._marked_at = self._marked_at is not None, None
        if ended is None:
            return
        if ended.is_complete() and not ended.has_picture:
            self._parameters = ended
            return
        self._last_timestamp = ended.timestamp
        if not ended.is_complete():
            self.damaged += 1
            return
        lost, damaged = self._reported
        self._reported = (self.lost, self.damaged)
        starts_stream, self._is_stream_start = self._is_stream_start, False
        yield AccessUnit(
            ended.data(),
            ended.timestamp,
            self.lost - lost,
            self.damaged - damaged,
            ended.arrived_at,
            starts_stream,
        )

    def _drop_open_frame(self) -> None:
        if self._open is not None:
            self._open = None
            self.damaged += 1
