"""Every coroutine of the fleet, cancelled after 0, 1, 2 ... loop steps.

Afterwards the same camera does all that it could do before, and nothing is left behind: no task, no
call, no reservation, no temporary application, no end on the bus.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from datetime import datetime
from typing import Any

import pytest

from smartcam import fleet
from smartcam.exceptions import SmartCamError
from smartcam.fleet import FleetCamera, FleetFile, FleetServer, MemoryBus
from tests.fleet.fleetkit import NAME, Plant, end_of, until
from tests.timed_loop import TimedLoop

STEP = 0.001
"""Seconds that a step of the loop takes."""

MAX_STEPS = 3000
STRIDE = 11
"""Of the short form: a prime, so that the sweeps do not all skip the same steps."""

Work = Callable[[Plant, FleetCamera[Any]], Coroutine[Any, Any, object]]


async def in_application(camera: FleetCamera[Any]) -> None:
    async with camera.application(2):
        await camera.trigger(input=bytes(4), timeout=1.0)


async def in_application_that_fails(camera: FleetCamera[Any]) -> None:
    with contextlib.suppress(ZeroDivisionError):
        async with camera.application(2):
            raise ZeroDivisionError


async def reserved(camera: FleetCamera[Any]) -> None:
    async with camera.reserve(timeout=1.0), camera.reserve(timeout=1.0):
        await camera.trigger(timeout=1.0)


async def next_result(plant: Plant, camera: FleetCamera[Any]) -> None:
    waiting = camera.next_result()
    plant.box.device.trigger()
    await waiting


async def stream(plant: Plant, camera: FleetCamera[Any]) -> None:
    async with camera.results() as results:
        await camera.trigger(timeout=1.0)
        await anext(results)


async def lost(plant: Plant, camera: FleetCamera[Any]) -> None:
    end = end_of(camera)
    end.detach()
    try:
        await asyncio.sleep(3 * STEP)
    finally:
        end.attach()
    await camera.wait_connected()


async def to_the_other_and_back(camera: FleetCamera[Any]) -> None:
    await camera.switch_application(2)
    await camera.switch_application(1)


CALLS: dict[str, Work] = {
    "trigger": lambda _, c: c.trigger(timeout=1.0),
    "trigger elsewhere": lambda _, c: c.trigger(2, input=bytes(4), timeout=1.0),
    "trigger nowhere": lambda _, c: c.trigger(99, timeout=1.0),
    "trigger that gives up": lambda _, c: c.trigger(timeout=3 * STEP),
    "switch_application": lambda _, c: to_the_other_and_back(c),
    "application": lambda _, c: in_application(c),
    "application that fails": lambda _, c: in_application_that_fails(c),
    "reserve": lambda _, c: reserved(c),
    "start": lambda _, c: c.start(),
    "query_application": lambda _, c: c.query_application(),
    "query_status": lambda _, c: c.query_status(),
    "reset_errors": lambda _, c: c.reset_errors(),
    "wait_ready": lambda _, c: c.wait_ready(),
    "wait_status": lambda _, c: c.wait_status(lambda status: status is not None),
    "read_image": lambda _, c: c.read_image(),
    "get_clock": lambda _, c: c.get_clock(),
    "set_clock": lambda _, c: c.set_clock(datetime(2024, 1, 1)),  # noqa: DTZ001 - it has no zone
    "set_sequence_number": lambda _, c: c.set_sequence_number(100),
    "request": lambda _, c: c.request(0x32),
    "next_result": next_result,
    "results": stream,
    "wait_connected": lost,
}


def sweep(make: Callable[[int], Coroutine[Any, Any, bool]], every: int) -> int:
    """Cancel after 0, ``every``, 2 * ``every`` ... steps until it is over before; return these."""
    for steps in range(0, MAX_STEPS, every):
        try:
            with asyncio.Runner(loop_factory=lambda: TimedLoop(turn=STEP)) as runner:
                if runner.run(make(steps)):
                    return steps
        except BaseException as exc:
            exc.add_note(f"cancelled after {steps} steps")
            raise
    raise AssertionError(f"it is not over after {MAX_STEPS} steps")


async def cancelled_after(steps: int, work: Coroutine[Any, Any, object]) -> bool:
    """Cancel something after so many steps; tell whether it was over before."""
    task = asyncio.create_task(work)
    for _ in range(steps):
        await asyncio.sleep(0)
        if task.done():
            break
    over = task.done()
    task.cancel()
    _, late = await asyncio.wait({task}, timeout=60.0)
    assert not late, "it goes on"
    if not task.cancelled() and task.exception() is not None:
        assert isinstance(task.exception(), SmartCamError), task.exception()
    return over


async def check_camera(
    plant: Plant, camera: FleetCamera[Any], homes: frozenset[int] = frozenset({1})
) -> None:
    """See that a camera does what it did before, and that nobody holds anything."""
    host = plant.agent.shared_cameras[NAME]
    await camera.wait_connected()
    result = await camera.trigger(1, timeout=30.0)
    assert result.value.run == plant.box.runs
    assert await camera.query_application() == camera.active_application
    assert camera.active_application in homes
    await until(lambda: not plant.agent._programs[camera._program.name].tasks)
    gate = host.gate
    assert (gate.holder, len(gate._queue), len(gate._running_commands)) == (None, 0, 0)
    assert plant.agent._programs[camera._program.name].switches == {}
    await until(lambda: not camera._caller._resending_tasks)
    assert camera._program._pending_calls == {}
    assert camera._change_queues == set()
    assert camera._receiver.own_triggers == {}
    assert host.outcomes == {}


async def call_cancelled(name: str, steps: int) -> bool:
    tasks = asyncio.all_tasks()
    async with Plant() as plant:
        async with plant.camera() as camera:
            over = await cancelled_after(steps, CALLS[name](plant, camera))
            switched = name == "switch_application"
            await check_camera(plant, camera, frozenset({1, 2} if switched else {1}))
        await until(lambda: not plant.agent._programs)
    assert plant.bus.connections == []
    await until(lambda: asyncio.all_tasks() == tasks)
    return over


async def open_cancelled(steps: int) -> bool:
    tasks = asyncio.all_tasks()
    async with Plant() as plant:
        camera = plant.camera()
        over = await cancelled_after(steps, camera.open())
        if steps and not over:
            assert len(plant.bus.connections) == 1  # it has closed itself
        await camera.close()
        await until(lambda: not plant.agent._programs)
        async with plant.camera() as other:
            await check_camera(plant, other)
    assert plant.bus.connections == []
    await until(lambda: asyncio.all_tasks() == tasks)
    return over


async def close_cancelled(steps: int) -> bool:
    tasks = asyncio.all_tasks()
    async with Plant() as plant:
        camera = plant.camera()
        await camera.open()
        over = await cancelled_after(steps, camera.close())
        await camera.close()
        assert len(plant.bus.connections) == 1
        await until(lambda: not plant.agent._programs)
    assert plant.bus.connections == []
    await until(lambda: asyncio.all_tasks() == tasks)
    return over


FILE = FleetFile.model_validate(
    {"fleet": "plant", "cameras": {"line1/**": {"emulated": {"count": 2}}}}
)


async def fleet_open_cancelled(steps: int) -> bool:
    tasks = asyncio.all_tasks()
    plant = fleet.open(FILE)
    over = await cancelled_after(steps, plant.open())
    await plant.close()
    await until(lambda: asyncio.all_tasks() == tasks)
    return over


async def fleet_trigger_cancelled(steps: int) -> bool:
    tasks = asyncio.all_tasks()
    async with fleet.open(FILE) as plant:
        for camera in plant:
            await camera.start()
        over = await cancelled_after(steps, plant.trigger("**", timeout=10.0))
        outcomes = await plant.trigger("**", timeout=10.0)
        assert [one for one in outcomes.values() if isinstance(one, SmartCamError)] == []
        await until(lambda: not plant._program._pending_calls)
    await until(lambda: asyncio.all_tasks() == tasks)
    return over


async def server_start_cancelled(steps: int) -> bool:
    tasks = asyncio.all_tasks()
    bus = MemoryBus()
    server = FleetServer(FILE, bus=bus.new_connection())
    over = await cancelled_after(steps, server.start())
    if not over and steps:
        assert bus.connections == []
    await server.start()  # it can be started again
    assert len(server.shared_cameras) == 2
    await server.stop()
    assert bus.connections == []
    await until(lambda: asyncio.all_tasks() == tasks)
    return over


def lives(name: str) -> Callable[[int], Coroutine[Any, Any, bool]]:
    """Return what cancels something that is no call of an open camera."""
    return {
        "open": open_cancelled,
        "close": close_cancelled,
        "fleet open": fleet_open_cancelled,
        "fleet trigger": fleet_trigger_cancelled,
        "server start": server_start_cancelled,
    }[name]


LIVES = ("open", "close", "fleet open", "fleet trigger", "server start")


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("name", CALLS)
def test_call_cancelled_at_any_step_leaves_everything_as_it_was(name: str) -> None:
    assert sweep(lambda steps: call_cancelled(name, steps), STRIDE) > 0


@pytest.mark.parametrize("name", LIVES)
def test_life_cancelled_at_any_step_leaves_nothing_behind(name: str) -> None:
    assert sweep(lives(name), STRIDE) > 0


@pytest.mark.long
@pytest.mark.parametrize("name", CALLS)
def test_call_cancelled_at_each_step_leaves_everything_as_it_was(name: str) -> None:
    assert sweep(lambda steps: call_cancelled(name, steps), 1) > 0


@pytest.mark.long
@pytest.mark.parametrize("name", LIVES)
def test_life_cancelled_at_each_step_leaves_nothing_behind(name: str) -> None:
    assert sweep(lives(name), 1) > 0
