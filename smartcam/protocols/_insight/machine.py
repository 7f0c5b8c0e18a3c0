"""The state machine of one connection to an In-Sight camera: the client's side of native mode.

Answers do not name their command, so a command is sent when the command before it is answered. Each
request of the library has a script, a generator method of :class:`InSightMachine`. The script
yields its commands one after the other, and makes messages of the answers.
"""

from __future__ import annotations

import collections
import enum
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from smartcam.exceptions import (
    ConfigurationError,
    FrameError,
    LocalProtocolError,
    RemoteProtocolError,
)
from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.protocols._base import Dialect, Role, Transport
from smartcam.protocols._insight.answers import AnswerReader, CommandAnswer, unexpected_line_error
from smartcam.protocols._insight.words import (
    COMMANDS,
    ENCODING,
    ERROR_VALUE,
    INVALID_PASSWORD,
    LAST_JOB_ID,
    LINE_END,
    LOGGED_IN,
    MAX_LINE_BYTES,
    PASSWORD_PROMPT,
    TRIGGER_EVENT,
    USER_PROMPT,
    WELCOME,
    StatusCode,
)
from smartcam.protocols._machine import Counters, Event, Frame, LinkEnded, LinkFailed, State

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Sequence

    from smartcam.protocols._insight.dialect import InSightDialect

    Script = Generator[str, CommandAnswer, None]
    """Yields command lines and receives their answers, which become messages."""

ONLINE = Status.RUNNING | Status.WAITING_FOR_TRIGGER
"""Status of a camera that is online and accepts event 8; the camera reports no other bits."""

MAX_READ_BYTES = 1 << 15
"""Largest number of bytes that one read takes."""


