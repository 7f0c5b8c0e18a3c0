"""``smartcam frames serve`` and ``show``: pictures of some sources, for people and for players."""

from __future__ import annotations

import asyncio
import contextlib
import re
import sys
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from smartcam._cli.frame_sources import TIMEOUT, opened
from smartcam._cli.options import OUTPUT, Options, option, runs
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.running import first
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    SmartCamError,
    UnsupportedError,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from smartcam.frames import FrameSource
    from smartcam.web import FramesSite

MOST_SHOWN = 4
"""Sources side by side on a page."""

FOR_GOOD = (ConfigurationError, FrameFormatError, UnsupportedError)
"""Errors of a source that will hardly ever be what was asked for."""

PERIOD = 1.0
"""Seconds between two looks at who looks."""

USER = "smartcam"
"""Of RTSP, where it wants the token."""


class Players(NamedTuple):
    """What is served beside the page.

    Attributes:
        rtsp: address to listen on for RTSP, None for none.
        rtp: address to send one source to, None for none.
        sdp: file to write the description of that to, None for stdout.
    """

    rtsp: tuple[str, int] | None = None
    rtp: tuple[str, int] | None = None
    sdp: str | None = None


def address(_context: object, parameter: click.Parameter, text: str | None) -> Any:
    """Return the host and port of ``HOST:PORT``, None for None."""
    if text is None:
        return None
    host, colon, port = text.rpartition(":")
    host = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if not (colon and host and port.isdecimal() and len(port) <= 5 and int(port) <= 65535):
        raise click.BadParameter(
            f"{text!r}: expected HOST:PORT, such as 127.0.0.1:8554 or [::1]:8554", param=parameter
        )
    return host, int(port)


def _serves(terminated: int) -> Callable[[Callable[..., Any]], Callable[..., None]]:
    """Give a command what both have; ``terminated``: its exit code after SIGTERM."""
    parts: list[Any] = [
        click.argument("urls", metavar="URL...", nargs=-1, required=True),
        click.option(
            "--quality",
            type=click.IntRange(1, 100),
            default=80,
            show_default=True,
            help="Of the JPEGs that the page gets; those of a camera that sends some stay as they "
            "are.",
        ),
        page_options("", always=True),
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
    help=f"Serve pictures of one source, or of up to {MOST_SHOWN}, until Ctrl-C or SIGTERM: a page "
    "with all of them side by side, and for players and recorders RTSP or RTP. What is served "
    "goes to stdout, who looks, on a terminal, to stderr. A device streams while somebody looks; "
    'one that is not there is awaited, and the others go on. Needs the extras "web" and "frames", '
    'for RTSP and RTP "video".'
)
@click.option(
    "--rtsp",
    metavar="HOST:PORT",
    callback=address,
    help="Serve them as H.264 by RTSP, too, as rtsp://HOST:PORT/NAME. Where the page has a token, "
    f"that is the password, and {USER} the user; on an address that others can reach, one is made.",
)
@click.option(
    "--rtp",
    metavar="HOST:PORT",
    callback=address,
    help="Send the one source as H.264 by RTP to this address, whether somebody is there or not.",
)
@click.option(
    "--sdp",
    metavar="FILE",
    type=click.Path(dir_okay=False),
    help="Write what a player of --rtp has to know to this file, and not to stdout.",
)
@_serves(terminated=0)
async def serve(
    urls: tuple[str, ...],
    quality: int,
    rtsp: tuple[str, int] | None,
    rtp: tuple[str, int] | None,
    sdp: str | None,
    web: PageOptions,
    options: Options,
) -> None:
    """Serve pictures of some sources."""
    if rtp is not None and len(urls) != 1:
        raise click.UsageError(f"--rtp sends one source: expected one URL, got {len(urls)}")
    if rtp is not None and not rtp[1]:
        raise click.UsageError("--rtp: expected the port of who receives it, got 0")
    if sdp is not None and rtp is None:
        raise click.UsageError("--sdp needs --rtp")
    await serve_sources(urls, quality, Players(rtsp, rtp, sdp), web, options)


@click.command(
    help=f"Show one source, or up to {MOST_SHOWN} side by side, on a page until Ctrl-C: the newest "
    "frame of each, its age, rates, what was skipped and lost. It is serve, with nothing but the "
    "page: its address goes to stdout. A device streams while somebody looks; one that is not "
    'there is awaited, and the page says so. Needs the extras "web" and "frames".'
)
@_serves(terminated=143)
async def show(urls: tuple[str, ...], quality: int, web: PageOptions, options: Options) -> None:
    """Show some sources."""
    await serve_sources(urls, quality, Players(), web, options)


async def serve_sources(
    urls: Sequence[str], quality: int, players: Players, web: PageOptions, options: Options
) -> None:
    """Serve sources until cancelled, or for ``--seconds``; one that fails harms no other.

    Raises ConfigurationError, FrameFormatError, UnsupportedError: so it is with all of them;
    ConfigurationError: it cannot listen.
    """
    if len(urls) > MOST_SHOWN:
        raise click.UsageError(f"expected {MOST_SHOWN} URLs at most, got {len(urls)}")
    from smartcam.web import FramesSite

    sources = [opened(url, options) for url in urls]
    site = FramesSite(sources, quality=quality, **web.place)
    tries = _Tries(len(sources))
    keeping = [site.pictures.keep_open(place, tries.of(place)) for place in range(len(sources))]
    await first([_serve(site, tries, players, options), *keeping], options.seconds)


