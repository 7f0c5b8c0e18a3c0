"""Every way a trigger can end, and what its result holds."""

from __future__ import annotations

import asyncio
import itertools
import logging
import struct
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

import smartcam
from smartcam import (
    CameraBusyError,
    CameraFaultError,
    CommandRejectedError,
    ConfigurationError,
    InputContainerError,
    InterpretationError,
    Layout,
    LayoutError,
    NotRunningError,
    OvertriggeredError,
    PluginError,
    Status,
    TriggerError,
    TriggerTimeoutError,
    WrongApplicationError,
)
from smartcam.protocols import messages as m
from tests.client.camera_by_hand import (
    BUSY,
    GET_CLOCK,
    INPUT,
    INPUT_CONTAINER,
    NUMBER,
    OVERTRIGGERED,
    QUERY,
    READY,
    RUNNING,
    START,
    STOP,
    SYSTEM_ERROR,
    TRIGGER,
    WAITING,
    HandmadeCamera,
)
from tests.client.clientkit import (
    SHORT,
    TRIGGER_IDS,
    balance,
    by_hand,
    cancelled,
    cancelled_at_its_query,
    emulated,
    gone,
    only,
    quiet,
    steps,
)
from tests.client.inside import Chunk, TriggerRequest
from tests.handmade import until
from tests.insides import inside
from tests.timed_loop import spend

BEGUN = m.StatusReport(status=Status.RUNNING, endian=0)
ECHO = {
    "id": 5,
    "layout": "part: int32",
    "input": "part: int32",
    "generator": "input",
    "load_time": 0.0,
    "processing_time": 0.05,
}
"""An application of the emulator that sends back its input data."""


# ---------------------------------------------------------------------- a result


@pytest.mark.parametrize("dialect", ["handbook", "thesis"])
async def test_trigger_returns_its_result_with_metadata(dialect: str) -> None:
    async with by_hand(box={"dialect": dialect}, name="press 4") as (_, camera):
        before = datetime.now(UTC)
        result = await camera.trigger()
        after = datetime.now(UTC)
    assert (result.camera, result.application, result.number) == ("press 4", 7, 1)
    assert (result.raw, result.value, result.sequence) == (b"found", b"found", None)
    assert result.triggered_at is not None
    assert before <= result.triggered_at <= result.received_at <= after
    assert result.latency is not None
    assert 0 <= result.latency < 1


async def test_trigger_again_and_again_counts() -> None:
    async with by_hand() as (_, camera):
        numbers = [(await camera.trigger()).number for _ in range(3)]
        assert numbers == [1, 2, 3]
        statistics = camera.statistics()
        assert (statistics.received, statistics.triggered) == (3, 3)


async def test_trigger_result_goes_to_the_streams_too() -> None:
    async with by_hand() as (_, camera):
        results, following = camera.results(), camera.next_result()
        result = await camera.trigger()
        assert await anext(results) is result
        assert await following is result


async def test_trigger_with_the_emulators_clock_takes_its_processing_time() -> None:
    box = {"running": True, "active": 7}
    async with emulated(box=box, interpret_as="localizations") as (emulator, clock, camera):
        triggering = asyncio.create_task(camera.trigger())
        await emulator.wait_received(m.Trigger)
        clock.advance(0.079)
        await steps(10)
        assert not triggering.done()
        clock.advance(0.001)
        result = await triggering
        assert [part.feature_id for part in result.value][:2] == [
            "big_triangle_1",
            "big_triangle_2",
        ]
        header = result.value[0].pose.header
        assert (header.seq, header.stamp, header.frame_id) == (1, result.received_at, camera.name)


async def test_result_before_or_after_waiting_rises_makes_no_difference() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: (
            box.status_frame(RUNNING) + box.status_frame(READY) + box.result_frame()
        )
        assert [(await camera.trigger()).raw for _ in range(3)] == [b"found"] * 3


async def test_result_in_pieces_is_put_together() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = box.takes
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        for byte in box.result_frame(b"slow"):
            box.send(bytes([byte]))
            await steps(2)
        assert (await triggering).raw == b"slow"


# ---------------------------------------------------------------------- no result


async def test_trigger_of_a_stopped_application_raises_at_once() -> None:
    async with by_hand(box={"status": 0}) as (box, camera):
        with pytest.raises(
            NotRunningError, match=r"application 7 is stopped: start it.*status: no bit set"
        ):
            await camera.trigger(timeout=60)
        assert TRIGGER not in box.ids


async def test_trigger_of_a_busy_camera_waits_until_it_is_ready() -> None:
    async with by_hand(box={"status": BUSY}) as (box, camera):
        triggering = asyncio.create_task(camera.trigger())
        await steps(5)
        box.report(RUNNING | BUSY, RUNNING)
        await steps(20)
        assert TRIGGER not in box.ids
        box.report(READY)
        assert (await triggering).raw == b"found"


