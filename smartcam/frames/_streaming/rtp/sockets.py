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
    """An address with its kind.

    Attributes:
        family: family of the sockets.
        host: numeric address.
        port: port of RTP; RTCP uses the next port.
    """

    family: socket.AddressFamily
    host: str
    port: int

    @property
    def multicast(self) -> bool:
        """True for a multicast group."""
        return ipaddress.ip_address(self.host.partition("%")[0]).is_multicast

    @property
    def reports(self) -> tuple[str, int]:
        """Address for RTCP."""
        return self.host, self.port + 1

    def __str__(self) -> str:
        """Return ``HOST:PORT``."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


async def resolved(host: str, port: int, label: str) -> Endpoint:
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
    family, *_, where = addresses[0]
    return Endpoint(family, str(where[0]), port)


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
    def listening(cls, at: Endpoint) -> SocketPair:
        """Return the sockets of a receiver; a multicast group is joined.

        Raises:
            OSError: the port is in use, or this machine has no such address.
        """
        with contextlib.ExitStack() as stack:
            made = []
            for port in (at.port, at.port + 1):
                sock = stack.enter_context(_socket(at.family))
                _grown(sock)
                if at.multicast:
                    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                sock.bind((at.host if sys.platform == "linux" or not at.multicast else "", port))
                if at.multicast:
                    _join(sock, at)
                made.append(sock)
            stack.pop_all()
        return cls(*made)

    @classmethod
    def waiting(cls, at: Endpoint) -> SocketPair:
        """Return sockets for receiving on an even port of an address, and the next port.

        Raises:
            OSError: no ports are free.
        """
        for left in reversed(range(MAX_TRIES)):
            with _socket(at.family) as probe:
                probe.bind((at.host, 0))
                even = probe.getsockname()[1] & ~1
            try:
                return cls.listening(at._replace(port=even))
            except OSError:
                if not left:
                    raise
        raise AssertionError("unreachable")

    @classmethod
    def sending(cls, to: Endpoint, ttl: int) -> SocketPair:
        """Return the sockets of a sender.

        Raises:
            OSError: no ports are free.
        """
        for left in reversed(range(MAX_TRIES)):
            with contextlib.ExitStack() as stack:
                rtp, rtcp = (stack.enter_context(_socket(to.family)) for _ in range(2))
                rtp.bind(("", 0))
                port = rtp.getsockname()[1]
                try:
                    rtcp.bind(("", port + 1 if port < 65535 else 0))
                except OSError:
                    if not left:
                        raise
                    continue
                rtp.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
                for sock in (rtp, rtcp):
                    if to.multicast:
                        _hops(sock, to.family, ttl)
                stack.pop_all()
                return cls(rtp, rtcp)
        raise AssertionError("unreachable")

    def read(
        self,
        rtp: Callable[[bytes, tuple[Any, ...]], None] | None,
        rtcp: Callable[[bytes, tuple[Any, ...]], None],
        read: Callable[[], None] = lambda: None,
    ) -> None:
        """Call a function for each datagram with its sender, until :meth:`close`.

        Args:
            rtp: function for the stream's packets; None: do not read them.
            rtcp: function for reports.
            read: function that is called after each batch.
        """
        for sock, take in ((self.rtp, rtp), (self.rtcp, rtcp)):
            if take is not None:
                self._loop.add_reader(sock, self._readable, sock, take, read)

    def _readable(
        self,
        sock: socket.socket,
        take: Callable[[bytes, tuple[Any, ...]], None],
        read: Callable[[], None],
    ) -> None:
        for _ in range(MAX_DATAGRAMS_PER_TURN):
            if self._closed:
                return
            try:
                data, sender = sock.recvfrom(65536)
            except BlockingIOError:
                break
            except OSError:  # an error of an earlier sent datagram; reading goes on
                continue
            take(data, sender)
        if not self._closed:
            read()

    def report(self, data: bytes, to: tuple[Any, ...]) -> None:
        """Send RTCP; drop it if the system does not accept it, since reports are repeated."""
        with contextlib.suppress(OSError):
            self.rtcp.sendto(data, to)

    async def writable(self, within: float) -> None:
        """Wait until the stream's socket accepts data, or until a time limit."""
        free = asyncio.Event()
        self._loop.add_writer(self.rtp, free.set)
        try:
            async with asyncio.timeout(within):
                await free.wait()
        except TimeoutError:
            pass
        finally:
            if not self._closed:
                self._loop.remove_writer(self.rtp)

    def close(self) -> None:
        """Close both. Idempotent."""
        if self._closed:
            return
        self._closed = True
        for sock in (self.rtp, self.rtcp):
            self._loop.remove_reader(sock)
            self._loop.remove_writer(sock)
            sock.close()


def _socket(family: socket.AddressFamily) -> socket.socket:
    made = socket.socket(family, socket.SOCK_DGRAM)
    made.setblocking(False)
    return made


def _grown(sock: socket.socket) -> None:
    for option in (socket.SO_RCVBUF, SO_RCVBUFFORCE):
        with contextlib.suppress(OSError):  # the second option is for privileged processes
            sock.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER_BYTES)


def _join(sock: socket.socket, group: Endpoint) -> None:
    address = socket.inet_pton(group.family, group.host.partition("%")[0])
    if group.family == socket.AF_INET6:
        scope = group.host.partition("%")[2]
        index = socket.if_nametoindex(scope) if scope else 0
        sock.setsockopt(
            socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, address + struct.pack("@I", index)
        )
    else:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, address + struct.pack("=I", 0))


def _hops(sock: socket.socket, family: socket.AddressFamily, ttl: int) -> None:
    if family == socket.AF_INET6:
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, ttl)
    else:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, ttl)
