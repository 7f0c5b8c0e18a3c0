"""The same client over datagrams: what is broken is dropped and counted, what is lost times out."""

from __future__ import annotations

import asyncio
import socket
import struct
from datetime import datetime

import pytest

import smartcam
from smartcam import (
    ConnectFailedError,
    ConnectionLostError,
    NotRunningError,
    ResponseTimeoutError,
    Status,
    TriggerTimeoutError,
)
from smartcam.emulator import EmulatedCamera, faults
from smartcam.protocols import messages as m
from tests.client.camera_by_hand import (
    BUSY,
    CONNECT,
    DISCONNECT,
    GET_CLOCK,
    HANDBOOK,
    INPUT,
    QUERY,
    READY,
    RESULT,
    RUNNING,
    START,
    STATUS,
    STOP,
    SWITCH,
    THESIS,
    TRIGGER,
    HandmadeCamera,
    words,
)
from tests.client.clientkit import SHORT, balance, by_hand, cancelled, emulated
from tests.handmade import until

DIALECTS = pytest.mark.parametrize("dialect", ["handbook", "thesis"])
UDP = {"transport": "udp"}


@DIALECTS
async def test_session_over_udp_does_everything(dialect: str) -> None:
    box_options = {"transport": "udp", "dialect": dialect, "active": 1}
    async with by_hand(box=box_options, application=7) as (box, camera):
        assert box.ids == [DISCONNECT, CONNECT, QUERY, QUERY, STOP, SWITCH, START]
        assert camera.url == box.url
        assert (await camera.trigger(input=b"part")).raw == b"found"
        assert box.received[-2:] == [(INPUT, b"part"), (TRIGGER, b"")]
        assert (await camera.trigger(3)).application == 3
        assert await camera.get_clock() == datetime(2016, 6, 25, 10, 11, 12)  # noqa: DTZ001
        assert (camera.active_application, camera.status) == (7, Status(READY))
        balance(camera.statistics())
    assert not camera.connected


@DIALECTS
async def test_session_over_udp_with_the_emulator_does_everything(dialect: str) -> None:
    box = {"transport": "udp", "dialect": dialect, "running": True, "active": 1}
    async with emulated(box=box, interpret_as={1: "strings50", 3: "raw"}) as found:
        emulator, clock, camera = found
        triggering = asyncio.create_task(camera.trigger())
        await emulator.wait_received(m.Trigger)
        clock.advance(0.05)
        assert (await triggering).value[0] == "a short text"
        switching = asyncio.create_task(camera.switch_application(3))
        await emulator.wait_received(m.SwitchApplication)
        clock.advance(0.3)
        await switching
        assert emulator.device.running
    await until(lambda: not emulator.has_session)


async def test_session_over_udp_says_disconnect_before_it_closes() -> None:
    async with by_hand(box=UDP) as (box, camera):
        await camera.close()
        await box.wait_for(DISCONNECT, 2)
        assert box.ids == [DISCONNECT, CONNECT, QUERY, DISCONNECT]


async def test_dialect_over_udp_is_found_out() -> None:
    async with EmulatedCamera(transport="udp", dialect="thesis") as emulator:
        url = emulator.url.partition("?")[0]
        async with smartcam.connect(url, connect_timeout=0.6) as camera:
            assert camera.url == emulator.url


async def test_load_that_ends_while_a_session_is_made_is_asked_about_in_the_session() -> None:
    """Take what came before for the old session's, the answer to its Query included."""
    async with HandmadeCamera(transport="udp") as box:
        told = iter([3])
        box.script[QUERY] = lambda _: box.said(QUERY, next(told, box.active))
        box.script[CONNECT] = lambda _: (
            box.said(CONNECT, 1) + box.status_frame(BUSY) + box.status_frame(READY)
        )
        async with smartcam.connect(box.url) as camera:
            assert await camera.query_application() == 7
            assert camera.active_application == 7
            assert (await camera.trigger()).application == 7
            assert camera.statistics().unexpected_messages == 0


