"""A fleet with one emulated camera, and a program without smartcam at its bus."""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

import smartcam.fleet
from smartcam.emulator import Application, EmulatedCamera
from smartcam.fleet import FleetFile, FleetServer, MemoryBus
from smartcam.protocols import messages as m
from tests.fleet.fleetkit import until
from tests.processes import free_place
from tests.timed_loop import TimedLoop

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from smartcam.fleet._inside import Bus
    from tests.fleet.inside import Publisher

PREFIX = "smartcam/plant"
NAME = "line1/cam3"
PATIENCE = 30.0
"""Seconds; only what has gone wrong takes as long."""

COUNTER, TEXTS, LOCALIZATIONS, SILENT = 11, 12, 7, 13
LAYOUT = "n: int32"


async def ask_thesis(session: Any, service: str, fields: dict[str, Any]) -> dict[str, Any]:
    """Return what a service of the thesis' interface answers to a program at plain Zenoh."""
    payload = json.dumps({"camera_name": NAME, **fields}).encode()

    def get() -> Any:
        (reply,) = session.get(f"{PREFIX}/thesis/{service}", payload=payload, timeout=PATIENCE)
        return json.loads(reply.ok.payload.to_bytes())

    answer: dict[str, Any] = await asyncio.to_thread(get)
    return answer


def applications() -> list[Application]:
    """Return a counter from 1, one that sends two texts, and one that sends nothing."""
    counts: list[Any] = [{"n": number} for number in range(1, 100)]
    texts: list[Any] = [{"text": "bolt"}, {"text": ""}]
    return [
        Application(id=COUNTER, layout=LAYOUT, cycle=counts, processing_time=0.01, load_time=0.05),
        Application(id=TEXTS, layout="(text: string[50])*", constant=texts, load_time=0.05),
        Application(id=SILENT, load_time=0.05),
    ]


class Client:
    """A program without smartcam; :class:`InProcess` and :class:`OverZenoh` are its two kinds."""

    async def ask_raw(self, key: str, payload: bytes) -> list[tuple[str, bytes]]:
        raise NotImplementedError

    def hear(self, pattern: str, take: Callable[[str, bytes], None]) -> None:
        raise NotImplementedError

    async def ask(self, key: str, request: object = None) -> list[tuple[str, dict[str, Any]]]:
        """Return what all answer, by key."""
        payload = request if isinstance(request, bytes) else json.dumps(request).encode()
        answers = await self.ask_raw(f"{PREFIX}/{key}", b"" if request is None else payload)
        return [(key.removeprefix(f"{PREFIX}/"), json.loads(said)) for key, said in answers]

    async def call(self, name: str, camera: str = NAME, **request: Any) -> dict[str, Any]:
        """Return the one answer of a service."""
        ((key, answer),) = await self.ask(f"service/{camera}/{name}", request)
        assert key == f"service/{camera}/{name}"
        assert isinstance(answer["error"], str)
        assert bool(answer["error"]) == ("kind" in answer)
        return answer

    async def thesis(self, name: str, camera: str = NAME, **request: Any) -> dict[str, Any]:
        """Return the one answer of a service of the thesis' interface."""
        ((_, answer),) = await self.ask(f"thesis/{name}", {"camera_name": camera, **request})
        return answer

    async def topic(self, pattern: str) -> Heard:
        """Subscribe; what is said from now on is heard."""
        heard = Heard()
        self.hear(f"{PREFIX}/{pattern}", heard.take)
        await self.call("status")  # the agent has seen the subscription before it answers
        return heard


class Heard:
    """The messages that came under a pattern."""

    def __init__(self) -> None:
        self._came: asyncio.Queue[tuple[str, dict[str, Any]]] = asyncio.Queue()

    def take(self, key: str, payload: bytes) -> None:
        self._came.put_nowait((key.removeprefix(f"{PREFIX}/"), json.loads(payload)))

    async def next(self) -> tuple[str, dict[str, Any]]:
        """Return the next one with its key."""
        async with asyncio.timeout(PATIENCE):
            return await self._came.get()

    async def until(self, wanted: Callable[[dict[str, Any]], object]) -> list[dict[str, Any]]:
        """Return what came up to the first one that is wanted, which is the last."""
        came: list[dict[str, Any]] = []
        while not came or not wanted(came[-1]):
            came.append((await self.next())[1])
        return came

    @property
    def empty(self) -> bool:
        return self._came.empty()


class InProcess(Client):
    """At an end of a bus in this process."""

    def __init__(self, end: Bus) -> None:
        self._end = end

    async def ask_raw(self, key: str, payload: bytes) -> list[tuple[str, bytes]]:
        return await self._end.ask(key, payload, PATIENCE)

    def hear(self, pattern: str, take: Callable[[str, bytes], None]) -> None:
        self._end.subscribe(pattern, take)


