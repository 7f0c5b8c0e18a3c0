"""Every public argument, what may be given for it, and odd values that may not.

A new argument without an entry here fails ``test_arguments.py``.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

MODULES = (
    "smartcam",
    "smartcam.sync",
    "smartcam.fleet",
    "smartcam.frames",
    "smartcam.conformance.camera",
    "smartcam.conformance.client",
    "smartcam.emulator",
    "smartcam.testing",
    "smartcam.doctor",
    "smartcam.recording",
    "smartcam.outlets",
    "smartcam.inspection",
)


class BrokenInteger(int):
    """An integer that does not say which."""

    def __index__(self) -> int:
        raise ZeroDivisionError


class BrokenText(str):
    """A text that does nothing as a text does."""

    __hash__ = str.__hash__

    def __eq__(self, other: object) -> bool:
        raise ZeroDivisionError

    def __len__(self) -> int:
        raise ZeroDivisionError

    def __repr__(self) -> str:
        raise ZeroDivisionError


ODD: dict[str, Any] = {
    "1.5": 1.5,
    "nan": float("nan"),
    "inf": float("inf"),
    "-1": -1,
    "-0.5": -0.5,
    "2**32": 1 << 32,
    "2**64": 1 << 64,
    "10**400": 10**400,
    "10**5000": 10**5000,
    "1j": 1j,
    "None": None,
    "empty text": "",
    "text": "x",
    "text without bytes": "\ud800",
    "text of a megabyte": "x" * 1_000_000,
    "broken text": BrokenText("x"),
    "no bytes": b"",
    "bytes": b"x",
    "list": [],
    "dict": {},
    "object": object(),
    "True": True,
    "broken integer": BrokenInteger(3),
    "numpy integer": np.int64(3),
    "numpy number": np.float64(0.5),
    "numpy truth": np.bool_(True),
    "numpy array": np.arange(2.0),
}
"""Values by their names."""

_INTEGER = frozenset({"numpy integer"})
_NUMBER = frozenset({"1.5", "numpy integer", "numpy number", "broken integer"})
_HUGE = frozenset({"2**32", "2**64", "10**400", "10**5000"})
_TEXT = frozenset({"text", "broken text"})
_NONE = frozenset({"None"})
_ALL = frozenset(ODD)

KINDS: dict[str, frozenset[str]] = {
    "seconds": _NUMBER,
    "seconds or None": _NUMBER | _NONE,
    "seconds or default": _NUMBER | _NONE,
    "age": _NUMBER | {"inf", "2**32", "2**64"},
    "moment": _NUMBER | {"-1", "-0.5", "2**32", "2**64"},
    "moment or None": _NUMBER | {"-1", "-0.5", "2**32", "2**64"} | _NONE,
    "number": _NUMBER,
    "number or None": _NUMBER | _NONE,
    "any number": _NUMBER | {"-1", "-0.5"},
    "integer": _INTEGER,
    "integer or None": _INTEGER | _NONE,
    "seed": _INTEGER | {"-1", "2**32"},
    "seed or None": _INTEGER | {"-1", "2**32"} | _NONE,
    "count": _INTEGER | _HUGE,
    "count or None": _INTEGER | _HUGE | _NONE,
    "application or name": _INTEGER | _TEXT,
    "flag": frozenset({"True", "numpy truth"}),
    "flag or None": frozenset({"True", "numpy truth"}) | _NONE,
    "bytes": frozenset({"bytes", "no bytes", "numpy array"}),
    "bytes or None": frozenset({"bytes", "no bytes", "numpy array"}) | _NONE,
    "choice": frozenset(),
    "choice or None": _NONE,
    "text": _TEXT,
    "text or None": _TEXT | _NONE,
    "any text": _TEXT | {"empty text"},
    "any text or None": _TEXT | {"empty text"} | _NONE,
    "text or integer": _TEXT | _INTEGER | {"empty text"},
    "pattern": _TEXT,
    "url": frozenset(),
    "path or url": _TEXT,
    "reading": _NONE | {"dict"},
    "function": frozenset(),
    "function or None": _NONE,
    "object": frozenset(),
    "object or None": _NONE,
    "pixels": frozenset({"numpy array"}),
    "list": frozenset({"list", "dict"}),
    "names": frozenset({"list"}),
    "mapping": frozenset({"dict"}),
    "mapping or None": frozenset({"dict"}) | _NONE,
    "message id": _INTEGER | _TEXT,
    "pair": frozenset(),
    "feature value": _NUMBER
    | _HUGE
    | _TEXT
    | {"-1", "-0.5", "empty text", "True", "numpy truth", "broken integer"},
    "not judged": _ALL,
}
"""The odd values that each kind admits; all others are refused."""


def _table(text: str) -> dict[str, dict[str, str]]:
    """Return the arguments' kinds by callable: ``NAME  ARGUMENT: KIND, ...`` on each line.

    A line that begins with spaces goes on with the callable before it.
    """
    rows = (row.partition("  ") for row in text.replace("\n    ", " ").strip().splitlines())
    return {
        name: dict(one.split(": ") for one in arguments.split(", ")) if arguments else {}
        for name, _, arguments in rows
    }


CAMERA = _table("""
application  application: integer
events  max_queue: count, overflow: choice
frame_after  moment: moment or None, encoding: choice, quality: integer or None, timeout: seconds
frames  encoding: choice, quality: integer or None, bitrate: not judged, latency: number or None,
    decode: flag, timeout: seconds or None
