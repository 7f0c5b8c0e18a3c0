"""Work that a lost link leaves undone: application, run state, the way back, owed results."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

import pytest

from smartcam import (
    Camera,
    CommandRejectedError,
    ConnectionLostError,
    NotRunningError,
    Status,
    WrongApplicationError,
)
from tests.client.camera_by_hand import QUERY, READY, RUNNING, START, STOP, SWITCH, TRIGGER
from tests.client.clientkit import (
    FAST,
    OPENING,
    SHORT,
    SOON,
    TRIGGER_IDS,
    by_hand,
    gone,
    lose_and_come_back,
    quiet,
    steps,
)
from tests.handmade import until

# ---------------------------------------------------------------------- application, run state


async def test_application_switched_meanwhile_is_told_before_a_trigger_is_sent() -> None:
    async with by_hand(application=7, reconnect=FAST) as (box, camera):
        box.active = 3
        await lose_and_come_back(box, camera)
        with pytest.raises(WrongApplicationError) as caught:
            await camera.trigger()
        assert (caught.value.expected, caught.value.got) == (7, 3)
        assert TRIGGER not in box.ids
        assert box.active == 3  # and without restore it stays so


async def test_run_state_is_left_alone_without_restore() -> None:
    async with by_hand(application=7, reconnect=FAST) as (box, camera):
        box.status = 0
        mark = len(box.ids)
        await lose_and_come_back(box, camera)
        with pytest.raises(NotRunningError):
            await camera.trigger()
        assert box.since(mark) == OPENING


async def named_by_connect(_: Camera) -> None:
    pass


async def named_by_switch(camera: Camera) -> None:
    await camera.switch_application(3)


async def stopped(camera: Camera) -> None:
    await camera.stop()


async def stopped_and_started(camera: Camera) -> None:
    await camera.stop()
    await camera.start()


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize(
    ("name", "application", "running"),
    [
        (named_by_connect, 7, True),
        (named_by_switch, 3, True),
        (stopped, 7, False),
        (stopped_and_started, 7, True),
    ],
)
@pytest.mark.parametrize("found", [(1, READY), (1, 0), (7, READY), (7, 0), (3, 0)])
async def test_restore_has_back_what_was_wanted_before_the_next_command(
    name: Callable[[Camera], Coroutine[Any, Any, None]],
    application: int,
    running: bool,
    found: tuple[int, int],
) -> None:
    async with by_hand(application=7, restore=True, reconnect=FAST) as (box, camera):
        await name(camera)
        box.hang_up()
        box.active, box.status = found
        await until(lambda: camera.statistics().sessions == 2)
        if running:
            assert (await camera.trigger()).application == application
        else:
            with pytest.raises(NotRunningError):
                await camera.trigger()
        assert box.active == camera.active_application == application
        assert camera.status == Status(READY if running else 0)


async def test_restore_with_nothing_wanted_changes_nothing() -> None:
    async with by_hand(restore=True, reconnect=FAST) as (box, camera):
        box.active, box.status = 3, 0
        mark = len(box.ids)
        await lose_and_come_back(box, camera)
        assert set(box.since(mark)) <= set(OPENING)
        assert (box.active, camera.status) == (3, Status(0))


async def test_restore_has_nothing_to_do_in_the_first_session() -> None:
    async with by_hand(application=7, restore=True, reconnect=FAST) as (box, camera):
        await camera.trigger()
        assert box.ids == [*OPENING, QUERY, *TRIGGER_IDS]


async def test_wait_connected_waits_for_what_is_restored() -> None:
    async with by_hand(application=7, restore=True, reconnect=FAST) as (box, camera):
        box.active = 1
        switch, box.script[SWITCH] = box.script[SWITCH], quiet
        box.hang_up()
        payload = await box.wait_for(SWITCH)
        assert camera.connected
        waiting = asyncio.create_task(camera.wait_connected(SOON))
        await steps(20)
        assert not waiting.done()
        box.send(switch(payload))
        await waiting
        assert (box.active, camera.status) == (7, Status(READY))


async def test_restore_that_is_refused_is_told_by_the_next_command_once() -> None:
    async with by_hand(application=7, restore=True, reconnect=FAST) as (box, camera):
        box.active = 3
        box.applications.discard(7)
        await lose_and_come_back(box, camera)
        with pytest.raises(CommandRejectedError, match="refused to switch to application 7"):
            await camera.trigger()
        with pytest.raises(WrongApplicationError):
            await camera.trigger()  # it was named, and it is not there
        await camera.switch_application(3)
        assert (await camera.trigger()).application == 3


@pytest.mark.usefixtures("never_taken")
async def test_restore_that_a_second_loss_prevented_is_done_then() -> None:
    async with by_hand(application=7, restore=True, reconnect=FAST) as (box, camera):
        box.active = 3
        switch, box.script[SWITCH] = box.script[SWITCH], quiet
        box.hang_up()
        await box.wait_for(SWITCH)
        box.script[SWITCH] = switch
        await lose_and_come_back(box, camera)
        assert (await camera.trigger()).application == 7


async def test_restore_that_was_never_answered_is_done_in_the_next_session(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The session lasted as long as the switch was waited for: nobody else has the camera."""
    monkeypatch.setattr("smartcam._client.supervisor.TAKEN_WITHIN", SHORT)
    options: dict[str, Any] = {"restore": True, "reconnect": FAST, "switch_timeout": 2 * SHORT}
    async with by_hand(application=7, **options) as (box, camera):
        box.active = 3
        switch, box.script[SWITCH] = box.script[SWITCH], quiet
        box.hang_up()
        await box.wait_for(SWITCH)
        box.script[SWITCH] = switch
        await until(lambda: camera.statistics().sessions == 3)
        assert (await camera.trigger()).application == 7


