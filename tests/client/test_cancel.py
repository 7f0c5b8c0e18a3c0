"""Every coroutine of a camera, cancelled after 0, 1, 2 ... steps: the camera goes on."""

from __future__ import annotations

import asyncio
import contextlib
from datetime import datetime
from types import NoneType
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam import ConnectionClosedError, NotRunningError
from smartcam.emulator import EmulatedCamera
from tests.client.clientkit import balance
from tests.client.inside import TriggerEvidence, _Owed
from tests.insides import inside

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from smartcam import Camera

    Call = Callable[[Camera], Coroutine[Any, Any, object]]

COUNTER = {
    "layout": "n: int32 @sequence",
    "generator": "sequence",
    "input": "part: int32",
    "load_time": 0.0,
    "processing_time": 0.0,
}
"""Each run gives another number, so that no result can pass for another one."""

MAX_STEPS = 300
"""Bound of a sweep; the longest call takes about a fifth of it."""


async def in_application(camera: Camera) -> None:
    async with camera.application(3):
        await asyncio.sleep(0)


async def in_application_that_fails(camera: Camera) -> None:
    with contextlib.suppress(ZeroDivisionError):
        async with camera.application(3):
            raise ZeroDivisionError


async def two_triggers(camera: Camera) -> None:
    await camera.trigger(timeout=5)
    await camera.trigger(3)


async def trigger_after_an_error(camera: Camera) -> object:
    await camera.request(0x40)
    return await camera.trigger()


async def next_of(stream: Any) -> object:
    async with stream:
        return await anext(stream)


async def next_result(camera: Camera) -> object:
    waiting = camera.next_result()
    return (await asyncio.gather(waiting, camera.trigger()))[0]


async def next_in_streams(camera: Camera) -> object:
    return await asyncio.gather(
        next_of(camera.results()),
        next_of(camera.statuses()),
        next_of(camera.events()),
        camera.trigger(),
    )


async def next_in_streams_of_bid(camera: Camera) -> object:
    """Without events: what has ended before the status is asked for has changed nothing."""
    return await asyncio.gather(
        next_of(camera.results()), next_of(camera.statuses()), camera.trigger()
    )


CALLS: dict[str, Call] = {
    "trigger": lambda camera: camera.trigger(),
    "trigger with input": lambda camera: camera.trigger(input=bytes(4)),
    "trigger in the active application": lambda camera: camera.trigger(7),
    "trigger in another application": lambda camera: camera.trigger(3),
    "two triggers": two_triggers,
    "switch_application": lambda camera: camera.switch_application(3),
    "application": in_application,
    "application that fails": in_application_that_fails,
    "start": lambda camera: camera.start(),
    "stop": lambda camera: camera.stop(),
    "query_application": lambda camera: camera.query_application(),
    "get_clock": lambda camera: camera.get_clock(),
    "set_clock": lambda camera: camera.set_clock(datetime(2024, 1, 1)),  # noqa: DTZ001
    "set_input": lambda camera: camera.set_input(bytes(4)),
    "set_sequence_number": lambda camera: camera.set_sequence_number(1000),
    "wait_status": lambda camera: camera.wait_status(bool),
    "wait_ready": lambda camera: camera.wait_ready(),
    "next_result": next_result,
    "streams": next_in_streams,
    "request": lambda camera: camera.request(0x30),
    "request without an answer": lambda camera: camera.request(0x30, answered=False),
}


BID_CALLS: dict[str, Call] = {
    **{name: call for name, call in CALLS.items() if name not in {"start", "stop"}},
    "streams": next_in_streams_of_bid,
    "query_status": lambda camera: camera.query_status(),
    "reset_errors": lambda camera: camera.reset_errors(),
    "trigger that resets errors": trigger_after_an_error,
}
del BID_CALLS["set_sequence_number"]

CALLS_IN = [("handbook", name) for name in CALLS] + [("bid", name) for name in BID_CALLS]


def emulator(
    transport: Any = "tcp", *, running: bool = True, dialect: str = "handbook"
) -> EmulatedCamera:
    """Return a camera whose every answer is there at once."""
    applications = [{"id": 7, **COUNTER}, {"id": 3, **COUNTER}]
    return EmulatedCamera(
        applications, transport=transport, running=running, builtins=False, dialect=dialect
    )


def connect(box: EmulatedCamera, application: int | None = None) -> Camera:
    return smartcam.connect(
        box.url, application=application, interpret_as="n: int32 @sequence", request_timeout=1.0
    )


async def cancel_after(count: int, call: Coroutine[Any, Any, object]) -> bool:
    """Cancel a call after some steps; return whether it was over already."""
    task = asyncio.create_task(call)
    for _ in range(count):
        await asyncio.sleep(0)
    over = task.done()
    task.cancel()
    _, late = await asyncio.wait({task}, timeout=5)
    assert not late
    if over:
        task.result()
    else:
        assert task.cancelled()
    return over


