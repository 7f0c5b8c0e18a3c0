"""``smartcam frames colours``: a page that picks a range of colours."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any, Final

import click

from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command, option
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.running import run_until_first
from smartcam._extras import from_part
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from smartcam.depth import ColourRange
    from smartcam.web import ColourSite

LINGER_TIME: Final = 3.0
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
    "initial_range",
    metavar="JSON",
    help="Range at the beginning, as the page copies it, such as '{\"value\": [0, 60]}'.",
)
@page_options(always=True)
@option("--seconds")
@option("--timeout", help="Longest wait for a frame.  [default: 5]")
@async_command(*OUTPUT_OPTIONS)
async def colours(url: str, initial_range: str | None, web: PageOptions, options: Options) -> None:
    """Serve the page."""
    from smartcam.frames import open as open_frames
    from smartcam.frames._inside import FRAME_TIMEOUT

    with from_part("depth", "smartcam frames colours needs"):
        from smartcam.web import ColourSite
    seconds = options.step_timeout(FRAME_TIMEOUT)
    source = open_frames(url, timeout=seconds, stall=seconds, linger=LINGER_TIME)
    site = ColourSite(source, colours=_parse_range(initial_range), **web.site_arguments)
    async with source:
        await run_until_first([_serve(site, options)], options.seconds)


async def _serve(site: ColourSite, options: Options) -> None:
    async with site:
        options.show({"page": site.url}, f"page: {site.url}")
        await asyncio.Event().wait()


def _parse_range(text: str | None) -> ColourRange | None:
    """Return the range of a JSON text, None without a text; ConfigurationError: it is not valid."""
    with from_part("depth", "smartcam frames colours needs"):
        from smartcam.depth import ColourRange

    if text is None:
        return None
    try:
        fields: Any = json.loads(text)
        return ColourRange(**fields)
    except ConfigurationError as exc:
        raise ConfigurationError(f"--range: {exc}") from exc
    except (ValueError, TypeError) as exc:
        raise ConfigurationError(
            '--range: expected JSON such as {"hue": [0, 179], "saturation": [0, 255], "value": '
            f"[0, 60]}}, got {text!r}"
        ) from exc
