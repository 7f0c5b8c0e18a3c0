"""The servers of the package that accept connections: how each is started and asked.

What listens and stands neither here nor in :mod:`tests.accepting.test_listeners` fails there.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass
from typing import Any

import aiohttp

import smartcam
from smartcam._accepting import Places
from smartcam.emulator import EmulatedCamera, EmulatedInSight
from smartcam.fleet import FleetServer, MemoryBus
from smartcam.frames import RtspServer
from smartcam.gateway import Gateway, GatewaySettings
from smartcam.makes import EmulatedIfm, EmulatedIv3, EmulatedSr
from smartcam.testing.proxy import LinkProxy
from smartcam.web import EmulatorSite, OperationsSite
from tests.emulator import camera_wire as wire
from tests.frames.drivers import scripted
from tests.frames.rtsp.client import Client, digest
from tests.testing.acme_page import acme
from tests.web.sitekit import TOKEN
from tests.web.test_operations import file

PATIENCE = 600.0
"""Seconds of the tests' own time that anything may take."""

SECRET = "secret-secret"  # noqa: S105 - of the tests

Check = Callable[[], Awaitable[None]]


@dataclass
class Stage:
    """A server that is started.

    Attributes:
        port: that it listens at.
        places: of its connections.
        served: comes as a newcomer, is served, and goes.
        session: has a session while it is open, and gives what sees whether that is alive.
    """

    port: int
    places: Places[Any]
    served: Check
    session: Callable[[], AbstractAsyncContextManager[Check]]


@dataclass(frozen=True)
class Row:
    """A server, and what strangers can say to it that is no session.

    Attributes:
        start: starts it.
        harmless: what anybody may ask, over and over.
        half: the begin of a request.
        one_session: a newcomer that is served takes the session over, as the camera has it.
        asks_again: who asks again in whole may stay: a request is all that there is.
        may_wait: who says nothing may stay until a newcomer wants the place.
        target_decides: it hands on to a server that has places of its own, for its one address.
    """

    start: Callable[[], AbstractAsyncContextManager[Stage]]
    harmless: bytes
    half: bytes
    one_session: bool = False
    asks_again: bool = False
    may_wait: bool = False
    target_decides: bool = False


def _camera(url: str, port: int, places: Places[Any]) -> Stage:
    """Return the stage of a camera, whose clients are smartcam's own."""

    @asynccontextmanager
    async def session() -> AsyncIterator[Check]:
        async with asyncio.timeout(PATIENCE):
            camera = await smartcam.connect(url, reconnect=None).open()

        async def alive() -> None:
            async with asyncio.timeout(PATIENCE):
                await camera.query_application()

        try:
            yield alive
        finally:
            await camera.close()

    async def served() -> None:
        async with session() as alive:
            await alive()

    return Stage(port, places, served, session)


@asynccontextmanager
async def bvs() -> AsyncIterator[Stage]:
    async with EmulatedCamera() as camera:
        yield _camera(camera.url, camera.port, camera._listener.places)


@asynccontextmanager
async def insight() -> AsyncIterator[Stage]:
    async with EmulatedInSight([{"file": "1.job"}], active=1) as camera:
        yield _camera(camera.url, camera.port, camera._listener.places)


@asynccontextmanager
async def proxy() -> AsyncIterator[Stage]:
    async with (
        EmulatedInSight([{"file": "1.job"}], active=1) as camera,
        LinkProxy("127.0.0.1", camera.port) as between,
    ):
        relay: Any = between._relay
        yield _camera(between.url(camera.url), between.port, relay._acceptor.places)


@asynccontextmanager
async def ifm() -> AsyncIterator[Stage]:
    async with EmulatedIfm() as camera:
        yield _camera(camera.url, camera.port, camera._listener.places)


@asynccontextmanager
async def iv3() -> AsyncIterator[Stage]:
    async with EmulatedIv3() as camera:
        yield _camera(camera.url, camera.port, camera._listener.places)


@asynccontextmanager
async def sr() -> AsyncIterator[Stage]:
    async with EmulatedSr() as camera:
        yield _camera(camera.url, camera.port, camera._listener.places)


@asynccontextmanager
async def lines() -> AsyncIterator[Stage]:
    async with acme.AcmeCamera() as camera:
        yield _camera(camera.url, camera.port, camera._listener.places)


def _web(port: int, places: Places[Any], path: str, headers: dict[str, str]) -> Stage:
    """Return the stage of a page: a session is a request that is being answered."""

    async def served() -> None:
        url = f"http://127.0.0.1:{port}{path}"
        async with (
            asyncio.timeout(PATIENCE),
            aiohttp.ClientSession(headers=headers) as session,
            session.get(url) as response,
        ):
            assert response.status == 200, await response.text()

    @asynccontextmanager
    async def session() -> AsyncIterator[Check]:
        yield served

    return Stage(port, places, served, session)


