"""Opening and closing a session, and how it is lost."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

import smartcam
from smartcam import (
    ApplicationChanged,
    Camera,
    CameraEvent,
    CommandRejectedError,
    ConfigurationError,
    Connected,
    ConnectFailedError,
    ConnectionClosedError,
    ConnectionLostError,
    Disconnected,
    FrameError,
    LocalProtocolError,
    ResponseTimeoutError,
    Status,
    StatusChanged,
)
from tests.client.camera_by_hand import (
    CONNECT,
    DISCONNECT,
    GET_CLOCK,
    QUERY,
    READY,
    RUNNING,
    START,
    STATUS,
    STOP,
    SWITCH,
    THESIS,
    TRIGGER,
    WAITING,
    HandmadeCamera,
    Peer,
)
from tests.client.clientkit import SHORT, by_hand, cancelled, emulated, gone, steps
from tests.handmade import until
from tests.insides import inside

TCP_DIALECTS = ["handbook", "thesis"]


# ---------------------------------------------------------------------- opening and closing


@pytest.mark.parametrize("dialect", TCP_DIALECTS)
async def test_session_of_either_dialect_begins_and_ends_with_disconnect(dialect: str) -> None:
    async with by_hand(box={"dialect": dialect}) as (box, camera):
        assert camera.connected
        assert (camera.status, camera.active_application) == (Status(READY), 7)
        assert camera.protocol_version == 1
    await box.wait_for(DISCONNECT, 2)
    assert box.received == [(DISCONNECT, b""), (CONNECT, b""), (QUERY, b""), (DISCONNECT, b"")]
    assert not camera.connected


async def test_connect_awaited_gives_an_open_camera() -> None:
    async with HandmadeCamera() as box:
        camera = await smartcam.connect(box.url)
        assert camera.connected
        await camera.close()
        await box.wait_for(DISCONNECT, 2)


async def test_dialect_not_named_is_found_out_and_pinned(monkeypatch: pytest.MonkeyPatch) -> None:
    async with HandmadeCamera(dialect="thesis") as box:
        monkeypatch.setattr(box, "arrive", _tolerant(box))
        url = box.url.partition("?")[0]
        async with smartcam.connect(url, connect_timeout=1.0, connect_attempts=2) as camera:
            assert camera.url == f"{url}?dialect=thesis"
            assert repr(camera) == f"<SmartCamera 127.0.0.1:{box.port} {camera.url}>"


def _tolerant(box: HandmadeCamera) -> Callable[[Peer, bytes], None]:
    """Ignore what begins with the other dialect's magic number, as a camera does."""
    take = box.arrive
    return lambda peer, data: take(peer, data) if data.startswith(THESIS) else None


def test_camera_before_open_knows_nothing() -> None:
    camera = smartcam.connect("192.168.0.10", model="BVS002C", name="press 4")
    assert camera.name == "press 4"
    assert camera.url == "bvs://192.168.0.10:36701"
    assert (camera.connected, camera.active_application, camera.protocol_version) == (
        False,
        None,
        None,
    )
    with pytest.raises(ConnectionClosedError, match="press 4: the connection is not opened yet"):
        _ = camera.status
    assert camera.statistics().sessions == 0


async def test_command_before_open_raises() -> None:
    camera = smartcam.connect("bvs://127.0.0.1")
    with pytest.raises(ConnectionClosedError, match="not connected: open it first"):
        await camera.trigger()


async def test_open_twice_is_refused_and_the_session_goes_on() -> None:
    async with by_hand() as (_, camera):
        with pytest.raises(LocalProtocolError, match="opened or closed before; make a new one"):
            await camera.open()
        assert await camera.query_application() == 7


async def test_open_after_close_is_refused() -> None:
    async with by_hand() as (box, camera):
        await camera.close()
        with pytest.raises(LocalProtocolError, match="make a new one"):
            await camera.open()
    assert box.connections == 1


async def test_open_after_close_without_a_session_is_refused() -> None:
    async with HandmadeCamera() as box:
        camera = smartcam.connect(box.url)
        await camera.close()
        with pytest.raises(LocalProtocolError, match="make a new one"):
            await camera.open()
    assert box.connections == 0


async def test_close_twice_and_at_once_does_it_once() -> None:
    async with by_hand() as (box, camera):
        await asyncio.gather(camera.close(), camera.close())
        await camera.close()
        assert box.ids == [DISCONNECT, CONNECT, QUERY, DISCONNECT]


async def test_close_of_a_peer_that_never_closes_is_bounded() -> None:
    async with HandmadeCamera(lingers=True) as box:
        camera = await smartcam.connect(box.url, close_timeout=SHORT)
        async with asyncio.timeout(1):
            await camera.close()
        await box.wait_for(DISCONNECT, 2)


