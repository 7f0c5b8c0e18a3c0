"""The site of clouds: who looks gets the newest one, one at a time; a large one is thinned."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
from collections.abc import AsyncIterator
from typing import Any, NamedTuple

import aiohttp
import numpy as np
import pytest

from smartcam.depth import Cloud, voxel_grid
from smartcam.exceptions import ConfigurationError
from smartcam.web import CloudSite
from tests.handmade import until
from tests.web.inside import MAX_VIEWERS, PROTOCOL, SHOW_TIMEOUT, pack_cloud, thin_cloud
from tests.web.inside import _clouds as clouds_module
from tests.web.sitekit import TOKEN, Caller


def line(count: int, place: float = 0, colours: bool = True) -> Cloud:
    points = np.zeros((count, 3), np.float32)
    points[:, 0], points[:, 2] = np.arange(count), place
    return Cloud(points, np.full((count, 3), 7, np.uint8) if colours else None)


class Looker:
    """One who looks, as the page does."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket

    async def cloud(self) -> tuple[dict[str, Any], Any, Any]:
        """Return the description of the next cloud, its points and colours."""
        async with asyncio.timeout(2 * SHOW_TIMEOUT):
            about = json.loads(await self.socket.receive_str())
            body = b""
            while len(body) < about["bytes"]:
                body += await self.socket.receive_bytes()
        count = about["points"]
        points = np.frombuffer(body, "<f4", 3 * count).reshape(-1, 3)
        colours = np.frombuffer(body, np.uint8, -1, 12 * count).reshape(-1, 3)
        return about, points, colours

    async def next(self) -> None:
        await self.socket.send_str("next")


class World(NamedTuple):
    site: CloudSite
    caller: Caller

    @contextlib.asynccontextmanager
    async def looking(self, **options: Any) -> AsyncIterator[Looker]:
        options = {"protocols": [PROTOCOL], **options}
        url = self.caller.url("/api/clouds")
        async with self.caller.session.ws_connect(url, **options) as socket:
            yield Looker(socket)


@contextlib.asynccontextmanager
async def world(cloud: Cloud | None = None, *, token: str | None = None) -> AsyncIterator[World]:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    async with (
        CloudSite(cloud, up="-y", token=token) as site,
        aiohttp.ClientSession(headers=headers) as session,
    ):
        yield World(site, Caller(site, session, ""))


async def test_cloud_crosses_as_it_is() -> None:
    cloud = line(20_000, 2.5)  # of several parts
    async with world(cloud) as one, one.looking() as looker:
        about, points, colours = await looker.cloud()
    assert np.array_equal(points, cloud.points)
    assert np.array_equal(colours, cloud.colours)  # type: ignore[arg-type]
    assert about == {
        "number": 1, "points": 20_000, "of": 20_000, "voxel": None, "colours": True,
        "low": [0, 0, 2.5], "high": [19_999, 0, 2.5], "bytes": 15 * 20_000,
    }  # fmt: skip


async def test_cloud_without_colours_and_without_points() -> None:
    async with world(line(5, colours=False)) as one, one.looking() as looker:
        about, points, colours = await looker.cloud()
        assert (about["colours"], len(points), len(colours)) == (False, 5, 0)
        one.site.show(Cloud(np.empty((0, 3))))
        await looker.next()
        about, points, _ = await looker.cloud()
        assert (about["points"], about["bytes"], len(points)) == (0, 0, 0)


async def test_newest_comes_when_the_last_was_shown() -> None:
    async with world() as one, one.looking() as looker, one.looking() as quick:
        for number in (1, 2, 3):
            one.site.show(line(number))
        assert (await looker.cloud())[0]["number"] == 3
        one.site.show(line(4))
        one.site.show(line(5))
        with pytest.raises(TimeoutError):  # it has not said that it has shown the third
            async with asyncio.timeout(0.3):
                await looker.socket.receive()
        assert (await quick.cloud())[0]["number"] == 3
        await quick.next()
        assert (await quick.cloud())[0]["number"] == 5
        await looker.next()
        assert (await looker.cloud())[0]["number"] == 5


async def test_cloud_is_packed_once_and_in_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def counted(cloud: Cloud) -> Any:
        made.append(threading.current_thread().name)
        return pack_cloud(cloud)

    monkeypatch.setattr(clouds_module, "pack_cloud", counted)
    async with world(line(3)) as one, one.looking() as looker, one.looking() as other:
        await looker.cloud()
        await other.cloud()
    assert len(made) == 1
    assert made[0].startswith("smartcam.web.cloud")
    assert not any(one.name.startswith("smartcam.web.cloud") for one in threading.enumerate())


