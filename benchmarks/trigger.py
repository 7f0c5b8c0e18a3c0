"""Trigger round trip: ``await camera.trigger()`` with five localizations, one after the other.

smartcam sends a Query in front of each Trigger, in the same write; the yardstick's bare Protocol
sends only the Trigger. The peer answers as a camera does: to the Query, then a status without
Waiting for Trigger, the result, a status with it. They come together in one delivery, as in a burst
behind a busy network, or apart, as from a camera that takes its time: the Query's answer with the
first status, the result and the second status each a delivery of its own. pymodbus reads 32 holding
registers, one request and one delivery: that is the same work as a trigger whose answers come
together. Apart, the bare Protocol alone takes three deliveries for its one, so there pymodbus is
shown without a goal.

The bare Protocol is shown without a goal, too. asyncio's own ``data_received`` takes 256 KiB for
each read, which a fresh process maps and unmaps every time: with that the yardstick is 20 to 80 us
too dear, by how the process happens to have laid out its memory, and says little about smartcam.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, cast

from pymodbus.client import AsyncModbusTcpClient

import smartcam
from benchmarks.measure import (
    Comparison,
    Cost,
    Goal,
    Plan,
    Series,
    cpu_microseconds,
    take_turns_awaiting,
)
from benchmarks.peers import peer, wire
from benchmarks.yardsticks import bare_client

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

__all__ = ["run"]

TRIGGERS = 400
"""In a round of each side."""

REGISTERS = 32

SMARTCAM, BARE, PYMODBUS = "smartcam", "bare Protocol", "pymodbus"


GOALS: dict[str, dict[str, Goal | None]] = {
    "together": {BARE: None, PYMODBUS: Goal("at most", 1.0)},
    "apart": {BARE: None, PYMODBUS: None},
}


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure on stock asyncio and on uvloop, with the answers together and apart."""
    with peer("modbus") as plc:
        for how, goals in GOALS.items():
            case = f"await trigger(), 5 localizations, {how}"
            with peer("trigger", how) as camera:
                series = asyncio.run(_measure(plan, camera, plc))
                for name, goal in goals.items():
                    yield Comparison("trigger", case, series[SMARTCAM], series[name], goal=goal)
                with asyncio.Runner(loop_factory=_uvloop()) as runner:
                    series = runner.run(_measure(plan, camera, plc))
                for name in goals:
                    yield Comparison("trigger", f"{case}, uvloop", series[SMARTCAM], series[name])


def _uvloop() -> Callable[[], asyncio.AbstractEventLoop]:
    import uvloop

    return cast("Callable[[], asyncio.AbstractEventLoop]", uvloop.new_event_loop)


async def _measure(plan: Plan, camera_port: int, plc_port: int) -> dict[str, Series]:
    count = plan.operations(TRIGGERS, least=5)
    bare = await bare_client(camera_port)
    plc = AsyncModbusTcpClient("127.0.0.1", port=plc_port)
    await plc.connect()
    url = f"bvs://127.0.0.1:{camera_port}?dialect=handbook"

    async def smartcam_side() -> Cost:
        begin = time.process_time()
        for _ in range(count):
            result = await camera.trigger()
        cost = cpu_microseconds(begin, count)
        assert len(result.value) == 5
        assert result.value[4].feature_id == "part 4"
        return cost

    async def bare_side() -> Cost:
        begin = time.process_time()
        for _ in range(count):
            await bare.ask(TRIGGER, wire.RESULT)
        return cpu_microseconds(begin, count)

    async def pymodbus_side() -> Cost:
        begin = time.process_time()
        for _ in range(count):
            got = await plc.read_holding_registers(0, count=REGISTERS)
        cost = cpu_microseconds(begin, count)
        assert got.registers == list(range(REGISTERS))
        return cost

    async with smartcam.connect(url, interpret_as="localizations") as camera:
        sides = {SMARTCAM: smartcam_side, BARE: bare_side, PYMODBUS: pymodbus_side}
        series = await take_turns_awaiting(plan, sides)
        counted = camera.statistics()
        assert counted.received == counted.triggered == count * (plan.rounds + 1)
    bare.transport.close()
    plc.close()
    return series


TRIGGER = wire.frame(wire.TRIGGER)
