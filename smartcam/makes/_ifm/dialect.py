"""PCIC, the protocol of ifm's sensors: each answer has the ticket (a number) of its question.

The known facts about the devices, with their sources, are in ``docs/ifm.md``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Literal

from smartcam._arguments import check_choice
from smartcam.exceptions import ConfigurationError, FrameError, UnsupportedError
from smartcam.makes._ifm.chunks import read_chunks
from smartcam.makes._ifm.layouts import RESULT_MARK, convert_bools, layout_json
from smartcam.models import Status
from smartcam.protocols import (
    CodeMeaning,
    LineCommand,
    LineMachine,
    LineReply,
    LineRow,
    Protocol,
    TicketedDialect,
    Transport,
    Verdict,
)
from smartcam.protocols import messages as m
from smartcam.protocols._inside import refuse_line

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping

    from smartcam.layout import Layout

    Reported = m.Message | tuple[m.Message, ...]
    Script = Generator[str, str, Reported]

DEFAULT_PORT = 50010
TICKETS = range(1000, 10000)
RESULT_TICKET, ERROR_TICKET, NOTIFICATION_TICKET, DEBUG_TICKET = "0000", "0001", "0010", "0020"
"""Tickets of messages that a device sends unasked."""

READY = Status.RUNNING | Status.WAITING_FOR_TRIGGER

MAX_APPLICATION = 99
"""Largest number of an application: switching commands have two digits for the number."""

MAX_INPUT_BYTES = 256
"""Largest number of bytes of an input container."""

CODES: Mapping[str, int] = {"*": 0, "!": 1, "?": 2, "$": 3}
"""Result codes that smartcam defines for answers of a single character."""

TRIGGER_REFUSED = 4
"""Result code that smartcam defines for a trigger that was answered with ``!``."""

_CODE_MEANINGS: Mapping[int, CodeMeaning] = {
    0: CodeMeaning("done", Verdict.DONE),
    1: CodeMeaning("!: not now, or a wrong value", Verdict.REFUSED),
    2: CodeMeaning("?: wrong syntax or length", Verdict.UNKNOWN),
    3: CodeMeaning("$: unknown error code", Verdict.REFUSED),
    TRIGGER_REFUSED: CodeMeaning(
        "!: busy, another trigger source, no application, or configuration mode", Verdict.BUSY
    ),
}

FATAL_ERRORS = frozenset({110001001, 110001002, 110001003})
"""ifm's errors that set the status bit System Error: boot timeout, fatal software error, unknown
hardware."""

OVERTEMPERATURE, OVERRUN = 110004000, 110001006


def _trigger_code(answer: str) -> int | None:
    code = CODES.get(answer)
    return TRIGGER_REFUSED if code == 1 else code


def _read_trigger_answer(answer: str) -> tuple[m.Message, ...]:
    code = _trigger_code(answer)
    if code:
        return (m.TriggerAnswer(code=code),)
    return m.TriggerAnswer(), _read_result(answer)


def _read_result(content: str) -> m.ResultContainer:
    return m.ResultContainer(data=content.encode("latin-1"))


def _read_status(answer: str) -> m.StatusReport:
    """Return the status: an error state of nine digits, or ``!`` in configuration mode."""
    if answer in CODES:
        return m.StatusReport(status=Status(0))
    error = int(answer)
    error_bit = Status.SYSTEM_ERROR if error in FATAL_ERRORS else Status(0)
    heat_bit = Status.OVERHEAT if error == OVERTEMPERATURE else Status(0)
    return m.StatusReport(status=READY | error_bit | heat_bit)


def _read_active(answer: str) -> int:
    """Return the active application from ``count TAB active TAB ...``; -1 if there is none."""
    if answer == "!":
        return m.UNNAMED_APPLICATION
    count, active, *_ = answer.split("\t")
    if not active.isdecimal() or len(active) > 9 or int(active) > MAX_APPLICATION:
        raise ValueError(answer)
    return int(active) if int(count) and int(active) else m.UNNAMED_APPLICATION


def _read_error(content: str) -> m.Notice:
    return _read_notice("error", content)


def _read_error_or_overrun(content: str) -> tuple[m.Message, ...]:
    """Return an error; for an overrun also statuses that tell of a dropped trigger."""
    notice = _read_error(content)
    if notice.code != OVERRUN:
        return (notice,)
    overrun = m.StatusReport(status=READY | Status.OVERTRIGGERED)
    return notice, overrun, m.StatusReport(status=READY)


def _read_notice(kind: Literal["error", "notification"], content: str) -> m.Notice:
    """Return a device's notice about itself from nine digits, a colon and a text."""
    digits, colon, text = content.partition(":")
    if colon and digits.isascii() and digits.isdecimal() and len(digits) <= 9:
        return m.Notice(kind, int(digits), text)
    return m.Notice(kind, 0, content)


