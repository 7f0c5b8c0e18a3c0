"""The emulator's page: its scenario loads, its tables agree with the code."""

from __future__ import annotations

import re
from pathlib import Path

from smartcam.emulator import Application, Quirks, faults, load_scenario
from smartcam.emulator.application import BUILTIN_APPLICATIONS
from smartcam.emulator.generators import generator_names
from smartcam.protocols import messages as m

PAGE = (Path(__file__).parents[2] / "docs" / "emulator.md").read_text(encoding="utf-8")


def first_cells(heading: str) -> list[str]:
    """Return the first column of the first table under a heading."""
    section = PAGE[PAGE.index(f"# {heading}\n") :]
    table = re.search(r"^\|.*(?:\n\|.*)*", section, re.MULTILINE)
    assert table is not None
    return [line.split("|")[1].strip(" `") for line in table[0].splitlines()[2:]]


def test_yaml_example_loads(tmp_path: Path) -> None:
    (text,) = re.findall(r"^```yaml\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    path = tmp_path / "line.yaml"
    path.write_text(text, encoding="utf-8")
    scenario = load_scenario(path)
    assert [app.id for app in scenario.applications] == [11, 12, 13, 14, 15]


def test_quirks_table_has_every_quirk() -> None:
    assert first_cells("Quirks") == list(Quirks.model_fields)


def test_fault_tables_have_every_fault_with_its_fields() -> None:
    wire_faults, device_faults = first_cells("On the wire"), first_cells("Of the device")
    both_ways = [
        kind for kind, made in faults.FAULTS.items()
        if issubclass(made, faults.WireFault) and m.Sender.CLIENT in made.senders
    ]  # fmt: skip
    assert [name.removesuffix("` *") for name in wire_faults] + device_faults == list(faults.FAULTS)
    assert [name.removesuffix("` *") for name in wire_faults if "*" in name] == both_ways
    assert first_cells("Which message") == ["on", "sender", "nth", "times"]
    tables = PAGE[PAGE.index("### On the wire") : PAGE.index("## How strict it is")]
    for kind, made in faults.FAULTS.items():
        (row,) = re.findall(rf"^\| `{kind}`.*$", tables, re.MULTILINE)
        own = set(made.model_fields) - {"kind", "on", "sender", "nth", "times", "when"}
        assert [field for field in own if f"`{field}`" not in row] == []


def test_application_table_has_every_field() -> None:
    assert sorted(first_cells("What an application sends")) == sorted(Application.model_fields)


def test_generator_table_has_every_generator() -> None:
    assert set(first_cells("Generators")) <= set(generator_names())
    assert len(first_cells("Generators")) == 4


def test_builtin_table_has_every_application_with_its_layout() -> None:
    assert first_cells("Built-in applications") == [str(app.id) for app in BUILTIN_APPLICATIONS]
    for app in BUILTIN_APPLICATIONS:
        assert f"`{app.layout}`" in PAGE
