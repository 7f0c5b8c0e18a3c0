"""Streams for players and recorders, in addition to the page: by RTSP, and by RTP."""

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
"""Longest time to wait for the first frame, which completes the description, seconds."""


class Outputs(NamedTuple):
    """The streams that are served in addition to the page.

    Attributes:
        rtsp: address to listen on for RTSP, None for none.
        rtp: address to send one source to, None for none.
        sdp: file for the description of the RTP stream, None for stdout.
    """

    rtsp: tuple[str, int] | None = None
    rtp: tuple[str, int] | None = None
    sdp: str | None = None


def parse_address_option(_context: object, parameter: click.Parameter, text: str | None) -> Any:
    """Return host and port of an option ``HOST:PORT``, None if it is not given."""
    if text is None:
        return None
    host, colon, port = text.rpartition(":")
    bracketed = host.startswith("[") and host.endswith("]")
    bare_host = host[1:-1] if bracketed else host
    is_full = colon and bare_host and (bracketed or ":" not in host)
    if not (is_full and re.fullmatch(r"[0-9]{1,5}", port) and int(port) <= 65535):
        raise click.BadParameter(
            f"{text!r}: expected HOST:PORT, such as 127.0.0.1:8554 or [::1]:8554", param=parameter
        )
    return bare_host, int(port)


def unique_names(sources: Sequence[FrameSource]) -> dict[str, FrameSource]:
    """Give each source a unique name that fits into a URL; return the sources by name."""
    by_name: dict[str, FrameSource] = {}
    for source in sources:
        base_name = (
            re.sub(r"[^A-Za-z0-9._~-]+", "-", source.name)[:MAX_NAME_LETTERS].strip("-._~")
            or "camera"
        )
        numbered_names = (f"{base_name}-{number}" for number in range(2, len(sources) + 2))
        by_name[next(name for name in (base_name, *numbered_names) if name not in by_name)] = source
    return by_name


# ---------------------------------------------------------------------- RTSP


def rtsp_server(
    sources: Sequence[FrameSource], listen_address: tuple[str, int], token: str | None
) -> tuple[RtspServer, str | None]:
    """Return a server of sources, and its password, None if it needs none.

    ``token``: the page's token, which is also the password. Without a token, a password is made if
    other machines can reach the server.
    """
    from smartcam._accepting import is_loopback
    from smartcam.frames import RtspServer
    from smartcam.web._inside import new_token

    host, port = listen_address
    password = token or (None if is_loopback(host) else new_token())
    user = None if password is None else RTSP_USER
    by_name = unique_names(sources)
    return RtspServer(by_name, host=host, port=port, user=user, password=password), password


def rtsp_urls(
    server: RtspServer, sources: Sequence[FrameSource], password: str | None
) -> dict[str, str]:
    """Return the URLs for players, by name."""
    login = "" if password is None else f"{RTSP_USER}:{password}@"
    return {name: server.url(name).replace("//", f"//{login}", 1) for name in unique_names(sources)}


# ---------------------------------------------------------------------- RTP


async def send_rtp(source: FrameSource, outputs: Outputs, options: Options) -> None:
    """Send a source by RTP whenever it is open, until cancelled; publish its SDP description.

    Raises ConfigurationError: the address is not valid, or the file cannot be written.
    """
    from smartcam.frames import RtpSender

    host, port = outputs.rtp or ("", 0)
    receiver = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    last_sdp, last_note, delays = "", "", Backoff().delays()
    while True:
        try:
            async with RtpSender(source, receiver) as sender:
                await _wait_for_frame(sender)
                if sender.sdp != last_sdp and (outputs.sdp is not None or not last_sdp):
                    await _describe(
                        receiver, sender.sdp, outputs.sdp, options, is_update=bool(last_sdp)
                    )
                    last_sdp = sender.sdp
                last_note, delays = "", Backoff().delays()
                await sender.wait()
        except LocalProtocolError:  # the source is not open
            await asyncio.sleep(CHECK_INTERVAL)
            continue
        except FrameSourceError as exc:
            if str(exc) != last_note:
                click.echo(f"note: {exc}; trying RTP again", err=True)
            last_note = str(exc)
        await asyncio.sleep(next(delays))


async def _wait_for_frame(sender: RtpSender) -> None:
    """Wait for the first frame, at most :data:`DESCRIPTION_TIMEOUT` seconds."""
    for _ in range(round(DESCRIPTION_TIMEOUT / CHECK_INTERVAL)):
        if sender.statistics().frames:
            return
        await asyncio.sleep(CHECK_INTERVAL)


async def _describe(
    receiver: str, sdp: str, file: str | None, options: Options, *, is_update: bool
) -> None:
    """Write the SDP description to the file, if there is one, and show it once.

    ``is_update``: a description was shown before.
    """
    if file is not None:
        try:
            await asyncio.to_thread(Path(file).write_text, sdp, "utf-8")
        except OSError as exc:
            raise ConfigurationError(f"--sdp {file}: {exc.strerror}") from exc
    if not is_update:
        text = f"rtp: {receiver}\n" + (f"sdp: {file}" if file is not None else sdp.strip())
        options.show({"rtp": receiver, "sdp": sdp}, text.replace("\r", ""))