@asynccontextmanager
async def page() -> AsyncIterator[Stage]:
    headers = {"Authorization": f"Bearer {TOKEN}"}
    async with EmulatedCamera() as camera, EmulatorSite({"c": camera}, token=TOKEN) as site:
        opened = site._open_port
        assert opened is not None
        stage = _web(site.port, opened.places, "/api", headers)

        @asynccontextmanager
        async def session() -> AsyncIterator[Check]:
            url = f"http://127.0.0.1:{site.port}/api/cameras/c/events"
            async with (
                aiohttp.ClientSession(headers=headers) as client,
                client.get(url, timeout=aiohttp.ClientTimeout(total=None)) as events,
            ):

                async def alive() -> None:
                    async with asyncio.timeout(PATIENCE):
                        assert await events.content.readuntil(b"\n\n")

                yield alive

        stage.session = session
        yield stage


@asynccontextmanager
async def operations() -> AsyncIterator[Stage]:
    async with EmulatedCamera() as camera:
        server = FleetServer(file({"c": camera.url}), bus=MemoryBus().new_connection())
        async with OperationsSite(server) as site, server:
            opened = site._open_port
            assert opened is not None
            yield _web(site.port, opened.places, "/healthz", {})


@asynccontextmanager
async def rtsp(password: str | None = SECRET) -> AsyncIterator[Stage]:
    _, source = scripted(stall=None)
    user = None if password is None else "me"
    async with source, RtspServer({"left": source}, port=0, user=user, password=password) as server:
        serving = server._serving
        assert serving is not None

        async def asked(client: Client, method: str, url: str, **headers: str) -> None:
            reply = await client.ask(method, url, **headers)
            if reply.status == 401:
                shown = digest(reply, method, url, "me", SECRET)
                reply = await client.ask(method, url, Authorization=shown, **headers)
            assert reply.status == 200, reply
            if method == "SETUP":
                client.session = reply.headers["session"].partition(";")[0]

        @asynccontextmanager
        async def session() -> AsyncIterator[Check]:
            async with asyncio.timeout(PATIENCE), await Client.connect(server) as client:
                track = f"{client.base}/track1"
                await asked(client, "SETUP", track, Transport="RTP/AVP/TCP;unicast;interleaved=0-1")

                async def alive() -> None:
                    await asked(client, "GET_PARAMETER", client.base)

                yield alive

        async def served() -> None:
            async with session() as alive:
                await alive()

        yield Stage(server.port, serving.places, served, session)


@asynccontextmanager
async def robots() -> AsyncIterator[Stage]:
    settings = GatewaySettings(listen="tcp/127.0.0.1:0")
    async with (
        EmulatedCamera() as camera,
        smartcam.connect(camera.url, interpret_as="localizations") as connected,
        Gateway(connected, settings) as gateway,
    ):
        port = int(gateway.address.rpartition(":")[2])

        @asynccontextmanager
        async def session() -> AsyncIterator[Check]:
            async with asyncio.timeout(PATIENCE):
                reader, writer = await asyncio.open_connection("127.0.0.1", port)

            async def alive() -> None:
                async with asyncio.timeout(PATIENCE):
                    writer.write(b"NEXT\n")
                    assert await reader.readuntil(b"\n")

            try:
                await alive()
                yield alive
            finally:
                writer.close()

        async def served() -> None:
            async with session() as alive:
                await alive()

        yield Stage(port, gateway._acceptor.places, served, session)


OPTIONS = b"OPTIONS rtsp://127.0.0.1/left RTSP/1.0\r\nCSeq: 1\r\n\r\n"
GET = b"GET %b HTTP/1.1\r\nHost: localhost\r\n\r\n"

SERVERS: dict[str, Row] = {
    "bvs": Row(bvs, wire.QUERY, wire.CONNECT[:-1], one_session=True),
    "insight": Row(insight, b"nobody\r\nwrong\r\n", b"adm"),
    "lines": Row(lines, b"STATE\r\n", b"HEL"),
    "ifm": Row(ifm, b"1000L000000008\r\n1000A?\r\n", b"1000L0000"),
    "iv3": Row(iv3, b"PR\r", b"R"),
    "sr": Row(sr, b"NUM\r", b"ERRS"),
    "proxy": Row(proxy, b"nobody\r\nwrong\r\n", b"adm", target_decides=True),
    "page": Row(page, GET % b"/", GET[:-2] % b"/api", asks_again=True),
    "operations": Row(operations, GET % b"/healthz", b"GET /hea", asks_again=True),
    "gateway": Row(robots, b"STATUS\n", b"STAT", may_wait=True),
    "rtsp": Row(rtsp, OPTIONS, OPTIONS[:-2]),
    "rtsp without a password": Row(lambda: rtsp(None), OPTIONS, OPTIONS[:-2]),
}
"""By a name; every server that accepts connections."""
