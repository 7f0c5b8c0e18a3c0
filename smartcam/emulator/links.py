"""Sockets of the emulated camera: they move bytes, what they mean is decided elsewhere.

A link is one client's way to the camera: a TCP connection, or all datagrams of one address. Each
has a :class:`~smartcam.protocols.framed.machine.Machine` in the camera's role.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import os
import socket
import struct
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Literal, Protocol, cast

from smartcam._accepting import Acceptor
from smartcam.emulator.faults.faulty_link import Passage, Watch
from smartcam.exceptions import FrameError, LocalProtocolError, RemoteProtocolError
from smartcam.protocols import messages as m
from smartcam.protocols.base import POLICIES, Policy, Role, Transport
from smartcam.protocols.framed.machine import Machine, State

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.emulator.bvs.device import Device
    from smartcam.emulator.bvs.quirks import Quirks
    from smartcam.emulator.faults.wire_effects import Parcel
    from smartcam.protocols.framed.framing import Frame

__all__ = [
    "FAREWELL",
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
"""Clients that are looked at. The camera serves one; a few more may wait to take over. A newcomer
always gets in: the one without a session for longest makes room."""

WRITE_LIMIT = 1 << 20
"""Bytes kept for a client that does not read, or held back by faults; more end its connection."""

FAREWELL = 1.0
"""Seconds of real time that a client has to close its side after a fault closed the camera's."""

_NO_LINGER = struct.pack("hh" if os.name == "nt" else "ii", 1, 0)


REFUSED = "refuse"
"""Kind of the fault that closes the port for a time."""

BAD_FRAME: Mapping[str, Policy] = {
    "skip": POLICIES[Role.CAMERA, Transport.TCP],
    "close": Policy(fatal=(FrameError,), exact_length=True),
}
"""What the quirk ``bad_frame`` means on TCP; a broken body or an unknown id never matters."""


def _policy(station: Station, transport: Transport) -> Policy:
    """Return what is done with broken input."""
    tcp = transport is Transport.TCP
    policy = BAD_FRAME[station.quirks.bad_frame] if tcp else POLICIES[Role.CAMERA, transport]
    return dataclasses.replace(policy, tells=station.device.manner.tells_bad_messages)


class Station(Watch, Protocol):
    """What links want from the emulator behind them."""

    @property
    def quirks(self) -> Quirks:
        """The quirks."""
        ...

    @property
    def device(self) -> Device:
        """The camera behind the wire."""
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

    def parted(self, link: Link, *, by_client: bool, reset: bool) -> None:
        """A connection has ended."""
        ...

    def traced(self, link: Link, sender: m.Sender, what: Frame | RemoteProtocolError) -> None:
        """A machine saw a frame, or bytes that make none."""
        ...

    def traced_parcel(self, link: Link, sender: m.Sender, parcel: Parcel) -> None:
        """What faults made of a message has passed, or is lost."""
        ...


class Link(ABC):
    """One client's way to the camera."""

    def __init__(self, station: Station, transport: Transport, peer: str) -> None:
        self.peer = peer
        self.closed: bool = False
        self.hearing: str | None = None
        """Kinds of the faults that acted on what the camera hears just now."""
        self._station = station
        self._machine = Machine(
            station.spoken,
            Role.CAMERA,
            transport,
            max_length=MAX_INPUT,
            policy=_policy(station, transport),
            trace=self._trace,
        )
        self._passage: Passage | None = None  # there while faults act

    def say(self, message: m.Message) -> None:
        """Put a message behind those that :meth:`flush` will write."""
        passage = self._passage
        if self._station.queue.said and passage is None:
            passage = self._enter_passage()
        try:
            self._machine.send(message)
        except LocalProtocolError as exc:
            _log.warning("! %s: not sent: %s", self.peer, exc)
            return
        if passage is not None and passage.saying is not None:
            passage.say(passage.saying, b"".join(self._machine.data_to_send()))

    def flush(self) -> None:
        """Write everything said."""
        passage = self._passage
        if passage is None:
            self._write_frames(self._machine.data_to_send())
            return
        passage.run()
        if passage.idle:
            self._passage = None

    @abstractmethod
    def close(self, reason: str) -> None:
        """End the link; nothing is read or written any more."""

    def dismiss(self, reason: str) -> None:
        """End the link because another client has the session; a dead one stays as it is."""
        if self._passage is None or not self._passage.dead:
            self.close(reason)

    def unseated(self) -> None:  # noqa: B027  only where links have an order of their own
        """The client has given the session back; it may stay."""

    def heard(self) -> None:
        """The camera heard something: write what it said to it."""
        self.flush()

    def feed(self, data: bytes) -> None:
        """Feed the machine and pass its messages on."""
        self._machine.receive_data(data)
        for event in self._machine.events():
            if isinstance(event, m.Message) and not self.closed:
                self._station.received(self, event)

    @abstractmethod
    def write(self, data: bytes) -> bool:
        """Write bytes that belong together; False if it was not possible."""

    @abstractmethod
    def part(self, how: Literal["close", "reset"]) -> None:
        """End the link as a fault has it."""

    @abstractmethod
    def stop_listening(self) -> None:
        """Read nothing more."""

    @abstractmethod
    def heal(self) -> None:
        """End what a fault does to the link for long."""

    def overflow(self) -> None:
        """Faults hold back too much."""
        self.close(f"more than {WRITE_LIMIT} bytes are held back")

    def traced_parcel(self, sender: m.Sender, parcel: Parcel) -> None:
        """What faults made of a message has passed, or is lost."""
        self._station.traced_parcel(self, sender, parcel)

    @abstractmethod
    def _write_frames(self, frames: list[bytes]) -> None:
        """Write frames as they are."""

    def _take(self, data: bytes) -> None:
        """Take what came: bytes of a stream, or one datagram."""
        if self._passage is None and not self._station.queue.heard:
            self.feed(data)
        else:
            self._enter_passage().take(data)

    def _enter_passage(self) -> Passage:
        if self._passage is None:
            self._write_frames(self._machine.data_to_send())
            self._passage = Passage(
                self._station, self, self._machine, max_length=MAX_INPUT, limit=WRITE_LIMIT
            )
        return self._passage

    def _leave(self) -> None:
        self.closed = True
        if self._passage is not None:
            self._passage.close()

    def _trace(self, sender: m.Sender, what: Frame | RemoteProtocolError) -> None:
        passage = self._passage
        if passage is None or sender is m.Sender.CLIENT or isinstance(what, RemoteProtocolError):
            self._station.traced(self, sender, what)
        else:
            passage.saying = what


