"""A camera that is gone and nobody said so; mostly in a time that leaps."""

from __future__ import annotations

import asyncio
import contextlib
import re
import socket
from collections.abc import AsyncIterator
from typing import Any

import pytest

import smartcam
from smartcam import (
    ApplicationChanged,
    Backoff,
    Camera,
    ConnectionLostError,
    Disconnected,
    Reconnected,
    ResponseTimeoutError,
    Status,
)
from tests.client.camera_by_hand import (
    BUSY,
    CONNECT,
    DISCONNECT,
    GET_CLOCK,
    QUERY,
    READY,
    RUNNING,
    START,
    STOP,
    SWITCH,
    TRIGGER,
    HandmadeCamera,
)
from tests.client.clientkit import SHORT, by_hand, gone, quiet, steps
from tests.handmade import until
from tests.insides import inside

LIVENESS, HALF, END = 1000.0, 500.0, 1500.0
"""Seconds of the time that leaps: a Query after half of it, the end after all of it from then."""

SWITCHING = 3000.0
"""Seconds of the time that leaps: ``switch_timeout``."""

JUST = 20.0
"""Seconds just before something: real time goes on between two leaps."""

LONG = 80_000.0

TRANSPORTS = pytest.mark.parametrize("transport", ["tcp", "udp"])