async def test_every_frame_over_udp_is_a_datagram() -> None:
    async with by_hand(box=UDP) as (box, camera):
        results = camera.results()
        box.send(b"".join(box.result_frame(bytes([number])) for number in range(3)))
        assert [(await anext(results)).raw for _ in range(3)] == [b"\0", b"\1", b"\2"]


GARBAGE = {
    "short": b"PSVB",
    "other magic": THESIS + words(4, TRIGGER),
    "cut": HANDBOOK + words(8, STATUS) + words(READY),
    "trailing": HANDBOOK + words(8, STATUS) + words(0, 0) + b"?",
    "two frames": 2 * (HANDBOOK + words(8, STATUS) + words(0, 0)),
    "endless": HANDBOOK + words(0xFFFFFFFF, RESULT),
    "short body": HANDBOOK + words(4, STATUS) + words(0),
    "no result": HANDBOOK + words(2, RESULT) + b"??",
}


@pytest.mark.parametrize("data", GARBAGE.values(), ids=GARBAGE.keys())
async def test_garbage_over_udp_is_ignored_and_counted(data: bytes) -> None:
    async with by_hand(box=UDP) as (box, camera):
        box.send_datagram(data)
        assert (await camera.trigger()).raw == b"found"
        await camera.get_clock()
        assert camera.statistics().ignored_datagrams == 1
        assert camera.status == Status(READY)


async def test_answer_to_connect_over_udp_that_comes_twice_is_counted_only() -> None:
    async with by_hand(box=UDP) as (box, camera):
        box.send(box.said(CONNECT, 1))
        assert (await camera.trigger()).raw == b"found"
        statistics = camera.statistics()
        assert statistics.ignored_datagrams + statistics.unexpected_messages == 1


async def test_answer_over_udp_that_comes_twice_is_used_once() -> None:
    async with by_hand(box=UDP) as (box, camera):
        box.script[QUERY] = lambda _: 2 * box.said(QUERY, 7)
        assert await camera.query_application() == 7
        await camera.get_clock()
        assert camera.statistics().unexpected_messages == 1


async def test_answer_over_udp_that_is_lost_gives_the_link_up() -> None:
    async with by_hand(box=UDP, request_timeout=SHORT) as (box, camera):
        box.script[GET_CLOCK] = lambda _: b""
        with pytest.raises(ResponseTimeoutError, match=r"no answer to GetClock \(0x32\)"):
            await camera.get_clock()
        with pytest.raises(ConnectionLostError):
            await camera.get_clock()
        await box.wait_for(DISCONNECT, 2)


async def test_result_over_udp_that_is_lost_times_out_and_the_next_one_is_its_own() -> None:
    async with by_hand(box=UDP) as (box, camera):
        trigger, box.script[TRIGGER] = box.script[TRIGGER], lambda _: b""
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=SHORT)
        box.script[TRIGGER] = trigger
        mark = len(box.ids)
        assert (await camera.trigger()).raw == b"found"
        asked_for_status = [QUERY, CONNECT, QUERY]
        assert box.since(mark) == [*asked_for_status, STOP, QUERY, START, TRIGGER]


async def test_trigger_over_udp_cancelled_owes_a_result() -> None:
    box = {"transport": "udp", "running": True, "active": 21}
    async with emulated(box=box) as (emulator, clock, camera):
        triggering = asyncio.create_task(camera.trigger())
        await emulator.wait_received(m.Trigger)
        await cancelled(triggering)
        clock.advance(0.05)
        await camera.query_application()
        assert camera.statistics().late == 1


async def test_camera_over_udp_that_is_gone_is_noticed_by_what_is_sent() -> None:
    async with by_hand(box=UDP) as (box, camera):
        waiting = asyncio.create_task(camera.wait_status(lambda _: False))
        box.vanish()
        await until(lambda: not box.peers)
        with pytest.raises((ConnectionLostError, ResponseTimeoutError)):
            await camera.get_clock(timeout=1)
        with pytest.raises(ConnectionLostError) as caught:
            await waiting
        assert isinstance(caught.value.__cause__, ConnectionRefusedError)


async def test_nobody_at_a_udp_port_fails_to_connect() -> None:
    async with EmulatedCamera(transport="udp") as emulator:
        url = emulator.url
    with pytest.raises(ConnectFailedError, match=r"nothing listens at .* \(UDP\)"):
        await smartcam.connect(url, connect_attempts=2, connect_timeout=1)


