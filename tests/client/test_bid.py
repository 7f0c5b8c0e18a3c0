"""The client and a BVS ID written by hand: result codes, sticky errors, status on request."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Coroutine
from datetime import datetime
from typing import Any

import pytest

import smartcam
from smartcam import (
    Camera,
    CameraBusyError,
    CommandRejectedError,
    ConfigurationError,
    ConnectionLostError,
    Disconnected,
    OvertriggeredError,
    Reconnected,
    ResponseTimeoutError,
    Status,
    StatusChanged,
    TriggerTimeoutError,
    UnsupportedError,
)
from tests.client.camera_by_hand import (
    BID_IDLE,
    BID_READY,
    BID_SIMULATION,
    BID_TRIGGER_ERROR,
    CONNECT,
    DISCONNECT,
    ERROR,
    INPUT,
    INVALID,
    NOT_READY,
    OK,
    OK_ID,
    QUERY,
    RESET,
    SET_CLOCK,
    STATUS,
    SWITCH,
    TRIGGER,
    HandmadeBid,
)
from tests.client.clientkit import (
    FAST,
    SHORT,
    SOON,
    balance,
    bid_by_hand,
    cancelled,
    gone,
    hear,
    lose_and_come_back,
    quiet,
    steps,
)
from tests.handmade import LIMIT, Peer, scripted, until
from tests.insides import inside

TRANSPORTS = pytest.mark.parametrize("transport", ["tcp", "udp"])
IDLE = Status.RUNNING | Status.WAITING_FOR_TRIGGER
STATUSES = {
    BID_IDLE: IDLE,
    BID_READY: Status.RUNNING,
    0: Status.RUNNING | Status.BUSY,
    BID_IDLE | BID_SIMULATION: IDLE | Status.SIMULATION_MODE,
    BID_READY | BID_SIMULATION: Status.RUNNING | Status.SIMULATION_MODE,
    BID_SIMULATION: Status.RUNNING | Status.BUSY | Status.SIMULATION_MODE,
}


def codes(box: HandmadeBid, message_id: int, *given: int) -> Callable[[bytes], bytes]:
    """Return what answers with these codes, one after the other, and then as it did before."""
    before, left = box.script[message_id], iter(given)

    def answer(payload: bytes) -> bytes:
        code = next(left, None)
        if code is None:
            return before(payload)
        values = [box.active] if message_id == SWITCH else []
        return box.said(message_id, code, *values)

    return answer


# ---------------------------------------------------------------------- byte for byte


async def test_bid_session_byte_for_byte() -> None:
    async def talk(peer: Peer, number: int) -> None:
        for request, answers in (
            ("02000000 01000000", "02000200 0000 01000400 0000 0100"),
            ("12000000", "12000200 2100"),
            ("30000000", "30000400 0200 1500"),
            ("12000000 30000000", "12000200 2100 30000400 0200 1500"),
            (
                "30000000 12000000 40000000 12000000",
                "30000400 0200 1500 12000200 2100"
                "40000200 0000 20000700 1500 48656c6c6f 12000200 2000",
            ),
        ):
            sent = bytes.fromhex(request)
            assert await peer.read(len(sent)) == sent
            peer.write(bytes.fromhex(answers))
        said.append(await peer.rest())
        peer.write(bytes.fromhex("02000200 0000"))
        peer.close()

    said: list[bytes] = []
    async with scripted(talk) as listener:
        url = f"bvs://127.0.0.1:{listener.port}?dialect=bid"
        async with smartcam.connect(url, reconnect=None) as camera:
            result = await camera.trigger(timeout=LIMIT)
            assert (result.application, result.value) == (21, b"Hello")
        await until(lambda: said)
    assert said[0].endswith(bytes.fromhex("02000000"))


@TRANSPORTS
async def test_bid_opening_asks_for_the_status(transport: str) -> None:
    async with bid_by_hand(box={"transport": transport}) as (box, camera):
        assert box.ids[:4] == [DISCONNECT, CONNECT, STATUS, QUERY]
        assert camera.status == IDLE
        assert camera.active_application == 7
        assert camera.protocol_version == 1


async def test_bid_refused_session_tells_the_code() -> None:
    async with HandmadeBid() as box:
        box.script[CONNECT] = lambda _: box.said(CONNECT, ERROR, 1)
        with pytest.raises(smartcam.ConnectFailedError) as caught:
            await smartcam.connect(box.url, connect_attempts=1).open()
    assert caught.value.attempts[0].endswith(
        "the camera refused the session: code 0x10 "
        "(NOK Error: transfer or execution failed, e.g. wrong format or length)"
    )


async def test_bid_query_busy_at_connect_is_asked_again() -> None:
    async with HandmadeBid() as box:
        active = iter([(NOT_READY, 0), (NOT_READY, 0), (OK_ID, 3)])
        box.script[QUERY] = lambda _: box.said(QUERY, *next(active))
        async with smartcam.connect(box.url) as camera:
            assert camera.active_application == 3
            assert box.ids.count(QUERY) == 3


async def test_bid_query_busy_for_ever_fails_the_connect_in_time() -> None:
    async with HandmadeBid() as box:
        box.script[QUERY] = lambda _: box.said(QUERY, NOT_READY, 0)
        with pytest.raises(smartcam.ConnectFailedError, match="waiting for the answer to Query"):
            await smartcam.connect(box.url, connect_timeout=0.2, connect_attempts=1).open()


# ---------------------------------------------------------------------- triggers


@TRANSPORTS
async def test_bid_trigger_gives_its_result(transport: str) -> None:
    async with bid_by_hand(box={"transport": transport}) as (box, camera):
        mark = len(box.ids)
        for _ in range(3):
            result = await camera.trigger()
            assert (result.application, result.value) == (7, b"found")
        assert box.commands(mark) == [TRIGGER] * 3
        balance(camera.statistics())


@TRANSPORTS
async def test_bid_trigger_refused_as_busy_is_sent_again(transport: str) -> None:
    async with bid_by_hand(box={"transport": transport}) as (box, camera):
        box.script[TRIGGER] = codes(box, TRIGGER, NOT_READY, NOT_READY)
        result = await camera.trigger()
        assert result.value == b"found"
        assert box.ids.count(TRIGGER) == 3
        assert camera.statistics().triggered == 1


async def test_bid_trigger_refused_as_busy_is_an_error_where_it_shall_not_wait() -> None:
    async with bid_by_hand(name="cell 1") as (box, camera):
        box.script[TRIGGER] = codes(box, TRIGGER, NOT_READY)
        with pytest.raises(CameraBusyError) as caught:
            await camera.trigger(when_busy="refuse")
        assert str(caught.value) == (
            "cell 1: Trigger: the camera answered code 0x16 (NOK Busy: Ready status is not set)"
        )
        assert box.ids.count(TRIGGER) == 1
        assert (await camera.trigger(when_busy="refuse")).value == b"found"


async def test_bid_trigger_refused_as_busy_to_the_end_is_a_timeout() -> None:
    async with bid_by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: box.said(TRIGGER, NOT_READY)
        with pytest.raises(TriggerTimeoutError, match=r"code 0x16 \(NOK Busy"):
            await camera.trigger(timeout=2 * SHORT)
        assert camera.connected


@pytest.mark.parametrize(
    ("code", "kind", "said"),
    [
        (INVALID, UnsupportedError, "code 0x13 (NOK Invalid Command: unknown command code)"),
        (ERROR, CommandRejectedError, "code 0x10 (NOK Error: transfer or execution failed, "),
        (0x55, CommandRejectedError, "code 0x55 (not documented)"),
    ],
)
async def test_bid_trigger_refused_ends_at_once_and_the_next_is_taken(
    code: int, kind: type[Exception], said: str
) -> None:
    async with bid_by_hand() as (box, camera):
        box.script[TRIGGER] = codes(box, TRIGGER, code)
        with pytest.raises(kind) as caught:
            await camera.trigger()
        assert f"Trigger: the camera answered {said}" in str(caught.value)
        if isinstance(caught.value, CommandRejectedError):
            assert (caught.value.message_id, caught.value.code) == (TRIGGER, code)
            assert caught.value.active_application == 7
        assert (await camera.trigger()).value == b"found"
        assert camera.statistics().late == 0


async def test_bid_result_before_the_acknowledgement_is_older() -> None:
    async with bid_by_hand() as (box, camera):
        results = camera.results()
        box.script[TRIGGER] = lambda _: (
            box.result_frame(b"older") + box.said(TRIGGER, 0) + box.result_frame()
        )
        for _ in range(2):
            assert (await camera.trigger()).value == b"found"
            assert [(await anext(results)).raw for _ in range(2)] == [b"older", b"found"]
        statistics = camera.statistics()
        assert (statistics.triggered, statistics.streamed) == (2, 2)
        assert statistics.unexpected_messages == 0


# ---------------------------------------------------------------------- what shows that it is ours


def at_the_triggers_query(box: HandmadeBid, status: int) -> None:
    """Let the status be another one from the Query on that goes out with the next trigger."""
    query, count = box.script[QUERY], 0

    def answer(payload: bytes) -> bytes:
        nonlocal count
        count += 1
        if count == 2:  # the first one is behind the status that is asked for before
            box.status = status
        return query(payload)

    box.script[QUERY] = answer


async def test_bid_trigger_of_a_camera_that_does_not_wait_as_its_status_says_is_in_doubt() -> None:
    """A sensor has triggered it since it was asked last; its result comes behind our answer."""
    async with bid_by_hand() as (box, camera):
        at_the_triggers_query(box, BID_READY)

        def at_trigger(_: bytes) -> bytes:
            box.status = BID_IDLE
            return box.said(TRIGGER, OK) + box.result_frame(b"sensor's")

        box.script[TRIGGER] = at_trigger
        with pytest.raises(
            OvertriggeredError, match="it is unknown to which trigger the result belongs"
        ):
            await camera.trigger()
        box.script[TRIGGER] = lambda _: box.said(TRIGGER, OK) + box.result_frame(b"own")
        assert (await camera.trigger()).raw == b"own"
        balance(camera.statistics())


async def test_bid_trigger_error_that_is_set_again_behind_the_reset_ends_the_call() -> None:
    """A sensor's trigger was dropped in between, and so may ours have been."""
    async with bid_by_hand(box={"status": BID_IDLE | BID_TRIGGER_ERROR}) as (box, camera):

        def reset(_: bytes) -> bytes:
            at_the_triggers_query(box, BID_IDLE | BID_TRIGGER_ERROR)
            return box.said(RESET, OK) + box.status_frame(BID_IDLE)

        query, box.script[RESET] = box.script[QUERY], reset
        box.script[TRIGGER] = lambda _: box.said(TRIGGER, OK) + box.result_frame(b"sensor's")
        with pytest.raises(OvertriggeredError):
            await camera.trigger()
        assert TRIGGER in box.ids
        box.script |= {RESET: box._reset, QUERY: query}
        box.script[TRIGGER] = lambda _: box.said(TRIGGER, OK) + box.result_frame(b"own")
        assert (await camera.trigger()).raw == b"own"


