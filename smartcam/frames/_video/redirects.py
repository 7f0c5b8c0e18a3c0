"""Follow a server's redirects for a URL, on the server's own host and port only.

FFmpeg follows every redirect, even to this machine's own ports. In HTTP it has an option against
this; in RTSP it has none, so smartcam sends the first requests itself.
"""

from __future__ import annotations

import base64
import contextlib
import os
import re
import socket
import ssl
import time
import urllib.request
from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import SplitResult, unquote, urljoin, urlsplit

from smartcam.exceptions import FrameSourceError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MAX_REDIRECTS: Final = 5

MAX_HEAD_BYTES: Final = 64 << 10
"""Largest size of an answer's header, or of a skipped body, bytes."""

REDIRECTS: Final = range(300, 400)
"""Statuses of redirects for FFmpeg."""

_PORTS: Final = {"http": 80, "https": 443, "rtsp": 554, "rtsps": 322}


class _Answer(NamedTuple):
    status: int
    headers: Mapping[str, Sequence[str]]  # values by the headers' names in lower case
    peer: str  # address of the sender


def follow_redirects(
    url: str, *, name: str, timeout: float, tls: ssl.SSLContext | None = None
) -> str:
    """Return the URL after a server's redirects.

    The call blocks. A server that does not answer is an error, since it could still redirect
    FFmpeg.

    Args:
        url: ``http:``, ``https:``, ``rtsp:`` or ``rtsps:``; may have user and password.
        name: name of the source, for errors; without a password.
        timeout: seconds for all requests.
        tls: TLS context that checks the server's certificate.

    Raises:
        FrameSourceError: a redirect leads to another host or port, there are too many, or there is
            no answer.
    """
    end = time.monotonic() + timeout
    for _ in range(MAX_REDIRECTS):
        try:
            answer = _ask(urlsplit(url), end, tls)
        except TimeoutError:
            text = f"{name}: expected an answer, got none within {timeout:g} s"
            raise FrameSourceError(text, source=name) from None
        except (OSError, ValueError) as exc:
            # without the error as the cause, whose text may have a URL with a password
            raise FrameSourceError(f"{name}: cannot be read: {why(exc)}", source=name) from None
        location = next(iter(answer.headers.get("location", ())), "")
        if answer.status not in REDIRECTS or not location:
            return url
        url = followed(url, location, answer.peer, name)
    raise FrameSourceError(f"{name}: more than {MAX_REDIRECTS} redirects", source=name)


def why(failure: Exception) -> str:
    """Return the reason of a failure in the system's words, without a URL."""
    number = getattr(failure, "errno", None)
    if number is not None and number > 0:
        return os.strerror(number)
    text = getattr(failure, "strerror", None)
    return str(text or "the answer is not readable")


def followed(url: str, location: str, peer: str, name: str) -> str:
    """Return a redirect's URL, with the user of the requested URL.

    Args:
        url: requested URL.
        location: header of the answer.
        peer: address of the answer's sender.
        name: name of the source, for errors.

    Raises:
        FrameSourceError: the redirect leads to another host or port.
    """
    before = urlsplit(url)
    try:
        after = urlsplit(urljoin(url, location))
        target, source = _place(after), _place(before)
    except ValueError:
        after, target, source = before, None, None
    hosts = {source[1], peer} if source is not None else set[str]()
    if target is None or source is None or target[::2] != source[::2] or target[1] not in hosts:
        raise FrameSourceError(
            f"{name}: expected pictures, or a redirect on the same host and port, got one to "
            f"{re.sub('//[^/]*@', '//***@', location)[:200]!r}; #elsewhere=yes follows it",
            source=name,
        )
    user, at, _ = before.netloc.rpartition("@")
    return after._replace(netloc=f"{user}{at}{after.netloc.rpartition('@')[2]}").geturl()


def _place(parts: SplitResult) -> tuple[str, str, int]:
    """Return scheme, host and port of a URL."""
    return parts.scheme, parts.hostname or "", parts.port or _PORTS.get(parts.scheme, 0)


