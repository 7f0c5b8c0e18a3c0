"""The fleet's page at its WebSocket and its calls: the messages, their readers, their bounds."""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
import time
from typing import TYPE_CHECKING, Any, NamedTuple

import aiohttp
import pytest

from smartcam.exceptions import ConfigurationError, InterpretationError
from smartcam.layout import Layout
from smartcam.layout._inside import ShownUnits
from smartcam.models import Header, Localization, Pose, Position, Quaternion, Status
from smartcam.web import FleetSite
from tests.handmade import until
from tests.web.inside import (
    ALIVE_INTERVAL,
    BAR_DURATION,
    CALLS,
    ERROR_MARK_SECONDS,
    MAX_KEPT_BYTES,
    MAX_QUEUE,
    MAX_ROWS,
    READER_TIMEOUT,
    line_of,
    outcome_of,
)
from tests.web.inside import FLEET_MAX_VIEWERS as MAX_VIEWERS
from tests.web.inside import FLEET_SOCKET_PROTOCOL as PROTOCOL
from tests.web.inside import _fleet as site_module
from tests.web.inside import _fleet_view as view_module
from tests.web.madeup import AT, READY, MadeUpFleet, names
from tests.web.sitekit import TOKEN, Caller, Raw

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


class Checked(NamedTuple):
    """A value with a verdict, as a layout's."""

    ok: bool
    width: float


class Told(NamedTuple):
    """One whose names tell of good and bad in another way, or do not."""

    present: bool
    defect: bool | None = None


GOOD, BAD = Checked(True, 1.5), Checked(False, 2.5)
MOST = 64_000
"""Bytes of a message with a whole window of ordinary rows, and far below all rows of a fleet."""


