"""Fleet: 10, 100 and 1,000 cameras in one process, idle and with ten results a second of each.

Each side has a process of its own, and a peer of its own that plays its cameras; the process opens
them once and then does what it is told, so that idle cameras of one side cost the other nothing.
A result is 70 bytes, of which smartcam makes a numpy table that a task for each camera takes with
``async for``; a bare protocol cuts and counts frames. What a process costs is its CPU time.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from functools import partial
from statistics import median
from typing import TYPE_CHECKING

from benchmarks.fleet_process import ASKING, BARE, SMARTCAM
from benchmarks.measure import Comparison, Cost, Curve, Goal, Plan, Series, take_turns
from benchmarks.peers import peer

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

__all__ = ["run"]

SIZES = (10, 100, 1000)
"""Cameras in one process."""

RATE = 10.0
"""Results a second of each camera."""

SECONDS = 0.5
"""How long the cameras send in a round."""

IDLE_SECONDS = 7.5
"""Three times the silence after which liveness asks a camera for a sign of life."""

STALL_SIZE, STALL_RATE, STALL_SECONDS = 100, 40.0, 0.2
STALL_TURNS = 5
"""In a round: what else the machine does is in a 99th percentile, so their median counts."""

FEW = 3
"""Rounds of what takes long and varies little: memory, and cameras that are idle."""

SIDES = SMARTCAM, BARE

Answer = dict[str, float]


def run(plan: Plan) -> Iterable[Comparison | Curve]:
    """Measure memory, cameras that are idle, cameras at work, and one that stalls."""
    sizes = SIZES[:1] if plan.quick else SIZES
    few = Plan(1 if plan.quick else min(plan.rounds, FEW), plan.scale)
    with contextlib.ExitStack() as stack:
        fleets = {
            (side, size): stack.enter_context(_fleet(side, size))
            for size in sizes
            for side in SIDES
        }
        with _fleet(ASKING, sizes[-1]) as asking:
            idle = _idle(few, {**fleets, (ASKING, sizes[-1]): asking})
        busy = {size: _busy(plan, fleets, size) for size in sizes}
        if sys.platform == "linux":
            yield _memory(few, {side: fleets[side, sizes[-1]] for side in SIDES}, sizes[-1])
    for size in sizes:
        goal = Goal("at most", 3, "% of a core") if size == SIZES[-1] else None
        yield Comparison(
            "fleet",
            f"{size:,} idle cameras, liveness on",
            idle[SMARTCAM, size],
            idle[BARE, size],
            how="alone",
            goal=goal,
            note="a Query every 2.5 s from each; a bare protocol asks nothing",
        )
    yield Comparison(
        "fleet",
        f"{sizes[-1]:,} idle cameras, liveness on",
        idle[SMARTCAM, sizes[-1]],
        idle[ASKING, sizes[-1]],
        note="a Query every 2.5 s from each of both",
    )
    for size in sizes:
        subject, yardstick = busy[size][SMARTCAM], busy[size][BARE]
        case = f"{size:,} cameras, {RATE:g} results a second each"
        yield Comparison(
            "fleet",
            case,
            subject,
            yardstick,
            goal=Goal("at most", 3),
            note="CPU time for each result",
        )
    del idle[ASKING, sizes[-1]]
    yield _curve("Idle cameras", "% of a core", idle)
    costs = {(side, size): one for size in sizes for side, one in busy[size].items()}
    yield _curve(f"{RATE:g} results a second of each camera", "us of CPU time a result", costs)
    yield from _stalls(plan, 10 if plan.quick else STALL_SIZE)


def _memory(plan: Plan, opened: dict[str, _Fleet], size: int) -> Comparison:
    """Compare what opening took; processes of their own for each further round."""
    values = {side: [fleet.opened["KiB"]] for side, fleet in opened.items()}
    for _ in range(plan.rounds - 1):
        for side in SIDES:
            with _fleet(side, size) as fleet:
                values[side].append(fleet.opened["KiB"])
    return Comparison(
        "fleet",
        f"memory of each of {size:,} cameras",
        Series(SMARTCAM, "KiB", values[SMARTCAM]),
        Series(BARE, "KiB", values[BARE]),
        how="more",
        goal=Goal("at most", 40, "KiB"),
        note="growth of the resident set while they are opened",
    )


def _idle(plan: Plan, fleets: dict[tuple[str, int], _Fleet]) -> dict[tuple[str, int], Series]:
    """Let all of them be idle at the same time: what counts is the CPU time of each process."""
    seconds = IDLE_SECONDS * plan.scale
    values: dict[tuple[str, int], list[float]] = {key: [] for key in fleets}
    for _ in range(plan.rounds):
        for fleet in fleets.values():
            fleet.tell("idle", seconds)
        for key, fleet in fleets.items():
            answer = fleet.answer()
            values[key].append(answer["percent"])
            asked = answer["asked"] / key[1]
            assert plan.quick or asked >= (0 if key[0] == BARE else 2), asked
    return {(name, size): Series(name, "% of a core", v) for (name, size), v in values.items()}


def _busy(plan: Plan, fleets: dict[tuple[str, int], _Fleet], size: int) -> dict[str, Series]:
    results = plan.operations(round(RATE * SECONDS), least=2)

    def busy(side: str) -> Cost:
        return fleets[side, size].ask("busy", results, RATE)["us"]

    return take_turns(plan, {side: partial(busy, side) for side in SIDES})


def _stalls(plan: Plan, size: int) -> Iterable[Comparison]:
    """Compare the others' latency, with and without a camera that stalls."""
    results = plan.operations(round(STALL_RATE * STALL_SECONDS), least=3)
    share = 1 if plan.quick else STALL_TURNS
    stalls = {
        "another stalls in mid-frame": "silent",
        "another's subscriber does not read": "unread",
    }
    with _fleet(SMARTCAM, size) as fleet:

        def latency(how: str) -> Cost:
            return fleet.ask(how, results, STALL_RATE)["p99"]

        turns = take_turns(
            Plan(plan.rounds * share, plan.scale),
            {how: partial(latency, how) for how in ("steady", *stalls.values())},
        )
    medians = {
        how: [median(values) for values in zip(*[iter(one.values)] * share, strict=True)]
        for how, one in turns.items()
    }
    for name, how in stalls.items():
        subject = Series("stall", "us", medians[how])
        yardstick = Series("no stall", "us", medians["steady"])
        yield Comparison(
            "fleet",
            f"p99 of {size - 1} cameras, {name}",
            subject,
            yardstick,
            goal=Goal("at most", 1.1),
            note=f"from sent to seen, at {STALL_RATE:g} results a second of each camera",
        )


def _curve(title: str, unit: str, series: dict[tuple[str, int], Series]) -> Curve:
    lines: dict[str, list[tuple[float, float]]] = {SMARTCAM: [], BARE: []}
    for (side, size), one in series.items():
        lines[side].append((size, one.median))
    return Curve("fleet", title, "cameras", unit, lines)


class _Fleet:
    """One side's cameras, in a process of their own."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.opened = self.answer()

    def tell(self, command: str, *arguments: float) -> None:
        assert self._process.stdin is not None
        print(command, *arguments, file=self._process.stdin, flush=True)

    def answer(self) -> Answer:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError("the process of a fleet has ended")
        answer: Answer = json.loads(line)
        return answer

    def ask(self, command: str, *arguments: float) -> Answer:
        self.tell(command, *arguments)
        return self.answer()


@contextlib.contextmanager
def _fleet(side: str, size: int) -> Iterator[_Fleet]:
    with peer("fleet") as port:
        process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.fleet_process", side, str(size), str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            yield _Fleet(process)
        finally:
            process.kill()
            process.communicate()
