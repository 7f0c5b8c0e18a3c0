"""Sender and receiver over the loopback: number and time are read from the picture."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import socket
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam import frames
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
    LocalProtocolError,
)
from smartcam.frames import Codecs, Moment, RtpSender
from smartcam.frames._inside import random_access_point, read_stamp
from smartcam.frames._streaming.rtp import decoding as receiving
from smartcam.frames._streaming.rtp import feedback
from smartcam.frames._streaming.rtp.sockets import host_and_port
from tests.frames.drivers import GoneError, scripted
from tests.frames.inside import (
    Goodbye,
    H264Packetizer,
    PacketsMissing,
    PictureLost,
    ReceiverReport,
    RtpDriver,
    RtpPacket,
    SenderReport,
    compound,
    parse_rtcp,
)
from tests.frames.pictures import HEIGHT, WIDTH, frame_of, stamped, stripes, write_stamp
from tests.frames.rtp.ways import HOST, two_ports, way

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from smartcam.frames import Frame, FrameReader, FrameSource
    from tests.frames.inside import RtpStatistics

pytestmark = pytest.mark.real_time

DRAWN = f"synthetic://?size={WIDTH}x{HEIGHT}&fps=100"
SIZE = f"size={WIDTH}x{HEIGHT}"
LIMIT = 30.0


def seen(source: FrameSource) -> RtpStatistics:
    driver = source.driver
    assert isinstance(driver, RtpDriver)
    return driver.statistics()


def patient(source: FrameSource) -> FrameSource:
    """Make a source wait for missing packets, even on a slow machine."""
    driver = source.driver
    assert isinstance(driver, RtpDriver)
    driver._plan = driver._plan._replace(repair=LIMIT)
    return source


def number_of(frame: Frame) -> int:
    """Check that a picture is whole, and return its number."""
    shown = frame.grey()
    stamp = read_stamp(shown)
    assert stamp is not None, "a broken picture"
    expected = np.roll(stripes(WIDTH, HEIGHT), stamp[0] % WIDTH, axis=1)
    write_stamp(expected, *stamp)
    assert np.abs(shown.astype(int) - expected).mean() < 4, "a broken picture"
    return stamp[0]


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(LIMIT):
        while not condition():  # noqa: ASYNC110 - nobody tells
            await asyncio.sleep(0.005)


async def read(source: FrameSource, enough: Any) -> list[Frame]:
    """Return the frames that come until a condition is true."""
    found: list[Frame] = []
    async with asyncio.timeout(LIMIT):
        async for frame in source:
            found.append(frame)
            if enough(found):
                return found
    raise AssertionError("the source ended")


async def drain(reader: FrameReader) -> None:
    async for _ in reader:
        pass


async def test_pictures_come_whole_and_in_order_with_their_times(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(receiving, "MAX_WAITING_FRAMES", 10_000)
    port = two_ports()
    async with (
        frames.open(DRAWN) as drawn,
        RtpSender(drawn, f"{HOST}:{port}", crf=18, keyint=8) as sender,
        frames.open(
            f"rtp://{HOST}:{port}?name=far&delay=0.5", timeout=LIMIT, linger=LIMIT
        ) as source,
    ):
        assert str(source.format) == f"I420_full {WIDTH}x{HEIGHT}"
        got = await read(source, lambda found: len(found) > 20 and found[-1].device_time)
        numbers = [number_of(frame) for frame in got]
        assert numbers == sorted(set(numbers))
        last = got[-1]
        assert (last.source, last.moment, last.duration) == ("far", Moment.ARRIVAL, 0.5)
        stamp = read_stamp(last.grey())
        assert stamp is not None
        assert last.captured >= stamp[1] / 1e9
        assert last.device_time is not None
        captured = time.time() - time.monotonic() + stamp[1] / 1e9
        assert last.device_time == pytest.approx(captured, abs=0.05)
        assert sum(frame.lost for frame in got) == 0
        assert [frame.sequence for frame in got] == sorted({frame.sequence for frame in got})
        told = seen(source)
        assert told.packets >= len(got)
        assert (told.lost, told.strange, told.overflows) == (0, 0, 0)
        assert told.damaged <= 1  # the refresh that the receiver joined late
        sent = sender.statistics()
        (one,) = sent.receivers
        assert one.address == f"{HOST}:{port + 1}"
        assert (one.loss, one.lost) == (0, 0)
        assert sent.frames >= len(got)
        assert sent.extra_key_frames >= 1  # for the new receiver


async def test_lost_packets_are_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receiving, "MAX_WAITING_FRAMES", 10_000)
    monkeypatch.setattr(feedback, "MAX_RESEND_AGE", LIMIT)
    port = two_ports()
    async with way(port) as between, frames.open(DRAWN) as drawn:
        gone: set[int] = set()

        def passes(packet: RtpPacket) -> bool:
            if packet.sequence % 5 or packet.sequence in gone:
                return True
            gone.add(packet.sequence)
            return False

        between.passes = passes
        async with (
            RtpSender(drawn, f"{HOST}:{between.port}") as sender,
            patient(
                frames.open(f"rtp://{HOST}:{port}?{SIZE}", timeout=LIMIT, linger=LIMIT)
            ) as source,
        ):
            got = await read(source, lambda _: seen(source).repaired > 8)
            assert [number_of(frame) for frame in got]
            assert sum(frame.lost for frame in got) == 0
            assert seen(source).lost == 0
            assert sender.statistics().resent >= seen(source).repaired


async def test_end_of_a_frame_is_requested_before_the_next_frame() -> None:
    port, packetizer = two_ports(), H264Packetizer(mtu_payload=200)
    async with Codecs(threads=1) as codecs:
        pictures = [frame_of(stamped(number), "Mono8") for number in (1, 2)]
        coded = [await codecs.h264_encoder(crf=5).encode(one) for one in pictures]
    first, second = (
        packetizer.packets(bytes(one.data), 3000 * number) for number, one in enumerate(coded)
    )
    assert min(len(first), len(second)) > 2
    with (
        socket.socket(type=socket.SOCK_DGRAM) as rtp,
        socket.socket(type=socket.SOCK_DGRAM) as rtcp,
    ):
        rtp.bind((HOST, here := two_ports()))
        rtcp.bind((HOST, here + 1))
        rtcp.setblocking(False)

        async def asked(packet: bytes) -> None:
            wanted = (RtpPacket.parse(packet).sequence,)
            while True:  # late packets are requested more than once
                for report in parse_rtcp(await asyncio.get_running_loop().sock_recv(rtcp, 2000)):
                    if isinstance(report, PacketsMissing) and report.sequences == wanted:
                        return

        def give(*packets: bytes) -> None:
            for one in packets:
                rtp.sendto(one, (HOST, port))

        async with (
            patient(frames.open(f"rtp://{HOST}:{port}?{SIZE}", timeout=LIMIT)) as source,
            source.reader() as reader,
        ):
            await until(lambda: source.statistics().streaming)
            async with asyncio.timeout(LIMIT):
                give(first[0], *first[2:])
                await asked(first[1])
                give(first[1])
                assert read_stamp((await anext(reader)).grey()) == (1, 1000)
                give(*second[:-1])
                await asked(second[-1])
                give(second[-1])
                assert read_stamp((await anext(reader)).grey()) == (2, 2000)


async def test_a_key_frame_in_the_midst_of_a_refresh_is_shown_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(receiving, "MAX_WAITING_FRAMES", 100)
    port, packetizer = two_ports(), H264Packetizer()
    async with Codecs(threads=1) as codecs:
        encoder, sent = codecs.h264_encoder(keyint=30), []
        for number in range(40):
            if number == 35:
                encoder.request_key_frame()
            sent.append(bytes((await encoder.encode(frame_of(stamped(number), "Mono8"))).data))
    (refresh,) = (number for number in range(1, 35) if random_access_point(sent[number])[1])
    async with (
        frames.open(f"rtp://{HOST}:{port}?{SIZE}&repair=0", timeout=LIMIT) as source,
        source.reader() as reader,
    ):
        await until(lambda: source.statistics().streaming)
        with socket.socket(type=socket.SOCK_DGRAM) as sender:
            for number, one in enumerate(sent):
                for data in packetizer.packets(one, 3000 * number):
                    if number != refresh - 1:
                        sender.sendto(data, (HOST, port))
                if number in (0, refresh - 2, 35):
                    async with asyncio.timeout(LIMIT):
                        while number_of(await anext(reader)) != number:
                            pass
        assert (seen(source).overflows, seen(source).lost) == (0, 1)


@pytest.mark.parametrize("back", [True, False], ids=["with key frames", "by refresh alone"])
async def test_stream_goes_on_after_a_loss_without_a_broken_picture(back: bool) -> None:
    port = two_ports()
    async with way(port) as between, frames.open(DRAWN) as drawn:
        between.back = back
        async with (
            RtpSender(drawn, f"{HOST}:{between.port}", keyint=5) as sender,
            frames.open(
                f"rtp://{HOST}:{port}?{SIZE}&repair=0", timeout=LIMIT, linger=LIMIT
            ) as source,
        ):
            got = await read(source, lambda found: len(found) > 3)
            skip: set[int] = set()
            between.passes = lambda packet: packet.sequence not in skip
            for lost in (2, 4, 6):
                last = between.carried[-1].sequence
                skip |= {last + more & 0xFFFF for more in (2, 3)}
                await until(lambda lost=lost: seen(source).lost == lost)  # type: ignore[misc]
                got += await read(source, lambda found: found[-1].lost)
            assert [number_of(frame) for frame in got]
            assert sum(frame.lost for frame in got) >= 3
            if back:
                await until(lambda: sender.statistics().extra_key_frames > 1)
            else:
                assert sender.statistics().extra_key_frames == 0


async def test_another_stream_replaces_a_silent_one() -> None:
    port = two_ports()
    async with frames.open(DRAWN) as drawn:
        url = f"rtp://{HOST}:{port}?{SIZE}"
        async with (
            frames.open(url, timeout=LIMIT, linger=LIMIT) as source,
            source.reader() as reader,
        ):
            async with RtpSender(drawn, f"{HOST}:{port}"):
                assert number_of(await anext(reader))
                with socket.socket(type=socket.SOCK_DGRAM) as other:
                    for number in range(3):
                        stray = RtpPacket(True, 96, number, 0, 77, b"\x65\x88")
                        other.sendto(stray.pack(), (HOST, port))
                    other.sendto(b"nothing", (HOST, port))
                    other.sendto(b"nothing", (HOST, port + 1))
                    async with asyncio.timeout(LIMIT):
                        while seen(source).strange < 4:
                            assert number_of(await anext(reader))
            with pytest.raises(FrameSourceError, match="said goodbye"):
                await drain(reader)
        async with (  # the sender restarted
            frames.open(url, timeout=LIMIT, linger=LIMIT) as source,
            RtpSender(drawn, f"{HOST}:{port}"),
        ):
            assert len(await read(source, lambda found: len(found) > 2)) == 3


async def test_silence_is_reported() -> None:
    port = two_ports()
    with pytest.raises(
        FrameSourceError, match=r"expected a whole picture .* within 0.1 s, got non"
    ):
        async with frames.open(f"rtp://{HOST}:{port}?timeout=0.1"):
            pass
    async with frames.open(f"rtp://{HOST}:{port}?{SIZE}&timeout=0.1") as source:
        with pytest.raises(FrameSourceError, match=r"no packet came for 0.1 s"):
            await anext(source.reader())


async def test_pictures_of_another_size_are_refused() -> None:
    port = two_ports()
    url = f"rtp://{HOST}:{port}?size=320x200"
    async with (
        frames.open(url) as source,
        frames.open(DRAWN) as drawn,
        RtpSender(drawn, f"{HOST}:{port}"),
        source.reader(timeout=LIMIT) as reader,
    ):
        with pytest.raises(FrameFormatError, match=f"320x200, .*got {WIDTH}x{HEIGHT}"):
            await anext(reader)


@pytest.mark.long
async def test_stream_that_cannot_be_decoded_is_reported() -> None:
    port = two_ports()
    async with Codecs(threads=1) as codecs:
        key = bytes((await codecs.h264_encoder().encode(frame_of(stamped(1), "Mono8"))).data)
    wrong = key[: key.find(b"\0\0\1\x65") + 4] + bytes([255]) * 40
    packetizer = H264Packetizer()
    async with frames.open(f"rtp://{HOST}:{port}?{SIZE}&payload=96") as source:
        reader = source.reader(timeout=LIMIT)
        waiting = asyncio.ensure_future(anext(reader))
        with socket.socket(type=socket.SOCK_DGRAM) as sender:
            async with asyncio.timeout(LIMIT):
                while not waiting.done():
                    for data in packetizer.packets(wrong, packetizer.sequence * 3000):
                        sender.sendto(data, (HOST, port))
                    await asyncio.sleep(0.01)
        with pytest.raises(FrameFormatError, match="expected a whole encoded frame"):
            await waiting


async def test_too_slow_decoder_restarts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receiving, "MAX_WAITING_FRAMES", 4)
    port, packetizer = two_ports(), H264Packetizer()
    async with Codecs(threads=1) as codecs:
        encoder, sent = codecs.h264_encoder(keyint=30), []
        for number in range(24):
            if number == 20:
                encoder.request_key_frame()
            sent.append(bytes((await encoder.encode(frame_of(stamped(number), "Mono8"))).data))
    async with frames.open(f"rtp://{HOST}:{port}?{SIZE}", timeout=LIMIT, linger=LIMIT) as source:
        reader = source.reader()
        await asyncio.sleep(0)
        with socket.socket(type=socket.SOCK_DGRAM) as sender:

            async def give(first: int, last: int) -> None:
                for number in range(first, last):
                    for data in packetizer.packets(sent[number], 3000 * number):
                        sender.sendto(data, (HOST, port))
                    if last - first < 5:
                        await asyncio.sleep(0.02)

            async with asyncio.timeout(LIMIT):
                await until(lambda: source.statistics().streaming)
                await give(0, 1)
                first = await anext(reader)
                await give(1, 20)  # at once
                await until(lambda: seen(source).overflows)
                await give(20, 24)
                found = await anext(reader)
                while (stamp := read_stamp(found.grey())) is None or stamp[0] < 20:
                    found = await anext(reader)
        assert read_stamp(first.grey()) == (0, 0)
        counted = source.statistics()
        assert counted.lost >= 10
        assert found.sequence == stamp[0] + 1


async def test_a_full_socket_cuts_a_frame_and_the_next_one_is_a_key_frame() -> None:
    port = two_ports()
    async with frames.open(DRAWN) as drawn, RtpSender(drawn, f"{HOST}:{port}", crf=1) as sender:
        link = sender._link
        assert link is not None

        class Full:
            left = 3

            def __init__(self, real: socket.socket) -> None:
                self.real = real

            def fileno(self) -> int:
                return self.real.fileno()

            def sendto(self, data: bytes, to: Any) -> int:
                if RtpPacket.parse(data).marker and self.left:
                    self.left -= 1
                    raise BlockingIOError
                return self.real.sendto(data, to)

            def close(self) -> None:
                self.real.close()

        link.pair.rtp = Full(link.pair.rtp)  # type: ignore[assignment]
        url = f"rtp://{HOST}:{port}?{SIZE}&repair=0"
        async with frames.open(url, timeout=LIMIT, linger=LIMIT) as source:
            got = await read(source, lambda found: len(found) > 2 and sender.statistics().cut == 3)
            got += await read(source, lambda found: len(found) > 2)
            assert [number_of(frame) for frame in got]
        assert sender.statistics().extra_key_frames >= 1


async def test_strangers_get_nothing_from_a_sender() -> None:
    port = two_ports()
    async with frames.open(DRAWN) as drawn, RtpSender(drawn, f"{HOST}:{port}") as sender:
        link = sender._link
        assert link is not None
        at = (HOST, link.pair.rtcp.getsockname()[1])
        with socket.socket(type=socket.SOCK_DGRAM) as receiver:
            receiver.bind((HOST, port + 1))
            receiver.setblocking(False)
            loop = asyncio.get_running_loop()
            async with asyncio.timeout(LIMIT):
                heard = parse_rtcp(await loop.sock_recv(receiver, 2000))
            assert isinstance(heard[0], SenderReport)
            receiver.sendto(b"nothing", at)
            receiver.sendto(compound(ReceiverReport(5), PictureLost(5, heard[0].ssrc ^ 1)), at)
            receiver.sendto(compound(ReceiverReport(6)), at)
            await until(lambda: len(sender.statistics().receivers) == 2)
            for number in range(200):
                receiver.sendto(compound(ReceiverReport(1000 + number)), at)
            await until(lambda: len(sender.statistics().receivers) == 64)
            receiver.sendto(compound(ReceiverReport(5), Goodbye((5,))), at)
            await until(lambda: len(sender.statistics().receivers) == 63)


async def test_sender_ends_with_its_source() -> None:
    driver, source = scripted()
    async with source, RtpSender(source, f"{HOST}:{two_ports()}") as sender:
        await driver.streams()
        assert driver.sink is not None
        driver.sink.ended(GoneError("unplugged", source="scripted"))
        with pytest.raises(GoneError, match="unplugged"):
            await sender.wait()
        await sender.close()
        await sender.close()
        with pytest.raises(LocalProtocolError, match="entered before"):
            await sender.__aenter__()


async def test_wrong_parameters_of_a_sender_are_refused() -> None:
    _, source = scripted()
    for to in ("host", "host:0", "host:65535", ":5004", "host:x"):
        with pytest.raises(ConfigurationError, match="expected HOST:PORT"):
            RtpSender(source, to)
    for wrong in ({"payload_type": 95}, {"ttl": 256}, {"crf": 52.0}, {"keyint": 1}):
        with pytest.raises(ConfigurationError, match=next(iter(wrong))):
            RtpSender(source, "host:5004", **wrong)
    assert host_and_port("[::1]:5004") == ("::1", 5004)
    sender = RtpSender(source, "nowhere.invalid:5004")
    with pytest.raises(LocalProtocolError, match="not open"):
        _ = sender.sdp
    with pytest.raises(LocalProtocolError, match="not open"):
        await sender.wait()
    async with source:
        with pytest.raises(FrameSourceError, match=r"nowhere\.invalid"):
            await sender.__aenter__()


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("sise=1x1", "unknown parameter 'sise'.*size"),
        ("size=1", "WIDTHxHEIGHT"),
        ("payload=128", "payload: expected a number from 0 to 127"),
        ("repair=2", "repair"),
        ("timeout=0", "timeout"),
    ],
)
def test_url_that_is_wrong(query: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        frames.open(f"rtp://{HOST}:5004?{query}")
    with pytest.raises(ConfigurationError, match="HOST:PORT"):
        frames.open("rtp://:65535")


async def test_port_that_is_in_use() -> None:
    port = two_ports()
    with socket.socket(type=socket.SOCK_DGRAM) as other:
        other.bind((HOST, port + 1))
        with pytest.raises(FrameSourceError, match=r"cannot listen on this port.*in use"):
            async with frames.open(f"rtp://{HOST}:{port}?{SIZE}"):
                pass
    async with frames.open(f"rtp://{HOST}:{port}?{SIZE}"):
        pass


@pytest.mark.parametrize("turns", range(12))
async def test_cancellation_anywhere_leaves_nothing_open(turns: int) -> None:
    port = two_ports()

    async def once() -> None:
        async with (
            frames.open(DRAWN) as drawn,
            RtpSender(drawn, f"{HOST}:{port}"),
            frames.open(f"rtp://{HOST}:{port}", timeout=LIMIT, linger=LIMIT) as source,
        ):
            await read(source, lambda found: len(found) > 1)

    task = asyncio.ensure_future(once())
    for _ in range(turns * turns):
        await asyncio.sleep(0)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    assert asyncio.all_tasks() == {asyncio.current_task()}
    for more in range(2):
        with socket.socket(type=socket.SOCK_DGRAM) as free:
            free.bind((HOST, port + more))


async def test_ffmpeg_plays_the_description(tmp_path: Path) -> None:
    if shutil.which("ffmpeg") is None:
        pytest.skip("there is no ffmpeg: apt-get install ffmpeg")
    port, file = two_ports(), tmp_path / "stream.sdp"
    async with frames.open(DRAWN) as drawn, RtpSender(drawn, f"{HOST}:{port}", keyint=5) as sender:
        await until(lambda: "sprop" in sender.sdp)
        file.write_text(sender.sdp, encoding="ascii")
        player = await asyncio.create_subprocess_exec(
            *("ffmpeg", "-v", "quiet", "-protocol_whitelist", "file,udp,rtp", "-probesize", "5000"),
            *("-i", str(file), "-frames:v", "20", "-f", "rawvideo", "-pix_fmt", "gray", "-"),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
        )
        try:
            async with asyncio.timeout(2 * LIMIT):
                out, _ = await player.communicate()
        finally:
            with contextlib.suppress(ProcessLookupError):
                player.kill()
    assert len(out) == 20 * WIDTH * HEIGHT
    pictures = np.frombuffer(out, np.uint8).reshape(20, HEIGHT, WIDTH)
    numbers = [stamp[0] for one in pictures if (stamp := read_stamp(one)) is not None]
    assert len(numbers) >= 10
    assert numbers == sorted(numbers)
