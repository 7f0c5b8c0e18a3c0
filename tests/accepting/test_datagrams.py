"""Strangers at every port that hears datagrams: they take no place of who is there."""

from __future__ import annotations

import asyncio
import socket
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import smartcam
from smartcam.emulator import EmulatedCamera
from smartcam.testing.proxy import LinkProxy
from tests.emulator import camera_wire as wire
from tests.frames.rtp.ways import HOST

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

STRANGERS = 100
"""Addresses, more than any port keeps places for."""

SAID = (b"", b"\0", wire.QUERY, bytes(1400), b"\x80\x60" + bytes(30))


@asynccontextmanager
async def flooded(port: int) -> AsyncIterator[None]:
    """Send something from strangers, each with its own port."""
    socks = [socket.socket(type=socket.SOCK_DGRAM) for _ in range(STRANGERS)]
    try:
        for one in socks:
            one.setblocking(False)
            for said in SAID:
                one.sendto(said, (HOST, port))
                for _ in range(3):  # what the system cannot keep would be lost
                    await asyncio.sleep(0)
        yield
    finally:
        for one in socks:
            one.close()


async def test_the_session_of_an_emulated_camera_stays() -> None:
    async with (
        EmulatedCamera(transport="udp") as camera,
        smartcam.connect(camera.url, reconnect=None) as client,
    ):
        async with flooded(camera.port):
            assert await client.query_application() == 1
            assert len(camera.links) <= camera.max_links
        assert await client.query_application() == 1


async def test_a_newcomer_gets_into_an_emulated_camera() -> None:
    async with (
        EmulatedCamera(transport="udp") as camera,
        flooded(camera.port),
        smartcam.connect(camera.url, reconnect=None) as client,
    ):
        assert await client.query_application() == 1


async def test_a_client_of_the_proxy_stays() -> None:
    async with (
        EmulatedCamera(transport="udp") as camera,
        LinkProxy(HOST, camera.port, transport="udp") as proxy,
        smartcam.connect(proxy.url(camera.url), reconnect=None) as client,
    ):
        async with flooded(proxy.port):
            assert await client.query_application() == 1
            assert proxy.open_connections <= 64
        assert await client.query_application() == 1
