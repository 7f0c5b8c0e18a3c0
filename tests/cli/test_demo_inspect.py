"""``smartcam demo --inspect``: each fault is found, and nothing else."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from tests.cli.commandline import run

pytest.importorskip("zxingcpp", reason="needs the extra inspection")

if TYPE_CHECKING:
    from pathlib import Path


def test_demo_finds_each_fault_and_nothing_else(tmp_path: Path) -> None:
    folder = tmp_path / "demo"
    done = run("demo", "--inspect", "--folder", str(folder), "--seed", "3", "--json")
    assert done.code == 0
    lines = [json.loads(line) for line in done.out.splitlines()]
    (parts,) = [line["parts"] for line in lines if "parts" in line]
    assert {one["picture"] for one in parts} == {one.stem for one in (folder / "seen").iterdir()}
    assert sum(bool(one["fault"]) for one in parts) == 3
    for one in parts:
        assert one["found"] == [one["fault"]][: bool(one["fault"])]
    again = run(
        "inspect", str(folder / "cell.yaml"), "desk/drawn", "label", str(folder / "pictures")
    )
    assert (again.code, again.out.count(": ok, "), again.out.count(": not ok, ")) == (0, 5, 1)


def test_demonstrations_do_not_go_together() -> None:
    done = run("demo", "--inspect", "--pick")
    assert (done.code, "--pick and --inspect do not go together" in done.err) == (2, True)
