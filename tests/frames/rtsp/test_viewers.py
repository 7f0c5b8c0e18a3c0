"""Viewers get whole pictures, the newest ones, and no viewer delays another."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam.frames import Codecs, RtspServer
from smartcam.frames._streaming.rtsp.session import (
    CLOCK_RATE,
    REPORT_INTERVAL,
    SESSION_TIMEOUT,
)
from tests.frames.drivers import GoneError, scripted
from tests.frames.inside import (
    KEY_FRAME_INTERVAL,
    LINGER,
    SECONDS_FROM_1900_TO_1970,
    STALL_TIMEOUT,
    Goodbye,
    PictureLost,
    ReceiverReport,
    RtpPacket,
    SenderReport,
    SourceDescription,
    compound,
    delivery,
    open_port_pair,
    parse_rtcp,
)
from tests.frames.pictures import frame_of, stamped, write_stamp
from tests.frames.rtsp.client import Client, Watcher
from tests.handmade import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from smartcam.frames import Frame
    from tests.frames.drivers import ScriptedDriver

pytestmark = pytest.mark.usefixtures("no_leaks")

LARGE, SMALL = (640, 480), (256, 64)


def noise(number: int, size: tuple[int, int] = LARGE) -> Frame:
    """Return a picture of noise, which no codec makes small."""
    picture = np.random.default_rng(number).integers(0, 255, size[::-1], np.uint8)
    write_stamp(picture, number, number)
    return frame_of(picture, "Mono8", number)


class Stage:
    """A server whose device gives the frames of a test."""

    def __init__(self, driver: ScriptedDriver, server: RtspServer, codecs: Codecs) -> None:
        self.driver, self.server, self.codecs = driver, server, codecs

    @property
    def counts(self) -> Any:
        return self.server.statistics()["left"]

    async def give(self, *frames: Frame) -> None:
        """Give frames, each after the encoding of the last one."""
        await self.driver.streams()
        for frame in frames:
            before = self.counts.encoded
            self.driver.give(frame)
            await until(lambda b=before: self.counts.encoded > b)  # type: ignore[misc]

    async def show(self, number: int) -> None:
        await self.give(frame_of(stamped(number), "Mono8", number))

    def watcher(self, size: tuple[int, int] | None = None) -> Watcher:
        return Watcher(self.codecs, size) if size else Watcher(self.codecs)


@asynccontextmanager
async def staged(**options: Any) -> AsyncIterator[Stage]:
    driver, source = scripted(stall=None)
    async with (
        source,
        RtspServer({"left": source}, port=0, **options) as server,
        Codecs(threads=1) as codecs,
    ):
        yield Stage(driver, server, codecs)


@pytest.fixture
async def stage() -> AsyncIterator[Stage]:
    async with staged() as made:
        yield made


async def seen(client: Client, watcher: Watcher) -> int:
    """Return the number of the next picture over the connection."""
    while (number := await watcher.see(await client.packet())) is None:
        pass
    return number


class Ports:
    """The two UDP ports of a client."""

    def __init__(self) -> None:
        self.sockets = open_port_pair("127.0.0.1", socket.AF_INET)
        self.ports = [one.getsockname()[1] for one in self.sockets]
        self.transport = f"RTP/AVP;unicast;client_port={self.ports[0]}-{self.ports[1]}"

    async def packet(self, which: int = 0) -> bytes:
        async with asyncio.timeout(20):
            return await asyncio.get_running_loop().sock_recv(self.sockets[which], 2048)

    async def seen(self, watcher: Watcher) -> int:
        while (number := await watcher.see(await self.packet())) is None:
            pass
        return number


@pytest.fixture
def ports() -> Iterator[Ports]:
    made = Ports()
    yield made
    for one in made.sockets:
        one.close()


async def test_pictures_over_the_connection(stage: Stage) -> None:
    watcher = stage.watcher()
    async with await Client.connect(stage.server) as client:
        reply = await client.play()
        begins = dict(part.split("=", 1) for part in reply.headers["rtp-info"].split(";"))
        for number in (5, 6, 7, 8):
            await stage.show(number)
            assert await seen(client, watcher) == number
        first = int(begins["seq"])
        assert watcher.sequences == [first + n & 0xFFFF for n in range(len(watcher.sequences))]
        steps = {b - a & 0xFFFFFFFF for a, b in pairwise(watcher.timestamps)}
        assert steps == {CLOCK_RATE}  # the pictures were exposed a second after each other
        await client.ask("PAUSE")
        before = stage.counts.sent
        await asyncio.sleep(1)
        assert (await client.ask("PLAY")).status == 200
        await stage.show(10)
        assert await seen(client, watcher) == 10
        assert stage.counts.sent == before + 1
        await client.ask("TEARDOWN")
        await asyncio.sleep(LINGER + 0.1)
    await stage.driver.rests()


async def test_pictures_over_udp(stage: Stage, ports: Ports) -> None:
    watcher = stage.watcher()
    async with await Client.connect(stage.server) as client:
        await client.play(ports.transport)
        assert f";client_port={ports.ports[0]}-{ports.ports[1]};server_port=" in client.transport
        for number in (5, 6, 7):
            await stage.show(number)
            assert await ports.seen(watcher) == number
        await client.ask("TEARDOWN")


async def test_twenty_viewers_are_encoded_once(stage: Stage) -> None:
    async with contextlib.AsyncExitStack() as stack:
        clients = [
            await stack.enter_async_context(await Client.connect(stage.server)) for _ in range(20)
        ]
        for client in clients:
            await client.play()
        watchers = [stage.watcher() for _ in clients]
        for number in (1, 2, 3):
            await stage.show(number)
            for client, watcher in zip(clients, watchers, strict=True):
                assert await seen(client, watcher) == number
    counts = stage.counts
    assert (counts.encoded, counts.keys, counts.sent, counts.skipped) == (3, 1, 60, 0)


async def test_viewer_that_does_not_read_skips_frames_and_resumes_whole() -> None:
    async with staged(crf=5) as stage:
        good, stalled = stage.watcher(LARGE), stage.watcher(LARGE)
        async with (
            await Client.connect(stage.server) as one,
            await Client.connect(stage.server, room=8192) as two,
        ):
            await one.play()
            await two.play()
            for number in range(1, 13):
                await stage.give(noise(number))
                assert await seen(one, good) == number
                await asyncio.sleep(0.2)
            assert stage.counts.skipped > 0
            sent = stage.counts.sent - 12
            got = [await seen(two, stalled) for _ in range(sent)]
            assert got == list(range(1, sent + 1))  # no picture in between is missing
            await asyncio.sleep(KEY_FRAME_INTERVAL)
            await stage.give(noise(20), noise(21))
            assert await seen(two, stalled) in (20, 21)  # Watcher decodes from a key frame only
            assert stalled.depacketizer.lost == 0
            assert good.numbers == list(range(1, 13))


async def test_viewer_that_reads_nothing_is_disconnected() -> None:
    async with staged(crf=5) as stage:
        good = stage.watcher(LARGE)
        async with (
            await Client.connect(stage.server) as one,
            await Client.connect(stage.server, room=8192) as two,
        ):
            await one.play()
            await two.play()
            for number in range(1, 5):
                await stage.give(noise(number))
                assert await seen(one, good) == number
            assert stage.counts.viewers == 2
            await asyncio.sleep(STALL_TIMEOUT - 1.5)
            assert (stage.counts.viewers, stage.counts.stalled) == (2, 0)
            await asyncio.sleep(3)
            assert (stage.counts.viewers, stage.counts.stalled) == (1, 1)
            await stage.give(noise(6))
            assert await seen(one, good) == 6
            assert await two.ended()


async def test_vanished_viewer_disturbs_no_other(stage: Stage, ports: Ports) -> None:
    watcher = stage.watcher()
    async with await Client.connect(stage.server) as one:
        await one.play()
        two, three = await Client.connect(stage.server), await Client.connect(stage.server)
        await two.play()
        await three.play(ports.transport)
        await stage.show(1)
        assert stage.counts.viewers == 3
        for client in (two, three):
            client.writer.transport.abort()
        await stage.show(2)
        await until(lambda: stage.counts.viewers == 1)
        await stage.show(3)
        assert [await seen(one, watcher) for _ in range(3)] == [1, 2, 3]
    await asyncio.sleep(LINGER + 0.1)
    await stage.driver.rests()


async def test_vanished_camera_is_reported(stage: Stage, ports: Ports) -> None:
    async with (
        await Client.connect(stage.server) as one,
        await Client.connect(stage.server) as two,
    ):
        await one.play()
        await two.play(ports.transport)
        await stage.show(1)
        assert stage.driver.sink is not None
        stage.driver.sink.ended(GoneError("scripted: it was unplugged"))
        assert await one.ended()
        assert await two.ended()
        goodbye = parse_rtcp(one.packets[1][-1])[-1]
        assert isinstance(goodbye, Goodbye)
        assert goodbye.reason == "scripted: it was unplugged"
        reports = [parse_rtcp(await ports.packet(1)) for _ in range(2)]
        assert isinstance(reports[0][0], SenderReport)
        assert isinstance(reports[1][-1], Goodbye)
        assert stage.counts.viewers == 0


async def test_reports_map_timestamps_to_utc(stage: Stage) -> None:
    async with await Client.connect(stage.server) as client:
        await client.play()
        await stage.show(1)
        first = parse_rtcp(await client.packet(1))
        await asyncio.sleep(REPORT_INTERVAL + 1)
        second = parse_rtcp(await client.packet(1))
        for report, described in (first, second):
            assert isinstance(report, SenderReport)
            assert isinstance(described, SourceDescription)
            assert report.ssrc == RtpPacket.parse(client.packets[0][0]).ssrc
            assert report.ntp >> 32 > SECONDS_FROM_1900_TO_1970
        a, b = first[0], second[0]
        assert isinstance(a, SenderReport)
        assert isinstance(b, SenderReport)
        passed = (b.ntp - a.ntp) / (1 << 32)
        assert (b.timestamp - a.timestamp & 0xFFFFFFFF) / CLOCK_RATE == pytest.approx(
            passed, abs=1e-3
        )
        assert (a.packets, a.octets) == (b.packets, b.octets)
        assert a.packets >= 1


async def test_udp_viewer_has_to_send_reports(stage: Stage, ports: Ports) -> None:
    report = compound(ReceiverReport(1), SourceDescription(1, "x"))
    async with await Client.connect(stage.server) as client:
        await client.play(ports.transport)
        control = int(client.transport.partition("server_port=")[2].split(";")[0].split("-")[1])
        await asyncio.sleep(SESSION_TIMEOUT - 5)
        ports.sockets[1].sendto(report, ("127.0.0.1", control))
        await asyncio.sleep(SESSION_TIMEOUT - 5)
        assert (await client.ask("GET_PARAMETER")).status == 200
        await asyncio.sleep(SESSION_TIMEOUT - 5)
        ports.sockets[1].sendto(b"no report", ("127.0.0.1", control))
        assert stage.counts.viewers == 1
        await asyncio.sleep(10)
        assert (stage.counts.viewers, stage.counts.silent) == (0, 1)
        assert await client.ended()


async def test_tcp_viewer_that_reads_pictures_need_send_nothing(
    stage: Stage,
) -> None:
    async with await Client.connect(stage.server) as client:
        await client.play()
        await asyncio.sleep(3 * SESSION_TIMEOUT)
        await client.ask("PAUSE")
        await asyncio.sleep(SESSION_TIMEOUT + 2)
        assert await client.ended()


async def test_unused_session_ends(stage: Stage) -> None:
    watcher = stage.watcher()
    async with await Client.connect(stage.server) as client:
        await client.set_up("RTP/AVP/TCP;unicast;interleaved=2-3")
        client.session = ""
        await client.play()
        await asyncio.sleep(SESSION_TIMEOUT + 2)
        assert (stage.counts.viewers, stage.counts.silent) == (1, 1)
        await stage.show(1)
        assert await seen(client, watcher) == 1


async def test_a_report_on_a_channel_counts_and_may_ask_for_a_key_frame(stage: Stage) -> None:
    watcher = stage.watcher()
    async with await Client.connect(stage.server) as client:
        await client.play()
        await stage.show(1)
        assert await seen(client, watcher) == 1
        await asyncio.sleep(KEY_FRAME_INTERVAL)
        assert watcher.depacketizer is not None
        lost = PictureLost(1, int(client.transport.partition("ssrc=")[2][:8], 16))
        data = compound(ReceiverReport(1), lost)
        client.writer.write(b"$\1" + len(data).to_bytes(2, "big") + data)
        client.writer.write(b"$\1\0\4none$\5\0\1x")  # invalid packets are ignored
        assert (await client.ask("OPTIONS")).status == 200
        await stage.show(2)
        assert stage.counts.keys == 2


class Full:
    """A socket whose buffer is full for some time."""

    def __init__(self, real: socket.socket, room: int) -> None:
        self._real, self.room = real, room

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    def sendto(self, data: bytes, to: Any) -> int:
        self.room -= 1
        if self.room < 0:
            raise BlockingIOError(errno.EAGAIN, "no room")
        return self._real.sendto(data, to)


async def test_datagrams_beyond_the_buffer_are_dropped_and_a_key_frame_follows(
    ports: Ports, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Full] = []

    def pair(*args: Any) -> tuple[Any, Any]:
        rtp, rtcp = open_port_pair(*args)
        made.append(Full(rtp, 1_000_000))
        return made[0], rtcp

    monkeypatch.setattr("smartcam.frames._streaming.rtsp.requests.open_port_pair", pair)
    async with staged(crf=5) as stage:
        watcher = stage.watcher(SMALL)
        async with await Client.connect(stage.server) as client:
            await client.play(ports.transport)
            await stage.give(noise(1, SMALL))
            made[0].room = 3
            assert await ports.seen(watcher) == 1
            await stage.give(noise(2, SMALL), noise(3, SMALL))
            made[0].room = 1_000_000
            await asyncio.sleep(KEY_FRAME_INTERVAL)
            await stage.give(noise(4, SMALL))
            watcher.decoder.note_loss()
            assert await ports.seen(watcher) == 4
            assert watcher.depacketizer.damaged == 1
            assert (stage.counts.sent, stage.counts.skipped) == (2, 2)


def test_report_of_another_host_does_not_count() -> None:
    heard: list[bytes] = []
    port = delivery._RtcpReceiver("192.0.2.1", heard.append)
    port.datagram_received(b"theirs", ("192.0.2.2", 5001))
    port.datagram_received(b"its own", ("192.0.2.1", 5001))
    port.error_received(OSError("no such port"))
    assert heard == [b"its own"]


async def test_port_pairs_are_even_and_odd(monkeypatch: pytest.MonkeyPatch) -> None:
    for _ in range(10):
        one, two = open_port_pair("127.0.0.1", socket.AF_INET)
        with one, two:
            first = one.getsockname()[1]
            assert (first % 2, two.getsockname()[1]) == (0, first + 1)

    def taken(*_: object) -> socket.socket:
        if len(asked) % 2:
            asked.append(0)
            raise OSError(errno.EADDRINUSE, "taken")
        asked.append(0)
        return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    asked: list[int] = []
    monkeypatch.setattr(delivery, "_bound_socket", taken)
    monkeypatch.setattr(socket.socket, "getsockname", lambda _: ("127.0.0.1", 4000))
    with pytest.raises(OSError, match="no two ports"):
        open_port_pair("127.0.0.1", socket.AF_INET)
    assert len(asked) == 2 * delivery.MAX_TRIES
