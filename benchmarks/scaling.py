"""Scaling: what a message costs, from a thousand of them to a million.

The protocol core alone is fed with 64 KiB at a time, over one machine: with results only, which it
takes in bursts, and with results and statuses in turn, where no two of a kind come together. End to
end, a camera that runs free sends results as fast as the link takes them, ``async for`` reads them
item by item, and they stay bytes. Straight lines mean that nothing grows with what was before.
"""

from __future__ import annotations

import asyncio
import gc
import time
from typing import TYPE_CHECKING

import smartcam
from benchmarks.measure import Comparison, Cost, Curve, Goal, Plan, Series, cpu_microseconds
from benchmarks.peers import peer, wire
from smartcam.protocols._base import Role, Transport
from smartcam.protocols._bvs import BVS
from smartcam.protocols._framed.machine import Machine
from smartcam.protocols._machine import ResultBurst
from smartcam.protocols.messages import Connect, ResultContainer

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from smartcam.protocols._machine import Event

__all__ = ["run"]

COUNTS = (1_000, 10_000, 100_000, 1_000_000)
BURSTS, IN_TURN = "protocol core, results", "protocol core, with statuses"
END_TO_END = "async for, end to end"
SIDES = BURSTS, IN_TURN, END_TO_END

ROUNDS = 5
"""At most: a round has more than three million messages."""

REPEATED = 20_000
"""Messages of one measurement, at least: few are measured several times over."""

READ = 65_536
BLOCK = 8_192
"""Messages that are prepared; a longer stream repeats them."""

DATA = bytes(range(70))
RESULT, STATUS = wire.result(DATA), wire.status(waiting=False)

MOST = 1.5
"""Times that a message of very many may cost what one of a few does: a straight line is 1."""


def run(plan: Plan) -> Iterable[Comparison | Curve]:
    """Measure the core and the whole way, at each count."""
    with peer("stream") as port:
        costs = asyncio.run(_measure(plan, port))
    counts = [plan.operations(count) for count in COUNTS]
    few, many = counts[:2], counts[-1]
    for side in SIDES:
        ends = [costs[side, count] for count in few]
        means = [sum(pair) / len(pair) for pair in zip(*ends, strict=True)]
        yield Comparison(
            "scaling",
            f"a message of {many:,}, {side}",
            Series(f"of {many:,}", "us", costs[side, many]),
            Series(f"one of {few[0]:,} or {few[1]:,}", "us", means),
            goal=Goal("at most", MOST),
        )
    lines: dict[str, list[tuple[float, float]]] = {
        side: [(count, Series(side, "us", costs[side, count]).median) for count in counts]
        for side in SIDES
    }
    yield Curve("scaling", "Cost of a message", "messages", "us of CPU time a message", lines)


async def _measure(plan: Plan, port: int) -> dict[tuple[str, int], list[Cost]]:
    """Take every count in each round, a first one of the smallest counts not counted."""
    counts = [plan.operations(count) for count in COUNTS]
    costs: dict[tuple[str, int], list[Cost]] = {
        (side, count): [] for count in counts for side in SIDES
    }
    url = f"bvs://127.0.0.1:{port}?dialect=handbook"
    async with smartcam.connect(url) as camera:
        for number in range(min(plan.rounds, ROUNDS) + 1):
            for count in counts if number else counts[:2]:
                times = max(1, round(REPEATED * plan.scale) // count)
                gc.collect()
                bursts = _core(RESULT, RESULT, count, times)
                in_turn = _core(STATUS, RESULT, count, times)
                end_to_end = await _end_to_end(camera, count, times)
                if number:
                    for side, cost in zip(SIDES, (bursts, in_turn, end_to_end), strict=True):
                        costs[side, count].append(cost)
        counted = camera.statistics()
        assert counted.received == counted.streamed
    return costs


def _core(one: bytes, other: bytes, messages: int, times: int) -> Cost:
    """Feed a machine with two frames in turn; the bytes are prepared before the clock runs."""
    reads = list(_reads((one + other) * (min(messages, BLOCK) // 2)))
    blocks, rest = divmod(messages, BLOCK) if messages > BLOCK else (1, 0)
    tail = list(_reads((one + other) * (rest // 2)))
    machines = [_connected() for _ in range(times)]
    begin = time.process_time()
    seen = 0
    for machine in machines:
        for part in (*[reads] * blocks, tail):
            for data in part:
                machine.receive_data(data)
                events = machine.events()
                seen += sum(map(_messages, events))
    cost = cpu_microseconds(begin, messages * times)
    assert seen == messages * times
    match events[-1]:
        case ResultBurst(data=[*_, last]) | ResultContainer(data=last):
            assert last == DATA
        case event:
            raise AssertionError(event)
    return cost


def _messages(event: Event) -> int:
    """Return how many messages an event is."""
    return len(event.data) if isinstance(event, ResultBurst) else 1


def _reads(data: bytes) -> Iterator[bytes]:
    """Cut bytes as a socket does."""
    for begin in range(0, len(data), READ):
        yield data[begin : begin + READ]


def _connected() -> Machine:
    machine = Machine(BVS.dialects["handbook"], Role.CLIENT, Transport.TCP)
    machine.send(Connect())
    machine.receive_data(wire.CONNECT_ANSWER)
    machine.events()
    return machine


async def _end_to_end(camera: smartcam.Camera, messages: int, times: int) -> Cost:
    go = messages.to_bytes(8, "little")
    begin = time.process_time()
    for _ in range(times):
        results = camera.results()
        await camera.request(wire.TRIGGER, go, answered=False)
        missing, last = messages, None
        async for last in results:  # noqa: B007 - looked at when it is over
            missing -= 1
            if not missing:
                break
    cost = cpu_microseconds(begin, messages * times)
    assert last is not None
    assert last.raw == DATA
    assert results.statistics().dropped == 0
    return cost
