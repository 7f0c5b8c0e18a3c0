"""Frames of a shared camera: one on request, and streams; the same over both buses."""

from __future__ import annotations

import asyncio
import math
import time
from typing import Any

import numpy as np
import pytest

import smartcam
from smartcam import (
    ConfigurationError,
    ConnectionClosedError,
    ConnectionLostError,
    FrameFormatError,
    FrameSourceError,
    FrameTimeoutError,
    RemoteProtocolError,
    UnsupportedError,
)
from smartcam.calibration import CameraModel
from smartcam.fleet import FleetFrame
from smartcam.fleet._frames import caller as _frame_caller
from smartcam.fleet._frames import stream as _frame_stream
from smartcam.frames import Moment
from tests.client.clientkit import gone
from tests.fleet.fleetkit import NAME, PATIENCE, Plant, end_of, until
from tests.fleet.framekit import FramePlant, looking
from tests.fleet.inside import SharedFrames, to_fields
from tests.fleet.inside import camera_frames as _frames
from tests.frames.drivers import GoneError, frame
from tests.timed_loop import TimedLoop

LENS = CameraModel(size=(4, 2), matrix=np.array([[3.0, 0, 2], [0, 3, 1], [0, 0, 1]]))


def in_process() -> bool:
    return isinstance(asyncio.get_running_loop(), TimedLoop)


# ---------------------------------------------------------------------- one frame


@pytest.mark.both_buses
async def test_frame_comes_with_all_that_is_known_of_it() -> None:
    async with looking(source={"camera_info": LENS, "linger": 60.0}) as (plant, camera):
        asking = asyncio.create_task(camera.newest_frame(max_age=math.inf, timeout=PATIENCE))
        await plant.driver.streams()
        given = frame(
            7, moment=Moment.FRAME_END, duration=0.25, lost=3, utc=1.5e9, data=b"\x01\x02" * 4
        )
        plant.driver.give(given)
        got = await asking
        assert isinstance(got, FleetFrame)
        assert bytes(got.data) == given.data
        assert (got.format, got.width, got.height, got.stride) == (given.format, 4, 2, 4)
        assert (got.sequence, got.lost, got.moment, got.utc) == (7, 3, Moment.FRAME_END, 1.5e9)
        assert (got.source, got.encoding_time) == (NAME, 0.0)
        assert abs(got.captured - given.captured) <= got.duration - given.duration + 1e-6
        assert got.began <= given.began + 1e-6
        assert got.camera_info is not None
        assert got.camera_info.to_data() == LENS.to_data()
        again = await camera.newest_frame(max_age=math.inf)
        assert again.camera_info is got.camera_info  # it crosses once


async def test_frame_in_one_process_is_not_copied() -> None:
    async with looking(source={"linger": 60.0}) as (plant, camera):
        asking = asyncio.create_task(camera.newest_frame(max_age=math.inf))
        await plant.driver.streams()
        given = frame(1, data=bytes(2_000_000), width=2000, height=1000, stride=2000)
        plant.driver.give(given)
        got = await asking
        assert got.data is given.data
        assert got.captured == pytest.approx(given.captured)
        assert got.duration == 0.0


@pytest.mark.both_buses
async def test_newest_frame_is_not_older_than_wanted() -> None:
    async with looking(source={"linger": 60.0}) as (plant, camera):
        asking = asyncio.create_task(camera.newest_frame(timeout=PATIENCE))
        await plant.driver.streams()
        plant.driver.give(frame(1, captured=time.monotonic() - 10.0))
        await asyncio.sleep(0.05)
        assert not asking.done()
        while not asking.done():  # one that is new yet when it is looked at
            plant.driver.give(frame(2))
            await asyncio.sleep(0.05)
        assert (await asking).sequence == 2
        assert (await camera.newest_frame(max_age=60.0)).sequence == 2
        plant.driver.give(frame(3, captured=time.monotonic() - 10.0))
        assert (await camera.newest_frame(max_age=math.inf)).sequence == 3


