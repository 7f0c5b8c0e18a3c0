"""Cameras that another client took from their agent: the event, slow attempts, taking back."""

from __future__ import annotations

import contextlib
import json
from collections.abc import AsyncIterator
from typing import Any

import pytest

import smartcam
from smartcam import Backoff
from smartcam.exceptions import ConnectionTakenError, ResponseTimeoutError
from smartcam.fleet import FleetCamera, MemoryBus
from smartcam.fleet._inside import Bus, Keys
from smartcam.settings import Address, CameraSettings
from tests.fleet.fleetkit import FLEET, LAYOUT, NAME, PATIENCE, NumberedCamera, until
from tests.fleet.inside import Agent, Program

QUICK = Backoff(initial=0.1, maximum=0.2, jitter=0.0)


class Shop:
    """A camera, its agent, and a program on a bus."""

    def __init__(self, box: NumberedCamera, host: Any, camera: FleetCamera[Any], end: Bus) -> None:
        self.box, self.host, self.camera, self.end = box, host, camera, end

    async def take(self) -> None:
        """Have a client that is no agent take the camera until it is left to that."""
        for _ in range(2):
            await until(lambda: self.host.connected)
            async with smartcam.connect(self.box.url):
                await until(lambda: not self.host.connected)
        await until(lambda: self.host.client.is_taken)


@contextlib.asynccontextmanager
async def shop() -> AsyncIterator[Shop]:
    bus = MemoryBus()
    async with contextlib.AsyncExitStack() as stack:
        box = await stack.enter_async_context(NumberedCamera(time=0.01))
        settings = CameraSettings.make(box.url, None, {"reconnect": QUICK, "name": NAME})
        agent = Agent("north", Keys(FLEET), bus.new_connection(), {NAME: settings})
        await agent.open(PATIENCE)
        stack.push_async_callback(agent.close)
        await agent.wait_first_attempts()
        address = Address("fleet", "fleet", "127.0.0.1", 7447, path=NAME)
        own = {"name": NAME, "interpret_as": LAYOUT, "reconnect": QUICK}
        program = Program(bus.new_connection(), FLEET, NAME)
        camera = FleetCamera[Any](CameraSettings.of(address, own), NAME, program)
        await stack.enter_async_context(camera)
        end = await bus.new_connection().open(PATIENCE)
        stack.push_async_callback(end.close)
        yield Shop(box, agent.shared_cameras[NAME], camera, end)


async def test_camera_that_was_taken_is_told_and_comes_back_by_itself() -> None:
    async with shop() as made:
        await made.take()
        await until(lambda: isinstance(made.camera.trouble, ConnectionTakenError))
        with pytest.raises(ConnectionTakenError, match=r"it is tried again in 30 s"):
            await made.camera.trigger(2)
        with pytest.raises(ResponseTimeoutError, match="another client has the camera"):
            await made.camera.wait_connected(1.0)
        assert made.host.state_fields()["over"] is False
        await made.camera.wait_connected(30.0 + PATIENCE)
        assert (await made.camera.trigger(2)).value.run == 1


async def test_camera_that_is_taken_again_and_again_is_tried_ever_more_seldom() -> None:
    async with shop() as made:
        supervisor = made.host.client._supervisor
        await made.take()
        pauses: list[float] = []
        for _ in range(7):
            pauses.append(supervisor._pause_of_taken)
            made.host.client.try_take_back()
            await until(lambda: made.host.connected)
            async with smartcam.connect(made.box.url):
                await until(lambda: made.host.client.is_taken)  # at the first loss already
        assert pauses == [60.0, 120.0, 240.0, 480.0, *[600.0] * 3]


@pytest.mark.parametrize("way", ["fleet", "json"])
async def test_camera_that_was_taken_is_taken_back_at_once(way: str) -> None:
    async with shop() as made:
        await made.take()
        sessions = made.host.client.statistics().sessions
        if way == "fleet":
            await made.camera.take_back(timeout=PATIENCE)
        else:
            key = Keys(FLEET).service(NAME, "take_back")
            ((_, answer),) = await made.end.ask(key, b"", PATIENCE)
            assert json.loads(answer) == {"error": ""}
        assert made.host.connected
        assert made.host.client.statistics().sessions == sessions + 1
        await made.camera.wait_connected(PATIENCE)
        assert (await made.camera.trigger(2)).value.run == 1


async def test_taking_back_what_nobody_took_changes_nothing() -> None:
    async with shop() as made:
        await made.camera.take_back()
        assert made.host.client.statistics().sessions == 1


async def test_camera_that_was_taken_and_is_switched_off_is_awaited_like_any_other() -> None:
    async with shop() as made:
        await made.take()
        await made.box.stop()
        with pytest.raises(ResponseTimeoutError):
            await made.camera.take_back(timeout=1.0)
        await made.box.start()
        await until(lambda: made.host.connected)  # long before it would be tried again
