"""The fault matrix: each fault at each place of each command, against the emulator on real sockets.

A cell is one fault at one place: a byte of a frame where the link breaks, a frame that comes wrong,
something that happens to the camera before or after it hears a request. Each has a camera of its
own. Its verdict asks six questions:

1. Does the command end with a value, or with an error that is allowed for it and for this fault?
2. Does it end in time: within its own timeout, or at once where the link was ended?
3. Does the client work again by itself, so that a trigger gives a right value?
4. Does its account balance, and agree with what the camera sent?
5. Is nothing left behind: no task, no socket, no report of the event loop?
6. Is every value right: a result its own trigger's, the application and the clock the camera's?

The time is the loop's own, see ``timed_loop.py``; only cells whose camera is a process take real
time.

Long form: ``python -m tests.proofs.fault_matrix`` (all cells, half an hour; fewer with
``--sample 60``, ``--family "udp link"``, ``--only NAME``; prints a table, exit 1 on a failure).
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import logging
import signal
import sys
import time
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Awaitable, Iterable, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import Any

from smartcam import exceptions as e
from tests.proofs.books import TRIGGER_OUTCOMES, LagProbe
from tests.proofs.matrix_camera import device_cells, frame_cells, request_cells
from tests.proofs.matrix_cells import (
    OPS,
    Cell,
    datagram_cells,
    ends_of,
    link_cells,
    ops_of,
    places,
    prepare,
)
from tests.proofs.matrix_process import (
    PROCESS_OPS,
    SIGNALS,
    ProcessCamera,
    process_bench,
    process_cells,
)
from tests.proofs.matrix_world import Bench, BenchBase, World, bench, caring_for_tasks, come_true
from tests.timed_loop import TimedLoop

ALLOWANCE = 0.05
"""Seconds that a wait may take longer than its bound and the loop's lag: this proof's own work."""

HOPS = 3
"""Times that the loop's lag counts in a wait: for its timer, for what the timer wakes, and for the
task that waits for that."""

HANG = 10.0
"""Seconds beyond its bound after which a call hangs."""

RECOVERY = 3.0
"""Seconds until a client with short timeouts works again: twice the sum of those that can run out
one after the other (liveness, three attempts to connect, a trigger)."""

LAG = 0.04
"""Seconds of real time: where the loop was later than this, the short timeouts of a cell (from
0.1 s) may run out of themselves. A cell that fails then is run again, and the table says how many
were."""

RERUNS = 3
"""Times that a cell is run again for that, with few others beside it."""

JOBS, FEW_JOBS = 24, 4
"""Cells at once: they wait more than they work."""

MISLED = tuple(
    one
    for one in TRIGGER_OUTCOMES
    if one not in {e.ConnectionTakenError, e.ConnectionClosedError, e.UnsupportedError}
)
"""Errors that a trigger may end with if its client was told wrong of the camera's state."""

NUMBERED = ("handbook", "thesis", "b16")
TCP = (*(World(d, "tcp", n) for d in NUMBERED for n in (True, False)), World("bid", "tcp", False))
UDP = (*(World(d, "udp", True) for d in NUMBERED), World("bid", "udp", False))
"""Worlds. Over UDP a result without a number is best effort, so there is nothing to prove of it;
``bid`` has no numbers, and there all else is proved."""

ONCE = (TCP[0], TCP[3], TCP[4], TCP[6])
"""Each dialect, some with a number and some without: enough for what has nothing to do with
results."""

AWAY_ONCE = frozenset({TCP[1], TCP[2], TCP[5]})
"""Worlds whose way to another application is taken in another world of the same dialect."""


