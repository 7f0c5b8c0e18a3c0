"""Parse URLs and transports in requests of RTSP clients."""

from __future__ import annotations

import re
from typing import Final, NamedTuple
from urllib.parse import unquote, urlsplit

from smartcam.frames._streaming.rtsp.messages import RtspError

TRACK: Final = "track1"
"""Name of the only track of each stream."""

STREAM_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._~-]{0,63}")
"""Allowed names of streams, which need no escapes in a URL."""


class RtspTarget(NamedTuple):
    """The target of a request.

    Attributes:
        base: the stream's URL as the client writes it, without a slash at the end.
        name: name of the stream.
        is_track: whether the URL names the stream's track, and not the whole stream.
    """

    base: str
    name: str
    is_track: bool


def target_of(url: str) -> RtspTarget:
    """Read a request's URL.

    Raises:
        RtspError: the URL is no RTSP URL.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
        parts = None
    if parts is None or parts.scheme != "rtsp" or not host:
        raise RtspError(400, f"URL: expected rtsp://HOST/NAME, got {url[:80]!r}")
    names = [unquote(part) for part in parts.path.split("/") if part]
    is_track = len(names) > 1 and names[-1] == TRACK
    name = "/".join(names[:-1] if is_track else names)
    url_host = f"[{host}]" if ":" in host else host
    base = f"rtsp://{url_host}{'' if port is None else f':{port}'}/{name}"
    return RtspTarget(base, name, is_track)


class RequestedTransport(NamedTuple):
    """A transport requested by a client: channels of its RTSP connection, or a pair of ports.

    Attributes:
        is_tcp: True for channels of the connection, False for ports.
        rtp: channel or port of the client for RTP; None: the server chooses a channel.
        rtcp: channel or port of the client for RTCP.
    """

    is_tcp: bool
    rtp: int | None
    rtcp: int | None


def requested_transport(header: str, client: str) -> RequestedTransport:
    """Return the first supported transport in a client's list.

    Args:
        header: value of the header ``Transport``.
        client: address of the client, the only allowed destination.

    Raises:
        RtspError: the list has no supported transport.
    """
    for text in header.split(","):
        requested = _parse_transport(text, client)
        if requested is not None:
            return requested
    raise RtspError(
        461,
        "Transport: expected RTP/AVP;unicast;client_port=A-B to the client's own address, or "
        f"RTP/AVP/TCP;unicast;interleaved=0-1, got {header[:80]!r}",
    )


def _parse_transport(text: str, client: str) -> RequestedTransport | None:
    protocol, *parts = (part.strip() for part in text.split(";"))
    options = {key.lower(): value for key, _, value in (option.partition("=") for option in parts)}
    is_tcp = protocol.upper() == "RTP/AVP/TCP"
    if not is_tcp and protocol.upper() not in ("RTP/AVP", "RTP/AVP/UDP"):
        return None
    if "multicast" in options or options.get("destination", client) != client:
        return None
    if options.get("mode", "play").strip('"').lower() != "play":
        return None
    if is_tcp and "interleaved" not in options:
        return RequestedTransport(True, None, None)
    minimum, maximum = (0, 255) if is_tcp else (1, 65535)
    numbers = options.get("interleaved" if is_tcp else "client_port", "")
    pair = _parse_pair(numbers, minimum, maximum)
    return None if pair is None else RequestedTransport(is_tcp, *pair)


def _parse_pair(text: str, minimum: int, maximum: int) -> tuple[int, int] | None:
    match = re.fullmatch(r"([0-9]{1,5})(?:-([0-9]{1,5}))?", text, re.ASCII)
    if match is None:
        return None
    first = int(match[1])
    second = int(match[2]) if match[2] else first + 1
    if not (minimum <= first <= maximum and minimum <= second <= maximum) or first == second:
        return None
    return first, second
