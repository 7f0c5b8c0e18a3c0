"""Result stream: a camera that runs free, 70 bytes a result, as fast as the link gives them.

smartcam makes a numpy table of each and hands it to ``async for``, one by one or in batches; the
yardsticks cut frames and do nothing else. Localizations and records are compared with the same
yardstick, and with one that makes equal values by ``struct``. An observer that looks at other
things than results is to cost nothing, and one that takes them little more than its own call. With
a status before and one after each result, as of a camera that a sensor triggers, no two results
follow each other. CPU time for each result.
"""

from __future__ import annotations

import asyncio
import math
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

import smartcam
from benchmarks.cores import placed
from benchmarks.instructions import count_sides
from benchmarks.measure import Comparison, Goal, Plan, instructions_of
from benchmarks.peers import peer, wire
from benchmarks.sides import Side, take_sides
from benchmarks.yardsticks import bare_client
from smartcam.models import Header, Localization, Pose, Position, Quaternion
from smartcam.observers import Observer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable, Sequence

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
PHOTO_PLACE, PHOTO_INDEX = 2, 0x39383736
AT = datetime(2024, 5, 1, tzinfo=UTC)
new: Any = tuple.__new__

RECORDS = "(" + LAYOUT.partition("(")[2]
EACH, TOGETHER = "smartcam, on_result", "smartcam, on_results"
LOCALIZED, RECORDED = "smartcam, localizations", "smartcam, records"
BARE, READER = "bare protocol", "StreamReader.readexactly"
READ_LOCALIZED = "StreamReader.readexactly and struct, localizations"
READ_RECORDED = "StreamReader.readexactly and struct, records"

CASES: tuple[tuple[str, str, str, How, Goal | None], ...] = (
    (ITEMS, "async for, item by item", READER, "speed", Goal("at least", 0.9)),
    (ITEMS, "async for, item by item", BARE, "speed", None),
    (BATCHES, "async for, batch=True", READER, "speed", Goal("at least", 1.0)),
    (BATCHES, "async for, batch=True", BARE, "speed", None),
    (OBSERVED, "async for, an observer without on_result", ITEMS, "ratio", Goal("at most", 1.1)),
    (TOGETHER, "async for, an observer with on_results", ITEMS, "ratio", Goal("at most", 1.2)),
    (EACH, "async for, an observer with on_result", ITEMS, "ratio", Goal("at most", 1.3)),
    (LOCALIZED, "batch=True, localizations", READER, "ratio", None),
    (LOCALIZED, "batch=True, localizations", READ_LOCALIZED, "ratio", Goal("at most", 1.3)),
    (RECORDED, "batch=True, records", READER, "ratio", None),
    (RECORDED, "batch=True, records", READ_RECORDED, "ratio", Goal("at most", 1.3)),
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
        ports = dict.fromkeys(SIDES, port)
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
async def _batches(port: int, interpret_as: str = LAYOUT) -> AsyncIterator[Work]:
    async with _camera(port, interpret_as=interpret_as) as camera:

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
async def _camera(
    port: int, *observers: Observer, interpret_as: str = LAYOUT
) -> AsyncIterator[smartcam.Camera]:
    url = f"bvs://127.0.0.1:{port}?dialect=handbook"
    async with smartcam.connect(url, interpret_as=interpret_as, observers=observers) as camera:
        yield camera
        counted = camera.statistics()
        assert counted.received == counted.streamed > 0


def _check(last: smartcam.Result, counted: SubscriberStatistics, count: int) -> None:
    part: Any = last.value[0]
    assert part[PHOTO_PLACE] == PHOTO_INDEX
    assert (counted.offered, counted.taken, counted.dropped) == (count, count, 0)


@asynccontextmanager
async def _bare(port: int) -> AsyncIterator[Work]:
    bare = await bare_client(port)

    async def work(count: int) -> None:
        await bare.ask(wire.frame(wire.TRIGGER, _number(count)), wire.RESULT, count)

    yield work
    bare.transport.close()


@asynccontextmanager
async def _reader(
    port: int, read: Callable[[bytes], list[Any]] | None = None
) -> AsyncIterator[Work]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    header = wire.HEADER

    async def work(count: int) -> None:
        writer.write(wire.frame(wire.TRIGGER, _number(count)))
        for _ in range(count):
            _, length, _ = header.unpack(await reader.readexactly(header.size))
            body = await reader.readexactly(length)
            if read is not None:
                value = read(body)
        assert len(body) == 74
        assert read is None or value[0].photo_index == PHOTO_INDEX

    yield work
    writer.close()


def _localizations(body: bytes) -> list[Localization]:
    """Return the values of ``localizations``, with the fastest constructor that Python has."""
    header = new(Header, (1, AT, "camera"))
    found: list[Localization] = []
    for text, quality, photo_index, x, y, theta in wire.RECORD.iter_unpack(body[4:]):
        half = 0.5 * theta
        orientation = new(Quaternion, (0.0, 0.0, math.sin(half), math.cos(half)))
        pose = new(Pose, (header, new(Position, (x, y, 0.0)), orientation))
        name = text.partition(b"\0")[0].decode()
        found.append(new(Localization, (name, quality, photo_index, pose)))
    return found


def _records(body: bytes) -> list[Record]:
    return [
        new(Record, (row[0].partition(b"\0")[0].decode(), *row[1:]))
        for row in wire.RECORD.iter_unpack(body[4:])
    ]


def _number(count: int) -> bytes:
    return count.to_bytes(8, "little")


class Record(NamedTuple):
    """A record with named fields, as a program would make it of the values of ``struct``."""

    feature_id: str
    quality: float
    photo_index: int
    x: float
    y: float
    theta: float


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
    LOCALIZED: lambda port: _batches(port, "localizations"),
    RECORDED: lambda port: _batches(port, RECORDS),
    BARE: _bare,
    READER: _reader,
    READ_LOCALIZED: lambda port: _reader(port, _localizations),
    READ_RECORDED: lambda port: _reader(port, _records),
}
"""By name; ``python -m benchmarks.sides stream NAME PORT OPERATIONS`` has one alone."""
