"""The native mode of Cognex In-Sight cameras: text over telnet.

What the library says (:mod:`smartcam.protocols.messages`) becomes command lines, one after the
other, each answered before the next is sent; what comes back becomes the library's messages. So the
client knows nothing of commands. What is known of the camera, and who says so, stands in
``docs/insight.md``.
"""

from __future__ import annotations

import collections
import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from smartcam.exceptions import (
    CommandRejectedError,
    ConfigurationError,
    FrameError,
    LocalProtocolError,
    RemoteProtocolError,
    UnsupportedError,
)
from smartcam.models import Capabilities, Status
from smartcam.protocols import messages as m
from smartcam.protocols.base import (
    Code,
    Dialect,
    Protocol,
    RawRequest,
    Role,
    Spelled,
    Transport,
    Verdict,
)
from smartcam.protocols.framing import Frame
from smartcam.protocols.insight_answers import Answer, AnswerReader
from smartcam.protocols.insight_words import (
    COMMANDS,
    DEFAULT_PORT,
    ENCODING,
    INVALID_PASSWORD,
    LAST_JOB_ID,
    LINE_END,
    LOGGED_IN,
    MAX_LINE,
    PASSWORD_PROMPT,
    TRIGGER_EVENT,
    USER_PROMPT,
    WELCOME,
    StatusCode,
    code_text,
    parse_cells,
    parse_tag,
)
from smartcam.protocols.machine import Counters, Event, LinkEnded, LinkFailed, State

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Mapping, Sequence

    Script = Generator[str, Answer, None]
    """Yields command lines and is sent their answers; what it finds out it tells as messages."""

__all__ = ["INSIGHT", "NATIVE", "Command", "InSightDialect", "InSightMachine", "Reply"]

ONLINE = Status.RUNNING | Status.WAITING_FOR_TRIGGER
"""Status of a camera that is online: an event 8 is taken. It tells no more of itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply(m.Acknowledgement):
    """The answer to a :class:`Command`: its code, and the data behind it."""

    line: str
    data: bytes = b""


@dataclass(frozen=True, slots=True, kw_only=True)
class Command(m.Request):
    """A command line of any kind that the library knows the answer's form of."""

    answer: ClassVar[type[m.Message] | None] = Reply

    line: str


_VERDICTS: Mapping[int, Verdict] = {
    StatusCode.DONE: Verdict.DONE,
    StatusCode.UNRECOGNIZED: Verdict.UNKNOWN,
}
"""What codes say; the others refuse."""

_LOGIN = Code("the user or the password is wrong", Verdict.REFUSED)

_MNEMONICS: Mapping[type[m.Message], str] = {
    m.GetStatus: "GO",
    m.Query: "GJ",
    m.SwitchApplication: "SJ",
    m.LoadFile: "LF",
    m.Start: "SO",
    m.Stop: "SO",
    m.Trigger: "SW",
    m.ReadImage: "RB",
}
"""The command behind each of the library's requests."""

_REQUESTS = frozenset({m.Connect, m.Disconnect, Command, *_MNEMONICS})
_REPORTS = frozenset(
    {m.ResultContainer, *(one.answer for one in _REQUESTS if issubclass(one, m.Request))}
) - {None}


