"""Treat lines of text as frames, for the links, faults and the log of an emulated camera.

A frame's payload is a line with its end. Its id is the number of the row that the line belongs to,
from 1, as a request or as an answer; 0 for a line without a row.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import FrameError, UnsupportedError
from smartcam.protocols import Frame, LineCommand, MessageRow, State
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.emulator._client_link import Trace
    from smartcam.protocols import LineRow, Transport

MAX_LOGGED_BYTES = 4096
"""Largest number of bytes of a line, or of an answer of several lines, that the log keeps."""

HIDDEN = b"***"
"""The text that the log shows in place of a secret line."""

_FIELD = re.compile(r"\{\w+(?::\w+)?\}")


@dataclass(frozen=True, slots=True, kw_only=True)
class HeardLine(m.Request):
    """A client's line, with its end."""

    row: int
    data: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class SaidLine(m.Report):
    """Bytes that a camera sends: lines with their ends, or a prompt."""

    row: int
    data: bytes


class LineCodec:
    """The lines of a camera.

    Args:
        label: the dialect's name.
        rows: requests and answers.
        line_end: end of the camera's lines.
        client_line_end: pattern of the end of a client's line.
        max_line: largest number of bytes of a client's line, without its end.
        encoding: encoding of characters.
        split: function that splits an answer into its word, or its request's ticket, and its text.
    """

    def __init__(
        self,
        label: str,
        rows: tuple[LineRow, ...],
        *,
        line_end: bytes,
        client_line_end: re.Pattern[bytes],
        max_line: int,
        encoding: str,
        split: Callable[[str], tuple[str, str]] | None = None,
    ) -> None:
        self._split = split
        self.label: str = label
        self.line_end: bytes = line_end
        self.client_line_end: re.Pattern[bytes] = client_line_end
        self.max_line: int = max_line
        self.encoding: str = encoding
        self.table: tuple[MessageRow, ...] = tuple(
            MessageRow(number, kind, row.line, "")
            for number, row in enumerate(rows, start=1)
            for kind in dict.fromkeys((row.request, row.answer, *row.extras))
            if kind is not None
        )
        self._rows = rows
        self._forms = [
            (number, _LineForm.of(row.line))
            for number, row in enumerate(rows, start=1)
            if row.request is not None
        ]

    def text(self, data: bytes) -> str:
        """Return a line's text without its end."""
        match = self.client_line_end.search(data)
        return data[: match.start() if match else None].decode(self.encoding, "replace")

    def sent_text(self, data: bytes) -> str:
        """Return the text of bytes that the camera sends."""
        return data.removesuffix(self.line_end).decode(self.encoding, "replace")

    def data(self, text: str) -> bytes:
        """Return a text as bytes that the camera sends."""
        return text.encode(self.encoding, "replace") + self.line_end

    def row_of(self, text: str) -> int:
        """Return the number of the row of a client's line, 0 for none."""
        return next((number for number, form in self._forms if form.read(text) is not None), 0)

    def row_of_word(self, word: str) -> int:
        """Return the number of the row with a word, 0 for none."""
        return next(
            (number for number, row in enumerate(self._rows, 1) if row.answer_word == word), 0
        )

    def request_key(self, data: bytes) -> str:
        """Return the word or ticket of the answer to a line, "" if only the order shows it."""
        if self._split is None:
            return ""
        text = self.text(data)
        row = self._rows[self.row_of(text) - 1] if self.row_of(text) else None
        word = None if row is None else row.answer_word
        return text.partition(",")[0] if word is None else word

    def answer_key(self, data: bytes) -> str:
        """Return the word or ticket of an answer, "" if only the order shows it."""
        try:
            return "" if self._split is None else self._split(self.sent_text(data))[0]
        except (ValueError, LookupError):
            return ""

    # ------------------------------------------------------------------ as a codec

    def framer(self, max_length: int) -> LineFramer:
        """Return a new reader that cuts a client's bytes into lines."""
        return LineFramer(self)

    def has(self, message_type: type[m.Message], /) -> bool:
        """Return True if a row has the message as a request or an answer."""
        return any(message_type in {row.request, row.answer, *row.extras} for row in self._rows)

    def message_id(self, message: m.Message, /) -> int:
        """Return the number of its row."""
        return message.row if isinstance(message, (HeardLine, SaidLine)) else 0

    def message_type(self, sender: m.Sender, message_id: int) -> type[m.Message]:
        """Return the type of a row's request, or of its answer if the camera is the sender."""
        if not 0 < message_id <= len(self._rows):
            return m.UnknownMessage
        row = self._rows[message_id - 1]
        kind = row.answer if sender is m.Sender.CAMERA else row.request
        return kind or m.UnknownMessage

    def encode(self, message: m.Message) -> bytes:
        """Return the bytes of a line; raise UnsupportedError for any other message."""
        if isinstance(message, (HeardLine, SaidLine)):
            return message.data
        raise UnsupportedError(f"dialect {self.label} has lines: insert data, no message")

    def encode_frame(self, frame: Frame) -> bytes:
        """Return a line's bytes."""
        return frame.payload

    def to_frame(self, message: m.Message) -> Frame:
        """Return a line as a frame."""
        return Frame(self.message_id(message), self.encode(message))

    def surplus(self, sender: m.Sender, frame: Frame) -> int:
        """Return 0: a line has no documented length."""
        return 0

    def decode(self, sender: m.Sender, frame: Frame) -> m.Message:
        """Return the message of a line; UnknownMessage if no row has the line."""
        kind = self.message_type(sender, frame.message_id)
        if sender is m.Sender.CLIENT and kind is not m.UnknownMessage:
            return self._request(kind, frame.message_id, self.text(frame.payload))
        if kind is not m.UnknownMessage:
            text = self.sent_text(frame.payload)
            try:
                messages = self._rows[frame.message_id - 1].read(
                    text if self._split is None else self._split(text)[1]
                )
            except (ValueError, LookupError):
                pass
            else:
                decoded = messages if isinstance(messages, tuple) else (messages,)
                return next((message for message in decoded if type(message) is kind), decoded[0])
        return m.UnknownMessage(message_id=frame.message_id, payload=frame.payload)

    def _request(self, kind: type[m.Message], number: int, text: str) -> m.Message:
        """Return a request with the fields that its line gives, or zeros."""
        if kind is LineCommand:
            return LineCommand(line=text)
        form = next(form for row, form in self._forms if row == number)
        fields = form.read(text) or {}
        values: dict[str, Any] = {}
        for name, wire in m.wire_fields(kind):
            word = fields.get(name, "")
            values[name] = (
                word.encode(self.encoding, "replace")
                if wire is m.Wire.DATA
                else int(word)
                if word.isdecimal()
                else 0
            )
        return kind(**values)


