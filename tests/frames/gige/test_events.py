"""Events of a camera's message channel are acknowledged, and each counts once."""

import asyncio
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

import smartcam.frames
from smartcam.exceptions import (
    ConfigurationError,
    FrameSourceError,
    FrameTimeoutError,
    LocalProtocolError,
    UnsupportedError,
)
from smartcam.frames import FrameSource
from tests.frames.gige import camera as cameras
from tests.frames.gige.camera import Camera, camera


@asynccontextmanager
async def opened(**options: Any) -> AsyncIterator[tuple[Camera, FrameSource]]:
    async with (
        camera(**options) as there,
        smartcam.frames.open(f"gige://127.0.0.1:{there.port}?packet_size=576") as source,
    ):
        yield there, source


@pytest.mark.parametrize("extended", [False, True])
async def test_events_come_with_their_data(extended: bool) -> None:
    async with opened(extended=extended) as (there, source):
        async with source.events("Plain", "FrameTriggerMissed", timeout=5) as events:
            assert there.words[cameras.NOTIFY + 8] == 1
            there.tell("Plain", 7, ticks=2_000_000)
            there.tell("ExposureEnd")  # which no reader wants
            there.tell("FrameTriggerMissed", 0, ticks=3_000_000)
            first, second = await anext(events), await anext(events)
        assert (first.name, first.number, first.block, first.device_time) == (
            "Plain", 0x9004, 7, 2.0,
        )  # fmt: skip
        assert (second.name, second.block, second.device_time) == ("FrameTriggerMissed", 0, 3.0)
        assert len(there.acked) == 2
        assert there.words[cameras.NOTIFY + 8] == 0


async def test_the_data_of_an_event_are_its_features() -> None:
    async with opened() as (there, source), source.events("ExposureEnd", timeout=5) as events:
        there.tell("ExposureEnd", 9, struct.pack(">I", 0x5), ticks=1_500_000)
        event = await anext(events)
        assert event.data == {
            "EventExposureEndTimestamp": 1_500_000,
            "EventExposureEndFrameID": 9,
            "EventExposureEndLines": 5,
        }
        assert not event.remark
        there.tell("ExposureEnd", 10)
        event = await anext(events)
        assert "EventExposureEndLines" not in event.data
        assert "its message has 16" in event.remark


async def test_event_with_a_lost_acknowledgement_counts_once() -> None:
    async with opened(lose_acks=2) as (there, source):
        async with source.events("Plain", timeout=1) as events:
            there.tell("Plain", 1)
            assert (await anext(events)).block == 1
            with pytest.raises(FrameTimeoutError, match="expected Plain, none came in 1 s"):
                await anext(events)
            there.tell("Plain", 2)
            assert (await anext(events)).block == 2
        assert there.acked == [1, 2]


async def test_slow_reader_loses_the_oldest_and_gets_the_count() -> None:
    async with opened() as (there, source), source.events("Plain", size=3, timeout=5) as events:
        for block in range(1, 11):
            there.tell("Plain", block)
            await asyncio.sleep(0.01)
        seen = [await anext(events) for _ in range(3)]
        assert [one.block for one in seen] == [8, 9, 10]
        assert [one.lost for one in seen] == [7, 0, 0]


async def test_last_of_two_readers_switches_the_event_off() -> None:
    async with opened() as (there, source), source.events("Plain", timeout=5) as first:
        async with source.events("Plain", "ExposureEnd", timeout=5) as second:
            there.tell("Plain", 4)
            assert (await anext(first)).block == (await anext(second)).block == 4
        assert there.words[cameras.NOTIFY + 8] == 1
        assert there.words[cameras.NOTIFY] == 0


async def test_event_that_the_camera_lacks_is_an_error() -> None:
    async with opened() as (_, source):
        with pytest.raises(FrameSourceError, match="did you mean 'ExposureEnd'") as caught:
            await source.events("ExposurEnd").__aenter__()
        assert caught.value.available == ("ExposureEnd", "FrameTriggerMissed", "Plain")
    async with opened(tells_events=False) as (_, source):
        with pytest.raises(UnsupportedError, match="no EventSelector"):
            await source.events("ExposureEnd").__aenter__()
    with pytest.raises(LocalProtocolError, match="not open"):
        await source.events("ExposureEnd").__aenter__()


@pytest.mark.parametrize("names", [(), ("",) * 65, (1,)])
async def test_odd_names_are_refused(names: Any) -> None:
    async with smartcam.frames.open("synthetic://") as source:
        with pytest.raises(ConfigurationError):
            source.events(*names)


async def test_other_sources_have_no_events() -> None:
    async with smartcam.frames.open("synthetic://") as source:
        with pytest.raises(UnsupportedError, match="reports no events"):
            await source.events("ExposureEnd").__aenter__()


async def test_datagrams_of_other_senders_are_no_events() -> None:
    async with opened() as (there, source), source.events("Plain", timeout=0.5) as events:
        item = struct.pack(">HHHHQ", 0, 0x9004, 0, 1, 5)
        datagram = struct.pack(">BBHHH", 0x42, 1, 0xC0, len(item), 1) + item
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(("127.0.0.9", 0))
            other.sendto(datagram, ("127.0.0.1", there.words[0xB00]))
            with pytest.raises(FrameTimeoutError):
                await anext(events)


async def test_lost_camera_ends_its_events() -> None:
    async with opened(heartbeat=0.6) as (there, source):
        events = source.events("Plain", timeout=30)
        async with events:
            there.deaf = True
            with pytest.raises(FrameSourceError, match="no answer for"):
                await anext(events)


async def test_closing_the_source_ends_its_events() -> None:
    async with opened() as (there, source):
        async with source.events("Plain", timeout=30) as events:
            waiting = asyncio.ensure_future(anext(events))
            await asyncio.sleep(0)
            await source.close()
            with pytest.raises(StopAsyncIteration):
                await waiting
        assert there.words[0xB00] == 0
