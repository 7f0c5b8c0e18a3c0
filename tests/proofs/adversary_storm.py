"""Storm of an adversary: whatever we, a sensor and an operator do, a result is the trigger's own.

A camera at the end of a line (``line_camera.py``: it does what ``docs/promises.md`` assumes, and
uses all freedom that this leaves) and callers who trigger it, one or several side by side. Chance
decides how long the line is, how many results a run sends, in which order and how late; who gives
up, by timeout or cancelled, most often right behind the sending; when a sensor triggers, around our
trigger's sending and arrival and in runs that count up to our next number; when an operator stops,
starts and loads; when a client ends and the next one begins, and when the link is lost.

The camera knows whose each container is, and when its run began. Of each result it is asked whether
it is of the Trigger message that the call sent. Where a sensor triggers and no wide number tells,
it may be of the sensor's instead, if that run began when the message had been sent.

Long form: ``python tests/proofs/adversary_storm.py --triggers 5000 --seed 1`` (per variant; prints
a table, exit 1 on a violation).
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, Literal

if __name__ == "__main__":  # the camera is the tests', too
    sys.path.append(str(Path(__file__).parent.parent))

from line_camera import AGAIN, APPLICATIONS, LAYOUTS, NUMBER, RESULT, SENSOR, TRIGGER, LineCamera
from trigger_ear import TriggerEar

import smartcam
from smartcam import exceptions

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Sequence

    from line_camera import Run, Step

    from smartcam.client import SmartCamera
    from smartcam.models import Result, Statistics

SLOWEST = 20.0
"""Times these, where the machine has other things to do."""

HANG = 20.0
"""Seconds after which a call hangs, whose own bound is a few."""

OUTCOMES: tuple[type[exceptions.SmartCamError], ...] = (
    exceptions.OvertriggeredError,
    exceptions.NotRunningError,
    exceptions.CameraBusyError,
    exceptions.CameraFaultError,
    exceptions.InputContainerError,
    exceptions.TriggerTimeoutError,
    exceptions.WrongApplicationError,
    exceptions.InterpretationError,
    exceptions.CommandRejectedError,
    exceptions.UnsupportedError,
    exceptions.ConnectionLostError,
    exceptions.ConnectionTakenError,
    exceptions.ConnectionClosedError,
)
"""What a trigger may end with beside a result; the list is closed."""

INSPECTION = 0.002
"""Seconds that a run takes, more or less."""

MOST_RUNS = 1_100
"""Runs of a sensor between two triggers."""

BITS = {"": 0, "int32": 32, "int16": 16, "int8": 8}
FAST = smartcam.Backoff(initial=0.001, factor=2, maximum=0.01, jitter=0.0)

Rule = Literal["own", "fresh", "count"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """One kind of storm.

    Attributes:
        name: in the table.
        rule: what a result must be: of the call's own trigger (``own``); that, or of a sensor's run
            that began when it had been sent (``fresh``); anything, and it is counted (``count``).
        share: of the calls that it gets: some take their time.
        number: type of the layout's number, empty for none.
        line: shortest and longest delay each way, seconds.
        results: fewest and most that a run sends.
        wanted: asked for per trigger.
        sensor, operator: they are there.
        lives: clients end, and the next one begins at once.
        drops: the camera drops the link now and then.
        callers: side by side.
        mixed: some numbers are set by hand, and some triggers are without number.
        lost, doubled, held: share of the datagrams.
    """

    name: str
    rule: Rule = "own"
    share: float = 1.0
    dialect: str = "handbook"
    transport: Literal["tcp", "udp"] = "tcp"
    number: Literal["", "int32", "int16", "int8"] = ""
    line: tuple[float, float] = (0.0, 0.01)
    results: tuple[int, int] = (1, 1)
    wanted: int | None = None
    sensor: bool = False
    operator: bool = False
    lives: bool = False
    drops: bool = False
    callers: int = 1
    mixed: bool = False
    lost: float = 0.0
    doubled: float = 0.0
    held: float = 0.0

    @property
    def ours(self) -> bool:
        """Nobody else does anything to the camera, and nothing that it says is lost."""
        return self.transport == "tcp" and not self.sensor and not self.operator


SHORT_LINE = (0.0, 0.003)
LONG_LINE = (0.008, 0.01)
SEVERAL = (1, 3)

VARIANTS = (
    Variant(name="tcp"),
    Variant(name="tcp several results", results=SEVERAL),
    Variant(name="tcp several results, short line", results=SEVERAL, line=SHORT_LINE),
    Variant(name="tcp several results, long line", results=SEVERAL, line=LONG_LINE, share=0.5),
    Variant(name="tcp several results, no line", results=SEVERAL, line=(0.0, 0.0)),
    Variant(name="tcp several results thesis", results=SEVERAL, dialect="thesis"),
    Variant(name="tcp several results b16", results=SEVERAL, dialect="b16"),
    Variant(name="tcp two results wanted", results=(2, 2), wanted=2),
    Variant(name="tcp callers", results=SEVERAL, callers=3),
    Variant(name="tcp lives", results=SEVERAL, lives=True),
    Variant(name="tcp lives, drops", results=SEVERAL, lives=True, drops=True, callers=2),
    Variant(name="tcp operator", results=SEVERAL, operator=True),
    Variant(name="tcp sensor", rule="fresh", sensor=True),
    Variant(name="tcp sensor, short line", rule="fresh", sensor=True, line=SHORT_LINE),
    Variant(name="tcp sensor, long line", rule="fresh", sensor=True, line=LONG_LINE, share=0.5),
    Variant(name="tcp sensor, several", rule="fresh", sensor=True, results=SEVERAL),
    Variant(name="tcp sensor thesis", rule="fresh", sensor=True, results=SEVERAL, dialect="thesis"),
    Variant(name="tcp sensor b16", rule="fresh", sensor=True, results=SEVERAL, dialect="b16"),
    Variant(name="tcp sensor, two wanted", rule="fresh", sensor=True, results=(2, 2), wanted=2),
    Variant(
        name="tcp everything",
        rule="fresh",
        results=SEVERAL,
        sensor=True,
        operator=True,
        lives=True,
        drops=True,
        callers=3,
    ),
    Variant(name="tcp number", number="int32", results=SEVERAL),
    Variant(name="tcp number, two wanted", number="int32", results=(2, 3), wanted=2),
    Variant(name="tcp number mixed", number="int32", results=SEVERAL, mixed=True),
    Variant(name="tcp number, sensor", number="int32", results=SEVERAL, sensor=True),
    Variant(
        name="tcp number, everything b16",
        number="int32",
        dialect="b16",
        results=SEVERAL,
        sensor=True,
        operator=True,
        lives=True,
        drops=True,
        callers=3,
    ),
    Variant(name="tcp int16", number="int16", results=SEVERAL),
    Variant(name="tcp int8", number="int8", results=SEVERAL),
    Variant(name="tcp int16, sensor", rule="fresh", number="int16", results=SEVERAL, sensor=True),
    Variant(name="tcp int8, sensor", rule="fresh", number="int8", results=SEVERAL, sensor=True),
    Variant(name="tcp bid", dialect="bid", share=0.5, results=SEVERAL),
    Variant(name="tcp bid, lives", dialect="bid", share=0.5, results=SEVERAL, lives=True),
    Variant(
        name="tcp bid, sensor",
        rule="fresh",
        dialect="bid",
        share=0.5,
        results=SEVERAL,
        sensor=True,
    ),
    Variant(
        name="udp number",
        share=0.4,
        transport="udp",
        number="int32",
        results=SEVERAL,
        lost=0.03,
        doubled=0.1,
        held=0.2,
    ),
    Variant(
        name="udp number, two wanted",
        transport="udp",
        number="int32",
        results=(2, 2),
        wanted=2,
        doubled=0.1,
        held=0.2,
    ),
    Variant(  # number and Trigger are two datagrams: a sensor's run between them has our number
        name="udp number, sensor",
        rule="fresh",
        transport="udp",
        number="int32",
        sensor=True,
        results=SEVERAL,
        doubled=0.1,
        held=0.2,
    ),
    Variant(name="best effort: udp", rule="count", transport="udp", results=SEVERAL),
    Variant(name="best effort: udp, sensor", rule="count", transport="udp", sensor=True, held=0.1),
    Variant(name="best effort: udp bid", rule="count", transport="udp", dialect="bid", share=0.5),
)


@dataclass(slots=True)
class Figures:
    """What came of a storm.

    Attributes:
        outcomes: of the calls: ``result``, ``cancelled``, or the error's name.
        own: results that are of the call's own trigger.
        fresh: of a sensor's run that began when the trigger had been sent.
        stale: of a sensor's run that was begun before.
        others: of another trigger of ours.
        longest: of wrong results in a row.
        fenced: times the client stopped the application for a trigger.
        queries: that the client sent.
        violations: what must not be, in words.
    """

    variant: Variant
    calls: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    own: int = 0
    fresh: int = 0
    stale: int = 0
    others: int = 0
    longest: int = 0
    in_a_row: int = 0
    sent: int = 0
    overtriggers: int = 0
    fenced: int = 0
    queries: int = 0
    late: int = 0
    extra: int = 0
    lives: int = 0
    sessions: int = 0
    violations: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def wrong(self) -> int:
        """Results that no rule allows."""
        return self.stale + self.others

    def demand(self, true: object, text: str) -> None:
        """Note a violation unless something is true."""
        if not true:
            self.violations.append(f"{self.variant.name}: {text}")


class Storm:
    """Does everything to a camera that may be done.

    Args:
        variant: which kind.
        chance: decides.
    """

    def __init__(self, variant: Variant, chance: Random) -> None:
        self.variant = variant
        self.figures = Figures(variant)
        self.camera = LineCamera(
            dialect=variant.dialect, transport=variant.transport, delay=self._delay
        )
        self.ear = TriggerEar()
        self._chance = chance
        self._scale = 1.0
        self._doomed: set[asyncio.Task[Any]] = set()  # to be cancelled at their sending
        self._taken: set[tuple[int, int]] = set()  # containers that were some call's result
        self._numbers = (0, 0)  # of our last two triggers
        self._by_hand = 7
        self._others: set[asyncio.Task[None]] = set()  # what others do to the camera
        self._ended = asyncio.Event()
        self.camera.plan = self._plan
        self.camera.before = self._before
        self.camera.between = self._between
        self.camera.network = self._network
        self.ear.at_trigger = self._at_trigger

    async def run(self, calls: int) -> Figures:
        """Have so many calls made, by one client or by many."""
        figures, begun = self.figures, time.perf_counter()
        async with self.camera:
            while figures.calls < calls:
                left = calls - figures.calls
                await self._live(min(left, self._chance.choice((1, 1, 1, 2, 4, 10))), calls)
            await self._calm()
        figures.seconds = time.perf_counter() - begun
        figures.sent = self.camera.sent.total()
        figures.overtriggers = self.camera.overtriggers
        figures.fenced = self.ear.said["Stop"]
        figures.queries = self.ear.said["Query"]
        if self.variant.ours:
            text = f"ours dropped each other {figures.overtriggers} times"
            figures.demand(not figures.overtriggers, text)
        return figures

    # ------------------------------------------------------------------ what chance decides

    def _happens(self, share: float) -> bool:
        return self._chance.random() < share

    def _delay(self) -> float:
        return self._chance.uniform(*self.variant.line)

    @property
    def _way(self) -> float:
        """Seconds from a trigger to its result, about."""
        return self._scale * (sum(self.variant.line) + INSPECTION)

    def _plan(self, _: Run) -> Sequence[Step]:
        """Say results and Waiting for Trigger in any order, together or apart."""
        chance = self._chance
        said = list(range(chance.randint(*self.variant.results)))
        waiting = len(said) if self.variant.dialect == "bid" else chance.randint(0, len(said))
        said.insert(waiting, AGAIN)
        steps: list[Step] = [(INSPECTION * chance.uniform(0.1, 1.9), said[0])]
        for what in said[1:]:
            longest = self.variant.line[1] * chance.choice((1, 1, 5)) + 0.001
            steps.append((chance.uniform(0, longest) if self._happens(0.6) else 0.0, what))
        return steps

    def _before(self, _: int, number: int | None) -> None:
        if number is not None:
            self._numbers = (self._numbers[1], number)

    def _between(self, _: int, __: int | None) -> None:
        """Have a whole run of a sensor between a Query and the Trigger behind it."""
        if self.variant.sensor and self._happens(0.05) and self.camera.takes_trigger:
            self.camera.sensor_runs(1)

    def _network(self, message_id: int) -> Sequence[float]:
        variant = self.variant
        if variant.transport == "tcp":
            return (0.0,)
        if message_id in {RESULT, -NUMBER, -TRIGGER} and self._happens(variant.lost):
            return ()
        if message_id != RESULT:
            return (0.0,)
        copies = 2 if self._happens(variant.doubled) else 1
        held = self._happens(variant.held)
        return [self._chance.uniform(0, 0.01) if held or copy else 0.0 for copy in range(copies)]

    def _at_trigger(self, task: asyncio.Task[Any]) -> None:
        """Have it given up, and a sensor trigger, around its sending and its arrival."""
        loop = asyncio.get_running_loop()
        if task in self._doomed:
            when = self._chance.choice((0.0, 0.0, self._chance.uniform(0, self._way)))
            loop.call_later(when, task.cancel)
        if self.variant.sensor and self._happens(0.3):
            self._other(self._trigger_soon(self._chance.uniform(0, 2.2 * self.variant.line[1])))

    # ------------------------------------------------------------------ what others do

    def _other(self, doing: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(doing)
        self._others.add(task)
        task.add_done_callback(self._others.discard)

    async def _trigger_soon(self, seconds: float) -> None:
        await asyncio.sleep(seconds)
        self.camera.sensor()

    async def _operate(self) -> None:
        camera, pause = self.camera, self._way
        await asyncio.sleep(self._chance.uniform(0, pause))
        camera.stop()
        await asyncio.sleep(self._chance.uniform(0, pause))
        if self._happens(0.4):
            camera.load(self._chance.choice(APPLICATIONS))
            await asyncio.sleep(2 * pause)
        camera.start()

    async def _drop(self) -> None:
        await asyncio.sleep(self._chance.uniform(0, self._way))
        self.camera.drop_link()

    def _unrest(self) -> None:
        """Do something to the camera right before a call, perhaps."""
        variant = self.variant
        if variant.sensor and self._happens(0.1):
            self.camera.sensor()
        if variant.sensor and variant.number and self._happens(0.04):
            self._race()
        if variant.operator and not self._others and self._happens(0.1):
            self._other(self._operate())
        if variant.drops and self._happens(0.03):
            self._other(self._drop())

    def _race(self) -> None:
        """Have a sensor trigger until its last run carries our next number, or almost that."""
        before, last = self._numbers
        rounds = 1 << BITS[self.variant.number]
        runs = (2 * last - before - self.camera.next_number + 1) % rounds
        runs += self._chance.choice((-1, 0, 0, 1))
        if 0 < runs <= MOST_RUNS and self.camera.takes_trigger:
            self.camera.sensor_runs(runs)

    async def _calm(self) -> None:
        """Have nobody do anything more."""
        while self._others:
            await asyncio.wait(self._others)

    # ------------------------------------------------------------------ clients

    async def _live(self, calls: int, all_calls: int) -> None:
        """Be a client for some calls; for all that are left where clients do not come and go."""
        figures, variant = self.figures, self.variant
        last = not variant.lives or figures.calls + calls >= all_calls
        until = all_calls if last else figures.calls + calls
        figures.lives += 1
        first_session = self.ear.session + 1
        drops = variant.drops
        async with contextlib.AsyncExitStack() as stack:
            client = smartcam.connect(
                self.camera.url,
                interpret_as=LAYOUTS[variant.number],
                observers=[self.ear],
                reconnect=FAST if drops else None,
            )
            try:
                await stack.enter_async_context(client)
            except exceptions.SmartCamError as error:
                figures.demand(drops, f"no session: {error!r}")
                figures.calls += 1
                return
            self._ended = asyncio.Event()
            await asyncio.gather(*(self._caller(client, until) for _ in range(variant.callers)))
            if last:
                await self._hear_the_rest(client)
            account = client.statistics()
        figures.sessions += account.sessions
        self._audit(account, heard=last and not drops, first_session=first_session)

    async def _caller(self, client: SmartCamera, until: int) -> None:
        while self.figures.calls < until and not self._ended.is_set():
            self.figures.calls += 1
            await self._call(client)
            if self._happens(0.4):  # what is on the line comes before the next one goes out
                await asyncio.sleep(self._chance.uniform(0, self._way))

    async def _call(self, client: SmartCamera) -> None:
        self._unrest()
        chance, variant = self._chance, self.variant
        patient = min(5.0, 0.5 + 40 * self._way)
        manners = ("patient", "hasty", "cancelled", "at sending")
        (manner,) = chance.choices(manners, (5, 3, 1, 3))
        options: dict[str, Any] = {"timeout": patient}
        if manner == "hasty":
            options["timeout"] = self._way * chance.uniform(0.2, 1.5)
        if variant.wanted is not None:
            options["results_per_trigger"] = variant.wanted
        if variant.mixed and self._happens(0.3):
            options["interpret_as"] = LAYOUTS[""]
        if variant.mixed and self._happens(0.2):
            self._by_hand += 10_000
            await client.set_sequence_number(self._by_hand)
        task: asyncio.Task[Any] = asyncio.create_task(client.trigger(**options))
        handle = None
        if manner == "at sending":
            self._doomed.add(task)
        elif manner == "cancelled":
            when = chance.uniform(0, 1.3 * self._way)
            handle = asyncio.get_running_loop().call_later(when, task.cancel)
        await asyncio.wait({task}, timeout=HANG)
        if handle is not None:
            handle.cancel()
        self._doomed.discard(task)
        outcome = self._judge(task)
        self.figures.outcomes[outcome] += 1
        if manner == "hasty":
            change = {"result": 0.9, "TriggerTimeoutError": 1.1}.get(outcome, 1.0)
            self._scale = min(SLOWEST, max(1.0, self._scale * change))
        await self._come_back(client, task, outcome)

    async def _come_back(self, client: SmartCamera, task: asyncio.Task[Any], outcome: str) -> None:
        """Do what somebody does who wants to go on."""
        if outcome == "hangs":
            task.cancel()
            await asyncio.wait({task}, timeout=HANG)
        elif outcome == "NotRunningError":
            await asyncio.sleep(self._way)
            if not self._others and not self.camera.is_running:
                self.camera.start()  # a client that ended has left it so
        elif outcome in {"ConnectionTakenError", "ConnectionClosedError"}:
            self._ended.set()
        elif outcome == "ConnectionLostError":
            try:
                await client.wait_connected(HANG)
            except exceptions.LinkError:
                self._ended.set()

    # ------------------------------------------------------------------ the judge

    def _judge(self, task: asyncio.Task[Any]) -> str:
        """Return the outcome's name; look whose the results are."""
        figures, call = self.figures, self.figures.calls
        sendings = self.ear.sendings.pop(task, [])
        if self.variant.dialect != "bid":  # there one is sent again where the camera was busy
            figures.demand(len(sendings) <= 1, f"call {call} sent {len(sendings)} triggers")
        figures.demand(task.done(), f"call {call} hangs")
        if not task.done():
            return "hangs"
        if task.cancelled():
            return "cancelled"
        error = task.exception()
        if error is not None:
            figures.demand(isinstance(error, OUTCOMES), f"call {call} ended with {error!r}")
            return type(error).__name__
        figures.demand(sendings, f"call {call} has a result and sent no trigger")
        results = task.result()
        if isinstance(results, list):
            wanted, got = self.variant.wanted, len(results)
            figures.demand(got == wanted, f"call {call}: {got} of {wanted} results")
        else:
            results = [results]
        same = len({one.value.run for one in results}) == 1
        figures.demand(same or self.variant.rule == "count", f"call {call}: results of two runs")
        wrong = [not self._is_right(one, call, sendings[-1:]) for one in results]
        figures.in_a_row = figures.in_a_row + 1 if any(wrong) else 0
        figures.longest = max(figures.longest, figures.in_a_row)
        return "result"

    def _is_right(self, result: Result, call: int, sendings: Sequence[Any]) -> bool:
        figures, rule = self.figures, self.variant.rule
        run = self.camera.runs[result.value.run]
        container = (run.index, result.value.part)
        if rule != "count":
            text = f"call {call}: part {container[1]} of run {run.index} for the second time"
            figures.demand(container not in self._taken, text)
        self._taken.add(container)
        (sending,) = sendings
        if (run.session, run.trigger) == (sending.session, sending.trigger):
            figures.own += 1
            return True
        age = sending.at - run.began
        if run.trigger == SENSOR and age <= 0:
            figures.fresh += 1
            text = f"a sensor's, begun {-1000 * age:.1f} ms after ours was sent"
            figures.demand(rule in {"fresh", "count"}, f"call {call}: {text}")
            return rule != "own"
        if run.trigger == SENSOR:
            figures.stale += 1
            text = f"a sensor's, begun {1000 * age:.1f} ms before ours was sent"
        else:
            figures.others += 1
            text = f"of trigger {run.trigger} of session {run.session}"
        mine = f"trigger {sending.trigger} of session {sending.session}"
        figures.demand(rule == "count", f"call {call}, {mine}: a result {text}")
        return False

    async def _hear_the_rest(self, client: SmartCamera) -> None:
        """Have every container that was sent."""
        await self._calm()
        while not self.camera.idle:  # noqa: ASYNC110 - it is a matter of the line, too
            await asyncio.sleep(INSPECTION)
        with contextlib.suppress(exceptions.LinkError):
            await client.query_application()

    def _audit(self, got: Statistics, *, heard: bool, first_session: int) -> None:
        figures, camera = self.figures, self.camera
        figures.late += got.late
        figures.extra += got.extra_results
        fates = got.triggered + got.streamed + got.late + got.unclaimed
        fates += got.wrong_application + got.uninterpretable
        figures.demand(got.received == fates, f"the fates do not add up: {got}")
        figures.demand(got.uninterpretable == 0, f"odd fates: {got}")
        sent = sum(camera.sent[one] for one in range(first_session, camera.sessions + 1))
        exact = heard and self.variant.transport == "tcp"
        if exact:
            text = f"{sent} containers sent, {got.received} received"
            figures.demand(got.received == sent, text)
        elif self.variant.transport == "tcp":
            figures.demand(got.received <= sent, f"{sent} containers sent, {got.received} received")


