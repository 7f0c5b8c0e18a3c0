"""Test the driver with an own camera: whole frames or losses on any network."""

import asyncio
import socket
from typing import Any

import pytest

import smartcam.frames
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
    FrameTimeoutError,
)
from smartcam.frames import Frame, FrameAddress, FrameSink, Moment
from smartcam.frames._inside import GigEDriver
from tests.frames.gige import camera as cameras
from tests.frames.gige.camera import Camera, Mischief, camera, number_in

SMALL = "packet_size=576"


class Sink(FrameSink):
    """Keeps the numbers of frames, and checks each frame."""

    def __init__(self) -> None:
        self.numbers: list[int] = []
        self.frames: list[Frame] = []
        self.counted = 0
        self.error: FrameSourceError | None = None
        self.over = asyncio.Event()
        self._came = asyncio.Event()

    async def until(self, count: int) -> None:
        """Wait for a number of frames."""
        async with asyncio.timeout(5):
            while len(self.numbers) < count:
                self._came.clear()
                await self._came.wait()

    def frame(self, frame: Frame) -> None:
        self.counted += frame.lost
        self.numbers.append(number_in(frame))
        self.frames = [*self.frames[-3:], frame]
        self._came.set()

    def lost(self, count: int) -> None:
        self.counted += count

    def ended(self, error: FrameSourceError | None) -> None:
        self.error = error
        self.over.set()


def driver(there: Camera, query: str = SMALL) -> GigEDriver:
    return GigEDriver(FrameAddress.parse(f"gige://127.0.0.1:{there.port}?{query}"))


async def streamed(there: Camera, frames: int, query: str = SMALL) -> tuple[Sink, GigEDriver]:
    """Stream until the camera has sent a number of frames, and all are whole or lost."""
    one, sink = driver(there, query), Sink()
    there.last = frames
    try:
        await one.open()
        await one.start(sink)
        async with asyncio.timeout(300):
            await there.done.wait()
        await asyncio.sleep(2)
        await one.stop()
    finally:
        await one.close()
    return sink, one


def check_account(sink: Sink, there: Camera) -> None:
    assert sink.numbers == sorted(set(sink.numbers)), "in order, each once"
    assert set(sink.numbers) <= set(there.sent)
    assert len(sink.numbers) + sink.counted == there.last


async def test_frames_arrive_whole_with_their_times() -> None:
    async with camera() as there:
        sink, one = await streamed(there, 10)
    assert sink.numbers == list(range(1, 11))
    assert sink.counted == 0
    assert sink.error is None
    last = sink.frames[-1]
    assert (last.width, last.height, last.stride, last.format.name) == (64, 48, 64, "Mono8")
    assert last.moment is Moment.ARRIVAL
    assert last.sequence == 10
    assert last.source == "Tester T1"
    assert last.duration == pytest.approx(0.001 + 0.01)  # exposure and a frame time
    assert last.device_time is not None
    before = sink.frames[-2].device_time
    assert before is not None
    assert last.device_time - before == pytest.approx(0.01, abs=1e-3)
    assert one.counts is not None
    assert one.counts.malformed == 0
    assert there.words[0xA00] == 0
    assert there.words[0xD00] == 0
    assert there.words[cameras.LOCKED] == 0
    assert there.locked_at_start == 1


async def test_a_source_by_its_url() -> None:
    async with (
        camera(mischief=Mischief(drop=0.01)) as there,
        smartcam.frames.open(f"gige://127.0.0.1:{there.port}?{SMALL}") as source,
    ):
        assert source.name == "Tester T1"
        assert not there.streaming
        numbers = []
        async with source.reader() as reader:
            async for frame in reader:
                numbers.append(number_in(frame))
                assert (frame.array() == frame.grey()).all()
                if len(numbers) == 20:
                    break
            account = reader.statistics()
        assert numbers == sorted(set(numbers))
        assert account.delivered == 20
        assert account.offered == 20 + account.skipped + account.waiting
        await asyncio.sleep(1)
        assert not there.streaming  # no reader
        assert number_in(await source.newest()) > numbers[-1]


