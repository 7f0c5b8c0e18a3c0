"""Private names of the room for its helpers of tests, or for several tests."""

from __future__ import annotations

from smartcam.fleet._agent import agent
from smartcam.fleet._agent.agent import Agent, CallNumbers
from smartcam.fleet._agent.bundle import AgentBundle, decode_bundle
from smartcam.fleet._agent.client import AgentInterpretation
from smartcam.fleet._agent.gate import Change, Gate, GateRequest
from smartcam.fleet._agent.summary import _read_cameras
from smartcam.fleet._bus import wire, zenoh
from smartcam.fleet._bus.address import CERTIFICATE_FILES, check_name, check_pattern
from smartcam.fleet._bus.bus import BusQuestion, Data, Handle, MemoryConnection, Publisher, never
from smartcam.fleet._bus.log import AgentLog, Feed
from smartcam.fleet._bus.wire import (
    ResultGroup,
    TriggerCall,
    decode,
    decode_groups,
    decode_state,
    decode_trigger,
    decode_trigger_reply,
    encode,
    encode_groups,
    encode_state,
    encode_status,
    encode_trigger,
    encode_trigger_reply,
    timestamp,
)
from smartcam.fleet._file.fleet_file import FramesEntry
from smartcam.fleet._file.standby import Standby
from smartcam.fleet._frames import camera_frames, collector
from smartcam.fleet._frames.camera_frames import FrameSupply, SharedFrames
from smartcam.fleet._frames.collector import FrameCollector, IncomingFrame
from smartcam.fleet._frames.wire import (
    MAX_FRAME_BYTES,
    FramePart,
    decode_part,
    encode_part,
    to_fields,
)
from smartcam.fleet._json import json_services
from smartcam.fleet._json.json_services import request_fields
from smartcam.fleet._json.services import SERVICES, JsonRequest
from smartcam.fleet._json.thesis import THESIS
from smartcam.fleet._operations import metric_families
from smartcam.fleet._operations.metric_families import _SUM_TEXTS
from smartcam.fleet._operations.trigger_counts import OUTCOMES, outcome_of
from smartcam.fleet._program import fleet
from smartcam.fleet._program.caller import Caller, CameraAgent, Lease
from smartcam.fleet._program.program import Program
from smartcam.fleet._program.program_name import ProgramName, in_words, names_pattern
from smartcam.fleet._security import door, renewal
from smartcam.fleet._security.access import RIGHTS, access_control, ros_rights
from smartcam.fleet._security.certificates import MAX_BYTES, ROLES, tls_context
from smartcam.fleet._security.door import ConnectionFilter