async def test_trigger_of_a_busy_camera_that_comes_out_stopped_raises() -> None:
    async with by_hand(box={"status": BUSY}) as (box, camera):
        triggering = asyncio.create_task(camera.trigger())
        await steps(5)
        box.report(0)
        with pytest.raises(NotRunningError):
            await triggering


async def test_trigger_looks_again_where_readiness_was_short() -> None:
    async with by_hand(box={"status": RUNNING}) as (box, camera):
        triggering = asyncio.create_task(camera.trigger())
        await steps(5)
        box.report(READY, RUNNING)  # both before the caller is woken
        await until(lambda: camera.status == Status.RUNNING)
        await steps(20)
        assert TRIGGER not in box.ids
        box.report(READY)
        await triggering


@pytest.mark.parametrize("status", [BUSY, RUNNING, RUNNING | BUSY | WAITING])
async def test_trigger_that_refuses_to_wait_says_what_the_camera_does(status: int) -> None:
    async with by_hand(box={"status": status}) as (box, camera):
        with pytest.raises(CameraBusyError, match="does not wait for a trigger: ") as caught:
            await camera.trigger(when_busy="refuse")
        assert str(Status(status)) in str(caught.value)
        assert TRIGGER not in box.ids


async def test_trigger_of_a_camera_busy_for_ever_times_out() -> None:
    async with by_hand(box={"status": BUSY}) as (_, camera):
        with pytest.raises(TriggerTimeoutError, match=r"within 0\.05 s; status: BUSY$") as caught:
            await camera.trigger(timeout=SHORT)
        assert caught.value.waited == pytest.approx(SHORT, abs=0.02)
        assert isinstance(caught.value, (TriggerError, TimeoutError))


async def test_trigger_of_a_free_running_application_says_so() -> None:
    async with by_hand(box={"status": RUNNING}) as (box, camera):
        with pytest.raises(TriggerTimeoutError, match="or while an application runs free"):
            await camera.trigger(timeout=SHORT)
        assert TRIGGER not in box.ids


async def test_trigger_of_the_emulators_free_running_application_says_so() -> None:
    async with emulated(box={"running": True, "active": 9}) as (_, clock, camera):
        triggering = asyncio.create_task(camera.trigger(timeout=SHORT))
        await steps(3)
        clock.advance(1)
        with pytest.raises(TriggerTimeoutError, match="runs free"):
            await triggering
        assert camera.statistics().unclaimed == 20


async def test_trigger_without_a_result_times_out() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: box.status_frame(RUNNING)
        with pytest.raises(TriggerTimeoutError, match="of the trigger; status: RUNNING") as caught:
            await camera.trigger(timeout=SHORT)
        assert 0 < caught.value.waited <= SHORT


async def test_trigger_with_no_time_at_all_times_out() -> None:
    async with by_hand() as (_, camera):
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=0)


async def test_trigger_in_line_for_too_long_says_that_none_was_sent() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = box.takes
        first = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        with pytest.raises(
            TriggerTimeoutError, match=r"another command had the camera for 0\.05 s; no trigger"
        ) as caught:
            await camera.trigger(timeout=SHORT)
        assert caught.value.waited == SHORT
        box.send(box.result_frame())
        await first


@pytest.mark.parametrize(("takes", "needed"), [(0.01, "0.05"), (2.0, "2")])
async def test_trigger_whose_turn_comes_too_late_is_not_sent(takes: float, needed: str) -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = box.takes
        quick = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        await asyncio.sleep(takes)
        box.send(box.result_frame() + box.status_frame(READY))
        await quick
        first = asyncio.create_task(camera.trigger(timeout=10))
        await box.wait_for(TRIGGER, 2)
        second = asyncio.create_task(camera.trigger(timeout=5))
        await asyncio.sleep(4.96 if takes < 1 else 4.0)
        box.send(box.result_frame() + box.status_frame(READY))
        await first
        text = rf"and its result needs at least {needed} s; no trigger was sent"
        with pytest.raises(TriggerTimeoutError, match=text):
            await second
        assert box.ids.count(TRIGGER) == 2
        third = asyncio.create_task(camera.trigger(timeout=5))
        await box.wait_for(TRIGGER, 3)
        box.send(box.result_frame())
        await third
        assert camera.statistics().late == 0


async def test_trigger_overtriggered_raises_and_the_result_is_streamed() -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        box.script[TRIGGER] = lambda _: box.status_frame(RUNNING | OVERTRIGGERED)
        with pytest.raises(OvertriggeredError, match="it is unknown whether"):
            await camera.trigger()
        box.send(box.result_frame(b"whose"))
        result = await anext(results)
        assert (result.raw, result.triggered_at, result.latency) == (b"whose", None, None)
        statistics = camera.statistics()
        assert (statistics.streamed, statistics.overtriggers) == (1, 1)


