"""Fleets over TLS: accepted and refused programs, and their errors."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, cast

import pytest

import smartcam
import smartcam.fleet
from smartcam.exceptions import (
    ConfigurationError,
    ConnectFailedError,
    ConnectionLostError,
    NotAllowedError,
    ResponseTimeoutError,
    TriggerTimeoutError,
)
from smartcam.fleet import FleetCamera, FleetFile, FleetServer
from smartcam.fleet._inside import read_identity
from smartcam.models import Disconnected, Reconnected
from tests.fleet.fleetkit import NAME, PATIENCE, NumberedCamera, Plant, until
from tests.fleet.inside import encode
from tests.fleet.inside import renewal as _renewal
from tests.fleet.inside import zenoh as _zenoh
from tests.fleet.plantkit import CAMERA, certified, plant_file, short_lived, url_of
from tests.processes import free_place

pytestmark = pytest.mark.real_time


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("plant")
    asyncio.run(certified(made))
    return made


@pytest.fixture
async def server(folder: Path) -> AsyncIterator[FleetServer]:
    async with smartcam.fleet.serve(plant_file(folder)) as server:
        await server.wait_first_attempts()
        yield server


def program(url: str) -> FleetCamera[Any]:
    """Return a camera of a fleet."""
    return cast("FleetCamera[Any]", smartcam.connect(url))


def url(server: FleetServer, certificates: Path, **more: str) -> str:
    return url_of(server.address.port, certificates, **more)


# ---------------------------------------------------------------------- roles


async def test_operator_commands_and_viewer_looks(server: FleetServer, folder: Path) -> None:
    async with (
        program(url(server, folder / "robot")) as robot,
        program(url(server, folder / "dashboard")) as dashboard,
    ):
        seen = dashboard.results()
        result = await robot.trigger()
        assert (await anext(seen)).raw == result.raw
        assert await dashboard.get_clock() is not None
        commands: list[Callable[[], Awaitable[object]]] = [
            dashboard.trigger,
            dashboard.start,
            dashboard.stop,
            dashboard.reboot,
            lambda: dashboard.set_clock(datetime(2030, 1, 1)),  # noqa: DTZ001 - a camera's clock
            lambda: dashboard.switch_application(7),
        ]
        for command in commands:
            with pytest.raises(NotAllowedError, match="certificate is that of viewer dashboard"):
                await command()
        with pytest.raises(NotAllowedError) as caught:
            async with dashboard.reserve():
                pass
        assert (caught.value.role, caught.value.certificate) == ("viewer", "dashboard")
        assert (await robot.trigger()).number == result.number + 1  # the robot's alone were done


async def test_viewer_reads_what_outlets_did(server: FleetServer, folder: Path) -> None:
    async with program(url(server, folder / "dashboard")) as dashboard:
        found = dashboard._program
        for name in ("counts", "results"):
            (answer,) = await found.bus.ask(found.keys.outlets("*", name), b"", PATIENCE)
            assert b'"error":""' in answer[1]


async def test_who_commands_all_the_same_is_not_heard(server: FleetServer, folder: Path) -> None:
    """One that does not look at its own certificate: the router drops it, and the call ends."""
    async with program(url(server, folder / "dashboard")) as dashboard:
        bus = dashboard._program.bus
        assert bus.identity is not None
        bus.identity = bus.identity._replace(role="another")
        with pytest.raises(TriggerTimeoutError, match=r"or trigger is not allowed for another "):
            await dashboard.trigger(timeout=0.2)
        with pytest.raises(ResponseTimeoutError, match="or stop is not allowed for another dash"):
            await dashboard.stop(timeout=0.1)
        host = server.shared_cameras[CAMERA]
        assert host.results.next_number == 1  # none
        assert (await dashboard.query_application()) == 7


async def test_two_agents_and_a_router_between(folder: Path) -> None:
    async with (
        smartcam.fleet.serve(plant_file(folder)) as first,
        smartcam.fleet.serve(
            plant_file(
                folder,
                "line2",
                listen=None,
                connect=f"tls/localhost:{first.address.port}",
                cameras={"line2/cam1": {"emulated": {}, "application": 7}},
            )
        ) as second,
    ):
        await asyncio.gather(first.wait_first_attempts(), second.wait_first_attempts())
        for name in ("line2/cam1", CAMERA):
            async with (
                program(url(first, folder / "robot", camera=name)) as robot,
                program(url(first, folder / "dashboard", camera=name)) as dashboard,
            ):
                seen = dashboard.results()
                result = await robot.trigger()
                assert (await anext(seen)).raw == result.raw
        async with program(url(first, folder / "line2")) as agent:
            with pytest.raises(NotAllowedError, match="that of agent line2, which may only read"):
                await agent.trigger()


async def test_cancelling_under_the_name_of_another() -> None:
    """A role that may only ask cannot cancel another's command, or make it count as done."""
    async with (
        Plant(NumberedCamera(time=0.2)) as plant,
        plant.camera() as robot,
        plant.camera() as spy,
    ):
        own = robot._program
        number = own._call_count + 1
        key = own.keys.ask(own.role, "agent", NAME)

        def cancel() -> None:
            for one in range(1, number + 3):
                fields = {"program": own.token, "call": 1, "cancel": one}
                spy._program.bus.put(key, encode(fields, []))

        cancel()  # before it comes
        await spy.query_application()  # which came behind
        triggering = asyncio.ensure_future(robot.trigger())
        await until(lambda: (True, number) in plant.agent._programs[own.name].tasks)
        cancel()  # while it is under way
        assert (await triggering).number == 1
        number = own._call_count + 1
        async with robot.reserve():
            cancel()
            await spy.query_application()
            assert plant.agent.shared_cameras[NAME].gate.holder == own.name


