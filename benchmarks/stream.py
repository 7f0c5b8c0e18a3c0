"""Result stream: a camera that runs free, 70 bytes a result, as fast as the link gives them.

smartcam makes a numpy table of each and hands it to ``async for``, one by one or in batches; the
yardsticks cut frames and do nothing else. An observer that looks at other things than results is to
cost nothing, and one that takes them together hardly anything. With a status before and one after
each result, as of a camera that a sensor triggers, no two results follow each other. CPU time for
each result.
"""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import smartcam
from benchmarks.cores import placed
from benchmarks.instructions import count_sides
from benchmarks.measure import Comparison, Goal, Plan, instructions_of
from benchmarks.peers import peer, wire
from benchmarks.sides import Side, take_sides
from benchmarks.yardsticks import bare_client
from smartcam.observers import Observer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Sequence

    from benchmarks.measure import How, Series
    from benchmarks.sides import Work
    from smartcam.models import CameraEvent, SubscriberStatistics

__all__ = ["SIDES", "run"]

RESULTS = 100_000
"""In a round of each side; a tenth of it with statuses."""

COUNTED = 5_000
"""Where instructions are counted."""

LAYOUT = (
    "table: (feature_id: string[50], quality: real32, photo_index: int32, "
    "x: real32, y: real32, theta: real32)*"
)
ITEMS, BATCHES, OBSERVED = "smartcam", "smartcam, batch=True", "smartcam, observed"
EACH, TOGETHER = "smartcam, on_result", "smartcam, on_results"
BARE, READER = "bare protocol", "StreamReader.readexactly"

CASES: tuple[tuple[str, str, str, How, Goal | None], ...] = (
    (ITEMS, "async for, item by item", READER, "speed", Goal("at least", 0.9)),
    (ITEMS, "async for, item by item", BARE, "speed", None),
    (BATCHES, "async for, batch=True", READER, "speed", Goal("at least", 1.0)),
    (BATCHES, "async for, batch=True", BARE, "speed", None),
    (OBSERVED, "async for, an observer without on_result", ITEMS, "ratio", Goal("at most", 1.1)),
    (TOGETHER, "async for, an observer with on_results", ITEMS, "ratio", Goal("at most", 1.2)),
    (EACH, "async for, an observer with on_result", ITEMS, "ratio", None),
)
"""Side, what it is, its yardstick, how they are compared, the goal."""

BETWEEN = 10.0
"""Times the bare protocol, for a result between two statuses: half of what it was when each frame
of them was worked off by itself."""


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure item by item, in batches, observed, and between statuses."""
    with placed(apart=False):
        yield from _results(plan)


def _results(plan: Plan) -> Iterable[Comparison]:
    with peer("stream") as port:
        ports = dict.fromkeys((ITEMS, BATCHES, OBSERVED, TOGETHER, EACH, BARE, READER), port)
        counts = count_sides(plan, "stream", ports, COUNTED)
        series = asyncio.run(_measure(plan, ports, plan.operations(RESULTS)))
    for name, case, yardstick, how, goal in CASES:
        yield Comparison(
            "stream",
            case,
            series[name],
            series[yardstick],
            how=how,
            goal=goal,
            instructions=instructions_of(counts, name, yardstick),
        )
    with peer("stream", "statuses") as port:
        ports = dict.fromkeys((ITEMS, BARE), port)
        counts = count_sides(plan, "stream", ports, COUNTED)
        series = asyncio.run(_measure(plan, ports, plan.operations(RESULTS // 10)))
    yield Comparison(
        "stream",
        "async for, each result between two statuses",
        series[ITEMS],
        series[BARE],
        goal=Goal("at most", BETWEEN),
        note="three frames; the goal is half of what it once was",
        instructions=instructions_of(counts, ITEMS, BARE),
    )


async def _measure(plan: Plan, ports: dict[str, int], count: int) -> dict[str, Series]:
    sides = {name: (SIDES[name], port) for name, port in ports.items()}
    return await take_sides(plan, sides, count)


# ---------------------------------------------------------------------- sides


@asynccontextmanager
async def _items(port: int, *observers: Observer) -> AsyncIterator[Work]:
    async with _camera(port, *observers) as camera:

        async def work(count: int) -> None:
            results = camera.results()
            await camera.request(wire.TRIGGER, _number(count), answered=False)
            missing = count
            async for result in results:  # noqa: B007 - the last one is looked at
                missing -= 1
                if not missing:
                    break
            _check(result, results.statistics(), count)

        yield work


@asynccontextmanager
async def _batches(port: int) -> AsyncIterator[Work]:
    async with _camera(port) as camera:

        async def work(count: int) -> None:
            results = camera.results(batch=True)
            await camera.request(wire.TRIGGER, _number(count), answered=False)
            missing = count
            async for batch in results:
                missing -= len(batch)
                if missing <= 0:
                    break
            _check(batch[-1], results.statistics(), count)

        yield work


@asynccontextmanager
async def _camera(port: int, *observers: Observer) -> AsyncIterator[smartcam.Camera]:
    url = f"bvs://127.0.0.1:{port}?dialect=handbook"
    async with smartcam.connect(url, interpret_as=LAYOUT, observers=observers) as camera:
        yield camera
        counted = camera.statistics()
        assert counted.received == counted.streamed > 0


def _check(last: smartcam.Result, counted: SubscriberStatistics, count: int) -> None:
    assert last.value["photo_index"].tolist() == [0x39383736]
    assert (counted.offered, counted.taken, counted.dropped) == (count, count, 0)


@asynccontextmanager
async def _bare(port: int) -> AsyncIterator[Work]:
    bare = await bare_client(port)

    async def work(count: int) -> None:
        await bare.ask(wire.frame(wire.TRIGGER, _number(count)), wire.RESULT, count)

    yield work
    bare.transport.close()


@asynccontextmanager
async def _reader(port: int) -> AsyncIterator[Work]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    header = wire.HEADER

    async def work(count: int) -> None:
        writer.write(wire.frame(wire.TRIGGER, _number(count)))
        for _ in range(count):
            _, length, _ = header.unpack(await reader.readexactly(header.size))
            body = await reader.readexactly(length)
        assert len(body) == 74

    yield work
    writer.close()


def _number(count: int) -> bytes:
    return count.to_bytes(8, "little")


class _Elsewhere(Observer):
    """Looks at states and at no results."""

    def on_state(self, event: CameraEvent) -> None:
        self.last = event


class _Each(Observer):
    """Looks at each result."""

    def on_result(self, result: smartcam.Result) -> None:
        self.last = result


class _Together(Observer):
    """Looks at results as they come."""

    def on_results(self, results: Sequence[smartcam.Result]) -> None:
        self.last = results[-1]


SIDES: dict[str, Side] = {
    ITEMS: _items,
    BATCHES: _batches,
    OBSERVED: lambda port: _items(port, _Elsewhere()),
    TOGETHER: lambda port: _items(port, _Together()),
    EACH: lambda port: _items(port, _Each()),
    BARE: _bare,
    READER: _reader,
}
"""By name; ``python -m benchmarks.sides stream NAME PORT OPERATIONS`` has one alone."""