get_clock  timeout: seconds or default
newest_frame  max_age: age, encoding: choice, quality: integer or None, timeout: seconds
next_result  timeout: seconds
query_application  timeout: seconds or default
query_status  timeout: seconds or default
read_image  timeout: seconds or default
request  message_id: message id, payload: bytes, answered: flag or None, timeout: seconds or default
reserve  timeout: seconds
reset_errors  timeout: seconds or default
results  batch: flag, min_interval: seconds, max_queue_bytes: count, max_queue: count,
    overflow: choice
set_clock  when: object
set_input  data: bytes
set_sequence_number  number: integer
start  timeout: seconds
statuses  min_interval: seconds, max_queue: count, overflow: choice
stop  timeout: seconds
switch_application  application: application or name, timeout: seconds or default
take_back  timeout: seconds or default
trigger  application: integer or None, interpret_as: reading, input: bytes or None,
    timeout: seconds, when_busy: choice, results_per_trigger: integer or None
wait_connected  timeout: seconds
wait_ready  timeout: seconds
wait_status  predicate: function, timeout: seconds
""")
"""Of each method of a camera, at the wire, in a fleet, and without asyncio."""

OPTIONS: dict[str, str] = {
    "name": "any text",
    "application": "integer or None",
    "application_names": "mapping",
    "interpret_as": "reading",
    "calibration": "not judged",
    "y_down": "flag",
    "lenient": "flag",
    "connect_timeout": "seconds",
    "connect_attempts": "integer",
    "switch_timeout": "seconds",
    "request_timeout": "seconds",
    "close_timeout": "seconds",
    "liveness_timeout": "seconds or None",
    "reconnect": "function or None",
    "restore": "flag",
    "max_length": "not judged",  # its least value is 16
}
"""Of each option of ``connect()``."""

TABLE = {
    f"{kind}.{method}": kinds
    for kind in ("Camera", "SmartCamera", "FleetCamera", "SyncCamera")
    for method, kinds in CAMERA.items()
} | _table("""
connect  url: path or url, model: text or None, observers: list
find  networks: text, ports: list, protocols: not judged, exclude: list, may_disturb: flag,
    ask: flag, rate: number, at_once: integer, timeout: seconds, max_addresses: integer