def _peer_text(address: Any) -> str:
    return f"{address[0]}:{address[1]}" if address else "?"


# ---------------------------------------------------------------------- TCP


class _TcpLink(Link, asyncio.Protocol):
    """A connection. All that one step causes goes out in one write (SC manual p. 40)."""

    _transport: asyncio.Transport

    def __init__(self, listener: TcpListener, station: Station) -> None:
        super().__init__(station, Transport.TCP, "?")
        self._listener = listener
        self._farewell: asyncio.TimerHandle | None = None
        self._end_waits = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self.peer: str = _peer_text(transport.get_extra_info("peername"))
        if self._listener.down:
            self.close("the camera is down")
            return
        self._listener.enter(self)
        if self.closed:
            return
        # the camera does so too (newest SC manual p. 40: published)
        with contextlib.suppress(OSError):  # the client may be gone already
            transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def data_received(self, data: bytes) -> None:
        if self.closed:  # it says farewell
            return
        with self._station.step():
            self._take(data)
            self.heard()

    def eof_received(self) -> bool:
        """The client has closed its side: that waits behind what faults hold back."""
        self._end_waits = self._passage is not None and self._passage.unheard
        return self._end_waits

    def heard(self) -> None:
        self.flush()  # also what was said before a Disconnect in the same bytes
        if self._machine.state is State.FAILED:
            self.close("a broken frame came")
        elif self._end_waits and (self._passage is None or not self._passage.unheard):
            self._transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._farewell is not None:
            self._farewell.cancel()
        by_client = not self.closed
        self._leave()
        self._listener.links.pop(self, None)
        with self._station.step():
            self._station.lost(self)
        self._station.parted(self, by_client=by_client, reset=exc is not None)

    def write(self, data: bytes) -> bool:
        if self.closed:
            return False
        if self._transport.get_write_buffer_size() + len(data) > WRITE_LIMIT:
            self.close(f"it does not read: more than {WRITE_LIMIT} bytes wait for it")
            return False
        self._transport.write(data)
        return True

    def unseated(self) -> None:
        if self in self._listener.links:
            del self._listener.links[self]
            self._listener.links[self] = None

    def close(self, reason: str) -> None:
        self._listener.links.pop(self, None)
        if not self.closed:
            self._leave()
            _log.info("= %s: connection closed: %s", self.peer, reason)
            self._station.lost(self)
        self._transport.abort()

    def part(self, how: Literal["close", "reset"]) -> None:
        if how == "reset":
            with contextlib.suppress(OSError):  # the client may be gone already
                sock = self._transport.get_extra_info("socket")
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
            self.close("a fault resets it")
            return
        self._leave()
        _log.info("= %s: connection closed: a fault ends it", self.peer)
        self._station.lost(self)
        # a socket that is closed with unread bytes sends a reset, so it stays until the client
        # has closed its side, too
        with contextlib.suppress(OSError):
            self._transport.write_eof()
        loop = asyncio.get_running_loop()
        self._farewell = loop.call_later(FAREWELL, self._transport.abort)

    def stop_listening(self) -> None:
        self._transport.pause_reading()

    def heal(self) -> None:
        if self._passage is not None and self._passage.muted is not None:
            self.part("reset")

    def _write_frames(self, frames: list[bytes]) -> None:
        if frames:
            self.write(b"".join(frames))


