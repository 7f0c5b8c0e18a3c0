"""Helpers of the two storms: a camera that knows whose each result is, callers, and the judge.

A storm triggers a camera again and again, in tasks that may be cancelled, and asks of each result
whether it is of the Trigger message that its call has sent. What else is done to the camera, and
when a call is given up, is the storm's own.
"""

from __future__ import annotations

import argparse
import asyncio
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any, ClassVar, Generic, Literal, TypeVar

from smartcam.models import Result, Statistics
from tests.client.camera_by_hand import RESULT
from tests.client.clientkit import Sending, TriggerEar, imbalances, loop_reports
from tests.client.line_camera import AGAIN, SENSOR, LineCamera, Step
from tests.proofs.books import TRIGGER_OUTCOMES, BookKeeper, aligned

SLOWEST = 20.0
"""Times these, where the machine has other things to do."""

HANG = 20.0
"""Seconds after which a call hangs, whose own bound is a few."""

LONGEST_HOLD = 0.01
"""Seconds that the network holds a datagram back."""

Rule = Literal["own", "fresh", "count"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """One kind of storm. Shares are 0 to 1, times seconds."""

    name: str  # in the table
    # what a result must be: of the call's own trigger (``own``); that, or of a sensor's run that
    # began when it had been sent (``fresh``); anything, and it is counted (``count``)
    rule: Rule = "own"
    share: float = 1.0  # of the calls that it gets: some take their time
    dialect: str = "handbook"
    transport: Literal["tcp", "udp"] = "tcp"
    # type of the layout's number, empty for none
    number: Literal["", "int32", "int16", "int8", "uint8"] = ""
    line: tuple[float, float] = (0.0, 0.0)  # shortest and longest delay each way
    results: tuple[int, int] = (1, 1)  # fewest and most that a run sends
    wanted: int | None = None  # asked for per trigger
    # share of the datagrams with a result that the network holds back; others pass them
    held: float = 0.0


VariantT = TypeVar("VariantT", bound=Variant)


USUAL = ("result", "TriggerTimeoutError", "cancelled", "OvertriggeredError")


@dataclass(slots=True)
class Figures:
    """The outcome of a storm."""

    variant: Variant
    calls: int = 0
    # of the calls: ``result``, ``cancelled``, or the error's name
    outcomes: Counter[str] = field(default_factory=Counter)
    own: int = 0  # results that are of the call's own trigger
    fresh: int = 0  # of a sensor's run that began when the trigger had been sent
    stale: int = 0  # of a sensor's run that was begun before
    others: int = 0  # of another trigger of ours
    longest: int = 0  # of wrong results in a row
    in_a_row: int = 0
    triggers: int = 0
    sent: int = 0
    overtriggers: int = 0
    stopped: int = 0  # times the client stopped the application for a trigger
    queries: int = 0  # that the client sent
    late: int = 0
    extra: int = 0
    lives: int = 0
    sessions: int = 0
    # triggers that were sent and whose call was not told anything of its run
    given_up: set[tuple[int, int]] = field(default_factory=set)
    # how much later a trigger was sent for a debt that its late result has paid
    waited_ms: list[float] = field(default_factory=list)
    stopped_ms: list[float] = field(default_factory=list)  # and where it took Stop, Query and Start
    violations: list[str] = field(default_factory=list)  # what must not be, in words
    seconds: float = 0.0

    @property
    def other(self) -> int:
        """Calls that ended in no usual way."""
        return self.outcomes.total() - sum(self.outcomes[name] for name in USUAL)

    @property
    def wrong(self) -> int:
        """Results that no rule allows."""
        return self.stale + self.others

    def demand(self, true: object, text: str) -> None:
        """Note a violation unless something is true."""
        if not true:
            self.violations.append(f"{self.variant.name}: {text}")


class Storm(Generic[VariantT]):
    """Triggers a camera again and again."""

    # what a trigger may end with beside a result
    allowed: ClassVar[tuple[type[Exception], ...]] = TRIGGER_OUTCOMES
    # dialects in which a trigger is sent again where the camera was busy
    sent_again: ClassVar[frozenset[str]] = frozenset({"bid"})
    # of the table: their heads, and what stands in them
    columns: ClassVar[Sequence[tuple[str, Callable[[Figures], object]]]]

    def __init__(self, variant: VariantT, chance: Random) -> None:
        self.variant = variant
        self.figures = Figures(variant)
        self.ear = TriggerEar()
        self.camera = self.make_camera()
        self._chance = chance
        self._scale = 1.0
        self._taken: set[bytes] = set()  # containers that were some call's result

    def make_camera(self) -> LineCamera | BookKeeper:
        """Return the camera."""
        raise NotImplementedError

    async def live(self, calls: int) -> None:
        """Have calls made, by one client or by many, until there were so many."""
        raise NotImplementedError

    async def run(self, calls: int) -> Figures:
        """Have so many calls made."""
        figures, begun = self.figures, time.perf_counter()
        async with self.camera:
            await self.live(calls)
        figures.seconds = time.perf_counter() - begun
        figures.sent = len(self.camera.sent)
        figures.triggers = self.camera.triggers
        figures.overtriggers = self.camera.overtriggers
        figures.stopped, figures.queries = self.ear.said["Stop"], self.ear.said["Query"]
        return figures

    # ------------------------------------------------------------------ what chance decides

    def happens(self, share: float) -> bool:
        """Say yes in this share of the times."""
        return self._chance.random() < share

    def delay(self) -> float:
        """Return how long something takes on the line."""
        return self._chance.uniform(*self.variant.line)

    def network(self, message_id: int) -> Sequence[float]:
        """Return after how many seconds each copy of a datagram arrives."""
        held = message_id == RESULT and self.happens(self.variant.held)
        return (self._chance.uniform(0, LONGEST_HOLD) if held else 0.0,)

    def steps(
        self, lasts: float, waiting: int, said: list[int], pause: Callable[[int], float]
    ) -> Sequence[Step]:
        """Return the steps of a run that says its first thing after ``lasts`` seconds.

        ``waiting`` of its results come before it waits for a trigger again.
        """
        every = [*said[:waiting], AGAIN, *said[waiting:]]
        return [(lasts, every[0]), *((pause(what), what) for what in every[1:])]

    def keep_pace(self, outcome: str) -> None:
        """Have about as many results as timeouts, also on a slow machine."""
        change = {"result": 0.9, "TriggerTimeoutError": 1.1}.get(outcome, 1.0)
        self._scale = min(SLOWEST, max(1.0, self._scale * change))

    async def quiet(self) -> None:
        """Wait until the camera has nothing more to say."""
        while isinstance(self.camera, LineCamera) and not self.camera.idle:  # noqa: ASYNC110
            await asyncio.sleep(0.001)

    # ------------------------------------------------------------------ calls

    async def end(self, task: asyncio.Task[Any], cancel_after: float | None = None) -> str:
        """Wait for a call, perhaps cancelled; return its outcome's name."""
        handle = None
        if cancel_after is not None:
            handle = asyncio.get_running_loop().call_later(cancel_after, task.cancel)
        await asyncio.wait({task}, timeout=HANG)
        if handle is not None:
            handle.cancel()
        sendings = self.ear.sendings.pop(task, [])
        outcome = self._judge(task, sendings)
        self.figures.outcomes[outcome] += 1
        if outcome == "hangs":
            task.cancel()
            await asyncio.wait({task}, timeout=HANG)
        self.after(outcome, sendings)
        return outcome

    def after(self, outcome: str, sendings: Sequence[Sending]) -> None:
        """Look at what came of a call."""

    # ------------------------------------------------------------------ the judge

    def _judge(self, task: asyncio.Task[Any], sendings: Sequence[Sending]) -> str:
        """Return the outcome's name; look whose the results are."""
        figures, call = self.figures, self.figures.calls
        if self.variant.dialect not in self.sent_again:
            figures.demand(len(sendings) <= 1, f"call {call} sent {len(sendings)} triggers")
        figures.demand(task.done(), f"call {call} hangs")
        if not task.done():
            return "hangs"
        if task.cancelled():
            return "cancelled"
        error = task.exception()
        if error is not None:
            figures.demand(isinstance(error, self.allowed), f"call {call} ended with {error!r}")
            return type(error).__name__
        figures.demand(sendings, f"call {call} has a result and sent no trigger")
        results = task.result()
        if isinstance(results, list):
            wanted, got = self.variant.wanted, len(results)
            figures.demand(got == wanted, f"call {call}: {got} of {wanted} results")
        else:
            results = [results]
        once = len({one.raw for one in results}) == len(results)
        figures.demand(once, f"call {call}: one container twice")
        same = len({one.value.run for one in results}) == 1
        figures.demand(same or self.variant.rule == "count", f"call {call}: results of two runs")
        wrong = [not self.is_right(one, sendings[-1]) for one in results if sendings]
        figures.in_a_row = figures.in_a_row + 1 if any(wrong) else 0
        figures.longest = max(figures.longest, figures.in_a_row)
        return "result"

    def is_right(self, result: Result, sending: Sending) -> bool:
        """Look whose a result is."""
        figures, rule, call = self.figures, self.variant.rule, self.figures.calls
        run = self.camera.runs[result.value.run]
        if rule != "count":
            text = f"call {call}: a container of run {result.value.run} for the second time"
            figures.demand(result.raw not in self._taken, text)
        self._taken.add(result.raw)
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

    def audit(self, got: Statistics) -> None:
        """Look at a client's accounts."""
        self.figures.late += got.late
        self.figures.extra += got.extra_results
        self.figures.sessions += got.sessions
        for text in imbalances(got):
            self.figures.demand(False, text)
        self.figures.demand(got.uninterpretable == 0, f"odd fates: {got}")


# ---------------------------------------------------------------------- running them


async def storms(
    kind: type[Storm[VariantT]],
    variants: Iterable[VariantT],
    calls: int,
    seed: int,
    *,
    at_once: int = 1,
) -> list[Figures]:
    """Run variants, a few at once; what the loop has to report is a violation of the first."""
    places = asyncio.Semaphore(at_once)

    async def run(variant: VariantT) -> Figures:
        async with places:
            chance = Random(f"{seed} {variant.name}")  # noqa: S311
            return await kind(variant, chance).run(max(1, round(calls * variant.share)))

    with loop_reports() as reports:
        done = await asyncio.gather(*(run(variant) for variant in variants))
    done[0].violations += reports
    return done


def table(kind: type[Storm[VariantT]], done: Sequence[Figures]) -> str:
    """Return the figures as text."""
    rows = [["variant", *(name for name, _ in kind.columns)]]
    rows += [[one.variant.name, *(str(of(one)) for _, of in kind.columns)] for one in done]
    return aligned(rows)


def run_command(
    kind: type[Storm[VariantT]],
    variants: Sequence[VariantT],
    arguments: Sequence[str] | None,
    *,
    about: str,
    triggers: int,
    at_once: int,
) -> int:
    """Run a storm from the command line; return 1 where something was that must not be."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--triggers", type=int, default=triggers, help="calls per variant")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--at-once", type=int, default=at_once, help="variants side by side")
    parser.add_argument("--only", default="", help="variants with this in their name")
    options = parser.parse_args(arguments)
    chosen = [one for one in variants if options.only in one.name]
    print(f"seed {options.seed}")  # noqa: T201
    done = asyncio.run(
        storms(kind, chosen, options.triggers, options.seed, at_once=options.at_once)
    )
    print(table(kind, done))  # noqa: T201
    violations = [text for one in done for text in one.violations]
    for text in violations[:50]:
        print(f"VIOLATION {text}")  # noqa: T201
    print(f"{len(violations)} violations")  # noqa: T201
    return 1 if violations else 0