# ---------------------------------------------------------------------- who does not come in


async def refused(url: str, timeout: float = PATIENCE) -> str:
    """Return why nobody comes in."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_zenoh, "DIAGNOSIS_TIMEOUT", PATIENCE)
        with pytest.raises(ConnectFailedError) as caught:
            async with smartcam.connect(url, connect_timeout=timeout):
                pass
    return str(caught.value)


async def test_plain_tcp(server: FleetServer) -> None:
    said = await refused(f"fleet://localhost:{server.address.port}/{CAMERA}")
    assert said.endswith(
        "nothing there speaks Zenoh, or it wants TLS and a certificate: fleet+tls://"
    )


async def test_tls_where_there_is_none(folder: Path) -> None:
    file = {"listen": free_place(), "cameras": {CAMERA: {"emulated": {}}}}
    async with smartcam.fleet.serve(FleetFile.model_validate(file)) as server:
        said = await refused(url(server, folder / "robot"), 1.0)
    assert said.endswith("is it fleet://, without +tls?")


async def test_another_authority(server: FleetServer, folder: Path, tmp_path: Path) -> None:
    await certified(tmp_path, {"operator": ["robot"]})
    said = await refused(url(server, tmp_path / "robot"))
    assert said.endswith("its certificate is of another authority than ca.pem")
    (tmp_path / "robot" / "ca.pem").write_bytes((folder / "robot" / "ca.pem").read_bytes())
    said = await refused(url(server, tmp_path / "robot"))
    assert said.endswith("the certificate of this program is of an authority that it does not know")


async def test_other_host(folder: Path) -> None:
    async with smartcam.fleet.serve(plant_file(folder, listen="tls/127.0.0.2:0")) as server:
        said = await refused(url(server, folder / "robot", host="127.0.0.2"))
    assert "its certificate is for other hosts than 127.0.0.2" in said


@pytest.mark.long
async def test_certificate_of_a_program_for_an_agent(folder: Path) -> None:
    """A program's certificate is none that another takes for an agent's."""
    with pytest.raises(ConfigurationError, match="wants a certificate whose common name is agent"):
        async with smartcam.fleet.serve(plant_file(folder, "robot")):
            pass
    file = plant_file(folder, "robot", access="any-certificate")
    async with smartcam.fleet.serve(file) as server:
        assert "its certificate is" in await refused(url(server, folder / "dashboard"))


async def test_expired(server: FleetServer, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "authority").symlink_to(folder / "authority")
    await short_lived(tmp_path, "operator", "robot", 0.0)
    async with asyncio.timeout(PATIENCE):  # it does not wait for its own
        said = await refused(url(server, tmp_path / "robot"), 3600.0)
    assert f"operator robot ({tmp_path / 'robot' / 'cert.pem'}) has expired on 20" in said
    assert "smartcam fleet certificates DIR" in said


@pytest.mark.long
async def test_any_certificate(folder: Path) -> None:
    file = plant_file(folder, access="any-certificate")
    async with smartcam.fleet.serve(file) as server:
        await server.wait_first_attempts()
        # what the roles of our own programs may is for them to know, whoever lets them in
        async with program(url(server, folder / "dashboard")) as dashboard:
            dashboard._program.bus.identity = None
            assert (await dashboard.trigger()).number == 1


# ---------------------------------------------------------------------- renewal


async def test_renewed_while_it_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_renewal, "CHECK_INTERVAL", 0.02)
    folder = await certified(tmp_path)
    async with smartcam.fleet.serve(plant_file(folder)) as server:
        await server.wait_first_attempts()
        session = server.shared_cameras[CAMERA].client
        async with (
            program(url(server, folder / "robot")) as robot,
            program(url(server, folder / "dashboard")) as dashboard,
        ):
            events, seen = robot.events(), dashboard.results()
            first = await robot.trigger()
            before = read_identity(folder / "line1")
            (folder / "line1" / "cert.pem").write_text("half a file")
            await asyncio.sleep(0.1)  # it looks, and leaves all as it was
            assert (await robot.trigger()).number == first.number + 1
            (folder / "line1" / "cert.pem").unlink()
            await certified(folder, {"agent": ["line1"]})
            assert read_identity(folder / "line1").digest != before.digest
            happened = []
            async with asyncio.timeout(PATIENCE):
                async for event in events:
                    if isinstance(event, Disconnected | Reconnected):
                        happened.append(type(event))
                    if happened == [Disconnected, Reconnected]:
                        break
                await dashboard.wait_connected()
                third = await robot.trigger()
            assert third.number == first.number + 2  # the same agent, the same count
            numbers = [(await anext(seen)).number for _ in range(3)]
            assert numbers == [first.number, first.number + 1, third.number]
            assert seen.statistics().missed == 0
            assert server.shared_cameras[CAMERA].client is session
            assert session.statistics().reconnects == 0


async def test_command_under_way_is_not_cut_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_renewal, "CHECK_INTERVAL", 0.02)
    folder = await certified(tmp_path)
    async with smartcam.fleet.serve(plant_file(folder)) as server:
        await server.wait_first_attempts()
        async with program(url(server, folder / "robot")) as robot:
            async with robot.reserve():
                waiting = asyncio.ensure_future(_trigger_of_another(server, folder))
                await until(lambda: server.busy)
                (folder / "line1" / "cert.pem").unlink()
                await certified(folder, {"agent": ["line1"]})
                await asyncio.sleep(0.2)
                assert robot.connected
            assert (await waiting).number == 1


async def _trigger_of_another(server: FleetServer, folder: Path) -> smartcam.Result:
    async with program(url(server, folder / "robot")) as other:
        return await other.trigger(timeout=PATIENCE)


@contextlib.asynccontextmanager
async def soon_expired(
    server: FleetServer, folder: Path, role: str, name: str
) -> AsyncIterator[FleetCamera[Any]]:
    """Give a program that came in with a certificate that ends soon after."""
    await short_lived(folder, role, name, 3.0)
    camera = program(url(server, folder / name))
    try:
        await camera.open()
    except ConnectFailedError:  # on a slow machine it has ended before
        await short_lived(folder, role, name, 40.0)
        camera = await program(url(server, folder / name)).open()
    try:
        yield camera
    finally:
        await camera.close()


@pytest.mark.long
async def test_certificates_that_end_while_all_runs(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Sessions go on; who comes new is told; with a new certificate it goes on."""
    folder = await certified(tmp_path)
    async with smartcam.fleet.serve(plant_file(folder)) as server:
        await server.wait_first_attempts()
        with caplog.at_level(logging.WARNING, "smartcam.fleet"):
            async with soon_expired(server, folder, "operator", "robot") as robot:
                assert "the certificate of operator robot" in caplog.text
                assert ", in 0.0" in caplog.text
                await until(lambda: "has expired" in caplog.text)
                assert read_identity(folder / "robot").expired_text
                assert (await robot.trigger()).number == 1
                assert "has expired" in await refused(url(server, folder / "robot"))
                await certified(folder, {})
                async with program(url(server, folder / "robot")) as other:
                    assert (await other.trigger()).number == 2