# ---------------------------------------------------------------------- going back


@contextlib.asynccontextmanager
async def lost_inside(*applications: int, **options: Any) -> AsyncIterator[Any]:
    """Lose the link inside of applications, one in the other, and come back."""
    async with by_hand(reconnect=FAST, **options) as (box, camera):
        with contextlib.suppress(ConnectionLostError):
            async with contextlib.AsyncExitStack() as stack:
                for one in applications:
                    await stack.enter_async_context(camera.application(one))
                box.hang_up()
                await camera.wait_status(lambda _: False)
        yield box, camera


@pytest.mark.parametrize("inside", [(3,), (3, 1), (3, 1, 3)])
async def test_going_back_that_a_loss_prevented_is_done_in_the_next_session(
    inside: tuple[int, ...],
) -> None:
    async with lost_inside(*inside) as (box, camera):
        await camera.wait_connected(SOON)
        assert (box.active, camera.active_application) == (7, 7)
        assert (await camera.trigger()).application == 7


async def test_going_back_restores_the_run_state_of_before() -> None:
    async with lost_inside(3, box={"status": 0}) as (box, camera):
        await camera.wait_connected(SOON)
        assert (box.active, camera.status) == (7, Status(0))


async def test_command_waits_for_going_back_in_the_next_session() -> None:
    async with lost_inside(3) as (box, camera):
        await until(lambda: camera.connected)
        assert (await camera.trigger()).application == 7
        assert box.ids[-3:] == TRIGGER_IDS


async def test_trigger_in_another_application_that_is_lost_is_gone_back_from() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        trigger, box.script[TRIGGER] = box.script[TRIGGER], quiet
        triggering = asyncio.create_task(camera.trigger(3))
        await box.wait_for(TRIGGER)
        box.script[TRIGGER] = trigger
        box.hang_up()
        with pytest.raises(ConnectionLostError):
            await triggering
        await camera.wait_connected(SOON)
        assert (box.active, camera.status) == (7, Status(READY))
        assert box.ids.count(TRIGGER) == 1


async def test_way_back_that_a_loss_interrupted_is_gone_again() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        async with camera.application(3):
            switch, box.script[SWITCH] = box.script[SWITCH], quiet

            def lose(_: object) -> None:  # the next session may begin before the block has ended
                box.script[SWITCH] = switch
                box.hang_up()

            leaving = asyncio.create_task(box.wait_for(SWITCH, 2))
            leaving.add_done_callback(lose)
        await camera.wait_connected(SOON)
        assert (box.active, camera.status) == (7, Status(READY))
        assert await leaving == struct.pack("<I", 7)


