"""Health, readiness and numbers of an agent, asked over HTTP."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import socket
import sys
from collections.abc import AsyncIterator
from typing import Any

import pytest

import smartcam
import smartcam.exceptions
from smartcam.emulator import EmulatedCamera
from smartcam.exceptions import ConfigurationError, MissingExtraError, SmartCamError
from smartcam.fleet import Fleet, FleetFile, FleetServer, MemoryBus
from smartcam.fleet._inside import exposition, read_counts
from smartcam.web import OperationsSite
from tests import ROOT
from tests.fleet.fleetkit import PATIENCE, NumberedCamera, until
from tests.processes import free_place

MAX_CONNECTIONS = 64


parser = pytest.importorskip("prometheus_client.parser")

ANYWHERE = {"listen": "127.0.0.1:0"}


async def ask(site: OperationsSite, path: str, method: str = "GET") -> tuple[int, str]:
    reader, writer = await asyncio.open_connection("127.0.0.1", site.port)
    head = f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
    writer.write(head.encode())
    async with asyncio.timeout(PATIENCE):
        answer = (await reader.read(-1)).decode()
    writer.close()
    head, _, body = answer.partition("\r\n\r\n")
    assert "Server: smartcam" in head
    return int(head.split()[1]), body


def samples(text: str) -> dict[tuple[str, ...], float]:
    """Return the numbers by name and labels' values."""
    found = {}
    for family in parser.text_string_to_metric_families(text):
        for one in family.samples:
            key = (one.name, *(one.labels[name] for name in sorted(one.labels)))
            assert key not in found
            found[key] = one.value
    return found


def file(urls: dict[str, str], **operations: Any) -> FleetFile:
    cameras = {name: {"url": url, "reconnect": {"initial": 5}} for name, url in urls.items()}
    said = {"agent": "a1", "operations": {**ANYWHERE, **operations}, "cameras": cameras}
    return FleetFile.model_validate(said)


@contextlib.asynccontextmanager
async def watched(
    *names: str, **operations: Any
) -> AsyncIterator[tuple[FleetServer, OperationsSite, Fleet, dict[str, NumberedCamera]]]:
    async with contextlib.AsyncExitStack() as stack:
        boxes = {name: await stack.enter_async_context(NumberedCamera()) for name in names}
        bus = MemoryBus()
        urls = {name: box.url for name, box in boxes.items()}
        server = FleetServer(file(urls, **operations), bus=bus.new_connection())
        site = await stack.enter_async_context(OperationsSite(server))
        await stack.enter_async_context(server)
        await server.wait_first_attempts()
        fleet = Fleet(bus.new_connection(), None, "plant", None, PATIENCE, {})
        yield server, site, await stack.enter_async_context(fleet), boxes


async def test_it_is_ready_once_each_camera_was_tried_and_stays_so() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:  # a camera that says nothing
        async with EmulatedCamera() as box:
            place = silent.getsockname()[1]
            urls = {"there": box.url, "silent": f"bvs://127.0.0.1:{place}"}
            server = FleetServer(file(urls), bus=MemoryBus().new_connection())
            async with OperationsSite(server) as site:

                async def readiness() -> tuple[int, dict[str, Any]]:
                    status, text = await ask(site, "/readyz")
                    return status, json.loads(text)

                status, said = await readiness()
                assert (status, said["reason"]) == (503, "the agent is not on the bus")
                assert await ask(site, "/healthz") == (200, "ok\n")
                async with server:
                    await until(lambda: server.shared_cameras["there"].connected)
                    status, said = await readiness()
                    assert (status, said["reason"]) == (503, "1 of 2 cameras were tried")
                    await server.wait_first_attempts()
                    status, said = await readiness()
                    assert (status, said["ready"], said["agent"]) == (200, True, "a1")
                    assert (said["connected"], said["not_connected"]) == (1, ["silent"])
                    await box.stop()
                    await until(lambda: not server.shared_cameras["there"].connected)
                    status, said = await readiness()
                    assert (status, said["connected"]) == (200, 0)
                status, said = await readiness()
                assert (status, said["ready"]) == (503, False)


