"""Storm of late results: no trigger may ever get another one's result.

Results come at random around the trigger's timeout, results and status in both orders, every tenth
trigger is cancelled at a random moment. The camera knows which trigger began each run and says so
in the container, beside the number; the client's n-th trigger is the n-th that the camera got.

Long form: ``python tests/proofs/late_storm.py --triggers 10000 --seed 1`` (per variant; prints a
table, exit 1 on a violation).
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import statistics
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any

if __name__ == "__main__":  # the wire is another camera's, too
    sys.path.append(str(Path(__file__).parent.parent))

from storm_camera import EXTERNAL, Habits, StormCamera
from storm_variants import PATIENCE, VARIANTS, make_camera

import smartcam
from smartcam import exceptions
from smartcam.models import Status
from smartcam.observers import Observer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Sequence
    from contextlib import AbstractAsyncContextManager

    from storm_variants import Camera, Variant

    from smartcam._client.link import TraceEntry
    from smartcam.client import SmartCamera
    from smartcam.models import Result, Statistics
    from smartcam.streams import Subscription

SLOWEST = 20.0
"""Times these, where the machine has other things to do."""

CANCEL_EACH = 10
HANG = 20.0
"""Seconds after which a call with such a timeout hangs."""

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

USUAL = (exceptions.OvertriggeredError, exceptions.InputContainerError)
"""What else may happen in a storm: nobody stops the camera, and no link breaks."""


# ---------------------------------------------------------------------- the client's side


class Ear(Observer):
    """Counts what the client says."""

    def __init__(self) -> None:
        self.said: Counter[str] = Counter()
        self.triggered_at = 0.0

    def on_frame(self, entry: TraceEntry) -> None:
        if entry.direction == ">":
            self.said[entry.message] += 1
            if entry.message == "Trigger":
                self.triggered_at = asyncio.get_running_loop().time()


@dataclass(slots=True)
class Figures:
    """What came of a storm.

    Attributes:
        outcomes: of the calls: ``result``, ``cancelled``, or the error's name.
        given_up: triggers that were sent and whose call was not told anything of its run.
        lapsed: of these, those that ended by cancellation.
        wrong: results of another trigger than the call's.
        stale: wrong ones from a run that nobody of ours asked for.
        waited_ms: how much later a trigger was sent for a debt that its late result has paid.
        fenced_ms: and where it took Stop, Query and Start.
        violations: what must not be, in words.
    """

    variant: Variant
    calls: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    given_up: set[int] = field(default_factory=set)
    triggers: int = 0
    wrong: int = 0
    stale: int = 0
    late: int = 0
    sent: int = 0
    waited_ms: list[float] = field(default_factory=list)
    fenced_ms: list[float] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def demand(self, true: object, text: str) -> None:
        """Note a violation unless something is true."""
        if not true:
            self.violations.append(f"{self.variant.name}: {text}")


class Storm:
    """Triggers a camera again and again.

    Args:
        variant: which kind.
        camera: it.
        client: a client in a session with it.
        ear: hears what the client says.
        chance: decides about timeouts and cancellations.
    """

    def __init__(
        self, variant: Variant, camera: Camera, client: SmartCamera, ear: Ear, chance: Random
    ) -> None:
        self.variant = variant
        self.camera = camera
        self.client = client
        self.ear = ear
        self.figures = Figures(variant)
        self._chance = chance
        self._owing = False
        self._scale = 1.0

    async def run(self, calls: int) -> None:
        """Trigger so many times, then look at the accounts."""
        begun = asyncio.get_running_loop().time()
        for call in range(1, calls + 1):
            await self._call(call)
        await self._hear_the_rest()
        self.figures.seconds = asyncio.get_running_loop().time() - begun
        self._audit(self.client.statistics())

    async def _call(self, call: int) -> None:
        patience = self._scale * self._chance.uniform(*PATIENCE)
        self.camera.pace = patience
        sent, stops = self.ear.said["Trigger"], self.ear.said["Stop"]
        begun = asyncio.get_running_loop().time()
        task = asyncio.create_task(self._trigger(call, patience))
        cancel = None
        if call % CANCEL_EACH == 0:
            when = self._chance.uniform(0, 1.3 * patience)
            cancel = asyncio.get_running_loop().call_later(when, task.cancel)
        await asyncio.wait({task}, timeout=HANG)
        if cancel is not None:
            cancel.cancel()
        self.figures.calls += 1
        self.figures.sent = len(self.camera.sent)
        self.figures.demand(task.done(), f"call {call} hangs")
        count = self.ear.said["Trigger"] - sent
        self.figures.demand(count <= 1, f"call {call} sent {count} triggers")
        if count:
            self._note_cost(begun, fenced=self.ear.said["Stop"] > stops)
        outcome = self._judge(task, call, self.ear.said["Trigger"] if count else None)
        self.figures.outcomes[outcome] += 1
        self._keep_pace(outcome)
        if outcome == "InputContainerError":
            await self.client.switch_application(1)
            self._owing = False

    def _keep_pace(self, outcome: str) -> None:
        """Have about as many results as timeouts, also on a slow machine."""
        change = {"result": 0.9, "TriggerTimeoutError": 1.1}.get(outcome, 1.0)
        self._scale = min(SLOWEST, max(1.0, self._scale * change))

    async def _trigger(self, call: int, patience: float) -> list[Result]:
        data = call.to_bytes(4, "little") if self.variant.habits.reads_input else None
        wanted = self.variant.results
        if wanted is not None:
            return await self.client.trigger(
                timeout=patience, input=data, results_per_trigger=wanted
            )
        return [await self.client.trigger(timeout=patience, input=data)]

    def _note_cost(self, begun: float, *, fenced: bool) -> None:
        cost = 1000 * (self.ear.triggered_at - begun)
        if fenced:
            self.figures.fenced_ms.append(cost)
        elif self._owing:
            self.figures.waited_ms.append(cost)

    def _judge(self, task: asyncio.Task[list[Result]], call: int, trigger: int | None) -> str:
        """Return the outcome's name; look whether a result is this call's own."""
        figures = self.figures
        if not task.done():
            return "hangs"
        error = None if task.cancelled() else task.exception()
        if task.cancelled() or isinstance(error, exceptions.TriggerTimeoutError):
            if trigger is not None:
                figures.given_up.add(trigger)
                self._owing = True
            return "cancelled" if error is None else "TriggerTimeoutError"
        if error is not None:
            name = type(error).__name__
            figures.demand(isinstance(error, USUAL), f"call {call} ended with {error!r}")
            self._owing = self._owing or trigger is not None
            return name
        self._owing = False
        figures.demand(trigger is not None, f"call {call} has a result and sent no trigger")
        self._compare(task.result(), call, trigger)
        return "result"

    def _compare(self, results: Sequence[Result], call: int, trigger: int | None) -> None:
        figures = self.figures
        wanted = self.variant.results or 1
        figures.demand(len(results) == wanted, f"call {call}: {len(results)} of {wanted} results")
        for result in results:
            value = result.value
            if value.trigger != trigger:
                figures.wrong += 1
                figures.stale += value.trigger == EXTERNAL
                text = f"call {call}, trigger {trigger}: a result of trigger {value.trigger}"
                figures.demand(not self.variant.promised, text)
            if self.variant.habits.reads_input:
                figures.demand(value.token == call, f"call {call}: inspected input {value.token}")
            same = result.sequence == (value.number if self.variant.mark else None)
            figures.demand(same, f"call {call}: sequence {result.sequence}, not {value.number}")
        parts = {result.value.part for result in results}
        figures.demand(len(parts) == len(results), f"call {call}: one container twice")

    async def _hear_the_rest(self) -> None:
        """Have every container that was sent."""
        self.camera.calm()
        await self.camera.quiet()
        await self.client.wait_status(_is_idle)
        await self.client.query_application()

    def _audit(self, got: Statistics) -> None:
        figures, camera = self.figures, self.camera
        figures.triggers, figures.late = camera.triggers, got.late
        figures.sent = len(camera.sent)
        said = self.ear.said["Trigger"]
        figures.demand(said == camera.triggers, f"{said} triggers sent, {camera.triggers} came")
        figures.demand(
            got.received == len(camera.sent),
            f"{len(camera.sent)} containers sent, {got.received} received",
        )
        fates = got.triggered + got.streamed + got.late + got.unclaimed
        figures.demand(got.received == fates, f"the fates do not add up: {got}")
        for one in got.subscribers:
            balanced = one.offered == one.taken + one.dropped + one.queued
            figures.demand(balanced, f"a subscriber's account does not balance: {one}")
        figures.demand(got.uninterpretable == got.wrong_application == 0, f"odd fates: {got}")
        figures.demand(got.sessions == 1, f"{got.sessions} sessions: {got.last_error}")
        self._audit_fates(got)

    def _audit_fates(self, got: Statistics) -> None:
        """Compare the fates with what the camera sent."""
        figures, camera = self.figures, self.camera
        results = figures.outcomes["result"] * (self.variant.results or 1)
        raced = got.triggered - results  # came in the same instant as a cancellation or timeout
        if self.variant.transport == "tcp":
            figures.demand(
                got.overtriggers == camera.overtriggers,
                f"Overtriggered rose {camera.overtriggers} times, {got.overtriggers} seen",
            )
        seconds, external = sum(one.part > 0 for one in camera.sent), self.variant.habits.external
        # where a late one is taken for the next one's, that one's own is extra
        if self.variant.promised and self.variant.transport == "tcp" and not external:
            figures.demand(
                got.extra_results <= seconds, f"{got.extra_results} extra, not {seconds}"
            )
        if not self.variant.exact:
            return
        lost = sum(one.trigger in figures.given_up for one in camera.sent)
        figures.demand(
            0 <= raced <= figures.outcomes["cancelled"],
            f"{got.triggered} containers counted as triggered, {results} results",
        )
        figures.demand(
            got.late == lost - raced,
            f"{lost} containers of given-up triggers, {raced} of them just in time; "
            f"{got.late} counted as late",
        )
        figures.demand(
            got.streamed + got.unclaimed == 0, f"{got.streamed + got.unclaimed} are nobody's"
        )


def _is_idle(status: Status) -> bool:
    return Status.WAITING_FOR_TRIGGER in status or Status.RUNNING not in status


# ---------------------------------------------------------------------- running them


@contextlib.asynccontextmanager
async def _listening(client: SmartCamera) -> AsyncIterator[None]:
    """Have a subscriber that reads along."""

    async def read(stream: Subscription[Result]) -> None:
        async for _ in stream:
            pass

    async with client.results(max_queue=64) as stream:
        reader = asyncio.create_task(read(stream))
        try:
            yield
        finally:
            stream.close()
            await asyncio.wait({reader}, timeout=HANG)


async def storm(variant: Variant, calls: int, seed: int) -> Figures:
    """Run one variant."""
    chance = Random(f"{seed} {variant.name}")  # noqa: S311
    ear = Ear()
    camera = make_camera(variant, chance)
    opened: AbstractAsyncContextManager[Any] = camera
    async with opened:
        options: dict[str, Any] = {"interpret_as": variant.layout, "reconnect": None}
        async with smartcam.connect(camera.url, observers=[ear], **options) as client:
            one = Storm(variant, camera, client, ear, chance)
            listening = contextlib.nullcontext() if variant.exact else _listening(client)
            async with listening:
                await one.run(round(calls * variant.share))
    return one.figures


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


# ---------------------------------------------------------------------- what a debt costs

LONG = 2.0
"""Seconds of a trigger's timeout beside which the client's grace is short."""


async def debt_cost(late: float, dialect: str = "handbook") -> float:
    """Return how much later a trigger is sent behind one that was given up, milliseconds.

    Args:
        late: seconds that the result of that one comes after its timeout.
        dialect: of the camera.
    """
    ear = Ear()
    habits = Habits(delays=(1.0, 1.0), waiting_first=0.0, apart=0.0)
    camera = StormCamera(dialect=dialect, transport="tcp", habits=habits, chance=Random(0))  # noqa: S311
    async with camera, smartcam.connect(camera.url, observers=[ear]) as client:
        camera.pace = 0.05 + late
        with contextlib.suppress(exceptions.TriggerTimeoutError):
            await client.trigger(timeout=0.05)
        camera.pace = 0.001
        begun = asyncio.get_running_loop().time()
        await client.trigger(timeout=LONG)
        return 1000 * (ear.triggered_at - begun)


async def debt_costs(rounds: int) -> str:
    """Return medians over some rounds, as text: for results a little late, and much."""
    lines = []
    for dialect, late in itertools.product(("handbook", "bid"), (0.01, 0.1, 1.0)):
        costs = [await debt_cost(late, dialect) for _ in range(rounds)]
        what = f"{dialect}: result {1000 * late:.0f} ms late, next timeout {LONG:g} s"
        lines.append(f"{what}: its trigger goes out {statistics.median(costs):.1f} ms later")
    return "\n".join(lines)


# ---------------------------------------------------------------------- the table

HEADINGS = (
    "calls",
    "triggers",
    "results",
    "timeouts",
    "cancelled",
    "overtrig",
    "other",
    "sent",
    "late",
    "wrong",
    "seconds",
    "grace",
    "ms",
    "fenced",
    "ms",
)


def row(figures: Figures) -> list[str]:
    """Return one line of the table."""
    outcomes = Counter(figures.outcomes)
    known = ("result", "TriggerTimeoutError", "cancelled", "OvertriggeredError")
    counts = [outcomes.pop(name, 0) for name in known]
    wrong = str(figures.wrong)
    if figures.wrong:
        share = 100 * figures.wrong / max(1, counts[0])
        wrong += f" ({share:.2f} %)"
    return [
        str(figures.calls),
        str(figures.triggers),
        *map(str, counts),
        str(outcomes.total()),
        str(figures.sent),
        str(figures.late),
        wrong,
        f"{figures.seconds:.1f}",
        str(len(figures.waited_ms)),
        _median(figures.waited_ms),
        str(len(figures.fenced_ms)),
        _median(figures.fenced_ms),
    ]


def _median(values: list[float]) -> str:
    return f"{statistics.median(values):.1f}" if values else "-"


def table(done: Sequence[Figures]) -> str:
    """Return the figures as text."""
    rows = [["variant", *HEADINGS], *([one.variant.name, *row(one)] for one in done)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for cells in rows:
        first = cells[0].ljust(widths[0])
        rest = (cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True))
        lines.append("  ".join([first, *rest]))
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the storm; return 1 where something was that must not be."""
    parser = argparse.ArgumentParser(description="Storm of late results.")
    parser.add_argument("--triggers", type=int, default=10_000, help="calls per variant")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--at-once", type=int, default=4, help="variants side by side")
    parser.add_argument("--only", default="", help="variants with this in their name")
    options = parser.parse_args(arguments)
    variants = [one for one in VARIANTS if options.only in one.name]
    print(f"seed {options.seed}")  # noqa: T201
    done = asyncio.run(storms(variants, options.triggers, options.seed, at_once=options.at_once))
    print(table(done))  # noqa: T201
    print(asyncio.run(debt_costs(10)))  # noqa: T201
    violations = [text for one in done for text in one.violations]
    for text in violations[:50]:
        print(f"VIOLATION {text}")  # noqa: T201
    print(f"{len(violations)} violations")  # noqa: T201
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(main())
