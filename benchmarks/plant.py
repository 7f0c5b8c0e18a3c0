"""Plant: 5,000 cameras of four agents, and a program that sees, asks and hears them all.

The cameras are canned ones, all in one process that is not counted, each with a session of its own
at its agent; the agents are processes, the first one the router too. The program is this process,
and a new one to the fleet in each round.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import importlib.util
import socket
import statistics
import sys
import time
from typing import TYPE_CHECKING

import smartcam.fleet
from benchmarks.fleet_process import LAYOUT
from benchmarks.measure import Comparison, Curve, Goal, Plan, Series
from benchmarks.peers import peer, wire
from benchmarks.peers.control import Control
from benchmarks.peers.fleet import GO, GO_BODY
from smartcam._zenoh import with_ports

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

__all__ = ["run"]

AGENTS, QUICK_AGENTS = 4, 2
SIZES = (40, 400, 5000)
"""Cameras of all agents together."""

RATE = 4.0
"""Results a second of each camera, which are sent whatever the machine makes of them."""

RESULTS = 6
"""Of each camera, in a round."""

FEW = 3
"""Rounds."""

QUESTIONS = 5
"""For the status of all, in a round: the one in the middle counts."""

LIMIT = 120.0
"""Seconds until what does not come is an error."""

SETTLED = 1.0
"""Seconds for a program to take what comes with its opening."""


def run(plan: Plan) -> Iterable[Comparison | Curve]:
    """Measure what a newcomer, a question and a result cost, and an agent's memory."""
    if importlib.util.find_spec("zenoh") is None:
        print("plant: left out: Zenoh is not installed (smartcam[fleet])", file=sys.stderr)
        return
    sizes = (8,) if plan.quick else SIZES
    rounds = 1 if plan.quick else min(plan.rounds, FEW)
    agents = QUICK_AGENTS if plan.quick else AGENTS
    found = {size: _measure(size, rounds, agents) for size in sizes}
    most, fewer = found[sizes[-1]], found[sizes[-2:][0]]
    name = f"{sizes[-1]:,} cameras of {agents} agents"
    seen, asked = Goal("at most", 1, "s"), Goal("at most", 100, "ms")
    through, flat = Goal("at least", 15_000, "results/s"), Goal("at most", 1.5)
    rows = {what: Series("fleet", unit, most[what]) for what, unit in UNITS.items()}
    few = Series(f"{sizes[-2:][0]} cameras", "us", fewer["both"])
    yield Comparison("plant", f"{name}: seen by a newcomer", rows["open"], how="alone", goal=seen)
    yield Comparison("plant", f"{name}: status of all", rows["status"], how="alone", goal=asked)
    yield Comparison(
        "plant",
        f"{name}: results into one subscriber",
        rows["rate"],
        how="alone",
        goal=through,
        note=f"{RATE * sizes[-1]:,.0f} a second are sent; none is lost, or the run fails",
    )
    yield Comparison("plant", f"{name}: a result, CPU of the program", rows["here"], how="alone")
    yield Comparison("plant", f"{name}: a result, CPU of its agent", rows["there"], how="alone")
    yield Comparison(
        "plant",
        f"{name}: a result, CPU of program and agent",
        rows["both"],
        few,
        goal=flat,
        note=f"{RATE:g} results a second of each camera, as many as there are",
    )
    if sys.platform == "linux":
        yield _memory(rows["memory"], sizes[-1] // agents)
    lines: dict[str, list[tuple[float, float]]] = {
        side: [(float(size), Series("", "us", one[what]).median) for size, one in found.items()]
        for side, what in (("program", "here"), ("agent", "there"))
    }
    yield Curve("plant", "A result of a plant", "cameras", "us of CPU time a result", lines)


UNITS = {
    "open": "s",
    "status": "ms",
    "rate": "results/s",
    "here": "us",
    "there": "us",
    "both": "us",
    "memory": "KiB",
}


def _memory(shared: Series, count: int) -> Comparison:
    with peer("fleet") as port, peer("plant", "clients", str(count), str(port)) as control:
        usage = Control(control).usage()
    alone = Series("clients", "KiB", [(usage.resident - usage.before) / count])
    first = Series("agent", "KiB", shared.values[:1])
    goal, note = Goal("at most", 60, "KiB"), "growth of the resident set while they are opened"
    case = f"memory of each of {count:,} cameras of an agent, above a client's own"
    return Comparison("plant", case, first, alone, "more", goal, note)


@contextlib.contextmanager
def _agents(size: int, count: int) -> Iterator[tuple[int, str, list[Control]]]:
    """Give the port of the cameras, the place of the fleet, and its agents."""
    (place,) = with_ports(["tcp/127.0.0.1:0"])
    with contextlib.ExitStack() as stack:
        port = stack.enter_context(peer("fleet"))
        controls: list[Control] = []
        for number in range(count):
            how = "connect" if number else "listen"
            names = (str(size // count), str(port), f"agent{number}", place, how)
            controls.append(Control(stack.enter_context(peer("plant", "agent", *names))))
        yield port, place, controls


def _measure(size: int, rounds: int, agents: int) -> dict[str, list[float]]:
    """Return the figures of each round, by what they are."""
    found: dict[str, list[float]] = {what: [] for what in UNITS}
    with _agents(size, agents) as (port, place, controls):
        usages = [one.usage() for one in controls]
        grown = sum(one.resident - one.before for one in usages)
        found["memory"].append(grown / (size // agents * agents))
        url = f"fleet://{place.partition('/')[2]}"
        for _ in range(rounds):
            for what, figure in asyncio.run(_round(size, port, url, controls)).items():
                found[what].append(figure)
    return found


async def _round(size: int, port: int, url: str, controls: list[Control]) -> dict[str, float]:
    gc.collect()
    begin = time.perf_counter()
    fleet = smartcam.fleet.open(url, interpret_as=LAYOUT, connect_timeout=LIMIT)
    async with asyncio.timeout(LIMIT), fleet:
        opened = time.perf_counter() - begin
        assert len(fleet) == size, len(fleet)
        await asyncio.sleep(SETTLED)
        took_each: list[float] = []
        for _ in range(QUESTIONS):
            begin = time.perf_counter()
            known = await fleet.status(timeout=LIMIT)
            took_each.append(time.perf_counter() - begin)
            assert sum(one.connected for one in known.values()) == size
        asked = statistics.median(took_each)
        results = fleet.results()
        await fleet.find_cameras()
        await asyncio.sleep(SETTLED)
        gc.collect()
        each = RESULTS
        there, here = sum(one.usage().cpu for one in controls), time.process_time()
        begin = time.perf_counter()
        with socket.create_connection(("127.0.0.1", port)) as control:
            control.sendall(wire.frame(GO, GO_BODY.pack(each, RATE)))
            left = each * size
            async for _ in results:
                left -= 1
                if not left:
                    break
        took = time.perf_counter() - begin
        here = time.process_time() - here
        there = sum(one.usage().cpu for one in controls) - there
        accounts = results.statistics().values()
        assert not any(one.dropped or one.missed for one in accounts)
        assert sum(one.taken for one in accounts) == each * size
    count = each * size
    return {
        "open": opened,
        "status": 1e3 * asked,
        "rate": count / took,
        "here": 1e6 * here / count,
        "there": 1e6 * there / count,
        "both": 1e6 * (here + there) / count,
    }
