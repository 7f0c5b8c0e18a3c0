"""Request a web camera's stream, with redirects on its host, and passwords."""

from __future__ import annotations

import asyncio
import re
from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import unquote, urlsplit

from smartcam.exceptions import FrameSourceError, MessageError
from smartcam.frames._streaming.rtsp_client.authorization import Credentials
from smartcam.frames._video.redirects import MAX_REDIRECTS, REDIRECTS, checked_redirect

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncGenerator, Mapping, Sequence

MAX_HEAD_BYTES: Final = 64 << 10
"""Largest number of bytes of an answer's head."""

MAX_REFUSALS: Final = 3
"""Largest number of refusals of a request's authorization, such as for an old nonce."""

MAX_LINE_BYTES: Final = 4096
"""Largest number of bytes of the line with a chunk's size."""

PIECE_BYTES: Final = 64 << 10
"""Largest number of bytes that are read at a time."""

INTERIM: Final = range(100, 200)
"""Status codes of interim answers."""

PORTS: Final = {"http": 80, "https": 443}

_PICTURES: Final = re.compile(r"(?i)\s*(?:multipart/|video/(?:x-)?(?:m|motion-?)?jpe?g\b)")

MAX_INTERIM_ANSWERS: Final = 8
"""Largest number of interim answers (1xx)."""

_HEADER_END: Final = re.compile(rb"\n\r{0,8}\n")


class WebAnswer(NamedTuple):
    """An answer without its body; header names are in lower case."""

    status: int
    reason: str
    headers: Mapping[str, Sequence[str]]

    def header(self, name: str) -> str:
        """Return a header's first value, or ""."""
        return next(iter(self.headers.get(name, ())), "")

    @property
    def is_pictures(self) -> bool:
        """True if the answer is a stream of JPEGs, in parts or one after the other."""
        return _PICTURES.match(self.header("content-type")) is not None


class WebStream:
    """The body of an answer to GET.

    Args:
        name: name of the source, for errors.
        url: URL with user and password.
        tls: options for checking the server's certificate.

    Attributes:
        answer: header of the server's answer, set by :meth:`open`.
    """

    answer: WebAnswer

    def __init__(self, name: str, url: str, tls: ssl.SSLContext | None) -> None:
        self._name, self._url, self._tls = name, url, tls
        self._writer: asyncio.StreamWriter | None = None
        self._reader: asyncio.StreamReader | None = None
        self._unread = b""

    async def open(self) -> None:
        """Send the request; follow redirects on the same host and port, and answer challenges.

        Raises:
            FrameSourceError: there is a redirect to another host, or too many redirects.
            OSError: there is no connection.
            ValueError: the server is no web server.

        Cancellation: :meth:`close` cleans up.
        """
        parts = urlsplit(self._url)
        credentials = Credentials(unquote(parts.username or ""), unquote(parts.password or ""))
        redirects = refusals = 0
        while redirects <= MAX_REDIRECTS:
            self.answer = answer = await self._request(credentials)
            challenges = answer.headers.get("www-authenticate", ())
            if (
                answer.status == 401
                and refusals < MAX_REFUSALS
                and credentials.store_challenge(challenges)
            ):
                refusals += 1
                continue
            location = answer.header("location")
            if answer.status not in REDIRECTS or not location:
                return
            peer = self._writer.get_extra_info("peername") if self._writer else None
            redirects += 1
            self._url = checked_redirect(self._url, location, str((peer or ("",))[0]), self._name)
        raise FrameSourceError(
            f"{self._name}: more than {MAX_REDIRECTS} redirects", source=self._name
        )

    def close(self) -> None:
        """End the stream. Idempotent."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.transport.abort()

    async def pieces(self) -> AsyncGenerator[bytes, None]:
        """Yield the body's bytes as they come.

        Raises:
            MessageError: a chunk is not valid.
            OSError: the connection is lost.
        """
        if "chunked" not in self.answer.header("transfer-encoding").lower():
            while piece := await self._read_piece():
                yield piece
            return
        while size := await self._chunk_size():
            while size:
                piece = await self._read_piece(size)
                if not piece:
                    return
                size -= len(piece)
                yield piece

    async def _request(self, credentials: Credentials) -> WebAnswer:
        self.close()
        parts = urlsplit(self._url)
        host, port = parts.hostname or "", parts.port or PORTS[parts.scheme]
        tls = self._tls if parts.scheme == "https" else None
        self._reader, self._writer = await asyncio.open_connection(
            host, port, ssl=tls, limit=PIECE_BYTES, server_hostname=host if tls else None
        )
        path = parts._replace(scheme="", netloc="", fragment="").geturl() or "/"
        path = path if path.startswith("/") else f"/{path}"
        authorization = credentials.header("GET", path)
        lines = [
            *(f"GET {path} HTTP/1.1", f"Host: {parts.netloc.rpartition('@')[2]}", "Accept: */*"),
            *("User-Agent: smartcam", "Connection: close"),
            *([f"Authorization: {authorization}"] if authorization else ()),
        ]
        self._writer.write("\r\n".join((*lines, "", "")).encode())
        self._unread = b""
        answer = await self._read_header()
        for _ in range(MAX_INTERIM_ANSWERS):
            if answer.status not in INTERIM:
                break
            answer = await self._read_header()
        return answer

    async def _read_header(self) -> WebAnswer:
        received = bytearray()
        searched = 0
        while (match := _HEADER_END.search(received, max(0, searched - 10))) is None:
            searched = len(received)
            piece = await self._read_piece()
            received += piece
            if not piece or len(received) > MAX_HEAD_BYTES:
                raise ValueError("no head")
        self._unread = bytes(received[match.end() :])
        return _parse_header(bytes(received[: match.start()]))

    async def _read_piece(self, size: int = PIECE_BYTES) -> bytes:
        if self._unread:
            piece, self._unread = self._unread[:size], self._unread[size:]
            return piece
        return b"" if self._reader is None else await self._reader.read(size)

    async def _chunk_size(self) -> int:
        """Return the size of the next chunk; 0 at the end."""
        line = bytearray()
        while not line.strip() or not line.endswith(b"\n"):
            byte = await self._read_piece(1)
            line += byte
            if not byte:
                return 0
            if len(line) > MAX_LINE_BYTES:
                raise MessageError("HTTP: a chunk: expected its size, got a line without an end")
        size = bytes(line).partition(b";")[0].strip()
        if not re.fullmatch(rb"[0-9A-Fa-f]{1,8}", size):
            raise MessageError(f"HTTP: a chunk: expected its size, got {size[:20]!r}")
        return int(size, 16)


def _parse_header(head: bytes) -> WebAnswer:
    first, *lines = head.decode("latin-1").replace("\r", "").split("\n")
    match = re.match(r"(?:HTTP/\d(?:\.\d)?|ICY)[ \t]+(\d{3})[ \t]*(.{0,200})", first)
    if match is None:
        raise ValueError("no answer")
    headers: dict[str, list[str]] = {}
    for line in lines:
        key, colon, value = line.partition(":")
        if colon:
            headers.setdefault(key.strip().lower(), []).append(value.strip())
    return WebAnswer(int(match[1]), match[2].strip(), headers)