async def test_bid_reset_of_another_task_hides_no_trigger_that_was_dropped() -> None:
    async with bid_by_hand() as (box, camera):
        results = camera.results()

        def dropped(_: bytes) -> bytes:
            box.status |= BID_TRIGGER_ERROR
            return box.said(TRIGGER, OK) + box.result_frame(b"sensor's")

        box.script[TRIGGER] = dropped
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        resetting = asyncio.create_task(camera.reset_errors())
        with pytest.raises(OvertriggeredError):
            await triggering
        assert await resetting == IDLE
        assert (await anext(results)).raw == b"sensor's"


async def test_bid_result_waits_for_the_status_behind_the_trigger() -> None:
    async with bid_by_hand() as (box, camera):
        results, status = camera.results(), box.script[STATUS]

        def at_trigger(_: bytes) -> bytes:
            box.script[STATUS] = quiet
            return box.said(TRIGGER, OK) + box.result_frame()

        box.script[TRIGGER] = at_trigger
        triggering = asyncio.create_task(camera.trigger())
        streamed = asyncio.ensure_future(anext(results))
        await box.wait_for(TRIGGER)
        await steps(50)
        assert not triggering.done()
        assert not streamed.done()
        box.send(status(b""))
        assert (await triggering).raw == (await streamed).raw == b"found"