class Piece(enum.IntEnum):
    """The kind of a frame in a trace, in place of a message id."""

    LINE = 0
    """A line, without its end."""
    TEXT = 1
    """Bytes without a line end: a prompt, or a counted text."""
    PASSWORD = 2
    """The line with the password, which is not shown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply(m.Acknowledgement):
    """The answer to a :class:`Command`: its code, and the data after it."""

    line: str
    data: bytes = b""


@dataclass(frozen=True, slots=True, kw_only=True)
class Command(m.Request):
    """A command line of any kind whose answer has a known form.

    Raises:
        ConfigurationError: the line is not valid, or it cannot be sent.
    """

    answer: ClassVar[type[m.Message] | None] = Reply

    line: str

    def __post_init__(self) -> None:
        problem = unsendable_reason(self.line, MAX_LINE_BYTES)
        if problem is None and self.line[:2].upper() not in COMMANDS:
            problem = f"it begins with none of {', '.join(COMMANDS)}"
        if problem is not None:
            raise ConfigurationError(f"command {self.line[:64]!r}: {problem}")


def unsendable_reason(text: str, limit: int) -> str | None:
    """Return the reason why a text cannot be a line of ``limit`` bytes, None if it can."""
    if not all(ord(char) < 256 and char not in "\r\n\0" for char in text):
        return "only Latin-1 without line ends can be sent"
    return None if len(text) <= limit else f"at most {limit} bytes can be sent"


class _PendingRequest(NamedTuple):
    """A request whose script runs, or that waits for its turn."""

    kind: type[m.Message]
    script: Script


class InSightMachine:
    """One connection in native mode, in the client's role, as a link needs it.

    See :class:`~smartcam.protocols.LinkMachine`. An answer belongs to the command before it. A line
    that no command asked for ends the link.

    Args:
        dialect: user, password and cells.
        role: the client's.
        transport: TCP.
        max_length: longest data of an answer, bytes; an image may have 64 MiB.
        trace: function that is called with each piece in both directions, see :class:`Piece`, and
            with the error of bytes that broke the protocol; never with the password.
        candidates: unused, there is one dialect.

    Raises:
        ConfigurationError: another role or transport.
    """

    def __init__(
        self,
        dialect: InSightDialect,
        role: Role,
        transport: Transport,
        *,
        max_length: int,
        trace: Callable[[m.Sender, Frame | RemoteProtocolError], None] | None = None,
        candidates: Sequence[Dialect] = (),
    ) -> None:
        if role is not Role.CLIENT or transport is not Transport.TCP:
            raise ConfigurationError("In-Sight native mode: the client's side of TCP only")
        self.dialect: InSightDialect = dialect
        self.candidates: Sequence[Dialect] = (dialect,)
        self.transport: Transport = transport
        self.may_reply: bool = True
        self.counters: Counters = Counters()
        self.state: State = State.IDLE
        self._trace = trace
        self._reader = AnswerReader(max_length=max_length, on_pieces=self._on_pieces)
        self._store = memoryview(bytearray(MAX_READ_BYTES))
        self._events: list[Event] = []
        self._outbox: list[bytes] = []
        self._login: Iterator[None] = iter(())
        self._queued_requests: collections.deque[_PendingRequest] = (
            collections.deque()
        )  # at most one of each kind
        self._running_request: _PendingRequest | None = None
        self._scripts: dict[type[m.Message], Callable[[Any], Script]] = {
            m.GetStatus: self._get_status,
            m.Query: self._query,
            m.SwitchApplication: self._load_id,
            m.LoadFile: self._load_file,
            m.Start: self._start,
            m.Stop: self._stop,
            m.Trigger: self._trigger,
            m.ReadImage: self._read_image,
            Command: self._command,
        }

    def adopt(self, dialect: Dialect) -> None:
        """Do nothing: there is one dialect."""

    # ------------------------------------------------------------------ bytes in

    @property
    def buffered(self) -> int:
        """Bytes of an unfinished line, or of a counted text."""
        return len(self._reader)

    @property
    def unfinished_bytes(self) -> bytes:
        """Copy of the bytes of an unfinished line or text."""
        return self._reader.unfinished_bytes

    def get_buffer(self) -> memoryview:
        """Return the buffer for the next bytes; call :meth:`buffer_updated` next."""
        return self._store

    def buffer_updated(self, count: int, now: float = 0.0) -> bool:
        """Accept ``count`` bytes that were written into :meth:`get_buffer`."""
        self.receive_data(bytes(self._store[:count]))
        return True

    def receive_data(self, data: bytes) -> None:
        """Add received bytes; call :meth:`events` next. Never raises for bad bytes.

        After Disconnect, and in state FAILED or CLOSED, they are dropped.
        """
        if self.state in {State.FAILED, State.CLOSED}:
            return
        self.counters.bytes_received += len(data)
        if self.state is not State.DISCONNECTED:
            self._reader.feed(data)
            self._read()

    def receive_eof(self) -> None:
        """Record that the camera will send no more; call :meth:`events` next."""
        if self.state in {State.FAILED, State.CLOSED}:
            return
        self._events.append(LinkEnded(pending=self.buffered))
        self._end_link(State.CLOSED)

    def events(self) -> list[Event]:
        """Return the events since the last call, in order; the caller owns the list."""
        events, self._events = self._events, []
        return events

    def _read(self) -> None:
        try:
            if self.state is State.CONNECTING:
                next(self._login, None)
            if self.state is State.CONNECTED:
                self._read_answers()
            elif self.buffered > 2 * MAX_LINE_BYTES:
                raise FrameError(f"more than {2 * MAX_LINE_BYTES} bytes came before the login")
        except RemoteProtocolError as error:
            if self._trace is not None:
                self._trace(m.Sender.CAMERA, error)
            self._events.append(LinkFailed(error=error))
            self._end_link(State.FAILED)

    def _read_answers(self) -> None:
        while self._running_request is not None:
            answer = self._reader.next_answer()
            if answer is None:
                return
            self._advance_script(self._running_request, answer)
        line = self._reader.next_line()
        if line is not None:
            raise FrameError(f"{line[:64]!r} came, nothing was asked", data=line.encode(ENCODING))

    def _end_link(self, state: State) -> None:
        """Stop sending and reading."""
        self.state = state
        self._running_request = None
        self._queued_requests.clear()
        self._reader = AnswerReader(max_length=0, on_pieces=self._on_pieces)

    def _on_pieces(self, pieces: Sequence[bytes], has_line_end: bool) -> None:
        self.counters.frames_received += len(pieces)
        if self._trace is not None:
            kind = Piece.LINE if has_line_end else Piece.TEXT
            for piece in pieces:
                self._trace(m.Sender.CAMERA, Frame(kind, piece))

    # ------------------------------------------------------------------ messages out

    def send(
        self, message: m.Message, *, answered: bool | None = None, again: bool = False
    ) -> None:
        """Queue a request; write :meth:`data_to_send` next.

        A Get status is not queued twice, since the answer to the queued one will be new enough. If
        one was already sent, its answer may be older, so another is queued. Disconnect sends
        nothing: the connection ends, and waiting requests are dropped.

        Raises:
            LocalProtocolError: there is no session, or an answer of the same kind is pending.
            UnsupportedError: the dialect has no such message.
            ConfigurationError: a file's name cannot be sent.
        """
        kind = type(message)
        self.dialect.message_id(kind)
        if kind is m.Connect:
            self._connect()
        elif kind is m.Disconnect:
            if self.state in {State.CONNECTING, State.CONNECTED}:
                self._end_link(State.DISCONNECTED)
        elif self.state is not State.CONNECTED or kind not in self._scripts:
            raise LocalProtocolError(
                f"{kind.__name__} cannot be sent by the client in state {self.state.value}"
            )
        else:
            is_queued = kind in {request.kind for request in self._queued_requests}
            is_running = self._running_request is not None and self._running_request.kind is kind
            if kind is not m.GetStatus and (is_queued or is_running):
                raise LocalProtocolError(f"the answer to a {kind.__name__} is still owed")
            if not is_queued:
                self._queued_requests.append(_PendingRequest(kind, self._scripts[kind](message)))
                self._start_next_request()

    def data_to_send(self) -> list[bytes]:
        """Return the bytes to write, in order."""
        outbox, self._outbox = self._outbox, []
        return outbox

    def _write(self, line: str, kind: Piece = Piece.LINE) -> None:
        data = line.encode(ENCODING)
        self._outbox.append(data + LINE_END)
        self.counters.frames_sent += 1
        self.counters.bytes_sent += len(data) + len(LINE_END)
        if self._trace is not None:
            self._trace(m.Sender.CLIENT, Frame(kind, b"" if kind is Piece.PASSWORD else data))

    # ------------------------------------------------------------------ login

    def _connect(self) -> None:
        if self.state is not State.IDLE:
            raise LocalProtocolError(f"Connect cannot be sent in state {self.state.value}")
        self.state = State.CONNECTING
        self._login = self._log_in()
        self._read()  # the greeting may have come already

    def _log_in(self) -> Iterator[None]:
        """Answer each prompt once, and read whether the camera accepts the login.

        The greeting differs from model to model. A camera that repeats a prompt has refused the
        login.
        """
        prompts = {
            USER_PROMPT: (self.dialect.user, Piece.LINE),
            PASSWORD_PROMPT: (self.dialect.password, Piece.PASSWORD),
        }
        while True:
            prompt = next(filter(self._reader.take_prompt, (USER_PROMPT, PASSWORD_PROMPT)), None)
            if prompt in prompts:
                self._write(*prompts.pop(prompt))
                continue
            line = INVALID_PASSWORD if prompt is not None else self._reader.next_line()
            line_text = "" if line is None else line.strip()
            if line_text in {LOGGED_IN, INVALID_PASSWORD}:
                code = StatusCode.DONE if line_text == LOGGED_IN else StatusCode.NO_ACCESS
                self.state = State.CONNECTED
                self._report(m.ConnectAnswer(code=code, version=1))
                return
            if line is None:
                yield
            elif line_text and not line_text.startswith(WELCOME):
                raise unexpected_line_error(
                    line_text, "the greeting or the login of an In-Sight camera"
                )

    # ------------------------------------------------------------------ scripts

    def _start_next_request(self) -> None:
        while self._running_request is None and self._queued_requests:
            self._running_request = self._queued_requests.popleft()
            self._advance_script(self._running_request, None)

    def _advance_script(self, request: _PendingRequest, answer: CommandAnswer | None) -> None:
        """Pass an answer to a script, and write its next line or start the next request."""
        try:
            line = next(request.script) if answer is None else request.script.send(answer)
        except StopIteration:
            self._running_request = None
            self._start_next_request()
            return
        self._reader.expect(COMMANDS[line[:2].upper()].form)
        self._write(line)

    def _report(self, message: m.Message) -> None:
        # not a local name for the list: events() replaces it while a script waits
        self._events.append(message)

    def _get_status(self, _message: m.Message | None = None) -> Script:
        answer_text = (yield "GO").text.strip()
        if answer_text not in {"0", "1"}:
            raise unexpected_line_error(answer_text, "0 (offline) or 1 (online)")
        self._report(m.StatusReport(status=ONLINE if answer_text == "1" else Status(0)))

    def _read_job_id(self) -> Generator[str, CommandAnswer, int]:
        """Return the active job's id.

        For a job without a name, or without a number in its name, return UNNAMED_APPLICATION.
        """
        code, text, _ = yield "GJ"
        if code != StatusCode.DONE:
            return m.UNNAMED_APPLICATION
        number = text.strip()
        if not number.isdecimal() or len(number) > 9 or int(number) > LAST_JOB_ID:
            raise unexpected_line_error(number, "the id of a job")
        return int(number)

    def _query(self, _message: m.Message) -> Script:
        job = yield from self._read_job_id()
        self._report(m.QueryAnswer(code=StatusCode.DONE, application=job))

    def _load_id(self, message: m.SwitchApplication) -> Script:
        return self._load(Command(line=f"SJ{message.application}"))

    def _load_file(self, message: m.LoadFile) -> Script:
        return self._load(Command(line="LF" + message.name.decode(errors="replace")))

    def _load(self, command: Command) -> Script:
        code = (yield command.line).code
        job = yield from self._read_job_id()
        self._report(m.SwitchAnswer(code=code, application=job))

    def _start(self, _message: m.Message) -> Script:
        self._report(m.StartAnswer(code=(yield "SO1").code))

    def _stop(self, _message: m.Message) -> Script:
        self._report(m.StopAnswer(code=(yield "SO0").code))

    def _trigger(self, _message: m.Message) -> Script:
        """Trigger, wait until the cells are up to date, and read them.

        If the camera did not accept the trigger, its status, which may show the reason, is
        reported before the answer.
        """
        code = (yield f"SW{TRIGGER_EVENT}").code
        if code == StatusCode.FAILED:
            yield from self._get_status()
        self._report(m.TriggerAnswer(code=code))
        if code != StatusCode.DONE:
            return
        job = yield from self._read_job_id()
        counter = self.dialect.counter
        before = (yield from self._read_value(counter)) if counter else None
        values: dict[str, str | None] = {}
        for cell in self.dialect.cells:
            values[cell] = yield from self._read_value(cell)
        after = (yield from self._read_value(counter)) if counter else None
        cells = [
            m.CellValue(cell, None if values[cell] == ERROR_VALUE else values[cell])
            for cell in self.dialect.cells
        ]
        fault, last_job = None, (yield from self._read_job_id()) if cells else job
        if last_job != job:
            fault = f"job {last_job} was loaded while the cells of job {job} were read"
        elif before != after:
            fault = (
                f"cell {counter}, which counts runs, went from {before} to {after} while the cells "
                "were read: they may be of more than one run"
            )
        self._report(
            m.ResultContainer(
                application=job,
                data=json.dumps(values).encode(),
                cells=tuple(cells),
                fault=fault,
            )
        )

    def _read_value(self, cell: str) -> Generator[str, CommandAnswer, str | None]:
        """Return a cell's text, None for one that is empty or does not exist."""
        answer = yield f"GV{cell}"
        return answer.text if answer.code == StatusCode.DONE else None

    def _read_image(self, _message: m.Message) -> Script:
        answer = yield "RI"
        if answer.code == StatusCode.UNRECOGNIZED:
            answer = yield "RB"
        self._report(m.Image(code=answer.code, data=answer.data))

    def _command(self, message: Command) -> Script:
        answer = yield message.line
        data = answer.data or answer.text.encode(ENCODING)
        self._report(Reply(line=message.line, code=answer.code, data=data))
