"""Sockets of the emulated camera: they move bytes, what they mean is decided elsewhere.

A link is one client's way to the camera: a TCP connection, or all datagrams of one address. Each
has a :class:`~smartcam.protocols.machine.Machine` in the camera's role.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from abc import ABC, abstractmethod
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, cast

from smartcam.exceptions import FrameError, LocalProtocolError, RemoteProtocolError
from smartcam.protocols import messages as m
from smartcam.protocols.base import POLICIES, Policy, Role, Transport
from smartcam.protocols.machine import Machine, State

if TYPE_CHECKING:
    from collections.abc import Mapping
    from contextlib import AbstractContextManager

    from smartcam.emulator.quirks import Quirks
    from smartcam.protocols.base import Dialect
    from smartcam.protocols.framing import Frame

__all__ = [
    "ACCEPT_PAUSE",
    "MAX_INPUT",
    "MAX_LINKS",
    "WRITE_LIMIT",
    "Link",
    "Listener",
    "Station",
    "TcpListener",
    "UdpListener",
]

_log = logging.getLogger("smartcam.emulator")

MAX_INPUT = 1 << 16
"""Bytes of payload the camera takes: input data has the container's limit of about 64 kB (HALCON
script manual p. 35, published for that side)."""

MAX_LINKS = 32
"""Clients that are looked at. The camera serves one; a few more may wait to take over."""

ACCEPT_PAUSE = 1.0
"""Seconds until the next try where the system has no socket left."""

WRITE_LIMIT = 1 << 20
"""Bytes kept for a client that does not read; more end its connection."""


BAD_FRAME: Mapping[str, Policy] = {
    "skip": POLICIES[Role.CAMERA, Transport.TCP],
    "close": Policy(fatal=(FrameError,), exact_length=True),
}
"""What the quirk ``bad_frame`` means on TCP; a broken body or an unknown id never matters."""


class Station(Protocol):
    """What links want from the emulator behind them."""

    @property
    def spoken(self) -> Dialect:
        """The dialect."""
        ...

    @property
    def quirks(self) -> Quirks:
        """The quirks."""
        ...

    def step(self) -> AbstractContextManager[object]:
        """Bring the device's time up; afterwards deliver what it said."""
        ...

    def received(self, link: Link, message: m.Message) -> None:
        """A link received a message."""
        ...

    def serves(self, link: Link) -> bool:
        """Whether the link has the session."""
        ...

    def lost(self, link: Link) -> None:
        """A link is gone; harmless when said twice."""
        ...

    def traced(self, link: Link, sender: m.Sender, what: Frame | RemoteProtocolError) -> None:
        """A machine saw a frame, or bytes that make none."""
        ...


class Link(ABC):
    """One client's way to the camera."""

    def __init__(self, station: Station, transport: Transport, peer: str) -> None:
        self.peer = peer
        self.closed = False
        self._station = station
        self._machine = Machine(
            station.spoken,
            Role.CAMERA,
            transport,
            max_length=MAX_INPUT,
            policy=BAD_FRAME[station.quirks.bad_frame] if transport is Transport.TCP else None,
            trace=self._trace,
        )

    def say(self, message: m.Message) -> None:
        """Put a message behind those that :meth:`flush` will write."""
        try:
            self._machine.send(message)
        except LocalProtocolError as exc:
            _log.warning("! %s: not sent: %s", self.peer, exc)

    @abstractmethod
    def flush(self) -> None:
        """Write everything said."""

    @abstractmethod
    def close(self, reason: str) -> None:
        """End the link; nothing is read or written any more."""

    def _take(self, data: bytes) -> None:
        """Feed the machine and pass its messages on."""
        self._machine.receive_data(data)
        for event in self._machine.events():
            if isinstance(event, m.Message) and not self.closed:
                self._station.received(self, event)

    def _trace(self, sender: m.Sender, what: Frame | RemoteProtocolError) -> None:
        self._station.traced(self, sender, what)


