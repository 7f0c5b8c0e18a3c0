"""Units beside values: in SI, or as --units says."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import pytest

from tests.cli.commandline import emulators, run

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

PART = struct.pack("<ff", 12.5, 90.0).hex()
FIELDS = "x: real32 mm, theta: real32 deg"


def decoded(spec: str, *options: str, times: int = 1) -> str:
    return run("decode", PART * times, "--interpret-as", spec, *options).done().out


@pytest.mark.parametrize(
    ("spec", "options", "lines"),
    [
        (FIELDS, (), ["  x = 0.0125 m", "  theta = 1.5708 rad"]),
        (FIELDS, ("--units", "mm,deg"), ["  x = 12.5 mm", "  theta = 90 deg"]),
        (FIELDS, ("--units", " deg , um"), ["  x = 12500 um", "  theta = 90 deg"]),
        ("x: real32, theta: real32 px", (), ["  x = 12.5", "  theta = 90 px"]),
        (f"({FIELDS})*", (), ["  x [m]  theta [rad]"]),
        (f"({FIELDS})*", ("--units", "mm"), ["  x [mm]  theta [rad]", "    12.5       1.5708"]),
        (f"table: ({FIELDS})*", ("--units", "deg"), ["  x [m]  theta [deg]"]),
        ("localizations: (y: real32 mm, x: real32 mm)*", ("--units", "mm"), ["x [mm]", "y [mm]"]),
        (f"parts: ({FIELDS})*", (), ["  parts:", "  x [m]  theta [rad]"]),
    ],
)
def test_value_has_its_unit_beside_it(
    spec: str, options: tuple[str, ...], lines: list[str]
) -> None:
    out = decoded(spec, *options)
    for line in lines:
        assert line in out


def test_json_is_si_whatever_people_see() -> None:
    (told,) = run("decode", PART, "--interpret-as", FIELDS, "--units", "mm", "--json").done().lines
    assert told["value"]["x"] == 0.0125


@pytest.mark.parametrize(
    ("units", "text"),
    [
        ("mmm", "unit 'mmm' is unknown; known are m, mm, um, inch, rad, deg, px, s, ms; did you"),
        ("mm,m", "mm and m are both units of length"),
        ("percent", "unit 'percent' is unknown"),
        ("", "unit '' is unknown"),
    ],
)
def test_units_that_cannot_be_are_refused(units: str, text: str) -> None:
    run("decode", PART, "--interpret-as", FIELDS, "--units", units).failed(2, text)


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with emulators(tmp_path_factory.mktemp("units"), ()) as (one,):
        yield one


def test_trigger_and_watch_show_units(url: str) -> None:
    spec = "(name: string[8], x: real32 mm)*"
    asked = ("--application", "8", "--interpret-as", spec, "--units", "mm")
    out = run("trigger", url, *asked).done().out
    assert "  name  x [mm]" in out
    assert "112" in out
    assert "x [m]" in run("trigger", url, *asked[:4]).done().out
    seen = run("watch", url, "--application", "5", "--interpret-as", "n: int32", "--count", "1")
    assert "  n = " in seen.done().out


SCENARIO = """\
applications:
  - {id: 5, layout: "(x: real32 mm)*", constant: [{x: 0.0125}]}
"""
MEASURED = """\
cameras:
  line1/table:
    emulated: {scenario: measured.yaml}
    application: 5
    interpret_as: {5: "table: (x: real32 mm)*"}
"""


def test_tables_have_the_units_of_the_fleet_files_layout(tmp_path: Path) -> None:
    (tmp_path / "measured.yaml").write_text(SCENARIO, encoding="utf-8")
    fleet = tmp_path / "plant.yaml"
    fleet.write_text(MEASURED, encoding="utf-8")
    assert "  x [m]\n  0.0125" in run("fleet", "trigger", str(fleet)).done().out
    practical = run("fleet", "trigger", str(fleet), "--units", "mm").done().out
    assert "  x [mm]\n    12.5" in practical


@pytest.mark.parametrize("command", ["live", "fleet page"])
def test_page_refuses_units_before_it_asks_anybody(command: str) -> None:
    run(*command.split(), "fleet://127.0.0.1:9", "--units", "mn").failed(2, "unit 'mn' is unknown")


def test_units_are_refused_before_anything_is_triggered(url: str) -> None:
    run("trigger", url, "--units", "deg,rad").failed(2, "deg and rad are both units of angle")