async def test_bid_acknowledgement_that_never_comes_costs_the_link_at_the_next_trigger() -> None:
    async with bid_by_hand(request_timeout=SHORT) as (box, camera):
        box.script[TRIGGER] = quiet
        with pytest.raises(TriggerTimeoutError, match=r"no result within 0\.0\d s of the trigger"):
            await camera.trigger(timeout=SHORT)
        with pytest.raises(TriggerTimeoutError) as caught:
            await camera.trigger(timeout=2 * SHORT)
        assert "could not send Trigger (0x40) in time: an earlier answer is owed" in str(
            caught.value
        )
        assert box.ids.count(TRIGGER) == 1
        with pytest.raises(ConnectionLostError):
            await camera.trigger()


async def test_bid_late_acknowledgement_is_not_taken_for_the_next_triggers() -> None:
    async with bid_by_hand() as (box, camera):
        box.script[TRIGGER] = quiet
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=SHORT)
        next_one = asyncio.create_task(camera.trigger())
        await steps(20)
        assert box.ids.count(TRIGGER) == 1
        box.script[TRIGGER] = lambda _: box.said(TRIGGER, 0) + box.result_frame(b"second")
        box.send(box.said(TRIGGER, INVALID))
        assert (await next_one).value == b"second"
        assert box.ids.count(TRIGGER) == 2