async def test_trigger_overtriggered_in_the_same_segment_as_the_result() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: (
            box.status_frame(RUNNING | OVERTRIGGERED) + box.result_frame() + box.status_frame(READY)
        )
        results = camera.results()
        with pytest.raises(OvertriggeredError):
            await camera.trigger()
        await anext(results)
        assert box.ids.count(STOP) == 0
        assert camera.statistics().streamed == 1


async def test_overtriggered_bit_that_was_set_before_is_not_ours() -> None:
    async with by_hand(box={"status": READY | OVERTRIGGERED}) as (box, camera):
        triggering = asyncio.create_task(camera.trigger())
        await steps(20)
        assert TRIGGER not in box.ids  # as long as it is set it could not rise for ours
        box.report(READY)
        assert (await triggering).raw == b"found"
        assert camera.statistics().overtriggers == 1  # at Connect


@pytest.mark.parametrize(("timeout", "grace"), [(10.0, "1 s"), (1.0, "0.5 s")])
async def test_overtriggered_that_stays_set_is_never_sent_into(timeout: float, grace: str) -> None:
    async with by_hand(box={"status": READY | OVERTRIGGERED}) as (box, camera):
        loop = asyncio.get_running_loop()
        begin = loop.time()
        with pytest.raises(
            OvertriggeredError, match=f"Overtriggered has stayed set for {grace}.*none was sent"
        ):
            await camera.trigger(timeout=timeout)
        assert loop.time() - begin < timeout
        assert TRIGGER not in box.ids
        box.report(READY)
        assert (await camera.trigger()).raw == b"found"


async def test_overtriggered_that_rises_while_the_trigger_waits_is_waited_for_as_well() -> None:
    async with by_hand(box={"status": RUNNING}) as (box, camera):
        triggering = asyncio.create_task(camera.trigger())
        await steps(5)
        box.report(RUNNING | OVERTRIGGERED, READY | OVERTRIGGERED)
        await steps(20)
        assert TRIGGER not in box.ids
        box.report(RUNNING | OVERTRIGGERED, RUNNING, READY)
        assert (await triggering).raw == b"found"


# ---------------------------------------------------------------------- what shows that it is ours


@pytest.mark.parametrize("layout", [None, "n: int32 @sequence", "n: uint8 @sequence"])
@pytest.mark.parametrize("dialect", ["handbook", "thesis", "b16"])
async def test_result_without_a_shown_inspection_is_not_the_triggers(
    dialect: str, layout: str | None
) -> None:
    async with by_hand(box={"dialect": dialect}, interpret_as=layout) as (box, camera):
        box.script[TRIGGER] = lambda _: box.result_frame(as_set(box, layout))
        results = camera.results()
        with pytest.raises(
            TriggerTimeoutError,
            match="the camera has not shown that it took the trigger; 1 result came before",
        ):
            await camera.trigger(timeout=SHORT)
        assert (await anext(results)).triggered_at is None
        box.script[TRIGGER] = lambda _: box.inspects(as_set(box, layout))
        await camera.trigger()
        statistics = camera.statistics()
        assert (statistics.triggered, statistics.streamed, statistics.late) == (1, 1, 0)


async def test_result_is_returned_only_when_the_question_behind_the_trigger_is_answered() -> None:
    async with by_hand() as (box, camera):
        query = box.script[QUERY]
        box.script[QUERY] = only(1, query)
        results = camera.results()
        triggering = asyncio.create_task(camera.trigger())
        streamed = asyncio.ensure_future(anext(results))
        await box.wait_for(TRIGGER)
        await steps(50)
        assert not triggering.done()
        assert not streamed.done()
        box.send(query(b""))
        assert (await triggering).raw == (await streamed).raw == b"found"


async def test_result_of_a_trigger_that_is_in_doubt_is_nobodys_in_a_stream() -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        box.script[TRIGGER] = lambda _: (
            box.status_frame(RUNNING)
            + box.result_frame(b"whose")
            + box.status_frame(READY)
            + box.status_frame(RUNNING)
            + box.status_frame(READY)
        )
        with pytest.raises(
            OvertriggeredError, match="it is unknown to which trigger the result belongs"
        ):
            await camera.trigger()
        result = await anext(results)
        assert (result.raw, result.triggered_at, result.latency) == (b"whose", None, None)
        statistics = camera.statistics()
        assert (statistics.triggered, statistics.streamed) == (0, 1)
        balance(statistics)


async def test_trigger_whose_second_question_is_never_answered_says_so() -> None:
    async with by_hand() as (box, camera):
        box.script[QUERY] = only(1, box.script[QUERY])
        with pytest.raises(
            TriggerTimeoutError, match="has not answered the question that was sent with"
        ):
            await camera.trigger(timeout=SHORT)


async def test_inspection_that_shows_behind_the_second_answer_is_the_triggers() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = quiet
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(QUERY, 3)
        await steps(20)  # the answers are heard
        box.send(box.inspects(b"own"))
        assert (await triggering).raw == b"own"
        assert camera.statistics().inspections_by_others == 0