async def test_close_cancelled_drops_the_link() -> None:
    async with HandmadeCamera(lingers=True) as box:
        camera = await smartcam.connect(box.url, close_timeout=30)
        closing = asyncio.create_task(camera.close())
        await box.wait_for(DISCONNECT, 2)
        await cancelled(closing)
        assert not camera.connected


async def test_close_leaves_the_run_state_alone() -> None:
    async with by_hand(application=7) as (box, _):
        pass
    assert box.status == READY
    assert STOP not in box.ids


async def test_error_in_the_body_closes_and_comes_out() -> None:
    with pytest.raises(ZeroDivisionError):
        async with by_hand() as (_, camera):
            raise ZeroDivisionError
    assert not camera.connected


# ---------------------------------------------------------------------- no session


async def test_open_where_nothing_listens_fails_with_every_attempt() -> None:
    async with HandmadeCamera() as box:
        url = box.url
    camera = smartcam.connect(url, connect_attempts=2)
    with pytest.raises(ConnectFailedError, match="no session with bvs:") as caught:
        await camera.open()
    assert (caught.value.host, caught.value.port) == ("127.0.0.1", box.port)
    assert len(caught.value.attempts) == 2
    assert "opening the link" in caught.value.attempts[0]
    assert isinstance(caught.value.__cause__, OSError)


async def test_open_without_an_answer_fails_and_says_silence() -> None:
    async with HandmadeCamera() as box:
        box.script[CONNECT] = lambda _: b""
        camera = smartcam.connect(box.url, connect_timeout=SHORT, connect_attempts=1)
        with pytest.raises(ConnectFailedError, match="waiting for the answer to Connect: silence"):
            await camera.open()
        with pytest.raises(ConnectFailedError):
            await camera.get_clock()
        assert camera.statistics().sessions == 0


async def test_open_failed_ends_streams_with_the_error() -> None:
    async with HandmadeCamera() as box:
        box.script[CONNECT] = lambda _: b"garbage, and more of it"
        camera = smartcam.connect(box.url, connect_attempts=1)
        events = camera.events()
        with pytest.raises(ConnectFailedError):
            await camera.open()
        with pytest.raises(ConnectFailedError):
            await anext(events)


async def test_open_cancelled_leaves_nothing() -> None:
    async with HandmadeCamera() as box:
        box.script[CONNECT] = lambda _: b""
        camera = smartcam.connect(box.url)
        opening = asyncio.create_task(camera.open())
        await box.wait_for(CONNECT)
        await cancelled(opening)
        assert not camera.connected
        with pytest.raises(ConnectionClosedError):
            await camera.trigger()


async def test_open_cancelled_while_it_switches_says_disconnect() -> None:
    async with HandmadeCamera(status=0) as box:
        box.script[SWITCH] = lambda _: b""
        opening = asyncio.create_task(smartcam.connect(box.url, application=3).open())
        await box.wait_for(SWITCH)
        await cancelled(opening)
        await box.wait_for(DISCONNECT, 2)


async def test_close_while_opening_ends_the_opener() -> None:
    async with HandmadeCamera() as box:
        box.script[CONNECT] = lambda _: b""
        camera = smartcam.connect(box.url)
        opening = asyncio.create_task(camera.open())
        await box.wait_for(CONNECT)
        await camera.close()
        with pytest.raises(ConnectionClosedError, match="the connection is closed"):
            await opening


def test_connect_with_a_wrong_option_names_it() -> None:
    with pytest.raises(ConfigurationError, match="aplication"):
        smartcam.connect("bvs://127.0.0.1", aplication=7)  # type: ignore[call-overload]


@pytest.mark.parametrize("timeout", [-1.0, float("nan"), float("inf")])
async def test_timeout_that_is_no_number_of_seconds_is_refused(timeout: float) -> None:
    async with by_hand() as (box, camera):
        calls: list[Callable[[], Coroutine[Any, Any, object]]] = [
            lambda: camera.trigger(timeout=timeout),
            lambda: camera.trigger(3, timeout=timeout),
            lambda: camera.next_result(timeout=timeout),
            lambda: camera.wait_ready(timeout),
            lambda: camera.get_clock(timeout=timeout),
        ]
        for call in calls:
            with pytest.raises(ConfigurationError, match="timeout: expected seconds"):
                await call()
        assert box.ids == [DISCONNECT, CONNECT, QUERY]


# ---------------------------------------------------------------------- application=


async def test_application_active_and_running_is_left_alone() -> None:
    async with by_hand(application=7) as (box, camera):
        assert box.ids == [DISCONNECT, CONNECT, QUERY, QUERY]
        assert (await camera.trigger()).application == 7


