"""Result stream: a camera that runs free, 70 bytes a result, as fast as the link gives them.

smartcam makes a numpy table of each and hands it to ``async for``, one by one or in batches; the
yardsticks cut frames and do nothing else. CPU time for each result.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

import smartcam
from benchmarks.measure import Comparison, Cost, Goal, Plan, cpu_microseconds, take_turns_awaiting
from benchmarks.peers import peer, wire
from benchmarks.yardsticks import bare_client

if TYPE_CHECKING:
    from collections.abc import Iterable

    from benchmarks.measure import Series

__all__ = ["run"]

RESULTS = 100_000
"""In a round of each side."""

LAYOUT = (
    "table: (feature_id: string[50], quality: real32, photo_index: int32, "
    "x: real32, y: real32, theta: real32)*"
)
ITEMS, BATCHES = "smartcam", "smartcam, batch=True"
BARE, READER = "bare Protocol", "StreamReader.readexactly"


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure item by item and in batches."""
    with peer("stream") as port:
        series = asyncio.run(_measure(plan, port))
    for name, case, least in (
        (ITEMS, "async for, item by item", 0.9),
        (BATCHES, "async for, batch=True", 1.0),
    ):
        subject = series[name]
        goal = Goal("at least", least)
        yield Comparison("stream", case, subject, series[READER], how="speed", goal=goal)
        yield Comparison("stream", case, subject, series[BARE], how="speed")


async def _measure(plan: Plan, port: int) -> dict[str, Series]:
    count = plan.operations(RESULTS)
    go = count.to_bytes(8, "little")
    bare = await bare_client(port)
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    url = f"bvs://127.0.0.1:{port}?dialect=handbook"

    async def items_side() -> Cost:
        results = camera.results()
        begin = time.process_time()
        await camera.request(wire.TRIGGER, go, answered=False)
        missing = count
        async for result in results:  # noqa: B007 - the last one is looked at
            missing -= 1
            if not missing:
                break
        cost = cpu_microseconds(begin, count)
        check(result, results.statistics())
        return cost

    async def batches_side() -> Cost:
        results = camera.results(batch=True)
        begin = time.process_time()
        await camera.request(wire.TRIGGER, go, answered=False)
        missing = count
        async for batch in results:
            missing -= len(batch)
            if missing <= 0:
                break
        cost = cpu_microseconds(begin, count)
        check(batch[-1], results.statistics())
        return cost

    def check(last: smartcam.Result, counted: smartcam.models.SubscriberStatistics) -> None:
        assert last.value["photo_index"].tolist() == [0x39383736]
        assert (counted.offered, counted.taken, counted.dropped) == (count, count, 0)

    async def bare_side() -> Cost:
        begin = time.process_time()
        await bare.ask(wire.frame(wire.TRIGGER, go), wire.RESULT, count)
        return cpu_microseconds(begin, count)

    async def reader_side() -> Cost:
        header = wire.HEADER
        begin = time.process_time()
        writer.write(wire.frame(wire.TRIGGER, go))
        for _ in range(count):
            _, length, _ = header.unpack(await reader.readexactly(header.size))
            body = await reader.readexactly(length)
        cost = cpu_microseconds(begin, count)
        assert len(body) == 74
        return cost

    async with smartcam.connect(url, interpret_as=LAYOUT) as camera:
        sides = {
            ITEMS: items_side,
            BATCHES: batches_side,
            BARE: bare_side,
            READER: reader_side,
        }
        series = await take_turns_awaiting(plan, sides)
        counted = camera.statistics()
        assert counted.received == counted.streamed == 2 * count * (plan.rounds + 1)
    bare.transport.close()
    writer.close()
    return series
