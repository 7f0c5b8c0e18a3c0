"""The fault matrix and the cancel sweep of the makes: ifm, IV3 and SR, on real sockets.

A cell is one fault in one call: a byte at which the link breaks, falls silent or is changed, an
answer that comes wrong, an operator or another client at any request, a cancellation after any
step of the loop. Each has an emulated camera and a client of its own, and asks:

1. Does the call end with a value or a typed error, within its bound?
2. Is a result its own trigger's, and of the application that it was made under?
3. Does the client work again by itself?
4. Does its account balance?
5. Is nothing left behind: no task, no report of the event loop?

The time is the loop's own, see ``timed_loop.py``.

Long form: ``python -m tests.proofs.makes_matrix`` (every byte, every answer, every step; fewer with
``--stride 7``, ``--make ifm``; prints a table, exit 1 on a failure).
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import logging
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import smartcam
from smartcam.backoff import Backoff
from smartcam.camera import Camera
from smartcam.emulator import LineClient
from smartcam.exceptions import InterpretationError, SmartCamError, WrongApplicationError
from smartcam.makes import EmulatedIfm, EmulatedIv3, EmulatedSr
from smartcam.models import Result
from smartcam.protocols import BVS
from smartcam.testing import proxy
from smartcam.testing.proxy import LinkProxy
from tests.client.clientkit import imbalances, loop_reports
from tests.makes.cameras import IV3_NUMBERS
from tests.timed_loop import TimedLoop

HOME, AWAY = 1, 2
EVALUATION = 0.05
"""Seconds of an evaluation."""

TIMEOUT, PATIENCE = 1.0, 2.0
"""Seconds of a trigger, and of every other wait of a client."""

BOUND = 12.0
"""Seconds after which a call hangs: what it may take, and as much again."""

RECOVERY = 30.0
"""Seconds after which a client that does not work is broken."""

STEP = 0.001
"""Seconds of a step of the loop in a sweep."""

MAX_STEPS = 400
"""Bound of a sweep: the longest call takes about a third of it."""


# ---------------------------------------------------------------------- cameras that know the truth


class Books:
    """Mixed into a camera: of which application each of its runs was, by its number."""

    def __init__(self, **options: Any) -> None:
        self.made: dict[int, int] = {}
        super().__init__(**options)

    def note(self) -> int:
        """Return the number of the run that ends now."""
        number = len(self.made) + 1
        self.made[number] = getattr(self, "active", HOME)
        return number


class Ifm(Books, EmulatedIfm):
    """A sensor whose values are the numbers of its evaluations."""

    def report_evaluation(self, call: LineClient | None, part: Any) -> None:
        super().report_evaluation(call, {"n": self.note()})


class Iv3(Books, EmulatedIv3):
    """A sensor whose first tool's rate is the number of the inspection."""

    def report_evaluation(self, call: LineClient | None, part: Any) -> None:
        super().report_evaluation(call, (self.note(),))


