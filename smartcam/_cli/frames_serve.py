"""``smartcam frames serve`` and ``show``: pictures of some sources, for viewers and players."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from datetime import datetime
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.frame_players import (
    RTSP_USER,
    Players,
    address,
    names_of,
    rtsp_server,
    rtsp_urls,
    send_rtp,
)
from smartcam._cli.frame_sources import TIMEOUT, opened
from smartcam._cli.options import OUTPUT, Options, option, runs
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.running import first
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
"""Errors after which another try to open the source would fail, too."""

FIRST_TRY_TIMEOUT = 3.0
"""Seconds to wait for the first try of each source, before the others are served."""

PERIOD = 1.0
"""Seconds between two checks of the viewers."""


def _serves(terminated: int) -> Callable[[Callable[..., Any]], Callable[..., None]]:
    """Give a command the options of both commands; ``terminated``: exit code after SIGTERM."""
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
        runs(*OUTPUT, terminated=terminated),
    ]

    def decorate(function: Callable[..., Any]) -> Callable[..., None]:
        for part in reversed(parts):
            function = part(function)
        return function

    return decorate


@click.command(
    help=f"Serve pictures of one source, or of up to {MAX_SHOWN}, until Ctrl-C or SIGTERM: a page "
    "with all of them side by side, and for players and recorders RTSP or RTP. The addresses "
    "go to stdout, the readers, on a terminal, to stderr. A device streams while it has readers; "
    'a missing device is awaited, and the others go on. Needs the extras "web" and "frames", '
    'for RTSP and RTP "video".'
)
@click.option(
    "--rtsp",
    metavar="HOST:PORT",
    callback=address,
    help="Serve them as H.264 by RTSP, too, as rtsp://HOST:PORT/NAME. The page's token is "
    f"the password of the user {RTSP_USER}; without a token, an address that other machines can "
    "reach gets a password.",
)
@click.option(
    "--rtp",
    metavar="HOST:PORT",
    callback=address,
    help="Send the one source as H.264 by RTP to this address, with or without a receiver.",
)
@click.option(
    "--sdp",
    metavar="FILE",
    type=click.Path(dir_okay=False),
    help="Write the description for players of --rtp to this file, not to stdout.",
)
@_serves(terminated=0)
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
    await serve_sources(urls, quality, Players(rtsp, rtp, sdp), web, options, changes=changes)


@click.command(
    help=f"Show one source, or up to {MAX_SHOWN} side by side, on a page until Ctrl-C: the newest "
    "frame of each, its age, rates, skipped and lost frames. It is serve, with only the page: its "
    "address goes to stdout. A device streams while the page is open; a missing device is "
    'awaited, and the page shows that. Needs the extras "web" and "frames".'
)
@_serves(terminated=143)
async def show(
    urls: tuple[str, ...], quality: int, changes: bool, web: PageOptions, options: Options
) -> None:
    """Show some sources."""
    await serve_sources(urls, quality, Players(), web, options, changes=changes)


async def serve_sources(
    urls: Sequence[str],
    quality: int,
    players: Players,
    web: PageOptions,
    options: Options,
    *,
    changes: bool,
) -> None:
    """Serve sources until cancelled, or for ``--seconds``; one that fails affects no other.

    Raises ConfigurationError, FrameFormatError, UnsupportedError: every source has failed for good;
    ConfigurationError: the site cannot listen.
    """
    if len(urls) > MAX_SHOWN:
        raise click.UsageError(f"expected {MAX_SHOWN} URLs at most, got {len(urls)}")
    from smartcam.web import FramesSite

    sources = [opened(url, options) for url in urls]
    site = FramesSite(sources, quality=quality, changes=changes, **web.site_arguments)
    tries = _Tries(len(sources))
    keeping = [site.pictures.keep_open(place, tries.of(place)) for place in range(len(sources))]
    await first([_serve(site, tries, players, options), *keeping], None)


async def _serve(site: FramesSite, tries: _Tries, players: Players, options: Options) -> None:
    """Serve, once each source was tried, or :data:`FIRST_TRY_TIMEOUT` seconds are over."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(FIRST_TRY_TIMEOUT):
            await tries.check()
    async with contextlib.AsyncExitStack() as stack:
        server: RtspServer | None = None
        urls: dict[str, str] = {}
        if players.rtsp is not None:
            server, password = rtsp_server(site.sources, players.rtsp, site.token)
            await stack.enter_async_context(server)
            urls = rtsp_urls(server, site.sources, password)
        await stack.enter_async_context(site)
        lines = [f"page: {site.url}", *(f"rtsp: {url}" for url in urls.values())]
        value = {"page": site.url, **({"rtsp": urls} if urls else {})}
        options.show(value, "\n".join(lines))
        jobs = [_show_viewers(site, server), tries.watch()]
        if players.rtp is not None:
            jobs.append(send_rtp(site.sources[0], players, options))
        await first(jobs, options.seconds)


class _Tries:
    """The outcomes of each source's first try; later failures are reported on stderr."""

    def __init__(self, count: int) -> None:
        self._done = asyncio.Event()  # set when every source was tried
        self._count = count
        self._first: dict[int, SmartCamError | None] = {}
        self._reported: dict[int, str] = {}

    def of(self, place: int) -> Callable[[SmartCamError | None], None]:
        """Return the function that gets the outcome of each try to open a source."""

        def tried(error: SmartCamError | None) -> None:
            self._first.setdefault(place, error)
            text = "" if error is None else str(error)
            if text and self._reported.get(place, "") != text and not self._all_for_good():
                click.echo(f"note: {text}; it is awaited", err=True)
            self._reported[place] = text
            if len(self._first) == self._count:
                self._done.set()

        return tried

    def _all_for_good(self) -> bool:
        wrong = [isinstance(error, PERMANENT_ERRORS) for error in self._first.values()]
        return len(wrong) == self._count and all(wrong)

    async def check(self) -> None:
        """Wait until every source was tried; raise the first error if all have failed for good."""
        await self._done.wait()
        error = self._first[0]
        if error is not None and self._all_for_good():
            raise error

    async def watch(self) -> None:
        """Report sources that fail, until cancelled."""
        await self.check()
        await asyncio.Event().wait()


# ---------------------------------------------------------------------- viewers


async def _show_viewers(site: FramesSite, server: RtspServer | None) -> None:
    """Report the viewers on a terminal's stderr, whenever they change; until cancelled."""
    if not sys.stderr.isatty():
        await asyncio.Event().wait()
    shown = viewers_text(site, server)
    while True:
        await asyncio.sleep(PERIOD)
        text = viewers_text(site, server)
        if text != shown:
            shown = text
            click.echo(f"{datetime.now().astimezone():%H:%M:%S} {text}", err=True)


def viewers_text(site: FramesSite, server: RtspServer | None = None) -> str:
    """Return each source's viewers as a text: addresses at the page, their number by RTSP."""
    played = {} if server is None else server.statistics()
    rows: list[str] = []
    for place, (name, source) in enumerate(names_of(site.sources).items()):
        addresses = sorted(viewer.address for viewer in site.viewers if viewer.place == place)
        by_rtsp = played[name].viewers if name in played else 0
        addresses += [f"{by_rtsp} by RTSP"] if by_rtsp else []
        rows += [f"{source.name}: {', '.join(addresses)}"] if addresses else []
    return "; ".join(rows) or "nobody looks"