class Listener(ABC):
    """The camera's port; it can be shut and opened again.

    Attributes:
        crowded_out: links that made room for newcomers.
    """

    kind: socket.SocketKind

    def __init__(self) -> None:
        self.crowded_out: int = 0

    def crowd_out(self, link: Link, why: str) -> None:
        """Close a link to make room for a newcomer."""
        self.crowded_out += 1
        link.close(why)

    @property
    @abstractmethod
    def all_links(self) -> list[Link]:
        """The links that are open."""

    @abstractmethod
    async def serve(self, sock: socket.socket) -> None:
        """Serve a bound socket."""

    @abstractmethod
    def close_port(self) -> None:
        """Close the port, at once; links stay."""

    @abstractmethod
    def shut(self) -> None:
        """Close the port and every link, at once."""

    async def wait_closed(self) -> None:
        """Wait until the event loop has let go of all sockets."""
        # transports that were aborted call connection_lost in the loop's next round
        for _ in range(2):
            await asyncio.sleep(0)


class TcpListener(Listener):
    """Accepts connections."""

    kind = socket.SOCK_STREAM

    def __init__(self, station: Station) -> None:
        super().__init__()
        self.links: dict[_TcpLink, None] = {}  # the one without a session for longest stands first
        self.down: bool = True
        """Whether connections that were accepted before are too late."""
        self._station = station
        self._acceptor = Acceptor(
            lambda: _TcpLink(self, self._station), _log, name="smartcam.emulator"
        )

    @property
    def all_links(self) -> list[Link]:
        """The links that are open."""
        return list(self.links)

    async def serve(self, sock: socket.socket) -> None:
        """Serve a bound socket that listens."""
        self.down = False
        self._acceptor.open(sock)

    def shut(self) -> None:
        """Close the port and every link, at once; the socket is its owner's to close."""
        self.down = True
        self.close_port()
        for link in self.all_links:
            link.close("the camera is down")

    def close_port(self) -> None:
        """Close the port, at once; the socket is its owner's to close."""
        self._acceptor.close()

    async def wait_closed(self) -> None:
        """Wait until the event loop has let go of all sockets."""
        await self._acceptor.wait_closed()
        await super().wait_closed()

    def enter(self, link: _TcpLink) -> None:
        """Take a new connection; where there are too many, another one makes room."""
        self.links[link] = None
        if len(self.links) > MAX_LINKS:
            one = next(one for one in self.links if not self._station.serves(one))
            why = f"{MAX_LINKS} others are open, it was without a session for longest"
            self.crowd_out(one, why)


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

    def write(self, data: bytes) -> bool:
        return not data or self._listener.send(data, self._address)

    def part(self, how: Literal["close", "reset"]) -> None:
        self.close(f"a fault ends it ({how})")

    def stop_listening(self) -> None:
        pass  # the passage takes nothing any more

    def heal(self) -> None:
        if self._passage is not None and self._passage.muted != REFUSED:
            self._passage.heal()

    def shut_off(self) -> None:
        """The port is closed for a time: what is said is lost."""
        passage = self._enter_passage()
        passage.muted = passage.muted or REFUSED

    def let_in(self) -> None:
        """The port is open again."""
        if self._passage is not None and self._passage.muted == REFUSED:
            self._passage.muted = None

    def _write_frames(self, frames: list[bytes]) -> None:
        for frame in frames:
            self._listener.send(frame, self._address)

    def close(self, reason: str) -> None:
        if not self.closed:
            self._leave()
            _log.debug("= %s: forgotten: %s", self.peer, reason)
            self._listener.links.pop(self._address, None)
            self._station.lost(self)


class UdpListener(Listener, asyncio.DatagramProtocol):
    """Sorts datagrams by address."""

    kind = socket.SOCK_DGRAM

    def __init__(self, station: Station) -> None:
        super().__init__()
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
        for link in self.links.values():
            link.let_in()

    def close_port(self) -> None:
        """Close the port, at once; what is said meanwhile is lost."""
        for link in self.links.values():
            link.shut_off()
        self._close_socket()

    def shut(self) -> None:
        """Close the port and every link, at once."""
        self._close_socket()
        for link in self.all_links:
            link.close("the camera is down")

    def _close_socket(self) -> None:
        transport, self._transport = self._transport, None
        if transport is not None:
            transport.abort()

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Pass it to the link of its address; too many links drop the one silent for longest."""
        if self._transport is None:
            return  # the port is shut, the loop had this one already
        link = self.links.pop(addr, None) or _UdpLink(self, self._station, addr)
        self.links[addr] = link
        if len(self.links) > MAX_LINKS:
            old = next(old for old in self.all_links if not self._station.serves(old))
            self.crowd_out(old, "idle")
        link.datagram_received(data)

    def error_received(self, exc: Exception) -> None:
        """Nobody reads the answers at a peer any more; the camera does not notice."""
        _log.debug("! datagram not delivered: %s", exc)

    def send(self, frame: bytes, address: Any) -> bool:
        """Send one datagram; False if it is lost here."""
        if self._transport is None:
            return False
        # the abstract class lacks it, every transport of asyncio has it
        if cast("asyncio.Transport", self._transport).get_write_buffer_size() > WRITE_LIMIT:
            _log.warning("! %s: datagram dropped: the network is too slow", _peer_text(address))
            return False
        self._transport.sendto(frame, address)
        return True
