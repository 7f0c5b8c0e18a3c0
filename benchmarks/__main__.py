"""``python -m benchmarks``: run them, print the table."""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks import instructions, runs
from benchmarks.measure import Comparison, Curve, Plan
from benchmarks.report import as_json, markdown, notes, table

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__: list[str] = []

BENCHMARKS = {
    "trigger": "await trigger() against a bare protocol and pymodbus, over TCP and UDP",
    "questions": "query_application(), and connect and close, above a bare protocol",
    "sync": "camera.trigger() without asyncio, above await of it",
    "stream": "results as fast as the link gives them, one by one and in batches",
    "decode": "from a container's bytes to a table, localizations, texts",
    "large": "containers of 1 kB to 1 MB",
    "fleet": "10, 100 and 1,000 cameras in one process",
    "bus": "triggers and results through a fleet's agent, above a camera at the wire",
    "outlets": "triggers beside an outlet whose far end is stalled, above those without",
    "plant": "5,000 cameras of four agents: a newcomer, a question to all, results, memory",
    "flood": "trigger latency of 99 cameras beside one that sends as fast as the link takes it",
    "emulator": "triggers that emulated cameras answer, one and 1,000 of them",
    "startup": "import smartcam, and the first connect",
    "commands": "smartcam --help, --version and trigger in a shell",
    "layouts": "a camera whose layout others have, too: time and memory",
    "recorder": "what a recording adds to a result",
    "insight": "a picture of 1 MB from an In-Sight camera",
    "calibration": "error and predicted error of a plane over the bound, points and poses a second",
    "corners": "error of corners and dots in images over the bound, and time for an image",
    "stereo": "squares of OpenCV's pairs that were left out; boards against dots",
    "hand_eye": "error of a camera on a robot over the bound, and of recorded poses left out",
    "frames": "a frame to its readers and to a JPEG, and the delay of the loop",
    "pixels": "colours and brightness of pixel formats, beside OpenCV alone",
    "inspection": "a software camera's trigger above its tools, and the delay of the loop",
    "locate": "a taught part in 1.3 MP at any angle, and nothing there, beside OpenCV",
    "pictures": "bytes of a picture at the same PSNR, and the CPU time of codecs",
    "transports": "pictures from stamp to stamp: bus, RTP, on request, GStreamer, rospy",
    "ros2": "pictures, calls and detections without ROS, and what a camera's node adds to it",
    "scaling": "cost of a message over 10^3 to 10^6 of them",
}
"""Modules of this package with a ``run(plan)``, and what they measure."""


PROCESSES = {"trigger": 5, "stream": 5, "fleet": 3, "emulator": 3}
"""Those that are measured in several processes, and in how many at most."""

ROUNDS = 5
"""Of each side in each of several processes, at most."""


def main(arguments: list[str] | None = None) -> int:
    """Run what is asked for; return 1 where a goal of a full run is missed."""
    parser = _parser()
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in BENCHMARKS]
    if unknown:
        parser.error(f"no benchmark is called {', '.join(unknown)}")
    for name in ("rounds", "processes"):
        if getattr(options, name) < 1:
            parser.error(f"--{name}: 1 or more")
    plan = _plan(options)
    comparisons: list[Comparison] = []
    curves: list[Curve] = []
    took: dict[str, float] = {}
    for name in options.names or BENCHMARKS:
        begin = time.monotonic()
        for found in _run(name, plan):
            if isinstance(found, Curve):
                curves.append(found)
            else:
                comparisons.append(found)
        took[name] = time.monotonic() - begin
        print(f"{name}: {took[name]:.0f} s", file=sys.stderr)
    print(table(comparisons), notes(comparisons), sep="\n\n")
    facts = as_json(comparisons, curves, took)
    if options.json is not None:
        _write(options.json, json.dumps(facts, indent=1))
    if options.results is not None:
        from benchmarks import plots

        _write(options.results / "results.json", json.dumps(facts, indent=1))
        pictures = plots.write(curves, comparisons, options.results)
        _write(options.results / "results.md", markdown(comparisons, pictures, facts, BENCHMARKS))
    missed = [one for one in comparisons if one.met is False]
    return 1 if missed and not plan.quick else 0


def _plan(options: argparse.Namespace) -> Plan:
    """Return what the options ask for: a quick one begins no processes and counts nothing."""
    count = instructions.wanted(
        asked=(not options.quick if options.instructions is None else options.instructions)
    )
    if options.quick:
        return Plan(rounds=1, scale=0.02, instructions=count)
    return Plan(options.rounds, 1.0, processes=options.processes, instructions=count)


def _run(name: str, plan: Plan) -> Iterable[Comparison | Curve]:
    """Run one: in processes of its own where these differ, and there are to be several."""
    if name in PROCESSES and plan.processes > 1:
        processes = min(plan.processes, PROCESSES[name])
        rounds = min(plan.rounds, ROUNDS)
        return runs.run(dataclasses.replace(plan, rounds=rounds, processes=processes), name)
    found: Iterable[Comparison | Curve] = importlib.import_module(f"benchmarks.{name}").run(plan)
    return found


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure smartcam and its yardsticks side by side. Exit code 1: a goal missed.",
        epilog="; ".join(f"{name}: {about}" for name, about in BENCHMARKS.items()),
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="which ones; default: all")
    parser.add_argument("--quick", action="store_true", help="only see that all of it works")
    parser.add_argument("--rounds", type=int, default=9, help="of each side; default: %(default)s")
    parser.add_argument(
        "--processes",
        type=int,
        default=5,
        metavar="N",
        help=f"how often {', '.join(PROCESSES)} are measured, each time in a new process, as what "
        "they cost varies with it; one with --quick; default: %(default)s, or fewer where it takes "
        "long",
    )
    parser.add_argument(
        "--instructions",
        action=argparse.BooleanOptionalAction,
        help="count the instructions of an operation, too, where valgrind is installed: this takes "
        "another five minutes; default: in a full run",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure to FILE")
    parser.add_argument(
        "--results", type=Path, metavar="DIR", help="write figures, tables and plots to DIR"
    )
    return parser


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
