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
_HEAD_ENDS: Final = re.compile(rb"\n\r{0,8}\n")
_BEGINS: Final = re.compile(
    rb"\$|RTSP/\d|(?:ANNOUNCE|GET_PARAMETER|OPTIONS|PAUSE|REDIRECT|SET_PARAMETER|TEARDOWN) "
)

MAX_BEGIN_BYTES: Final = 16
"""Number of bytes that suffice to recognize a message."""

USUAL_CHANNELS: Final = range(4)
"""Channels that are accepted directly after bytes outside of messages."""


class ServerAnswer(NamedTuple):
    """An answer; header names are in lower case, with all values of each."""

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
    """Cut messages from a stream of bytes.

    Bytes outside of messages are skipped. The parser keeps at most :data:`MAX_HELD_BYTES`, and
    bytes fed since the last :meth:`next`.
    """

    def __init__(self) -> None:
        self._data = bytearray()
        self._searched = 0  # number of searched bytes without the end of a header
        self._strays = 0
        self._channels = set(USUAL_CHANNELS)
        self._head: ServerAnswer | ServerRequest | None = None
        self._body = 0  # size of the current body

    def feed(self, data: bytes) -> None:
        """Add bytes."""
        self._data += data

    def next(self) -> Received | None:
        """Return the next complete message; None if it is incomplete.

        Raises:
            MessageError: too many bytes outside of messages, or a message is too large.
        """
        while self._head is None:
            if not self._skip_strays():
                return None
            if self._data[:1] == b"$":
                return self._packet()
            if not self._read_head():
                return None
        if len(self._data) < self._body:
            return None
        head, self._head = self._head, None
        body = bytes(self._data[: self._body])
        del self._data[: self._body]
        return head._replace(body=body) if isinstance(head, ServerAnswer) else head

    def _skip_strays(self) -> bool:
        """Skip bytes outside of messages; return True if a message begins."""
        while (begins := self._begins()) is None:
            if self._strays > MAX_STRAY_BYTES:
                break
        if self._strays > MAX_STRAY_BYTES:
            raise MessageError(f"RTSP: {self._strays} bytes came that belong to no message")
        return bool(begins)

    def _begins(self) -> bool | None:
        """Return True if a message begins; None: bytes that resembled a message were skipped."""
        match = _BEGINS.search(self._data)
        gone = match.start() if match else max(0, len(self._data) - MAX_BEGIN_BYTES)
        if gone:
            self._strays += len(self._data[:gone].strip(b"\r\n\0 "))
            del self._data[:gone]
            self._searched = 0
        if match is None or not self._strays or self._data[:1] != b"$":
            return match is not None
        if len(self._data) <= 4:  # after skipped bytes, a dollar may be data
            return False
        if self._data[4] >> 6 == 2 and self._data[1] in self._channels:
            return True
        del self._data[:1]
        self._strays += 1
        return None

    def _packet(self) -> ChannelPacket | None:
        if len(self._data) < 4:
            return None
        end = 4 + int.from_bytes(self._data[2:4], "big")
        if len(self._data) < end:
            return None
        packet = ChannelPacket(self._data[1], bytes(self._data[4:end]))
        self._channels.add(packet.channel)
        self._strays = 0
        del self._data[:end]
        return packet

    def _read_head(self) -> bool:
        """Read the header of a message; return False if it is incomplete.

        Lines may end by either character, or by both.
        """
        match = _HEAD_ENDS.search(self._data, max(0, self._searched - 10))
        size = match.end() if match else len(self._data)
        if size > MAX_HEAD_BYTES:
            raise MessageError(f"RTSP: an answer: expected lines of {MAX_HEAD_BYTES} bytes at most")
        if match is None:
            self._searched = size
            return False
        lines = bytes(self._data[:size]).replace(b"\r", b"").split(b"\n")
        del self._data[:size]
        self._searched = 0
        self._head = _message(lines[0], _headers(lines[1:]))
        if self._head is not None:
            self._strays = 0
            self._body = _length(self._head.headers)
        return True


def _message(
    line: bytes, headers: Mapping[str, Sequence[str]]
) -> ServerAnswer | ServerRequest | None:
    """Return the message for its first line; None: the line is no beginning of a message."""
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


def _length(headers: Mapping[str, Sequence[str]]) -> int:
    given = next(iter(headers.get("content-length", ())), "0")
    if not re.fullmatch(r"[0-9]{1,20}", given):
        return 0
    if int(given) > MAX_BODY_BYTES:
        raise MessageError(
            f"RTSP: an answer: expected a body of {MAX_BODY_BYTES} bytes at most, got {given}"
        )
    return int(given)