async def storm(variant: Variant, calls: int, seed: int) -> Figures:
    """Run one variant."""
    chance = Random(f"{seed} {variant.name}")  # noqa: S311
    return await Storm(variant, chance).run(max(1, round(calls * variant.share)))


async def storms(
    variants: Iterable[Variant], calls: int, seed: int, *, at_once: int
) -> list[Figures]:
    """Run variants, a few at once; what the loop has to report is a violation of the first."""
    places = asyncio.Semaphore(at_once)
    reports: list[str] = []

    async def run(variant: Variant) -> Figures:
        async with places:
            return await storm(variant, calls, seed)

    loop = asyncio.get_running_loop()
    handler = loop.get_exception_handler()
    loop.set_exception_handler(lambda _, context: reports.append(str(context)))
    try:
        done = await asyncio.gather(*(run(variant) for variant in variants))
    finally:
        loop.set_exception_handler(handler)
    done[0].violations += reports
    return done


# ---------------------------------------------------------------------- the table

COMMON = ("result", "TriggerTimeoutError", "cancelled", "OvertriggeredError")

COLUMNS: dict[str, Callable[[Figures], object]] = {
    "calls": lambda one: one.calls,
    "results": lambda one: one.outcomes["result"],
    "timeouts": lambda one: one.outcomes["TriggerTimeoutError"],
    "cancelled": lambda one: one.outcomes["cancelled"],
    "overtrig": lambda one: one.outcomes["OvertriggeredError"],
    "other": lambda one: one.outcomes.total() - sum(one.outcomes[name] for name in COMMON),
    "sent": lambda one: one.sent,
    "late": lambda one: one.late,
    "extra": lambda one: one.extra,
    "clients": lambda one: one.lives,
    "sessions": lambda one: one.sessions,
    "stops": lambda one: one.fenced,
    "queries": lambda one: one.queries,
    "dropped": lambda one: one.overtriggers,
    "fresh": lambda one: one.fresh,
    "stale": lambda one: one.stale,
    "another's": lambda one: one.others,
    "in a row": lambda one: one.longest,
    "seconds": lambda one: f"{one.seconds:.1f}",
}


def table(done: Sequence[Figures]) -> str:
    """Return the figures as text."""
    rows = [["variant", *COLUMNS]]
    rows += [[one.variant.name, *(str(of(one)) for of in COLUMNS.values())] for one in done]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for cells in rows:
        first = cells[0].ljust(widths[0])
        rest = (cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True))
        lines.append("  ".join([first, *rest]))
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the storm; return 1 where something was that must not be."""
    parser = argparse.ArgumentParser(description="Storm of an adversary.")
    parser.add_argument("--triggers", type=int, default=5_000, help="calls per variant")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--at-once", type=int, default=40, help="variants side by side")
    parser.add_argument("--only", default="", help="variants with this in their name")
    options = parser.parse_args(arguments)
    variants = [one for one in VARIANTS if options.only in one.name]
    print(f"seed {options.seed}")  # noqa: T201
    done = asyncio.run(storms(variants, options.triggers, options.seed, at_once=options.at_once))
    print(table(done))  # noqa: T201
    violations = [text for one in done for text in one.violations]
    for text in violations[:50]:
        print(f"VIOLATION {text}")  # noqa: T201
    print(f"{len(violations)} violations")  # noqa: T201
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(main())
