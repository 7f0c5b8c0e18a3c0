"""``smartcam dissector``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from click.testing import CliRunner

from smartcam.cli.dissector import dissector
from smartcam.dissector import lua_source

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result


def give(*options: str) -> Result:
    return CliRunner().invoke(dissector, options)


def test_dissector_is_printed() -> None:
    done = give()
    assert (done.exit_code, done.output) == (0, lua_source())


def test_dissector_is_written_to_a_file_and_nothing_is_printed(tmp_path: Path) -> None:
    path = tmp_path / "smartcam.lua"
    done = give("-o", str(path))
    assert (done.exit_code, done.output) == (0, "")
    assert path.read_text(encoding="ascii") == lua_source()


def test_dissector_that_cannot_be_written_is_a_usage_error(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "smartcam.lua"
    done = give("-o", str(path))
    text = f"smartcam: error: --output {path}: No such file or directory\n"
    assert done.exit_code == 2
    assert done.output == text  # both streams, in every click
