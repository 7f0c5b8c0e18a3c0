"""A camera written by hand from the manuals' tables, to prove the client against.

It shares nothing with the library: two framings by ``struct``, sockets by asyncio. It does exactly
what its ``script`` says, a table from message id to a function that takes the payload and returns
the bytes to send; the entries at the beginning behave like a camera with a few applications. An
entry that returns ``b""`` is a camera that keeps quiet until the test sends something itself.
"""

from __future__ import annotations

import asyncio
import struct
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from typing import Self

CONNECT, DISCONNECT, STATUS, RESULT = 0x01, 0x02, 0x12, 0x20
QUERY, SWITCH, GET_CLOCK, SET_CLOCK, INPUT, NUMBER = 0x30, 0x31, 0x32, 0x33, 0x34, 0x35
TRIGGER, START, STOP, REBOOT = 0x40, 0x41, 0x42, 0x43

OVERHEAT, SYSTEM_ERROR, INPUT_CONTAINER, BUSY = 0x001, 0x002, 0x004, 0x010
RUNNING, OVERTRIGGERED, WAITING = 0x080, 0x100, 0x200
READY = RUNNING | WAITING

MAGIC = {"handbook": bytes.fromhex("50535642"), "thesis": bytes.fromhex("42565350")}
LENGTH_BEYOND_PAYLOAD = {"handbook": 0, "thesis": 4}  # the thesis counts the message id too
HEADER = struct.Struct("<4sII")


def words(*values: int) -> bytes:
    """Return UINT32s, little endian."""
    return struct.pack(f"<{len(values)}I", *values)


def _quiet(_: bytes) -> bytes:
    return b""


