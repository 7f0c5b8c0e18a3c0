"""A source of frames is lazy, gives the latest frame, and counts for each reader."""

from __future__ import annotations

import asyncio
import gc
import sys
import time
import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.calibration import CameraModel
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
    FrameTimeoutError,
    LocalProtocolError,
)
from smartcam.frames import FrameReader, FrameSource
from tests.frames.drivers import GoneError, ScriptedDriver, frame, scripted
from tests.handmade import until

pytestmark = pytest.mark.usefixtures("no_leaks")


async def test_device_streams_from_the_first_reader_to_the_last_one() -> None:
    driver, source = scripted()
    async with source:
        await asyncio.sleep(1)
        assert driver.calls == ["open"]
        first, second = source.reader(), source.reader()
        await driver.streams()
        first.close()
        await asyncio.sleep(1)
        assert driver.calls == ["open", "start"]
        second.close()
        await driver.rests()
        assert driver.calls == ["open", "start", "stop"]
        source.reader()  # without a reference
        gc.collect()
        async with source.reader():
            await driver.streams()
        await driver.rests()
        assert source.statistics().started == 2
    assert driver.calls[-1] == "close"


async def test_iteration_that_is_left_ends_the_stream() -> None:
    driver, source = scripted()
    async with source:
        giving = asyncio.create_task(_give_soon(driver, 1))
        async for one in source:
            assert one.sequence == 1
            break
        await giving
        await driver.rests()


async def _give_soon(driver: ScriptedDriver, number: int) -> None:
    await driver.streams()
    driver.give(frame(number))


async def test_slow_reader_gets_the_newest_frame_and_a_count_of_the_others() -> None:
    driver, source = scripted()
    async with source, source.reader() as slow, source.reader() as fast:
        await driver.streams()
        for number in range(1, 11):
            driver.give(frame(number, lost=int(number == 5) * 3))
            assert (await anext(fast)).sequence == number
        assert (await anext(slow)).sequence == 10
        driver.give(frame(11))
        of_slow, of_fast = slow.statistics(), fast.statistics()
        assert (of_slow.offered, of_slow.delivered, of_slow.skipped, of_slow.waiting) == (
            11,
            1,
            9,
            1,
        )
        assert (of_fast.offered, of_fast.delivered, of_fast.skipped) == (11, 10, 0)
        assert of_slow.lost == of_fast.lost == source.statistics().lost == 3


@given(st.lists(st.sampled_from(["give", "take", "lose"]), max_size=40))
async def test_every_frame_that_was_offered_is_accounted_for(steps: list[str]) -> None:
    driver, source = scripted()
    async with source, source.reader(timeout=0.01) as reader:
        await driver.streams()
        given, lost, taken = 0, 0, list[int]()
        for step in steps:
            if step == "give":
                given += 1
                driver.give(frame(given))
            elif step == "lose" and driver.sink is not None:
                lost += 2
                driver.sink.lost(2)
            else:
                try:
                    taken.append((await anext(reader)).sequence)
                except FrameTimeoutError:
                    assert not taken or taken[-1] == given
        account = reader.statistics()
        assert account.offered == account.delivered + account.skipped + account.waiting == given
        assert account.lost == lost
        assert taken == sorted(set(taken))
        assert account.delivered == len(taken)


async def test_newest_returns_the_last_frame_unless_it_is_too_old() -> None:
    driver, source = scripted()
    async with source, source.reader() as reader:
        await driver.streams()
        driver.give(frame(1, captured=time.monotonic() - 60))
        waiting = asyncio.create_task(reader.newest(max_age=30))
        await asyncio.sleep(0.01)
        assert not waiting.done()
        driver.give(frame(2))
        assert (await waiting).sequence == 2
        assert (await reader.newest(max_age=30)).sequence == 2  # still the newest
        assert reader.statistics().delivered == 2
        assert (await reader.newest(max_age=90)).sequence == 2
        assert (await source.newest(max_age=30)).sequence == 2


async def test_after_returns_no_frame_that_may_have_begun_earlier() -> None:
    driver, source = scripted()
    async with source, source.reader() as reader:
        await driver.streams()
        moment = time.monotonic()
        waiting = asyncio.create_task(reader.after(moment))
        await asyncio.sleep(0)
        driver.give(frame(1, captured=moment - 0.001))
        await asyncio.sleep(0.01)
        driver.give(frame(2, captured=moment + 1e-6, duration=0.03))  # exposed before
        await asyncio.sleep(0.01)
        assert not waiting.done()
        now = time.monotonic()
        driver.give(frame(3, captured=now, duration=now - moment))
        assert (await waiting).sequence == 3
        driver.give(frame(4))
        assert (await reader.after(moment)).sequence == 3  # the first one that is still here
        assert (await source.after(moment)).sequence == 4


