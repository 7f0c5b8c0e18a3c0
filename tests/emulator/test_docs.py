"""The emulator's pages: the scenario loads, the tables agree with the code."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from smartcam.emulator import load_scenario
from smartcam.protocols._inside import StatusCode, words
from tests import ROOT
from tests.emulator.builtins import BUILTIN_APPLICATIONS
from tests.emulator.inside import generator_names

if TYPE_CHECKING:
    from pathlib import Path

PAGE = (ROOT / "docs" / "emulator.md").read_text(encoding="utf-8")


def first_cells(heading: str) -> list[str]:
    """Return the first column of the first table under a heading."""
    section = PAGE[PAGE.index(f"# {heading}\n") :]
    table = re.search(r"^\|.*(?:\n\|.*)*", section, re.MULTILINE)
    assert table is not None
    return [line.split("|")[1].strip(" `") for line in table[0].splitlines()[2:]]


def test_yaml_example_loads(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "scenarios.md").read_text(encoding="utf-8")
    text = re.findall(r"^```yaml\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)[0]
    path = tmp_path / "line.yaml"
    path.write_text(text, encoding="utf-8")
    scenario = load_scenario(path)
    assert [app.id for app in scenario.applications] == [11]


def test_generator_table_has_every_generator() -> None:
    assert set(first_cells("Generators")) <= set(generator_names())
    assert len(first_cells("Generators")) == 4


def test_builtin_table_has_every_application_with_its_layout() -> None:
    assert first_cells("Built-in applications") == [str(app.id) for app in BUILTIN_APPLICATIONS]
    for app in BUILTIN_APPLICATIONS:
        assert f"`{app.layout}`" in PAGE


# ---------------------------------------------------------------------- In-Sight native mode


INSIGHT = (ROOT / "docs" / "insight.md").read_text(encoding="utf-8")


def rows(first: str) -> list[list[str]]:
    """Return the rows of the table whose first heading is ``first``."""
    table = re.search(rf"^\| {first} \|.*(?:\n\|.*)*", INSIGHT, re.MULTILINE)
    assert table is not None
    return [
        [cell.strip(" `") for cell in line.split("|")[1:-1]] for line in table[0].splitlines()[2:]
    ]


def test_command_table_has_every_command() -> None:
    shown = [(row[0], row[1], row[3], row[4]) for row in rows("command")]
    assert shown == [
        (row.mnemonic, row.title, row.form.value, row.mode.value) for row in words.COMMANDS.values()
    ]
    grades = {row[0]: row[-1] for row in rows("command")}
    assert grades == {name: row.source.split(": ")[1] for name, row in words.COMMANDS.items()}


def test_code_and_form_tables_are_complete() -> None:
    assert [int(row[0]) for row in rows("code")] == [code.value for code in StatusCode]
    assert [row[0] for row in rows("form")] == [form.value for form in words.AnswerForm]


def test_every_source_that_is_named_is_in_the_list() -> None:
    keys = {key for row in rows("key") for key in re.split(r", | \*n\*", row[0]) if key}
    named = {
        source.split(" ")[0]
        for heading in ("fact", "command")
        for table in re.findall(rf"^\| {heading} \|.*(?:\n\|.*)*", INSIGHT, re.MULTILINE)
        for line in table.splitlines()[2:]
        for source in line.split("|")[-3].strip().split(", ")
    }
    assert named - {"\u2013"} <= keys