async def test_packets_of_other_senders_are_dropped() -> None:
    async with camera() as there:
        one, sink = driver(there), Sink()
        await one.open()
        await one.start(sink)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(("127.0.0.9", 0))
            for packet in there.packets(1000, 1):
                other.sendto(packet, ("127.0.0.1", there.words[0xD00]))
            await sink.until(5)
        assert sink.numbers == [1, 2, 3, 4, 5]
        assert one._stream is not None
        assert one._stream.foreign == len(there.packets(1, 1))
        await one.close()


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
async def test_thousands_of_frames_of_a_bad_network_are_whole_or_lost(seed: int) -> None:
    it = Mischief(seed=seed, drop=0.01, double=0.05, reorder=4, skip=frozenset(range(7, 2000, 97)))
    async with camera(mischief=it, extended=seed == 2, first_id=64800) as there:
        sink, one = await streamed(there, 1500)
    check_account(sink, there)
    assert len(sink.numbers) > 1400
    assert one.counts is not None
    assert one.counts.malformed == 0


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("resend", ["answer", "ignore", "refuse"])
@pytest.mark.parametrize(
    "mischief",
    [{"drop": 0.02}, {"double": 0.2, "reorder": 3}, {"drop": 0.05, "double": 0.1, "reorder": 8}],
    ids=["drop", "double and reorder", "all"],
)
async def test_bad_network_loses_frames_and_mixes_none(
    mischief: dict[str, Any], resend: str, extended: bool
) -> None:
    it = Mischief(seed=5, resend=resend, **mischief)
    async with camera(mischief=it, extended=extended, first_id=65500) as there:
        sink, one = await streamed(there, 60)
    check_account(sink, there)
    assert one.counts is not None
    assert one.counts.malformed == 0
    if resend == "answer" or not it.drop:
        assert len(sink.numbers) >= 58
    if it.drop:
        assert there.asked
        assert there.dropped
        if resend != "answer":
            assert 0 < sink.counted < 60


async def test_without_resend_incomplete_frames_are_lost_at_once() -> None:
    async with camera(mischief=Mischief(seed=1, drop=0.02)) as there:
        sink, _ = await streamed(there, 60, f"{SMALL}&resend=off")
    check_account(sink, there)
    assert sink.counted
    assert not there.asked


async def test_restarted_block_ids_lose_no_frame() -> None:
    async with camera(mischief=Mischief(restart_at=8)) as there:
        sink, one = await streamed(there, 20)
    assert sink.numbers == list(range(1, 21))
    assert sink.counted == 0
    assert one.counts is not None
    assert one.counts.restarts == 1
    assert sink.frames[-1].sequence == 20


async def test_frames_that_the_camera_skips_are_lost() -> None:
    async with camera(mischief=Mischief(skip=frozenset({5, 6, 11, 12, 13, 14, 15, 16}))) as there:
        sink, _ = await streamed(there, 20)
    check_account(sink, there)
    assert sink.counted == 8


async def test_pictures_with_chunks_are_cut_to_their_pixels() -> None:
    async with camera(payload_type=0x4001) as there:
        there.words[cameras.PAYLOAD_EXTRA] = 700
        sink, _ = await streamed(there, 5)
    assert sink.numbers == [1, 2, 3, 4, 5]
    assert len(sink.frames[-1].data) == 64 * 48


async def test_payload_without_a_picture_ends_the_stream() -> None:
    async with camera(payload_type=6) as there:
        sink, _ = await streamed(there, 5)
    assert isinstance(sink.error, FrameFormatError)
    assert "JPEG" in str(sink.error)
    assert not sink.numbers


async def test_changed_size_ends_the_stream() -> None:
    async with camera() as there:
        one, sink = driver(there), Sink()
        await one.open()
        await one.start(sink)
        await sink.until(3)
        there.words[cameras.WIDTH], there.words[cameras.HEIGHT] = 32, 48
        await asyncio.wait_for(sink.over.wait(), 5)
        await one.close()
    assert isinstance(sink.error, FrameFormatError)
    assert "32x48" in str(sink.error)


async def test_unplugged_camera_ends_the_stream_and_is_reopened() -> None:
    async with camera(mischief=Mischief(stop_after=5)) as there:
        one, sink = driver(there), Sink()
        await one.open()
        await one.start(sink)
        async with asyncio.timeout(20):
            await sink.over.wait()
        assert sink.numbers == [1, 2, 3, 4]
        assert "no answer for" in str(sink.error)
        await one.stop()
        assert sink.counted == 1
        there.deaf, there.owner = False, None
        again = Sink()
        await one.start(again)
        await again.until(3)
        await one.close()


async def test_control_taken_by_another_application_ends_the_stream() -> None:
    async with camera() as there:
        one, sink = driver(there), Sink()
        await one.open()
        await one.start(sink)
        there.take_away("192.0.2.7")
        async with asyncio.timeout(20):
            await sink.over.wait()
        assert "control was lost" in str(sink.error)
        with pytest.raises(FrameSourceError, match=r"another application at 192\.0\.2\.7"):
            await one.start(sink)
        await one.close()


async def test_silent_refusal_of_control_differs_from_a_silent_camera() -> None:
    async with camera(mute_when_taken=True) as there:
        first = driver(there)
        await first.open()
        with pytest.raises(FrameSourceError, match="Tester T1 is controlled by another"):
            await driver(there).open()
        await first.close()


async def test_heartbeat_keeps_control_of_an_idle_camera() -> None:
    async with camera(heartbeat=1.0) as there:
        one = driver(there)
        await one.open()
        await asyncio.sleep(30)
        assert there.words[0xA00] == 2
        sink = Sink()
        await one.start(sink)
        await asyncio.sleep(5)
        assert len(sink.numbers) > 400
        assert sink.error is None
        await one.close()
        assert not there.streaming
        assert there.words[0xA00] == 0


