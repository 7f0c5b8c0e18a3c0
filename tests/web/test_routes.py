"""The calls of the emulator's site: what they do, what they refuse, what they draw."""

from __future__ import annotations

import asyncio
import itertools
import json
import math
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam.emulator import EmulatedCamera
from smartcam.emulator._inside import PIECES, TABLE_SIZE, LogEntry
from smartcam.emulator.faults import FAULTS
from smartcam.exceptions import ConfigurationError
from smartcam.models import Status
from smartcam.web import EmulatorSite
from smartcam.web._shapes import OUTLINES, SIDE
from tests.web.inside import EMULATOR_CALLS as CALLS
from tests.web.inside import EMULATOR_MAX_PARTS as MAX_PARTS
from tests.web.inside import (
    MAX_BODY_BYTES,
    MAX_HEX_BYTES,
    MAX_REPLY_BYTES,
    MAX_VALUES_BYTES,
    Streams,
)
from tests.web.sitekit import Raw, served

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from smartcam.web._shapes import Outline

# ---------------------------------------------------------------------- what they tell


async def test_list_of_calls_has_every_call() -> None:
    async with served() as world:
        calls = (await world.caller.get("/api"))["calls"]
    assert [(one["method"], one["path"]) for one in calls] == [(c.method, c.path) for c in CALLS]
    assert all(one["about"] for one in calls)


async def test_cameras_tells_each_in_short() -> None:
    async with (
        EmulatedCamera(active=7, running=True) as one,
        EmulatedCamera(transport="udp", dialect="thesis") as other,
        EmulatorSite({"one": one, "other": other}) as site,
        served() as world,
    ):
        world.caller.site = site
        cameras = (await world.caller.get("/api/cameras"))["cameras"]
    assert cameras == [
        {
            "name": "one",
            "url": one.url,
            "mode": "running",
            "status": ["RUNNING", "WAITING_FOR_TRIGGER"],
            "active_application": 7,
            "session": None,
        },
        {
            "name": "other",
            "url": other.url,
            "mode": "stopped",
            "status": [],
            "active_application": 1,
            "session": None,
        },
    ]


async def test_camera_tells_its_state() -> None:
    async with served(active=21, quirks={"reboot_time": 5}) as world:
        async with smartcam.connect(world.emulator.url):
            world.clock.advance(2)
            state = await world.caller.get()
            links = world.emulator.links
        log = world.emulator.log.since(0)
    expected = {
        "name": "camera",
        "url": world.emulator.url,
        "host": "127.0.0.1",
        "port": world.emulator.port,
        "transport": "tcp",
        "dialect": "handbook",
        "mode": "stopped",
        "status": [],
        "status_word": 0,
        "conditions": {"overheat": False, "system_error": False},
        "running": False,
        "processing": False,
        "active_application": 21,
        "session": links[0],
        "links": links,
        "next_number": 0,
        "queued_inputs": 0,
        "endian": 0,
        "quirks_chosen": {"reboot_time": 5.0},
        "commands": [],
        "faults": {"waiting": 0, "fired": 0},
        "time": 2.0,
        "clock_time": "1970-01-01T00:00:02+00:00",
    }
    assert {key: state[key] for key in expected} == expected
    assert state["log"] == {"first": 0, "next": log[1] - 1}  # the Disconnect came later
    assert state["quirks"]["second_client"] == "takeover"
    assert state["applications"][-1] == {
        "id": 21,
        "name": "greeting",
        "layout": "text: string[20]",
        "input": None,
        "rate": None,
        "load_time": 0.3,
        "processing_time": 0.05,
    }


async def test_kinds_of_faults_have_their_schemas() -> None:
    async with served() as world:
        kinds = (await world.caller.get("/api/faults"))["kinds"]
    assert [one["kind"] for one in kinds] == list(FAULTS)
    delay = next(one for one in kinds if one["kind"] == "delay")
    assert (delay["of"], delay["about"]) == ("wire", "The message comes later.")
    assert delay["schema"]["required"] == ["seconds"]
    assert next(one for one in kinds if one["kind"] == "reboot")["of"] == "device"


