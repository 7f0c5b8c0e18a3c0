"""A camera written by hand from the manuals' tables, to prove the client against.

It shares nothing with the library. It does exactly what its ``script`` says, a table from message
id to a function that takes the payload and returns the bytes to send; the entries at the beginning
behave like a camera with a few applications. An entry that returns ``b""`` is a camera that keeps
quiet until the test sends something itself.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple, Self, cast

CONNECT, DISCONNECT, STATUS, RESET, RESULT = 0x01, 0x02, 0x12, 0x16, 0x20
QUERY, SWITCH, GET_CLOCK, SET_CLOCK, INPUT, NUMBER = 0x30, 0x31, 0x32, 0x33, 0x34, 0x35
TRIGGER, START, STOP, REBOOT = 0x40, 0x41, 0x42, 0x43

OVERHEAT, SYSTEM_ERROR, INPUT_CONTAINER, BUSY = 0x001, 0x002, 0x004, 0x010
RUNNING, OVERTRIGGERED, WAITING = 0x080, 0x100, 0x200
READY = RUNNING | WAITING

# of ``bid``: result codes and status bits
OK, OK_ID, OK_DATE, ERROR, INVALID, NOT_READY, INSPECTION_ERROR = 0, 2, 6, 0x10, 0x13, 0x16, 0x1A
BID_WAITING, BID_SIMULATION, BID_READY, BID_TRIGGER_ERROR = 0x0001, 0x0008, 0x0020, 0x0100
BID_IDLE = BID_READY | BID_WAITING

Frame = tuple[int, bytes]
"""Id and payload."""


def words(*values: int) -> bytes:
    """Return UINT32s, little endian."""
    return struct.pack(f"<{len(values)}I", *values)


class Wire(NamedTuple):
    """The form of frames: struct code of the integers, magic, what the length counts too."""

    word: str
    magic: bytes = b""
    beyond: int = 0

    @property
    def size(self) -> int:
        """Bytes of a header."""
        return len(self.magic) + 2 * struct.calcsize(self.word)

    def words(self, *values: int) -> bytes:
        """Return integers as they are on the wire."""
        return struct.pack(f"<{len(values)}{self.word}", *values)

    def frame(self, message_id: int, payload: bytes = b"") -> bytes:
        length = len(payload) + self.beyond
        numbers = (length, message_id) if self.magic else (message_id, length)
        return self.magic + self.words(*numbers) + payload

    def begins(self, data: bytes) -> bool:
        """Return True for a datagram that a client sends first: a Disconnect or a Connect."""
        return data in {self.frame(DISCONNECT), self.frame(CONNECT)}

    def read(self, data: bytes) -> Frame | None:
        """Return the first frame's id and payload, None while it is not whole."""
        if len(data) < self.size:
            return None
        assert data.startswith(self.magic), f"no frame begins with {data[:12].hex()}"
        first, second = struct.unpack_from(f"<2{self.word}", data, len(self.magic))
        message_id, length = (second, first - self.beyond) if self.magic else (first, second)
        end = self.size + length
        return (message_id, data[self.size : end]) if len(data) >= end else None


HANDBOOK, THESIS = bytes.fromhex("50535642"), bytes.fromhex("42565350")
"""Magic numbers."""

WIRES = {
    "handbook": Wire("I", HANDBOOK),
    "thesis": Wire("I", THESIS, 4),
    "b16": Wire("H"),
    "bid": Wire("H"),
}


@dataclass(slots=True, eq=False)
class Peer:
    """A connection, or the other end of the datagrams."""

    transport: asyncio.BaseTransport
    address: tuple[str, int] | None = None
    buffer: bytes = b""
    gone: bool = False

    def take(self, wire: Wire, data: bytes) -> list[Frame]:
        """Take bytes of a stream, or a datagram; return the frames that are whole now."""
        self.buffer += data
        frames: list[Frame] = []
        while (frame := wire.read(self.buffer)) is not None:
            frames.append(frame)
            self.buffer = self.buffer[wire.size + len(frame[1]) :]
        return frames

    def write(self, data: bytes) -> None:
        """Send to a connection."""
        cast("asyncio.WriteTransport", self.transport).write(data)

    def send_datagram(self, data: bytes) -> None:
        """Send to where datagrams come from."""
        cast("asyncio.DatagramTransport", self.transport).sendto(data, self.address)

    def abort(self) -> None:
        """Reset the connection, or shut the socket."""
        cast("asyncio.WriteTransport", self.transport).abort()


