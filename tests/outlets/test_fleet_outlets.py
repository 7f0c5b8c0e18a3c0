"""Outlets of a fleet's agent and of one camera, and the commands for their accounts."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sqlite3
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam.exceptions import ConfigurationError, SmartCamError
from smartcam.fleet import FleetServer, MemoryBus, load_fleet
from smartcam.fleet._inside import FleetOutlets, exposition, read_counts
from smartcam.outlets._inside import StoreQuery, read_store
from smartcam.registry import OUTLETS
from tests.outlets.broker import broker, listener, needs_mosquitto
from tests.outlets.outletkit import FarEnd, ListOutlet, until
from tests.processes import free_port

pytestmark = pytest.mark.real_time

FLEET = """
cameras:
  line1/cam1: {emulated: {}, application: 7, interpret_as: localizations}
outlets:
  store: {kind: sqlite, file: results.sqlite}
"""


def fleet(folder: Path, text: str = FLEET) -> Path:
    path = folder / "fleet.yaml"
    path.write_text(text)
    return path


@contextlib.asynccontextmanager
async def serving(path: Path) -> Any:
    server = FleetServer(path, bus=MemoryBus().new_connection())
    async with FleetOutlets(server) as outlets, server:
        await server.wait_first_attempts()
        await until(lambda: server.shared_cameras["line1/cam1"].connected)
        yield server, outlets.outlets


def rows(folder: Path, query: str) -> list[Any]:
    with contextlib.closing(sqlite3.connect(folder / "results.sqlite")) as database:
        return database.execute(query).fetchall()


async def test_results_of_an_agents_triggers_are_rows_by_the_layout(tmp_path: Path) -> None:
    async with serving(fleet(tmp_path)) as (server, outlets):
        camera = server.shared_cameras["line1/cam1"].client
        for _ in range(5):
            await camera.trigger(timeout=20)
        await until(lambda: outlets.states["store"].counts.delivered >= 5)
        numbers = await read_counts(server)
        text, _ = await exposition(numbers, per_camera=False)
    assert b'smartcam_outlet_results_total{agent="' in text
    assert b'outlet="store"} 5.0' in text
    (count,) = rows(tmp_path, "SELECT COUNT(*) FROM results WHERE kind = 'result'")
    assert count == (5,)
    parts = rows(tmp_path, "SELECT DISTINCT id FROM app_7 WHERE x IS NOT NULL")
    assert len(parts) == 5
    assert (("x", "real64", "m")) in rows(tmp_path, "SELECT name, type, unit FROM fields")


SOFTWARE = """
cameras:
  line1/cam1:
    software:
      frames: shots
      applications:
        7:
          name: spot
          present: {grey: [200, 255], area: [50, 5000]}
          measure: {edge: {across: [[10, 30], [40, 30]]}}
outlets:
  store: {kind: sqlite, file: results.sqlite}
