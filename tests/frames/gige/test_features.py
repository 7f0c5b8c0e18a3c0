"""Features of a camera are read, set, described and executed, with and without a stream."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

import smartcam.frames
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
    FrameTimeoutError,
    LocalProtocolError,
    UnsupportedError,
)
from smartcam.frames import Feature, FrameSource
from tests.frames.gige import camera as cameras
from tests.frames.gige.camera import Camera, camera, number_in


@asynccontextmanager
async def opened(query: str = "", **options: Any) -> AsyncIterator[tuple[Camera, FrameSource]]:
    async with (
        camera(**options) as there,
        smartcam.frames.open(f"gige://127.0.0.1:{there.port}?packet_size=576{query}") as source,
    ):
        yield there, source


async def test_a_feature_is_read_and_set_by_its_name() -> None:
    async with opened() as (there, source):
        exposure = source.features["ExposureTime"]
        assert await exposure.get() == 1000.0
        assert await exposure.set(2500.5) == 2500.5
        assert await source.features["exposure_time"].get() == 2500.5
        assert await source.features["ReverseX"].set(True) is True
        assert there.words[cameras.FLAGS] == 0x00FB0001
        assert await source.features["PixelFormat"].get() == "Mono8"
        assert await source.features["TriggerSource"].set("Line1") == "Line1"


async def test_a_value_is_returned_as_the_camera_rounded_it() -> None:
    async with opened() as (there, source):
        assert await source.features["BlackLevel"].set(1.23) == 1.2
        assert there.words[cameras.BLACK] == 12


async def test_a_feature_is_described_with_range_unit_entries_and_access() -> None:
    async with opened() as (_, source):
        features = await source.features.describe()
        assert features["BlackLevel"] == Feature(
            name="BlackLevel",
            kind="float",
            access="rw",
            value=0.0,
            minimum=0,
            maximum=25.5,
            unit="DN",
            description="Offset of all pixels.",
        )
        width = features["Width"]
        assert (width.kind, width.value, width.minimum, width.maximum, width.step) == (
            "integer", 64, 8, 4096, 8,
        )  # fmt: skip
        assert features["Height"].maximum == 3072
        assert features["PixelFormat"].entries == ("Mono8", "Odd8")
        assert features["TriggerMode"].selectors == ("TriggerSelector",)
        assert features["Gain"].access == "ro"
        assert features["Nothing"].access == ""
        assert features["TriggerSoftware"].kind == "command"
        assert features["TriggerSoftware"].access == "wo"
        assert features["ExposureTime"].maximum is None
        problems = {one.problem.partition(" is ")[2] for one in features.values()}
        assert problems == {"", "sent with each frame only", "sent with an event only"}
        assert str(width) == "Width = 64 (8 to 4096 in steps of 8)"
        assert str(features["BlackLevel"]) == "BlackLevel = 0.0 DN (0 to 25.5 DN)"
        assert set(features) == set(await source.features.names())


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("ExposurTime", 1, "did you mean 'ExposureTime'"),
        ("Width", 100, "expected 8 to 4096 in steps of 8, got 100"),
        ("Width", 64.5, "expected a whole number"),
        ("TriggerSource", "Line7", "expected Software, Line1, got 'Line7'"),
        ("Gain", 1, "can only be read"),
        ("TriggerSoftware", 1, "it is a command: execute it"),
        ("Nothing", 1, "not available now"),
    ],
)
async def test_features_that_cannot_be_set_are_errors(name: str, value: Any, text: str) -> None:
    async with opened() as (there, source):
        before = dict(there.words)
        with pytest.raises(FrameSourceError) as caught:
            await source.features[name].set(value)
        assert text in str(caught.value)
        assert there.words == before


@pytest.mark.parametrize("value", [None, float("nan"), float("inf"), [1], 1j, b"x"])
async def test_a_value_of_no_kind_is_refused(value: Any) -> None:
    async with opened() as (_, source):
        with pytest.raises(ConfigurationError):
            await source.features["ExposureTime"].set(value)


async def test_commands_are_executed_to_their_end() -> None:
    async with opened() as (there, source):
        await source.features["BlackLevel"].set(5.0)
        await source.features.save("UserSet1")
        assert there.words[cameras.USER_SAVE] == 0
        await source.features["BlackLevel"].set(7.0)
        await source.features.load("Default")
        assert await source.features["BlackLevel"].get() == 0
        await source.features.load("UserSet1")
        assert await source.features["BlackLevel"].get() == 5.0
        await source.features.load_at_power_on("UserSet1")
        assert there.words[cameras.USER_DEFAULT] == 1
        with pytest.raises(FrameSourceError, match="expected Default, UserSet1, got 'UserSet9'"):
            await source.features.save("UserSet9")
        with pytest.raises(FrameSourceError, match="it is no command"):
            await source.features["BlackLevel"].execute()


async def test_command_that_is_not_done_in_time_is_an_error() -> None:
    async with opened() as (_, source):
        with pytest.raises(FrameTimeoutError, match="UserSetSave to be done within"):
            await source.features["UserSetSave"].execute(timeout=0.05)


async def test_features_are_set_during_a_stream() -> None:
    async with opened() as (_, source), source.reader() as reader:
        for number in range(20):
            frame = await anext(reader)
            assert await source.features["BlackLevel"].set(number / 10) == number / 10
        assert number_in(frame) >= 20
        assert source.statistics().started == 1


async def test_new_size_is_the_size_of_the_next_stream() -> None:
    async with opened() as (_, source):
        assert (source.format.width, source.format.height) == (64, 48)
        await source.features["Width"].set(128)
        assert source.format.width == 128
        frame = await source.newest()
        assert (frame.width, frame.height) == (128, 48)
        async with source.reader() as reader:
            await anext(reader)
            await source.features["Width"].set(32)
            with pytest.raises(FrameFormatError, match="then came 32x48"):
                await reader.after(float(1 << 62))
        assert (await source.newest()).width == 32
        assert source.format.width == 32


async def test_concurrent_requests_are_not_mixed() -> None:
    async with opened() as (_, source):
        await source.features["BlackLevel"].set(2.5)
        names = ["Width", "Height", "BlackLevel", "PixelFormat", "ExposureTime"] * 8
        values = await asyncio.gather(*(source.features[name].get() for name in names))
        assert values == [64, 48, 2.5, "Mono8", 1000.0] * 8


async def test_lost_camera_is_reopened_for_a_feature() -> None:
    async with opened(heartbeat=0.6) as (there, source):
        there.deaf = True
        with pytest.raises(FrameSourceError):
            await source.features["Width"].get()
        await asyncio.sleep(2)
        there.deaf, there.owner = False, None
        assert await source.features["Width"].get() == 64


async def test_closed_source_has_no_features() -> None:
    async with opened() as (there, source):
        exposure = source.features["ExposureTime"]
        assert await exposure.get()
    with pytest.raises(LocalProtocolError, match="is not open"):
        await exposure.get()
    assert there.words[0xA00] == 0


async def test_request_during_the_closing_does_not_keep_the_camera() -> None:
    async with camera(pending=0.05) as there:
        source = smartcam.frames.open(f"gige://127.0.0.1:{there.port}")
        async with source:
            asking = asyncio.create_task(source.features.describe())
            await asyncio.sleep(0.1)
        await asyncio.wait([asking])
        assert isinstance(asking.exception(), FrameSourceError)
        assert there.words[0xA00] == 0


async def test_other_sources_report_that_they_have_no_features() -> None:
    async with smartcam.frames.open("synthetic://") as source:
        with pytest.raises(UnsupportedError, match="has no features"):
            await source.features["ExposureTime"].get()


async def test_next_call_works_after_a_cancellation_at_each_await() -> None:
    async with opened() as (_, source):
        steps = 0
        while True:
            task = asyncio.create_task(source.features["BlackLevel"].set(2.0))
            for _ in range(steps):
                await asyncio.sleep(0)
            done = task.done()
            task.cancel()
            await asyncio.wait([task])
            assert await source.features["BlackLevel"].set(1.0) == 1.0
            if done:
                break
            steps = steps + 1 + steps // 4
