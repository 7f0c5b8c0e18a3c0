"""A frame's time by this computer's clock: the error is within its bound."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.fleet import FleetFile, FleetServer
from smartcam.frames import FrameSource
from smartcam.frames import open as open_frames
from smartcam.frames._inside import read_stamp
from tests.fleet.fleetkit import PATIENCE
from tests.fleet.inside import Caller
from tests.processes import free_place

MAX_DRIFT_RATIO = 0.0001


WAYS = st.floats(0.0, 0.2)


class _Bus:
    local = False


class _Program:
    bus = _Bus()


def caller() -> Caller:
    nothing: Any = None
    program: Any = _Program()
    return Caller("camera", "camera", program, nothing, nothing, nothing)


@given(
    ahead=st.floats(-1e4, 1e4),
    drift=st.floats(-MAX_DRIFT_RATIO, MAX_DRIFT_RATIO),
    calls=st.lists(st.tuples(WAYS, WAYS, WAYS, st.floats(0, 100)), min_size=1, max_size=20),
    since=st.floats(0, 100),
)
async def test_bounds_hold_the_truth(
    ahead: float, drift: float, calls: list[tuple[float, ...]], since: float
) -> None:
    """The way there, at the agent, and back, each of any length; then a while of nothing."""
    loop, one = asyncio.get_running_loop(), caller()

    def agent(at: float) -> float:
        return at * (1 + drift / 2) + ahead

    one._min_clock_lead, one._min_lead_at = -math.inf, loop.time()
    for there, held, back, pause in calls:
        said = loop.time()
        await asyncio.sleep(there)
        came = agent(loop.time())
        await asyncio.sleep(held)
        spoke = agent(loop.time())
        await asyncio.sleep(back)
        one.narrow_clock_lead(came, said)
        one.sample_clock(spoke)
        await asyncio.sleep(pause)
    await asyncio.sleep(since)
    now = loop.time()
    earliest, latest = one.local_times(agent(now))
    assert earliest - 1e-6 <= now <= latest + 1e-6
    assert -one.local_times(0.0)[0] >= agent(now) - now - 1e-6  # as clock_at_most() has it
    assert latest - earliest <= min(there + held + back for there, held, back, _ in calls) + 1.0


async def test_exact_where_all_is_in_one_process() -> None:
    one = caller()
    one.program.bus.local = True
    try:
        assert one.local_times(12.5) == (12.5, 12.5)
    finally:
        one.program.bus.local = False


@pytest.mark.real_time
async def test_frames_over_the_network_have_the_time_at_which_they_were_drawn() -> None:
    camera = {"emulated": {}, "frames": "synthetic://?size=300x200&fps=200"}
    file = {"listen": free_place(), "cameras": {"a": camera}}
    async with FleetServer(FleetFile.model_validate(file)) as server:
        source = open_frames(server.urls["a"], timeout=PATIENCE)
        assert isinstance(source, FrameSource)
        async with source, source.reader() as frames:
            for _ in range(20):
                got = await anext(frames)
                stamp = read_stamp(got.array())
                assert stamp is not None
                assert stamp[0] == got.sequence
                assert abs(stamp[1] / 1e9 - got.captured) <= got.duration + 1e-4
                assert got.began <= stamp[1] / 1e9 + 1e-4
