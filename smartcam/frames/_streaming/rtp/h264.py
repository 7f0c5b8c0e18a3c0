"""H.264 in RTP packets and back (RFC 6184, packetization mode 1)."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import ConfigurationError, FrameFormatError
from smartcam.frames._streaming.rtp.assembling import END, START, NalAccessUnit
from smartcam.frames._streaming.rtp.packets import RtpPacket

if TYPE_CHECKING:
    from collections.abc import Iterator


MTU_PAYLOAD: Final = 1380
"""Largest payload of a packet, bytes; with headers and a tunnel it fits into Ethernet's 1500."""

SLICES, KEY_SLICE, SPS, PPS, DELIMITER = range(1, 6), 5, 7, 8, 9
"""Types of NAL units (ITU-T H.264, table 7-1)."""

STAP_A, FU_A = 24, 28
"""Types of payloads: several units in a packet, and a fragment of a unit."""


def units(access_unit: bytes) -> list[bytes]:
    """Return the units of an encoded frame, without start codes.

    Args:
        access_unit: bytes as in a file (ITU-T H.264, annex B).

    Raises:
        FrameFormatError: the bytes do not begin with a start code, or a unit has an unknown type.
    """
    data = bytes(access_unit)
    start = data.find(b"\0\0\1")
    if start < 0 or data[:start].strip(b"\0"):
        raise _format_error("a start code first", data)
    nal_units = []
    while start >= 0:
        next_start = data.find(b"\0\0\1", start + 3)
        unit = data[start + 3 : next_start if next_start >= 0 else len(data)].rstrip(b"\0")
        if not unit or unit[0] & 0x80 or not 1 <= unit[0] & 0x1F < STAP_A:
            raise _format_error("units of kinds 1 to 23", unit)
        nal_units.append(unit)
        start = next_start
    return nal_units


def parameter_sets(access_unit: bytes) -> tuple[bytes, bytes] | None:
    """Return the sequence and picture parameter sets; None if one is missing.

    Raises:
        FrameFormatError: as :func:`units`.
    """
    by_kind = {unit[0] & 0x1F: unit for unit in units(access_unit)}
    if SPS not in by_kind or PPS not in by_kind:
        return None
    return by_kind[SPS], by_kind[PPS]


class H264Packetizer:
    """Make the packets of one stream.

    Args:
        payload_type: payload type, 0 to 127; formats without an assigned type, such as H.264, use
            96 to 127.
        ssrc: SSRC of the stream; None: a random one.
        sequence: number of the first packet; None: a random one.
        mtu_payload: largest payload of a packet, bytes.

    Attributes:
        packets_made: number of packets so far.
        octets_made: number of payload bytes so far.

    Raises:
        ConfigurationError: a number is out of range.
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
        for name, value, minimum, maximum in (
            ("payload_type", payload_type, 0, 127),
            ("ssrc", ssrc, 0, 0xFFFFFFFF),
            ("sequence", sequence, 0, 0xFFFF),
            ("mtu_payload", mtu_payload, 64, 65_000),
        ):
            if not minimum <= value <= maximum:
                expected = f"expected {minimum} to {maximum}, got {value!r}"
                raise ConfigurationError(f"RTP: {name}: {expected}")
        self.payload_type, self.ssrc, self._mtu = payload_type, ssrc, mtu_payload
        self._sequence = sequence
        self.packets_made = self.octets_made = 0

    @property
    def sequence(self) -> int:
        """Sequence number of the next packet."""
        return self._sequence

    def packets(self, access_unit: bytes, timestamp: int) -> list[bytes]:
        """Return an encoded frame's packets; the last one has the marker.

        Args:
            access_unit: one encoded frame, as in a file (annex B).
            timestamp: timestamp of the frame, ticks of 90 kHz; the lower 32 bits are used.

        Raises:
            FrameFormatError: the frame is not valid; no sequence number was used.
        """
        payloads = [
            part for group in self._groups(units(access_unit)) for part in self._payloads(group)
        ]
        packets: list[bytes] = []
        for payload in payloads:
            marker = len(packets) == len(payloads) - 1
            head = (marker, self.payload_type, self._sequence, timestamp & 0xFFFFFFFF, self.ssrc)
            packets.append(RtpPacket(*head, payload).pack())
            self._sequence = self._sequence + 1 & 0xFFFF
        self.packets_made += len(packets)
        self.octets_made += sum(map(len, payloads))
        return packets

    def _groups(self, nal_units: list[bytes]) -> Iterator[list[bytes]]:
        """Yield the units of each packet: a slice alone, other units together while they fit."""
        group: list[bytes] = []
        for unit in nal_units:
            fits = 1 + sum(2 + len(member) for member in (*group, unit)) <= self._mtu
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
            sized_units = (len(unit).to_bytes(2, "big") + unit for unit in group)
            yield bytes((importance | STAP_A,)) + b"".join(sized_units)
        elif len(first) <= self._mtu:
            yield first
        else:
            size = self._mtu - 2
            for offset in range(1, len(first), size):
                start_bit, end_bit = START * (offset == 1), END * (offset + size >= len(first))
                fragment_header = start_bit | end_bit | first[0] & 0x1F
                yield (
                    bytes((first[0] & 0x60 | FU_A, fragment_header)) + first[offset : offset + size]
                )


class H264AccessUnit(NalAccessUnit):
    """An access unit of H.264."""

    HEADER_SIZE = 1
    AGGREGATION = 24
    FRAGMENT = 28

    @staticmethod
    def unit_type(head: int) -> int:
        """Return a NAL unit's type; -1: not valid."""
        return -1 if head & 0x80 or not head & 0x1F else head & 0x1F

    @staticmethod
    def is_picture(unit_type: int) -> bool:
        """Return True for slices."""
        return unit_type in SLICES

    @classmethod
    def fragmented_header(cls, payload: bytes) -> bytes:
        """Return the header of the NAL unit whose fragment is in a packet."""
        return bytes((payload[0] & 0xE0 | payload[1] & 0x1F,))


class H264PayloadFormat:
    """The RTP payload format of H.264."""

    new_unit = H264AccessUnit

    @staticmethod
    def certainly_starts_frame(payload: bytes) -> bool:
        """Return True if a packet has parameters, a delimiter, or a key frame's first slice."""
        unit_type = payload[0] & 0x1F if payload else 0
        if unit_type == STAP_A and len(payload) > 3:
            payload = payload[3:]
            unit_type = payload[0] & 0x1F
        elif unit_type == FU_A and len(payload) > 2 and payload[1] & START:
            payload = payload[1:]
            unit_type = payload[0] & 0x1F
        if unit_type == KEY_SLICE:  # first_mb_in_slice is the first field; 0 is coded as one bit
            return len(payload) > 1 and bool(payload[1] & 0x80)
        return unit_type in (SPS, DELIMITER)


def _format_error(expected: str, actual: bytes) -> FrameFormatError:
    return FrameFormatError(
        f"H264: expected {expected} (annex B), got {len(actual)} bytes that begin with "
        f"{actual[:8].hex(' ') or 'nothing'}"
    )
