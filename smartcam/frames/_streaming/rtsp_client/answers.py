"""Parse the bytes of an RTSP server into answers, requests and packets."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from smartcam.exceptions import MessageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


MAX_HEAD_BYTES: Final = 64 << 10
"""Largest number of bytes of an answer's header."""

MAX_BODY_BYTES: Final = 64 << 10
"""Largest number of bytes of an answer's body, such as a description's."""

MAX_STRAY_BYTES: Final = 256 << 10
"""Number of bytes in a row outside of messages after which the connection fails."""

MAX_HELD_BYTES: Final = 4 + 0xFFFF + MAX_HEAD_BYTES + MAX_BODY_BYTES
"""Largest number of bytes that the parser keeps."""

_ANSWER: Final = re.compile(rb"RTSP/\d\.\d[ \t]+(\d{3})(?:[ \t]+([^\r\n]{0,200}))?")
_REQUEST: Final = re.compile(rb"([A-Z_]{3,32})[ \t]+([^ \r\n]{1,2048})[ \t]+RTSP/\d\.\d[ \t]*")
_HEADER_END: Final = re.compile(rb"\n\r{0,8}\n")
_MESSAGE_START: Final = re.compile(
    rb"\$|RTSP/\d|(?:ANNOUNCE|GET_PARAMETER|OPTIONS|PAUSE|REDIRECT|SET_PARAMETER|TEARDOWN) "
)

MAX_START_BYTES: Final = 16
"""Number of bytes that suffice to recognize the start of a message."""

USUAL_CHANNELS: Final = range(4)
"""Channels whose packets are recognized after stray bytes even if none came before."""


class ServerAnswer(NamedTuple):
    """An answer; ``headers`` has all values of each header, by its name in lower case."""

    status: int
    reason: str
    headers: Mapping[str, Sequence[str]]
    body: bytes = b""

    def header(self, name: str) -> str:
        """Return a header's first value, or ""."""
        return next(iter(self.headers.get(name, ())), "")

    @property
    def cseq(self) -> int | None:
        """CSeq of the answered request; None: missing."""
        given = self.header("cseq").strip()
        return int(given) if re.fullmatch(r"[0-9]{1,9}", given) else None


class ServerRequest(NamedTuple):
    """A request of the server."""

    method: str
    headers: Mapping[str, Sequence[str]]


class ChannelPacket(NamedTuple):
    """A packet of a channel, between the answers (RFC 2326, section 10.12)."""

    channel: int
    data: bytes


Received: TypeAlias = ServerAnswer | ServerRequest | ChannelPacket


class AnswerParser:
    """Parse messages from a stream of bytes.

    Bytes outside of messages are skipped. The parser keeps at most :data:`MAX_HELD_BYTES`, and the
    bytes that were fed since the last call of :meth:`next`.
    """

    def __init__(self) -> None:
        self._data = bytearray()
        self._searched_bytes = 0  # number of bytes that were searched and have no end of a header
        self._stray_bytes = 0
        self._channels = set(USUAL_CHANNELS)
        self._message: ServerAnswer | ServerRequest | None = None
        self._body_size = 0  # size of the current body

    def feed(self, data: bytes) -> None:
        """Add bytes."""
        self._data += data

    def next(self) -> Received | None:
        """Return the next message; None if no complete message is left.

        Raises:
            MessageError: too many bytes outside of messages, or a message is too large.
        """
        while self._message is None:
            if not self._skip_strays():
                return None
            if self._data[:1] == b"$":
                return self._packet()
            if not self._read_header():
                return None
        if len(self._data) < self._body_size:
            return None
        message, self._message = self._message, None
        body = bytes(self._data[: self._body_size])
        del self._data[: self._body_size]
        return message._replace(body=body) if isinstance(message, ServerAnswer) else message

    def _skip_strays(self) -> bool:
        """Skip bytes outside of messages; return True if a message begins."""
        while (has_start := self._find_start()) is None:
            if self._stray_bytes > MAX_STRAY_BYTES:
                break
        if self._stray_bytes > MAX_STRAY_BYTES:
            raise MessageError(f"RTSP: {self._stray_bytes} bytes came that belong to no message")
        return bool(has_start)

    def _find_start(self) -> bool | None:
        """Skip bytes up to a possible start of a message.

        Returns:
            True if a message starts; False: bytes are missing; None: a false start was skipped.
        """
        match = _MESSAGE_START.search(self._data)
        skipped = match.start() if match else max(0, len(self._data) - MAX_START_BYTES)
        if skipped:
            self._stray_bytes += len(self._data[:skipped].strip(b"\r\n\0 "))
            del self._data[:skipped]
            self._searched_bytes = 0
        if match is None or not self._stray_bytes or self._data[:1] != b"$":
            return match is not None
        if len(self._data) <= 4:  # after skipped bytes, a dollar sign may be part of data
            return False
        if self._data[4] >> 6 == 2 and self._data[1] in self._channels:
            return True
        del self._data[:1]
        self._stray_bytes += 1
        return None

    def _packet(self) -> ChannelPacket | None:
        if len(self._data) < 4:
            return None
        end = 4 + int.from_bytes(self._data[2:4], "big")
        if len(self._data) < end:
            return None
        packet = ChannelPacket(self._data[1], bytes(self._data[4:end]))
        self._channels.add(packet.channel)
        self._stray_bytes = 0
        del self._data[:end]
        return packet

    def _read_header(self) -> bool:
        """Read the header of a message; return False if it is incomplete.

        Lines may end with LF or CRLF.
        """
        match = _HEADER_END.search(self._data, max(0, self._searched_bytes - 10))
        size = match.end() if match else len(self._data)
        if size > MAX_HEAD_BYTES:
            raise MessageError(f"RTSP: expected a header of {MAX_HEAD_BYTES} bytes at most")
        if match is None:
            self._searched_bytes = size
            return False
        lines = bytes(self._data[:size]).replace(b"\r", b"").split(b"\n")
        del self._data[:size]
        self._searched_bytes = 0
        self._message = _parse_first_line(lines[0], _headers(lines[1:]))
        if self._message is not None:
            self._stray_bytes = 0
            self._body_size = _body_length(self._message.headers)
        return True


def _parse_first_line(
    line: bytes, headers: Mapping[str, Sequence[str]]
) -> ServerAnswer | ServerRequest | None:
    """Return the message that starts with a line; None: no message starts with this line."""
    if (match := _ANSWER.match(line)) is not None:
        reason = (match[2] or b"").decode("latin-1").strip()
        return ServerAnswer(int(match[1]), reason, headers)
    request = _REQUEST.fullmatch(line)
    return None if request is None else ServerRequest(request[1].decode(), headers)


def _headers(lines: list[bytes]) -> dict[str, list[str]]:
    headers: dict[str, list[str]] = {}
    last: list[str] = []
    for line in lines:
        text = line.decode("latin-1")
        if text[:1] in (" ", "\t") and last and text.strip():  # continuation of the line before
            last[-1] = f"{last[-1]} {text.strip()}"
            continue
        name, colon, value = text.partition(":")
        if colon:
            last = headers.setdefault(name.strip().lower(), [])
            last.append(value.strip())
    return headers


def _body_length(headers: Mapping[str, Sequence[str]]) -> int:
    given = next(iter(headers.get("content-length", ())), "0")
    if not re.fullmatch(r"[0-9]{1,20}", given):
        return 0
    if int(given) > MAX_BODY_BYTES:
        raise MessageError(
            f"RTSP: an answer: expected a body of {MAX_BODY_BYTES} bytes at most, got {given}"
        )
    return int(given)