def _read_reply(answer: str) -> LineReply:
    return LineReply(code=CODES.get(answer, 0), data=answer.encode("latin-1"))


def _connect_script(dialect: PcicDialect, message: m.Connect) -> Script:
    """Ask for the maker, switch unasked messages on, and upload the layout."""
    maker = yield "G?"
    if not maker.upper().startswith("IFM"):
        raise FrameError(f"{maker[:64]!r} came, a device of ifm says IFM ELECTRONIC first")
    code = CODES[(yield "p7" if dialect.tickets else "p0")]
    code = code or (yield from _upload_layout(dialect))
    return m.ConnectAnswer(code=code, version=1)


def _upload_layout(dialect: PcicDialect) -> Generator[str, str, int]:
    if dialect.layout is None:
        return 0
    description = layout_json(dialect.layout)
    return CODES[(yield f"c{len(description):09}{description}")]


def _switch_script(dialect: PcicDialect, message: m.SwitchApplication) -> Script:
    code = CODES[(yield f"a{message.application:02}")]
    active = _read_active((yield "A?"))
    if code == 0:
        code = yield from _upload_layout(dialect)  # the layout may be lost with the old application
    return m.SwitchAnswer(code=code, application=active)


def _image_script(dialect: PcicDialect, message: m.ReadImage) -> Script:
    answer = yield "I01?"
    if answer in CODES:
        answer = yield "I02?"
    if answer in CODES:
        return m.Image(code=CODES[answer], data=b"")
    chunks = read_chunks(answer.encode("latin-1"))
    return m.Image(data=chunks[0].file if chunks else b"")


def _input_script(dialect: PcicDialect, message: m.SetInput) -> Script:
    data = message.data
    if len(data) > MAX_INPUT_BYTES:
        raise ConfigurationError(
            f"ifm: an input container holds at most {MAX_INPUT_BYTES} bytes, got {len(data)}"
        )
    answer = yield f"j{dialect.container:02}{len(data):09}{data.decode('latin-1')}"
    return m.SetInputAnswer(code=CODES[answer])


def _make_rows(trigger: LineRow, *, tickets: bool, lengths: bool) -> tuple[LineRow, ...]:
    """Return the rows of a dialect.

    Only versions with ``lengths`` have rows for pictures, only versions with ``tickets`` have rows
    for unasked messages.
    """
    read_error = _read_error if trigger.answer is m.ResultContainer else _read_error_or_overrun
    unasked_rows = (
        LineRow(None, "results", m.ResultContainer, _read_result, answer_word=RESULT_TICKET),
        LineRow(
            None, "errors", m.Notice, read_error, answer_word=ERROR_TICKET, extras=(m.StatusReport,)
        ),
        LineRow(
            None,
            "notifications",
            m.Notice,
            partial(_read_notice, "notification"),
            answer_word=NOTIFICATION_TICKET,
        ),
        LineRow(
            None,
            "debug",
            m.Notice,
            lambda text: m.Notice("debug", 0, text[:200]),
            answer_word=DEBUG_TICKET,
        ),
    )
    return (
        LineRow(m.Connect, "G?", m.ConnectAnswer, refuse_line, script=_connect_script),
        LineRow(m.GetStatus, "E?", m.StatusReport, _read_status),
        LineRow(
            m.Query, "A?", m.QueryAnswer, lambda text: m.QueryAnswer(application=_read_active(text))
        ),
        LineRow(
            m.SwitchApplication,
            "a{application}",
            m.SwitchAnswer,
            refuse_line,
            script=_switch_script,
        ),
        trigger,
        *(
            (LineRow(m.ReadImage, "I01?", m.Image, refuse_line, script=_image_script),)
            if lengths
            else ()
        ),
        LineRow(m.SetInput, "j{data}", m.SetInputAnswer, refuse_line, script=_input_script),
        *(unasked_rows if tickets else ()),
        LineRow(LineCommand, "{line}", LineReply, _read_reply),
    )


SYNCHRONOUS_TRIGGER = LineRow(
    m.Trigger, "T?", m.ResultContainer, _read_trigger_answer, extras=(m.TriggerAnswer,)
)
ASYNCHRONOUS_TRIGGER = LineRow(
    m.Trigger, "t", m.TriggerAnswer, lambda text: m.TriggerAnswer(code=_trigger_code(text) or 0)
)

_COMMAND_FORM = re.compile(r"[A-Zabcdgjlop][^\r\n]*")


