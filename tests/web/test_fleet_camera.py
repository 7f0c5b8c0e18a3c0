"""One camera's page on the fleet's site: the live page's calls, for a camera of a real fleet."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

import aiohttp
import pytest

import smartcam.fleet
from smartcam.emulator import EmulatedCamera
from smartcam.exceptions import ConnectionTakenError
from smartcam.fleet import Fleet, FleetFile, MemoryBus
from smartcam.web import FleetSite
from tests.fleet.fleetkit import FAST, LAYOUT, NAME, Plant
from tests.handmade import until
from tests.web.inside import _fleet as fleet_module
from tests.web.sitekit import Answer, Caller, Listener

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

LINGER = 30.0
MAX_CAMERAS = 16


CELL = FleetFile.model_validate(
    {
        "cameras": {
            "line1/cam1": {"emulated": {}, "application": 7, "interpret_as": "localizations"},
            "line1/cam2": {"emulated": {}, "application": 21},
        }
    }
)


class World(NamedTuple):
    """A fleet, its site, and who calls it."""

    fleet: Fleet
    site: FleetSite
    caller: Caller

    def path(self, call: str = "", camera: str = "line1/cam1") -> str:
        return f"/api/cameras/{quote(camera, safe='')}{call}"

    async def post(self, call: str, body: object = None, camera: str = "line1/cam1") -> Answer:
        return await self.caller.call("POST", self.path(call, camera), body)

    @contextlib.asynccontextmanager
    async def events(self, camera: str = "line1/cam1") -> AsyncIterator[Listener]:
        url = self.caller.site.origin + self.path("/events", camera)
        async with self.caller.session.get(url) as response:
            assert response.status == 200
            yield Listener(response)


@contextlib.asynccontextmanager
async def served(fleet: Fleet, **options: Any) -> AsyncIterator[World]:
    """Serve the page of a fleet."""
    async with fleet, FleetSite(fleet, **options) as site, aiohttp.ClientSession() as session:
        yield World(fleet, site, Caller(site, session, ""))


async def test_camera_is_triggered_and_its_page_and_row_tell_it() -> None:
    async with served(smartcam.fleet.open(CELL), control=True) as world:
        async with world.events() as events:
            state = await events.until("camera", lambda told: told["connection"] == "connected")
            assert (state["name"], state["control"], state["frames"]) == ("line1/cam1", True, False)
            answer = await world.post("/trigger")
            assert (answer.status, answer.value["number"]) == (200, 1)
            told = await events.until("results", lambda told: told["results"])
            parts = {part["name"] for part in told["results"][0]["parts"]}
            account = await events.until("counts", lambda told: told["received"])
            assert account["received"] == account["triggered"] == 1
        row = world.site.view.rows["line1/cam1"]
        await until(lambda: row.count == 1)
        assert {part[0] for part in row.fields()["last"]["parts"]} == parts
        assert world.site.view.rows["line1/cam2"].count == 0


async def test_result_of_before_somebody_looked_is_shown() -> None:
    async with served(smartcam.fleet.open(CELL)) as world:
        await world.fleet["line1/cam2"].trigger()
        await until(lambda: world.site.view.rows["line1/cam2"].count == 1)
        told = await world.caller.get(world.path("/results", "line1/cam2"))
        assert [one["number"] for one in told["results"]] == [1]


@pytest.mark.parametrize("call", ["/trigger", "/start", "/stop", "/switch", "/take_back"])
async def test_without_control_a_camera_is_not_commanded(call: str) -> None:
    async with served(smartcam.fleet.open(CELL)) as world:
        answer = await world.post(call, {"application": 8} if call == "/switch" else None)
        assert answer.status == 403
        assert world.fleet["line1/cam1"].active_application == 7
        assert world.fleet["line1/cam1"].statistics().received == 0


async def test_refusal_of_the_camera_is_reported() -> None:
    async with served(smartcam.fleet.open(CELL), control=True) as world:
        answer = await world.post("/switch", {"application": 999})
        assert answer.status == 409
        assert "999" in answer.value["received"]


async def test_unknown_camera_is_refused_with_what_was_meant() -> None:
    async with served(smartcam.fleet.open(CELL), control=True) as world:
        answer = await world.post("/trigger", camera="line1/cm1")
        assert answer.status == 404
        assert "did you mean 'line1/cam1'" in answer.value["received"]


async def test_camera_is_left_when_nobody_looks_any_more() -> None:
    async with served(smartcam.fleet.open(CELL)) as world:
        camera = world.fleet["line1/cam1"]
        streams = len(camera.statistics().subscribers)
        async with world.events() as events:
            await events.next()
            await asyncio.sleep(LINGER + 3)
            assert len(camera.statistics().subscribers) == streams + 2
        await asyncio.sleep(LINGER + 3)
        assert len(camera.statistics().subscribers) == streams
        async with world.events() as events:
            await events.next("camera")


async def test_cameras_with_a_page_of_their_own_are_bounded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fleet_module, "MAX_CAMERAS", 1)
    async with served(smartcam.fleet.open(CELL)) as world, world.events() as events:
        await events.next()
        answer = await world.caller.call("GET", world.path(camera="line1/cam2"))
        assert answer.status == 503
    assert MAX_CAMERAS > 1


async def test_camera_of_an_agent_that_comes_back_goes_on() -> None:
    async with Plant() as plant:
        options = {"interpret_as": LAYOUT, "reconnect": FAST}
        fleet = Fleet(plant.bus.new_connection(), None, "plant", None, 60.0, options)
        async with served(fleet, control=True) as world, world.events(NAME) as events:
            row = world.site.view.rows[NAME]
            assert (await world.post("/trigger", camera=NAME)).status == 200
            await plant.stop_agent()
            await until(lambda: row.mode == "gone")
            lost = await events.until("camera", lambda told: told["connection"] == "lost")
            assert lost["loss"]
            assert (await world.post("/trigger", camera=NAME)).status == 409
            await plant.start_agent()
            await until(lambda: row.mode == "running")
            await events.until("camera", lambda told: told["connection"] == "connected")
            assert (await world.post("/trigger", camera=NAME)).status == 200
            await until(lambda: row.count == 2)
            assert row.errors == 1


async def test_camera_whose_agent_is_back_before_it_keeps_its_page() -> None:
    async with Plant() as plant:
        fleet = Fleet(plant.bus.new_connection(), None, "plant", None, 60.0, {"reconnect": FAST})
        async with served(fleet) as world, world.events(NAME) as events:
            await events.until("camera", lambda told: told["connection"] == "connected")
            known = fleet[NAME].capabilities
            await plant.stop_agent()
            await plant.box.stop()
            await plant.start_agent()
            await asyncio.sleep(2.0)  # the agent has answered, and has no session with the camera
            assert not fleet[NAME].connected
            assert fleet[NAME].capabilities == known
            await plant.box.start()
            await events.until("camera", lambda told: told["connection"] == "connected")


async def test_camera_given_up_is_followed_as_its_next_object() -> None:
    async with Plant() as plant:
        fleet = Fleet(plant.bus.new_connection(), None, "plant", None, 2.0, {"reconnect": None})
        async with served(fleet, control=True) as world, world.events(NAME) as events:
            before = world.fleet[NAME]
            await events.until("camera", lambda told: told["connection"] == "connected")
            await plant.stop_agent()
            await events.until("camera", lambda told: told["connection"] == "ended")
            await plant.start_agent()
            await events.until("camera", lambda told: told["connection"] == "connected")
            assert world.fleet[NAME] is not before
            assert (await world.post("/trigger", camera=NAME)).status == 200
            await until(lambda: world.site.view.rows[NAME].count == 1)


async def test_stop_leaves_the_fleet_as_it_was() -> None:
    async with smartcam.fleet.open(CELL) as fleet:
        site = FleetSite(fleet)
        async with site, aiohttp.ClientSession() as session:
            world = World(fleet, site, Caller(site, session, ""))
            async with world.events() as events:
                await events.next()
                await site.stop()
                await events.end()
        camera = fleet["line1/cam1"]
        assert camera.statistics().subscribers == []
        assert (await camera.trigger()).number == 1


async def test_port_that_is_taken_leaves_nothing_behind() -> None:
    async with smartcam.fleet.open(CELL) as fleet, FleetSite(fleet) as site:
        before = asyncio.all_tasks()
        other = FleetSite(fleet, port=site.port)
        with pytest.raises(smartcam.ConfigurationError, match="cannot listen"):
            await other.start()
        assert asyncio.all_tasks() <= before


async def test_bus_of_nobody_is_an_empty_table() -> None:
    fleet = Fleet(MemoryBus().new_connection(), None, "plant", None, 0.1, {})
    async with served(fleet) as world:
        told = await world.caller.get("/api/fleet")
        assert (told["totals"]["cameras"], told["agents"]) == (0, [])


async def test_camera_that_another_client_took_is_shown_and_taken_back() -> None:
    async with EmulatedCamera() as box:
        cell = FleetFile.model_validate({"cameras": {"line1/cam1": {"url": box.url}}})
        async with served(smartcam.fleet.open(cell), control=True) as world:
            camera = world.fleet["line1/cam1"]
            for _ in range(2):
                await until(lambda: camera.connected)
                async with smartcam.connect(box.url, reconnect=None):
                    await until(lambda: not camera.connected)
            await until(lambda: isinstance(camera.trouble, ConnectionTakenError))
            state = await world.caller.get(world.path())
            assert state["connection"] == "taken"
            assert (await world.post("/take_back")).status == 200
            await until(lambda: camera.connected)
