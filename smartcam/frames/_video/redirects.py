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
    deadline = time.monotonic() + timeout
    for _ in range(MAX_REDIRECTS):
        try:
            answer = _request(urlsplit(url), deadline, tls)
        except TimeoutError:
            text = f"{name}: expected an answer, got none within {timeout:g} s"
            raise FrameSourceError(text, source=name) from None
        except (OSError, ValueError) as exc:
            # without the error as the cause, whose text may have a URL with a password
            raise FrameSourceError(
                f"{name}: cannot be read: {failure_reason(exc)}", source=name
            ) from None
        location = next(iter(answer.headers.get("location", ())), "")
        if answer.status not in REDIRECTS or not location:
            return url
        url = checked_redirect(url, location, answer.peer, name)
    raise FrameSourceError(f"{name}: more than {MAX_REDIRECTS} redirects", source=name)


def failure_reason(failure: Exception) -> str:
    """Return the reason of a failure in the system's words, without a URL."""
    number = getattr(failure, "errno", None)
    if number is not None and number > 0:
        return os.strerror(number)
    text = getattr(failure, "strerror", None)
    return str(text or "the answer is not readable")


def checked_redirect(url: str, location: str, peer: str, name: str) -> str:
    """Return the URL of a redirect on the same host and port, with the user of the requested URL.

    Args:
        url: requested URL.
        location: header of the answer.
        peer: address of the answer's sender.
        name: name of the source, for errors.

    Raises:
        FrameSourceError: the redirect leads to another host or port.
    """
    requested = urlsplit(url)
    try:
        redirected = urlsplit(urljoin(url, location))
        target, source = _origin(redirected), _origin(requested)
    except ValueError:
        redirected, target, source = requested, None, None
    hosts = {source[1], peer} if source is not None else set[str]()
    if target is None or source is None or target[::2] != source[::2] or target[1] not in hosts:
        raise FrameSourceError(
            f"{name}: expected pictures, or a redirect on the same host and port, got one to "
            f"{re.sub('//[^/]*@', '//***@', location)[:200]!r}; add #elsewhere=yes to follow it",
            source=name,
        )
    user, at_sign, _ = requested.netloc.rpartition("@")
    host = redirected.netloc.rpartition("@")[2]
    return redirected._replace(netloc=f"{user}{at_sign}{host}").geturl()


def _origin(parts: SplitResult) -> tuple[str, str, int]:
    """Return scheme, host and port of a URL."""
    return parts.scheme, parts.hostname or "", parts.port or _PORTS.get(parts.scheme, 0)


def _request(url: SplitResult, deadline: float, tls: ssl.SSLContext | None) -> _Answer:
    """Send FFmpeg's first requests; return the first redirect, or the last answer.

    Raises:
        OSError, ValueError: there is no answer, or it cannot be read.
    """
    scheme, host, port = _origin(url)
    without_user = url._replace(netloc=url.netloc.rpartition("@")[2], fragment="")
    is_http = scheme.startswith("http")
    challenges: Sequence[str] = ()
    answer, cseq = _Answer(0, {}, ""), 0
    with contextlib.ExitStack() as links:
        link: socket.socket | None = None
        for method in ("GET",) if is_http else ("OPTIONS", "DESCRIBE"):
            while True:
                # a web server may close after a refusal; an RTSP server's challenge is for this
                # connection
                if link is None or is_http:
                    link = links.enter_context(_connect(scheme, host, port, deadline, tls))
                cseq += 1
                authorization = _authorization(url, without_user, method, challenges)
                link.settimeout(_remaining_time(deadline))
                peer = str(link.getpeername()[0])  # not available after the server has closed
                link.sendall(_request_text(method, without_user, cseq, authorization).encode())
                answer = _read_answer(link, peer, deadline, is_http=is_http)
                if answer.status in REDIRECTS:
                    return answer
                new_challenges = answer.headers.get("www-authenticate", ())
                if answer.status != 401 or challenges or not new_challenges or url.username is None:
                    break
                challenges = new_challenges
        return answer


