"""Cut what a server sends on an RTSP connection into answers, requests and packets."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from smartcam.exceptions import MessageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


MAX_HEAD_BYTES: Final = 64 << 10
"""Largest number of bytes of an answer's lines."""

MAX_BODY_BYTES: Final = 64 << 10
"""Largest number of bytes of an answer's body, such as a description's."""

MAX_STRAY_BYTES: Final = 256 << 10
"""Bytes in a row that belong to no message, after which the connection is given up."""

ROOM: Final = 4 + 0xFFFF + MAX_HEAD_BYTES + MAX_BODY_BYTES
"""Bytes that a message and what comes behind it may take."""

_ANSWER: Final = re.compile(rb"RTSP/\d\.\d[ \t]+(\d{3})(?:[ \t]+([^\r\n]{0,200}))?")
_REQUEST: Final = re.compile(rb"([A-Z_]{3,32})[ \t]+([^ \r\n]{1,2048})[ \t]+RTSP/\d\.\d[ \t]*")
_HEAD_ENDS: Final = re.compile(rb"\n\r{0,8}\n")
_BEGINS: Final = re.compile(
    rb"\$|RTSP/\d|(?:ANNOUNCE|GET_PARAMETER|OPTIONS|PAUSE|REDIRECT|SET_PARAMETER|TEARDOWN) "
)

MAX_BEGIN_BYTES: Final = 16
"""Largest number of bytes by which it is known that a message begins."""

USUAL_CHANNELS: Final = range(4)
"""Channels that packets are believed to be of when they follow bytes that belong to no packet."""


class ServerAnswer(NamedTuple):
    """An answer; the names of its headers are in lower case, with all values of each."""

    status: int
    reason: str
    headers: Mapping[str, Sequence[str]]
    body: bytes = b""

    def header(self, name: str) -> str:
        """Return a header's first value, or ""."""
        return next(iter(self.headers.get(name, ())), "")

    @property
    def cseq(self) -> int | None:
        """The number of the request that it answers; None: it does not say."""
        said = self.header("cseq").strip()
        return int(said) if re.fullmatch(r"[0-9]{1,9}", said) else None


class ServerRequest(NamedTuple):
    """A request of the server's."""

    method: str
    headers: Mapping[str, Sequence[str]]


class ChannelPacket(NamedTuple):
    """A packet of a channel, between the answers (section 10.12)."""

    channel: int
    data: bytes


Received: TypeAlias = ServerAnswer | ServerRequest | ChannelPacket


class AnswerParser:
    """Cuts messages from bytes that come in any pieces.

    Bytes that belong to none are skipped until a message begins. What is held is bounded by
    :data:`ROOM` and by what one feeds before one takes.
    """

    def __init__(self) -> None:
        self._data = bytearray()
        self._seen = 0  # bytes in which a head does not end
        self._strays = 0
        self._channels = set(USUAL_CHANNELS)
        self._head: ServerAnswer | ServerRequest | None = None
        self._body = 0  # bytes that its body has

    def feed(self, data: bytes) -> None:
        """Take bytes."""
        self._data += data

    def next(self) -> Received | None:
        """Return the next whole message; None if it is not complete yet.

        Raises:
            MessageError: too many bytes that belong to no message, or more than there is room for.
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
        """Throw away what begins no message; return True if one begins."""
        while (begins := self._begins()) is None:
            if self._strays > MAX_STRAY_BYTES:
                break
        if self._strays > MAX_STRAY_BYTES:
            raise MessageError(f"RTSP: {self._strays} bytes came that belong to no message")
        return bool(begins)

    def _begins(self) -> bool | None:
        """Return True if a message begins; None: bytes that looked like one were thrown away."""
        found = _BEGINS.search(self._data)
        gone = found.start() if found else max(0, len(self._data) - MAX_BEGIN_BYTES)
        if gone:
            self._strays += len(self._data[:gone].strip(b"\r\n\0 "))
            del self._data[:gone]
            self._seen = 0
        if found is None or not self._strays or self._data[:1] != b"$":
            return found is not None
        if len(self._data) <= 4:  # behind strays any byte may be a dollar
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
        """Take the lines of a message; return False where they are not there yet.

        Lines may end by either character, or by both.
        """
        found = _HEAD_ENDS.search(self._data, max(0, self._seen - 10))
        size = found.end() if found else len(self._data)
        if size > MAX_HEAD_BYTES:
            raise MessageError(f"RTSP: an answer: expected lines of {MAX_HEAD_BYTES} bytes at most")
        if found is None:
            self._seen = size
            return False
        lines = bytes(self._data[:size]).replace(b"\r", b"").split(b"\n")
        del self._data[:size]
        self._seen = 0
        self._head = _message(lines[0], _headers(lines[1:]))
        if self._head is not None:
            self._strays = 0
            self._body = _length(self._head.headers)
        return True


def _message(
    line: bytes, headers: Mapping[str, Sequence[str]]
) -> ServerAnswer | ServerRequest | None:
    """Return the message that a first line begins; None: the line begins no message."""
    if (found := _ANSWER.match(line)) is not None:
        reason = (found[2] or b"").decode("latin-1").strip()
        return ServerAnswer(int(found[1]), reason, headers)
    asked = _REQUEST.fullmatch(line)
    return None if asked is None else ServerRequest(asked[1].decode(), headers)


def _headers(lines: list[bytes]) -> dict[str, list[str]]:
    headers: dict[str, list[str]] = {}
    last: list[str] = []
    for line in lines:
        text = line.decode("latin-1")
        if text[:1] in (" ", "\t") and last and text.strip():  # goes on with the line before
            last[-1] = f"{last[-1]} {text.strip()}"
            continue
        name, colon, value = text.partition(":")
        if colon:
            last = headers.setdefault(name.strip().lower(), [])
            last.append(value.strip())
    return headers


def _length(headers: Mapping[str, Sequence[str]]) -> int:
    said = next(iter(headers.get("content-length", ())), "0")
    if not re.fullmatch(r"[0-9]{1,20}", said):
        return 0
    if int(said) > MAX_BODY_BYTES:
        raise MessageError(
            f"RTSP: an answer: expected a body of {MAX_BODY_BYTES} bytes at most, got {said}"
        )
    return int(said)
