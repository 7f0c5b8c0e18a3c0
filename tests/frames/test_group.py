"""Groups of cameras give frames of one moment."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import ConfigurationError, FrameTimeoutError, LocalProtocolError
from smartcam.frames import FrameGroup, FrameSource
from tests.frames.drivers import GoneError, ScriptedDriver, frame
from tests.handmade import until

pytestmark = pytest.mark.usefixtures("no_leaks")


def drivers(count: int, **options: Any) -> tuple[list[ScriptedDriver], FrameGroup]:
    """Return drivers and their group, not open."""
    found = [ScriptedDriver() for _ in range(count)]
    sources = {f"cam{number}": FrameSource(one) for number, one in enumerate(found)}
    return found, FrameGroup(sources, **options)


async def started(group: FrameGroup, found: list[ScriptedDriver]) -> asyncio.Task[Any]:
    """Start all cameras, and return the task that waits for the group's first set."""
    waiting = asyncio.ensure_future(anext(group))
    await until(lambda: all(one.sink is not None for one in found))
    return waiting


async def test_four_cameras_open_begin_and_end_together() -> None:
    found, group = drivers(4)
    async with group:
        assert [one.calls for one in found] == [["open"]] * 4
        waiting = await started(group, found)
        now = time.monotonic() - 1
        for number, one in enumerate(found):
            one.give(frame(10 + number, captured=now + number * 0.002))
        both = await waiting
        assert [both[f"cam{number}"].sequence for number in range(4)] == [10, 11, 12, 13]
        assert both.skew == pytest.approx(0.006)
        assert both.captured == pytest.approx(now + 0.006)
        assert group.statistics().skew == both.skew
    assert [one.calls for one in found] == [["open", "start", "stop", "close"]] * 4
    with pytest.raises(LocalProtocolError, match="not open"):
        await anext(group)


async def test_frames_of_different_moments_are_never_in_one_set() -> None:
    (left, right), group = drivers(2, within=0.01)
    async with group:
        waiting = await started(group, [left, right])
        now = time.monotonic() - 10
        left.give(frame(1, captured=now))
        right.give(frame(101, captured=now + 0.011))
        left.give(frame(2, captured=now + 0.033))
        await asyncio.sleep(0.01)
        assert not waiting.done()
        right.give(frame(102, captured=now + 0.035))
        both = await waiting
        assert (both["cam0"].sequence, both["cam1"].sequence) == (2, 102)
        assert group.statistics().alone == {"cam0": 1, "cam1": 1}


@given(st.lists(st.tuples(st.integers(0, 1), st.floats(0, 0.03)), max_size=60))
async def test_sets_are_of_one_moment_in_order_and_each_frame_is_in_one(
    arrivals: list[tuple[int, float]],
) -> None:
    found, group = drivers(2, within=0.01, timeout=0.001)
    async with group:
        waiting = await started(group, found)
        await asyncio.gather(waiting, return_exceptions=True)
        moments = [time.monotonic() - 100] * 2
        seen: list[tuple[int, int]] = []
        for number, (camera, apart) in enumerate(arrivals):
            moments[camera] += apart
            found[camera].give(frame(number, captured=moments[camera]))
            if group.statistics().waiting:
                both = await anext(group)
                captured = [one.captured for one in both.frames.values()]
                assert both.skew == max(captured) - min(captured) <= 0.01
                seen.append((both["cam0"].sequence, both["cam1"].sequence))
        for one in zip(*seen, strict=True):
            assert list(one) == sorted(set(one))
        account = group.statistics()
        assert account.offered == account.delivered == len(seen)


async def test_slow_reader_gets_the_newest_set() -> None:
    found, group = drivers(2, within=0.01)
    async with group:
        waiting = await started(group, found)
        begun = time.monotonic() - 10
        for number in range(5):
            for one in found:
                one.give(frame(number, captured=begun + number * 0.1))
        assert (await waiting)["cam0"].sequence == 4
        account = group.statistics()
        assert (account.offered, account.delivered, account.skipped) == (5, 1, 4)


async def test_camera_that_falls_silent_is_named() -> None:
    found, group = drivers(2, timeout=1)
    async with group:
        waiting = await started(group, found)
        found[0].give(*(frame(number) for number in range(20)))
        with pytest.raises(FrameTimeoutError, match="received in total: cam0 20, cam1 0"):
            await waiting
        assert group.statistics().alone == {"cam0": 12, "cam1": 0}


async def test_lost_camera_ends_the_group() -> None:
    found, group = drivers(3)
    async with group:
        waiting = await started(group, found)
        assert found[1].sink is not None
        found[1].sink.ended(GoneError("unplugged"))
        with pytest.raises(GoneError):
            await waiting
        with pytest.raises(GoneError):
            await anext(group)


async def test_camera_that_does_not_open_leaves_the_others_closed() -> None:
    found, group = drivers(3)
    found[0].waits["open"] = asyncio.Event()
    found[2].fails["open"] = GoneError("not there")
    with pytest.raises(GoneError):
        async with group:
            raise AssertionError("it is not open")
    assert [one.calls[-1] for one in found] == ["close"] * 3


async def test_cancelled_opening_of_a_group_leaves_all_closed() -> None:
    found, group = drivers(2)
    found[0].waits["open"] = asyncio.Event()
    opening = asyncio.ensure_future(group.__aenter__())
    await until(lambda: found[0].calls and found[1].calls)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    await until(lambda: all(one.calls[-1] == "close" for one in found))


async def test_largest_skew_is_half_of_the_fastest_cameras_period() -> None:
    found, group = drivers(2)
    found[0].rates, found[1].rates = (25.0,), (50.0, 10.0)
    with pytest.raises(LocalProtocolError):
        _ = group.within
    async with group:
        assert group.within == pytest.approx(0.01)


def test_group_of_nothing_or_of_one_twice_is_refused() -> None:
    source = FrameSource(ScriptedDriver())
    for sources in ({}, {"left": source, "right": source}):
        with pytest.raises(ConfigurationError, match="one or more, each once"):
            FrameGroup(sources)
    with pytest.raises(ConfigurationError, match="within: expected"):
        FrameGroup({"left": source}, within=0)
