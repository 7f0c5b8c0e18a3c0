"""Clock, numbers, input data, reboot, and the escape hatch."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Coroutine
from datetime import datetime
from typing import Any

import pytest

import smartcam
from smartcam import (
    Camera,
    ConfigurationError,
    ConnectionLostError,
    InterpretationError,
    LocalProtocolError,
    RemoteProtocolError,
    ResponseTimeoutError,
    Status,
)
from smartcam.protocols import messages as m
from tests.client.camera_by_hand import (
    CONNECT,
    DISCONNECT,
    GET_CLOCK,
    INPUT,
    NUMBER,
    QUERY,
    REBOOT,
    RUNNING,
    SET_CLOCK,
    START,
    STATUS,
    SWITCH,
    TRIGGER,
    words,
)
from tests.client.clientkit import SHORT, by_hand, cancelled, emulated, quiet, steps
from tests.handmade import until
from tests.insides import inside
from tests.timed_loop import spend

UNKNOWN = 0x77
NOON = datetime(2024, 2, 29, 12, 0, 1)  # noqa: DTZ001 - the camera's clock has no zone


# ---------------------------------------------------------------------- the clock


@pytest.mark.parametrize("dialect", ["handbook", "thesis"])
async def test_get_clock_gives_a_time_without_a_zone(dialect: str) -> None:
    async with by_hand(box={"dialect": dialect}) as (_, camera):
        clock = await camera.get_clock()
        assert clock == datetime(2016, 6, 25, 10, 11, 12)  # noqa: DTZ001 - vector A-1
        assert clock.tzinfo is None


@pytest.mark.parametrize(
    "fields", [(2023, 2, 29, 0, 0, 0), (0, 1, 1, 0, 0, 0), (2023, 1, 1, 24, 0, 0), (1 << 31,) * 6]
)
async def test_get_clock_that_is_no_date_says_what_came(fields: tuple[int, ...]) -> None:
    async with by_hand() as (box, camera):
        box.script[GET_CLOCK] = lambda _: box.said(GET_CLOCK, *fields)
        with pytest.raises(InterpretationError, match="the camera's clock is no date") as caught:
            await camera.get_clock()
        assert (caught.value.field, caught.value.got) == ("clock", fields)
        assert camera.connected


async def test_set_clock_sends_the_published_vector() -> None:
    async with by_hand() as (box, camera):
        await camera.set_clock(datetime(2016, 6, 25, 10, 11, 12))  # noqa: DTZ001 - vector A-1
        payload = await box.wait_for(SET_CLOCK)
    assert payload == bytes.fromhex("E0070000 06000000 19000000 0A000000 0B000000 0C000000")


async def test_clock_that_was_set_is_read_again() -> None:
    async with emulated() as (emulator, clock, camera):
        await camera.set_clock(NOON)
        await emulator.wait_received(m.SetClock)
        clock.advance(2.0)
        assert await camera.get_clock() == NOON.replace(second=3)


async def test_get_clock_never_answered_gives_the_link_up() -> None:
    async with by_hand(request_timeout=SHORT) as (box, camera):
        box.script[GET_CLOCK] = quiet
        with pytest.raises(ResponseTimeoutError, match=r"no answer to GetClock \(0x32\)") as caught:
            await camera.get_clock()
        assert caught.value.message_id == GET_CLOCK
        await until(lambda: not camera.connected)
        with pytest.raises(ConnectionLostError) as later:
            await camera.query_application()
        assert later.value.__cause__ is caught.value
        await box.wait_for(DISCONNECT, 2)


@pytest.mark.parametrize("seconds", [0.0, SHORT])
async def test_requests_that_are_awaited_for_too_short_a_time_keep_the_link(seconds: float) -> None:
    """The camera answers all of them, later; the next ones get their own answers."""
    async with by_hand() as (box, camera):
        calls: dict[int, Callable[..., Coroutine[Any, Any, Any]]] = {
            QUERY: camera.query_application,
            GET_CLOCK: camera.get_clock,
            UNKNOWN: functools.partial(camera.request, UNKNOWN),
        }
        box.script[UNKNOWN] = lambda _: box.said(UNKNOWN)
        held = {message_id: box.script[message_id] for message_id in calls}
        for message_id, call in calls.items():
            box.script[message_id] = quiet
            with pytest.raises(ResponseTimeoutError):
                await call(timeout=seconds)
            await box.wait_for(message_id)
        again = [asyncio.create_task(call()) for call in calls.values()]
        await asyncio.sleep(SHORT)
        assert not any(task.done() for task in again)
        box.script |= held
        for answer in held.values():
            box.send(answer(b""))
        application, clock, answer = await asyncio.gather(*again)
        assert (application, type(clock), answer) == (7, datetime, b"")
        assert (camera.connected, camera.statistics().sessions) == (True, 1)


@pytest.mark.parametrize("first", [0, 1, 2])
async def test_requests_side_by_side_each_end_at_their_own_deadline(first: int) -> None:
    async with by_hand() as (box, camera):
        calls: dict[str, Callable[..., Coroutine[Any, Any, Any]]] = {
            "query": camera.query_application,
            "clock": camera.get_clock,
            "unknown": functools.partial(camera.request, UNKNOWN),
        }
        box.script |= dict.fromkeys((QUERY, GET_CLOCK, UNKNOWN), quiet)
        ended: list[str] = []

        async def ask(name: str, seconds: float) -> None:
            with pytest.raises(ResponseTimeoutError):
                await calls[name](timeout=seconds)
            ended.append(name)

        names = [*calls][first:] + [*calls][:first]
        seconds = {name: SHORT * (1 + 3 * place) for place, name in enumerate(calls)}
        await asyncio.gather(*(ask(name, seconds[name]) for name in names))
        assert ended == [*calls]
        await camera.wait_connected(timeout=SHORT)


async def test_request_timeout_of_the_settings_bounds_requests() -> None:
    async with by_hand(request_timeout=SHORT) as (box, camera):
        box.script[QUERY] = quiet
        with pytest.raises(ResponseTimeoutError, match=r"no answer to Query \(0x30\) in time"):
            await camera.query_application()


# ---------------------------------------------------------------------- what is never answered


async def test_set_sequence_number_is_the_next_runs() -> None:
    async with emulated(box={"active": 9}, interpret_as="n: int32 @sequence") as (_, clock, camera):
        await camera.set_sequence_number(41)
        await camera.start()
        results = camera.results()
        clock.advance(0.1)
        assert [(await anext(results)).sequence for _ in range(2)] == [41, 42]


@pytest.mark.parametrize("number", [0, 4294967295])
async def test_set_sequence_number_takes_a_uint32(number: int) -> None:
    async with by_hand() as (box, camera):
        await camera.set_sequence_number(number)
        assert await box.wait_for(NUMBER) == words(number)


@pytest.mark.parametrize("number", [-1, 4294967296])
async def test_set_sequence_number_that_does_not_fit_sends_nothing(number: int) -> None:
    async with by_hand() as (box, camera):
        with pytest.raises(ConfigurationError, match="number: expected"):
            await camera.set_sequence_number(number)
        await camera.query_application()
        assert NUMBER not in box.ids


async def test_set_input_sends_the_bytes_as_they_are() -> None:
    async with by_hand() as (box, camera):
        await camera.set_input(b"\x00part\xff")
        assert await box.wait_for(INPUT) == b"\x00part\xff"


async def test_reboot_loses_the_link_and_the_camera_comes_back_stopped() -> None:
    async with emulated(box={"running": True, "active": 3}) as (emulator, clock, camera):
        waiting = asyncio.create_task(camera.wait_status(lambda _: False))
        await camera.reboot()
        with pytest.raises(ConnectionLostError):
            await waiting
        clock.advance(30)
        assert (emulator.device.running, emulator.device.active_application) == (False, 3)


async def test_reboot_over_udp_ends_the_link_for_nothing_else_will() -> None:
    async with emulated(box={"transport": "udp"}) as (_, _, camera):
        await camera.reboot()
        await until(lambda: not camera.connected)
        with pytest.raises(ConnectionLostError, match="the camera restarts"):
            await camera.query_application()


async def test_reboot_is_one_frame() -> None:
    async with by_hand() as (box, camera):
        await camera.reboot()
        assert await box.wait_for(REBOOT) == b""


CALLS: list[Callable[[Camera], Coroutine[Any, Any, object]]] = [
    lambda camera: camera.set_input(bytes(1 << 25)),
    lambda camera: camera.trigger(input=bytes(1 << 25), timeout=SHORT),
]


@pytest.mark.parametrize("call", CALLS, ids=["set_input", "trigger"])
async def test_camera_that_takes_no_bytes_is_a_timeout(
    call: Callable[[Camera], Coroutine[Any, Any, object]],
) -> None:
    async with by_hand(request_timeout=SHORT, close_timeout=SHORT) as (box, camera):
        box.stop_reading()
        with pytest.raises(TimeoutError, match=r"takes no more bytes|no result within"):
            await call(camera)


# ---------------------------------------------------------------------- the escape hatch


async def test_request_of_a_known_id_gives_the_answers_body() -> None:
    async with by_hand() as (_, camera):
        assert await camera.request(QUERY) == words(7)


async def test_request_of_an_unknown_id_gives_the_answer_under_the_same_id() -> None:
    async with by_hand() as (box, camera):
        box.script[UNKNOWN] = lambda payload: box.frame(UNKNOWN, payload[::-1])
        assert await camera.request(UNKNOWN, b"abc") == b"cba"
        assert camera.statistics().unknown_ids == 1


async def test_request_of_an_unknown_id_never_answered_gives_the_link_up() -> None:
    async with by_hand(request_timeout=SHORT) as (_, camera):
        with pytest.raises(ResponseTimeoutError, match=r"no answer to UnknownMessage \(0x77\)"):
            await camera.request(UNKNOWN)
        await until(lambda: not camera.connected)


async def test_request_that_wants_no_answer_returns_once_written() -> None:
    async with by_hand() as (box, camera):
        for _ in range(2):
            assert await camera.request(UNKNOWN, b"x", answered=False) is None
        await box.wait_for(UNKNOWN, 2)
        assert camera.connected


async def test_request_that_wants_no_answer_may_get_one_nevertheless() -> None:
    async with by_hand() as (_, camera):
        assert await camera.request(QUERY, answered=False) is None
        assert await camera.query_application() == 7
        assert await camera.request(QUERY, answered=False) is None
        assert await camera.query_application() == 7


async def test_request_of_a_command_returns_once_written() -> None:
    async with by_hand(box={"status": 0}) as (_, camera):
        assert await camera.request(START) is None
        assert await camera.wait_status(lambda status: Status.RUNNING in status)


async def test_request_of_a_command_that_is_answered_here_gives_the_answer() -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: box.said(TRIGGER, 0)
        assert await camera.request(TRIGGER, answered=True) == words(0)


async def test_request_for_a_status_gives_it_as_often_as_asked() -> None:
    async with by_hand() as (box, camera):
        box.script[STATUS] = lambda _: box.said(STATUS, RUNNING, 0)
        for _ in range(2):
            assert await camera.request(STATUS) == words(RUNNING, 0)
        assert camera.status == Status.RUNNING


async def test_request_of_a_switch_is_known_like_any_switch() -> None:
    async with by_hand(box={"status": 0}) as (_, camera):
        assert await camera.request(SWITCH, words(3)) == words(0, 3)
        assert camera.active_application == 3


@pytest.mark.parametrize("payload", [b"", b"\x01", words(3, 4)])
async def test_request_sends_the_payload_as_it_is(payload: bytes) -> None:
    async with by_hand() as (box, camera):
        box.script[SWITCH] = lambda _: box.switched_frame(7, code=1)
        assert await camera.request(SWITCH, payload) == words(1, 7)
        assert box.received[-1] == (SWITCH, payload)


@pytest.mark.parametrize("message_id", [CONNECT, DISCONNECT])
@pytest.mark.parametrize("payload", [b"", b"more"])
async def test_request_of_a_session_is_refused(message_id: int, payload: bytes) -> None:
    async with by_hand() as (box, camera):
        with pytest.raises(
            LocalProtocolError, match="only the client itself sends Connect and Disconnect"
        ):
            await camera.request(message_id, payload)
        assert box.ids == [DISCONNECT, CONNECT, QUERY]


@pytest.mark.parametrize("message_id", [-1, 1 << 32])
async def test_request_of_no_id_at_all_sends_nothing(message_id: int) -> None:
    async with by_hand() as (box, camera):
        for answered in (True, False):
            with pytest.raises(ConfigurationError, match="message_id: expected"):
                await camera.request(message_id, answered=answered)
        assert await camera.query_application() == 7
        assert box.ids == [DISCONNECT, CONNECT, QUERY, QUERY]


async def test_request_before_open_raises() -> None:
    async with by_hand() as (_, camera):
        await camera.close()
        with pytest.raises(ConnectionError, match="the connection is closed"):
            await camera.request(QUERY)


# ---------------------------------------------------------------------- one at a time


async def test_requests_of_one_kind_at_once_are_sent_one_after_the_other() -> None:
    async with by_hand() as (box, camera):
        box.script[GET_CLOCK] = quiet
        asking = [asyncio.create_task(camera.get_clock()) for _ in range(2)]
        for year, task in enumerate(asking, 2001):
            await box.wait_for(GET_CLOCK, year - 2000)
            await steps(10)
            assert box.ids.count(GET_CLOCK) == year - 2000
            box.send(box.said(GET_CLOCK, year, 1, 1, 0, 0, 0))
            assert (await task).year == year


async def test_requests_of_different_kinds_at_once_may_be_answered_in_any_order() -> None:
    async with by_hand() as (box, camera):
        query, clock = box.script[QUERY], box.script[GET_CLOCK]
        box.script |= {QUERY: quiet, GET_CLOCK: quiet}
        asking = asyncio.gather(camera.query_application(), camera.get_clock())
        await box.wait_for(GET_CLOCK)
        box.send(clock(b"") + query(b""))
        application, when = await asking
        assert (application, when.year) == (7, 2016)


async def test_request_in_line_for_too_long_leaves_the_link() -> None:
    async with by_hand() as (box, camera):
        clock = box.script[GET_CLOCK]
        box.script[GET_CLOCK] = quiet
        first = asyncio.create_task(camera.get_clock())
        await box.wait_for(GET_CLOCK)
        with pytest.raises(
            ResponseTimeoutError, match=r"could not send GetClock \(0x32\) in time"
        ) as caught:
            await camera.get_clock(timeout=SHORT)
        assert caught.value.message_id == GET_CLOCK
        box.send(clock(b""))
        assert (await first).year == 2016


async def test_request_cancelled_drops_its_answer_and_the_next_gets_its_own() -> None:
    async with by_hand() as (box, camera):
        box.script[GET_CLOCK] = quiet
        first = asyncio.create_task(camera.get_clock())
        await box.wait_for(GET_CLOCK)
        await cancelled(first)
        second = asyncio.create_task(camera.get_clock())
        await steps(10)
        assert box.ids.count(GET_CLOCK) == 1  # the owed answer is awaited first
        box.send(box.said(GET_CLOCK, 1999, 1, 1, 0, 0, 0))
        await box.wait_for(GET_CLOCK, 2)
        box.send(box.said(GET_CLOCK, 2001, 1, 1, 0, 0, 0))
        assert (await second).year == 2001


async def test_request_cancelled_in_line_sends_nothing() -> None:
    async with by_hand() as (box, camera):
        clock = box.script[GET_CLOCK]
        box.script[GET_CLOCK] = quiet
        first = asyncio.create_task(camera.get_clock())
        await box.wait_for(GET_CLOCK)
        second = asyncio.create_task(camera.get_clock())
        await steps(5)
        await cancelled(second)
        box.send(clock(b""))
        await first
        assert box.ids.count(GET_CLOCK) == 1


async def test_request_in_line_behind_an_owed_answer_leaves_the_link() -> None:
    async with by_hand() as (box, camera):
        clock = box.script[GET_CLOCK]
        box.script[GET_CLOCK] = quiet
        first = asyncio.create_task(camera.get_clock())
        await box.wait_for(GET_CLOCK)
        await cancelled(first)
        second = asyncio.create_task(camera.get_clock())
        await steps(2)
        with pytest.raises(ResponseTimeoutError, match="an earlier answer is owed"):
            await camera.get_clock(timeout=SHORT)
        box.script[GET_CLOCK] = clock
        box.send(clock(b""))
        assert (await second).year == 2016


async def test_answer_that_nobody_asked_for_is_counted_only() -> None:
    async with by_hand() as (box, camera):
        box.send(box.said(QUERY, 99) + box.frame(UNKNOWN, b"?"))
        await camera.get_clock()
        assert await camera.query_application() == 7
        statistics = camera.statistics()
        assert (statistics.unexpected_messages, statistics.unknown_ids) == (1, 1)
        assert camera.active_application == 7


async def test_answer_of_another_kind_than_asked_for_is_an_error() -> None:
    async with by_hand() as (_, camera):
        asking = asyncio.create_task(camera.query_application())
        await until(lambda: m.QueryAnswer in inside(camera)._waits.pending_answers)
        inside(camera)._waits.pending_answers[m.QueryAnswer].set_result(
            m.SwitchAnswer(code=0, application=1)
        )
        del inside(camera)._waits.pending_answers[m.QueryAnswer]
        with pytest.raises(RemoteProtocolError, match="QueryAnswer was expected"):
            await asking


class _SlowWatcher(smartcam.Observer):
    """Somebody's callback that holds the loop up when the application changes."""

    def on_state(self, event: smartcam.CameraEvent) -> None:
        if isinstance(event, smartcam.ApplicationChanged) and event.previous is not None:
            spend(3 * SHORT)


async def test_owed_answer_and_another_question_before_its_waiter_wakes() -> None:
    watchers = [_SlowWatcher()]
    async with by_hand(liveness_timeout=4 * SHORT, observers=watchers) as (box, camera):
        usual = box.script[QUERY]
        box.script[QUERY] = lambda _: b""
        await box.wait_for(QUERY, 2)  # liveness asks
        asking = asyncio.create_task(camera.query_application())
        await steps(2)
        box.script[QUERY] = usual
        box.active = 3
        box.send(box.said(QUERY, 3))
        assert await asking == 3
