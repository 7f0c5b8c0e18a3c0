"""The processes of a plant: its cameras, its router, a program that uses all of it.

``python -m tests.proofs.plant_process`` with ``cameras COUNT [ADDRESS]``, ``router PLACE
CERTIFICATES``, ``program URL FIRST SEED``, ``visitor URL SECONDS``, ``joiner URL SECONDS``,
``holder URL CAMERA``, ``guest URL CAMERA TOKEN`` or ``strangers ADDRESS PORT COUNT``: each says on
stdout, as lines of JSON, what it sees, and most go on until a line comes on stdin.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import json
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from random import Random
from typing import Any

import smartcam.fleet
from smartcam import Disconnected, Reconnected, Result
from smartcam.exceptions import InputContainerError, SmartCamError
from smartcam.fleet import Fleet, FleetCamera
from tests.fleet.fleetkit import FAST, LAYOUT, PATIENCE, NumberedCamera
from tests.fleet.plantkit import router_end
from tests.proofs.chaos_soak import resident
from tests.proofs.fleet_storm import WITH_INPUT, call
from tests.proofs.plant_pace import Pace
from tests.proofs.plant_pair import PAIRED

AT_ONCE = 3
"""Calls of a program that are under way at a time."""

PAUSE = 0.15
"""Mean seconds between two of one of them."""

PATIENT = 10
QUEUE = 8
"""Results of a camera that a program has room for: who is stopped for long has more to read."""

LOOK = 0.2
SAMPLE = 2.0

GRACE = 2.0
"""Seconds after its deadline that a call may take on a computer that has much to do."""

LATELY = 5.0
"""Seconds for which this computer's pace is asked."""

RESERVING = 0.15
"""Share of a program's calls that are reservations."""

LAST = 30.0
"""Seconds of a call at the end, when nothing is wrong any more."""


def say(**what: Any) -> None:
    """Write a line."""
    print(json.dumps(what), flush=True)  # noqa: T201


async def told_to_end() -> None:
    """Wait for a line on stdin, or its end."""
    reader = asyncio.StreamReader()
    protocol = asyncio.StreamReaderProtocol(reader)
    await asyncio.get_running_loop().connect_read_pipe(lambda: protocol, sys.stdin)
    await reader.readline()


class ReportedCamera(NumberedCamera):
    """A camera that says at which host its session is.

    Args:
        number: of the camera.
        **options: as a numbered camera has them.
    """

    def __init__(self, number: int, **options: Any) -> None:
        super().__init__(**options)
        self._place, self._had = number, [""]

    def handle_message(self, link: Any, message: Any) -> None:
        """Hear a message, and say whose the session is, if that has changed."""
        super().handle_message(link, message)
        self._tell()

    def forget_link(self, link: Any) -> None:
        """Lose a link; the same."""
        super().forget_link(link)
        self._tell()

    def _tell(self) -> None:
        if self.sessions != self._had:
            self._had = self.sessions
            host = None
            if self._had:
                host = int(self._had[0].rpartition(":")[0].rpartition(".")[2])
            say(session=[self._place, host])


async def cameras(count: int, host: str = "127.0.0.1") -> None:
    """Be so many cameras; say in the end which token was executed how often, and the runs."""
    async with contextlib.AsyncExitStack() as stack:
        boxes = [
            await stack.enter_async_context(
                ReportedCamera(number, active=WITH_INPUT, time=0.005, host=host)
            )
            for number in range(count)
        ]
        say(urls=[box.url for box in boxes])
        await told_to_end()
    times = Counter(token for box in boxes for token in box.inputs.values())
    twice = {token: count for token, count in times.items() if count > 1}
    say(executed=times.total(), twice=twice)


async def router(place: str, certificates: str) -> None:
    """Be the router."""
    async with router_end(place, certificates):
        say(ready=True)
        await told_to_end()


@dataclass
class Heard:
    """The results of a camera that a program has read."""

    first: int | None = None  # run
    last: int | None = None
    number: int = 0  # the agent's
    seen: int = 0
    gaps: list[int] = field(default_factory=list)  # runs that are missing
    again: int = 0  # results that came once more, or before an earlier one

    def take(self, result: Result[Any]) -> None:
        """Take the next one."""
        run = result.value.run
        self.seen += 1
        self.number = result.number
        if self.last is None:
            self.first = run
        else:
            if run <= self.last:
                self.again += 1
                return
            if run > self.last + 1:
                self.gaps.append(run - self.last - 1)
        self.last = run


class Shared:
    """A camera that two agents have in turn, as a program sees it: one and the same throughout.

    Args:
        camera: of the program's.
    """

    def __init__(self, camera: FleetCamera[Any]) -> None:
        self.camera = camera
        self.told = 0  # how often it was lost
        self.wrong: set[str] = set()
        self._events = camera.events()
        self._there = camera.connected

    async def hear(self) -> None:
        """Hear of it."""
        async for event in self._events:
            if isinstance(event, (Disconnected, Reconnected)):
                there = isinstance(event, Reconnected)
                if there == self._there:
                    self.wrong.add(f"{type(event).__name__} twice in a row")
                self._there = there
                self.told += not there

    def look(self, now: FleetCamera[Any]) -> None:
        """Look what it is now."""
        if now is not self.camera:
            self.wrong.add("it is another object")
        if now.ended:
            self.wrong.add("it has ended")


