"""Set up a shell to complete the commands, by a line in its startup file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from smartcam._suggestions import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Mapping

PROGRAMS = ("smartcam", "smartcam-emulator")
"""Commands that are completed."""

_EVAL = 'command -v {program} >/dev/null && eval "$({variable}={shell}_source {program})"'

LINES: Mapping[str, str] = {
    "bash": _EVAL,
    "zsh": _EVAL,
    "fish": "command -q {program}; and {variable}=fish_source {program} | source",
}
"""By shell, the line that sets up the completion of a program, if it is installed."""


def install(shell: str) -> str:
    """Add the missing lines to the shell's startup file, and return a report.

    Args:
        shell: name of the shell; "": the one that the variable SHELL names.

    Raises:
        click.UsageError: the shell is unknown, or its startup file cannot be written.
    """
    name = shell or Path(os.environ.get("SHELL", "")).name
    if name not in LINES:
        known = ", ".join(LINES)
        raise click.UsageError(
            f"--install-completion: expected one of {known}, got {name!r}"
            f"{did_you_mean(name, LINES)}"
        )
    path = _startup_file(name)
    try:
        added_count = _append_missing(path, [_line(name, program) for program in PROGRAMS])
    except (OSError, UnicodeDecodeError) as exc:
        raise click.UsageError(f"--install-completion: {path}: {exc}") from exc
    if not added_count:
        return f"{path}: has the lines already"
    return f"{path}: {added_count} lines added; a new {name} completes {' and '.join(PROGRAMS)}"


def _line(shell: str, program: str) -> str:
    variable = f"_{program.replace('-', '_').upper()}_COMPLETE"
    return LINES[shell].format(program=program, variable=variable, shell=shell)


def _startup_file(shell: str) -> Path:
    """Return the startup file of an interactive shell."""
    home = Path.home()
    if shell == "fish":
        config = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
        return config / "fish" / "conf.d" / "smartcam.fish"
    folder = Path(os.environ.get("ZDOTDIR") or home) if shell == "zsh" else home
    return folder / f".{shell}rc"


def _append_missing(path: Path, lines: list[str]) -> int:
    """Append the lines that a file lacks; return their number."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    rc_lines = text.splitlines()
    missing = [line for line in lines if line not in rc_lines]
    if missing:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as stream:
            stream.write("\n" * (bool(text) and not text.endswith("\n")))
            stream.writelines(f"{line}\n" for line in missing)
    return len(missing)
