"""The base class of emulated cameras of several makes, whose frames have a ticket."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, cast

from smartcam.emulator._line_camera import LineCamera, LineClient
from smartcam.emulator._line_codec import LineCodec, LineFramer, LineServer
from smartcam.exceptions import ConfigurationError, FrameError
from smartcam.protocols import Frame, TicketedDialect

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self

    from smartcam.emulator._client_link import ClientLink
    from smartcam.emulator._line_codec import HeardLine
    from smartcam.protocols import LineRow

MAX_REQUEST_BYTES = 1 << 16
"""Largest number of bytes of a request's content."""


class TicketedClient(LineClient):
    """A client of an emulated camera that uses frames.

    A subclass keeps the values of a session in attributes of its own, see
    :attr:`TicketedCamera.client_class`.

    Attributes:
        dialect: dialect of the frames to the client.
        ticket: ticket of the current request, "" if it has none.
        number: number of its session, from 1.
    """

    def __init__(self, camera: LineCamera, link: ClientLink, server: LineServer) -> None:
        super().__init__(camera, link, server)
        self.dialect: TicketedDialect
        self.speak(next(iter(camera.protocol.dialects)))
        self.ticket: str = ""
        self.number: int = 0
        self._session: TicketedClient = self

    @property
    def session(self) -> Self:
        """The client itself; for a copy from :meth:`answer_later`, the original client."""
        return cast("Self", self._session)

    def speak(self, name: str) -> None:
        """Continue in one of the protocol's dialects."""
        dialect = self._camera.protocol.dialects[name]
        assert isinstance(dialect, TicketedDialect)  # noqa: S101 - as make_codec has seen to
        self.dialect = dialect

    def pack(self, text: str) -> bytes:
        """Return an answer to the current request, with its ticket."""
        return self.frame(text, self.ticket)

    def say_recorded(self, data: bytes) -> None:
        """Send a frame again, with the ticket of the current request unless it has its own."""
        codec = self._camera.lines
        ticket = codec.answer_key(data)
        if self.ticket and ticket.isdecimal() and int(ticket) in self.dialect.tickets:
            text = codec.sent_text(data).removeprefix(ticket)
            data = self.frame(text, self.ticket)
        self.say_bytes(data)

    def frame(self, text: str, ticket: str) -> bytes:
        """Return a frame in the client's dialect."""
        dialect = self.dialect
        content = text.encode(dialect.encoding, "replace")
        return dialect.frame(content, ticket[: dialect.width], with_length=dialect.digits > 0)


class TicketedCodec(LineCodec):
    """The frames of a camera: with a header of text, or ended by ``CR LF`` alone."""

    def __init__(self, dialect: TicketedDialect) -> None:
        super().__init__(
            dialect.name,
            dialect.rows,
            line_end=dialect.line_end,
            client_line_end=re.compile(b"\r\n"),
            max_line=MAX_REQUEST_BYTES,
            encoding=dialect.encoding,
            split=dialect.split,
        )
        self.width: int = dialect.width
        width = self.width
        self.header: re.Pattern[bytes] = re.compile(
            rb"([0-9]{%d})?L([0-9]{%d})\r\n" % (width, dialect.digits)
        )
        self.header_size: int = width + 1 + dialect.digits + 2
        self._ticket = re.compile(f"[0-9]{{{width}}}")

    def framer(self, max_length: int) -> TicketedFramer:
        """Return a new reader that cuts a client's bytes into frames."""
        return TicketedFramer(self)

    def sent_text(self, data: bytes) -> str:
        """Return the text of a frame without its header."""
        match = self.header.match(data)
        return data[match.end() if match else 0 :].removesuffix(b"\r\n").decode(self.encoding)

    def request_key(self, data: bytes) -> str:
        """Return the ticket of a request."""
        return self.content(self.sent_text(data))[0]

    def text(self, data: bytes) -> str:
        """Return a request without header and ticket."""
        return self.content(self.sent_text(data))[1]

    def content(self, text: str) -> tuple[str, str]:
        """Return the ticket, "" for none, and the content."""
        match = self._ticket.match(text)
        return ("", text) if match is None else (match[0], text[match.end() :])


class TicketedFramer(LineFramer):
    """Cuts a client's bytes into frames, with a header or ended by ``CR LF``."""

    def __init__(self, codec: TicketedCodec) -> None:
        super().__init__(codec)
        self._ticketed_codec = codec

    def next_frame(self) -> Frame | None:
        """Return the next frame, None if it is incomplete; raise FrameError if it is too long."""
        codec = self._ticketed_codec
        match = codec.header.match(self._buffer)
        if match is None:
            length_mark = self._buffer[codec.width : codec.width + 1]
            if length_mark == b"L" and len(self._buffer) < codec.header_size:
                return None
            return super().next_frame()
        length = int(match[2])
        if length > codec.max_line:
            raise FrameError(f"a frame of {length} bytes came", data=bytes(self._buffer[:64]))
        end = match.end() + length
        if len(self._buffer) < end:
            return None
        data = bytes(self._buffer[:end])
        del self._buffer[:end]
        self._search_start = 0
        return Frame(codec.row_of(codec.text(data)), data)


class TicketedCamera(LineCamera):
    """An emulated camera that reads frames, each with a ticket that its answer repeats.

    A subclass overrides :meth:`answer`, or :meth:`hear` if an answer needs time: further requests
    are read meanwhile.

    Attributes:
        also_hears: requests that smartcam does not send, but other clients do.
        client_class: class of its clients.
    """

    also_hears: ClassVar[tuple[LineRow, ...]] = ()
    client_class: ClassVar[type[TicketedClient]] = TicketedClient
    _sessions: int = 0

    def make_codec(self) -> LineCodec:
        """Return the frames of its protocol's first dialect.

        Raises:
            ConfigurationError: the dialect has no tickets.
        """
        dialect = next(iter(self.protocol.dialects.values()))
        if not isinstance(dialect, TicketedDialect):
            raise ConfigurationError(
                f"{type(self).__name__}: dialect {dialect.name} has no tickets"
            )
        *rows, catch_all_row = dialect.rows  # the last row may match any line
        return TicketedCodec(
            replace(dialect, rows=(*rows, *self.also_hears, catch_all_row), split=None)
        )

    def make_client(self, link: ClientLink, server: LineServer) -> LineClient:
        """Return a new client."""
        client = self.client_class(self, link, server)
        client.number = self._sessions = self._sessions + 1
        return client

    def tell(
        self, ticket: str, content: Callable[[Any], str], to: Callable[[Any], object] = bool
    ) -> None:
        """Send a message under a ticket of the camera's own.

        Args:
            ticket: the ticket, which a row of the dialect has as its word.
            content: function that returns the content for a client.
            to: function that returns whether a client gets it; default all clients do.
        """
        row = self.lines.row_of_word(ticket)
        for client in list(self._clients.values()):
            if isinstance(client, TicketedClient) and to(client):
                client.say_bytes(client.frame(content(client), ticket), row=row)

    def on_raw_line(self, client: LineClient, message: HeardLine) -> None:
        """Note the ticket of a request."""
        if isinstance(client, TicketedClient) and isinstance(self.lines, TicketedCodec):
            client.ticket = self.lines.content(self.lines.sent_text(message.data))[0]
