"""A link is lost: who is told, what is made again, and when it is given up."""

from __future__ import annotations

import asyncio
import dataclasses
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam import (
    ApplicationChanged,
    Backoff,
    ConfigurationError,
    ConnectFailedError,
    ConnectionClosedError,
    ConnectionLostError,
    Disconnected,
    FrameError,
    Reconnected,
    ResponseTimeoutError,
    Status,
    StatusChanged,
)
from smartcam.emulator import EmulatedCamera
from tests.client.camera_by_hand import (
    BUSY,
    CONNECT,
    GET_CLOCK,
    QUERY,
    READY,
    START,
    STOP,
    SWITCH,
    TRIGGER,
    HandmadeCamera,
)
from tests.client.clientkit import (
    FAST,
    NEVER_YET,
    OPENING,
    SHORT,
    SOON,
    balance,
    by_hand,
    cancelled,
    gone,
    lose,
    lose_and_come_back,
    quiet,
    steps,
)
from tests.handmade import until
from tests.insides import inside

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from smartcam import Camera

    Wait = Callable[[Camera], Coroutine[Any, Any, object]]


# ---------------------------------------------------------------------- who waits is told


async def inside_application(camera: Camera) -> None:
    async with camera.application(3):
        await camera.wait_status(lambda _: False)


@dataclasses.dataclass(frozen=True)
class Waiter:
    """Somebody who waits, and what for."""

    wait: Wait  # what it does
    # message that the camera does not answer, None where nothing is asked
    silent: int | None = None
    answered: int = 0  # how many of these it answers before
    status: int = READY  # the camera's at first


def mute(box: HandmadeCamera, message_id: int, answered: int, asked: asyncio.Event) -> None:
    """Answer some more messages of an id, then none; tell when that begins."""
    answer, begin = box.script[message_id], box.ids.count(message_id)

    def say(payload: bytes) -> bytes:
        if box.ids.count(message_id) <= begin + answered:
            return answer(payload)
        asked.set()
        return b""

    box.script[message_id] = say


WAITERS = {
    "query": Waiter(lambda camera: camera.query_application(), QUERY),
    "clock": Waiter(lambda camera: camera.get_clock(), GET_CLOCK),
    "raw request": Waiter(lambda camera: camera.request(GET_CLOCK), GET_CLOCK),
    "status": Waiter(lambda camera: camera.wait_status(lambda _: False)),
    "ready": Waiter(lambda camera: camera.wait_ready(), status=BUSY),
    "next_result": Waiter(lambda camera: camera.next_result()),
    "trigger": Waiter(lambda camera: camera.trigger(), TRIGGER),
    "trigger of a busy camera": Waiter(lambda camera: camera.trigger(), status=BUSY),
    "start": Waiter(lambda camera: camera.start(), START, status=0),
    "stop": Waiter(lambda camera: camera.stop(), STOP),
    "switch that stops": Waiter(lambda camera: camera.switch_application(3), STOP),
    "switch that loads": Waiter(lambda camera: camera.switch_application(3), SWITCH),
    "switch that starts": Waiter(lambda camera: camera.switch_application(3), START),
    "trigger in another application": Waiter(lambda camera: camera.trigger(3), SWITCH),
    "trigger in another application, inside": Waiter(lambda camera: camera.trigger(3), TRIGGER),
    "trigger in another application, back": Waiter(
        lambda camera: camera.trigger(3), STOP, answered=1
    ),
    "application": Waiter(inside_application, START),
    "inside an application": Waiter(inside_application),
}
ALWAYS_ENDS_WELL = {"trigger in another application, back"}
"""The result is there already: going back is the next session's."""