examine  url: path or url, application: integer or None, interpret_as: reading, y_down: flag,
    trigger: flag, timeout: seconds or default, seconds: seconds, count: integer,
    trace: function or None
Backoff.__init__  initial: seconds, factor: not judged, maximum: seconds, jitter: not judged,
    attempts: count or None, transient: function
SyncSubscription.get  timeout: seconds
FleetCamera.frame_source  encoding: choice, quality: integer or None
Fleet.agents  pattern: pattern
Fleet.cameras  pattern: pattern
Fleet.events  max_queue: count, overflow: choice
Fleet.find_cameras  pattern: pattern
Fleet.names  pattern: pattern
Fleet.reload  agent: choice or None, timeout: seconds
Fleet.results  pattern: pattern, min_interval: seconds, max_queue_bytes: count, max_queue: count,
    overflow: choice
Fleet.status  pattern: pattern, timeout: seconds
Fleet.outlets  timeout: seconds
Fleet.stored_results  pattern: pattern, since: function or None, only_failed: flag,
    max_rows: integer, timeout: seconds
Fleet.trigger  pattern: url, timeout: seconds
Outlets.__init__  section: mapping, folder: text, columns: function, command: function or None,
    cameras: function, application_names: function, on_trouble: function
Outlets.stored  query: object
Fleet.url_of  name: text
fleet.open  address_or_file: url, connect_timeout: seconds
FrameSource.__init__  driver: not judged, camera_info: not judged, timeout: seconds or None,
    stall: seconds or None, linger: seconds
FrameSource.reader  timeout: seconds or None
FrameSource.newest  max_age: age, timeout: seconds or None
FrameSource.after  moment: moment, timeout: seconds or None
FrameSource.trigger  timeout: seconds, when_busy: choice, fire: function or None
FrameSource.events  names: any text, size: integer, timeout: seconds or None
FrameFeatures.__getitem__  name: any text
FrameFeatures.names  timeout: seconds
FrameFeatures.describe  timeout: seconds
FrameFeatures.load  user_set: any text, timeout: seconds
FrameFeatures.save  user_set: any text, timeout: seconds
FrameFeatures.load_at_power_on  user_set: any text, timeout: seconds
FrameFeature.get  timeout: seconds
FrameFeature.describe  timeout: seconds
FrameFeature.set  value: feature value, timeout: seconds
FrameFeature.execute  timeout: seconds
FrameReader.newest  max_age: age, timeout: seconds or None
FrameReader.after  moment: moment, timeout: seconds or None
FrameReader.wait_newer  since: moment, until: moment
FrameGroup.__init__  sources: object, within: seconds or None, timeout: seconds or None
frames.open  url: path or url, camera_info: not judged, timeout: seconds or None,
    stall: seconds or None, linger: seconds
find_format  name: text or integer
discover  scheme: choice or None
Codecs.__init__  threads: integer
RateControl.__init__  bitrate: not judged, latency: number or None, quality: pair, fps: pair
Codecs.converted  frame: object, format: any text
Codecs.decode  frame: object, format: any text
Codecs.jpeg  frame: object, quality: integer
Codecs.jpegxl  frame: object
Codecs.png  frame: object
Codecs.h264_encoder  fps: number, keyint: integer, crf: number, bitrate: choice or None
RtpSender.__init__  source: object, to: url, fps: number or None, crf: number,
    bitrate: choice or None, keyint: integer, payload_type: choice, ttl: integer
RtspServer.__init__  sources: object, host: text, port: integer, user: not judged,
    password: not judged, basic: flag, bitrate: choice or None, crf: number, fps: number or None,
    keyint: integer, max_connections: integer, max_viewers: integer
RtspServer.url  name: choice
ConformanceOptions.__init__  url: text, application: integer or None,
    other_application: integer or None, allow: object, timeout: seconds, silence: seconds,
    switch_timeout: seconds, reboot_timeout: seconds, sequence_offset: integer or None,
    input_data: bytes or None