@pytest.mark.parametrize("layout", [None, "n: int32 @sequence"])
@pytest.mark.parametrize("dialect", ["handbook", "thesis", "b16"])
async def test_two_inspections_between_the_answers_end_the_call(
    dialect: str, layout: str | None
) -> None:
    """A sensor's began and was over between the Query and the Trigger."""
    async with by_hand(box={"dialect": dialect}, interpret_as=layout) as (box, camera):
        box.script[TRIGGER] = lambda _: 2 * box.inspects(as_set(box, layout))
        with pytest.raises(
            OvertriggeredError, match="it is unknown to which trigger the result belongs"
        ):
            await camera.trigger()
        box.script[TRIGGER] = lambda _: box.inspects(as_set(box, layout))
        await camera.trigger()
        balance(camera.statistics())


def as_set(box: HandmadeCamera, layout: str | None) -> bytes:
    """Return a container that has the number that was set last, where the layout has one."""
    if layout is None:
        return box.container
    numbers = [payload for one, payload in box.received if one == NUMBER]
    return numbers[-1][: Layout(layout).size]


async def test_trigger_by_a_sensor_meanwhile_overtriggers_the_emulator() -> None:
    async with emulated(box={"running": True, "active": 21}) as (emulator, clock, camera):
        triggering = asyncio.create_task(camera.trigger())
        await emulator.wait_received(m.Trigger)
        assert not emulator.device.trigger()
        with pytest.raises(OvertriggeredError):
            await triggering
        clock.advance(1)
        assert camera.connected


async def test_trigger_of_a_faulty_camera_raises_at_once() -> None:
    async with by_hand(box={"status": READY | SYSTEM_ERROR}) as (box, camera):
        with pytest.raises(CameraFaultError, match="the camera reports System Error"):
            await camera.trigger()
        assert TRIGGER not in box.ids


async def test_trigger_during_which_the_camera_fails_raises() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: box.status_frame(RUNNING | SYSTEM_ERROR)
        with pytest.raises(CameraFaultError):
            await camera.trigger()


async def test_trigger_that_waits_when_the_camera_fails_raises() -> None:
    async with by_hand(box={"status": BUSY}) as (box, camera):
        triggering = asyncio.create_task(camera.trigger())
        await steps(5)
        box.report(BUSY | SYSTEM_ERROR)
        with pytest.raises(CameraFaultError):
            await triggering


async def test_trigger_after_a_fault_sends_nothing_to_the_faulty_camera() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: box.status_frame(RUNNING | SYSTEM_ERROR)
        await gone(camera.trigger())
        mark = len(box.ids)
        with pytest.raises(CameraFaultError):
            await camera.trigger()
        assert box.since(mark) == []


async def test_trigger_with_input_out_of_step_raises() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: box.status_frame(RUNNING | INPUT_CONTAINER)
        with pytest.raises(InputContainerError, match="input data and inspections are out of step"):
            await camera.trigger(input=b"\x01")


async def test_trigger_without_input_does_not_care_for_the_bit() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: (
            box.status_frame(RUNNING | INPUT_CONTAINER) + box.result_frame()
        )
        assert (await camera.trigger()).raw == b"found"


async def test_trigger_whose_result_does_not_fit_raises_and_the_link_stays() -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        box.container = b"\x01\x02"
        with pytest.raises(InterpretationError) as caught:
            await camera.trigger()
        assert (caught.value.field, caught.value.offset) == ("n", 0)
        box.container = b"\x01\x00\x00\x00"
        assert (await camera.trigger()).value.n == 1
        statistics = camera.statistics()
        assert (statistics.uninterpretable, statistics.triggered) == (1, 1)


# ---------------------------------------------------------------------- input data


async def test_trigger_sends_its_input_right_before() -> None:
    async with by_hand() as (box, camera):
        await camera.trigger(input=b"part 4")
        assert box.received[-4:] == [(QUERY, b""), (INPUT, b"part 4"), (TRIGGER, b""), (QUERY, b"")]


async def test_triggers_with_input_at_once_get_their_own_results() -> None:
    box = {"applications": [{**ECHO, "processing_time": 0.0}], "running": True, "active": 5}
    async with emulated(box=box, interpret_as="part: int32") as (emulator, _, camera):
        results = await asyncio.gather(
            *(camera.trigger(input=struct.pack("<i", part)) for part in range(8))
        )
        assert [result.value.part for result in results] == list(range(8))
        sent = [entry.message_id for entry in emulator.log if entry.direction == "in"]
        assert sent[-32:] == [QUERY, INPUT, TRIGGER, QUERY] * 8


async def test_trigger_with_one_container_too_many_raises() -> None:
    box = {"applications": [ECHO], "running": True, "active": 5, "quirks": {"input_queue_depth": 1}}
    async with emulated(box=box) as (_, _, camera):
        await camera.set_input(bytes(4))
        with pytest.raises(InputContainerError):
            await camera.trigger(input=bytes(4))