@pytest.mark.parametrize("name", WAITERS)
async def test_loss_tells_who_waits_at_once_and_the_next_session_works(name: str) -> None:
    one = WAITERS[name]
    async with by_hand(box={"status": one.status}, reconnect=FAST) as (box, camera):
        script = dict(box.script)
        asked = asyncio.Event()
        if one.silent is None:
            asked.set()
        else:
            mute(box, one.silent, one.answered, asked)
        waiting = asyncio.create_task(one.wait(camera))
        async with asyncio.timeout(SOON):
            await asked.wait()
        await steps(20)
        assert not waiting.done()
        box.script = script
        box.hang_up()
        async with asyncio.timeout(SOON):
            error = await gone(waiting)
        if name not in ALWAYS_ENDS_WELL:
            assert isinstance(error, ConnectionLostError)
            assert isinstance(error.__cause__, ConnectionResetError)
        await camera.wait_connected(SOON)
        box.report(READY)
        await camera.wait_status(lambda status: status == READY)
        assert (await camera.trigger()).raw == b"found"
        balance(camera.statistics())


async def test_loss_tells_everybody_the_same_first_cause() -> None:
    async with by_hand(reconnect=NEVER_YET) as (box, camera):
        box.script |= {GET_CLOCK: quiet, TRIGGER: quiet}
        waits: list[Wait] = [
            lambda camera: camera.trigger(),
            lambda camera: camera.trigger(),  # in line
            lambda camera: camera.get_clock(),
            lambda camera: camera.get_clock(),  # in line
            lambda camera: camera.wait_status(lambda _: False),
            lambda camera: camera.next_result(),
        ]
        tasks = [asyncio.create_task(wait(camera)) for wait in waits]
        await box.wait_for(TRIGGER)
        await box.wait_for(GET_CLOCK)
        box.hang_up()
        errors = await asyncio.gather(*tasks, return_exceptions=True)
        assert {type(error) for error in errors} == {ConnectionLostError}
        causes = {id(error.__cause__) for error in errors if isinstance(error, BaseException)}
        assert len(causes) == 1
        assert box.ids.count(TRIGGER) == box.ids.count(GET_CLOCK) == 1


DURING_AN_OUTAGE: dict[str, Wait] = {
    "trigger": lambda camera: camera.trigger(timeout=60),
    "trigger in an application": lambda camera: camera.trigger(3, timeout=60),
    "switch": lambda camera: camera.switch_application(3),
    "application": inside_application,
    "start": lambda camera: camera.start(),
    "stop": lambda camera: camera.stop(),
    "query": lambda camera: camera.query_application(),
    "clock": lambda camera: camera.get_clock(),
    "input": lambda camera: camera.set_input(b"part"),
    "number": lambda camera: camera.set_sequence_number(1),
    "reboot": lambda camera: camera.reboot(),
    "request": lambda camera: camera.request(GET_CLOCK),
    "status": lambda camera: camera.wait_status(lambda _: True),
    "ready": lambda camera: camera.wait_ready(),
}


async def test_call_during_an_outage_fails_at_once_with_the_first_cause() -> None:
    async with by_hand(reconnect=NEVER_YET) as (box, camera):
        await lose(box, camera)
        mark = len(box.ids)
        for name, call in DURING_AN_OUTAGE.items():
            async with asyncio.timeout(SOON):
                error = await gone(call(camera))
            assert isinstance(error, ConnectionLostError), name
            assert isinstance(error.__cause__, ConnectionResetError), name
            assert error.host == "127.0.0.1"
        with pytest.raises(ConnectionLostError):
            camera.next_result().close()
        assert box.since(mark) == []
        assert camera.status == Status(READY)  # the last one that is known
        assert camera.active_application == 7


async def test_broken_frame_is_the_cause_and_the_camera_is_there_again() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        waiting = asyncio.create_task(camera.wait_status(lambda _: False))
        await steps(2)
        box.send(b"no frame at all")
        error = await gone(waiting)
        assert isinstance(error, ConnectionLostError)
        assert isinstance(error.__cause__, FrameError)
        await camera.wait_connected(SOON)
        assert (await camera.trigger()).raw == b"found"


