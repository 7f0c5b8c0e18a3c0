"""Streams for players and recorders, beside the page: by RTSP, and by RTP."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from smartcam.backoff import Backoff
from smartcam.exceptions import ConfigurationError, FrameSourceError, LocalProtocolError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam._cli.options import Options
    from smartcam.frames import FrameSource, RtpSender, RtspServer

RTSP_USER = "smartcam"
"""Name of the RTSP user, if a password is set."""

MAX_NAME_LETTERS = 60
"""Largest number of letters of a source's name in a URL, before its number."""

CHECK_INTERVAL = 0.1
"""Seconds between two checks whether a source is open."""

DESCRIPTION_TIMEOUT = 5.0
"""Seconds to wait for the first frame, which completes the description."""


class Players(NamedTuple):
    """The streams that are served beside the page.

    Attributes:
        rtsp: address to listen on for RTSP, None for none.
        rtp: address to send one source to, None for none.
        sdp: file for the description of the RTP stream, None for stdout.
    """

    rtsp: tuple[str, int] | None = None
    rtp: tuple[str, int] | None = None
    sdp: str | None = None


def address(_context: object, parameter: click.Parameter, text: str | None) -> Any:
    """Return the host and port of ``HOST:PORT``, None for None."""
    if text is None:
        return None
    host, colon, port = text.rpartition(":")
    bracketed = host.startswith("[") and host.endswith("]")
    plain = host[1:-1] if bracketed else host
    is_full = colon and plain and (bracketed or ":" not in host)
    if not (is_full and re.fullmatch(r"[0-9]{1,5}", port) and int(port) <= 65535):
        raise click.BadParameter(
            f"{text!r}: expected HOST:PORT, such as 127.0.0.1:8554 or [::1]:8554", param=parameter
        )
    return plain, int(port)


def names_of(sources: Sequence[FrameSource]) -> dict[str, FrameSource]:
    """Return sources by unique names that fit into a URL."""
    named: dict[str, FrameSource] = {}
    for source in sources:
        plain = (
            re.sub(r"[^A-Za-z0-9._~-]+", "-", source.name)[:MAX_NAME_LETTERS].strip("-._~")
            or "camera"
        )
        numbered = (f"{plain}-{number}" for number in range(2, len(sources) + 2))
        named[next(name for name in (plain, *numbered) if name not in named)] = source
    return named


# ---------------------------------------------------------------------- RTSP


def rtsp_server(
    sources: Sequence[FrameSource], place: tuple[str, int], token: str | None
) -> tuple[RtspServer, str | None]:
    """Return a server of sources, and its password, None for none.

    ``token``: the page's token, which is the password, too. If there is none, and other machines
    can reach the server, one is made.
    """
    from smartcam._accepting import is_loopback
    from smartcam.frames import RtspServer
    from smartcam.web._inside import new_token

    host, port = place
    password = token or (None if is_loopback(host) else new_token())
    user = None if password is None else RTSP_USER
    named = names_of(sources)
    return RtspServer(named, host=host, port=port, user=user, password=password), password


def rtsp_urls(
    server: RtspServer, sources: Sequence[FrameSource], password: str | None
) -> dict[str, str]:
    """Return the URLs for players, by name."""
    login = "" if password is None else f"{RTSP_USER}:{password}@"
    return {name: server.url(name).replace("//", f"//{login}", 1) for name in names_of(sources)}


# ---------------------------------------------------------------------- RTP


async def send_rtp(source: FrameSource, players: Players, options: Options) -> None:
    """Send a source by RTP whenever it is open, until cancelled; print the description for players.

    Raises ConfigurationError: the address is not valid, or the file cannot be written.
    """
    from smartcam.frames import RtpSender

    host, port = players.rtp or ("", 0)
    to = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    described, noted, delays = "", "", Backoff().delays()
    while True:
        try:
            async with RtpSender(source, to) as sender:
                await _first_frame(sender)
                if sender.sdp != described and (players.sdp is not None or not described):
                    await _describe(to, sender.sdp, players.sdp, options, again=bool(described))
                    described = sender.sdp
                noted, delays = "", Backoff().delays()
                await sender.wait()
        except LocalProtocolError:  # the source is not open
            await asyncio.sleep(CHECK_INTERVAL)
            continue
        except FrameSourceError as exc:
            if str(exc) != noted:
                click.echo(f"note: {exc}; RTP is tried again", err=True)
            noted = str(exc)
        await asyncio.sleep(next(delays))


async def _first_frame(sender: RtpSender) -> None:
    """Wait for the first frame, but not for long."""
    for _ in range(round(DESCRIPTION_TIMEOUT / CHECK_INTERVAL)):
        if sender.statistics().frames:
            return
        await asyncio.sleep(CHECK_INTERVAL)


async def _describe(to: str, sdp: str, file: str | None, options: Options, *, again: bool) -> None:
    """Write the description to a file, or show it."""
    if file is not None:
        try:
            await asyncio.to_thread(Path(file).write_text, sdp, "utf-8")
        except OSError as exc:
            raise ConfigurationError(f"--sdp {file}: {exc.strerror}") from exc
    if not again:
        text = f"rtp: {to}\n" + (f"sdp: {file}" if file is not None else sdp.strip())
        options.show({"rtp": to, "sdp": sdp}, text.replace("\r", ""))
