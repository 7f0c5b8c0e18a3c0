"""What a server has while it is started: its port, connections and streams."""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
from typing import TYPE_CHECKING, Final

from smartcam._accepting import Acceptor
from smartcam.frames._rtsp.connection import RtspConnection
from smartcam.frames._rtsp.messages import RtspError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.frames._codecs import Codecs
    from smartcam.frames._rtsp.authentication import Authentication
    from smartcam.frames._rtsp.session import RtspSession
    from smartcam.frames._rtsp.streams import RtspStream


_log = logging.getLogger(__name__)

BACKLOG: Final = 16
RESOLVE_TIMEOUT: Final = 5.0


class RtspServing:
    """Takes connections, and counts them and their viewers.

    Args:
        streams: by their names.
        codecs: open; they are closed with it.
        authentication: who may look.
        max_connections: at a time.
        max_viewers: sessions at a time.
    """

    def __init__(
        self,
        streams: Mapping[str, RtspStream],
        codecs: Codecs,
        authentication: Authentication,
        max_connections: int,
        max_viewers: int,
    ) -> None:
        self.authentication = authentication
        self.number: int = secrets.randbits(31)  # of its descriptions
        self.connections: set[RtspConnection] = set()
        self._streams, self._codecs = streams, codecs
        self._max_connections, self._max_viewers = max_connections, max_viewers
        self._viewers = 0
        self._listener: socket.socket | None = None
        self._acceptor = Acceptor(lambda: RtspConnection(self), _log, name="smartcam.rtsp")

    def open(self, listener: socket.socket) -> None:
        """Take connections from now on; the socket is closed with it."""
        self._listener = listener
        self._acceptor.open(listener)

    async def close(self) -> None:
        """Say goodbye, and close everything."""
        listener, self._listener = self._listener, None
        self._acceptor.close()
        if listener is not None:
            listener.close()
        await self._acceptor.wait_closed()
        for connection in list(self.connections):
            connection.close("the server is stopped")
        tasks = {one.task for one in self.connections if one.task is not None}
        if tasks:
            await asyncio.wait(tasks)
        for shared in {id(one.shared): one.shared for one in self._streams.values()}.values():
            await shared.close()
        await self._codecs.close()

    # what its connections ask

    def enter(self, connection: RtspConnection) -> bool:
        """Take a new connection; return whether there is room for it."""
        if self._listener is None or len(self.connections) >= self._max_connections:
            return False
        self.connections.add(connection)
        return True

    def leave(self, connection: RtspConnection) -> None:
        """Forget a connection that is closed."""
        self.connections.discard(connection)

    def stream(self, name: str) -> RtspStream:
        """Return a stream.

        Raises:
            RtspError: there is none of that name.
        """
        if name not in self._streams:
            raise RtspError(404, f"expected one of {', '.join(self._streams)}, got {name[:80]!r}")
        return self._streams[name]

    def admit(self, session: RtspSession) -> None:
        """Count a viewer.

        Raises:
            RtspError: there are too many.
        """
        if self._viewers >= self._max_viewers:
            raise RtspError(453, f"{self._max_viewers} others look already")
        self._viewers += 1
        session.stream.viewers += 1

    def dismiss(self, session: RtspSession) -> None:
        """Count a viewer no longer."""
        self._viewers -= 1
        session.stream.viewers -= 1


async def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens.

    Raises:
        OSError, ValueError, OverflowError: it cannot be had.
    """
    loop = asyncio.get_running_loop()
    async with asyncio.timeout(RESOLVE_TIMEOUT):
        found = await loop.getaddrinfo(host or "0.0.0.0", port, type=socket.SOCK_STREAM)  # noqa: S104
    family, _, _, _, address = found[0]
    listener = socket.create_server((address[0], port), family=family, backlog=BACKLOG)
    listener.setblocking(False)
    return listener