@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_trigger_is_never_sent_again_by_itself(transport: str) -> None:
    async with by_hand(box={"transport": transport}, reconnect=FAST) as (box, camera):
        box.script[TRIGGER] = quiet
        triggering = asyncio.create_task(camera.trigger(input=b"part"))
        await box.wait_for(TRIGGER)
        inside(camera)._connection.require_link().abort(ConnectionResetError("pulled"))
        with pytest.raises(ConnectionLostError, match="pulled"):
            await triggering
        await camera.wait_connected(SOON)
        await camera.get_clock()
        assert box.ids.count(TRIGGER) == 1


# ---------------------------------------------------------------------- what is made again


async def test_session_is_made_again_as_the_first_was_with_the_dialect_pinned() -> None:
    async with by_hand(box={"dialect": "thesis"}, reconnect=FAST) as (box, camera):
        mark = len(box.ids)
        await lose_and_come_back(box, camera)
        assert box.since(mark) == OPENING
        assert camera.url == box.url
        assert (camera.connected, camera.protocol_version) == (True, 1)


async def test_dialect_found_out_once_is_kept() -> None:
    async with EmulatedCamera(dialect="thesis") as emulator:
        url = emulator.url.partition("?")[0]
        async with smartcam.connect(url, connect_timeout=1.0, reconnect=FAST) as camera:
            inside(camera)._connection.require_link().abort(ConnectionResetError("pulled"))
            await until(lambda: camera.statistics().sessions == 2)
            assert camera.url == emulator.url
        # what the other dialect says makes no frame here
        broken = [entry.peer for entry in emulator.log if entry.error is not None]
        assert emulator.log[-1].peer not in broken


@pytest.mark.usefixtures("never_taken")
async def test_old_link_is_over_before_the_camera_hears_the_next_connect() -> None:
    async with HandmadeCamera() as box:
        open_at_connect: list[int] = []
        connect = box.script[CONNECT]

        def note(payload: bytes) -> bytes:
            open_at_connect.append(len(box.peers))
            return connect(payload)

        box.script[CONNECT] = note
        async with smartcam.connect(box.url, reconnect=Backoff(initial=0.0)) as camera:
            for reason in ("eof", "broken", "aborted"):
                sessions = camera.statistics().sessions
                if reason == "eof":
                    box.hang_up()
                elif reason == "broken":
                    box.send(b"no frame at all")
                else:
                    inside(camera)._connection.require_link().give_up(
                        ConnectionResetError("pulled")
                    )
                await until(lambda: camera.statistics().sessions > sessions)  # noqa: B023
        assert open_at_connect == [1, 1, 1, 1]


async def test_events_of_a_loss_come_in_order() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        events = camera.events()
        box.active, box.status = 3, 0  # somebody else was there meanwhile
        await lose_and_come_back(box, camera)
        seen = [await anext(events) for _ in range(4)]
        lost, back, status, application = seen
        assert isinstance(lost, Disconnected)
        assert (lost.reason, lost.expected) == ("the camera closed the connection", False)
        assert isinstance(back, Reconnected)
        assert back.url == box.url
        assert isinstance(status, StatusChanged)
        assert (status.previous, status.status) == (Status(READY), Status(0))
        assert isinstance(application, ApplicationChanged)
        assert (application.previous, application.application) == (7, 3)
        assert [event.at for event in seen] == sorted(event.at for event in seen)
        assert camera.active_application == 3


async def test_nothing_that_did_not_change_is_an_event_of_a_loss() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        events = camera.events()
        await lose_and_come_back(box, camera)
        await camera.close()
        kinds = [type(event).__name__ async for event in events]
        assert kinds == ["Disconnected", "Reconnected", "Disconnected"]


