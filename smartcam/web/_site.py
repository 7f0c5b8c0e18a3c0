"""Serve a web site in the running event loop: the files of a page, and HTTP calls."""

from __future__ import annotations

import logging
import socket
from typing import TYPE_CHECKING, Any, cast

from aiohttp import web

from smartcam._accepting import is_loopback, listening_socket
from smartcam._finishing import finish
from smartcam._server import Server
from smartcam.exceptions import ConfigurationError
from smartcam.web._connections import KEEP_ALIVE_TIMEOUT, SiteConnections
from smartcam.web._guard import HEADERS, Guard, check_token, new_token
from smartcam.web._pages import page_html, read_file
from smartcam.web._routes import MAX_BODY_BYTES, middleware, routes
from smartcam.web._streams import Streams

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from smartcam.web._routes import Calls

_log = logging.getLogger("smartcam.web")

API = "/api"
"""First part of the paths of all calls."""

FINISH_TIMEOUT = 0.2
"""Seconds for unfinished answers to end when the site stops. Then they are cancelled, and have this
time again."""

_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css"}
_ALL_ADDRESSES = frozenset({"", "0.0.0.0", "::"})  # noqa: S104  only compared


class Site(Server):
    """A page and its calls on a port; each handler of a call gets the site as an argument.

    Args:
        page: name of the page's files in ``smartcam/web/page``: PAGE.html, PAGE.js, PAGE.css, and
            of its row in ``PAGES``. Pages may use ``base.css`` and ``base.js``, too.
        host, port, token: as for :class:`~smartcam.web.EmulatorSite`.
        files: files of other pages that this page uses, too.
        pages: other pages of the site, by their path in the form of aiohttp's router.

    Attributes:
        host: the given host.
        token: token that calls must carry, None without one.
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
            check_token(token)
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
        self._open_port: OpenPort | None = None

    @property
    def port(self) -> int:
        """The port that the site listens on; the given one until it is started."""
        return self._port

    @property
    def origin(self) -> str:
        """Address to which the calls' paths are appended, ``http://HOST:PORT``.

        HOST is this machine's name if the site listens on all addresses.
        """
        name = socket.gethostname() if self.host in _ALL_ADDRESSES else self.host
        return f"http://{f'[{name}]' if ':' in name else name}:{self._port}"

    @property
    def url(self) -> str:
        """Address of the page; the token follows ``#``, a part that browsers do not send."""
        return f"{self.origin}/" + ("" if self.token is None else f"#token={self.token}")

    async def start(self) -> None:
        """Open the port; do nothing if it is started already.

        Raises:
            ConfigurationError: the server cannot listen there.

        Cancellation: leaves the site stopped.
        """
        if self._open_port is not None:
            return
        self.streams = Streams()
        try:
            opened = await open_port(
                self._application(), self.host, self._port, local=self.token is None
            )
        except (OSError, ValueError, OverflowError) as exc:
            raise ConfigurationError(f"web: cannot listen on {self.origin}: {exc}") from exc
        self._port, self._open_port = opened.port, opened

    async def stop(self) -> None:
        """Close the port, every stream and every connection; do nothing if stopped.

        Cancellation: takes effect when all is closed, after twice :data:`FINISH_TIMEOUT` at most.
        """
        opened, self._open_port = self._open_port, None
        if opened is None:
            return
        self.streams.close()
        await finish(opened.close)

    def _application(self) -> web.Application:
        guard = Guard(token=self.token)
        application = web.Application(
            middlewares=[middleware(guard, API)], client_max_size=MAX_BODY_BYTES
        )
        application.on_response_prepare.append(_add_headers)
        application.router.add_routes(routes(self._calls, self))
        for path, page in {"/": self._page, **self._pages}.items():
            application.router.add_get(path, _file_handler(page_html(page).encode(), "html"))
        for name in self._files:
            application.router.add_get(f"/{name}", _file_handler(read_file(name), name))
        return application


class OpenPort:
    """The open port of a site.

    aiohttp's own class for it accepts any number of connections, and its ``asyncio.Server`` fills
    the log if there are too many.
    """

    def __init__(self, runner: web.AppRunner, listener: socket.socket) -> None:
        if runner.server is None:
            raise RuntimeError("the runner is not set up")
        self._connections = SiteConnections(runner.server)
        self.places = self._connections.places  # slots of connections
        self._runner = runner
        self._listener = listener
        self.port: int = listener.getsockname()[1]
        self._connections.acceptor.open(listener)

    async def close(self) -> None:
        """Close the port and all connections."""
        self._connections.closed = True
        self._connections.acceptor.close()
        self._listener.close()
        await self._connections.acceptor.wait_closed()
        await self._runner.cleanup()


class _InfoLogger(logging.LoggerAdapter[logging.Logger]):
    """Logs aiohttp's messages at INFO at most: they are only about bad requests."""

    def log(self, level: int, msg: object, *args: object, **kwargs: Any) -> None:
        """Log a message at INFO at most."""
        super().log(min(level, logging.INFO), msg, *args, **kwargs)


def at_info_level(logger: logging.Logger) -> logging.Logger:
    """Return a logger for aiohttp that logs to ``logger`` at INFO at most."""
    return cast("logging.Logger", _InfoLogger(logger))


async def _add_headers(_request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)


def _file_handler(body: bytes, name: str) -> Callable[[web.Request], Awaitable[web.Response]]:
    """Return a handler that answers with a file; the type follows from the end of ``name``."""
    content_type = _TYPES[name.rpartition(".")[2]]

    async def serve(_request: web.Request) -> web.Response:
        return web.Response(body=body, content_type=content_type, charset="utf-8")

    return serve


async def open_port(
    application: web.Application, host: str, port: int, *, local: bool = False
) -> OpenPort:
    """Serve an application on a port from now on; return the open port.

    Raises:
        OSError, ValueError, OverflowError: the address is not available, or is not local although
            ``local`` is set.

    Cancellation: leaves nothing open.
    """
    runner = web.AppRunner(
        application,
        access_log=None,
        shutdown_timeout=FINISH_TIMEOUT,
        keepalive_timeout=KEEP_ALIVE_TIMEOUT,
        logger=at_info_level(_log),
    )
    listener = await listening_socket(host, port, local=local)
    try:
        await runner.setup()
    except BaseException:
        listener.close()
        await runner.cleanup()
        raise
    return OpenPort(runner, listener)
