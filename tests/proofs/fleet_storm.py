"""Several programs trigger one camera of a fleet at once: each gets its own result, or an error.

Each trigger brings a number of its own as its input, and its result has that number. So it is known
of each result whose it is, and of each number how often it was executed. Calls are cancelled and
run out of time at random. Inside a process the bus loses, doubles, delays and mixes up, and the
agent is restarted; over Zenoh the programs are processes, one after the other of which is killed,
and one is stopped for a while, in the long form for longer than the engine's lease.

Long form: ``python -m tests.proofs.fleet_storm --triggers 10000 --seed 1`` (for each bus; prints
its figures, exit 1 on a violation).
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any, Self

import smartcam
from smartcam import Camera
from smartcam._zenoh import LEASE_TIME
from smartcam.exceptions import SmartCamError
from tests.fleet.fleetkit import FAST, LAYOUT, PATIENCE, NumberedCamera, Plant
from tests.fleet.lossy_bus import LossyBus, chance_of
from tests.proofs.books import TRIGGER_OUTCOMES, aligned
from tests.timed_loop import TimedLoop

PROGRAMS = 6
CALLS_AT_ONCE = 3
"""Calls of one program that are under way at a time."""

CANCELLED = 0.15
"""Share of the calls."""

WITH_INPUT = 2
"""The application whose results say which trigger they are of."""


@dataclass
class Figures:
    """The outcome of a storm."""

    name: str
    outcomes: Counter[str] = field(default_factory=Counter)
    executed: int = 0
    restarts: int = 0  # of the agent
    killed: int = 0  # programs
    stopped: int = 0  # and those that were stopped for a while
    violations: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def calls(self) -> int:
        """Calls that came to an end."""
        return self.outcomes.total()

    def take(self, token: int, outcome: str, got: int | None) -> None:
        """Note how a call ended."""
        self.outcomes[outcome] += 1
        if got is not None and got != token:
            self.violations.append(f"{self.name}: call {token} got the result of {got}")
        if outcome.startswith("!"):
            self.violations.append(f"{self.name}: call {token} ended with {outcome}")

    def judge(self, box: NumberedCamera) -> None:
        """Look at what the camera did."""
        times = Counter(box.inputs.values())
        self.executed = box.runs
        self.violations += [
            f"{self.name}: call {token} was executed {count} times"
            for token, count in times.items()
            if count > 1
        ]


async def call(
    camera: Camera[Any], token: int, chance: Random, grace: float = PATIENCE
) -> tuple[str, int | None]:
    """Trigger once, perhaps cancelled; return the outcome and whose result it was.

    That it has not ended ``grace`` seconds after its own timeout is an outcome, too.
    """
    timeout = chance.choice((0.005, 0.05, 0.5, 5.0))
    task = asyncio.create_task(camera.trigger(input=token.to_bytes(4, "little"), timeout=timeout))
    if chance.random() < CANCELLED:
        asyncio.get_running_loop().call_later(chance.uniform(0, 0.02), task.cancel)
    _, late = await asyncio.wait({task}, timeout=timeout + grace)
    if late:  # this process may have been stopped, so that all is due at once
        _, late = await asyncio.wait({task}, timeout=1.0)
    if late:
        return "! nothing", None
    if task.cancelled():
        return "cancelled", None
    error = task.exception()
    if error is None:
        return "result", task.result().value.token
    known = isinstance(error, TRIGGER_OUTCOMES)
    return f"{'' if known else '! '}{type(error).__name__}", None


async def live(
    camera: Camera[Any], tokens: Sequence[int], chance: Random
) -> AsyncIterator[tuple[int, str, int | None]]:
    """Make calls, some at once; give the outcome of each."""
    left = iter(tokens)
    ends: asyncio.Queue[tuple[int, str, int | None] | None] = asyncio.Queue()

    async def one_after_the_other() -> None:
        for token in left:
            outcome, got = await call(camera, token, chance)
            ends.put_nowait((token, outcome, got))
            if not camera.connected:
                with contextlib.suppress(SmartCamError):
                    await camera.wait_connected(PATIENCE)
            elif outcome == "InputContainerError":
                with contextlib.suppress(SmartCamError):
                    await camera.switch_application(WITH_INPUT)
            elif outcome == "NotRunningError":  # who was to switch was killed meanwhile
                with contextlib.suppress(SmartCamError):
                    await camera.start()
        ends.put_nowait(None)

    async with asyncio.TaskGroup() as group:
        for _ in range(CALLS_AT_ONCE):
            group.create_task(one_after_the_other())
        over = 0
        while over < CALLS_AT_ONCE:
            end = await ends.get()
            if end is None:
                over += 1
            else:
                yield end


# ---------------------------------------------------------------------- inside a process


async def storm_in_process(triggers: int, seed: int) -> Figures:
    """Have programs share a camera over a bus that does its worst."""
    figures, chance, begun = Figures("in process"), Random(f"{seed} process"), time.perf_counter()  # noqa: S311
    bus = LossyBus()
    worst = chance_of(chance, lost=0.02, doubled=0.1, late=0.1, by=0.05)
    box = NumberedCamera(active=WITH_INPUT)
    each = max(1, triggers // PROGRAMS)

    async def program(number: int) -> None:
        tokens = range(1 + number * each, 1 + (number + 1) * each)
        async with plant.camera() as camera:
            async for end in live(camera, tokens, chance):
                figures.take(*end)

    async with Plant(box, bus=bus) as plant:
        programs = [asyncio.create_task(program(number)) for number in range(PROGRAMS)]
        await asyncio.sleep(0.1)
        bus.fate = worst
        while True:
            _, left = await asyncio.wait(programs, timeout=chance.uniform(0.5, 3.0))
            if not left:
                break
            if len(left) == PROGRAMS:
                await plant.stop_agent()
                await plant.start_agent()
                figures.restarts += 1
        await asyncio.gather(*programs)
    figures.judge(box)
    figures.seconds = time.perf_counter() - begun
    return figures


# ---------------------------------------------------------------------- over Zenoh


async def run_program(url: str, first: int, calls: int, seed: int) -> None:
    """Be one of the programs: make calls, and print how each ended."""
    chance = Random(f"{seed} {first}")  # noqa: S311
    camera: Camera[Any] = smartcam.connect(url, interpret_as=LAYOUT, reconnect=FAST)
    async with camera:
        async for end in live(camera, range(first, first + calls), chance):
            print(json.dumps(end), flush=True)  # noqa: T201


class Program:
    """A process that triggers the camera.

    Args:
        figures: what comes of it.
        tokens: of its calls.
    """

    def __init__(self, figures: Figures, tokens: range) -> None:
        self.done = 0
        self._figures, self._tokens = figures, tokens
        self._process: asyncio.subprocess.Process
        self._reading: asyncio.Task[None]

    async def start(self, url: str, seed: int) -> Self:
        """Start it."""
        arguments = [url, str(self._tokens.start), str(len(self._tokens)), str(seed)]
        command = [sys.executable, "-m", "tests.proofs.fleet_storm", "--program", *arguments]
        self._process = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE)
        self._reading = asyncio.create_task(self._read())
        return self

    async def _read(self) -> None:
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            if line.endswith(b"\n"):  # it may be killed in the middle of one
                self._figures.take(*json.loads(line))
                self.done += 1
        code = await self._process.wait()
        if code not in {0, -signal.SIGKILL}:
            self._figures.violations.append(f"zenoh: a program ended with {code}")

    def signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self._process.returncode is None:
            self._process.send_signal(number)

    async def at_work(self) -> None:
        """Wait until it has made some calls, or has ended."""
        done = self.done + 20
        while self.done < done and not self._reading.done():  # noqa: ASYNC110 - lines that come
            await asyncio.sleep(0.01)

    async def ended(self) -> None:
        """Wait until it has ended."""
        await self._reading


async def storm_over_zenoh(
    triggers: int, seed: int, *, programs: int, kills: int, stop: float
) -> Figures:
    """Have processes share a camera; others are killed, and one is stopped for ``stop`` seconds."""
    figures, begun = Figures("zenoh"), time.perf_counter()
    box = NumberedCamera(active=WITH_INPUT)
    each = triggers // programs
    first = 1
    started: list[Program] = []

    async def start(calls: int) -> Program:
        nonlocal first
        started.append(Program(figures, range(first, first + calls)))
        first += calls
        return await started[-1].start(plant.address.url, seed)

    async with Plant(box, zenoh=True) as plant:
        try:
            steady = [await start(each) for _ in range(programs)]
            await steady[0].at_work()
            steady[0].signal(signal.SIGSTOP)
            await asyncio.sleep(stop)
            steady[0].signal(signal.SIGCONT)
            figures.stopped += 1
            for _ in range(kills):
                victim = await start(1_000_000)  # it would go on for ever
                await victim.at_work()
                victim.signal(signal.SIGKILL)
                await victim.ended()
                figures.killed += 1
            for program in steady:
                await program.ended()
        finally:
            for program in started:
                program.signal(signal.SIGKILL)
                await program.ended()
    figures.judge(box)
    figures.seconds = time.perf_counter() - begun
    return figures


# ---------------------------------------------------------------------- the command


COLUMNS = ("calls", "result", "executed", "restarts", "killed", "stopped")


def table(done: Sequence[Figures]) -> str:
    """Return the figures as text."""
    others = sorted({name for one in done for name in one.outcomes} - {"result"})
    rows: list[list[str]] = [["bus", *COLUMNS, *others, "seconds"]]
    for one in done:
        own = [one.calls, one.outcomes["result"], one.executed, one.restarts, one.killed]
        counts = [*own, one.stopped, *(one.outcomes[name] for name in others)]
        rows.append([one.name, *map(str, counts), f"{one.seconds:.1f}"])
    return aligned(rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the long form; return 1 where something was that must not be."""
    parser = argparse.ArgumentParser(description="One camera of a fleet, many programs at once")
    parser.add_argument("--triggers", type=int, default=10_000, help="calls on each bus")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--program", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.program is not None:
        url, *numbers = options.program
        asyncio.run(run_program(url, *map(int, numbers)))
        return 0
    print(f"seed {options.seed}")  # noqa: T201
    with asyncio.Runner(loop_factory=TimedLoop) as runner:
        done = [runner.run(storm_in_process(options.triggers, options.seed))]
    over_zenoh = storm_over_zenoh(
        options.triggers, options.seed, programs=PROGRAMS, kills=10, stop=LEASE_TIME + 3.0
    )
    done.append(asyncio.run(over_zenoh))
    print(table(done))  # noqa: T201
    violations = [text for one in done for text in one.violations]
    for text in violations[:50]:
        print(f"VIOLATION {text}")  # noqa: T201
    print(f"{len(violations)} violations")  # noqa: T201
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(main())