@pytest.mark.both_buses
async def test_frame_after_was_exposed_after_the_call_or_the_moment() -> None:
    async with looking(source={"linger": 60.0}) as (plant, camera), camera.frames():
        await plant.driver.streams()
        for given in (False, True):
            plant.driver.give(frame(1))
            moment = time.monotonic() if given else None
            asking = asyncio.create_task(camera.frame_after(moment, timeout=PATIENCE))
            await until(lambda: plant.shared._pending_calls)
            # exposed before, or perhaps: both came after
            plant.driver.give(frame(2, duration=1000.0))
            plant.driver.give(frame(3, captured=time.monotonic() - 1000.0))
            await asyncio.sleep(0.05)
            assert not asking.done()
            while not asking.done():  # the agent's clock is known as well as a call was quick
                plant.driver.give(frame(4))
                await asyncio.sleep(0.05)
            assert (await asking).sequence == 4


@pytest.mark.both_buses
async def test_no_frame_in_time_is_told_by_the_agent() -> None:
    async with looking() as (plant, camera):
        for call in (camera.newest_frame, camera.frame_after):
            error = await gone(call(timeout=0.2))
            assert isinstance(error, FrameTimeoutError)
            assert error.source == NAME
            if in_process():  # else the answer may come later than is waited for it
                assert "waited 0.2 s for a frame" in str(error)
        await until(lambda: not plant.shared._pending_calls)


@pytest.mark.both_buses
async def test_device_that_cannot_be_opened_is_told_with_what_it_has() -> None:
    async with looking() as (plant, camera):
        refused = FrameFormatError("no such pixels", source="dev", available=("Mono8 4x2",))
        plant.driver.fails["open"] = refused
        for call in (camera.newest_frame(), camera.frames().__aenter__()):
            error = await gone(call)
            assert isinstance(error, FrameFormatError)
            assert (str(error), error.available) == ("no such pixels", ("Mono8 4x2",))
        del plant.driver.fails["open"]
        async with plant.streaming():
            assert (await camera.newest_frame()).sequence >= 1


# ---------------------------------------------------------------------- streams


@pytest.mark.both_buses
async def test_stream_gives_what_comes_and_counts_what_is_skipped_and_lost() -> None:
    async with looking() as (plant, camera), camera.frames(timeout=PATIENCE) as frames:
        for number in (1, 2):
            await plant.waits()
            plant.driver.give(frame(number))
            assert (await anext(frames)).sequence == number
        await plant.waits()
        for number in range(3, 10):
            plant.driver.give(frame(number))  # one goes on its way, one waits: five are skipped
        await until(lambda: frames.statistics().offered == 9)
        assert (await anext(frames)).sequence == 9
        plant.driver.give(frame(15, lost=5))
        last = await anext(frames)
        assert (last.sequence, last.lost) == (15, 5)
        account = frames.statistics()
        assert (account.offered, account.waiting, account.lost) == (10, 0, 5)
        assert account.delivered == 4
        assert account.skipped == 6


@pytest.mark.both_buses
async def test_stream_that_nobody_takes_has_the_newest_frame() -> None:
    async with (
        looking() as (plant, camera),
        camera.frames(timeout=PATIENCE) as frames,
        plant.streaming(),
    ):
        await until(lambda: frames.statistics().offered >= 10)
        got = await frames.newest()
        assert got.sequence >= 10
        after = await frames.after(time.monotonic())
        assert after.sequence > got.sequence


@pytest.mark.both_buses
async def test_nothing_streams_while_nobody_looks() -> None:
    async with looking() as (plant, camera):
        await camera.trigger()
        assert plant.driver.calls == []  # it was not even opened
        async with plant.streaming():
            async with camera.frames() as first:
                await anext(first)
                async with camera.frames() as second:
                    await anext(second)
                    assert plant.driver.calls == ["open", "start"]
                await anext(first)
            await plant.driver.rests()
            assert plant.driver.calls == ["open", "start", "stop"]
            await camera.newest_frame()
            await plant.driver.rests()
            assert plant.driver.calls[3:] == ["start", "stop"]


