"""Outlets: triggers of an agent's camera beside an outlet whose far end is stalled.

Two agents in this process have a session each with the same canned camera, which is a process of
its own. One has an outlet that takes nothing for ever, so that each result goes to its spool; the
other one has none. Triggers come as those of fast machines do, 100 a second at random intervals, in
blocks by turns at both agents; each is measured on the wall clock from the call of ``trigger()`` to
its result. Of a round counts the 99th percentile of each side.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import importlib.util
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.measure import Comparison, Cost, Goal, Plan, Series
from benchmarks.peers import peer
from smartcam.fleet import FleetServer, MemoryBus
from smartcam.fleet._inside import FleetOutlets
from smartcam.outlets import Outlet, OutletEntry, OutletSettings
from smartcam.registry import OUTLETS

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Mapping, Sequence

__all__ = ["run"]

TRIGGERS = 400
"""In a round of each side: the fourth slowest is the 99th percentile."""

BLOCK = 20
"""Triggers of a side before the other one has its turn."""

PERIOD = 0.01
"""Seconds from a trigger to the next, in the mean; from half of it to one and a half."""

STALLED, WITHOUT = "beside a stalled outlet", "without an outlet"


class StalledSettings(OutletSettings):
    """No settings of its own."""


class StalledOutlet(Outlet[StalledSettings]):
    """Takes nothing, and never says so."""

    settings_class = StalledSettings

    async def deliver(self, entries: Sequence[OutletEntry]) -> None:
        """Wait for ever."""
        await asyncio.Event().wait()


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure the 99th percentile and the median of triggers on both sides."""
    if importlib.util.find_spec("yaml") is None:
        print("outlets: left out: PyYAML is not installed (smartcam[yaml])", file=sys.stderr)
        return
    OUTLETS.register("stalled", StalledOutlet)
    with peer("trigger", "together") as port, tempfile.TemporaryDirectory() as folder:
        yield from asyncio.run(_triggers(plan, port, Path(folder)))


async def _triggers(plan: Plan, port: int, folder: Path) -> list[Comparison]:
    blocks = plan.operations(TRIGGERS, least=100) // BLOCK
    slowest, middle = (dict[str, list[Cost]]({STALLED: [], WITHOUT: []}) for _ in range(2))
    async with (
        _agent(port, folder, {"stalled": {"timeout": 3600}}) as stalled,
        _agent(port, folder, None) as without,
    ):
        for number in range(plan.rounds + 1):
            gc.collect()
            took = await _in_turn({STALLED: stalled, WITHOUT: without}, blocks)
            for name, each in took.items() if number else ():
                slowest[name].append(each[len(each) - max(1, len(each) // 100)])
                middle[name].append(each[len(each) // 2])
        account = stalled.outlet_states()["stalled"].counts
        count = blocks * BLOCK * (plan.rounds + 1)
        assert account.spooled == account.results == count, account
    case = "await trigger(), 100 a second"
    note = "wall clock; every result is written to the spool, and none is taken"
    last, mid = (
        {name: Series(name, "us", costs) for name, costs in each.items()}
        for each in (slowest, middle)
    )
    goal = Goal("at most", 1.1)
    return [
        Comparison("outlets", f"{case}, p99", last[STALLED], last[WITHOUT], "ratio", goal, note),
        Comparison("outlets", f"{case}, p50", mid[STALLED], mid[WITHOUT]),
    ]


@contextlib.asynccontextmanager
async def _agent(
    port: int, folder: Path, outlets: dict[str, Any] | None
) -> AsyncIterator[FleetServer]:
    from smartcam.fleet import FleetFile

    url = f"bvs://127.0.0.1:{port}?dialect=handbook"
    fields: dict[str, Any] = {"cameras": {"cam": {"url": url, "interpret_as": "localizations"}}}
    if outlets is not None:
        fields["outlets"] = outlets
    server = FleetServer(
        FleetFile.model_validate(fields), bus=MemoryBus().new_connection(), folder=folder
    )
    async with contextlib.AsyncExitStack() as stack:
        if outlets is not None:
            await stack.enter_async_context(FleetOutlets(server))
        await stack.enter_async_context(server)
        await server.wait_first_attempts()
        yield server


async def _in_turn(servers: Mapping[str, FleetServer], blocks: int) -> dict[str, list[float]]:
    """Return the microseconds of triggers of each side, sorted; the sides take turns by blocks.

    So what else the machine does for a moment meets both of them.
    """
    took: dict[str, list[float]] = {name: [] for name in servers}
    dice = random.Random(blocks)  # noqa: S311
    for number in range(blocks):
        for name in [*servers] if number % 2 else reversed([*servers]):
            took[name] += await _block(servers[name], dice)
    return {name: sorted(each) for name, each in took.items()}


async def _block(server: FleetServer, dice: random.Random) -> list[float]:
    """Return the microseconds of a block of triggers."""
    camera, took = server.shared_cameras["cam"].client, list[float]()
    due = time.perf_counter()
    for _ in range(BLOCK):
        due += dice.uniform(0.5, 1.5) * PERIOD
        await asyncio.sleep(max(0.0, due - time.perf_counter()))
        begin = time.perf_counter()
        await camera.trigger(timeout=30.0)
        took.append(1e6 * (time.perf_counter() - begin))
    return took
