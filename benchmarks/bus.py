"""The fleet's bus: triggers and results through an agent, against a camera at the wire.

The agent is a process of its own, and so is the camera: the canned one of the benchmark
``trigger``, which is not counted. Counted is the CPU time of agent and program together, the
engine's threads included. Direct is the same camera, at the wire, in the same run. The yardsticks
do nothing but send and wait: Zenoh without asyncio or smartcam, and a pair of asyncio protocols
over TCP; with a question and an answer as long as a trigger's, and with results in batches. So do
what a program would use in place of the fleet: a query of Zenoh's, and a message of MQTT and its
answer, each between two event loops in processes of their own; the broker's CPU time counts.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import statistics
import sys
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import smartcam
import smartcam.fleet
from benchmarks.measure import (
    Comparison,
    Cost,
    Goal,
    Plan,
    Series,
    cpu_microseconds,
    take_turns_awaiting,
)
from benchmarks.peers import peer, wire
from benchmarks.peers.agent import fleet_file
from benchmarks.peers.answering import broker
from benchmarks.peers.control import Control
from benchmarks.peers.echo import RESULTS, Zenoh, asking
from benchmarks.yardsticks import BareClient

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator

    from smartcam.models import SubscriberStatistics

__all__ = ["run"]

TRIGGERS = 400
"""In a round of each side."""

STREAM = 200_000
"""Results in a round of each side."""

LAYOUT = (
    "table: (feature_id: string[50], quality: real32, photo_index: int32, "
    "x: real32, y: real32, theta: real32)*"
)
DIRECT, FLEET, INSIDE = "direct", "fleet", "fleet, in-process bus"
ZENOH, TCP = "zenoh", "asyncio TCP"
QUERY, MQTT = "zenoh query from asyncio", "MQTT request and reply"
BATCHES, ITEMS = "batch=True", "item by item"
HOW = ("together", "apart")
RATE = 20_000
LIMIT = 60.0
"""Seconds until a stream that is not through is an error."""

CPU = "CPU time of agent and program together, the engine's threads included"
BARE = "a question and an answer as long as a trigger's, or batches; both sides together"
WALL = "the one in the middle on the wall clock, above direct"
ASKED = "a question and an answer as long as a trigger's; all processes, without a camera's work"
LOST = f"{STREAM:,} of them from one agent to one program; none is lost, or the run fails"


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure triggers, and a stream of results."""
    if importlib.util.find_spec("zenoh") is None:
        print("bus: left out: Zenoh is not installed (smartcam[fleet])", file=sys.stderr)
        return
    with contextlib.ExitStack() as stack:
        cameras = {how: stack.enter_context(peer("trigger", how)) for how in HOW}
        cameras["free"] = stack.enter_context(peer("stream"))
        # one each: a link that is not alone in its process gives way to the others again and again
        agents = {name: stack.enter_context(_agent({name: port})) for name, port in cameras.items()}
        echoes = {
            name: Control(stack.enter_context(peer("echo", kind)))
            for name, kind in ((ZENOH, "zenoh"), (TCP, "tcp"))
        }
        others = {QUERY: stack.enter_context(_asked_by_query())}
        if (asked := stack.enter_context(_asked_by_messages())) is not None:
            others[MQTT] = asked
        else:
            print("bus: MQTT is left out: no mosquitto, or no aiomqtt", file=sys.stderr)
        for how in HOW:
            yield from asyncio.run(_triggers(plan, how, cameras[how], agents[how], echoes, others))
        yield from asyncio.run(_stream(plan, cameras["free"], agents["free"], echoes))


@contextlib.contextmanager
def _agent(cameras: dict[str, int]) -> Iterator[Control]:
    with peer("agent", *(f"{name}={port}" for name, port in cameras.items())) as control:
        yield Control(control)


class Asked:
    """A pair of processes that ask and answer over a bus of others.

    Args:
        asker: the one that asks on request.
        clocks: what tells the CPU time of every process that takes part.
    """

    def __init__(self, asker: Control, *clocks: Callable[[], float]) -> None:
        self._asker = asker
        self.clocks = clocks

    def ask(self, count: int) -> None:
        """Have so many questions asked, one after the other."""
        self._asker.do(count)


def _clock(control: Control) -> Callable[[], float]:
    return lambda: control.usage().cpu


@contextlib.contextmanager
def _asked_by_query() -> Iterator[Asked]:
    with peer("answering", "query") as answering:
        answers = Control(answering)
        (port,) = answers.usage().ports
        with peer("answering", "query", str(port)) as asking:
            asks = Control(asking)
            yield Asked(asks, _clock(asks), _clock(answers))


