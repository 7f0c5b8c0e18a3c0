"""``smartcam frames serve`` and ``show``: sources on a page, by RTSP and by RTP."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from datetime import datetime
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.frame_players import (
    RTSP_USER,
    Outputs,
    parse_address_option,
    rtsp_server,
    rtsp_urls,
    send_rtp,
    unique_names,
)
from smartcam._cli.frame_sources import TIMEOUT, make_source
from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command, option
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.running import run_until_first
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    UnsupportedError,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from smartcam.exceptions import SmartCamError
    from smartcam.frames import RtspServer
    from smartcam.web import FramesSite

MAX_SHOWN = 4
"""Largest number of sources side by side on a page."""

PERMANENT_ERRORS = (ConfigurationError, FrameFormatError, UnsupportedError)
"""Errors of a source after which every other try to open it would fail, too."""

FIRST_TRY_TIMEOUT = 3.0
"""Longest wait for the first try of each source, before the page is served, seconds."""

PERIOD = 1.0
"""Seconds between two checks of the viewers."""


def _serving_command(terminate_code: int) -> Callable[[Callable[..., Any]], Callable[..., None]]:
    """Declare the options that ``serve`` and ``show`` share.

    ``terminate_code``: exit code after SIGTERM.
    """
    parts: list[Any] = [
        click.argument("urls", metavar="URL...", nargs=-1, required=True),
        click.option(
            "--quality",
            type=click.IntRange(1, 100),
            default=80,
            show_default=True,
            help="Quality of the JPEGs for the page; JPEGs of a camera stay as they are.",
        ),
        click.option(
            "--changes",
            is_flag=True,
            help="Everyone who can open the page may set features of the devices and trigger them.",
        ),
        page_options(always=True),
        option("--seconds"),
        option("--timeout", help=TIMEOUT),
        async_command(*OUTPUT_OPTIONS, terminate_code=terminate_code),
    ]

    def decorate(function: Callable[..., Any]) -> Callable[..., None]:
        for part in reversed(parts):
            function = part(function)
        return function

    return decorate


@click.command(
    help=f"Serve pictures of one source, or of up to {MAX_SHOWN}, until Ctrl-C or SIGTERM: a page "
    "with all of them side by side, and for players and recorders RTSP or RTP. The addresses "
    "go to stdout. On a terminal, stderr shows who is looking. A device streams while it has "
    "readers. The command waits for a missing device and serves the others meanwhile. Needs the "
    'extras "web" and "frames", for RTSP and RTP "video".'
)
@click.option(
    "--rtsp",
    metavar="HOST:PORT",
    callback=parse_address_option,
    help="Also serve them as H.264 by RTSP, at rtsp://HOST:PORT/NAME. The page's token is "
    f"the password of the user {RTSP_USER}; without a token, an address that other machines can "
    "reach gets a password.",
)
@click.option(
    "--rtp",
    metavar="HOST:PORT",
    callback=parse_address_option,
    help="Send a single source as H.264 by RTP to this address, with or without a receiver.",
)
@click.option(
    "--sdp",
    metavar="FILE",
    type=click.Path(dir_okay=False),
    help="Write the description for players of --rtp to this file, not to stdout.",
)
@_serving_command(terminate_code=0)
async def serve(
    urls: tuple[str, ...],
    quality: int,
    rtsp: tuple[str, int] | None,
    rtp: tuple[str, int] | None,
    sdp: str | None,
    changes: bool,
    web: PageOptions,
    options: Options,
) -> None:
    """Serve pictures of some sources."""
    if rtp is not None and len(urls) != 1:
        raise click.UsageError(f"--rtp sends one source: expected one URL, got {len(urls)}")
    if rtp is not None and not rtp[1]:
        raise click.UsageError("--rtp: expected the receiver's port, got 0")
    if sdp is not None and rtp is None:
        raise click.UsageError("--sdp needs --rtp")
    await serve_sources(urls, quality, Outputs(rtsp, rtp, sdp), web, options, changes=changes)


@click.command(
    help=f"Show one source, or up to {MAX_SHOWN} side by side, on a page until Ctrl-C: the newest "
    "frame of each, its age, rates, skipped and lost frames. This is frames serve with the page "
    "only. The page's address goes to stdout. A device streams while the page is open. The page "
    'shows which devices are missing. Needs the extras "web" and "frames".'
)
@_serving_command(terminate_code=143)
async def show(
    urls: tuple[str, ...], quality: int, changes: bool, web: PageOptions, options: Options
) -> None:
    """Show some sources."""
    await serve_sources(urls, quality, Outputs(), web, options, changes=changes)


async def serve_sources(
    urls: Sequence[str],
    quality: int,
    outputs: Outputs,
    web: PageOptions,
    options: Options,
    *,
    changes: bool,
) -> None:
    """Serve sources until cancelled, or for ``--seconds``; a source that fails affects no other.

    Raises ConfigurationError, FrameFormatError, UnsupportedError: no source can ever be opened;
    ConfigurationError: the site cannot listen.
    """
    if len(urls) > MAX_SHOWN:
        raise click.UsageError(f"expected {MAX_SHOWN} URLs at most, got {len(urls)}")
    from smartcam.web import FramesSite

    sources = [make_source(url, options) for url in urls]
    site = FramesSite(sources, quality=quality, changes=changes, **web.site_arguments)
    tries = _FirstTries(len(sources))
    jobs = [_serve(site, tries, outputs, options)]
    jobs += [
        site.pictures.keep_open(index, tries.callback_for(index)) for index in range(len(sources))
    ]
    await run_until_first(jobs, None)


async def _serve(site: FramesSite, tries: _FirstTries, outputs: Outputs, options: Options) -> None:
    """Wait for the first try of each source, at most :data:`FIRST_TRY_TIMEOUT`; then serve."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(FIRST_TRY_TIMEOUT):
            await tries.wait_for_all()
    async with contextlib.AsyncExitStack() as stack:
        server: RtspServer | None = None
        urls: dict[str, str] = {}
        if outputs.rtsp is not None:
            server, password = rtsp_server(site.sources, outputs.rtsp, site.token)
            await stack.enter_async_context(server)
            urls = rtsp_urls(server, site.sources, password)
        await stack.enter_async_context(site)
        lines = [f"page: {site.url}", *(f"rtsp: {url}" for url in urls.values())]
        value = {"page": site.url, **({"rtsp": urls} if urls else {})}
        options.show(value, "\n".join(lines))
        jobs = [_show_viewers(site, server), tries.run()]
        if outputs.rtp is not None:
            jobs.append(send_rtp(site.sources[0], outputs, options))
        await run_until_first(jobs, options.seconds)


