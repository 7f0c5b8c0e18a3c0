"""Parse requests of RTSP, and write answers (RFC 2326)."""

from __future__ import annotations

import re
from http import HTTPStatus
from typing import TYPE_CHECKING, Final, NamedTuple, NoReturn

if TYPE_CHECKING:
    from collections.abc import Mapping


MAX_LINE_BYTES: Final = 4096
"""Largest number of bytes of a line."""

MAX_HEADERS: Final = 64

MAX_BODY_BYTES: Final = 8192
"""Largest number of bytes of a request's body; no supported request needs a body."""

MAX_DIGITS: Final = 9
"""Largest number of digits of CSeq and Content-Length."""

_REQUEST: Final = re.compile(rb"([A-Z_]{1,32}) ([\x21-\x7e]{1,2048}) RTSP/(\d\.\d)")
_HEADER: Final = re.compile(rb"([A-Za-z0-9!#$%&'*+.^_`|~-]{1,64}):[ \t]*([\t\x20-\x7e\x80-\xff]*)")
_SINGLE_HEADERS: Final = ("authorization", "content-length", "cseq", "session", "transport")

_REASONS: Final[Mapping[int, str]] = {
    453: "Not Enough Bandwidth",
    454: "Session Not Found",
    455: "Method Not Valid in This State",
    459: "Aggregate Operation Not Allowed",
    461: "Unsupported Transport",
    505: "RTSP Version Not Supported",
    551: "Option Not Supported",
}
"""Reasons of statuses that HTTP lacks or names differently."""


class RtspError(Exception):
    """A request that is answered with an error.

    Args:
        status: status of RFC 2326, section 7.1.1.
        text: reason, which is sent as the body of the answer.
        headers: headers of the answer.
        fatal: whether the connection must be closed.
    """

    def __init__(
        self,
        status: int,
        text: str,
        headers: tuple[tuple[str, str], ...] = (),
        *,
        fatal: bool = False,
    ) -> None:
        super().__init__(text)
        self.status, self.text, self.headers, self.fatal = status, text, headers, fatal


class RtspRequest(NamedTuple):
    """A request; the names of its headers are in lower case."""

    method: str
    url: str
    headers: Mapping[str, str]
    body: bytes = b""


class ChannelData(NamedTuple):
    """A packet of a channel, between the requests (section 10.12)."""

    channel: int
    data: bytes


def encode_answer(
    status: int, cseq: str, headers: tuple[tuple[str, str], ...] = (), body: bytes = b""
) -> bytes:
    """Return an answer's bytes.

    Args:
        status: status code.
        cseq: CSeq of the request; "": it was not readable, so the answer has none.
        headers: further headers.
        body: body.
    """
    lines = [f"RTSP/1.0 {status} {_REASONS.get(status) or HTTPStatus(status).phrase}"]
    if cseq:
        lines.append(f"CSeq: {cseq}")
    lines += (f"{name}: {value}" for name, value in headers)
    if body:
        lines.append(f"Content-Length: {len(body)}")
    return "\r\n".join((*lines, "", "")).encode() + body


