"""Target ``scenario``: any text as a scenario file of the emulator.

Input: the file.
"""

from __future__ import annotations

import atexit
import functools
import os
import tempfile
import tracemalloc
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from smartcam.emulator import Scenario
from smartcam.emulator._inside import Device, load_scenarios
from smartcam.exceptions import ConfigurationError
from smartcam.protocols import messages as m
from tests.emulator.parts import course

if TYPE_CHECKING:
    from collections.abc import Generator


GREEDY = (b"slots", b"&")
"""Words that can make much of little; only with these is memory measured, which takes time."""

MEMORY = 16 << 20
"""Bytes that loading a file may take: a container has 64 KiB, an input here far less."""


@functools.cache
def scratch() -> Path:
    """Return the file that the inputs are written to, one after the other."""
    handle, name = tempfile.mkstemp(prefix="smartcam-fuzz-", suffix=".yaml")
    os.close(handle)
    path = Path(name)
    atexit.register(path.unlink, missing_ok=True)
    return path


@contextmanager
def measured() -> Generator[None]:
    """Fail where the body takes more memory than any file should."""
    tracemalloc.start()
    try:
        yield
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < MEMORY, f"too much memory for one file: {peak >> 20} MiB"


def check(data: bytes) -> None:
    """Load a file: a scenario that makes a camera, or an error that names the file."""
    path = scratch()
    path.write_bytes(data)
    try:
        with measured() if any(word in data for word in GREEDY) else nullcontext():
            scenarios = load_scenarios(path)
    except ConfigurationError as error:
        text = str(error)
        assert text.startswith(f"scenario {path}")
        assert "MemoryError" not in text, "too much memory for one file"
        return
    for scenario in scenarios[:3]:
        assert Scenario.model_validate(scenario.model_dump(exclude_unset=True)) == scenario
        check_camera(scenario)
        check_timeline(scenario)


def check_camera(scenario: Scenario) -> None:
    """The camera of a scenario does what each of its applications says."""
    applications = scenario.all_applications
    if not applications:
        return
    active = scenario.active if scenario.active is not None else applications[0].id
    device = Device(applications, active=active, running=scenario.running, quirks=scenario.quirks)
    device.handle(m.Connect())
    for application in scenario.applications[:3]:
        device.handle(m.Stop())
        device.handle(m.SwitchApplication(application=application.id))
        device.tick(application.load_time)
        assert device.active_application == application.id
        device.handle(m.Start())
        device.handle(m.Trigger())
        device.tick(min(application.processing_time, 1.0))
        assert device.take_output()


def check_timeline(scenario: Scenario) -> None:
    """Its timeline runs, and does so again in the same way."""
    first, second = course(scenario), course(scenario)
    assert first == second
