"""Reservations over the bus: no command comes between, and each one ends."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence

import pytest

from smartcam.exceptions import (
    ReservationLostError,
    ResponseTimeoutError,
    TriggerTimeoutError,
)
from tests.client.clientkit import gone
from tests.fleet.fleetkit import NAME, NumberedCamera, Plant, end_of, until
from tests.fleet.inside import Gate, in_words
from tests.fleet.lossy_bus import LossyBus, as_said, only


def gate(plant: Plant) -> Gate:
    return plant.agent.shared_cameras[NAME].gate


async def test_commands_of_others_wait_and_fail_naming_the_holder() -> None:
    async with Plant() as plant, plant.cameras(2) as (one, other):
        async with one.reserve(timeout=1.0):
            holder = in_words(one._program.name)
            error = await gone(other.trigger(timeout=0.5))
            assert isinstance(error, TriggerTimeoutError)
            assert holder in str(error)
            assert "was not done" in str(error)
            error = await gone(other.reserve(timeout=0.5).__aenter__())
            assert isinstance(error, ResponseTimeoutError)
            assert holder in str(error)
            assert (await one.trigger(timeout=1.0)).value.run == 1
            assert (await other.query_application()) == 1  # a question passes
            waiting = asyncio.create_task(other.trigger(timeout=60.0))
            await asyncio.sleep(1.0)
            assert not waiting.done()
        assert (await waiting).value.run == 2


async def test_reservation_that_waits_for_commands_says_so() -> None:
    box = NumberedCamera(time=5.0)
    async with Plant(box) as plant, plant.cameras(3) as (one, other, third):
        running = asyncio.create_task(one.trigger(timeout=60.0))
        await asyncio.sleep(0.1)
        reserving = asyncio.create_task(other.reserve(timeout=2.0).__aenter__())
        await asyncio.sleep(0.1)
        behind = await gone(third.trigger(timeout=1.0))
        error = await gone(reserving)
        for one_error in (behind, error):
            assert isinstance(one_error, (ResponseTimeoutError, TriggerTimeoutError))
            assert "None" not in str(one_error)
            assert "commands of others" in str(one_error)
            assert "was not done" in str(one_error)
        assert (await running).value.run == 1
        assert (await third.trigger(timeout=60.0)).value.run == 2


async def test_program_that_is_cut_off_holds_nothing() -> None:
    async with Plant() as plant, plant.cameras(2) as (one, other):
        reservation = one.reserve(timeout=1.0)
        await reservation.__aenter__()
        waiting = asyncio.create_task(other.trigger(timeout=60.0))
        await asyncio.sleep(0.1)
        begun = asyncio.get_running_loop().time()
        end_of(one).detach()
        assert (await waiting).value.run == 1
        assert asyncio.get_running_loop().time() - begun < 0.1
        end_of(one).attach()
        await one.wait_connected()
        async with other.reserve(timeout=1.0):
            with pytest.raises(ReservationLostError):
                await reservation.__aexit__(None, None, None)  # its end is no other's
            await asyncio.sleep(0.1)
            assert gate(plant).holder == other._program.name
        await until(lambda: gate(plant).holder is None)
        assert (await one.trigger(timeout=1.0)).value.run == 2


@pytest.mark.parametrize("lost", ["command", "reply"])
async def test_no_reservation_is_forgotten_where_its_end_is_lost(lost: str) -> None:
    """A release, or the word that nobody waits for a reservation any more, may be lost."""
    bus = LossyBus()
    async with Plant(bus=bus) as plant, plant.cameras(2) as (one, other):
        ends = pytest.raises(ReservationLostError) if lost == "reply" else contextlib.nullcontext()
        with ends:
            async with one.reserve(timeout=1.0):
                bus.fate = only(lost, lambda *_: ())
        await asyncio.sleep(0.5)
        bus.fate = as_said
        assert (await other.trigger(timeout=20.0)).value.run == 1
        if lost == "reply":
            bus.fate = only(lost, lambda *_: ())
            assert isinstance(await gone(one.reserve(timeout=1.0).__aenter__()), TimeoutError)
            bus.fate = as_said
            assert (await other.trigger(timeout=20.0)).value.run == 2
        await until(lambda: gate(plant).holder is None)


@pytest.mark.parametrize(
    "fates", [(0.0, 0.3), (0.3, 0.0), (0.2, 0.2), (0.0, None), (0.2, None), (None, 0.0)]
)
@pytest.mark.parametrize("end", ["cancelled", "timeout"])
async def test_reservation_that_nobody_waits_for_any_more_is_none(
    fates: tuple[float | None, float | None], end: str
) -> None:
    """The call and the word that it is given up are late or lost; no reply comes at all."""
    delays = iter(fates)

    def fate(key: str, _: bytes) -> Sequence[float]:
        at = next(delays, 0.0) if "/command/" in key else 0.0
        return () if at is None or "/reply/" in key else (at,)

    bus = LossyBus()
    async with Plant(bus=bus) as plant, plant.cameras(2) as (one, other):
        bus.fate = fate
        task = asyncio.create_task(one.reserve(timeout=0.25).__aenter__())
        if end == "cancelled":
            await asyncio.sleep(0.1)
            task.cancel()
        error = (await asyncio.gather(task, return_exceptions=True))[0]
        assert isinstance(error, (asyncio.CancelledError, ResponseTimeoutError))
        await asyncio.sleep(0.5)
        bus.fate = as_said
        assert await other.trigger(timeout=20.0)
        assert gate(plant).holder is None


async def test_temporary_application_is_left_where_the_word_is_lost() -> None:
    bus = LossyBus()
    async with Plant(bus=bus) as plant, plant.camera() as one:
        with contextlib.suppress(ZeroDivisionError):
            async with one.application(2):
                bus.fate = only("command", lambda *_: ())
                raise ZeroDivisionError
        await asyncio.sleep(0.5)
        assert plant.box.device.active_application == 2
        bus.fate = as_said
        await until(lambda: plant.box.device.active_application == 1)