async def test_application_active_but_stopped_is_only_started() -> None:
    async with by_hand(box={"status": 0}, application=7) as (box, camera):
        assert box.since(4) == [START]
        assert camera.status == Status(READY)


async def test_application_not_active_is_switched_to_and_started() -> None:
    async with by_hand(box={"active": 1}, application=7) as (box, camera):
        assert box.since(4) == [STOP, SWITCH, START]
        assert camera.active_application == 7
        assert (await camera.trigger()).application == 7


async def test_application_not_active_and_stopped_is_not_stopped_again() -> None:
    async with by_hand(box={"active": 1, "status": 0}, application=7) as (box, _):
        assert box.since(4) == [SWITCH, START]


async def test_application_active_but_busy_is_waited_for() -> None:
    async with HandmadeCamera(status=RUNNING | 0x10) as box:
        opening = asyncio.create_task(smartcam.connect(box.url, application=7).open())
        await box.wait_for(QUERY, 2)
        await steps(5)
        assert not opening.done()
        box.report(READY)
        await (await opening).close()


async def test_application_the_camera_does_not_have_fails_and_closes() -> None:
    async with HandmadeCamera() as box:
        camera = smartcam.connect(box.url, application=99)
        with pytest.raises(CommandRejectedError, match="refused to switch to application 99"):
            await camera.open()
        await box.wait_for(DISCONNECT, 2)
        assert box.ids[-2:] == [START, DISCONNECT]  # the old one runs again


async def test_application_that_never_becomes_ready_fails_and_closes() -> None:
    async with HandmadeCamera(status=0) as box:
        box.script[START] = lambda _: b""
        camera = smartcam.connect(box.url, application=7, switch_timeout=SHORT)
        with pytest.raises(ResponseTimeoutError, match="Running and not BUSY after Start"):
            await camera.open()
        await box.wait_for(DISCONNECT, 2)


# ---------------------------------------------------------------------- events


async def test_events_of_a_session_come_in_order() -> None:
    async with HandmadeCamera(active=1) as box:
        camera = smartcam.connect(box.url, application=7, name="press 4")
        events = camera.events()
        async with camera:
            pass
        seen = [event async for event in events]
    assert [_text(event) for event in seen] == [
        f"Connected {box.url}",
        f"StatusChanged None -> {Status(READY)!r}",
        "ApplicationChanged None -> 1",
        f"StatusChanged {Status(READY)!r} -> {Status(0)!r}",
        f"StatusChanged {Status(0)!r} -> {Status.BUSY!r}",
        f"StatusChanged {Status.BUSY!r} -> {Status(0)!r}",
        "ApplicationChanged 1 -> 7",
        f"StatusChanged {Status(0)!r} -> {Status(READY)!r}",
        "Disconnected closed by this side True",
    ]
    assert {event.camera for event in seen} == {"press 4"}
    assert [event.at for event in seen] == sorted(event.at for event in seen)


def _text(event: CameraEvent) -> str:
    match event:
        case Connected(url=url):
            return f"Connected {url}"
        case StatusChanged(previous=previous, status=status):
            return f"StatusChanged {previous!r} -> {status!r}"
        case ApplicationChanged(previous=before, application=application):
            return f"ApplicationChanged {before} -> {application}"
        case Disconnected(reason=reason, expected=expected):
            return f"Disconnected {reason} {expected}"
        case _:
            return repr(event)


async def test_events_of_a_lost_session_end_with_why() -> None:
    async with by_hand() as (box, camera):
        events = camera.events()
        box.hang_up()
        event = await anext(events)
        assert isinstance(event, Disconnected)
        assert (event.reason, event.expected) == ("the camera closed the connection", False)
        with pytest.raises(ConnectionLostError):
            await anext(events)


async def test_status_that_did_not_change_is_no_event() -> None:
    async with by_hand() as (box, camera):
        events = camera.events()
        box.report(READY, READY, RUNNING)
        event = await anext(events)
        assert isinstance(event, StatusChanged)
        assert (event.previous, event.status) == (Status(READY), Status.RUNNING)


# ---------------------------------------------------------------------- the link is lost

WAITERS: dict[str, Callable[[Camera], Coroutine[Any, Any, object]]] = {
    "trigger": lambda camera: camera.trigger(),
    "trigger in line": lambda camera: camera.trigger(),
    "wait_status": lambda camera: camera.wait_status(lambda _: False),
    "next_result": lambda camera: camera.next_result(),
    "get_clock": lambda camera: camera.get_clock(),
    "get_clock in line": lambda camera: camera.get_clock(),
    "results": lambda camera: anext(camera.results()),
    "statuses": lambda camera: anext(camera.statuses()),
}