async def test_bid_late_result_is_never_the_next_triggers() -> None:
    async with bid_by_hand() as (box, camera):
        box.status = BID_IDLE
        box.script[TRIGGER] = lambda _: _busy_from_now(box) + box.said(TRIGGER, 0)
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=SHORT)
        next_one = asyncio.create_task(camera.trigger())
        mark = len(box.ids)
        await until(lambda: STATUS in box.since(mark))
        assert TRIGGER not in box.since(mark)
        box.script[TRIGGER] = lambda _: box.said(TRIGGER, 0) + box.result_frame(b"second")
        box.status = BID_IDLE
        box.send(box.result_frame(b"first"))
        assert (await next_one).value == b"second"
        statistics = camera.statistics()
        assert (statistics.late, statistics.triggered) == (1, 1)
        balance(statistics)


def _busy_from_now(box: HandmadeBid) -> bytes:
    box.status = BID_READY
    return b""


async def test_bid_trigger_without_a_result_is_over_when_the_camera_waits_again() -> None:
    async with bid_by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: box.said(TRIGGER, 0)  # and no result
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=SHORT)
        box.script[TRIGGER] = lambda _: box.said(TRIGGER, 0) + box.result_frame(b"second")
        assert (await camera.trigger()).value == b"second"


# ---------------------------------------------------------------------- sticky errors


@TRANSPORTS
async def test_bid_trigger_error_during_ours_is_an_overtrigger(transport: str) -> None:
    async with bid_by_hand(box={"transport": transport}) as (box, camera):

        def dropped(_: bytes) -> bytes:
            box.status = BID_IDLE | BID_TRIGGER_ERROR
            return box.said(TRIGGER, 0)

        box.script[TRIGGER] = dropped
        with pytest.raises(OvertriggeredError):
            await camera.trigger()
        assert camera.statistics().overtriggers == 1
        box.script[TRIGGER] = lambda _: box.said(TRIGGER, 0) + box.result_frame()
        assert (await camera.trigger()).value == b"found"


@TRANSPORTS
async def test_bid_trigger_error_of_before_is_reset_and_spoils_nothing(transport: str) -> None:
    sticky = {"transport": transport, "status": BID_IDLE | BID_TRIGGER_ERROR}
    async with bid_by_hand(box=sticky) as (box, camera):
        mark = len(box.ids)
        assert Status.OVERTRIGGERED in camera.status
        assert (await camera.trigger()).value == b"found"
        assert box.commands(mark) == [RESET, TRIGGER]
        assert camera.status == IDLE


@TRANSPORTS
async def test_bid_trigger_error_that_no_reset_clears_is_never_sent_into(transport: str) -> None:
    sticky = {"transport": transport, "status": BID_IDLE | BID_TRIGGER_ERROR}
    async with bid_by_hand(box=sticky) as (box, camera):
        reset, box.script[RESET] = box.script[RESET], lambda _: box.said(RESET, OK)
        with pytest.raises(OvertriggeredError, match=r"has stayed set for 1 s.*none was sent"):
            await camera.trigger(timeout=10.0)
        assert (TRIGGER in box.ids, RESET in box.ids) == (False, True)
        box.script[RESET] = reset
        assert (await camera.trigger()).value == b"found"


async def test_bid_reset_errors_returns_the_status_after_it() -> None:
    async with bid_by_hand(box={"status": BID_IDLE | BID_TRIGGER_ERROR}) as (box, camera):
        assert await camera.reset_errors() == IDLE
        assert box.ids.count(RESET) == 1


async def test_bid_reset_errors_refused_tells_the_code() -> None:
    async with bid_by_hand() as (box, camera):
        box.script[RESET] = lambda _: box.said(RESET, ERROR)
        with pytest.raises(CommandRejectedError, match="ResetErrors: the camera answered") as error:
            await camera.reset_errors()
        assert (error.value.message_id, error.value.code) == (RESET, ERROR)


# ---------------------------------------------------------------------- switching


async def test_bid_switch_refused_tells_the_code_and_what_is_active() -> None:
    async with bid_by_hand(name="cell 1") as (_, camera):
        with pytest.raises(CommandRejectedError) as caught:
            await camera.switch_application(99)
        assert str(caught.value) == (
            "cell 1: the camera refused to switch to application 99: code 0x1a "
            "(NOK Inspection Error: program change failed); application 7 is active"
        )
        error = caught.value
        assert (error.message_id, error.code, error.active_application) == (SWITCH, 0x1A, 7)
        assert (await camera.trigger()).application == 7


