"""The live page's site: what it tells of a camera, what it refuses, what bounds it."""

from __future__ import annotations

import asyncio
import contextlib
import json
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, NamedTuple

import aiohttp
import pytest

import smartcam
from smartcam._meanings import good_value_of
from smartcam.emulator import Application, EmulatedCamera, EmulatedInSight
from smartcam.fleet import FleetFile
from smartcam.layout import Layout
from smartcam.models import Localization, Pose, Position, Quaternion, Result
from smartcam.web import FleetSite, LiveSite
from tests.handmade import until
from tests.web.inside import (
    BAR_SECONDS,
    MAX_BARS,
    MAX_FAILURES,
    MAX_NEWS,
    MAX_PARTS,
    MAX_PICTURES,
    MAX_RESULTS,
    MAX_SHOWN_RAW_BYTES,
    MAX_VALUE_CHARACTERS,
    SHIFT_SECONDS,
    SLOT_SECONDS,
    ShiftHistory,
    ShownResult,
    value_fields,
    verdicts,
)
from tests.web.inside import LIVE_CALLS as CALLS
from tests.web.sitekit import TOKEN, Caller, Listener, Raw

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam.camera import Camera

CHECK = "ok: bool, width: real32"
APPLICATIONS = (
    Application(
        id=5,
        layout=CHECK,
        constant={"ok": True, "width": 12.5},
        load_time=0,
        processing_time=0.001,
    ),
    Application(id=6, layout="n: int32", generator="sequence", rate=500, load_time=0,
                processing_time=0.001),
)  # fmt: skip
FAST = smartcam.Backoff(initial=0.01, maximum=0.05)
SUM = ("triggered", "streamed", "late", "wrong_application", "uninterpretable", "unclaimed")


class World(NamedTuple):
    """A camera at the wire, its site, and who calls it."""

    camera: Camera[Any]
    site: LiveSite
    caller: Caller

    @contextlib.asynccontextmanager
    async def events(self, **headers: str) -> AsyncIterator[Listener]:
        url = self.caller.url("/api/events")
        async with self.caller.session.get(url, headers=headers) as response:
            assert response.status == 200
            yield Listener(response)


@contextlib.asynccontextmanager
async def shown(
    url: str, *, control: bool = False, token: str | None = None, **options: Any
) -> AsyncIterator[World]:
    """Show the camera of a URL."""
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    camera = smartcam.connect(url, **{"reconnect": FAST, **options})
    async with (
        LiveSite(camera, control=control, token=token) as site,
        camera,
        aiohttp.ClientSession(headers=headers) as session,
    ):
        yield World(camera, site, Caller(site, session, ""))


@pytest.fixture
async def emulator() -> AsyncIterator[EmulatedCamera]:
    async with EmulatedCamera(APPLICATIONS, active=5, running=True) as emulator:
        yield emulator


# ---------------------------------------------------------------------- calls


async def test_list_of_calls_has_every_call(emulator: EmulatedCamera) -> None:
    async with shown(emulator.url) as world:
        calls = (await world.caller.get("/api"))["calls"]
    assert [(one["method"], one["path"]) for one in calls] == [(c.method, c.path) for c in CALLS]
    assert all(one["about"] for one in calls)


async def test_page_has_its_files_and_the_shared_style(emulator: EmulatedCamera) -> None:
    async with shown(emulator.url) as world:
        for path in ("/", "/live.js", "/live.css", "/base.css"):
            async with world.caller.session.get(world.caller.url(path)) as response:
                assert response.status == 200
                assert "img-src 'self' data:" in response.headers["Content-Security-Policy"]
        assert (await world.caller.call("GET", "/emulator.js")).status == 404


COMMANDS: dict[str, object] = {
    "trigger": {"timeout": 5.0},
    "switch": {"application": 6},
    "start": None,
    "stop": None,
}


@pytest.mark.parametrize("command", COMMANDS)
async def test_command_without_control_is_refused_and_reaches_no_camera(
    emulator: EmulatedCamera, command: str
) -> None:
    async with shown(emulator.url) as world:
        before = world.camera.statistics().frames_sent
        answer = await world.caller.call("POST", f"/api/{command}", COMMANDS[command])
        await world.caller.get("/api/camera")
        await world.caller.get("/api/results")
        assert world.camera.statistics().frames_sent == before
    assert answer.status == 403
    assert "--control" in answer.value["expected"]