async def test_timeout_names_the_awaited_frame_and_the_next_wait_works() -> None:
    driver, source = scripted(timeout=2)
    async with source, source.reader() as reader:
        begun = asyncio.get_running_loop().time()
        with pytest.raises(FrameTimeoutError, match="scripted: expected the next frame"):
            await anext(reader)
        assert asyncio.get_running_loop().time() - begun == pytest.approx(2, abs=0.1)
        with pytest.raises(FrameTimeoutError, match="of the last 1 s"):
            await reader.newest(timeout=0.1)
        with pytest.raises(FrameTimeoutError, match="exposed after"):
            await reader.after(time.monotonic(), timeout=0.1)
        driver.give(frame(1))
        assert (await anext(reader)).sequence == 1


async def test_invalid_timeout_is_refused() -> None:
    _, source = scripted(timeout=None)
    nan = float("nan")
    async with source, source.reader() as reader:
        for waiting in (
            reader.newest(max_age=-1, timeout=None),
            reader.newest(max_age=nan, timeout=None),
            reader.newest(timeout=nan),
            reader.after(nan, timeout=None),
            reader.after(float("inf"), timeout=None),
            source.newest(max_age=nan, timeout=None),
        ):
            with pytest.raises(ConfigurationError, match=r"expected .*seconds"):
                await waiting


async def test_wait_that_is_cancelled_loses_no_frame() -> None:
    driver, source = scripted()
    async with source, source.reader() as reader:
        await driver.streams()
        for steps in range(4):
            waiting = asyncio.create_task(reader.__anext__())
            for _ in range(steps):
                await asyncio.sleep(0)
            driver.give(frame(steps))
            waiting.cancel()
            taken = (await asyncio.gather(waiting, return_exceptions=True))[0]
            if isinstance(taken, BaseException):
                assert (await anext(reader)).sequence == steps
        account = reader.statistics()
        assert (account.offered, account.delivered, account.skipped) == (4, 4, 0)


async def test_stuck_device_ends_its_readers_and_is_reopened() -> None:
    driver, source = scripted(stall=3, timeout=None)
    async with source:
        async with source.reader() as reader:
            await driver.streams()
            driver.give(frame(1))
            assert (await anext(reader)).sequence == 1
            with pytest.raises(FrameSourceError, match="gave no frame for 3 s"):
                await anext(reader)
            assert driver.calls[-1] == "stop"
        async with source.reader() as reader:
            await driver.streams()
            driver.give(frame(2))
            assert (await anext(reader)).sequence == 2


async def test_camera_without_triggers_is_not_reported_as_stuck() -> None:
    driver, source = scripted(stall=None, timeout=None)
    async with source, source.reader() as reader:
        await driver.streams()
        waiting = asyncio.create_task(reader.__anext__())
        await asyncio.sleep(1000)
        driver.give(frame(1))
        assert (await waiting).sequence == 1


async def test_device_that_is_unplugged_ends_each_reader_with_its_error() -> None:
    driver, source = scripted()
    async with source:
        readers = [source.reader() for _ in range(3)]
        await driver.streams()
        driver.give(frame(1))
        assert driver.sink is not None
        driver.sink.ended(GoneError("unplugged"))
        await driver.rests()
        for reader in readers:
            assert (await anext(reader)).sequence == 1  # came before the end
            with pytest.raises(GoneError):
                await anext(reader)
            with pytest.raises(GoneError):
                await reader.newest(max_age=0)
        assert source.statistics().readers == 0
        source.reader()


async def test_end_of_a_file_ends_the_iteration() -> None:
    driver, source = scripted()
    async with source, source.reader() as reader:
        await driver.streams()
        assert driver.sink is not None
        driver.give(frame(1))
        driver.sink.ended(None)
        assert [one.sequence async for one in reader] == [1]
        with pytest.raises(FrameSourceError, match="the source ended"):
            await reader.newest(max_age=0)


@pytest.mark.parametrize("error", [GoneError("busy"), RuntimeError("a driver's own mistake")])
async def test_device_that_does_not_start_is_an_error_of_its_readers(error: Exception) -> None:
    driver, source = scripted()
    driver.fails["start"] = error
    async with source:
        async with source.reader() as reader:
            with pytest.raises(FrameSourceError, match=r"busy|a driver's own mistake"):
                await anext(reader)
        del driver.fails["start"]
        async with source.reader() as reader:
            await driver.streams()


async def test_device_that_does_not_open_is_closed_again() -> None:
    driver, source = scripted()
    driver.fails["open"] = GoneError("not there")
    with pytest.raises(GoneError):
        async with source:
            raise AssertionError("it is not open")
    assert driver.calls == ["open", "close"]
    with pytest.raises(LocalProtocolError, match="not open"):
        source.reader()
    with pytest.raises(LocalProtocolError, match="not open"):
        _ = source.format


@pytest.mark.parametrize("at", ["open", "start", "stop"])
async def test_cancellation_anywhere_leaves_the_device_closed(at: str) -> None:
    driver, source = scripted()
    driver.waits[at] = asyncio.Event()

    async def use() -> None:
        async with source, source.reader() as reader:
            if at == "stop":
                await driver.streams()
                return
            await anext(reader)

    user = asyncio.create_task(use())
    await until(lambda: at in driver.calls)
    user.cancel()
    await asyncio.sleep(0.01)
    driver.waits[at].set()
    with pytest.raises(asyncio.CancelledError):
        await user
    await until(lambda: driver.calls[-1] == "close")


