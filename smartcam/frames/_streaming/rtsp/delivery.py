"""Deliver packets to a client over its connection's channels or as datagrams."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING, Final, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable

CATCH_UP_TIME: Final = 0.5
"""Seconds after a key frame, which is large, during which frames may wait. At other times a frame
is skipped while a part of an earlier frame waits."""

MAX_WAITING_BYTES: Final = 4 << 20
"""Largest number of bytes that wait after a key frame."""

STALL_TIMEOUT: Final = 10.0
"""Seconds without progress of the client after which its connection is aborted."""

SEND_BUFFER_BYTES: Final = 64 << 10
"""Size of a connection's send buffer in the system; frames in it cannot be skipped."""

DATAGRAM_BUFFER_BYTES: Final = 1 << 20
"""Size of the system's send buffer for datagrams, which has room for a key frame."""

MAX_TRIES: Final = 32
"""Largest number of tries to find a free even port with a free next port."""


class PacketDelivery(Protocol):
    """The transport of one viewer's packets."""

    transport: str
    """Header Transport of the answer to SETUP."""

    def can_send(self, now: float) -> bool:
        """Return True if a frame may be sent now, False if it has to be skipped."""
        ...

    def send(self, packets: list[bytes], is_key_frame: bool, now: float) -> bool:
        """Send a frame; return False if only a part was sent."""
        ...

    def send_rtcp(self, data: bytes) -> None:
        """Send RTCP; drop it if it would have to wait."""
        ...

    def is_alive(self, now: float) -> bool | None:
        """Return True if the client accepted data lately, False if it stalls; None: unknown."""
        ...

    def close(self) -> None:
        """Release the sockets."""
        ...


class ChannelDelivery:
    """Delivery over the RTSP connection (RFC 2326, section 10.12), in complete frames."""

    def __init__(self, connection: asyncio.Transport, rtp: int, rtcp: int) -> None:
        self.transport = f"RTP/AVP/TCP;unicast;interleaved={rtp}-{rtcp}"
        self.channels = (rtp, rtcp)
        self._connection = connection
        self._catch_up_until = -1.0
        self._last_waiting = 0  # waiting bytes at the last check
        self._progress_at: float | None = None  # time at which the client last accepted bytes

    def can_send(self, now: float) -> bool:
        waiting = self._connection.get_write_buffer_size()
        return not waiting or (waiting < MAX_WAITING_BYTES and now < self._catch_up_until)

    def send(self, packets: list[bytes], is_key_frame: bool, now: float) -> bool:
        if is_key_frame:
            self._catch_up_until = now + CATCH_UP_TIME
        self._write(0, packets)
        return True

    def send_rtcp(self, data: bytes) -> None:
        if not self._connection.get_write_buffer_size():
            self._write(1, [data])

    def _write(self, channel_index: int, packets: list[bytes]) -> None:
        head = bytes((ord("$"), self.channels[channel_index]))
        pieces = (head + len(packet).to_bytes(2, "big") + packet for packet in packets)
        self._connection.write(b"".join(pieces))

    def is_alive(self, now: float) -> bool | None:
        waiting = self._connection.get_write_buffer_size()
        if not waiting or waiting < self._last_waiting or self._progress_at is None:
            self._progress_at = now
        self._last_waiting = waiting
        return now - self._progress_at < STALL_TIMEOUT

    def close(self) -> None:
        pass  # the connection is closed by its owner


class DatagramDelivery:
    """Delivery as datagrams, from two ports to two ports of the client.

    Packets that would have to wait are dropped.

    Args:
        sockets: bound sockets for RTP and RTCP.
        client: address of the client, from the RTSP connection.
        ports: ports of the client for RTP and RTCP.
        on_rtcp: function that is called with RTCP from the client.
    """

    def __init__(
        self,
        sockets: tuple[socket.socket, socket.socket],
        client: tuple[str | int, ...],
        ports: tuple[int, int],
        on_rtcp: Callable[[bytes], None],
    ) -> None:
        self._rtp_socket, control_socket = sockets
        server_ports = f"{self._rtp_socket.getsockname()[1]}-{control_socket.getsockname()[1]}"
        self.transport = (
            f"RTP/AVP;unicast;client_port={ports[0]}-{ports[1]};server_port={server_ports}"
        )
        self._rtp_address, self._rtcp_address = ((client[0], port, *client[2:]) for port in ports)
        self._control_socket = control_socket
        self._control_transport: asyncio.DatagramTransport | None = None
        self._on_rtcp = on_rtcp

    async def open(self) -> None:
        """Start receiving the client's reports.

        Cancellation: the sockets are closed.
        """
        loop = asyncio.get_running_loop()
        try:
            self._control_transport, _ = await loop.create_datagram_endpoint(
                lambda: _RtcpReceiver(str(self._rtp_address[0]), self._on_rtcp),
                sock=self._control_socket,
            )
        except BaseException:
            self.close()
            raise

    def can_send(self, now: float) -> bool:
        return True

    def send(self, packets: list[bytes], is_key_frame: bool, now: float) -> bool:
        try:
            for packet in packets:
                self._rtp_socket.sendto(packet, self._rtp_address)
        except OSError:  # the socket is full, or there is no route now
            return False
        return True

    def send_rtcp(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            self._control_socket.sendto(data, self._rtcp_address)

    def is_alive(self, now: float) -> bool | None:
        return None

    def close(self) -> None:
        self._rtp_socket.close()
        if self._control_transport is not None:
            self._control_transport.abort()
        else:
            self._control_socket.close()


class _RtcpReceiver(asyncio.DatagramProtocol):
    """Pass on the datagrams of one host."""

    def __init__(self, host: str, on_rtcp: Callable[[bytes], None]) -> None:
        self._host, self._on_rtcp = host, on_rtcp

    def datagram_received(self, data: bytes, addr: tuple[str | int, ...]) -> None:
        if addr[0] == self._host:
            self._on_rtcp(data)

    def error_received(self, exc: Exception) -> None:
        """Ignore ICMP errors, which any host can send."""


def open_port_pair(host: str, family: socket.AddressFamily) -> tuple[socket.socket, socket.socket]:
    """Return two sockets, on an even port and on the next port.

    Raises:
        OSError: there is no pair of free ports.
    """
    for _ in range(MAX_TRIES):
        first = _bound_socket(host, 0, family)
        port = first.getsockname()[1]
        try:
            second = _bound_socket(host, port ^ 1, family)
        except OSError:
            first.close()
            continue
        except BaseException:
            first.close()
            raise
        with contextlib.suppress(OSError):
            (second if port & 1 else first).setsockopt(
                socket.SOL_SOCKET, socket.SO_SNDBUF, DATAGRAM_BUFFER_BYTES
            )
        return (second, first) if port & 1 else (first, second)
    raise OSError(f"{host}: no two ports next to each other are free")


def _bound_socket(host: str, port: int, family: socket.AddressFamily) -> socket.socket:
    sock = socket.socket(family, socket.SOCK_DGRAM)
    try:
        sock.setblocking(False)
        sock.bind((host, port))
    except BaseException:
        sock.close()
        raise
    return sock
