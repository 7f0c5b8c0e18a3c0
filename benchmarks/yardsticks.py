"""Bare protocols: they cut frames and do nothing else.

Nothing written in Python is faster on the same loop, so they are the limit.
"""

from __future__ import annotations

import asyncio
import socket
from typing import Any

from benchmarks.peers import wire

__all__ = ["BareClient", "bare_client"]


class BareClient(asyncio.Protocol):
    """Cuts frames; wakes its user when a number of them with one id have come."""

    def __init__(self) -> None:
        self.transport: Any
        self._buffer = b""
        self._wanted = self._missing = 0
        self._waiter: asyncio.Future[None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """asyncio: the link is open."""
        self.transport = transport
        sock = transport.get_extra_info("socket")
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def data_received(self, data: bytes) -> None:
        """asyncio: bytes."""
        buffer = self._buffer + data if self._buffer else data
        size, unpack = wire.HEADER.size, wire.HEADER.unpack_from
        start, available, found = 0, len(buffer), 0
        while available - start >= size:
            _, length, message_id = unpack(buffer, start)
            end = start + size + length
            if end > available:
                break
            self.body = buffer[start + size : end]
            found += message_id == self._wanted
            start = end
        self._buffer = buffer[start:]
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
