"""Start: what ``import smartcam``, a first camera and the pytest plugin cost a fresh process.

CPU time of the process, user and system together, less that of an interpreter which is started
beside it and does nothing (for pytest: the whole of it, with the plugin and without). The yardstick
of a camera is a process that imports the modules which that one has in the end, and that are not
smartcam's, in the same order, and does nothing with them: numpy is in it only if it is used.
"""

from __future__ import annotations

import tempfile
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.measure import Comparison, Goal, Plan, Series, take_turns
from benchmarks.peers import peer
from benchmarks.starts import ENVIRONMENT, imports_of, median, start

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

__all__ = ["run"]

STARTS = 3
"""Of each process in a round; the median counts."""

SMARTCAM, ASYNCIO = "import smartcam", "import asyncio"
MAKING, OPENING = "smartcam.connect(url)", "async with smartcam.connect(url)"
NEEDED = "import what it needs"
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
        codes = {SMARTCAM: SMARTCAM, ASYNCIO: ASYNCIO}
        for name, code in ((MAKING, MAKE), (OPENING, OPEN.format(port=port))):
            codes |= {name: code, f"{NEEDED}: {name}": imports_of(code)}
        starts = plan.operations(STARTS)
        series = take_turns(
            plan,
            {name: _side(code, starts) for name, code in codes.items()},
            unit="ms",
            warm_up=not plan.quick,
        )
    for case, other, most in (
        (SMARTCAM, ASYNCIO, 1.3),
        (MAKING, NEEDED, 1.2),
        (OPENING, NEEDED, 1.2),
    ):
        yardstick = series[other if other == ASYNCIO else f"{NEEDED}: {case}"]
        yield Comparison(
            "startup",
            case,
            series[case],
            Series(other, yardstick.unit, yardstick.values),
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
        environment = {**ENVIRONMENT, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
        series = take_turns(
            plan,
            {
                "with the plugin": lambda: median(
                    starts, lambda: start([*command, *loaded], environment).cpu
                ),
                "without": lambda: median(starts, lambda: start(command, environment).cpu),
            },
            unit="ms",
            warm_up=not plan.quick,
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
    return lambda: median(starts, lambda: start(["-c", code]).cpu - start(["-c", "pass"]).cpu)