class Program:
    """Reads the results of all cameras, triggers one after the other, and says who is there."""

    def __init__(self, fleet: Fleet, first: int, seed: int) -> None:
        self._fleet = fleet
        self._tokens = itertools.count(first)
        self._chance = Random(f"{seed} {first}")  # noqa: S311
        self._heard: dict[str, Heard] = {}
        self._shared: dict[str, Shared] = {}
        self._pace = Pace()
        self._ending = False
        self._under_way: Counter[str] = Counter()
        self._blocked: set[str] = set()  # cameras that a block of this program has

    async def run(self) -> None:
        """Be at work until it is told to end."""
        results = self._fleet.results(max_queue=QUEUE)
        self._shared = {name: Shared(self._fleet[name]) for name in PAIRED}
        beside = [
            asyncio.create_task(one)
            for one in (
                self._read(results),
                self._look(),
                self._sample(),
                self._pace.run(),
                *(one.hear() for one in self._shared.values()),
            )
        ]
        work = [asyncio.create_task(self._work()) for _ in range(AT_ONCE)]
        await told_to_end()
        self._ending = True
        await asyncio.gather(*work)
        ends = await asyncio.gather(*(self._last(one) for one in self._fleet.cameras()))
        accounts = results.statistics()
        say(
            account={
                name: {
                    **vars(heard),
                    **{
                        key: getattr(accounts[name], key)
                        for key in ("offered", "taken", "dropped", "queued", "missed")
                    },
                }
                for name, heard in self._heard.items()
            },
            ends=[
                *(one for one in ends if one),
                *(f"{name}: {text}" for name, one in self._shared.items() for text in one.wrong),
            ],
        )
        for task in beside:
            if task.done():
                task.result()
            task.cancel()
        await asyncio.wait(beside)

    async def _read(self, results: Any) -> None:
        async for result in results:
            self._heard.setdefault(result.camera, Heard()).take(result)

    async def _look(self) -> None:
        """Say who is there, again and again, for it may be asked since when that is so."""
        fleet, shared = self._fleet, self._shared
        while True:
            for name, one in shared.items():
                one.look(fleet[name])
            say(
                here=sorted(one.name for one in fleet.cameras() if one.connected),
                having={name: fleet.agents(name) for name in shared},
                told={name: one.told for name, one in shared.items()},
            )
            await asyncio.sleep(LOOK)

    async def _sample(self) -> None:
        while True:
            await asyncio.sleep(SAMPLE)
            gc.collect()
            seen = sum(one.seen for one in self._heard.values())
            say(memory=resident(), tasks=len(asyncio.all_tasks()), seen=seen)

    async def _work(self) -> None:
        while not self._ending:
            await asyncio.sleep(self._chance.uniform(0, 2 * PAUSE))
            there = self._fleet.cameras()
            if not there:
                continue
            camera = self._chance.choice(there)
            if camera.name in self._blocked:
                continue
            if self._chance.random() < RESERVING and not self._under_way[camera.name]:
                self._blocked.add(camera.name)
                try:
                    say(block=[camera.name, await self._block(camera)])
                finally:
                    self._blocked.discard(camera.name)
                continue
            token = next(self._tokens)
            grace = GRACE * self._pace.since(time.monotonic() - LATELY)
            self._under_way[camera.name] += 1
            outcome, got = await call(camera, token, self._chance, grace=grace)
            self._under_way[camera.name] -= 1
            say(call=[token, outcome, got])
            with contextlib.suppress(SmartCamError):
                if outcome == "InputContainerError":
                    await camera.switch_application(WITH_INPUT)
                elif outcome == "NotRunningError":
                    await camera.start()

    async def _block(self, camera: FleetCamera[Any]) -> str:
        """Trigger twice in a block of a reservation; return how it ended.

        A block that ends without an error had the camera for itself: no run is between its two.
        """
        tokens = next(self._tokens), next(self._tokens)
        try:
            async with camera.reserve(timeout=LAST):
                first = await camera.trigger(input=tokens[0].to_bytes(4, "little"))
                await asyncio.sleep(self._chance.uniform(0, 4 * PAUSE))
                second = await camera.trigger(input=tokens[1].to_bytes(4, "little"))
        except SmartCamError as error:
            return type(error).__name__
        if (first.value.token, second.value.token) != tokens:
            return f"! {tokens} got {first.value.token}, {second.value.token}"
        between = second.value.run - first.value.run - 1
        return f"! {between} runs of others came between" if between else "kept"

    def _number(self, camera: str) -> int:
        """Return that of the last result that was read."""
        heard = self._heard.get(camera)
        return 0 if heard is None else heard.number

    async def _last(self, camera: Any) -> str:
        """Trigger once more, now that nothing is wrong; return what went wrong all the same."""
        token = next(self._tokens)
        try:
            await camera.wait_connected(LAST)
            for _ in range(PATIENT):  # others are at work, too
                try:
                    result = await camera.trigger(input=token.to_bytes(4, "little"), timeout=LAST)
                    break
                except InputContainerError:  # which says that nothing was sent
                    await camera.switch_application(WITH_INPUT)
            else:
                return f"{camera.name}: the last call: its input is in doubt again and again"
            if result.value.token != token:
                return f"{camera.name}: call {token} got the result of {result.value.token}"
            async with asyncio.timeout(LAST):
                while self._number(camera.name) < result.number:  # noqa: ASYNC110 - it is read
                    await asyncio.sleep(LOOK)
        except (SmartCamError, TimeoutError) as error:
            return f"{camera.name}: the last call: {type(error).__name__}: {error}"
        return ""


