"""An endpoint reads one datagram, however large, and makes no room for more."""

from __future__ import annotations

import asyncio
import sys
from typing import Any

from smartcam._datagrams import MAX_DATAGRAM_BYTES, limit_read_size
from smartcam.emulator import Application, EmulatedCamera
from tests.client.clientkit import emulated
from tests.emulator.camera_wire import UdpClient, greet
from tests.insides import inside

LARGEST = 9216 if sys.platform == "darwin" else 65_507
"""Bytes of a datagram that the system sends."""

HEADER, ID = 12, 4
INPUT_ID = 0x21


class Keeper(asyncio.DatagramProtocol):
    """Keeps what comes."""

    def __init__(self) -> None:
        self.came: asyncio.Queue[bytes] = asyncio.Queue()
        self.transport: Any = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """asyncio: the endpoint is there."""
        self.transport = transport
        limit_read_size(transport)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """asyncio: a datagram."""
        self.came.put_nowait(data)


async def test_endpoint_reads_the_largest_datagram_whole() -> None:
    loop = asyncio.get_running_loop()
    transport, keeper = await loop.create_datagram_endpoint(Keeper, local_addr=("127.0.0.1", 0))
    try:
        assert getattr(transport, "max_size", MAX_DATAGRAM_BYTES) == MAX_DATAGRAM_BYTES
        address = transport.get_extra_info("sockname")
        for size in (LARGEST, 1, LARGEST):
            transport.sendto(b"\7" * size, address)
            async with asyncio.timeout(5):
                assert await keeper.came.get() == b"\7" * size
    finally:
        transport.abort()


async def test_transport_of_another_kind_is_left_as_it_is() -> None:
    transport = asyncio.DatagramTransport()
    limit_read_size(transport)
    assert not hasattr(transport, "max_size")


async def test_clients_link_reads_a_result_that_fills_a_datagram() -> None:
    text = "x" * (LARGEST - HEADER - ID)
    program = Application(
        id=21, processing_time=0.0, layout=f"text: string[{len(text)}]", constant={"text": text}
    )
    box = {"transport": "udp", "applications": [program], "builtins": False, "running": True}
    async with emulated(box=box) as (_, _, camera):
        assert (await camera.trigger()).raw == text.encode()
        transport: Any = inside(camera)._connection.require_link()._transport
        assert getattr(transport, "max_size", MAX_DATAGRAM_BYTES) == MAX_DATAGRAM_BYTES


async def test_emulator_reads_input_that_fills_a_datagram() -> None:
    async with EmulatedCamera(transport="udp") as emulator, UdpClient(emulator) as client:
        await greet(client)
        size = LARGEST - HEADER
        client.send(b"PSVB" + size.to_bytes(4, "little") + bytes([INPUT_ID, 0, 0, 0]) + bytes(size))
        await emulator.wait_received(INPUT_ID)
        listener: Any = emulator._listener
        assert getattr(listener._transport, "max_size", MAX_DATAGRAM_BYTES) == MAX_DATAGRAM_BYTES
