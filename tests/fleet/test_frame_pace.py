"""The pace of streams, with sources and links of any speed, in simulated time."""

from __future__ import annotations

import asyncio
import itertools
import math

from hypothesis import given
from hypothesis import strategies as st

from smartcam.fleet._frames.pace import (
    MAX_WAIT_PERIODS,
    MAX_WAIT_SHARE,
    MIN_ALLOWED_WAIT,
    FramePace,
)
from smartcam.frames import FrameSource
from tests.frames.drivers import ScriptedDriver, frame


def follow(
    period: float, way: float, *, rest: float = 0.0, frames: int = 40, stops: int = 10**9
) -> list[tuple[float, float]]:
    """Return when each frame came and went to one who asks as soon as it has the last one.

    Args:
        period: of the source.
        way: seconds to get there.
        rest: as it is asked for.
        frames: how many.
        stops: frames that the source gives before it stops.
    """
    pace, now, given_to = FramePace(), 0.0, 0
    went: list[tuple[float, float]] = []
    while len(went) < frames:
        newest = min(math.floor(now / period), stops)
        since, until = pace.choose_window(now, newest * period, rest)
        # the first one that came since, and is new to it; or at the end whichever is newest
        number = max(given_to + 1, math.ceil(since / period - 1e-9), newest)
        at = max(now, number * period)
        if number > stops or at > until:
            at = max(now, until)
            number = min(math.floor(at / period + 1e-9), stops)
            if number <= given_to:
                if number == stops:
                    break
                number = given_to + 1
                at = number * period
        pace.note_taken(number * period, number)
        pace.note_sent(at)
        went.append((number * period, at))
        given_to, now = number, at + way
    return went


@given(period=st.floats(0.005, 1.0), way=st.floats(0.0005, 3.0))
def test_frame_has_hardly_waited_and_the_link_is_used(period: float, way: float) -> None:
    went = follow(period, way)[3:]
    assert len(went) == 37
    for came, at in went:
        assert at - came <= max(MIN_ALLOWED_WAIT, MAX_WAIT_SHARE * way) + 1e-6
    for (_, one), (_, other) in itertools.pairwise(went):
        assert other - one <= way + period + 1e-6


@given(period=st.floats(0.005, 0.2), way=st.floats(0.0005, 2.0), stops=st.integers(5, 60))
def test_last_frame_of_a_source_that_stops_gets_there(
    period: float, way: float, stops: int
) -> None:
    came, at = follow(period, way, stops=stops, frames=10**6)[-1]
    assert came == stops * period
    assert at - came <= max(way, MAX_WAIT_PERIODS * period) + 1e-6


@given(rest=st.floats(0.04, 1.0))
def test_rest_is_held_on_average(rest: float) -> None:
    went = follow(1 / 30, 0.005, rest=rest, frames=60)[2:]
    took = (went[-1][1] - went[0][1]) / (len(went) - 1)
    assert abs(took - rest) <= 0.034 / 20
    assert all(at - came <= MIN_ALLOWED_WAIT + 1e-6 for came, at in went)


async def test_reader_waits_past_what_has_waited() -> None:
    driver, loop = ScriptedDriver(), asyncio.get_running_loop()
    async with FrameSource(driver) as source, source.reader(timeout=1.0) as reader:
        await driver.streams()
        driver.give(frame(1))
        assert reader.last_arrival == loop.time()
        await asyncio.sleep(0.1)
        later = loop.call_later(0.05, driver.give, frame(2))
        await reader.wait_newer(loop.time() - 0.01, loop.time() + 1.0)
        assert (await anext(reader)).sequence == 2
        later.cancel()
        driver.give(frame(3))
        await asyncio.sleep(0.1)
        begun = loop.time()
        await reader.wait_newer(begun, begun + 0.2)  # none comes
        assert 0.2 <= loop.time() - begun < 0.3
        assert (await anext(reader)).sequence == 3
        await reader.wait_newer(loop.time(), loop.time() - 1.0)  # too late already
        source.ended(None)
        await reader.wait_newer(loop.time(), loop.time() + 100.0)
        assert (reader.statistics().offered, reader.statistics().skipped) == (3, 1)
