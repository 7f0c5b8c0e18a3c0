"""Lost again and again: by another client, by a restart, by what breaks at once."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import itertools
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam import (
    Backoff,
    ConnectionLostError,
    ConnectionTakenError,
    Disconnected,
    NotRunningError,
    TriggerTimeoutError,
)
from smartcam.emulator import EmulatedCamera
from tests.client.camera_by_hand import CONNECT, QUERY, REBOOT, TRIGGER, HandmadeCamera
from tests.client.clientkit import (
    FAST,
    SHORT,
    SOON,
    by_hand,
    cancelled,
    gone,
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

# ---------------------------------------------------------------------- another client

FREE = {
    "id": 9,
    "layout": "n: int32",
    "generator": "sequence",
    "rate": 500.0,
    "load_time": 0.0,
    "processing_time": 0.0,
}


async def taken(*cameras: Camera) -> tuple[Camera, Camera]:
    """Wait until one of two clients has stopped; return it and the one that has the camera."""
    waiting = {asyncio.create_task(_until_over(one)): one for one in cameras}
    done, left = await asyncio.wait(waiting, timeout=2 * SOON, return_when=asyncio.FIRST_COMPLETED)
    for task in left:
        await cancelled(task)
    assert len(done) == 1, "they fight"
    stopped_one = waiting.pop(done.pop())
    (other,) = waiting.values()
    return stopped_one, other


async def _until_over(camera: Camera) -> None:
    with contextlib.suppress(ConnectionTakenError):
        async for _ in camera.events():
            pass


@pytest.mark.parametrize("transport", ["tcp", "udp"])
@pytest.mark.parametrize("active", [21, 9])
async def test_camera_that_another_client_took_is_not_fought_for(
    transport: Any, active: int
) -> None:
    options: dict[str, Any] = {"reconnect": FAST, "liveness_timeout": 2 * SHORT}
    box: dict[str, Any] = {"applications": [FREE], "active": active, "running": True}
    async with (
        EmulatedCamera(transport=transport, **box) as emulator,
        smartcam.connect(emulator.url, name="first", **options) as first,
        smartcam.connect(emulator.url, name="second", **options) as second,
    ):
        stopped_one, other = await taken(first, second)
        with pytest.raises(ConnectionTakenError, match="another client has the camera") as caught:
            await stopped_one.trigger()
        assert isinstance(caught.value.__cause__, OSError)
        assert caught.value.port == emulator.port
        with pytest.raises(ConnectionTakenError):
            await stopped_one.wait_connected()
        with pytest.raises(ConnectionTakenError):
            await anext(stopped_one.results())
        assert "another client" in str(stopped_one.statistics().last_error)
        await other.wait_connected(SOON)
        await other.get_clock()
        assert emulator.has_session


async def test_camera_taken_over_udp_is_not_fought_for_where_silence_shows_it_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each notices by silence only: a round takes both liveness timeouts, as long as the limit."""
    monkeypatch.setattr("smartcam._client.supervisor.TAKEN_WITHIN", 2 * SHORT)
    options: dict[str, Any] = {"reconnect": Backoff(initial=0.01), "liveness_timeout": SHORT}
    box: dict[str, Any] = {"applications": [FREE], "active": 9, "running": True}
    async with (
        EmulatedCamera(transport="udp", **box) as emulator,
        smartcam.connect(emulator.url, name="first", **options) as first,
        smartcam.connect(emulator.url, name="second", **options) as second,
    ):
        stopped_one, other = await taken(first, second)
        assert isinstance(await gone(stopped_one.trigger()), ConnectionTakenError)
        await other.wait_connected(SOON)


async def test_session_lost_again_soon_after_a_reconnect_was_taken() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        await lose_and_come_back(box, camera)
        waiting = asyncio.create_task(camera.wait_status(lambda _: False))
        await steps(2)
        box.hang_up()
        assert isinstance(await gone(waiting), ConnectionLostError)  # who waited is told the loss
        with pytest.raises(ConnectionTakenError, match="lost again right after a reconnect"):
            await camera.wait_connected(SOON)
        assert box.connections == 2


async def test_first_session_lost_soon_was_not_taken() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        await lose_and_come_back(box, camera)
        assert (await camera.trigger()).raw == b"found"


async def test_session_that_lasted_was_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("smartcam._client.supervisor.TAKEN_WITHIN", 0.0)
    async with by_hand(reconnect=FAST) as (box, camera):
        for _ in range(3):
            await lose_and_come_back(box, camera)
        assert (await camera.trigger()).raw == b"found"


async def test_session_that_a_broken_frame_ended_was_not_taken() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        for sessions in range(2, 5):
            box.send(b"no frame at all")
            await until(lambda: camera.statistics().sessions == sessions)  # noqa: B023
            await camera.wait_connected(SOON)
        assert (await camera.trigger()).raw == b"found"


NO_SIGN = TimeoutError("no sign of life for 5.0 s")


