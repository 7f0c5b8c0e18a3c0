"""The client and emulated cameras that speak b16 and bid."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import smartcam
from smartcam import (
    Camera,
    CommandRejectedError,
    ConnectionLostError,
    OvertriggeredError,
    Status,
    StatusChanged,
    TriggerTimeoutError,
    UnsupportedError,
)
from smartcam.emulator import EmulatedCamera, faults
from smartcam.protocols import messages as m
from tests.client.clientkit import FAST, SHORT, SOON, balance, emulated
from tests.handmade import until

IDLE = Status.RUNNING | Status.WAITING_FOR_TRIGGER

COUNTER = {
    "id": 7,
    "layout": "n: uint32 @sequence",
    "generator": "sequence",
    "processing_time": 0.5,
}
"""Each run gives another number, so that no result can pass for another one."""


@pytest.fixture(params=[False, True], ids=["pull", "push"])
def push(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


def bid(transport: Any = "tcp", *, push: bool = False, **options: Any) -> dict[str, Any]:
    """Return what makes a BVS ID with the counter."""
    quirks = {"push_status": push}
    return {
        "applications": [COUNTER, {**COUNTER, "id": 3}],
        "transport": transport,
        "dialect": "bid",
        "quirks": quirks,
        **options,
    }


async def number(camera: Camera, **options: Any) -> int:
    """Trigger and return the run's number."""
    result = await camera.trigger(interpret_as="n: uint32", **options)
    return int(result.value.n)


# ---------------------------------------------------------------------- bid: triggers


async def test_bid_late_result_after_a_timeout_is_never_the_next_triggers(
    transport: Any, *, push: bool
) -> None:
    async with emulated(box=bid(transport, push=push)) as (box, clock, camera):
        with pytest.raises(TriggerTimeoutError, match="no result within"):
            await number(camera, timeout=SHORT)
        next_one = asyncio.create_task(number(camera))
        await until(lambda: camera.status == Status.RUNNING)
        clock.advance(0.5)  # the first run's result comes
        await box.wait_received(m.Trigger, count=2)
        clock.advance(0.5)
        assert await next_one == 1
        statistics = camera.statistics()
        assert (statistics.late, statistics.triggered) == (1, 1)
        balance(statistics)


async def test_bid_run_without_a_result_leaves_the_next_trigger_its_own(
    transport: Any, *, push: bool
) -> None:
    lost = faults.NoResult(on="Trigger")
    async with emulated(box=bid(transport, push=push, faults=[lost])) as (box, clock, camera):
        with pytest.raises(TriggerTimeoutError):
            await number(camera, timeout=SHORT)
        clock.advance(0.5)
        next_one = asyncio.create_task(number(camera))
        await box.wait_received(m.Trigger, count=2)
        clock.advance(0.5)
        assert await next_one == 1


async def test_bid_trigger_waits_for_the_end_of_somebody_elses_inspection(
    transport: Any, *, push: bool
) -> None:
    async with emulated(box=bid(transport, push=push)) as (box, clock, camera):
        box.device.trigger()
        waiting = asyncio.create_task(number(camera))
        await box.wait_received(m.GetStatus, count=3)
        clock.advance(0.5)
        await box.wait_received(m.Trigger)
        clock.advance(0.5)
        assert await waiting == 1
        assert camera.statistics().overtriggers == 0
        balance(camera.statistics())


async def test_bid_trigger_error_during_ours_is_an_overtrigger_and_then_reset(
    transport: Any, *, push: bool
) -> None:
    async with emulated(box=bid(transport, push=push)) as (box, clock, camera):
        waiting = asyncio.create_task(number(camera))
        await box.wait_received(m.Trigger)
        box.device.trigger()
        with pytest.raises(OvertriggeredError):
            await waiting
        clock.advance(0.5)
        next_one = asyncio.create_task(number(camera))
        await box.wait_received(m.Trigger, count=2)
        clock.advance(0.5)
        assert await next_one == 1
        assert await camera.query_status() == IDLE
        balance(camera.statistics())


async def test_bid_sticky_error_of_before_the_session_spoils_nothing(transport: Any) -> None:
    box = bid(transport, applications=[{**COUNTER, "processing_time": 0.0}])
    drop = faults.Overtrigger()
    async with EmulatedCamera(**box, faults=[drop]) as emulator:
        emulator.device.trigger()
        async with smartcam.connect(emulator.url) as camera:
            assert Status.OVERTRIGGERED in camera.status
            assert await number(camera) == 0
            assert camera.status == IDLE


async def test_bid_reset_errors_clears_what_is_set(transport: Any) -> None:
    drop = faults.Overtrigger()
    async with emulated(box=bid(transport, faults=[drop])) as (box, _, camera):
        box.device.trigger()
        assert await camera.query_status() == IDLE | Status.OVERTRIGGERED
        assert await camera.reset_errors() == IDLE
        assert await camera.query_status() == IDLE


# ---------------------------------------------------------------------- bid: switching


async def test_bid_switch_waits_for_another_one_that_is_under_way(transport: Any) -> None:
    async with emulated(box=bid(transport)) as (box, clock, camera):
        box.device.switch_application(21)
        waiting = asyncio.create_task(camera.switch_application(3))
        await box.wait_received(m.SwitchApplication, count=2)  # the first one came too soon
        clock.advance(0.3)
        count = 3
        while box.device.mode.value != "switching":
            await box.wait_received(m.SwitchApplication, count=count)
            count += 1
        clock.advance(0.3)
        await waiting
        assert (box.device.active_application, camera.active_application) == (3, 3)


