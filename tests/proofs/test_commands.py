"""The long forms are commands: each starts by itself, with nothing on its path."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

COMMANDS = [
    path
    for path in sorted(Path(__file__).parent.glob("*.py"))
    if "argparse" in path.read_text(encoding="utf-8") and not path.name.startswith("test_")
]


@pytest.mark.parametrize("path", COMMANDS, ids=lambda path: path.stem)
def test_long_form_starts_as_a_command(path: Path, tmp_path: Path) -> None:
    command = [sys.executable, str(path), "--help"]
    done = subprocess.run(  # noqa: S603 - our own
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "usage:" in done.stdout
