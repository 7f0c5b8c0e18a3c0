"""Bare protocols: they cut frames and do nothing else.

Nothing written in Python is faster on the same loop, so they are the limit. All that a process has
share one buffer: asyncio reads into it and hands over what came in the same step. A plain
``asyncio.Protocol`` is no limit: for each read, asyncio takes a block of 256 KiB
(:mod:`benchmarks.malloc`).
"""

from __future__ import annotations

import asyncio
import socket
from typing import Any

from benchmarks.peers import wire

__all__ = ["BUFFER", "Bare", "BareClient", "BareDatagrams", "bare_client", "bare_datagrams"]

BUFFER = bytearray(256 * 1024)
"""As much as asyncio reads at once for a plain Protocol."""

VIEW = memoryview(BUFFER)


class Bare(asyncio.BufferedProtocol):
    """What both ends of a link have in common; one that cuts has ``buffer_updated``, too."""

    def __init__(self) -> None:
        self.transport: Any
        self._rest = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """asyncio: the link is open."""
        self.transport = transport
        sock = transport.get_extra_info("socket")
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def get_buffer(self, sizehint: int) -> memoryview:
        """asyncio: where to read to."""
        return VIEW

    def unread(self, size: int) -> tuple[bytes | bytearray, int]:
        """Return bytes of which so many are to be cut: ``size`` have come behind what was left."""
        if not self._rest:
            return BUFFER, size
        data = self._rest + VIEW[:size]
        return data, len(data)

    def keep(self, data: bytes | bytearray, start: int, end: int) -> None:
        """Keep what is no whole frame yet: ``data`` from ``start`` to ``end``."""
        self._rest = bytes(data[start:end]) if start < end else b""


class BareClient(Bare):
    """Cuts frames; wakes its user when a number of them with one id have come."""

    def __init__(self) -> None:
        super().__init__()
        self._wanted = self._missing = 0
        self._waiter: asyncio.Future[None] | None = None

    def buffer_updated(self, size: int) -> None:
        """asyncio: bytes."""
        buffer, available = self.unread(size)
        header, unpack = wire.HEADER.size, wire.HEADER.unpack_from
        start, found = 0, 0
        while available - start >= header:
            _, length, message_id = unpack(buffer, start)
            end = start + header + length
            if end > available:
                break
            self.body = buffer[start + header : end]
            found += message_id == self._wanted
            start = end
        self.keep(buffer, start, available)
        if found and self._waiter is not None:
            self._missing -= found
            if self._missing <= 0:
                self._waiter.set_result(None)
                self._waiter = None

    async def ask(self, request: bytes, wanted: int, count: int = 1) -> None:
        """Send bytes and wait until ``count`` frames with the id ``wanted`` have come."""
        self._wanted, self._missing = wanted, count
        self._waiter = asyncio.get_running_loop().create_future()
        self.transport.write(request)
        await self._waiter


async def bare_client(port: int) -> BareClient:
    """Connect one, in a session."""
    loop = asyncio.get_running_loop()
    _, client = await loop.create_connection(BareClient, "127.0.0.1", port)
    await client.ask(wire.frame(wire.CONNECT), wire.STATUS)
    return client


class BareDatagrams:
    """The same with datagrams, a frame each: a socket that the loop watches, without a transport.

    Args:
        port: of the camera.
    """

    def __init__(self, port: int) -> None:
        self._loop = asyncio.get_running_loop()
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.connect(("127.0.0.1", port))
        self._loop.add_reader(self._socket, self._read)
        self._wanted = -1
        self._waiter: asyncio.Future[None] | None = None

    async def ask(self, request: bytes, wanted: int) -> None:
        """Send a datagram and wait for one with the id ``wanted``."""
        self._wanted = wanted
        self._waiter = self._loop.create_future()
        self._socket.send(request)
        await self._waiter

    def close(self) -> None:
        """Close the socket."""
        self._loop.remove_reader(self._socket)
        self._socket.close()

    def _read(self) -> None:
        size = self._socket.recv_into(BUFFER)
        _, length, message_id = wire.HEADER.unpack_from(BUFFER)
        assert size == wire.HEADER.size + length
        self.body = BUFFER[wire.HEADER.size : size]
        if message_id == self._wanted and self._waiter is not None:
            self._waiter.set_result(None)
            self._waiter = None


async def bare_datagrams(port: int) -> BareDatagrams:
    """Open one, in a session."""
    client = BareDatagrams(port)
    await client.ask(wire.frame(wire.CONNECT), wire.STATUS)
    return client
