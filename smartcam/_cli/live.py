"""``smartcam live``: a page of a camera, also while the camera does not answer."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import click

from smartcam._cli.options import CAMERA_OPTIONS, CONNECT_WARNING, Options, async_command
from smartcam._cli.page import PageOptions, page_options
from smartcam.backoff import Backoff
from smartcam.exceptions import LinkError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.camera import Camera


@click.command(
    help="Serve a page of a camera until Ctrl-C: results as they come, status, counts. The page's "
    "address goes to stdout. The command waits for a missing or lost camera, and the page says "
    f'so. Needs the extra "web". {CONNECT_WARNING}'
)
@click.argument("url")
@click.option(
    "--control", is_flag=True, help="The page may trigger, start, stop and switch applications."
)
@page_options(always=True)
@async_command(
    *("--application", "--interpret-as", "--y-down", "--calibration", "--name", "--units"),
    "--seconds",
    *CAMERA_OPTIONS,
)
async def live(url: str, control: bool, web: PageOptions, options: Options) -> None:
    """Serve a page of a camera."""
    await serve_page(url, web, options, control=control)


async def serve_page(
    url: str, web: PageOptions, options: Options, *, control: bool = False
) -> None:
    """Serve the page until ``--seconds`` are over, or the camera can never be opened."""
    from smartcam.web import LiveSite

    units = options.unit_names
    url = await options.locate_url(url)
    with options.cameras(url, reconnect=Backoff()) as make_camera:
        camera = make_camera()
        options.show_remarks(camera)
        with contextlib.suppress(TimeoutError):  # --seconds are over
            async with asyncio.timeout(options.seconds):
                async with LiveSite(
                    camera, control=control, units=units, **web.site_arguments
                ) as site:
                    options.show({"page": site.url}, f"page: {site.url}")
                    await keep_open(camera, make_camera, site.view.follow)


async def keep_open(
    camera: Camera,
    make_camera: Callable[[], Camera],
    on_replaced: Callable[[Camera, str], Awaitable[None]],
    on_open: Callable[[], None] = lambda: None,
) -> None:
    """Open the camera, trying again until that succeeds, and keep it open until cancelled.

    A camera object that could not be opened is replaced: ``on_replaced`` gets the new object and
    the reason. ``on_open`` is called when the camera is open.
    """
    policy = Backoff()
    for delay in policy.delays():
        try:
            async with camera:
                on_open()
                await asyncio.Event().wait()
        except LinkError as exc:
            if not policy.transient(exc):
                raise
            camera = make_camera()
            await on_replaced(camera, str(exc))
        await asyncio.sleep(delay)
