"""Input of a trigger without a result: the agent empties the queue before the next trigger."""

from __future__ import annotations

import asyncio

import pytest

from smartcam import Status
from smartcam.emulator import faults
from smartcam.exceptions import TriggerTimeoutError
from smartcam.fleet import FleetCamera
from tests.fleet.fleetkit import NAME, NumberedCamera, Plant, until


def token(number: int) -> bytes:
    return number.to_bytes(4, "little")


async def leave_in_doubt(plant: Plant, camera: FleetCamera) -> None:
    """Have a trigger with input end without a result: its input may still be queued."""
    plant.box.inject(faults.NoResult())
    with pytest.raises(TriggerTimeoutError):
        await camera.trigger(input=token(7), timeout=0.1)
    client = plant.agent.shared_cameras[NAME].client
    await until(lambda: client._results.input_in_doubt)


async def test_no_program_is_kept_out_by_anothers_trigger_with_input() -> None:
    async with Plant(NumberedCamera(active=2)) as plant, plant.cameras(2) as (one, other):
        await leave_in_doubt(plant, one)
        outcomes = await asyncio.gather(
            *(
                camera.trigger(input=token(number), timeout=30.0)
                for number, camera in enumerate((one, other, other), 8)
            )
        )
        assert [result.value.token for result in outcomes] == [8, 9, 10]
        assert Status.RUNNING in other.status
        assert plant.agent.shared_cameras[NAME].client._state.wanted.application is None


async def test_trigger_cancelled_with_its_input_keeps_nobody_out() -> None:
    async with Plant(NumberedCamera(active=2)) as plant, plant.cameras(2) as (one, other):
        plant.box.inject(faults.NoResult())
        cancelled = asyncio.create_task(one.trigger(input=token(7), timeout=30.0))
        await until(lambda: plant.box.runs)
        cancelled.cancel()
        await asyncio.wait({cancelled})
        assert (await other.trigger(input=token(8), timeout=30.0)).value.token == 8


async def test_trigger_that_cannot_wait_so_long_is_not_sent_and_the_queue_is_emptied() -> None:
    async with Plant(NumberedCamera(active=2, time=0.3)) as plant, plant.cameras(2) as (one, other):
        await leave_in_doubt(plant, one)
        with pytest.raises(TriggerTimeoutError, match="no trigger was sent"):
            await other.trigger(input=token(8), timeout=0.05)
        assert (await other.trigger(input=token(9), timeout=30.0)).value.token == 9
        assert 8 not in plant.box.inputs.values()
