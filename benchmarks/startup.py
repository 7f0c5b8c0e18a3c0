"""Start: what ``import smartcam``, a first camera and the pytest plugin cost a fresh process.

CPU time of the process, user and system together, less that of an interpreter which is started
beside it and does nothing (for pytest: the whole of it, with the plugin and without). With ``-I``,
so that the directory it starts in plays no part; imports find compiled files, as a second start
does.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.measure import Comparison, Goal, Plan, take_turns
from benchmarks.peers import peer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

__all__ = ["run"]

STARTS = 3
"""Of each process in a round; the median counts."""

SMARTCAM, ASYNCIO, HEAVY = "import smartcam", "import asyncio", "import numpy, pydantic, construct"
MAKE = "import smartcam; smartcam.connect('bvs://127.0.0.1')"
OPEN = """
import asyncio, smartcam
async def main():
    async with smartcam.connect('bvs://127.0.0.1:{port}?dialect=handbook') as camera:
        assert camera.connected
asyncio.run(main())
"""
PYTEST = ["-m", "pytest", "-q", "-p", "no:cacheprovider"]


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure imports, a first camera, and the pytest plugin where there is one."""
    with peer("trigger", "together") as port:
        codes = {
            SMARTCAM: SMARTCAM,
            ASYNCIO: ASYNCIO,
            HEAVY: HEAVY,
            "smartcam.connect(url)": MAKE,
            "async with smartcam.connect(url)": OPEN.format(port=port),
        }
        starts = plan.operations(STARTS)
        series = take_turns(
            plan, {name: _side(code, starts) for name, code in codes.items()}, unit="ms"
        )
    for case, other, most in (
        (SMARTCAM, ASYNCIO, 1.3),
        ("smartcam.connect(url)", HEAVY, 1.5),
        ("async with smartcam.connect(url)", HEAVY, 1.5),
    ):
        yield Comparison(
            "startup",
            case,
            series[case],
            series[other],
            goal=Goal("at most", most),
            note="CPU time of a fresh process, the interpreter's own start subtracted",
        )
    plugins = [
        point.name
        for point in entry_points(group="pytest11")
        if point.dist is not None and point.dist.name == "smartcam"
    ]
    if plugins:
        yield _plugin(plan, plugins, starts)


def _plugin(plan: Plan, plugins: list[str], starts: int) -> Comparison:
    """Compare runs of pytest in a project that does not use the plugin.

    No other plugin is there: one that imports asyncio, say, would take over what it costs.
    """
    loaded = [option for name in plugins for option in ("-p", name)]
    with tempfile.TemporaryDirectory() as folder:
        test = Path(folder, "test_nothing.py")
        test.write_text("def test_nothing():\n    pass\n", encoding="ascii")
        command = [*PYTEST, "--rootdir", folder, str(test)]
        environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
        series = take_turns(
            plan,
            {
                "with the plugin": lambda: _median(
                    starts, lambda: _cpu([*command, *loaded], environment)
                ),
                "without": lambda: _median(starts, lambda: _cpu(command, environment)),
            },
            unit="ms",
        )
    return Comparison(
        "startup",
        "pytest in a project that does not use the plugin",
        series["with the plugin"],
        series["without"],
        how="more",
        goal=Goal("at most", 10, "ms"),
        note="CPU time; no other plugin is loaded",
    )


def _side(code: str, starts: int) -> Callable[[], float]:
    return lambda: _median(starts, lambda: _cpu(["-c", code]) - _cpu(["-c", "pass"]))


def _median(times: int, measure: Callable[[], float]) -> float:
    return statistics.median(measure() for _ in range(times))


def _cpu(arguments: list[str], environment: Mapping[str, str] = os.environ) -> float:
    """Run Python and return the CPU time of the process, milliseconds."""
    command = [sys.executable, "-I", *arguments]
    with open(os.devnull, "wb") as nowhere:  # noqa: PTH123
        process = os.posix_spawn(
            sys.executable,
            command,
            environment,
            file_actions=[(os.POSIX_SPAWN_DUP2, nowhere.fileno(), 1)],
        )
        _, status, used = os.wait4(process, 0)
    assert status == 0, f"{command} ended with {status}"
    return (used.ru_utime + used.ru_stime) * 1e3
