"""Emulated cameras in a thread: seen from synchronous code, asyncio, and trio."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

import smartcam
from smartcam._loop_thread import LoopThread
from smartcam.emulator import EmulatedCamera, Scenario, faults
from smartcam.exceptions import ConfigurationError, ResponseTimeoutError
from smartcam.protocols.messages import Connect, Query, Trigger
from smartcam.testing import ThreadedCamera, ThreadedFleet

pytestmark = pytest.mark.real_time

CONNECT = bytes.fromhex("50535642 00000000 01000000")
CONNECTED = bytes.fromhex("50535642 04000000 01000000 01000000")


@pytest.fixture
def emulator() -> Iterator[ThreadedCamera]:
    timeline = [{"command": "jam", "do": {"kind": "busy_for_ever"}}]
    with ThreadedCamera(active=21, running=True, timeline=timeline) as threaded:
        yield threaded


def threads() -> set[str]:
    return {thread.name for thread in threading.enumerate() if "smartcam" in thread.name}


def test_synchronous_client_is_served(emulator: ThreadedCamera) -> None:
    with socket.create_connection((emulator.host, emulator.port), timeout=60) as client:
        client.sendall(CONNECT)
        assert client.recv(16, socket.MSG_WAITALL) == CONNECTED
        assert emulator.has_session
        host, port = client.getsockname()
        assert emulator.links == [f"{host}:{port}"]
    assert emulator.log[0].message == Connect()
    assert len(emulator.log[:2]) == 2


async def test_asyncio_client_is_served_while_the_test_uses_the_emulator(
    emulator: ThreadedCamera,
) -> None:
    async with smartcam.connect(emulator.url, interpret_as="text: string[20]") as camera:
        waiting = asyncio.create_task(camera.next_result(timeout=60))
        await asyncio.sleep(0)
        assert emulator.device.trigger()
        assert (await waiting).value.text == "Hello World"
        emulator.inject(faults.NoResult(on="Trigger"))
        with pytest.raises(smartcam.TriggerTimeoutError):
            await camera.trigger(timeout=0.05)
        await emulator.received(Trigger, timeout=60)
        assert [fired.fault.kind for fired in emulator.fired] == ["no_result"]
        await emulator.received(Query, timeout=60)
        with pytest.raises(ResponseTimeoutError):
            await emulator.received(Query, count=1000, timeout=0.05)


@pytest.mark.long
def test_trio_program_waits_for_what_was_received(emulator: ThreadedCamera) -> None:
    trio: Any = pytest.importorskip("trio", reason="needs trio, of the extra dev")
    pytest.importorskip("anyio", reason="needs anyio, of the extra dev")

    async def main() -> None:
        stream = await trio.open_tcp_stream(emulator.host, emulator.port)
        async with stream:
            await stream.send_all(CONNECT)
            await emulator.received(Connect)
            assert await stream.receive_some(16) == CONNECTED

    trio.run(main)


def test_faults_commands_and_states_by_any_thread(emulator: ThreadedCamera) -> None:
    emulator.inject({"kind": "drop", "on": "Query"})
    assert [fault.kind for fault in emulator.faults] == ["drop"]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(emulator.command, ["jam"] * 20))
    assert emulator.commands == ("jam",)
    assert emulator.cue_counts == [20]
    assert emulator.device.status & smartcam.Status.BUSY
    emulator.clear_faults()
    assert emulator.faults == []
    assert not emulator.device.status & smartcam.Status.BUSY
    with pytest.raises(ConfigurationError, match="no cue of the timeline has the command 'x'"):
        emulator.command("x")


def test_manual_clock_moves_when_it_is_told() -> None:
    with ThreadedCamera(manual_clock=True, timeline=[{"at": 60, "do": {"kind": "start"}}]) as one:
        one.advance(59.9)
        assert not one.device.running
        one.advance(0.1)
        assert one.device.running
    with ThreadedCamera() as one, pytest.raises(ConfigurationError, match="manual_clock=True"):
        one.advance(1)


def test_log_can_be_read_when_all_is_over(emulator: ThreadedCamera) -> None:
    with socket.create_connection((emulator.host, emulator.port), timeout=60) as client:
        client.sendall(CONNECT)
        client.recv(16)
    emulator.stop()
    emulator.stop()
    assert emulator.log.received == [Connect()]
    assert len(emulator.ended_connections) == 1
    assert not emulator.has_session
    with pytest.raises(ConfigurationError, match="does not run"):
        emulator.inject({"kind": "stop"})


def test_nothing_is_left_behind() -> None:
    before = threads()
    with ThreadedCamera() as emulator, ThreadedFleet([Scenario(name="one")]):
        assert len(threads() - before) == 2
        address = (emulator.host, emulator.port)
    assert threads() == before
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(address, timeout=60)


def test_camera_that_cannot_listen_leaves_no_thread() -> None:
    before = threads()
    with ThreadedCamera() as taken:
        another = ThreadedCamera(port=taken.port)
        with pytest.raises(ConfigurationError, match="cannot listen"):
            another.start()
        fleet = ThreadedFleet([Scenario(name="one", port=taken.port)])
        with pytest.raises(ConfigurationError, match="cannot listen"):
            fleet.start()
    assert threads() == before


def test_fleet_has_its_cameras_by_name() -> None:
    scenarios = [Scenario(name="left"), Scenario(name="right", transport="udp")]
    with ThreadedFleet(scenarios) as fleet:
        assert list(fleet) == ["left", "right"]
        assert fleet.urls == {name: one.url for name, one in fleet.items()}
        assert (fleet["right"].transport, fleet["right"].dialect) == ("udp", "handbook")
        fleet["left"].device.start()
        assert [one.device.running for one in fleet.values()] == [True, False]


def test_function_runs_in_the_emulators_thread(emulator: ThreadedCamera) -> None:
    def look(camera: EmulatedCamera) -> tuple[str, int]:
        return threading.current_thread().name, camera.port

    assert emulator.run(look) == ("smartcam.emulator[camera]", emulator.port)
    assert "smartcam.emulator[camera]" in threads()
    assert repr(emulator) == f"<ThreadedCamera camera {emulator.url}>"
    assert (emulator.seed, emulator.scenario.active, emulator.transport) == (0, 21, "tcp")
    assert "square" in emulator.scene.pieces


def test_call_that_does_not_return_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    thread = LoopThread("smartcam.slow")
    thread.start()
    thread.start()

    async def for_ever() -> None:
        await asyncio.Event().wait()

    async def too_late() -> None:
        raise TimeoutError("its own")

    try:
        with pytest.raises(ResponseTimeoutError, match=r"smartcam.slow did not answer within 0.05"):
            thread.run_coroutine(for_ever, 0.05)
        with pytest.raises(TimeoutError, match="its own"):
            thread.run_coroutine(too_late)
    finally:
        thread.stop()
