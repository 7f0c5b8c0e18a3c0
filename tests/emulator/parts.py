"""Parts of an emulated camera by themselves, for the tests of other rooms."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.emulator import ManualClock, Quirks, Scenario
from smartcam.emulator._inside import Device
from tests.emulator.inside import (
    NANOSECONDS,
    InSightCommands,
    InSightDevice,
    Timeline,
    behaviour_of,
    generator_names,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from smartcam.emulator import Application
    from smartcam.emulator.faults import Fault
    from smartcam.protocols import FramedDialect

__all__ = ["course", "generator_names", "insight", "made_device", "pass_time"]


def made_device(
    applications: Iterable[Application], dialect: FramedDialect, quirks: Quirks, **options: Any
) -> Device:
    """Return a device that behaves as its dialect says."""
    return Device(applications, quirks=quirks, behaviour=behaviour_of(dialect, quirks), **options)


def insight(jobs: Sequence[Mapping[str, Any]]) -> tuple[InSightDevice, InSightCommands]:
    """Return an In-Sight camera that is online, and its commands."""
    device = InSightDevice(jobs, online=True)
    return device, InSightCommands(device)


def pass_time(device: InSightDevice, seconds: float) -> None:
    """Advance a device's time."""
    device.advance_to(device.now + round(seconds * NANOSECONDS))


def course(scenario: Scenario) -> list[tuple[float, str]]:
    """Return a timeline with events in half a second, and on every command."""
    clock = ManualClock()
    happened: list[tuple[float, str]] = []

    def inject(do: Sequence[Fault]) -> None:
        happened.extend((clock.now, fault.kind) for fault in do)

    cues = scenario.timeline[:20]
    timeline = Timeline(cues, clock=clock, seed=scenario.seed, inject=inject)
    timeline.start()
    for command in sorted({cue.command for cue in cues if cue.command is not None}):
        timeline.command(command)
    clock.advance(0.5)
    timeline.stop()
    return happened
