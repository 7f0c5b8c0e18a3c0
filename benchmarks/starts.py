"""Whole processes: what a Python that is started and ends takes, and what it has imported by then.

They are started with ``-P -s``, so that the directory they start in plays no part; imports find
compiled files, as a second start does.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

__all__ = ["ENVIRONMENT", "Took", "imports_of", "median", "start"]

PYTHON = [sys.executable, "-P", "-s"]

NAMES = "\nimport sys; print(*sys.modules)"
"""What is asked with must not import anything itself."""

OURS = "smartcam"

PATIENCE = 120.0
"""Seconds until a process that does not end is an error."""


_NEVER_WRITTEN = "PYTHONDONTWRITEBYTECODE"
"""Where that is set, each start would compile all that it imports, and be measured for it."""

ENVIRONMENT = {name: value for name, value in os.environ.items() if name != _NEVER_WRITTEN}


class Took(NamedTuple):
    """What a process took, milliseconds.

    Attributes:
        cpu: its CPU time, user and system together.
        wall: from its start to its end.
    """

    cpu: float
    wall: float


def start(arguments: Sequence[str], environment: Mapping[str, str] = ENVIRONMENT) -> Took:
    """Run Python with these arguments and without output; return what it took."""
    command = [*PYTHON, *arguments]
    with Path(os.devnull).open("wb") as nowhere:
        begin = time.perf_counter()
        process = os.posix_spawn(
            sys.executable,
            command,
            environment,
            file_actions=[(os.POSIX_SPAWN_DUP2, nowhere.fileno(), 1)],
        )
        _, status, used = os.wait4(process, 0)
        wall = time.perf_counter() - begin
    assert status == 0, f"{command} ended with {status}"
    return Took((used.ru_utime + used.ru_stime) * 1e3, wall * 1e3)


def median(times: int, measure: Callable[[], float]) -> float:
    """Return the figure in the middle of several."""
    return statistics.median(measure() for _ in range(times))


def imports_of(code: str) -> str:
    """Return code that imports what ``code`` ends up with, in the same order, and no smartcam.

    That is the standard library's and other people's modules: what smartcam is made of, and cannot
    be without. A module that its package makes itself, and that cannot be imported by its name, is
    left out.
    """
    plain = set(_modules("pass"))
    needed = [
        name
        for name in _modules(code)
        if name not in plain and name.partition(".")[0] not in {OURS, "__mp_main__"}
    ]
    tried = "".join(
        f"try: __import__({name!r})\nexcept ImportError: missing.append({name!r})\n"
        for name in needed
    )
    missing = _said(f"missing = []\n{tried}print(*missing)").split()
    return "\n".join(f"__import__({name!r})" for name in needed if name not in missing)


def _modules(code: str) -> list[str]:
    """Return the names of the modules that are there when ``code`` has run."""
    return [name for name in _said(code + NAMES).split() if name != "__main__"]


def _said(code: str) -> str:
    """Return the last line that code prints."""
    done = subprocess.run(
        [*PYTHON, "-c", code],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=PATIENCE,
    )
    return done.stdout.rstrip("\n").rpartition("\n")[2]
