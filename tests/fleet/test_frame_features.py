"""Features and triggers of a GigE camera that an agent shares, as its programs see them."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest

import smartcam.frames
from smartcam import ConfigurationError, FrameSourceError, UnsupportedError
from smartcam.exceptions import CameraBusyError, NotRunningError, TriggerTimeoutError
from smartcam.fleet import FleetCamera
from tests.fleet.fleetkit import NAME, Plant
from tests.frames.gige.camera import Camera, camera, number_in
from tests.frames.rtsp_client import camera as rtsp
from tests.frames.rtsp_client.test_parameters import with_parameters
from tests.handmade import until
from tests.timed_loop import TimedLoop


class GigEPlant(Plant):
    """A plant whose camera's frames come from a GigE camera."""

    def __init__(self, there: Camera, query: str, **options: Any) -> None:
        self._url = f"gige://127.0.0.1:{there.port}?packet_size=576{query}"
        options.setdefault("zenoh", not isinstance(asyncio.get_running_loop(), TimedLoop))
        super().__init__(frames=self._make, **options)

    def _make(self) -> smartcam.frames.FrameSource:
        return smartcam.frames.open(self._url, linger=30)


@contextlib.asynccontextmanager
async def shared(
    query: str = "&trigger=software", **options: Any
) -> AsyncIterator[tuple[Camera, FleetCamera[Any], GigEPlant]]:
    async with (
        camera(**options) as there,
        GigEPlant(there, query) as plant,
        plant.camera() as one,
    ):
        yield there, one, plant


@pytest.mark.both_buses
async def test_features_are_those_of_the_device() -> None:
    async with shared() as (_, one, plant), one.frame_source() as source:
        assert await source.features["exposure_time"].get() == 1000.0
        assert await source.features["BlackLevel"].set(1.23) == 1.2
        black = await source.features["BlackLevel"].describe()
        assert (black.kind, black.unit, black.value, black.maximum) == ("float", "DN", 1.2, 25.5)
        there = await plant.agent.shared_cameras[NAME].frames.source()
        assert await source.features.names() == await there.features.names()
        assert await source.features.describe() == await there.features.describe()
        await source.features.save("UserSet1")
        await source.features["BlackLevel"].set(3.0)
        await source.features.load("UserSet1")
        assert await source.features["BlackLevel"].get() == 1.2
        with pytest.raises(FrameSourceError, match="did you mean 'BlackLevel'") as caught:
            await source.features["BlackLevl"].set(1)
        assert "Width" in caught.value.available
        with pytest.raises(FrameSourceError, match=r"expected 0 to 25\.5, got 26"):
            await source.features["BlackLevel"].set(26)


@pytest.mark.both_buses
async def test_a_trigger_returns_the_picture_that_it_caused() -> None:
    query = "&trigger=software&feature.ChunkModeActive=true"
    async with shared(query) as (there, one, _), one.frame_source() as source:
        for number in range(1, 6):
            frame = await source.trigger()
            assert number_in(frame) == there.exposed[number]
            assert frame.trigger is not None
            assert frame.trigger.number == number
            assert "names its block" in frame.trigger.evidence[0]
            assert frame.chunks["ChunkFrameID"] == number_in(frame)
        there.plan = ["late 0.5"]
        with pytest.raises(TriggerTimeoutError, match="no picture of the trigger within"):
            await source.trigger(timeout=0.2)
        assert number_in(await source.trigger()) == there.exposed[7]


async def test_triggers_of_two_programs_have_each_their_own_picture() -> None:
    async with (
        shared() as (there, one, plant),
        plant.camera() as other,
        one.frame_source() as first,
        other.frame_source() as second,
    ):
        await first.trigger()
        pictures = await asyncio.gather(*(s.trigger() for s in (first, second) * 5))
        assert sorted(map(number_in, pictures)) == sorted(
            there.exposed[number] for number in range(2, 12)
        )
        there.plan = ["late 0.3"]
        slow = asyncio.create_task(first.trigger())
        await until(lambda: 12 in there.exposed)
        with pytest.raises(CameraBusyError):
            await second.trigger(when_busy="refuse")
        await slow


async def test_a_readers_stream_has_a_triggered_picture_once() -> None:
    async with shared() as (_, one, _), one.frame_source() as source, source.reader() as reader:
        await asyncio.sleep(0.3)
        frame = await source.trigger()
        assert (await anext(reader)).sequence == frame.sequence
        await asyncio.sleep(0.3)
        assert reader.statistics().offered == 1


async def test_what_cannot_be_done_is_said_as_by_the_device() -> None:
    async with shared("") as (_, one, _), one.frame_source() as source:
        with pytest.raises(NotRunningError, match="TriggerMode is Off"):
            await source.trigger()

        async def fire() -> None:
            raise AssertionError("it was called")

        with pytest.raises(UnsupportedError, match="cannot be called there"):
            await source.trigger(fire=fire)
        with pytest.raises(ConfigurationError):
            await source.features["Width"].set(float("nan"))


async def test_a_camera_without_frames_has_no_features() -> None:
    async with Plant() as plant, plant.camera() as one:
        with pytest.raises(UnsupportedError, match="has no frames"):
            await one.frame_source().__aenter__()


@pytest.mark.real_time
async def test_parameters_of_an_rtsp_camera_are_features_on_the_bus() -> None:
    there = with_parameters(await rtsp.pictures())
    async with (
        rtsp.camera_on(there) as where,
        Plant(frames=lambda: smartcam.frames.open(f"rtsp://{where}")) as plant,
        plant.camera() as one,
        one.frame_source() as source,
    ):
        assert await source.features["zoom"].get() == "2"
        assert await source.features["zoom"].set(4) == "4"
        assert (await source.features["serial"].describe()).value == "A17 b"
        with pytest.raises(FrameSourceError, match="'serial': it can only be read"):
            await source.features["serial"].set("B")
        with pytest.raises(UnsupportedError, match="cannot list its parameters"):
            await source.features.describe()
