"""The options of commands that can serve a page: ``--web``, ``--web-host`` and others."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from collections.abc import Callable


class PageOptions:
    """The options of a page.

    Args:
        web: whether there is a page.
        web_host: address to listen on, None for loopback.
        web_port: port to listen on, None for a free one.
        web_token: the token, None for the site's own choice.

    Attributes:
        is_wanted: whether there is a page.
        site_arguments: arguments of the site: host, port and token.

    Raises:
        click.UsageError: an address is given without a page.
    """

    def __init__(
        self, *, web: bool, web_host: str | None, web_port: int | None, web_token: str | None
    ) -> None:
        values = {"--web-host": web_host, "--web-port": web_port}
        needless = [name for name, value in values.items() if value is not None]
        if needless and not web:
            raise click.UsageError(f"{needless[0]} needs --web")
        self.is_wanted: bool = web
        self.site_arguments: dict[str, Any] = {
            "host": web_host or "127.0.0.1",
            "port": web_port or 0,
            "token": web_token,
        }


def page_options(
    about: str = "", *, always: bool = False
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that gives a command the options of a page, as ``web``.

    ``about``: help for ``--web``. ``always``: the command always has a page, and no ``--web``.
    """
    flag = click.option("--web", is_flag=True, help=f'{about} Needs the extra "web".')
    options = [
        *([] if always else [flag]),
        click.option("--web-host", metavar="HOST", help="Page's address.  [default: 127.0.0.1]"),
        click.option(
            "--web-port",
            type=click.IntRange(0, 65535),
            help="Port of the page; 0, the default, takes a free one.",
        ),
        click.option(
            "--web-token",
            metavar="TOKEN",
            envvar="SMARTCAM_WEB_TOKEN",
            show_envvar=True,
            help="Token that users of the page need. By default users of this machine need "
            "none; on an address that other machines can reach, one is made.",
        ),
    ]

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(function)
        def with_page(*args: Any, **arguments: Any) -> None:
            site = {name: arguments.pop(name) for name in ("web_host", "web_port", "web_token")}
            web = always or arguments.pop("web")
            function(*args, web=PageOptions(web=web, **site), **arguments)

        for option in reversed(options):
            with_page = option(with_page)
        return with_page

    return decorate
