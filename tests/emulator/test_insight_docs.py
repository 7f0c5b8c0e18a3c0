"""The page about In-Sight native mode: its tables agree with the code."""

from __future__ import annotations

import re
from pathlib import Path

from smartcam.emulator.insight.camera import InSightQuirks
from smartcam.protocols.insight.words import COMMANDS, AnswerForm, StatusCode

PAGE = (Path(__file__).parents[2] / "docs" / "insight.md").read_text(encoding="utf-8")


def rows(first: str) -> list[list[str]]:
    """Return the rows of the table whose first heading is ``first``."""
    table = re.search(rf"^\| {first} \|.*(?:\n\|.*)*", PAGE, re.MULTILINE)
    assert table is not None
    return [
        [cell.strip(" `") for cell in line.split("|")[1:-1]] for line in table[0].splitlines()[2:]
    ]


def test_command_table_has_every_command() -> None:
    shown = [(row[0], row[1], row[3], row[4]) for row in rows("command")]
    assert shown == [
        (row.mnemonic, row.title, row.form.value, row.mode.value) for row in COMMANDS.values()
    ]
    grades = {row[0]: row[-1] for row in rows("command")}
    assert grades == {name: row.source.split(": ")[1] for name, row in COMMANDS.items()}


def test_code_and_form_tables_are_complete() -> None:
    assert [int(row[0]) for row in rows("code")] == [code.value for code in StatusCode]
    assert [row[0] for row in rows("form")] == [form.value for form in AnswerForm]


def test_quirk_table_has_every_quirk() -> None:
    shown = [(row[0], row[1]) for row in rows("quirk")]
    assert shown == [
        (name, str(field.default)) for name, field in InSightQuirks.model_fields.items()
    ]


def test_every_source_that_is_named_is_in_the_list() -> None:
    keys = {key for row in rows("key") for key in re.split(r", | \*n\*", row[0]) if key}
    named = {
        source.split(" ")[0]
        for heading in ("fact", "command")
        for table in re.findall(rf"^\| {heading} \|.*(?:\n\|.*)*", PAGE, re.MULTILINE)
        for line in table.splitlines()[2:]
        for source in line.split("|")[-3].strip().split(", ")
    }
    assert named - {"\u2013"} <= keys
