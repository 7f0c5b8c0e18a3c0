"""No result is ever taken for another trigger's: by number, and by settling debts."""

from __future__ import annotations

import asyncio
import struct
from typing import Any

import pytest

from smartcam import Backoff, Camera, InterpretationError, Status, TriggerTimeoutError
from smartcam.protocols import messages as m
from tests.client.camera_by_hand import (
    CONNECT,
    INPUT,
    NUMBER,
    QUERY,
    READY,
    RUNNING,
    START,
    STOP,
    TRIGGER,
    WAITING,
    HandmadeCamera,
    words,
)
from tests.client.clientkit import (
    SHORT,
    SOON,
    TRIGGER_IDS,
    by_hand,
    cancelled_at_its_query,
    emulated,
    gone,
    quiet,
    steps,
)
from tests.insides import inside

# ---------------------------------------------------------------------- by number

TRANSPORTS = pytest.mark.parametrize("transport", ["tcp", "udp"])
NUMBERED = "n: uint32 @sequence, part: string[4]"


def numbered(number: int, part: bytes = b"own") -> bytes:
    return struct.pack("<I4s", number, part)


def counting(box: HandmadeCamera) -> None:
    """Let the camera put the number that was set into its results."""
    box.script[TRIGGER] = lambda _: box.inspects(numbered(last(box)))


def with_queries(transport: str, *ids: int) -> list[int]:
    """Return what is said around a trigger, in one write, with what is said for it."""
    return [QUERY, *ids, QUERY] if transport == "tcp" else [*ids]


def last(box: HandmadeCamera) -> int:
    """Return the number that was set last."""
    payload = [payload for one, payload in box.received if one == NUMBER][-1]
    return int.from_bytes(payload, "little")


async def times_out(box: HandmadeCamera, camera: Camera[Any]) -> None:
    """Have a trigger time out that the camera takes, and does not answer."""
    trigger = box.script[TRIGGER]
    box.script[TRIGGER] = box.takes
    with pytest.raises(TriggerTimeoutError):
        await camera.trigger(timeout=SHORT)
    box.script[TRIGGER] = trigger


@TRANSPORTS
async def test_number_is_set_right_before_each_trigger(transport: str) -> None:
    async with by_hand(box={"transport": transport}, interpret_as=NUMBERED) as (box, camera):
        counting(box)
        mark = len(box.ids)
        results = [await camera.trigger(), await camera.trigger(input=b"part")]
        first, second = (NUMBER, TRIGGER), (NUMBER, INPUT, TRIGGER)
        assert box.since(mark) == with_queries(transport, *first) + with_queries(transport, *second)
        assert [one.sequence for one in results] == [one.value.n for one in results]
        assert results[0].sequence != results[1].sequence == last(box)


@TRANSPORTS
async def test_late_result_of_an_earlier_number_is_known_without_stopping(transport: str) -> None:
    async with by_hand(box={"transport": transport}, interpret_as=NUMBERED) as (box, camera):
        results = camera.results()
        # over TCP each is taken, and its result is late; over UDP all of that is lost
        box.script[TRIGGER] = (lambda _: box.inspects()) if transport == "tcp" else quiet
        numbers: list[int] = []
        for _ in range(3):
            with pytest.raises(TriggerTimeoutError):
                await camera.trigger(timeout=SHORT)
            numbers.append(last(box))
        mark = len(box.ids)
        following = asyncio.create_task(camera.next_result(timeout=SOON))
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER, 4)
        for number in reversed(numbers):
            box.send(box.result_frame(numbered(number, b"old")))
        box.send(box.result_frame(numbered(last(box))))
        assert (await triggering).value.part == "own"
        assert (await following).value.part == "own"
        # over UDP the status that tells of a Stop may have been lost as well
        asked_for_status = [QUERY, CONNECT, QUERY] if transport == "udp" else []
        assert box.since(mark) == asked_for_status + with_queries(transport, NUMBER, TRIGGER)
        assert [(await anext(results)).value.part for _ in range(4)] == ["old"] * 3 + ["own"]
        statistics = camera.statistics()
        assert (statistics.late, statistics.triggered, statistics.streamed) == (3, 1, 0)


