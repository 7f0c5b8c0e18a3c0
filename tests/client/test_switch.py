"""Another application: for good, for a while, refused, interrupted."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable

import pytest

import smartcam
from smartcam import (
    Camera,
    CommandRejectedError,
    ConfigurationError,
    ConnectionClosedError,
    ConnectionLostError,
    InterpretationError,
    ResponseTimeoutError,
    Status,
    TriggerTimeoutError,
    WrongApplicationError,
)
from smartcam.emulator import EmulatedCamera, ManualClock
from smartcam.protocols import messages as m
from tests.client.camera_by_hand import (
    BUSY,
    DISCONNECT,
    QUERY,
    READY,
    RUNNING,
    START,
    STOP,
    SWITCH,
    TRIGGER,
    HandmadeCamera,
)
from tests.client.clientkit import SHORT, balance, by_hand, cancelled, emulated, gone, steps
from tests.handmade import until

QUICK = [
    {"id": 3, "layout": "n: uint8", "constant": {"n": 3}, "load_time": 0.0, "processing_time": 0.0},
    {"id": 21, "layout": "n: uint8", "constant": {"n": 1}, "load_time": 0.0},
]

# ---------------------------------------------------------------------- for good


async def test_switch_while_running_stops_first_and_starts_again() -> None:
    async with by_hand() as (box, camera):
        await camera.switch_application(3)
        assert box.since(3) == [STOP, SWITCH, START]
        assert (camera.active_application, camera.status) == (3, Status(READY))
        assert (await camera.trigger()).application == 3


async def test_switch_while_stopped_stays_stopped() -> None:
    async with by_hand(box={"status": 0}) as (box, camera):
        await camera.switch_application(3)
        assert box.since(3) == [SWITCH]
        assert (camera.active_application, camera.status) == (3, Status(0))


async def test_switch_with_the_emulator_takes_its_load_time() -> None:
    async with emulated(box={"running": True, "active": 1}) as (emulator, clock, camera):
        switching = asyncio.create_task(camera.switch_application(7))
        await until(lambda: Status.BUSY in camera.status)
        clock.advance(0.499)
        assert await camera.wait_status(lambda _: True) == Status.BUSY
        clock.advance(0.001)
        await switching
        assert emulator.device.active_application == 7
        assert emulator.device.running


async def test_switch_answer_among_statuses_and_an_old_result_loses_nothing() -> None:
    async with by_hand(application=7) as (box, camera):
        results, statuses = camera.results(), camera.statuses()
        box.script[STOP] = lambda _: b""
        box.script[SWITCH] = lambda _: (
            box.result_frame(b"old", 7) + box.status_frame(BUSY) + box.switched_frame(3)
        )
        switching = asyncio.create_task(camera.switch_application(3))
        await box.wait_for(STOP)
        box.send(box.status_frame(RUNNING) + box.status_frame(0))
        await box.wait_for(SWITCH)
        box.report(0)
        await switching
        old = await anext(results)
        assert (old.application, old.raw, old.triggered_at) == (7, b"old", None)
        seen = [await anext(statuses) for _ in range(5)]
        assert seen == [Status(one) for one in (RUNNING, 0, BUSY, 0, READY)]
        assert camera.statistics().streamed == 1


@pytest.mark.parametrize("quirk", ["after_status", "before_status"])
async def test_switch_answer_before_or_after_busy_falls_makes_no_difference(quirk: str) -> None:
    box = {"running": True, "active": 1, "quirks": {"switch_answer": quirk}}
    async with emulated(box=box) as (_, clock, camera):
        switching = asyncio.create_task(camera.switch_application(21))
        await until(lambda: Status.BUSY in camera.status)
        clock.advance(1)
        await switching
        assert camera.status == Status(READY)


async def test_switch_answered_while_busy_waits_until_it_falls() -> None:
    async with by_hand(box={"status": 0}) as (box, camera):
        box.script[SWITCH] = lambda _: box.status_frame(BUSY) + box.switched_frame(3)
        switching = asyncio.create_task(camera.switch_application(3))
        await until(lambda: camera.active_application == 3)
        await steps(3)
        assert not switching.done()
        box.report(0)
        await switching


async def test_switch_that_stays_busy_times_out() -> None:
    async with by_hand(box={"status": 0}) as (box, camera):
        box.script[SWITCH] = lambda _: box.status_frame(BUSY) + box.switched_frame(3)
        with pytest.raises(ResponseTimeoutError, match=r"waited .* for not BUSY; status: BUSY"):
            await camera.switch_application(3, timeout=SHORT)
        assert camera.connected


# ---------------------------------------------------------------------- refused


async def test_switch_to_an_unknown_id_raises_and_the_old_one_runs_again() -> None:
    async with by_hand() as (box, camera):
        with pytest.raises(
            CommandRejectedError,
            match=r"switch to application 99: code 0x01 \(id invalid\); application 7 is active",
        ) as caught:
            await camera.switch_application(99)
        error = caught.value
        assert (error.message_id, error.code, error.active_application) == (SWITCH, 1, 7)
        assert box.since(3) == [STOP, SWITCH, START]
        assert (await camera.trigger()).application == 7


async def test_switch_refused_while_stopped_stays_stopped() -> None:
    async with by_hand(box={"status": 0}) as (box, camera):
        with pytest.raises(CommandRejectedError):
            await camera.switch_application(99)
        assert box.since(3) == [SWITCH]
        assert camera.status == Status(0)


async def test_switch_to_id_0_raises_and_stops_nothing() -> None:
    async with by_hand() as (box, camera):
        with pytest.raises(CommandRejectedError, match="application 7 is active") as caught:
            await camera.switch_application(0)
        assert (caught.value.code, caught.value.active_application) == (1, 7)
        assert box.since(3) == [QUERY]


@pytest.mark.parametrize("application", [-1, 1 << 32])
async def test_switch_to_no_id_at_all_sends_nothing(application: int) -> None:
    async with by_hand() as (box, camera):
        with pytest.raises(ConfigurationError, match=f"application: .* got {application}"):
            await camera.switch_application(application)
        assert box.since(3) == []


async def test_switch_answer_that_names_another_application_raises() -> None:
    async with by_hand() as (box, camera):
        box.script[SWITCH] = lambda _: box.switched_frame(1)
        with pytest.raises(CommandRejectedError, match="application 1 is active") as caught:
            await camera.switch_application(3)
        assert (caught.value.code, caught.value.active_application) == (0, 1)
        assert camera.active_application == 1
        assert box.since(3) == [STOP, SWITCH, START]


async def test_switch_never_answered_gives_the_link_up() -> None:
    async with by_hand(box={"status": 0}, switch_timeout=SHORT) as (box, camera):
        box.script[SWITCH] = lambda _: b""
        with pytest.raises(
            ResponseTimeoutError, match=r"no answer to SwitchApplication \(0x31\)"
        ) as caught:
            await camera.switch_application(3)
        assert caught.value.message_id == SWITCH
        await box.wait_for(DISCONNECT, 2)
        await until(lambda: not camera.connected)
        with pytest.raises(ConnectionLostError) as later:
            await camera.trigger()
        assert later.value.__cause__ is caught.value


async def test_switch_that_is_awaited_for_too_short_a_time_keeps_the_link() -> None:
    async with by_hand(box={"status": 0}, request_timeout=SHORT) as (box, camera):
        catch_up = _silence(box, SWITCH)
        with pytest.raises(ResponseTimeoutError, match="no answer to SwitchApplication"):
            await camera.switch_application(3, timeout=SHORT)
        switching = asyncio.create_task(camera.switch_application(1))
        await asyncio.sleep(2 * SHORT)
        assert box.ids.count(SWITCH) == 1  # the second waits for the answer to the first
        catch_up()
        await switching
        assert (box.active, camera.statistics().sessions) == (1, 1)


# ---------------------------------------------------------------------- interrupted


def _silence(box: HandmadeCamera, message_id: int) -> Callable[[], None]:
    """Let a message be unanswered; what is returned sends the answer that is owed."""
    answer = box.script[message_id]
    box.script[message_id] = lambda _: b""

    def catch_up() -> None:
        box.script[message_id] = answer
        box.send(answer(dict(box.received)[message_id]))

    return catch_up


@pytest.mark.parametrize("phase", [STOP, SWITCH, START])
async def test_switch_cancelled_in_any_phase_leaves_a_camera_that_works(phase: int) -> None:
    async with by_hand() as (box, camera):
        catch_up = _silence(box, phase)
        switching = asyncio.create_task(camera.switch_application(3))
        await box.wait_for(phase)
        await cancelled(switching)
        back = asyncio.create_task(camera.trigger(application=1))
        await steps(20)
        catch_up()
        assert (await back).application == 1


@pytest.mark.parametrize("phase", [STOP, SWITCH, START])
async def test_switch_cancelled_and_repeated_ends_where_it_should(phase: int) -> None:
    async with by_hand() as (box, camera):
        catch_up = _silence(box, phase)
        switching = asyncio.create_task(camera.switch_application(3))
        await box.wait_for(phase)
        await cancelled(switching)
        catch_up()
        await camera.switch_application(1)
        assert (camera.active_application, box.active) == (1, 1)


async def test_switch_cancelled_owes_an_answer_that_is_awaited_first() -> None:
    async with by_hand(box={"status": 0}) as (box, camera):
        catch_up = _silence(box, SWITCH)
        switching = asyncio.create_task(camera.switch_application(3))
        await box.wait_for(SWITCH)
        await cancelled(switching)
        asking = asyncio.create_task(camera.query_application())
        again = asyncio.create_task(camera.switch_application(1))
        await steps(20)
        assert box.since(3) == [SWITCH]
        catch_up()
        assert await asking in {1, 3}
        await again
        assert camera.active_application == 1


async def test_query_too_short_for_a_switch_under_way_leaves_the_link() -> None:
    async with by_hand(box={"status": 0}) as (box, camera):
        catch_up = _silence(box, SWITCH)
        switching = asyncio.create_task(camera.switch_application(3))
        await box.wait_for(SWITCH)
        with pytest.raises(
            ResponseTimeoutError, match=r"could not send Query \(0x30\) in time: an earlier answer"
        ):
            await camera.query_application(timeout=SHORT)
        assert camera.connected
        catch_up()
        await switching


async def test_owed_answer_beyond_its_own_time_gives_the_link_up() -> None:
    async with by_hand(box={"status": 0}, switch_timeout=SHORT) as (box, camera):
        box.script[SWITCH] = lambda _: b""
        switching = asyncio.create_task(camera.switch_application(3))
        await box.wait_for(SWITCH)
        await cancelled(switching)
        with pytest.raises(ResponseTimeoutError, match="an earlier answer is owed"):
            await camera.query_application(timeout=2 * SHORT)
        await box.wait_for(DISCONNECT, 2)


async def test_switch_in_line_for_too_long_says_so() -> None:
    async with by_hand(box={"status": 0}) as (box, camera):
        catch_up = _silence(box, SWITCH)
        switching = asyncio.create_task(camera.switch_application(3))
        await box.wait_for(SWITCH)
        with pytest.raises(ResponseTimeoutError, match=r"another command had the camera") as caught:
            await camera.switch_application(1, timeout=SHORT)
        assert caught.value.waited == SHORT
        catch_up()
        await switching


@pytest.mark.parametrize(("command", "expected"), [(START, READY), (STOP, 0)])
async def test_start_or_stop_cancelled_is_known_by_the_next_command(
    command: int, expected: int
) -> None:
    async with by_hand(box={"status": READY - expected}) as (box, camera):
        answer, box.script[command] = box.script[command], lambda _: b""
        calling = asyncio.create_task(camera.start() if command == START else camera.stop())
        await box.wait_for(command)
        await cancelled(calling)
        box.script[command] = answer
        box.script[QUERY] = lambda _: box.status_frame(expected) + box.said(QUERY, 7)
        await camera.switch_application(3)  # the camera refuses it where it is not stopped
        assert camera.status == Status(expected)


async def test_start_times_out_with_the_status() -> None:
    async with by_hand(box={"status": 0}) as (box, camera):
        box.script[START] = lambda _: box.status_frame(BUSY)
        with pytest.raises(ResponseTimeoutError, match=r"Running and not BUSY.*status: BUSY"):
            await camera.start(timeout=SHORT)
        box.report(READY)
        await camera.start()


async def test_start_and_stop_return_when_the_camera_reports_it() -> None:
    async with emulated() as (emulator, _, camera):
        await camera.start()
        assert emulator.device.running
        assert Status.RUNNING in camera.status
        await camera.stop()
        assert not emulator.device.running
        assert camera.status == Status(0)


# ---------------------------------------------------------------------- for a while


@pytest.mark.parametrize("status", [READY, 0])
async def test_application_goes_back_with_the_run_state(status: int) -> None:
    async with by_hand(box={"status": status}) as (box, camera):
        async with camera.application(3) as same:
            assert same is camera
            assert (await camera.trigger()).application == 3
        assert (camera.active_application, box.active) == (7, 7)
        assert camera.status == Status(status)


@pytest.mark.parametrize("status", [READY, 0])
async def test_application_that_is_active_already_only_restores_the_run_state(status: int) -> None:
    async with by_hand(box={"status": status}) as (box, camera):
        async with camera.application(7):
            assert camera.status == Status(READY)
        assert camera.status == Status(status)
        assert SWITCH not in box.ids


async def test_application_stopped_inside_runs_again_behind_it() -> None:
    async with by_hand() as (_, camera):
        async with camera.application(7):
            await camera.stop()
        assert camera.status == Status(READY)


async def test_application_goes_back_after_an_error() -> None:
    async with by_hand() as (box, camera):
        with pytest.raises(ZeroDivisionError):
            async with camera.application(3):
                raise ZeroDivisionError
        assert (await camera.trigger()).application == 7  # it waits for going back
        assert box.active == 7


async def test_application_goes_back_after_a_cancellation() -> None:
    async with by_hand() as (_, camera):
        inside = asyncio.Event()

        async def work() -> None:
            async with camera.application(3):
                inside.set()
                await asyncio.Event().wait()

        task = asyncio.create_task(work())
        await inside.wait()
        await cancelled(task)
        assert (await camera.trigger()).application == 7


async def test_application_cancelled_while_going_back_goes_back() -> None:
    async with by_hand() as (box, camera):

        async def work() -> None:
            async with camera.application(3):
                catch_up.append(_silence(box, STOP))

        catch_up: list[Callable[[], None]] = []
        task = asyncio.create_task(work())
        await box.wait_for(STOP, 2)
        await cancelled(task)
        catch_up[0]()
        assert (await camera.trigger()).application == 7


async def test_application_the_camera_does_not_have_raises_and_leaves_the_old_one() -> None:
    async with by_hand() as (_, camera):
        with pytest.raises(CommandRejectedError, match="application 99"):
            async with camera.application(99):
                pytest.fail("there is no such application")
        assert (await camera.trigger()).application == 7


async def test_application_inside_another_goes_back_step_by_step() -> None:
    async with by_hand() as (_, camera):
        async with camera.application(3):
            async with camera.application(1):
                assert (await camera.trigger()).application == 1
            assert (await camera.trigger()).application == 3
        assert (await camera.trigger()).application == 7


async def test_application_closed_inside_goes_nowhere() -> None:
    async with by_hand() as (box, camera):
        async with camera.application(3):
            await camera.close()
        await box.wait_for(DISCONNECT, 2)
        assert box.active == 3


async def test_application_whose_way_back_is_shut_raises_why(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with by_hand() as (box, camera):
        with pytest.raises(CommandRejectedError, match="refused to switch to application 7"):
            async with camera.application(3):
                box.applications.discard(7)
        assert (await camera.trigger()).application == 3
    assert "going back failed" in caplog.text
    assert [record.levelno for record in caplog.records] == [logging.WARNING]


async def test_way_back_shut_after_an_error_is_told_by_the_next_command() -> None:
    async with by_hand() as (box, camera):
        with contextlib.suppress(ZeroDivisionError):
            async with camera.application(3):
                box.applications.discard(7)
                raise ZeroDivisionError
        with pytest.raises(CommandRejectedError, match="application 7"):
            await camera.trigger()
        assert (await camera.trigger()).application == 3


async def test_link_lost_while_going_back_is_told(caplog: pytest.LogCaptureFixture) -> None:
    async with by_hand(box={"status": 0}) as (box, camera):
        box.script[STOP] = lambda _: b""
        triggering = asyncio.create_task(camera.trigger(3))
        await box.wait_for(STOP)
        box.hang_up()
        assert (await triggering).application == 3
        with pytest.raises(ConnectionLostError):
            await camera.trigger()
    assert "going back failed" in caplog.text


@pytest.mark.parametrize("status", [READY, 0])
async def test_trigger_in_an_application_goes_back_with_the_run_state(status: int) -> None:
    async with by_hand(box={"status": status}) as (box, camera):
        result = await camera.trigger(3)
        assert (result.application, result.raw) == (3, b"found")
        assert (box.active, camera.status) == (7, Status(status))
        assert camera.active_application == 7


async def test_trigger_in_an_application_goes_back_after_a_timeout() -> None:
    async with by_hand() as (box, camera):
        trigger, box.script[TRIGGER] = box.script[TRIGGER], lambda _: b""
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(3, timeout=SHORT)
        box.script[TRIGGER] = trigger
        assert (await camera.trigger()).application == 7


async def test_trigger_in_an_application_cancelled_goes_back() -> None:
    async with by_hand() as (box, camera):
        trigger, box.script[TRIGGER] = box.script[TRIGGER], lambda _: b""
        triggering = asyncio.create_task(camera.trigger(3))
        await box.wait_for(TRIGGER)
        await cancelled(triggering)
        box.script[TRIGGER] = trigger
        assert (await camera.trigger()).application == 7
        assert camera.statistics().triggered == 1


async def test_trigger_in_an_application_the_camera_does_not_have_raises() -> None:
    async with by_hand() as (_, camera):
        with pytest.raises(CommandRejectedError, match="application 99"):
            await camera.trigger(99)
        assert (await camera.trigger()).application == 7


async def test_trigger_in_an_application_too_slow_to_load_is_a_trigger_timeout() -> None:
    async with by_hand(switch_timeout=SHORT) as (box, camera):
        box.script[SWITCH] = lambda _: b""
        with pytest.raises(TriggerTimeoutError, match=r"no answer to Switch.*no trigger was sent"):
            await camera.trigger(3)


async def test_triggers_in_different_applications_at_once_get_their_own() -> None:
    async with by_hand() as (_, camera):
        wanted = [3, None, 1, None, 7, 3]
        results = await asyncio.gather(*(camera.trigger(one) for one in wanted))
        assert [result.application for result in results] == [one or 7 for one in wanted]
        assert camera.active_application == 7
        balance(camera.statistics())


# ---------------------------------------------------------------------- expected


async def test_result_of_another_application_than_named_is_counted_and_not_interpreted() -> None:
    layout = {7: "text: string[5]"}
    async with by_hand(application=7, interpret_as=layout) as (box, camera):
        results = camera.results()
        box.send(box.result_frame(b"?", 3) + box.result_frame(b"seven", 7))
        assert (await anext(results)).value.text == "seven"
        statistics = camera.statistics()
        assert (statistics.received, statistics.wrong_application, statistics.streamed) == (2, 1, 1)
        assert statistics.uninterpretable == 0
        assert camera.active_application == 7


async def test_trigger_that_gets_another_applications_result_raises_both_ids() -> None:
    async with by_hand(application=7) as (box, camera):
        box.script[TRIGGER] = lambda _: box.result_frame(b"?", 3)
        with pytest.raises(
            WrongApplicationError, match="a result of application 3 came, application 7 was exp"
        ) as caught:
            await camera.trigger()
        assert (caught.value.expected, caught.value.got) == (7, 3)
        assert isinstance(caught.value, InterpretationError)


async def test_trigger_after_another_applications_result_never_gets_the_late_one() -> None:
    async with by_hand(application=7) as (box, camera):
        trigger = box.script[TRIGGER]
        box.script[TRIGGER] = lambda _: box.takes() + box.result_frame(b"?", 3)
        await gone(camera.trigger())
        box.script[TRIGGER] = trigger
        box.script[STOP] = lambda _: box.result_frame(b"late") + box.status_frame(0)
        assert (await camera.trigger()).raw == b"found"
        statistics = camera.statistics()
        assert (statistics.wrong_application, statistics.late, statistics.triggered) == (1, 1, 1)


async def test_result_names_the_active_application_where_none_was_named() -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        box.send(box.result_frame(b"?", 3))
        await anext(results)
        assert camera.active_application == 3


async def test_application_left_expects_what_was_expected_before() -> None:
    async with by_hand() as (box, camera):
        async with camera.application(3):
            pass
        results = camera.results()
        box.send(box.result_frame(b"free", 1))
        assert (await anext(results)).raw == b"free"  # none was named, so any is welcome


async def test_switch_names_the_application_that_results_are_expected_from() -> None:
    async with by_hand() as (box, camera):
        await camera.switch_application(3)
        results = camera.results()
        box.send(box.result_frame(b"?", 7) + box.result_frame(b"three", 3))
        assert (await anext(results)).raw == b"three"
        assert camera.statistics().wrong_application == 1


async def test_commands_at_once_take_turns() -> None:
    async with by_hand() as (box, camera):
        mark = len(box.ids)
        await asyncio.gather(*(camera.switch_application(one) for one in (3, 1, 7)))
        assert box.since(mark) == [STOP, SWITCH, START] * 3
        assert camera.active_application == 7


async def test_application_used_by_two_tasks_does_not_mix_them_up() -> None:
    async with by_hand() as (_, camera):

        async def shot() -> int:
            async with camera.application(7):
                return (await camera.trigger()).application

        assert await asyncio.gather(*(shot() for _ in range(5))) == [7] * 5


# ---------------------------------------------------------------------- closing on the way back


async def left_by_error(camera: Camera) -> None:
    async with camera.application(21):
        raise ValueError("the user's own")


async def left_by_timeout(camera: Camera) -> None:
    await camera.trigger(21, timeout=0.0)


async def left_by_interpretation(camera: Camera) -> None:
    await camera.trigger(21, interpret_as="n: int32")


@pytest.mark.parametrize("leave", [left_by_error, left_by_timeout, left_by_interpretation])
async def test_close_waits_for_the_way_back(
    leave: Callable[[Camera], Awaitable[None]],
) -> None:
    async with EmulatedCamera(applications=QUICK) as emulator:
        with pytest.raises((ValueError, TriggerTimeoutError)):
            async with smartcam.connect(emulator.url, application=3) as camera:
                await leave(camera)
        assert emulator.device.active_application == 3
        assert emulator.device.running


async def test_close_cancelled_on_the_way_back_drops_the_link() -> None:
    async with EmulatedCamera(applications=QUICK, clock=ManualClock()) as emulator:
        camera = await smartcam.connect(emulator.url)
        visit = asyncio.create_task(camera.trigger(21))
        await emulator.wait_received(m.SwitchApplication)
        await cancelled(visit)
        closing = asyncio.create_task(camera.close())
        await steps(3)
        assert not closing.done()
        await cancelled(closing)
        assert not camera.connected


async def test_close_does_not_wait_for_a_way_back_behind_somebodys_long_trigger() -> None:
    slow = [QUICK[0], {**QUICK[1], "processing_time": 60.0}]
    async with EmulatedCamera(applications=slow) as emulator:
        camera = await smartcam.connect(emulator.url, application=3, switch_timeout=0.3)
        with contextlib.suppress(ZeroDivisionError):
            async with camera.application(21):
                long = asyncio.create_task(camera.trigger(timeout=60))
                await emulator.wait_received(m.Trigger)
                raise ZeroDivisionError
        async with asyncio.timeout(5):
            await camera.close()
        assert isinstance(await gone(long), ConnectionClosedError)