async def test_input_of_a_trigger_without_result_is_never_taken_for_the_next() -> None:
    box = {"applications": [ECHO], "running": True, "active": 5}
    async with emulated(box=box, interpret_as="part: int32") as (emulator, clock, camera):
        first = asyncio.create_task(camera.trigger(input=struct.pack("<i", 1)))
        await asyncio.sleep(0)
        emulator.device.trigger()  # a sensor is faster, and takes the place of ours
        with pytest.raises(TriggerError):
            await first
        clock.advance(1)
        with pytest.raises(InputContainerError, match="may still be queued in the camera"):
            await camera.trigger(input=struct.pack("<i", 2))
        switched = asyncio.create_task(camera.switch_application(5))
        await emulator.wait_received(m.Start)
        await switched
        third = asyncio.create_task(camera.trigger(input=struct.pack("<i", 3)))
        await emulator.wait_received(m.Trigger, count=2)
        clock.advance(1)
        assert (await third).value.part == 3


async def test_trigger_when_busy_mistyped_is_refused() -> None:
    async with by_hand() as (_, camera):
        with pytest.raises(ConfigurationError, match="when_busy: expected 'wait' or 'refuse'"):
            await camera.trigger(when_busy="refused")  # type: ignore[call-overload]


# ---------------------------------------------------------------------- turns and debts


async def test_trigger_that_goes_out_at_once_has_nothing_to_wait_for() -> None:
    """The straight way is taken only where the long one would neither wait, nor send, nor raise."""
    async with by_hand() as (_, camera):
        client = inside(camera)
        triggers, state, waits = client._triggers, client._state, client._waits
        correlation, commands, link = (
            triggers._correlation,
            client._commands,
            triggers._connection.link,
        )
        assert link is not None
        bits = [sum(some) for some in itertools.product(*((0, int(one)) for one in TELLING))]
        doubts = [*itertools.product((False, True), ([], [None]), (None, 0), (0, 1))]
        usual = state.status, state.bits, correlation.owed
        straight = 0
        for said, (status_may_be_old, owed, halted, open_) in itertools.product(bits, doubts):
            for data, expected in itertools.product((None, b"1"), (None, state.active, 99)):
                state.status, state.bits = Status(said), said
                correlation.status_may_be_old, correlation.owed = status_may_be_old, owed  # type: ignore[assignment]
                commands._loads_when_halted, waits.open_queries = halted, open_
                request = TriggerRequest(client._default, data, 1, wait=True)
                if triggers._can_send_now(request, expected):
                    straight += 1
                    written = link.machine.counters.frames_sent
                    with pytest.raises(StopIteration):
                        triggers._get_ready(request, expected, link.loop.time() + 1.0).send(None)
                    assert link.machine.counters.frames_sent == written
        state.status, state.bits, correlation.owed = usual
        correlation.status_may_be_old, commands._loads_when_halted, waits.open_queries = (
            False,
            None,
            0,
        )
    assert straight == 4  # with Running or without, whichever application is expected


TELLING = (WAITING, RUNNING, BUSY, OVERTRIGGERED, SYSTEM_ERROR)


async def test_triggers_at_once_take_turns() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = box.takes
        tasks = [asyncio.create_task(camera.trigger()) for _ in range(3)]
        for number, task in enumerate(tasks, 1):
            await box.wait_for(TRIGGER, number)
            await steps(10)
            assert box.ids.count(TRIGGER) == number
            box.send(box.over(bytes([number])))
            assert (await task).raw == bytes([number])


async def test_trigger_cancelled_owes_a_result_that_the_next_one_never_gets() -> None:
    async with by_hand() as (box, camera):
        trigger, box.script[TRIGGER] = box.script[TRIGGER], box.takes
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        await cancelled(triggering)
        box.script[TRIGGER] = trigger
        box.script[STOP] = lambda _: box.result_frame(b"late") + box.status_frame(0)
        mark = len(box.ids)
        assert (await camera.trigger()).raw == b"found"
        assert box.since(mark) == [STOP, QUERY, START, *TRIGGER_IDS]
        statistics = camera.statistics()
        assert (statistics.late, statistics.triggered) == (1, 1)


async def test_trigger_timed_out_owes_a_result_that_the_next_one_never_gets() -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        box.script[TRIGGER] = box.takes
        await gone(camera.trigger(timeout=SHORT))
        box.send(box.over(b"late"))
        late = await anext(results)
        assert (late.raw, late.triggered_at) == (b"late", None)
        box.script[TRIGGER], box.container = box._trigger, b"ours"
        mark = len(box.ids)
        assert (await camera.trigger()).raw == b"ours"
        assert box.since(mark) == TRIGGER_IDS  # the debt was paid
        assert camera.statistics().late == 1