async def cells() -> list[Cell]:
    """Return every cell, in a fixed order."""
    made: list[Cell] = []
    for world in (*TCP, *UDP):
        for name, op in ops_of(world).items():
            if world.transport == "tcp" and not op.triggers and world not in ONCE:
                continue
            found = await places(world, name)
            link = link_cells if world.transport == "tcp" else datagram_cells
            made += link(world, name, found)
            if name == "visit" or (name == "elsewhere" and world in AWAY_ONCE):
                continue  # the same messages as others have
            for family in (frame_cells, request_cells, device_cells):
                made += family(world, name, found)
    for world in (TCP[0], TCP[2], TCP[4], TCP[6]):
        for name in PROCESS_OPS if SIGNALS else ():
            if name not in ops_of(world):
                continue
            made += process_cells(world, name, await places(world, name))
    return made


def sample(every: Iterable[Cell], stride: int) -> list[Cell]:
    """Return each so manyth cell of every family, the first of each among them."""
    families: dict[str, list[Cell]] = defaultdict(list)
    for cell in every:
        families[cell.family].append(cell)
    return [cell for some in families.values() for cell in some[::stride]]


def is_apart(cell: Cell) -> bool:
    """Return whether a cell's camera is a process, which takes real time."""
    return cell.family.startswith("process")


@dataclass(slots=True)
class Verdict:
    """The outcome of a cell."""

    cell: Cell
    outcome: str = "none"  # of the command: ``value``, or the error's name
    # what must not be; empty where the cell has passed
    wrong: list[str] = field(default_factory=list[str])
    tries: Counter[str] = field(default_factory=Counter)  # errors until the client worked again
    seconds: float = 0.0  # how long the whole cell took
    lag: float = 0.0  # how late the loop was in it at most, seconds
    anew: bool = False  # a status was withheld, and it took a new client to get it
    garbled: int = 0  # values that were told with bytes of other frames in them
    # what was wrong when it ran before, and why it was run again
    before: list[str] = field(default_factory=list[str])
    known: bool = False  # it fails, as it is known to

    @property
    def passed(self) -> bool:
        """True if nothing was wrong."""
        return not self.wrong and not self.known