async def test_bid_connect_while_it_loads_waits_for_the_application(transport: Any) -> None:
    async with EmulatedCamera(**bid(transport, clock=smartcam.emulator.ManualClock())) as box:
        box.device.switch_application(3)
        opening = asyncio.create_task(smartcam.connect(box.url).open())
        await box.wait_received(m.Query, count=2)
        assert not opening.done()
        box.clock.advance(0.3)  # type: ignore[attr-defined]
        camera = await opening
        assert camera.active_application == 3
        await camera.close()


async def test_bid_switch_to_an_unknown_id_leaves_the_old_one(transport: Any) -> None:
    async with emulated(box=bid(transport)) as (_, _, camera):
        with pytest.raises(CommandRejectedError) as caught:
            await camera.switch_application(99)
        assert (caught.value.code, caught.value.active_application) == (0x1A, 7)
        assert await camera.query_application() == 7


# ---------------------------------------------------------------------- bid: status, life


async def test_bid_changes_behind_the_clients_back_are_seen(transport: Any, *, push: bool) -> None:
    async with emulated(box=bid(transport, push=push)) as (box, clock, camera):
        async with camera.statuses() as statuses, camera.events() as events:
            box.device.trigger()
            async with asyncio.timeout(SOON):
                while await anext(statuses) != Status.RUNNING:
                    pass
            clock.advance(0.5)
            async with asyncio.timeout(SOON):
                while await anext(statuses) != IDLE:
                    pass
                changes = [await anext(events), await anext(events)]
        assert [one.status for one in changes if isinstance(one, StatusChanged)] == [
            Status.RUNNING,
            IDLE,
        ]


async def test_bid_wait_status_sees_what_is_now(transport: Any) -> None:
    async with emulated(box=bid(transport)) as (box, clock, camera):
        box.device.trigger()
        assert await camera.wait_status(lambda status: True) == Status.RUNNING
        clock.advance(0.5)
        assert await camera.wait_ready() == IDLE


async def test_bid_comes_back_after_a_restart_and_triggers_again() -> None:
    box = bid(applications=[{**COUNTER, "processing_time": 0.0}])
    async with (
        EmulatedCamera(**box) as emulator,
        smartcam.connect(emulator.url, reconnect=FAST) as camera,
    ):
        assert await number(camera) == 0
        emulator.device.reboot(0.02)
        await until(lambda: not camera.connected)
        with pytest.raises(ConnectionLostError):
            await number(camera)
        await camera.wait_connected(SOON)
        assert await number(camera) == 0


# ---------------------------------------------------------------------- b16


async def test_b16_container_without_an_id_is_the_active_applications(transport: Any) -> None:
    applications = [{**COUNTER, "id": one, "processing_time": 0.0} for one in (7, 3)]
    options: Any = {"transport": transport, "dialect": "b16", "quirks": {"no_id": True}}
    async with (
        EmulatedCamera(applications, running=True, **options) as emulator,
        smartcam.connect(emulator.url, interpret_as="n: uint32") as camera,
    ):
        assert emulator.url.endswith("?dialect=b16&quirks=no_id")
        assert (await camera.trigger()).application == 7
        assert (await camera.trigger(3)).application == 3
        async with camera.results() as results:
            emulator.device.trigger()
            async with asyncio.timeout(SOON):
                result = await anext(results)
        assert (result.application, result.value.n) == (7, 2)
        balance(camera.statistics())


async def test_b16_free_run_without_ids_is_the_active_applications(transport: Any) -> None:
    free = {"id": 9, "layout": "n: uint32 @sequence", "generator": "sequence", "rate": 500.0}
    options: Any = {"transport": transport, "dialect": "b16", "quirks": {"no_id": True}}
    async with (
        EmulatedCamera([free], **options) as emulator,
        smartcam.connect(emulator.url, application=9, interpret_as="n: uint32") as camera,
        camera.results() as results,
    ):
        async with asyncio.timeout(SOON):
            got = [await anext(results) for _ in range(20)]
    assert {one.application for one in got} == {9}
    first = got[0].value.n
    assert [one.value.n for one in got] == list(range(first, first + 20))


@pytest.mark.parametrize("quirk", [False, True])
async def test_b16_number_of_a_trigger_reaches_the_camera(transport: Any, *, quirk: bool) -> None:
    options: Any = {
        "transport": transport,
        "dialect": "b16",
        "quirks": {"big_endian_number": quirk},
    }
    fast = {**COUNTER, "processing_time": 0.0}
    async with (
        EmulatedCamera([fast], running=True, **options) as emulator,
        smartcam.connect(emulator.url, interpret_as="n: uint32 @sequence") as camera,
    ):
        await camera.set_sequence_number(56_078_336)
        assert (await camera.trigger()).sequence == 56_078_336
        assert emulator.device.next_number == 56_078_337
        assert (await camera.trigger()).sequence == emulator.device.next_number - 1


async def test_b16_request_it_lacks_names_dialect_and_abilities() -> None:
    async with emulated(box={"dialect": "b16"}) as (_, _, camera):
        with pytest.raises(UnsupportedError) as caught:
            await camera.reset_errors()
        assert str(caught.value) == (
            "dialect b16 has no ResetErrors; it can: switch, start_stop, reboot, get_clock, "
            "set_clock, input_data, sequence_number, unasked_status, unasked_results"
        )
        with pytest.raises(UnsupportedError, match="dialect b16 has no GetStatus"):
            await camera.query_status()
        assert await camera.query_application() == 1


async def test_bid_answer_that_is_only_a_refusing_code_leaves_the_session(transport: Any) -> None:
    async with emulated(box=bid(transport)) as (_, _, camera):
        assert await camera.request(0x31, b"\x05") == bytes.fromhex("1000 0000")
        assert await camera.request(0x33, b"") == bytes.fromhex("1000")
        assert camera.active_application == 7
        assert await camera.query_application() == 7
