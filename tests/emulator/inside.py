"""Private names of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.emulator._bvs.behaviour import behaviour_of
from smartcam.emulator._client_link import MAX_INPUT_BYTES, SecondClientSession, Trace
from smartcam.emulator._clock import NANOSECONDS
from smartcam.emulator._generators import _LOADED, generator_names
from smartcam.emulator._insight.commands import InSightCommands
from smartcam.emulator._insight.device import InSightDevice
from smartcam.emulator._insight.job import BUILTIN_JOBS, Control, cell_text, make_job
from smartcam.emulator._links import TcpListener, _TcpLink
from smartcam.emulator._scenario.timeline import MAX_CUES_AT_ONCE, MAX_PENDING, Timeline
from smartcam.emulator.faults import _matching
from smartcam.emulator.faults._base import WireFault
from smartcam.emulator.faults._matching import FaultQueue
from smartcam.emulator.faults._wire_effects import WireMessage, apply_faults, parse, parse_one
