"""Speak with cameras whose requests and answers are lines of text.

A table of :class:`LineRow` lists a camera's requests and answers; dialect and machine use
it. Answers have several forms: one line, in the order of the requests; several lines; an echo and
then a result; or lines in any order, each with a word or a ticket of its request.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from smartcam.exceptions import (
    CommandRejectedError,
    ConfigurationError,
    FrameError,
    LocalProtocolError,
    RemoteProtocolError,
    UnsupportedError,
)
from smartcam.models import Capabilities
from smartcam.protocols import messages as m
from smartcam.protocols._base import (
    UNDOCUMENTED,
    CodeMeaning,
    Dialect,
    RawRequest,
    ReadableFrame,
    Role,
    Transport,
    Verdict,
)
from smartcam.protocols._held_results import HeldResults
from smartcam.protocols._line_reader import LineReader
from smartcam.protocols._machine import Counters, Frame, LinkEnded, LinkFailed, State

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping, Sequence

    from smartcam.protocols._machine import Event

    Reported = m.Message | tuple[m.Message, ...]
    """One message, or several, that an answer becomes."""

    Script = Generator[str, str, Reported]
    """Yields lines, receives the answer to each, and returns the messages made of them."""

MAX_READ_BYTES = 1 << 15
"""Largest number of bytes that one read takes."""

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

_FIRST_WORD = re.compile(r"\w*")
_COMMAND_WORD = re.compile(r"\w+\??")


class LineRow(NamedTuple):
    """A request and its answer, or a line that the camera sends by itself.

    Attributes:
        request: the client's request; None for a line that the camera sends unasked.
        line: the line of the request, with the message's fields in braces: ``"PROGRAM
            {application}"``.
        answer: message type of the answer; None for a request without an answer.
        read: function that makes one or several messages of the answer's line; a ValueError
            or LookupError means that the line is no answer.
        answer_word: word by which the answer is recognized, if the dialect splits answers; "" for
            an answer without a word; None: the first word of the request's line. Answers to later
            lines of a script are always recognized by the first word of the line. A dialect with
            tickets needs it only for unasked lines.
        echo: line that comes before the answer.
        until: possible first words of the last line of an answer of several lines. ``read`` gets
            these lines joined by line feeds.
        extras: further message types that ``read`` may return.
        script: function for a request of several lines; it gets the dialect and the message, yields
            lines and receives the answer to each. ``line`` is then the line for error texts.
    """

    request: type[m.Request] | None
    line: str
    answer: type[m.Report] | None
    read: Callable[[str], Reported]
    answer_word: str | None = None
    echo: str = ""
    until: tuple[str, ...] = ()
    extras: tuple[type[m.Report], ...] = ()
    script: Callable[[Any, Any], Script] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LineReply(m.Acknowledgement):
    """The answer to a :class:`LineCommand`: its code, and its bytes."""

    data: bytes = b""


@dataclass(frozen=True, slots=True, kw_only=True)
class LineCommand(m.Request):
    """A line that the user writes; a dialect allows such lines if it has a row for this class."""

    answer: ClassVar[type[m.Message] | None] = LineReply

    line: str


def refuse_line(line: str) -> m.Message:
    """Refuse every line; for ``read`` of a row that has no answer, or that has a script.

    Raises:
        ValueError: always.
    """
    raise ValueError(line)


@dataclass(frozen=True, kw_only=True, eq=False)
class LineDialect(Dialect):
    """A dialect whose requests and answers are lines of text.

    Args:
        name, about, source, quirks: as for :class:`~smartcam.protocols.Dialect`.
        rows: requests and answers; ``Connect`` and ``Query`` are needed.
        ids: the ids that applications may have.
        line_end: end of each line, one or two bytes.
        max_line: bytes of a line, without its end; a longer line breaks the protocol.
        encoding: encoding of the lines.
        split: function that splits an answer into its word ("" for none) and the text for
            ``read``; None if answers come in order and do not name their request.
        tickets: numbers of which each request carries the next one, in place of ``{ticket}`` in a
            row's line or added by :meth:`pack`; empty for a dialect without tickets.
        pipelined: True if requests are sent without waiting for earlier answers; needs ``split``.
        codes: the meaning of each result code of the answers; without codes, every answer is a
            success.
        names_application: results name their application, or there is only one. Otherwise the
            camera is asked before each trigger and after each result, by the row of Query.
        make: name of the maker or the product line, for error texts.
    """

    rows: tuple[LineRow, ...]
    ids: range = range(1, 1 << 31)
    line_end: bytes = b"\n"
    max_line: int = 4096
    encoding: str = "utf-8"
    split: Callable[[str], tuple[str, str]] | None = None
    tickets: range = range(0)
    pipelined: bool = False
    codes: Mapping[int, CodeMeaning] = field(default_factory=dict[int, CodeMeaning])
    names_application: bool = True
    make: str = ""

    results_are_attributable: ClassVar[bool] = True
    exclusive: ClassVar[bool] = False

    @property
    def application_ids(self) -> range:
        """The ids that applications may have."""
        return self.ids

    @property
    def capabilities(self) -> Capabilities:
        """Abilities of a camera in this dialect, from its rows."""
        abilities = {name: True for kind, name in _ABILITIES.items() if self.row(kind) is not None}
        unasked = {row.answer for row in self.rows if row.request is None}
        return Capabilities(
            dialect=self.name,
            start_stop=self.row(m.Start) is not None and self.row(m.Stop) is not None,
            result_codes=bool(self.codes),
            unasked_status=self.row(m.GetStatus) is None,
            unasked_results=m.ResultContainer in unasked,
            **abilities,
        )

    def row(self, request: type[m.Message]) -> LineRow | None:
        """Return the row of a request, None if the dialect has none."""
        return next((row for row in self.rows if row.request is request), None)

    def code(self, code: int, request: type[m.Message] | None = None) -> CodeMeaning:
        """Return the meaning of a code; in a dialect without codes it is a success."""
        return self.codes.get(code, UNDOCUMENTED) if self.codes else DONE

    def has(self, message_type: type[m.Message]) -> bool:
        """Return True if the dialect has a message of this type."""
        if message_type is m.Disconnect:
            return True
        return any(message_type in {row.request, row.answer, *row.extras} for row in self.rows)

    def message_id(self, message: m.Message | type[m.Message]) -> int:
        """Return 0, since lines have no ids; raise UnsupportedError without such a message."""
        kind = message if isinstance(message, type) else type(message)
        if not self.has(kind):
            raise self.unsupported(kind)
        return 0

    def message_label(self, message: m.Message) -> str:
        """Return a message's name for errors, with its line."""
        row = self.row(type(message))
        return f"{type(message).__name__} ({'' if row is None else row.line[:32]})"

    def unsupported(self, message_type: type[m.Message]) -> UnsupportedError:
        """Return the error for a message that the dialect does not have; it names the make."""
        plain = super().unsupported(message_type)
        return UnsupportedError(f"{self.make}: {plain}") if self.make else plain

    def line(self, message: m.Message) -> str:
        """Return the line of a request.

        Raises:
            UnsupportedError: no row has the request.
        """
        row = self.row(type(message))
        if row is None:
            raise self.unsupported(type(message))
        values = {attribute.name: getattr(message, attribute.name) for attribute in fields(message)}
        texts = {
            key: value.decode(self.encoding, "replace") if isinstance(value, bytes) else value
            for key, value in values.items()
        }
        return row.line.format_map({"ticket": "{ticket}", **texts})

    def script(self, row: LineRow, message: m.Message) -> Script:
        """Return the script of a request, which yields its lines one after the other."""
        if row.script is not None:
            return row.script(self, message)
        return _one_line(row, self.line(message))

    def pack(self, line: str, ticket: str) -> bytes:
        """Return the bytes of a line.

        Raises:
            ConfigurationError: the text cannot stand in a line.
        """
        data = line.replace("{ticket}", ticket).encode(self.encoding, "replace")
        if len(data) > self.max_line or any(byte in self.line_end for byte in data):
            raise ConfigurationError(
                f"dialect {self.name}: {line[:64]!r} is longer than {self.max_line} bytes, or "
                "contains a line end"
            )
        return data + self.line_end

    def reader(self, max_length: int = 0) -> LineReader:
        """Return a new reader that cuts a stream into lines.

        Args:
            max_length: largest answer in bytes, if the dialect bounds answers other than by lines.
        """
        ends = re.compile(re.escape(self.line_end))
        return LineReader(ends, max_line=self.max_line, encoding=self.encoding)

    def make_readable(self, sender: m.Sender, frame: Frame) -> ReadableFrame:
        """Return a line in readable form."""
        text = frame.payload.decode(self.encoding, "replace")
        return ReadableFrame(None, "line", {"text": text}, frame.payload + self.line_end)

    def command(self, line: str) -> str:
        """Check a line that the user writes, and return it; a subclass may refuse some lines.

        Raises:
            ConfigurationError: the text is no line that can be sent.
        """
        return line

    def raw_request(self, message_id: int | str, payload: bytes) -> RawRequest:
        """Return the request for a line that the user writes; the payload is added to the line.

        Raises:
            UnsupportedError: the dialect allows no such lines.
            ConfigurationError: the text is no line that can be sent.
            LocalProtocolError: the line triggers, and its answer would not name the trigger.
        """
        if self.row(LineCommand) is None or not isinstance(message_id, str):
            raise UnsupportedError(f"dialect {self.name}: there are no other requests")
        line = self.command(message_id + payload.decode(self.encoding, "replace"))
        self.pack(line, "")
        message = LineCommand(line=line)
        equivalent = self._equivalent_row(message)
        if (
            equivalent is not None
            and equivalent.request in {m.Trigger, m.EndTrigger}
            and not self.tickets
        ):
            raise LocalProtocolError(
                f"{self.make or self.name}: {line[:32]!r} triggers the camera: its result could "
                "not be distinguished from that of trigger(); call trigger()"
            )
        expects_answer = equivalent is None or equivalent.answer is not None
        return RawRequest(message, LineReply, expects_answer=expects_answer, known=True)

    def _equivalent_row(self, message: LineCommand) -> LineRow | None:
        """Return the row of a client's request that sends the same command as a user's line."""
        word = _command_word(message.line)
        own_rows = (row for row in self.rows if row.request not in {None, LineCommand})
        return next((row for row in own_rows if _command_word(row.line) == word), None)

    def row_of(self, message: m.Message) -> LineRow | None:
        """Return the row of a message.

        For a user's line that sends the same command as a client's request, the row describes
        that request's answer.
        """
        row = self.row(type(message))
        equivalent = self._equivalent_row(message) if isinstance(message, LineCommand) else None
        if row is None or equivalent is None:
            return row
        answer = None if equivalent.answer is None else row.answer
        word = None if equivalent.script is not None else equivalent.answer_word
        echo, until = equivalent.echo, equivalent.until
        return row._replace(answer=answer, answer_word=word, echo=echo, until=until)

    def body(self, answer: m.Message) -> bytes:
        """Return the bytes of the answer to a line of the user's own.

        Raises:
            UnsupportedError: by its answer, the camera does not know the line.
            CommandRejectedError: by its answer, the camera did not carry it out.
        """
        if not isinstance(answer, LineReply):
            raise LocalProtocolError(f"{type(answer).__name__} is no answer to a line")
        meaning = self.code(answer.code)
        if meaning.verdict is Verdict.DONE:
            return answer.data
        refusal = f"the camera answered {answer.data[:64]!r} ({meaning.text})"
        if meaning.verdict is Verdict.UNKNOWN:
            raise UnsupportedError(refusal)
        raise CommandRejectedError(refusal, code=answer.code)