@pytest.mark.parametrize(
    ("cause", "tcp", "udp"),
    [
        (NO_SIGN, False, True),  # over UDP a client that is served no more hears nothing
        (OSError(errno.ETIMEDOUT, "the network acknowledges nothing"), False, True),
        (OSError(errno.EHOSTUNREACH, "no route"), False, False),
        (OSError(errno.ENETDOWN, "the cable is out"), False, False),
        (ConnectionRefusedError("nothing listens there"), False, False),
        (smartcam.ResponseTimeoutError("too late"), False, True),
        (smartcam.ProtocolError("no frame at all"), False, False),
        (RuntimeError("a fault of this program"), False, False),
        (ConnectionResetError("the camera closed the connection"), True, True),
        (BrokenPipeError("the camera reads no more"), True, True),
    ],
    ids=repr,
)
@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_only_what_another_client_can_have_caused_is_taken_for_it(
    transport: str, cause: Exception, tcp: bool, udp: bool
) -> None:
    async with by_hand(box={"transport": transport}, reconnect=FAST) as (_, camera):
        supervisor = inside(camera)._supervisor
        for sessions in range(2, 4):
            inside(camera)._connection.require_link().abort(cause)
            await until(lambda: supervisor.has_ended or camera.statistics().sessions == sessions)  # noqa: B023
        if tcp if transport == "tcp" else udp:
            with pytest.raises(ConnectionTakenError):
                await camera.wait_connected(SOON)
        else:
            assert (await camera.trigger()).raw == b"found"


async def test_camera_that_hangs_again_and_again_is_not_given_up() -> None:
    async with by_hand(reconnect=FAST, liveness_timeout=2 * SHORT) as (box, camera):
        answering = box.script[QUERY]
        for sessions in range(2, 5):
            box.script[QUERY] = quiet
            await until(lambda: not camera.connected)
            box.script[QUERY] = answering
            await until(lambda: camera.statistics().sessions == sessions)  # noqa: B023
            await camera.wait_connected(SOON)
        assert (await camera.trigger()).raw == b"found"


async def test_links_that_break_at_once_are_made_again_ever_slower() -> None:
    policy = Backoff(initial=0.02, factor=4, maximum=1.0, jitter=0.0)
    loop = asyncio.get_running_loop()
    async with HandmadeCamera() as box:
        made_at: list[float] = []
        connect = box.script[CONNECT]

        def broken(payload: bytes) -> bytes:
            made_at.append(loop.time())
            return connect(payload)

        box.script |= {CONNECT: broken}
        async with smartcam.connect(box.url, reconnect=policy) as camera:
            for sessions in range(1, 4):
                await until(lambda: camera.statistics().sessions == sessions)  # noqa: B023
                box.send(b"no frame at all")
            await until(lambda: len(made_at) == 4)
    first, second, third = (b - a for a, b in itertools.pairwise(made_at))
    assert first < second < third
    assert third >= 0.3


# ---------------------------------------------------------------------- reboot


def hangs_up(box: HandmadeCamera) -> Callable[[bytes], bytes]:
    def answer(_: bytes) -> bytes:
        box.hang_up()
        return b""

    return answer


@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_rebooted_camera_is_waited_for_and_triggered(transport: Any) -> None:
    box: dict[str, Any] = {"active": 21, "running": True, "quirks": {"reboot_time": 0.05}}
    async with (
        EmulatedCamera(transport=transport, **box) as emulator,
        smartcam.connect(
            emulator.url, reconnect=FAST, connect_timeout=0.5, connect_attempts=1
        ) as camera,
    ):
        events = camera.events()
        await camera.reboot()
        assert not camera.connected
        lost = await anext(events)
        assert isinstance(lost, Disconnected)
        assert (lost.reason, lost.expected) == ("the camera restarts", True)
        await camera.wait_connected(SOON)
        with pytest.raises(NotRunningError):
            await camera.trigger()  # it comes back stopped
        await camera.start()
        assert (await camera.trigger()).raw.startswith(b"Hello World")


@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_rebooted_camera_is_restored(transport: Any) -> None:
    box: dict[str, Any] = {"active": 1, "quirks": {"reboot_time": 0.05}}
    async with (
        EmulatedCamera(transport=transport, **box) as emulator,
        smartcam.connect(
            emulator.url,
            application=21,
            restore=True,
            reconnect=FAST,
            connect_timeout=0.5,
            connect_attempts=1,
        ) as camera,
    ):
        await camera.reboot()
        await camera.wait_connected(SOON)
        assert (await camera.trigger()).raw.startswith(b"Hello World")
        assert emulator.device.running


async def test_session_lost_again_after_our_own_reboot_was_not_taken() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        box.script[REBOOT] = hangs_up(box)
        await camera.reboot()
        await camera.wait_connected(SOON)  # it answers once more before it goes
        await lose_and_come_back(box, camera)
        assert (await camera.trigger()).raw == b"found"
        box.hang_up()  # but that was our reboot's only excuse
        await until(lambda: not camera.connected)
        with pytest.raises(ConnectionTakenError):
            await camera.wait_connected(SOON)


async def test_camera_that_does_not_hang_up_at_a_reboot_is_left_in_time() -> None:
    async with by_hand(reconnect=FAST, close_timeout=SHORT) as (box, camera):
        async with asyncio.timeout(1):
            await camera.reboot()
        await camera.wait_connected(SOON)
        assert box.connections == 2


async def test_reboot_fails_who_waits() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        box.script[TRIGGER] = quiet
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        box.script[REBOOT] = hangs_up(box)
        await camera.reboot()
        assert isinstance(await gone(triggering), ConnectionLostError)
        assert camera.statistics().last_error is None


async def test_timeout_of_a_trigger_does_not_cost_the_link() -> None:
    async with by_hand(reconnect=FAST) as (box, camera):
        box.script[TRIGGER] = quiet
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=SHORT)
        assert (camera.connected, box.connections) == (True, 1)
