"""An agent, or a program that has a camera or looks, in a process of its own, to be killed.

``python -m tests.fleet.partner agent PLACE CAMERA_URL``, or ``... holder FLEET_URL``, or ``...
viewer FLEET_URL``, or ``... standby PLACE CAMERA_URL NAME``: an agent that connects to a router,
and stands by for a camera that another one has. It says when it is ready, and goes on until its
end.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from typing import Any

import smartcam
from smartcam._zenoh import BusLink
from smartcam.fleet import FleetCamera
from smartcam.fleet._inside import Keys, ZenohConnection
from smartcam.settings import CameraSettings
from tests.fleet.fleetkit import FAST, FLEET, NAME, PATIENCE
from tests.fleet.inside import Agent, Standby


class Partner:
    """A process."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process

    def signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self._process.returncode is None:
            self._process.send_signal(number)

    async def kill(self) -> None:
        """End it without a word."""
        self.signal(signal.SIGKILL)
        await self._process.wait()


@contextlib.asynccontextmanager
async def partner(*arguments: str, within: tuple[str, ...] = ()) -> AsyncIterator[Partner]:
    """Give one that is ready; ``within`` is a command that runs it elsewhere."""
    command = (*within, sys.executable, "-m", "tests.fleet.partner", *arguments)
    process = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        async with asyncio.timeout(PATIENCE):
            assert await process.stdout.readline() == b"ready\n"
        yield Partner(process)
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


async def _agent(place: str, url: str) -> None:
    settings = CameraSettings.make(url, None, {"reconnect": FAST, "name": NAME})
    agent = Agent("agent", Keys(FLEET), ZenohConnection(BusLink(listen=(place,))), {NAME: settings})
    await agent.open(PATIENCE)
    await agent.wait_first_attempts()
    await _ready()


async def _standby(place: str, url: str, name: str) -> None:
    settings = CameraSettings.make(url, None, {"reconnect": FAST, "name": NAME})
    end = ZenohConnection(BusLink(connect=(place,)))
    agent = Agent(name, Keys(FLEET), end, {NAME: settings}, standby=Standby.model_validate({}))
    await agent.open(PATIENCE)
    await agent.wait_first_attempts()
    await _ready()


async def _holder(url: str) -> None:
    async with smartcam.connect(url) as camera:
        assert isinstance(camera, FleetCamera)
        async with camera.reserve(timeout=PATIENCE):
            await _ready()


async def _viewer(url: str) -> None:
    async with smartcam.connect(url) as camera, camera.frames(timeout=PATIENCE) as frames:
        await anext(frames)
        await _ready()


async def _ready() -> None:
    print("ready", flush=True)  # noqa: T201
    await asyncio.Event().wait()


if __name__ == "__main__":
    programs: dict[str, Any] = {
        "agent": _agent,
        "standby": _standby,
        "holder": _holder,
        "viewer": _viewer,
    }
    asyncio.run(programs[sys.argv[1]](*sys.argv[2:]))
