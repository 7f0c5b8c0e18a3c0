"""Small servers written by hand: what the client's links are tried against, byte for byte.

They use nothing of smartcam: what they say is hex from the documents.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from typing import Any, NamedTuple

HOST = "127.0.0.1"
LIMIT = 5.0
"""Seconds after which a wait for something that should happen at once fails the test."""
PATIENCE = 60.0
"""The same where a thread or a real clock may have a part in it."""

# dialect handbook
CONNECT = bytes.fromhex("50535642 00000000 01000000")
CONNECT_ANSWER = bytes.fromhex("50535642 04000000 01000000 01000000")
DISCONNECT = bytes.fromhex("50535642 00000000 02000000")
QUERY = bytes.fromhex("50535642 00000000 30000000")
QUERY_ANSWER = bytes.fromhex("50535642 04000000 30000000 15000000")
TRIGGER = bytes.fromhex("50535642 00000000 40000000")
STATUS = bytes.fromhex("50535642 08000000 12000000 80020000 00000000")
BUSY = bytes.fromhex("50535642 08000000 12000000 10000000 00000000")
RESULT = bytes.fromhex("50535642 09000000 20000000 15000000 48656c6c6f")
OPENING = DISCONNECT + CONNECT
"""Bytes that a client sends first."""

# dialect thesis
THESIS_OPENING = bytes.fromhex("42565350 04000000 02000000 42565350 04000000 01000000")
THESIS_CONNECT_ANSWER = bytes.fromhex("42565350 08000000 01000000 01000000")
THESIS_STATUS = bytes.fromhex("42565350 0c000000 12000000 80020000 00000000")
THESIS_QUERY = bytes.fromhex("42565350 04000000 30000000")
THESIS_QUERY_ANSWER = bytes.fromhex("42565350 08000000 30000000 03000000")


async def until(condition: Callable[[], object], seconds: float = PATIENCE) -> None:
    """Let the loop run until ``condition`` holds."""
    async with asyncio.timeout(seconds):
        while not condition():  # noqa: ASYNC110 - what is waited for has no event of its own
            await asyncio.sleep(0)


class Peer(NamedTuple):
    """One accepted connection."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    async def read(self, count: int) -> bytes:
        """Return exactly ``count`` bytes."""
        async with asyncio.timeout(LIMIT):
            return await self.reader.readexactly(count)

    async def rest(self) -> bytes:
        """Return what comes until the other side ends; b"" where it only reset the link."""
        async with asyncio.timeout(LIMIT):
            with contextlib.suppress(ConnectionError):
                return await self.reader.read()
            return b""

    def write(self, data: bytes) -> None:
        """Send."""
        self.writer.write(data)

    def close(self) -> None:
        """End the connection in order."""
        self.writer.close()

    def pause_reading(self) -> None:
        """Take nothing from the socket."""
        transport: Any = self.writer.transport
        transport.pause_reading()

    def resume_reading(self) -> None:
        """Take from the socket again."""
        transport: Any = self.writer.transport
        transport.resume_reading()

    def reset(self) -> None:
        """End the connection with RST."""
        sock = self.writer.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.writer.transport.abort()


class Listener:
    """A listening socket; connections are taken by :meth:`accept`."""

    def __init__(self) -> None:
        self.port = 0
        self.peers: list[Peer] = []
        self._fresh: asyncio.Queue[Peer] = asyncio.Queue()

    def made(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """asyncio: a connection."""
        peer = Peer(reader, writer)
        self.peers.append(peer)
        self._fresh.put_nowait(peer)

    async def accept(self) -> Peer:
        """Return the next connection."""
        async with asyncio.timeout(LIMIT):
            return await self._fresh.get()

    async def next_peer(self) -> Peer:
        """Return the next connection, whenever it comes."""
        return await self._fresh.get()


@contextlib.asynccontextmanager
async def listening() -> AsyncIterator[Listener]:
    """A server on a free port; every connection is dropped at the end."""
    listener = Listener()
    server = await asyncio.start_server(listener.made, HOST, 0)
    listener.port = server.sockets[0].getsockname()[1]
    try:
        yield listener
    finally:
        for peer in listener.peers:
            peer.writer.transport.abort()
        server.close()
        await server.wait_closed()


@contextlib.asynccontextmanager
async def scripted(talk: Callable[[Peer, int], Awaitable[None]]) -> AsyncIterator[Listener]:
    """A server that talks to each connection as told: the peer and its number, from 1.

    What goes wrong in the talk fails the test; a talk that is under way at the end is cancelled.
    """
    async with listening() as listener:
        talks: list[asyncio.Task[None]] = []

        async def take() -> None:
            while True:
                peer = await listener.next_peer()
                talks.append(asyncio.create_task(run(peer, len(talks) + 1)))

        async def run(peer: Peer, number: int) -> None:
            with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
                await talk(peer, number)

        taking = asyncio.create_task(take())
        try:
            yield listener
        finally:
            for task in (taking, *talks):
                task.cancel()
            await asyncio.wait([taking, *talks])
        for task in talks:
            if not task.cancelled():
                task.result()


class Datagrams(asyncio.DatagramProtocol):
    """A UDP server: keeps what comes and answers with what ``answer`` gives."""

    def __init__(self, answer: Callable[[bytes], list[bytes]]) -> None:
        self.received: list[bytes] = []
        self.clients: list[Any] = []
        self.port = 0
        self._answer = answer
        self._transport: Any = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """asyncio: the socket is open."""
        self._transport = transport
        self.port = transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """asyncio: a datagram."""
        self.received.append(data)
        if addr not in self.clients:
            self.clients.append(addr)
        self.send(*self._answer(data))

    def send(self, *datagrams: bytes) -> None:
        """Send to the last client."""
        for one in datagrams:
            self._transport.sendto(one, self.clients[-1])


@contextlib.asynccontextmanager
async def datagrams(
    answer: Callable[[bytes], list[bytes]] = lambda data: [],
) -> AsyncIterator[Datagrams]:
    """A UDP server on a free port."""
    loop = asyncio.get_running_loop()
    transport, protocol = await loop.create_datagram_endpoint(
        lambda: Datagrams(answer), local_addr=(HOST, 0)
    )
    try:
        yield protocol
    finally:
        transport.abort()


@contextlib.contextmanager
def refusing(kind: socket.SocketKind) -> Iterator[int]:
    """A port of our own at which nothing listens: what is sent there is refused at once."""
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind((HOST, 0))
        if kind is socket.SOCK_DGRAM:
            sock.connect((HOST, 9))  # it takes datagrams of that peer alone
        yield sock.getsockname()[1]