def _peer_text(address: Any) -> str:
    return f"{address[0]}:{address[1]}" if address else "?"


# ---------------------------------------------------------------------- TCP


class _TcpLink(Link, asyncio.Protocol):
    """A connection. All that one step causes goes out in one write (SC manual p. 40)."""

    _transport: asyncio.Transport

    def __init__(self, listener: TcpListener, station: Station) -> None:
        super().__init__(station, Transport.TCP, "?")
        self._listener = listener

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self.peer = _peer_text(transport.get_extra_info("peername"))
        self._listener.links.add(self)
        if not self._listener.open:
            self.close("the camera is down")
            return
        if len(self._listener.links) > MAX_LINKS:
            self.close(f"{MAX_LINKS} connections are open already")
            return
        # the camera does so too (newest SC manual p. 40: published)
        with contextlib.suppress(OSError):  # the client may be gone already
            transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def data_received(self, data: bytes) -> None:
        with self._station.step():
            self._take(data)
            self.flush()  # also what was said before a Disconnect in the same bytes
            if self._machine.state is State.FAILED:
                self.close("a broken frame came")

    def connection_lost(self, exc: Exception | None) -> None:
        self.closed = True
        self._listener.links.discard(self)
        with self._station.step():
            self._station.lost(self)

    def flush(self) -> None:
        data = b"".join(self._machine.data_to_send())
        if not data or self.closed:
            return
        if self._transport.get_write_buffer_size() + len(data) > WRITE_LIMIT:
            self.close(f"it does not read: more than {WRITE_LIMIT} bytes wait for it")
            return
        self._transport.write(data)

    def close(self, reason: str) -> None:
        if not self.closed:
            self.closed = True
            _log.info("= %s: connection closed: %s", self.peer, reason)
            self._transport.abort()
            self._listener.links.discard(self)
            self._station.lost(self)


class Listener(ABC):
    """The camera's port; it can be shut and opened again."""

    kind: socket.SocketKind

    @property
    @abstractmethod
    def all_links(self) -> list[Link]:
        """The links that are open."""

    @abstractmethod
    async def serve(self, sock: socket.socket) -> None:
        """Serve a bound socket."""

    @abstractmethod
    def shut(self) -> None:
        """Close the port and every link, at once."""

    async def wait_closed(self) -> None:
        """Wait until the event loop has let go of all sockets."""
        # transports that were aborted call connection_lost in the loop's next round
        for _ in range(2):
            await asyncio.sleep(0)


