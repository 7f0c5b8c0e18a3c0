"""Storm of late results: no trigger may ever get another one's result.

Results come at random around the trigger's timeout, results and status in both orders, every tenth
trigger is cancelled at a random moment. The camera knows which trigger began each run, and what
became of each container is compared with what it sent.

Long form: ``python -m tests.proofs.late_storm --triggers 10000 --seed 1`` (per variant; prints a
table, exit 1 on a violation).
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import statistics
import sys
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import smartcam
from smartcam import exceptions
from smartcam.camera import Camera
from smartcam.models import Result, Statistics, Status
from smartcam.streams import Subscription
from tests.client.clientkit import Sending, TriggerEar
from tests.client.line_camera import AGAIN, LAYOUTS, LineCamera, Run, Step
from tests.proofs.books import BookKeeper
from tests.proofs.storm import HANG, Figures, Storm, Variant, run_command

CANCEL_EACH = 10

PATIENCE = (0.005, 0.02)
"""Shortest and longest timeout of a trigger, seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LateVariant(Variant):
    """The ways in which a camera is late. Shares are 0 to 1, times seconds."""

    exact: bool = True  # each container's fate is known beforehand, so the counts must agree
    # share of the runs whose Waiting for Trigger rises before their results
    waiting_first: float = 0.5
    apart: float = 0.3  # share of the runs with a pause between results and status
    longest_pause: float = 0.003  # the longest of these
    second: float = 0.0  # share of the runs that send a second container
    second_apart: bool = False  # and pause before it
    # mean time between two triggers of the digital input, in multiples of what a run takes; 0 for
    # none
    external: float = 0.0
    reads_input: bool = False  # the application has a "receive data" tool
    # of an emulator, whose quirk it is; None is the camera made by hand
    order: Literal["result first", "waiting first"] | None = None
    pushed: bool = False  # of an emulator with ``bid``: a status comes with every change, too


def of_bid(name: str, *, waiting_first: float = 0.0, **more: Any) -> LateVariant:
    """Return a variant with ``bid``, which waits again when it has sent everything."""
    return LateVariant(name=name, dialect="bid", waiting_first=waiting_first, **more)


def best_effort(
    name: str, *, make: Callable[..., LateVariant] = LateVariant, **more: Any
) -> LateVariant:
    """Return a variant where nothing is promised; what is wrong is counted and shown."""
    return make(name=f"best effort: {name}", rule="count", exact=False, **more)


SLOW = (0.002, 0.002)
TWO: dict[str, Any] = {"exact": False, "wanted": 2, "second": 0.9}

