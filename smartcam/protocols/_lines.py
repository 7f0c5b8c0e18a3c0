"""Cameras that speak in lines of text: each request is a line, and so is its answer, in order.

What a camera says stands in a table of :class:`LineRow`; dialect and machine are made of it.
"""

from __future__ import annotations

import collections
import re
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from smartcam.exceptions import (
    ConfigurationError,
    FrameError,
    LocalProtocolError,
    RemoteProtocolError,
    UnsupportedError,
)
from smartcam.models import Capabilities
from smartcam.protocols import messages as m
from smartcam.protocols._base import (
    CodeMeaning,
    Dialect,
    RawRequest,
    Role,
    Spelled,
    Transport,
    Verdict,
)
from smartcam.protocols._framed.framing import Frame
from smartcam.protocols._framed.machine import Counters, LinkEnded, LinkFailed, State
from smartcam.protocols._line_reader import LineReader

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.protocols._framed.machine import Event

READ_SIZE = 1 << 15
"""Bytes that one read takes at most."""

DONE = CodeMeaning("done", Verdict.DONE)

_ABILITIES: Mapping[type[m.Message], str] = {
    m.SwitchApplication: "switch",
    m.LoadFile: "load_file",
    m.Reboot: "reboot",
    m.GetClock: "get_clock",
    m.SetClock: "set_clock",
    m.SetInput: "input_data",
    m.SetSequenceNumber: "sequence_number",
    m.GetStatus: "get_status",
    m.ResetErrors: "reset_errors",
    m.ReadImage: "read_image",
}


class LineRow(NamedTuple):
    """A request, and what answers it; or what the camera says by itself.

    Attributes:
        request: what the client asks for; None for a line that the camera says unasked.
        line: how it asks, with the message's fields in braces: ``"PROGRAM {application}"``.
        answer: what the answer is.
        read: makes it of the answer's line; a ValueError or LookupError says that it is none.
    """

    request: type[m.Request] | None
    line: str
    answer: type[m.Report]
    read: Callable[[str], m.Message]


@dataclass(frozen=True, kw_only=True, eq=False)
class LineDialect(Dialect):
    """A dialect of lines.

    Args:
        name, about, source, quirks: as those of :class:`~smartcam.protocols.Dialect`.
        rows: what is said; ``Connect`` and ``Query`` are needed.
        ids: the ids that applications may have.
        line_end: ends each line, one or two bytes.
        max_line: bytes of a line, its end not counted; a longer one breaks the protocol.
        encoding: of its characters.
    """

    rows: tuple[LineRow, ...]
    ids: range = range(1, 1 << 31)
    line_end: bytes = b"\n"
    max_line: int = 4096
    encoding: str = "utf-8"

    in_order: ClassVar[bool] = True
    exclusive: ClassVar[bool] = False

    @property
    def application_ids(self) -> range:
        """The ids that applications may have."""
        return self.ids

    @property
    def capabilities(self) -> Capabilities:
        """What a camera can do in it, which the rows say."""
        able = {name: True for kind, name in _ABILITIES.items() if self.row(kind) is not None}
        unasked = {row.answer for row in self.rows if row.request is None}
        return Capabilities(
            dialect=self.name,
            start_stop=self.row(m.Start) is not None and self.row(m.Stop) is not None,
            unasked_results=m.ResultContainer in unasked,
            **able,
        )

    def row(self, request: type[m.Message]) -> LineRow | None:
        """Return the row of a request, None where the dialect has none."""
        return next((row for row in self.rows if row.request is request), None)

    def code(self, code: int, request: type[m.Message] | None = None) -> CodeMeaning:
        """Return that it is done: lines carry no codes unless a dialect says so."""
        return DONE

    def has(self, message_type: type[m.Message]) -> bool:
        """Return whether there is such a message."""
        known = {m.Disconnect, *(row.request for row in self.rows), *(r.answer for r in self.rows)}
        return message_type in known

    def message_id(self, message: m.Message | type[m.Message]) -> int:
        """Return 0: lines have no numbers; UnsupportedError: it has no such message."""
        kind = message if isinstance(message, type) else type(message)
        if not self.has(kind):
            raise self.unsupported(kind)
        return 0

    def called(self, message: m.Message) -> str:
        """Return a message's name for errors, with its line."""
        row = self.row(type(message))
        return f"{type(message).__name__} ({'' if row is None else row.line[:32]})"

    def line(self, message: m.Message) -> str:
        """Return the line of a request.

        Raises:
            ConfigurationError: a field of it cannot stand in a line.
        """
        row = self.row(type(message))
        if row is None:
            raise self.unsupported(type(message))
        values = {one.name: getattr(message, one.name) for one in fields(message)}
        texts = {
            key: value.decode(self.encoding, "replace") if isinstance(value, bytes) else value
            for key, value in values.items()
        }
        line = row.line.format_map(texts)
        data = line.encode(self.encoding, "replace")
        if len(data) > self.max_line or any(byte in self.line_end for byte in data):
            raise ConfigurationError(
                f"{type(message).__name__}: {line[:64]!r} is no line of {self.max_line} bytes"
            )
        return line

    def reader(self) -> LineReader:
        """Return what cuts lines from a stream."""
        ends = re.compile(re.escape(self.line_end))
        return LineReader(ends, max_line=self.max_line, encoding=self.encoding)

    def spell(self, sender: m.Sender, frame: Frame) -> Spelled:
        """Return a line in words."""
        text = frame.payload.decode(self.encoding, "replace")
        return Spelled(None, "line", {"text": text}, frame.payload + self.line_end)

    def raw_request(self, message_id: int | str, payload: bytes) -> RawRequest:
        """Raise UnsupportedError: how another line is answered is not known."""
        raise UnsupportedError(f"dialect {self.name}: there are no other requests")

    def body(self, answer: m.Message) -> bytes:
        """Raise LocalProtocolError: there are no raw requests."""
        raise LocalProtocolError(f"dialect {self.name}: there are no other requests")


