"""Recorder: what writing a recording adds to a result, all of it: hooks, thread and file.

A camera that runs free, 70 bytes a result. Each round of a side connects, takes its results and
leaves, and the recording is whole and closed by then; the CPU time is that of both threads.
"""

from __future__ import annotations

import asyncio
import importlib.util
import sys
import tempfile
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import smartcam
from benchmarks.measure import Comparison, Goal, Plan
from benchmarks.peers import peer, wire
from benchmarks.sides import Side, take_sides
from benchmarks.stream import LAYOUT

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable

    from benchmarks.measure import Series
    from benchmarks.sides import Work

__all__ = ["SIDES", "run"]

RESULTS = 2_000
"""In a round of each side."""

RECORDED, PLAIN = "recorded", "not recorded"

GOAL = Goal("at most", 50, "us")


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure results with a recorder and without."""
    if importlib.util.find_spec("zstandard") is None:
        print("recorder: left out: zstandard is not installed (smartcam[record])", file=sys.stderr)
        return
    with peer("stream") as port:
        series = asyncio.run(_measure(plan, port))
    case = "a result of 70 bytes, its frame and its value"
    yield Comparison("recorder", case, series[RECORDED], series[PLAIN], "more", GOAL)


async def _measure(plan: Plan, port: int) -> dict[str, Series]:
    sides = {name: (side, port) for name, side in SIDES.items()}
    return await take_sides(plan, sides, plan.operations(RESULTS))


@asynccontextmanager
async def _recorded(port: int) -> AsyncIterator[Work]:
    from smartcam.recording import Recorder

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.mcap")

        async def work(count: int) -> None:
            with Recorder(path, overwrite=True) as recorder:
                await _take(port, count, recorder)
            assert recorder.counts.results == count

        yield work


@asynccontextmanager
async def _plain(port: int) -> AsyncIterator[Work]:
    async def work(count: int) -> None:
        await _take(port, count)

    yield work


async def _take(port: int, count: int, *observers: smartcam.Observer) -> None:
    url = f"bvs://127.0.0.1:{port}?dialect=handbook"
    async with smartcam.connect(url, interpret_as=LAYOUT, observers=observers) as camera:
        results = camera.results(max_queue=count)
        await camera.request(wire.TRIGGER, count.to_bytes(8, "little"), answered=False)
        for _ in range(count):
            await anext(results)


SIDES: dict[str, Side] = {RECORDED: _recorded, PLAIN: _plain}
"""By name; ``python -m benchmarks.sides recorder NAME PORT OPERATIONS`` has one alone."""