judge  options: object, names: not judged
Layout.__init__  text: text, lenient: flag, start: integer
load_fleet  path: text
load_scenario  path: text, dialect: text or None
load_scenarios  path: text, dialect: text or None
EmulatedFleet.__init__  scenarios: list, host: text, transport: choice or None,
    dialect: choice or None, quirks: not judged, clock: not judged
Recorder.__init__  path: text, overwrite: flag, pictures: flag
CellCamera.program  application: application or name
Inspection.payload  byte_order: choice, sequence: seed or None
PartModel.from_outline  path: text, pixels_per_mm: number, name: text, bright: flag,
    unit: choice or None, layers: names
PartModel.predicted_sigma  noise: number or None
PartModel.read  path: text
PartModel.teach  picture: pixels, region: object or None, name: text, contrast: number or None
PartModel.write  path: text
Picture.__init__  pixels: pixels, depth: integer or None, frame: object or None
Picture.of  source: pixels
Picture.read  path: text
Program.inspect  source: pixels, input: bytes
SoftwareCamera.read_drawn_image  timeout: seconds or default
SoftwareCamera.read_judged_image  result: object, drawn: flag, timeout: seconds or default
SoftwareDevice.__init__  camera: object, protocol: choice, host: text, port: integer,
    transport: choice or None, dialect: choice or None, quirks: mapping or None, seed: seed or None
Teaching.__init__  path: text, camera: text, application: count
Teaching.program  tools: mapping
Teaching.save  tools: mapping
load_cell  path: text
make_camera  name: any text, software: object, folder: text
register_tool  name: text, tool: object
software_mistakes  name: any text, software: object, folder: text
Recorder.add_picture  frame: object, camera: any text, result: choice or None
RotatingRecorder.__init__  path: text, size: count, age: seconds, keep: count, on_trouble: function
RotatingRecorder.add_picture  frame: object, camera: any text
Recording.camera  name: text or None
Recording.all_items  camera: text or None
Recording.errors  camera: text or None
Recording.events  camera: text or None
Recording.frames  camera: text or None
Recording.items  camera: text or None
Recording.results  camera: text or None
Recording.pictures  camera: text or None
Recording.results_with_pictures  camera: text or None
FleetRecorder.__init__  server: object, section: choice or None, on_trouble: function,
    _clock: not judged
FleetReplay.__init__  recording: object, speed: number, loop: flag, on_over: function or None,
    cameras: choice or None, listen: text
ReplayedCamera.__init__  recording: object, speed: number, loop: flag, on_over: function or None,
    camera: text or None, host: text, port: integer, transport: choice or None,
    dialect: choice or None, quirks: mapping or None, clock: not judged, name: any text or None
load_recording  path: text, since: choice or None, until: choice or None
replay  recording: object, speed: number, loop: flag, on_over: function or None,
    camera: text or None
write_bag  recording: object, path: text, camera: text or None, interpret_as: reading,
    y_down: flag or None, calibration: choice or None, overwrite: flag
write_pcap  recording: object, path: text, camera: text or None, overwrite: flag
Device.change_inspection  late: seconds, no_result: flag, extra: integer
Device.drop_triggers  count: count
Device.hold_busy  seconds: seconds or None
Device.reboot  seconds: seconds or None
Device.set_condition  condition: object, on: flag
Device.set_endian  endian: integer
Device.switch_application  application: integer, running: flag
Device.tick  dt: seconds
EmulatedCamera.__init__  applications: list, scenario: not judged, transport: choice or None,
    dialect: choice or None, quirks: not judged, name: not judged, active: integer or None,
    running: flag or None, builtins: flag or None, faults: list, timeline: list, host: text,
    port: integer or None, clock: not judged, seed: seed or None
