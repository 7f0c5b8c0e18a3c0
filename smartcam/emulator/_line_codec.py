"""Lines of text as frames: what links, faults and the log of an emulated camera work on.

A frame's payload is a line with its end. Its id is the row of the table that it belongs to, from
1, as a request or as an answer; 0 for a line that stands in none.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import FrameError, UnsupportedError
from smartcam.protocols import messages as m
from smartcam.protocols._framed.dialect import MessageRow
from smartcam.protocols._framed.framing import Frame
from smartcam.protocols._framed.machine import State

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.emulator._client_link import Trace
    from smartcam.protocols._base import Transport
    from smartcam.protocols._lines import LineRow

MAX_LOGGED = 4096
"""Bytes of a line, or of an answer of several, that the log keeps."""

HIDDEN = b"***"
"""What the log shows of a line that is secret."""

_FIELD = re.compile(r"\{\w+\}")


@dataclass(frozen=True, slots=True, kw_only=True)
class HeardLine(m.Request):
    """A client's line, with its end."""

    row: int
    data: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class SaidLine(m.Report):
    """Bytes that a camera says: lines with their ends, or a prompt."""

    row: int
    data: bytes


class LineCodec:
    """The lines of a camera.

    Args:
        label: the dialect's name.
        rows: what is said.
        line_end: what the camera ends its lines with.
        ends: what ends a client's line.
        max_line: bytes of a client's line, its end not counted.
        encoding: of characters.
    """

    def __init__(
        self,
        label: str,
        rows: tuple[LineRow, ...],
        *,
        line_end: bytes,
        ends: re.Pattern[bytes],
        max_line: int,
        encoding: str,
    ) -> None:
        self.label: str = label
        self.line_end: bytes = line_end
        self.ends: re.Pattern[bytes] = ends
        self.max_line: int = max_line
        self.encoding: str = encoding
        self.table: tuple[MessageRow, ...] = tuple(
            MessageRow(number, kind, row.line, "")
            for number, row in enumerate(rows, start=1)
            for kind in (row.request, row.answer)
            if kind is not None
        )
        self._rows = rows
        self._patterns = [
            (number, re.compile(_pattern(row.line), re.DOTALL))
            for number, row in enumerate(rows, start=1)
            if row.request is not None
        ]

    def text(self, data: bytes) -> str:
        """Return a line's text without its end."""
        found = self.ends.search(data)
        return data[: found.start() if found else None].decode(self.encoding, "replace")

    def data(self, text: str) -> bytes:
        """Return a text as the camera says it."""
        return text.encode(self.encoding, "replace") + self.line_end

    def row_of(self, text: str) -> int:
        """Return the number of the row of a client's line, 0 for none."""
        return next((number for number, one in self._patterns if one.fullmatch(text)), 0)

    # ------------------------------------------------------------------ as a codec

    def framer(self, max_length: int) -> LineFramer:
        """Return what cuts a client's lines."""
        return LineFramer(self)

    def has(self, message_type: type[m.Message], /) -> bool:
        """Return whether a row has it, as a request or an answer."""
        return any(message_type in {row.request, row.answer} for row in self._rows)

    def message_id(self, message: m.Message, /) -> int:
        """Return the number of its row."""
        return message.row if isinstance(message, (HeardLine, SaidLine)) else 0

    def message_type(self, sender: m.Sender, message_id: int) -> type[m.Message]:
        """Return what a row is asked by, or what it answers."""
        if not 0 < message_id <= len(self._rows):
            return m.UnknownMessage
        row = self._rows[message_id - 1]
        return row.answer if sender is m.Sender.CAMERA else row.request or m.UnknownMessage

    def encode(self, message: m.Message) -> bytes:
        """Return the bytes of a line; UnsupportedError: it is another message."""
        if isinstance(message, (HeardLine, SaidLine)):
            return message.data
        raise UnsupportedError(f"dialect {self.label} is lines: insert data")

    def encode_frame(self, frame: Frame) -> bytes:
        """Return a line's bytes."""
        return frame.payload

    def to_frame(self, message: m.Message) -> Frame:
        """Return a line as a frame."""
        return Frame(self.message_id(message), self.encode(message))

    def surplus(self, sender: m.Sender, frame: Frame) -> int:
        """Return 0: a line has the length that it has."""
        return 0

    def decode(self, sender: m.Sender, frame: Frame) -> m.Message:
        """Return what a line means; UnknownMessage where no row says it."""
        kind = self.message_type(sender, frame.message_id)
        if sender is m.Sender.CLIENT and kind is not m.UnknownMessage:
            return self._request(kind, frame.message_id, self.text(frame.payload))
        if kind is not m.UnknownMessage:
            said = frame.payload.removesuffix(self.line_end).decode(self.encoding, "replace")
            try:
                return self._rows[frame.message_id - 1].read(said)
            except (ValueError, LookupError):
                pass
        return m.UnknownMessage(message_id=frame.message_id, payload=frame.payload)

    def _request(self, kind: type[m.Message], number: int, text: str) -> m.Message:
        """Return a request with what its line says for its fields, or zeros."""
        pattern = next(one for row, one in self._patterns if row == number)
        found = pattern.fullmatch(text)
        said: dict[str, Any] = {} if found is None else found.groupdict()
        values: dict[str, Any] = {}
        for name, wire in m.wire_fields(kind):
            word = said.get(name, "")
            values[name] = (
                word.encode(self.encoding, "replace")
                if wire is m.Wire.DATA
                else int(word)
                if word.isdecimal()
                else 0
            )
        return kind(**values)