@pytest.mark.usefixtures("never_taken")
async def test_everything_is_counted_over_all_sessions() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        for sessions in range(1, 4):
            statistics = camera.statistics()
            assert (statistics.sessions, statistics.reconnects) == (sessions, sessions - 1)
            await camera.trigger()
            await lose_and_come_back(box, camera)
        statistics = camera.statistics()
        assert statistics.triggered == 3
        assert statistics.frames_sent == len(box.received)
        assert statistics.bytes_sent == sum(12 + len(payload) for _, payload in box.received)
        assert statistics.frames_received == 4 * 3 + 3 * 5  # three at Connect, five at a trigger
        assert statistics.processing.count == 3
        assert "closed the connection" in str(statistics.last_error)
        balance(statistics)


async def test_statistics_stay_during_an_outage_and_after_the_end() -> None:
    async with by_hand(reconnect=NEVER_YET) as (box, camera):
        await camera.trigger()
        await lose(box, camera)
        before = camera.statistics()
        assert (before.triggered, before.frames_sent) == (1, 6)
        await camera.close()
        assert dataclasses.replace(camera.statistics(), subscribers=[]) == before


async def test_streams_and_their_accounts_go_on() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        results, statuses = camera.results(), camera.statuses()
        box.send(box.result_frame(b"before"))
        assert (await anext(results)).raw == b"before"
        waiting = asyncio.create_task(anext(results))
        await lose_and_come_back(box, camera)
        assert not waiting.done()
        box.send(box.result_frame(b"behind"))
        result = await waiting
        assert (result.raw, result.number) == (b"behind", 2)
        assert await anext(statuses) == Status(READY)  # the one that Connect brings
        accounts = {one.name: one for one in camera.statistics().subscribers}
        assert (accounts["results"].offered, accounts["results"].taken) == (2, 2)
        balance(camera.statistics())


async def test_stream_made_during_an_outage_goes_on_with_the_next_session() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        connect, box.script[CONNECT] = box.script[CONNECT], quiet
        await lose(box, camera)
        await box.wait_for(CONNECT, 2)
        events, results = camera.events(), camera.results()
        box.script[CONNECT] = connect
        box.send(connect(b""))
        assert isinstance(await anext(events), Reconnected)
        box.send(box.result_frame(b"behind"))
        assert (await anext(results)).raw == b"behind"


async def test_results_that_come_with_the_next_connect_are_not_lost() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        results = camera.results()
        connect = box.script[CONNECT]
        box.script[CONNECT] = lambda payload: connect(payload) + box.result_frame(b"at once")
        await lose_and_come_back(box, camera)
        assert (await anext(results)).raw == b"at once"


# ---------------------------------------------------------------------- it is given up


async def test_no_reconnect_ends_everything_with_the_loss() -> None:
    async with by_hand(reconnect=None) as (box, camera):
        results = camera.results()
        waiting = asyncio.create_task(camera.wait_connected())
        await waiting
        box.hang_up()
        with pytest.raises(ConnectionLostError):
            await anext(results)
        for call in (camera.trigger, camera.wait_connected):
            with pytest.raises(ConnectionLostError, match="the camera closed the connection"):
                await call()
        assert box.connections == 1
        assert camera.statistics().sessions == 1


async def test_attempts_that_are_used_up_tell_the_loss_and_the_last_failure() -> None:
    policy = dataclasses.replace(FAST, attempts=2)
    options: dict[str, Any] = {"connect_attempts": 1, "name": "press 4"}
    async with by_hand(reconnect=policy, **options) as (box, camera):
        results = camera.results()
        waiting = asyncio.create_task(camera.wait_status(lambda _: False))
        await steps(2)
        box.vanish()
        loss = await gone(waiting)
        with pytest.raises(ConnectionLostError) as caught:
            await camera.wait_connected(SOON)
        error = caught.value
        assert str(loss) in str(error)
        assert "given up after that: press 4: no session with" in str(error)
        assert isinstance(error.__cause__, ConnectFailedError)
        assert (error.host, error.port) == ("127.0.0.1", box.port)
        with pytest.raises(ConnectionLostError, match="given up"):
            await anext(results)
        with pytest.raises(ConnectionLostError, match="given up"):
            await camera.trigger()
        assert "no session with" in str(camera.statistics().last_error)


