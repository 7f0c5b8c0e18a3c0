"""The commands ``smartcam`` and ``smartcam-emulator``; each calls the library."""

from __future__ import annotations

import importlib
import importlib.util
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
        except ModuleNotFoundError:
            sys.exit(_report_missing_extra(program))
        # PyYAML is a package, a module of the same name is not it
        yaml = importlib.util.find_spec("yaml")
        if yaml is None or yaml.submodule_search_locations is None:
            sys.exit(_report_missing_extra(program))
        command = importlib.import_module(f"smartcam._cli.{module}").command
    except KeyboardInterrupt:  # Ctrl-C while still importing
        sys.exit(130)
    command(prog_name=program)


def _report_missing_extra(program: str) -> int:
    sys.stderr.write(f'{program}: needs the extra "cli": pip install "smartcam[cli]"\n')
    return 2