VARIANTS: tuple[LateVariant, ...] = (
    LateVariant(
        name="tcp extra slow link",
        exact=False,
        share=0.4,
        # shorter pauses than a trigger's way: the second container always comes before it counts
        second=0.5,
        second_apart=True,
        longest_pause=0.0015,
        line=SLOW,
    ),
    LateVariant(name="tcp slow link", share=0.4, line=SLOW),
    LateVariant(name="tcp"),
    LateVariant(name="tcp thesis", dialect="thesis"),
    LateVariant(name="tcp number", number="int32"),
    LateVariant(name="tcp number thesis", number="int32", dialect="thesis"),
    LateVariant(name="tcp number of 8 bits", number="uint8"),
    LateVariant(name="udp number", number="int32", transport="udp"),
    LateVariant(name="udp number thesis", number="int32", transport="udp", dialect="thesis"),
    LateVariant(name="udp number held", number="int32", transport="udp", held=0.3),
    LateVariant(name="tcp input", reads_input=True),
    LateVariant(name="udp input number", transport="udp", number="int32", reads_input=True),
    LateVariant(name="tcp extra", exact=False, second=0.3),
    LateVariant(
        name="tcp extra number", exact=False, number="int32", second=0.3, second_apart=True
    ),
    LateVariant(name="tcp two results", **TWO),
    LateVariant(name="tcp two results number", number="int32", second_apart=True, **TWO),
    LateVariant(name="tcp external number", exact=False, number="int32", external=3.0),
    LateVariant(
        name="udp external number",
        exact=False,
        number="int32",
        transport="udp",
        external=3.0,
        held=0.1,
    ),
    LateVariant(name="emulator", order="result first"),
    LateVariant(name="emulator waiting first", order="waiting first"),
    LateVariant(name="emulator number", number="int32", order="waiting first"),
    LateVariant(name="emulator udp number", number="int32", order="result first", transport="udp"),
    LateVariant(name="tcp b16", dialect="b16"),
    LateVariant(name="tcp b16 number", dialect="b16", number="int32"),
    LateVariant(
        name="udp b16 number held", dialect="b16", number="int32", transport="udp", held=0.3
    ),
    of_bid("tcp bid", share=0.4),
    of_bid("tcp bid slow link", share=0.4, line=SLOW),
    of_bid("tcp bid input", share=0.4, reads_input=True),
    of_bid("tcp bid extra", share=0.4, exact=False, second=0.3, second_apart=True),
    of_bid("tcp bid two results", share=0.4, second_apart=True, **TWO),
    of_bid("emulator bid", order="result first"),
    of_bid("emulator bid pushed", order="waiting first", pushed=True),
    best_effort("udp bid", make=of_bid, transport="udp"),
    best_effort("udp bid held", make=of_bid, transport="udp", held=0.3),
    best_effort("tcp bid external", make=of_bid, external=3.0),
    best_effort("tcp bid waiting first", make=of_bid, waiting_first=0.5),
    best_effort("udp", transport="udp"),
    best_effort("udp held", transport="udp", held=0.3),
    best_effort("tcp external", external=3.0),
    best_effort("tcp external tidy", external=3.0, waiting_first=0.0, apart=0.0),
    best_effort("tcp external slow link", share=0.4, external=3.0, line=SLOW),
    best_effort("udp external", transport="udp", external=3.0, held=0.1),
    best_effort("tcp extra apart", second=0.3, second_apart=True),
)


def _wrong(figures: Figures) -> str:
    wrong = figures.wrong + figures.fresh
    share = 100 * wrong / max(1, figures.outcomes["result"])
    return f"{wrong} ({share:.2f} %)" if wrong else "0"


def _median(values: list[float]) -> str:
    return f"{statistics.median(values):.1f}" if values else "-"