async def test_cloud_that_cannot_be_packed_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(cloud: Cloud, most: int) -> Any:
        raise MemoryError("no room for it")

    async with world(line(3)) as one, one.looking() as looker:
        await looker.cloud()
        with monkeypatch.context() as patch:
            patch.setattr(clouds_module, "thin_cloud", fails)
            one.site.show(line(4))
            await looker.next()
            told = json.loads(await looker.socket.receive_str())
        assert told == {"number": 2, "failure": "no room for it", "bytes": 0}
        one.site.show(line(5))
        await looker.next()
        assert (await looker.cloud())[0]["points"] == 5


def test_large_cloud_is_thin_cloud() -> None:
    rng = np.random.default_rng(1)
    cloud = Cloud(rng.random((20_000, 3)) * [1, 2, 0.001])
    thin, size = thin_cloud(cloud, 5000)
    assert size is not None
    assert 2000 < len(thin) <= 5000
    assert np.array_equal(thin.points, voxel_grid(cloud, size).points)
    assert thin_cloud(cloud, 20_000) == (cloud, None)
    for odd in (
        np.full((100, 3), 1e7),  # all at one place, far off
        np.concatenate([rng.random((99, 3)), [[3e38, 0, 0]]]),
        np.concatenate([rng.random((99, 3)) * 1e-30, [[-3e38, 3e38, 0]]]),
    ):
        assert 0 < len(thin_cloud(Cloud(odd), 50)[0]) <= 50


async def test_thinned_cloud_is_said_to_be_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clouds_module, "MAX_CLOUD_POINTS", 100)
    async with world(line(1000)) as one, one.looking() as looker:
        about, points, _ = await looker.cloud()
        state = await one.caller.get("/api/cloud")
    assert about["of"] == 1000
    assert about["points"] == len(points) <= 100
    assert about["voxel"] > 0
    assert state == {"number": 1, "points": 1000, "colours": True, "up": "-y", "viewers": 1}


async def test_page_that_shows_nothing_loses_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clouds_module, "SHOW_TIMEOUT", 0.05)
    async with world(line(3)) as one, one.looking() as looker:
        await looker.cloud()
        async with asyncio.timeout(60):
            message = await looker.socket.receive()
        assert message.type in {aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED}
        await until(lambda: not one.site.viewers)


async def test_who_is_one_too_many_or_no_websocket_is_refused() -> None:
    async with world() as one, contextlib.AsyncExitStack() as stack:
        answer = await one.caller.call("GET", "/api/clouds")
        assert answer.status == 400
        for _ in range(MAX_VIEWERS):
            await stack.enter_async_context(one.looking())
        await until(lambda: len(one.site.viewers) == MAX_VIEWERS)
        with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
            await stack.enter_async_context(one.looking())
        paths = [row["path"] for row in (await one.caller.get("/api"))["calls"]]
        assert paths == ["/api", "/api/cloud", "/api/clouds"]


async def test_token_is_asked_for() -> None:
    async with world(line(2), token=TOKEN) as one, aiohttp.ClientSession() as stranger:
        with pytest.raises(aiohttp.WSServerHandshakeError, match="401"):
            await stranger.ws_connect(one.caller.url("/api/clouds"), protocols=[PROTOCOL])
        url = one.caller.url("/api/clouds")
        protocols = [PROTOCOL, f"bearer.{TOKEN}"]
        async with stranger.ws_connect(url, protocols=protocols) as socket:
            assert (await Looker(socket).cloud())[0]["points"] == 2


async def test_site_that_stops_says_good_bye_and_starts_again() -> None:
    async with world(line(2)) as one, one.looking() as looker:
        await looker.cloud()
        await one.site.stop()
        assert (await looker.socket.receive()).type is aiohttp.WSMsgType.CLOSE
        await one.site.start()
        async with one.looking() as again:
            assert (await again.cloud())[0]["points"] == 2


def test_what_is_no_cloud_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="expected a Cloud, got ndarray"):
        CloudSite(np.zeros((3, 3)))  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="up: expected one of x, y, z"):
        CloudSite(up="w")  # type: ignore[arg-type]
