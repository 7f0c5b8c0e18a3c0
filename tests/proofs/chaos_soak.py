"""Soak under chaos: many cameras, each with a client at work, and a fault somewhere every second.

No result may be another trigger's, every container must be accounted for, every wait must end in
time, and neither memory nor tasks may grow.

Long form: ``python -m tests.proofs.chaos_soak --cameras 20 --seconds 600 --seed 1`` (prints its
figures, exit 1 on a violation).
"""

from __future__ import annotations

import argparse
import asyncio
import ctypes
import gc
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from statistics import fmean

from tests.client.clientkit import loop_reports
from tests.proofs.chaos_faults import TCP_FAULTS, UDP_FAULTS
from tests.proofs.chaos_station import Station, Watch

SAMPLES = 40
"""Number of looks at memory and tasks in a run."""

GROWTH = 16.0
"""MB that the last quarter may have more than the first; caches fill, and the heap has holes."""

MORE_BLOCKS = 1.1
"""Times as many blocks of memory in use that it may have."""

MORE_TASKS = 1.2
"""Times as many tasks that it may have: how many there are goes by chance."""


@dataclass(slots=True)
class Soak:
    """The outcome of the soak."""

    cameras: int
    seconds: float
    watch: Watch = field(default_factory=Watch)  # counts and violations
    faults: Counter[str] = field(default_factory=Counter)  # how often each was done
    memory: list[float] = field(default_factory=list)  # resident MB, sample by sample
    blocks: list[int] = field(default_factory=list)  # blocks of memory that Python has in use
    tasks: list[int] = field(default_factory=list)  # how many there were
    # containers, by transport
    sent: Counter[str] = field(default_factory=Counter)
    received: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)


async def soak(cameras: int, seconds: float, seed: int, *, interval: float = 1.0) -> Soak:
    """Run it, every fourth camera over UDP; ``interval`` is the mean time between two faults.

    The network's and the system's own chance is beside that of the seed.
    """
    chance = Random(seed)  # noqa: S311
    made = Soak(cameras, seconds)
    before = asyncio.all_tasks()
    with loop_reports() as reports:
        await _run(made, chance, interval)
    for text in reports:
        made.watch.complain(f"unheard: {text}")
    for _ in range(100):
        if not asyncio.all_tasks() - before:
            break
        await asyncio.sleep(0)
    for task in asyncio.all_tasks() - before:
        made.watch.complain(f"a task is left: {task}")
        task.cancel()
    return made


async def _run(made: Soak, chance: Random, interval: float) -> None:
    watch = made.watch
    stations = [
        Station(number, watch, Random(chance.random()))  # noqa: S311
        for number in range(made.cameras)
    ]
    for station in stations:
        await station.open()
    workers = [asyncio.create_task(one.work(), name=f"{one.name} work") for one in stations]
    beside = [
        asyncio.create_task(_harm(made, stations, chance, interval)),
        asyncio.create_task(_sample(made, stations)),
    ]
    await asyncio.wait(beside, timeout=made.seconds, return_when=asyncio.FIRST_COMPLETED)
    for task in beside:
        task.cancel()
    for station in stations:
        station.stop()
    _, hanging = await asyncio.wait(workers, timeout=120)
    watch.lag.stop()
    await asyncio.wait(beside)
    for task in (*beside, *workers):
        if task.done() and not task.cancelled() and task.exception() is not None:
            watch.complain(f"{task.get_name()} failed: {task.exception()!r}")
    for task in hanging:
        watch.complain(f"{task.get_name()} hangs")
        task.cancel()
    for station in stations:
        station.ledger.close()
        kind = station.transport
        made.sent[kind] += station.ledger.sent
        made.received[kind] += station.ledger.received
        made.lost[kind] += station.ledger.lost
        await station.close()
    _compare_quarters(made)