async def test_commands_with_control(emulator: EmulatedCamera) -> None:
    async with shown(emulator.url, control=True) as world:
        caller = world.caller
        assert "RUNNING" not in (await caller.post("/api/stop"))["status"]
        refused = await caller.call("POST", "/api/trigger")
        assert (refused.status, "NotRunningError" in refused.value["received"]) == (409, True)
        assert "RUNNING" in (await caller.post("/api/start"))["status"]
        assert (await caller.post("/api/trigger", {"timeout": 30.0}))["number"] == 1
        assert (await caller.post("/api/switch", {"application": 6}))["application"] == 6
        gone = await caller.call("POST", "/api/switch", {"application": 99})
        assert (gone.status, "CommandRejectedError" in gone.value["received"]) == (409, True)


@pytest.mark.parametrize(
    ("call", "body"),
    [
        ("trigger", {"timeout": 61.0}),
        ("trigger", {"timeout": 0.0}),
        ("trigger", {"more": 1}),
        ("switch", {"application": -1}),
        ("switch", {"application": 1 << 32}),
        ("switch", {}),
    ],
)
async def test_call_out_of_bounds_is_refused(
    emulator: EmulatedCamera, call: str, body: object
) -> None:
    async with shown(emulator.url, control=True) as world:
        assert (await world.caller.call("POST", f"/api/{call}", body)).status == 422


async def test_site_is_guarded(emulator: EmulatedCamera) -> None:
    async with shown(emulator.url, control=True) as world, Raw.connected(world.site) as raw:
        status, _ = await raw.call("GET /api/camera HTTP/1.1", "Host: evil.example")
        assert status == 403
        evil = {"Origin": "http://evil.example"}
        answer = await world.caller.call("POST", "/api/trigger", headers=evil)
        assert answer.status == 403
        assert world.camera.statistics().received == 0


async def test_token_is_needed_if_there_is_one(emulator: EmulatedCamera) -> None:
    async with shown(emulator.url, token=TOKEN) as world:
        await world.caller.get("/api/camera")
        for path in ("camera", "results", "picture", "events"):
            other = {"Authorization": "Bearer another-token-of-some"}
            answer = await world.caller.call("GET", f"/api/{path}", headers=other)
            assert answer.status == 401


# ---------------------------------------------------------------------- what is told


async def test_result_is_reported_and_the_account_adds_up(emulator: EmulatedCamera) -> None:
    async with shown(emulator.url, interpret_as=CHECK) as world, world.events() as events:
        first = await events.next("camera")
        assert (first.data["connection"], first.data["control"]) == ("connected", False)
        result = await world.camera.trigger()
        (told,) = (await events.next("results")).data["results"]
        account = await events.until("counts", lambda account: account["received"])
        (later,) = (await events.until("clock", lambda clock: clock["series"]))["series"][-1:]
    assert told["number"] == result.number
    assert told["value"] == {"ok": True, "width": 12.5}
    assert told["verdicts"] == [{"name": "ok", "true": 1, "of": 1, "verdict": "pass"}]
    assert told["raw"] == result.raw.hex(" ")
    assert account["received"] == sum(account[name] for name in SUM) == account["triggered"] == 1
    assert set(later) == {"at", "rate", "latency"}


async def test_rate_is_reported_over_time(emulator: EmulatedCamera) -> None:
    async with shown(emulator.url, application=6) as world, world.events() as events:
        told = await events.until(
            "clock", lambda clock: clock["series"] and clock["series"][-1]["rate"] > 10
        )
        assert told["series"][-1]["latency"] is None


async def test_container_that_cannot_be_read_is_reported(emulator: EmulatedCamera) -> None:
    async with shown(emulator.url, interpret_as="text: string[50]") as world:
        with pytest.raises(smartcam.InterpretationError):
            await world.camera.trigger()
        await until(lambda: world.site.view.entries)
        (told,) = (await world.caller.get("/api/results"))["results"]
        account = (await world.caller.get("/api/camera"))["counts"]
    assert set(told) == {"serial", "error"}
    assert account["uninterpretable"] == account["received"] == 1


