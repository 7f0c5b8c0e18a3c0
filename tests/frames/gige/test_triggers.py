"""``trigger()``: the picture that this trigger caused, or a typed error; never another picture."""

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

import smartcam.frames
from smartcam.exceptions import (
    CameraBusyError,
    ConfigurationError,
    FrameLostError,
    FrameSourceError,
    FrameTimeoutError,
    NotRunningError,
    OvertriggeredError,
    TriggerTimeoutError,
    UnsupportedError,
)
from smartcam.frames import FrameSource
from tests.frames.gige import camera as cameras
from tests.frames.gige.camera import Camera, Mischief, camera, number_in


@asynccontextmanager
async def triggered(
    query: str = "trigger=software", **options: Any
) -> AsyncIterator[tuple[Camera, FrameSource]]:
    async with (
        camera(**options) as there,
        smartcam.frames.open(
            f"gige://127.0.0.1:{there.port}?packet_size=576&{query}", linger=30
        ) as source,
    ):
        yield there, source


async def test_each_trigger_returns_the_picture_that_it_caused() -> None:
    async with triggered() as (there, source):
        for number in range(1, 31):
            frame = await source.trigger()
            assert number_in(frame) == there.exposed[number]
            assert frame.trigger is not None
            assert frame.trigger.number == number
            assert frame.trigger.fired <= time.monotonic()
    assert there.triggers == 30
    assert frame.trigger is not None
    assert f"event ExposureEnd names its block {frame.sequence}" in frame.trigger.evidence[0]
    assert "it was exposed" in frame.trigger.evidence[1]


async def test_evidence_without_a_clock_names_its_basis() -> None:
    async with triggered(latches=False, tells_events=False) as (there, source):
        frame = await source.trigger()
        assert number_in(frame) == there.exposed[1]
        assert frame.trigger is not None
        (evidence,) = frame.trigger.evidence
        assert evidence.startswith("only this program may trigger it by software")


async def test_readers_also_get_the_frame() -> None:
    async with triggered() as (_, source), source.reader() as reader:
        frame = await source.trigger()
        assert await anext(reader) is frame


@pytest.mark.parametrize("latches", [True, False])
@pytest.mark.parametrize("late", ["late 0.4", "slow 0.25", "slow 0.4"])
async def test_late_picture_of_a_timed_out_trigger_is_not_used_for_the_next(
    late: str, latches: bool
) -> None:
    async with triggered("trigger=software&fps=2", latches=latches) as (there, source):
        assert number_in(await source.trigger()) == there.exposed[1]
        there.plan = [late]
        with pytest.raises(TriggerTimeoutError, match="no picture of the trigger within"):
            await source.trigger(timeout=0.2)
        there.plan = ["late 0.3"]  # the old picture may come during this wait
        frame = await source.trigger()
        assert number_in(frame) == there.exposed[3]
        await asyncio.sleep(0.5)
        assert number_in(await source.trigger()) == there.exposed[4]


async def test_camera_clock_identifies_a_late_picture_in_the_next_stream() -> None:
    async with triggered() as (there, source):
        there.plan = ["", "slow 0.5", "late 0.6"]
        await source.trigger()
        with pytest.raises(TriggerTimeoutError):
            await source.trigger(timeout=0.2)
        frame = await source.trigger()
        assert there.exposed == {1: 1, 2: 2, 3: 3}
        assert number_in(frame) == 3


async def test_a_picture_exposed_before_the_trigger_is_never_returned() -> None:
    async with triggered() as (there, source):
        there.plan = ["early"]
        frame = await source.trigger()
        assert number_in(frame) == there.exposed[1] == 2


async def test_missed_trigger_reports_that_an_older_picture_came() -> None:
    async with triggered() as (there, source):
        await source.trigger()
        there.plan = ["ignore"]
        asyncio.get_running_loop().call_later(
            0.1, lambda: there.expose(ticks=there.clock() - there.ticks)
        )
        with pytest.raises(TriggerTimeoutError, match="block 2 came, which was exposed before"):
            await source.trigger(timeout=0.3)
        assert number_in(await source.trigger()) == there.exposed[3]


@pytest.mark.parametrize("resend", ["on", "off"])
async def test_an_incomplete_picture_is_lost_and_not_replaced(resend: str) -> None:
    async with triggered(f"trigger=software&resend={resend}") as (there, source):
        await source.trigger()
        there.plan = ["cut"]
        with pytest.raises(FrameLostError, match="1 picture came incomplete"):
            await source.trigger()
        assert number_in(await source.trigger()) == there.exposed[3]


async def test_picture_after_a_lost_one_is_not_used() -> None:
    async with triggered("trigger=line1") as (there, source):

        async def pulse() -> None:
            there.pull(1)

        await source.trigger(fire=pulse)
        there.plan = ["lose", ""]

        async def bounce() -> None:
            there.pull(1)
            there.pull(1)

        with pytest.raises(FrameLostError):
            await source.trigger(fire=bounce)
        frame = await source.trigger(fire=pulse)
        assert number_in(frame) == there.exposed[4]


