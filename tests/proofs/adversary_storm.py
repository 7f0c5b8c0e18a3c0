"""Storm of an adversary: whatever we, a sensor and an operator do, a result is the trigger's own.

A camera at the end of a line (``line_camera.py``: it does what ``docs/promises.md`` assumes, and
uses all freedom that this leaves) and callers who trigger it, one or several side by side. Chance
decides how long the line is, how many results a run sends, in which order and how late; who gives
up, by timeout or cancelled, most often right behind the sending; when a sensor triggers, around our
trigger's sending and arrival and in runs that count up to our next number; when an operator stops,
starts and loads; when a client ends and the next one begins, and when the link is lost.

The camera knows whose each container is, and when its run began. Of each result it is asked whether
it is of the Trigger message that the call sent. Over UDP, where a sensor triggers, it may be of the
sensor's instead, if that run began when the message had been sent.

Long form: ``python -m tests.proofs.adversary_storm --triggers 5000 --seed 1`` (per variant; prints
a table, exit 1 on a violation).
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any

import smartcam
from smartcam import exceptions
from smartcam.camera import Camera
from smartcam.models import Statistics
from tests.client.camera_by_hand import NUMBER, RESULT, TRIGGER
from tests.client.line_camera import APPLICATIONS, LAYOUTS, LineCamera, Run, Step
from tests.proofs.storm import HANG, LONGEST_HOLD, Storm, Variant, run_command

INSPECTION = 0.002
"""Seconds that a run takes, more or less."""

MAX_RUNS = 1_100
"""Runs of a sensor between two triggers."""

BITS = {"": 0, "int32": 32, "int16": 16, "int8": 8}
FAST = smartcam.Backoff(initial=0.001, factor=2, maximum=0.01, jitter=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Adversary(Variant):
    """Deeds done to a camera."""

    line: tuple[float, float] = (0.0, 0.01)
    # sensor, operator: they are there
    sensor: bool = False
    operator: bool = False
    lives: bool = False  # clients end, and the next one begins at once
    drops: bool = False  # the camera drops the link now and then
    callers: int = 1  # side by side
    mixed: bool = False  # some numbers are set by hand, and some triggers are without number
    # lost, doubled: share of the datagrams
    lost: float = 0.0
    doubled: float = 0.0

    @property
    def ours(self) -> bool:
        """Nobody else does anything to the camera, and nothing that it says is lost."""
        return self.transport == "tcp" and not self.sensor and not self.operator


SHORT_LINE = (0.0, 0.003)
LONG_LINE = (0.008, 0.01)
SEVERAL = (1, 3)
EVERYTHING: dict[str, Any] = {"operator": True, "lives": True, "drops": True, "callers": 3}
NUMBERED_UDP: dict[str, Any] = {"transport": "udp", "number": "int32", "doubled": 0.1, "held": 0.2}


def sensed(name: str, **more: Any) -> Adversary:
    """Return a variant with a sensor, none of whose results may be taken."""
    return Adversary(name=name, sensor=True, **more)


VARIANTS = (
    Adversary(name="tcp"),
    Adversary(name="tcp several results", results=SEVERAL),
    Adversary(name="tcp several results, short line", results=SEVERAL, line=SHORT_LINE),
    Adversary(name="tcp several results, long line", results=SEVERAL, line=LONG_LINE, share=0.5),
    Adversary(name="tcp several results, no line", results=SEVERAL, line=(0.0, 0.0)),
    Adversary(name="tcp several results thesis", results=SEVERAL, dialect="thesis"),
    Adversary(name="tcp several results b16", results=SEVERAL, dialect="b16"),
    Adversary(name="tcp two results wanted", results=(2, 2), wanted=2),
    Adversary(name="tcp callers", results=SEVERAL, callers=3),
    Adversary(name="tcp lives", results=SEVERAL, lives=True),
    Adversary(name="tcp lives, drops", results=SEVERAL, lives=True, drops=True, callers=2),
    Adversary(name="tcp operator", results=SEVERAL, operator=True),
    sensed("tcp sensor"),
    sensed("tcp sensor, short line", line=SHORT_LINE),
    sensed("tcp sensor, long line", line=LONG_LINE, share=0.5),
    sensed("tcp sensor, several", results=SEVERAL),
    sensed("tcp sensor thesis", results=SEVERAL, dialect="thesis"),
    sensed("tcp sensor b16", results=SEVERAL, dialect="b16"),
    sensed("tcp sensor, two wanted", results=(2, 2), wanted=2),
    sensed("tcp everything", results=SEVERAL, **EVERYTHING),
    Adversary(name="tcp number", number="int32", results=SEVERAL),
    Adversary(name="tcp number, two wanted", number="int32", results=(2, 3), wanted=2),
    Adversary(name="tcp number mixed", number="int32", results=SEVERAL, mixed=True),
    Adversary(name="tcp number, sensor", number="int32", results=SEVERAL, sensor=True),
    Adversary(
        name="tcp number, everything b16",
        number="int32",
        dialect="b16",
        results=SEVERAL,
        sensor=True,
        **EVERYTHING,
    ),
    Adversary(name="tcp int16", number="int16", results=SEVERAL),
    Adversary(name="tcp int8", number="int8", results=SEVERAL),
    sensed("tcp int16, sensor", number="int16", results=SEVERAL),
    sensed("tcp int8, sensor", number="int8", results=SEVERAL),
    Adversary(name="tcp bid", dialect="bid", share=0.5, results=SEVERAL),
    Adversary(name="tcp bid, lives", dialect="bid", share=0.5, results=SEVERAL, lives=True),
    sensed("tcp bid, sensor", dialect="bid", share=0.5, results=SEVERAL),
    Adversary(name="udp number", **NUMBERED_UDP, share=0.4, results=SEVERAL, lost=0.03),
    Adversary(name="udp number, two wanted", **NUMBERED_UDP, results=(2, 2), wanted=2),
    # number and Trigger are two datagrams: a sensor's run between them has our number
    sensed("udp number, sensor", rule="fresh", **NUMBERED_UDP, results=SEVERAL),
    Adversary(name="best effort: udp", rule="count", transport="udp", results=SEVERAL),
    Adversary(
        name="best effort: udp, sensor", rule="count", transport="udp", sensor=True, held=0.1
    ),
    Adversary(name="best effort: udp bid", rule="count", transport="udp", dialect="bid", share=0.5),
)


class AdversaryStorm(Storm[Adversary]):
    """Does everything to a camera that may be done."""

    camera: LineCamera
    columns = (
        ("calls", lambda one: one.calls),
        ("results", lambda one: one.outcomes["result"]),
        ("timeouts", lambda one: one.outcomes["TriggerTimeoutError"]),
        ("cancelled", lambda one: one.outcomes["cancelled"]),
        ("overtrig", lambda one: one.outcomes["OvertriggeredError"]),
        ("other", lambda one: one.other),
        ("sent", lambda one: one.sent),
        ("late", lambda one: one.late),
        ("extra", lambda one: one.extra),
        ("clients", lambda one: one.lives),
        ("sessions", lambda one: one.sessions),
        ("stops", lambda one: one.stopped),
        ("queries", lambda one: one.queries),
        ("dropped", lambda one: one.overtriggers),
        ("fresh", lambda one: one.fresh),
        ("stale", lambda one: one.stale),
        ("another's", lambda one: one.others),
        ("in a row", lambda one: one.longest),
        ("seconds", lambda one: f"{one.seconds:.1f}"),
    )

    def __init__(self, variant: Adversary, chance: Random) -> None:
        super().__init__(variant, chance)
        self._doomed: set[asyncio.Task[Any]] = set()  # to be cancelled at their sending
        self._numbers = (0, 0)  # of our last two triggers
        self._by_hand = 7
        self._others: set[asyncio.Task[None]] = set()  # what others do to the camera
        self._ended = asyncio.Event()
        self.ear.at_trigger = self._at_trigger

    def make_camera(self) -> LineCamera:
        variant = self.variant
        camera = LineCamera(dialect=variant.dialect, transport=variant.transport, delay=self.delay)
        camera.plan, camera.network = self._plan, self.network
        camera.before, camera.between = self._before, self._between
        camera.splits = lambda: self.happens(0.3)
        return camera

    async def live(self, calls: int) -> None:
        """Have calls made, by one client or by many."""
        figures = self.figures
        while figures.calls < calls:
            left = calls - figures.calls
            await self._live(min(left, self._chance.choice((1, 1, 1, 2, 4, 10))), calls)
        await self._calm()
        if self.variant.ours:
            text = f"ours dropped each other {self.camera.overtriggers} times"
            figures.demand(not self.camera.overtriggers, text)

    # ------------------------------------------------------------------ what chance decides

    @property
    def _way(self) -> float:
        """Seconds from a trigger to its result, about."""
        return self._scale * (sum(self.variant.line) + INSPECTION)

    def _plan(self, _: Run) -> Sequence[Step]:
        """Say results and Waiting for Trigger in any order, together or apart."""
        chance = self._chance
        said = list(range(chance.randint(*self.variant.results)))

        def pause(_: int) -> float:
            longest = self.variant.line[1] * chance.choice((1, 1, 5)) + 0.001
            return chance.uniform(0, longest) if self.happens(0.6) else 0.0

        waiting = len(said) if self.variant.dialect == "bid" else chance.randint(0, len(said))
        return self.steps(INSPECTION * chance.uniform(0.1, 1.9), waiting, said, pause)

    def _before(self, _: int, number: int | None) -> None:
        if number is not None:
            self._numbers = (self._numbers[1], number)

    def _between(self, _: int, __: int | None) -> None:
        """Have a whole run of a sensor between a Query and the Trigger behind it."""
        if self.variant.sensor and self.happens(0.05) and self.camera.takes_trigger:
            self.camera.sensor_runs(1)

    def network(self, message_id: int) -> Sequence[float]:
        """Lose some datagrams, too, and bring some twice."""
        variant = self.variant
        if message_id in {RESULT, -NUMBER, -TRIGGER} and self.happens(variant.lost):
            return ()
        if message_id == RESULT and self.happens(variant.doubled):
            return (*super().network(message_id), self._chance.uniform(0, LONGEST_HOLD))
        return super().network(message_id)

    def _at_trigger(self, task: asyncio.Task[Any]) -> None:
        """Have it given up, and a sensor trigger, around its sending and its arrival."""
        loop = asyncio.get_running_loop()
        if task in self._doomed:
            when = self._chance.choice((0.0, 0.0, self._chance.uniform(0, self._way)))
            loop.call_later(when, task.cancel)
        if self.variant.sensor and self.happens(0.3):
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
        if self.happens(0.4):
            camera.load(self._chance.choice(APPLICATIONS))
            await asyncio.sleep(2 * pause)
        camera.start()

    async def _drop(self) -> None:
        await asyncio.sleep(self._chance.uniform(0, self._way))
        self.camera.drop_link()

    def _unrest(self) -> None:
        """Do something to the camera right before a call, perhaps."""
        variant = self.variant
        if variant.sensor and self.happens(0.1):
            self.camera.sensor()
        if variant.sensor and variant.number and self.happens(0.04):
            self._race()
        if variant.operator and not self._others and self.happens(0.1):
            self._other(self._operate())
        if variant.drops and self.happens(0.03):
            self._other(self._drop())

    def _race(self) -> None:
        """Have a sensor trigger until its last run carries our next number, or almost that."""
        before, last = self._numbers
        rounds = 1 << BITS[self.variant.number]
        runs = (2 * last - before - self.camera.next_number + 1) % rounds
        runs += self._chance.choice((-1, 0, 0, 1))
        if 0 < runs <= MAX_RUNS and self.camera.takes_trigger:
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
        self._audit(account, heard=last and not drops, first_session=first_session)

    async def _caller(self, client: Camera, until: int) -> None:
        while self.figures.calls < until and not self._ended.is_set():
            self.figures.calls += 1
            await self._call(client)
            if self.happens(0.4):  # what is on the line comes before the next one goes out
                await asyncio.sleep(self._chance.uniform(0, self._way))

    async def _call(self, client: Camera) -> None:
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
        if variant.mixed and self.happens(0.3):
            options["interpret_as"] = LAYOUTS[""]
        if variant.mixed and self.happens(0.2):
            self._by_hand += 10_000
            await client.set_sequence_number(self._by_hand)
        task: asyncio.Task[Any] = asyncio.create_task(client.trigger(**options))
        cancelled = chance.uniform(0, 1.3 * self._way) if manner == "cancelled" else None
        if manner == "at sending":
            self._doomed.add(task)
        outcome = await self.end(task, cancelled)
        self._doomed.discard(task)
        if manner == "hasty":
            self.keep_pace(outcome)
        await self._come_back(client, outcome)

    async def _come_back(self, client: Camera, outcome: str) -> None:
        """Do what somebody does who wants to go on."""
        if outcome == "NotRunningError":
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

    async def _hear_the_rest(self, client: Camera) -> None:
        """Have every container that was sent."""
        await self._calm()
        await self.quiet()
        with contextlib.suppress(exceptions.LinkError):
            await client.query_application()

    def _audit(self, got: Statistics, *, heard: bool, first_session: int) -> None:
        self.audit(got)
        sent = self.camera.sent_since(first_session)
        text = f"{sent} containers sent, {got.received} received"
        if self.variant.transport == "tcp":
            right = got.received == sent if heard else got.received <= sent
            self.figures.demand(right, text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the storm; return 1 where something was that must not be."""
    about = "Storm of an adversary."
    return run_command(AdversaryStorm, VARIANTS, arguments, about=about, triggers=5_000, at_once=40)


if __name__ == "__main__":
    sys.exit(main())