class _LineForm(NamedTuple):
    """The form of a row's line: fixed texts with a field of any text between two of them.

    Attributes:
        fields: names of the fields.
        texts: fixed texts, one more than there are fields.
    """

    fields: tuple[str, ...]
    texts: tuple[str, ...]

    @classmethod
    def of(cls, line: str) -> _LineForm:
        """Return the form of a row's line, which has its fields in braces."""
        return cls(
            tuple(name[1:-1].partition(":")[0] for name in _FIELD.findall(line)),
            tuple(_FIELD.split(line)),
        )

    def read(self, text: str) -> dict[str, str] | None:
        """Return the fields of a line, each as long as possible; None for a line of another form.

        Fixed texts are searched from the end, so that no character is read twice.
        """
        first, *texts = self.texts
        if not texts:
            return {} if text == first else None
        end = len(text) - len(texts[-1])
        if not text.startswith(first) or not text.endswith(texts[-1]) or end < len(first):
            return None
        values: dict[str, str] = {}
        for name, before in zip(reversed(self.fields), reversed((first, *texts[:-1])), strict=True):
            start = text.rfind(before, len(first), end) if len(values) < len(texts) - 1 else 0
            if start < 0:
                return None
            values[name] = text[start + len(before) : end]
            end = start
        return values


class LineFramer:
    """Cuts a client's bytes into lines; a line longer than the codec's limit is an error."""

    def __init__(self, codec: LineCodec) -> None:
        self._codec = codec
        self._buffer = bytearray()
        self._search_start = 0  # offset where the search for a line end goes on

    @property
    def unfinished_bytes(self) -> bytes:
        """Bytes that are not cut into lines yet."""
        return bytes(self._buffer)

    def __len__(self) -> int:
        """Return the number of bytes that are not cut yet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> None:
        """Add received bytes."""
        self._buffer += data

    def next_frame(self) -> Frame | None:
        """Return the next line, None if it is incomplete; raise FrameError if it is too long."""
        codec = self._codec
        match = codec.client_line_end.search(self._buffer, self._search_start)
        size = len(self._buffer) if match is None else match.start()
        if size > codec.max_line + (match is None):  # the last byte may be half of an end
            raise FrameError(
                f"a line of more than {codec.max_line} bytes came", data=bytes(self._buffer[:64])
            )
        if match is None:
            self._search_start = max(0, size - 1)
            return None
        data = bytes(self._buffer[: match.end()])
        del self._buffer[: match.end()]
        self._search_start = 0
        return Frame(codec.row_of(data[:size].decode(codec.encoding, "replace")), data)

    def resync(self) -> int:
        """Drop everything; return the number of dropped bytes."""
        size = len(self._buffer)
        self._buffer.clear()
        self._search_start = 0
        return size


class LineServer:
    """The camera's side of one connection: a line waits until the line before it is answered.

    Attributes:
        busy: True while a line is carried out and not answered yet.
        is_reading: True while :meth:`events` is running.
        hides_next_line: True if the log must not show the next line.
    """

    def __init__(self, codec: LineCodec, transport: Transport, trace: Trace) -> None:
        self.transport: Transport = transport
        self.state: State = State.CONNECTED
        self.busy: bool = False
        self.is_reading: bool = False
        self.hides_next_line: bool = False
        self._trace = trace
        self._framer = codec.framer(0)
        self._outbox: list[bytes] = []

    @property
    def buffered(self) -> int:
        """Bytes that wait: of an unfinished line, and of lines after the current one."""
        return len(self._framer)

    def receive_data(self, data: bytes) -> None:
        """Add received bytes; never raises for bad bytes."""
        self._framer.feed(data)

    def events(self) -> Iterator[HeardLine]:
        """Yield lines one by one, until a line is not carried out at once."""
        if self.is_reading:
            return
        self.is_reading = True
        try:
            while not self.busy and self.state is State.CONNECTED:
                frame = self._framer.next_frame()
                if frame is None:
                    return
                hides_line, self.hides_next_line = self.hides_next_line, False
                traced_frame = Frame(0, HIDDEN) if hides_line else frame
                self._trace(m.Sender.CLIENT, traced_frame)
                yield HeardLine(row=frame.message_id, data=frame.payload)
        except FrameError as exc:
            self.state = State.FAILED
            self._framer.resync()
            self._trace(m.Sender.CLIENT, exc)
        finally:
            self.is_reading = False

    def send(self, message: SaidLine) -> None:
        """Send bytes."""
        self._outbox.append(message.data)
        self._trace(m.Sender.CAMERA, Frame(message.row, message.data[:MAX_LOGGED_BYTES]))

    def data_to_send(self) -> list[bytes]:
        """Return the bytes to write, in order."""
        outbox, self._outbox = self._outbox, []
        return outbox
