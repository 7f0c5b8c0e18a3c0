"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.emulator._bvs.device import Device, LastReport
    from smartcam.emulator._camera import CONDITIONS
    from smartcam.emulator._client_link import ClientLink
    from smartcam.emulator._clock import Clock, RealClock, TimerHandle
    from smartcam.emulator._evaluating import EvaluatingCamera, applications_of, request
    from smartcam.emulator._generators import Values, find_generator, wrap_number
    from smartcam.emulator._insight.job import InspectedJob
    from smartcam.emulator._inspected import InspectedApplication, InspectionOrder, Inspector
    from smartcam.emulator._line_codec import HeardLine, LineCodec, LineServer
    from smartcam.emulator._makes import check_options, emulated_class, options_of
    from smartcam.emulator._scenario.file import load_scenarios, scenario_schema
    from smartcam.emulator._scene import PIECES, TABLE_SIZE, Observation
    from smartcam.emulator._tally import Tally
    from smartcam.emulator._traffic import EndedConnection, LogEntry
    from smartcam.emulator.faults import FiredFault
    from smartcam.emulator.faults._base import MESSAGE_NAMES, BaseFault, DeviceFault, known_name
    from smartcam.emulator.faults._delay_line import DelayLine, Ending, Transmission
    from smartcam.emulator.faults._wire_effects import WireCodec

__all__ = [
    "CONDITIONS",
    "MESSAGE_NAMES",
    "PIECES",
    "TABLE_SIZE",
    "BaseFault",
    "ClientLink",
    "Clock",
    "DelayLine",
    "Device",
    "DeviceFault",
    "EndedConnection",
    "Ending",
    "EvaluatingCamera",
    "FiredFault",
    "HeardLine",
    "InspectedApplication",
    "InspectedJob",
    "InspectionOrder",
    "Inspector",
    "LastReport",
    "LineCodec",
    "LineServer",
    "LogEntry",
    "Observation",
    "RealClock",
    "Tally",
    "TimerHandle",
    "Transmission",
    "Values",
    "WireCodec",
    "applications_of",
    "check_options",
    "emulated_class",
    "find_generator",
    "known_name",
    "load_scenarios",
    "options_of",
    "request",
    "scenario_schema",
    "wrap_number",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_scenario.file": "scenario_schema load_scenarios",
            "faults": "FiredFault",
            "_traffic": "EndedConnection LogEntry",
            "_bvs.device": "Device LastReport",
            "_camera": "CONDITIONS",
            "_client_link": "ClientLink",
            "_clock": "Clock RealClock TimerHandle",
            "_evaluating": "EvaluatingCamera applications_of request",
            "_generators": "Values find_generator wrap_number",
            "_insight.job": "InspectedJob",
            "_inspected": "InspectedApplication InspectionOrder Inspector",
            "_line_codec": "HeardLine LineCodec LineServer",
            "_makes": "check_options emulated_class options_of",
            "_scene": "Observation PIECES TABLE_SIZE",
            "_tally": "Tally",
            "faults._base": "BaseFault DeviceFault MESSAGE_NAMES known_name",
            "faults._delay_line": "DelayLine Ending Transmission",
            "faults._wire_effects": "WireCodec",
        },
    )