class LeapingTime:
    """The loop's time, which leaps to where :meth:`at` says: seconds since the camera was heard."""

    def __init__(self, camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
        loop = asyncio.get_running_loop()
        self._real = loop.time
        self._begin = inside(camera)._connection.require_link().last_byte_at
        self._ahead = 0.0
        monkeypatch.setattr(loop, "time", lambda: self._real() + self._ahead)

    async def at(self, seconds: float) -> None:
        """Leap, and let happen what then does."""
        self._ahead = self._begin + seconds - self._real()
        await steps(10)


@contextlib.asynccontextmanager
async def leaping(
    monkeypatch: pytest.MonkeyPatch, *, box: dict[str, Any] | None = None, **options: Any
) -> AsyncIterator[tuple[HandmadeCamera, Camera, LeapingTime]]:
    """A handmade camera and a client, whose time leaps from then on."""
    options = {"liveness_timeout": LIVENESS, "switch_timeout": SWITCHING, **options}
    async with by_hand(box=box, **options) as (made, camera):
        with monkeypatch.context() as patch:
            yield made, camera, LeapingTime(camera, patch)


def queries(box: HandmadeCamera) -> int:
    """Return how many came after the one of the handshake."""
    return box.ids.count(QUERY) - 1


async def heard(camera: Camera, box: HandmadeCamera, data: bytes) -> None:
    """Send bytes and wait until the client has them."""
    link = inside(camera)._connection.require_link()
    before = link.machine.counters.bytes_received
    box.send(data)
    await until(lambda: link.machine.counters.bytes_received == before + len(data))


# ---------------------------------------------------------------------- in real time


@TRANSPORTS
async def test_silent_camera_is_found_without_any_call(transport: str) -> None:
    async with by_hand(box={"transport": transport}, liveness_timeout=2 * SHORT) as (box, camera):
        events = camera.events()
        box.script[QUERY] = quiet
        begin = inside(camera)._connection.require_link().last_byte_at
        async with asyncio.timeout(5):
            event = await anext(events)
        waited = asyncio.get_running_loop().time() - begin
        assert isinstance(event, Disconnected)
        assert re.fullmatch(r"no sign of life for \d\.\d s", event.reason)
        assert not event.expected
        assert waited >= 3 * SHORT * 0.9
        await box.wait_for(DISCONNECT, 2)
        assert box.ids == [DISCONNECT, CONNECT, QUERY, QUERY, DISCONNECT]


@TRANSPORTS
async def test_silent_camera_is_reconnected_to_when_it_speaks_again(transport: str) -> None:
    options: dict[str, Any] = {"liveness_timeout": 2 * SHORT, "reconnect": Backoff(initial=0.001)}
    async with by_hand(box={"transport": transport}, **options) as (box, camera):
        events = camera.events()
        query, box.script[QUERY] = box.script[QUERY], quiet
        await box.wait_for(QUERY, 2)
        await until(lambda: not camera.connected)
        box.script[QUERY] = query
        assert isinstance(await anext(events), Disconnected)
        assert isinstance(await anext(events), Reconnected)
        assert (await camera.trigger()).raw == b"found"


@TRANSPORTS
async def test_silence_is_the_cause_that_who_waits_is_told(transport: str) -> None:
    async with by_hand(box={"transport": transport}, liveness_timeout=2 * SHORT) as (box, camera):
        box.script |= {QUERY: quiet, GET_CLOCK: quiet}
        errors = await asyncio.gather(
            camera.get_clock(), camera.next_result(), return_exceptions=True
        )
        for error in errors:
            assert isinstance(error, ConnectionLostError)
            assert isinstance(error.__cause__, TimeoutError)
            assert not isinstance(error.__cause__, ResponseTimeoutError)


# ---------------------------------------------------------------------- one question, then the end


@TRANSPORTS
async def test_query_is_sent_after_half_the_time_and_has_all_of_it_for_its_answer(
    transport: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with leaping(monkeypatch, box={"transport": transport}) as (box, camera, time):
        box.script[QUERY] = quiet
        await time.at(HALF - JUST)
        assert queries(box) == 0
        await time.at(HALF)
        await box.wait_for(QUERY, 2)
        await time.at(LIVENESS)
        await time.at(END - JUST)
        assert camera.connected
        await time.at(END)
        assert not camera.connected
        assert queries(box) == 1


@TRANSPORTS
async def test_answer_keeps_the_link(transport: str, monkeypatch: pytest.MonkeyPatch) -> None:
    async with leaping(monkeypatch, box={"transport": transport}) as (box, camera, time):
        for count in range(1, 6):
            await time.at(count * (HALF + JUST))
            await box.wait_for(QUERY, count + 1)
            await until(lambda: not inside(camera)._waits.pending_answers)
        await time.at(5 * (HALF + JUST) + HALF - JUST)
        assert camera.connected
        assert queries(box) == 5
        assert camera.statistics().round_trip.count == 5


async def test_answer_in_the_last_moment_keeps_the_link(monkeypatch: pytest.MonkeyPatch) -> None:
    async with leaping(monkeypatch) as (box, camera, time):
        query, box.script[QUERY] = box.script[QUERY], quiet
        await time.at(HALF)
        await box.wait_for(QUERY, 2)
        await time.at(END - JUST)
        await heard(camera, box, query(b""))
        await time.at(END + HALF - 2 * JUST)
        assert camera.connected
        assert queries(box) == 1
        await time.at(END + HALF)
        await box.wait_for(QUERY, 3)


@pytest.mark.parametrize("begin", [0.0, 0.25, 0.45])
async def test_stall_that_is_shorter_than_the_timeout_ends_no_idle_session(
    begin: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stall that begins any time between two questions; the camera answers behind it."""
    async with leaping(monkeypatch) as (box, camera, time):
        answer, box.script[QUERY] = box.script[QUERY], quiet
        stall = begin * LIVENESS, begin * LIVENESS + 0.9 * LIVENESS
        moment = HALF
        while moment < stall[1]:
            await time.at(moment)
            moment += HALF / 2
        await box.wait_for(QUERY, 2)
        await time.at(stall[1])
        assert camera.connected
        await heard(camera, box, answer(b""))
        box.script[QUERY] = answer
        await time.at(stall[1] + HALF + JUST)
        await box.wait_for(QUERY, 3)
        assert camera.connected


SIGNS_OF_LIFE = {
    "status": lambda box: box.status_frame(READY),
    "result": lambda box: box.result_frame(),
    "unknown message": lambda box: box.frame(0x77, b"?"),
    "piece of a frame": lambda box: box.result_frame()[:3],
}


@pytest.mark.parametrize("name", SIGNS_OF_LIFE)
async def test_any_byte_puts_the_question_off(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    async with leaping(monkeypatch) as (box, camera, time):
        await time.at(300.0)
        await heard(camera, box, SIGNS_OF_LIFE[name](box))
        await time.at(HALF)
        await time.at(300.0 + HALF - JUST)
        assert queries(box) == 0
        await time.at(300.0 + HALF)
        await box.wait_for(QUERY, 2)


async def test_camera_that_keeps_talking_is_never_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    async with leaping(monkeypatch) as (box, camera, time):
        for count in range(1, 10):
            await time.at(count * (HALF - JUST))
            await heard(camera, box, box.status_frame(READY))
        assert camera.connected
        assert queries(box) == 0


async def test_byte_after_the_question_keeps_the_link_and_it_is_not_asked_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with leaping(monkeypatch) as (box, camera, time):
        box.script[QUERY] = quiet
        await time.at(HALF)
        await box.wait_for(QUERY, 2)
        await time.at(700.0)
        await heard(camera, box, box.status_frame(READY))
        await time.at(LIVENESS)
        await time.at(700.0 + HALF + JUST)
        await time.at(700.0 + END)
        assert camera.connected
        assert queries(box) == 1
        await time.at(700.0 + END + 2 * JUST)
        assert not camera.connected


async def test_answer_within_the_same_tick_of_a_coarse_clock_keeps_the_link(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Windows' clock ticks every 16 ms: question and answer then have the same time."""
    async with leaping(monkeypatch) as (box, camera, time):
        loop, heard_at = (
            asyncio.get_running_loop(),
            inside(camera)._connection.require_link().last_byte_at,
        )
        with monkeypatch.context() as standing:
            standing.setattr(loop, "time", lambda: heard_at + HALF)
            await steps(100)
            assert queries(box) == 1
            assert inside(camera)._connection.require_link().last_byte_at == heard_at + HALF
        await time.at(LIVENESS)
        assert camera.connected
        await time.at(LIVENESS + JUST)
        await box.wait_for(QUERY, 3)


async def test_answer_tells_an_application_that_somebody_switched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with leaping(monkeypatch) as (box, camera, time):
        events = camera.events()
        box.active = 3
        await time.at(HALF)
        event = await anext(events)
        assert isinstance(event, ApplicationChanged)
        assert (event.previous, event.application) == (7, 3)


# ---------------------------------------------------------------------- beside the user's


async def test_users_open_query_is_question_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    async with leaping(monkeypatch) as (box, camera, time):
        box.script[QUERY] = quiet
        asking = asyncio.create_task(camera.query_application(timeout=LONG))
        await box.wait_for(QUERY, 2)
        await time.at(HALF)
        await time.at(END - JUST)
        assert queries(box) == 1
        assert not asking.done()
        await time.at(END)
        assert isinstance(await gone(asking), ConnectionLostError)


async def test_users_query_at_the_same_moment_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    async with leaping(monkeypatch) as (box, camera, time):
        query, box.script[QUERY] = box.script[QUERY], quiet
        await time.at(HALF)
        await box.wait_for(QUERY, 2)
        asking = [asyncio.create_task(camera.query_application()) for _ in range(2)]
        await steps(10)
        assert queries(box) == 1  # ours is open: theirs wait
        box.script[QUERY] = query
        box.active = 3
        box.send(box.said(QUERY, 7))
        assert [await one for one in asking] == [3, 3]
        assert queries(box) == 3
        assert camera.connected


async def test_users_query_too_short_for_the_open_question_leaves_the_link(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with leaping(monkeypatch) as (box, camera, time):
        query, box.script[QUERY] = box.script[QUERY], quiet
        await time.at(HALF)
        await box.wait_for(QUERY, 2)
        asking = asyncio.create_task(camera.query_application(timeout=JUST))
        await steps(5)
        await time.at(HALF + JUST)
        with pytest.raises(ResponseTimeoutError, match="an earlier answer is owed"):
            await asking
        assert camera.connected
        await heard(camera, box, query(b""))
        box.script[QUERY] = query
        assert await camera.query_application() == 7


async def test_trigger_without_a_result_is_no_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    """A long inspection: the camera says nothing, but it answers."""
    async with leaping(monkeypatch) as (box, camera, time):
        box.script[TRIGGER] = lambda _: box.status_frame(RUNNING)
        triggering = asyncio.create_task(camera.trigger(timeout=LONG))
        await until(lambda: camera.status == Status.RUNNING)
        for count in range(1, 8):
            await time.at(count * (HALF + JUST))
            await box.wait_for(QUERY, count + 1)
            await until(lambda: not inside(camera)._waits.pending_answers)
        box.send(box.result_frame() + box.status_frame(READY))
        assert (await triggering).raw == b"found"


# ---------------------------------------------------------------------- while it loads


async def test_own_switch_is_left_in_peace_until_its_timeout(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with leaping(monkeypatch, box={"status": 0}) as (box, camera, time):
        box.script |= {SWITCH: quiet, QUERY: quiet}
        switching = asyncio.create_task(camera.switch_application(3, timeout=LONG))
        await box.wait_for(SWITCH)
        for seconds in (HALF, LIVENESS, SWITCHING - JUST):
            await time.at(seconds)
        assert queries(box) == 0
        assert camera.connected
        await time.at(SWITCHING)
        await box.wait_for(QUERY, 2)
        await time.at(SWITCHING + LIVENESS - JUST)
        assert camera.connected
        await time.at(SWITCHING + LIVENESS + JUST)
        assert isinstance(await gone(switching), ConnectionLostError)


async def test_own_switch_that_takes_its_time_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    async with leaping(monkeypatch) as (box, camera, time):
        switch, box.script[SWITCH] = box.script[SWITCH], quiet
        switching = asyncio.create_task(camera.switch_application(3))
        payload = await box.wait_for(SWITCH)
        for seconds in (HALF, LIVENESS, SWITCHING - JUST):
            await time.at(seconds)
        box.send(switch(payload))
        await switching
        assert queries(box) == 0
        assert box.since(3) == [STOP, SWITCH, START]


@TRANSPORTS
async def test_somebody_elses_switch_is_left_in_peace(
    transport: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with leaping(monkeypatch, box={"transport": transport}) as (box, camera, time):
        box.script[QUERY] = quiet
        await heard(camera, box, box.status_frame(BUSY))
        await until(lambda: camera.status == Status.BUSY)
        for seconds in (HALF, LIVENESS, 2 * LIVENESS, SWITCHING - JUST):
            await time.at(seconds)
        assert queries(box) == 0
        assert camera.connected
        await time.at(SWITCHING)
        await box.wait_for(QUERY, 2)
        await time.at(SWITCHING + LIVENESS + JUST)
        assert not camera.connected


async def test_load_that_is_over_is_asked_after_again(monkeypatch: pytest.MonkeyPatch) -> None:
    async with leaping(monkeypatch) as (box, camera, time):
        await heard(camera, box, box.status_frame(BUSY))
        await time.at(HALF)
        await time.at(1200.0)
        await heard(camera, box, box.status_frame(READY))
        await box.wait_for(QUERY, 2)  # which application is active now?
        await until(lambda: not inside(camera)._waits.pending_answers)
        await time.at(1200.0 + HALF - JUST)
        assert queries(box) == 1
        await time.at(1200.0 + HALF)
        await box.wait_for(QUERY, 3)


async def test_load_that_begins_while_the_question_is_open_is_left_in_peace(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with leaping(monkeypatch) as (box, camera, time):
        box.script[QUERY] = quiet
        await time.at(HALF)
        await box.wait_for(QUERY, 2)
        await heard(camera, box, box.status_frame(BUSY))
        for seconds in (LIVENESS, 2 * LIVENESS, SWITCHING):
            await time.at(seconds)
        assert camera.connected
        assert queries(box) == 1


async def test_busy_camera_that_runs_is_asked_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    async with leaping(monkeypatch, box={"status": BUSY | RUNNING}) as (box, _, time):
        await time.at(HALF)
        await box.wait_for(QUERY, 2)


# ---------------------------------------------------------------------- off, options, timers


def looks() -> list[asyncio.TimerHandle]:
    """Return the timers of watches that are set."""
    loop: Any = asyncio.get_running_loop()
    timers: list[asyncio.TimerHandle] = loop._scheduled
    return [one for one in timers if not one.cancelled() and "_Watch.check_link" in repr(one)]


async def test_no_timeout_turns_it_off(monkeypatch: pytest.MonkeyPatch) -> None:
    async with leaping(monkeypatch, liveness_timeout=None) as (box, camera, time):
        assert looks() == []
        for seconds in (HALF, LIVENESS, LONG):
            await time.at(seconds)
        assert camera.connected
        assert queries(box) == 0


async def test_one_timer_is_set_and_none_is_left_after_close() -> None:
    async with by_hand() as (_, camera):
        assert len(looks()) == 1
        await camera.close()
        assert looks() == []


async def test_one_timer_is_set_in_each_session_and_none_between() -> None:
    async with by_hand(reconnect=Backoff(initial=0.001)) as (box, camera):
        connect, box.script[CONNECT] = box.script[CONNECT], quiet
        box.hang_up()
        await box.wait_for(CONNECT, 2)
        assert looks() == []
        box.script[CONNECT] = connect
        box.send(connect(b""))
        await camera.wait_connected(5)
        assert len(looks()) == 1


def option(camera: Camera, level: int, name: str) -> int:
    transport = inside(camera)._connection.require_link()._transport
    found: int = transport.get_extra_info("socket").getsockopt(level, getattr(socket, name))
    return found


@pytest.mark.parametrize(("timeout", "probe"), [(5.0, 2), (30.0, 10), (0.5, 1), (86_400.0, 28_800)])
async def test_system_is_told_to_look_too(timeout: float, probe: int) -> None:
    async with by_hand(liveness_timeout=timeout) as (_, camera):
        assert option(camera, socket.SOL_SOCKET, "SO_KEEPALIVE") == 1
        expected = {
            "TCP_KEEPIDLE": probe,
            "TCP_KEEPINTVL": probe,
            "TCP_KEEPCNT": 2,
            "TCP_USER_TIMEOUT": round(timeout * 1000),
            "TCP_NODELAY": 1,
        }
        for name, value in expected.items():
            if hasattr(socket, name):
                assert option(camera, socket.IPPROTO_TCP, name) == value, name


async def test_system_is_not_told_where_it_is_off() -> None:
    async with by_hand(liveness_timeout=None) as (_, camera):
        assert option(camera, socket.SOL_SOCKET, "SO_KEEPALIVE") == 0
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            assert option(camera, socket.IPPROTO_TCP, "TCP_USER_TIMEOUT") == 0


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("nan"), float("inf")])
def test_timeout_that_is_no_number_of_seconds_is_refused(timeout: float) -> None:
    with pytest.raises(smartcam.ConfigurationError, match="liveness_timeout"):
        smartcam.connect("bvs://12700.0.0.1", liveness_timeout=timeout)