async def test_newcomer_over_udp_takes_the_session() -> None:
    async with (
        EmulatedCamera(transport="udp", running=True, active=21) as emulator,
        smartcam.connect(emulator.url) as first,
        smartcam.connect(emulator.url) as second,
    ):
        assert (await second.trigger()).raw == struct.pack("20s", b"Hello World")
        with pytest.raises(TriggerTimeoutError):
            await first.trigger(timeout=SHORT)


async def test_status_that_is_lost_is_said_again() -> None:
    async with by_hand(box={"transport": "udp"}) as (box, camera):
        usual = box.script[TRIGGER]
        box.script[TRIGGER] = lambda _: box.status_frame(RUNNING) + box.result_frame(b"first")
        assert (await camera.trigger()).raw == b"first"
        box.script[TRIGGER] = usual
        box.status = READY  # its datagram was lost
        assert (await camera.trigger(timeout=4 * SHORT)).raw == b"found"
        assert box.ids[-3:] == [QUERY, CONNECT, TRIGGER]


async def test_status_that_is_lost_is_not_asked_for_where_the_session_is_gone() -> None:
    async with by_hand(box={"transport": "udp"}) as (box, camera):
        box.send(box.status_frame(RUNNING))
        await camera.wait_status(lambda status: Status.WAITING_FOR_TRIGGER not in status)
        box.script[QUERY] = lambda _: b""
        with pytest.raises(TriggerTimeoutError, match="did not wait for a trigger"):
            await camera.trigger(timeout=2 * SHORT)
        assert box.ids.count(CONNECT) == 1


async def test_answer_to_the_connect_that_asks_for_a_status_may_be_lost_once() -> None:
    async with by_hand(box={"transport": "udp"}) as (box, camera):
        box.send(box.status_frame(RUNNING))
        await camera.wait_status(lambda status: Status.WAITING_FOR_TRIGGER not in status)
        box.script[CONNECT] = lambda _: b""
        for error in (TriggerTimeoutError, ConnectionLostError):
            with pytest.raises(error):
                await camera.trigger(timeout=2 * SHORT)


async def test_stop_whose_status_is_lost_is_noticed_after_a_trigger_without_a_result() -> None:
    async with by_hand(box={"transport": "udp"}) as (box, camera):
        box.status = 0  # its datagram was lost
        box.script[TRIGGER] = lambda _: b""
        with pytest.raises(TriggerTimeoutError, match="no result"):
            await camera.trigger(timeout=SHORT)
        with pytest.raises(NotRunningError):
            await camera.trigger(timeout=1)
        assert START not in box.ids
        assert box.ids.count(TRIGGER) == 1


@pytest.mark.parametrize(
    "fault", [faults.Drop(on="TriggerAnswer"), faults.Delay(on="TriggerAnswer", seconds=0.2)]
)
async def test_result_comes_where_the_answer_to_its_trigger_is_lost_or_late(
    fault: faults.Drop | faults.Delay,
) -> None:
    box = EmulatedCamera(
        [{"id": 5, "layout": "n: int32", "generator": "sequence", "processing_time": 0.05}],
        dialect="bid",
        transport="udp",
        faults=[fault],
    )
    async with box, smartcam.connect(box.url, application=5, interpret_as="n: int32") as camera:
        assert (await camera.trigger(timeout=1.0)).value.n == 0
        assert camera.statistics().unclaimed == 0


async def test_datagrams_of_strangers_are_nothing_to_the_camera_by_hand() -> None:
    """Another test may have had its port before: what still comes for that one changes nothing."""
    async with by_hand(box=UDP) as (box, camera):
        before = list(box.received)
        with socket.socket(type=socket.SOCK_DGRAM) as stranger:
            for data in (b"\x80\xc9\x00\x01" * 7, b"", box.frame(TRIGGER)):
                stranger.sendto(data, ("127.0.0.1", box.port))
            assert (await camera.trigger()).raw == b"found"
            assert box.received == [*before, (TRIGGER, b"")]