class PortByHand:
    """A free port of the loopback, TCP or UDP; an asynchronous context manager."""

    def __init__(self, dialect: str, transport: str) -> None:
        self.dialect = dialect  # ``handbook``, ``thesis``, ``b16`` or ``bid``
        self.transport = transport  # ``tcp`` or ``udp``
        self.wire = WIRES[dialect]
        self.port = 0
        self.peers: list[Peer] = []  # connections that are open, or the datagram socket
        self.lingers = False  # never closes a connection by itself
        self._server: asyncio.Server | None = None
        self._changed = asyncio.Event()

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        if self.transport == "tcp":
            self._server = await loop.create_server(lambda: _Socket(self), "127.0.0.1", 0)
            self.port = self._server.sockets[0].getsockname()[1]
        else:
            address = ("127.0.0.1", 0)
            endpoint, _ = await loop.create_datagram_endpoint(lambda: _Socket(self), address)
            self.port = endpoint.get_extra_info("sockname")[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self.vanish()
        while self.peers:
            await self.wait_change()

    @property
    def url(self) -> str:
        """Its address, the dialect pinned."""
        scheme = {"tcp": "bvs", "udp": "bvs+udp"}[self.transport]
        return f"{scheme}://127.0.0.1:{self.port}?dialect={self.dialect}"

    def vanish(self) -> None:
        """Shut the port and reset every connection."""
        if self._server is not None:
            self._server.close()
        for peer in self.peers:
            peer.abort()

    def changed(self) -> None:
        """Wake who waits for something."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def wait_change(self) -> None:
        """Wait until something came, or a connection was opened or lost."""
        await self._changed.wait()

    def opened(self, peer: Peer) -> None:
        """Note a connection, or the datagram socket."""
        self.peers.append(peer)
        self.changed()

    def arrive(self, peer: Peer, data: bytes) -> None:
        """Take bytes of a stream, or a datagram."""
        raise NotImplementedError

    def lost(self, peer: Peer) -> None:
        """Note that a connection is gone."""
        peer.gone = True
        self.peers.remove(peer)
        self.changed()


class _Socket(asyncio.Protocol, asyncio.DatagramProtocol):
    def __init__(self, port: PortByHand) -> None:
        self._port = port

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._peer = Peer(transport)
        self._port.opened(self._peer)

    def data_received(self, data: bytes) -> None:
        self._port.arrive(self._peer, data)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        if addr != self._peer.address:
            if not self._port.wire.begins(data):
                return  # from a stranger: another test's, which had the port in mind before
            self._peer.address = addr
        self._port.arrive(self._peer, data)

    def eof_received(self) -> bool:
        return self._port.lingers

    def connection_lost(self, exc: Exception | None) -> None:
        self._port.lost(self._peer)


def _quiet(_: bytes) -> bytes:
    return b""


class HandmadeCamera(PortByHand):
    """One camera on a free port of the loopback; an asynchronous context manager."""

    def __init__(
        self,
        *,
        # ``handbook`` or ``thesis``; for ``bid`` there is :class:`HandmadeBid`
        dialect: str = "handbook",
        transport: str = "tcp",  # ``tcp`` or ``udp``
        active: int = 7,  # id of the active application
        status: int = READY,  # its status word at first
        applications: Iterable[int] = (1, 3, 7),
        lingers: bool = False,  # never closes a connection by itself
    ) -> None:
        super().__init__(dialect, transport)
        self.active = active
        self.status = status
        self.endian = 0
        self.applications = set(applications)  # ids that a switch accepts
        self.lingers = lingers
        self.container = b"found"  # bytes of the results that triggers give
        self.received: list[Frame] = []  # every whole frame that came: id and payload
        self.connections = 0  # how many TCP connections were made
        # what to do with a message, by id; tests replace entries
        self.script: dict[int, Callable[[bytes], bytes]] = {
            CONNECT: lambda _: self.said(CONNECT, 1) + self.status_frame(self.status),
            QUERY: lambda _: self.said(QUERY, self.active),
            SWITCH: self._switch,
            GET_CLOCK: lambda _: self.said(GET_CLOCK, 2016, 6, 25, 10, 11, 12),
            TRIGGER: self._trigger,
            START: lambda _: self.status_frame(READY),
            STOP: lambda _: self.status_frame(0),
        }
        self._last: Peer | None = None

    @property
    def last(self) -> Peer:
        """The last connection that was made, or the datagram socket."""
        assert self._last is not None
        return self._last

    def hang_up(self) -> None:
        """Close the connection in order."""
        self.last.transport.close()

    def stop_reading(self) -> None:
        """Take no more bytes of the connection."""
        cast("asyncio.ReadTransport", self.last.transport).pause_reading()

    # ------------------------------------------------------------------ what came

    @property
    def ids(self) -> list[int]:
        """Ids of what came, in order."""
        return [message_id for message_id, _ in self.received]

    def since(self, mark: int) -> list[int]:
        """Return the ids of what came behind the first ``mark`` messages."""
        return self.ids[mark:]

    async def wait_for(self, message_id: int, count: int = 1) -> bytes:
        """Wait until ``count`` messages of an id came; return the last one's payload."""
        async with asyncio.timeout(5):
            while self.ids.count(message_id) < count:
                await self.wait_change()
        return [payload for one, payload in self.received if one == message_id][-1]

    # ------------------------------------------------------------------ what to say

    def frame(self, message_id: int, payload: bytes = b"") -> bytes:
        """Return a message's bytes."""
        return self.wire.frame(message_id, payload)

    def said(self, message_id: int, *values: int) -> bytes:
        """Return the bytes of a message of integers."""
        return self.frame(message_id, self.wire.words(*values))

    def status_frame(self, status: int, endian: int | None = None) -> bytes:
        """Return a status message's bytes; the camera is in that state from now on."""
        self.status = status
        self.endian = self.endian if endian is None else endian
        return self.said(STATUS, status, *([self.endian] if self.wire.word == "I" else []))

    def result_frame(self, data: bytes | None = None, application: int | None = None) -> bytes:
        """Return a result container's bytes."""
        number = self.active if application is None else application
        data = self.container if data is None else data
        return self.frame(RESULT, self.wire.words(number) + data)

    def switched_frame(self, application: int, code: int = 0) -> bytes:
        """Return the bytes of an answer to a switch."""
        return self.said(SWITCH, code, application)

    def send(self, data: bytes) -> None:
        """Send frames: in one write, or a datagram each."""
        if self.transport == "tcp":
            self.last.write(data)
            return
        for one in self.split(data):
            self.send_datagram(one)

    def send_datagram(self, data: bytes) -> None:
        """Send a datagram, whatever is in it."""
        self.last.send_datagram(data)

    def report(self, *statuses: int) -> None:
        """Send status messages, all in one segment."""
        self.send(b"".join(self.status_frame(status) for status in statuses))

    def split(self, data: bytes) -> list[bytes]:
        """Cut bytes into whole frames."""
        peer = Peer(self.last.transport)
        return [self.frame(*frame) for frame in peer.take(self.wire, data)]

    # ------------------------------------------------------------------ what a trigger does

    def takes(self, _: bytes = b"") -> bytes:
        """Show that a trigger is taken; the test says the rest (:meth:`over`)."""
        return self.status_frame(RUNNING)

    def over(self, *containers: bytes) -> bytes:
        """Return results of the inspection under way, and that the camera waits again."""
        return b"".join(map(self.result_frame, containers)) + self.status_frame(READY)

    def inspects(self, *containers: bytes) -> bytes:
        """Return all that an inspection says."""
        return self.takes() + self.over(*containers)

    # ------------------------------------------------------------------ the first script

    def _switch(self, payload: bytes) -> bytes:
        wanted = int.from_bytes(payload, "little")
        if self.status & RUNNING or wanted not in self.applications:
            return self.switched_frame(self.active, code=1)
        self.active = wanted
        return self.status_frame(BUSY) + self.status_frame(0) + self.switched_frame(wanted)

    def _trigger(self, _: bytes) -> bytes:
        return self.inspects(self.container) if self.status & WAITING else b""

    # ------------------------------------------------------------------ the port

    def arrive(self, peer: Peer, data: bytes) -> None:
        for frame in peer.take(self.wire, data):
            self.hear(*frame)

    def hear(self, message_id: int, payload: bytes) -> None:
        """Take a whole frame and do what the script says."""
        self.received.append((message_id, payload))
        answer = self.script.get(message_id, _quiet)(payload)
        if answer:
            self.send(answer)
        self.changed()

    def opened(self, peer: Peer) -> None:
        self._last = peer
        self.connections += 1
        super().opened(peer)


class HandmadeBid(HandmadeCamera):
    """One BVS ID on a free port of the loopback, as :class:`HandmadeCamera`."""

    def __init__(self, *, status: int = BID_IDLE, **options: Any) -> None:
        super().__init__(dialect="bid", status=status, **options)
        self.script = {
            CONNECT: lambda _: self.said(CONNECT, OK, 1),
            DISCONNECT: lambda _: self.said(DISCONNECT, OK),
            STATUS: lambda _: self.status_frame(self.status),
            RESET: self._reset,
            QUERY: lambda _: self.said(QUERY, OK_ID, self.active),
            SWITCH: self._switch,
            GET_CLOCK: lambda _: self.said(GET_CLOCK, OK_DATE, 2016, 6, 25, 10, 11, 12),
            SET_CLOCK: lambda _: self.said(SET_CLOCK, OK),
            INPUT: lambda _: self.said(INPUT, OK),
            TRIGGER: lambda _: self.said(TRIGGER, OK) + self.result_frame(),
        }

    def commands(self, mark: int = 0) -> list[int]:
        """Return the ids of what came behind the first ``mark``, without the polling of status."""
        return [one for one in self.ids[mark:] if one not in {STATUS, QUERY}]

    def _reset(self, _: bytes) -> bytes:
        status = self.status & ~BID_TRIGGER_ERROR
        return self.said(RESET, OK) + self.status_frame(status)

    def _switch(self, payload: bytes) -> bytes:
        wanted = int.from_bytes(payload, "little")
        if wanted not in self.applications:
            return self.said(SWITCH, INSPECTION_ERROR, self.active)
        self.active = wanted
        return self.said(SWITCH, OK, wanted)