@contextlib.asynccontextmanager
async def _everybody_waits() -> Any:
    async with by_hand() as (box, camera):
        box.script |= {TRIGGER: lambda _: b"", GET_CLOCK: lambda _: b""}
        waiting = {name: asyncio.ensure_future(wait(camera)) for name, wait in WAITERS.items()}
        await box.wait_for(TRIGGER)
        await box.wait_for(GET_CLOCK)
        yield box, camera, waiting


@pytest.mark.parametrize("end", ["hang_up", "vanish"])
async def test_lost_link_tells_everybody_who_waits(end: str) -> None:
    async with _everybody_waits() as (box, _, waiting):
        getattr(box, end)()
        for name, one in waiting.items():
            error = await gone(one)
            assert isinstance(error, ConnectionLostError), name
            assert (error.host, error.port) == ("127.0.0.1", box.port)
            assert isinstance(error.__cause__, ConnectionError), name


async def test_lost_link_tells_everybody_who_comes_later() -> None:
    async with by_hand() as (box, camera):
        box.hang_up()
        await until(lambda: not camera.connected)
        for name, wait in WAITERS.items():
            if "in line" not in name:
                with pytest.raises(ConnectionLostError, match="closed the connection"):
                    await wait(camera)
        assert camera.status == Status(READY)
        assert "closed the connection" in str(camera.statistics().last_error)


async def test_trouble_is_what_a_call_would_raise() -> None:
    async with HandmadeCamera() as box:
        camera = smartcam.connect(box.url, reconnect=None)
        assert isinstance(camera.trouble, ConnectionClosedError)
        async with camera:
            assert camera.trouble is None
            box.hang_up()
            await until(lambda: camera.trouble is not None)
            assert isinstance(camera.trouble, ConnectionLostError)
            with pytest.raises(ConnectionLostError) as caught:
                await camera.query_application()
            assert str(camera.trouble) == str(caught.value)


async def test_error_raised_again_and_again_does_not_grow() -> None:
    async with by_hand() as (box, camera):
        box.hang_up()
        await until(lambda: not camera.connected)
        sizes = {await _traceback_size(camera) for _ in range(5)}
        assert len(sizes) == 1


async def _traceback_size(camera: Camera) -> int:
    size, error = 0, await gone(camera.trigger())
    traceback = error.__traceback__ if error is not None else None
    while traceback is not None:
        size, traceback = size + 1, traceback.tb_next
    return size


async def test_closed_by_us_tells_everybody_who_waits() -> None:
    async with _everybody_waits() as (_, camera, waiting):
        await camera.close()
        for name, one in waiting.items():
            expected = StopAsyncIteration if name in {"results", "statuses"} else None
            error = await gone(one)
            assert isinstance(error, expected or ConnectionClosedError), name
        with pytest.raises(ConnectionClosedError, match="the connection is closed"):
            await camera.trigger()
        assert [status async for status in camera.statuses()] == []
        assert camera.statistics().last_error is None


async def test_broken_frame_loses_the_link_with_the_bytes_as_cause() -> None:
    async with by_hand() as (box, camera):
        waiting = asyncio.create_task(camera.wait_status(lambda _: False))
        await steps(1)
        box.send(box.said(STATUS, RUNNING, 0) + b"no frame, whatever it is")
        error = await gone(waiting)
        assert isinstance(error, ConnectionLostError)
        assert isinstance(error.__cause__, FrameError)
        assert error.__cause__.data.startswith(b"no frame")
        assert camera.status == Status.RUNNING  # what came before it counts


def _fail(*_: object) -> None:
    raise KeyError("bug")


async def test_supervisor_that_fails_tells_everybody(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    async with by_hand() as (box, camera):
        waiting = asyncio.create_task(camera.wait_status(lambda _: False))
        await steps(1)
        monkeypatch.setattr(inside(camera)._dispatch, "dispatch", _fail)
        box.report(RUNNING)
        error = await gone(waiting)
        assert isinstance(error, ConnectionLostError)
        assert isinstance(error.__cause__, KeyError)
        assert "KeyError('bug') in the client" in str(error)
    assert [record.levelno for record in caplog.records] == [logging.ERROR]


async def test_session_that_cannot_begin_by_a_fault_of_ours_tells_the_opener(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def establish(*_: object) -> object:
        raise KeyError("bug")

    monkeypatch.setattr("smartcam._client.supervisor.establish", establish)
    camera = smartcam.connect("bvs://127.0.0.1")
    with pytest.raises(ConnectionLostError, match=r"KeyError\('bug'\) in the client"):
        await camera.open()


async def test_application_reported_by_the_emulator_is_known_at_once() -> None:
    async with emulated(box={"active": 21, "running": True}) as (emulator, _, camera):
        assert (camera.active_application, camera.status) == (21, Status(RUNNING | WAITING))
        assert camera.url == emulator.url
    assert not emulator.has_session