class Sr(Books, EmulatedSr):
    """A reader whose codes are the numbers of its readings."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.codes = (str(self.note()) for _ in itertools.count())  # type: ignore[assignment]


def _ifm(version: int) -> Callable[[], Any]:
    given = {"processing_time": EVALUATION}
    return lambda: Ifm(applications=[HOME, AWAY], defaults=given, version=version)


class Make(NamedTuple):
    """A camera, how a client speaks to it, and the calls that it has."""

    camera: Callable[[], Any]
    query: str
    layout: str
    calls: tuple[str, ...]
    switches: bool = True


IFM_CALLS = ("open", "trigger", "query", "switch", "input", "image", "by hand")
MAKES: dict[str, Make] = {
    "ifm v3": Make(_ifm(3), "dialect=v3", "n: int32", IFM_CALLS),
    "ifm v3 async": Make(_ifm(3), "dialect=v3&trigger=async", "n: int32", IFM_CALLS[:4]),
    "ifm v4": Make(_ifm(4), "dialect=v4", "n: int32", IFM_CALLS),
    "iv3": Make(
        lambda: Iv3(programs=(HOME, AWAY), processing_time=EVALUATION),
        "dialect=lines",
        IV3_NUMBERS,
        ("open", "trigger", "query", "switch", "by hand"),
    ),
    "sr": Make(
        lambda: Sr(reading_time=EVALUATION),
        f"dialect=lines&bank={HOME}",
        "read: bool, n: string[10]",
        ("open", "trigger", "query", "by hand"),
        switches=False,
    ),
}
BY_HAND = {"ifm": "S?", "iv3": "RT", "sr": "ERRSTAT"}


@dataclass
class Bench:
    """A camera, a link and a client, and what was found to be wrong."""

    make: str
    emulator: Any
    proxy: LinkProxy
    garbled: bool = False  # bytes were changed, and no protocol here has a checksum
    strays: bool = False  # results of others come that nothing tells from a trigger's
    wrong: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        made = MAKES[self.make]
        self.camera: Camera[Any] = smartcam.connect(
            f"{self.proxy.url(self.emulator.url)}?{made.query}",
            interpret_as=made.layout,
            reconnect=Backoff(initial=0.005, maximum=0.05, jitter=0),
            connect_timeout=PATIENCE,
            request_timeout=PATIENCE,
            switch_timeout=PATIENCE,
            liveness_timeout=PATIENCE,
            close_timeout=0.5,
        )

    async def renew(self) -> None:
        """Have a new client instead of one that is over."""
        await self.camera.close()
        self.wrong += imbalances(self.camera.statistics())
        self.__post_init__()
        await self.camera.open()

    def demand(self, true: object, text: str) -> None:
        """Note what is wrong unless something is true."""
        if not true:
            self.wrong.append(text)

    async def trigger(self) -> None:
        """Trigger; the result must be this trigger's own, and of its application."""
        before = len(self.emulator.made)
        result = await self.camera.trigger(timeout=TIMEOUT)
        self.look_at(result, before)

    def look_at(self, result: Result[Any], before: int) -> None:
        """Look whether a result is of a run that began since."""
        if self.garbled or result.raw == b"ERROR":
            return
        run = int(result.value.n)
        of = self.emulator.made.get(run)
        self.demand(run > before or self.strays, f"a stale result: run {run} of {before}")
        self.demand(of == result.application, f"told as of {result.application}, it is of {of}")

    async def works(self) -> None:
        """Have the client trigger as if nothing had happened."""
        last: Exception | None = None
        clock = asyncio.get_running_loop().time
        end = clock() + RECOVERY
        while clock() < end:
            try:
                await self.camera.wait_connected(timeout=PATIENCE)
                await self.trigger()
            except WrongApplicationError as exc:
                last = exc
                with contextlib.suppress(SmartCamError):  # as a user who is told of it does
                    await self.camera.switch_application(HOME, timeout=PATIENCE)
            except InterpretationError as exc:
                last = exc
                if self.garbled:  # the layout, which a device keeps for the session
                    await self.renew()
            except SmartCamError as exc:
                last = exc
                await asyncio.sleep(0.05)
            else:
                return
        self.wrong.append(f"does not work again: {last!r}")


async def _open(bench: Bench) -> None:
    await bench.camera.open()


async def _query(bench: Bench) -> None:
    active = await bench.camera.query_application()
    right = {HOME, AWAY} if MAKES[bench.make].switches else {HOME}
    bench.demand(active in right or bench.garbled, f"application {active}")


async def _switch(bench: Bench) -> None:
    await bench.camera.switch_application(AWAY, timeout=PATIENCE)
    bench.demand(bench.emulator.active == AWAY or bench.garbled or bench.strays, "not switched")


async def _image(bench: Bench) -> None:
    picture = await bench.camera.read_image()
    bench.demand(picture or bench.garbled, "an empty picture")


async def _by_hand(bench: Bench) -> None:
    assert await bench.camera.request(BY_HAND[bench.make.split()[0]]) is not None


CALLS: dict[str, Callable[[Bench], Awaitable[object]]] = {
    "open": _open,
    "trigger": Bench.trigger,
    "query": _query,
    "switch": _switch,
    "input": lambda bench: bench.camera.set_input(b"bolt"),
    "image": _image,
    "by hand": _by_hand,
}


@contextlib.asynccontextmanager
async def bench_of(make: str) -> AsyncIterator[Bench]:
    """Put up a bench whose client is not open."""
    async with MAKES[make].camera() as emulator, LinkProxy(emulator.host, emulator.port) as link:
        bench = Bench(make, emulator, link)
        try:
            yield bench
        finally:
            await bench.camera.close()
            bench.wrong += imbalances(bench.camera.statistics())


# ---------------------------------------------------------------------- cells


class Cell(NamedTuple):
    """One fault in one call."""

    make: str
    call: str
    fault: str
    arm: Callable[[Bench], object]
    steps: int = 0  # after which the call is cancelled, 0 for never
    happens: Callable[[Bench], object] | None = None  # while the call is under way

    @property
    def name(self) -> str:
        """Name for people."""
        return f"{self.make}, {self.call}: {self.fault}"


