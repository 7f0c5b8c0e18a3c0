"""The port, connections and streams of a started server."""

from __future__ import annotations

import asyncio
import logging
import secrets
from typing import TYPE_CHECKING

from smartcam._accepting import Acceptor, Places, is_loopback, share_of
from smartcam.frames._streaming.rtsp.connection import IDLE_TIMEOUT, RtspConnection
from smartcam.frames._streaming.rtsp.messages import RtspError

if TYPE_CHECKING:
    import socket
    from collections.abc import Mapping

    from smartcam.frames._codecs.threads import Codecs
    from smartcam.frames._streaming.rtsp.authentication import Authentication
    from smartcam.frames._streaming.rtsp.session import RtspSession
    from smartcam.frames._streaming.rtsp.streams import RtspStream


_log = logging.getLogger(__name__)


class RtspServing:
    """Accept connections, and count connections and viewers.

    Args:
        streams: streams by their names.
        codecs: open codecs, which are closed with this object.
        authentication: user and password.
        max_connections: largest number of connections.
        max_viewers: largest number of sessions.
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
        self.sdp_session: int = secrets.randbits(31)  # session number in SDP descriptions
        self._streams, self._codecs = streams, codecs
        self._max_viewers = max_viewers
        self._viewer_addresses: list[str] = []  # address of each viewer
        self._listener: socket.socket | None = None
        self.places: Places[RtspConnection] = Places(max_connections, timeout=IDLE_TIMEOUT)
        self._acceptor = Acceptor(
            lambda: RtspConnection(self), self.places, _log, name="smartcam.rtsp"
        )

    def open(self, listener: socket.socket) -> None:
        """Accept connections on a socket, which is closed with this object."""
        self._listener = listener
        self._acceptor.open(listener)

    async def close(self) -> None:
        """Close all connections, streams and codecs."""
        listener, self._listener = self._listener, None
        self._acceptor.close()
        if listener is not None:
            listener.close()
        await self._acceptor.wait_closed()
        connections = list(self.places)
        for connection in connections:
            connection.close("the server is stopped")
        tasks = {connection.task for connection in connections if connection.task is not None}
        if tasks:
            await asyncio.wait(tasks)
        for shared in {
            id(stream.shared_h264): stream.shared_h264 for stream in self._streams.values()
        }.values():
            await shared.close()
        await self._codecs.close()

    # called by the connections

    def register(self, connection: RtspConnection, peer: object) -> str:
        """Register a new connection; return the reason if there are too many, else ""."""
        if self._listener is None:
            return "the server is stopped"
        return self._acceptor.enter(connection, peer)

    def unregister(self, connection: RtspConnection) -> None:
        """Remove a closed connection."""
        self._acceptor.leave(connection)

    def mark_served(self, connection: RtspConnection) -> None:
        """Mark a connection as the most recently served one: others are closed first for room."""
        self._acceptor.restart_idle_time(connection)

    def on_last_session_end(self, connection: RtspConnection) -> None:
        """Start the time limit of a connection that has no session any more."""
        self._acceptor.restart_idle_time(connection)
        self._acceptor.set_time_limit(connection, IDLE_TIMEOUT, "no session")

    def stream(self, name: str) -> RtspStream:
        """Return a stream.

        Raises:
            RtspError: there is no stream of that name.
        """
        if name not in self._streams:
            raise RtspError(404, f"expected one of {', '.join(self._streams)}, got {name[:80]!r}")
        return self._streams[name]

    def add_viewer(self, session: RtspSession, peer: str) -> None:
        """Count a viewer from an address.

        Raises:
            RtspError: there are too many viewers, or too many from the address.
        """
        if len(self._viewer_addresses) >= self._max_viewers:
            raise RtspError(453, f"there are {self._max_viewers} viewers already")
        share = share_of(self._max_viewers)
        if not is_loopback(peer) and self._viewer_addresses.count(peer) >= share:
            raise RtspError(453, f"there are {share} viewers from {peer} already")
        self._viewer_addresses.append(peer)
        session.stream.viewer_count += 1

    def remove_viewer(self, session: RtspSession, peer: str) -> None:
        """Remove a viewer from the count."""
        self._viewer_addresses.remove(peer)
        session.stream.viewer_count -= 1
