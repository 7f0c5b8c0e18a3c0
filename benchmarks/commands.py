"""Commands: what ``smartcam`` takes in a shell, from the start of its process to its end.

The whole process, the interpreter's own start included: wall clock and CPU time. It is started as
the script in ``bin`` starts it. For a trigger there is an emulated camera in a process of its own,
and the yardstick is a process that imports what that command has imported in the end and is not
smartcam's; for the others it is a Python that does nothing.
"""

from __future__ import annotations

import sys
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Literal

from benchmarks.measure import Comparison, Goal, Plan, Series
from benchmarks.peers import peer
from benchmarks.peers.control import Control
from benchmarks.starts import Took, imports_of, start

if TYPE_CHECKING:
    from collections.abc import Iterable

    from benchmarks.measure import How

__all__ = ["run"]

STARTS = 3
"""Of each process in a round."""

NOTHING, NEEDED = "a Python that does nothing", "import what it needs"

QUICK = Goal("at most", 100, "ms")
"""Of a command that only says something."""


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure what only says something, and a trigger."""
    script = _script()
    if script is None:
        print("commands: left out: smartcam is not installed here", file=sys.stderr)
        return
    with peer("emulated", "1", "0", "constant") as control:
        (port,) = Control(control).usage().ports
        url = f"bvs://127.0.0.1:{port}?dialect=handbook"
        commands = {
            "smartcam --help": ["--help"],
            "smartcam --version": ["--version"],
            "smartcam trigger URL": ["trigger", url, "--interpret-as", "localizations"],
        }
        codes = {name: f"arguments = {words!r}\n{script}" for name, words in commands.items()}
        trigger = codes["smartcam trigger URL"]
        codes |= {NOTHING: "pass", NEEDED: imports_of(f"{trigger}")}
        took = _take(plan, codes)
    for name in commands:
        yardstick, goal = (NEEDED, None) if "trigger" in name else (NOTHING, QUICK)
        yield _compared(f"{name}, wall clock", took, (name, yardstick), "wall", "alone", goal)
        yield _compared(f"{name}, CPU", took, (name, yardstick), "cpu", "ratio", None)


def _compared(
    case: str,
    took: dict[str, list[Took]],
    names: tuple[str, str],
    what: Literal["cpu", "wall"],
    how: How,
    goal: Goal | None,
) -> Comparison:
    subject, yardstick = (
        Series(name, "ms", [getattr(one, what) for one in took[name]]) for name in names
    )
    return Comparison("commands", case, subject, yardstick, how, goal)


def _take(plan: Plan, codes: dict[str, str]) -> dict[str, list[Took]]:
    """Start each in turns; the first round, which compiles and warms up, is dropped."""
    took: dict[str, list[Took]] = {name: [] for name in codes}
    for number in range(1 if plan.quick else plan.rounds * STARTS + 1):
        for name, code in codes.items():
            one = start(["-c", code])
            if number or plan.quick:
                took[name].append(one)
    return took


def _script() -> str | None:
    """Return the code of the command's script; None where it is not installed."""
    for point in entry_points(group="console_scripts", name="smartcam"):
        return (
            "import sys; sys.argv = ['smartcam', *arguments]\n"
            f"from {point.module} import {point.attr}\n"
            f"try: {point.attr}()\n"
            "except SystemExit as ended:\n"
            "    if ended.code: raise"
        )
    return None
