"""``smartcam-emulator --web``: the options, and the page beside the cameras."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, TypeVar, cast

import click

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import AsyncExitStack

    from smartcam.emulator import EmulatedCamera

__all__ = ["Page", "page_options"]

F = TypeVar("F", bound="Callable[..., Any]")

_OPTIONS = [
    click.option(
        "--web",
        is_flag=True,
        help="Serve a page that shows and controls the cameras; its address goes to stderr. Needs "
        'the extra "web".',
    ),
    click.option("--web-host", metavar="HOST", help="Its address.  [default: 127.0.0.1]"),
    click.option(
        "--web-port", type=click.IntRange(0, 65535), help="Its port; 0, the default, a free one."
    ),
    click.option(
        "--web-token",
        metavar="TOKEN",
        envvar="SMARTCAM_WEB_TOKEN",
        show_envvar=True,
        help="What everybody must know who uses it. Without one this machine's users need none; "
        "on an address that others can reach, one is made.",
    ),
]


class Page:
    """The page as the options want it.

    Args:
        web: whether there is one.
        web_host: address to listen on, None for loopback.
        web_port: port to listen on, None for a free one.
        web_token: the token, None for the site's own choice.

    Raises:
        click.UsageError: something is said of a page that is not wanted.
    """

    def __init__(
        self, *, web: bool, web_host: str | None, web_port: int | None, web_token: str | None
    ) -> None:
        said = {"--web-host": web_host, "--web-port": web_port}
        needless = [name for name, value in said.items() if value is not None]
        if needless and not web:
            raise click.UsageError(f"{needless[0]} needs --web")
        self.wanted: bool = web
        self._options: dict[str, Any] = {
            "host": web_host or "127.0.0.1",
            "port": web_port or 0,
            "token": web_token,
        }

    async def open(self, stack: AsyncExitStack, cameras: Sequence[EmulatedCamera]) -> str | None:
        """Serve the page until the stack ends, and print its address to stderr.

        Returns:
            The page's address, None where there is no page.

        Raises:
            ConfigurationError: it cannot listen there.
            MissingExtraError: aiohttp is not installed.
        """
        if not self.wanted:
            return None
        from smartcam.web import EmulatorSite

        site = EmulatorSite({camera.name: camera for camera in cameras}, **self._options)
        await stack.enter_async_context(site)
        click.echo(f"page: {site.url}", err=True)
        return site.url


def page_options(function: F) -> F:
    """Decorate a command with the options of the page; it gets them as ``page``."""

    @functools.wraps(function)
    def packed(
        *args: Any,
        web: bool,
        web_host: str | None,
        web_port: int | None,
        web_token: str | None,
        **others: Any,
    ) -> Any:
        page = Page(web=web, web_host=web_host, web_port=web_port, web_token=web_token)
        return function(*args, page=page, **others)

    decorated: Any = packed
    for option in reversed(_OPTIONS):
        decorated = option(decorated)
    return cast("F", decorated)