async def test_bid_switch_while_busy_is_asked_again() -> None:
    async with bid_by_hand() as (box, camera):
        mark = len(box.ids)
        box.script[SWITCH] = codes(box, SWITCH, NOT_READY, NOT_READY)
        await camera.switch_application(3)
        assert box.commands(mark) == [SWITCH] * 3
        assert camera.active_application == 3
        assert (await camera.trigger()).application == 3


async def test_bid_switch_while_busy_to_the_end_is_a_timeout() -> None:
    async with bid_by_hand() as (box, camera):
        box.script[SWITCH] = lambda _: box.switched_frame(7, code=NOT_READY)
        with pytest.raises(ResponseTimeoutError, match="for the busy camera to load 3; status: "):
            await camera.switch_application(3, timeout=2 * SHORT)
        assert camera.connected
        assert camera.active_application == 7


@pytest.mark.parametrize("application", [-1, 0x10000, 1 << 32])
async def test_bid_switch_to_an_id_that_does_not_fit_sends_nothing(application: int) -> None:
    async with bid_by_hand() as (box, camera):
        mark = len(box.ids)
        with pytest.raises(ConfigurationError, match=rf"application.* {application}\b"):
            await camera.switch_application(application)
        assert box.commands(mark) == []


async def test_bid_switch_to_application_0_is_refused() -> None:
    async with bid_by_hand() as (_, camera):
        with pytest.raises(CommandRejectedError, match="no application may have the id 0") as error:
            await camera.switch_application(0)
        assert (error.value.code, error.value.active_application) == (0x1A, 7)


async def test_bid_temporary_application_is_left_again() -> None:
    async with bid_by_hand() as (box, camera):
        mark = len(box.ids)
        assert (await camera.trigger(3)).application == 3
        assert box.commands(mark) == [SWITCH, TRIGGER, SWITCH]
        assert (box.active, camera.active_application) == (7, 7)


async def test_bid_connect_with_an_application_has_it_loaded() -> None:
    async with bid_by_hand(application=3) as (box, camera):
        assert (box.active, camera.active_application) == (3, 3)
        assert SWITCH in box.ids


# ---------------------------------------------------------------------- what it cannot


CANNOT: dict[str, Callable[[Camera], Coroutine[Any, Any, object]]] = {
    "Start": lambda camera: camera.start(),
    "Stop": lambda camera: camera.stop(),
    "Reboot": lambda camera: camera.reboot(),
    "SetSequenceNumber": lambda camera: camera.set_sequence_number(5),
    "LoadFile": lambda camera: camera.switch_application("job"),
    "ReadImage": lambda camera: camera.read_image(),
}


@pytest.mark.parametrize("message", CANNOT)
async def test_bid_request_it_lacks_names_dialect_and_abilities(message: str) -> None:
    async with bid_by_hand(interpret_as="raw") as (box, camera):
        mark = len(box.ids)
        with pytest.raises(UnsupportedError) as caught:
            await CANNOT[message](camera)
        assert str(caught.value) == (
            f"dialect bid has no {message}; it can: switch, get_clock, set_clock, input_data, "
            "result_codes, get_status, reset_errors, unasked_results"
        )
        assert box.commands(mark) == []
        assert (await camera.trigger()).value == b"found"
        await camera.wait_ready()


async def test_bid_capabilities_say_what_it_can() -> None:
    async with bid_by_hand() as (_, camera):
        assert camera.capabilities == smartcam.Capabilities(
            dialect="bid",
            switch=True,
            get_clock=True,
            set_clock=True,
            input_data=True,
            result_codes=True,
            get_status=True,
            reset_errors=True,
            unasked_results=True,
        )


# ---------------------------------------------------------------------- input data, clock


async def test_bid_input_is_acknowledged_before_the_trigger() -> None:
    async with bid_by_hand() as (box, camera):
        box.script[INPUT] = quiet
        waiting = asyncio.create_task(camera.trigger(input=b"Hello"))
        assert await box.wait_for(INPUT) == b"Hello"
        await steps(20)
        assert TRIGGER not in box.ids
        box.send(box.said(INPUT, 0))
        assert (await waiting).value == b"found"


@pytest.mark.parametrize("code", [ERROR, NOT_READY])
async def test_bid_input_that_is_refused_sends_no_trigger(code: int) -> None:
    async with bid_by_hand() as (box, camera):
        box.script[INPUT] = codes(box, INPUT, code)
        with pytest.raises(CommandRejectedError, match="SetInput: the camera answered") as caught:
            await camera.trigger(input=b"Hello")
        assert (caught.value.message_id, caught.value.code) == (INPUT, code)
        assert TRIGGER not in box.ids
        assert (await camera.trigger(input=b"Hello")).value == b"found"