async def test_results_are_bounded_and_the_page_is_told_what_it_missed(
    emulator: EmulatedCamera,
) -> None:
    async with shown(emulator.url, application=6) as world:
        await until(lambda: world.site.view.serial > 2 * MAX_RESULTS)
        await world.camera.stop()
        assert len((await world.caller.get("/api/results"))["results"]) == MAX_RESULTS
        async with world.events(**{"Last-Event-ID": "0"}) as events:
            told = await events.next("results")
    assert len(told.data["results"]) == MAX_NEWS
    assert told.data["missed"] == told.data["results"][0]["serial"]
    assert told.serial == str(told.data["results"][-1]["serial"] + 1)


def result_of(value: object, raw: bytes = b"") -> Result[Any]:
    return Result(
        camera="c", application=7, sequence=None, number=1, triggered_at=None,
        received_at=datetime.now(UTC), latency=None, raw=raw, value=value,
    )  # fmt: skip


def test_long_values_are_cut() -> None:
    told = ShownResult(0, result_of(["x" * MAX_VALUE_CHARACTERS], bytes(1000)), "").as_json()
    assert "value" not in told
    assert len(json.dumps(told)) < MAX_VALUE_CHARACTERS
    assert told["raw"] == bytes(MAX_SHOWN_RAW_BYTES).hex(" ")
    assert told["size"] == 1000


def test_parts_are_reported_in_the_plane_and_bounded() -> None:
    header = smartcam.Header(1, datetime.now(UTC), "table")
    pose = Pose(header, Position(0.1, 0.2), Quaternion.from_theta(0.5))
    found = [Localization("bolt", 0.9, 0, pose)] * (MAX_PARTS + 1)
    told = ShownResult(0, result_of(found), "").as_json()
    assert (len(told["parts"]), told["count"], told["frame"]) == (MAX_PARTS, MAX_PARTS + 1, "table")
    assert told["parts"][0] == pytest.approx(
        {"name": "bolt", "quality": 0.9, "x": 0.1, "y": 0.2, "z": 0.0, "theta": 0.5}
    )
    assert ShownResult(0, result_of([]), "").as_json()["parts"] == []


@pytest.mark.parametrize(
    ("name", "good"),
    [
        ("ok", True),
        ("Pass", True),
        ("code_valid", True),
        ("nok", False),
        ("defect", False),
        ("not_ok", False),
        ("no_error", True),
        ("present", None),
        ("token", None),
        ("ok_or_defect", None),
    ],
)
def test_what_is_good_is_judged_by_the_name(name: str, good: bool | None) -> None:
    assert good_value_of(name) is good


def test_verdict_of_records_counts() -> None:
    records = [{"ok": True, "here": False}, {"ok": False, "here": False}]
    assert verdicts(records) == [
        {"name": "ok", "true": 1, "of": 2, "verdict": "fail"},
        {"name": "here", "true": 0, "of": 2, "verdict": None},
    ]
    assert verdicts([{"defect": False}])[0]["verdict"] == "pass"
    assert verdicts([1, 2]) == verdicts([]) == verdicts("text") == []


# ---------------------------------------------------------------------- connection


async def test_lost_camera_is_reported_and_found_again(emulator: EmulatedCamera) -> None:
    async with shown(emulator.url, interpret_as=CHECK) as world, world.events() as events:
        await world.camera.trigger()
        await emulator.stop()
        lost = await events.until("camera", lambda state: "nothing listens" in state["last_error"])
        assert lost["connection"] == "lost"
        assert lost["loss"] == "the camera closed the connection"
        again = EmulatedCamera(APPLICATIONS, active=5, running=True, port=emulator.port)
        async with again:
            found = await events.until("camera", lambda state: state["connection"] == "connected")
            account = await events.until("counts", lambda account: account["reconnects"])
            await world.camera.trigger()
            serials = [one.serial for one in world.site.view.entries]
    assert (found["loss"], found["last_error"]) == ("", "")
    assert account["reconnects"] == 1
    assert serials == [0, 1]