async def test_a_lost_picture_times_out_and_the_next_trigger_works() -> None:
    async with triggered() as (there, source):
        await source.trigger()
        there.plan = ["lose"]
        with pytest.raises(TriggerTimeoutError):
            await source.trigger(timeout=0.2)
        assert number_in(await source.trigger()) == there.exposed[3]


async def test_trigger_that_the_camera_missed_is_reported() -> None:
    async with triggered() as (there, source):
        await source.trigger()
        there.plan = ["missed"]
        with pytest.raises(OvertriggeredError, match="FrameTriggerMissed"):
            await source.trigger()
        assert number_in(await source.trigger()) == there.exposed[3]


async def test_timeout_reports_the_exposed_block() -> None:
    async with triggered() as (there, source):
        there.plan = ["", "lose"]
        await source.trigger()
        with pytest.raises(TriggerTimeoutError, match="ExposureEnd says that it exposed block 2"):
            await source.trigger(timeout=0.2)


async def test_events_with_other_ids_than_the_pictures_prove_nothing() -> None:
    async with triggered(event_ids_off=1000) as (there, source):
        for number in (1, 2, 3):
            frame = await source.trigger()
            assert number_in(frame) == there.exposed[number]
            assert frame.trigger is not None
            assert "after the camera's clock" in frame.trigger.evidence[0]


async def test_picture_of_another_block_than_the_events_is_not_used() -> None:
    async with triggered() as (there, source):
        assert number_in(await source.trigger()) == there.exposed[1]
        there.event_ids_off = 1
        with pytest.raises(FrameLostError, match="exposed block 3 for it, which did not come"):
            await source.trigger()


async def test_one_trigger_at_a_time_waits_or_is_busy() -> None:
    async with triggered() as (there, source):
        await source.trigger()
        there.plan = ["late 0.2"]
        first = asyncio.create_task(source.trigger())
        await asyncio.sleep(0.05)
        with pytest.raises(CameraBusyError):
            await source.trigger(when_busy="refuse")
        second, third = await asyncio.gather(source.trigger(), source.trigger())
        assert number_in(await first) == there.exposed[2]
        assert number_in(second) == there.exposed[3]
        assert number_in(third) == there.exposed[4]
        there.plan = ["busy"]
        with pytest.raises(CameraBusyError, match="BUSY"):
            await source.trigger()
        assert number_in(await source.trigger()) == there.exposed[5]
        assert source.statistics().started == 1


async def test_second_picture_of_one_trigger_is_not_used_for_the_next() -> None:
    async with triggered() as (there, source):
        there.plan = ["double"]
        assert number_in(await source.trigger()) == 1
        assert number_in(await source.trigger()) == there.exposed[2] == 3


async def test_function_that_sets_a_line_triggers_it() -> None:
    async with triggered("trigger=Line1") as (there, source):

        async def pulse() -> None:
            await asyncio.sleep(0)
            there.pull(1)

        frame = await source.trigger(fire=pulse)
        assert number_in(frame) == there.exposed[1]
        assert frame.trigger is not None
        assert "any other pulse on that line" in frame.trigger.evidence[-1]
        with pytest.raises(NotRunningError, match="set TriggerSource to Software, or pass `fire`"):
            await source.trigger()

        async def broken() -> None:
            raise OSError("no such output")

        with pytest.raises(OSError, match="no such output"):
            await source.trigger(fire=broken)
        assert number_in(await source.trigger(fire=pulse)) == there.exposed[2]


async def test_a_camera_that_streams_by_itself_takes_no_trigger() -> None:
    async with triggered("trigger=off") as (there, source):
        with pytest.raises(NotRunningError, match=r"its TriggerMode is Off.*trigger=Software"):
            await source.trigger()
        await source.features["TriggerMode"].set("On")
        assert number_in(await source.trigger()) == there.exposed[1]
        await source.features["TriggerMode"].set("Off")
        async with source.reader() as reader:
            await anext(reader)


async def test_a_trigger_that_needs_another_one_is_refused() -> None:
    async with triggered() as (there, source):
        there.words[cameras.TRIGGERS + 16] = 1
        await source.features["BlackLevel"].set(1.0)  # the exposure is read again
        with pytest.raises(UnsupportedError, match="On for AcquisitionStart"):
            await source.trigger()


async def test_source_without_a_trigger_reports_it() -> None:
    async with smartcam.frames.open("synthetic://") as source:
        with pytest.raises(UnsupportedError, match="has no trigger"):
            await source.trigger()


