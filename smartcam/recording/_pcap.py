"""Convert a recording to packets, for Wireshark and similar programs.

A recording has frames and no packets, so packets are made: Ethernet, IP, and TCP with handshake,
segments, acknowledgements and an end, or UDP with one datagram per frame. Times and payload are the
recorded ones. What was not recorded is invented: the client's address and port, the division into
segments, and the end of a lost link.
"""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._arguments import check_flag, check_path
from smartcam.exceptions import ConfigurationError, RecordingError, UnsupportedError
from smartcam.models import Disconnected
from smartcam.observers import TraceEntry
from smartcam.protocols import Transport
from smartcam.recording._mcap.form import nanoseconds
from smartcam.recording._packets import (
    ACK,
    FIN,
    PUSH,
    SYN,
    Side,
    file_header,
    file_record,
    tcp_packet,
    udp_packet,
)
from smartcam.recording._reader import check_recording
from smartcam.registry import PROTOCOLS
from smartcam.settings import is_fleet, parse_address

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from smartcam.recording._mcap.form import Item
    from smartcam.recording._reader import RecordedCamera, Recording

MSS = {4: 1460, 6: 1440}
"""Bytes of a TCP segment that fit into an Ethernet frame, by the version of IP."""

FIRST_PORT, PORTS = 49_152, 16_384
"""First ephemeral port of clients, and number of such ports (RFC 6335); each link uses the next."""

MAX_DATAGRAM_BYTES = 65_507
"""Largest number of bytes of a UDP datagram over IPv4."""

MAX_TIME_NS = (1 << 32) * 10**9
"""Upper bound of a packet's time, nanoseconds since 1970: pcap counts seconds in 32 bits."""

_ADDRESSES = {4: ("192.0.2.1", "192.0.2.2"), 6: ("2001:db8::1", "2001:db8::2")}
"""Documentation addresses (RFC 5737, RFC 3849): of the client, and of a camera with a host name."""

_CLIENT_MAC, _CAMERA_MAC = bytes.fromhex("020000000001"), bytes.fromhex("020000000002")

_HANDSHAKE = 3000  # nanoseconds before the first frame


class _Packet(NamedTuple):
    """A packet and its time, nanoseconds since 1970."""

    time: int
    data: bytes


def write_pcap(
    recording: Recording, path: str | Path, *, camera: str | None = None, overwrite: bool = False
) -> int:
    """Write the frames of a recording as packets to a pcap file.

    Args:
        recording: recording to read.
        path: the file; the usual suffix is ``.pcap``.
        camera: name of the camera whose frames to write; default all cameras.
        overwrite: replace an existing file.

    Returns:
        Number of packets.

    Raises:
        ConfigurationError: there is no such camera, or the file exists already or cannot be
            created.
        UnsupportedError: a camera belongs to a fleet, so that only the agent has its frames.
        RecordingError: the file cannot be written to its end: the disk is full, or a frame does
            not fit into a packet.
    """
    check_recording(recording, "pcap")
    path = check_path(path, "path", "pcap")
    overwrite = check_flag(overwrite, "overwrite", "pcap")
    for recorded in [*recording.cameras.values()] if camera is None else [recording.camera(camera)]:
        if is_fleet(recorded.url):
            raise UnsupportedError(
                f"recording {recording.path}: camera {recorded.name!r} belongs to a fleet, so "
                "the recording has no frames of it, of which packets could be made"
            )
    try:
        stream = path.open("wb" if overwrite else "xb")
    except FileExistsError as exc:
        raise ConfigurationError(
            f"pcap {path}: the file exists already; overwrite (--force) replaces it"
        ) from exc
    except (OSError, ValueError) as exc:
        reason = exc.strerror if isinstance(exc, OSError) else exc
        raise ConfigurationError(f"pcap {path}: {reason}") from exc
    count = 0
    try:
        with stream:
            stream.write(file_header())
            for packet in _packets(recording, camera):
                stream.write(file_record(packet.time, packet.data))
                count += 1
    except RecordingError as exc:
        raise RecordingError(f"pcap {path}: {exc}") from exc
    except OSError as exc:
        raise RecordingError(f"pcap {path}: {exc.strerror or exc}") from exc
    return count


def _packets(recording: Recording, camera: str | None) -> Iterator[_Packet]:
    captures: dict[str, _Capture] = {}
    for index, recorded in enumerate(recording.cameras.values()):
        if not is_fleet(recorded.url):
            captures[recorded.name] = _Capture(recorded, index)
    for item in recording.items(camera):
        if item.camera in captures:
            yield from captures[item.camera].packets(item)
    for capture in captures.values():
        yield from capture.finish()


