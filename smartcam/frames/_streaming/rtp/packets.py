"""Read and write packets of RTP and RTCP (RFC 3550, RFC 4585)."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from smartcam.exceptions import MessageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


VERSION: Final = 2
MAX_REPORT_BLOCKS: Final = 31
"""Largest number of report blocks in a report, and of sources in a BYE: five bits."""

SR, RR, SDES, BYE, APP, RTPFB, PSFB = range(200, 207)
"""Types of RTCP packets."""

CNAME: Final = 1
NACK: Final = 1
PLI: Final = 1

_HEAD: Final = struct.Struct("!BBHII")
_BLOCK: Final = struct.Struct("!IIIIII")
_SENDER: Final = struct.Struct("!IQIII")


class RtpPacket(NamedTuple):
    """One packet of a stream.

    Attributes:
        marker: True for the last packet of a picture, in a video stream.
        payload_type: payload type, 0 to 127.
        sequence: sequence number, 0 to 65535.
        timestamp: timestamp, 0 to 2**32 - 1; for video in ticks of 90 kHz.
        ssrc: id of the stream, 0 to 2**32 - 1.
        payload: payload without padding.
    """

    marker: bool
    payload_type: int
    sequence: int
    timestamp: int
    ssrc: int
    payload: bytes

    def pack(self) -> bytes:
        """Return the packet's bytes: no CSRC, no extension, no padding."""
        second = self.marker << 7 | self.payload_type
        head = _HEAD.pack(VERSION << 6, second, self.sequence, self.timestamp, self.ssrc)
        return head + self.payload

    @classmethod
    def parse(cls, data: bytes | memoryview) -> RtpPacket:
        """Read a datagram; CSRC, extension and padding are removed.

        Raises:
            MessageError: the datagram is no RTP packet.
        """
        if len(data) < _HEAD.size:
            raise MessageError(f"RTP: expected 12 bytes or more, got {len(data)}", data=data)
        first, second, sequence, timestamp, ssrc = _HEAD.unpack_from(data)
        if first >> 6 != VERSION:
            raise MessageError(f"RTP: expected version 2, got {first >> 6}", data=data)
        begin, end = _HEAD.size + 4 * (first & 0xF), len(data)
        if first & 0x10:
            if begin + 4 > end:
                raise _cut_off_error("extension", begin + 4, data)
            begin += 4 + 4 * int.from_bytes(data[begin + 2 : begin + 4], "big")
        if begin > end:
            raise _cut_off_error("head", begin, data)
        if first & 0x20:
            padding = data[-1]
            if not 1 <= padding <= end - begin:
                raise MessageError(
                    f"RTP: padding: expected 1 to {end - begin} bytes, got {padding}",
                    offset=end - 1,
                    data=data,
                )
            end -= padding
        payload = bytes(data[begin:end])
        return cls(second >= 0x80, second & 0x7F, sequence, timestamp, ssrc, payload)


class ReportBlock(NamedTuple):
    """A receiver's report on one stream.

    Attributes:
        ssrc: id of the stream.
        fraction: share of packets lost since the last report, in 256ths.
        lost: packets lost since the beginning; negative with many duplicates.
        highest: highest sequence number, with the count of wraps above the 16 bits.
        jitter: jitter of the arrival, ticks of the stream's clock.
        last_report: middle 32 bits of the last sender report's NTP time; 0: no report.
        delay: time since that sender report, in 65536ths of a second.
    """

    ssrc: int
    fraction: int
    lost: int
    highest: int
    jitter: int
    last_report: int = 0
    delay: int = 0

    def pack(self) -> bytes:
        """Return the block's 24 bytes; ``lost`` is limited to 24 bits."""
        lost = max(-(1 << 23), min(self.lost, (1 << 23) - 1)) & 0xFFFFFF
        numbers = (self.highest, self.jitter, self.last_report, self.delay)
        return _BLOCK.pack(self.ssrc, self.fraction << 24 | lost, *numbers)

    @classmethod
    def parse(cls, data: bytes) -> ReportBlock:
        """Read 24 bytes."""
        ssrc, lost, *numbers = _BLOCK.unpack(data)
        signed = ((lost & 0xFFFFFF) ^ 0x800000) - 0x800000
        return cls(ssrc, lost >> 24, signed, *numbers)