class Judge:
    """Runs one cell on its bench."""

    def __init__(self, cell: Cell, bench: BenchBase, probe: LagProbe, verdict: Verdict) -> None:
        self.cell, self.fault, self.op = cell, cell.fault, OPS[cell.op]
        self.bench = bench
        self.probe = probe
        self.verdict = verdict
        self._loop = asyncio.get_running_loop()
        self._told = False  # the user was told that the command has failed

    async def run(self) -> None:
        """Do the command with its fault, then look at everything."""
        bench, fault, op = self.bench, self.fault, self.op
        bench.strays, bench.garbled = fault.strays, fault.garbled
        await prepare(bench, op)
        sessions = bench.camera.statistics().sessions
        fault.arm(bench)
        error = await self._command()
        if fault.heal is not None:
            await come_true(lambda: fault.fired(bench))
            fault.heal(bench)
        await bench.mend()
        anew = op.closes or (not op.opened and error is not None)
        if fault.blind and not anew and not await self._works_at_once():
            same = bench.camera.connected and bench.camera.statistics().sessions == sessions
            anew = self.verdict.anew = same  # else a new session has told the status
        await self._recover(anew=anew)
        if fault.lasts:
            await asyncio.sleep(fault.lasts)
            await self._recover(anew=False)
        bench.strays = bench.garbled = False
        await self._prove()
        bench.garbled = fault.garbled
        if isinstance(bench, Bench):
            bench.audit_containers(fault.copies)
        await bench.close()
        bench.demand(fault.fired(bench), "the fault did not happen")

    async def _command(self) -> BaseException | None:
        begun = self._loop.time()
        error = await self._bounded(self.op.run(self.bench), self.op.bound(self.fault.bounds))
        self.verdict.outcome = "value" if error is None else type(error).__name__
        if error is not None:
            self._told = True
            self._allow(error, (*self.fault.allowed, *self.fault.repairs), self._ends())
            if self.fault.at_once is not None:
                self._in_time(begun, self.fault.at_once)
        return error

    def _ends(self, name: str = "") -> tuple[type[BaseException], ...]:
        return ends_of(name or self.cell.op, self.cell.world)

    def _allow(
        self,
        error: BaseException,
        allowed: Sequence[type[BaseException]],
        ends: Sequence[type[BaseException]],
    ) -> None:
        if type(error) not in allowed or type(error) not in ends:
            lines = traceback.format_exception(error)
            self.bench.demand(False, f"ended with {error!r}\n{''.join(lines[-6:])}")

    async def _bounded(self, waiting: Awaitable[object], bound: float) -> BaseException | None:
        """Await something; return its error. It must end in time."""
        begun = self._loop.time()
        task = asyncio.ensure_future(waiting)
        await asyncio.wait({task}, timeout=bound + HANG)
        if not task.done():
            self.bench.demand(False, f"hangs: {task.get_stack()}")
            task.cancel()
            await asyncio.wait({task}, timeout=HANG)
            return e.ConnectionClosedError("hangs")
        self._in_time(begun, bound)
        return task.exception()

    def _in_time(self, begun: float, bound: float) -> None:
        took = self._loop.time() - begun
        most = bound + HOPS * max(self.probe.since(begun)) + ALLOWANCE
        self.bench.demand(took <= most, f"took {took:.3f} s, its bound is {bound:.3f} s")

    async def _works_at_once(self) -> bool:
        try:
            await self._working()
        except e.SmartCamError as error:
            self.verdict.tries[type(error).__name__] += 1
            self._allow(error, MISLED, self._ends("trigger"))
            return False
        return True

    async def _recover(self, *, anew: bool) -> None:
        """Have the client work again, by itself or as the user was told."""
        end = self._loop.time() + RECOVERY
        while anew and self._loop.time() < end:
            try:
                await self.bench.renew()
                break
            except e.SmartCamError as error:
                self.verdict.tries[f"open: {type(error).__name__}"] += 1
                self._allow(error, self.fault.allowed, self._ends("open"))
                await asyncio.sleep(0.01)
        while self._loop.time() < end:
            try:
                await self._working()
            except e.SmartCamError as error:
                self.verdict.tries[type(error).__name__] += 1
                await self._mend(error)
            else:
                return
        camera = self.bench.camera
        self.bench.demand(
            False,
            f"does not work again: {dict(self.verdict.tries)}; {camera.status}; "
            f"{camera.statistics().last_error}",
        )

    async def _working(self) -> None:
        """Trigger, as soon as there is a session."""
        bench = self.bench
        error = await self._bounded(bench.camera.wait_connected(RECOVERY), RECOVERY)
        if error is None:
            error = await self._bounded(bench.trigger(), bench.bounds.trigger)
        if error is not None:
            raise error

    async def _mend(self, error: e.SmartCamError) -> None:
        """Do what a user does who is told so."""
        repairs = self.fault.repairs
        repairs += (e.NotRunningError,) if self.op.stops else ()
        # after a loss the client restores what was wanted by itself
        repairs += self.op.mends if self._told and self.fault.at_once is None else ()
        self._told = True
        if type(error) not in repairs:
            self._allow(error, self.fault.allowed, self._ends("trigger"))
            return
        camera, bench = self.bench.camera, self.bench
        try:
            if isinstance(error, e.NotRunningError):
                await camera.start(timeout=bench.bounds.switch)
            else:
                await camera.switch_application(bench.home)
        except e.SmartCamError as again:
            self.verdict.tries[f"repair: {type(again).__name__}"] += 1

    async def _prove(self) -> None:
        """Everything is as ever: no error, right values, one state on both sides."""
        bench = self.bench
        for check in (bench.trigger, bench.ask_application, bench.ask_clock):
            try:
                await check()
            except e.SmartCamError as error:
                bench.demand(False, f"in the end: {error!r}")


# ---------------------------------------------------------------------- running them