@dataclass(frozen=True, kw_only=True, eq=False)
class PcicDialect(TicketedDialect):
    """One version of PCIC.

    Args:
        layout: layout of the session's results; None for the device's own.
        container: number of the input container that input data goes to.
    """

    layout: Layout | None = None
    container: int = 0
    names_application: bool = False
    make: str = "ifm"

    def with_parameters(self, parameters: Mapping[str, str]) -> PcicDialect:
        """Return the dialect with the parameters of a URL.

        Raises:
            ConfigurationError: there is no such trigger or container.
        """
        trigger_kind = check_choice(parameters.get("trigger", "sync"), "trigger", ("sync", "async"))
        container = parameters.get("input", str(self.container))
        if not (container.isdecimal() and len(container) <= 2):
            raise ConfigurationError(f"input: 0 to 99 was expected, got {container!r}")
        trigger = SYNCHRONOUS_TRIGGER if trigger_kind == "sync" else ASYNCHRONOUS_TRIGGER
        rows = _make_rows(trigger, tickets=bool(self.tickets), lengths=bool(self.digits))
        return replace(self, container=int(container), rows=rows, split=None)

    def for_layout(self, layout: Layout | None) -> PcicDialect:
        """Return the dialect for a session that uploads a layout.

        Raises:
            ConfigurationError: a device cannot send such results, or this version has no binary
                results or no unasked ones.
        """
        row = self.row(m.Trigger)
        if not self.tickets and row is ASYNCHRONOUS_TRIGGER:
            raise ConfigurationError(
                f"ifm: dialect {self.name} has no results without a question, so no trigger=async"
            )
        if layout is None:
            return self
        if not self.digits:
            raise ConfigurationError(
                f"ifm: dialect {self.name} has no length, so no results in binary; use v3 or v4, "
                "or interpret_as='raw'"
            )
        layout_json(layout)
        readers = {
            row: _make_reader(layout, row) for row in self.rows if row.answer is m.ResultContainer
        }
        rows = tuple(row._replace(read=readers.get(row, row.read)) for row in self.rows)
        return replace(self, layout=layout, rows=rows, split=None)

    def command(self, line: str) -> str:
        """Return a user's command after checking it.

        Raises:
            ConfigurationError: the line is no command, or would end the session, such as one that
                sets the version or another layout.
            UnsupportedError: its answer needs a length.
        """
        if line[:1] in {"I", "H"} and not self.digits:
            raise UnsupportedError(
                f"ifm: dialect {self.name} has no length, so the end of the answer to {line[:8]!r} "
                "could not be found; use v3 or v4"
            )
        if line[:1] == "c" and self.layout is not None:
            raise ConfigurationError(
                f"ifm: the session's layout is that of interpret_as: {self.layout.text}"
            )
        if not _COMMAND_FORM.fullmatch(line):
            raise ConfigurationError(
                f"ifm: {line[:32]!r} is no command that can be sent; docs/ifm.md lists them; the "
                "dialect fixes the protocol's version"
            )
        return line


def _make_reader(layout: Layout, row: LineRow) -> Callable[[str], Reported]:
    """Return a function that reads results in an uploaded layout, which begin with a mark."""

    def read(content: str) -> Reported:
        if row.request is m.Trigger and content in CODES:
            return row.read(content)
        data = content.encode("latin-1")
        if content.startswith(RESULT_MARK):
            container = m.ResultContainer(data=convert_bools(layout, data[len(RESULT_MARK) :]))
        else:
            fault = (
                f"{content[:32]!r} came, a result in the session's layout begins with "
                f"{RESULT_MARK!r}"
            )
            container = m.ResultContainer(data=data, cells=(), fault=fault)
        return (m.TriggerAnswer(), container) if row.request is m.Trigger else container

    return read


def _make_version(name: str, about: str, tickets: range, digits: int) -> PcicDialect:
    return PcicDialect(
        name=name,
        about=about,
        source="docs/ifm.md, published",
        ids=range(1, MAX_APPLICATION + 1),
        rows=_make_rows(SYNCHRONOUS_TRIGGER, tickets=bool(tickets), lengths=bool(digits)),
        codes=_CODE_MEANINGS,
        tickets=tickets,
        pipelined=bool(tickets),
        digits=digits,
        asks_with_length=name == "v3",
    )


_VERSIONS = (
    _make_version("v3", "ticket and length in both directions", TICKETS, 9),
    _make_version("v4", "answers with their length, no tickets", range(0), 9),
    _make_version("v2", "tickets, no length: texts only", TICKETS, 0),
    _make_version("v1", "neither: texts only, no results but a trigger's", range(0), 0),
)

PCIC = Protocol(
    name="pcic",
    schemes={"pcic": Transport.TCP},
    default_port=DEFAULT_PORT,
    models=("O2D5XX", "O2I5XX", "O2U5XX", "O3D3XX"),
    dialects={version.name: version for version in _VERSIONS},
    machine=LineMachine,
    parameters={
        "trigger": "sync (default): T?, answered by the result; async: t, the result comes later",
        "input": "number of the input container that input data goes to; default 0",
    },
    detection={Transport.TCP: tuple((version,) for version in _VERSIONS)},
    emulator="smartcam.makes._ifm.camera:EmulatedIfm",
    greeting=b"",
)
"""The protocol that the scheme ``pcic`` names."""