class RequestParser:
    """Parse requests and packets from a stream of bytes.

    The parser keeps at most :data:`MAX_MESSAGE_BYTES`, and the bytes that were fed since the last
    call of :meth:`next`.
    """

    def __init__(self) -> None:
        self._data = bytearray()
        self._searched_bytes = 0  # number of bytes that were searched and have no line end
        self._request_line: tuple[str, str] | None = None  # method and URL
        self._headers: dict[str, str] = {}

    def feed(self, data: bytes) -> None:
        """Add bytes."""
        self._data += data

    @property
    def unparsed_bytes(self) -> int:
        """Number of unparsed bytes."""
        return len(self._data)

    @property
    def has_partial_message(self) -> bool:
        """True while a message is incomplete."""
        return self._request_line is not None or bool(self._data)

    def next(self) -> RtspRequest | ChannelData | None:
        """Return the next message; None if no complete message is left.

        Raises:
            RtspError: the bytes are no request; the error is fatal.
        """
        while self._request_line is None:
            if self._data[:1] == b"$":
                return self._channel_data()
            line = self._next_line()
            if line is None:
                return None
            if line:
                self._request_line = _parse_request_line(line)
        return self._request(*self._request_line)

    def _request(self, method: str, url: str) -> RtspRequest | None:
        while (line := self._next_line(self._body_size())) is not None:
            if line:
                self._add_header(line)
                continue
            size = self._body_size()
            body = bytes(self._data[:size])
            del self._data[:size]
            request = RtspRequest(method, url, self._headers, body)
            self._request_line, self._headers = None, {}
            return request
        return None

    def _channel_data(self) -> ChannelData | None:
        if len(self._data) < 4:
            return None
        end = 4 + int.from_bytes(self._data[2:4], "big")
        if len(self._data) < end:
            return None
        packet = ChannelData(self._data[1], bytes(self._data[4:end]))
        del self._data[:end]
        return packet

    def _next_line(self, body_size: int = 0) -> bytes | None:
        """Return the next line; None if it is incomplete.

        The empty line that ends the headers is returned only when the body is complete, too.
        """
        end = self._data.find(b"\n", self._searched_bytes)
        if end < 0 or end > MAX_LINE_BYTES:
            self._searched_bytes = len(self._data)
            if end > 0 or self._searched_bytes > MAX_LINE_BYTES:
                _raise_error(f"a line: expected {MAX_LINE_BYTES} bytes at most, got more")
            return None
        line = bytes(self._data[:end]).removesuffix(b"\r")
        if not line and len(self._data) - end - 1 < body_size:
            return None
        del self._data[: end + 1]
        self._searched_bytes = 0
        return line

    def _add_header(self, line: bytes) -> None:
        match = _HEADER.fullmatch(line)
        if match is None:
            _raise_error(f"a header: expected NAME: VALUE, got {line[:60]!r}")
        name = match[1].decode("ascii").lower()
        value = match[2].decode("latin-1").strip()
        if name in self._headers:
            if name in _SINGLE_HEADERS:
                _raise_error(f"{name}: expected once, got it twice")
            value = f"{self._headers.pop(name)}, {value}"
        if len(value) > MAX_LINE_BYTES:
            _raise_error(f"{name}: expected {MAX_LINE_BYTES} bytes at most, got more")
        if len(self._headers) == MAX_HEADERS:
            _raise_error(f"headers: expected {MAX_HEADERS} at most, got more")
        if name == "content-length" and (not _is_number(value) or int(value) > MAX_BODY_BYTES):
            _raise_error(f"Content-Length: expected 0 to {MAX_BODY_BYTES}, got {value[:20]!r}", 413)
        self._headers[name] = value

    def _body_size(self) -> int:
        return int(self._headers.get("content-length", "0"))


MAX_MESSAGE_BYTES: Final = 4 + 0xFFFF
"""Size of the largest message, a packet of a channel, bytes."""


def _parse_request_line(line: bytes) -> tuple[str, str]:
    match = _REQUEST.fullmatch(line)
    if match is None:
        _raise_error(f"expected METHOD URL RTSP/1.0, got {line[:60]!r}")
    if match[3] != b"1.0":
        _raise_error(f"expected RTSP/1.0, got RTSP/{match[3].decode()}", 505)
    return match[1].decode(), match[2].decode()


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= MAX_DIGITS


def cseq_of(request: RtspRequest) -> str:
    """Return the CSeq of a request, which its answer repeats.

    Raises:
        RtspError: the request has no CSeq.
    """
    cseq = request.headers.get("cseq", "")
    if not _is_number(cseq):
        raise RtspError(400, f"CSeq: expected a number, got {cseq[:20]!r}")
    return cseq


def _raise_error(text: str, status: int = 400) -> NoReturn:
    raise RtspError(status, text, fatal=True)