async def test_timeout_of_a_reader_reports_the_awaited_trigger() -> None:
    async with triggered() as (_, source):
        with pytest.raises(FrameTimeoutError, match="TriggerMode is On for FrameStart, Trigger"):
            await source.newest(timeout=0.2)


async def test_camera_without_triggers_is_not_reported_as_stuck() -> None:
    async with (
        camera() as there,
        smartcam.frames.open(
            f"gige://127.0.0.1:{there.port}?packet_size=576&trigger=software", stall=0.2
        ) as source,
        source.reader() as reader,
    ):
        await asyncio.sleep(0.6)
        frame = await source.trigger()
        assert await anext(reader) is frame


@pytest.mark.parametrize("seconds", [0, -1, float("nan"), "1", None])
async def test_invalid_timeout_is_refused(seconds: Any) -> None:
    async with smartcam.frames.open("synthetic://") as source:
        with pytest.raises(ConfigurationError):
            await source.trigger(timeout=seconds)


async def test_lost_camera_ends_the_trigger_with_its_error() -> None:
    async with triggered(heartbeat=0.6) as (there, source):
        await source.trigger()
        there.plan = ["ignore"]
        asyncio.get_running_loop().call_later(0.05, setattr, there, "deaf", True)
        with pytest.raises(FrameSourceError, match="no answer for"):
            await source.trigger(timeout=20)


async def test_trigger_after_a_cancellation_has_its_own_picture() -> None:
    async with triggered() as (there, source):
        steps = 0
        while True:
            task = asyncio.create_task(source.trigger())
            for _ in range(steps):
                await asyncio.sleep(0)
            done = task.done()
            task.cancel()
            await asyncio.wait([task])
            frame = await source.trigger()
            assert number_in(frame) == there.exposed[there.triggers]
            if done:
                break
            steps = steps + 1 + steps // 4


@pytest.mark.parametrize("seed", range(3))
async def test_bad_network_gives_no_trigger_the_picture_of_another(seed: int) -> None:
    mischief = Mischief(seed=seed, drop=0.05, double=0.1, reorder=3)
    outcomes = {"picture": 0, "lost": 0}
    async with triggered(mischief=mischief) as (there, source):
        for step in range(60):
            if step % 7 == 3:
                there.plan = ["late 0.15" if step % 2 else "double"]
            try:
                frame = await source.trigger(timeout=0.1 if step % 7 == 3 else 2.0)
            except (FrameLostError, TriggerTimeoutError):
                outcomes["lost"] += 1
            else:
                assert number_in(frame) == there.exposed[there.triggers]
                outcomes["picture"] += 1
    assert outcomes["picture"] > 40


AUTOMATIC = cameras.DESCRIPTION.replace(
    '<FloatReg Name="ExposureTime">',
    '<Enumeration Name="ExposureAuto"><EnumEntry Name="Off"><Value>0</Value></EnumEntry>'
    '<EnumEntry Name="Continuous"><Value>1</Value></EnumEntry><pValue>Automatic</pValue>'
    '</Enumeration><Integer Name="Automatic"><Value>1</Value></Integer>'
    '<Float Name="ExposureTime"><pValue>ExposureReg</pValue><Max>500000</Max></Float>'
    '<FloatReg Name="ExposureReg">',
)
"""A camera that chooses its exposure times, 0.5 s at most."""


@pytest.mark.real_time
async def test_exposure_set_during_a_stream_is_on_the_next_frames() -> None:
    async with (
        camera() as there,
        smartcam.frames.open(f"gige://127.0.0.1:{there.port}?packet_size=576") as source,
        source.reader() as reader,
    ):
        assert (await anext(reader)).duration == pytest.approx(0.001 + 0.01)
        await source.features["ExposureTime"].set(1_000_000.0)
        frame = await reader.after(time.monotonic(), timeout=30)
        assert frame.duration == pytest.approx(1.0 + 0.01)
        await source.features["ExposureTime"].set(1000.0)
        frame = await reader.after(time.monotonic() - 0.9, timeout=30)
        assert frame.duration == pytest.approx(1.0 + 0.01)  # the exposure may have begun before
        async with asyncio.timeout(30):
            while (await anext(reader)).duration > 0.02:
                pass


async def test_automatic_exposure_is_the_frames_own_or_the_longest() -> None:
    async with (
        camera(description=AUTOMATIC.encode()) as there,
        smartcam.frames.open(f"gige://127.0.0.1:{there.port}?packet_size=576") as source,
    ):
        assert (await source.newest()).duration == pytest.approx(0.5 + 0.01)
    async with (
        camera(description=AUTOMATIC.encode(), payload_type=0x4001) as there,
        smartcam.frames.open(
            f"gige://127.0.0.1:{there.port}?packet_size=576&feature.ChunkModeActive=true"
        ) as source,
    ):
        assert (await source.newest()).duration == pytest.approx(0.001 + 0.01)
