"""Bytes on the wire, written down by hand: no code of the library makes or reads them.

Vectors from the published pages are marked *published*, those put together from the published
layouts *derived*.
"""

from __future__ import annotations

import asyncio
import socket
from typing import Self

from smartcam.emulator import EmulatedCamera
from smartcam.emulator._inside import Device
from smartcam.models import Status
from smartcam.protocols import messages as m
from tests.emulator.stream_client import TIMEOUT, StreamClient

MAGIC = bytes.fromhex("50535642")
THESIS_MAGIC = bytes.fromhex("42565350")

CONNECT = bytes.fromhex("50535642 00000000 01000000")  # derived
CONNECTED = bytes.fromhex("50535642 04000000 01000000 01000000")  # derived
DISCONNECT = bytes.fromhex("50535642 00000000 02000000")  # derived
QUERY = bytes.fromhex("50535642 00000000 30000000")  # derived
ACTIVE_21 = bytes.fromhex("50535642 04000000 30000000 15000000")  # derived
ACTIVE_1 = bytes.fromhex("50535642 04000000 30000000 01000000")
SWITCH_21 = bytes.fromhex("50535642 04000000 31000000 15000000")
SWITCHED_21 = bytes.fromhex("50535642 08000000 31000000 00000000 15000000")
SWITCH_5 = bytes.fromhex("50535642 04000000 31000000 05000000")  # derived
REFUSED_1 = bytes.fromhex("50535642 08000000 31000000 01000000 01000000")  # derived
SET_CLOCK = bytes.fromhex(  # published: vector A-1, 2016-06-25 10:11:12
    "50535642 18000000 33000000 E0070000 06000000 19000000 0A000000 0B000000 0C000000"
)
GET_CLOCK = bytes.fromhex("50535642 00000000 32000000")
CLOCK = bytes.fromhex(
    "50535642 18000000 32000000 E0070000 06000000 19000000 0A000000 0B000000 0C000000"
)
TRIGGER = bytes.fromhex("50535642 00000000 40000000")  # derived
START = bytes.fromhex("50535642 00000000 41000000")
STOP = bytes.fromhex("50535642 00000000 42000000")
REBOOT = bytes.fromhex("50535642 00000000 43000000")
NO_BIT = bytes.fromhex("50535642 08000000 12000000 00000000 00000000")
BUSY = bytes.fromhex("50535642 08000000 12000000 10000000 00000000")  # derived
RUNNING = bytes.fromhex("50535642 08000000 12000000 80000000 00000000")
WAITING = bytes.fromhex("50535642 08000000 12000000 80020000 00000000")  # derived
OVERTRIGGERED = bytes.fromhex("50535642 08000000 12000000 80010000 00000000")  # derived
OVERTRIGGERED_WAITING = bytes.fromhex("50535642 08000000 12000000 80030000 00000000")
HELLO_WORLD = bytes.fromhex(  # derived
    "50535642 18000000 20000000 15000000 48656c6c6f20576f726c64 000000000000000000"
)
RESULT_3 = bytes.fromhex(  # derived
    "50535642 19000000 20000000 03000000 ff 02000000 0000cb42 000050c0 4142430000000000"
)


def thesis(frame: bytes) -> bytes:
    """Return a handbook frame as the thesis writes it: other magic, the length counts the id."""
    length = int.from_bytes(frame[4:8], "little") + 4
    return THESIS_MAGIC + length.to_bytes(4, "little") + frame[8:]


class TcpClient(StreamClient):
    """A plain TCP client."""

    async def expect_nothing_but(self, request: bytes, answer: bytes) -> None:
        """See that nothing was on its way: the next bytes answer ``request``."""
        self.send(request)
        await self.expect(answer)


