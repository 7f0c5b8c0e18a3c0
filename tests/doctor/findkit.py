"""Servers on loopback addresses for the tests of searches: cameras and others."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from typing import TYPE_CHECKING

import pytest

from smartcam.emulator import EmulatedCamera

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from smartcam.emulator._inside import ClientLink

NETWORK = f"127.{100 + os.getpid() % 100}.{os.getpid() // 100 % 250 + 1}."
"""First three numbers of addresses that only this process uses, for tests in parallel."""


def free_port() -> int:
    """Return a free port; no other test takes ports on the network's addresses."""
    with socket.socket() as sock:
        try:
            sock.bind((f"{NETWORK}1", 0))
        except OSError:
            pytest.skip("this system has no loopback address but 127.0.0.1")
        return int(sock.getsockname()[1])


class Listening:
    """A server that sends ``greeting``, and then is silent or closes the connection.

    ``slowly``: seconds between two bytes of the greeting.

    Attributes:
        received: bytes from all clients.
        opened: number of connections so far.
        ended: number of connections that clients have closed.
    """

    def __init__(self, greeting: bytes, *, hangs_up: bool, slowly: float) -> None:
        self.received = b""
        self.opened = 0
        self.ended = 0
        self._greeting = greeting
        self._hangs_up = hangs_up
        self._slowly = slowly

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.opened += 1
        with contextlib.suppress(ConnectionError):
            for index in range(len(self._greeting) if self._slowly else 0):
                writer.write(self._greeting[index : index + 1])
                await asyncio.sleep(self._slowly)
            if not self._slowly:
                writer.write(self._greeting)
            while not self._hangs_up and (data := await reader.read(4096)):
                self.received += data
        self.ended += not self._hangs_up
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


@contextlib.asynccontextmanager
async def listening(
    host: str, port: int, greeting: bytes = b"", *, hangs_up: bool = False, slowly: float = 0.0
) -> AsyncIterator[Listening]:
    """Run a :class:`Listening` server at an address."""
    server = Listening(greeting, hangs_up=hangs_up, slowly=slowly)
    async with await asyncio.start_server(server.serve, host, port):
        yield server


@contextlib.contextmanager
def filtered(host: str, port: int) -> Iterator[None]:
    """Listen at an address that answers nothing: its queue of connections is full."""
    with contextlib.ExitStack() as stack:
        sock = stack.enter_context(socket.create_server((host, port), backlog=0))
        for _ in range(4):
            client = stack.enter_context(socket.socket())
            client.setblocking(False)
            client.connect_ex(sock.getsockname())
        yield


class TakenAtOnce(EmulatedCamera):
    """A camera whose session a bare connection takes; no document says whether cameras do that."""

    def connection_begun(self, link: ClientLink) -> None:
        super().connection_begun(link)
        old = self._session_link
        if isinstance(old, type(link)) and old is not link:
            old.close("a newcomer")


class RefusesAtOnce(EmulatedCamera):
    """A camera that closes every new connection at once while it has a session."""

    def connection_begun(self, link: ClientLink) -> None:
        super().connection_begun(link)
        if self.has_session and not self.serves(link):
            link.close("another client has the session")