@pytest.mark.both_buses
async def test_program_that_is_gone_has_nothing_stream() -> None:
    async with looking() as (plant, camera), plant.streaming(), camera.frames() as frames:
        await anext(frames)
        await camera._program.bus.close()  # as where it is killed: it says no more
        await plant.driver.rests()
        assert not plant.shared._streams
        assert not plant.shared._pending_calls


async def test_program_that_asks_no_more_has_nothing_stream() -> None:
    async with looking() as (plant, camera), plant.streaming():
        stream = camera.frame_client.next_stream()
        loop = asyncio.get_running_loop()
        arguments = {"stream": stream, "encoding": "raw", "quality": None}
        counts = _frame_caller.StreamCounts()
        await camera.frame_client.request_frame("next_frame", loop.time() + 1, arguments, counts)
        await asyncio.sleep(_frame_stream.IDLE_TIMEOUT - 0.1)
        assert plant.driver.sink is not None
        await asyncio.sleep(0.2)
        assert plant.driver.sink is None
        assert not plant.shared._streams
        # and goes on as if it had been away
        answer, got = await camera.frame_client.request_frame(
            "next_frame", loop.time() + 1, arguments, counts
        )
        assert got is not None
        assert answer["skipped"] == got.lost == 0


@pytest.mark.both_buses
async def test_unplugged_device_ends_the_stream_and_the_next_one_tries_again() -> None:
    async with looking() as (plant, camera), camera.frames(timeout=PATIENCE) as frames:
        await plant.waits()
        assert plant.driver.sink is not None
        plant.driver.sink.ended(GoneError("unplugged", source="dev"))
        error = await gone(anext(frames))
        assert type(error) is FrameSourceError
        assert "unplugged" in str(error)
        assert error.source == "dev"
        plant.driver.fails["start"] = GoneError("still away")
        assert "still away" in str(await gone(camera.newest_frame()))
        del plant.driver.fails["start"]
        async with plant.streaming(), camera.frames() as again:
            assert (await anext(again)).sequence == 1


@pytest.mark.both_buses
async def test_source_that_ends_in_order_ends_the_stream() -> None:
    async with looking() as (plant, camera), camera.frames(timeout=PATIENCE) as frames:
        await plant.waits()
        assert plant.driver.sink is not None
        plant.driver.give(frame(1))
        plant.driver.sink.ended(None)
        assert [one.sequence async for one in frames] == [1]


@pytest.mark.both_buses
async def test_agent_that_is_gone_ends_the_stream_and_a_new_one_is_read_anew() -> None:
    async with looking() as (plant, camera), plant.streaming():
        async with camera.frames(timeout=PATIENCE) as frames:
            await anext(frames)
            await plant.stop_agent()
            with pytest.raises(FrameSourceError, match="agent") as caught:
                async for _ in frames:
                    pass
            assert isinstance(caught.value.__cause__, ConnectionLostError)
            assert isinstance(await gone(camera.newest_frame()), ConnectionLostError)
            assert isinstance(await gone(camera.frames().__aenter__()), FrameSourceError)
        await plant.start_agent()
        await camera.wait_connected(PATIENCE)
        async with camera.frames() as frames:
            await anext(frames)
        await camera.newest_frame()


async def test_closed_camera_ends_its_stream() -> None:
    async with FramePlant() as plant, plant.streaming():
        camera = await plant.camera().open()
        async with camera.frames() as frames:
            await anext(frames)
            await camera.close()
            with pytest.raises(FrameSourceError, match="closed"):
                async for _ in frames:
                    pass


