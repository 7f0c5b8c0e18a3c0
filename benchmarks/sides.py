"""A side by its name: what it opens, and its work, in a process with others or in one of its own.

A side is made for the port of its peer; it is open as long as it is used, and gives its work: so
many operations, one after the other. Benchmarks measure sides in turns, in one loop
(:func:`take_sides`). ``python -m benchmarks.sides MODULE SIDE PORT OPERATIONS`` opens one of a
module's ``SIDES`` alone and prints what an operation costs there: for what a whole process decides,
such as the state of its allocator, or that its instructions are counted.
"""

from __future__ import annotations

import asyncio
import gc
import importlib
import os
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from functools import partial
from typing import TYPE_CHECKING, Literal

from benchmarks.measure import Cost, cpu_microseconds, take_turns_awaiting

if TYPE_CHECKING:
    from benchmarks.measure import Plan, Series

__all__ = ["COUNTED", "Side", "Work", "alone", "command", "take_sides"]

Work = Callable[[int], Awaitable[None]]
"""Does so many operations."""

Side = Callable[[int], AbstractAsyncContextManager[Work]]
"""Opens a side at a port."""

WARM_UP = 0.2
"""Operations before those that count, as a share of them."""

COUNTED = "counted"
"""Last word of the command line where instructions are counted."""

COUNTED_WARM_UP = 20
"""Operations before those; N and 2 N have the same."""

SLOWER = 50
"""Times that a process is slower then, about."""

PATIENCE = 120.0
"""Seconds until a process that does not end is an error."""


async def take_sides(
    plan: Plan,
    sides: Mapping[str, tuple[Side, int]],
    count: int,
    *,
    unit: Literal["us", "ms"] = "us",
) -> dict[str, Series]:
    """Measure the CPU time of ``count`` operations of each side, in turns.

    Each is open only for its turn: cameras that have a loop in common give way to each other.

    Args:
        plan: how many rounds.
        sides: by name, and the port of each.
        count: operations of a round.
        unit: of the figures.
    """

    async def cost(side: Side, port: int) -> Cost:
        return (
            await _cost(side, port, count, round(count * WARM_UP)) * {"us": 1.0, "ms": 1e-3}[unit]
        )

    costs = {name: partial(cost, *place) for name, place in sides.items()}
    return await take_turns_awaiting(plan, costs, unit=unit)


async def _cost(
    side: Side,
    port: int,
    count: int,
    warm_up: int,
    prepare: Callable[[], object] = gc.collect,
) -> Cost:
    """Return the CPU time of an operation, microseconds; opening and a few before are not in it."""
    async with side(port) as work:
        await work(max(1, warm_up))
        prepare()
        begin = time.process_time()
        await work(count)
        return cpu_microseconds(begin, count)


def command(module: str, side: str, port: int, count: int) -> list[str]:
    """Return the command line that opens a side alone."""
    return [sys.executable, "-m", "benchmarks.sides", module, side, str(port), str(count)]


def alone(module: str, side: str, port: int, count: int, environment: Mapping[str, str]) -> Cost:
    """Return the CPU time of an operation, microseconds, in a new process.

    Args:
        module: a benchmark.
        side: one of its ``SIDES``.
        port: of its peer.
        count: operations.
        environment: added to this process' own.
    """
    run = subprocess.run(
        command(module, side, port, count),
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=PATIENCE,
    )
    return float(run.stdout)


def _freeze() -> None:
    """Leave what is there to itself: how much was imported before is not the question."""
    gc.collect()
    gc.freeze()


def _slow_clock() -> None:
    """Let the client cut its work as it does at full speed: it goes by the CPU time of a chunk."""
    from smartcam._client import link

    link.TURN_TIME *= SLOWER
    link.SHARED_TURN_TIME *= SLOWER


async def main(module: str, side: str, port: str, count: str, how: str = "") -> None:
    """Open a side of a module, and print what an operation costs."""
    sides: Mapping[str, Side] = importlib.import_module(f"benchmarks.{module}").SIDES
    warm_up = round(int(count) * WARM_UP)
    if how == COUNTED:
        _slow_clock()
        warm_up = COUNTED_WARM_UP
    print(await _cost(sides[side], int(port), int(count), warm_up, _freeze))


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