async def test_bid_input_that_nobody_acknowledges_sends_no_trigger() -> None:
    async with bid_by_hand() as (box, camera):
        box.script[INPUT] = quiet
        with pytest.raises(TriggerTimeoutError, match=r"no answer to SetInput .* no trigger was"):
            await camera.trigger(input=b"Hello", timeout=SHORT)
        assert TRIGGER not in box.ids


async def test_bid_set_input_waits_for_its_acknowledgement() -> None:
    async with bid_by_hand() as (box, camera):
        await camera.set_input(b"Hello")
        box.script[INPUT] = codes(box, INPUT, ERROR)
        with pytest.raises(CommandRejectedError) as caught:
            await camera.set_input(b"Hello")
        assert (caught.value.message_id, caught.value.code) == (INPUT, ERROR)


async def test_bid_clock_is_told_and_set() -> None:
    async with bid_by_hand() as (box, camera):
        assert await camera.get_clock() == datetime(2016, 6, 25, 10, 11, 12)  # noqa: DTZ001
        await camera.set_clock(datetime(2016, 3, 2, 12, 14, 10))  # noqa: DTZ001
        assert (await box.wait_for(SET_CLOCK)).hex() == "e0070300" + "02000c00" + "0e000a00"
        box.script[SET_CLOCK] = codes(box, SET_CLOCK, ERROR)
        with pytest.raises(CommandRejectedError, match="SetClock: the camera answered code 0x10"):
            await camera.set_clock(datetime(2016, 3, 2))  # noqa: DTZ001


# ---------------------------------------------------------------------- status on request


async def test_bid_query_status_asks_for_it() -> None:
    async with bid_by_hand() as (box, camera):
        box.status = BID_READY
        assert await camera.query_status() == Status.RUNNING
        box.status = 0
        assert await camera.query_status() == Status.RUNNING | Status.BUSY
        box.status = BID_IDLE | 0x0008
        assert await camera.query_status() == IDLE | Status.SIMULATION_MODE


@TRANSPORTS
async def test_bid_query_status_whose_answer_is_lost_asks_again(transport: str) -> None:
    async with bid_by_hand(box={"transport": transport}) as (box, camera):
        silences = iter([True, False])
        box.status = BID_READY
        before = box.script[STATUS]
        box.script[STATUS] = lambda payload: b"" if next(silences, False) else before(payload)
        assert await camera.query_status() == Status.RUNNING


@TRANSPORTS
async def test_bid_query_status_takes_no_answer_to_an_earlier_request(transport: str) -> None:
    async with bid_by_hand(box={"transport": transport}) as (box, camera):
        answer, late = box.script[STATUS], box.status_frame(BID_IDLE)
        box.script[STATUS] = quiet
        asked = box.ids.count(STATUS)
        earlier = asyncio.create_task(camera.query_status())
        await until(lambda: box.ids.count(STATUS) > asked)
        await cancelled(earlier)
        box.status = BID_READY
        lates = iter([late])  # the answer to the second request is lost
        box.script[STATUS] = lambda payload: next(lates, b"") or answer(payload)
        assert await camera.query_status() == Status.RUNNING


@pytest.mark.parametrize(
    "seed", [11, *(pytest.param(one, marks=pytest.mark.long) for one in range(10))]
)
async def test_bid_query_status_is_never_older_than_its_call(seed: int) -> None:
    """Answers are lost or come late, and calls are cancelled."""
    chance, late, codes = random.Random(seed), list[bytes](), [BID_IDLE]  # noqa: S311

    def arriving() -> bytes:
        arrived, late[:] = b"".join(late), []
        return arrived

    def answer(_: bytes) -> bytes:
        codes.append(chance.choice([one for one in STATUSES if one != codes[-1]]))
        frame, fate = box.said(STATUS, codes[-1]), chance.random()
        if fate > 0.5:
            return arriving() + frame
        late.extend([frame] * (fate > 0.2))
        return b""

    async with bid_by_hand(box={"transport": "udp"}) as (box, camera), camera.statuses():
        query = box.script[QUERY]
        box.script[STATUS] = answer
        box.script[QUERY] = lambda payload: (
            (arriving() if chance.random() < 0.5 else b"") + query(payload)
        )
        for _ in range(60):
            known = len(codes) - 1
            task = asyncio.create_task(camera.query_status())
            if chance.random() < 0.5:
                await steps(chance.randrange(12))
                task.cancel()
            status = (await asyncio.gather(task, return_exceptions=True))[0]
            if isinstance(status, Status):
                assert status in {STATUSES[code] for code in codes[known:]}


