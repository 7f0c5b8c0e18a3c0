"""H.264 in RTP packets and back (RFC 6184, packetization mode 1)."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import ConfigurationError, FrameFormatError
from smartcam.frames._rtp.assembling import END, FU_A, STAP_A, START, AccessUnit, OpenUnit
from smartcam.frames._rtp.packets import RtpPacket

if TYPE_CHECKING:
    from collections.abc import Iterator


MTU_PAYLOAD: Final = 1380
"""Bytes of a packet behind its 12: with UDP, IP and a tunnel they fit into Ethernet's 1500."""

SLICES, SPS, PPS, DELIMITER = range(1, 6), 7, 8, 9
"""Kinds of units (ITU-T H.264, table 7-1)."""

WINDOW: Final = 64
"""Packets that wait for one that is missing before it."""

MOST_AHEAD, MOST_BEHIND = 3000, 500
"""Packets: a sequence number further off is a stream that began anew, if a second one follows."""


def units(access_unit: bytes) -> list[bytes]:
    """Return the units of an encoded frame, without start codes.

    Args:
        access_unit: as in a file (ITU-T H.264, annex B).

    Raises:
        FrameFormatError: it begins with none, or has one that cannot be.
    """
    data = bytes(access_unit)
    place = data.find(b"\0\0\1")
    if place < 0 or data[:place].strip(b"\0"):
        raise _wrong("a start code first", data)
    found = []
    while place >= 0:
        after = data.find(b"\0\0\1", place + 3)
        unit = data[place + 3 : after if after >= 0 else len(data)].rstrip(b"\0")
        if not unit or unit[0] & 0x80 or not 1 <= unit[0] & 0x1F < STAP_A:
            raise _wrong("units of kinds 1 to 23", unit)
        found.append(unit)
        place = after
    return found


def parameter_sets(access_unit: bytes) -> tuple[bytes, bytes] | None:
    """Return the sequence's and the picture's parameters; None where one of them is not in it.

    Raises:
        FrameFormatError: as :func:`units`.
    """
    by_kind = {unit[0] & 0x1F: unit for unit in units(access_unit)}
    if SPS not in by_kind or PPS not in by_kind:
        return None
    return by_kind[SPS], by_kind[PPS]


class H264Packetizer:
    """Makes the packets of one stream.

    Args:
        payload_type: 0 to 127; what has no number of its own takes 96 to 127.
        ssrc: of the stream; None: a random one.
        sequence: of the first packet; None: a random one.
        mtu_payload: bytes of a packet's payload.

    Attributes:
        packets_made: since the beginning.
        octets_made: of their payloads.

    Raises:
        ConfigurationError: a number out of its range.
    """

    def __init__(
        self,
        payload_type: int = 96,
        ssrc: int | None = None,
        sequence: int | None = None,
        mtu_payload: int = MTU_PAYLOAD,
    ) -> None:
        ssrc = secrets.randbits(32) if ssrc is None else ssrc
        sequence = secrets.randbits(16) if sequence is None else sequence
        for name, value, least, most in (
            ("payload_type", payload_type, 0, 127),
            ("ssrc", ssrc, 0, 0xFFFFFFFF),
            ("sequence", sequence, 0, 0xFFFF),
            ("mtu_payload", mtu_payload, 64, 65_000),
        ):
            if not least <= value <= most:
                raise ConfigurationError(f"RTP: {name}: expected {least} to {most}, got {value!r}")
        self.payload_type, self.ssrc, self._mtu = payload_type, ssrc, mtu_payload
        self._sequence = sequence
        self.packets_made = self.octets_made = 0

    @property
    def sequence(self) -> int:
        """The next packet's."""
        return self._sequence

    def packets(self, access_unit: bytes, timestamp: int) -> list[bytes]:
        """Return an encoded frame's packets; the last one has the marker.

        Args:
            access_unit: one encoded frame, as in a file (annex B).
            timestamp: of the frame, in ticks of 90 kHz; its lower 32 bits count.

        Raises:
            FrameFormatError: it is no encoded frame; no sequence number was used.
        """
        payloads = [
            part for group in self._groups(units(access_unit)) for part in self._payloads(group)
        ]
        made: list[bytes] = []
        for payload in payloads:
            last = len(made) == len(payloads) - 1
            head = (last, self.payload_type, self._sequence, timestamp & 0xFFFFFFFF, self.ssrc)
            made.append(RtpPacket(*head, payload).pack())
            self._sequence = self._sequence + 1 & 0xFFFF
        self.packets_made += len(made)
        self.octets_made += sum(map(len, payloads))
        return made

    def _groups(self, found: list[bytes]) -> Iterator[list[bytes]]:
        """Yield the units that go together: parameter sets and messages, as far as they fit."""
        group: list[bytes] = []
        for unit in found:
            fits = 1 + sum(2 + len(one) for one in (*group, unit)) <= self._mtu
            if group and (unit[0] & 0x1F in SLICES or not fits):
                yield group
                group = []
            group.append(unit)
            if unit[0] & 0x1F in SLICES:
                yield group
                group = []
        if group:
            yield group

    def _payloads(self, group: list[bytes]) -> Iterator[bytes]:
        first = group[0]
        if len(group) > 1:
            importance = max(unit[0] & 0x60 for unit in group)
            sized = (len(unit).to_bytes(2, "big") + unit for unit in group)
            yield bytes((importance | STAP_A,)) + b"".join(sized)
        elif len(first) <= self._mtu:
            yield first
        else:
            room = self._mtu - 2
            for at in range(1, len(first), room):
                start, end = START * (at == 1), END * (at + room >= len(first))
                second = start | end | first[0] & 0x1F
                yield bytes((first[0] & 0x60 | FU_A, second)) + first[at : at + room]


