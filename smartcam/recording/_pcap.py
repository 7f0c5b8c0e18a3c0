"""A recording as packets, for Wireshark and its kin.

A recording holds frames and no packets, so these are made: Ethernet, IP, and TCP with handshake,
segments, acknowledgements and an end, or UDP with one datagram a frame. Times and payload are the
recorded ones. What was not recorded is made up: the client's address and port, the division into
segments, and how a link that was lost came to its end.
"""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import ConfigurationError, RecordingError, UnsupportedError
from smartcam.models import Disconnected
from smartcam.observers import TraceEntry
from smartcam.protocols._base import Transport
from smartcam.recording._form import load_extra, nanoseconds
from smartcam.registry import PROTOCOLS
from smartcam.settings import is_fleet, parse_address

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.recording._form import Item
    from smartcam.recording._reader import RecordedCamera, Recording

MSS = {4: 1460, 6: 1440}
"""Bytes of a TCP segment, by the version of IP: what fits into an Ethernet frame."""

SCALE = 7
"""Window scale: a window of 8 MB, more than the largest frame."""

MAX_PACKET = 1 << 18
"""Snapshot length that the file's header tells: Wireshark's own default."""

FIRST_PORT, PORTS = 49_152, 16_384
"""The ports that a system gives to clients (RFC 6335); each link takes the next."""

MAX_DATAGRAM = 65_507
"""Bytes of a UDP datagram over IPv4."""

MAX_TIME = (1 << 32) * 10**9
"""Nanoseconds since 1970 that a packet's time stays below: pcap counts seconds in 32 bits."""

_ADDRESSES = {4: ("192.0.2.1", "192.0.2.2"), 6: ("2001:db8::1", "2001:db8::2")}
"""Addresses for documents (RFC 5737, RFC 3849): the client's, and that of a camera with a name."""

_CLIENT_MAC, _CAMERA_MAC = bytes.fromhex("020000000001"), bytes.fromhex("020000000002")

_HANDSHAKE = 3000  # nanoseconds before the first frame

_FIN, _SYN, _RST, _PUSH, _ACK = 0x01, 0x02, 0x04, 0x08, 0x10


class _Packet(NamedTuple):
    """A packet and its time, nanoseconds since 1970."""

    time: int
    data: bytes


@dataclass(slots=True, eq=False)
class _Side:
    """One end of a link."""

    mac: bytes
    ip: bytes
    port: int
    sequence: int = 0


