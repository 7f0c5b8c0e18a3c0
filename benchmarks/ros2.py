"""ROS 2 without ROS: pictures, calls, detections, and what a camera's node adds to the camera.

Pictures and calls go from one process to another over TCP, beside zenoh-ros2-sdk and bare Zenoh,
which has the bytes ready and makes nothing of them. Their cost is the CPU time of both processes,
the engine's threads included. Each picture's bytes are compared with those that were sent, so none
is lost or mixed up, or the run fails.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import json
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

import smartcam
from benchmarks.measure import (
    Comparison,
    Goal,
    Plan,
    Series,
    cpu_microseconds,
    take_turns,
    take_turns_awaiting,
)
from benchmarks.peers import peer
from benchmarks.peers.control import Control

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

__all__ = ["run"]

PICTURES = 100
CALLS = 500
MESSAGES = 400
TRIGGERS = 200
"""In a round of each side."""

SIZES = (1, 20, 100)
"""Cameras of an agent."""

IDLE = 5.0
"""Seconds in which nothing is asked of it."""

LIMIT = 60.0
"""Seconds until what does not come is an error."""

SMARTCAM, SDK, ZENOH = "smartcam", "zenoh-ros2-sdk", "zenoh"
KINDS = {SMARTCAM: "smartcam", SDK: "sdk", ZENOH: "zenoh"}
DETECTIONS = "vision_msgs/msg/Detection3DArray"
POSES = "geometry_msgs/msg/PoseArray"
TRIGGER = "smartcam_msgs/srv/TriggerResults"
DOMAIN = 7

PICTURE = "picture of 1.31 MB, publisher to subscriber"
CALL = "call of a std_srvs/SetBool"
BOTH = (
    "two processes, two pictures on their way at once; each compared with what was sent; none is "
    "lost, or the run fails, except of zenoh-ros2-sdk, which loses one now and then"
)
CPU = "CPU time of both processes, the engine's threads included"
TEN = "one message with ten localizations: from smartcam's values to bytes, and back to a message"
HEARD = "the same, and published to a subscriber in another process; the engine's threads included"
IDLE_OF = ("CPU of each", "memory of each")
NODE = "the one in the middle on the wall clock, above the same camera triggered at the wire"
IDLING = (
    "above an agent with as many cameras and without `ros2`; CPU in thousandths of a second a "
    "second, of a camera without frames and with a subscriber of none of its topics"
)


def run(plan: Plan) -> Iterator[Comparison]:
    """Measure what goes between processes, then what is made, then cameras."""
    missing = [one for one in ("zenoh", "rosbags", "xxhash") if not importlib.util.find_spec(one)]
    if missing:
        print(f"ros2: left out: {', '.join(missing)} (smartcam[ros2])", file=sys.stderr)
        return
    kinds = [SMARTCAM, SDK, ZENOH]
    if importlib.util.find_spec("zenoh_ros2_sdk") is None:
        print("ros2: without zenoh-ros2-sdk, which is not installed", file=sys.stderr)
        kinds.remove(SDK)
    with contextlib.ExitStack() as stack:
        pairs = _pairs(kinds, stack)
        yield from _pictures(plan, pairs)
        yield from _calls(plan, pairs)
        yield from asyncio.run(_detections(plan, pairs[SMARTCAM]))
    with peer("trigger", "together") as port:
        yield from _cameras(plan, port)


class End:
    """A process that does what it is told; see :mod:`benchmarks.peers.ros2_end`.

    Args:
        kind: of its ends.
        port: of the router.
        folder: for message definitions.
    """

    def __init__(self, kind: str, port: int, folder: str) -> None:
        self.port = port
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.peers.ros2_end", KINDS[kind], str(port), folder],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __call__(self, do: str, **more: Any) -> Any:
        """Have it do something, and return what came of it."""
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps({"do": do, **more}) + "\n")
        process.stdin.flush()
        line = process.stdout.readline()
        if not line:
            raise RuntimeError(f"a peer on port {self.port} ended at {do}")
        return json.loads(line)

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.communicate()


class Pair:
    """Two ends of one kind: who publishes and serves, and who hears and calls."""

    def __init__(self, near: End, far: End) -> None:
        self.near, self.far = near, far
        self.found: list[list[float]] = []

    def measure(self, do: str, count: int) -> float:
        """Return microseconds of CPU time of both; what came of it is kept."""
        begin = self._cpu()
        found = self.far(do, count=count)
        took = self._cpu() - begin
        self.found.append([count / found] if do == "take" else [1e3 * one for one in found])
        return took / count * 1e6

    def _cpu(self) -> float:
        return float(self.near("usage")[0] + self.far("usage")[0])

    def series(self, name: str, unit: str, quantile: float) -> Series:
        """Return what the rounds gave, without the first, which warms up; and forget it."""
        rounds, self.found = self.found[1:], []
        return Series(name, unit, [float(np.quantile(one, quantile)) for one in rounds])


def _pairs(kinds: list[str], stack: contextlib.ExitStack) -> dict[str, Pair]:
    folder = stack.enter_context(tempfile.TemporaryDirectory())
    ros, bare = _free_port(), _free_port()

    def end(kind: str) -> End:
        made = End(kind, bare if kind == ZENOH else ros, folder)
        stack.callback(made.close)
        return made

    found: dict[str, Pair] = {}
    for kind in kinds:  # smartcam first: its source is the router of ROS
        near = end(kind)
        port = near("source")
        near("serve")
        far = end(kind)
        far("sink", port=port)
        far("client")
        found[kind] = Pair(near, far)
    return found


def _free_port() -> int:
    from smartcam._zenoh import with_ports

    (place,) = with_ports(["tcp/127.0.0.1:0"])
    return int(place.rpartition(":")[2])


def _sides(pairs: dict[str, Pair], do: str, count: int) -> dict[str, Callable[[], float]]:
    return {kind: partial(pair.measure, do, count) for kind, pair in pairs.items()}


# ---------------------------------------------------------------------- between processes


def _pictures(plan: Plan, pairs: dict[str, Pair]) -> Iterator[Comparison]:
    cpu = take_turns(plan, _sides(pairs, "take", plan.operations(PICTURES, least=4)))
    rates = {kind: pair.series(kind, "pictures/s", 0.5) for kind, pair in pairs.items()}
    ours, goal = rates[SMARTCAM], Goal("at least", 400, "pictures/s")
    yield Comparison("ros2", PICTURE, ours, rates[ZENOH], "alone", goal, BOTH)
    for other in pairs.keys() - {SMARTCAM, ZENOH}:
        yield Comparison("ros2", PICTURE, ours, rates[other])
    yield from _against(f"{PICTURE}, CPU", cpu)


def _calls(plan: Plan, pairs: dict[str, Pair]) -> Iterator[Comparison]:
    cpu = take_turns(plan, _sides(pairs, "call", plan.operations(CALLS, least=10)))
    rounds = {kind: pair.found for kind, pair in pairs.items()}
    for quantile, goal in ((0.5, Goal("at most", 1, "ms")), (0.99, None)):
        waited: dict[str, Series] = {}
        for kind, pair in pairs.items():
            pair.found = rounds[kind]
            waited[kind] = pair.series(kind, "ms", quantile)
        case, ours = f"{CALL}, p{quantile * 100:.0f}", waited.pop(SMARTCAM)
        for number, other in enumerate(waited.values()):
            yield Comparison("ros2", case, ours, other, "alone", None if number else goal)
    yield from _against(f"{CALL}, CPU", cpu)


def _against(case: str, cpu: dict[str, Series]) -> Iterator[Comparison]:
    for kind, series in cpu.items():
        if kind != SMARTCAM:
            yield Comparison("ros2", case, cpu[SMARTCAM], series, note=CPU)


# ---------------------------------------------------------------------- made and published


def _ten() -> Any:
    """Return a result with ten localizations."""
    from smartcam.models import Header, Localization, Pose, Position, Quaternion, Result

    at = datetime(2026, 1, 2, 3, 4, 5, 678_000, UTC)
    parts = [
        Localization(
            f"part {number}",
            0.9,
            7,
            Pose(
                Header(0, at, "cam3"), Position(0.1 * number, 0.2, 0.0), Quaternion(0, 0, 0.6, 0.8)
            ),
        )
        for number in range(10)
    ]
    return Result("cam3", 7, None, 1, None, at, None, bytes(700), parts)


async def _detections(plan: Plan, pair: Pair) -> list[Comparison]:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from smartcam.ros2 import Node
    from smartcam.ros2._cameras.messages import ResultMessages

    topic, count = "/bench/detections", plan.operations(MESSAGES, least=10)
    result = _ten()
    async with (
        asyncio.timeout(LIMIT * (plan.rounds + 1)),
        Node("bench", connect=f"tcp/127.0.0.1:{pair.near.port}", domain=DOMAIN) as node,
    ):
        kind, make = node.types.message(DETECTIONS), ResultMessages(node.types, "cam3", "cam3")
        store = get_typestore(Stores.ROS2_JAZZY)
        names = [DETECTIONS, *(f"vision_msgs/msg/{one}" for one in NESTED)]
        for name in names:
            store.register(get_types_from_msg(node.types.message(name).text, name))
        message = make.detections(result, result.value)
        data = kind.encode(message)
        assert bytes(store.serialize_cdr(message, DETECTIONS)) == data
        publisher = node.publisher(topic, DETECTIONS)
        pair.far("hear", topic=topic, kind=DETECTIONS)
        while not publisher.has_subscribers:  # noqa: ASYNC110 - there is no event for it
            await asyncio.sleep(0.01)

        def timed(work: Callable[[], object]) -> float:
            begin = time.process_time()
            for _ in range(count):
                work()
            return cpu_microseconds(begin, count) / 1e3

        def publish() -> None:
            publisher.publish(make.detections(result, result.value))
            if not publisher.published % 8:  # a queue of the engine's takes 16, and drops then
                time.sleep(0.002)

        series = take_turns(
            plan,
            {
                "made": lambda: timed(lambda: kind.encode(make.detections(result, result.value))),
                "published": lambda: timed(publish),
                "encoded": lambda: timed(lambda: kind.encode(message)),
                "decoded": lambda: timed(lambda: kind.decode(data)),
                "rosbags writes": lambda: timed(lambda: store.serialize_cdr(message, DETECTIONS)),
                "rosbags reads": lambda: timed(lambda: store.deserialize_cdr(data, DETECTIONS)),
            },
            unit="ms",
        )
        published = count * (plan.rounds + 1)
        await asyncio.sleep(0.2)
        heard = pair.far("heard")
        assert published >= heard >= 0.8 * published, (heard, published)
    case, goal = "Detection3DArray of ten", Goal("at most", 0.15, "ms")
    writes, reads = series["rosbags writes"], series["rosbags reads"]
    return [
        Comparison("ros2", f"{case}, made", series["made"], None, "alone", goal, TEN),
        Comparison("ros2", f"{case}, published", series["published"], how="alone", note=HEARD),
        Comparison("ros2", f"{case}, encoded", series["encoded"], writes),
        Comparison("ros2", f"{case}, decoded", series["decoded"], reads),
    ]


NESTED = (
    "BoundingBox3D",
    "Detection3D",
    "ObjectHypothesis",
    "ObjectHypothesisWithPose",
)


# ---------------------------------------------------------------------- cameras


def _cameras(plan: Plan, port: int) -> Iterator[Comparison]:
    seconds = IDLE * max(plan.scale, 0.1)
    for count in SIZES[:1] if plan.quick else SIZES:
        with peer("ros2_agent", str(count), str(port), "plain") as control:
            plain = _idle(Control(control), seconds, count)
        with peer("ros2_agent", str(count), str(port), "ros") as control:
            agent = Control(control)
            ours = _idle(agent, seconds, count)
            (at,) = agent.usage().ports
            yield from asyncio.run(_newcomer(at, count))
            for what, unit, one, other in zip(IDLE_OF, ("ms/s", "KiB"), ours, plain, strict=True):
                with_it, without = (
                    Series("with ros2", unit, [one]),
                    Series("without", unit, [other]),
                )
                case = f"{count} camera nodes, idle, {what}"
                yield Comparison("ros2", case, with_it, without, "more", note=IDLING)
            if count == 1:
                yield from asyncio.run(_triggers(plan, port, at))


def _idle(agent: Control, seconds: float, count: int) -> tuple[float, float]:
    """Return milliseconds of CPU time a second and KiB, of each camera."""
    time.sleep(seconds / 2)
    before = agent.usage()
    time.sleep(seconds)
    after = agent.usage()
    cpu = (after.cpu - before.cpu) / seconds * 1e3
    return cpu / count, (after.resident - after.before) / count


async def _newcomer(port: int, count: int) -> list[Comparison]:
    from smartcam.ros2 import Node

    how: Any = {"connect": f"tcp/127.0.0.1:{port}", "domain": DOMAIN, "parameters": False}
    async with asyncio.timeout(LIMIT):
        async with Node("first", **how) as first:  # what there is, of which nobody tells the end
            tokens = await _settled(first, count)
        begin = time.perf_counter()
        async with Node("late", **how) as late:
            while len(tuple(late.graph)) < tokens:  # noqa: ASYNC110 - there is no event for it
                await asyncio.sleep(0.001)
            took = Series("seconds", "s", [time.perf_counter() - begin])
    note = f"{tokens} tokens; a node that opens in another process, until its graph has all"
    case = f"{count} camera nodes, until a newcomer sees all"
    return [Comparison("ros2", case, took, how="alone", note=note)]


async def _settled(node: Any, count: int) -> int:
    """Return how many tokens there are, when no more come."""
    before = -1
    while (now := len(tuple(node.graph))) != before or len(node.graph.nodes()) <= count:
        before = now
        await asyncio.sleep(0.3)
    return now


async def _triggers(plan: Plan, port: int, at: int) -> list[Comparison]:
    from smartcam.ros2 import Node, QoS

    count = plan.operations(TRIGGERS, least=10)
    options: Any = {"interpret_as": "localizations"}
    async with (
        asyncio.timeout(LIMIT * (plan.rounds + 1)),
        smartcam.connect(f"bvs://127.0.0.1:{port}?dialect=handbook", **options) as direct,
        smartcam.connect(f"fleet://127.0.0.1:{at}/cam0", **options) as fleet,
        Node("viewer", connect=f"tcp/127.0.0.1:{at}", domain=DOMAIN) as node,
    ):
        poses = node.subscribe("/cam0/localizations", POSES, qos=QoS(depth=5))
        client = node.client("/cam0/trigger_results", TRIGGER)

        async def service() -> float:
            (result,) = (await client.call()).results
            took = time.perf_counter()
            assert len(result.localizations) == 5
            await anext(poses)
            return took

        async def topic() -> float:
            asking = asyncio.ensure_future(fleet.trigger())
            assert len((await anext(poses)).poses) == 5
            took = time.perf_counter()
            await asking
            return took

        async def shared() -> float:
            await fleet.trigger()
            took = time.perf_counter()
            await anext(poses)
            return took

        async def at_wire() -> float:
            await direct.trigger()
            return time.perf_counter()

        async def measure(work: Callable[[], Awaitable[float]]) -> float:
            """Return the one in the middle, milliseconds."""
            took: list[float] = []
            for _ in range(count):
                begin = time.perf_counter()
                took.append(await work() - begin)
            return 1e3 * statistics.median(took)

        await _active(client, poses)
        works = {"service": service, "topic": topic, "fleet://": shared, "at the wire": at_wire}
        sides = {name: partial(measure, work) for name, work in works.items()}
        series = await take_turns_awaiting(plan, sides, unit="ms")
    case = "camera's node, 5 localizations, {}"
    return [
        Comparison("ros2", case.format(what), series[name], series[other], "more", note=NODE)
        for name, what in (("service", "trigger_results"), ("topic", "trigger to PoseArray"))
        for other in ("at the wire", "fleet://")
    ]


async def _active(client: Any, poses: Any) -> None:
    """Have the node publish what is triggered, and nothing wait."""
    while not poses.statistics().offered:
        await client.call(timeout=LIMIT)
        await asyncio.sleep(0.1)
    while poses.statistics().queued:
        await anext(poses)
