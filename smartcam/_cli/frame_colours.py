"""``smartcam frames colours``: a page that picks a range of colours."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any, Final

import click

from smartcam._cli.options import OUTPUT, Options, option, runs
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.running import first
from smartcam._extras import from_part
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from smartcam.depth import ColourRange
    from smartcam.web import ColourSite

LINGER: Final = 3.0
"""Seconds for which the device continues streaming after the last request of a page."""


@click.command(
    help="Serve a page that picks a range of colours in a camera's live picture, until Ctrl-C: the "
    "picture beside the mask, sliders for hue, saturation and value, a click that takes a colour "
    "from the picture, and the range to copy. The page's address goes to stdout. The device "
    'streams while the page is open. Needs the extras "web" and "depth".'
)
@click.argument("url")
@click.option(
    "--range",
    "begin",
    metavar="JSON",
    help="Range at the beginning, as the page copies it, such as '{\"value\": [0, 60]}'.",
)
@page_options(always=True)
@option("--seconds")
@option("--timeout", help="Longest wait for a frame.  [default: 5]")
@runs(*OUTPUT)
async def colours(url: str, begin: str | None, web: PageOptions, options: Options) -> None:
    """Serve the page."""
    from smartcam.frames import open as open_frames
    from smartcam.frames._inside import FRAME_TIMEOUT

    with from_part("depth", "smartcam frames colours needs"):
        from smartcam.web import ColourSite
    seconds = options.step(FRAME_TIMEOUT)
    source = open_frames(url, timeout=seconds, stall=seconds, linger=LINGER)
    site = ColourSite(source, colours=_range(begin), **web.site_arguments)
    async with source:
        await first([_serve(site, options)], options.seconds)


async def _serve(site: ColourSite, options: Options) -> None:
    async with site:
        options.show({"page": site.url}, f"page: {site.url}")
        await asyncio.Event().wait()


def _range(text: str | None) -> ColourRange | None:
    """Return a range from JSON; raise ConfigurationError if it is not valid."""
    with from_part("depth", "smartcam frames colours needs"):
        from smartcam.depth import ColourRange

    if text is None:
        return None
    try:
        given: Any = json.loads(text)
        return ColourRange(**given)
    except ConfigurationError as exc:
        raise ConfigurationError(f"--range: {exc}") from exc
    except (ValueError, TypeError) as exc:
        raise ConfigurationError(
            '--range: expected JSON such as {"hue": [0, 179], "saturation": [0, 255], "value": '
            f"[0, 60]}}, got {text!r}"
        ) from exc