class _Errors(smartcam.Observer):
    def __init__(self) -> None:
        self.errors: list[smartcam.SmartCamError] = []

    def on_error(self, camera: str, error: smartcam.SmartCamError, triggered_at: object) -> None:
        self.errors.append(error)


async def test_observers_are_told_the_loss_and_every_failed_try() -> None:
    watching = _Errors()
    policy = dataclasses.replace(FAST, attempts=3)
    options: dict[str, Any] = {"connect_attempts": 1, "observers": [watching]}
    async with by_hand(reconnect=policy, **options) as (box, camera):
        box.vanish()
        await gone(camera.wait_connected(SOON))
        await until(lambda: len(watching.errors) == 4)
        kinds = [type(error) for error in watching.errors]
        assert kinds == [ConnectionLostError] + 3 * [ConnectFailedError]


async def test_error_that_another_try_does_not_help_ends_it_at_once() -> None:
    asked: list[BaseException] = []

    def transient(error: BaseException) -> bool:
        asked.append(error)
        return len(asked) < 2

    policy = dataclasses.replace(FAST, transient=transient)
    async with by_hand(reconnect=policy, connect_attempts=1) as (box, camera):
        box.vanish()
        await until(lambda: not camera.connected)
        with pytest.raises(ConnectionLostError, match="given up"):
            await camera.wait_connected(SOON)
        assert [type(error) for error in asked] == [ConnectFailedError] * 2


async def test_policy_that_fails_itself_ends_the_client_and_tells_everybody(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def transient(_: BaseException) -> bool:
        raise KeyError("the user's own")

    policy = dataclasses.replace(FAST, transient=transient)
    async with by_hand(reconnect=policy, connect_attempts=1) as (box, camera):
        box.vanish()
        await until(lambda: not camera.connected)
        with pytest.raises(ConnectionLostError, match="the user's own") as caught:
            await camera.wait_connected(SOON)
        assert isinstance(caught.value.__cause__, KeyError)
    assert "the supervisor failed" in caplog.text


async def test_first_failure_is_loud_and_the_rest_quiet(caplog: pytest.LogCaptureFixture) -> None:
    policy = dataclasses.replace(FAST, attempts=4)
    with caplog.at_level("DEBUG", "smartcam.client"):
        async with by_hand(reconnect=policy, connect_attempts=1) as (box, camera):
            box.vanish()
            await until(lambda: not camera.connected)
            await gone(camera.wait_connected(SOON))
    tries = [record for record in caplog.records if "! reconnect" in record.getMessage()]
    assert [record.levelname for record in tries] == ["WARNING", "DEBUG", "DEBUG", "DEBUG"]


def test_reconnect_that_is_no_policy_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="reconnect"):
        smartcam.connect("bvs://127.0.0.1", reconnect=True)  # type: ignore[call-overload]


# ---------------------------------------------------------------------- closing meanwhile


async def closed_at_once(camera: Camera) -> None:
    async with asyncio.timeout(0.5):
        await camera.close()
    for call in (camera.trigger, camera.wait_connected):
        with pytest.raises(ConnectionClosedError, match="the connection is closed"):
            await call()


async def test_close_while_it_waits_for_the_next_try_is_immediate() -> None:
    async with by_hand(reconnect=NEVER_YET) as (box, camera):
        results = camera.results()
        await lose(box, camera)
        await closed_at_once(camera)
        assert [result async for result in results] == []
        assert box.connections == 1


async def test_close_while_it_connects_is_immediate() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        box.script[CONNECT] = quiet
        await lose(box, camera)
        await box.wait_for(CONNECT, 2)
        await closed_at_once(camera)
        await until(lambda: not box.peers)


async def test_close_while_a_command_of_before_still_has_the_turn_is_immediate() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        async with inside(camera)._lock.hold(SOON):
            await lose(box, camera)
            with pytest.raises(ResponseTimeoutError):
                await camera.wait_connected(SHORT)  # the next session waits for it
            assert box.connections == 1
            await closed_at_once(camera)
        assert box.connections == 1