async def _serve(site: FramesSite, tries: _Tries, players: Players, options: Options) -> None:
    """Serve, once each source was tried."""
    await tries.done.wait()
    tries.check()
    async with contextlib.AsyncExitStack() as stack:
        served: dict[str, Any] = {}
        if players.rtsp is not None:
            served["rtsp"] = await _rtsp(site, players.rtsp, stack)
        if players.rtp is not None:
            served |= await _rtp(site.sources[0], players, stack)
        await stack.enter_async_context(site)
        options.show({"page": site.url, **served}, _text({"page": site.url, **served}))
        await _tell_viewers(site)


def _text(served: dict[str, Any]) -> str:
    """Return what is served, for people."""
    lines = [f"page: {served['page']}"]
    lines += [f"rtsp: {url}" for url in served.get("rtsp", {}).values()]
    if "rtp" in served:
        lines.append(f"rtp: {served['rtp']}")
        lines.append(
            str(served["sdp"]).strip() if "file" not in served else f"sdp: {served['file']}"
        )
    return "\n".join(lines)


class _Tries:
    """What became of the first try of each source; later ones that fail are told on stderr."""

    def __init__(self, count: int) -> None:
        self.done = asyncio.Event()  # each was tried
        self._count = count
        self._first: dict[int, SmartCamError | None] = {}
        self._told: dict[int, str] = {}

    def of(self, place: int) -> Callable[[SmartCamError | None], None]:
        """Return what hears of the tries of a source."""

        def tried(error: SmartCamError | None) -> None:
            self._first.setdefault(place, error)
            text = "" if error is None else str(error)
            if text and self._told.get(place, "") != text and not self._all_for_good():
                click.echo(f"note: {text}; it is awaited", err=True)
            self._told[place] = text
            if len(self._first) == self._count:
                self.done.set()

        return tried

    def _all_for_good(self) -> bool:
        wrong = [isinstance(one, FOR_GOOD) for one in self._first.values()]
        return len(wrong) == self._count and all(wrong)

    def check(self) -> None:
        """Raise what is wrong with the first, where all of them are wrong for good."""
        error = self._first[0]
        if error is not None and self._all_for_good():
            raise error


# ---------------------------------------------------------------------- players


def names_of(sources: Sequence[FrameSource]) -> dict[str, FrameSource]:
    """Return sources by names that a URL can have, each its own."""
    named: dict[str, FrameSource] = {}
    for one in sources:
        plain = re.sub(r"[^A-Za-z0-9._-]+", "-", one.name).strip("-.") or "camera"
        numbered = (f"{plain}-{number}" for number in range(2, len(sources) + 2))
        named[next(name for name in (plain, *numbered) if name not in named)] = one
    return named


def _password(site: FramesSite, host: str) -> str | None:
    """Return what a player must know: the page's token, or one of its own where others can come."""
    from smartcam.web._guard import is_loopback, new_token

    return site.token or (None if is_loopback(host) else new_token())


async def _rtsp(
    site: FramesSite, place: tuple[str, int], stack: contextlib.AsyncExitStack
) -> dict[str, str]:
    """Serve by RTSP; return the URLs by name."""
    from smartcam.frames import RtspServer

    (host, port), sources = place, names_of(site.sources)
    password = _password(site, host)
    user = None if password is None else USER
    made = RtspServer(sources, host=host, port=port, user=user, password=password)
    server = await stack.enter_async_context(made)
    return {name: server.url(name) for name in sources}


async def _rtp(
    source: FrameSource, players: Players, stack: contextlib.AsyncExitStack
) -> dict[str, Any]:
    """Send by RTP; return where to, and what a player has to know."""
    from smartcam.frames import RtpSender

    host, port = players.rtp or ("", 0)
    to = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    sender = await stack.enter_async_context(RtpSender(source, to))
    said: dict[str, Any] = {"rtp": to, "sdp": sender.sdp}
    if players.sdp is not None:
        try:
            await asyncio.to_thread(Path(players.sdp).write_text, sender.sdp, "utf-8")
        except OSError as exc:
            raise ConfigurationError(f"--sdp {players.sdp}: {exc.strerror}") from exc
        said["file"] = players.sdp
    return said


# ---------------------------------------------------------------------- who looks


async def _tell_viewers(site: FramesSite) -> None:
    """Tell on a terminal's stderr who looks, when that changes; until cancelled."""
    if not sys.stderr.isatty():
        await asyncio.Event().wait()
    told = viewers_text(site)
    while True:
        await asyncio.sleep(PERIOD)
        text = viewers_text(site)
        if text != told:
            told = text
            click.echo(f"{datetime.now().astimezone():%H:%M:%S} {text}", err=True)


def viewers_text(site: FramesSite) -> str:
    """Return who looks at which source: addresses of those at the page, how many others."""
    rows = []
    for place, source in enumerate(site.sources):
        at_page = [one.address for one in site.viewers if one.place == place]
        others = source.statistics().readers - len(at_page)
        who = [*sorted(at_page), *([f"{others} more"] if others > 0 else [])]
        if who:
            rows.append(f"{source.name}: {', '.join(who)}")
    return "; ".join(rows) or "nobody looks"
