"""Listen for clients of an emulated camera, and move bytes without interpreting them.

A client's link is a TCP connection, or all datagrams of one address.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import struct
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Literal, cast

from smartcam._accepting import DESCRIPTORS_LEFT_BY_EMULATORS, HANDSHAKE_TIMEOUT, Acceptor, Places
from smartcam._datagrams import limit_read_size
from smartcam.emulator._client_link import ClientLink
from smartcam.protocols import State, Transport

if TYPE_CHECKING:
    from smartcam.emulator._client_link import LinkOwner

_log = logging.getLogger("smartcam.emulator")

CLOSE_TIMEOUT = 1.0
"""Seconds of real time in which a client must close its side after a fault closed the camera's."""

_NO_LINGER = struct.pack("hh" if os.name == "nt" else "ii", 1, 0)

FIRST_READ_BYTES = 1 << 10
"""Size of a connection's first read buffer: messages of clients are short, and hundreds of cameras
may have a buffer each. The buffer doubles after each full read, as input data needs, and shrinks to
this size after a read that was not full."""

MAX_READ_BYTES = 1 << 16
"""Largest number of bytes of a connection's read buffer."""

REFUSED = "refuse"
"""Kind of the fault that closes the port for a time."""


def _peer_text(address: Any) -> str:
    return f"{address[0]}:{address[1]}" if address else "?"


# ---------------------------------------------------------------------- TCP