def _with_rule(rule: proxy.Rule, *, garbles: bool = False) -> Callable[[Bench], None]:
    def arm(bench: Bench) -> None:
        bench.garbled = bench.garbled or garbles
        bench.proxy.from_now(rule)

    return arm


LINKS: dict[str, Callable[[Any, int], tuple[proxy.Rule, bool]]] = {
    "cut": lambda way, at: (proxy.Cut(direction=way, at=at), False),
    "reset": lambda way, at: (proxy.ResetConnection(direction=way, at=at), False),
    "silent": lambda way, at: (proxy.Stall(direction=way, at=at, both=True), False),
    "split": lambda way, at: (proxy.SplitBytes(direction=way, at=at, pause=0.01), False),
    "flip": lambda way, at: (proxy.Flip(direction=way, at=at, mask=1), True),
    "lost byte": lambda way, at: (proxy.DropBytes(direction=way, at=at), True),
    "twice": lambda way, at: (proxy.DuplicateBytes(direction=way, at=at), True),
}
FRAMES: dict[str, dict[str, Any]] = {
    "drop": {},
    "duplicate": {},
    "delay": {"seconds": 0.3},
    "truncate": {"keep": 3},
    "reset": {},
    "close": {},
    "half_open": {},
}


async def link_cells(make: str, call: str) -> list[Cell]:
    """Return what may happen to each byte of a call, in both directions."""
    async with bench_of(make) as bench:
        if call != "open":
            await bench.camera.open()
        before = bench.camera.statistics()
        await CALLS[call](bench)
        after = bench.camera.statistics()
    up, down = after.bytes_sent - before.bytes_sent, after.bytes_received - before.bytes_received
    return [
        Cell(make, call, f"{fault} {way} {at}", _with_rule(rule, garbles=garbles))
        for way, size in (("up", up), ("down", down))
        for at in range(min(size, 400))
        for fault, one in LINKS.items()
        for rule, garbles in [one(way, at)]
    ]


def frame_cells(make: str, call: str) -> Iterator[Cell]:
    """Give each fault of each kind of answer."""
    dialect = next(iter(MAKES[make].camera().protocol.dialects.values()))
    known = {row.type.__name__ for one in BVS.dialects.values() for row in one.table}
    answers = known & {row.answer.__name__ for row in dialect.rows if row.answer}
    for kind, (fault, given) in itertools.product(sorted(answers), FRAMES.items()):
        what = {"kind": fault, "on": kind, **given}

        def arm(bench: Bench, what: dict[str, Any] = what) -> None:
            bench.strays = bench.strays or what["kind"] == "duplicate"
            bench.emulator.inject(what)

        yield Cell(make, call, f"{fault} {kind}", arm)


async def _others(bench: Bench, what: str, after: float) -> None:
    """Do something at the camera while the call is under way."""
    await asyncio.sleep(after)
    device = bench.emulator.device
    if what == "switch":
        device.switch_application(AWAY)
    elif what == "there and back":
        device.switch_application(AWAY)
        await asyncio.sleep(EVALUATION / 5)
        device.switch_application(HOME)
    elif what == "restart":
        await bench.emulator.stop()
        await bench.emulator.start()
    else:
        bench.strays = bench.make == "sr" or "async" in bench.make  # documented
        device.trigger()


TIMES = (0.0, 0.0005, 0.001, 0.002, 0.01, 0.04, 0.05, 0.051, 0.06)
"""Seconds at which somebody else does something: around the call's own steps."""


def others_cells(make: str, call: str) -> Iterator[Cell]:
    """Give what others do at the camera meanwhile."""
    switches = ("switch", "there and back") if MAKES[make].switches else ()
    for what, at in itertools.product((*switches, "trigger", "restart"), TIMES):
        if call != "open" or what != "restart":
            happens = lambda b, what=what, at=at: _others(b, what, at)  # noqa: E731
            yield Cell(make, call, f"{what} after {at} s", lambda _: None, happens=happens)


def cancel_cells(make: str, call: str) -> Iterator[Cell]:
    """Give a cancellation after each step of the loop."""
    for steps in range(1, MAX_STEPS):
        yield Cell(make, call, f"cancelled after {steps} steps", lambda _: None, steps=steps)


