"""The protocol of Keyence SR code readers: LON begins a reading, LOFF ends it.

The known facts about them, with sources, are in ``docs/keyence.md``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from smartcam.exceptions import ConfigurationError
from smartcam.makes._keyence.words import (
    ENCODING,
    LINE_END,
    MAX_LINE_BYTES,
    READY,
    answer_key,
    error_code,
    result_code,
)
from smartcam.models import Status
from smartcam.protocols import (
    CodeMeaning,
    LineCommand,
    LineDialect,
    LineMachine,
    LineReply,
    LineRow,
    Protocol,
    Transport,
    Verdict,
)
from smartcam.protocols import messages as m
from smartcam.protocols._inside import refuse_line

if TYPE_CHECKING:
    from collections.abc import Mapping

DEFAULT_PORT = 9004
LAST_BANK = 15
NOTHING_READ = "ERROR"
"""Line that a reader sends if it has read no code."""

CODES = {
    0: CodeMeaning("done", Verdict.DONE),
    **{code: CodeMeaning("unknown command or wrong format", Verdict.UNKNOWN) for code in (100, 1)},
    **{code: CodeMeaning("wrong parameter", Verdict.REFUSED) for code in (2, 3)},
    20: CodeMeaning("not now", Verdict.BUSY),
    21: CodeMeaning("the buffer is full", Verdict.REFUSED),
    22: CodeMeaning("a file is wrong", Verdict.REFUSED),
    99: CodeMeaning("the reader is broken", Verdict.REFUSED),
}
"""Meanings of the codes after ``ER,<command>``. Code 00 (unknown command) has the key 100, since 0
means done."""


def _answer_code(line: str) -> int:
    code = error_code(line)
    return 0 if code is None else code or 100


def read_code(line: str) -> m.ResultContainer:
    """Return the result of a reading: whether a code was read, and its text."""
    data = line.encode(ENCODING)
    is_read = line != NOTHING_READ
    text = data.decode("utf-8", "replace") if is_read else ""
    cells = (m.CellValue("read", str(int(is_read))), m.CellValue("code", text))
    return m.ResultContainer(data=data, cells=cells)


def _read_trigger_answer(line: str) -> tuple[m.Message, ...]:
    if line.startswith("ER,LON,"):
        return (m.TriggerAnswer(code=_answer_code(line)),)
    return m.TriggerAnswer(), _read_unasked(line)


def _read_unasked(line: str) -> m.ResultContainer:
    # ER is an answer and no barcode; the reader never confirms LON by OK
    if line.startswith(("ER,", "OK,LON")):
        raise ValueError(line)
    return read_code(line)


def _read_status(line: str) -> m.StatusReport:
    """Return the status in ``OK,BUSYSTAT,<word>``; NONE means that the reader waits."""
    if _answer_code(line):
        raise ValueError(line)
    is_idle = line.split(",")[2] == "NONE"
    return m.StatusReport(status=READY if is_idle else Status.RUNNING | Status.BUSY)


def _read_reply(line: str) -> LineReply:
    return LineReply(code=_answer_code(line), data=line.encode(ENCODING))


def _split(line: str) -> tuple[str, str]:
    """Return the command that a line answers ("" if the line is a code), and the line."""
    first, _, argument = line.partition(",")
    return (answer_key(line, {}) if first in {"OK", "ER"} and argument else ""), line


def _make_rows(bank: int | None) -> tuple[LineRow, ...]:
    active = m.UNNAMED_APPLICATION if bank is None else bank
    trigger_line = "LON" if bank is None else f"LON,{bank:02}"

    def read_query_answer(line: str) -> m.QueryAnswer:
        if result_code(line) or not line.startswith("OK,NUM"):
            raise ValueError(line)
        return m.QueryAnswer(application=active)

    def read_connect_answer(line: str) -> m.ConnectAnswer:
        if not line.startswith("OK,ERRSTAT"):
            raise ValueError(line)
        return m.ConnectAnswer(version=1)

    return (
        LineRow(m.Connect, "ERRSTAT", m.ConnectAnswer, read_connect_answer),
        LineRow(m.GetStatus, "BUSYSTAT", m.StatusReport, _read_status),
        LineRow(m.Query, "NUM", m.QueryAnswer, read_query_answer),
        LineRow(
            m.Trigger,
            trigger_line,
            m.ResultContainer,
            _read_trigger_answer,
            answer_word="",
            extras=(m.TriggerAnswer,),
        ),
        LineRow(m.EndTrigger, "LOFF", None, refuse_line),
        LineRow(
            None,
            "LOFF",
            m.Notice,
            lambda line: m.Notice("error", _answer_code(line), line),
            answer_word="LOFF",
        ),
        LineRow(None, "code", m.ResultContainer, _read_unasked),
        LineRow(LineCommand, "{line}", LineReply, _read_reply),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class SrDialect(LineDialect):
    """The lines of an SR reader."""

    def with_parameters(self, parameters: Mapping[str, str]) -> SrDialect:
        """Return the dialect with the bank of settings that a URL names.

        Raises:
            ConfigurationError: there is no such bank.
        """
        if "bank" not in parameters:
            return self
        text = parameters["bank"]
        if not (text.isascii() and text.isdecimal() and int(text[:4]) <= LAST_BANK):
            raise ConfigurationError(f"bank: 0 to {LAST_BANK} was expected, got {text!r}")
        return replace(self, rows=_make_rows(int(text)))


LINES = SrDialect(
    name="lines",
    about="lines that end with CR",
    source="docs/keyence.md, derived",
    rows=_make_rows(None),
    ids=range(LAST_BANK + 1),
    line_end=LINE_END,
    max_line=MAX_LINE_BYTES,
    encoding=ENCODING,
    split=_split,
    pipelined=True,
    codes=CODES,
    make="Keyence SR",
)

SR = Protocol(
    name="sr",
    schemes={"sr": Transport.TCP},
    default_port=DEFAULT_PORT,
    models=("SR-1000", "SR-2000", "SR-5000", "SR-X"),
    dialects={LINES.name: LINES},
    machine=LineMachine,
    parameters={
        "bank": "bank of settings that a trigger reads with, 0 to 15; default the reader's"
    },
    emulator="smartcam.makes._keyence.sr_camera:EmulatedSr",
    greeting=b"",
)
"""The protocol that the scheme ``sr`` names."""
