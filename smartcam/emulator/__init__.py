"""An emulated smart camera: write and test an application without one on the desk.

::

    async with EmulatedCamera(applications=[...]) as emulator:
        emulator.url    # bvs://127.0.0.1:PORT?dialect=handbook
"""

from smartcam.emulator import faults
from smartcam.emulator.application import Application
from smartcam.emulator.bvs.device import Device
from smartcam.emulator.bvs.quirks import Quirks
from smartcam.emulator.camera import EmulatedCamera
from smartcam.emulator.clock import Clock, ManualClock, RealClock
from smartcam.emulator.faults import FiredFault
from smartcam.emulator.fleet import EmulatedFleet
from smartcam.emulator.generators import Run, register_generator
from smartcam.emulator.scenario.file import load_scenario, load_scenarios, scenario_schema
from smartcam.emulator.scenario.scenario import Scenario
from smartcam.emulator.scenario.states import DeviceState
from smartcam.emulator.scenario.timeline import Cue
from smartcam.emulator.scene import TableScene
from smartcam.emulator.traffic import LogEntry, Visit

__all__ = [
    "Application",
    "Clock",
    "Cue",
    "Device",
    "DeviceState",
    "EmulatedCamera",
    "EmulatedFleet",
    "FiredFault",
    "LogEntry",
    "ManualClock",
    "Quirks",
    "RealClock",
    "Run",
    "Scenario",
    "TableScene",
    "Visit",
    "faults",
    "load_scenario",
    "load_scenarios",
    "register_generator",
    "scenario_schema",
]