async def test_next_session_waits_for_a_command_of_before_not_for_ever() -> None:
    async with by_hand(reconnect=FAST, switch_timeout=SHORT) as (box, camera):
        async with inside(camera)._lock.hold(SOON):
            await lose(box, camera)
            await camera.wait_connected(SOON)
        assert box.connections == 2


async def _error_during_an_outage() -> None:
    async with by_hand(reconnect=NEVER_YET) as (box, camera):
        await lose(box, camera)
        raise ZeroDivisionError


async def test_error_in_the_body_during_an_outage_comes_out() -> None:
    async with asyncio.timeout(SOON):
        with pytest.raises(ZeroDivisionError):
            await _error_during_an_outage()


async def test_close_cancelled_during_an_outage_leaves_nothing() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        box.script[CONNECT] = quiet
        await lose(box, camera)
        await box.wait_for(CONNECT, 2)
        closing = asyncio.create_task(camera.close())
        await steps(1)
        closing.cancel()
        await asyncio.wait({closing})
        await camera.close()
        assert not camera.connected


# ---------------------------------------------------------------------- wait_connected


async def test_wait_connected_returns_at_once_where_there_is_a_session() -> None:
    async with by_hand(reconnect=FAST) as (_, camera):
        await camera.wait_connected(0)


async def test_wait_connected_times_out_and_tells_the_loss() -> None:
    async with by_hand(reconnect=NEVER_YET) as (box, camera):
        await lose(box, camera)
        with pytest.raises(
            ResponseTimeoutError, match=r"no session within 0\.05 s; .*closed the connection"
        ) as caught:
            await camera.wait_connected(SHORT)
        assert caught.value.waited == SHORT


async def test_wait_connected_before_open_and_after_close_raises() -> None:
    camera = smartcam.connect("bvs://127.0.0.1")
    with pytest.raises(ConnectionClosedError, match="open it first"):
        await camera.wait_connected()
    async with by_hand(reconnect=FAST) as (_, other):
        pass
    with pytest.raises(ConnectionClosedError, match="the connection is closed"):
        await other.wait_connected()


async def test_wait_connected_while_it_is_opened_waits_for_the_first_session() -> None:
    async with HandmadeCamera() as box:
        connect, box.script[CONNECT] = box.script[CONNECT], quiet
        camera = smartcam.connect(box.url)
        opening = asyncio.create_task(camera.open())
        await box.wait_for(CONNECT)
        waiting = asyncio.create_task(camera.wait_connected(SOON))
        await steps(5)
        assert not waiting.done()
        box.send(connect(b""))
        await waiting
        await opening
        await camera.close()


async def test_wait_connected_is_told_when_it_is_closed() -> None:
    async with by_hand(reconnect=NEVER_YET) as (box, camera):
        await lose(box, camera)
        waiting = [asyncio.create_task(camera.wait_connected()) for _ in range(3)]
        await steps(2)
        await camera.close()
        for one in waiting:
            assert isinstance(await gone(one), ConnectionClosedError)


async def test_wait_connected_cancelled_disturbs_nobody() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        connect, box.script[CONNECT] = box.script[CONNECT], quiet
        await lose(box, camera)
        await box.wait_for(CONNECT, 2)
        one, other = (asyncio.create_task(camera.wait_connected(SOON)) for _ in range(2))
        await steps(2)
        await cancelled(one)
        box.script[CONNECT] = connect
        box.send(connect(b""))
        await other
        assert (await camera.trigger()).raw == b"found"


@pytest.mark.parametrize("timeout", [-1.0, float("nan"), float("inf")])
async def test_wait_connected_wants_a_number_of_seconds(timeout: float) -> None:
    async with by_hand() as (_, camera):
        with pytest.raises(ConfigurationError, match="timeout: expected seconds"):
            await camera.wait_connected(timeout)
