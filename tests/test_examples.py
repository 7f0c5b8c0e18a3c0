"""The examples: the tutorial's package, word by word as in the docs, monitoring, the sorting."""

from __future__ import annotations

import ast
import re
import runpy
import struct
import sys
import tomllib
from typing import TYPE_CHECKING

import pytest

from smartcam.emulator import TableScene
from smartcam.exceptions import InterpretationError
from smartcam.interpreters import Interpreter, Reader, resolve, run
from smartcam.registry import INTERPRETERS
from tests import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

PACKAGE = ROOT / "examples" / "smartcam-weights"


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Interpreter]:
    """Return the interpreter as found by its installed entry point."""
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    points = project["entry-points"]["smartcam.interpreters"]
    info = tmp_path / "smartcam_weights-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: smartcam-weights\nVersion: 0.1.0\n"
    )
    (info / "entry_points.txt").write_text(
        "[smartcam.interpreters]\n" + "".join(f"{k} = {v}\n" for k, v in points.items())
    )
    monkeypatch.syspath_prepend(str(PACKAGE))
    monkeypatch.syspath_prepend(str(tmp_path))
    INTERPRETERS.refresh()
    yield resolve("weights")
    INTERPRETERS.refresh()
    sys.modules.pop("smartcam_weights", None)


def test_weights_gives_names_and_weights(weights: Interpreter) -> None:
    payload = struct.pack("<10sf10sf", b"bolt", 0.25, b"nut", 0.125)
    assert run(weights, Reader(payload)) == {"bolt": 0.25, "nut": 0.125}
    with pytest.raises(InterpretationError, match="whole records of 14 bytes, got 1 bytes"):
        run(weights, Reader(payload + b"\0"))


@pytest.mark.parametrize("name", ["pyproject.toml", "smartcam_weights.py"])
def test_page_shows_the_package_word_by_word(name: str) -> None:
    page = (ROOT / "docs" / "new-interpreter.md").read_text()
    assert (PACKAGE / name).read_text() in page


def test_interpreter_has_fewer_than_fifteen_lines() -> None:
    source = (PACKAGE / "smartcam_weights.py").read_text()
    lines = [line for line in source.splitlines() if line.strip()]
    assert ast.parse(source)
    assert len(lines) < 15


# ---------------------------------------------------------------------- monitoring


@pytest.mark.long
@pytest.mark.real_time
@pytest.mark.parametrize(
    ("name", "needs"),
    [
        ("spans", "opentelemetry.sdk"),
        ("outcomes", "prometheus_client"),
        ("account", "prometheus_client"),
    ],
)
def test_monitoring_example_finds_what_it_looks_for(name: str, needs: str) -> None:
    pytest.importorskip(needs, reason=f"needs {needs}, of the extra dev")
    runpy.run_path(str(ROOT / "examples" / "monitoring" / f"{name}.py"), run_name="__main__")


# ---------------------------------------------------------------------- tangram


@pytest.mark.long
def test_tangram_is_found_in_a_picture(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(ROOT / "examples" / "tangram" / "tangram.py"), run_name="__main__")
    *pieces, last = capsys.readouterr().out.splitlines()
    names = {one.split()[0] for one in pieces}
    assert names == {*TableScene().pieces}
    assert last.startswith("7 of 7 pieces, all within ")
    assert float(last.split()[-2]) < 0.03


@pytest.mark.long
def test_tower_is_built_by_pictures(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(ROOT / "examples" / "tower" / "tower.py"), run_name="__main__")
    *lines, last = capsys.readouterr().out.splitlines()
    assert [one.split()[0] for one in lines] == [
        "block",
        "top",
        "a",
        "block",
        "top",
        "a",
        "block",
        "top",
    ]
    found = re.fullmatch(
        r"5 layers, 75 mm; all found within (.*) mm, (.*) degrees and (.*) mm of height", last
    )
    assert found is not None, last
    beside, turned, higher = map(float, found.groups())
    assert (beside < 0.05, turned < 0.05, higher < 0.2) == (True, True, True)


# ---------------------------------------------------------------------- sorting


SCRIPT = ROOT / "examples" / "sorting" / "sorting.py"


def test_sorting_script_sorts_everything(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(SCRIPT), run_name="__main__")
    assert capsys.readouterr().out.splitlines() == [
        "3 screws: screw_1, screw_2, screw_3",
        "3 nuts: nut_1, nut_2, nut_3",
    ]