def _ask(url: SplitResult, end: float, tls: ssl.SSLContext | None) -> _Answer:
    """Send FFmpeg's first requests; return the first redirect, or the last answer.

    Raises:
        OSError, ValueError: there is no answer, or it cannot be read.
    """
    scheme, host, port = _place(url)
    plain = url._replace(netloc=url.netloc.rpartition("@")[2], fragment="")
    web = scheme.startswith("http")
    challenges: Sequence[str] = ()
    answer, number = _Answer(0, {}, ""), 0
    with contextlib.ExitStack() as opened:
        link: socket.socket | None = None
        for method in ("GET",) if web else ("OPTIONS", "DESCRIBE"):
            while True:
                # a web server may close after a refusal; an RTSP server's challenge is for this
                # connection
                if link is None or web:
                    link = opened.enter_context(_connected(scheme, host, port, end, tls))
                number += 1
                shown = _authorization(url, plain, method, challenges)
                link.settimeout(_left(end))
                peer = str(link.getpeername()[0])  # not available after the server has closed
                link.sendall(_head(method, plain, number, shown).encode())
                answer = _read(link, peer, end, web=web)
                if answer.status in REDIRECTS:
                    return answer
                challenged = answer.headers.get("www-authenticate", ())
                if answer.status != 401 or challenges or not challenged or url.username is None:
                    break
                challenges = challenged
        return answer


def _connected(
    scheme: str, host: str, port: int, end: float, tls: ssl.SSLContext | None
) -> socket.socket:
    made = socket.create_connection((host, port), timeout=_left(end))
    if scheme not in {"https", "rtsps"}:
        return made
    with contextlib.ExitStack() as undone:
        undone.callback(made.close)
        link = (tls or ssl.create_default_context()).wrap_socket(made, server_hostname=host)
        undone.pop_all()
        return link


def _authorization(
    url: SplitResult, plain: SplitResult, method: str, challenges: Sequence[str]
) -> str:
    """Return the header that answers a challenge; "" without a supported challenge."""
    user, password = unquote(url.username or ""), unquote(url.password or "")
    for challenge in challenges:
        scheme, _, text = challenge.partition(" ")
        if scheme.lower() == "digest":
            passwords = urllib.request.HTTPPasswordMgrWithDefaultRealm()
            passwords.add_password(None, plain.geturl(), user, password)
            request = urllib.request.Request(plain.geturl(), method=method)  # noqa: S310 - not sent
            if method != "GET":
                request.selector = plain.geturl()
            words = (parameter.partition("=") for parameter in urllib.request.parse_http_list(text))
            parts = {key: value.removeprefix('"').removesuffix('"') for key, _, value in words}
            made = urllib.request.HTTPDigestAuthHandler(passwords).get_authorization(request, parts)
            return f"Authorization: Digest {made}" if made else ""
        if scheme.lower() == "basic":
            return (
                "Authorization: Basic " + base64.b64encode(f"{user}:{password}".encode()).decode()
            )
    return ""


def _left(end: float) -> float:
    left = end - time.monotonic()
    if left <= 0:
        raise TimeoutError("no answer in time")
    return left


def _head(method: str, url: SplitResult, number: int, authorization: str) -> str:
    if method == "GET":
        path = url._replace(scheme="", netloc="").geturl() or "/"
        lines = [f"GET {path} HTTP/1.1", f"Host: {url.netloc}", "Accept: */*"]
    else:
        lines = [f"{method} {url.geturl()} RTSP/1.0", f"CSeq: {number}"]
        lines += ["Accept: application/sdp"] if method == "DESCRIBE" else []
    lines.append("User-Agent: smartcam")
    return "\r\n".join((*lines, *([authorization] if authorization else ()), "", ""))


def _read(link: socket.socket, peer: str, end: float, *, web: bool) -> _Answer:
    """Read an answer, and skip its body if another answer may follow.

    Like FFmpeg, it accepts lines that end with LF, or with several CRs.
    """
    head = bytearray()  # without carriage returns
    size = 0
    while True:
        received = _receive(link, end, size)
        size += len(received)
        begin = max(0, len(head) - 1)
        head += received.replace(b"\r", b"")
        end_of_head = head.find(b"\n\n", begin)
        if end_of_head >= 0:
            break
    status, *lines = head[:end_of_head].decode("latin-1").split("\n")
    headers: dict[str, list[str]] = {}
    for line in lines:
        key, _, value = line.partition(":")
        headers.setdefault(key.strip().lower(), []).append(value.strip())
    answer = _Answer(int(status.partition(" ")[2][:3]), headers, peer)
    if not web:
        left = int(headers.get("content-length", ("0",))[0])
        # the last piece also holds the begin of the body, with carriage returns
        lines_of_head = received.count(b"\n") - head.count(b"\n", end_of_head + 2)
        left -= len(received.split(b"\n", lines_of_head)[-1])
        while left > 0:
            received = _receive(link, end, size)
            size += len(received)
            left -= len(received)
    return answer


def _receive(link: socket.socket, end: float, before: int) -> bytes:
    """Return the next bytes of an answer; ``before``: number of bytes received so far.

    Raises:
        OSError, ValueError: there are no bytes, or too many.
    """
    link.settimeout(_left(end))
    received = link.recv(4096)
    if not received or before + len(received) > MAX_HEAD_BYTES:
        raise ValueError("no end of an answer")
    return received