class SenderReport(NamedTuple):
    """A sender's report on its stream.

    Attributes:
        ssrc: id of the stream.
        ntp: wall clock of the report, seconds since 1900 in units of 2**-32.
        timestamp: RTP timestamp of the same moment.
        packets: number of packets sent so far.
        octets: number of payload bytes sent so far.
        blocks: report blocks on other streams, at most 31.
    """

    ssrc: int
    ntp: int
    timestamp: int
    packets: int
    octets: int
    blocks: tuple[ReportBlock, ...] = ()

    def pack(self) -> bytes:
        """Return the report's bytes."""
        head = _SENDER.pack(*(part & mask for part, mask in zip(self[:5], _MASKS, strict=True)))
        return _packet(SR, len(self.blocks), head + b"".join(b.pack() for b in self.blocks))


class ReceiverReport(NamedTuple):
    """A receiver's report with at most 31 blocks."""

    ssrc: int
    blocks: tuple[ReportBlock, ...] = ()

    def pack(self) -> bytes:
        """Return the report's bytes."""
        body = self.ssrc.to_bytes(4, "big") + b"".join(block.pack() for block in self.blocks)
        return _packet(RR, len(self.blocks), body)


class SourceDescription(NamedTuple):
    """The permanent name of a participant, independent of its SSRC."""

    ssrc: int
    cname: str

    def pack(self) -> bytes:
        """Return the description's bytes; a name is cut after 255 bytes."""
        name = self.cname.encode()[:255]
        body = self.ssrc.to_bytes(4, "big") + bytes((CNAME, len(name))) + name + b"\0"
        return _packet(SDES, 1, body + bytes(-len(body) % 4))


class Goodbye(NamedTuple):
    """A goodbye (BYE) of at most 31 participants."""

    ssrcs: tuple[int, ...]
    reason: str = ""

    def pack(self) -> bytes:
        """Return the packet's bytes; a reason is cut after 255 bytes."""
        body = b"".join(ssrc.to_bytes(4, "big") for ssrc in self.ssrcs)
        if self.reason:
            reason = self.reason.encode()[:255]
            body += bytes((len(reason),)) + reason
            body += bytes(-len(body) % 4)
        return _packet(BYE, len(self.ssrcs), body)


class PacketsMissing(NamedTuple):
    """A receiver's request for missing packets (generic NACK, RFC 4585).

    Attributes:
        ssrc: id of the receiver.
        media: id of the stream.
        sequences: numbers of the missing packets.
    """

    ssrc: int
    media: int
    sequences: tuple[int, ...]

    def pack(self) -> bytes:
        """Return the request's bytes, with one entry for up to 17 neighbouring packets."""
        body = struct.pack("!II", self.ssrc, self.media)
        remaining = list(self.sequences)
        while remaining:
            first = remaining[0]
            mask = sum(
                1 << distance - 1
                for sequence in remaining
                if 1 <= (distance := sequence - first & 0xFFFF) <= 16
            )
            remaining = [sequence for sequence in remaining if sequence - first & 0xFFFF > 16]
            body += struct.pack("!HH", first, mask)
        return _packet(RTPFB, NACK, body)


class PictureLost(NamedTuple):
    """A receiver's request for a key frame (PLI, RFC 4585)."""

    ssrc: int
    media: int

    def pack(self) -> bytes:
        """Return the request's bytes."""
        return _packet(PSFB, PLI, struct.pack("!II", self.ssrc, self.media))


Report: TypeAlias = (
    SenderReport | ReceiverReport | SourceDescription | Goodbye | PacketsMissing | PictureLost
)


def compound(*reports: Report) -> bytes:
    """Return one datagram of RTCP; the first should be a sender's or a receiver's report."""
    return b"".join(report.pack() for report in reports)


def parse_rtcp(data: bytes) -> list[Report]:
    """Read a datagram of RTCP; unsupported kinds of packets are skipped.

    Raises:
        MessageError: the version, a type, a length or a count is wrong.
    """
    reports: list[Report] = []
    offset = 0
    while offset < len(data) or not offset:
        if len(data) - offset < 4:
            raise _cut_off_error("RTCP head", offset + 4, data)
        first, kind = data[offset], data[offset + 1]
        end = offset + 4 + 4 * int.from_bytes(data[offset + 2 : offset + 4], "big")
        if first >> 6 != VERSION or not 192 <= kind <= 223:
            raise MessageError(
                f"RTCP: expected version 2 and a type from 192 to 223, got {first >> 6} and {kind}",
                offset=offset,
                data=data[offset:],
            )
        if end > len(data):
            raise _cut_off_error("RTCP packet", end, data)
        body = data[offset + 4 : end]
        if first & 0x20:
            body = _without_padding(body, end == len(data), offset, data)
        parse = _PARSERS.get(kind)
        if parse is not None:
            try:
                reports += parse(first & 0x1F, body)
            except (struct.error, IndexError) as exc:
                raise MessageError(
                    f"RTCP: a packet of type {kind} with a count of {first & 0x1F}: its "
                    f"{len(body)} bytes are too few",
                    offset=offset,
                    data=data[offset:end],
                ) from exc
        offset = end
    return reports