async def test_late_result_that_does_not_fit_is_late() -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        results = camera.results()
        box.script[TRIGGER] = box.takes
        await gone(camera.trigger(timeout=SHORT))
        box.send(box.result_frame(b"?"))
        with pytest.raises(InterpretationError):
            await anext(results)
        assert camera.statistics().late == 1
        balance(camera.statistics())


async def test_trigger_cancelled_at_the_emulator_is_voided_by_the_next() -> None:
    async with emulated(box={"running": True, "active": 21}) as (emulator, clock, camera):
        triggering = asyncio.create_task(camera.trigger())
        await emulator.wait_received(m.Trigger)
        await cancelled(triggering)
        following = asyncio.create_task(camera.trigger())
        await emulator.wait_received(m.Trigger, count=2)
        clock.advance(0.05)
        assert (await following).raw.startswith(b"Hello World")
        sent = [entry.message_id for entry in emulator.log if entry.direction == "in"]
        assert sent[-9:] == [*TRIGGER_IDS, STOP, QUERY, START, *TRIGGER_IDS]
        statistics = camera.statistics()
        assert (statistics.received, statistics.triggered) == (1, 1)


async def test_debt_of_a_stopped_application_is_forgotten() -> None:
    async with by_hand() as (box, camera):
        trigger, box.script[TRIGGER] = box.script[TRIGGER], box.takes
        await gone(camera.trigger(timeout=SHORT))
        await camera.stop()
        with pytest.raises(NotRunningError):
            await camera.trigger()
        box.script[TRIGGER] = trigger
        await camera.start()
        mark = len(box.ids)
        await camera.trigger()
        assert box.since(mark) == TRIGGER_IDS


async def test_debt_is_paid_by_a_switch() -> None:
    async with by_hand() as (box, camera):
        trigger, box.script[TRIGGER] = box.script[TRIGGER], box.takes
        await gone(camera.trigger(timeout=SHORT))
        box.script[TRIGGER] = trigger
        await camera.switch_application(3)
        mark = len(box.ids)
        assert (await camera.trigger()).application == 3
        assert box.since(mark) == TRIGGER_IDS


@pytest.mark.parametrize("phase", [STOP, QUERY, START])
async def test_settling_cancelled_half_way_is_put_up_again(phase: int) -> None:
    async with by_hand() as (box, camera):
        script = dict(box.script)
        box.script |= {TRIGGER: box.takes}
        await gone(camera.trigger(timeout=SHORT))
        box.script[phase] = quiet
        fencing = asyncio.create_task(camera.trigger())
        await box.wait_for(phase, 4 if phase == QUERY else 1)
        await cancelled(fencing)
        box.script |= script
        box.send(script[phase](b""))
        assert (await camera.trigger()).raw == b"found"
        assert camera.status == Status(READY)


async def test_settling_cancelled_leaves_the_stop_that_the_user_wants() -> None:
    async with by_hand() as (box, camera):
        await cancelled_at_its_query(box, camera)
        box.send(box.script[QUERY](b""))
        await camera.stop()
        with pytest.raises(NotRunningError):
            await camera.trigger()


async def test_settling_cancelled_then_switched_runs_again() -> None:
    async with by_hand() as (box, camera):
        await cancelled_at_its_query(box, camera)
        box.send(box.script[QUERY](b""))
        await camera.switch_application(3)
        assert camera.status == Status(READY)


async def test_settling_too_slow_for_a_short_trigger_leaves_the_link() -> None:
    async with by_hand() as (box, camera):
        script = dict(box.script)
        box.script[TRIGGER] = box.takes
        await gone(camera.trigger(timeout=SHORT))
        box.script[QUERY] = quiet
        for _ in range(2):
            with pytest.raises(TriggerTimeoutError, match=r"Query.*no trigger was sent"):
                await camera.trigger(timeout=SHORT)
        box.script |= script
        box.send(script[QUERY](b""))
        assert (await camera.trigger()).raw == b"found"


async def test_settling_never_answered_gives_the_link_up_in_the_end() -> None:
    async with by_hand(request_timeout=SHORT) as (box, camera):
        box.script[TRIGGER] = box.takes
        await gone(camera.trigger(timeout=SHORT))
        box.script[QUERY] = quiet
        with pytest.raises(TriggerTimeoutError, match="no answer to Query"):
            await camera.trigger(timeout=2 * SHORT)
        await until(lambda: not camera.connected)


async def test_settling_cancelled_then_a_switch_refused_runs_again() -> None:
    async with by_hand() as (box, camera):
        await cancelled_at_its_query(box, camera)
        box.send(box.script[QUERY](b""))
        with pytest.raises(CommandRejectedError):
            await camera.switch_application(99)
        assert camera.status == Status(READY)