def _first_word(line: str) -> str:
    match = _FIRST_WORD.match(line)
    return "" if match is None else match[0]


def _command_word(line: str) -> str:
    """Return a command's first word, with a question mark that follows it directly."""
    match = _COMMAND_WORD.match(line)
    return line if match is None else match[0]


def _one_line(row: LineRow, line: str) -> Script:
    return row.read((yield line))


@dataclass(slots=True, eq=False)
class _OpenRequest:
    """A request that is not answered yet.

    Attributes:
        row: row of the request.
        script: the request's remaining lines and answers.
        line: line to send next, or the line sent last.
        answer_word: word by which the answer to ``line`` will be recognized; None: the first word
            of ``line``.
        word: word or ticket by which the answer to the sent line is recognized.
        is_sent: whether ``line`` was sent.
        has_echo: whether the echo before the answer has come.
        lines: received lines of an answer of several lines.
        size: number of characters in ``lines``.
        question: number of the machine's own question for the application; 0 for a request of the
            client.
    """

    row: LineRow
    script: Script
    line: str
    answer_word: str | None
    word: str = ""
    is_sent: bool = False
    has_echo: bool = False
    lines: list[str] = field(default_factory=list[str])
    size: int = 0
    question: int = 0


class LineMachine:
    """One connection's lines, in the client's role, as a link needs it.

    See :class:`~smartcam.protocols.LinkMachine`. If answers do not name their request, a
    request is sent when the request before it is answered, so that the answer to a later request is
    never taken for a lost one. A line is the answer to the open request, unless a row says that the
    camera sends such a line unasked. If answers name their request, they may come in any order.

    Containers that answer a Trigger have ``requested=True``, containers that come unasked
    ``requested=False``, so that the client does not confuse them.

    Args:
        dialect: the dialect of the camera.
        role: the client's.
        transport: TCP.
        max_length: largest answer of several lines, bytes; the dialect bounds one line.
        trace: function that is called with each line in both directions, and with bytes that broke
            the protocol.
        candidates: unused, there is one dialect.

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
        candidates: Sequence[Dialect] = (),
    ) -> None:
        if role is not Role.CLIENT or transport is not Transport.TCP:
            raise ConfigurationError(f"dialect {dialect.name}: the client's side of TCP only")
        self.dialect: LineDialect = dialect
        self.candidates: Sequence[Dialect] = (dialect,)
        self.transport: Transport = transport
        self.may_reply: bool = True
        self.counters: Counters = Counters()
        self.state: State = State.IDLE
        self._trace = trace
        self._max_length = max_length
        self._reader = dialect.reader(max_length)
        self._store = memoryview(bytearray(MAX_READ_BYTES))
        self._open_requests: list[_OpenRequest] = []  # in order; at most one of each kind
        self._tickets = itertools.cycle(map(str, dialect.tickets))
        self._unasked = tuple(row for row in dialect.rows if row.request is None)
        trigger = dialect.row(m.Trigger)
        self._marks_results = trigger is not None and trigger.answer is m.ResultContainer
        self._query = None if dialect.names_application else dialect.row(m.Query)
        self._held = HeldResults()
        self._outbox: list[bytes] = []

    def adopt(self, dialect: Dialect) -> None:
        """Do nothing: there is one dialect."""

    # ------------------------------------------------------------------ bytes in

    @property
    def unfinished_bytes(self) -> bytes:
        """Copy of the bytes of an unfinished line."""
        return self._reader.unfinished_bytes

    def get_buffer(self) -> memoryview:
        """Return the buffer for the next bytes; call :meth:`buffer_updated` next."""
        return self._store

    def buffer_updated(self, count: int, now: float = 0.0) -> bool:
        """Accept ``count`` bytes that were written into :meth:`get_buffer`."""
        self.receive_data(bytes(self._store[:count]))
        return True

    def receive_data(self, data: bytes) -> None:
        """Add received bytes; call :meth:`events` next. Never raises for bad bytes."""
        if self.state in {State.FAILED, State.CLOSED}:
            return
        self.counters.bytes_received += len(data)
        self._reader.feed(data)
        try:
            while (line := self._reader.next_line()) is not None:
                self.counters.frames_received += 1
                self._trace_line(m.Sender.CAMERA, line)
                self._handle_line(line)
        except RemoteProtocolError as error:
            if self._trace is not None:
                self._trace(m.Sender.CAMERA, error)
            self._end_link(State.FAILED, LinkFailed(error=error))

    def receive_eof(self) -> None:
        """Record that the camera will send no more; call :meth:`events` next."""
        if self.state not in {State.FAILED, State.CLOSED}:
            self._end_link(State.CLOSED, LinkEnded(pending=len(self._reader)))

    def events(self) -> list[Event]:
        """Return the events since the last call, in order; the caller owns the list."""
        return self._held.take_ready()

    def _handle_line(self, line: str) -> None:
        """Handle a line; raise FrameError if it is neither an answer nor an unasked line."""
        split = self.dialect.split
        if split is None:
            request = self._open_requests[0] if self._open_requests else None
            has_begun = request is not None and (request.has_echo or request.lines)
            if not has_begun and self._report_unasked("", line):
                return
            word, text = "", line
        else:
            try:
                word, text = split(line)
            except (ValueError, LookupError) as exc:
                raise FrameError(f"{line[:64]!r} came, no answer of this dialect") from exc
            request = self._request_for_word(word) if word else None
            if request is None and self._report_unasked(word, text, by_word=True):
                return
            request = request or self._request_for_word("")
            if request is None and self._report_unasked(word, text):
                return
        if request is None:
            raise FrameError(f"{line[:64]!r} came, nothing was asked")
        self._handle_answer_line(request, text)

    def _request_for_word(self, word: str) -> _OpenRequest | None:
        """Return the request whose answer is recognized by a word."""
        return next(
            (
                request
                for request in self._open_requests
                if request.is_sent and request.word == word
            ),
            None,
        )

    def _report_unasked(self, word: str, text: str, *, by_word: bool = False) -> bool:
        """Report a line that the camera sent by itself; return False if no row has such a line.

        Args:
            word: word of the line.
            text: text of the line after the word.
            by_word: try only the rows with this word; otherwise only the rows without a word.
        """
        for row in self._unasked:
            if by_word != bool(row.answer_word) or (by_word and row.answer_word != word):
                continue
            try:
                reported = row.read(text)
            except (ValueError, LookupError):
                continue
            self._report_messages(reported, is_answer=False)
            return True
        return False

    def _handle_answer_line(self, request: _OpenRequest, text: str) -> None:
        """Handle a line of an answer; if the answer is complete, report its messages."""
        row = request.row
        if row.echo and not request.has_echo and text == row.echo:
            request.has_echo, request.word = True, ""
            return
        if row.until:
            request.lines.append(text)
            request.size += len(text) + 1
            if request.size > self._max_length:
                raise FrameError(f"an answer of more than {self._max_length} bytes came")
            if _first_word(text) not in row.until:
                return
            text = "\n".join(request.lines)
        elif row.echo and not request.has_echo and self.dialect.split is None:
            raise FrameError(f"{text[:64]!r} came, the echo {row.echo!r} was expected")
        try:
            request.line = request.script.send(text)
        except StopIteration as done:
            reported: Reported = done.value
        except (ValueError, LookupError) as exc:
            name = row.answer.__name__ if row.answer is not None else "nothing"
            raise FrameError(
                f"{text[:64]!r} came, {name} to {row.line[:32]!r} was expected"
            ) from exc
        else:
            request.is_sent = request.has_echo = False
            request.answer_word = None
            request.lines, request.size = [], 0
            if self.state in {State.CONNECTING, State.CONNECTED}:
                self._send_line(request)
            else:
                self._open_requests.remove(request)  # Disconnect was the last request
            return
        self._open_requests.remove(request)
        if row.request is m.Connect and self.state is State.CONNECTING:
            self.state = State.CONNECTED
        if request.question:
            self._note_application(reported, request.question)
        else:
            self._report_messages(reported, is_answer=row.request is m.Trigger)
        if (
            self._open_requests
            and not self._open_requests[0].is_sent
            and self.state is State.CONNECTED
        ):
            self._send_line(self._open_requests[0])

    def _report_messages(self, reported: Reported, *, is_answer: bool) -> None:
        """Report messages; note in containers whether they answer a Trigger, if that is known."""
        messages = reported if isinstance(reported, tuple) else (reported,)
        if self._marks_results:
            messages = tuple(
                replace(message, requested=is_answer)
                if isinstance(message, m.ResultContainer)
                else message
                for message in messages
            )
        if self._query is None:
            self._held.add_ready(messages)
            return
        if self._held.add(messages, answers_trigger=is_answer):
            self._ask_application()
        self._note_application(messages)

    def _note_application(self, reported: Reported, question: int = 0) -> None:
        """Record which application is active; ask again if results came after the question."""
        for message in reported if isinstance(reported, tuple) else (reported,):
            if not isinstance(message, m.QueryAnswer | m.SwitchAnswer):
                continue
            if self._held.note_application(message.application, question):
                self._ask_application()

    def _ask_application(self, *, trigger: bool = False) -> None:
        """Ask which application is active, before a trigger or after a result."""
        if self._query is None or self.state not in {State.CONNECTING, State.CONNECTED}:
            self._held.end_link()
            return
        number = self._held.add_question(trigger=trigger)
        self._start_request(self._query, m.Query(), question=number)

    def _end_link(self, state: State, event: Event) -> None:
        """Stop sending and reading; report the reason as the last event."""
        self.state = state
        self._open_requests.clear()
        self._reader = self.dialect.reader(0)
        self._held.end_link()
        self._held.add_ready((event,))

    # ------------------------------------------------------------------ messages out

    def send(
        self, message: m.Message, *, answered: bool | None = None, again: bool = False
    ) -> None:
        """Send a request, or queue it; write :meth:`data_to_send` next.

        A Get status is not queued twice, since the answer to the queued one will be new enough. If
        one was already sent, its answer may be older, so another is queued. Disconnect sends
        nothing, it ends the connection. A request without an answer is sent at once.

        Raises:
            LocalProtocolError: not in this state, or an answer of the same kind is pending.
            UnsupportedError: the dialect has no such message.
            ConfigurationError: one of its fields cannot stand in a line.
        """
        kind = type(message)
        self.dialect.message_id(kind)
        if kind is m.Disconnect:
            if self.state in {State.CONNECTING, State.CONNECTED}:
                self.state = State.DISCONNECTED
            return
        row = self.dialect.row_of(message)
        if row is None or self.state is not (State.IDLE if kind is m.Connect else State.CONNECTED):
            raise LocalProtocolError(
                f"{kind.__name__} cannot be sent by the client in state {self.state.value}"
            )
        same_kind = [
            request
            for request in self._open_requests
            if request.row.request is row.request and not request.question
        ]
        if kind is m.GetStatus:
            if not all(request.is_sent for request in same_kind):
                return
        elif same_kind:
            raise LocalProtocolError(f"the answer to a {kind.__name__} is still owed")
        if kind is m.Trigger and self._query is not None:
            self._ask_application(trigger=True)
        self._start_request(row, message)
        if kind is m.Connect:
            self.state = State.CONNECTING

    def _start_request(self, row: LineRow, message: m.Message, *, question: int = 0) -> None:
        """Send the first line of a request, or queue the request."""
        script = self.dialect.script(row, message)
        request = _OpenRequest(row, script, next(script), row.answer_word, question=question)
        if row.answer is None or self.dialect.pipelined or not self._open_requests:
            self._send_line(request)
        else:
            self.dialect.pack(request.line, "")  # if this raises, nothing has changed
        if row.answer is not None:
            self._open_requests.append(request)

    def _send_line(self, request: _OpenRequest) -> None:
        """Send the line of a request, and note the ticket or word of its answer."""
        ticket = self._next_ticket() if self.dialect.tickets else ""
        data = self.dialect.pack(request.line, ticket)
        word = request.answer_word
        request.word = ticket or (_first_word(request.line) if word is None else word)
        request.is_sent = True
        self._outbox.append(data)
        self.counters.frames_sent += 1
        self.counters.bytes_sent += len(data)
        if self._trace is not None:
            self._trace(m.Sender.CLIENT, Frame(0, data.removesuffix(self.dialect.line_end)))

    def _next_ticket(self) -> str:
        """Return a ticket that no waiting request has."""
        used = {request.word for request in self._open_requests}
        return next(ticket for ticket in self._tickets if ticket not in used)

    def data_to_send(self) -> list[bytes]:
        """Return the bytes to write, in order."""
        outbox, self._outbox = self._outbox, []
        return outbox

    def _trace_line(self, sender: m.Sender, line: str) -> None:
        if self._trace is not None:
            self._trace(sender, Frame(0, line.encode(self.dialect.encoding, "replace")))