async def program(url: str, first: int, seed: int) -> None:
    """Be a program."""
    options: Any = {"interpret_as": LAYOUT, "reconnect": FAST}
    async with smartcam.fleet.open(url, connect_timeout=PATIENCE, **options) as fleet:
        await Program(fleet, first, seed).run()


async def visitor(url: str, seconds: float) -> None:
    """Come once, and say what came of it."""
    loop = asyncio.get_running_loop()
    begun = loop.time()
    try:
        async with smartcam.fleet.open(url, connect_timeout=seconds) as fleet:
            outcome, text = "here", str(len(fleet))
    except SmartCamError as error:
        outcome, text = type(error).__name__, str(error)
    say(outcome=outcome, text=text, took=loop.time() - begun)


async def joiner(url: str, seconds: float) -> None:
    """Come as soon as it goes, trying again; say how many cameras are there."""
    loop = asyncio.get_running_loop()
    end = loop.time() + seconds
    text = ""
    while loop.time() < end:
        try:
            async with smartcam.fleet.open(url, connect_timeout=LATELY) as fleet:
                say(outcome="here", text=str(len(fleet)))
                return
        except SmartCamError as error:
            text = f"{type(error).__name__}: {error}"
            await asyncio.sleep(LOOK)
    say(outcome="not here", text=text)


async def holder(url: str, camera: str) -> None:
    """Reserve a camera, and never give it back."""
    async with (
        smartcam.fleet.open(url, connect_timeout=LAST, reconnect=FAST) as fleet,
        fleet[camera].reserve(timeout=LAST),
    ):
        say(outcome="reserved")
        await told_to_end()


async def guest(url: str, camera: str, token: int) -> None:
    """Trigger once; say what came of it."""
    options: Any = {"interpret_as": LAYOUT, "reconnect": FAST}
    end = asyncio.get_running_loop().time() + LAST
    text = ""
    async with smartcam.fleet.open(url, connect_timeout=LAST, **options) as fleet:
        while asyncio.get_running_loop().time() < end:
            try:
                await fleet[camera].wait_connected(LATELY)
                data = token.to_bytes(4, "little")
                result = await fleet[camera].trigger(input=data, timeout=LATELY)
            except InputContainerError:
                with contextlib.suppress(SmartCamError):
                    await fleet[camera].switch_application(WITH_INPUT)
            except SmartCamError as error:
                text = f"{type(error).__name__}: {error}"
                break
            else:
                say(outcome="result" if result.value.token == token else "! a stranger's", text="")
                return
    say(outcome="none", text=text)


async def strangers(address: str, port: int, count: int) -> None:
    """Have so many connections that say nothing; a new one for each that ends."""
    there = 0

    async def one() -> None:
        nonlocal there
        while True:
            with contextlib.suppress(OSError, TimeoutError):
                async with asyncio.timeout(LAST):
                    reader, writer = await asyncio.open_connection(address, port)
                there += 1
                with contextlib.suppress(OSError):
                    await reader.read()
                there -= 1
                writer.close()
            await asyncio.sleep(LOOK)

    tasks = [asyncio.create_task(one()) for _ in range(count)]
    while not there:  # noqa: ASYNC110 - each counts itself
        await asyncio.sleep(LOOK)
    say(outcome="there")
    await told_to_end()
    for task in tasks:
        task.cancel()
    await asyncio.wait(tasks)


if __name__ == "__main__":
    kind, *given = sys.argv[1:]
    if kind == "cameras":
        asyncio.run(cameras(int(given[0]), *given[1:]))
    elif kind == "router":
        asyncio.run(router(*given))
    elif kind == "program":
        asyncio.run(program(given[0], *map(int, given[1:])))
    elif kind == "joiner":
        asyncio.run(joiner(given[0], float(given[1])))
    elif kind == "holder":
        asyncio.run(holder(*given))
    elif kind == "guest":
        asyncio.run(guest(given[0], given[1], int(given[2])))
    elif kind == "strangers":
        asyncio.run(strangers(given[0], int(given[1]), int(given[2])))
    else:
        asyncio.run(visitor(given[0], float(given[1])))