class _Capture:
    """The packets of one camera's links; ``index`` is the camera's index in the recording."""

    def __init__(self, camera: RecordedCamera, index: int) -> None:
        host, port, self._tcp = _address_and_transport(camera)
        address = _address(host, index)
        client = address
        if not address.is_loopback:
            client = ipaddress.ip_address(_ADDRESSES[address.version][0])
        self._camera = Side(_CAMERA_MAC, address.packed, port)
        self._client = Side(_CLIENT_MAC, client.packed, FIRST_PORT + 512 * index)
        self._last_packet_id = 0
        self._mss = MSS[address.version]
        self._is_open = False
        self._held_disconnect: TraceEntry | None = None  # a Disconnect that may begin a link
        self._now = 0

    def packets(self, item: Item) -> Iterator[_Packet]:
        """Yield the packets of an item."""
        if isinstance(item, Disconnected):
            self._now = max(self._now, nanoseconds(item.at))
            yield from self._release_held()
            yield from self._close_link(by_client=item.expected)
        elif isinstance(item, TraceEntry):
            yield from self._packets_of_frame(item)

    def finish(self) -> Iterator[_Packet]:
        """Yield the packets that end a link which is still open."""
        yield from self._release_held()
        yield from self._close_link(by_client=True)

    def _packets_of_frame(self, entry: TraceEntry) -> Iterator[_Packet]:
        # a link starts with Connect, or with Disconnect and Connect
        to_camera = entry.direction == ">"
        if to_camera and entry.message == "Disconnect":
            yield from self._release_held()
            self._held_disconnect = entry
            return
        if to_camera and entry.message == "Connect" and self._tcp:
            yield from self._close_link(by_client=True)
        yield from self._release_held()
        yield from self._packets_of_entry(entry)

    def _release_held(self) -> Iterator[_Packet]:
        disconnect, self._held_disconnect = self._held_disconnect, None
        if disconnect is not None:
            yield from self._packets_of_entry(disconnect)

    def _packets_of_entry(self, entry: TraceEntry) -> Iterator[_Packet]:
        data = bytes.fromhex(entry.hex)
        if not data:
            return  # passwords are not recorded
        self._now = max(self._now, nanoseconds(entry.at), _HANDSHAKE)
        if not self._is_open:
            self._is_open = True
            yield from self._open_link()
        to_camera = entry.direction == ">"
        sender, receiver = (
            (self._client, self._camera) if to_camera else (self._camera, self._client)
        )
        if not self._tcp:
            if len(data) > MAX_DATAGRAM_BYTES:
                raise RecordingError(
                    f"a frame of {len(data)} bytes, expected {MAX_DATAGRAM_BYTES} at most over UDP"
                )
            yield self._datagram(sender, receiver, data)
            return
        for begin in range(0, len(data), self._mss):
            part = data[begin : begin + self._mss]
            last = begin + self._mss >= len(data)
            yield self._segment(sender, receiver, ACK | (PUSH if last else 0), part)
            sender.sequence += len(part)
        yield self._segment(receiver, sender, ACK)

    # ------------------------------------------------------------------ a link's begin and end

    def _open_link(self) -> Iterator[_Packet]:
        """Open a link on the client's next port: three packets right before the first frame."""
        client, camera = self._client, self._camera
        client.port = FIRST_PORT + (client.port + 1 - FIRST_PORT) % PORTS
        if not self._tcp:
            return
        client.sequence, camera.sequence = 1000, 2000
        now, self._now = self._now, self._now - _HANDSHAKE
        yield self._segment(client, camera, SYN)
        client.sequence += 1
        self._now += 1000
        yield self._segment(camera, client, SYN | ACK)
        camera.sequence += 1
        self._now += 1000
        yield self._segment(client, camera, ACK)
        self._now = now

    def _close_link(self, *, by_client: bool) -> Iterator[_Packet]:
        if not self._is_open:
            return
        self._is_open = False
        if not self._tcp:
            return
        first, second = (self._client, self._camera) if by_client else (self._camera, self._client)
        yield self._segment(first, second, FIN | ACK)
        first.sequence += 1
        yield self._segment(second, first, FIN | ACK)
        second.sequence += 1
        yield self._segment(first, second, ACK)

    # ------------------------------------------------------------------ packets

    def _segment(self, sender: Side, receiver: Side, flags: int, data: bytes = b"") -> _Packet:
        number = self._next_number()
        return self._packet(tcp_packet(sender, receiver, flags, number, data, self._mss))

    def _datagram(self, sender: Side, receiver: Side, data: bytes) -> _Packet:
        return self._packet(udp_packet(sender, receiver, self._next_number(), data))

    def _next_number(self) -> int:
        self._last_packet_id = (self._last_packet_id + 1) & 0xFFFF
        return self._last_packet_id

    def _packet(self, data: bytes) -> _Packet:
        if self._now >= MAX_TIME_NS:
            raise RecordingError("a frame came in the year 2106 or later, which pcap cannot store")
        return _Packet(self._now, data)


def _address_and_transport(camera: RecordedCamera) -> tuple[str, int, bool]:
    """Return a camera's host and port, and whether the transport was TCP."""
    if not camera.url:
        bvs: Any = PROTOCOLS.load("bvs")
        return "", bvs.default_port, True
    address = parse_address(camera.url)
    protocol: Any = PROTOCOLS.load(address.protocol)
    return address.host, address.port, protocol.schemes[address.scheme] is Transport.TCP


def _address(host: str, index: int) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """Return a camera's address; a documentation address if only its host name is known."""
    try:
        return ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return ipaddress.ip_address(_ADDRESSES[4][1]) + index % 200
