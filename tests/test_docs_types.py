"""The pages' ``python`` blocks type-check, by mypy and pyright.

Both are strict but for annotations of the pages' own functions, which readers can do without. A
block that cannot be checked like this stands in :data:`LEFT_OUT` with the reason, and only as long
as there is something to complain about.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from tests import ROOT

pytestmark = pytest.mark.long

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
TIMEOUT = 240.0
"""Seconds that a checker takes at most; on two slow cores it is half a minute."""

SHORT = "reads what may be None in other cases, to be short"
UNTYPED = "shows data whose types nobody has declared"
ARRAYS = "gives lists where arrays are declared"
FILE = "imports the file that the page has above it"
OTHERS = "uses a library of others whose values may be None"

LEFT_OUT: dict[tuple[str, str], str] = {
    ("docs/bus.md", "import zenoh"): OTHERS,
    ("docs/calibrating.md", "CameraModel("): ARRAYS,
    ("docs/first-test.md", "# test_cell.py"): FILE,
    ("docs/first-test.md", "# test_jam.py"): FILE,
    ("docs/formats.md", "read_cameras"): UNTYPED,
    ("docs/from-images.md", ""): SHORT,
    ("docs/judging-clients.md", ""): SHORT,
    ("docs/layouts.md", "def interpret(spec: str)"): UNTYPED,
    ("docs/new-interpreter.md", "self.layout"): SHORT,
    ("docs/promises.md", ""): SHORT,
    ("docs/sheets.md", ""): ARRAYS,
    ("docs/tower.md", ""): SHORT,
}
"""By page, and by words that the block has."""

MYPY = ("--strict", "--allow-untyped-defs", "--allow-incomplete-defs", "--allow-untyped-calls")

PYRIGHT = {
    "typeCheckingMode": "strict",
    "pythonVersion": "3.11",
    **dict.fromkeys(
        (
            "reportMissingParameterType",
            "reportMissingTypeStubs",
            "reportUnknownArgumentType",
            "reportUnknownLambdaType",
            "reportUnknownMemberType",
            "reportUnknownParameterType",
            "reportUnknownVariableType",
            "reportUnusedExpression",
            "reportUnusedImport",
            "reportMatchNotExhaustive",
        ),
        "none",
    ),
}


class Shown(NamedTuple):
    """A block, and the file that it becomes."""

    page: str
    line: int
    text: str
    file: str


def shown() -> list[Shown]:
    """Return the blocks of all pages."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        name = str(page.relative_to(ROOT))
        for match in re.finditer(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
            line = text[: match.start(1)].count("\n") + 1
            file = re.sub(r"\W", "_", name.removesuffix(".md")) + f"_{line}.py"
            found.append(Shown(name, line, match[1], file))
    return found


def reason(block: Shown) -> tuple[str, str] | None:
    """Return the row by which a block is left out."""
    return next((key for key in LEFT_OUT if key[0] == block.page and key[1] in block.text), None)


BLOCKS = shown()


@pytest.fixture(scope="module")
def complaints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Return what both checkers say of each file; the library is found where the tests find it."""
    folder = tmp_path_factory.mktemp("blocks")
    for block in BLOCKS:
        (folder / block.file).write_text(block.text, encoding="utf-8")
    found: dict[str, list[str]] = {block.file: [] for block in BLOCKS}
    for said in [*by_mypy(folder), *by_pyright(folder)]:
        found[said.partition(":")[0]].append(said)
    return found


def run(folder: Path, *command: str) -> str:
    """Run a checker; what it has to say is on its standard output."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    done = subprocess.run(  # noqa: S603 - a checker of this environment
        command,
        cwd=folder,
        env={**os.environ, "PATH": path, "MYPYPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )
    assert done.returncode in {0, 1}, done.stdout + done.stderr
    return done.stdout


def by_mypy(folder: Path) -> list[str]:
    """Return mypy's complaints, each beginning with the file."""
    options = ("--config-file=", "--python-version=3.11", *MYPY)
    cache = ROOT / ".mypy_cache" / "docs"
    files = sorted(one.name for one in folder.glob("*.py"))
    said = run(folder, sys.executable, "-m", "mypy", *options, f"--cache-dir={cache}", *files)
    return [line for line in said.splitlines() if ": error: " in line]


def by_pyright(folder: Path) -> list[str]:
    """Return pyright's complaints, each beginning with the file."""
    config = {**PYRIGHT, "include": ["."], "extraPaths": [str(ROOT)]}
    (folder / "pyrightconfig.json").write_text(json.dumps(config), encoding="utf-8")
    pyright = str(Path(sys.executable).parent / "pyright")
    said = json.loads(run(folder, pyright, "--pythonpath", sys.executable, "--outputjson"))
    assert said["summary"]["filesAnalyzed"] >= len(BLOCKS)
    return [
        f"{Path(one['file']).name}:{one['range']['start']['line'] + 1}: {one['message']}"
        for one in said["generalDiagnostics"]
        if one["severity"] == "error"
    ]


def test_what_pages_show_type_checks(complaints: dict[str, list[str]]) -> None:
    found = [
        f"{block.page}, block at line {block.line}: {said}"
        for block in BLOCKS
        if reason(block) is None
        for said in complaints[block.file]
    ]
    assert not found, "\n".join(found)


def test_blocks_that_are_left_out_have_to_be(complaints: dict[str, list[str]]) -> None:
    wanted = {key for block in BLOCKS if complaints[block.file] and (key := reason(block))}
    assert {*LEFT_OUT} == wanted
    assert len(LEFT_OUT) <= len(BLOCKS) // 5