async def test_a_cameras_own_connection_error_is_not_taken_for_a_reader_that_is_gone(
    emulator: EmulatedCamera, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def lost() -> Any:
        raise smartcam.ConnectionLostError("the camera is gone")

    async with shown(emulator.url) as world:
        async with world.events() as events:
            await events.next("camera")
            monkeypatch.setattr(world.site.view, "state", lost)
            await until(lambda: "a fault of smartcam" in caplog.text)
        answer = await world.caller.call("GET", "/api/camera")
    assert answer.status == 500
    assert "the camera is gone" in caplog.text


async def test_camera_taken_by_another_client_is_told(emulator: EmulatedCamera) -> None:
    async with (
        shown(emulator.url) as world,
        world.events() as events,
        smartcam.connect(emulator.url, reconnect=FAST),
    ):
        over = {"taken", "ended"}
        told = await events.until("camera", lambda state: state["connection"] in over)
    assert told["connection"] == "taken"
    assert "another client" in told["loss"]


async def test_another_camera_is_followed_while_the_first_is_not_there(
    emulator: EmulatedCamera,
) -> None:
    async with shown(emulator.url) as world, world.events() as events:
        await world.camera.trigger()
        other = smartcam.connect(emulator.url)
        await world.site.view.follow(other, "nothing there")
        told = await events.until("camera", lambda state: state["connection"] == "awaited")
        assert (told["loss"], told["status"], told["capabilities"]) == ("nothing there", [], None)
        async with other:
            await events.until("camera", lambda state: state["connection"] == "connected")
            await other.trigger()
            await until(lambda: len(world.site.view.entries) == 2)
        assert [one.serial for one in world.site.view.entries] == [0, 1]


# ---------------------------------------------------------------------- picture


async def test_picture_is_fetched_when_somebody_looks() -> None:
    async with EmulatedInSight(online=True) as emulator, shown(emulator.url) as world:
        assert (await world.caller.call("GET", "/api/picture")).status == 404
        async with world.events() as events:
            await events.until("picture", lambda picture: picture["serial"] == 1)
            url = world.caller.url("/api/picture")
            async with world.caller.session.get(url) as response:
                assert response.content_type == "image/bmp"
                data = await response.read()
            await world.caller.post("/api/picture")
            await events.until("picture", lambda picture: picture["serial"] == 2)
    assert data.startswith(b"BM")


async def test_picture_that_cannot_be_had_is_reported() -> None:
    async with (
        EmulatedInSight(online=True) as emulator,
        shown(emulator.url) as world,
        world.events() as events,
    ):
        await events.until("picture", lambda picture: picture["serial"] == 1)
        emulator.answer_next(-2, command="RI")
        await world.caller.post("/api/picture")
        told = await events.until("camera", lambda state: state["picture_error"])
    assert "-2" in told["picture_error"]


async def test_camera_without_pictures_is_asked_for_none(emulator: EmulatedCamera) -> None:
    async with shown(emulator.url) as world, world.events() as events:
        await world.caller.post("/api/picture")
        await events.next("counts")
        await events.next("clock")
        assert world.site.view.picture is None
        assert world.site.view.picture_error == ""


def test_units_are_told_beside_the_value() -> None:
    layout = Layout("ok: bool, x: real32 mm, parts: (a: real32 deg)*")
    value = layout.parse(bytes.fromhex("ff 00004841 0000b442"))
    told = ShownResult(0, result_of(value), "").as_json()
    assert told["units"] == {"x": "m", "parts": {"a": "rad"}}
    table = Layout("(x: real32 mm)*")
    rows = table.parse_table(bytes(4))
    assert ShownResult(0, result_of(rows), "", table).as_json()["units"] == {"x": "m"}


# ---------------------------------------------------------------------- a shift

SHIFT_BEGIN = datetime(2026, 3, 2, 6, 0, tzinfo=UTC)
SHIFT_CHECK = Layout("ok: bool, width: real32")


def shift_result(number: int, ok: bool, seconds: float = 0.0) -> Result[Any]:
    """Return a result of the shift."""
    return Result(
        value=SHIFT_CHECK.parse(SHIFT_CHECK.build({"ok": ok, "width": 1.0})),
        camera="cell", application=5, number=number, sequence=None,
        received_at=SHIFT_BEGIN + timedelta(seconds=seconds),
        triggered_at=None, latency=None, raw=b"",
    )  # fmt: skip


def test_it_fails_since_the_first_failure_after_the_last_pass() -> None:
    history = ShiftHistory()
    for number, ok in enumerate([True, False, True, False, False, False]):
        history.add(shift_result(number, ok, 10.0 * number))
    found = history.as_json()
    assert found["failed_since"] == SHIFT_BEGIN.timestamp() + 30
    assert (found["in_a_row"], found["failed"]) == (3, 4)
    assert [(one["number"], one["count"]) for one in found["failures"]] == [(1, 1), (3, 3)]
    assert found["failures"][0]["what"] == "ok is false, expected true"
    assert found["failures"][1]["until"] == SHIFT_BEGIN.timestamp() + 50
    assert found["bars"] == [[SHIFT_BEGIN.timestamp(), 2, 4, 0, 0]]
    history.add(shift_result(9, ok=True))
    assert history.as_json()["failed_since"] is None


def test_what_is_kept_is_bounded() -> None:
    history = ShiftHistory()
    for number in range(2 * MAX_BARS):
        history.add(shift_result(number, ok=False, seconds=BAR_SECONDS * number))
        history.attach_picture(history.newest_result_failure, b"BM" + bytes([number]))
        history.add(shift_result(number, ok=True, seconds=BAR_SECONDS * number))
    found = history.as_json()
    assert (len(found["bars"]), len(found["failures"])) == (MAX_BARS, MAX_FAILURES)
    assert history.totals == [MAX_BARS, MAX_BARS, 0, 0]
    assert sum(one["picture"] for one in found["failures"]) == MAX_PICTURES
    assert history.picture(found["failed"]) == b"BM" + bytes([2 * MAX_BARS - 1])
    assert history.picture(1) is None


def test_bars_of_before_the_shift_are_dropped_though_few_came_since() -> None:
    history = ShiftHistory()
    history.add(shift_result(1, ok=False))
    history.add(shift_result(2, ok=True, seconds=SHIFT_SECONDS))
    assert [bar[1:] for bar in history.as_json()["bars"]] == [[1, 0, 0, 0]]
    assert history.totals == [1, 0, 0, 0]


def test_picture_belongs_to_no_failure_once_anything_came_after_it() -> None:
    history = ShiftHistory()
    history.add(shift_result(1, ok=False))
    assert history.wants_picture
    history.add(shift_result(2, ok=False)._replace(value=b"no verdict"))
    assert not history.wants_picture
    history.attach_picture(history.newest_result_failure, b"BM of another part")
    assert history.as_json()["failures"][0]["picture"] is False


def test_losses_and_missed_results_are_failures_with_their_time() -> None:
    history = ShiftHistory()
    history.add_loss("cable unplugged")
    history.add_loss("cable unplugged")
    history.add_missed(7, "7 results did not come")
    found = history.as_json()
    told = [(one["what"], one["count"]) for one in found["failures"]]
    assert told == [("connection lost: cable unplugged", 2), ("7 results did not come", 1)]
    assert (history.totals, found["failed_since"]) == ([0, 0, 0, 7], None)


def test_short_trend_tells_how_many_of_ten_were_bad() -> None:
    history = ShiftHistory()
    assert history.trend() == {"end": 0, "characters": ""}
    for number, ok in enumerate([True] * 39 + [False]):
        history.add(shift_result(number, ok))
    later = 2 * SLOT_SECONDS
    history.add(shift_result(40, ok=True, seconds=later)._replace(value=b"no verdict"))
    history.add(shift_result(41, ok=False, seconds=later + SLOT_SECONDS))
    begin = SHIFT_BEGIN.timestamp()
    assert history.trend() == {"end": begin + 4 * SLOT_SECONDS, "characters": "1 -X"}


def test_a_text_is_shown_as_text_and_not_as_hex() -> None:
    cells = b'{"A2": 12.5, "B2": "bolt"}'
    assert value_fields(cells)["value"] == cells.decode()
    assert value_fields(b"\x00\x01")["value"] == "0001"
    assert value_fields(b"")["value"] == ""


async def test_page_of_a_camera_tells_its_failures() -> None:
    bad = Application(id=5, layout="ok: bool", constant={"ok": False}, load_time=0)
    async with EmulatedCamera([bad], active=5, running=True) as emulator:
        camera = smartcam.connect(emulator.url, interpret_as="ok: bool")
        async with LiveSite(camera) as site, camera, aiohttp.ClientSession() as session:
            caller = Caller(site, session, "")
            await camera.trigger()
            await until(lambda: site.view.history.version)
            told = await caller.get("/api/history")
            assert (told["failed"], told["in_a_row"]) == (1, 1)
            assert told["failures"][0]["what"] == "ok is false, expected true"
            assert (await caller.call("GET", "/api/failures/1")).status == 404


async def test_failure_has_its_picture_though_nobody_looks() -> None:
    job = {"file": "1check.job", "cells": {"A2": 0}}
    async with EmulatedInSight(jobs=[job]) as emulator:
        camera = smartcam.connect(f"{emulator.url}?cells=A2", interpret_as=lambda r: Failed())
        async with LiveSite(camera) as site, camera:
            await camera.start()
            await camera.trigger()
            await until(lambda: site.view.history.picture(1))
            assert site.view.history.as_json()["failures"][0]["picture"] is True
            async with (
                aiohttp.ClientSession() as session,
                session.get(f"{site.origin}/api/failures/1") as answer,
            ):
                assert (answer.status, (await answer.read())[:2]) == (200, b"BM")


class Failed:
    """A value with a truth value that says that it failed."""

    def _asdict(self) -> dict[str, bool]:
        return {"ok": False}


async def test_fleet_has_the_picture_of_a_failure_though_nobody_looks() -> None:
    job = {"file": "1check.job", "cells": {"A2": 0}}
    async with EmulatedInSight(jobs=[job]) as emulator:
        entry = {"url": f"{emulator.url}?cells=A2", "interpret_as": "ok: bool"}
        file = FleetFile.model_validate({"cameras": {"a": entry}})
        async with smartcam.fleet.open(file) as fleet, FleetSite(fleet) as site:
            await fleet["a"].start()
            await fleet["a"].trigger()
            history = site.view.rows["a"].history
            await until(lambda: history.picture(1))
            assert history.as_json()["failures"][0]["picture"] is True


async def test_page_of_a_fleets_camera_knows_since_when_it_is_lost() -> None:
    async with EmulatedCamera(active=21, running=True) as emulator:
        file = FleetFile.model_validate({"cameras": {"a": {"url": emulator.url}}})
        async with smartcam.fleet.open(file) as fleet, FleetSite(fleet) as site:
            assert site.watched_camera("a").state()["changed_at_exact"] is False
            await site.watched_camera("a").stop()
            site._watched.clear()
            await emulator.stop()
            row = site.view.rows["a"]
            await until(lambda: row.mode == "lost")
            lost_at = row.changed_at
            await asyncio.sleep(0.05)
            told = site.watched_camera("a").state()
            assert (told["changed_at"], told["changed_at_exact"]) == (lost_at, True)
            assert row.fields()["changed_at_exact"] is True
            (failure,) = row.history.as_json()["failures"]
            assert failure["what"].startswith("connection lost: ")


async def test_fleet_keeps_the_failures_of_a_camera_at_which_nobody_looks() -> None:
    scenario = {"emulated": {}, "application": 21, "interpret_as": "text: string[20]"}
    file = FleetFile.model_validate({"cameras": {"a": scenario}})
    async with smartcam.fleet.open(file) as fleet, FleetSite(fleet) as site:
        await fleet["a"].trigger(timeout=5.0)
        row = site.view.rows["a"]
        await until(lambda: row.history.version)
        assert row.history.as_json()["bars"][0][3] == 1
        async with aiohttp.ClientSession() as session:
            told = await Caller(site, session, "a").get("history")
        assert told["bars"][0][3] == 1
