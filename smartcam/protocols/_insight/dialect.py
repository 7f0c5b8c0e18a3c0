"""Define the dialect for the native mode of Cognex In-Sight cameras: text over telnet.

The library's messages (:mod:`smartcam.protocols.messages`) become command lines, of which each is
answered before the next is sent; the answers become the library's messages. So the client knows
nothing of commands. The facts about the camera, with their sources, stand in ``docs/insight.md``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

from smartcam.exceptions import (
    CommandRejectedError,
    ConfigurationError,
    LocalProtocolError,
    UnsupportedError,
)
from smartcam.models import Capabilities
from smartcam.protocols import messages as m
from smartcam.protocols._base import (
    CodeMeaning,
    Dialect,
    Protocol,
    RawRequest,
    ReadableFrame,
    Transport,
    Verdict,
)
from smartcam.protocols._insight.machine import (
    Command,
    InSightMachine,
    Piece,
    Reply,
    unsendable_reason,
)
from smartcam.protocols._insight.words import (
    COMMANDS,
    DEFAULT_PORT,
    ENCODING,
    LAST_JOB_ID,
    LINE_END,
    MAX_CELLS,
    WELCOME,
    StatusCode,
    code_text,
    parse_cells,
    parse_tag,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.protocols._machine import Frame

MAX_LOGIN_CHARACTERS = 255
"""Largest number of characters of a user's name or password; the camera's own bound is not
published."""

_VERDICTS: Mapping[int, Verdict] = {
    StatusCode.DONE: Verdict.DONE,
    StatusCode.UNRECOGNIZED: Verdict.UNKNOWN,
}
"""Verdicts by status code; any other code is a refusal."""

_WRONG_LOGIN = CodeMeaning("the user or the password is wrong", Verdict.REFUSED)

_MNEMONICS: Mapping[type[m.Message], str] = {
    m.GetStatus: "GO",
    m.Query: "GJ",
    m.SwitchApplication: "SJ",
    m.LoadFile: "LF",
    m.Start: "SO",
    m.Stop: "SO",
    m.Trigger: "SW",
    m.ReadImage: "RI",
}
"""The command for each of the library's requests."""

_REQUESTS = frozenset({m.Connect, m.Disconnect, Command, *_MNEMONICS})
_REPORTS = frozenset(
    {
        m.ResultContainer,
        *(request.answer for request in _REQUESTS if issubclass(request, m.Request)),
    }
) - {None}