WireCamera.command  name: choice
WireCamera.inject  faults: object
WireCamera.wait_received  what: integer, count: count, timeout: seconds
EmulatedInSight.__init__  jobs: list, users: mapping or None, model: text, active: not judged,
    online: flag, image: not judged, evaluations: mapping or None, info: mapping or None,
    quirks: not judged
EmulatedInSight.answer_next  code: seed, command: text or None
EmulatedInSight.load  job: choice
EmulatedInSight.set_online  online: flag
EmulatedInSight.wait_heard  command: text, count: count, timeout: seconds
ManualClock.advance  seconds: seconds
ManualClock.call_at  when: moment, callback: function
TableScene.__init__  scale: number, offset: pair, rotation: any number, pixel_noise: number,
    seed: seed, y_down: flag
CameraLog.expect  expected: integer, only: flag, timeout: seconds
CameraLog.expect_disconnect_before_close  timeout: seconds
CameraLog.expect_nothing_while_busy  also: object, grace: seconds, timeout: seconds
ThreadedCamera.__init__  protocol: choice, manual_clock: flag
ThreadedCamera.advance  seconds: seconds
ThreadedCamera.command  name: choice
ThreadedCamera.inject  faults: object
ThreadedCamera.received  what: integer, count: count, timeout: seconds
ThreadedCamera.run  function: function
ThreadedCamera.wait_received  what: integer, count: count, timeout: seconds
""")
"""The kinds of arguments of each public callable; positional and keyword alike.
What is "not judged" may be an odd value, or has a test of its own."""

NOT_HERE: dict[str, str] = {
    "only the search for parts calls it": "PartModel.bands_at",
    "the package makes these, or a function that is in the table": """
        ApplicationChanged CameraEvent Capabilities Connected Disconnected Histogram
        NoticeReceived Reconnected Statistics StatusChanged Quaternion AgentJoined AgentLeft
        CameraJoined CameraLeft FleetEvent ReservationLost FleetFrame Feature FrameEvents
        FrameTrigger AwaitedTrigger FrameFeatures.__init__ FrameFeature.__init__ FoundSource
        Frame FrameSet PixelFormat ReaderStatistics SourceStatistics FrameAddress Finding
        FoundPort H264Encoder H264Decoder Camera.__init__ SmartCamera.__init__
        Recording.__init__ FleetCamera.__init__ FleetCamera.agent_left FleetCamera.connect_to_agent
        Fleet.__init__ FrameReader.__init__ SyncCameraBase.__init__
        SyncSubscription.__init__ SyncFrameReaderBase SyncFrameReader CameraLog.__init__
        ThreadedCamera.in_thread Backoff.delays WireCamera.__init__ Device.__init__
        CellCamera.__init__ Drawing View Inspection.__init__ PixelPose Pose.with_sigma
        Program.__init__ ToolSetup SoftwareCamera.__init__ LocatedPart.__init__
        PartModel.__init__
    """,
    "what a driver, an observer, a client or another make of camera does or is told": """
        Observer FrameDriver FrameSink FrameSource.attach FrameSource.ended
        FrameSource.frame FrameSource.lost FrameSource.skipped RateControl.record_arrival
        DeviceFeatures FrameSource.trigger_failed FrameSource.watch_events
        FrameSource.wait_until_streaming Outlet OutletContext Outlets.offer_result
        Outlets.offer_error Outlets.state_changed Device.handle Device.watch LineClient
        LineCamera TicketedClient TicketedCamera Recorder.describe Recorder.on_error
        Recorder.on_frame Recorder.on_result Recorder.on_raw_frames Recorder.on_results
        Recorder.on_picture BagRecorder.on_picture Tool Recorder.on_state
        BagRecorder.on_frame ReplayedCamera.handle_message Task ClientConformance
        CameraConformance EmulatedCamera.application_of EmulatedCamera.from_scenario
        EmulatedCamera.forget_link EmulatedCamera.make_machine EmulatedCamera.mistake
        EmulatedCamera.handle_message EmulatedCamera.serves EmulatedCamera.state_options
        WireCamera.connection_begun WireCamera.connection_ended WireCamera.note_frame
        WireCamera.note_message WireCamera.mistake WireCamera.application_of
        WireCamera.state_options WireCamera.from_scenario WireCamera.forget_link
        WireCamera.make_machine WireCamera.handle_message WireCamera.serves
        EmulatedInSight.admits EmulatedInSight.execute EmulatedInSight.image_answer
        EmulatedInSight.from_scenario EmulatedInSight.greet EmulatedInSight.greeting
        EmulatedInSight.hear EmulatedInSight.make_client EmulatedInSight.say
        EmulatedInSight.serves EmulatedInSight.state_options
    """,
    "judged by their own rooms' tests: layouts, files, pictures, links that break": """
        Layout FleetServer serve ThreadedFleet register_generator Rectifier Undistorter
        CameraKind ContainerSample Conversation LiveCamera
        EmulatedInSight.set_image TableScene.to_pixels TableScene.to_table
        Recorder.add_image Recorder.record RotatingRecorder.record
    """,
}
"""By reason: classes, methods and functions whose arguments are not in the table."""


JSON_ODD: dict[str, str] = {
    "1.5": "1.5",
    "-1": "-1",
    "-0.5": "-0.5",
    "2**32": str(1 << 32),
    "2**64": str(1 << 64),
    "10**400": str(10**400),
    "10**5000": "1" + 5000 * "0",
    "1e400": "1e400",
    "NaN": "NaN",
    "Infinity": "-Infinity",
    "null": "null",
    "empty text": '""',
    "text": '"x"',
    "text without bytes": r'"\ud800"',
    "text of 100 kB": '"' + 100_000 * "x" + '"',
    "text of a megabyte": '"' + 1_000_000 * "x" + '"',
    "true": "true",
    "list": "[]",
    "dict": "{}",
    "list in a list": "[[1]]",
    "deep list": 5000 * "[" + 5000 * "]",
}
"""Values in requests of programs without smartcam, as they stand there."""

_SAID = frozenset({"null"})
_MOMENTS = frozenset({"2**32", "2**64"})

JSON_KINDS: dict[str, frozenset[str]] = {
    "seconds": _SAID | {"1.5"},
    "id": _SAID | _MOMENTS | {"-1", "text", "text without bytes"},
    "deadline": _SAID | _MOMENTS,
    "epoch": _SAID,
    "any text": _SAID | {"text", "empty text"},
    "choice": _SAID,
    "choice or empty": _SAID | {"empty text"},
    "number": _SAID,
    "number from 1": _SAID | _MOMENTS | {"10**400"},
    "age": _SAID | _MOMENTS | {"1.5"},
    "flag": _SAID | {"true"},
    "hex": _SAID | {"empty text"},
    "must: hex": frozenset({"empty text"}),
    "must: number": frozenset(),
    "must: number or name": frozenset({"text"}),
    "must: time": frozenset(),
    "must: camera": frozenset(),
    "name": _SAID | {"text"},
    "must: name": frozenset({"text"}),
    "must: value": frozenset(
        {"-0.5", "-1", "1.5", "2**32", "2**64", "10**400", "text", "empty text", "true"}
    ),
}
"""Odd values that may be said, for each kind of field; the others are refused. What must be said
may not be null, too."""

JSON_FIELDS: dict[str, str] = {
    "timeout": "seconds",
    "id": "id",
    "program": "any text",
    "epoch": "epoch",
    "deadline": "deadline",
}
"""Of every request."""

JSON_SERVICES: dict[str, dict[str, str]] = {
    "trigger": {
        "application": "number",
        "input": "hex",
        "results_per_trigger": "number",
        "when_busy": "choice",
        "interpret_as": "choice",
    },
    "status": {},
    "results": {"first": "number from 1", "most": "number"},
    "frame": {"encoding": "choice", "quality": "number", "max_age": "age", "fresh": "flag"},
    "switch_application": {"application": "must: number or name"},
    "start": {},
    "stop": {},
    "reset_errors": {},
    "set_input": {"input": "must: hex"},
    "set_sequence_number": {"number": "must: number"},
    "set_clock": {"when": "must: time"},
    "reboot": {},
    "take_back": {},
    "query_status": {},
    "query_application": {},
    "wait_ready": {},
    "get_clock": {},
    "read_image": {},
    "trigger_frame": {"encoding": "choice", "quality": "number", "when_busy": "choice"},
    "features": {"name": "name"},
    "set_feature": {"name": "must: name", "value": "must: value"},
    "execute_feature": {"name": "must: name"},
}
"""Of each plain service, beside those."""

_CAMERA_NAME = {"camera_name": "must: camera"}
_SETUP = {
    **_CAMERA_NAME,
    "camera_model_name": "choice or empty",
    "port": "choice or empty",
    "con_address": "choice or empty",
    "application_id": "number",
    "interpret_as": "choice or empty",
    "topic_status": "any text",
}

JSON_THESIS: dict[str, dict[str, str]] = {
    "SmartcameraSetup": _SETUP,
    "Setup": _SETUP,
    "SmartcameraStop": _CAMERA_NAME,
    "Stop": _CAMERA_NAME,
    "EnablePublishing": {
        **_CAMERA_NAME,
        "topic_for_outputs": "any text",
        "min_delay": "seconds",
        "queue_size": "number",
    },
    "ChangeApplication": {**_CAMERA_NAME, "application_id": "must: number"},
    "Trigger50ByteString": {**_CAMERA_NAME, "application_id": "number"},
    "TriggerLocalization": {**_CAMERA_NAME, "application_id": "number"},
}
"""Of each service of the thesis' interface, beside those, whose empty text is not said."""


