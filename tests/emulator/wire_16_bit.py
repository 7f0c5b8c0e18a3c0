"""Bytes of the dialects with 16 bits, written down by hand, and an emulated camera beside them.

Vectors from the published pages are marked *published*, those put together from the published
layouts *derived*, those of b16's bodies *inferred*.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from smartcam.emulator import EmulatedCamera, ManualClock
from tests.emulator.camera_wire import TcpClient, UdpClient

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


def frame(text: str) -> bytes:
    """Return the bytes of hex digits."""
    return bytes.fromhex(text)


CONNECT = frame("0100 0000")  # published: B-1, I-1
DISCONNECT = frame("0200 0000")  # published: B-3, I-2
GET_STATUS = frame("1200 0000")  # derived
RESET_ERRORS = frame("1600 0000")  # published: I-4
QUERY = frame("3000 0000")  # published: I-5
SWITCH_21 = frame("3100 0200 1500")  # derived
GET_CLOCK = frame("3200 0000")  # published: I-8
TRIGGER = frame("4000 0000")  # published: B-3, I-11
START = frame("4100 0000")  # published: B-3
STOP = frame("4200 0000")  # published: B-3
REBOOT = frame("4300 0000")

HELLO_WORLD = frame(  # published: B-4
    "2000 1600 1500 48656C6C6F20576F726C64 000000000000000000"
)


class Client(Protocol):
    """The common methods of both plain clients."""

    def send(self, *frames: bytes) -> None: ...

    async def expect(self, *frames: bytes) -> None: ...

    async def expect_nothing_but(self, request: bytes, answer: bytes) -> None: ...


class Rig(NamedTuple):
    """A camera on a clock that stands still, and a plain client at it."""

    emulator: EmulatedCamera
    client: Client
    clock: ManualClock

    async def asks(self, *exchanges: tuple[bytes, tuple[bytes, ...]]) -> None:
        """Send each request and see exactly its answers."""
        for request, answers in exchanges:
            self.client.send(request)
            await self.client.expect(*answers)

    async def opens(self, *hello: bytes) -> None:
        """Connect."""
        await self.asks((CONNECT, hello))


@contextlib.asynccontextmanager
async def rig(transport: Any, dialect: str, **options: Any) -> AsyncIterator[Rig]:
    """Start a camera and open a plain client's way to it; there is no session yet."""
    clock = ManualClock()
    async with (
        EmulatedCamera(transport=transport, dialect=dialect, clock=clock, **options) as emulator,
        _client(emulator) as client,
    ):
        yield Rig(emulator, client, clock)


@contextlib.asynccontextmanager
async def reopened(camera: Rig) -> AsyncIterator[Rig]:
    """Open another client's way to a camera; there is no session yet."""
    async with _client(camera.emulator) as client:
        yield camera._replace(client=client)


@contextlib.asynccontextmanager
async def _client(emulator: EmulatedCamera) -> AsyncIterator[Client]:
    made = await TcpClient.open(emulator) if emulator.transport == "tcp" else UdpClient(emulator)
    async with made as client:
        yield client