@dataclass(frozen=True, kw_only=True, eq=False)
class InSightDialect(Dialect):
    """In-Sight native mode.

    Args:
        name: as in ``?dialect=``.
        about: one line for people.
        source: where it is described, with its grade.
        user: who logs in.
        password: the user's.
        cells: cells that are read after each trigger, in order, as commands name them.
    """

    user: str = "admin"
    password: str = ""
    cells: tuple[str, ...] = ()

    def with_parameters(self, parameters: Mapping[str, str]) -> InSightDialect:
        """Return the dialect with user, password and cells of a URL.

        Raises:
            ConfigurationError: a cell is none, or a text cannot be sent.
        """
        for key in ("user", "password"):
            text = parameters.get(key, "")
            if any(char in text for char in "\r\n\0") or len(text) > 255:
                raise ConfigurationError(f"{key}: no line ends, at most 255 characters")
        return replace(
            self,
            user=parameters.get("user", self.user),
            password=parameters.get("password", self.password),
            cells=tuple(_cell_names(parameters.get("cells", ""))),
        )

    @property
    def capabilities(self) -> Capabilities:
        """What a camera can do in it."""
        return Capabilities(
            dialect=self.name,
            switch=True,
            load_file=True,
            start_stop=True,
            result_codes=True,
            get_status=True,
            read_image=True,
        )

    @property
    def application_ids(self) -> range:
        """Ids of jobs: 0 to 999 (published)."""
        return range(LAST_JOB_ID + 1)

    @property
    def in_order(self) -> bool:
        """A connection's commands are done one after the other."""
        return True

    def code(self, code: int, request: type[m.Message] | None = None) -> Code:
        """Return what a status code means in the answer to a request."""
        if request is m.Connect and code != StatusCode.DONE:
            return _LOGIN
        verdicts: dict[int, Verdict] = {
            StatusCode.DONE: Verdict.DONE,
            StatusCode.UNRECOGNIZED: Verdict.UNKNOWN,
        }
        mnemonic = _MNEMONICS.get(request, "") if request is not None else ""
        return Code(code_text(mnemonic, code), verdicts.get(code, Verdict.REFUSED))

    def has(self, message_type: type[m.Message]) -> bool:
        """Whether there is such a message."""
        return message_type in _REQUESTS or message_type in _REPORTS

    def message_id(self, message: m.Message | type[m.Message]) -> int:
        """Return 0: commands have no numbers.

        Raises:
            UnsupportedError: it has no such message.
        """
        kind = message if isinstance(message, type) else type(message)
        if not self.has(kind):
            raise self.unsupported(kind)
        return 0

    def spell(self, sender: m.Sender, frame: Frame) -> Spelled:
        """Return a line in words."""
        what = "command" if sender is m.Sender.CLIENT else "line"
        text = frame.payload.decode(ENCODING)
        return Spelled(None, what, {"text": text}, frame.payload + LINE_END)

    def raw_request(self, message_id: int | str, payload: bytes) -> RawRequest:
        """Return a command of one's own, such as ``GVA001``; the payload stands behind it.

        Raises:
            UnsupportedError: the form of its answer is not known.
            ConfigurationError: it is no line.
        """
        line = f"{message_id}{payload.decode(ENCODING)}"
        known = ", ".join(COMMANDS)
        if not isinstance(message_id, str) or line[:2].upper() not in COMMANDS:
            raise UnsupportedError(
                f"dialect {self.name}: {line[:32]!r} begins with no command that is known: {known}"
            )
        return RawRequest(Command(line=_line(line)), Reply, answered=True, known=True)

    def body(self, answer: m.Message) -> bytes:
        """Return the data behind the code.

        Raises:
            CommandRejectedError: the code says that the command was not done.
        """
        if not isinstance(answer, Reply):
            raise LocalProtocolError(f"{type(answer).__name__} is no answer to a command")
        if answer.code != StatusCode.DONE:
            raise CommandRejectedError(
                f"{answer.line}: the camera answered {answer.code}: "
                f"{code_text(answer.line, answer.code)}",
                code=answer.code,
            )
        return answer.data


def _cell_names(text: str) -> list[str]:
    """Return the cells that a URL names, as commands name them.

    Raises:
        ConfigurationError: one is neither a cell, a range, nor a name.
    """
    names: list[str] = []
    for part in filter(None, (one.strip() for one in text.split(","))):
        if part[1:2].isdigit():
            names += [cell.wire for cell in parse_cells(part)]
        else:
            parse_tag(part)
            names.append(part)
    return names