def is_rtcp(data: bytes) -> bool:
    """Return True if a datagram is RTCP rather than RTP (RFC 5761)."""
    return len(data) > 1 and 192 <= data[1] <= 223


def _sender_report(count: int, body: bytes) -> Iterable[Report]:
    ssrc, ntp, timestamp, packets, octets = _SENDER.unpack_from(body)
    blocks = _blocks(count, body[_SENDER.size :])
    yield SenderReport(ssrc, ntp, timestamp, packets, octets, blocks)


def _receiver_report(count: int, body: bytes) -> Iterable[Report]:
    yield ReceiverReport(_read_uint32(body, 0), _blocks(count, body[4:]))


def _blocks(count: int, data: bytes) -> tuple[ReportBlock, ...]:
    size = _BLOCK.size
    starts = range(0, count * size, size)
    return tuple(ReportBlock.parse(data[start : start + size]) for start in starts)


def _descriptions(count: int, body: bytes) -> Iterable[Report]:
    offset = 0
    for _ in range(count):
        ssrc = _read_uint32(body, offset)
        offset += 4
        while body[offset]:
            item, size = body[offset], body[offset + 1]
            offset += 2 + size
            if offset > len(body):
                raise IndexError
            if item == CNAME:
                yield SourceDescription(ssrc, body[offset - size : offset].decode(errors="replace"))
        offset += 4 - offset % 4


def _goodbye(count: int, body: bytes) -> Iterable[Report]:
    ssrcs = tuple(_read_uint32(body, 4 * index) for index in range(count))
    reason = body[4 * count :]
    size = reason[0] if reason else 0
    if 1 + size > len(reason) > 0:
        raise IndexError
    yield Goodbye(ssrcs, reason[1 : 1 + size].decode(errors="replace"))


def _packets_missing(kind: int, body: bytes) -> Iterable[Report]:
    ssrc, media = _read_uint32(body, 0), _read_uint32(body, 4)
    if kind != NACK:
        return
    sequences: dict[int, None] = {}
    for first, mask in struct.iter_unpack("!HH", body[8:]):
        distances = [bit + 1 for bit in range(16) if mask >> bit & 1]
        sequences |= dict.fromkeys(first + distance & 0xFFFF for distance in (0, *distances))
    yield PacketsMissing(ssrc, media, tuple(sequences))


def _picture_lost(kind: int, body: bytes) -> Iterable[Report]:
    ssrc, media = _read_uint32(body, 0), _read_uint32(body, 4)
    if kind == PLI:
        yield PictureLost(ssrc, media)


_PARSERS: Final[dict[int, Callable[[int, bytes], Iterable[Report]]]] = {
    SR: _sender_report,
    RR: _receiver_report,
    SDES: _descriptions,
    BYE: _goodbye,
    RTPFB: _packets_missing,
    PSFB: _picture_lost,
}
"""Parser of each packet type, called with the header's count (or feedback type) and the body."""

_MASKS: Final = (0xFFFFFFFF, (1 << 64) - 1, 0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF)


def _read_uint32(data: bytes, offset: int) -> int:
    value: int = struct.unpack_from("!I", data, offset)[0]
    return value


def _packet(kind: int, count: int, body: bytes) -> bytes:
    if not 0 <= count <= MAX_REPORT_BLOCKS:
        raise ValueError(f"RTCP: expected 0 to {MAX_REPORT_BLOCKS} entries, got {count}")
    return struct.pack("!BBH", VERSION << 6 | count, kind, len(body) // 4) + body


def _without_padding(body: bytes, is_last: bool, offset: int, data: bytes) -> bytes:
    padding = body[-1] if body else 0
    if not is_last or not 4 <= padding <= len(body) or padding % 4:
        raise MessageError(
            f"RTCP: padding: expected a multiple of 4 up to {len(body)} in the last packet, got "
            f"{padding}",
            offset=offset,
            data=data[offset:],
        )
    return body[:-padding]


def _cut_off_error(label: str, expected: int, data: bytes | memoryview) -> MessageError:
    return MessageError(f"{label}: expected {expected} bytes or more, got {len(data)}", data=data)
