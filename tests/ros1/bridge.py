"""A rosbridge inside the process, which does what rosbridge_suite's branch ros1 does.

Its services belong to all links and stay when their link goes; calls are counted by service and
from one; a response is kept by the call's number until the call takes it; a call waits without end.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import Any

from aiohttp import WSMsgType, web

from smartcam._server import Server
from tests.processes import free_port


class Gone(Exception):  # noqa: N818
    """The answer that a caller gets when the service is withdrawn."""


class Served:
    """A service that a link has advertised."""

    def __init__(self, link: web.WebSocketResponse, kind: str) -> None:
        self.link, self.type = link, kind
        self.count = 0
        self.withdrawn = asyncio.Event()

    def add(self) -> None:
        self.count += 1


class Bridge(Server):
    """See the module.

    Attributes:
        links: that are open.
        said: every operation that came, but those of ``published``.
        topics: the last advertisement of each.
        published: operations ``publish``.
        services: by name.
        heard: operations ``subscribe`` under way, by their ids.
        reading: cleared, nothing is read.
        rosapi: what is said of a topic's subscribers.
        late: what the first link, a slow one, hears when a service has been withdrawn.
        wakes_after: seconds in which the thread of a call wakes up after the response.
    """

    def __init__(self, wakes_after: float = 0.1) -> None:
        self.wakes_after = wakes_after
        self.links: list[web.WebSocketResponse] = []
        self.said: list[dict[str, Any]] = []
        self.topics: dict[str, dict[str, Any]] = {}
        self.published: list[dict[str, Any]] = []
        self.services: dict[str, Served] = {}
        self.responses: dict[str, dict[str, Any]] = {}
        self.heard: dict[str, dict[str, Any]] = {}
        self.late: dict[str, Any] | None = None
        self.rosapi: Any = lambda _arguments: None
        self.changed = asyncio.Condition()
        self.reading = asyncio.Event()
        self.reading.set()
        self._port = free_port()
        self._runner: web.AppRunner | None = None

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self._port}"

    async def start(self) -> None:
        app = web.Application()
        app.router.add_get("/", self._serve)
        self._runner = web.AppRunner(app, shutdown_timeout=0)
        await self._runner.setup()
        site = web.TCPSite(self._runner, "127.0.0.1", self._port)
        await site.start()
        self._port = self._runner.addresses[0][1]

    async def stop(self) -> None:
        runner, self._runner = self._runner, None
        if runner is not None:
            await self.cut()
            await runner.cleanup()

    async def cut(self) -> None:
        """End all links, as a network does: nobody says goodbye."""
        for link in self.links:
            transport = link.get_extra_info("socket")
            if transport is not None:
                with contextlib.suppress(OSError):
                    transport.shutdown(2)
        await self.until(lambda: not self.links)

    async def restart(self) -> None:
        """Be another process."""
        await self.stop()
        for one in self.services.values():
            one.withdrawn.set()
        self.services.clear()
        self.topics.clear()
        self.responses.clear()
        await self.start()

    async def until(self, met: Any) -> None:
        async with asyncio.timeout(600), self.changed:
            await self.changed.wait_for(met)

    async def call(self, service: str, args: Any = None, **more: Any) -> dict[str, Any]:
        """Call a service; the operation that was the response.

        Raises:
            Gone: it was withdrawn.
        """
        await self.until(lambda: service in self.services)
        served = self.services[service]
        await self._change(served.add)
        identity = f"service_request:{service}:{served.count}"
        said = {"op": "call_service", "id": identity, "service": service}
        with contextlib.suppress(ConnectionError):
            await served.link.send_str(json.dumps({**said, "args": args or {}, **more}))
        await self.until(lambda: identity in self.responses or served.withdrawn.is_set())
        await asyncio.sleep(self.wakes_after)
        if served.withdrawn.is_set():
            raise Gone
        return self.responses.pop(identity)

    async def another(self, service: str, before: Served) -> None:
        """Wait until a service is advertised again."""
        await self.until(lambda: self.services.get(service, before) is not before)

    async def say(self, operation: object) -> None:
        """Say something on the first link."""
        text = operation if isinstance(operation, str) else json.dumps(operation)
        with contextlib.suppress(ConnectionError):
            await self.links[0].send_str(text)

    async def publish(self, topic: str, message: dict[str, Any]) -> None:
        """Publish a message of ROS to the links that have subscribed to the topic."""
        links = {one["link"] for one in self.heard.values() if one["topic"] == topic}
        for link in links:
            with contextlib.suppress(ConnectionError):
                await link.send_str(json.dumps({"op": "publish", "topic": topic, "msg": message}))

    async def _serve(self, request: web.Request) -> web.WebSocketResponse:
        link = web.WebSocketResponse(max_msg_size=0)
        await link.prepare(request)
        await self._change(self.links.append, link)
        try:
            while True:
                await self.reading.wait()
                message = await link.receive()
                if message.type is not WSMsgType.TEXT:
                    return link
                await self._hear(link, json.loads(message.data))
        finally:
            await self._change(self.links.remove, link)

    async def _change(self, how: Any, *what: Any) -> None:
        async with self.changed:
            how(*what)
            self.changed.notify_all()

    async def _hear(self, link: web.WebSocketResponse, said: dict[str, Any]) -> None:
        hear = getattr(self, f"_{said['op']}", None)
        if hear is not None:
            await hear(link, said)
        where = self.published if said["op"] == "publish" else self.said
        await self._change(where.append, said)

    async def _subscribe(self, link: web.WebSocketResponse, said: dict[str, Any]) -> None:
        self.heard[said["id"]] = {**said, "link": link}

    async def _unsubscribe(self, _: web.WebSocketResponse, said: dict[str, Any]) -> None:
        self.heard.pop(said["id"], None)

    async def _advertise(self, _link: web.WebSocketResponse, said: dict[str, Any]) -> None:
        self.topics[said["topic"]] = said

    async def _unadvertise(self, _link: web.WebSocketResponse, said: dict[str, Any]) -> None:
        self.topics.pop(said["topic"], None)  # another link may have had it, too

    async def _advertise_service(self, link: web.WebSocketResponse, said: dict[str, Any]) -> None:
        self.services[said["service"]] = Served(link, said["type"])

    async def _unadvertise_service(self, _: web.WebSocketResponse, said: dict[str, Any]) -> None:
        served = self.services.pop(said["service"], None)
        if served is not None:
            served.withdrawn.set()
            late = asyncio.create_task(self._say_late())
            await asyncio.sleep(1)
            self._late = late

    async def _say_late(self) -> None:
        if self.late is not None:
            await asyncio.sleep(1.3)
            await self.say(self.late)

    async def _service_response(self, _: web.WebSocketResponse, said: dict[str, Any]) -> None:
        if "values" in said and said["service"] in self.services:
            self.responses[said["id"]] = said

    async def _call_service(self, link: web.WebSocketResponse, said: dict[str, Any]) -> None:
        answer = {"op": "service_response", "id": said["id"], "service": said["service"]}
        if link is self.links[0] and self.late is not None:
            await asyncio.sleep(0.5)
        values = self.rosapi(said["args"]) if said["service"] == "/rosapi/subscribers" else None
        values = values or {"values": "no such service", "result": False}
        await link.send_str(json.dumps({**answer, **values}))