async def judge(cell: Cell) -> tuple[str, list[str]]:
    """Return how the call of a cell ended, and what is wrong."""
    everyone = asyncio.all_tasks()
    with loop_reports() as reports:
        async with bench_of(cell.make) as bench:
            end = await _run(cell, bench)
            if end != "over":
                await asyncio.wait_for(bench.works(), 2 * RECOVERY)
        for _ in range(3):
            await asyncio.sleep(1.1)  # what a proxy leaves of a cut connection lingers for 1 s
        left = [task.get_name() for task in asyncio.all_tasks() - everyone if not task.done()]
    bench.demand(not left, f"tasks were left: {left}")
    return end, [*bench.wrong, *reports]


async def _run(cell: Cell, bench: Bench) -> str:
    if cell.call != "open":
        await bench.camera.open()
        cell.arm(bench)
    else:
        with contextlib.suppress(SmartCamError):
            cell.arm(bench)
    call = asyncio.ensure_future(_as_task(CALLS[cell.call](bench)))
    other = None if cell.happens is None else asyncio.ensure_future(_as_task(cell.happens(bench)))
    try:
        if cell.steps:
            for _ in range(cell.steps):
                await asyncio.sleep(0)
                if call.done():
                    break
            else:
                call.cancel()
        async with asyncio.timeout(BOUND):
            await call
    except SmartCamError as exc:
        end = type(exc).__name__
    except asyncio.CancelledError:
        end = "cancelled"
    except TimeoutError:
        end = "hangs"
        bench.wrong.append(f"hangs for {BOUND} s")
    else:
        end = "value" if not cell.steps else "over"
    if other is not None:
        await other
    if cell.call == "open" and not bench.camera.connected:
        await bench.renew()
    return end


async def _as_task(what: Any) -> None:
    await what


async def cells(makes: Iterable[str] = MAKES) -> list[Cell]:
    """Return all cells but the cancellations."""
    found: list[Cell] = []
    for make in makes:
        for call in MAKES[make].calls:
            if call != "open":  # whose bytes are those of a connection that is not there yet
                found += await link_cells(make, call)
            found += [*frame_cells(make, call), *others_cells(make, call)]
    return found


class Tally:
    """Outcomes of cells, and the faults found in them."""

    def __init__(self) -> None:
        self.ends: Counter[tuple[str, str]] = Counter()
        self.failures: list[str] = []

    def add(self, cell: Cell, end: str, wrong: list[str]) -> None:
        self.ends[cell.make, end] += 1
        self.failures += [f"{cell.name}: {one}" for one in wrong]

    @property
    def table(self) -> str:
        rows = [f"{make:14} {end:24} {count}" for (make, end), count in sorted(self.ends.items())]
        return "\n".join([*rows, f"{sum(self.ends.values())} cells"])


def run(which: Iterable[Cell], tally: Tally, turn: float = 2e-5) -> None:
    """Judge cells, each in a loop of its own."""
    for cell in which:
        with asyncio.Runner(loop_factory=lambda: TimedLoop(turn)) as runner:
            try:
                end, wrong = runner.run(judge(cell))
            except Exception as exc:  # noqa: BLE001 - a cell that breaks is a failure, too
                end, wrong = "broken", [repr(exc)]
        tally.add(cell, end, wrong)


def sweep(make: str, call: str, stride: int, tally: Tally) -> None:
    """Cancel a call after every ``stride`` steps until it is over."""
    for cell in itertools.islice(cancel_cells(make, call), 0, None, stride):
        before = tally.ends[make, "over"]
        run([cell], tally, turn=STEP)
        if tally.ends[make, "over"] > before:
            return


def main() -> int:
    """Run all of it; return 1 where anything is wrong."""
    logging.disable(logging.CRITICAL)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stride", type=int, default=1, help="one of so many cells")
    parser.add_argument("--make", default="", help="only makes whose names begin so")
    given = parser.parse_args()
    makes = [one for one in MAKES if one.startswith(given.make)]
    tally, begun = Tally(), time.monotonic()
    with asyncio.Runner(loop_factory=TimedLoop) as runner:
        found = runner.run(cells(makes))
    run(found[:: given.stride], tally)
    for make in makes:
        for call in MAKES[make].calls:
            sweep(make, call, given.stride, tally)
    failures = "\n".join(tally.failures[:200])
    print(f"{tally.table}, {time.monotonic() - begun:.0f} s\n{failures}")  # noqa: T201
    print(f"{len(tally.failures)} failures")  # noqa: T201
    return bool(tally.failures)


if __name__ == "__main__":
    sys.exit(main())