class PublicCall(NamedTuple):
    """Something that users may call, with the names of its arguments."""

    name: str
    arguments: tuple[str, ...]


RECEIVED = """
    CameraLog CellCamera Device FrameEvents FrameFeature FrameFeatures H264Decoder H264Encoder
    Teaching
"""
"""Classes without a name of their own at a door, whose methods users call on what they receive."""


def public_calls() -> Iterator[PublicCall]:
    """Give every public callable of the package that takes arguments."""
    seen: set[str] = set()
    doors = [(name, importlib.import_module(name)) for name in MODULES]
    public = [
        (door, name, getattr(module, name)) for door, module in doors for name in module.__all__
    ]
    for name in RECEIVED.split():
        (found,) = {
            id(vars(module)[name]): vars(module)[name]
            for module in tuple(sys.modules.values())
            if module.__name__.startswith("smartcam.") and name in vars(module)
        }.values()
        public.append((found.__module__, name, found))
    for door, name, found in public:
        for call, function in _calls(door, name, found):
            taken = inspect.signature(function).parameters.values()
            arguments = tuple(
                one.name for one in taken if one.name != "self" and one.kind is not one.VAR_KEYWORD
            )
            if arguments and call not in seen:
                seen.add(call)
                yield PublicCall(call, arguments)


def _calls(module: str, name: str, found: Any) -> Iterator[tuple[str, Any]]:
    if inspect.ismodule(found) or not callable(found):
        return
    if not inspect.isclass(found):
        if inspect.isfunction(found):
            yield (f"{module.rpartition('.')[2]}.{name}" if name == "open" else name), found
        return
    if issubclass(found, BaseException) or hasattr(found, "model_fields") or "Suite" in name:
        return
    for method, function in inspect.getmembers(found, callable):
        owner = next((kind for kind in found.__mro__ if method in vars(kind)), object)
        public = method == "__init__" or not method.startswith("_")
        if public and owner.__module__.startswith("smartcam") and not inspect.isclass(function):
            yield f"{owner.__name__}.{method}", function