@TRANSPORTS
async def test_somebody_elses_number_is_streamed_and_not_ours(transport: str) -> None:
    async with by_hand(box={"transport": transport}, interpret_as=NUMBERED) as (box, camera):
        results, following = camera.results(), camera.next_result(timeout=SOON)
        box.script[TRIGGER] = lambda _: box.inspects(
            numbered(last(box) - 1, b"else"),
            numbered(last(box) + 1, b"else"),
            numbered(last(box)),
        )
        assert (await camera.trigger()).value.part == "own"
        assert [(await anext(results)).value.part for _ in range(3)] == ["else", "else", "own"]
        assert (await following).value.part == "else"
        statistics = camera.statistics()
        assert (statistics.streamed, statistics.triggered, statistics.extra_results) == (2, 1, 0)


@TRANSPORTS
async def test_camera_that_ignores_the_number_ends_in_a_timeout(transport: str) -> None:
    async with by_hand(box={"transport": transport}, interpret_as=NUMBERED) as (box, camera):
        results = camera.results()
        box.script[TRIGGER] = lambda _: box.inspects(numbered(1))
        for _ in range(2):
            with pytest.raises(TriggerTimeoutError, match="no result within"):
                await camera.trigger(timeout=SHORT)
        assert [(await anext(results)).sequence for _ in range(2)] == [1, 1]
        assert camera.statistics().streamed == 2
        assert STOP not in box.ids


@TRANSPORTS
async def test_number_the_user_has_set_is_used_once(transport: str) -> None:
    async with by_hand(box={"transport": transport}, interpret_as=NUMBERED) as (box, camera):
        counting(box)
        await camera.set_sequence_number(41)
        await box.wait_for(NUMBER)
        mark = len(box.ids)
        assert (await camera.trigger()).sequence == 41
        assert box.since(mark) == with_queries(transport, NUMBER, TRIGGER)
        assert (await camera.trigger()).sequence != 41


async def test_number_the_user_has_set_that_does_not_fit_the_field_is_replaced() -> None:
    async with by_hand(interpret_as="n: uint8 @sequence") as (box, camera):
        box.script[TRIGGER] = lambda _: box.inspects(bytes([last(box)]))
        await camera.set_sequence_number(1000)
        assert 0 <= (await camera.trigger()).value.n <= 255


async def test_second_result_with_a_number_is_extra_even_behind_the_next_trigger() -> None:
    async with by_hand(interpret_as=NUMBERED) as (box, camera):
        counting(box)
        first = await camera.trigger()
        assert first.sequence is not None
        box.script[TRIGGER] = box.takes
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER, 2)
        box.send(box.result_frame(numbered(first.sequence, b"copy")))
        box.send(box.over(numbered(last(box))))
        assert (await triggering).value.part == "own"
        assert camera.statistics().extra_results == 1


async def test_several_results_with_one_number_are_all_the_triggers() -> None:
    async with by_hand(interpret_as=NUMBERED) as (box, camera):
        box.script[TRIGGER] = lambda _: box.inspects(
            numbered(last(box), b"a"), numbered(last(box) - 1, b"else"), numbered(last(box), b"b")
        )
        results = await camera.trigger(results_per_trigger=2)
        assert [one.value.part for one in results] == ["a", "b"]


@TRANSPORTS
async def test_number_in_a_container_that_does_not_fit_is_read_nowhere(transport: str) -> None:
    async with by_hand(box={"transport": transport}, interpret_as=NUMBERED) as (box, camera):
        box.script[TRIGGER] = lambda _: box.inspects(b"?")
        with pytest.raises(InterpretationError):
            await camera.trigger()
        counting(box)
        assert (await camera.trigger()).value.part == "own"