class H264Depacketizer:
    """Makes encoded frames of one stream's packets: whole ones, in order, each once.

    Packets may come late, twice, or not at all. One that is missing is waited for until ``window``
    packets came after it, or until it is told that it took too long: :meth:`give_up`.
    Another SSRC is a new stream.

    Args:
        window: packets.

    Attributes:
        lost: packets that never came.
        duplicates: packets that came more than once, or too late.
        damaged: frames that something was seen of, and that did not come whole.
        streams: how often a stream began.
    """

    def __init__(self, window: int = WINDOW) -> None:
        self._window = window
        self.lost = self.duplicates = self.damaged = self.streams = 0
        self._ssrc: int | None = None
        self._told = (0, 0)  # what of lost and damaged the last unit said
        self._begin()

    def _begin(self) -> None:
        self._next: int | None = None  # with the wraps counted
        self._held: dict[int, tuple[RtpPacket, float]] = {}
        self._open: OpenUnit | None = None
        self._sure = False  # that the next packet is the first one of a frame
        self._closed: int | None = None  # timestamp of the last frame that ended
        self._begins = True  # until a frame is whole
        self._odd: int | None = None  # what would follow a sequence number that was far off

    def take(self, packet: RtpPacket, now: float = 0.0) -> list[AccessUnit]:
        """Take a packet, and return the frames that are whole with it.

        Args:
            packet: of the stream.
            now: when it arrived.
        """
        if packet.ssrc != self._ssrc:
            self._damage_open()
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
        """Return the sequence numbers that are waited for."""
        if not self._held or self._next is None:
            return []
        gone = (one for one in range(self._next, max(self._held)) if one not in self._held)
        return [one & 0xFFFF for one in gone]

    def tail(self) -> int | None:
        """Return the sequence number that a frame goes on with whose end did not come yet.

        None: none is begun, or others are missing before that.
        """
        if self._open is None or not self._open.whole or self._held or self._next is None:
            return None
        return self._next & 0xFFFF

    def waits_since(self) -> float | None:
        """Return when the first packet came that waits for another; None: none does."""
        return min((now for _, now in self._held.values()), default=None)

    def give_up(self, before: float) -> list[AccessUnit]:
        """Return what is whole without those that packets wait for that came before a moment."""
        made: list[AccessUnit] = []
        while (since := self.waits_since()) is not None and since < before:
            made += self._ready(True)
        return made

    def _place(self, sequence: int) -> int | None:
        """Return a packet's number with the wraps counted; None: it came before, or too late."""
        if self._next is None:
            self._next = sequence
        off = (sequence - self._next + 0x8000 & 0xFFFF) - 0x8000
        if not -MOST_BEHIND <= off <= MOST_AHEAD:
            if sequence != self._odd:
                self._odd = sequence + 1 & 0xFFFF
                return None
            self._damage_open()
            self._begin()
            self.streams += 1
            self._next, off = sequence, 0
        self._odd = None
        place = self._next + off
        return None if off < 0 or place in self._held else place

    def _ready(self, at_once: bool) -> list[AccessUnit]:
        """Return the frames of the packets that nothing is missing before."""
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
        self._sure = False

    def _follow(self, packet: RtpPacket, now: float) -> Iterator[AccessUnit]:
        if self._open is not None and self._open.timestamp != packet.timestamp:
            yield from self._end()
        if self._open is None:
            sure = (self._sure or _begins(packet.payload)) and packet.timestamp != self._closed
            self._open = OpenUnit(packet.timestamp, sure, now)
        self._open.add(packet.payload)
        self._sure = True
        if packet.marker:
            yield from self._end()

    def _end(self) -> Iterator[AccessUnit]:
        ended, self._open = self._open, None
        if ended is None:
            return
        self._closed = ended.timestamp
        if not ended.ended():
            self.damaged += 1
            return
        lost, damaged = self._told
        self._told = (self.lost, self.damaged)
        since, begins, self._begins = (
            (self.lost - lost, self.damaged - damaged),
            self._begins,
            False,
        )
        yield AccessUnit(b"".join(ended.parts), ended.timestamp, *since, ended.arrived, begins)

    def _damage_open(self) -> None:
        if self._open is not None:
            self._open = None
            self.damaged += 1


def _begins(payload: bytes) -> bool:
    """Return whether a packet is surely a frame's first: it begins with what only stands there."""
    if len(payload) < 4:
        return bool(payload) and payload[0] & 0x1F == DELIMITER
    kind = payload[3] & 0x1F if payload[0] & 0x1F == STAP_A else payload[0] & 0x1F
    return kind in (SPS, DELIMITER)


def _wrong(expected: str, got: bytes) -> FrameFormatError:
    return FrameFormatError(
        f"H264: expected {expected} (annex B), got {len(got)} bytes that begin with "
        f"{got[:8].hex(' ') or 'nothing'}"
    )