async def test_bid_wait_ready_asks_and_waits_within_one_timeout() -> None:
    async with bid_by_hand() as (box, camera):
        silences = iter([True] * 4)
        box.status = 0  # not Ready
        before = box.script[STATUS]
        box.script[STATUS] = lambda payload: b"" if next(silences, False) else before(payload)
        with pytest.raises(ResponseTimeoutError, match="for the camera to be ready") as caught:
            await camera.wait_ready(timeout=0.3)
        # the questions that were not answered took four pauses of it
        assert caught.value.waited < 0.3 - 3 * 0.02


async def test_bid_query_status_that_is_never_answered_is_a_timeout() -> None:
    async with bid_by_hand() as (box, camera):
        box.script[STATUS] = quiet
        with pytest.raises(ResponseTimeoutError, match="for the camera to tell its status"):
            await camera.query_status(timeout=2 * SHORT)
        assert camera.connected


async def test_bid_wait_status_sees_a_change_that_nobody_tells() -> None:
    async with bid_by_hand() as (box, camera):
        waiting = asyncio.create_task(camera.wait_status(lambda status: Status.BUSY in status))
        await until(lambda: box.ids.count(STATUS) > 3)
        box.status = 0
        assert await waiting == Status.RUNNING | Status.BUSY


async def test_bid_streams_see_changes_that_nobody_tells() -> None:
    async with bid_by_hand() as (box, camera):
        async with camera.statuses() as statuses, camera.events() as events:
            box.status = BID_READY
            async with asyncio.timeout(SOON):
                while await anext(statuses) != Status.RUNNING:
                    pass
                event = await anext(events)
        assert isinstance(event, StatusChanged)
        assert (event.previous, event.status) == (IDLE, Status.RUNNING)


async def test_bid_status_is_asked_for_only_while_somebody_wants_it() -> None:
    async with bid_by_hand() as (box, camera):
        with pytest.raises(ResponseTimeoutError):
            await camera.wait_status(lambda _: False, timeout=2 * SHORT)
        poll: Any = inside(camera)._status._polling
        await until(lambda: poll._timer is None)
        statuses = camera.statuses()
        assert poll._timer is not None
        statuses.close()
        await until(lambda: poll._timer is None)
        asked = box.ids.count(STATUS)
        await camera.query_application()
        assert box.ids.count(STATUS) == asked


@TRANSPORTS
async def test_bid_status_is_not_asked_for_again_while_a_trigger_asks(transport: str) -> None:
    """The answers say nothing of whose they are, so one question of a kind is open at a time."""
    async with bid_by_hand(box={"transport": transport}) as (box, camera):

        def take_and_say_no_more(_: bytes) -> bytes:
            box.script[STATUS] = lambda _: b""
            return box.said(TRIGGER, OK)

        box.script[TRIGGER] = take_and_say_no_more
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=2 * SHORT)
        behind = box.ids[box.ids.index(TRIGGER) :]
        assert behind.count(STATUS) == 1


async def test_bid_status_that_comes_by_itself_is_seen() -> None:
    async with bid_by_hand() as (box, camera):
        statuses = camera.statuses()
        box.report(BID_READY)
        async with asyncio.timeout(SOON):
            while await anext(statuses) != Status.RUNNING:
                pass


# ---------------------------------------------------------------------- requests by id


async def test_bid_request_gives_the_answers_body() -> None:
    async with bid_by_hand() as (box, camera):
        assert await camera.request(QUERY) == bytes.fromhex("0200 0700")
        assert await camera.request(STATUS) == bytes.fromhex("2100")
        box.script[0x77] = lambda payload: box.said(0x77, INVALID)
        assert await camera.request(0x77, b"\x01") == bytes.fromhex("1300")
        assert await camera.request(TRIGGER) == bytes.fromhex("0000")
        await until(lambda: camera.statistics().received == 1)
        assert camera.statistics().unclaimed == 1


async def test_bid_status_from_before_a_request_is_no_answer_to_it() -> None:
    """It was read, and is handed on when the request has gone out."""
    async with bid_by_hand() as (box, camera):
        older = box.status_frame(BID_READY)
        box.status = BID_IDLE
        hear(camera, older)
        newer = await camera.request(STATUS)
        assert newer == box.status.to_bytes(2, "little")
        assert newer != older[-2:]
        assert await camera.request(STATUS) == newer  # nothing is owed any more


