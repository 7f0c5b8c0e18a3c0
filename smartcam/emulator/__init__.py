"""An emulated smart camera: write and test an application without a real camera.

::

    async with EmulatedCamera(applications=[...]) as emulator:
        emulator.url    # bvs://127.0.0.1:PORT?dialect=handbook
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.emulator import faults
    from smartcam.emulator._application import Application
    from smartcam.emulator._bvs.quirks import Quirks
    from smartcam.emulator._camera import EmulatedCamera
    from smartcam.emulator._clock import ManualClock
    from smartcam.emulator._fleet import EmulatedFleet
    from smartcam.emulator._generators import Run, register_generator
    from smartcam.emulator._insight.camera import EmulatedInSight
    from smartcam.emulator._insight.commands import InSightQuirks
    from smartcam.emulator._insight.job import Job
    from smartcam.emulator._line_camera import LineCamera, LineClient
    from smartcam.emulator._scenario.file import load_scenario
    from smartcam.emulator._scenario.scenario import Scenario
    from smartcam.emulator._scenario.timeline import Cue
    from smartcam.emulator._scene import TablePose, TableScene
    from smartcam.emulator._ticketed_camera import TicketedCamera, TicketedClient
    from smartcam.emulator._wire_camera import WireCamera

__all__ = [
    "Application",
    "Cue",
    "EmulatedCamera",
    "EmulatedFleet",
    "EmulatedInSight",
    "InSightQuirks",
    "Job",
    "LineCamera",
    "LineClient",
    "ManualClock",
    "Quirks",
    "Run",
    "Scenario",
    "TablePose",
    "TableScene",
    "TicketedCamera",
    "TicketedClient",
    "WireCamera",
    "faults",
    "load_scenario",
    "register_generator",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "": "faults",
            "_application": "Application",
            "_bvs.quirks": "Quirks",
            "_camera": "EmulatedCamera",
            "_clock": "ManualClock",
            "_fleet": "EmulatedFleet",
            "_generators": "Run register_generator",
            "_insight.camera": "EmulatedInSight",
            "_line_camera": "LineCamera LineClient",
            "_insight.commands": "InSightQuirks",
            "_insight.job": "Job",
            "_scenario.file": "load_scenario",
            "_scenario.scenario": "Scenario",
            "_scenario.timeline": "Cue",
            "_scene": "TablePose TableScene",
            "_ticketed_camera": "TicketedCamera TicketedClient",
            "_wire_camera": "WireCamera",
        },
    )
