"""Starting, stopping, rebooting, configuring and watching the emulated camera."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from typing import Any, Literal

import pytest

from smartcam.emulator import (
    Application,
    EmulatedCamera,
    EmulatedInSight,
    ManualClock,
    Quirks,
    Scenario,
)
from smartcam.emulator._inside import RealClock
from smartcam.exceptions import ConfigurationError, LocalProtocolError, ResponseTimeoutError
from smartcam.models import Status
from smartcam.protocols import messages as m
from tests import ROOT
from tests.emulator import camera_wire as wire
from tests.emulator.camera_wire import TcpClient, UdpClient
from tests.handmade import until

BOLTS = ROOT / "examples" / "scenarios" / "bolts.yaml"


async def refused(emulator: EmulatedCamera) -> bool:
    try:
        _, writer = await asyncio.open_connection(emulator.host, emulator.port)
    except ConnectionRefusedError:
        return True
    writer.transport.abort()
    return False


def other_tasks() -> set[str]:
    return {task.get_name() for task in asyncio.all_tasks() if task is not asyncio.current_task()}


# ---------------------------------------------------------------------- start and stop


@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_start_and_stop_leave_nothing(transport: Literal["tcp", "udp"]) -> None:
    emulator = EmulatedCamera(transport=transport)
    assert emulator.port == 0
    await emulator.start()
    port = emulator.port
    await emulator.start()
    assert emulator.port == port > 0
    await emulator.stop()
    await emulator.stop()
    assert other_tasks() == set()
    await emulator.start()
    assert emulator.port == port
    await emulator.stop()


async def test_stop_closes_connections_and_ends_the_session() -> None:
    async with EmulatedCamera(running=True, active=9) as emulator:
        client = await TcpClient.open(emulator)
        idle = await TcpClient.open(emulator)
        client.send(wire.CONNECT)
        await client.expect(wire.CONNECTED)
    await idle.expect_end()
    assert await refused(emulator)
    assert not emulator.has_session
    assert emulator.links == []
    assert other_tasks() == set()
    for opened in (client, idle):
        opened.writer.transport.abort()
    await asyncio.sleep(0)


@pytest.mark.parametrize("kind", [EmulatedCamera, EmulatedInSight])
@pytest.mark.parametrize("rounds", range(6))
async def test_stop_while_a_client_is_being_accepted_leaves_nothing(
    rounds: int, kind: type[EmulatedCamera | EmulatedInSight]
) -> None:
    emulator = kind()
    await emulator.start()
    sock = socket.create_connection((emulator.host, emulator.port))
    for _ in range(rounds):
        await asyncio.sleep(0)
    await emulator.stop()
    sock.settimeout(5)
    with sock, contextlib.suppress(ConnectionResetError):
        said = b"".join(iter(lambda: sock.recv(100), b""))
        assert said == b"" or kind is EmulatedInSight  # which greets
    assert emulator.links == []
    assert other_tasks() == set()


async def test_error_in_the_body_closes_everything() -> None:
    emulator = EmulatedCamera()
    with pytest.raises(ZeroDivisionError):
        async with emulator:
            raise ZeroDivisionError
    assert await refused(emulator)
    assert other_tasks() == set()


async def test_stopped_devices_time_stands_still() -> None:
    clock = ManualClock()
    emulator = EmulatedCamera(clock=clock, active=9, running=True)
    async with emulator:
        clock.advance(1.0)
    clock.advance(5.0)
    assert emulator.device.time == 1.0
    emulator.device.stop()
    async with emulator:
        clock.advance(1.0)
        with emulator.step():
            assert emulator.device.time == 2.0


async def test_start_port_taken_is_a_configuration_error() -> None:
    async with EmulatedCamera() as emulator:
        text = f"cannot listen on tcp 127.0.0.1:{emulator.port}: .*in use"
        with pytest.raises(ConfigurationError, match=text):
            await EmulatedCamera(port=emulator.port).start()


@pytest.mark.parametrize("host", ["192.0.2.1", "no..host", "256.0.0.1.invalid"])
async def test_start_impossible_host_is_a_configuration_error(host: str) -> None:
    with pytest.raises(ConfigurationError, match="cannot listen on tcp"):
        await EmulatedCamera(host=host).start()


def test_impossible_port_is_a_configuration_error() -> None:
    with pytest.raises(ConfigurationError, match=r"port: .* got 70000"):
        EmulatedCamera(port=70_000)


async def test_start_cancelled_leaves_it_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    emulator = EmulatedCamera()
    forever = asyncio.Event()

    async def serve(sock: socket.socket) -> None:
        await forever.wait()

    monkeypatch.setattr(emulator._listener, "serve", serve)
    task = asyncio.create_task(emulator.start())
    await until(lambda: emulator._port._socket is not None)
    task.cancel()
    await asyncio.wait({task})
    assert task.cancelled()
    assert emulator._port._socket is None
    assert await refused(emulator)


async def test_accept_that_fails_is_tried_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("smartcam._accepting.ACCEPT_PAUSE", 0.001)
    failures: list[OSError] = [OSError(24, "no descriptor left"), BlockingIOError()]

    class Scarce(socket.socket):
        def accept(self) -> Any:
            if failures:
                raise failures.pop(0)
            return super().accept()

    monkeypatch.setattr("smartcam.emulator._port.socket.socket", Scarce)
    async with EmulatedCamera() as emulator:
        monkeypatch.undo()
        async with await TcpClient.open(emulator) as client:
            await wire.greet(client)
    assert failures == []
    assert "a connection cannot be accepted: [Errno 24] no descriptor left" in caplog.text


async def test_accepted_connection_that_is_lost_is_closed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def fail(factory: object, sock: socket.socket) -> None:
        raise OSError("gone")

    async with EmulatedCamera() as emulator:
        with monkeypatch.context() as patch:
            patch.setattr(asyncio.get_running_loop(), "connect_accepted_socket", fail)
            async with await TcpClient.open(emulator) as client:
                await client.expect_end()
        async with await TcpClient.open(emulator) as client:
            await wire.greet(client)
    assert "an accepted connection was lost" in caplog.text


async def test_loop_without_readers_accepts_by_a_task(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("smartcam._accepting.ACCEPT_PAUSE", 0.001)
    loop = asyncio.get_running_loop()
    accept = loop.sock_accept
    failures: list[OSError] = [OSError(24, "no descriptor left")]

    async def scarce(sock: socket.socket) -> Any:
        if failures:
            raise failures.pop(0)
        return await accept(sock)

    def none(*args: object) -> None:
        raise NotImplementedError

    with monkeypatch.context() as patch:
        patch.setattr(loop, "add_reader", none)
        patch.setattr(loop, "sock_accept", scarce)
        async with EmulatedCamera() as emulator:
            for _ in range(2):
                async with await TcpClient.open(emulator) as client:
                    await wire.greet(client)
        assert await refused(emulator)
    assert failures == []
    assert other_tasks() == set()


async def test_ipv6_host_stands_in_brackets() -> None:
    emulator = EmulatedCamera(host="::1")
    try:
        await emulator.start()
    except ConfigurationError:
        pytest.skip("no IPv6 here")
    try:
        assert emulator.url == f"bvs://[::1]:{emulator.port}?dialect=handbook"
        async with await TcpClient.open(emulator) as client:
            await wire.greet(client)
    finally:
        await emulator.stop()


# ---------------------------------------------------------------------- reboot


async def test_reboot_shuts_the_port_and_opens_the_same_again() -> None:
    clock = ManualClock()
    async with EmulatedCamera(clock=clock) as emulator:
        port = emulator.port
        async with await TcpClient.open(emulator) as client, await TcpClient.open(emulator) as idle:
            client.send(wire.CONNECT, wire.SET_CLOCK, wire.START, wire.REBOOT, wire.QUERY)
            await client.expect(*wire.HELLO, wire.WAITING)
            await client.expect_end()
            await idle.expect_end()
        assert await refused(emulator)
        clock.advance(29.999)
        assert await refused(emulator)
        clock.advance(0.001)
        async with await TcpClient.open(emulator) as client:
            client.send(wire.CONNECT, wire.QUERY)
            await client.expect(*wire.HELLO, wire.ACTIVE_1)
        assert emulator.port == port


@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_reboot_inside_one_advance(transport: Literal["tcp", "udp"]) -> None:
    clock = ManualClock()
    async with EmulatedCamera(clock=clock, transport=transport) as emulator:
        for _ in range(3):
            emulator.device.reboot()
            clock.advance(31.0)
        if transport == "udp":
            async with UdpClient(emulator) as udp:
                await wire.greet(udp)
        else:
            async with await TcpClient.open(emulator) as tcp:
                await wire.greet(tcp)
    assert other_tasks() == set()


async def test_reboot_stop_while_down() -> None:
    emulator = EmulatedCamera(clock=ManualClock())
    async with emulator:
        emulator.device.reboot()
    assert other_tasks() == set()


async def test_reboot_stop_while_it_comes_up() -> None:
    clock = ManualClock()
    emulator = EmulatedCamera(clock=clock)
    async with emulator:
        emulator.device.reboot()
        clock.advance(30.0)
    assert await refused(emulator)
    assert other_tasks() == set()


async def test_reboot_port_taken_meanwhile_is_tried_again(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.emulator._port.RETRY_PAUSE", 0.001)
    clock = ManualClock()
    async with EmulatedCamera(clock=clock) as emulator:
        emulator.device.reboot()
        thief = socket.create_server((emulator.host, emulator.port), reuse_port=False)
        with caplog.at_level(logging.WARNING, logger="smartcam.emulator"):
            clock.advance(30.0)
            await until(lambda: "cannot be opened yet" in caplog.text)
        thief.close()
        opening = emulator._port._opening
        assert opening is not None
        await until(opening.done)
        async with await TcpClient.open(emulator) as client:
            await wire.greet(client)


# ---------------------------------------------------------------------- what it is given


async def test_applications_come_beside_the_builtins_and_replace_theirs() -> None:
    emulator = EmulatedCamera(
        [{"id": 50, "name": "mine"}, Application(id=21, name="mine too")], name="left"
    )
    applications = emulator.device.applications
    assert sorted(applications) == [1, 3, 7, 9, 21, 50]
    assert applications[21].name == "mine too"
    assert emulator.device.active_application == 50
    assert not emulator.device.running
    assert emulator.name == "left"
    assert isinstance(emulator.clock, RealClock)


def test_without_builtins() -> None:
    emulator = EmulatedCamera([{"id": 50}], builtins=False)
    assert list(emulator.device.applications) == [50]
    with pytest.raises(ConfigurationError, match="at least one application"):
        EmulatedCamera(builtins=False)


def test_defaults() -> None:
    emulator = EmulatedCamera()
    assert emulator.device.active_application == 1
    assert emulator.host == "127.0.0.1"
    assert emulator.transport == "tcp"
    assert emulator.dialect == "handbook"
    assert emulator.quirks == Quirks()
    assert emulator.seed == 0
    assert not emulator.has_session


def test_scenario_and_what_goes_before_it() -> None:
    scenario = Scenario(
        name="line",
        applications=(Application(id=50), Application(id=51)),
        active=51,
        running=True,
        seed=5,
        quirks=Quirks(reboot_time=1),
    )
    emulator = EmulatedCamera(scenario=scenario)
    assert emulator.device.active_application == 51
    assert emulator.device.running
    assert (emulator.name, emulator.seed, emulator.scene.seed) == ("line", 5, 5)
    assert emulator.quirks.reboot_time == 1
    other = EmulatedCamera(
        [{"id": 50, "name": "new"}],
        scenario=scenario,
        active=50,
        running=False,
        seed=6,
        quirks=Quirks(reboot_time=2),
    )
    assert other.device.applications[50].name == "new"
    assert other.device.active_application == 50
    assert not other.device.running
    assert other.quirks.reboot_time == 2
    assert other.seed == 6


def test_scenario_file() -> None:
    emulator = EmulatedCamera(scenario=BOLTS)
    assert emulator.name == "bolts"
    assert emulator.device.active_application == 11
    assert emulator.quirks.busy_while_processing


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"dialect": "klingon"}, "dialect 'klingon' is unknown; known are handbook, thesis"),
        ({"transport": "pigeon"}, "transport 'pigeon' is unknown; known are tcp, udp"),
        ({"quirks": {"colour": 1}}, "quirks: colour: Extra inputs"),
        ({"quirks": {"reboot_time": -1}}, "quirks: reboot_time: Input should be greater"),
        ({"active": 77}, "no application has the id 77"),
        ({"applications": [{"id": 5, "rate": -1}]}, "application 5: rate"),
        ({"applications": [{"id": 5}, {"id": 5}]}, "application id 5 is there twice"),
        ({"scenario": "/no/such/file.yaml"}, "scenario /no/such/file.yaml"),
    ],
)
def test_wrong_options_are_named(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        EmulatedCamera(**options)


def test_same_seed_same_scene() -> None:
    one, other = EmulatedCamera(seed=4), EmulatedCamera(seed=4)
    assert one.scene.measure() == other.scene.measure()


# ---------------------------------------------------------------------- watching


async def test_log_has_both_directions_and_what_was_ignored() -> None:
    clock = ManualClock()
    clock.advance(2.5)
    async with EmulatedCamera(clock=clock) as emulator, await TcpClient.open(emulator) as client:
        client.send(wire.QUERY, wire.CONNECT, bytes.fromhex("50535642 01000000 77000000 ff"))
        client.send(bytes.fromhex("50535642 01000000 30000000 ff"), b"no magic at all", wire.QUERY)
        await client.expect(*wire.HELLO, wire.ACTIVE_1)
        log = list(emulator.log)
    peer = log[0].peer
    assert peer.startswith("127.0.0.1:")
    assert {entry.peer for entry in log} == {peer}
    assert {entry.time for entry in log} == {2.5}
    frames = [(e.direction, e.message_id, e.message, e.hex) for e in log if e.error is None]
    assert [frame for frame in frames if frame[0] == "in"] == [
        ("in", 0x30, m.Query(), ""),
        ("in", 0x01, m.Connect(), ""),
        ("in", 0x77, None, "ff"),
        ("in", 0x30, None, "ff"),
        ("in", 0x30, m.Query(), ""),
    ]
    assert [frame for frame in frames if frame[0] == "out"] == [
        ("out", 0x01, m.ConnectAnswer(version=1), "01 00 00 00"),
        ("out", 0x12, m.StatusReport(status=Status(0)), "00 00 00 00 00 00 00 00"),
        ("out", 0x30, m.QueryAnswer(application=1), "01 00 00 00"),
    ]
    errors = [entry.error or "" for entry in log if entry.error is not None]
    assert "state idle" in errors[0]
    assert "1 bytes too long" in errors[1]
    assert "wrong magic number" in errors[2]


async def test_log_entry_of_a_short_body_has_no_message() -> None:
    async with EmulatedCamera() as emulator, await TcpClient.open(emulator) as client:
        client.send(bytes.fromhex("50535642 00000000 31000000"))
        await emulator.wait_received(0x31)
        assert emulator.log[0].message is None


async def test_wait_received_counts_from_the_beginning() -> None:
    async with EmulatedCamera() as emulator, await TcpClient.open(emulator) as client:
        client.send(wire.CONNECT, wire.QUERY, wire.QUERY)
        await emulator.wait_received(m.Query, count=2)
        await emulator.wait_received(0x30, count=2)
        waiter = asyncio.create_task(emulator.wait_received(0x30, count=3))
        await asyncio.sleep(0)
        assert not waiter.done()
        client.send(wire.QUERY)
        async with asyncio.timeout(5):
            await waiter


@pytest.mark.parametrize(
    ("what", "text"),
    [(m.Trigger, "received 0 of 1 Trigger in 0.01 s"), (0x40, "0 of 1 message 0x40 in 0.01 s")],
)
async def test_wait_received_gives_up(what: int | type[m.Message], text: str) -> None:
    async with EmulatedCamera() as emulator:
        with pytest.raises(ResponseTimeoutError, match=text) as caught:
            await emulator.wait_received(what, timeout=0.01)
    assert caught.value.waited == 0.01


async def test_debug_log_has_a_line_a_frame(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG, logger="smartcam.emulator"):
        async with EmulatedCamera() as emulator, await TcpClient.open(emulator) as client:
            client.send(wire.QUERY, wire.CONNECT)
            await client.expect(*wire.HELLO)
    lines = [record.getMessage() for record in caplog.records]
    assert any(line.startswith("<") and "Connect()" in line for line in lines)
    assert any(
        line.startswith(">") and "ConnectAnswer(code=0, version=1)" in line for line in lines
    )
    assert any(line.startswith("!") and "state idle" in line for line in lines)


async def test_message_that_does_not_fit_its_frame_is_dropped_and_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with EmulatedCamera() as emulator, await TcpClient.open(emulator) as client:
        await wire.greet(client)
        link: Any = emulator._session_link

        def refuse(_: object, message: m.Message) -> None:
            raise LocalProtocolError("too long for its header")

        monkeypatch.setattr(type(link.machine), "send", refuse)
        emulator.device.start()
        monkeypatch.undo()
        await client.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)
    assert "not sent: too long for its header" in caplog.text


async def test_two_cameras_on_one_clock_move_together() -> None:
    clock = ManualClock()
    async with (
        EmulatedCamera(clock=clock, active=9, running=True) as left,
        EmulatedCamera(clock=clock, active=9, running=True) as right,
    ):
        clock.advance(1.0)
        assert left.device.next_number == right.device.next_number == 21