class LateStorm(Storm[LateVariant]):
    """One client, one call after the other."""

    allowed = (
        exceptions.OvertriggeredError,
        exceptions.InputContainerError,
        exceptions.TriggerTimeoutError,
    )
    sent_again = frozenset()
    columns = (
        ("calls", lambda one: one.calls),
        ("triggers", lambda one: one.triggers),
        ("results", lambda one: one.outcomes["result"]),
        ("timeouts", lambda one: one.outcomes["TriggerTimeoutError"]),
        ("cancelled", lambda one: one.outcomes["cancelled"]),
        ("overtrig", lambda one: one.outcomes["OvertriggeredError"]),
        ("other", lambda one: one.other),
        ("sent", lambda one: one.sent),
        ("late", lambda one: one.late),
        ("wrong", _wrong),
        ("seconds", lambda one: f"{one.seconds:.1f}"),
        ("grace", lambda one: len(one.waited_ms)),
        ("ms", lambda one: _median(one.waited_ms)),
        ("stopped", lambda one: len(one.stopped_ms)),
        ("ms", lambda one: _median(one.stopped_ms)),
    )
    _pace = 0.01
    _owing = False
    _begun = 0.0
    _stops = 0

    def make_camera(self) -> LineCamera | BookKeeper:
        """Return the camera made by hand, or an emulated one."""
        variant = self.variant
        if variant.order is None:
            camera = LineCamera(
                dialect=variant.dialect,
                transport=variant.transport,
                delay=self.delay,
                in_order=False,
                reads_input=variant.reads_input,
            )
            camera.plan, camera.network = self._plan, self.network
            return camera
        # it keeps one pace: here chance lies with the timeouts
        return BookKeeper(
            {1: {"processing_time": sum(PATIENCE) / 4}},
            marked=bool(variant.number),
            transport=variant.transport,
            dialect=variant.dialect,
            quirks={
                "waiting_before_result": variant.order == "waiting first",
                "push_status": variant.pushed,
            },
        )

    def _plan(self, _: Run) -> Sequence[Step]:
        variant, chance = self.variant, self._chance
        said = [0, 1] if self.happens(variant.second) else [0]

        def pause(what: int) -> float:
            if what == 1:
                return chance.uniform(0, variant.longest_pause) * variant.second_apart
            return self.happens(variant.apart) * chance.uniform(0, variant.longest_pause)

        waiting = 0 if self.happens(variant.waiting_first) else len(said)
        return self.steps(self._pace * chance.uniform(0.1, 1.3), waiting, said, pause)

    async def live(self, calls: int) -> None:
        """Have one client make all calls."""
        variant, camera = self.variant, self.camera
        layout = LAYOUTS[variant.number] if isinstance(camera, LineCamera) else camera.layout
        options: dict[str, Any] = {"interpret_as": layout, "reconnect": None}
        async with smartcam.connect(camera.url, observers=[self.ear], **options) as client:
            listening = contextlib.nullcontext() if variant.exact else _listening(client)
            async with listening:
                external = asyncio.create_task(self._digital_input())
                for _ in range(calls):
                    await self._call(client)
                external.cancel()
                await self.quiet()
                await client.wait_status(_is_idle)
                await client.query_application()
                self.audit(client.statistics())

    async def _digital_input(self) -> None:
        while self.variant.external:
            mean = self.variant.external * self._pace
            await asyncio.sleep(self._chance.expovariate(1 / mean))
            assert isinstance(self.camera, LineCamera)
            self.camera.sensor()

    async def _call(self, client: Camera) -> None:
        self.figures.calls += 1
        call = self.figures.calls
        self._pace = self._scale * self._chance.uniform(*PATIENCE)
        self._begun, self._stops = asyncio.get_running_loop().time(), self.ear.said["Stop"]
        options: dict[str, Any] = {"timeout": self._pace}
        if self.variant.reads_input:
            options["input"] = call.to_bytes(4, "little")
        if self.variant.wanted is not None:
            options["results_per_trigger"] = self.variant.wanted
        task = asyncio.create_task(client.trigger(**options))
        cancelled = self._chance.uniform(0, 1.3 * self._pace) if call % CANCEL_EACH == 0 else None
        outcome = await self.end(task, cancelled)
        self.keep_pace(outcome)
        if outcome == "InputContainerError":
            await client.switch_application(1)
            self._owing = False

    def after(self, outcome: str, sendings: Sequence[Sending]) -> None:
        """Note what the trigger had to wait for, and whether its result is owed now."""
        figures = self.figures
        if sendings:
            cost = 1000 * (sendings[-1].at - self._begun)
            if self.ear.said["Stop"] > self._stops:
                figures.stopped_ms.append(cost)
            elif self._owing:
                figures.waited_ms.append(cost)
        if outcome in {"cancelled", "TriggerTimeoutError"}:
            figures.given_up |= {sending[:2] for sending in sendings}
        self._owing = outcome != "result" and (self._owing or bool(sendings))

    def is_right(self, result: Result, sending: Sending) -> bool:
        """Look whose a result is, and at its input and its number."""
        value, call = result.value, self.figures.calls
        if self.variant.reads_input:
            text = f"call {call}: inspected input {value.token}"
            self.figures.demand(value.token == call, text)
        same = result.sequence == (value.number if self.variant.number else None)
        text = f"call {call}: sequence {result.sequence}, not {value.number}"
        self.figures.demand(same, text)
        return super().is_right(result, sending)

    def audit(self, got: Statistics) -> None:
        """Compare the fates with what the camera sent."""
        super().audit(got)
        figures, camera, variant = self.figures, self.camera, self.variant
        demand, sent = figures.demand, camera.sent
        said = self.ear.said["Trigger"]
        demand(said == camera.triggers, f"{said} triggers sent, {camera.triggers} came")
        demand(got.received == len(sent), f"{len(sent)} containers sent, {got.received} received")
        demand(got.wrong_application == 0, f"odd fates: {got}")
        demand(got.sessions == 1, f"{got.sessions} sessions: {got.last_error}")
        if variant.transport == "tcp":
            text = f"Overtriggered rose {camera.overtriggers} times, {got.overtriggers} seen"
            demand(got.overtriggers == camera.overtriggers, text)
        seconds = len(sent) - len({one.run.index for one in sent})
        # where a late one is taken for the next one's, that one's own is extra
        if variant.rule == "own" and variant.transport == "tcp" and not variant.external:
            demand(got.extra_results <= seconds, f"{got.extra_results} extra, not {seconds}")
        if not variant.exact:
            return
        results = figures.outcomes["result"] * (variant.wanted or 1)
        raced = got.triggered - results  # came in the same instant as a cancellation or timeout
        lost = sum((one.run.session, one.run.trigger) in figures.given_up for one in sent)
        text = f"{got.triggered} containers counted as triggered, {results} results"
        demand(0 <= raced <= figures.outcomes["cancelled"], text)
        text = f"{lost} containers of given-up triggers, {raced} of them just in time"
        demand(got.late == lost - raced, f"{text}; {got.late} counted as late")
        nobodys = got.streamed + got.unclaimed
        demand(nobodys == 0, f"{nobodys} are nobody's")