@pytest.mark.long
async def test_lost_with_a_certificate_that_has_expired(tmp_path: Path) -> None:
    folder = await certified(tmp_path)
    async with (
        smartcam.fleet.serve(plant_file(folder)) as server,
        soon_expired(server, folder, "viewer", "dashboard") as dashboard,
    ):
        ends = read_identity(folder / "dashboard").expires_at
        await asyncio.sleep(max(0.0, (ends - datetime.now(UTC)).total_seconds()) + 0.01)
        await server.stop()
        await until(lambda: not dashboard.connected)
        with pytest.raises(ConnectionLostError, match=r"viewer dashboard .* has expired on"):
            await dashboard.get_clock()


def test_warnings(tmp_path: Path) -> None:
    asyncio.run(certified(tmp_path, {"viewer": ["a"]}))
    identity = read_identity(tmp_path / "a")
    now = datetime.now(UTC)
    for days, urgency in ((31, 0), (29, 1), (8, 1), (6, 2), (0.01, 2), (-1, 3)):
        found = identity._replace(expires_at=now + timedelta(days=days))
        assert found.urgency == urgency
        assert bool(found.warning) == bool(urgency)
        assert bool(found.expired_text) == (days < 0)
    assert (
        ", in 6 days; smartcam fleet"
        in identity._replace(expires_at=now + timedelta(days=6, hours=1)).warning
    )
    soon = identity._replace(authority_expires_at=now + timedelta(days=3))
    assert "its authority" in soon.warning


async def test_name_that_does_not_resolve_is_told_as_such() -> None:
    said = await refused(f"fleet://nohost.invalid:7447/{CAMERA}")
    assert "the name 'nohost.invalid' does not resolve" in said