async def run_cell(cell: Cell, probe: LagProbe, process: ProcessCamera | None = None) -> Verdict:
    """Run one cell; with a process, on that camera."""
    verdict = Verdict(cell)
    begun = asyncio.get_running_loop().time()
    home = OPS[cell.op].home
    making: AbstractAsyncContextManager[BenchBase]
    if process is None:
        making = bench(cell.world, cell.fault.bounds, home)
    else:
        making = process_bench(process, cell.fault.bounds, home)
    made: BenchBase | None = None
    try:
        async with making as made:
            await Judge(cell, made, probe, verdict).run()
    except Exception as exc:  # noqa: BLE001 - whatever it is, this cell has failed
        verdict.wrong.append("".join(traceback.format_exception(exc)))
    if made is not None:
        verdict.wrong += made.wrong
        verdict.garbled = made.taken_in
    if cell.fault.known:
        verdict.known = bool(verdict.wrong)
        verdict.wrong = [] if verdict.known else [f"no longer so: {cell.fault.known}"]
    verdict.seconds = asyncio.get_running_loop().time() - begun
    verdict.lag = max(probe.since(begun))
    return verdict


def was_late(verdict: Verdict) -> bool:
    """Return whether short timeouts may have run out; of another process nobody knows it."""
    return verdict.lag > LAG or is_apart(verdict.cell)


class Runner:
    """Runs many cells in one loop."""

    def __init__(self) -> None:
        # what the loop had to report, and what was thrown away unclosed
        self.reports: list[str] = []
        self.worst_lag = 0.0  # seconds

    async def run(self, chosen: Sequence[Cell], jobs: int = JOBS) -> list[Verdict]:
        """Run cells; those that failed while the loop, or their camera, was late, again."""
        probe = LagProbe()
        hook, sys.unraisablehook = sys.unraisablehook, self._on_unraisable
        try:
            with warnings.catch_warnings(), caring_for_tasks() as reports:
                warnings.simplefilter("error", ResourceWarning)
                done = await self._run_all(chosen, probe, jobs)
                for _ in range(RERUNS):
                    again = [n for n, one in enumerate(done) if one.wrong and was_late(one)]
                    verdicts = await self._run_all([chosen[n] for n in again], probe, FEW_JOBS)
                    for number, verdict in zip(again, verdicts, strict=True):
                        verdict.before = [*done[number].before, *done[number].wrong]
                        done[number] = verdict
                gc.collect()  # what was never awaited or closed tells so now
                await asyncio.sleep(0)
        finally:
            sys.unraisablehook = hook
            probe.stop()
        self.reports += reports
        self.worst_lag = max(self.worst_lag, probe.worst)
        return done

    def _on_unraisable(self, what: Any) -> None:
        self.reports.append(f"{what.err_msg or 'unraisable'}: {what.exc_value!r}")

    async def _run_all(self, chosen: Sequence[Cell], probe: LagProbe, jobs: int) -> list[Verdict]:
        places = asyncio.Semaphore(jobs)
        done: dict[int, Verdict] = {}
        chains: dict[object, list[int]] = defaultdict(list)
        for number, cell in enumerate(chosen):
            chains[(cell.family, cell.world) if is_apart(cell) else number].append(number)

        async def alone(number: int) -> None:
            async with places:
                done[number] = await run_cell(chosen[number], probe)

        async def chain(numbers: list[int]) -> None:
            """Run cells of one process, one after the other."""
            async with ProcessCamera(chosen[numbers[0]].world) as process:
                for number in numbers:
                    done[number] = await run_cell(chosen[number], probe, process)

        await asyncio.gather(
            *(
                alone(key) if isinstance(key, int) else chain(numbers)
                for key, numbers in chains.items()
            )
        )
        return [done[number] for number in range(len(chosen))]


# ---------------------------------------------------------------------- telling


