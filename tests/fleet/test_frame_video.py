"""H.264 of a shared camera, and JPEGs whose bit rate or latency is held: over the fleet's bus."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import numpy as np
import pytest

from smartcam import ConfigurationError, FrameFormatError, FrameSourceError
from smartcam.fleet import FleetFrame
from smartcam.fleet._frames.video import MAX_LAG, MIN_KEY_INTERVAL, SharedVideo, VideoUnit
from smartcam.frames import Codecs, Frame, FrameSource, find_format
from smartcam.frames._inside import random_access_point, read_stamp
from tests.client.clientkit import gone
from tests.fleet.fleetkit import PATIENCE, until
from tests.fleet.framekit import FramePlant, looking
from tests.fleet.inside import collector as _frame_collector
from tests.fleet.lossy_bus import LossyBus, only
from tests.frames.drivers import ScriptedDriver, frame
from tests.frames.pictures import stripes, write_stamp

pytest.importorskip("av")

SIZE = 320, 64


def stamped(number: int) -> Frame:
    """Return a picture that says which one it is."""
    width, height = SIZE
    picture = np.roll(stripes(width, height), number, axis=1)
    write_stamp(picture, number, number)
    about = {"width": width, "height": height, "stride": width, "data": picture.tobytes()}
    return frame(number, **about)


def number_in(picture: Frame) -> int:
    """Return which picture it is, by its pixels; a broken one has no number, or another."""
    stamp = read_stamp(picture.grey())
    assert stamp is not None
    assert stamp == (picture.sequence, picture.sequence)
    return stamp[0]


class Filmed:
    """Gives numbered pictures.

    Args:
        plant: its device gives them.
    """

    def __init__(self, plant: FramePlant) -> None:
        self.plant, self.number = plant, 0

    async def next(self) -> int:
        await until(lambda: self.plant.driver.sink is not None)
        self.number += 1
        self.plant.driver.give(stamped(self.number))
        return self.number


def videos(plant: FramePlant) -> list[SharedVideo]:
    return [*plant.shared._videos.values()]


# ---------------------------------------------------------------------- H.264


@pytest.mark.real_time
async def test_pictures_of_h264_are_whole_and_one_encoder_is_for_all() -> None:
    async with looking() as (plant, camera), plant.camera() as other:
        film = Filmed(plant)
        async with (
            camera.frames(encoding="h264", timeout=PATIENCE) as one,
            other.frames(encoding="h264", timeout=PATIENCE) as two,
        ):
            for _ in range(5):
                number = await film.next()
                assert number_in(await anext(one)) == number
                got = await anext(two)
                assert number_in(got) == number
                assert isinstance(got, FleetFrame)
                assert got.format.name == "I420_full"
            assert len(videos(plant)) == 1
            async with camera.frames(encoding="h264", bitrate=1e6, timeout=PATIENCE) as third:
                await until(lambda: len(videos(plant)) == 2)
                number = await film.next()
                assert number_in(await anext(third)) == number
            account = one.statistics()
            assert account.offered == account.delivered + account.skipped + account.waiting
            assert account.lost == 0
        await until(lambda: not videos(plant) and not plant.shared._streams)
        await plant.driver.rests()


@pytest.mark.real_time
async def test_encoded_frames_are_there_for_who_wants_them() -> None:
    async with looking() as (plant, camera), Codecs(threads=1) as codecs:
        decoder, film = codecs.h264_decoder(), Filmed(plant)
        async with camera.frames(encoding="h264", decode=False, timeout=PATIENCE) as frames:
            for count in range(4):
                number = await film.next()
                got = await anext(frames)
                assert got.format.name == "H264"
                assert random_access_point(bytes(got.data))[0] == (count == 0)
                picture = await decoder.decode(got)
                assert picture is not None
                assert number_in(picture) == number


@pytest.mark.real_time
async def test_lost_answer_costs_no_picture_that_was_kept_and_none_is_broken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_frame_collector, "PART_TIMEOUT", 0.1)

    def every_third(key: str, payload: bytes) -> tuple[float, ...]:
        count[0] += 1
        return () if count[0] % 3 == 0 else (0.0,)

    count = [0]
    bus = LossyBus(only("frames", every_third), local=False)
    async with looking(bus=bus, zenoh=False) as (plant, camera):
        film = Filmed(plant)

        async def give() -> None:
            while True:
                await film.next()
                await asyncio.sleep(0.03)

        task = asyncio.create_task(give())
        seen: list[int] = []
        async with camera.frames(encoding="h264", timeout=PATIENCE) as frames:
            while bus.lost < 1 or len(seen) < 12:
                seen.append(number_in(await anext(frames)))
            account = frames.statistics()
        task.cancel()  # it may wait for somebody who looks
        with contextlib.suppress(asyncio.CancelledError):
            await task
        assert seen == sorted(set(seen))
        assert account.offered == account.delivered + account.skipped + account.waiting


@pytest.mark.real_time
async def test_frames_that_cannot_be_video_end_the_stream_and_say_why() -> None:
    deep = find_format("Mono16")
    async with (
        looking() as (plant, camera),
        plant.streaming(format=deep, stride=8, data=bytes(16)),
    ):
        async with camera.frames(encoding="h264", timeout=PATIENCE) as frames:
            error = await gone(anext(frames))
            assert isinstance(error, FrameFormatError)
            assert "Mono16 cannot become video" in str(error)
        await until(lambda: not videos(plant))


@pytest.mark.real_time
async def test_device_that_is_gone_ends_a_video() -> None:
    async with looking() as (plant, camera):
        film = Filmed(plant)
        async with camera.frames(encoding="h264", timeout=PATIENCE) as frames:
            await film.next()
            await anext(frames)
            assert plant.driver.sink is not None
            plant.driver.sink.ended(FrameSourceError("unplugged", source="scripted"))
            assert "unplugged" in str(await gone(anext(frames)))


async def test_one_frame_is_no_video() -> None:
    async with looking() as (_, camera):
        wrong: Any = "h264"
        for call in (camera.newest_frame(encoding=wrong), camera.frame_after(encoding=wrong)):
            error = await gone(call)
            assert isinstance(error, ConfigurationError)
            assert "its frames depend on each other" in str(error)
        # and not at the agent either, whoever asks
        error = await gone(camera.frame_client._caller.call("frame", 60.0, {"encoding": "h264"}))
        assert isinstance(error, ConfigurationError)


@pytest.mark.parametrize(
    "asked", [{"encoding": "png", "bitrate": 1e6}, {"encoding": "jpeg", "latency": -1.0}]
)
async def test_what_cannot_be_held_is_refused(asked: dict[str, Any]) -> None:
    async with looking() as (_, camera):

        async def look() -> None:
            async with camera.frames(**asked):
                raise AssertionError("frames were promised")

        assert isinstance(await gone(look()), ConfigurationError)


# ---------------------------------------------------------------------- who gets what


class Encoder:
    """In the place of one of H.264: the first frame is a key frame, and those asked for."""

    def __init__(self) -> None:
        self.anew = True
        self.keys: list[float] = []

    def request_key_frame(self) -> None:
        self.anew = True

    async def encode(self, given: Frame) -> Frame:
        kind = 0x65 if self.anew else 0x41
        if self.anew:
            self.keys.append(asyncio.get_running_loop().time())
        self.anew = False
        return frame(given.sequence, data=b"\0\0\1" + bytes([kind]))


def has(units: list[VideoUnit]) -> list[tuple[int, bool]]:
    return [(unit.frame.sequence, unit.is_key_frame) for unit in units]


async def test_who_is_too_late_gets_nothing_until_a_key_frame_which_are_few() -> None:
    driver, encoder, loop = ScriptedDriver(), Encoder(), asyncio.get_running_loop()
    made: Any = encoder
    async with FrameSource(driver) as source:
        video = SharedVideo(source, made, "cam")
        number = 0

        async def give(count: int = 1, every: float = 0.05) -> None:
            nonlocal number
            for _ in range(count):
                number += 1
                driver.give(frame(number))
                await asyncio.sleep(every)

        await driver.streams()
        await give()
        first = await video.next_units(0)
        assert has(first) == [(1, True)]
        have = first[-1].number
        await give(3)
        units = await video.next_units(have)  # all that came since, in order
        assert has(units) == [(2, False), (3, False), (4, False)]
        have = units[-1].number
        assert has(await video.next_units(0)) == [(1, True), (2, False), (3, False), (4, False)]
        await give(round(MAX_LAG / 0.05) + 2)
        late = asyncio.create_task(video.next_units(have))
        await asyncio.sleep(0.01)
        assert not late.done()
        await give(30)
        units = await late
        assert units[0].is_key_frame
        assert len(encoder.keys) == 2
        for _ in range(40):  # whoever asks, and however often
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.0):
                    await video.next_units(5)
            await give()
        assert len(encoder.keys) > 2
        between = np.diff(encoder.keys)
        assert (between >= MIN_KEY_INTERVAL - 0.051).all()
        assert loop.time() > encoder.keys[0] + 3 * MIN_KEY_INTERVAL
        await video.close()
        assert isinstance(await gone(video.next_units(0)), FrameSourceError)


# ---------------------------------------------------------------------- what is held


@pytest.mark.both_buses
async def test_bit_rate_of_a_stream_is_held_and_said() -> None:
    chance = np.random.default_rng(1)
    noise = {"width": 160, "height": 120, "stride": 160}
    async with looking() as (plant, camera):
        asyncio.get_running_loop()
        async with (
            plant.streaming(1 / 30, data=chance.bytes(160 * 120), **noise),
            camera.frames(encoding="jpeg", bitrate=0.5e6, timeout=PATIENCE) as frames,
        ):
            got = [await anext(frames) for _ in range(4)]
        sizes = {len(one.data) for one in got}
        rates = [one.rate for one in got if isinstance(one, FleetFrame) and one.rate is not None]
        assert len(rates) == len(got)
        assert rates[-1].quality == 10  # noise: even the smallest are too large
        assert rates[-1].fps < 25.0
        assert rates[-1].reason == "bit rate, at the lowest quality"
        assert max(sizes) < 8_000


@pytest.mark.both_buses
async def test_stream_without_a_rate_says_none() -> None:
    async with looking() as (plant, camera), plant.streaming(), camera.frames() as frames:
        got = await anext(frames)
        assert isinstance(got, FleetFrame)
        assert got.rate is None