def write_pcap(
    recording: Recording, path: str | Path, *, camera: str | None = None, overwrite: bool = False
) -> int:
    """Write the frames of a recording as packets to a pcap file.

    Args:
        recording: where from.
        path: the file; the usual ending is ``.pcap``.
        camera: whose frames; default all cameras'.
        overwrite: take the place of a file that is there.

    Returns:
        How many packets were written.

    Raises:
        ConfigurationError: no such camera, or the file is there already or cannot be made.
        UnsupportedError: a camera is a fleet's, whose frames are its agent's.
        RecordingError: it cannot be written to its end: the disk is full, or a frame fits into no
            packet.
        MissingExtraError: dpkt is not installed.
    """
    dpkt = load_extra("dpkt")
    for known in [*recording.cameras.values()] if camera is None else [recording.camera(camera)]:
        if is_fleet(known.url):
            raise UnsupportedError(
                f"recording {recording.path}: camera {known.name!r} is a fleet's, so no frames of "
                "it are recorded, which packets are made of"
            )
    path = Path(path)
    try:
        stream = path.open("wb" if overwrite else "xb")
    except FileExistsError as exc:
        raise ConfigurationError(
            f"pcap {path}: the file is there already; overwrite (--force) takes its place"
        ) from exc
    except (OSError, ValueError) as exc:
        reason = exc.strerror if isinstance(exc, OSError) else exc
        raise ConfigurationError(f"pcap {path}: {reason}") from exc
    count = 0
    try:
        with stream:
            writer = dpkt.pcap.Writer(stream, snaplen=MAX_PACKET)
            for packet in _packets(recording, camera, dpkt):
                writer.writepkt_time(packet.data, Decimal(packet.time // 1000) / 1_000_000)
                count += 1
    except RecordingError as exc:
        raise RecordingError(f"pcap {path}: {exc}") from exc
    except OSError as exc:
        raise RecordingError(f"pcap {path}: {exc.strerror or exc}") from exc
    return count


def _packets(recording: Recording, camera: str | None, dpkt: Any) -> Iterator[_Packet]:
    wires: dict[str, _Capture] = {}
    for index, known in enumerate(recording.cameras.values()):
        if not is_fleet(known.url):
            wires[known.name] = _Capture(known, dpkt, index)
    for item in recording.items(camera):
        if item.camera in wires:
            yield from wires[item.camera].packets(item)
    for wire in wires.values():
        yield from wire.end()


class _Capture:
    """Everything that one camera's links carry; ``index`` is the camera's in the recording."""

    def __init__(self, camera: RecordedCamera, dpkt: Any, index: int) -> None:
        self._dpkt = dpkt
        host, port, self._tcp = _where(camera)
        address = _address(host, index)
        client = address
        if not address.is_loopback:
            client = ipaddress.ip_address(_ADDRESSES[address.version][0])
        self._camera = _Side(_CAMERA_MAC, address.packed, port)
        self._client = _Side(_CLIENT_MAC, client.packed, FIRST_PORT + 512 * index)
        self._ids = 0
        self._mss = MSS[address.version]
        self._open = False
        self._before: TraceEntry | None = None  # a Disconnect that may begin a link
        self._now = 0

    def packets(self, item: Item) -> Iterator[_Packet]:
        """Yield what an item makes."""
        if isinstance(item, Disconnected):
            self._now = max(self._now, nanoseconds(item.at))
            yield from self._held()
            yield from self._end(by_client=item.expected)
        elif isinstance(item, TraceEntry):
            yield from self._frame(item)

    def end(self) -> Iterator[_Packet]:
        """Yield what ends a link that is still there."""
        yield from self._held()
        yield from self._end(by_client=True)

    def _frame(self, entry: TraceEntry) -> Iterator[_Packet]:
        # a link begins with Connect, or with Disconnect and Connect
        outward = entry.direction == ">"
        if outward and entry.message == "Disconnect":
            yield from self._held()
            self._before = entry
            return
        if outward and entry.message == "Connect" and self._tcp:
            yield from self._end(by_client=True)
        yield from self._held()
        yield from self._say(entry)

    def _held(self) -> Iterator[_Packet]:
        held, self._before = self._before, None
        if held is not None:
            yield from self._say(held)

    def _say(self, entry: TraceEntry) -> Iterator[_Packet]:
        data = bytes.fromhex(entry.hex)
        if not data:
            return  # a password, which is not recorded
        self._now = max(self._now, nanoseconds(entry.at), _HANDSHAKE)
        if not self._open:
            self._open = True
            yield from self._begin()
        outward = entry.direction == ">"
        sender, receiver = (self._client, self._camera) if outward else (self._camera, self._client)
        if not self._tcp:
            if len(data) > MAX_DATAGRAM:
                raise RecordingError(
                    f"a frame of {len(data)} bytes, expected {MAX_DATAGRAM} at most over UDP"
                )
            yield self._datagram(sender, receiver, data)
            return
        for begin in range(0, len(data), self._mss):
            part = data[begin : begin + self._mss]
            last = begin + self._mss >= len(data)
            yield self._segment(sender, receiver, _ACK | (_PUSH if last else 0), part)
            sender.sequence += len(part)
        yield self._segment(receiver, sender, _ACK)

    # ------------------------------------------------------------------ a link's begin and end

    def _begin(self) -> Iterator[_Packet]:
        """Open a link on the client's next port: three packets right before the first frame."""
        client, camera = self._client, self._camera
        client.port = FIRST_PORT + (client.port + 1 - FIRST_PORT) % PORTS
        if not self._tcp:
            return
        client.sequence, camera.sequence = 1000, 2000
        now, self._now = self._now, self._now - _HANDSHAKE
        yield self._segment(client, camera, _SYN)
        client.sequence += 1
        self._now += 1000
        yield self._segment(camera, client, _SYN | _ACK)
        camera.sequence += 1
        self._now += 1000
        yield self._segment(client, camera, _ACK)
        self._now = now

    def _end(self, *, by_client: bool) -> Iterator[_Packet]:
        if not self._open:
            return
        self._open = False
        if not self._tcp:
            return
        first, second = (self._client, self._camera) if by_client else (self._camera, self._client)
        yield self._segment(first, second, _FIN | _ACK)
        first.sequence += 1
        yield self._segment(second, first, _FIN | _ACK)
        second.sequence += 1
        yield self._segment(first, second, _ACK)

    # ------------------------------------------------------------------ packets

    def _segment(self, sender: _Side, receiver: _Side, flags: int, data: bytes = b"") -> _Packet:
        tcp = self._dpkt.tcp.TCP(
            sport=sender.port,
            dport=receiver.port,
            seq=sender.sequence & 0xFFFFFFFF,
            ack=receiver.sequence & 0xFFFFFFFF if flags & _ACK else 0,
            flags=flags,
            win=65_535,
            data=data,
        )
        if flags & _SYN:  # maximum segment size; no operation; window scale
            size = self._mss.to_bytes(2, "big")
            tcp.opts = b"\x02\x04" + size + b"\x01\x03\x03" + bytes([SCALE])
            tcp.off = (20 + len(tcp.opts)) // 4
        return self._packet(sender, receiver, self._dpkt.ip.IP_PROTO_TCP, tcp)

    def _datagram(self, sender: _Side, receiver: _Side, data: bytes) -> _Packet:
        udp = self._dpkt.udp.UDP(
            sport=sender.port, dport=receiver.port, ulen=8 + len(data), data=data
        )
        return self._packet(sender, receiver, self._dpkt.ip.IP_PROTO_UDP, udp)

    def _packet(self, sender: _Side, receiver: _Side, protocol: int, payload: Any) -> _Packet:
        dpkt = self._dpkt
        if len(sender.ip) == 4:
            self._ids = (self._ids + 1) & 0xFFFF
            ip = dpkt.ip.IP(
                src=sender.ip, dst=receiver.ip, p=protocol, id=self._ids, df=1, data=payload
            )
            ip.len = len(ip)
            kind = dpkt.ethernet.ETH_TYPE_IP
        else:
            ip = dpkt.ip6.IP6(src=sender.ip, dst=receiver.ip, nxt=protocol, hlim=64, data=payload)
            ip.plen = len(payload)
            kind = dpkt.ethernet.ETH_TYPE_IP6
        if self._now >= MAX_TIME:
            raise RecordingError("a frame of the year 2106 or later, which pcap cannot tell")
        frame = dpkt.ethernet.Ethernet(src=sender.mac, dst=receiver.mac, type=kind, data=ip)
        return _Packet(self._now, bytes(frame))


def _where(camera: RecordedCamera) -> tuple[str, int, bool]:
    """Return a camera's host and port, and whether it was spoken to over TCP."""
    if not camera.url:
        bvs: Any = PROTOCOLS.load("bvs")
        return "", bvs.default_port, True
    address = parse_address(camera.url)
    protocol: Any = PROTOCOLS.load(address.protocol)
    return address.host, address.port, protocol.schemes[address.scheme] is Transport.TCP


def _address(host: str, index: int) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """Return a camera's address; one for documents where only its name is known."""
    try:
        return ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return ipaddress.ip_address(_ADDRESSES[4][1]) + index % 200