async def works(camera: Camera, box: EmulatedCamera) -> None:
    """Assert that a trigger gets its own result and that both sides agree on everything."""
    result = await camera.trigger(7, timeout=5)
    assert result.application == 7
    assert result.sequence == box.device.next_number - 1
    await camera.get_clock()
    if camera.capabilities.get_status:
        await camera.query_status()
    assert camera.status == box.device.status
    assert camera.active_application == box.device.active_application
    assert box.device.active_application in {3, 7}
    balance(camera.statistics())


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize("transport", ["tcp", "udp"])
@pytest.mark.parametrize(("dialect", "name"), CALLS_IN)
async def test_call_cancelled_at_any_step_leaves_a_camera_that_works(
    dialect: str, name: str, transport: str
) -> None:
    calls = BID_CALLS if dialect == "bid" else CALLS
    for count in range(MAX_STEPS):
        async with emulator(transport, dialect=dialect) as box, connect(box) as camera:
            over = await cancel_after(count, calls[name](camera))
            await works(camera, box)
        if over:
            return
    pytest.fail(f"it is not over after {MAX_STEPS} steps")


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("name", CALLS)
async def test_call_cancelled_at_any_step_leaves_a_camera_whose_state_is_known(name: str) -> None:
    for count in range(MAX_STEPS):
        async with emulator() as box, connect(box) as camera:
            over = await cancel_after(count, CALLS[name](camera))
            try:
                result = await camera.trigger(timeout=1)
            except NotRunningError:
                assert not box.device.running
            else:
                assert result.application == box.device.active_application
                assert result.sequence == box.device.next_number - 1
        if over:
            return


@pytest.mark.parametrize("name", ["trigger", "trigger in another application", "application"])
async def test_call_cancelled_at_any_step_and_repeated_is_done(name: str) -> None:
    async with emulator() as box, connect(box) as camera:
        for count in range(MAX_STEPS):
            over = await cancel_after(count, CALLS[name](camera))
            assert await camera.query_application() in {3, 7}
            if over:
                break
        await CALLS[name](camera)
        assert (box.device.active_application, box.device.running) == (7, True)
        await works(camera, box)


@pytest.mark.parametrize("dialect", ["handbook", "b16", "bid"])
async def test_trigger_cancelled_at_any_step_leaves_the_next_trigger_its_own_result(
    dialect: str,
) -> None:
    async with emulator(dialect=dialect) as box, connect(box) as camera:
        for count in range(MAX_STEPS):
            over = await cancel_after(count, camera.trigger())
            result = await camera.trigger()
            assert result.sequence == box.device.next_number - 1
            if over:
                return


def _owe(camera: Camera) -> None:
    """Have the client owe a result, as after a trigger that was given up."""
    begun = TriggerEvidence()
    begun.on_beginning()
    inside(camera)._results.correlation.owed.append(_Owed("late", None, 1, begun))


@pytest.mark.parametrize("dialect", ["handbook", "bid"])
async def test_settling_cancelled_at_any_step_leaves_the_next_trigger_its_own_result(
    dialect: str,
) -> None:
    async with emulator(dialect=dialect) as box, connect(box) as camera:
        for count in range(MAX_STEPS):
            _owe(camera)
            over = await cancel_after(count, camera.trigger())
            result = await camera.trigger()
            assert result.sequence == box.device.next_number - 1
            if over:
                return


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("application", [None, 3, 7])
@pytest.mark.parametrize(
    ("dialect", "running"), [("handbook", True), ("handbook", False), ("bid", True)]
)
async def test_open_cancelled_at_any_step_leaves_a_camera_for_the_next(
    application: int | None, dialect: str, *, running: bool
) -> None:
    for count in range(MAX_STEPS):
        async with emulator(running=running, dialect=dialect) as box:
            camera = connect(box, application=application)
            over = await cancel_after(count, camera.open())
            assert camera.connected == over
            await camera.close()
            async with connect(box, application=7) as following:
                await works(following, box)
        if over:
            return


@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_close_cancelled_at_any_step_leaves_nothing(transport: str) -> None:
    for count in range(MAX_STEPS):
        async with emulator(transport) as box:
            camera = await connect(box)
            over = await cancel_after(count, camera.close())
            await camera.close()
            assert not camera.connected
            async with connect(box) as following:
                await works(following, box)
        if over:
            return


async def test_close_at_any_step_of_a_trigger_in_another_application_ends_it() -> None:
    for count in range(MAX_STEPS):
        async with emulator() as box, connect(box) as camera:
            task = asyncio.create_task(camera.trigger(3))
            for _ in range(count):
                await asyncio.sleep(0)
            over = task.done()
            await camera.close()
            _, late = await asyncio.wait({task}, timeout=5)
            assert not late
            if not over:
                assert isinstance(task.exception(), (ConnectionClosedError, NoneType))
        if over:
            return