async def test_way_back_that_was_never_answered_is_gone_in_the_next_session() -> None:
    async with by_hand(reconnect=FAST, switch_timeout=2 * SHORT) as (box, camera):
        async with camera.application(3):
            switch, box.script[SWITCH] = box.script[SWITCH], quiet
        box.script[SWITCH] = switch
        await until(lambda: camera.statistics().sessions == 2)
        assert (await camera.trigger()).application == 7
        assert box.active == 7


async def test_application_left_in_the_next_session_is_left_there() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        async with camera.application(3):
            await lose_and_come_back(box, camera)
            assert (await camera.trigger()).application == 3
        assert (await camera.trigger()).application == 7


async def test_going_back_that_is_refused_in_the_next_session_is_told_once() -> None:
    async with lost_inside(3) as (box, camera):
        box.applications.discard(7)
        await camera.wait_connected(SOON)
        with pytest.raises(CommandRejectedError, match="application 7"):
            await camera.trigger()
        assert (await camera.trigger()).application == 3


async def test_going_back_comes_before_what_restore_would_do() -> None:
    async with lost_inside(3, application=7, restore=True) as (box, camera):
        await camera.wait_connected(SOON)
        assert (box.active, camera.status) == (7, Status(READY))
        assert box.ids.count(SWITCH) == 2


async def test_loss_inside_an_application_restores_it_while_it_is_used() -> None:
    async with by_hand(application=7, restore=True, reconnect=FAST) as (box, camera):
        async with camera.application(3):
            box.hang_up()
            box.active, box.status = 7, 0  # it came up with another one
            await until(lambda: camera.statistics().sessions == 2)
            assert (await camera.trigger()).application == 3
        assert (await camera.trigger()).application == 7


# ---------------------------------------------------------------------- debts


@pytest.mark.parametrize("order", ["result first", "waiting first"])
async def test_result_of_the_lost_session_is_late_and_never_the_next_triggers(order: str) -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        results = camera.results()
        trigger = box.script[TRIGGER]
        box.script[TRIGGER] = lambda _: box.status_frame(RUNNING)
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        box.hang_up()
        assert isinstance(await gone(triggering), ConnectionLostError)
        await camera.wait_connected(SOON)  # the inspection goes on meanwhile
        assert camera.status == Status.RUNNING
        box.script[TRIGGER] = trigger
        following = asyncio.create_task(camera.trigger())
        await steps(20)
        old, ready = box.result_frame(b"old"), box.status_frame(READY)
        box.send(old + ready if order == "result first" else ready + old)
        assert (await following).raw == b"found"
        assert [(await anext(results)).raw for _ in range(2)] == [b"old", b"found"]
        statistics = camera.statistics()
        assert (statistics.late, statistics.triggered, statistics.streamed) == (1, 1, 0)
        assert STOP not in box.ids


async def test_result_of_the_lost_session_that_never_comes_is_made_impossible() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        trigger, box.script[TRIGGER] = box.script[TRIGGER], box.takes
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        box.script[TRIGGER] = trigger
        await lose_and_come_back(box, camera)
        await gone(triggering)
        mark = len(box.ids)
        assert (await camera.trigger()).raw == b"found"
        assert box.since(mark) == [STOP, QUERY, START, *TRIGGER_IDS]


async def test_result_of_the_lost_session_is_not_taken_by_next_result() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        box.script[TRIGGER] = lambda _: box.status_frame(RUNNING)
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        await lose_and_come_back(box, camera)
        await gone(triggering)
        following = camera.next_result()
        box.send(box.result_frame(b"old") + box.status_frame(READY))
        box.send(box.status_frame(RUNNING) + box.result_frame(b"new"))
        assert (await following).raw == b"new"


async def test_settling_that_a_loss_interrupted_leaves_no_stopped_camera() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        script = dict(box.script)
        box.script |= {TRIGGER: box.takes, START: quiet}
        await gone(camera.trigger(timeout=SHORT))
        fencing = asyncio.create_task(camera.trigger())
        await box.wait_for(START)
        box.script = script
        await lose_and_come_back(box, camera)
        assert isinstance(await gone(fencing), ConnectionLostError)
        assert camera.status == Status(0)  # our own Stop
        assert (await camera.trigger()).raw == b"found"