class Looker:
    """A browser's page, as far as it receives messages."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.rows: dict[str, dict[str, Any]] = {}
        self.names: list[str] = []
        self.said: dict[str, Any] = {}

    async def see(self, **sight: Any) -> None:
        await self.socket.send_str(json.dumps(sight))

    async def hear(self, *, acknowledge: bool = True) -> str:
        """Return the next message."""
        async with asyncio.timeout(1000):
            text: str = await self.socket.receive_str()
        news = json.loads(text)
        self.said |= news
        self.names = news.get("names", self.names)
        self.rows |= {row["name"]: row for row in news.get("rows", [])}
        if acknowledge:
            await self.socket.send_str("next")
        return text

    async def until(self, condition: Any) -> str:
        """Receive until a condition is true."""
        while True:
            text = await self.hear()
            if condition():
                return text

    async def listen(self, seconds: float) -> list[str]:
        """Return all that comes within so many seconds."""
        heard: list[str] = []
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while True:
                    heard.append(await self.hear())
        return heard


class World(NamedTuple):
    """A made-up fleet, its site, and who calls it."""

    fleet: MadeUpFleet
    site: FleetSite
    caller: Caller

    @contextlib.asynccontextmanager
    async def looking(self, **sight: Any) -> AsyncIterator[Looker]:
        """Connect as the page does; the viewer has received the first messages."""
        url = self.caller.url("/api/table")
        async with self.caller.session.ws_connect(url, protocols=[PROTOCOL]) as socket:
            looker = Looker(socket)
            await looker.see(**sight)
            await looker.hear()
            await looker.until(lambda: "found" in looker.said)
            yield looker

    async def shown(self, **query: Any) -> list[str]:
        """Return the names that a query finds."""
        text = "&".join(f"{key}={value}" for key, value in query.items())
        told = await self.caller.get(f"/api/cameras?{text}")
        return [one["name"] for one in told["cameras"]]


@contextlib.asynccontextmanager
async def served(count: int = 100, **options: Any) -> AsyncIterator[World]:
    """Serve the page of a made-up fleet."""
    fleet = MadeUpFleet(names(count))
    async with FleetSite(fleet.as_fleet, **options) as site, aiohttp.ClientSession() as session:
        yield World(fleet, site, Caller(site, session, ""))


# ---------------------------------------------------------------------- what crosses


async def test_page_is_told_the_rows_in_sight_and_no_others() -> None:
    async with served(5000) as world, world.looking(first=0, count=40) as looker:
        assert looker.said["found"] == 5000
        assert looker.names == names(40)
        assert set(looker.rows) == set(looker.names)
        await looker.until(lambda: "totals" in looker.said)
        totals = looker.said["totals"]
        assert (totals["cameras"], totals["connected"], totals["agents"]) == (5000, 5000, 2)
        row = looker.rows["line01/cam001"]
        assert (row["agents"], row["mode"], row["last"]) == (["b"], "running", None)
        await looker.see(first=4990, count=40)
        await looker.until(lambda: looker.names == names(5000)[4960:])
        assert looker.said["first"] == 4960


async def test_nothing_crosses_while_nothing_happens() -> None:
    async with served() as world, world.looking() as looker:
        await looker.listen(10.0)
        heard = await looker.listen(20 * ALIVE_INTERVAL)
        assert set(heard) == {"{}"}
        assert 15 <= len(heard) <= 20


async def test_what_changed_in_sight_crosses_and_nothing_else() -> None:
    async with served(1000) as world, world.looking(count=40) as looker:
        await looker.listen(10.0)
        world.fleet["line02/cam400"].send(GOOD)  # out of sight
        world.fleet["line01/cam003"].send(GOOD)
        heard = [json.loads(text) for text in await looker.listen(1.5)]
        told = [row["name"] for news in heard for row in news.get("rows", [])]
        assert set(told) == {"line01/cam003"}
        assert not any("names" in news for news in heard)
        assert looker.rows["line01/cam003"]["count"] == 1
        assert looker.said["totals"]["results"] == 2


async def test_a_storm_of_results_is_a_few_messages_of_bounded_length() -> None:
    async with served(1500) as world, world.looking(count=40) as looker:
        await looker.listen(3.0)
        cameras = list(world.fleet.made.values())

        async def storm() -> None:
            for number in range(3 * 1500):
                cameras[number % 1500].send(GOOD if number % 3 else BAD)
                if number % 90 == 89:
                    await asyncio.sleep(0.02)

        sending = asyncio.create_task(storm())
        heard = await looker.listen(2.0)
        await sending
        await looker.listen(3.0)
        assert 1 < len(heard) <= 12
        assert max(map(len, heard)) < MOST
        totals = world.site.view.totals()
        assert (totals["results"], totals["failures"]) == (4500, 0)
        assert {row["count"] for row in looker.rows.values()} == {3}


# ---------------------------------------------------------------------- which rows, in which order


async def test_search_takes_words_of_name_agent_state_and_error() -> None:
    async with served() as world:
        world.fleet["line01/cam007"].lose("cable unplugged")
        world.fleet["line01/cam008"].say(Status(0))
        await asyncio.sleep(1.0)
        assert await world.shown(search="cam01") == names(20)[10:]
        assert await world.shown(search="CAM01+lost") == []
        assert await world.shown(search="unplugged+cam0") == ["line01/cam007"]
        assert await world.shown(search="stopped") == ["line01/cam008"]
        assert (await world.shown(search="cam00+b"))[:2] == ["line01/cam001", "line01/cam003"]


async def test_filters_and_their_numbers() -> None:
    async with served(10) as world:
        cameras = [*world.fleet.made.values()]
        cameras[1].lose("gone")
        cameras[2].say(Status(0))
        cameras[3].say(Status.RUNNING)  # an inspection runs
        cameras[4].say(READY | Status.OVERHEAT)
        cameras[5].fail(InterpretationError("too short"))
        await asyncio.sleep(1.0)
        found = {
            one: [int(name[-3:]) for name in await world.shown(filter=one)]
            for one in ("connected", "errors", "busy", "stopped")
        }
        assert found == {
            "connected": [0, 2, 3, 4, 5, 6, 7, 8, 9],
            "errors": [1, 4, 5],
            "busy": [3],
            "stopped": [2],
        }
        totals = world.site.view.totals()
        assert {one: totals[one] for one in found} == {k: len(v) for k, v in found.items()}
        await asyncio.sleep(ERROR_MARK_SECONDS + 2)
        assert [int(name[-3:]) for name in await world.shown(filter="errors")] == [1, 4]


async def test_orders() -> None:
    async with served(5) as world:
        cameras = [*world.fleet.made.values()]
        for _ in range(10):
            cameras[3].send(GOOD)
            await asyncio.sleep(0.3)
        cameras[1].send(GOOD)
        cameras[2].lose("gone")
        await asyncio.sleep(1.5)
        assert (await world.shown(descending="true"))[0] == names(5)[4]
        assert (await world.shown(sort="rate", descending="true"))[:2] == [names(5)[3], names(5)[1]]
        assert (await world.shown(sort="last", descending="true"))[:2] == [names(5)[1], names(5)[3]]
        assert (await world.shown(sort="state"))[0] == names(5)[2]
        assert (await world.shown(sort="errors", descending="true"))[0] == names(5)[2]


@pytest.mark.parametrize(
    "said",
    ["", "{", "[]", '{"count": 121}', '{"first": -1}', '{"filter": "none"}', '{"sort": "x"}',
     '{"search": "' + "x" * 101 + '"}', '{"other": 1}', "n" * 2000],
)  # fmt: skip
async def test_what_means_nothing_ends_the_socket(said: str) -> None:
    async with served(3) as world, world.looking() as looker:
        await looker.socket.send_str(said)
        async with asyncio.timeout(60):
            while (await looker.socket.receive()).type is aiohttp.WSMsgType.TEXT:
                pass
        assert looker.socket.closed
        await until(lambda: not world.site.viewers)


async def test_wrong_query_is_refused() -> None:
    async with served(3) as world:
        answer = await world.caller.call("GET", f"/api/cameras?count={MAX_ROWS + 1}")
        assert (answer.status, answer.value["fields"][0]["field"]) == (422, "count")


# ---------------------------------------------------------------------- who comes and goes


async def test_agent_that_goes_and_comes_back() -> None:
    async with served(10) as world, world.looking() as looker:
        first = world.fleet["line01/cam000"]
        first.send(GOOD)
        world.fleet.lose("a")
        first.connected = False
        await looker.until(lambda: looker.rows["line01/cam008"]["mode"] == "gone")
        row = looker.rows["line01/cam000"]
        assert (row["mode"], row["agents"], row["count"], row["errors"]) == ("gone", [], 1, 1)
        assert world.site.view.totals()["connected"] == 5
        first.connected = True
        for name in names(10)[::2]:
            world.fleet.join(name, "a")
        first.send(BAD)
        await looker.until(lambda: looker.rows["line01/cam000"]["count"] == 2)
        assert looker.rows["line01/cam000"]["mode"] == "running"
        assert looker.rows["line01/cam000"]["last"]["outcome"] == "failed"
        assert world.site.view.totals()["connected"] == 10


async def test_camera_that_joins_has_its_place() -> None:
    async with served(3) as world, world.looking() as looker:
        world.fleet.join("line01/cam001b", "new")
        await looker.until(lambda: len(looker.names) == 4)
        assert looker.names[2] == "line01/cam001b"
        assert looker.rows["line01/cam001b"]["agents"] == ["new"]
        assert world.site.view.totals()["agents"] == 3


async def test_one_that_was_given_up_is_followed_as_the_object_that_it_is_now() -> None:
    async with served(2) as world:
        before = world.fleet["line01/cam000"]
        before.send(GOOD)
        await asyncio.sleep(1.0)
        before.ended, before.connected = True, False
        before.lose("taken")
        await asyncio.sleep(1.0)
        assert world.site.view.rows["line01/cam000"].mode == "ended"
        world.fleet.leave("line01/cam000")
        del world.fleet.made["line01/cam000"]
        camera = world.fleet.join("line01/cam000", "a")
        await asyncio.sleep(1.0)
        camera.send(GOOD)
        await asyncio.sleep(1.0)
        row = world.site.view.rows["line01/cam000"]
        assert (row.count, row.mode) == (2, "running")


async def test_more_events_than_are_kept_are_made_good(monkeypatch: pytest.MonkeyPatch) -> None:
    async with served(6) as world:
        monkeypatch.setattr(view_module, "MAX_EVENTS", 50)
        world.fleet.join("x", "a")
        await world.site.view._read_fleet()
        world.fleet.leave("line01/cam001")
        world.fleet.agent.pop("line01/cam002")  # whose going is not heard
        for number in range(60):
            world.fleet.join(f"y{number % 3}", "a")
        await asyncio.sleep(1.0)
        rows = world.site.view.rows
        gone = [name for name, row in rows.items() if not row.agents]
        assert gone == ["line01/cam001", "line01/cam002"]
        assert {"y0", "y1", "y2"} <= set(rows)


async def test_cameras_that_are_gone_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view_module, "MAX_UNSHARED", 3)
    async with served(10) as world, world.looking() as looker:
        for name in names(8):
            world.fleet.leave(name)
        await looker.until(lambda: looker.said["found"] == 5)
        assert looker.names == names(10)[5:]
        await asyncio.sleep(2.0)
        totals = world.site.view.totals()
        assert (totals["cameras"], totals["connected"], totals["errors"]) == (5, 2, 3)


# ---------------------------------------------------------------------- outcomes


@pytest.mark.parametrize(
    ("value", "outcome"),
    [
        (GOOD, "passed"),
        (BAD, "failed"),
        ([GOOD, BAD, GOOD], "failed"),
        ([GOOD, GOOD], "passed"),
        ([], "other"),
        (b"\1", "other"),
        (Told(present=False), "other"),
        (Told(present=True, defect=True), "failed"),
    ],
)
def test_outcome(value: Any, outcome: str) -> None:
    assert outcome_of(value) == outcome


async def test_every_result_has_one_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    async with served(3) as world:
        camera, view = world.fleet["line01/cam001"], world.site.view
        for value in (GOOD, GOOD, BAD, b"raw"):
            camera.send(value)
        camera.fail(InterpretationError("too short"))
        camera.miss(7)
        await asyncio.sleep(1.5)
        for _ in range(MAX_QUEUE + 10):  # of these ten have no room
            world.fleet["line01/cam002"].send(GOOD)
        await asyncio.sleep(1.5)
        later = time.time() + 2 * BAR_DURATION
        monkeypatch.setattr(time, "time", lambda: later)
        await asyncio.sleep(1.5)
        sums = [sum(bar[place] for bar in view.series) for place in (1, 2, 3, 4)]
        assert sums == [2 + MAX_QUEUE, 1, 1 + 10, 1 + 7]
        assert sum(sums) == view.totals()["results"] == sum(r.count for r in view.rows.values())
        told = await world.caller.get("/api/fleet")
        assert (told["totals"]["failures"], told["bars"]) == (8, [list(b) for b in view.series])


async def test_parts_are_reported_as_they_lie_and_long_results_by_their_length() -> None:
    async with served(2) as world, world.looking() as looker:
        header = Header(1, AT, "line01/cam000")
        pose = Pose(header, Position(0.1, 0.2), Quaternion.from_theta(1.5))
        world.fleet["line01/cam000"].send([Localization("square", 0.9, 0, pose)])
        world.fleet["line01/cam001"].send(b"", raw=bytes(MAX_KEPT_BYTES + 1))
        await looker.until(lambda: all(row["last"] for row in looker.rows.values()))
        last = looker.rows["line01/cam000"]["last"]
        assert last["parts"] == [["square", 0.1, 0.2, 1.5]]
        assert last["parts_count"] == 1
        assert looker.rows["line01/cam001"]["last"]["text"] == f"{MAX_KEPT_BYTES + 1} bytes"


# ---------------------------------------------------------------------- who is slow


async def test_who_does_not_read_holds_up_nobody_and_gets_the_newest() -> None:
    async with served(3) as world, world.looking() as slow, world.looking() as quick:
        await slow.listen(3.0)
        camera = world.fleet["line01/cam000"]
        camera.send(GOOD)
        await slow.hear(acknowledge=False)  # and then looks away
        for _ in range(20):
            camera.send(GOOD)
            await asyncio.sleep(0.25)
        await quick.until(lambda: quick.rows["line01/cam000"]["count"] == 21)
        await slow.socket.send_str("next")
        await slow.hear()
        assert slow.rows["line01/cam000"]["count"] == 21


async def test_who_never_reads_is_disconnected() -> None:
    async with served(3) as world, world.looking() as quick, world.looking() as slow:
        await slow.listen(3.0)
        for number in range(2 * int(READER_TIMEOUT)):
            world.fleet["line01/cam000"].send(GOOD)
            await quick.listen(1.0)
            assert quick.rows["line01/cam000"]["count"] == number + 1
        assert len(world.site.viewers) == 1


async def test_page_may_look_elsewhere_while_nothing_happens() -> None:
    async with served(500) as world, world.looking(count=10) as looker:
        await looker.listen(3.0)
        for first in (100, 300, 5, 480):
            await looker.see(first=first, count=10)
            await looker.until(lambda: looker.names == names(500)[first : first + 10])  # noqa: B023
            assert set(looker.names) <= set(looker.rows)


# ---------------------------------------------------------------------- who may look


async def test_lookers_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    assert MAX_VIEWERS > 3
    monkeypatch.setattr(site_module, "MAX_VIEWERS", 3)
    async with served(3) as world, contextlib.AsyncExitStack() as stack:
        for _ in range(3):
            await stack.enter_async_context(world.looking())
        headers = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
        answer = await world.caller.call("GET", "/api/table", headers=headers)
        assert answer.status == 503
        assert len(world.site.viewers) == 3


async def test_what_is_no_socket_of_this_page_is_refused() -> None:
    async with served(3) as world:
        answer = await world.caller.call("GET", "/api/table")
        assert (answer.status, answer.value["expected"]) == (400, f"a WebSocket of {PROTOCOL}")


async def test_token_is_wanted_of_the_socket_too() -> None:
    async with served(3, token=TOKEN) as world:
        assert world.site.url.endswith(f"#token={TOKEN}")
        url, connect = world.caller.url("/api/table"), world.caller.session.ws_connect
        with pytest.raises(aiohttp.WSServerHandshakeError, match="401"):
            await connect(url, protocols=[PROTOCOL])
        async with connect(url, protocols=[PROTOCOL, f"bearer.{TOKEN}"]) as socket:
            assert json.loads(await socket.receive_str())["fleet"] == "fleet://made-up"


async def test_list_of_calls_and_files() -> None:
    async with served(3) as world:
        calls = (await world.caller.get("/api"))["calls"]
        assert [(one["method"], one["path"]) for one in calls] == [
            (c.method, c.path) for c in CALLS
        ]
        assert all(one["about"] for one in calls)
        assert ("POST", "/api/cameras/{camera}/trigger") in {(c.method, c.path) for c in CALLS}
        for path in ("/", "/fleet.js", "/fleet_row.js", "/live.js", "/camera/line01/cam000"):
            async with world.caller.session.get(world.caller.url(path)) as response:
                assert response.status == 200, path


async def test_stop_ends_everything_and_start_begins_anew() -> None:
    async with served(3) as world:
        async with world.looking() as looker:
            await world.site.stop()
            await world.site.stop()
            async with asyncio.timeout(60):
                while not looker.socket.closed:
                    await looker.socket.receive()
        assert not asyncio.all_tasks() - {asyncio.current_task()}
        await world.site.start()
        async with world.looking() as looker:
            assert looker.names == names(3)


async def test_head_of_no_request_is_as_everywhere() -> None:
    async with served(3) as world, Raw.connected(world.site) as raw:
        status, _ = await raw.call("GET /api/fleet HTTP/1.1", "Host: elsewhere.example")
        assert status == 403


def test_line_of_a_result_has_units() -> None:
    value = {"ok": True, "x": 0.0125, "n": 3, "parts": [{"a": 1.5}, {"a": 2.0}]}
    units = {"x": "m", "parts": {"a": "rad"}}
    assert line_of(value, units) == "ok true, x 0.0125 m, n 3, parts 2: a 1.5 rad | a 2 rad"
    assert line_of([{"x": 1.0}], {}) == "1: x 1"
    practical = ShownUnits(("mm", "deg"))
    text = "ok true, x 12.5 mm, n 3, parts 2: a 85.944 deg | a 114.59 deg"
    assert line_of(value, units, practical) == text


async def test_row_has_its_result_in_si_and_in_the_units_of_the_switch() -> None:
    layout = "(x: real32 mm, a: real32 deg)*"
    rows = Layout(layout).parse_table(struct.pack("<ff", 12.5, 90.0))
    async with served(2) as world, world.looking() as looker:
        assert looker.said["units"]["instead"]["m"] == ["mm", 1000.0]
        assert looker.said["units"]["shown_first"] is False
        table, plain = (world.fleet[name] for name in names(2))
        table.read_as({7: f"table: {layout}"})
        table.send(rows)
        plain.send({"n": 3})
        await looker.until(lambda: all(row["last"] for row in looker.rows.values()))
        last = looker.rows[table.name]["last"]
        assert last["text"] == "1: x 0.0125 m, a 1.5708 rad"
        assert last["practical"] == "1: x 12.5 mm, a 90 deg"
        assert "practical" not in looker.rows[plain.name]["last"]


async def test_units_that_cannot_be_are_refused_before_anything_listens() -> None:
    with pytest.raises(ConfigurationError, match="unit 'mn' is unknown"):
        FleetSite(MadeUpFleet(names(1)).as_fleet, units=("mn",))
