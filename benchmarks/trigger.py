"""Trigger round trip: ``await camera.trigger()`` with five localizations, one after the other.

smartcam sends a Query in front of each Trigger, in the same write; the yardstick's bare protocol
sends only the Trigger. The peer answers as a camera does: to the Query, then a status without
Waiting for Trigger, the result, a status with it. They come together in one delivery, as in a burst
behind a busy network, or apart, as from a camera that takes its time: the Query's answer with the
first status, the result and the second status each a delivery of its own. pymodbus reads 32 holding
registers, one request and one delivery: that is the same work as a trigger whose answers come
together. Apart, the bare protocol alone takes three deliveries for its one, so there pymodbus is
shown without a goal.

A peer that sleeps on another core has to be woken, which is as dear for every side and often more
than all the rest (:mod:`benchmarks.cores`). With both on one core what is measured is the program,
and the ratios come near those of the instructions.

Over UDP each frame is a datagram, there and back: two to the camera and four from it. asyncio reads
each into a block of its own, so a process whose allocator has not settled is shown, too.
"""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

from pymodbus.client import AsyncModbusTcpClient

import smartcam
from benchmarks.cores import placed
from benchmarks.instructions import count_sides
from benchmarks.malloc import UNSETTLED
from benchmarks.measure import Comparison, Goal, Plan, Series, instructions_of, take_turns
from benchmarks.peers import peer, wire
from benchmarks.sides import Side, alone, take_sides
from benchmarks.yardsticks import bare_client, bare_datagrams

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable, Mapping

    from benchmarks.sides import Work

__all__ = ["SIDES", "run"]

TRIGGERS = 400
"""In a round of each side."""

COUNTED = 50
"""Where instructions are counted."""

REGISTERS = 32

SMARTCAM, BARE, PYMODBUS = "smartcam", "bare protocol", "pymodbus"
UDP, BARE_UDP, TCP = "smartcam, UDP", "bare datagrams", "smartcam, TCP"
MAPPING = "smartcam, UDP, not settled"

