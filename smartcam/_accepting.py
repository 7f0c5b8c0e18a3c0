"""Accepting connections on a port, for whoever listens: the emulators and the pages.

Not by ``asyncio.Server``. A connection that it has accepted but not yet wrapped when it is closed
stays open until the garbage collector finds it, and a client would wait for ever. And where no file
descriptor is left, it writes a traceback for each place of its backlog, every second.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from functools import partial
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import logging
    from collections.abc import Callable

ACCEPT_PAUSE = 1.0
"""Seconds until the next try where the system has no socket left."""


class Acceptor:
    """Gives each connection on a listening socket a protocol; how many may stay is theirs to say.

    Args:
        make: returns a new protocol. One that is made after :meth:`close` is for a connection that
            was accepted before.
        log: the logger that is told of what fails.
        name: for tasks.
    """

    def __init__(
        self, make: Callable[[], asyncio.BaseProtocol], log: logging.Logger, name: str
    ) -> None:
        self._make = make
        self._log = log
        self._name = name
        self._socket: socket.socket | None = None
        self._waiting: asyncio.Task[None] | asyncio.TimerHandle | None = None
        self._adopting: set[asyncio.Task[Any]] = set()
        self._scarce = False  # the last try has failed

    def open(self, sock: socket.socket) -> None:
        """Accept from now on; the socket listens and does not block."""
        self._socket = sock
        self._listen(sock)

    def close(self) -> None:
        """Accept nothing more, at once; the socket is its owner's to close."""
        sock, self._socket = self._socket, None
        if sock is not None:
            with contextlib.suppress(NotImplementedError):
                asyncio.get_running_loop().remove_reader(sock)
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    async def wait_closed(self) -> None:
        """Wait until every connection that was accepted has its protocol, or is closed."""
        if self._adopting:
            await asyncio.wait(self._adopting)

    def _listen(self, sock: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        try:
            loop.add_reader(sock, self._accept, sock)
        except NotImplementedError:  # Windows' proactor
            self._waiting = loop.create_task(
                self._accept_for_ever(sock), name=f"{self._name}.accept"
            )

    def _accept(self, sock: socket.socket) -> None:
        try:
            connection, _ = sock.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return  # the client has changed its mind
        except OSError as exc:  # no file descriptor is left: the reader would call without end
            self._tell(exc)
            loop = asyncio.get_running_loop()
            loop.remove_reader(sock)
            self._waiting = loop.call_later(ACCEPT_PAUSE, self._listen, sock)
            return
        connection.setblocking(False)
        self._adopt(connection)

    async def _accept_for_ever(self, sock: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, _ = await loop.sock_accept(sock)
            except OSError as exc:
                self._tell(exc)
                await asyncio.sleep(ACCEPT_PAUSE)
            else:
                self._adopt(connection)

    def _tell(self, exc: OSError) -> None:
        """Say once that nothing can be accepted, until it can be again."""
        if not self._scarce:
            self._log.warning("! a connection cannot be accepted: %s", exc)
        self._scarce = True

    def _adopt(self, connection: socket.socket) -> None:
        """Give an accepted connection its protocol; one that is too late is closed by that."""
        self._scarce = False
        with contextlib.suppress(OSError):  # it is gone again
            # asyncio does so only where the listening socket was made with the protocol's number
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        loop = asyncio.get_running_loop()
        task = loop.create_task(
            loop.connect_accepted_socket(self._make, connection), name=f"{self._name}.adopt"
        )
        self._adopting.add(task)
        task.add_done_callback(partial(self._adopted, connection))

    def _adopted(self, connection: socket.socket, task: asyncio.Task[Any]) -> None:
        self._adopting.discard(task)
        if task.cancelled() or task.exception() is not None:
            self._log.warning("! an accepted connection was lost: %s", task)
            connection.close()