def table(done: Iterable[Verdict]) -> str:
    """Return what came of each family."""
    families: dict[str, list[Verdict]] = defaultdict(list)
    for one in done:
        families[one.cell.family].append(one)
    rows = [
        f"{'family':18}{'cells':>7}{'passed':>8}{'known':>7}{'again':>7}{'anew':>6}"
        f"{'garbled':>9}"
        f"{'slowest':>9}  outcomes"
    ]
    for family, some in families.items():
        outcomes = Counter(one.outcome for one in some)
        rows.append(
            f"{family:18}{len(some):7}{sum(one.passed for one in some):8}"
            f"{sum(one.known for one in some):7}"
            f"{sum(bool(one.before) for one in some):7}{sum(one.anew for one in some):6}"
            f"{sum(one.garbled for one in some):9}{max(one.seconds for one in some):8.2f}s  "
            + ", ".join(f"{count} {name}" for name, count in outcomes.most_common())
        )
    return "\n".join(rows)


def failures(done: Iterable[Verdict], most: int) -> str:
    """Return what was wrong, in full for the first ones."""
    rows: list[str] = []
    for number, one in enumerate(one for one in done if one.wrong):
        rows.append(f"FAILED {one.cell.name}: {one.outcome}; {dict(one.tries)}; lag {one.lag:.3f}")
        rows += [f"    {text}" for text in one.wrong] if number < most else []
    return "\n".join(rows)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sample", type=int, default=1, metavar="K", help="every K-th cell")
    parser.add_argument("--family", default="", help="cells whose family begins so")
    parser.add_argument("--world", default="", help="cells whose world's name contains this")
    parser.add_argument("--only", metavar="NAME", help="one cell, with its log")
    parser.add_argument("--jobs", type=int, default=JOBS, help="cells at once")
    parser.add_argument("--show", type=int, default=10, help="failures told in full")
    parser.add_argument("--list", action="store_true", help="print the names and do nothing")
    return parser.parse_args()


async def _chosen(options: argparse.Namespace) -> list[Cell]:
    chosen = [cell for cell in await cells() if cell.family.startswith(options.family)]
    chosen = [cell for cell in chosen if options.world in str(cell.world)]
    chosen = sample(chosen, options.sample)
    return [cell for cell in chosen if options.only in (None, cell.name)]


async def _run_apart(runner: Runner, chosen: Sequence[Cell], jobs: int) -> list[Verdict]:
    me = asyncio.current_task()
    if me is not None and sys.platform != "win32":  # so that cameras that are processes end, too
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, me.cancel)
    return await runner.run(chosen, jobs)


def main() -> int:
    """Run from the command line."""
    options, begun = _arguments(), time.monotonic()
    level = logging.DEBUG if options.only else logging.CRITICAL
    logging.basicConfig(level=level, format="%(relativeCreated)7.0f %(name)s %(message)s")
    runner = Runner()
    with asyncio.Runner(loop_factory=TimedLoop) as timed:
        chosen = timed.run(_chosen(options))
        if options.list or not chosen:
            print("\n".join(cell.name for cell in chosen) or "no such cell")  # noqa: T201
            return 0 if chosen else 2
        together = [cell for cell in chosen if not is_apart(cell)]
        done = timed.run(runner.run(together, options.jobs))
    done += asyncio.run(_run_apart(runner, [*filter(is_apart, chosen)], options.jobs))
    passed, known = sum(one.passed for one in done), sum(one.known for one in done)
    again = [one for one in done if one.before and not one.wrong]
    print(table(done))  # noqa: T201
    for one in again[: options.show]:
        print(f"passed when run again: {one.cell.name}: {one.before[0].splitlines()[0]}")  # noqa: T201
    print(failures(done, options.show))  # noqa: T201
    print("\n".join(f"LOOP: {text}" for text in runner.reports[:20]))  # noqa: T201
    print(  # noqa: T201
        f"{len(done)} cells, {passed} passed, {known} fail as known, "
        f"{len(runner.reports)} reports of the loop; "
        f"{time.monotonic() - begun:.0f} s, the loop was {runner.worst_lag:.3f} s late at most"
    )
    return int(passed + known < len(done) or bool(runner.reports))


if __name__ == "__main__":
    sys.exit(main())