async def _harm(made: Soak, stations: Sequence[Station], chance: Random, interval: float) -> None:
    """Do something to a camera, again and again."""
    while True:
        await asyncio.sleep(chance.expovariate(1 / interval))
        victim = chance.choice(stations)
        table = TCP_FAULTS if victim.transport == "tcp" else UDP_FAULTS
        name, _, act = chance.choices(table, [share for _, share, _ in table])[0]
        made.faults[name] += 1
        act(victim, chance)


async def _sample(made: Soak, stations: Sequence[Station]) -> None:
    """Look at memory and tasks."""
    while True:
        await asyncio.sleep(made.seconds / SAMPLES)
        for station in stations:
            station.forget()
        gc.collect()
        made.memory.append(resident())
        made.blocks.append(sys.getallocatedblocks())
        made.tasks.append(len(asyncio.all_tasks()))


def resident() -> float:
    """Return the memory that this process has, MB; 0 where the system does not say.

    Holes of the heap are given back first, where the C library can: they come and go by chance.
    """
    status = Path("/proc/self/status")
    if not status.exists():
        return 0.0
    give_back = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if give_back is not None:
        give_back(0)
    lines = status.read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS"))


def quarters(values: Sequence[float]) -> tuple[float, float]:
    """Return the means of the first quarter and the last."""
    size = max(1, len(values) // 4)
    return fmean(values[:size]), fmean(values[-size:])


def _compare_quarters(made: Soak) -> None:
    if not made.memory:
        made.watch.complain("memory was never looked at")
        return
    first, last = quarters(made.memory)
    if last > first + GROWTH:
        made.watch.complain(f"memory grew from {first:.1f} to {last:.1f} MB")
    first, last = quarters(made.blocks)
    if last > MORE_BLOCKS * first:
        made.watch.complain(f"memory grew from {first:.0f} to {last:.0f} blocks")
    first, last = quarters(made.tasks)
    if last > MORE_TASKS * first + 2:
        made.watch.complain(f"tasks grew from {first:.1f} to {last:.1f}")


def report(made: Soak) -> str:
    """Return the figures as text."""
    watch = made.watch
    memory, blocks, tasks = (quarters(one) for one in (made.memory, made.blocks, made.tasks))
    lines = [
        f"{made.cameras} cameras, {made.seconds:g} s",
        f"faults: {made.faults.total()}: "
        + ", ".join(f"{name} {count}" for name, count in sorted(made.faults.items())),
    ]
    lines += [
        f"containers over {kind}: {made.sent[kind]} sent, {made.received[kind]} received, "
        f"{made.lost[kind]} lost"
        for kind in made.sent
    ]
    lines += [
        f"memory: {memory[0]:.1f} MB in the first quarter, {memory[1]:.1f} MB in the last",
        f"blocks in use: {blocks[0]:.0f} in the first quarter, {blocks[1]:.0f} in the last",
        f"tasks: {tasks[0]:.1f} in the first quarter, {tasks[1]:.1f} in the last",
        f"loop late by {1000 * watch.lag.worst:.0f} ms at most; "
        f"no wait more than {1000 * max(0.0, watch.worst):.0f} ms beyond its timeout and the lag",
    ]
    lines += [f"  {name}: {count}" for name, count in sorted(watch.counts.items())]
    lines += [f"VIOLATION {text}" for text in watch.violations]
    lines.append(f"{watch.counts['wrong']} wrong results, {watch.counts['violations']} violations")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the soak; return 1 where something was that must not be."""
    parser = argparse.ArgumentParser(description="Soak under chaos.")
    parser.add_argument("--cameras", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--interval", type=float, default=1.0, help="mean seconds between faults")
    options = parser.parse_args(arguments)
    print(f"seed {options.seed}", flush=True)  # noqa: T201
    made = asyncio.run(
        soak(options.cameras, options.seconds, options.seed, interval=options.interval)
    )
    print(report(made))  # noqa: T201
    return 1 if made.watch.violations else 0


if __name__ == "__main__":
    sys.exit(main())
