"""Open a pair of sockets: RTP, and RTCP on the next port."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
import struct
import sys
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam.exceptions import ConfigurationError, FrameSourceError

if TYPE_CHECKING:
    from collections.abc import Callable


MAX_DATAGRAMS_PER_TURN: Final = 64
"""Largest number of datagrams that are read before the event loop continues."""

RECEIVE_BUFFER_BYTES: Final = 4 << 20
SEND_BUFFER_BYTES: Final = 128 << 10
"""Size of the system's send buffer: 50 ms on a link of 20 Mbit/s."""

SO_RCVBUFFORCE: Final = 33 if sys.platform == "linux" else socket.SO_RCVBUF
"""Socket option from asm-generic/socket.h that exceeds rmem_max, for processes that may administer
the network."""

MAX_TRIES: Final = 32
"""Largest number of tries to find two free consecutive ports."""


class Endpoint(NamedTuple):
    """An address with its family.

    Attributes:
        family: family of the sockets.
        host: numeric address.
        port: port of RTP; RTCP uses the next port.
    """

    family: socket.AddressFamily
    host: str
    port: int

    @property
    def is_multicast(self) -> bool:
        """True for a multicast group."""
        return ipaddress.ip_address(self.host.partition("%")[0]).is_multicast

    @property
    def rtcp_address(self) -> tuple[str, int]:
        """Address for RTCP."""
        return self.host, self.port + 1

    def __str__(self) -> str:
        """Return ``HOST:PORT``."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


async def resolve(host: str, port: int, label: str) -> Endpoint:
    """Return a host's address.

    Raises:
        FrameSourceError: there is no such host.
    """
    loop = asyncio.get_running_loop()
    try:
        addresses = await loop.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as exc:
        raise FrameSourceError(
            f"{label}: no address of {host!r} is known: {exc}", source=label
        ) from exc
    family, *_, address = addresses[0]
    return Endpoint(family, str(address[0]), port)


def host_and_port(text: str) -> tuple[str, int]:
    """Read ``HOST:PORT`` or ``[HOST]:PORT``.

    Raises:
        ConfigurationError: the text has another form.
    """
    host, colon, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not colon or not host or not port.isdecimal() or not 1 <= int(port) <= 65534:
        raise ConfigurationError(f"RTP: expected HOST:PORT with a port below 65535, got {text!r}")
    return host, int(port)


class SocketPair:
    """A pair of sockets for RTP and RTCP.

    Args:
        rtp: bound socket.
        rtcp: socket bound to the next port.
    """

    def __init__(self, rtp: socket.socket, rtcp: socket.socket) -> None:
        self.rtp, self.rtcp = rtp, rtcp
        self._loop = asyncio.get_running_loop()
        self._closed = False

    @classmethod
    def open_listening(cls, endpoint: Endpoint) -> SocketPair:
        """Return the sockets of a receiver; a multicast group is joined.

        Raises:
            OSError: the port is in use, or this machine has no such address.
        """
        with contextlib.ExitStack() as stack:
            socks = []
            for port in (endpoint.port, endpoint.port + 1):
                sock = stack.enter_context(_udp_socket(endpoint.family))
                _enlarge_receive_buffer(sock)
                if endpoint.is_multicast:
                    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                sock.bind(
                    (
                        endpoint.host
                        if sys.platform == "linux" or not endpoint.is_multicast
                        else "",
                        port,
                    )
                )
                if endpoint.is_multicast:
                    _join_group(sock, endpoint)
                socks.append(sock)
            stack.pop_all()
        return cls(*socks)

    @classmethod
    def open_even_port(cls, endpoint: Endpoint) -> SocketPair:
        """Return sockets for receiving on an even port of an address, and the next port.

        Raises:
            OSError: no ports are free.
        """
        for tries_left in reversed(range(MAX_TRIES)):
            with _udp_socket(endpoint.family) as probe:
                probe.bind((endpoint.host, 0))
                even = probe.getsockname()[1] & ~1
            try:
                return cls.open_listening(endpoint._replace(port=even))
            except OSError:
                if not tries_left:
                    raise
        raise AssertionError("unreachable")

    @classmethod
    def open_sending(cls, to: Endpoint, ttl: int) -> SocketPair:
        """Return the sockets of a sender.

        Raises:
            OSError: no ports are free.
        """
        for tries_left in reversed(range(MAX_TRIES)):
            with contextlib.ExitStack() as stack:
                rtp, rtcp = (stack.enter_context(_udp_socket(to.family)) for _ in range(2))
                rtp.bind(("", 0))
                port = rtp.getsockname()[1]
                try:
                    rtcp.bind(("", port + 1 if port < 65535 else 0))
                except OSError:
                    if not tries_left:
                        raise
                    continue
                rtp.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
                for sock in (rtp, rtcp):
                    if to.is_multicast:
                        _set_hop_limit(sock, to.family, ttl)
                stack.pop_all()
                return cls(rtp, rtcp)
        raise AssertionError("unreachable")

    def start_reading(
        self,
        on_rtp: Callable[[bytes, tuple[Any, ...]], None] | None,
        on_rtcp: Callable[[bytes, tuple[Any, ...]], None],
        on_batch_read: Callable[[], None] = lambda: None,
    ) -> None:
        """Call a function for each datagram with its sender, until :meth:`close`.

        Args:
            on_rtp: function for the stream's packets; None: packets are not read.
            on_rtcp: function for reports.
            on_batch_read: function that is called after each batch of datagrams.
        """
        for sock, on_datagram in ((self.rtp, on_rtp), (self.rtcp, on_rtcp)):
            if on_datagram is not None:
                self._loop.add_reader(sock, self._read_batch, sock, on_datagram, on_batch_read)

    def _read_batch(
        self,
        sock: socket.socket,
        on_datagram: Callable[[bytes, tuple[Any, ...]], None],
        on_batch_read: Callable[[], None],
    ) -> None:
        for _ in range(MAX_DATAGRAMS_PER_TURN):
            if self._closed:
                return
            try:
                data, sender = sock.recvfrom(65536)
            except BlockingIOError:
                break
            except OSError:  # from a datagram sent earlier; reading goes on
                continue
            on_datagram(data, sender)
        if not self._closed:
            on_batch_read()

    def send_rtcp(self, data: bytes, address: tuple[Any, ...]) -> None:
        """Send RTCP; drop it if the system does not accept it, since reports are repeated."""
        with contextlib.suppress(OSError):
            self.rtcp.sendto(data, address)

    async def wait_writable(self, timeout: float) -> None:
        """Wait until the stream's socket accepts data, or until a time limit."""
        writable = asyncio.Event()
        self._loop.add_writer(self.rtp, writable.set)
        try:
            async with asyncio.timeout(timeout):
                await writable.wait()
        except TimeoutError:
            pass
        finally:
            if not self._closed:
                self._loop.remove_writer(self.rtp)

    def close(self) -> None:
        """Close both sockets. Idempotent."""
        if self._closed:
            return
        self._closed = True
        for sock in (self.rtp, self.rtcp):
            self._loop.remove_reader(sock)
            self._loop.remove_writer(sock)
            sock.close()


def _udp_socket(family: socket.AddressFamily) -> socket.socket:
    sock = socket.socket(family, socket.SOCK_DGRAM)
    sock.setblocking(False)
    return sock


def _enlarge_receive_buffer(sock: socket.socket) -> None:
    for option in (socket.SO_RCVBUF, SO_RCVBUFFORCE):
        with contextlib.suppress(OSError):  # the second option is for privileged processes
            sock.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER_BYTES)


def _join_group(sock: socket.socket, group: Endpoint) -> None:
    address = socket.inet_pton(group.family, group.host.partition("%")[0])
    if group.family == socket.AF_INET6:
        scope = group.host.partition("%")[2]
        index = socket.if_nametoindex(scope) if scope else 0
        sock.setsockopt(
            socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, address + struct.pack("@I", index)
        )
    else:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, address + struct.pack("=I", 0))


def _set_hop_limit(sock: socket.socket, family: socket.AddressFamily, ttl: int) -> None:
    if family == socket.AF_INET6:
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, ttl)
    else:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, ttl)
