"""Layouts: what a camera with a layout takes more than one without, where others have the same.

A thousand cameras are made, not opened, as a fleet's program makes them: with one text of a layout
for all. Time is CPU time, memory what Python's allocator counts (``tracemalloc``).
"""

from __future__ import annotations

import gc
import time
import tracemalloc
from functools import partial
from typing import TYPE_CHECKING

import smartcam
from benchmarks.measure import Comparison, Cost, Goal, Plan, cpu_microseconds, take_turns
from benchmarks.stream import LAYOUT

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["run"]

CAMERAS = 1_000
"""In a round of each side."""

WITH, WITHOUT = "with a layout", "without"

GOAL_TIME, GOAL_MEMORY = Goal("at most", 25, "us"), Goal("at most", 0.5, "KiB")


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure time and memory."""
    count = plan.operations(CAMERAS, least=20)
    case = "a camera with the layout of others"
    took = take_turns(plan, {name: partial(_time, name, count) for name in (WITH, WITHOUT)})
    yield Comparison("layouts", f"{case}, time", took[WITH], took[WITHOUT], "more", GOAL_TIME)
    memory = {name: partial(_memory, name, count) for name in (WITH, WITHOUT)}
    holds = take_turns(plan, memory, unit="KiB")
    yield Comparison("layouts", f"{case}, memory", holds[WITH], holds[WITHOUT], "more", GOAL_MEMORY)


def _make(which: str, count: int) -> list[smartcam.Camera]:
    parts = [LAYOUT] if which == WITH else ["raw"]
    # a text of its own for each, as of a file
    return [
        smartcam.connect("bvs://127.0.0.1", interpret_as="".join([*parts, ""]))
        for _ in range(count)
    ]


def _time(which: str, count: int) -> Cost:
    begin = time.process_time()
    made = _make(which, count)
    cost = cpu_microseconds(begin, count)
    assert len(made) == count
    return cost


def _memory(which: str, count: int) -> Cost:
    tracemalloc.start()
    try:
        made = _make(which, count)
        gc.collect()
        size, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return size / 1024 / len(made)