@dataclass(frozen=True, kw_only=True, eq=False)
class InSightDialect(Dialect):
    """In-Sight native mode.

    Args:
        name, about, source, quirks: as for :class:`~smartcam.protocols.Dialect`.
        user: name of the user to log in.
        password: password of that user.
        cells: cells that are read after each trigger, in order, as commands name them.
        counter: a cell that counts runs; it is read before and after ``cells``. "" for none.
    """

    user: str = "admin"
    password: str = field(default="", repr=False)
    cells: tuple[str, ...] = ()
    counter: str = ""

    results_are_attributable: ClassVar[bool] = True
    exclusive: ClassVar[bool] = False  # several users may be connected at a time (published)
    has_login: ClassVar[bool] = True

    def with_parameters(self, parameters: Mapping[str, str]) -> InSightDialect:
        """Return the dialect with user, password, cells and counter of a URL.

        Raises ConfigurationError: a cell is not valid, or a text cannot be sent.
        """
        for key in ("user", "password"):
            problem = unsendable_reason(parameters.get(key, ""), MAX_LOGIN_CHARACTERS)
            if problem is not None:
                raise ConfigurationError(f"{key}: {problem}")
        counter = _cell_names(parameters.get("counter", ""))
        if len(counter) > 1:
            raise ConfigurationError(f"counter: one cell, not {len(counter)}")
        return replace(
            self,
            user=parameters.get("user", self.user),
            password=parameters.get("password", self.password),
            cells=tuple(_cell_names(parameters.get("cells", ""))),
            counter="".join(counter),
        )

    @property
    def remark(self) -> str:
        """Text for users: a result is empty if no cells are named."""
        if self.cells:
            return ""
        return "no cells are asked for, so results are empty; ?cells=B2,C2 in the URL names some"

    @property
    def capabilities(self) -> Capabilities:
        """Abilities of a camera in this dialect."""
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

    def code(self, code: int, request: type[m.Message] | None = None) -> CodeMeaning:
        """Return the meaning of a status code in the answer to a request."""
        if request is m.Connect and code != StatusCode.DONE:
            return _WRONG_LOGIN
        mnemonic = _MNEMONICS.get(request, "") if request is not None else ""
        return CodeMeaning(code_text(mnemonic, code), _VERDICTS.get(code, Verdict.REFUSED))

    def has(self, message_type: type[m.Message]) -> bool:
        """Return True if the dialect has a message of this type."""
        return message_type in _REQUESTS or message_type in _REPORTS

    def message_id(self, message: m.Message | type[m.Message]) -> int:
        """Return 0, since commands have no ids; raise UnsupportedError without such a message."""
        kind = message if isinstance(message, type) else type(message)
        if not self.has(kind):
            raise self.unsupported(kind)
        return 0

    def message_label(self, message: m.Message) -> str:
        """Return a message's name for errors, with its command."""
        kind = type(message)
        command = message.line if isinstance(message, Command) else _MNEMONICS.get(kind, "")
        return f"{kind.__name__} ({command[:32]})"

    def make_readable(self, sender: m.Sender, frame: Frame) -> ReadableFrame:
        """Return a line in readable form; the password is not shown."""
        text = frame.payload.decode(ENCODING)
        if frame.message_id == Piece.PASSWORD:
            return ReadableFrame(None, "password", {"text": "***"}, b"")
        if frame.message_id == Piece.TEXT:
            return ReadableFrame(None, "text", {"text": text}, frame.payload)
        kind = "command" if sender is m.Sender.CLIENT else "line"
        return ReadableFrame(None, kind, {"text": text}, frame.payload + LINE_END)

    def raw_request(self, message_id: int | str, payload: bytes) -> RawRequest:
        """Return a command that the user writes, such as ``GVA001``; the payload is added to it.

        Raises:
            UnsupportedError: the form of its answer is not known.
            ConfigurationError: the text is no line.
        """
        line = f"{message_id}{payload.decode(ENCODING)}"
        if not isinstance(message_id, str) or line[:2].upper() not in COMMANDS:
            known = ", ".join(COMMANDS)
            raise UnsupportedError(
                f"dialect {self.name}: {line[:32]!r} begins with no command that is known: {known}"
            )
        return RawRequest(Command(line=line), Reply, expects_answer=True, known=True)

    def body(self, answer: m.Message) -> bytes:
        """Return the data after the code.

        Raises:
            UnsupportedError: by its code, the camera does not know the command.
            CommandRejectedError: by its code, the camera did not carry out the command.
        """
        if not isinstance(answer, Reply):
            raise LocalProtocolError(f"{type(answer).__name__} is no answer to a command")
        if answer.code == StatusCode.DONE:
            return answer.data
        refusal = f"{answer.line}: the camera answered {answer.code}"
        refusal = f"{refusal}: {code_text(answer.line, answer.code)}"
        if answer.code == StatusCode.UNRECOGNIZED:
            raise UnsupportedError(refusal)
        raise CommandRejectedError(refusal, code=answer.code)


def _cell_names(text: str) -> list[str]:
    """Return the cells that a URL names, as commands name them.

    Raises ConfigurationError: one is neither a cell, a range, nor a name; or there are too many.
    """
    names: list[str] = []
    for part in filter(None, (name.strip() for name in text.split(","))):
        if ":" in part or part[1:2].isdecimal():
            names += [cell.wire for cell in parse_cells(part)]
        else:
            parse_tag(part)
            names.append(part)
        if len(names) > MAX_CELLS:
            raise ConfigurationError(f"cells: more than {MAX_CELLS}")
    return names


NATIVE = InSightDialect(
    name="native",
    about="native mode: text over telnet; ?cells= names the cells to read after a trigger",
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
        "user": "user to log in; default admin",
        "password": "the user's; default none",
        "cells": "cells that are a result's values, such as B2,C2,D4:F6",
        "counter": "a cell that counts runs, which shows whether values are of one run",
    },
    emulator="smartcam.emulator._insight.camera:EmulatedInSight",
    greeting=WELCOME.encode(ENCODING),
)
"""The protocol that the entry point ``insight`` gives."""