@pytest.mark.parametrize("name", ["line 1", "a/b", "ü?#%", "50%2F"])
async def test_camera_with_any_name_is_found(name: str) -> None:
    async with served(name) as world:
        assert (await world.caller.get())["name"] == name
        assert (await world.caller.post("start"))["camera"]["running"] is True


@pytest.mark.parametrize("name", ["", ".", "..", "a\nb"])
def test_camera_with_a_name_that_no_path_holds_is_refused(name: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        EmulatorSite({name: EmulatedCamera()})
    assert str(caught.value) == f"web: {name!r} cannot stand in a path: name the camera"


# ---------------------------------------------------------------------- what they do


async def test_trigger_brings_the_client_a_result() -> None:
    async with (
        served(active=21, running=True) as world,
        smartcam.connect(world.emulator.url, interpret_as="text: string[20]") as camera,
    ):
        waiting = asyncio.create_task(camera.next_result(timeout=60))
        await asyncio.sleep(0)  # let it begin to wait
        answer = await world.caller.post("trigger")
        assert answer["taken"] is True
        assert answer["camera"]["processing"] is True
        world.clock.advance(0.05)
        assert (await waiting).value.text == "Hello World"


async def test_trigger_of_a_stopped_camera_is_not_taken() -> None:
    async with served() as world:
        answer = await world.caller.post("trigger")
    assert (answer["taken"], answer["camera"]["mode"]) == (False, "stopped")


async def test_start_and_stop_are_seen_by_the_client() -> None:
    async with served() as world, smartcam.connect(world.emulator.url) as camera:
        assert (await world.caller.post("start"))["camera"]["running"] is True
        await camera.wait_status(lambda status: Status.RUNNING in status, timeout=60)
        assert (await world.caller.post("stop", {}))["camera"]["running"] is False
        await camera.wait_status(lambda status: Status.RUNNING not in status, timeout=60)


async def test_application_is_loaded_and_runs() -> None:
    async with served() as world:
        answer = await world.caller.post("application", {"id": 7, "running": True})
        assert answer["camera"]["mode"] == "switching"
        again = await world.caller.call("POST", "application", {"id": 9})
        world.clock.advance(0.5)
        state = await world.caller.get()
    assert again.status == 409
    assert again.value["received"] == "the camera is switching"
    assert (state["active_application"], state["mode"]) == (7, "running")


async def test_reboot_takes_the_seconds_it_is_given_or_the_quirks() -> None:
    async with served(quirks={"reboot_time": 7}) as world:
        modes: list[str] = []
        for body, seconds in (({"seconds": 0.5}, 0.5), ({}, 7.0), (None, 7.0)):
            modes.append((await world.caller.post("reboot", body))["camera"]["mode"])
            world.clock.advance(seconds - 0.01)
            modes.append((await world.caller.get())["mode"])
            world.clock.advance(0.01)
            modes.append((await world.caller.get())["mode"])
    assert modes == ["rebooting", "rebooting", "stopped"] * 3


async def test_conditions_change_those_that_are_named() -> None:
    async with served() as world:
        await world.caller.post("conditions", {"overheat": True, "system_error": True})
        assert world.emulator.device.status == Status.OVERHEAT | Status.SYSTEM_ERROR
        answer = await world.caller.post("conditions", {"system_error": False})
    assert answer["camera"]["status"] == ["OVERHEAT"]
    assert answer["camera"]["conditions"] == {"overheat": True, "system_error": False}


async def test_endian_is_that_of_results() -> None:
    async with served() as world:
        answer = await world.caller.post("endian", {"endian": 1})
    assert answer["camera"]["endian"] == world.emulator.device.endian == 1


async def test_faults_wait_happen_and_are_cleared() -> None:
    async with served(active=21, running=True) as world:
        drop = {"kind": "drop", "on": "QueryAnswer", "times": None}
        listed = await world.caller.post(
            "faults", [drop, {"kind": "condition", "condition": "overheat"}]
        )
        assert listed["waiting"] == [drop]
        (fired,) = listed["fired"]
        assert fired == {
            "time": 0.0,
            "fault": {"kind": "condition", "condition": "overheat"},
            "message": None,
        }
        assert world.emulator.device.status & Status.OVERHEAT
        one = await world.caller.post("faults", {"kind": "insert", "data": "00ff"})
        assert one["waiting"][1] == {"kind": "insert", "data": "00ff"}
        assert one == await world.caller.get("faults")
        cleared = await world.caller.call("DELETE", "faults")
    assert (cleared.value["waiting"], cleared.value["waiting_count"]) == ([], 0)


async def test_commands_are_those_of_the_timeline(tmp_path: Any) -> None:
    path = tmp_path / "line.yaml"
    path.write_text(
        "timeline:\n  - {command: sensor, do: {kind: condition, condition: overheat}}\n"
    )
    async with served(scenario=path) as world:
        assert (await world.caller.get())["commands"] == ["sensor"]
        answer = await world.caller.post("commands/sensor")
        unknown = await world.caller.call("POST", "commands/door")
    assert answer["camera"]["status"] == ["OVERHEAT"]
    assert (unknown.status, unknown.value["received"]) == (404, "no command is called 'door'")
    assert unknown.value["expected"] == "sensor"


# ---------------------------------------------------------------------- the scene


async def test_scene_has_parts_field_of_view_and_what_was_reported() -> None:
    async with (
        served(active=7, running=True) as world,
        smartcam.connect(world.emulator.url, interpret_as="localizations"),
    ):
        assert (await world.caller.get("scene"))["reported"] is None
        await world.caller.post("trigger")
        world.clock.advance(0.08)
        scene = await world.caller.get("scene")
    assert [one["name"] for one in scene["parts"]] == list(PIECES)
    square = next(one for one in scene["parts"] if one["name"] == "square")
    assert (square["x"], square["y"], square["theta"]) == PIECES["square"]
    assert len(square["outline"]) == 4
    assert square["in_view"] is True
    assert len(scene["field_of_view"]) == 4
    reported = {one["name"]: one for one in scene["reported"]["parts"]}
    assert (scene["reported"]["application"], scene["reported"]["time"]) == (7, 0.08)
    for name, pose in PIECES.items():
        assert math.dist((reported[name]["x"], reported[name]["y"]), pose[:2]) < 0.0005


async def test_part_is_put_and_taken_off() -> None:
    async with served() as world:
        pieces = world.emulator.scene.pieces
        put = await world.caller.call("PUT", "scene/parts/square", {"x": 0.2, "y": 0.1, "theta": 1})
        assert pieces["square"] == (0.2, 0.1, 1.0)
        new = await world.caller.call("PUT", "scene/parts/a%20bolt", {"x": 9, "y": 0})
        assert pieces["a bolt"] == (9.0, 0.0, 0.0)
        await world.caller.call("DELETE", "scene/parts/square")
        assert "square" not in pieces
        gone = await world.caller.call("DELETE", "scene/parts/square")
        await world.caller.post("scene/reset")
        assert pieces == PIECES
    assert put.value["parts"][5]["x"] == 0.2
    bolt = new.value["parts"][-1]
    assert (bolt["name"], bolt["outline"], bolt["in_view"]) == ("a bolt", None, False)
    assert (gone.status, gone.value["received"]) == (404, "no part is called 'square'")


async def test_parts_are_no_more_than_fit() -> None:
    async with served() as world:
        for index in range(MAX_PARTS):
            world.emulator.scene.pieces[f"{index}"] = PIECES["square"]
        answer = await world.caller.call("PUT", "scene/parts/one-more", {"x": 0, "y": 0})
        long = await world.caller.call("PUT", f"scene/parts/{'a' * 51}", {"x": 0, "y": 0})
    assert (answer.status, answer.value["expected"]) == (422, "100 parts on a table at most")
    assert long.value["expected"] == "a name of 1 to 50 printable ASCII characters"


# ---------------------------------------------------------------------- the log


async def test_log_goes_on_from_a_serial() -> None:
    async with served(active=21, running=True) as world, smartcam.connect(world.emulator.url):
        first = await world.caller.get("log?limit=2")
        rest = await world.caller.get(f"log?since={first['next']}")
        nothing = await world.caller.get(f"log?since={rest['next']}")
    entries = [*first["entries"], *rest["entries"]]
    assert [one["serial"] for one in entries] == list(range(len(entries)))
    connect = next(i for i, one in enumerate(entries) if one["message"] == "Connect")
    asked, answer, status = entries[connect : connect + 3]
    assert (asked["direction"], asked["fields"], asked["hex"]) == ("in", {}, "")
    assert (answer["message"], answer["fields"]) == ("ConnectAnswer", {"version": 1})
    assert (status["direction"], status["message"]) == ("out", "StatusReport")
    assert status["fields"] == {"status": ["RUNNING", "WAITING_FOR_TRIGGER"], "endian": 0}
    assert status["hex"] == "80 02 00 00 00 00 00 00"
    assert (nothing["entries"], nothing["next"]) == ([], rest["next"])


async def test_log_shows_a_result_decoded() -> None:
    async with served(active=21, running=True) as world, smartcam.connect(world.emulator.url):
        await world.caller.post("trigger")
        world.clock.advance(0.05)
        entries = (await world.caller.get("log"))["entries"]
    result = next(one for one in entries if one["message"] == "ResultContainer")
    assert result["fields"] == {"application": 21}
    assert result["values"] == {"text": "Hello World"}
    assert (result["time"], result["message_id"], result["size"]) == (0.05, 0x20, 24)


async def test_log_cuts_a_long_payload_and_one_entry_has_all() -> None:
    layout = f"a: string[{MAX_HEX_BYTES}], b: string[{MAX_VALUES_BYTES}]"
    long = {"id": 5, "layout": layout, "constant": {"a": "x", "b": "y"}, "processing_time": 0}
    async with (
        served(applications=[long], running=True) as world,
        smartcam.connect(world.emulator.url),
    ):
        await world.caller.post("trigger")
        entries = (await world.caller.get("log"))["entries"]
        cut = next(one for one in entries if one["message"] == "ResultContainer")
        whole = await world.caller.get(f"log/{cut['serial']}")
    assert cut["size"] == whole["size"] == 4 + MAX_HEX_BYTES + MAX_VALUES_BYTES
    assert (len(bytes.fromhex(cut["hex"])), cut["values"]) == (MAX_HEX_BYTES, None)
    assert len(bytes.fromhex(whole["hex"])) == whole["size"]
    assert whole["values"] == {"a": "x", "b": "y"}


def large(count: int) -> dict[str, Any]:
    """Return an application whose results are as long as a list of entries shows any."""
    layout = "(text: string[100])*"
    values = [{"text": f"{number}"} for number in range((MAX_VALUES_BYTES - 4) // 100)]
    return {"id": count, "layout": layout, "constant": values, "processing_time": 0}


async def test_log_ends_where_it_told_enough_and_goes_on_from_there() -> None:
    async with (
        served(applications=[large(5)], running=True) as world,
        smartcam.connect(world.emulator.url),
    ):
        for _ in range(300):
            assert world.emulator.device.trigger()
            world.clock.advance(0)
        count = world.emulator.log.since(0)[1]
        seen: list[int] = []
        answers = 0
        while len(seen) < count:
            part = await world.caller.get(f"log?since={len(seen)}")
            assert sum(one["size"] for one in part["entries"]) <= MAX_REPLY_BYTES + MAX_VALUES_BYTES
            seen += [one["serial"] for one in part["entries"]]
            answers += 1
    assert seen == list(range(count))
    assert answers == 3


async def test_log_tells_what_was_pushed_out() -> None:
    async with served(running=True, active=21) as world, smartcam.connect(world.emulator.url):
        world.emulator.log.max_bytes = 5000
        for _ in range(20):
            world.emulator.device.trigger()
            world.clock.advance(1)
        gone = world.emulator.log.dropped_count
        part = await world.caller.get("log")
    assert gone > 20
    assert (part["missed"], part["entries"][0]["serial"]) == (gone, gone)


async def test_log_cuts_what_really_passed_too() -> None:
    passed = bytes(5000).hex(" ")
    async with served() as world:
        world.emulator.log.append(
            LogEntry(0.0, "out", "somebody", 0x01, None, "01", None, "corrupt", passed)
        )
        (cut,) = (await world.caller.get("log"))["entries"]
        whole = await world.caller.get("log/0")
    assert (cut["hex"], cut["size"], cut["wire_size"]) == ("01", 1, 5000)
    assert len(bytes.fromhex(cut["wire"])) == MAX_HEX_BYTES
    assert whole["wire"] == passed


async def test_list_of_faults_ends_where_it_told_enough() -> None:
    async with served() as world:
        large = {"kind": "insert", "on": "QueryAnswer", "data": "00" * 60_000}
        for _ in range(10):
            await world.caller.post("faults", large)
        told = await world.caller.get("faults")
    assert (len(told["waiting"]), told["waiting_count"]) == (4, 10)


async def test_log_tells_what_is_gone() -> None:
    async with served() as world, smartcam.connect(world.emulator.url):
        count = (await world.caller.get())["log"]["next"]
        cleared = await world.caller.call("DELETE", "log")
        log = await world.caller.get("log?since=1")
        gone = await world.caller.call("GET", "log/0")
    assert cleared.value == {"next": count}
    assert (log["entries"], log["next"], log["missed"]) == ([], count, count - 1)
    assert (gone.status, gone.value["expected"]) == (404, "one that is there: none")


async def test_log_marks_faults_and_errors() -> None:
    lost = {"kind": "drop", "on": "ConnectAnswer"}
    async with served(faults=[lost]) as world:
        reader, writer = await asyncio.open_connection("127.0.0.1", world.emulator.port)
        writer.write(bytes.fromhex("50535642 00000000 30000000"))  # Query, without Connect
        writer.write(bytes.fromhex("50535642 00000000 01000000"))  # Connect
        assert (await reader.readexactly(20))[8] == 0x12  # the status
        entries = (await world.caller.get("log"))["entries"]
        writer.close()
        await writer.wait_closed()
    query, ignored, _, answer, _ = entries
    assert (query["message"], ignored["message"], ignored["message_id"]) == ("Query", None, None)
    assert "not expected" in ignored["error"]
    assert (answer["message"], answer["fault"], answer["wire"]) == ("ConnectAnswer", "drop", "")


async def test_log_waits_for_the_first_entry() -> None:
    async with served() as world, smartcam.connect(world.emulator.url):
        count = (await world.caller.get())["log"]["next"]
        waiting = asyncio.create_task(world.caller.get(f"log?since={count}&wait=5"))
        empty = await world.caller.get(f"log?since={count}&wait=0.05")
        world.emulator.device.set_endian(1)
        (entry,) = (await waiting)["entries"]
    assert empty["entries"] == []
    assert (entry["message"], entry["fields"]["endian"]) == ("StatusReport", 1)


async def test_log_that_waits_ends_with_the_site(monkeypatch: pytest.MonkeyPatch) -> None:
    waits = asyncio.Event()
    wait_closing = Streams.wait_closing

    def told(streams: Streams, seconds: float) -> Coroutine[Any, Any, bool]:
        waits.set()
        return wait_closing(streams, seconds)

    monkeypatch.setattr(Streams, "wait_closing", told)
    async with served() as world:
        waiting = asyncio.create_task(world.caller.get("log?wait=30"))
        async with asyncio.timeout(60):
            await waits.wait()
            await world.site.stop()
            assert (await waiting)["entries"] == []


# ---------------------------------------------------------------------- what they refuse


async def test_unknown_camera_is_404_with_those_there_are() -> None:
    async with served() as world:
        answer = await world.caller.call("POST", "/api/cameras/line%202/trigger")
    assert answer.status == 404
    assert answer.value == {
        "error": "POST /api/cameras/line 2/trigger: no camera is called 'line 2'; expected camera",
        "tried": "POST /api/cameras/line 2/trigger",
        "received": "no camera is called 'line 2'",
        "expected": "camera",
    }


@pytest.mark.parametrize(
    ("path", "body", "field", "came", "expected"),
    [
        ("application", {"id": 5}, "id", "5", "one of 1, 3, 7, 9, 21"),
        ("application", {"id": "7"}, "id", "'7'", "a valid integer"),
        ("application", {}, "id", "nothing", "a value"),
        ("application", {"id": 7, "run": True}, "run", "True", "no such field"),
        ("conditions", {"overheat": 1}, "overheat", "1", "a valid boolean"),
        ("conditions", {}, "", "{}", "overheat, system_error or both, true or false"),
        ("endian", {"endian": -1}, "endian", "-1", "greater than or equal to 0"),
        ("reboot", {"seconds": 1e9}, "seconds", "1000000000.0", "less than or equal to 3600"),
        ("faults", {"kind": "drop", "nth": 0}, "0.drop.nth", "0", "greater than or equal to 1"),
        ("faults", 5, "", "5", "a valid list"),
    ],
)
async def test_wrong_field_is_422_with_its_name(
    path: str, body: object, field: str, came: str, expected: str
) -> None:
    async with served() as world:
        answer = await world.caller.call("POST", path, body)
    assert answer.status == 422
    assert answer.value["fields"] == [{"field": field, "received": came, "expected": expected}]
    assert answer.value["error"].startswith(f"POST /api/cameras/camera/{path}: ")


async def test_fault_that_the_dialect_lacks_is_422_and_none_is_added() -> None:
    async with served() as world:
        answer = await world.caller.call(
            "POST", "faults", [{"kind": "drop"}, {"kind": "drop", "on": "TriggerAnswer"}]
        )
        assert world.emulator.faults == []
    assert answer.status == 422
    assert "fault 2" in answer.value["received"]


@pytest.mark.parametrize(
    ("data", "kind", "status", "text"),
    [
        (b"{", "application/json", 400, "a body that is no JSON"),
        (b"[" * 100_000, "application/json", 400, "a body that is no JSON"),
        (b"1" * 5000, "application/json", 400, "a body that is no JSON"),
        (b'{"seconds": NaN}', "application/json", 400, "NaN is no number"),
        (b"\xff", "application/json", 400, "a body that is no JSON"),
        (b"seconds=1", "application/x-www-form-urlencoded", 415, "with curl: --json"),
        (b'{"seconds": 1}', "text/plain", 415, "with curl: --json"),
        (b" " * (MAX_BODY_BYTES + 1), "application/json", 413, f"{MAX_BODY_BYTES} bytes at most"),
    ],
)
async def test_body_that_cannot_be_read_is_refused(
    data: bytes, kind: str, status: int, text: str
) -> None:
    async with served() as world:
        answer = await world.caller.call(
            "POST", "reboot", data=data, headers={"Content-Type": kind}
        )
        assert world.emulator.device.rebooting is False
    assert answer.status == status
    assert text in answer.value["error"]


async def test_body_that_no_call_takes_is_refused() -> None:
    async with served() as world:
        body = await world.caller.call("POST", "trigger", {"times": 3})
        none = await world.caller.call("POST", "application")
        query = await world.caller.call("GET", "scene?since=3")
        limit = await world.caller.call("GET", "log?limit=1001")
    assert (body.status, body.value["received"]) == (422, "the body {'times': 3}")
    assert (none.status, none.value["expected"]) == (
        422,
        'JSON, for example {"id": 7, "running": true}',
    )
    assert (query.status, query.value["received"]) == (422, "the query {'since': '3'}")
    assert limit.value["fields"][0]["field"] == "limit"


async def test_wrong_method_is_405_with_those_allowed() -> None:
    async with served() as world:
        answer = await world.caller.call("GET", "trigger")
        unknown = await world.caller.call("GET", "/api/nothing")
    assert (answer.status, answer.headers["Allow"]) == (405, "POST")
    assert answer.value["expected"] == "POST"
    assert (unknown.status, unknown.value["expected"]) == (404, "one of those that GET /api lists")


async def test_every_sample_is_taken() -> None:
    async with served() as world:
        for call in CALLS:
            if call.sample:
                path = call.path.format(camera="camera", part="square")
                answer = await world.caller.call(call.method, path, json.loads(call.sample))
                assert answer.status == 200, call
                world.clock.advance(1)


async def test_unfinished_body_ends_with_the_site() -> None:
    async with served() as world, Raw.connected(world.site) as raw:
        raw.writer.write(
            b"POST /api/cameras/camera/reboot HTTP/1.1\r\nHost: localhost\r\n"
            b"Content-Type: application/json\r\nContent-Length: 50\r\n\r\n{"
        )
        await raw.writer.drain()
        assert (await world.caller.get())["mode"] == "stopped"
        await world.site.stop()
        assert await raw.reader.read() == b""


# ----------------------------------------------------------------------
# The shapes of the tangram pieces.


Point = tuple[float, float]


def edges(outline: Outline) -> list[tuple[Point, Point]]:
    return list(zip(outline, (*outline[1:], outline[0]), strict=True))


def area(outline: Outline) -> float:
    return sum(x1 * y2 - x2 * y1 for (x1, y1), (x2, y2) in edges(outline)) / 2


def placed(name: str) -> Outline:
    x, y, theta = PIECES[name]
    cos, sin = math.cos(theta), math.sin(theta)
    return tuple((x + cos * u - sin * v, y + sin * u + cos * v) for u, v in OUTLINES[name])


def gap(one: Outline, other: Outline) -> float:
    """Return the widest gap that a straight line along an edge has; negative where they touch."""
    widest = -math.inf
    for (x1, y1), (x2, y2) in [*edges(one), *edges(other)]:
        length = math.dist((x1, y1), (x2, y2))
        across = [[((y2 - y1) * x + (x1 - x2) * y) / length for x, y in s] for s in (one, other)]
        (low, high), (low2, high2) = [(min(all_), max(all_)) for all_ in across]
        widest = max(widest, low - high2, low2 - high)
    return widest


def test_outlines_make_one_square() -> None:
    assert list(OUTLINES) == list(PIECES)
    assert all(area(outline) > 0 for outline in OUTLINES.values())  # counter-clockwise
    assert sum(map(area, OUTLINES.values())) == pytest.approx(SIDE**2)
    sizes = {name: area(outline) / SIDE**2 for name, outline in OUTLINES.items()}
    assert sizes["big_triangle_1"] == pytest.approx(1 / 4)
    assert sizes["medium_triangle"] == pytest.approx(1 / 8)
    assert sizes["square"] == pytest.approx(1 / 8)
    assert sizes["parallelogram"] == pytest.approx(1 / 8)
    assert sizes["small_triangle_2"] == pytest.approx(1 / 16)


def test_outlines_are_about_their_centroids() -> None:
    for outline in OUTLINES.values():
        centre = [sum(point[axis] for point in outline) / len(outline) for axis in (0, 1)]
        assert centre == pytest.approx([0.0, 0.0])


def test_pieces_lie_apart_on_the_table_with_their_outlines() -> None:
    shapes = [placed(name) for name in PIECES]
    for x, y in itertools.chain(*shapes):
        assert 0 < x < TABLE_SIZE[0]
        assert 0 < y < TABLE_SIZE[1]
    for one, other in itertools.combinations(shapes, 2):
        assert gap(one, other) > 0.01
