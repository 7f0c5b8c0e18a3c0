"""The commands ``smartcam`` and ``smartcam-emulator``; thin, each calls the library."""

from __future__ import annotations

import importlib
import sys


def main() -> None:
    """Run ``smartcam``."""
    _run("smartcam", "smartcam")


def emulator_main() -> None:
    """Run ``smartcam-emulator``."""
    _run("smartcam-emulator", "smartcam_emulator")


def _run(program: str, module: str) -> None:
    try:
        try:
            importlib.import_module("click")
            importlib.import_module("yaml")
        except ModuleNotFoundError:
            sys.exit(_missing(program))
        command = importlib.import_module(f"smartcam._cli.{module}").command
    except KeyboardInterrupt:  # Ctrl-C while still importing
        sys.exit(130)
    command(prog_name=program)


def _missing(program: str) -> int:
    sys.stderr.write(f'{program}: needs the extra "cli": pip install "smartcam[cli]"\n')
    return 2