async def test_records_that_may_be_missing_are_settled_as_without_a_number() -> None:
    async with by_hand(interpret_as="(n: uint32 @sequence)*") as (box, camera):
        box.script[TRIGGER] = box.takes
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=SHORT)
        mark = len(box.ids)
        box.script[TRIGGER], box.container = box._trigger, b""
        result = await camera.trigger()
        assert (list(result.value), result.sequence) == ([], None)
        assert box.since(mark) == [STOP, QUERY, START, *with_queries("tcp", NUMBER, TRIGGER)]


@TRANSPORTS
async def test_numbers_of_the_emulator_keep_sensors_and_triggers_apart(transport: str) -> None:
    application = {
        "id": 5,
        "layout": "n: int32 @sequence",
        "generator": "sequence",
        "processing_time": 0.05,
    }
    box = {"transport": transport, "applications": [application], "active": 5, "running": True}
    async with emulated(box=box, interpret_as="n: int32 @sequence") as (emulator, clock, camera):
        own: list[int | None] = []
        for turn in range(1, 6):
            emulator.device.trigger()  # a sensor
            clock.advance(0.05)
            triggering = asyncio.create_task(camera.trigger())
            await emulator.wait_received(m.Trigger, count=turn)
            clock.advance(0.05)
            own.append((await triggering).sequence)
        statistics = camera.statistics()
        assert (statistics.triggered, statistics.unclaimed) == (5, 5)
        assert len(set(own)) == 5
        sent = [entry.message_id for entry in emulator.log if entry.direction == "in"]
        assert STOP not in sent


# ---------------------------------------------------------------------- debts without a number


@pytest.mark.parametrize("order", ["result first", "waiting first"])
async def test_late_result_within_the_grace_needs_no_stop(order: str) -> None:
    async with by_hand() as (box, camera):
        await times_out(box, camera)
        mark = len(box.ids)
        triggering = asyncio.create_task(camera.trigger())
        await steps(10)
        late, ready = box.result_frame(b"late"), box.status_frame(READY)
        box.send(late + ready if order == "result first" else ready + late)
        assert (await triggering).raw == b"found"
        assert box.since(mark) == TRIGGER_IDS
        statistics = camera.statistics()
        assert (statistics.late, statistics.triggered) == (1, 1)


async def test_late_result_that_does_not_come_is_made_impossible_after_the_grace() -> None:
    async with by_hand() as (box, camera):
        await times_out(box, camera)
        mark, loop = len(box.ids), asyncio.get_running_loop()
        begin = loop.time()
        assert (await camera.trigger()).raw == b"found"
        assert loop.time() - begin >= 0.2
        assert box.since(mark) == [STOP, QUERY, START, *TRIGGER_IDS]


async def test_grace_is_half_the_time_of_a_short_trigger() -> None:
    async with by_hand() as (box, camera):
        await times_out(box, camera)
        async with asyncio.timeout(SOON):
            assert (await camera.trigger(timeout=0.2)).raw == b"found"


async def test_settling_that_was_cancelled_after_its_stop_is_finished_by_the_next() -> None:
    async with by_hand() as (box, camera):
        await cancelled_at_its_query(box, camera)
        box.script[TRIGGER] = box._trigger
        paid = box.result_frame(b"late")
        box.send(paid + box.script[QUERY](b""))  # the camera has stopped
        await camera.query_application()
        assert camera.status == Status(0)
        assert (await camera.trigger()).raw == b"found"


async def test_late_result_that_does_not_fit_is_not_told_to_next_result() -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        box.script[TRIGGER] = box.takes
        await gone(camera.trigger(timeout=SHORT))
        following = asyncio.create_task(camera.next_result(timeout=SOON))
        await steps(2)
        box.send(box.result_frame(b"late?") + box.result_frame(words(5)))
        assert (await following).value.n == 5
        assert camera.statistics().late == 1