class _FirstTries:
    """The outcome of the first try to open each source; reports failed tries on stderr."""

    def __init__(self, count: int) -> None:
        self._all_tried = asyncio.Event()  # set when every source was tried
        self._count = count
        self._first: dict[int, SmartCamError | None] = {}
        self._reported: dict[int, str] = {}

    def callback_for(self, index: int) -> Callable[[SmartCamError | None], None]:
        """Return the function to call with the outcome of each try to open a source."""

        def on_try(error: SmartCamError | None) -> None:
            self._first.setdefault(index, error)
            text = "" if error is None else str(error)
            if (
                text
                and self._reported.get(index, "") != text
                and not self._all_failed_permanently()
            ):
                click.echo(f"note: {text}; waiting for it", err=True)
            self._reported[index] = text
            if len(self._first) == self._count:
                self._all_tried.set()

        return on_try

    def _all_failed_permanently(self) -> bool:
        permanent = [isinstance(error, PERMANENT_ERRORS) for error in self._first.values()]
        return len(permanent) == self._count and all(permanent)

    async def wait_for_all(self) -> None:
        """Wait until every source was tried; raise the first error if all failed permanently."""
        await self._all_tried.wait()
        error = self._first[0]
        if error is not None and self._all_failed_permanently():
            raise error

    async def run(self) -> None:
        """Raise the first error once all sources failed permanently; else wait until cancelled."""
        await self.wait_for_all()
        await asyncio.Event().wait()


# ---------------------------------------------------------------------- viewers


async def _show_viewers(site: FramesSite, server: RtspServer | None) -> None:
    """Print the viewers to stderr, if it is a terminal, whenever they change; until cancelled."""
    if not sys.stderr.isatty():
        await asyncio.Event().wait()
    shown_text = viewers_text(site, server)
    while True:
        await asyncio.sleep(PERIOD)
        text = viewers_text(site, server)
        if text != shown_text:
            shown_text = text
            click.echo(f"{datetime.now().astimezone():%H:%M:%S} {text}", err=True)


def viewers_text(site: FramesSite, server: RtspServer | None = None) -> str:
    """Return a text of each source's viewers: addresses at the page, number by RTSP."""
    rtsp_statistics = {} if server is None else server.statistics()
    rows: list[str] = []
    for index, (name, source) in enumerate(unique_names(site.sources).items()):
        addresses = sorted(viewer.address for viewer in site.viewers if viewer.index == index)
        rtsp_count = rtsp_statistics[name].viewers if name in rtsp_statistics else 0
        addresses += [f"{rtsp_count} by RTSP"] if rtsp_count else []
        rows += [f"{source.name}: {', '.join(addresses)}"] if addresses else []
    return "; ".join(rows) or "nobody looks"