async def test_result_that_comes_while_its_caller_is_being_cancelled_is_late() -> None:
    async with by_hand() as (box, camera):
        trigger, box.script[TRIGGER] = box.script[TRIGGER], box.takes
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        await until(lambda: not inside(camera)._waits.is_pending(m.QueryAnswer))
        triggering.cancel()
        inside(camera)._dispatch.dispatch(
            Chunk(0.0, [m.ResultContainer(application=7, data=b"late")])
        )
        await asyncio.wait({triggering})
        assert triggering.cancelled()
        assert camera.statistics().late == 1
        box.send(box.over())
        box.script[TRIGGER] = trigger
        mark = len(box.ids)
        await camera.trigger()
        assert box.since(mark) == TRIGGER_IDS  # nothing is owed


async def test_result_that_comes_before_its_caller_is_cancelled_owes_nothing() -> None:
    async with by_hand() as (box, camera):
        trigger, box.script[TRIGGER] = box.script[TRIGGER], quiet
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        await until(lambda: not inside(camera)._waits.is_pending(m.QueryAnswer))
        inside(camera)._dispatch.dispatch(
            Chunk(0.0, [BEGUN, m.ResultContainer(application=7, data=b"ours")])
        )
        inside(camera)._dispatch.dispatch(
            Chunk(0.0, [m.StatusReport(status=Status(READY), endian=0)])
        )
        await cancelled(triggering)
        box.script[TRIGGER] = trigger
        mark = len(box.ids)
        await camera.trigger()
        assert box.since(mark) == TRIGGER_IDS


@pytest.mark.parametrize("waiting", ["trigger", "next_result"])
async def test_result_at_the_very_deadline_is_returned(waiting: str) -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = quiet
        loop = asyncio.get_running_loop()
        chunk = Chunk(0.0, [BEGUN, m.ResultContainer(application=7, data=b"just")])
        deadline = loop.time() + SHORT
        task = asyncio.ensure_future(getattr(camera, waiting)(timeout=SHORT))
        loop.call_at(deadline - 0.001, inside(camera)._dispatch.dispatch, chunk)
        await steps(5)
        spend(SHORT)  # both timers are due in the loop's next step
        assert (await task).raw == b"just"


# ---------------------------------------------------------------------- interpret_as

RECORD = struct.pack("<Bif8s", 0xFF, 2, 101.5, b"ABC")
LAYOUT = "passed: bool, count: int32, x: real32 mm, code: string[8]"


async def _read(spec: object, data: bytes = RECORD, **options: Any) -> Any:
    async with by_hand(interpret_as=spec, **options) as (box, camera):
        box.container = data
        return (await camera.trigger()).value


async def test_interpret_as_nothing_gives_bytes() -> None:
    assert await _read(None) == RECORD
    assert await _read("raw") == RECORD


@pytest.mark.parametrize("spec", [LAYOUT, Layout(LAYOUT), f"record: {LAYOUT}", {7: LAYOUT}])
async def test_interpret_as_a_layout_gives_a_record_in_si(spec: object) -> None:
    value = await _read(spec)
    assert (value.passed, value.count, value.x, value.code) == (
        True,
        2,
        pytest.approx(0.1015),
        "ABC",
    )


async def test_interpret_as_a_name_with_a_layout_gives_a_table() -> None:
    table = await _read("table: (n: int32, x: real32 mm)*", struct.pack("<ifif", 1, 5.0, 2, -5.0))
    assert isinstance(table, np.ndarray)
    assert table["n"].tolist() == [1, 2]
    assert table["x"].tolist() == pytest.approx([0.005, -0.005])


async def test_interpret_as_strings() -> None:
    assert await _read("50ByteStrings", b"one".ljust(50, b"\0") + bytes(50)) == ["one", ""]


async def test_interpret_as_a_function_of_ones_own() -> None:
    assert await _read(lambda reader: reader.get_int32(1)) == 2


def _part(x: float, y: float, theta: float) -> bytes:
    return struct.pack("<50sfifff", b"square", 0.9, 0, x, y, theta)


async def test_interpret_as_localizations_turns_an_axis_that_points_down() -> None:
    (part,) = await _read("localizations", _part(1.0, 2.0, 0.5), y_down=True)
    assert part.pose.position == (1.0, -2.0, 0.0)
    assert part.pose.orientation.theta == pytest.approx(-0.5)


async def test_interpret_as_localizations_skips_and_counts_empty_slots() -> None:
    async with by_hand(interpret_as="localizations") as (box, camera):
        box.container = _part(1.0, 2.0, 0.5) + 2 * bytes(len(_part(0, 0, 0)))
        assert len((await camera.trigger()).value) == 1
        assert camera.statistics().empty_slots == 2


async def test_interpret_as_strict_wants_the_cameras_bool_and_lenient_takes_any() -> None:
    with pytest.raises(InterpretationError) as caught:
        await _read("passed: bool", b"\x01")
    assert caught.value.field == "passed"
    assert (await _read("passed: bool", b"\x01", lenient=True)).passed is True


