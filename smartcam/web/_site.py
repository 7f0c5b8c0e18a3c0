"""A web site in the running event loop: a page, which is a few files, and calls."""

from __future__ import annotations

import asyncio
import importlib.resources
import logging
import socket
from typing import TYPE_CHECKING, Any, cast

from aiohttp import web

from smartcam._accepting import Acceptor
from smartcam._server import Server
from smartcam.exceptions import ConfigurationError
from smartcam.web._connections import KEEP_ALIVE, Places
from smartcam.web._guard import HEADERS, Guard, checked_token, is_loopback, new_token
from smartcam.web._routes import MAX_BODY, middleware, routes
from smartcam.web._streams import Streams

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from smartcam.web._routes import Calls

_log = logging.getLogger("smartcam.web")

API = "/api"
"""Prefix of the paths of all calls."""

FAREWELL = 0.2
"""Seconds that an answer under way gets when the site stops, twice."""

BACKLOG = 128
"""Connections that wait for being accepted; the system keeps them."""

RESOLVE_TIMEOUT = 10.0
"""Seconds that the look-up of the host's address may take."""

_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css"}
_ANY = frozenset({"", "0.0.0.0", "::"})  # noqa: S104  names, nothing is bound here


class Site(Server):
    """A page and its calls on a port; the calls' handlers get the site.

    Args:
        page: name of the page's files in ``smartcam/web/page``: PAGE.html, PAGE.js, PAGE.css.
            Pages may use ``base.css`` and ``base.js``, too.
        host, port, token: as :class:`~smartcam.web.EmulatorSite` has them.
        files: of others that the page uses beside these.
        pages: files that are pages of their own, by their path, as aiohttp's router takes it.

    Attributes:
        host: as given.
        token: what calls must carry, None for nothing.
        streams: the event streams.

    Raises:
        ConfigurationError: the token cannot be used.
    """

    def __init__(
        self,
        calls: Calls[Any],
        page: str,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
        files: tuple[str, ...] = (),
        pages: Mapping[str, str] | None = None,
    ) -> None:
        if token is not None:
            checked_token(token)
        elif not is_loopback(host):
            token = new_token()
        self.host: str = host
        self.token: str | None = token
        self.streams: Streams = Streams()
        self._calls = calls
        self._page = page
        self._files = ("base.css", "base.js", f"{page}.css", f"{page}.js", *files)
        self._pages = dict(pages or {})
        self._port = port
        self._open: OpenPort | None = None

    @property
    def port(self) -> int:
        """The port it listens on; the one given until it is started."""
        return self._port

    @property
    def api(self) -> str:
        """Address in front of the calls' paths, ``http://HOST:PORT``.

        It has this machine's name where the site listens on all addresses.
        """
        name = socket.gethostname() if self.host in _ANY else self.host
        return f"http://{f'[{name}]' if ':' in name else name}:{self._port}"

    @property
    def url(self) -> str:
        """Address of the page; the token stands behind ``#``, which browsers send to nobody."""
        return f"{self.api}/" + ("" if self.token is None else f"#token={self.token}")

    async def start(self) -> None:
        """Open the port; does nothing if it is started already.

        Raises:
            ConfigurationError: it cannot listen there.

        Cancellation: leaves it stopped.
        """
        if self._open is not None:
            return
        self.streams = Streams()
        try:
            opened = await open_port(
                self._application(), self.host, self._port, local=self.token is None
            )
        except (OSError, ValueError, OverflowError) as exc:
            raise ConfigurationError(f"web: cannot listen on {self.api}: {exc}") from exc
        self._port, self._open = opened.port, opened

    async def stop(self) -> None:
        """Close the port, every stream and every connection; does nothing if stopped.

        Cancellation: takes effect when all is closed, which two :data:`FAREWELL` take at most.
        """
        opened, self._open = self._open, None
        if opened is None:
            return
        self.streams.close()
        closing = asyncio.ensure_future(opened.close())
        try:
            await asyncio.shield(closing)
        except asyncio.CancelledError:
            await asyncio.wait({closing})
            raise

    def _application(self) -> web.Application:
        guard = Guard(token=self.token)
        application = web.Application(
            middlewares=[middleware(guard, API)], client_max_size=MAX_BODY
        )
        application.on_response_prepare.append(_add_headers)
        application.router.add_routes(routes(self._calls, self))
        application.router.add_get("/", _file(f"{self._page}.html"))
        for path, name in self._pages.items():
            application.router.add_get(path, _file(name))
        for name in self._files:
            application.router.add_get(f"/{name}", _file(name))
        return application


class OpenPort:
    """A site's port while it is open.

    Not aiohttp's: that takes as many connections as come, and ``asyncio.Server`` fills the log
    where there are too many.
    """

    def __init__(self, runner: web.AppRunner, listener: socket.socket) -> None:
        if runner.server is None:
            raise RuntimeError("the runner is not set up")
        self.places: Places = Places(runner.server)
        self._runner = runner
        self._listener = listener
        self.port: int = listener.getsockname()[1]
        self._acceptor = Acceptor(self.places, _log, name="smartcam.web")
        self._acceptor.open(listener)

    async def close(self) -> None:
        """Close port and connections."""
        self.places.closed = True
        self._acceptor.close()
        self._listener.close()
        await self._acceptor.wait_closed()
        await self._runner.cleanup()


class _Calm(logging.LoggerAdapter[logging.Logger]):
    """Takes what aiohttp logs. It is about what clients send wrong: no errors with tracebacks."""

    def log(self, level: int, msg: object, *args: object, **kwargs: Any) -> None:
        """Log it at INFO at most."""
        super().log(min(level, logging.INFO), msg, *args, **kwargs)


def calm(logger: logging.Logger) -> logging.Logger:
    """Return what aiohttp logs to, as if it was ``logger``."""
    return cast("logging.Logger", _Calm(logger))


async def _add_headers(_request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)


def _file(name: str) -> Callable[[web.Request], Awaitable[web.Response]]:
    """Return a handler that serves one of the page's files, which is read now."""
    body = importlib.resources.files("smartcam.web").joinpath("page", name).read_bytes()
    content_type = _TYPES[name.rpartition(".")[2]]

    async def serve(_request: web.Request) -> web.Response:
        return web.Response(body=body, content_type=content_type, charset="utf-8")

    return serve


async def open_port(
    application: web.Application, host: str, port: int, *, local: bool = False
) -> OpenPort:
    """Return the port on which an application is served from now on.

    Raises:
        OSError, ValueError, OverflowError: it cannot be had, or it is not ``local``.

    Cancellation: leaves nothing open.
    """
    runner = web.AppRunner(
        application,
        access_log=None,
        shutdown_timeout=FAREWELL,
        keepalive_timeout=KEEP_ALIVE,
        logger=calm(_log),
    )
    listener = await _listening(host, port, local=local)
    try:
        await runner.setup()
    except BaseException:
        listener.close()
        await runner.cleanup()
        raise
    return OpenPort(runner, listener)


async def _listening(host: str, port: int, *, local: bool) -> socket.socket:
    """Return a listening socket.

    Raises:
        OSError, ValueError, OverflowError: it cannot be had, or it is not ``local``.
    """
    loop = asyncio.get_running_loop()
    async with asyncio.timeout(RESOLVE_TIMEOUT):
        found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    family, _, _, _, address = found[0]
    if local and not is_loopback(str(address[0])):
        raise ValueError(f"{host} is {address[0]} here, which needs a token")
    listener = socket.create_server((address[0], port), family=family, backlog=BACKLOG)
    listener.setblocking(False)
    return listener