def _line(text: str) -> str:
    """Return a command line that can be sent.

    Raises:
        ConfigurationError: it cannot.
    """
    try:
        raw = text.encode(ENCODING)
    except UnicodeEncodeError as exc:
        raise ConfigurationError(f"the command {text[:64]!r} is not Latin-1: {exc}") from exc
    if len(raw) > MAX_LINE or any(end in text for end in "\r\n\0"):
        raise ConfigurationError(
            f"the command {text[:64]!r} is no line: no line ends, at most {MAX_LINE} bytes"
        )
    return text


class _Job(NamedTuple):
    """A request under way, or in line."""

    kind: type[m.Message]
    script: Generator[str, Answer, None]


class InSightMachine:
    """One connection's native mode, in the client's role; what a link needs (LinkMachine).

    Args:
        dialect: user, password and cells.
        role: the client's.
        transport: TCP.
        max_length: longest data of an answer, bytes.
        trace: called with each line in both directions, the password left out.
        kin: unused, there is one dialect.
    """

    def __init__(
        self,
        dialect: InSightDialect,
        role: Role,
        transport: Transport,
        *,
        max_length: int,
        trace: Callable[[m.Sender, Frame | RemoteProtocolError], None] | None = None,
        kin: Sequence[Dialect] = (),
    ) -> None:
        if role is not Role.CLIENT or transport is not Transport.TCP:
            raise ConfigurationError("In-Sight native mode: the client's side of TCP only")
        self.dialect: InSightDialect = dialect
        self.kin: Sequence[Dialect] = (dialect,)
        self.transport: Transport = transport
        self.replies: bool = True
        self.counters: Counters = Counters()
        self.state: State = State.IDLE
        self._trace = trace
        self._reader = AnswerReader(max_length=max_length, on_line=self._on_line)
        self._store = memoryview(bytearray(MAX_LINE))
        self._events: list[Event] = []
        self._outbox: list[bytes] = []
        self._login: Iterator[None] = iter(())
        self._waiting: collections.deque[_Job] = collections.deque()
        self._job: _Job | None = None
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
        """There is one dialect."""

    # ------------------------------------------------------------------ bytes in

    def room(self) -> memoryview:
        """Return where the next bytes may be written; call :meth:`filled` next."""
        return self._store

    def filled(self, count: int) -> bool:
        """Take ``count`` bytes that were written into :meth:`room`."""
        self.receive_data(bytes(self._store[:count]))
        return True

    def receive_data(self, data: bytes) -> None:
        """Take bytes; call :meth:`events` next. Never raises for what is in them."""
        if self.state in {State.FAILED, State.CLOSED}:
            return
        self.counters.bytes_received += len(data)
        self._reader.lines.feed(data)
        self._read()

    def receive_eof(self) -> None:
        """The camera will send no more; call :meth:`events` next."""
        if self.state not in {State.FAILED, State.CLOSED}:
            self._events.append(LinkEnded(pending=len(self._reader.lines)))
            self.state = State.CLOSED

    def events(self) -> list[Event]:
        """Return what came since the last call, in order; the caller owns the list."""
        events, self._events = self._events, []
        return events

    def _read(self) -> None:
        try:
            if self.state is State.CONNECTING:
                next(self._login, None)
            if self.state in {State.CONNECTED, State.DISCONNECTED}:
                self._read_answers()
            elif len(self._reader.lines) > 2 * MAX_LINE:
                raise FrameError(f"more than {2 * MAX_LINE} bytes came before the login")
        except RemoteProtocolError as error:
            self._fail(error)

    def _read_answers(self) -> None:
        while self._job is not None:
            answer = self._reader.next_answer()
            if answer is None:
                return
            self._go_on(self._job, answer)
        line = self._reader.next_line()
        if line is not None and self.state is State.CONNECTED:
            raise FrameError(f"{line[:64]!r} came, nothing was asked", data=line.encode(ENCODING))

    def _fail(self, error: RemoteProtocolError) -> None:
        self.state = State.FAILED
        self._job = None
        self._waiting.clear()
        if self._trace is not None:
            self._trace(m.Sender.CAMERA, error)
        self._events.append(LinkFailed(error=error))

    def _on_line(self, line: str) -> None:
        self.counters.frames_received += 1
        if self._trace is not None:
            self._trace(m.Sender.CAMERA, Frame(0, line.encode(ENCODING)))

    # ------------------------------------------------------------------ messages out

    def send(self, message: m.Message, *, answered: bool | None = None) -> None:
        """Put a request in line; write :meth:`data_to_send` next.

        A Get status that is in line already is not repeated: its answer is new enough.

        Raises:
            LocalProtocolError: there is no session, or an answer of the same kind is still owed.
            UnsupportedError: the dialect has no such message.
        """
        kind = type(message)
        self.dialect.message_id(kind)
        if kind is m.Connect:
            self._connect()
        elif kind is m.Disconnect:
            if self.state in {State.CONNECTING, State.CONNECTED}:
                self.state = State.DISCONNECTED
        elif self.state is not State.CONNECTED:
            raise LocalProtocolError(
                f"{kind.__name__} cannot be sent in state {self.state.value}: nobody is logged in"
            )
        elif any(job.kind is kind for job in (self._job, *self._waiting) if job is not None):
            if kind is not m.GetStatus:
                raise LocalProtocolError(f"the answer to a {kind.__name__} is still owed")
        else:
            self._waiting.append(_Job(kind, self._scripts[kind](message)))
            self._begin_next()

    def data_to_send(self) -> list[bytes]:
        """Return what is to be written, in order."""
        outbox, self._outbox = self._outbox, []
        return outbox

    def _write(self, line: str, shown: str | None = None) -> None:
        data = line.encode(ENCODING, "replace") + LINE_END
        self._outbox.append(data)
        self.counters.frames_sent += 1
        self.counters.bytes_sent += len(data)
        if self._trace is not None:
            text = line if shown is None else shown
            self._trace(m.Sender.CLIENT, Frame(0, text.encode(ENCODING, "replace")))

    # ------------------------------------------------------------------ login

    def _connect(self) -> None:
        if self.state is not State.IDLE:
            raise LocalProtocolError(f"Connect cannot be sent in state {self.state.value}")
        self.state = State.CONNECTING
        self._login = self._log_in()
        self._read()

    def _log_in(self) -> Iterator[None]:
        """Answer the prompts; the greeting differs from model to model."""
        lines = self._reader.lines
        for prompt, line, shown in (
            (USER_PROMPT, self.dialect.user, None),
            (PASSWORD_PROMPT, self.dialect.password, "***"),
        ):
            while not lines.take_prompt(prompt):
                yield from self._greeting()
            self._write(line, shown)
        said = ""
        while not said:  # a camera may also refuse by asking again
            answer = self._reader.next_line()
            if lines.take_prompt(USER_PROMPT):
                answer = INVALID_PASSWORD
            if answer is None:
                yield
            else:
                said = answer.strip()
        done = said == LOGGED_IN
        if not done and said != INVALID_PASSWORD:
            raise FrameError(f"{said[:64]!r} came, the answer to a login was expected")
        self.state = State.CONNECTED
        code = StatusCode.DONE if done else StatusCode.NO_ACCESS
        self._events.append(m.ConnectAnswer(code=code, version=1))

    def _greeting(self) -> Iterator[None]:
        said = self._reader.next_line()
        if said is None:
            yield
        elif said.strip() and not said.startswith(WELCOME):
            raise FrameError(
                f"{said[:64]!r} came, the greeting of an In-Sight camera was expected",
                data=said.encode(ENCODING),
            )

    # ------------------------------------------------------------------ scripts

    def _begin_next(self) -> None:
        while self._job is None and self._waiting:
            self._job = self._waiting.popleft()
            self._go_on(self._job, None)

    def _go_on(self, job: _Job, answer: Answer | None) -> None:
        """Let a script take an answer; write its next line, or begin the next script."""
        try:
            line = next(job.script) if answer is None else job.script.send(answer)
        except StopIteration:
            self._job = None
            self._begin_next()
            return
        self._reader.expect(COMMANDS[line[:2].upper()].form)
        self._write(line)

    def _tell(self, message: m.Message) -> None:
        self._events.append(message)

    def _get_status(self, message: m.Message) -> Script:
        online = (yield "GO").text.strip()
        if online not in {"0", "1"}:
            raise FrameError(f"{online[:64]!r} came, 0 (offline) or 1 (online) was expected")
        self._tell(m.StatusReport(status=ONLINE if online == "1" else Status(0)))

    def _name_job(self) -> Generator[str, Answer, tuple[int, int]]:
        """Return a code and the active job's id; one without an id has none, and that is fine."""
        code, text, _ = yield "GJ"
        if code == StatusCode.DONE:
            if not text.strip().isdecimal():
                raise FrameError(f"{text[:64]!r} came, the id of a job was expected")
            return code, int(text)
        return StatusCode.DONE if code == StatusCode.FAILED else code, m.UNNAMED_APPLICATION

    def _query(self, message: m.Message) -> Script:
        code, job = yield from self._name_job()
        self._tell(m.QueryAnswer(code=code, application=job))

    def _load_id(self, message: m.SwitchApplication) -> Script:
        yield from self._load(f"SJ{message.application}")

    def _load_file(self, message: m.LoadFile) -> Script:
        yield from self._load(_line("LF" + message.name.decode(errors="replace")))

    def _load(self, command: str) -> Script:
        code = (yield command).code
        _, job = yield from self._name_job()
        self._tell(m.SwitchAnswer(code=code, application=job))

    def _start(self, message: m.Message) -> Script:
        self._tell(m.StartAnswer(code=(yield "SO1").code))

    def _stop(self, message: m.Message) -> Script:
        self._tell(m.StopAnswer(code=(yield "SO0").code))

    def _trigger(self, message: m.Message) -> Script:
        """Trigger, and when the cells are up to date, read them."""
        code = (yield f"SW{TRIGGER_EVENT}").code
        self._tell(m.TriggerAnswer(code=code))
        if code != StatusCode.DONE:
            return
        _, job = yield from self._name_job()
        cells: list[m.CellValue] = []
        for cell in self.dialect.cells:
            answer = yield f"GV{cell}"
            done = answer.code == StatusCode.DONE
            cells.append(m.CellValue(cell, answer.text if done else None))
        data = json.dumps(dict(cells)).encode()
        self._tell(m.ResultContainer(application=job, data=data, cells=tuple(cells)))

    def _read_image(self, message: m.Message) -> Script:
        answer = yield "RI"
        if answer.code == StatusCode.UNRECOGNIZED:
            answer = yield "RB"
        self._tell(m.Image(code=answer.code, data=answer.data))

    def _command(self, message: Command) -> Script:
        answer = yield message.line
        data = answer.data or answer.text.encode(ENCODING)
        self._tell(Reply(line=message.line, code=answer.code, data=data))


NATIVE = InSightDialect(
    name="native",
    about="native mode: text over telnet; ?cells= names what is read after a trigger",
    source="docs/insight.md, published and derived",
)

INSIGHT = Protocol(
    name="insight",
    schemes={"insight": Transport.TCP},
    default_port=DEFAULT_PORT,
    models=("IN-SIGHT",),
    dialects={NATIVE.name: NATIVE},
    machine=InSightMachine,
    parameters={
        "user": "who logs in; default admin",
        "password": "the user's; default none",
        "cells": "cells that are a result's values, such as B2,C2,D4:F6",
    },
)
"""What the entry point ``insight`` gives."""
