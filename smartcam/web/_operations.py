"""Serve an agent's health and metrics over HTTP: ``/healthz``, ``/readyz``, ``/metrics``."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
from typing import TYPE_CHECKING, Any, TypeAlias

from aiohttp import web

from smartcam._accepting import is_loopback
from smartcam._finishing import finish
from smartcam._server import Server
from smartcam.exceptions import ConfigurationError
from smartcam.fleet._inside import OperationsSection, exposition, read_counts, require_prometheus
from smartcam.settings import validated
from smartcam.web._connections import connection_of
from smartcam.web._errors import RefusedError
from smartcam.web._guard import HEADERS, check_host
from smartcam.web._site import OpenPort, open_port

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection

    from smartcam.fleet import FleetServer

_log = logging.getLogger("smartcam.web")

_Handler: TypeAlias = "Callable[[web.Request], Awaitable[web.StreamResponse]]"

MAX_CAMERAS_LISTED = 100
"""Largest number of unconnected cameras that an answer names."""


class OperationsSite(Server):
    """A site for programs that monitor an agent; read-only, without a login.

    ::

        server = smartcam.fleet.serve("fleet.yaml")
        async with smartcam.web.OperationsSite(server) as site, server:
            print(f"http://127.0.0.1:{site.port}/metrics")

    Args:
        server: the agent; may be started later.
        listen: ``HOST:PORT``; None: as in the agent's file, by default ``127.0.0.1:9464``.
            Port 0 takes a free one.

    Raises:
        MissingExtraError: the extra ``operations`` is not installed.
        ConfigurationError: the address is not valid, or the file switches the site off.
    """

    def __init__(self, server: FleetServer, *, listen: str | None = None) -> None:
        require_prometheus()
        self._agent_server = server
        section = server.file.operations or OperationsSection.model_validate({})
        if listen is not None:
            section = validated(
                OperationsSection, {**section.model_dump(), "listen": listen}, "operations"
            )
        if section.endpoint is None:
            raise ConfigurationError("operations.listen: null: there is nowhere to listen")
        self._host, self._port = section.endpoint
        self._names = {socket.gethostname().lower(), *(name.lower() for name in section.names)}
        self._per_camera = section.latency == "camera"
        self._all_tried = False
        self._open_port: OpenPort | None = None
        self._metrics_task: asyncio.Task[tuple[bytes, str]] | None = None

    @property
    def port(self) -> int:
        """The port that the site listens on; the given one until it is started."""
        return self._port

    async def start(self) -> None:
        """Open the port; do nothing if it is open.

        Raises:
            ConfigurationError: the site cannot listen there.

        Cancellation: leaves the site stopped.
        """
        if self._open_port is not None:
            return
        names = None if is_loopback(self._host) else self._names
        application = web.Application(middlewares=[_middleware(names)], client_max_size=0)
        application.on_response_prepare.append(_add_headers)
        for path, handler in self._pages().items():
            application.router.add_get(path, handler)
        try:
            opened = await open_port(application, self._host, self._port)
        except (OSError, ValueError, OverflowError) as exc:
            raise ConfigurationError(
                f"operations.listen: cannot listen on {self._host}:{self._port}: {exc}"
            ) from exc
        self._port, self._open_port = opened.port, opened

    async def stop(self) -> None:
        """Close the port and every connection; do nothing if stopped. Bounded."""
        opened, self._open_port = self._open_port, None
        if opened is None:
            return
        try:
            await finish(opened.close)
        finally:
            task, self._metrics_task = self._metrics_task, None
            if task is not None:
                task.cancel()
                await asyncio.wait({task})

    # ------------------------------------------------------------------ answers

    def _pages(self) -> dict[str, Callable[[web.Request], Awaitable[web.Response]]]:
        return {"/healthz": self._health, "/readyz": self._ready, "/metrics": self._metrics}

    async def _health(self, _request: web.Request) -> web.Response:
        """Answer; any answer shows that the event loop runs."""
        return web.Response(text="ok\n")

    async def _ready(self, _request: web.Request) -> web.Response:
        value = self.readiness()
        return web.Response(
            text=json.dumps(value) + "\n",
            status=200 if value["ready"] else 503,
            content_type="application/json",
        )

    def readiness(self) -> dict[str, Any]:
        """Return the readiness, as values for JSON.

        The agent is ready when it is on the bus and has once tried to connect to each camera. A
        camera that is lost, or added by a reload, does not change this.
        """
        server = self._agent_server
        cameras = server.shared_cameras.values()
        started = server.agent is not None
        tried = sum(camera.was_tried for camera in cameras)
        self._all_tried = started and (self._all_tried or tried == len(cameras))
        missing = [camera.name for camera in cameras if not camera.connected]
        reason = None
        if not server.is_connected:
            reason = "the agent is not on the bus"
            if started:
                reason += f": nobody answers at {', '.join(server.file.endpoints[1])}"
        elif server.agent is not None and server.agent.retired_by is not None:
            reason = str(server.agent.retired_by)
        elif not self._all_tried:
            reason = f"{tried} of {len(cameras)} cameras were tried"
        return {
            "ready": reason is None,
            "reason": reason,
            "agent": server.name or None,
            "cameras": len(cameras),
            "connected": len(cameras) - len(missing),
            "not_connected": missing[:MAX_CAMERAS_LISTED],
        }

    async def _metrics(self, _request: web.Request) -> web.Response:
        """Answer with the current numbers; requests at the same time get the same answer."""
        if self._metrics_task is None or self._metrics_task.done():
            self._metrics_task = asyncio.get_running_loop().create_task(
                self._make_metrics(), name="smartcam.metrics"
            )
        body, kind = await asyncio.shield(self._metrics_task)
        return web.Response(body=body, headers={"Content-Type": kind})

    async def _make_metrics(self) -> tuple[bytes, str]:
        numbers = await read_counts(self._agent_server)
        return await exposition(numbers, per_camera=self._per_camera)


def _middleware(names: Collection[str] | None) -> Any:
    """Return the middleware of all handlers, which bounds connections and refuses with a text.

    Args:
        names: names of this machine that requests may use; None: only loopback names.
    """

    @web.middleware
    async def guarded(request: web.Request, handler: _Handler) -> web.StreamResponse:
        connection = connection_of(request)
        with contextlib.ExitStack() as stack:
            if connection is not None:
                stack.enter_context(connection.serving_request(request))
                stack.enter_context(connection.running_handler())
            response = await _answer(request, handler, names)
        if not request.content.is_eof():
            response.force_close()
        return response

    return guarded


async def _answer(
    request: web.Request, handler: _Handler, names: Collection[str] | None
) -> web.StreamResponse:
    """Return the answer to a request; it shows no details of an internal error."""
    try:
        check_host(request.host, names)
        return await handler(request)
    except RefusedError as exc:
        text = f"{exc.status} {exc.received}: expected {exc.expected}\n"
        return web.Response(status=exc.status, text=text)
    except web.HTTPException as exc:
        text = f"{exc.status} {exc.reason}: there are /healthz, /readyz, /metrics\n"
        return web.Response(status=exc.status, text=text)
    except Exception:  # noqa: BLE001 - no other handler follows
        _log.exception("! %s %s: a fault of smartcam", request.method, request.path)
        return web.Response(status=500, text="500 a fault of smartcam: see the log\n")


async def _add_headers(_request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)