async def test_sensors_result_in_flight_is_not_the_triggers() -> None:
    """The camera waits again, but the result of a sensor's inspection is still on its way."""
    async with by_hand() as (box, camera):
        results, statuses = camera.results(), camera.statuses()
        query, sensors = box.script[QUERY], iter([box.result_frame(b"sensor's")])
        box.script[QUERY] = lambda payload: next(sensors, b"") + query(payload)
        box.report(RUNNING, READY)
        assert [await anext(statuses) for _ in range(2)] == [RUNNING, READY]
        mark = len(box.ids)
        assert (await camera.trigger()).raw == b"found"
        assert box.since(mark) == TRIGGER_IDS
        assert [(await anext(results)).raw for _ in range(2)] == [b"sensor's", b"found"]
        assert camera.statistics().streamed == 1


async def test_trigger_between_waiting_and_its_drop_takes_no_older_result() -> None:
    async with by_hand() as (box, camera):
        await camera.trigger()  # the camera was seen to drop Waiting for Trigger
        box.script[TRIGGER] = lambda _: (
            box.result_frame(b"older")
            + box.status_frame(RUNNING)
            + box.result_frame(b"own")
            + box.status_frame(RUNNING | WAITING)
        )
        assert (await camera.trigger()).raw == b"own"
        assert camera.statistics().unclaimed == 1


# ---------------------------------------------------------------------- more results than one


async def test_debt_is_of_all_results_that_are_missing() -> None:
    """Of three results one came in time, and two are late."""
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: box.takes() + box.result_frame(b"1")
        await gone(camera.trigger(timeout=SHORT, results_per_trigger=3))
        box.send(box.result_frame(b"2"))
        await camera.query_application()
        assert inside(camera)._results.correlation.owed_fate == "late"
        box.script[TRIGGER] = lambda _: box.inspects(b"own")
        assert (await camera.trigger()).raw == b"own"
        assert box.ids.count(STOP) == 1


async def test_extra_result_over_a_reconnect_is_not_the_next_triggers() -> None:
    async with by_hand(reconnect=Backoff(initial=0.001)) as (box, camera):
        trigger = box.script[TRIGGER]
        box.script[TRIGGER] = lambda _: box.status_frame(RUNNING)
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        box.hang_up()
        await gone(triggering)
        await camera.wait_connected(5)
        box.send(box.result_frame(b"old 1") + box.status_frame(READY))
        await camera.query_application()
        box.script[TRIGGER] = lambda _: box.result_frame(b"old 2") + trigger(b"")
        assert (await camera.trigger()).raw == b"found"


async def test_every_late_result_of_a_number_is_kept_from_next_result() -> None:
    async with by_hand(interpret_as="n: uint32 @sequence") as (box, camera):
        box.script[TRIGGER] = lambda _: b""
        await gone(camera.trigger(timeout=SHORT, results_per_trigger=2))
        number = box.received[box.ids.index(NUMBER)][1]
        waiting = camera.next_result(timeout=1)
        box.send(3 * box.result_frame(number) + box.result_frame(words(1)))
        assert (await waiting).value.n == 1
        assert camera.statistics().late == 3


async def test_owed_number_does_not_hide_the_debt_of_a_trigger_without_one() -> None:
    async with by_hand(interpret_as="n: int32 @sequence") as (box, camera):
        box.script[TRIGGER] = box.takes
        await gone(camera.trigger(timeout=SHORT))
        number = int.from_bytes(box.received[box.ids.index(NUMBER)][1], "little")
        await gone(camera.trigger(timeout=SHORT, interpret_as="raw"))
        box.send(box.result_frame(words(number + 1)))
        await camera.query_application()
        assert camera.statistics().late == 1


async def test_own_number_that_does_not_fit_leaves_no_debt() -> None:
    async with by_hand(interpret_as="n: uint32 @sequence, ok: bool") as (box, camera):
        box.script[TRIGGER] = lambda _: box.inspects(
            box.received[box.ids.index(NUMBER)][1] + b"\x01"
        )
        with pytest.raises(InterpretationError):
            await camera.trigger()
        assert inside(camera)._results.correlation.owed_fate is None
