"""What the face without asyncio costs: ``camera.trigger()`` from another thread, and its ``await``.

Both trigger the same peer, one after the other, with five localizations and its answers in one
delivery. CPU time is that of the whole process, so of both threads; all of it is on one core, since
what it takes to wake a thread on another one varies more than all the rest. What is above the async
trigger is two wake-ups of a thread and a task; ``asyncio.run_coroutine_threadsafe`` of a coroutine
that does nothing is beside it to compare.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import smartcam
import smartcam.sync
from benchmarks.cores import placed
from benchmarks.instructions import count_sides
from benchmarks.measure import (
    Comparison,
    Cost,
    Goal,
    Plan,
    cpu_microseconds,
    instructions_of,
    take_turns,
)
from benchmarks.peers import peer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable

    from benchmarks.sides import Side, Work

__all__ = ["SIDES", "run"]

TRIGGERS = 400
"""In a round of each side."""

COUNTED = 50
"""Where instructions are counted."""

SYNC, ASYNC, STANDARD = "smartcam.sync", "await", "run_coroutine_threadsafe"


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure what a trigger takes above the async one."""
    count = plan.operations(TRIGGERS, least=5)
    with placed(apart=False), peer("trigger", "together") as port, asyncio.Runner() as runner:
        counts = count_sides(plan, "sync", dict.fromkeys((SYNC, ASYNC), port), COUNTED)
        url = _url(port)

        def sync_side() -> Cost:
            with smartcam.sync.connect(url, interpret_as="localizations") as camera:
                begin = time.process_time()
                for _ in range(count):
                    result = camera.trigger()
                cost = cpu_microseconds(begin, count)
            assert len(result.value) == 5
            return cost

        async def awaited() -> Cost:
            async with smartcam.connect(url, interpret_as="localizations") as camera:
                begin = time.process_time()
                for _ in range(count):
                    await camera.trigger()
                return cpu_microseconds(begin, count)

        async def nothing() -> None: ...

        async def standard() -> Cost:
            loop = asyncio.get_running_loop()

            def calls() -> Cost:
                begin = time.process_time()
                for _ in range(count):
                    asyncio.run_coroutine_threadsafe(nothing(), loop).result()
                return cpu_microseconds(begin, count)

            return await asyncio.to_thread(calls)

        sides = {
            SYNC: sync_side,
            ASYNC: lambda: runner.run(awaited()),
            STANDARD: lambda: runner.run(standard()),
        }
        series = take_turns(plan, sides)
    goal = Goal("at most", 60.0, "us")
    case = "trigger(), above await trigger()"
    yield Comparison("sync", case, series[SYNC], series[ASYNC], how="more", goal=goal)
    counted = instructions_of(counts, SYNC, ASYNC)
    yield Comparison(
        "sync", "trigger(), all of it", series[SYNC], series[ASYNC], instructions=counted
    )
    yield Comparison("sync", "a call that does nothing", series[STANDARD], how="alone")


@asynccontextmanager
async def _sync(port: int) -> AsyncIterator[Work]:
    connected = smartcam.sync.connect(_url(port), interpret_as="localizations")
    camera = await asyncio.to_thread(connected.open)  # it refuses to hold up this loop

    def trigger(count: int) -> None:
        for _ in range(count):
            camera.trigger()

    try:
        yield lambda count: asyncio.to_thread(trigger, count)
    finally:
        await asyncio.to_thread(camera.close)


@asynccontextmanager
async def _async(port: int) -> AsyncIterator[Work]:
    async with smartcam.connect(_url(port), interpret_as="localizations") as camera:

        async def work(count: int) -> None:
            for _ in range(count):
                await camera.trigger()

        yield work


def _url(port: int) -> str:
    return f"bvs://127.0.0.1:{port}?dialect=handbook"


SIDES: dict[str, Side] = {SYNC: _sync, ASYNC: _async}
"""By name; ``python -m benchmarks.sides sync NAME PORT OPERATIONS`` has one alone."""