class TcpListener(Listener):
    """Accepts connections.

    Not by ``asyncio.Server``: a connection that it has accepted but not yet wrapped when it is
    closed stays open until the garbage collector finds it, and a client would wait for ever.
    """

    kind = socket.SOCK_STREAM

    def __init__(self, station: Station) -> None:
        self.links: set[_TcpLink] = set()
        self._station = station
        self._socket: socket.socket | None = None
        self._waiting: asyncio.Task[None] | asyncio.TimerHandle | None = None
        self._adopting: set[asyncio.Task[Any]] = set()

    @property
    def all_links(self) -> list[Link]:
        """The links that are open."""
        return list(self.links)

    @property
    def open(self) -> bool:
        """Whether the port is open."""
        return self._socket is not None

    async def serve(self, sock: socket.socket) -> None:
        """Serve a bound socket that listens."""
        self._socket = sock
        self._listen(sock)

    def shut(self) -> None:
        """Close the port and every link, at once; the socket is its owner's to close."""
        sock, self._socket = self._socket, None
        if sock is not None:
            with contextlib.suppress(NotImplementedError):
                asyncio.get_running_loop().remove_reader(sock)
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None
        for link in self.all_links:
            link.close("the camera is down")

    async def wait_closed(self) -> None:
        """Wait until the event loop has let go of all sockets."""
        if self._adopting:
            await asyncio.wait(self._adopting)
        await super().wait_closed()

    def _listen(self, sock: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        try:
            loop.add_reader(sock, self._accept, sock)
        except NotImplementedError:  # Windows' proactor
            self._waiting = loop.create_task(
                self._accept_for_ever(sock), name="smartcam.emulator.accept"
            )

    def _accept(self, sock: socket.socket) -> None:
        try:
            connection, _ = sock.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return  # the client has changed its mind
        except OSError as exc:  # no file descriptor is left: the reader would call without end
            _log.warning("! a connection cannot be accepted: %s", exc)
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
                _log.warning("! a connection cannot be accepted: %s", exc)
                await asyncio.sleep(ACCEPT_PAUSE)
            else:
                self._adopt(connection)

    def _adopt(self, connection: socket.socket) -> None:
        """Make a link of an accepted connection; one that is too late is closed by its link."""
        loop = asyncio.get_running_loop()
        task = loop.create_task(
            loop.connect_accepted_socket(lambda: _TcpLink(self, self._station), connection),
            name="smartcam.emulator.adopt",
        )
        self._adopting.add(task)
        task.add_done_callback(partial(self._adopted, connection))

    def _adopted(self, connection: socket.socket, task: asyncio.Task[Any]) -> None:
        self._adopting.discard(task)
        if task.cancelled() or task.exception() is not None:
            _log.warning("! an accepted connection was lost: %s", task)
            connection.close()


# ---------------------------------------------------------------------- UDP


class _UdpLink(Link):
    """The datagrams of one address; one message is one datagram (SC manual p. 40)."""

    def __init__(self, listener: UdpListener, station: Station, address: Any) -> None:
        super().__init__(station, Transport.UDP, _peer_text(address))
        self._listener = listener
        self._address = address

    def datagram_received(self, data: bytes) -> None:
        with self._station.step():
            self._take(data)
            self.flush()

    def flush(self) -> None:
        for frame in self._machine.data_to_send():
            self._listener.send(frame, self._address)

    def close(self, reason: str) -> None:
        if not self.closed:
            self.closed = True
            _log.debug("= %s: forgotten: %s", self.peer, reason)
            self._listener.links.pop(self._address, None)
            self._station.lost(self)


class UdpListener(Listener, asyncio.DatagramProtocol):
    """Sorts datagrams by address."""

    kind = socket.SOCK_DGRAM

    def __init__(self, station: Station) -> None:
        self.links: dict[Any, _UdpLink] = {}  # the one that was heard last stands last
        self._station = station
        self._transport: asyncio.DatagramTransport | None = None

    @property
    def all_links(self) -> list[Link]:
        """The links that are open."""
        return list(self.links.values())

    async def serve(self, sock: socket.socket) -> None:
        """Serve a bound socket."""
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(lambda: self, sock=sock)

    def shut(self) -> None:
        """Close the port and every link, at once."""
        transport, self._transport = self._transport, None
        if transport is not None:
            transport.abort()
        for link in self.all_links:
            link.close("the camera is down")

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Pass it to the link of its address; too many links drop the one silent for longest."""
        if self._transport is None:
            return  # the port is shut, the loop had this one already
        link = self.links.pop(addr, None) or _UdpLink(self, self._station, addr)
        self.links[addr] = link
        if len(self.links) > MAX_LINKS:
            next(old for old in self.all_links if not self._station.serves(old)).close("idle")
        link.datagram_received(data)

    def error_received(self, exc: Exception) -> None:
        """Nobody reads the answers at a peer any more; the camera does not notice."""
        _log.debug("! datagram not delivered: %s", exc)

    def send(self, frame: bytes, address: Any) -> None:
        """Send one datagram."""
        if self._transport is None:
            return
        # the abstract class lacks it, every transport of asyncio has it
        if cast("asyncio.Transport", self._transport).get_write_buffer_size() > WRITE_LIMIT:
            _log.warning("! %s: datagram dropped: the network is too slow", _peer_text(address))
            return
        self._transport.sendto(frame, address)
