"""Open, close and reopen the port of an emulated camera, always with the same number."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from smartcam._accepting import BACKLOG

if TYPE_CHECKING:
    from smartcam.emulator._links import Listener

_log = logging.getLogger("smartcam.emulator")

RETRY_PAUSE = 0.2  # seconds between two tries to open the port again


@dataclass(eq=False)
class Port:
    """A port and its listener."""

    _listener: Listener
    _host: str
    number: int  # 0 for a free one until it is open
    _name: str  # name for logs

    def __post_init__(self) -> None:
        self._address: tuple[int, Any] = (socket.AF_INET, (self._host, self.number))
        self._socket: socket.socket | None = None
        self._opening: asyncio.Task[None] | None = None
        self._handing_over = False  # True while the loop takes the socket over

    async def open(self) -> None:
        """Open the port for the first time.

        Raises:
            OSError, ValueError, OverflowError: the port is not available.

        Cancellation: leaves the port closed.
        """
        try:
            self._address = await self._resolve()
            self._socket = self._bind()
            self.number = self._socket.getsockname()[1]
            await self._hand_over(self._socket)
        except BaseException:
            self.close_with_links()
            raise

    def reopen(self) -> None:
        """Open the port again, at once or as soon as it is free."""
        try:
            self._socket = self._bind()
        except OSError:
            self._socket = None  # another program or the loop still has it
        self._opening = asyncio.get_running_loop().create_task(
            self._reopen(self._opening), name=f"smartcam.emulator[{self._name}].reopen"
        )

    def close(self) -> None:
        """Close the port; connections stay."""
        self._stop_opening()
        self._listener.close_port()
        self._close_socket()

    def close_with_links(self) -> None:
        """Close the port and every link."""
        self._stop_opening()
        self._listener.close_with_links()
        self._close_socket()

    async def wait_closed(self) -> None:
        """Wait until the port and all links are closed; call :meth:`close_with_links` before."""
        opening, self._opening = self._opening, None
        if opening is not None:
            await asyncio.wait({opening})
        await self._listener.wait_closed()

    async def _resolve(self) -> tuple[int, Any]:
        loop = asyncio.get_running_loop()
        addresses = await loop.getaddrinfo(self._host, self.number, type=self._listener.kind)
        return addresses[0][0], addresses[0][4]

    def _bind(self) -> socket.socket:
        family, address = self._address
        sock = socket.socket(family, self._listener.kind)
        try:
            sock.setblocking(False)
            if self._listener.kind is socket.SOCK_STREAM and os.name == "posix":
                # the camera comes up on its old port while old connections linger
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((address[0], self.number, *address[2:]))
            if self._listener.kind is socket.SOCK_STREAM:
                sock.listen(BACKLOG)
        except BaseException:
            sock.close()
            raise
        return sock

    async def _reopen(self, earlier_try: asyncio.Task[None] | None) -> None:
        if earlier_try is not None:  # an earlier, cancelled try must release its socket first
            await asyncio.wait({earlier_try})
        while True:
            try:
                self._socket = self._socket or self._bind()
                await self._hand_over(self._socket)
            except OSError as exc:
                _log.warning("! %s: port %d cannot be opened yet: %s", self._name, self.number, exc)
                await asyncio.sleep(RETRY_PAUSE)
            else:
                return

    async def _hand_over(self, sock: socket.socket) -> None:
        self._handing_over = True
        try:
            await self._listener.serve(sock)
        finally:
            self._handing_over = False

    def _stop_opening(self) -> None:
        if self._opening is not None:
            self._opening.cancel()

    def _close_socket(self) -> None:
        sock, self._socket = self._socket, None
        if sock is None:
            return
        if self._handing_over and self._opening is not None:
            self._opening.add_done_callback(lambda _: sock.close())
        else:
            sock.close()  # not served yet, or closed already