def _pattern(line: str) -> str:
    """Return the pattern of a row's line: its fields are any text."""
    fixed = _FIELD.split(line)
    names = [name[1:-1] for name in _FIELD.findall(line)]
    parts = [re.escape(fixed[0])]
    for name, text in zip(names, fixed[1:], strict=True):
        parts += [f"(?P<{name}>.*)", re.escape(text)]
    return "".join(parts)


class LineFramer:
    """Cuts a client's lines; a longer one than the codec's breaks the protocol."""

    def __init__(self, codec: LineCodec) -> None:
        self._codec = codec
        self._buffer = bytearray()
        self._searched = 0  # no end begins before this

    @property
    def pending(self) -> bytes:
        """What is not cut yet."""
        return bytes(self._buffer)

    def __len__(self) -> int:
        """Return the number of bytes that are not cut yet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> None:
        """Take bytes."""
        self._buffer += data

    def next_frame(self) -> Frame | None:
        """Return the next line, None if it is not whole yet; FrameError: it is too long."""
        codec = self._codec
        found = codec.ends.search(self._buffer, self._searched)
        size = len(self._buffer) if found is None else found.start()
        if size > codec.max_line + (found is None):  # the last byte may be half of an end
            raise FrameError(
                f"a line of more than {codec.max_line} bytes came", data=bytes(self._buffer[:64])
            )
        if found is None:
            self._searched = max(0, size - 1)
            return None
        data = bytes(self._buffer[: found.end()])
        del self._buffer[: found.end()]
        self._searched = 0
        return Frame(codec.row_of(data[:size].decode(codec.encoding, "replace")), data)

    def resync(self) -> int:
        """Drop everything; return how much that was."""
        size = len(self._buffer)
        self._buffer.clear()
        self._searched = 0
        return size


class LineServer:
    """One connection's lines, in the camera's role: while one is done the next ones wait.

    Attributes:
        busy: a line is under way.
        going: lines are taken just now.
        secret: the next line is not shown in the log.
    """

    def __init__(self, codec: LineCodec, transport: Transport, trace: Trace) -> None:
        self.transport: Transport = transport
        self.state: State = State.CONNECTED
        self.busy: bool = False
        self.going: bool = False
        self.secret: bool = False
        self._trace = trace
        self._framer = codec.framer(0)
        self._outbox: list[bytes] = []

    @property
    def buffered(self) -> int:
        """Bytes that wait: of an unfinished line, and of those behind one under way."""
        return len(self._framer)

    def receive_data(self, data: bytes) -> None:
        """Take bytes; never raises for what is in them."""
        self._framer.feed(data)

    def events(self) -> Iterator[HeardLine]:
        """Yield lines until one is under way; each before the next is looked at."""
        if self.going:
            return
        self.going = True
        try:
            while not self.busy and self.state is State.CONNECTED:
                frame = self._framer.next_frame()
                if frame is None:
                    return
                secret, self.secret = self.secret, False
                shown = Frame(0, HIDDEN) if secret else frame
                self._trace(m.Sender.CLIENT, shown)
                yield HeardLine(row=frame.message_id, data=frame.payload)
        except FrameError as exc:
            self.state = State.FAILED
            self._framer.resync()
            self._trace(m.Sender.CLIENT, exc)
        finally:
            self.going = False

    def send(self, message: SaidLine) -> None:
        """Say bytes."""
        self._outbox.append(message.data)
        self._trace(m.Sender.CAMERA, Frame(message.row, message.data[:MAX_LOGGED]))

    def data_to_send(self) -> list[bytes]:
        """Return the bytes to write, in order."""
        outbox, self._outbox = self._outbox, []
        return outbox