async def test_interpret_as_of_one_trigger_goes_before_the_cameras() -> None:
    async with by_hand(interpret_as="raw") as (box, camera):
        box.container = RECORD
        result = await camera.trigger(interpret_as=LAYOUT)
        assert result.value.count == 2
        assert (await camera.trigger()).value == RECORD


async def test_interpret_as_mapping_takes_the_specification_of_the_results_application() -> None:
    async with by_hand(interpret_as={7: "raw", 3: "n: int32"}) as (box, camera):
        box.container = bytes(4)
        assert (await camera.trigger()).value == bytes(4)
        assert (await camera.trigger(3)).value.n == 0


async def test_interpret_as_mapping_that_lacks_the_application_raises() -> None:
    with pytest.raises(
        WrongApplicationError, match=r"result of application 7 came; interpret_as knows \[1, 3\]"
    ) as caught:
        await _read({3: "raw", 1: "raw"})
    assert (caught.value.expected, caught.value.got) == ([1, 3], 7)


@pytest.mark.parametrize(
    ("spec", "error"),
    [({"7": "raw"}, ConfigurationError), ({7: "nothing"}, PluginError), ("n: int33", LayoutError)],
)
async def test_interpret_as_something_wrong_is_refused_before_a_trigger_is_sent(
    spec: object, error: type[ConfigurationError]
) -> None:
    async with by_hand() as (box, camera):
        with pytest.raises(error):
            await camera.trigger(interpret_as=spec)  # type: ignore[call-overload]
        assert TRIGGER not in box.ids


async def test_result_carries_the_value_of_its_sequence_field() -> None:
    async with by_hand(interpret_as="n: int32 @sequence, x: int32") as (box, camera):
        box.container = struct.pack("<ii", 41, 5)
        await camera.set_sequence_number(41)
        result = await camera.trigger()
        assert (result.sequence, result.value.x, result.number) == (41, 5, 1)


async def test_endian_field_of_the_status_turns_the_result_around() -> None:
    async with by_hand(interpret_as="n: int32 @sequence") as (box, camera):
        box.container = struct.pack(">i", 41)
        box.send(box.status_frame(READY, 1))
        assert (await camera.trigger(interpret_as="raw")).value == struct.pack(">i", 41)
        await camera.set_sequence_number(41)
        result = await camera.trigger()
        assert (result.value.n, result.sequence) == (41, 41)


async def test_endian_field_that_means_nothing_is_an_error_when_a_result_comes() -> None:
    async with by_hand() as (box, camera):
        box.send(box.status_frame(READY, 7))
        await camera.query_application()
        with pytest.raises(InterpretationError, match=r"endian field is 7; 0 .* or 1") as caught:
            await camera.trigger()
        error = caught.value
        assert (error.field, error.expected, error.got) == ("endian", (0, 1), 7)
        assert camera.statistics().uninterpretable == 1


def _slip(_: object) -> object:
    raise KeyError("slip")


async def test_interpreter_with_a_slip_is_an_outcome_like_any_other() -> None:
    async with by_hand(interpret_as=_slip) as (_, camera):
        with pytest.raises(InterpretationError, match="the interpreter failed with KeyError"):
            await camera.trigger()
        balance(camera.statistics())
        assert camera.connected


# ---------------------------------------------------------------------- traces of it all


class _Frames(smartcam.Observer):
    def __init__(self) -> None:
        self.entries: list[Any] = []

    def on_frame(self, entry: object) -> None:
        self.entries.append(entry)


async def test_trigger_is_traced(caplog: pytest.LogCaptureFixture) -> None:
    frames = _Frames()
    with caplog.at_level(logging.DEBUG, "smartcam"):
        async with HandmadeCamera() as box, smartcam.connect(box.url, observers=[frames]) as camera:
            await camera.trigger()
    entries = frames.entries
    names = [(entry.direction, entry.message) for entry in entries]
    at = names.index((">", "Trigger"))
    assert names[at - 1 : at + 7] == [
        (">", "Query"),
        (">", "Trigger"),
        (">", "Query"),
        ("<", "QueryAnswer"),
        ("<", "StatusReport"),
        ("<", "ResultContainer"),
        ("<", "StatusReport"),
        ("<", "QueryAnswer"),
    ]
    assert entries[at + 4].fields == {"application": 7, "data": b"found".hex()}
    assert "> Trigger" in caplog.text


async def test_clock_and_trigger_at_once_do_not_disturb_each_other() -> None:
    async with by_hand() as (box, camera):
        clock = box.script[GET_CLOCK]
        box.script[GET_CLOCK] = quiet
        box.script[TRIGGER] = lambda _: (
            box.status_frame(RUNNING) + clock(b"") + box.result_frame() + box.status_frame(READY)
        )
        asking = asyncio.create_task(camera.get_clock())
        await box.wait_for(GET_CLOCK)
        assert (await camera.trigger()).raw == b"found"
        assert await asking == datetime(2016, 6, 25, 10, 11, 12)  # noqa: DTZ001 - it has no zone
