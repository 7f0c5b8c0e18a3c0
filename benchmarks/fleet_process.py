"""One side of the fleet benchmark: opens its cameras, then does what lines on stdin ask for.

Each answer is a line of JSON. ``idle SECONDS``; ``busy RESULTS RATE``: take that many of each
camera; ``steady``, ``silent`` and ``unread`` with the same arguments: take them, and tell how long
they took from the peer's ``send`` to here, while the first camera is as the others, stalls, or has
a subscriber that does not read. The first camera is none of those that are timed.
"""

from __future__ import annotations

import asyncio
import gc
import json
import os
import socket
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.measure import cpu_microseconds
from benchmarks.peers import wire
from benchmarks.peers.fleet import GO, GO_BODY, STALL, allow_sockets
from benchmarks.yardsticks import BareClient, bare_client

if TYPE_CHECKING:
    from collections.abc import Coroutine

    import smartcam
    from smartcam.streams import Subscription

__all__ = ["ASKING", "BARE", "SMARTCAM"]

SMARTCAM, BARE, ASKING = "smartcam", "bare protocol", "bare protocol that asks"

LAYOUT = (
    "table: (sent: uint64, feature_id: string[42], quality: real32, photo_index: int32, "
    "x: real32, y: real32, theta: real32)*"
)
EVERY = 2.5
"""Seconds: as often as smartcam asks a silent camera, half its default liveness_timeout."""

QUERY = wire.frame(wire.QUERY)

AT_ONCE = 20
"""Cameras that are opened at the same time."""

LIMIT = 30.0
"""Seconds until a result that does not come is an error."""


class BareSide:
    """Bare protocols."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._clients: list[BareClient] = []

    async def open(self) -> None:
        """Open one more."""
        self._clients.append(await bare_client(self._port))

    def take(self, count: int) -> list[Coroutine[None, None, None]]:
        """Return what takes ``count`` results of each."""
        return [client.ask(b"", wire.RESULT, count) for client in self._clients]

    def asked(self) -> int:
        """Return how many frames were sent."""
        return 0


class AskingSide(BareSide):
    """Bare protocols that send a Query now and then, and look at nothing."""

    def __init__(self, port: int) -> None:
        super().__init__(port)
        self._asked = 0

    async def open(self) -> None:
        """Open one more."""
        await super().open()
        self._ask_later(self._clients[-1])

    def asked(self) -> int:
        """Return how many frames were sent."""
        return self._asked

    def _ask_later(self, client: BareClient) -> None:
        asyncio.get_running_loop().call_later(EVERY, self._ask, client)

    def _ask(self, client: BareClient) -> None:
        client.transport.write(QUERY)
        self._asked += 1
        self._ask_later(client)


class SmartcamSide:
    """Cameras, as their user has them."""

    def __init__(self, port: int) -> None:
        self._url = f"bvs://127.0.0.1:{port}?dialect=handbook"
        self.cameras: list[smartcam.Camera] = []

    async def open(self) -> None:
        """Open one more."""
        import smartcam

        self.cameras.append(await smartcam.connect(self._url, interpret_as=LAYOUT))

    def take(self, count: int) -> list[Coroutine[None, None, None]]:
        """Return what takes ``count`` results of each."""
        return [_read(camera.results(), count) for camera in self.cameras]

    def asked(self) -> int:
        """Return how many frames were sent; none has lost its camera."""
        counted = [camera.statistics() for camera in self.cameras]
        assert all(one.sessions == 1 for one in counted)
        assert all(camera.connected for camera in self.cameras)
        return sum(one.frames_sent for one in counted)


async def _read(results: Subscription[smartcam.Result], count: int) -> None:
    async for result in results:
        count -= 1
        if not count:
            assert result.value["photo_index"].tolist() == [7]
            return


async def _time(results: Subscription[smartcam.Result], count: int, took: list[int]) -> None:
    async for result in results:
        took.append(time.monotonic_ns() - int(result.value["sent"][0]))
        count -= 1
        if not count:
            return


SIDES: dict[str, type[BareSide | SmartcamSide]] = {
    SMARTCAM: SmartcamSide,
    BARE: BareSide,
    ASKING: AskingSide,
}


class Commands:
    """What can be asked for.

    Args:
        side: whose cameras.
        control: a connection to the peer, in no session.
    """

    def __init__(self, side: BareSide | SmartcamSide, control: socket.socket) -> None:
        self._side = side
        self._control = control

    async def do(self, command: str, *arguments: float) -> dict[str, float]:
        """Do it and return the figures."""
        gc.collect()
        if command == "idle":
            return await self._idle(*arguments)
        count, rate = int(arguments[0]), arguments[1]
        if command == "busy":
            return await self._busy(count, rate)
        assert isinstance(self._side, SmartcamSide)
        first = self._side.cameras[0]
        match command:
            case "steady":
                results = first.results()
                took = await self._timed(count, rate)
                assert results.statistics().offered == count
            case "silent":
                results = first.results()
                await first.request(STALL, answered=False)
                took = await self._timed(count, rate)
                assert results.statistics().offered == 0
                await first.request(STALL, answered=False)
                await anext(results)  # the rest of it
            case _:
                results = first.results(max_queue=1)
                took = await self._timed(count, rate)
                assert results.statistics().dropped == count - 1
        return {"p99": sorted(took)[len(took) * 99 // 100] / 1e3}

    async def _idle(self, seconds: float) -> dict[str, float]:
        asked = self._side.asked()
        wall, cpu = time.monotonic(), time.process_time()
        await asyncio.sleep(seconds)
        cpu, wall = time.process_time() - cpu, time.monotonic() - wall
        return {"percent": cpu / wall * 100, "asked": self._side.asked() - asked}

    async def _busy(self, count: int, rate: float) -> dict[str, float]:
        takers = self._side.take(count)
        begin = time.process_time()
        await self._run(takers, count, rate)
        return {"us": cpu_microseconds(begin, count * len(takers))}

    async def _timed(self, count: int, rate: float) -> list[int]:
        assert isinstance(self._side, SmartcamSide)
        took: list[int] = []
        others = self._side.cameras[1:]
        await self._run([_time(one.results(), count, took) for one in others], count, rate)
        assert len(took) == count * len(others)
        return took

    async def _run(
        self, takers: list[Coroutine[None, None, None]], count: int, rate: float
    ) -> None:
        """Have the peer send, and take it all."""
        async with asyncio.timeout(LIMIT), asyncio.TaskGroup() as group:
            for taker in takers:
                group.create_task(taker)
            await asyncio.sleep(0)
            self._control.sendall(wire.frame(GO, GO_BODY.pack(count, rate)))


def _resident() -> int:
    """Return the bytes of this process that are in memory; 0 where the system does not say."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


async def _serve(name: str, size: int, port: int) -> None:
    allow_sockets()
    side = SIDES[name](port)
    await side.open()  # with all that is imported for it
    gc.collect()
    before = _resident()
    for begin in range(1, size, AT_ONCE):
        await asyncio.gather(*(side.open() for _ in range(begin, min(begin + AT_ONCE, size))))
    gc.collect()
    _print({"KiB": (_resident() - before) / 1024 / (size - 1)})
    commands = Commands(side, socket.create_connection(("127.0.0.1", port)))
    loop = asyncio.get_running_loop()
    while line := await loop.run_in_executor(None, sys.stdin.readline):
        command, *arguments = line.split()
        _print(await commands.do(command, *map(float, arguments)))


def _print(answer: dict[str, float]) -> None:
    print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    asyncio.run(_serve(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