async def test_camera_that_is_not_open_says_so() -> None:
    async with FramePlant() as plant:
        camera = plant.camera()
        for _ in range(2):  # before and after
            for call in (camera.newest_frame(), camera.frame_after(1.0)):
                assert isinstance(await gone(call), ConnectionClosedError)
            assert isinstance(await gone(camera.frames().__aenter__()), FrameSourceError)
            await camera.close()


async def test_silent_agent_ends_a_stream() -> None:
    async with (
        looking() as (plant, camera),
        plant.streaming(),
        camera.frames(timeout=PATIENCE) as frames,
    ):
        await anext(frames)
        end_of(camera).subscriptions.clear()  # nothing comes to this program any more
        with pytest.raises(FrameSourceError, match="did not answer"):
            async for _ in frames:
                pass


async def test_frame_that_no_bus_takes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_frames, "MAX_FRAME_BYTES", 7)
    async with looking() as (plant, camera), plant.streaming():
        assert "of 8 bytes, expected 7" in str(await gone(camera.newest_frame()))
        async with camera.frames() as frames:
            assert isinstance(await gone(anext(frames)), FrameFormatError)


@pytest.mark.both_buses
async def test_one_program_s_stream_does_not_end_another_s() -> None:
    async with (
        looking() as (plant, camera),
        plant.streaming(),
        plant.camera() as other,
        other.frames(timeout=PATIENCE) as theirs,
    ):
        async with camera.frames() as frames:
            await anext(frames)
        for _ in range(5):
            await anext(theirs)
        assert plant.driver.calls.count("start") == 1
        assert (await camera.trigger()).value.run == 1


# ---------------------------------------------------------------------- bounds


async def test_streams_and_calls_of_a_program_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_frames, "MAX_STREAMS_PER_PROGRAM", 2)
    monkeypatch.setattr(_frames, "MAX_FRAME_CALLS_PER_PROGRAM", 3)
    async with (
        looking() as (plant, camera),
        camera.frames() as first,
        camera.frames() as second,
    ):
        async with camera.frames() as third:
            error = await gone(anext(third))
        assert "no more are possible" in str(error)
        waiting = asyncio.create_task(camera.newest_frame(timeout=60))
        await until(lambda: sum(plant.shared._pending_calls.values()) == 3)
        assert "under way" in str(await gone(camera.newest_frame()))
        async with plant.camera() as other, plant.streaming():
            await other.newest_frame()
            await asyncio.gather(anext(first), anext(second), waiting)


@pytest.mark.both_buses
async def test_wrong_order_is_refused_before_anything_is_asked() -> None:
    async with looking() as (plant, camera):
        for error in [
            await gone(camera.newest_frame(encoding=_any("bmp"))),
            await gone(camera.newest_frame(encoding="png", quality=50)),
            await gone(camera.newest_frame(encoding="jpeg", quality=101)),
            await gone(camera.newest_frame(max_age=-1.0)),
            await gone(camera.newest_frame(timeout=math.nan)),
            await gone(camera.frame_after(math.inf)),
            await gone(camera.frames(quality=3).__aenter__()),
        ]:
            assert isinstance(error, ConfigurationError)
        assert plant.driver.calls == []


def _any(value: Any) -> Any:
    return value


# ---------------------------------------------------------------------- an agent that errs