class HandmadeCamera:
    """One camera on a free port of the loopback; an asynchronous context manager.

    Args:
        dialect: ``handbook`` or ``thesis``.
        transport: ``tcp`` or ``udp``.
        active: id of the active application.
        status: its status word at first.
        applications: ids that a switch accepts.
        lingers: never closes a connection by itself.

    Attributes:
        script: what to do with a message, by id; tests replace entries.
        received: every whole frame that came: id and payload.
        container: bytes of the results that triggers give.
        connections: how many TCP connections were made.
    """

    def __init__(
        self,
        *,
        dialect: str = "handbook",
        transport: str = "tcp",
        active: int = 7,
        status: int = READY,
        applications: Iterable[int] = (1, 3, 7),
        lingers: bool = False,
    ) -> None:
        self.dialect = dialect
        self.transport = transport
        self.active = active
        self.status = status
        self.endian = 0
        self.applications = set(applications)
        self.lingers = lingers
        self.container = b"found"
        self.received: list[tuple[int, bytes]] = []
        self.connections = 0
        self.port = 0
        self.script: dict[int, Callable[[bytes], bytes]] = {
            CONNECT: lambda _: self.frame(CONNECT, words(1)) + self.status_frame(self.status),
            QUERY: lambda _: self.frame(QUERY, words(self.active)),
            SWITCH: self._switch,
            GET_CLOCK: lambda _: self.frame(GET_CLOCK, words(2016, 6, 25, 10, 11, 12)),
            TRIGGER: self._trigger,
            START: lambda _: self.status_frame(READY),
            STOP: lambda _: self.status_frame(0),
        }
        self._changed = asyncio.Event()
        self._buffer = b""
        self._peer: Any = None
        self._server: asyncio.Server | None = None
        self._transports: list[asyncio.BaseTransport] = []
        self._open = 0

    # ------------------------------------------------------------------ life

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        if self.transport == "tcp":
            self._server = await loop.create_server(lambda: _Stream(self), "127.0.0.1", 0)
            self.port = self._server.sockets[0].getsockname()[1]
        else:
            endpoint, _ = await loop.create_datagram_endpoint(
                lambda: _Datagrams(self), local_addr=("127.0.0.1", 0)
            )
            self.port = endpoint.get_extra_info("sockname")[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self.vanish()
        while self._open:
            await self._wait_change()

    @property
    def url(self) -> str:
        """Its address, the dialect pinned."""
        scheme = {"tcp": "bvs", "udp": "bvs+udp"}[self.transport]
        return f"{scheme}://127.0.0.1:{self.port}?dialect={self.dialect}"

    @property
    def is_open(self) -> bool:
        """Whether a connection, or the datagram socket, is open."""
        return self._open > 0

    def vanish(self) -> None:
        """Shut the port and reset every connection."""
        if self._server is not None:
            self._server.close()
        for transport in self._transports:
            cast("asyncio.WriteTransport", transport).abort()

    def hang_up(self) -> None:
        """Close the connection in order."""
        self._transports[-1].close()

    def stop_reading(self) -> None:
        """Take no more bytes of the connection."""
        cast("asyncio.ReadTransport", self._transports[-1]).pause_reading()

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
                await self._wait_change()
        return [payload for one, payload in self.received if one == message_id][-1]

    # ------------------------------------------------------------------ what to say

    def frame(self, message_id: int, payload: bytes = b"") -> bytes:
        """Return a message's bytes."""
        length = len(payload) + LENGTH_BEYOND_PAYLOAD[self.dialect]
        return HEADER.pack(MAGIC[self.dialect], length, message_id) + payload

    def status_frame(self, status: int, endian: int | None = None) -> bytes:
        """Return a status message's bytes; the camera is in that state from now on."""
        self.status = status
        self.endian = self.endian if endian is None else endian
        return self.frame(STATUS, words(status, self.endian))

    def result_frame(self, data: bytes | None = None, application: int | None = None) -> bytes:
        """Return a result container's bytes."""
        number = self.active if application is None else application
        return self.frame(RESULT, words(number) + (self.container if data is None else data))

    def switched_frame(self, application: int, code: int = 0) -> bytes:
        """Return the bytes of an answer to a switch."""
        return self.frame(SWITCH, words(code, application))

    def send(self, data: bytes) -> None:
        """Send frames: in one write, or a datagram each."""
        if self.transport == "tcp":
            cast("asyncio.WriteTransport", self._transports[-1]).write(data)
            return
        for one in self.split(data):
            self.send_datagram(one)

    def send_datagram(self, data: bytes) -> None:
        """Send a datagram, whatever is in it."""
        cast("asyncio.DatagramTransport", self._transports[-1]).sendto(data, self._peer)

    def report(self, *statuses: int) -> None:
        """Send status messages, all in one segment."""
        self.send(b"".join(self.status_frame(status) for status in statuses))

    def split(self, data: bytes) -> list[bytes]:
        """Cut bytes into whole frames."""
        frames: list[bytes] = []
        while data:
            length = HEADER.unpack_from(data)[1]
            size = HEADER.size + length - LENGTH_BEYOND_PAYLOAD[self.dialect]
            frames.append(data[:size])
            data = data[size:]
        return frames

    # ------------------------------------------------------------------ the first script

    def _switch(self, payload: bytes) -> bytes:
        (wanted,) = struct.unpack("<I", payload)
        if self.status & RUNNING or wanted not in self.applications:
            return self.switched_frame(self.active, code=1)
        self.active = wanted
        return self.status_frame(BUSY) + self.status_frame(0) + self.switched_frame(wanted)

    def _trigger(self, _: bytes) -> bytes:
        if not self.status & WAITING:
            return b""
        return self.status_frame(RUNNING) + self.result_frame() + self.status_frame(READY)

    # ------------------------------------------------------------------ bytes

    def take(self, data: bytes) -> None:
        """Take bytes of a stream, or a datagram."""
        self._buffer += data
        while len(self._buffer) >= HEADER.size:
            magic, length, message_id = HEADER.unpack_from(self._buffer)
            assert magic == MAGIC[self.dialect], f"no frame begins with {self._buffer[:12].hex()}"
            size = HEADER.size + length - LENGTH_BEYOND_PAYLOAD[self.dialect]
            if len(self._buffer) < size:
                return
            payload, self._buffer = self._buffer[HEADER.size : size], self._buffer[size:]
            self.hear(message_id, payload)

    def hear(self, message_id: int, payload: bytes) -> None:
        """Take a whole frame and do what the script says."""
        self.received.append((message_id, payload))
        answer = self.script.get(message_id, _quiet)(payload)
        if answer:
            self.send(answer)
        self.changed()

    def opened(self, transport: asyncio.BaseTransport) -> None:
        """Note that a connection, or the datagram socket, is open."""
        self._transports.append(transport)
        self._buffer = b""
        self._open += 1
        self.connections += 1
        self.changed()

    def lost(self) -> None:
        """Note that one is gone."""
        self._open -= 1
        self.changed()

    def changed(self) -> None:
        """Wake who waits for something."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def _wait_change(self) -> None:
        await self._changed.wait()

    def heard_from(self, peer: object) -> None:
        """Note where datagrams come from."""
        self._peer = peer


class _Stream(asyncio.Protocol):
    def __init__(self, camera: HandmadeCamera) -> None:
        self._camera = camera

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._camera.opened(transport)

    def data_received(self, data: bytes) -> None:
        self._camera.take(data)

    def eof_received(self) -> bool:
        return self._camera.lingers

    def connection_lost(self, exc: Exception | None) -> None:
        self._camera.lost()


class _Datagrams(asyncio.DatagramProtocol):
    def __init__(self, camera: HandmadeCamera) -> None:
        self._camera = camera

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._camera.opened(transport)

    def datagram_received(self, data: bytes, addr: object) -> None:
        self._camera.heard_from(addr)
        self._camera.take(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._camera.lost()