"""


async def test_results_of_a_software_camera_are_typed_and_those_that_failed_are_found(
    tmp_path: Path,
) -> None:
    cv2 = pytest.importorskip("cv2")
    pytest.importorskip("av")
    (tmp_path / "shots").mkdir()
    part = np.full((60, 80), 40, np.uint8)
    cv2.imwrite(str(tmp_path / "shots" / "1.png"), cv2.circle(part.copy(), (30, 30), 12, 240, -1))
    cv2.imwrite(str(tmp_path / "shots" / "2.png"), part)
    async with serving(fleet(tmp_path, SOFTWARE)) as (server, outlets):
        reading = server.shared_cameras["line1/cam1"].client
        assert reading.settings.application_names == {"spot": 7}
        for _ in range(4):
            await reading.trigger(timeout=20)
        await until(lambda: outlets.states["store"].counts.delivered >= 4)
        found = read_store(tmp_path / "results.sqlite", StoreQuery(failed=True))
        assert (found.total, found.failed) == (4, 2)
    assert rows(tmp_path, "SELECT ok, present_count FROM app_7 ORDER BY id") == [(1, 1), (0, 0)] * 2
    units = dict(rows(tmp_path, "SELECT column_name, unit FROM fields WHERE unit != ''"))
    assert units["measure_place"] == units["present_x"] == "px"
    made = FleetOutlets(FleetServer(tmp_path / "fleet.yaml", bus=MemoryBus().new_connection()))
    read = made.interpretation("line1/cam1")  # what waits may be delivered before there is a camera
    assert read is not None
    layout: Any = getattr(read.interpreter(7), "layout", None)
    assert layout.text.startswith("ok: bool, reason: string[80], present_ok: bool")


async def test_a_trigger_without_a_result_is_an_error_row(tmp_path: Path) -> None:
    async with serving(fleet(tmp_path)) as (server, outlets):
        camera = server.shared_cameras["line1/cam1"].client
        await camera.stop()
        with pytest.raises(SmartCamError):
            await server.shared_cameras["line1/cam1"].client.trigger(timeout=5)
        await until(lambda: outlets.states["store"].counts.delivered >= 1)
    assert ("NotRunningError",) in rows(tmp_path, "SELECT error_kind FROM results")


async def test_a_stalled_far_end_holds_up_no_trigger(tmp_path: Path) -> None:
    OUTLETS.register("list", ListOutlet)
    ListOutlet.far = FarEnd()
    ListOutlet.far.stalled = True
    try:
        text = FLEET.replace("store: {kind: sqlite, file: results.sqlite}", "list: {timeout: 600}")
        async with serving(fleet(tmp_path, text)) as (server, outlets):
            for _ in range(10):  # each within its deadline, while the far end takes nothing
                await server.shared_cameras["line1/cam1"].client.trigger(timeout=20)
            found = outlets.states["list"].counts
            assert (found.results, found.delivered, found.spooled) == (10, 0, 10)
    finally:
        OUTLETS._registered.pop("list")
        OUTLETS._loaded.pop("list", None)


@needs_mosquitto
async def test_a_trigger_over_mqtt_reaches_a_camera_of_the_fleet(tmp_path: Path) -> None:
    aiomqtt = pytest.importorskip("aiomqtt")
    pytest.importorskip("zenoh")
    async with broker(tmp_path) as there:
        mqtt = f"mqtt: {{broker: '{there.url}', commands: true}}"
        text = FLEET.replace("store: {kind: sqlite, file: results.sqlite}", mqtt)
        path = fleet(tmp_path, f"listen: tcp/127.0.0.1:{free_port()}\n{text}")
        server = FleetServer(path)
        async with FleetOutlets(server), server:
            await until(lambda: server.shared_cameras["line1/cam1"].connected)
            async with (
                listener(there.port, "smartcam/reply/#") as replies,
                listener(there.port, "smartcam/result/line1/cam1") as heard,
                listener(there.port, "smartcam/outlet/mqtt") as online,
                aiomqtt.Client("127.0.0.1", there.port) as client,
            ):
                await until(lambda: bool(online))
                await client.publish("smartcam/command/trigger/line1/cam1", "{}", qos=1)
                await client.publish("smartcam/command/trigger/line1/none", "{}", qos=1)
                await until(lambda: len(replies) == 2 and bool(heard))
    said = {one["camera"]: one for one in (json.loads(reply.payload) for reply in replies)}
    assert said["line1/cam1"]["ok"], said
    assert said["line1/cam1"]["result"]["application"] == 7
    assert not said["line1/none"]["ok"]


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("  store: {kind: sqlite}", r"line 5.*outlets\.store\.file"),
        ("  store: {kind: sqlit, file: a}", "line 5.*unknown"),
        ("  mqtt: {broker: 'mqtt://a', password: geheim}", "line 5.*is never in this file itself"),
    ],
)
def test_a_wrong_outlet_in_a_fleet_file_is_told_with_its_line(
    tmp_path: Path, line: str, told: str
) -> None:
    path = fleet(tmp_path, FLEET.replace("  store: {kind: sqlite, file: results.sqlite}", line))
    with pytest.raises(ConfigurationError, match=told) as caught:
        load_fleet(path)
    assert "geheim" not in str(caught.value)


async def command(*arguments: str) -> tuple[int, str, str]:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "smartcam", *arguments),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    async with asyncio.timeout(120):
        out, err = await process.communicate()
    return process.returncode or 0, out.decode(), err.decode()


async def test_results_of_one_camera_go_to_a_store_and_the_commands_show_them(
    tmp_path: Path,
) -> None:
    from smartcam.emulator import Application, EmulatedCamera

    path = tmp_path / "outlets.yaml"
    path.write_text("outlets:\n  sqlite: {file: results.sqlite, spool: .}\n")
    layout = "passed: bool, n: int32 @sequence"
    free = Application(id=4, layout=layout, constant={"passed": True}, rate=20)
    async with EmulatedCamera(applications=[free]) as emulator:
        code, out, err = await command(
            *("outlet", emulator.url, str(path), "--application", "4", "--seconds", "3"),
            *("--interpret-as", "passed: bool, n: int32 @sequence", "--json"),
        )
    assert code == 0, err
    account = json.loads(out.splitlines()[-1])
    kept = account["delivered"] + account["spooled"] + sum(account["dropped"].values())
    assert account["results"] == kept > 0
    code, out, err = await command("results", str(tmp_path / "results.sqlite"), "--json")
    assert code == 0, err
    told = json.loads(out.splitlines()[-1])
    assert account["delivered"] <= told["total"] <= account["results"]


async def test_fleet_outlets_shows_the_accounts(tmp_path: Path) -> None:
    path = fleet(tmp_path)
    code, out, err = await command("fleet", "outlets", str(path))
    assert code == 0, err
    assert "no spool yet" in out
    async with serving(path) as (server, outlets):
        await server.shared_cameras["line1/cam1"].client.trigger(timeout=20)
        await until(lambda: outlets.states["store"].counts.delivered == 1)
        code, out, err = await command("fleet", "outlets", str(path), "--json")
    assert code == 0, err
    assert json.loads(out)["counts"] == {
        "results": 1,
        "delivered": 1,
        "spooled": 0,
        "dropped": {},
    }


async def test_a_fleets_url_is_asked_for_accounts_and_for_results(tmp_path: Path) -> None:
    pytest.importorskip("zenoh")
    path = fleet(tmp_path, f"listen: tcp/127.0.0.1:0\n{FLEET}")
    server = FleetServer(path)
    async with FleetOutlets(server) as outlets, server:
        await server.wait_first_attempts()
        await server.shared_cameras["line1/cam1"].client.trigger(timeout=20)
        await until(lambda: outlets.outlets.states["store"].counts.delivered == 1)
        url = f"fleet://127.0.0.1:{server.address.port}"
        code, out, err = await command("fleet", "outlets", url, "--json", "--timeout", "30")
        assert code == 0, err
        (told,) = map(json.loads, out.splitlines())
        assert (told["outlet"], told["trouble"], told["counts"]["delivered"]) == ("store", "", 1)
        code, out, err = await command("results", url, "--since", "8h", "--json", "--timeout", "30")
        assert code == 0, err
        row, total = map(json.loads, out.splitlines())
        assert row["camera"] == "line1/cam1"
        assert (total["outlet"], total["total"], total["failed"]) == ("store", 1, 0)


async def test_results_that_did_not_pass_are_found_with_errors_and_gaps(tmp_path: Path) -> None:
    from smartcam.outlets import OutletContext, OutletEntry

    kind: Any = OUTLETS.load("sqlite")
    settings = kind.settings_class.model_validate({"file": "results.sqlite"})
    store = kind("s", settings, tmp_path, OutletContext(lambda _c, _a: [("passed", "bool", "")]))
    await store.open()
    body = '{{"camera":"a","application":1,"value":{{"passed":{}}}}}'
    await store.deliver(
        [
            OutletEntry("a", 1, 1, "result", 1, 1.7e9, body.format("true")),
            OutletEntry("a", 1, 2, "result", 1, 1.7e9, body.format("false")),
            OutletEntry("a", 1, 3, "error", None, 1.7e9, '{"error":"none came","kind":"X"}'),
            OutletEntry("a", 1, 4, "gap", None, 1.7e9, '{"error":"full","kind":"Gap","lost":5}'),
        ]
    )
    await store.close()
    path = str(tmp_path / "results.sqlite")
    code, out, err = await command("results", path, "--failed", "--json")
    assert code == 0, err
    *shown, total = map(json.loads, out.splitlines())
    assert sorted(one["id"] for one in shown) == ["a/1/2", "a/1/3", "a/1/4/gap"]
    assert total == {
        "total": 4,
        "failed": 3,
        "errors": 1,
        "gaps": 1,
        "lost": 5,
        "at_least": False,
    }
    code, out, err = await command("results", path, "--since", "8h", "--json")
    assert json.loads(out.splitlines()[-1])["total"] == 0
    code, _, err = await command("results", str(tmp_path / "none"))
    assert code == 2
    assert "there is no such file" in err