# ---------------------------------------------------------------------- cancelling

BUSY_CALLS: dict[str, tuple[int, Callable[[Camera], Coroutine[Any, Any, object]]]] = {
    "trigger": (TRIGGER, lambda camera: camera.trigger()),
    "switch": (SWITCH, lambda camera: camera.switch_application(3)),
    "query": (QUERY, lambda camera: camera.query_application()),
}


@pytest.mark.parametrize("name", BUSY_CALLS)
async def test_bid_call_cancelled_between_two_tries_is_not_repeated(name: str) -> None:
    message_id, call = BUSY_CALLS[name]
    async with bid_by_hand() as (box, camera):
        before = box.script[message_id]
        values = {TRIGGER: [], SWITCH: [7], QUERY: [0]}[message_id]
        box.script[message_id] = lambda _: box.said(message_id, NOT_READY, *values)
        task = asyncio.create_task(call(camera))
        await box.wait_for(message_id, box.ids.count(message_id) + 2)
        await cancelled(task)
        box.script[message_id] = before
        assert (await camera.trigger()).value == b"found"
        assert await camera.query_application() == 7
        balance(camera.statistics())


UNANSWERED_CALLS: dict[str, tuple[int, Callable[[Camera], Coroutine[Any, Any, object]]]] = {
    "trigger": (TRIGGER, lambda camera: camera.trigger()),
    "trigger with input": (INPUT, lambda camera: camera.trigger(input=b"Hello")),
    "set_input": (INPUT, lambda camera: camera.set_input(b"Hello")),
    "reset_errors": (RESET, lambda camera: camera.reset_errors()),
    "query_status": (QUERY, lambda camera: camera.query_status()),
    "switch": (SWITCH, lambda camera: camera.switch_application(3)),
}


@pytest.mark.parametrize("name", UNANSWERED_CALLS)
async def test_bid_call_cancelled_before_its_answer_leaves_it_owed(name: str) -> None:
    message_id, call = UNANSWERED_CALLS[name]
    async with bid_by_hand() as (box, camera):
        before = box.script[message_id]
        held: list[bytes] = []

        def hold(payload: bytes) -> bytes:
            held.append(payload)
            return b""

        box.script[message_id] = hold
        task = asyncio.create_task(call(camera))
        await box.wait_for(message_id, box.ids.count(message_id) + 1)
        await steps(5)
        await cancelled(task)
        box.script[message_id] = before
        again = asyncio.create_task(call(camera))
        await steps(20)
        assert not again.done()
        box.send(before(held[0]))
        await again
        assert (await camera.trigger()).value == b"found"
        assert camera.statistics().unexpected_messages == 0
        balance(camera.statistics())


# ---------------------------------------------------------------------- silence, reconnect


@TRANSPORTS
async def test_bid_silent_camera_is_found_without_any_call(transport: str) -> None:
    async with bid_by_hand(box={"transport": transport}, liveness_timeout=4 * SHORT) as (
        box,
        camera,
    ):
        events = camera.events()
        box.script = {}
        async with asyncio.timeout(SOON):
            event = await anext(events)
        assert isinstance(event, Disconnected)
        assert "no sign of life for" in event.reason


async def test_bid_quiet_camera_that_answers_is_kept() -> None:
    async with bid_by_hand(liveness_timeout=2 * SHORT) as (box, camera):
        await box.wait_for(QUERY, 4)
        assert camera.connected


@pytest.mark.usefixtures("never_taken")
async def test_bid_next_session_asks_for_the_status_too() -> None:
    async with bid_by_hand(reconnect=FAST) as (box, camera):
        events, statuses = camera.events(), camera.statuses()
        box.status = BID_READY
        await lose_and_come_back(box, camera)
        assert camera.status == Status.RUNNING
        box.status = BID_IDLE
        assert (await camera.trigger()).value == b"found"
        async with asyncio.timeout(SOON):
            while await anext(statuses) != IDLE:
                pass
            while not isinstance(await anext(events), Reconnected):
                pass


async def test_bid_link_lost_under_a_trigger_is_told() -> None:
    async with bid_by_hand() as (box, camera):
        box.script[TRIGGER] = quiet
        waiting = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        box.hang_up()
        assert isinstance(await gone(waiting), ConnectionLostError)


async def test_bid_close_says_disconnect_and_takes_its_answer() -> None:
    async with HandmadeBid() as box:
        async with smartcam.connect(box.url) as camera:
            await camera.trigger()
        assert box.ids[-1] == DISCONNECT
        assert camera.statistics().unexpected_messages == 0
