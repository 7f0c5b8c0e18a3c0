"""Flood: trigger latency of 99 cameras, with and without another that floods in the same process.

The quiet cameras are triggered now and then, 400 triggers a second in all, and answer at once.
Beside them one more camera sends as fast as the link takes it: statuses, small results as they are,
results with five localizations; its subscriber does not read. All are measured by turns, on the
wall clock, from the call of ``trigger()`` to its result.

Without: the same camera sends the same statuses as fast to somebody else, so that the machine is as
busy on both sides. How much the machine itself slows the triggers is a comparison of its own.

On Linux the process that is measured has a core, and its peers the others, where there are two.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import sys
import time
from functools import partial
from typing import TYPE_CHECKING

import smartcam
from benchmarks.measure import Comparison, Cost, Goal, Plan, Series, take_turns_awaiting
from benchmarks.peers import peer
from benchmarks.peers.flood import ASIDE, FLOOD

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

__all__ = ["run"]

FLOODS = {
    "statuses": "raw",
    "results of 40 bytes": "raw",
    "results with 5 localizations": "localizations",
}
"""What the flood is of, as its peer knows it, and how it is interpreted."""

QUIET = 99
"""Cameras that are triggered."""

RATE = 400.0
"""Triggers a second, of all of them."""

TRIGGERS = 800
"""In a round of each side: the eighth slowest is the 99th percentile."""

LIMIT = 30.0
"""Seconds until a trigger that has no result is an error."""

ELSEWHERE = "a flood elsewhere"
ALONE = "no flood"


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure without a flood and beside each kind."""
    with _peers() as ports:
        p50, p99, taken = asyncio.run(_measure(plan, *ports))
    for what in FLOODS:
        case = f"of {QUIET} cameras' triggers beside {what}"
        goal = Goal("at most", 1.2)
        yield Comparison("flood", f"p99 {case}", p99[what], p99[ELSEWHERE], goal=goal)
        yield Comparison("flood", f"p50 {case}", p50[what], p50[ELSEWHERE])
    case = f"of {QUIET} cameras' triggers, the machine alone"
    yield Comparison("flood", f"p99 {case}", p99[ELSEWHERE], p99[ALONE])
    yield Comparison("flood", f"p50 {case}", p50[ELSEWHERE], p50[ALONE])
    for what in FLOODS:
        yield Comparison("flood", f"{what}, taken meanwhile", taken[what], how="alone")


@contextlib.contextmanager
def _peers() -> Iterator[tuple[int, int]]:
    """Run the peers; give the ports of the quiet cameras and of those that flood."""
    with contextlib.ExitStack() as stack:
        cores = os.sched_getaffinity(0) if sys.platform == "linux" else set[int]()
        if len(cores) > 1:
            stack.callback(os.sched_setaffinity, 0, cores)
            os.sched_setaffinity(0, cores - {min(cores)})  # the peers inherit it
        ports = (
            stack.enter_context(peer("trigger", "together")),
            stack.enter_context(peer("flood")),
        )
        if len(cores) > 1:
            os.sched_setaffinity(0, {min(cores)})
        yield ports


async def _measure(
    plan: Plan, quiet_port: int, loud_port: int
) -> tuple[dict[str, Series], dict[str, Series], dict[str, Series]]:
    """Return p50 and p99 of each side, and how many frames a second the floods had."""
    count = plan.operations(TRIGGERS, least=20)
    middle: dict[str, list[float]] = {side: [] for side in (ALONE, ELSEWHERE, *FLOODS)}
    frames: dict[str, list[float]] = {what: [] for what in FLOODS}

    async def latency(side: str) -> Cost:
        took: list[float] = []
        begin = time.perf_counter()

        async def trigger(place: int) -> None:
            for number in range(place, count, QUIET):
                await asyncio.sleep(begin + number / RATE - time.perf_counter())
                called = time.perf_counter()
                result = await cameras[place].trigger(timeout=LIMIT)
                took.append((time.perf_counter() - called) * 1e3)
                assert len(result.value) == 5

        await asyncio.gather(*map(trigger, range(QUIET)))
        took.sort()
        middle[side].append(took[count // 2])
        return took[count * 99 // 100]

    async def beside(what: str) -> Cost:
        loud = louds[what]
        before, begin = loud.statistics().frames_received, time.perf_counter()
        await loud.request(FLOOD, what.encode(), answered=False)
        cost = await latency(what)
        came = loud.statistics().frames_received - before
        frames[what].append(came / (time.perf_counter() - begin) / 1e3)
        await loud.request(FLOOD, answered=False)
        await loud.query_application(timeout=LIMIT)  # its answer is behind all of the flood
        return cost

    async def elsewhere() -> Cost:
        loud = louds["statuses"]
        await loud.request(ASIDE, b"statuses", answered=False)
        cost = await latency(ELSEWHERE)
        await loud.request(ASIDE, answered=False)
        return cost

    async with contextlib.AsyncExitStack() as stack:

        async def connect(port: int, interpret_as: str) -> smartcam.Camera:
            url = f"bvs://127.0.0.1:{port}?dialect=handbook"
            camera = smartcam.connect(url, interpret_as=interpret_as)
            return await stack.enter_async_context(camera)

        cameras = [await connect(quiet_port, "localizations") for _ in range(QUIET)]
        louds = {what: await connect(loud_port, name) for what, name in FLOODS.items()}
        unread = [loud.results(max_queue=1) for loud in louds.values()]
        gc.collect()
        gc.freeze()  # how long the benchmark's own heap takes to collect is not the question
        stack.callback(gc.unfreeze)
        p99 = await take_turns_awaiting(
            plan,
            {
                ALONE: partial(latency, ALONE),
                ELSEWHERE: elsewhere,
                **{what: partial(beside, what) for what in FLOODS},
            },
            unit="ms",
        )
        assert all(camera.statistics().sessions == 1 for camera in (*cameras, *louds.values()))
        lost = [results.statistics().dropped > 0 for results in unread]
        # in a quick run on a busy machine fewer results may have come than there is room for
        assert lost == [False, True, True] or (plan.quick and not lost[0])
    # the first round warmed up
    p50 = {side: Series(side, "ms", values[1:]) for side, values in middle.items()}
    taken = {what: Series(what, "thousand/s", values[1:]) for what, values in frames.items()}
    return p50, p99, taken
