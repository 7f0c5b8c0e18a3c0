"""An agent's health and numbers over HTTP: ``/healthz``, ``/readyz``, ``/metrics``."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from typing import TYPE_CHECKING, Any

from aiohttp import web

from smartcam._server import Server
from smartcam.exceptions import ConfigurationError
from smartcam.fleet._metric_families import exposition, require_client
from smartcam.fleet._metrics import read_numbers
from smartcam.fleet._operations_file import OperationsSection
from smartcam.settings import validated
from smartcam.web._connections import visitor_of
from smartcam.web._guard import HEADERS
from smartcam.web._site import OpenPort, open_port

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.fleet import FleetServer

_log = logging.getLogger("smartcam.web")

MOST_TOLD = 100
"""Cameras that are named as not connected."""


class OperationsSite(Server):
    """What watches an agent asks here; nothing can be changed, and nobody has to say who they are.

    ::

        server = smartcam.fleet.serve("fleet.yaml")
        async with smartcam.web.OperationsSite(server) as site, server:
            print(f"http://127.0.0.1:{site.port}/metrics")

    Args:
        server: the agent; may be started later.
        listen: ``HOST:PORT``; None: as its file says, or where that says nothing
            ``127.0.0.1:9464``. Port 0 takes a free one.

    Raises:
        MissingExtraError: the extra ``operations`` is not installed.
        ConfigurationError: that is no place, or the file says to listen nowhere.
    """

    def __init__(self, server: FleetServer, *, listen: str | None = None) -> None:
        require_client()
        self._server = server
        section = server.file.operations or OperationsSection.model_validate({})
        if listen is not None:
            section = validated(
                OperationsSection, {**section.model_dump(), "listen": listen}, "operations"
            )
        if section.place is None:
            raise ConfigurationError("operations.listen: null: there is nowhere to listen")
        self._host, self._port = section.place
        self._each = section.latency == "camera"
        self._tried = False
        self._open: OpenPort | None = None
        self._making: asyncio.Task[tuple[bytes, str]] | None = None

    @property
    def port(self) -> int:
        """The port it listens on; the one given until it is started."""
        return self._port

    async def start(self) -> None:
        """Open the port; does nothing if it is open.

        Raises:
            ConfigurationError: it cannot listen there.

        Cancellation: leaves it stopped.
        """
        if self._open is not None:
            return
        application = web.Application(middlewares=[_placed], client_max_size=0)
        application.on_response_prepare.append(_add_headers)
        for path, handler in self._pages().items():
            application.router.add_get(path, handler)
        try:
            opened = await open_port(application, self._host, self._port)
        except (OSError, ValueError, OverflowError) as exc:
            raise ConfigurationError(
                f"operations.listen: cannot listen on {self._host}:{self._port}: {exc}"
            ) from exc
        self._port, self._open = opened.port, opened

    async def stop(self) -> None:
        """Close the port and every connection; does nothing if stopped. Bounded."""
        opened, self._open = self._open, None
        if opened is None:
            return
        closing = asyncio.ensure_future(opened.close())
        try:
            await asyncio.shield(closing)
        except asyncio.CancelledError:
            await asyncio.wait({closing})
            raise
        finally:
            making, self._making = self._making, None
            if making is not None:
                making.cancel()
                await asyncio.wait({making})

    # ------------------------------------------------------------------ what is asked

    def _pages(self) -> dict[str, Callable[[web.Request], Awaitable[web.Response]]]:
        return {"/healthz": self._health, "/readyz": self._ready, "/metrics": self._metrics}

    async def _health(self, _request: web.Request) -> web.Response:
        """Answer: that there is an answer says that the event loop runs."""
        return web.Response(text="ok\n")

    async def _ready(self, _request: web.Request) -> web.Response:
        value = self.readiness()
        return web.Response(
            text=json.dumps(value) + "\n",
            status=200 if value["ready"] else 503,
            content_type="application/json",
        )

    def readiness(self) -> dict[str, Any]:
        """Return whether the agent is on the bus and has tried every camera once; for JSON.

        A camera that is not connected, or that a reload brings later, changes nothing about it.
        """
        server = self._server
        hosts = server.hosts.values()
        started = server.agent is not None
        tried = sum(host.was_tried for host in hosts)
        self._tried = started and (self._tried or tried == len(hosts))
        missing = [host.name for host in hosts if not host.connected]
        reason = None
        if not started:
            reason = "the agent is not on the bus"
        elif not self._tried:
            reason = f"{tried} of {len(hosts)} cameras were tried"
        return {
            "ready": reason is None,
            "reason": reason,
            "agent": server.name or None,
            "cameras": len(hosts),
            "connected": len(hosts) - len(missing),
            "not_connected": missing[:MOST_TOLD],
        }

    async def _metrics(self, _request: web.Request) -> web.Response:
        """Answer with the numbers of now; who asks at the same time gets the same."""
        if self._making is None or self._making.done():
            self._making = asyncio.get_running_loop().create_task(
                self._made(), name="smartcam.metrics"
            )
        body, kind = await asyncio.shield(self._making)
        return web.Response(body=body, headers={"Content-Type": kind})

    async def _made(self) -> tuple[bytes, str]:
        numbers = await read_numbers(self._server)
        return await exposition(numbers, each=self._each)


@web.middleware
async def _placed(
    request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
) -> web.StreamResponse:
    """Give the connection its place, and have nothing of a fault go out."""
    visitor = visitor_of(request)
    with contextlib.ExitStack() as stack:
        if visitor is not None:
            stack.enter_context(visitor.request(request))
            stack.enter_context(visitor.answer())
        try:
            response = await handler(request)
        except web.HTTPException as exc:
            response = web.Response(
                status=exc.status,
                text=f"{exc.status} {exc.reason}: there are /healthz, /readyz, /metrics\n",
            )
        except Exception:  # noqa: BLE001 - the last place
            _log.exception("! %s %s: a fault of ours", request.method, request.path)
            response = web.Response(status=500, text="500 a fault of ours: see the log\n")
    if not request.content.is_eof():
        response.force_close()
    return response


async def _add_headers(_request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)
