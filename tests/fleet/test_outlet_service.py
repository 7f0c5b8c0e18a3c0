"""Outlets over the bus: accounts and stores of all agents, asked by programs and by pages."""

from __future__ import annotations

import contextlib
import importlib
import json
import sqlite3
from collections.abc import AsyncIterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from smartcam.exceptions import ConfigurationError
from smartcam.fleet import Fleet, FleetServer
from smartcam.fleet._inside import FleetOutlets, Keys

pytestmark = pytest.mark.real_time

MemoryBus: Any = importlib.import_module("smartcam.fleet._bus.bus").MemoryBus

FLEET = """
agent: a1
cameras:
  line1/cam1: {emulated: {}, application: 7, interpret_as: localizations}
  line1/cam2: {emulated: {}, application: 7}
outlets:
  shifts: {kind: sqlite, file: results.sqlite}
"""


@contextlib.asynccontextmanager
async def plant(folder: Path, text: str = FLEET) -> AsyncIterator[tuple[FleetServer, Fleet]]:
    path = folder / "fleet.yaml"
    path.write_text(text)
    bus = MemoryBus()
    server = FleetServer(path, bus=bus.new_connection())
    async with FleetOutlets(server), server:
        await server.wait_first_attempts()
        fleet = Fleet(bus.new_connection(), None, None, None, 20.0, {})
        async with fleet:
            yield server, fleet


async def triggered(fleet: Fleet, count: int) -> None:
    for _ in range(count):
        await fleet["line1/cam1"].trigger(timeout=20)

    async def all_there() -> bool:
        return [one.delivered for one in await fleet.outlets()] == [count]

    while not await all_there():
        pass


async def test_every_agents_outlets_tell_their_accounts(tmp_path: Path) -> None:
    async with plant(tmp_path) as (_, fleet):
        await triggered(fleet, 3)
        (told,) = await fleet.outlets()
    assert told == ("a1", "shifts", 3, 3, 0, {}, "")


async def test_stores_are_asked_for_what_failed_and_for_a_cameras_results(tmp_path: Path) -> None:
    async with plant(tmp_path) as (_, fleet):
        await triggered(fleet, 2)
        (everything,) = await fleet.stored_results()
        assert (everything.agent, everything.outlet, everything.total) == ("a1", "shifts", 2)
        (some,) = await fleet.stored_results("line1/cam1", max_rows=1)
        assert [row["id"][-2:] for row in some.rows] == ["/2"]
        (none,) = await fleet.stored_results("line2/**")
        assert (none.total, none.rows) == (0, [])
        (late,) = await fleet.stored_results(since=datetime.now(UTC) + timedelta(hours=1))
        assert late.total == 0
        (failed,) = await fleet.stored_results(only_failed=True)
        assert (failed.failed, failed.rows) == (0, [])


async def test_a_question_that_cannot_be_read_is_answered_with_an_error(tmp_path: Path) -> None:
    async with plant(tmp_path) as (_, fleet):
        bus, key = fleet._program.bus, Keys("plant").outlets("*", "results")
        for payload in (b"[]", b"\xff", b'{"since": "yesterday"}', b'{"most": 5000}', b'{"a": 1}'):
            ((_, answer),) = await bus.ask(key, payload, 10.0)
            said: dict[str, Any] = json.loads(answer)
            assert said["error"], payload
            assert said["kind"] == "ConfigurationError"
        ((_, answer),) = await bus.ask(Keys("plant").outlets("a1", "nothing"), b"", 10.0)
        assert "expected counts or results" in json.loads(answer)["error"]


async def test_a_store_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    async with plant(tmp_path) as (_, fleet):
        await triggered(fleet, 1)
        (tmp_path / "results.sqlite").rename(tmp_path / "elsewhere")
        (told,) = await fleet.stored_results()
    assert "there is no such file" in told.error


async def test_an_agent_without_outlets_says_so(tmp_path: Path) -> None:
    text = FLEET[: FLEET.index("outlets:")]
    path = tmp_path / "fleet.yaml"
    path.write_text(text)
    bus = MemoryBus()
    async with (
        FleetServer(path, bus=bus.new_connection()),
        Fleet(bus.new_connection(), None, None, None, 20, {}) as one,
    ):
        assert await one.outlets() == []
        assert await one.stored_results() == []


async def test_arguments_are_checked(tmp_path: Path) -> None:
    async with plant(tmp_path) as (_, fleet):
        with pytest.raises(ConfigurationError, match="time zone"):
            await fleet.stored_results(since=datetime(2030, 1, 1))  # noqa: DTZ001 - it lacks one
        with pytest.raises(ConfigurationError, match="max_rows"):
            await fleet.stored_results(max_rows=-1)


async def test_a_large_answer_leaves_out_the_oldest_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.fleet._agent.outlet_service.MAX_ROWS_BYTES", 12_000)
    async with plant(tmp_path) as (_, fleet):
        await triggered(fleet, 6)
        with contextlib.closing(sqlite3.connect(tmp_path / "results.sqlite")) as database:
            ids = [one for (one,) in database.execute("SELECT id FROM results ORDER BY at")]
        (told,) = await fleet.stored_results()
    assert told.total == 6
    assert 0 < len(told.rows) < 6
    assert [row["id"] for row in told.rows] == ids[-len(told.rows) :]


async def test_a_page_shows_accounts_and_what_failed(tmp_path: Path) -> None:
    aiohttp = pytest.importorskip("aiohttp")
    from smartcam.web import FleetSite

    async with plant(tmp_path) as (_, fleet), FleetSite(fleet) as site:
        await triggered(fleet, 2)
        site.outlets._asked_at = -10.0
        async with aiohttp.ClientSession() as session:

            async def get(path: str, **query: str) -> Any:
                async with session.get(f"{site.origin}/api/{path}", params=query) as answer:
                    return answer.status, await answer.json()

            status, said = await get("outlets")
            assert (status, said["outlets"][0]["delivered"]) == (200, 2)
            status, said = await get("stored", hours="8", failed="true")
            assert (status, said["stores"][0]["total"], said["stores"][0]["rows"]) == (200, 2, [])
            assert (await get("stored", hours="-1"))[0] == 422
            assert (await get("stored", camera="//"))[0] == 422
