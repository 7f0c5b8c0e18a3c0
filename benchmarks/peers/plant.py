"""Many cameras on one port in a process of its own, at an agent or without one.

``python -m benchmarks.peers.plant clients COUNT PORT`` has clients alone; ``... agent COUNT PORT
NAME PLACE listen|connect`` has an agent share them. CPU time and memory as
:mod:`benchmarks.peers.control` tells them: before the cameras, and since.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import sys

import smartcam
import smartcam.fleet
from benchmarks.peers.control import allow_files, resident, serve_control
from smartcam.fleet import FleetFile

__all__: list[str] = []

HISTORY = 2_000
"""Results that the agent keeps of each camera."""

SPARE_FILES = 100

AT_ONCE = 20

PATIENCE = 60.0
"""Seconds until cameras that do not connect are an error."""


def url(port: int, agent: int = 0) -> str:
    """Return the URL of any of the cameras of an agent."""
    return f"bvs://127.0.0.{1 + agent}:{port}?dialect=handbook"


async def clients(count: int, port: int) -> None:
    """Have clients, and nothing else."""
    async with contextlib.AsyncExitStack() as stack:
        await stack.enter_async_context(smartcam.connect(url(port)))  # with all that it imports
        gc.collect()
        before = resident()
        for begin in range(0, count, AT_ONCE):
            some = [smartcam.connect(url(port)) for _ in range(begin, min(count, begin + AT_ONCE))]
            await asyncio.gather(*(stack.enter_async_context(one) for one in some))
        gc.collect()
        await serve_control([port], before)


async def agent(count: int, port: int, name: str, place: str, how: str) -> None:
    """Share the cameras."""
    where = url(port, int(name.removeprefix("agent")))
    cameras = {f"{name}/cam{number:05}": {"url": where} for number in range(count)}
    file = FleetFile.model_validate(
        {"agent": name, how: place, "history": {"results": HISTORY}, "cameras": cameras}
    )
    async with smartcam.connect(url(port)):  # with all that it imports
        pass
    gc.collect()
    before = resident()
    async with smartcam.fleet.serve(file) as server:
        async with asyncio.timeout(PATIENCE):
            while not all(one.connected for one in server.shared_cameras.values()):  # noqa: ASYNC110
                await asyncio.sleep(0.1)
        gc.collect()
        await serve_control([server.address.port], before)


if __name__ == "__main__":
    kind, cameras_, port_, *more = sys.argv[1:]
    allow_files(int(cameras_) + SPARE_FILES)
    if kind == "clients":
        asyncio.run(clients(int(cameras_), int(port_)))
    else:
        asyncio.run(agent(int(cameras_), int(port_), *more))
