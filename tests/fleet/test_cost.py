"""The cost of a call on the bus, counted in messages."""

from __future__ import annotations

import asyncio
import collections
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import pytest

from smartcam.emulator import Application, EmulatedCamera
from smartcam.fleet import FleetCamera, FleetFile, FleetServer, MemoryBus
from smartcam.fleet._inside import FleetAddress
from smartcam.settings import CameraSettings
from tests.fleet.inside import Program

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from smartcam.models import Status

CATCH_UP = 0.2
STATUS_DELAY = 0.005


NAME = "line1/cam3"
TRIGGERS = 10


class Plant:
    """An agent with one camera on a bus inside the process; counts what is said there.

    Args:
        stack: has all of it.
        url: of the camera, which is at work and answers a trigger at once.
    """

    def __init__(self, stack: AsyncExitStack, url: str) -> None:
        self.bus = MemoryBus()
        self.said: collections.Counter[str] = collections.Counter()
        self._stack = stack
        file = {"cameras": {NAME: {"url": url}}}
        self.server = FleetServer(FleetFile.model_validate(file), bus=self.bus.new_connection())

    async def start(self) -> None:
        """Have the camera connected."""
        await self._stack.enter_async_context(self.server)
        await self.server.wait_first_attempts()
        ear = await self.bus.new_connection().open(1.0)
        self._stack.push_async_callback(ear.close)
        for kind in ("command", "ask", "reply", "states"):
            ear.subscribe(f"smartcam/plant/{kind}/**", lambda key, _: self._count(key))

    def _count(self, key: str) -> None:
        self.said[key.split("/")[2]] += 1

    async def camera(self) -> FleetCamera[object]:
        """Return it as one more program has it."""
        settings = CameraSettings.of(FleetAddress.parse("fleet://here").of(NAME), {})
        camera = FleetCamera[object](settings, NAME, Program(self.bus.new_connection(), "plant"))
        return await self._stack.enter_async_context(camera)


@pytest.fixture
async def plant() -> AsyncGenerator[Plant]:
    async with AsyncExitStack() as stack:
        program = Application(
            id=21, layout="(quality: real32)*", constant=[{"quality": 0.5}], processing_time=0.0
        )
        emulated = EmulatedCamera([program], builtins=False, running=True)
        made = Plant(stack, (await stack.enter_async_context(emulated)).url)
        await made.start()
        yield made


async def test_a_trigger_is_a_call_and_a_reply_and_statuses_of_several_go_in_one_message(
    plant: Plant,
) -> None:
    camera = await plant.camera()
    await plant.camera()  # who hears of it without a reply
    await camera.trigger()
    await asyncio.sleep(2 * STATUS_DELAY)
    plant.said.clear()
    for _ in range(TRIGGERS):
        await camera.trigger()
    await asyncio.sleep(2 * STATUS_DELAY)
    assert plant.said["command"] == plant.said["reply"] == TRIGGERS
    assert plant.said["ask"] == 0  # nothing was missing
    # two statuses each; the clock stands still meanwhile
    assert 0 < plant.said["states"] <= 2


async def test_statuses_that_the_only_program_has_with_a_reply_are_not_said_again(
    plant: Plant,
) -> None:
    camera = await plant.camera()
    await camera.trigger()
    await asyncio.sleep(2 * CATCH_UP)
    plant.said.clear()
    statuses = camera.statuses()
    for _ in range(TRIGGERS):
        await camera.trigger()
    await asyncio.sleep(2 * STATUS_DELAY)
    assert plant.said["states"] == 0
    assert statuses.statistics().queued >= 2 * TRIGGERS
    await asyncio.sleep(2 * CATCH_UP)
    assert plant.said["states"] == 1  # that there are no more, should a reply have been lost
    assert plant.said["ask"] == 0
    other = await plant.camera()
    await camera.trigger()
    await asyncio.sleep(2 * STATUS_DELAY)
    assert other.status == camera.status
    assert plant.said["states"] == 2


async def test_the_status_after_a_call_is_that_of_its_end(plant: Plant) -> None:
    camera = await plant.camera()
    host = plant.server.shared_cameras[NAME]
    for _ in range(TRIGGERS):
        await camera.trigger()
        assert camera.status == host.client.status
    await camera.stop()
    assert camera.status == host.client.status
    await camera.start()
    assert camera.status == host.client.status


async def test_others_hear_of_every_status_in_order_a_moment_later(plant: Plant) -> None:
    one, other = await plant.camera(), await plant.camera()
    streams = [one.statuses(), other.statuses()]
    for _ in range(TRIGGERS):
        await one.trigger()
    await asyncio.sleep(2 * STATUS_DELAY)
    heard: list[list[Status]] = [
        [await anext(stream) for _ in range(stream.statistics().queued)] for stream in streams
    ]
    assert heard[0] == heard[1]
    assert len(heard[0]) >= 2 * TRIGGERS


async def test_two_programs_that_trigger_in_turn_both_know_the_status(plant: Plant) -> None:
    cameras = [await plant.camera(), await plant.camera()]
    host = plant.server.shared_cameras[NAME]
    for number in range(TRIGGERS):
        camera = cameras[number % 2]
        await camera.trigger()
        assert camera.status == host.client.status
    assert plant.said["ask"] == 2  # the hello of each: nothing was missing


async def test_a_lost_camera_is_told_at_once(plant: Plant) -> None:
    camera = await plant.camera()
    loop = asyncio.get_running_loop()
    gone = camera.events()
    await camera.trigger()
    begin = loop.time()
    await plant.server.shared_cameras[NAME].client.close()
    async for event in gone:
        if type(event).__name__ == "Disconnected":
            break
    assert loop.time() - begin < STATUS_DELAY
    assert not camera.connected