Goals = dict[str, Goal | None]
NONE: Goals = {BARE: None, PYMODBUS: None}
GOALS: dict[str, Goals] = {
    "together": {BARE: Goal("at most", 2.6), PYMODBUS: Goal("at most", 1.0)},
    "apart": NONE,
}
"""With a peer that has to be woken on another core, as who sends to a network has to do more."""


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure with the answers together and apart, on two cores and on one, on uvloop, over UDP."""
    for how, goals in GOALS.items():
        case = f"await trigger(), 5 localizations, {how}"
        with placed(apart=True), peer("modbus") as plc, peer("trigger", how) as camera:
            yield from _compared(plan, f"{case}, two cores", _ports(camera, plc), goals)
        with placed(apart=False), peer("modbus") as plc, peer("trigger", how) as camera:
            ports = _ports(camera, plc)
            counts = count_sides(plan, "trigger", ports, COUNTED)
            yield from _compared(plan, f"{case}, one core", ports, NONE, counts)
            yield from _compared(plan, f"{case}, one core, uvloop", ports, NONE, loop=_uvloop())
    with placed(apart=False):
        yield from _datagrams(plan)


def _ports(camera: int, plc: int) -> dict[str, int]:
    return {SMARTCAM: camera, BARE: camera, PYMODBUS: plc}


def _compared(
    plan: Plan,
    case: str,
    ports: dict[str, int],
    goals: Goals,
    counts: Mapping[str, float] = MappingProxyType({}),
    loop: Callable[[], asyncio.AbstractEventLoop] | None = None,
) -> Iterable[Comparison]:
    with asyncio.Runner(loop_factory=loop) as runner:
        series = runner.run(_measure(plan, ports))
    for name, goal in goals.items():
        yield Comparison(
            "trigger",
            case,
            series[SMARTCAM],
            series[name],
            goal=goal,
            instructions=instructions_of(counts, SMARTCAM, name),
        )


def _datagrams(plan: Plan) -> Iterable[Comparison]:
    case = "await trigger(), 5 localizations, UDP, one core"
    with peer("trigger", "udp") as datagrams, peer("trigger", "together") as stream:
        ports = {UDP: datagrams, BARE_UDP: datagrams, TCP: stream}
        counts = count_sides(plan, "trigger", ports, COUNTED)
        series = asyncio.run(_measure(plan, ports))
        for name in (BARE_UDP, TCP):
            yield Comparison(
                "trigger",
                case,
                series[UDP],
                series[name],
                instructions=instructions_of(counts, UDP, name),
            )
        count = plan.operations(TRIGGERS, least=5)
        mapping = take_turns(
            Plan(min(plan.rounds, FEW), plan.scale),
            {
                MAPPING: lambda: alone("trigger", UDP, datagrams, count, UNSETTLED),
                UDP: lambda: alone("trigger", UDP, datagrams, count, {}),
            },
            warm_up=False,
        )
    yield Comparison(
        "trigger",
        f"{case}, allocator not settled",
        mapping[MAPPING],
        mapping[UDP],
        goal=Goal("at most", 1.1),
        note="each time in a new process; the one maps and unmaps each block of 128 KiB or more",
    )


FEW = 3
"""Rounds of what begins a process each time."""


def _uvloop() -> Callable[[], asyncio.AbstractEventLoop]:
    import uvloop

    return cast("Callable[[], asyncio.AbstractEventLoop]", uvloop.new_event_loop)


async def _measure(plan: Plan, ports: dict[str, int]) -> dict[str, Series]:
    sides = {name: (SIDES[name], port) for name, port in ports.items()}
    return await take_sides(plan, sides, plan.operations(TRIGGERS, least=5))


# ---------------------------------------------------------------------- sides


@asynccontextmanager
async def _smartcam(port: int, scheme: str = "bvs") -> AsyncIterator[Work]:
    url = f"{scheme}://127.0.0.1:{port}?dialect=handbook"
    async with smartcam.connect(url, interpret_as="localizations") as camera:
        triggered = 0

        async def work(count: int) -> None:
            nonlocal triggered
            for _ in range(count):
                result = await camera.trigger()
            triggered += count
            assert len(result.value) == 5
            assert result.value[4].feature_id == "part 4"

        yield work
        counted = camera.statistics()
        assert counted.received == counted.triggered == triggered


@asynccontextmanager
async def _bare(port: int) -> AsyncIterator[Work]:
    bare = await bare_client(port)

    async def work(count: int) -> None:
        for _ in range(count):
            await bare.ask(TRIGGER, wire.RESULT)

    yield work
    bare.transport.close()


@asynccontextmanager
async def _bare_datagrams(port: int) -> AsyncIterator[Work]:
    bare = await bare_datagrams(port)

    async def work(count: int) -> None:
        for _ in range(count):
            await bare.ask(TRIGGER, wire.RESULT)

    yield work
    bare.close()


@asynccontextmanager
async def _pymodbus(port: int) -> AsyncIterator[Work]:
    plc = AsyncModbusTcpClient("127.0.0.1", port=port)
    await plc.connect()

    async def work(count: int) -> None:
        for _ in range(count):
            got = await plc.read_holding_registers(0, count=REGISTERS)
        assert got.registers == list(range(REGISTERS))

    yield work
    plc.close()


SIDES: dict[str, Side] = {
    SMARTCAM: _smartcam,
    BARE: _bare,
    PYMODBUS: _pymodbus,
    UDP: lambda port: _smartcam(port, "bvs+udp"),
    BARE_UDP: _bare_datagrams,
    TCP: _smartcam,
}
"""By name; ``python -m benchmarks.sides trigger NAME PORT OPERATIONS`` has one alone."""

TRIGGER = wire.frame(wire.TRIGGER)
