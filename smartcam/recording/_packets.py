"""Packets as bytes: Ethernet, IP, TCP and UDP, and their pcap file.

Sources: the format of pcap is libpcap's (draft-ietf-opsawg-pcap), IPv4 RFC 791, IPv6 RFC 8200, TCP
RFC 9293, its window scale RFC 7323, UDP RFC 768.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

MAX_PACKET_BYTES: Final = 1 << 18
"""Snapshot length in the file's header: Wireshark's own default."""

WINDOW_SCALE: Final = 7
"""Shift that makes the largest window of a header 8 MB, more than the largest frame."""

FIN, SYN, RST, PUSH, ACK = 0x01, 0x02, 0x04, 0x08, 0x10
"""Flags of a TCP segment."""

_TCP, _UDP = 6, 17
_TYPES: Final = {4: 0x0800, 16: 0x86DD}
"""Type of an Ethernet frame, by the bytes of the IP addresses in it."""

_HOPS: Final = 64
_DO_NOT_FRAGMENT: Final = 0x4000
_WINDOW: Final = 0xFFFF
_MAGIC_MICROSECONDS, _ETHERNET = 0xA1B2C3D4, 1

_FILE: Final = struct.Struct("<IHHiIII")
_RECORD: Final = struct.Struct("<IIII")
_IPV4: Final = struct.Struct(">BBHHHBBH4s4s")
_IPV6: Final = struct.Struct(">IHBB16s16s")
_TCP_HEADER: Final = struct.Struct(">HHIIBBHHH")
_UDP_HEADER: Final = struct.Struct(">HHHH")


@dataclass(slots=True, eq=False)
class Side:
    """One end of a link."""

    mac: bytes
    ip: bytes
    port: int
    sequence: int = 0


def file_header() -> bytes:
    """Return the header of a pcap file."""
    return _FILE.pack(_MAGIC_MICROSECONDS, 2, 4, 0, 0, MAX_PACKET_BYTES, _ETHERNET)


def file_record(time: int, packet: bytes) -> bytes:
    """Return a packet's record; ``time`` in nanoseconds since 1970, cut to microseconds."""
    seconds, nanoseconds = divmod(time, 10**9)
    return _RECORD.pack(seconds, nanoseconds // 1000, len(packet), len(packet)) + packet


def tcp_packet(
    sender: Side, receiver: Side, flags: int, number: int, data: bytes, mss: int = 0
) -> bytes:
    """Return an Ethernet frame with a TCP segment.

    Args:
        sender: the end whose sequence number is the segment's.
        receiver: the end whose sequence number is acknowledged.
        flags: flags of the segment; a segment with SYN has options.
        number: number of the IP packet, in IPv4.
        data: data of the segment.
        mss: the maximum segment size in its options.
    """
    # maximum segment size; no operation; window scale
    options = struct.pack(">BBHBBBB", 2, 4, mss, 1, 3, 3, WINDOW_SCALE) if flags & SYN else b""
    size = _TCP_HEADER.size + len(options)
    acknowledged = receiver.sequence & 0xFFFFFFFF if flags & ACK else 0
    header = sender.port, receiver.port, sender.sequence & 0xFFFFFFFF, acknowledged, size << 2
    without_checksum = _TCP_HEADER.pack(*header, flags, _WINDOW, 0, 0) + options + data
    pseudo_header = _pseudo_header(sender, receiver, _TCP, len(without_checksum))
    checksum = _checksum(pseudo_header + without_checksum)
    body = _TCP_HEADER.pack(*header, flags, _WINDOW, checksum, 0) + options + data
    return _ethernet(sender, receiver, _TCP, number, body)


def udp_packet(sender: Side, receiver: Side, number: int, data: bytes) -> bytes:
    """Return an Ethernet frame with a UDP datagram; ``number`` is the IP packet's, in IPv4."""
    header = sender.port, receiver.port, _UDP_HEADER.size + len(data)
    without_checksum = _UDP_HEADER.pack(*header, 0) + data
    pseudo_header = _pseudo_header(sender, receiver, _UDP, len(without_checksum))
    checksum = _checksum(pseudo_header + without_checksum)
    body = _UDP_HEADER.pack(*header, checksum or 0xFFFF) + data  # 0 would mean no checksum
    return _ethernet(sender, receiver, _UDP, number, body)


def _ethernet(sender: Side, receiver: Side, protocol: int, number: int, body: bytes) -> bytes:
    ethertype = _TYPES[len(sender.ip)]
    if len(sender.ip) == 4:
        size = _IPV4.size + len(body)
        fields_before = 0x45, 0, size, number, _DO_NOT_FRAGMENT, _HOPS, protocol
        checksum = _checksum(_IPV4.pack(*fields_before, 0, sender.ip, receiver.ip))
        ip = _IPV4.pack(*fields_before, checksum, sender.ip, receiver.ip)
    else:
        ip = _IPV6.pack(6 << 28, len(body), protocol, _HOPS, sender.ip, receiver.ip)
    return receiver.mac + sender.mac + struct.pack(">H", ethertype) + ip + body


def _pseudo_header(sender: Side, receiver: Side, protocol: int, size: int) -> bytes:
    """Return the bytes that a checksum covers in addition to the segment."""
    if len(sender.ip) == 4:
        return sender.ip + receiver.ip + struct.pack(">HH", protocol, size)
    return sender.ip + receiver.ip + struct.pack(">II", size, protocol)


def _checksum(data: bytes) -> int:
    """Return the Internet checksum (RFC 1071) of bytes whose checksum field is 0."""
    # The sum of all words is the number that they make, modulo 2^16 - 1.
    total = int.from_bytes(data + bytes(len(data) % 2), "big") % 0xFFFF
    if total == 0 and any(data):
        total = 0xFFFF
    return 0xFFFF - total
