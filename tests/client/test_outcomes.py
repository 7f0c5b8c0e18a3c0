"""Each outcome of a trigger, and what follows it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import pytest

import smartcam
from smartcam import (
    Backoff,
    Camera,
    CameraBusyError,
    CameraFaultError,
    CommandRejectedError,
    ConfigurationError,
    ConnectionClosedError,
    ConnectionLostError,
    ConnectionTakenError,
    InputContainerError,
    InterpretationError,
    NotRunningError,
    OvertriggeredError,
    Result,
    SmartCamError,
    Status,
    StatusChanged,
    TriggerTimeoutError,
    WrongApplicationError,
)
from smartcam.emulator import EmulatedCamera, ManualClock
from smartcam.protocols import messages as m
from tests.client.camera_by_hand import (
    BUSY,
    INPUT_CONTAINER,
    OVERHEAT,
    OVERTRIGGERED,
    QUERY,
    READY,
    RUNNING,
    SYSTEM_ERROR,
    TRIGGER,
    HandmadeCamera,
    words,
)
from tests.client.clientkit import SHORT, SOON, answers, balance, by_hand, emulated, gone, steps
from tests.handmade import until


class Witness(smartcam.Observer):
    """Keeps what it sees."""

    def __init__(self) -> None:
        self.results: list[Result] = []
        self.errors: list[tuple[SmartCamError, datetime | None]] = []

    def on_result(self, result: Result) -> None:
        self.results.append(result)

    def on_error(self, camera: str, error: SmartCamError, triggered_at: datetime | None) -> None:
        self.errors.append((error, triggered_at))


# ---------------------------------------------------------------------- the closed list, by hand


async def plain(_: Any, camera: Camera) -> object:
    return await camera.trigger(timeout=SOON)


async def short(_: Any, camera: Camera) -> object:
    return await camera.trigger(timeout=2.0)  # all that is said in it comes in it, over Zenoh, too


async def with_input(_: Any, camera: Camera) -> object:
    return await camera.trigger(input=b"part", timeout=SOON)


async def without_patience(_: Any, camera: Camera) -> object:
    return await camera.trigger(when_busy="refuse", timeout=SOON)


async def of_a_number(_: Any, camera: Camera) -> object:
    return await camera.trigger(interpret_as="n: int32", timeout=SOON)


async def in_application_99(_: Any, camera: Camera) -> object:
    return await camera.trigger(99, timeout=SOON)


async def while_the_link_is_lost(box: HandmadeCamera, camera: Camera) -> object:
    triggering = asyncio.create_task(camera.trigger(timeout=SOON))
    await box.wait_for(TRIGGER)
    box.hang_up()
    return await triggering


async def while_it_is_closed(box: HandmadeCamera, camera: Camera) -> object:
    triggering = asyncio.create_task(camera.trigger(timeout=SOON))
    await box.wait_for(TRIGGER)
    await camera.close()
    return await triggering


async def after_it_was_closed(_: Any, camera: Camera) -> object:
    await camera.close()
    return await camera.trigger(timeout=SOON)


async def after_it_was_taken(box: HandmadeCamera, camera: Camera) -> object:
    for _ in range(2):  # lost, and lost again right after the reconnect
        await camera.wait_connected(SOON)
        waiting = asyncio.create_task(camera.wait_status(lambda _: False))
        await steps(2)
        box.hang_up()
        await gone(waiting)
    await gone(camera.wait_connected(SOON))
    return await camera.trigger(timeout=SOON)


@dataclass(frozen=True)
class DirectFuture:
    """The end of a trigger."""

    error: type[SmartCamError]  # with what
    text: str  # what its text says
    at_trigger: Any = None  # what the camera does; as ever where it is None
    status: int = READY  # the camera's at first
    options: dict[str, Any] = field(default_factory=dict[str, Any])  # of the client
    play: Callable[[HandmadeCamera, Camera], Awaitable[object]] = plain  # what the user does


SILENT = answers()
FAST: dict[str, Any] = {"reconnect": Backoff(initial=0.001, jitter=0.0)}
BY_HAND = {
    "overtriggered": DirectFuture(
        OvertriggeredError, "it is unknown whether it", answers(RUNNING | OVERTRIGGERED)
    ),
    "stopped": DirectFuture(NotRunningError, "application 7 is stopped", status=0),
    "stopped meanwhile": DirectFuture(
        NotRunningError, "somebody else stopped application 7 during", answers(RUNNING, 0)
    ),
    "loaded meanwhile": DirectFuture(
        NotRunningError, "somebody else stopped application 7 during", answers(RUNNING, BUSY)
    ),
    "busy": DirectFuture(
        CameraBusyError, "does not wait for a trigger", status=BUSY, play=without_patience
    ),
    "inspecting": DirectFuture(
        CameraBusyError, "does not wait for a trigger", status=RUNNING, play=without_patience
    ),
    "fault": DirectFuture(CameraFaultError, "System Error", status=READY | SYSTEM_ERROR),
    "fault meanwhile": DirectFuture(
        CameraFaultError, "System Error", answers(RUNNING, RUNNING | SYSTEM_ERROR)
    ),
    "input out of step": DirectFuture(
        InputContainerError, "out of step", answers(RUNNING | INPUT_CONTAINER), play=with_input
    ),
    "no result": DirectFuture(TriggerTimeoutError, "no result within", SILENT, play=short),
    "never waits": DirectFuture(TriggerTimeoutError, "runs free", status=RUNNING, play=short),
    "result of another application": DirectFuture(
        WrongApplicationError,
        "a result of application 3 came, application 7 was expected",
        answers(RUNNING, result=b"?", application=3),
        options={"application": 7},
    ),
    "result of another application than was active": DirectFuture(
        WrongApplicationError,
        "a result of application 3 came, application 7 was expected",
        answers(RUNNING, result=b"?", application=3),
    ),
    "application that the mapping lacks": DirectFuture(
        WrongApplicationError,
        r"interpret_as knows \[1, 3\]",
        options={"interpret_as": {1: "raw", 3: "raw"}},
    ),
    "result that does not fit": DirectFuture(InterpretationError, "got 5", play=of_a_number),
    "application that is not there": DirectFuture(
        CommandRejectedError, "application 99", play=in_application_99
    ),
    "lost": DirectFuture(ConnectionLostError, "is gone", SILENT, play=while_the_link_is_lost),
    "taken": DirectFuture(
        ConnectionTakenError, "another client has the camera", play=after_it_was_taken, options=FAST
    ),
    "closed": DirectFuture(ConnectionClosedError, "is closed", play=after_it_was_closed),
    "closed meanwhile": DirectFuture(
        ConnectionClosedError, "is closed", SILENT, play=while_it_is_closed
    ),
}


@pytest.mark.parametrize("name", BY_HAND)
async def test_outcome_of_a_trigger_by_hand(name: str) -> None:
    one, witness = BY_HAND[name], Witness()
    options = {"observers": [witness], **one.options}
    async with by_hand(box={"status": one.status}, **options) as (box, camera):
        if one.at_trigger is not None:
            box.script[TRIGGER] = one.at_trigger(box)
        async with asyncio.timeout(2 * SOON):
            with pytest.raises(one.error, match=one.text) as caught:
                await one.play(box, camera)
        assert type(caught.value) is one.error
        error, triggered_at = witness.errors[-1]
        assert error is caught.value or "closed" in name
        assert triggered_at is not None or "closed" in name
        assert witness.results == []
        balance(camera.statistics())


async def test_outcome_that_is_a_result_is_seen_by_observers() -> None:
    witness = Witness()
    async with by_hand(observers=[witness]) as (_, camera):
        result = await camera.trigger()
        assert witness.results == [result]
        assert result.triggered_at is not None
        assert witness.errors == []


# ---------------------------------------------------------------------- the closed list, emulated


@dataclass
class Stage:
    """The emulated camera, its clock, the client."""

    emulator: EmulatedCamera
    clock: ManualClock
    camera: Camera

    async def begin(self, **options: Any) -> asyncio.Task[Any]:
        """Trigger, and wait until the camera inspects."""
        triggering = asyncio.create_task(self.camera.trigger(timeout=SOON, **options))
        await self.emulator.wait_received(m.Trigger)
        return triggering


async def sensor_meanwhile(stage: Stage) -> object:
    triggering = await stage.begin()
    stage.emulator.device.trigger()
    return await triggering


async def stopped_meanwhile(stage: Stage) -> object:
    triggering = await stage.begin()
    stage.emulator.device.stop()
    return await triggering


async def stopped_before(stage: Stage) -> object:
    stage.emulator.device.stop()
    await stage.camera.wait_status(lambda status: not status)
    return await stage.camera.trigger()


async def sensor_before(stage: Stage) -> object:
    stage.emulator.device.trigger()
    await stage.camera.wait_status(lambda status: Status.WAITING_FOR_TRIGGER not in status)
    return await stage.camera.trigger(when_busy="refuse")


async def fault_meanwhile(stage: Stage) -> object:
    triggering = await stage.begin()
    stage.emulator.device.set_condition(Status.SYSTEM_ERROR, on=True)
    return await triggering


async def one_input_too_many(stage: Stage) -> object:
    await stage.camera.set_input(bytes(4))
    return await stage.camera.trigger(input=bytes(4))


async def time_stands_still(stage: Stage) -> object:
    return await stage.camera.trigger(timeout=SHORT)


async def switched_behind_our_back(stage: Stage) -> object:
    stage.emulator.device.switch_application(7, running=True)
    stage.clock.advance(1)
    await stage.camera.query_application()
    return await stage.camera.trigger()


async def layout_that_does_not_fit(stage: Stage) -> object:
    triggering = await stage.begin(interpret_as="n: int32")
    stage.clock.advance(1)
    return await triggering


async def no_such_application(stage: Stage) -> object:
    return await stage.camera.trigger(99)


async def power_cut(stage: Stage) -> object:
    triggering = await stage.begin()
    await stage.emulator.stop()
    return await triggering


async def closed_meanwhile(stage: Stage) -> object:
    triggering = await stage.begin()
    await stage.camera.close()
    return await triggering


EMULATED: dict[str, tuple[type[SmartCamError], Callable[[Stage], Awaitable[object]]]] = {
    "overtriggered": (OvertriggeredError, sensor_meanwhile),
    "stopped": (NotRunningError, stopped_before),
    "stopped meanwhile": (NotRunningError, stopped_meanwhile),
    "busy": (CameraBusyError, sensor_before),
    "fault": (CameraFaultError, fault_meanwhile),
    "input out of step": (InputContainerError, one_input_too_many),
    "no result": (TriggerTimeoutError, time_stands_still),
    "another application": (WrongApplicationError, switched_behind_our_back),
    "result that does not fit": (InterpretationError, layout_that_does_not_fit),
    "application that is not there": (CommandRejectedError, no_such_application),
    "lost": (ConnectionLostError, power_cut),
    "closed": (ConnectionClosedError, closed_meanwhile),
}
READS_INPUT = {
    "id": 21,
    "layout": "text: string[20]",
    "constant": {"text": "Hello World"},
    "input": "part: int32",
    "processing_time": 0.05,
}


@pytest.mark.parametrize("transport", ["tcp", "udp"])
@pytest.mark.parametrize("name", EMULATED)
async def test_outcome_of_a_trigger_emulated(name: str, transport: str) -> None:
    expected, play = EMULATED[name]
    box = {
        "transport": transport,
        "applications": [READS_INPUT],
        "active": 21,
        "running": True,
        "quirks": {"input_queue_depth": 1},
    }
    async with emulated(box=box, application=21, liveness_timeout=1.0) as (emulator, clock, camera):
        async with asyncio.timeout(2 * SOON):
            with pytest.raises(expected) as caught:
                await play(Stage(emulator, clock, camera))
        assert type(caught.value) is expected
        balance(camera.statistics())


# ---------------------------------------------------------------------- what follows an outcome


async def test_fault_is_told_at_once_and_again_until_it_is_over() -> None:
    async with by_hand() as (box, camera):
        trigger = box.script[TRIGGER]
        box.script[TRIGGER] = answers(RUNNING, RUNNING | SYSTEM_ERROR)(box)
        for _ in range(2):
            async with asyncio.timeout(SOON):
                with pytest.raises(CameraFaultError):
                    await camera.trigger(timeout=60)
        assert box.ids.count(TRIGGER) == 1
        box.script[TRIGGER] = trigger
        box.report(READY)
        await camera.wait_status(lambda status: status == READY)
        assert (await camera.trigger()).raw == b"found"


@pytest.mark.parametrize("rest", ["result first", "waiting first"])
async def test_result_after_overtriggered_is_streamed_and_nobodys(rest: str) -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        trigger = box.script[TRIGGER]
        box.script[TRIGGER] = answers(RUNNING, RUNNING | OVERTRIGGERED)(box)
        with pytest.raises(OvertriggeredError):
            await camera.trigger()
        following = asyncio.create_task(camera.next_result(timeout=SOON))
        box.script[TRIGGER] = trigger
        triggering = asyncio.create_task(camera.trigger())
        await steps(10)
        whose, ready = box.result_frame(b"whose"), box.status_frame(READY)
        box.send(whose + ready if rest == "result first" else ready + whose)
        assert (await triggering).raw == b"found"
        assert (await following).raw == b"found"
        assert [(await anext(results)).raw for _ in range(2)] == [b"whose", b"found"]
        statistics = camera.statistics()
        assert (statistics.streamed, statistics.triggered, statistics.late) == (1, 1, 0)


async def test_stopped_by_somebody_else_then_started_gives_the_next_its_own() -> None:
    async with by_hand() as (box, camera):
        trigger = box.script[TRIGGER]
        box.script[TRIGGER] = answers(RUNNING, 0)(box)
        with pytest.raises(NotRunningError):
            await camera.trigger()
        with pytest.raises(NotRunningError, match="is stopped: start it"):
            await camera.trigger()
        box.script[TRIGGER] = trigger
        await camera.start()
        assert (await camera.trigger()).raw == b"found"


async def test_another_application_that_a_query_has_shown_gets_no_trigger() -> None:
    async with by_hand(application=7) as (box, camera):
        box.active = 3
        assert await camera.query_application() == 3
        mark = len(box.ids)
        with pytest.raises(WrongApplicationError, match="somebody else has switched") as caught:
            await camera.trigger(input=b"part")
        assert (caught.value.expected, caught.value.got) == (7, 3)
        assert box.since(mark) == [QUERY]  # asked again, what was known may be old
        box.active = 7
        assert (await camera.trigger(input=b"part")).application == 7


async def test_application_that_is_back_meanwhile_is_triggered() -> None:
    async with by_hand(application=7) as (box, camera):
        box.send(box.result_frame(b"?", 3))
        await until(lambda: camera.active_application == 3)
        assert (await camera.trigger()).application == 7


async def test_mapping_by_application_accepts_either() -> None:
    async with by_hand(interpret_as={7: "n: int32", 3: "text: string[5]"}) as (box, camera):
        box.script[TRIGGER] = answers(RUNNING, READY, result=words(5), application=7)(box)
        assert (await camera.trigger()).value.n == 5
        box.active = 3  # somebody else has switched
        box.script[TRIGGER] = answers(RUNNING, READY, result=b"three", application=3)(box)
        result = await camera.trigger()
        assert (result.application, result.value.text) == (3, "three")
        assert camera.active_application == 3


async def test_overheat_is_an_event_and_a_line_in_the_log_and_no_outcome(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.INFO, "smartcam.client"):
        async with by_hand() as (box, camera):
            events = camera.events()
            box.script[TRIGGER] = answers(RUNNING | OVERHEAT, READY | OVERHEAT, result=b"hot")(box)
            assert (await camera.trigger()).raw == b"hot"
            seen = [await anext(events) for _ in range(2)]
            box.report(READY)
            seen.append(await anext(events))
    hot_ones = [
        Status.OVERHEAT in event.status for event in seen if isinstance(event, StatusChanged)
    ]
    assert hot_ones == [True, True, False]
    lines = [(one.levelname, one.getMessage().partition(" ")[2]) for one in caplog.records]
    hot = [line for line in lines if "hot" in line[1]]
    assert hot == [
        ("WARNING", "! the camera is too hot: inspections may get worse"),
        ("INFO", "= the camera is no longer too hot"),
    ]


# ---------------------------------------------------------------------- more than one result


async def test_results_per_trigger_come_as_a_list() -> None:
    async with by_hand() as (box, camera):
        stream = camera.results()
        box.script[TRIGGER] = lambda _: (
            box.status_frame(RUNNING)
            + b"".join(box.result_frame(bytes([one])) for one in range(3))
            + box.status_frame(READY)
        )
        results = await camera.trigger(results_per_trigger=3)
        assert [one.raw for one in results] == [b"\0", b"\1", b"\2"]
        assert [one.number for one in results] == [1, 2, 3]
        assert len({one.triggered_at for one in results}) == 1
        assert None not in {one.latency for one in results}
        assert [await anext(stream) for _ in range(3)] == results
        statistics = camera.statistics()
        assert (statistics.triggered, statistics.extra_results) == (3, 0)
        assert statistics.processing.count == 1


async def test_results_per_trigger_of_one_is_a_list_too() -> None:
    async with by_hand() as (_, camera):
        assert [one.raw for one in await camera.trigger(results_per_trigger=1)] == [b"found"]


async def test_results_per_trigger_may_come_behind_waiting() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: (
            box.status_frame(RUNNING)
            + box.result_frame(b"1")
            + box.status_frame(READY)
            + box.result_frame(b"2")
        )
        assert [one.raw for one in await camera.trigger(results_per_trigger=2)] == [b"1", b"2"]


async def test_results_per_trigger_that_lack_one_say_how_many_came() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: box.status_frame(RUNNING) + 2 * box.result_frame()
        with pytest.raises(TriggerTimeoutError, match=r"2 of 3 results within 0\.0\d s"):
            await camera.trigger(results_per_trigger=3, timeout=SHORT)
        box.send(box.result_frame(b"third"))
        await until(lambda: camera.statistics().received == 3)
        statistics = camera.statistics()
        assert (statistics.triggered, statistics.late) == (2, 1)
        balance(statistics)


async def test_results_per_trigger_with_one_that_does_not_fit_raises() -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        script = box.script[TRIGGER]
        box.script[TRIGGER] = lambda _: (
            box.status_frame(RUNNING)
            + box.result_frame(words(1))
            + box.result_frame(b"?")
            + box.result_frame(words(3))
            + box.status_frame(READY)
        )
        with pytest.raises(InterpretationError):
            await camera.trigger(results_per_trigger=3)
        await until(lambda: camera.status == READY)
        statistics = camera.statistics()
        assert (statistics.triggered, statistics.uninterpretable, statistics.late) == (1, 1, 1)
        balance(statistics)
        box.script[TRIGGER], box.container = script, words(4)
        assert (await camera.trigger()).value.n == 4


@pytest.mark.parametrize("wanted", [0, -1])
async def test_results_per_trigger_are_at_least_one(wanted: int) -> None:
    async with by_hand() as (box, camera):
        with pytest.raises(ConfigurationError, match="results_per_trigger: "):
            await camera.trigger(results_per_trigger=wanted)
        assert TRIGGER not in box.ids


ORDERS = {
    "result, result, waiting": "rrw",
    "waiting, result, result": "wrr",
    "result, waiting, result": "rwr",
}


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS.keys())
async def test_second_result_of_a_trigger_is_extra_and_never_the_next_ones(
    order: str, *, apart: bool, caplog: pytest.LogCaptureFixture
) -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        turn = 0

        def at_trigger(_: bytes) -> bytes:
            nonlocal turn
            turn += 1
            made = iter((f"{turn}a", f"{turn}b"))
            frames = [box.status_frame(RUNNING)]
            for one in order:
                frame = box.result_frame(next(made).encode()) if one == "r" else None
                frames.append(frame or box.status_frame(READY))
            if apart:
                box.send(b"".join(frames[:-1]))
                asyncio.get_running_loop().call_soon(box.send, frames[-1])
                return b""
            return b"".join(frames)

        box.script[TRIGGER] = at_trigger
        own = [(await camera.trigger()).raw for _ in range(5)]
        assert own == [f"{one}a".encode() for one in range(1, 6)]
        await until(lambda: camera.statistics().received == 10)
        seen = [(await anext(results)).raw for _ in range(10)]
        assert seen == [f"{one}{which}".encode() for one in range(1, 6) for which in "ab"]
        statistics = camera.statistics()
        assert (statistics.triggered, statistics.streamed) == (5, 5)
        assert statistics.extra_results in ({5} if not apart else range(1, 6))
        balance(statistics)
    assert caplog.text.count("more than one result for a trigger") == 1


async def test_extra_results_of_the_emulator_are_counted() -> None:
    box = {"running": True, "active": 21}
    async with emulated(box=box) as (emulator, clock, camera):
        emulator.device.change_inspection(extra=2)
        triggering = asyncio.create_task(camera.trigger())
        await emulator.wait_received(m.Trigger)
        clock.advance(1)
        await triggering
        await camera.query_application()
        statistics = camera.statistics()
        assert (statistics.triggered, statistics.extra_results) == (1, 2)
        assert statistics.unclaimed == 2


# ---------------------------------------------------------------------- an older Overtriggered


async def test_trigger_waits_until_an_older_overtriggered_has_fallen() -> None:
    async with by_hand() as (box, camera):
        box.send(box.status_frame(READY | OVERTRIGGERED))
        await camera.wait_status(lambda status: Status.OVERTRIGGERED in status)
        triggering = asyncio.create_task(camera.trigger())
        await camera.query_application()
        assert TRIGGER not in box.ids
        box.send(box.status_frame(READY))
        assert (await triggering).raw == b"found"
