"""Strangers at the ports of streams and cameras replace no known sender."""

from __future__ import annotations

import asyncio
import socket
import struct
import sys

import pytest

from smartcam import frames
from smartcam.frames import RtpSender
from smartcam.frames._gige.stream import StreamSocket
from tests.frames.gige.camera import camera as gige_camera
from tests.frames.inside import (
    MAX_ANSWERS_OF_ONE_ADDRESS,
    NEW_HOST_DELAY,
    Network,
    RtpPacket,
    _NetworkSearch,
    _RtcpReceiver,
)
from tests.frames.rtp.test_stream import DRAWN, LIMIT, SIZE, number_of, seen
from tests.frames.rtp.ways import HOST, two_ports


class Junk:
    """A stranger that continuously sends packets of RTP without a picture."""

    def __init__(self, port: int, host: str = HOST) -> None:
        self._sock = socket.socket(type=socket.SOCK_DGRAM)
        self._sock.bind((host, 0))
        self._port = port
        self._number = 0
        self._task = asyncio.create_task(self._send())

    async def _send(self) -> None:
        while True:
            self._number += 1
            packet = RtpPacket(True, 96, self._number & 0xFFFF, self._number, 77, b"\x65\x88")
            self._sock.sendto(packet.pack(), (HOST, self._port))
            await asyncio.sleep(0.02)

    async def end(self) -> None:
        self._task.cancel()
        await asyncio.wait([self._task])
        self._sock.close()


@pytest.mark.long
@pytest.mark.real_time
async def test_earlier_stranger_does_not_keep_the_sender_out() -> None:
    port = two_ports()
    async with (
        frames.open(DRAWN) as drawn,
        frames.open(f"rtp://{HOST}:{port}?{SIZE}", timeout=LIMIT, linger=LIMIT) as source,
        source.reader() as reader,
    ):
        junk = Junk(port)
        try:
            async with asyncio.timeout(LIMIT):
                while not seen(source).packets:  # noqa: ASYNC110 - nobody tells
                    await asyncio.sleep(0.01)
            async with RtpSender(drawn, f"{HOST}:{port}"):
                for _ in range(3):
                    async with asyncio.timeout(LIMIT):
                        assert number_of(await anext(reader))
        finally:
            await junk.end()


@pytest.mark.real_time
@pytest.mark.skipif(sys.platform != "linux", reason="127.0.0.2 is this machine's on Linux alone")
async def test_only_packets_of_the_host_in_the_url_count() -> None:
    port = two_ports()
    url = f"rtp://{HOST}:{port}?{SIZE}&from=127.0.0.1"
    async with (
        frames.open(DRAWN) as drawn,
        frames.open(url, timeout=LIMIT, linger=LIMIT) as source,
        source.reader() as reader,
    ):
        junk = Junk(port, "127.0.0.2")
        try:
            async with asyncio.timeout(LIMIT):
                while not seen(source).strange:  # noqa: ASYNC110 - nobody tells
                    await asyncio.sleep(0.01)
                assert not seen(source).packets
                async with RtpSender(drawn, f"{HOST}:{port}"):
                    assert number_of(await anext(reader))
        finally:
            await junk.end()


@pytest.mark.long
@pytest.mark.real_time
@pytest.mark.skipif(sys.platform != "linux", reason="127.0.0.2 is this machine's on Linux alone")
async def test_another_host_does_not_replace_a_sender_between_two_pictures() -> None:
    port = two_ports()
    async with (
        frames.open(f"synthetic://?{SIZE}&fps=0.6") as drawn,  # longer apart than CHANGED
        frames.open(f"rtp://{HOST}:{port}?{SIZE}", timeout=LIMIT, linger=LIMIT) as source,
        source.reader() as reader,
        RtpSender(drawn, f"{HOST}:{port}"),
    ):
        assert NEW_HOST_DELAY > 1 / 0.6
        async with asyncio.timeout(LIMIT):
            assert await anext(reader)
            junk = Junk(port, "127.0.0.2")
            try:
                for _ in range(2):
                    assert (await anext(reader)).lost == 0
            finally:
                await junk.end()


def test_reports_to_an_rtsp_server_count_of_its_viewer_alone() -> None:
    heard: list[bytes] = []
    port = _RtcpReceiver("10.0.0.1", heard.append)
    port.datagram_received(b"stranger", ("10.0.0.2", 5001))
    port.datagram_received(b"viewer", ("10.0.0.1", 5001))
    assert heard == [b"viewer"]


@pytest.mark.skipif(sys.platform != "linux", reason="127.0.0.2 is this machine's on Linux alone")
async def test_gige_packets_count_of_the_camera_alone() -> None:
    where = StreamSocket("127.0.0.1", "127.0.0.1")
    size = 1400
    with socket.socket(type=socket.SOCK_DGRAM) as stranger:
        stranger.bind(("127.0.0.2", 0))
        stranger.sendto(bytes(size - 28), ("127.0.0.1", where.port))
        assert not await where.receives_test_packet(size, 0.1)
    where.close()


async def test_events_of_a_gige_camera_are_those_of_its_address_alone() -> None:
    async with (
        gige_camera() as there,
        frames.open(f"gige://127.0.0.1:{there.port}") as source,
        source.events("Plain", timeout=5) as events,
    ):
        item = struct.pack(">HHHHQ", 0, 0x9004, 0, 66, 5)
        datagram = struct.pack(">BBHHH", 0x42, 1, 0xC0, len(item), 1) + item
        with socket.socket(type=socket.SOCK_DGRAM) as stranger:
            stranger.bind(("127.0.0.2", 0))
            stranger.sendto(datagram, ("127.0.0.1", there.words[0xB00]))
            stranger.sendto(bytes(2000), ("127.0.0.1", there.words[0xB00]))
        there.tell("Plain", 7)
        assert (await anext(events)).block == 7


async def test_one_address_does_not_replace_all_gige_cameras() -> None:
    async with gige_camera() as there:
        asking = _NetworkSearch(Network("127.0.0.1", ()))
        answer = await discovery_of(there.port)
        for number in range(300):
            asking.datagram_received(answer, ("10.0.0.9", number))
        asking.datagram_received(answer, ("10.0.0.1", 3956))
    assert [one.address for one in asking.cameras] == ["10.0.0.9"] * MAX_ANSWERS_OF_ONE_ADDRESS + [
        "10.0.0.1"
    ]


async def discovery_of(port: int) -> bytes:
    """Return a camera's answer to a discovery request."""
    loop = asyncio.get_running_loop()
    with socket.socket(type=socket.SOCK_DGRAM) as sock:
        sock.setblocking(False)
        sock.connect(("127.0.0.1", port))
        await loop.sock_sendall(sock, bytes.fromhex("4211 0002 0000 0001"))
        async with asyncio.timeout(60):
            return await loop.sock_recv(sock, 1024)
