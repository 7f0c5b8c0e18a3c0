"""Helpers of the pages' tests: sites, calls and event streams."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from typing import Any, NamedTuple, Self
from urllib.parse import quote

import aiohttp

from smartcam.emulator import EmulatedCamera, ManualClock
from smartcam.web import EmulatorSite
from tests.web.inside import Site

TOKEN = "a-token_of-24-characters"  # noqa: S105 - of the tests


class Answer(NamedTuple):
    """The answer to a call."""

    status: int
    value: Any
    headers: dict[str, str]


class Caller:
    """Makes calls to a site, of one camera where the path begins with no slash."""

    def __init__(self, site: Site, session: aiohttp.ClientSession, camera: str) -> None:
        self.site = site
        self.session = session
        self.camera = camera

    def url(self, path: str) -> str:
        if path.startswith("/"):
            return self.site.origin + path
        return f"{self.site.origin}/api/cameras/{quote(self.camera, safe='')}/{path}".rstrip("/")

    async def call(self, method: str, path: str, body: object = None, **options: Any) -> Answer:
        if body is not None:
            options["json"] = body
        async with self.session.request(method, self.url(path), **options) as response:
            assert response.content_type == "application/json"
            return Answer(response.status, await response.json(), dict(response.headers))

    async def get(self, path: str = "", **options: Any) -> Any:
        answer = await self.call("GET", path, **options)
        assert answer.status == 200, answer
        return answer.value

    async def post(self, path: str, body: object = None) -> Any:
        answer = await self.call("POST", path, body)
        assert answer.status == 200, answer
        return answer.value


class Told(NamedTuple):
    """An event of a stream."""

    kind: str
    data: Any
    serial: str | None


class Listener:
    """Reads an event stream."""

    def __init__(self, response: aiohttp.ClientResponse) -> None:
        self.response = response

    async def next(self, kind: str | None = None) -> Told:
        """Return the next event, of a kind."""
        async with asyncio.timeout(60):
            while True:
                block = (await self.response.content.readuntil(b"\n\n")).decode()
                assert block, "the stream has ended"
                fields = dict(line.split(": ", 1) for line in block.splitlines() if line)
                if "event" not in fields:
                    continue  # a sign of life
                told = Told(fields["event"], json.loads(fields["data"]), fields.get("id"))
                if kind in {None, told.kind}:
                    return told

    async def until(self, kind: str, condition: Callable[[Any], object]) -> Any:
        """Return the data of the first event of a kind that fits."""
        while True:
            told = await self.next(kind)
            if condition(told.data):
                return told.data

    async def end(self) -> bytes:
        """Return everything received until the stream ends."""
        async with asyncio.timeout(60):
            return await self.response.content.read()


class World(NamedTuple):
    """A camera whose clock stands still, its site, and who calls it."""

    emulator: EmulatedCamera
    clock: ManualClock
    site: EmulatorSite
    caller: Caller

    @contextlib.asynccontextmanager
    async def events(self, query: str = "", **headers: str) -> AsyncIterator[Listener]:
        url = self.caller.url(f"events{query}")
        async with self.caller.session.get(url, headers=headers) as response:
            assert response.status == 200
            assert response.headers["Content-Type"].startswith("text/event-stream")
            yield Listener(response)


@contextlib.asynccontextmanager
async def served(
    name: str = "camera", *, token: str | None = None, **options: Any
) -> AsyncIterator[World]:
    """Serve a camera; the caller knows the token."""
    clock = ManualClock()
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    async with (
        EmulatedCamera(clock=clock, **options) as emulator,
        EmulatorSite({name: emulator}, token=token) as site,
        aiohttp.ClientSession(headers=headers) as session,
    ):
        yield World(emulator, clock, site, Caller(site, session, name))


class Raw:
    """A connection to a site, byte by byte."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    @classmethod
    @contextlib.asynccontextmanager
    async def connected(cls, site: Site) -> AsyncIterator[Self]:
        reader, writer = await asyncio.open_connection("127.0.0.1", site.port)
        try:
            yield cls(reader, writer)
        finally:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()

    async def call(self, *lines: str) -> tuple[int, bytes]:
        """Send a request's head and return the answer's status and body."""
        self.writer.write("\r\n".join((*lines, "", "")).encode())
        async with asyncio.timeout(60):
            head = (await self.reader.readuntil(b"\r\n\r\n")).decode()
            size = next(
                int(line.partition(":")[2])
                for line in head.splitlines()
                if line.lower().startswith("content-length:")
            )
            return int(head.split()[1]), await self.reader.readexactly(size)