async def test_missing_camera_is_reported_in_seconds() -> None:
    async with camera(deaf=True) as there:
        with pytest.raises(FrameTimeoutError, match="no answer to READMEM"):
            await driver(there).open()


async def test_driver_waits_for_a_pending_request() -> None:
    async with camera(pending=2.0, heartbeat=60, packed=True) as there:
        one = driver(there)
        assert str(await one.open()) == "Mono8 64x48 at 100/s"
        await one.close()


async def test_parameters_are_carried_out() -> None:
    query = "format=Mono8&size=128x96&fps=50&feature.ExposureTime=2500.5&feature.ReverseX=true"
    async with camera(packed=True) as there:
        one = driver(there, query)
        assert str(await one.open()) == "Mono8 128x96 at 50/s"
        sink = Sink()
        await one.start(sink)
        await asyncio.sleep(0.5)
        await one.close()
    assert len(sink.numbers) > 20
    assert there.words[0xD04] == 1500  # the size of the largest test packet that came
    assert there.words[cameras.FLAGS] == 0x00FB0001


@pytest.mark.parametrize(
    ("test_packets", "expected"), [(9000, 9000), (4000, 1500), (576, 576), (0, 1400)]
)
async def test_the_packet_size_is_the_largest_that_comes_through(
    test_packets: int, expected: int
) -> None:
    async with camera(test_packets=test_packets) as there:
        sink, _ = await streamed(there, 3, "resend=on")
    assert there.words[0xD04] == expected
    assert sink.numbers == [1, 2, 3]


@pytest.mark.parametrize(
    ("query", "kind", "text", "available"),
    [
        ("format=RGB8", FrameFormatError, "it has Mono8, Odd8", ("Mono8", "Odd8")),
        (
            "format=Odd8",
            FrameFormatError,
            "which is unknown; of its formats, smartcam knows Mono8",
            ("Mono8",),
        ),
        ("size=100x48", FrameFormatError, "8 to 4096 in steps of 8, got 100", None),
        ("size=64x5000", FrameFormatError, "Height: expected 1 to 3072", None),
        ("fps=2000", FrameSourceError, "0.1 to 1000, got 2000", None),
        ("feature.ExposurTime=1", FrameSourceError, "did you mean 'ExposureTime'", None),
        ("feature.Gain=1", FrameSourceError, "can only be read", None),
        ("feature.Nothing=1", FrameSourceError, "not available now", None),
        ("feature.ReverseX=maybe", FrameSourceError, "expected true or false", None),
    ],
)
async def test_unsupported_settings_are_errors(
    query: str, kind: type[FrameSourceError], text: str, available: tuple[str, ...] | None
) -> None:
    async with camera() as there:
        with pytest.raises(kind) as caught:
            await driver(there, query).open()
        assert text in str(caught.value)
        if available is not None:
            assert caught.value.available == available
        assert there.words[0xA00] == 0  # released


@pytest.mark.parametrize(
    ("query", "text"),
    [
        ("sise=1x1", "did you mean 'size'"),
        ("size=big", "WIDTHxHEIGHT"),
        ("packet_size=100", "576 to 16384"),
        ("resend=maybe", "on or off"),
        ("fps=0", "fps"),
        ("serial=1", "none together with an address"),
        ("feature.=1", "unknown parameter"),
    ],
)
def test_wrong_url_is_an_error(query: str, text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        GigEDriver(FrameAddress.parse(f"gige://127.0.0.1?{query}"))


async def test_start_that_the_camera_refuses_leaves_nothing_open() -> None:
    async with camera(refuse={cameras.START: 0x8007}) as there:
        one = driver(there)
        await one.open()
        with pytest.raises(FrameSourceError, match="BUSY"):
            await one.start(Sink())
        there.refuse.clear()
        sink = Sink()
        await one.start(sink)
        await asyncio.sleep(0.2)
        await one.close()
        assert sink.numbers


async def test_source_streams_after_a_cancellation_at_each_await() -> None:
    async with camera() as there:
        steps = 0
        while True:
            one, sink = driver(there), Sink()

            async def all_of_it(one: GigEDriver = one, sink: Sink = sink) -> None:
                await one.open()
                await one.start(sink)
                await one.stop()
                await one.close()

            task = asyncio.create_task(all_of_it())
            for _ in range(steps):
                await asyncio.sleep(0)
            done = task.done()
            task.cancel()
            await asyncio.wait([task])
            await one.close()
            there.owner, there.streaming = None, False
            there.stop()
            if done:
                break
            steps = steps + 1 + steps // 8
        sink, _ = await streamed(there, there.number + 5)
        assert len(sink.numbers) == 5
