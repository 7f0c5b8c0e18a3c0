"""The processes of a plant: its cameras, its router, a program that uses all of it.

``python -m tests.proofs.plant_process cameras COUNT``, ``... router PLACE CERTIFICATES``,
``... program URL FIRST CAMERAS SEED``, ``... visitor URL``: each says on stdout, as lines of JSON,
what it sees, and goes on until a line comes on stdin.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import json
import sys
from collections import Counter
from dataclasses import dataclass, field
from random import Random
from typing import Any

import smartcam.fleet
from smartcam import Result
from smartcam._zenoh import BusLink
from smartcam.exceptions import InputContainerError, SmartCamError
from smartcam.fleet import Fleet
from smartcam.fleet._access import access_control
from smartcam.fleet._zenoh import ZenohEnd
from tests.fleet.fleetkit import FAST, LAYOUT, PATIENCE, NumberedCamera
from tests.proofs.chaos_soak import resident
from tests.proofs.fleet_storm import WITH_INPUT, call

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


async def cameras(count: int) -> None:
    """Be so many cameras; say in the end which token was executed how often, and the runs."""
    async with contextlib.AsyncExitStack() as stack:
        boxes = [
            await stack.enter_async_context(NumberedCamera(active=WITH_INPUT, time=0.005))
            for _ in range(count)
        ]
        say(urls=[box.url for box in boxes])
        await told_to_end()
    times = Counter(token for box in boxes for token in box.inputs.values())
    twice = {token: count for token, count in times.items() if count > 1}
    say(executed=times.total(), twice=twice)


async def router(place: str, certificates: str) -> None:
    """Be the router."""
    link = BusLink((place,), (), certificates)
    end = ZenohEnd(link, {"access_control": access_control()})
    await end.open(PATIENCE)
    say(ready=True)
    await told_to_end()
    await end.close()


@dataclass
class Heard:
    """What a program has read of a camera's results."""

    last: int | None = None  # run
    number: int = 0  # the agent's
    seen: int = 0
    gaps: list[int] = field(default_factory=list)  # runs that are missing
    again: int = 0  # results that came once more, or before an earlier one

    def take(self, result: Result[Any]) -> None:
        """Take the next one."""
        run = result.value.run
        self.seen += 1
        self.number = result.number
        if self.last is not None:
            if run <= self.last:
                self.again += 1
                return
            if run > self.last + 1:
                self.gaps.append(run - self.last - 1)
        self.last = run


class Program:
    """Reads the results of all cameras, triggers one after the other, and says who is there."""

    def __init__(self, fleet: Fleet, first: int, expected: int, seed: int) -> None:
        self._fleet, self._expected = fleet, expected
        self._tokens = itertools.count(first)
        self._chance = Random(f"{seed} {first}")  # noqa: S311
        self._heard: dict[str, Heard] = {}
        self._ending = False

    async def run(self) -> None:
        """Be at work until it is told to end."""
        results = self._fleet.results(max_queue=QUEUE)
        beside = [
            asyncio.create_task(one) for one in (self._read(results), self._look(), self._sample())
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
            ends=[one for one in ends if one],
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
        while True:
            say(here=sorted(one.name for one in self._fleet.cameras() if one.connected))
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
            token = next(self._tokens)
            outcome, got = await call(camera, token, self._chance, grace=GRACE)
            say(call=[token, outcome, got])
            with contextlib.suppress(SmartCamError):
                if outcome == "InputContainerError":
                    await camera.switch_application(WITH_INPUT)
                elif outcome == "NotRunningError":
                    await camera.start()

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


async def program(url: str, first: int, expected: int, seed: int) -> None:
    """Be a program."""
    options: Any = {"interpret_as": LAYOUT, "reconnect": FAST}
    async with smartcam.fleet.open(url, connect_timeout=PATIENCE, **options) as fleet:
        await Program(fleet, first, expected, seed).run()


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


if __name__ == "__main__":
    kind, *given = sys.argv[1:]
    if kind == "cameras":
        asyncio.run(cameras(int(given[0])))
    elif kind == "router":
        asyncio.run(router(*given))
    elif kind == "program":
        asyncio.run(program(given[0], *map(int, given[1:])))
    else:
        asyncio.run(visitor(given[0], float(given[1])))
