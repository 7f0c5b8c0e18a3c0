"""Helpers of the proxy's tests: ends of connections that keep what comes, and a target for them."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator, Iterator
from typing import Any, NamedTuple

import pytest

from smartcam.testing.proxy import LinkProxy, Rule
from tests.handmade import until

HOST = "127.0.0.1"
SHORT = 0.05
"""Seconds of a timeout that is meant to fire."""
MESSAGE = b"0123456789"
OFFSETS = [0, 5, len(MESSAGE)]
"""Points: before the first byte, in the middle, after the last."""
PLACES = [0, 5, len(MESSAGE) - 1]
"""Bytes: the first, one in the middle, the last."""


class End(asyncio.Protocol):
    """One end of a connection; it closes nothing by itself."""

    def __init__(self, *, echo: bool = False) -> None:
        # what came, delivery by delivery, and the loop time of each in ``times``
        self.chunks: list[bytes] = []
        self.times: list[float] = []
        self.eof = False  # FIN came
        # what ended it, None while it is open; "closed" where no error did
        self.lost: str | None = None
        self.transport: Any = None
        self._echo = echo

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        sock = transport.get_extra_info("socket")
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def data_received(self, data: bytes) -> None:
        self.chunks.append(data)
        self.times.append(asyncio.get_running_loop().time())
        if self._echo:
            self.transport.write(data)

    def eof_received(self) -> bool:
        self.eof = True
        return True

    def connection_lost(self, exc: Exception | None) -> None:
        self.lost = "closed" if exc is None else type(exc).__name__

    @property
    def data(self) -> bytes:
        """All that came."""
        return b"".join(self.chunks)

    def write(self, data: bytes) -> None:
        """Send."""
        self.transport.write(data)

    def reset(self) -> None:
        """End with RST."""
        sock = self.transport.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.transport.abort()

    async def wait_data(self, wanted: bytes) -> None:
        """Wait until exactly these bytes came in all."""
        await until(lambda: len(self.data) >= len(wanted) or self.eof or self.lost)
        assert self.data == wanted

    async def wait_eof(self) -> None:
        """Wait for FIN."""
        await until(lambda: self.eof or self.lost)
        assert self.eof

    async def stays_silent(self) -> None:
        """Assert that nothing more comes, no end either, while a timeout has the time to fire."""
        before = (self.data, self.eof, self.lost)
        with pytest.raises(TimeoutError):
            await until(lambda: (self.data, self.eof, self.lost) != before, SHORT)

    async def wait_lost(self) -> None:
        """Wait until it is over on this side."""
        await until(lambda: self.lost)

    async def wait_reset(self) -> None:
        """Wait for RST; no FIN came before."""
        await until(lambda: self.eof or self.lost)
        assert (self.eof, self.lost) == (False, "ConnectionResetError")


class Target:
    """A listening socket; ``ends`` are the connections it took."""

    def __init__(self) -> None:
        self.port = 0
        self.ends: list[End] = []

    async def accept(self, count: int = 1) -> End:
        """Wait until there were ``count`` connections; return the last."""
        await until(lambda: len(self.ends) >= count and self.ends[count - 1].transport)
        return self.ends[count - 1]


@contextlib.asynccontextmanager
async def target(*, echo: bool = False) -> AsyncIterator[Target]:
    """A target on a free port."""
    made = Target()

    def end() -> End:
        made.ends.append(End(echo=echo))
        return made.ends[-1]

    server = await asyncio.get_running_loop().create_server(end, HOST, 0)
    made.port = server.sockets[0].getsockname()[1]
    try:
        yield made
    finally:
        server.close()
        for one in made.ends:
            if one.transport is not None:
                one.transport.abort()


@contextlib.asynccontextmanager
async def client(port: int) -> AsyncIterator[End]:
    """An end that is connected to a port."""
    _, end = await asyncio.get_running_loop().create_connection(End, HOST, port)
    try:
        yield end
    finally:
        end.transport.abort()


class Linked(NamedTuple):
    """A client and a camera's place with a proxy between."""

    proxy: LinkProxy
    client: End
    camera: End


@contextlib.asynccontextmanager
async def linked(*rules: Rule, echo: bool = False) -> AsyncIterator[Linked]:
    """One connection through a proxy."""
    async with (
        target(echo=echo) as camera,
        LinkProxy(HOST, camera.port, rules=rules) as proxy,
        client(proxy.port) as end,
    ):
        await proxy.wait_for("connect")
        yield Linked(proxy, end, await camera.accept())


@contextlib.contextmanager
def raw_client(port: int) -> Iterator[socket.socket]:
    """A bare socket that is connected to a port."""
    with socket.socket() as sock:
        sock.connect((HOST, port))  # at once, by the system; a reset cannot fall into it
        sock.setblocking(False)
        yield sock


async def rest_of(sock: socket.socket) -> tuple[bytes, str]:
    """Read to the end; return the bytes and how it ended: FIN or RST."""
    loop = asyncio.get_running_loop()
    data = b""
    async with asyncio.timeout(5):
        while True:
            try:
                more = await loop.sock_recv(sock, 1 << 16)
            except ConnectionResetError:
                return data, "RST"
            if not more:
                return data, "FIN"
            data += more


class Mailbox(asyncio.DatagramProtocol):
    """A UDP socket that keeps what comes, and answers with it if it is an echo."""

    def __init__(self, *, echo: bool = False) -> None:
        self.received: list[bytes] = []
        self.peers: list[Any] = []
        self.error: Exception | None = None
        self.port = 0
        self.transport: Any = None
        self._echo = echo

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        self.port = transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self.received.append(data)
        if addr not in self.peers:
            self.peers.append(addr)
        if self._echo:
            self.transport.sendto(data, addr)

    def error_received(self, exc: Exception) -> None:
        self.error = exc

    def send(self, *datagrams: bytes) -> None:
        for one in datagrams:
            self.transport.sendto(one)


@contextlib.asynccontextmanager
async def mailbox(port: int | None = None, *, echo: bool = False) -> AsyncIterator[Mailbox]:
    """A UDP socket: connected to ``port``, or for others to send to."""
    loop = asyncio.get_running_loop()
    where: dict[str, Any] = {"remote_addr": (HOST, port)} if port else {"local_addr": (HOST, 0)}
    transport, box = await loop.create_datagram_endpoint(lambda: Mailbox(echo=echo), **where)
    try:
        yield box
    finally:
        transport.abort()
