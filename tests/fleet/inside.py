"""Names behind the wall of the room that several of its tests use."""

from __future__ import annotations

from smartcam.fleet._agent.agent import Agent
from smartcam.fleet._agent.gate import Gate
from smartcam.fleet._bus import zenoh
from smartcam.fleet._bus.bus import Data, Handle, MemoryEnd, Publisher
from smartcam.fleet._bus.log import AgentLog
from smartcam.fleet._bus.wire import decode, decode_order, decode_outcome, encode
from smartcam.fleet._file.standby import Standby
from smartcam.fleet._json import plain
from smartcam.fleet._program.caller import Caller
from smartcam.fleet._program.program import Program
from smartcam.fleet._program.program_name import ProgramName, in_words
from smartcam.fleet._security import renewal

__all__ = [
    "Agent",
    "AgentLog",
    "Caller",
    "Data",
    "Gate",
    "Handle",
    "MemoryEnd",
    "Program",
    "ProgramName",
    "Publisher",
    "Standby",
    "decode",
    "decode_order",
    "decode_outcome",
    "encode",
    "in_words",
    "plain",
    "renewal",
    "zenoh",
]