@pytest.mark.parametrize(
    ("wrong", "kind"),
    [
        ({"width": 0}, RemoteProtocolError),
        ({"height": "x"}, RemoteProtocolError),
        ({"duration": -1.0}, RemoteProtocolError),
        ({"moment": "SOME"}, RemoteProtocolError),
        ({"captured": None}, RemoteProtocolError),
        ({"size": 7}, FrameTimeoutError),
        ({"lens": 99}, None),  # one that it has forgotten
        ({"format": "Mono9"}, FrameFormatError),
    ],
)
async def test_frame_that_is_none_is_told(
    monkeypatch: pytest.MonkeyPatch, wrong: dict[str, Any], kind: type[Exception] | None
) -> None:
    said = to_fields
    monkeypatch.setattr(_frames, "to_fields", lambda *args: said(*args) | wrong)
    async with looking() as (plant, camera), plant.streaming(every=0.5):
        if kind is None:
            assert (await camera.newest_frame()).camera_info is None
            return
        assert isinstance(await gone(camera.newest_frame(timeout=2.0)), kind)
        async with camera.frames(timeout=PATIENCE) as frames:
            error = await gone(anext(frames))
            assert isinstance(error, FrameSourceError)
            assert isinstance(error.__cause__, kind) or kind in {type(error), FrameTimeoutError}


async def test_device_that_is_none_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    async def about(*_: object) -> dict[str, Any]:
        return {"format": "Mono8"}

    monkeypatch.setattr(SharedFrames, "format_fields", about)
    async with looking() as (_, camera):
        error = await gone(camera.frames().__aenter__())
        assert isinstance(error, FrameSourceError)
        assert isinstance(error.__cause__, RemoteProtocolError)


async def test_what_fails_in_a_stream_ends_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with looking() as (plant, camera), plant.streaming():
        async with camera.frames() as frames:
            await anext(frames)
            monkeypatch.setattr(_frame_caller, "from_fields", lambda *_, **__: 1 // 0)
            with pytest.raises(FrameSourceError, match="ZeroDivisionError"):
                async for _ in frames:
                    pass
        assert "its stream of frames failed" in caplog.text
        caplog.clear()


async def test_one_stream_asks_once_at_a_time() -> None:
    async with looking() as (_, camera):
        ask, loop = camera.frame_client.request_frame, asyncio.get_running_loop()
        arguments = {"stream": 1, "encoding": "raw", "quality": None}
        counts = _frame_caller.StreamCounts()
        asked = [ask("next_frame", loop.time() + 1, arguments, counts) for _ in range(2)]
        first, second = await asyncio.gather(*asked, return_exceptions=True)
        assert first == ({"asked_at": pytest.approx(loop.time(), abs=2)}, None)
        assert "two requests" in str(second)


# ---------------------------------------------------------------------- cameras without frames


@pytest.mark.both_buses
async def test_camera_without_frames_says_what_to_do() -> None:
    async with Plant(zenoh=not in_process()) as plant, plant.camera() as camera:
        for call in (camera.newest_frame(), camera.frame_after(), camera.frames().__aenter__()):
            error = await gone(call)
            assert isinstance(error, UnsupportedError)
            assert "frames: URL" in str(error)


async def test_camera_at_the_wire_says_what_to_do() -> None:
    async with Plant() as plant, smartcam.connect(plant.box.url) as camera:
        assert "frames: URL" in str(await gone(camera.newest_frame()))
        assert "smartcam.frames.open" in str(await gone(camera.frame_after()))
        with pytest.raises(UnsupportedError, match="connected directly"):
            camera.frames()


# ---------------------------------------------------------------------- cancelling


@pytest.mark.parametrize("what", ["newest_frame", "frame_after", "frames"])
async def test_call_may_be_cancelled_at_any_step(what: str) -> None:
    async with looking() as (plant, camera), plant.streaming():

        async def call() -> None:
            if what == "frames":
                async with camera.frames() as frames:
                    await anext(frames)
            else:
                await getattr(camera, what)()

        steps = 0
        while True:
            task = asyncio.create_task(call())
            for _ in range(steps):
                await asyncio.sleep(0)
            if not task.cancel():
                break
            await asyncio.wait([task])
            steps += 1
            if steps % 10 == 0:
                assert (await camera.frame_after()).sequence
        assert steps > 10
        await until(lambda: not plant.shared._streams and not plant.shared._pending_calls)
        await plant.driver.rests()
        assert not plant.agent._sender._windows