@contextlib.contextmanager
def _asked_by_messages() -> Iterator[Asked | None]:
    with broker() as between:
        if between is None:
            yield None
            return
        port = str(between.port)
        with (
            peer("answering", "mqtt", port) as answering,
            peer("answering", "mqtt", port, "ask") as asking,
        ):
            answers, asks = Control(answering), Control(asking)
            yield Asked(asks, _clock(asks), _clock(answers), between.cpu)


class Meter:
    """Sides of which another process has a share.

    Args:
        count: operations in a round.

    Attributes:
        rounds: what each round of a side took: microseconds of CPU time an operation here and in
            the other processes, and what its work returned.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self.rounds: dict[str, list[tuple[Cost, Cost, float]]] = {}

    def side(
        self, name: str, work: Callable[[], Awaitable[float]], *others: Callable[[], float]
    ) -> Callable[[], Awaitable[Cost]]:
        """Return a side whose cost is the CPU time of this process and the others.

        Args:
            name: name of the side.
            work: what is done in a round.
            *others: what tells the CPU time of each other process, seconds.
        """
        rounds = self.rounds.setdefault(name, [])

        async def measure() -> Cost:
            begin = sum(other() for other in others)
            here = time.process_time()
            found = await work()
            here = cpu_microseconds(here, self._count)
            there = (sum(other() for other in others) - begin) / self._count * 1e6
            rounds.append((here, there, found))
            return here + there

        return measure

    def series(self, name: str, what: Literal["here", "there", "found"], unit: str) -> Series:
        """Return what the rounds took, without the first, which warms up."""
        place = ("here", "there", "found").index(what)
        return Series(name, unit, [one[place] for one in self.rounds[name][1:]])


async def _bare(echo: Control) -> BareClient:
    loop = asyncio.get_running_loop()
    (port,) = echo.usage().ports
    return (await loop.create_connection(BareClient, "127.0.0.1", port))[1]


def _zenoh(echo: Control) -> Zenoh:
    (port,) = echo.usage().ports
    return Zenoh(connect=f"tcp/127.0.0.1:{port}")


# ---------------------------------------------------------------------- triggers


async def _triggers(
    plan: Plan,
    how: str,
    port: int,
    agent: Control,
    echoes: dict[str, Control],
    others: dict[str, Asked],
) -> list[Comparison]:
    count = plan.operations(TRIGGERS, least=5)
    meter = Meter(count)
    tcp, zenoh = await _bare(echoes[TCP]), _zenoh(echoes[ZENOH])
    question = asking(0)

    async def triggers(camera: smartcam.Camera) -> float:
        """Return the time of one in the middle, microseconds."""
        took: list[float] = []
        result: Any = None
        for _ in range(count):
            begin = time.perf_counter()
            result = await camera.trigger()
            took.append(time.perf_counter() - begin)
        assert len(result.value) == 5
        return statistics.median(took) * 1e6

    async def zenoh_side() -> float:
        for _ in range(count):
            zenoh.ask()
        return 0.0

    async def tcp_side() -> float:
        for _ in range(count):
            await tcp.ask(question, wire.RESULT)
        return 0.0

    async def asked(other: Asked) -> float:
        other.ask(count)
        return 0.0

    options: Any = {"interpret_as": "localizations"}
    async with (
        smartcam.connect(f"bvs://127.0.0.1:{port}?dialect=handbook", **options) as direct,
        smartcam.connect(f"fleet://127.0.0.1:{agent.usage().ports[0]}/{how}", **options) as shared,
        smartcam.fleet.open(fleet_file({how: port}), **options) as inside,
    ):
        cameras = {DIRECT: direct, FLEET: shared, INSIDE: inside[how]}
        sides = {
            name: meter.side(
                name, partial(triggers, camera), *([_clock(agent)] if name == FLEET else [])
            )
            for name, camera in cameras.items()
        }
        sides[ZENOH] = meter.side(ZENOH, zenoh_side, _clock(echoes[ZENOH]))
        sides[TCP] = meter.side(TCP, tcp_side, _clock(echoes[TCP]))
        for name, other in others.items():
            sides[name] = meter.side(name, partial(asked, other), *other.clocks)
        series = await take_turns_awaiting(plan, sides)
        for camera in cameras.values():
            counted = camera.statistics()
            assert counted.triggered == count * (plan.rounds + 1), counted
    zenoh.close()
    tcp.transport.close()
    case = f"await trigger(), 5 localizations, {how}"
    cpu, waits = Goal("at most", 3), Goal("at most", 1, "ms")
    waited = {
        name: Series(name, "ms", [1e-3 * one for one in meter.series(name, "found", "us").values])
        for name in (FLEET, DIRECT)
    }
    goals = {QUERY: Goal("at most", 1.2), MQTT: Goal("at most", 1)}
    return [
        *(
            Comparison("bus", case, series[FLEET], series[name], goal=goals[name], note=ASKED)
            for name in others
        ),
        Comparison("bus", case, series[FLEET], series[DIRECT], goal=cpu, note=CPU),
        Comparison("bus", case, series[FLEET], series[ZENOH], note=BARE),
        Comparison("bus", case, series[FLEET], series[TCP]),
        Comparison("bus", case, series[INSIDE], series[DIRECT]),
        Comparison("bus", f"{case}, p50", waited[FLEET], waited[DIRECT], "more", waits, note=WALL),
    ]


# ---------------------------------------------------------------------- results


async def _stream(
    plan: Plan, port: int, agent: Control, echoes: dict[str, Control]
) -> list[Comparison]:
    batches = plan.operations(STREAM // RESULTS)
    count = batches * RESULTS
    meter = Meter(count)
    tcp, zenoh = await _bare(echoes[TCP]), _zenoh(echoes[ZENOH])

    async def results(camera: smartcam.Camera, name: str) -> float:
        """Return how many came in a second."""
        begin = time.perf_counter()
        taking = _items if name == ITEMS else _batches
        async with asyncio.timeout(LIMIT):  # one that is lost never comes
            account = await taking(camera, count)
        took = time.perf_counter() - begin
        assert (account.taken, account.dropped, account.missed) == (count, 0, 0), account
        return count / took

    async def zenoh_side() -> float:
        begin = time.perf_counter()
        zenoh.ask(batches)
        return count / (time.perf_counter() - begin)

    async def tcp_side() -> float:
        begin = time.perf_counter()
        await tcp.ask(asking(batches), wire.RESULT, count)
        return count / (time.perf_counter() - begin)

    options: Any = {"interpret_as": LAYOUT}
    async with (
        smartcam.connect(f"bvs://127.0.0.1:{port}?dialect=handbook", **options) as direct,
        smartcam.connect(f"fleet://127.0.0.1:{agent.usage().ports[0]}/free", **options) as shared,
    ):
        sides = {
            ZENOH: meter.side(ZENOH, zenoh_side, _clock(echoes[ZENOH])),
            TCP: meter.side(TCP, tcp_side, _clock(echoes[TCP])),
        }
        for name in (BATCHES, ITEMS):
            for place, camera, clocks in ((DIRECT, direct, []), (FLEET, shared, [_clock(agent)])):
                called = f"{place}, {name}"
                sides[called] = meter.side(called, partial(results, camera, name), *clocks)
        series = await take_turns_awaiting(plan, sides)
        counted = shared.statistics()
        assert counted.streamed == 2 * count * (plan.rounds + 1), counted
    zenoh.close()
    tcp.transport.close()
    found: list[Comparison] = []
    for name in (BATCHES, ITEMS):
        through, at_wire = f"{FLEET}, {name}", f"{DIRECT}, {name}"
        case = f"results of 70 bytes, {name}"
        rates = {
            one: meter.series(one, "found", "results/s") for one in (through, at_wire, ZENOH, TCP)
        }
        goal = Goal("at least", RATE, "results/s")
        found += [
            Comparison("bus", case, rates[through], rates[at_wire], "alone", goal, LOST),
            Comparison("bus", case, rates[through], rates[ZENOH]),
            Comparison("bus", case, rates[through], rates[TCP]),
            Comparison("bus", f"{case}, CPU", series[through], series[at_wire], note=CPU),
            Comparison("bus", f"{case}, CPU", series[through], series[ZENOH]),
            Comparison("bus", f"{case}, CPU", series[through], series[TCP]),
            Comparison("bus", f"{case}, CPU of the agent", meter.series(through, "there", "us")),
            Comparison("bus", f"{case}, CPU of the program", meter.series(through, "here", "us")),
        ]
    return found


async def _items(camera: smartcam.Camera, count: int) -> SubscriberStatistics:
    stream = camera.results(max_queue=count)
    await camera.request(wire.TRIGGER, count.to_bytes(8, "little"), answered=False)
    missing = count
    async for result in stream:
        missing -= 1
        if not missing:
            assert result.value["photo_index"].tolist() == [0x39383736]
            break
    return stream.statistics()


async def _batches(camera: smartcam.Camera, count: int) -> SubscriberStatistics:
    stream = camera.results(batch=True, max_queue=count)
    await camera.request(wire.TRIGGER, count.to_bytes(8, "little"), answered=False)
    missing = count
    async for batch in stream:
        missing -= len(batch)
        if missing <= 0:
            assert batch[-1].value["photo_index"].tolist() == [0x39383736]
            break
    return stream.statistics()