class OverZenoh(Client):
    """With plain Zenoh, at a server in this process."""

    def __init__(self, session: Any, server: FleetServer) -> None:
        self._session = session
        self._server = server
        self._loop = asyncio.get_running_loop()

    async def topic(self, pattern: str) -> Heard:
        heard = await super().topic(pattern)
        # of a subscription the engine tells in another thread than of what is asked
        await until(lambda: all(one.has_subscribers for one in self._publishers(pattern)))
        return heard

    def _publishers(self, pattern: str) -> list[Publisher]:
        """Return what the server says things with that a pattern means."""
        own = self._server.shared_cameras[NAME].topics
        if pattern.startswith("topic/"):
            return [
                one
                for kind, one in own._topics._kind_publishers.items()
                if kind == pattern.split("/")[1]
            ]
        results = None if own.results_out is None else own.results_out.publisher
        return [one for one in (own.status_out, results) if one is not None]

    async def ask_raw(self, key: str, payload: bytes) -> list[tuple[str, bytes]]:
        return await asyncio.to_thread(self._get, key, payload)

    def _get(self, key: str, payload: bytes) -> list[tuple[str, bytes]]:
        replies = self._session.get(key, payload=payload or None, timeout=PATIENCE)
        return [(str(one.ok.key_expr), one.ok.payload.to_bytes()) for one in replies]

    def hear(self, pattern: str, take: Callable[[str, bytes], None]) -> None:
        def on_sample(sample: Any) -> None:
            key, payload = str(sample.key_expr), sample.payload.to_bytes()
            self._loop.call_soon_threadsafe(take, key, payload)

        self._session.declare_subscriber(pattern, on_sample)


class Plant(NamedTuple):
    """A fleet with one camera.

    Attributes:
        client: a program without smartcam.
        camera: the emulated camera.
        server: the agent.
        memory: the bus, where it is one in this process.
    """

    client: Client
    camera: EmulatedCamera
    server: FleetServer
    memory: MemoryBus | None

    @property
    def active(self) -> int | None:
        """The application that the camera has told of."""
        return self.server.shared_cameras[NAME].client.active_application

    @contextlib.asynccontextmanager
    async def fleet(self) -> AsyncIterator[smartcam.fleet.Fleet]:
        """A program of smartcam's in the same fleet."""
        if self.memory is None:
            made = smartcam.fleet.open(self.server.address.url)
        else:
            made = smartcam.fleet.Fleet(
                self.memory.new_connection(), None, "plant", None, PATIENCE, {}
            )
        async with made as fleet:
            yield fleet


def fleet_file(url: str, **more: Any) -> FleetFile:
    """Return a fleet file with one camera."""
    entry: dict[str, Any] = {
        "url": url,
        "application": COUNTER,
        "interpret_as": {COUNTER: LAYOUT, TEXTS: "strings50"},
        "reconnect": {"initial": 0.05, "maximum": 0.05},
    }
    fields = {"agent": "one", "listen": free_place(), "cameras": {NAME: {**entry, **more}}}
    return FleetFile.model_validate(fields)


def zenoh_session(port: int) -> Any:
    """Return a session of plain Zenoh's with what listens at a port."""
    zenoh = pytest.importorskip("zenoh")
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def is_virtual() -> bool:
    """True if time is virtual here, so that the bus is the one inside the process."""
    return isinstance(asyncio.get_running_loop(), TimedLoop)


@contextlib.asynccontextmanager
async def plant(**more: Any) -> AsyncIterator[Plant]:
    """A fleet with one camera; over Zenoh where time is real. ``more`` is for its file."""
    async with contextlib.AsyncExitStack() as stack:
        made = EmulatedCamera(applications=applications(), active=COUNTER, running=True)
        camera = await stack.enter_async_context(made)
        memory = MemoryBus() if is_virtual() else None
        file = fleet_file(camera.url, **more)
        made_server = FleetServer(file, bus=None if memory is None else memory.new_connection())
        server = await stack.enter_async_context(made_server)
        await server.wait_first_attempts()
        if memory is not None:
            end = await memory.new_connection().open(PATIENCE)
            stack.push_async_callback(end.close)
            client: Client = InProcess(end)
        else:
            session = await asyncio.to_thread(zenoh_session, server.address.port)
            stack.push_async_callback(asyncio.to_thread, session.close)
            client = OverZenoh(session, server)
        yield Plant(client, camera, server, memory)


def heard(camera: EmulatedCamera, kind: type[m.Message]) -> int:
    """Return how many messages of a kind a camera got."""
    return sum(isinstance(entry.message, kind) for entry in camera.log if entry.direction == "in")
