"""``smartcam live``: a page of a camera, even before the camera answers."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import click

from smartcam._cli.options import CAMERA, CONNECTS, Options, runs
from smartcam._cli.page import PageOptions, page_options
from smartcam.backoff import Backoff
from smartcam.exceptions import LinkError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.camera import Camera


@click.command(
    help="Serve a page of a camera until Ctrl-C: results as they come, status, account. The page's "
    "address goes to stdout. A missing or lost camera is awaited, with a note on the "
    f'page. Needs the extra "web". {CONNECTS}'
)
@click.argument("url")
@click.option(
    "--control", is_flag=True, help="The page may trigger, start, stop and switch applications."
)
@page_options(always=True)
@runs(
    *("--application", "--interpret-as", "--y-down", "--calibration", "--name", "--units"),
    "--seconds",
    *CAMERA,
)
async def live(url: str, control: bool, web: PageOptions, options: Options) -> None:
    """Serve a page of a camera."""
    await serve_page(url, web, options, control=control)


async def serve_page(
    url: str, web: PageOptions, options: Options, *, control: bool = False
) -> None:
    """Serve the page until the end; a camera that can never be used ends it."""
    from smartcam.web import LiveSite

    units = options.unit_names
    url = await options.located(url)
    with options.cameras(url, reconnect=Backoff()) as make:
        camera = make()
        options.remark(camera)
        with contextlib.suppress(TimeoutError):  # --seconds are over
            async with asyncio.timeout(options.seconds):
                async with LiveSite(
                    camera, control=control, units=units, **web.site_arguments
                ) as site:
                    options.show({"page": site.url}, f"page: {site.url}")
                    await have_open(camera, make, site.view.follow)


async def have_open(
    camera: Camera,
    make: Callable[[], Camera],
    follow: Callable[[Camera, str], Awaitable[None]],
    opened: Callable[[], None] = lambda: None,
) -> None:
    """Open the camera, try again until that succeeds, and keep it open until cancelled.

    ``follow`` gets each new camera object that replaces one that could not be opened, and the
    reason. ``opened`` is called when the camera is open.
    """
    policy = Backoff()
    for delay in policy.delays():
        try:
            async with camera:
                opened()
                await asyncio.Event().wait()
        except LinkError as exc:
            if not policy.transient(exc):
                raise
            camera = make()
            await follow(camera, str(exc))
        await asyncio.sleep(delay)