@pytest.mark.real_time
async def test_agent_whose_router_is_gone_is_not_ready_until_that_is_back() -> None:
    hub = FleetFile.model_validate(
        {"agent": "hub", "listen": free_place(), "cameras": {"x": {"emulated": {}}}}
    )
    said = {"agent": "a1", "connect": hub.endpoints[0][0], "operations": ANYWHERE}
    server = FleetServer(FleetFile.model_validate({**said, "cameras": {"one": {"emulated": {}}}}))
    async with contextlib.AsyncExitStack() as stack:
        async with FleetServer(hub):
            site = await stack.enter_async_context(OperationsSite(server))
            await stack.enter_async_context(server)
            await server.wait_first_attempts()
            assert (await ask(site, "/readyz"))[0] == 200
        await until(lambda: not site.readiness()["ready"])
        status, text = await ask(site, "/readyz")
        assert (status, json.loads(text)["connected"]) == (503, 1)
        assert f"nobody answers at {said['connect']}" in json.loads(text)["reason"]
        async with FleetServer(hub):
            await until(lambda: site.readiness()["ready"])


PAGE = (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")


def words_of(title: str, column: int = 0) -> set[str]:
    """Return the words in code of a column of the page's table whose head begins with a title."""
    table = PAGE.partition(f"\n| {title} |")[2].partition("\n\n")[0].splitlines()[2:]
    cells = [row.strip("| ").split(" | ")[column] for row in table]
    return {word for cell in cells for word in re.findall(r"`([^`]+)`", cell)}


def test_page_has_the_words_of_readiness() -> None:
    server = FleetServer(file({"one": "bvs://127.0.0.1:1"}), bus=MemoryBus().new_connection())
    assert set(OperationsSite(server).readiness()) <= words_of("path", 1)


async def test_numbers_are_those_of_the_account() -> None:
    async with watched("one", "two") as (server, site, fleet, boxes):
        for _ in range(3):
            await fleet["one"].trigger()
        await fleet["two"].stop()
        with pytest.raises(SmartCamError):
            await fleet["two"].trigger()
        boxes["one"].device.trigger()
        await until(lambda: server.shared_cameras["one"].client.statistics().received == 4)
        status, text = await ask(site, "/metrics")
        found = samples(text)
        assert status == 200
        assert found["smartcam_connected", "a1", "one"] == 1
        assert found["smartcam_taken", "a1", "one"] == 0
        assert found["smartcam_triggers_total", "a1", "one", "result"] == 3
        assert found["smartcam_triggers_total", "a1", "two", "not_running"] == 1
        assert found["smartcam_triggers_total", "a1", "two", "result"] == 0
        account = server.shared_cameras["one"].client.statistics()
        told = {key[3]: n for key, n in found.items() if key[0] == "smartcam_results_total"}
        assert len(told) == 6
        for fate in told:
            assert found["smartcam_results_total", "a1", "one", fate] == getattr(account, fate)
        assert found["smartcam_results_total", "a1", "one", "streamed"] == 1
        sums = ("smartcam_camera_trigger_latency_seconds_sum", "a1", "one")
        assert found[sums] == pytest.approx(account.processing.total)
        assert found["smartcam_trigger_latency_seconds_count", "a1"] == 3
        assert found["smartcam_trigger_latency_seconds_bucket", "a1", "+Inf"] == 3
        assert found["smartcam_agent_cameras", "a1", "connected"] == 2
        assert found["smartcam_agent_programs", "a1"] == 1
        assert found["smartcam_agent_kept_results", "a1"] == 4
        assert found["smartcam_sessions_total", "a1", "two"] == 1
        assert found["smartcam_received_bytes_total", "a1"] == sum(
            host.client.statistics().bytes_received for host in server.shared_cameras.values()
        )
        assert found["smartcam_agent_info", "a1", "plant", smartcam.__version__] == 1


async def test_camera_that_another_client_took_is_in_the_numbers() -> None:
    async with watched("one") as (server, site, _, boxes):
        host = server.shared_cameras["one"]
        for _ in range(2):
            await until(lambda: host.connected)
            async with smartcam.connect(boxes["one"].url):
                await until(lambda: not host.connected)
        await until(lambda: host.client.is_taken)
        found = samples((await ask(site, "/metrics"))[1])
        assert (found["smartcam_connected", "a1", "one"], found["smartcam_taken", "a1", "one"]) == (
            0,
            1,
        )


async def test_sums_do_not_go_down_when_a_camera_goes() -> None:
    async with watched("one", "two") as (server, site, fleet, boxes):
        await fleet.trigger()
        sums = ("smartcam_trigger_latency_seconds_count", "smartcam_received_bytes_total")
        before = samples((await ask(site, "/metrics"))[1])
        assert before[sums[0], "a1"] == 2
        await server.reload(file({"two": boxes["two"].url}))
        after = samples((await ask(site, "/metrics"))[1])
        assert after[sums[0], "a1"] == 2
        assert after[sums[1], "a1"] >= before[sums[1], "a1"]
        assert ("smartcam_connected", "a1", "one") not in after
        assert after["smartcam_reloads_total", "a1", "done"] == 1


async def test_each_camera_may_have_a_histogram() -> None:
    async with watched("one", latency="camera") as (_, site, fleet, _boxes):
        await fleet["one"].trigger()
        found = samples((await ask(site, "/metrics"))[1])
        name = "smartcam_camera_trigger_latency_seconds"
        assert found[f"{name}_bucket", "a1", "one", "+Inf"] == 1
        assert found[f"{name}_bucket", "a1", "one", "0.0001"] == 0
        assert found[f"{name}_count", "a1", "one"] == 1


async def test_the_text_grows_by_a_few_lines_for_a_camera_and_by_no_labels_of_others() -> None:
    async with watched("one") as (server, _site, fleet, _boxes):
        await fleet["one"].trigger()
        numbers = await read_counts(server)
        assert numbers is not None

    async def lines(count: int) -> int:
        cameras = [numbers.cameras[0]._replace(name=f"line/cam{n}") for n in range(count)]
        text, _ = await exposition(numbers._replace(cameras=cameras), per_camera=False)
        assert text.count(b"# TYPE smartcam_connected ") == 1
        assert (
            len([one for one in samples(text.decode()) if one[0] == "smartcam_connected"]) == count
        )
        return text.count(b"\n")

    assert await lines(101) - await lines(1) == 100 * 12


async def test_who_asks_at_the_same_time_gets_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []

    async def counted(server: FleetServer) -> Any:
        read.append(1)
        await asyncio.sleep(1.0)
        return await read_counts(server)

    monkeypatch.setattr("smartcam.web._operations.read_counts", counted)
    async with watched("one") as (_, site, _fleet, _boxes):
        answers = await asyncio.gather(*(ask(site, "/metrics") for _ in range(20)))
        assert len({text for _, text in answers}) == 1
        assert len(read) == 1
        await ask(site, "/metrics")
        assert len(read) == 2


async def test_nothing_else_is_there_and_connections_are_bounded() -> None:
    async with watched("one") as (_, site, _fleet, _boxes):
        assert (await ask(site, "/"))[0] == 404
        status, text = await ask(site, "/metrics", "POST")
        assert (status, "/healthz" in text) == (405, True)
        many = [
            await asyncio.open_connection("127.0.0.1", site.port)
            for _ in range(MAX_CONNECTIONS + 10)
        ]
        assert await ask(site, "/healthz") == (200, "ok\n")  # the idle ones made room
        assert site._open_port is not None
        assert len(site._open_port.places) <= MAX_CONNECTIONS
        for _, writer in many:
            writer.close()


async def asked_as(port: int, host: str) -> tuple[int, str]:
    """Ask for the health by a name of the machine; return status and text."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(f"GET /healthz HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
    async with asyncio.timeout(PATIENCE):
        head, _, text = (await reader.read(-1)).decode().partition("\r\n\r\n")
    writer.close()
    return int(head.split()[1]), text


ATTACKER = "attacker.example"


@pytest.mark.parametrize(
    ("listen", "names", "host", "status"),
    [
        ("127.0.0.1:0", [], "localhost:9464", 200),
        ("127.0.0.1:0", [], "127.0.0.1", 200),
        ("127.0.0.1:0", [], "[::1]:9464", 200),
        ("127.0.0.1:0", [], ATTACKER, 403),
        ("127.0.0.1:0", [], "10.0.0.1", 403),
        ("127.0.0.1:0", ["agent1.plant.example"], "agent1.plant.example", 403),
        ("127.0.0.1:0", [], "", 403),
        ("127.0.0.1:0", [], "[::1", 403),
        ("0.0.0.0:0", [], "10.0.0.1:9464", 200),
        ("0.0.0.0:0", [], "localhost", 200),
        ("0.0.0.0:0", [], socket.gethostname(), 200),
        ("0.0.0.0:0", ["Agent1.plant.example"], "agent1.PLANT.example:9464", 200),
        ("0.0.0.0:0", ["agent1.plant.example"], ATTACKER, 403),
        ("0.0.0.0:0", [], f"{socket.gethostname()}.{ATTACKER}", 403),
    ],
)
async def test_who_asks_by_another_machines_name_gets_nothing(
    listen: str, names: list[str], host: str, status: int
) -> None:
    async with watched("one", listen=listen, names=names) as (_, site, _fleet, _boxes):
        got, text = await asked_as(site.port, host)
        assert got == status, text
        if status == 403:
            assert text.startswith("403 Host ")
            assert "expected" in text


@pytest.mark.parametrize("name", ["", "http://x", "a b", "-x", "x/y"])
def test_a_name_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="names"):
        file({}, names=[name])


async def test_it_stops_while_somebody_asks_and_starts_again() -> None:
    async with watched("one") as (_, site, _fleet, _boxes):
        asking = [asyncio.create_task(ask(site, "/metrics")) for _ in range(3)]
        for _ in range(20):
            await asyncio.sleep(0)
        await site.stop()
        await asyncio.gather(*asking, return_exceptions=True)
        await site.stop()
        with pytest.raises(ConnectionRefusedError):
            await ask(site, "/healthz")
        await site.start()
        assert await ask(site, "/healthz") == (200, "ok\n")


async def test_what_cannot_be_is_reported_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    nowhere = FleetServer(file({"one": "bvs://h"}, listen=None), bus=MemoryBus().new_connection())
    with pytest.raises(ConfigurationError, match="nowhere to listen"):
        OperationsSite(nowhere)
    server = FleetServer(file({"one": "bvs://h"}), bus=MemoryBus().new_connection())
    with socket.create_server(("127.0.0.1", 0)) as taken:
        place = f"127.0.0.1:{taken.getsockname()[1]}"
        site = OperationsSite(server, listen=place)
        with pytest.raises(ConfigurationError, match=f"cannot listen on {place}"):
            await site.start()
    assert OperationsSite(server, listen="[::1]:9464").port == 9464
    for wrong in ("here", ":1", "h:70000", "h:1:2"):
        with pytest.raises(ConfigurationError, match="expected HOST:PORT"):
            OperationsSite(server, listen=wrong)
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with pytest.raises(MissingExtraError, match=r"smartcam\[operations\]"):
        OperationsSite(server)
