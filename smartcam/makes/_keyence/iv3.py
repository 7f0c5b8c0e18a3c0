"""The protocol of Keyence IV2 and IV3: sensors that answer each trigger with OK or NG.

The known facts about them, with their sources, are in ``docs/keyence.md``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.makes._keyence.words import (
    ENCODING,
    LINE_END,
    MAX_LINE_BYTES,
    READY,
    answer_key,
    error_code,
    result_code,
)
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
    from collections.abc import Generator

    Script = Generator[str, str, m.Message]

DEFAULT_PORT = 8500
LAST_PROGRAM = 127

CODES = {
    0: CodeMeaning("done", Verdict.DONE),
    2: CodeMeaning("unknown command", Verdict.UNKNOWN),
    3: CodeMeaning("not now", Verdict.BUSY),
    22: CodeMeaning("wrong parameter", Verdict.REFUSED),
}
"""Meanings of the codes after ``ER,<command>``; inferred from other Keyence devices."""


def read_result(line: str) -> m.ResultContainer:
    """Return the result in ``RT,count,OK|NG[,tool,OK|NG,rate]...``; raise ValueError for others."""
    word, count, judgement, *tools = line.split(",")
    if word != "RT":
        raise ValueError(line)
    cells = [m.CellValue("count", count), m.CellValue("judgement", _bool_text(judgement))]
    for index in range(0, len(tools) - len(tools) % 3, 3):
        tool, passed, rate = tools[index : index + 3]
        cells += (
            m.CellValue(f"tool {tool}", tool),
            m.CellValue(f"tool {tool} judgement", _bool_text(passed)),
            m.CellValue(f"tool {tool} rate", rate),
        )
    if len(tools) % 3:
        raise ValueError(line)
    return m.ResultContainer(data=line.encode(ENCODING), cells=tuple(cells))


def _bool_text(word: str) -> str:
    return {"OK": "1", "NG": "0"}[word]


def _read_trigger_answer(line: str) -> tuple[m.Message, ...]:
    code = error_code(line)
    if code is not None:
        return (m.TriggerAnswer(code=code),)
    return m.TriggerAnswer(), read_result(line)


def _read_unasked(line: str) -> m.Notice:
    """Return an unasked result as a notice; no known sensor sends one."""
    return m.Notice("notification", 0, line)


def _read_connect_answer(line: str) -> tuple[m.Message, ...]:
    if error_code(line) is None:
        read_result(line)
    return m.ConnectAnswer(version=1), m.StatusReport(status=READY)


def _read_program(line: str) -> m.QueryAnswer:
    word, program = line.split(",")
    if word != "PR" or not program.isdecimal() or len(program) > 9:
        raise ValueError(line)
    if int(program) > LAST_PROGRAM:
        raise ValueError(line)
    return m.QueryAnswer(application=int(program))


def _switch_script(dialect: LineDialect, message: m.SwitchApplication) -> Script:
    code = result_code((yield f"PW,{message.application}"))
    program = _read_program((yield "PR")).application
    return m.SwitchAnswer(code=code, application=program)


def _read_reply(line: str) -> LineReply:
    return LineReply(code=result_code(line), data=line.encode(ENCODING))


LINES = LineDialect(
    name="lines",
    about="lines that end with CR",
    source="docs/keyence.md, derived",
    rows=(
        LineRow(m.Connect, "RT", m.ConnectAnswer, _read_connect_answer, extras=(m.StatusReport,)),
        LineRow(m.Query, "PR", m.QueryAnswer, _read_program),
        LineRow(
            m.SwitchApplication,
            "PW,{application}",
            m.SwitchAnswer,
            refuse_line,
            script=_switch_script,
        ),
        LineRow(
            m.Trigger,
            "T2",
            m.ResultContainer,
            _read_trigger_answer,
            answer_word="RT",
            extras=(m.TriggerAnswer,),
        ),
        LineRow(None, "result", m.Notice, _read_unasked, answer_word="RT"),
        LineRow(LineCommand, "{line}", LineReply, _read_reply),
    ),
    ids=range(LAST_PROGRAM + 1),
    line_end=LINE_END,
    max_line=MAX_LINE_BYTES,
    encoding=ENCODING,
    split=lambda line: (answer_key(line, {"T2": "RT"}), line),
    codes=CODES,
    names_application=False,
    make="Keyence IV3",
    shows_triggers=False,
)

IV3 = Protocol(
    name="iv3",
    schemes={"iv3": Transport.TCP},
    default_port=DEFAULT_PORT,
    models=("IV2", "IV3"),
    dialects={LINES.name: LINES},
    machine=LineMachine,
    emulator="smartcam.makes._keyence.iv3_camera:EmulatedIv3",
    greeting=b"",
)
"""The protocol that the scheme ``iv3`` names."""
