"""Frames of cameras that send a text header (a ticket and the length) before each content.

Each request carries a ticket that its answer repeats, so answers may come in any order, with other
frames between them. Such a frame is handled as a line whose length is given in advance. Contents
are bytes; as texts they are Latin-1, in which each character is one byte.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam.exceptions import ConfigurationError, FrameError
from smartcam.protocols._base import ReadableFrame
from smartcam.protocols._line_reader import LineReader
from smartcam.protocols._lines import LineDialect

if TYPE_CHECKING:
    from smartcam.protocols import messages as m
    from smartcam.protocols._machine import Frame

_DIGIT = re.compile(rb"[0-9]")

ENCODING = "latin-1"
"""An encoding in which each byte is one character, so that any content can be a text."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TicketedDialect(LineDialect):
    """A dialect whose frames are a ticket, ``L``, a length, ``CR LF``, the ticket again, content.

    Args:
        digits: number of digits of the length, 0 for frames without a header, which end with their
            first ``CR LF``. The length counts the ticket, the content and the ``CR LF`` after it.
        asks_with_length: True if requests have the header, too; otherwise only answers have it.
    """

    digits: int = 9
    asks_with_length: bool = True

    encoding: str = ENCODING
    line_end: bytes = b"\r\n"
    max_line: int = 1 << 16
    tickets: range = range(1000, 10000)
    pipelined: bool = True

    def __post_init__(self) -> None:
        if self.split is None and self.tickets:
            object.__setattr__(self, "split", self._split)

    @property
    def width(self) -> int:
        """Number of digits of a ticket, 0 without tickets."""
        return len(str(self.tickets[-1])) if self.tickets else 0

    def _split(self, line: str) -> tuple[str, str]:
        """Return the ticket of a frame, and its content."""
        ticket = line[: self.width]
        if len(ticket) < self.width or not (ticket.isascii() and ticket.isdecimal()):
            raise ValueError(line)
        return ticket, line[self.width :]

    def frame(self, content: bytes, ticket: str, *, with_length: bool) -> bytes:
        """Return the bytes of a frame, with or without the length."""
        body = ticket.encode() + content + self.line_end
        if not with_length:
            return body
        return f"{ticket}L{len(body):0{self.digits}}".encode() + self.line_end + body

    def pack(self, line: str, ticket: str) -> bytes:
        """Return the bytes of a request.

        Raises:
            ConfigurationError: a frame cannot hold the content.
        """
        data = line.encode(ENCODING, "replace")
        if len(data) > self.max_line or (not self.asks_with_length and b"\r\n" in data):
            raise ConfigurationError(
                f"dialect {self.name}: {line[:64]!r} is longer than {self.max_line} bytes, or "
                "contains CR LF"
            )
        return self.frame(data, ticket, with_length=self.asks_with_length)

    def reader(self, max_length: int = 0) -> LineReader:
        """Return a new reader that cuts a stream into contents, each with its ticket."""
        if self.digits:
            return HeaderReader(self.width, self.digits, max_length)
        line_end = re.compile(re.escape(self.line_end))
        return LineReader(line_end, max_line=max_length, encoding=ENCODING)

    def make_readable(self, sender: m.Sender, frame: Frame) -> ReadableFrame:
        """Return a frame in readable form."""
        from_client = sender.value == "client"  # the client's frames are traced with their header
        has_header = from_client and self.asks_with_length
        body = frame.payload.partition(b"\r\n")[2] if has_header else frame.payload
        ticket, content = body[: self.width].decode(ENCODING), body[self.width :]
        data = frame.payload + self.line_end
        if not from_client:
            data = self.frame(content, ticket, with_length=self.digits > 0)
        fields = {"ticket": ticket, "text": content.decode(ENCODING)}
        return ReadableFrame(None, "frame", fields, data)


class HeaderReader(LineReader):
    """Cuts frames with a header of text from a stream of bytes.

    Args:
        ticket_digits: number of digits of a ticket, 0 for frames without tickets.
        length_digits: number of digits of the length.
        max_length: largest number of bytes of a frame's content.
    """

    def __init__(self, ticket_digits: int, length_digits: int, max_length: int) -> None:
        super().__init__(re.compile(b"\r\n"), max_line=0, encoding=ENCODING)
        self._ticket_digits = ticket_digits
        self._header_bytes = ticket_digits + 1 + length_digits + 2
        self._form = re.compile(rb"([0-9]{%d})L([0-9]{%d})\r\n" % (ticket_digits, length_digits))
        self._max_length = max_length

    def next_line(self) -> str | None:
        """Return the next frame's ticket and content, None if there is no whole frame yet.

        Raises FrameError: the bytes are no frame, so the rest of the stream cannot be read either.
        """
        header = bytes(self._buffer[: self._header_bytes])
        if len(header) < self._header_bytes:
            if not self._may_begin(header):
                raise FrameError(f"no frame begins with {header!r}", data=header)
            return None
        form = self._form.fullmatch(header)
        if form is None:
            raise FrameError(f"no frame begins with {header!r}", data=header)
        length = int(form[2])
        shortest = self._ticket_digits + 2
        longest = shortest + self._max_length
        if not shortest <= length <= longest:
            raise FrameError(
                f"a frame announces {length} bytes; {shortest} to {longest} are accepted",
                data=header,
            )
        if len(self._buffer) < self._header_bytes + length:
            return None
        self.take(self._header_bytes)
        body = self.take(length) or b""
        if not body.endswith(b"\r\n") or not body.startswith(form[1]):
            raise FrameError(
                f"frame {form[1].decode()} does not repeat its ticket, or does not end with CR LF",
                data=body[:64],
            )
        return body[:-2].decode(ENCODING)

    def _may_begin(self, header: bytes) -> bool:
        """Return True if bytes that are too few for a header may be the beginning of one."""
        pattern = (
            b"0" * self._ticket_digits
            + b"L"
            + b"0" * (self._header_bytes - self._ticket_digits - 3)
            + b"\r\n"
        )
        return _DIGIT.sub(b"0", header) == pattern[: len(header)]