async def test_closing_the_source_ends_waiting_readers() -> None:
    driver, source = scripted(timeout=None)
    async with source:
        reader = source.reader()
        await driver.streams()
        waiting = asyncio.create_task(_all(reader))
        newest = asyncio.create_task(reader.newest(timeout=None))
        await asyncio.sleep(0.01)
    assert await waiting == []
    with pytest.raises(FrameSourceError):
        await newest
    with pytest.raises(LocalProtocolError):
        source.reader()
    await source.close()


async def _all(reader: FrameReader) -> list[int]:
    return [one.sequence async for one in reader]


async def test_source_lingers_for_a_returning_reader() -> None:
    driver, source = scripted(linger=10)
    async with source:
        for wait in (9, 9, 11):
            async with source.reader():
                await driver.streams()
            await asyncio.sleep(wait)
        assert source.statistics().started == 1
        assert driver.calls == ["open", "start", "stop"]


async def test_time_in_the_future_is_that_of_the_arrival() -> None:
    driver, source = scripted()
    async with source, source.reader() as reader:
        await driver.streams()
        driver.give(frame(1, captured=time.monotonic() + 0.04))
        one = await anext(reader)
        assert one.captured <= time.monotonic()
        assert one.age >= 0
        assert source.statistics().ahead == 1


async def test_time_of_the_camera_clock_is_converted_to_the_local_clock() -> None:
    driver, source = scripted()
    async with source, source.reader() as reader:
        await driver.streams()
        now = time.monotonic()
        driver.give(frame(1, device_time=500.0, captured=now - 0.2))
        driver.give(frame(2, device_time=500.1, captured=now))  # 0.1 s longer on its way
        one = await anext(reader)
        assert one.captured == pytest.approx(now - 0.1)
        before, told, after = time.time(), one.utc + one.age, time.time()
        assert before - 0.05 < told < after + 0.05
        driver.give(frame(3, device_time=2.0))
        clock = source.statistics().clock
        assert clock is not None
        assert clock.jumps == 1


async def test_lens_travels_with_the_frames_and_has_their_size() -> None:
    matrix = np.array([[500.0, 0, 2], [0, 500, 1], [0, 0, 1]])
    lens = CameraModel(size=(4, 2), matrix=matrix)
    driver, source = scripted(camera_info=lens)
    async with source, source.reader() as reader:
        await driver.streams()
        driver.give(frame(1))
        assert (await anext(reader)).camera_info is lens
    _, source = scripted(camera_info=CameraModel(size=(640, 480), matrix=matrix))
    with pytest.raises(FrameFormatError, match="640x480, got Mono8 4x2 at 30/s"):
        async with source:
            raise AssertionError("it is not open")


@pytest.mark.parametrize(
    "options", [{"timeout": 0}, {"stall": -1}, {"stall": float("inf")}, {"linger": -0.1}]
)
def test_invalid_times_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match=f"{next(iter(options))}: expected"):
        FrameSource(ScriptedDriver(), **options)


@pytest.mark.long
async def test_memory_is_flat_over_20_000_frames() -> None:
    driver, source = scripted()
    async with source, source.reader() as fast, source.reader() as slow:
        await driver.streams()
        held = []
        for number in range(20_000):
            driver.give(frame(number, data=bytes(1000), device_time=number / 100))
            await anext(fast)
            await asyncio.sleep(0)
            if number % 7 == 0:
                await anext(slow)
            if number % 2_000 == 1_999:
                gc.collect()
                held.append(sys.getallocatedblocks())
        assert max(held[1:]) - held[0] < 500  # of memory, of which a frame takes four


# ---------------------------------------------------------------------- whose task it is


async def test_source_closed_in_the_same_turn_closes_its_device() -> None:
    driver = ScriptedDriver()
    async with FrameSource(driver) as source:
        source.reader()
    assert driver.calls[0] == "open"
    assert driver.calls[-1] == "close"


async def test_cancelled_task_of_a_source_ends_its_readers_and_restarts() -> None:
    driver = ScriptedDriver()
    async with FrameSource(driver, stall=None) as source:
        reader = source.reader(timeout=None)
        reading = asyncio.ensure_future(anext(reader))
        await until(lambda: driver.sink)
        (task,) = (one for one in asyncio.all_tasks() if one.get_name() == "frames of scripted")
        task.cancel()
        with pytest.raises(FrameSourceError, match="its task was cancelled"):
            await reading
        again = asyncio.ensure_future(anext(source.reader()))
        await until(lambda: driver.sink)
        driver.give(frame(7))
        assert (await again).sequence == 7


async def test_abandoned_source_closes_its_device() -> None:
    driver = ScriptedDriver()
    kept: list[Any] = [await FrameSource(driver, stall=None).__aenter__()]
    readers = [kept[0].reader()]
    await until(lambda: driver.sink)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # its reader has a reference
        kept.clear()
        gc.collect()
        driver.give(frame(1))
        assert (await anext(readers[0])).sequence == 1
    readers.clear()
    with pytest.warns(ResourceWarning, match="FrameSource scripted> was not closed"):
        await until(lambda: not gc.collect() and driver.calls[-1] == "close")