class _TcpLink(ClientLink, asyncio.BufferedProtocol):
    """A connection. All messages of one step are sent by one write (SC manual p. 40)."""

    _transport: asyncio.Transport

    def __init__(self, listener: TcpListener, owner: LinkOwner) -> None:
        super().__init__(owner, Transport.TCP, "?")
        self.address: Any = None
        self._listener = listener
        self._abort_timer: asyncio.TimerHandle | None = None
        self._close_is_pending = False
        self._read_buffer = memoryview(bytearray(FIRST_READ_BYTES))

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self.address = transport.get_extra_info("peername")
        self.peer: str = _peer_text(self.address)
        if self._listener.is_down:
            self.close("the camera is down")
            return
        refusal = self._listener.enter(self)
        if refusal:
            self.close(refusal)
            return
        # the camera switches Nagle's algorithm off (newest SC manual p. 40: published)
        with contextlib.suppress(OSError):  # the client may be gone already
            transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._owner.connection_begun(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._read_buffer

    def buffer_updated(self, nbytes: int) -> None:
        buffer, size = self._read_buffer, len(self._read_buffer)
        data = bytes(buffer[:nbytes])
        if nbytes == size < MAX_READ_BYTES:
            self._read_buffer = memoryview(bytearray(2 * size))
        elif nbytes < size > FIRST_READ_BYTES:
            self._read_buffer = memoryview(bytearray(FIRST_READ_BYTES))
        if self.closed:  # the last bytes before the end
            return
        with self._owner.step():
            self._handle_bytes(data)
            self.answer_messages()

    def eof_received(self) -> bool:
        """Note that the client has closed its side; first handle bytes that faults hold back."""
        self._close_is_pending = self._faulty is not None and self._faulty.holds_input
        return self._close_is_pending

    def answer_messages(self) -> None:
        self.flush()  # also answers before a Disconnect in the same bytes
        if self.machine.state is State.FAILED:
            self.close("a broken frame came")
        elif self._close_is_pending and (self._faulty is None or not self._faulty.holds_input):
            self._transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._abort_timer is not None:
            self._abort_timer.cancel()
        by_client = not self.closed
        self._mark_closed()
        self._listener.leave(self)
        with self._owner.step():
            self._owner.forget_link(self)
        self._owner.connection_ended(self, by_client=by_client, reset=exc is not None)

    def write(self, data: bytes) -> bool:
        if self.closed:
            return False
        if self._transport.get_write_buffer_size() + len(data) > self._owner.write_limit:
            self.close(f"it does not read: more than {self._owner.write_limit} bytes wait for it")
            return False
        self._transport.write(data)
        return True

    def session_ended(self) -> None:
        self._listener.session_ended(self)

    def close(self, reason: str) -> None:
        self._listener.leave(self)
        if not self.closed:
            self._mark_closed()
            _log.info("= %s: connection closed: %s", self.peer, reason)
            self._owner.forget_link(self)
        self._transport.abort()

    def end_link(self, how: Literal["close", "reset"], reason: str = "a fault ends it") -> None:
        if how == "reset":
            with contextlib.suppress(OSError):  # the client may be gone already
                sock = self._transport.get_extra_info("socket")
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
            self.close("a fault resets it")
            return
        self._mark_closed()
        _log.info("= %s: connection closed: %s", self.peer, reason)
        self._owner.forget_link(self)
        # closing a socket with unread bytes sends a reset, so it stays open until the client
        # has closed its side, too
        with contextlib.suppress(OSError):
            self._transport.write_eof()
        loop = asyncio.get_running_loop()
        self._abort_timer = loop.call_later(CLOSE_TIMEOUT, self._transport.abort)

    def stop_reading(self) -> None:
        self._transport.pause_reading()
        self._listener.lift_time_limit(self)

    def set_paused(self, paused: bool) -> None:
        if paused:
            self._transport.pause_reading()
        elif self._faulty is None or not self._faulty.is_dead:
            self._transport.resume_reading()

    def end_fault_effects(self) -> None:
        if self._faulty is not None and self._faulty.muted_by is not None:
            self.end_link("reset")

    def _write_frames(self, frames: list[bytes]) -> None:
        if frames:
            self.write(b"".join(frames))


class Listener(ABC):
    """The camera's port; it can be shut and opened again."""

    kind: socket.SocketKind

    def __init__(self, owner: LinkOwner) -> None:
        self.places: Places[ClientLink] = Places(owner.max_links)
        self._owner = owner

    @property
    def all_links(self) -> list[ClientLink]:
        """The links that are open."""
        return list(self.places)

    @abstractmethod
    async def serve(self, sock: socket.socket) -> None:
        """Serve a bound socket."""

    @abstractmethod
    def close_port(self) -> None:
        """Close the port, at once; links stay."""

    @abstractmethod
    def close_with_links(self) -> None:
        """Close the port and every link, at once."""

    async def wait_closed(self) -> None:
        """Wait until the event loop has released all sockets."""
        # transports that were aborted call connection_lost in the loop's next round
        for _ in range(2):
            await asyncio.sleep(0)


class TcpListener(Listener):
    """Accepts connections."""

    kind = socket.SOCK_STREAM

    def __init__(self, owner: LinkOwner) -> None:
        super().__init__(owner)
        self.is_down: bool = True
        """True while the camera is down: accepted connections are closed at once."""
        self._acceptor: Acceptor[ClientLink] = Acceptor(
            lambda: _TcpLink(self, self._owner),
            self.places,
            _log,
            name="smartcam.emulator",
            reserve=DESCRIPTORS_LEFT_BY_EMULATORS,
        )

    async def serve(self, sock: socket.socket) -> None:
        """Serve a bound socket that listens."""
        self.is_down = False
        self._acceptor.open(sock)

    def close_with_links(self) -> None:
        """Close the port and every link, at once; the owner closes the socket."""
        self.is_down = True
        self.close_port()
        for link in self.all_links:
            link.close("the camera is down")

    def close_port(self) -> None:
        """Close the port, at once; the owner closes the socket."""
        self._acceptor.close()

    async def wait_closed(self) -> None:
        """Wait until the event loop has released all sockets."""
        await self._acceptor.wait_closed()
        await super().wait_closed()

    def enter(self, link: _TcpLink) -> str:
        """Accept a new connection; return "", or the reason why it is refused."""
        self.places.max_places = self._owner.max_links
        return self._acceptor.enter(link, link.address)

    def leave(self, link: _TcpLink) -> None:
        """Forget a connection that has ended; harmless when called twice."""
        self._acceptor.leave(link)

    def session_ended(self, link: _TcpLink) -> None:
        """Note that a client has ended its session; it may now be closed for a new client."""
        self._acceptor.restart_idle_time(link)
        self._acceptor.set_time_limit(link, HANDSHAKE_TIMEOUT, "no session")

    def lift_time_limit(self, link: _TcpLink) -> None:
        """Lift the time limit of a connection that a fault keeps silent."""
        self._acceptor.set_time_limit(link, None, "")


# ---------------------------------------------------------------------- UDP


class _UdpLink(ClientLink):
    """The datagrams of one address; one message is one datagram (SC manual p. 40)."""

    def __init__(self, listener: UdpListener, owner: LinkOwner, address: Any) -> None:
        super().__init__(owner, Transport.UDP, _peer_text(address))
        self._listener = listener
        self._address = address

    def datagram_received(self, data: bytes) -> None:
        with self._owner.step():
            self._handle_bytes(data)
            self.flush()

    def write(self, data: bytes) -> bool:
        return not data or self._listener.send(data, self._address)

    def end_link(self, how: Literal["close", "reset"], reason: str = "a fault ends it") -> None:
        self.close(f"{reason} ({how})")

    def stop_reading(self) -> None:
        pass  # the faulty link takes nothing any more

    def end_fault_effects(self) -> None:
        if self._faulty is not None and self._faulty.muted_by != REFUSED:
            self._faulty.end_fault_effects()

    def block_messages(self) -> None:
        """Lose all messages while the port is closed."""
        faulty = self._enter_faulty()
        faulty.muted_by = faulty.muted_by or REFUSED

    def unblock_messages(self) -> None:
        """Stop losing messages, since the port is open again."""
        if self._faulty is not None and self._faulty.muted_by == REFUSED:
            self._faulty.muted_by = None

    def _write_frames(self, frames: list[bytes]) -> None:
        for frame in frames:
            self._listener.send(frame, self._address)

    def close(self, reason: str) -> None:
        if not self.closed:
            self._mark_closed()
            _log.debug("= %s: forgotten: %s", self.peer, reason)
            self._listener.forget(self._address)
            self._owner.forget_link(self)


class UdpListener(Listener, asyncio.DatagramProtocol):
    """Passes each datagram to the link of its address."""

    kind = socket.SOCK_DGRAM

    def __init__(self, owner: LinkOwner) -> None:
        super().__init__(owner)
        self.links: dict[Any, _UdpLink] = {}  # links by address
        self._transport: asyncio.DatagramTransport | None = None

    async def serve(self, sock: socket.socket) -> None:
        """Serve a bound socket."""
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(lambda: self, sock=sock)
        for link in self.links.values():
            link.unblock_messages()

    def close_port(self) -> None:
        """Close the port, at once; messages are lost meanwhile."""
        for link in self.links.values():
            link.block_messages()
        self._close_socket()

    def close_with_links(self) -> None:
        """Close the port and every link, at once."""
        self._close_socket()
        for link in self.all_links:
            link.close("the camera is down")

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Limit the reads of the new endpoint."""
        limit_read_size(transport)

    def _close_socket(self) -> None:
        transport, self._transport = self._transport, None
        if transport is not None:
            transport.abort()

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Pass a datagram to its address' link; a new link may replace the longest silent one."""
        if self._transport is None:
            return  # the port is shut; this datagram was read before
        now = asyncio.get_running_loop().time()
        link = self.links.get(addr)
        if link is None:
            link = _UdpLink(self, self._owner, addr)
            self.places.max_places = self._owner.max_links
            if self.places.enter(link, str(addr[0]), now):
                return  # every link has a session
            self.links[addr] = link
        else:
            self.places.restart_idle_time(link, now)
        link.datagram_received(data)

    def forget(self, address: Any) -> None:
        """Forget the client of an address."""
        link = self.links.pop(address, None)
        if link is not None:
            self.places.leave(link)

    def error_received(self, exc: Exception) -> None:
        """Log that a peer is gone; the camera itself does not notice."""
        _log.debug("! datagram not delivered: %s", exc)

    def send(self, frame: bytes, address: Any) -> bool:
        """Send one datagram; return False if it was dropped."""
        if self._transport is None:
            return False
        # the abstract class lacks it, every transport of asyncio has it
        if (
            cast("asyncio.Transport", self._transport).get_write_buffer_size()
            > self._owner.write_limit
        ):
            _log.warning("! %s: datagram dropped: the network is too slow", _peer_text(address))
            return False
        self._transport.sendto(frame, address)
        return True