def _is_idle(status: Status) -> bool:
    return Status.WAITING_FOR_TRIGGER in status or Status.RUNNING not in status


@contextlib.asynccontextmanager
async def _listening(client: Camera) -> AsyncIterator[None]:
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


# ---------------------------------------------------------------------- what a debt costs

LONG = 2.0
"""Seconds of a trigger's timeout beside which the client's grace is short."""


async def debt_cost(late: float, dialect: str = "handbook") -> float:
    """Return how much later a trigger is sent behind one that was given up, milliseconds.

    The result of that one comes ``late`` seconds after its timeout.
    """
    ear = TriggerEar()
    paces = itertools.chain((0.05 + late,), itertools.repeat(0.001))
    camera = LineCamera(dialect=dialect)
    camera.plan = lambda _: ((next(paces), 0), (0.0, AGAIN))
    async with camera, smartcam.connect(camera.url, observers=[ear]) as client:
        with contextlib.suppress(exceptions.TriggerTimeoutError):
            await client.trigger(timeout=0.05)
        begun = asyncio.get_running_loop().time()
        await client.trigger(timeout=LONG)
        return 1000 * (max(one.at for some in ear.sendings.values() for one in some) - begun)


async def debt_costs(rounds: int) -> str:
    """Return medians over some rounds, as text: for results a little late, and much."""
    lines = []
    for dialect, late in itertools.product(("handbook", "bid"), (0.01, 0.1, 1.0)):
        costs = [await debt_cost(late, dialect) for _ in range(rounds)]
        what = f"{dialect}: result {1000 * late:.0f} ms late, next timeout {LONG:g} s"
        lines.append(f"{what}: its trigger goes out {statistics.median(costs):.1f} ms later")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the storm; return 1 where something was that must not be."""
    about = "Storm of late results."
    failed = run_command(LateStorm, VARIANTS, arguments, about=about, triggers=10_000, at_once=4)
    print(asyncio.run(debt_costs(10)))  # noqa: T201
    return failed


if __name__ == "__main__":
    sys.exit(main())