def _connect(
    scheme: str, host: str, port: int, deadline: float, tls: ssl.SSLContext | None
) -> socket.socket:
    sock = socket.create_connection((host, port), timeout=_remaining_time(deadline))
    if scheme not in {"https", "rtsps"}:
        return sock
    with contextlib.ExitStack() as cleanup:
        cleanup.callback(sock.close)
        link = (tls or ssl.create_default_context()).wrap_socket(sock, server_hostname=host)
        cleanup.pop_all()
        return link


def _authorization(
    url: SplitResult, without_user: SplitResult, method: str, challenges: Sequence[str]
) -> str:
    """Return the header that answers a challenge; "" without a supported challenge."""
    user, password = unquote(url.username or ""), unquote(url.password or "")
    for challenge in challenges:
        scheme, _, text = challenge.partition(" ")
        if scheme.lower() == "digest":
            passwords = urllib.request.HTTPPasswordMgrWithDefaultRealm()
            passwords.add_password(None, without_user.geturl(), user, password)
            request = urllib.request.Request(without_user.geturl(), method=method)  # noqa: S310 - not sent
            if method != "GET":
                request.selector = without_user.geturl()
            words = (parameter.partition("=") for parameter in urllib.request.parse_http_list(text))
            parts = {key: value.removeprefix('"').removesuffix('"') for key, _, value in words}
            handler = urllib.request.HTTPDigestAuthHandler(passwords)
            digest = handler.get_authorization(request, parts)
            return f"Authorization: Digest {digest}" if digest else ""
        if scheme.lower() == "basic":
            return (
                "Authorization: Basic " + base64.b64encode(f"{user}:{password}".encode()).decode()
            )
    return ""


def _remaining_time(deadline: float) -> float:
    remaining = deadline - time.monotonic()
    if remaining <= 0:
        raise TimeoutError("no answer in time")
    return remaining


def _request_text(method: str, url: SplitResult, cseq: int, authorization: str) -> str:
    if method == "GET":
        path = url._replace(scheme="", netloc="").geturl() or "/"
        lines = [f"GET {path} HTTP/1.1", f"Host: {url.netloc}", "Accept: */*"]
    else:
        lines = [f"{method} {url.geturl()} RTSP/1.0", f"CSeq: {cseq}"]
        lines += ["Accept: application/sdp"] if method == "DESCRIBE" else []
    lines.append("User-Agent: smartcam")
    return "\r\n".join((*lines, *([authorization] if authorization else ()), "", ""))


def _read_answer(link: socket.socket, peer: str, deadline: float, *, is_http: bool) -> _Answer:
    """Read an answer, and skip its body if another answer may follow.

    Like FFmpeg, this function accepts lines that end with LF, or with several CRs before it.
    """
    head = bytearray()  # without carriage returns
    size = 0
    while True:
        received = _receive(link, deadline, size)
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
    if not is_http:
        remaining = int(headers.get("content-length", ("0",))[0])
        # the last piece also has the beginning of the body, with carriage returns
        lines_of_head = received.count(b"\n") - head.count(b"\n", end_of_head + 2)
        remaining -= len(received.split(b"\n", lines_of_head)[-1])
        while remaining > 0:
            received = _receive(link, deadline, size)
            size += len(received)
            remaining -= len(received)
    return answer


def _receive(link: socket.socket, deadline: float, received_bytes: int) -> bytes:
    """Return the next bytes of an answer.

    Args:
        link: connection.
        deadline: time until which the bytes must come.
        received_bytes: number of bytes of the answer received so far.

    Raises:
        OSError, ValueError: there are no bytes, or too many.
    """
    link.settimeout(_remaining_time(deadline))
    received = link.recv(4096)
    if not received or received_bytes + len(received) > MAX_HEAD_BYTES:
        raise ValueError("no end of an answer")
    return received