class _AskedLine(NamedTuple):
    """A request, and how it is said."""

    row: LineRow
    line: str


class LineMachine:
    """One connection's lines, in the client's role; what a link needs.

    See :class:`~smartcam.protocols.LinkMachine`. A request is said when the one before it is
    answered: nothing in a line says what it answers, so one that is lost must not make the answers
    of later ones its own. A line is the answer to it, unless a row says that the camera says such a
    line unasked.

    Args:
        dialect: what is spoken.
        role: the client's.
        transport: TCP.
        max_length: unused: a line is bounded by the dialect.
        trace: called with each line in both directions, and with what broke the protocol.
        kin: unused, there is one dialect.

    Raises:
        ConfigurationError: another role or transport.
    """

    def __init__(
        self,
        dialect: LineDialect,
        role: Role,
        transport: Transport,
        *,
        max_length: int,
        trace: Callable[[m.Sender, Frame | RemoteProtocolError], None] | None = None,
        kin: Sequence[Dialect] = (),
    ) -> None:
        if role is not Role.CLIENT or transport is not Transport.TCP:
            raise ConfigurationError(f"dialect {dialect.name}: the client's side of TCP only")
        self.dialect: LineDialect = dialect
        self.kin: Sequence[Dialect] = (dialect,)
        self.transport: Transport = transport
        self.replies: bool = True
        self.counters: Counters = Counters()
        self.state: State = State.IDLE
        self._trace = trace
        self._reader = dialect.reader()
        self._store = memoryview(bytearray(READ_SIZE))
        # under way is the first one; at most one of a kind
        self._asked: collections.deque[_AskedLine] = collections.deque()
        self._unasked = tuple(row for row in dialect.rows if row.request is None)
        self._events: list[Event] = []
        self._outbox: list[bytes] = []

    def adopt(self, dialect: Dialect) -> None:
        """Do nothing: there is one dialect."""

    # ------------------------------------------------------------------ bytes in

    @property
    def pending(self) -> bytes:
        """Copy of the bytes that wait for their line's end."""
        return self._reader.pending

    def room(self) -> memoryview:
        """Return the buffer for the next bytes; call :meth:`filled` next."""
        return self._store

    def filled(self, count: int, now: float = 0.0) -> bool:
        """Take ``count`` bytes that were written into :meth:`room`."""
        self.receive_data(bytes(self._store[:count]))
        return True

    def receive_data(self, data: bytes) -> None:
        """Take bytes; call :meth:`events` next. Never raises for what is in them."""
        if self.state in {State.FAILED, State.CLOSED}:
            return
        self.counters.bytes_received += len(data)
        self._reader.feed(data)
        try:
            while (line := self._reader.next_line()) is not None:
                self.counters.frames_received += 1
                self._tell(m.Sender.CAMERA, line)
                self._events.append(self._read(line))
        except RemoteProtocolError as error:
            if self._trace is not None:
                self._trace(m.Sender.CAMERA, error)
            self._events.append(LinkFailed(error=error))
            self._end(State.FAILED)

    def receive_eof(self) -> None:
        """Take note that the camera will send no more; call :meth:`events` next."""
        if self.state not in {State.FAILED, State.CLOSED}:
            self._events.append(LinkEnded(pending=len(self._reader)))
            self._end(State.CLOSED)

    def events(self) -> list[Event]:
        """Return the events since the last call, in order; the caller owns the list."""
        events, self._events = self._events, []
        return events

    def _read(self, line: str) -> m.Message:
        """Return what a line says; FrameError: nothing that is known."""
        for row in self._unasked:
            try:
                return row.read(line)
            except (ValueError, LookupError):
                continue
        if not self._asked:
            raise FrameError(f"{line[:64]!r} came, nothing was asked")
        row = self._asked.popleft().row
        try:
            message = row.read(line)
        except (ValueError, LookupError) as exc:
            raise FrameError(
                f"{line[:64]!r} came, {row.answer.__name__} to {row.line[:32]!r} was expected"
            ) from exc
        if row.request is m.Connect and self.state is State.CONNECTING:
            self.state = State.CONNECTED
        if self._asked and self.state is State.CONNECTED:
            self._write(self._asked[0].line)
        return message

    def _end(self, state: State) -> None:
        """Say and read nothing more."""
        self.state = state
        self._asked.clear()
        self._reader = self.dialect.reader()

    # ------------------------------------------------------------------ messages out

    def send(self, message: m.Message, *, answered: bool | None = None) -> None:
        """Put a request in line; write :meth:`data_to_send` next.

        A Get status whose answer is owed is not repeated: it is new enough. Disconnect has no
        words, the connection's end is that.

        Raises:
            LocalProtocolError: not in this state, or an answer of the same kind is still owed.
            UnsupportedError: the dialect has no such message.
            ConfigurationError: a field of it cannot stand in a line.
        """
        kind = type(message)
        self.dialect.message_id(kind)
        if kind is m.Disconnect:
            if self.state in {State.CONNECTING, State.CONNECTED}:
                self.state = State.DISCONNECTED
            return
        row = self.dialect.row(kind)
        if row is None or self.state is not (State.IDLE if kind is m.Connect else State.CONNECTED):
            raise LocalProtocolError(
                f"{kind.__name__} cannot be sent by the client in state {self.state.value}"
            )
        if any(row is one.row for one in self._asked):
            if kind is m.GetStatus:
                return
            raise LocalProtocolError(f"the answer to a {kind.__name__} is still owed")
        line = self.dialect.line(message)
        if kind is m.Connect:
            self.state = State.CONNECTING
        self._asked.append(_AskedLine(row, line))
        if len(self._asked) == 1:
            self._write(line)

    def _write(self, line: str) -> None:
        data = line.encode(self.dialect.encoding, "replace") + self.dialect.line_end
        self._outbox.append(data)
        self.counters.frames_sent += 1
        self.counters.bytes_sent += len(data)
        self._tell(m.Sender.CLIENT, line)

    def data_to_send(self) -> list[bytes]:
        """Return the bytes to write, in order."""
        outbox, self._outbox = self._outbox, []
        return outbox

    def _tell(self, sender: m.Sender, line: str) -> None:
        if self._trace is not None:
            self._trace(sender, Frame(0, line.encode(self.dialect.encoding, "replace")))