class RawClient:
    """A TCP socket without streams: it tells an orderly end from a reset."""

    def __init__(self, emulator: EmulatedCamera) -> None:
        self.socket = socket.create_connection((emulator.host, emulator.port), timeout=TIMEOUT)
        self.socket.setblocking(False)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.socket.close()

    @property
    def address(self) -> str:
        """Its address as the emulator tells it."""
        host, port = self.socket.getsockname()
        return f"{host}:{port}"

    def send(self, *frames: bytes) -> None:
        self.socket.send(b"".join(frames))

    async def receive(self, limit: int = 1 << 16) -> bytes:
        """Return the bytes of one call of recv."""
        async with asyncio.timeout(TIMEOUT):
            return await asyncio.get_running_loop().sock_recv(self.socket, limit)

    async def expect(self, *frames: bytes) -> None:
        """Read exactly these bytes."""
        for expected in frames:
            got = b""
            while len(got) < len(expected):
                data = await self.receive(len(expected) - len(got))
                assert data, f"the end came after {got.hex(' ')}"
                got += data
            assert got.hex(" ") == expected.hex(" ")

    async def expect_fin(self) -> None:
        """See the orderly end, and nothing before it."""
        assert await self.receive() == b""

    async def expect_reset(self) -> None:
        """See a reset, and nothing before it."""
        try:
            data = await self.receive()
        except ConnectionResetError:
            return
        raise AssertionError(f"no reset: {data.hex(' ') or 'the orderly end'}")

    def expect_silence(self) -> None:
        """See that nothing has come so far."""
        try:
            data = self.socket.recv(1)
        except BlockingIOError:
            return
        raise AssertionError(f"something came: {data.hex(' ') or 'the orderly end'}")


class UdpClient:
    """A plain UDP client."""

    def __init__(self, emulator: EmulatedCamera) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.connect((emulator.host, emulator.port))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.socket.close()

    def send(self, *datagrams: bytes) -> None:
        for datagram in datagrams:
            self.socket.send(datagram)

    async def expect(self, *datagrams: bytes) -> None:
        """Receive exactly these datagrams."""
        for expected in datagrams:
            async with asyncio.timeout(TIMEOUT):
                got = await asyncio.get_running_loop().sock_recv(self.socket, 1 << 17)
            assert got.hex(" ") == expected.hex(" ")

    async def expect_nothing_but(self, request: bytes, answer: bytes) -> None:
        """See that nothing was on its way: the next datagram answers ``request``."""
        self.send(request)
        await self.expect(answer)

    @property
    def address(self) -> str:
        """Its address as the emulator tells it."""
        host, port = self.socket.getsockname()
        return f"{host}:{port}"

    def expect_silence(self) -> None:
        """See that nothing has come so far."""
        try:
            data = self.socket.recv(1 << 16)
        except BlockingIOError:
            return
        raise AssertionError(f"something came: {data.hex(' ')}")


HELLO = (CONNECTED, NO_BIT)
CLOCK_0 = bytes.fromhex(
    "50535642 18000000 32000000 b2070000 01000000 01000000 00000000 00000000 00000000"
)


async def greet(client: TcpClient | RawClient | UdpClient) -> None:
    """Connect to a camera with no status bit set; its answer and its status must come."""
    client.send(CONNECT)
    await client.expect(*HELLO)


SHORT = {
    Status.OVERHEAT: "hot",
    Status.SYSTEM_ERROR: "error",
    Status.INPUT_CONTAINER: "input",
    Status.BUSY: "busy",
    Status.RUNNING: "run",
    Status.OVERTRIGGERED: "over",
    Status.WAITING_FOR_TRIGGER: "wait",
}


def word(status: Status) -> str:
    """Return a status as ``[run wait]``."""
    return f"[{' '.join(name for bit, name in SHORT.items() if bit & status)}]"


def heard(device: Device) -> list[str]:
    """Return the device's messages, one word each."""
    return [_short(message) for message in device.take_output()]


def _short(message: m.Message) -> str:
    match message:
        case m.ConnectAnswer(version=version):
            return f"hello {version}"
        case m.StatusReport(status=status, endian=0):
            return word(status)
        case m.StatusReport(status=status, endian=endian):
            return f"{word(status)} endian {endian}"
        case m.ResultContainer(application=application, data=data):
            return f"result {application} {data.hex()}"
        case m.QueryAnswer(application=application):
            return f"active {application}"
        case m.SwitchAnswer(code=code, application=application):
            return f"switched {code} {application}"
        case m.ClockAnswer():
            return (
                f"{message.year}-{message.month}-{message.day} "
                f"{message.hour}:{message.minute}:{message.second}"
            )
        case _:
            raise AssertionError(f"a camera does not say {message}")
