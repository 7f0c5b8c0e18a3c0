"""Arguments that cannot work: refused at once, wherever they are given, and nothing is sent."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import smartcam
import smartcam.conformance.camera
import smartcam.conformance.client
import smartcam.doctor
import smartcam.emulator
import smartcam.fleet
import smartcam.frames
import smartcam.sync
from smartcam import Backoff, ConfigurationError
from smartcam._arguments import duration_text
from smartcam.conformance.camera import ConformanceOptions
from smartcam.emulator import (
    EmulatedCamera,
    EmulatedFleet,
    EmulatedInSight,
    ManualClock,
    Scenario,
    TableScene,
    load_scenario,
)
from smartcam.emulator._inside import load_scenarios
from smartcam.fleet._inside import RecordSection
from smartcam.frames import Codecs, FrameGroup, FrameSource, RateControl, RtpSender, RtspServer
from smartcam.inspection import PartModel, Picture, SoftwareDevice, Tool, load_cell, register_tool
from smartcam.inspection._inside import SoftwareEntry, Teaching, make_camera, software_mistakes
from smartcam.models import Result
from smartcam.outlets import Outlets
from smartcam.recording import (
    FleetRecorder,
    FleetReplay,
    Recorder,
    ReplayedCamera,
    RotatingRecorder,
    load_recording,
    replay,
    write_bag,
    write_pcap,
)
from smartcam.settings import CameraOptions, CameraSettings, OtherOptions
from smartcam.testing import ThreadedCamera
from tests.argument_table import CAMERA, KINDS, NOT_HERE, ODD, OPTIONS, TABLE, public_calls

CELL_OF_ONE = {"frames": "x", "applications": {7: {"present": {"grey": [0, 90]}}}}

BASE: dict[str, Any] = {
    "set_clock": {"when": datetime(2030, 1, 1)},  # noqa: DTZ001 - as cameras have it
    "set_input": {"data": b""},
    "set_sequence_number": {"number": 1},
    "switch_application": {"application": 1},
    "application": {"application": 1},
    "request": {"message_id": 0x30},
    "wait_status": {"predicate": bool},
}
"""Arguments that a camera's method is given beside the odd value."""


def test_every_public_argument_is_in_the_table() -> None:
    elsewhere = {name for names in NOT_HERE.values() for name in names.split()}
    calls = {call.name: set(call.arguments) for call in public_calls()}
    assert len(calls) > 300
    missing = {
        name: arguments - TABLE.get(name, {}).keys()
        for name, arguments in calls.items()
        if name not in elsewhere and name.partition(".")[0] not in elsewhere
    }
    assert {name: arguments for name, arguments in missing.items() if arguments} == {}
    assert {*OPTIONS} == {*CameraOptions.__annotations__, *OtherOptions.__annotations__}


async def finished(outcome: Any) -> None:
    """See a call through, whatever kind of thing it returns."""
    if inspect.isawaitable(outcome):
        outcome = await outcome
    if hasattr(outcome, "__aenter__") and not isinstance(outcome, smartcam.Camera):
        async with outcome:
            pass
    elif inspect.isasyncgen(outcome):
        async with contextlib.aclosing(outcome):
            await anext(outcome)


async def outcome_of(call: Callable[[], Any]) -> str:
    """Return how a call ends: "done", or the kind of its error."""
    try:
        async with asyncio.timeout(60.0):
            await finished(call())
    except Exception as exc:  # noqa: BLE001 - whatever it is is judged
        long = len(str(exc)) > LONGEST_TEXT
        return f"{len(str(exc))} characters" if long else type(exc).__name__
    return "done"


def wrong(kinds: dict[str, str]) -> Iterator[tuple[str, str]]:
    """Give arguments, and the name of an odd value that each refuses."""
    for argument, kind in kinds.items():
        for odd in ODD.keys() - KINDS[kind]:
            yield argument, odd


RESULT = Result("cam", 7, None, 1, None, datetime(2030, 1, 1, tzinfo=UTC), None, b"", None)

LONGEST_TEXT = 2000
"""Characters of an error's text that quotes an argument, whatever that is."""

REFUSALS = {"ConfigurationError", "PluginError", "LayoutError"}
"""The second and third are kinds of the first, for what is to be read."""


async def judge(name: str, call: Callable[..., Any], given: dict[str, Any]) -> list[str]:
    """Return for which arguments and values something else came than a refusal."""
    found = []
    for argument, odd in wrong(TABLE[name]):
        arguments = {**given, argument: ODD[odd]}
        outcome = await outcome_of(lambda: call(**arguments))  # noqa: B023 - called at once
        if outcome not in REFUSALS:
            found.append(f"{argument}={odd}: {outcome}")
    return found


# ---------------------------------------------------------------------- cameras


PLANT: dict[str, Any] = {
    "fleet": "plant",
    "cameras": {"cam": {"emulate": {"active": 21, "running": True}}},
}


@contextlib.asynccontextmanager
async def at_the_wire(dialect: str) -> AsyncIterator[tuple[smartcam.Camera, Callable[[], int]]]:
    async with (
        EmulatedCamera(active=21, running=True, dialect=dialect) as emulator,
        smartcam.connect(emulator.url) as camera,
    ):
        yield camera, lambda: len(emulator.log)


@contextlib.asynccontextmanager
async def in_a_fleet(dialect: str) -> AsyncIterator[tuple[smartcam.Camera, Callable[[], int]]]:
    async with EmulatedCamera(active=21, running=True, dialect=dialect) as emulator:
        file = smartcam.fleet.FleetFile.model_validate(
            {"fleet": "plant", "cameras": {"cam": {"url": emulator.url}}}
        )
        async with smartcam.fleet.open(file) as fleet:
            await fleet["cam"].wait_connected(60.0)
            yield fleet["cam"], lambda: len(emulator.log)


@pytest.mark.parametrize("dialect", ["handbook", "bid"])
async def test_odd_arguments_end_the_same_at_the_wire_and_in_a_fleet(dialect: str) -> None:
    found: list[str] = []
    async with (
        at_the_wire(dialect) as (wire, wire_frames),
        in_a_fleet(dialect) as (shared, shared_frames),
    ):
        for method, kinds in CAMERA.items():
            for argument, odd in wrong(kinds):
                given = {**BASE.get(method, {}), argument: ODD[odd]}
                before = wire_frames(), shared_frames()
                outcomes = [
                    await outcome_of(lambda: getattr(camera, method)(**given))  # noqa: B023
                    for camera in (wire, shared)
                ]
                if not REFUSALS.issuperset(outcomes) or outcomes[0] != outcomes[1]:
                    found.append(f"{method}({argument}={odd}): {outcomes}")
                if (wire_frames(), shared_frames()) != before:
                    found.append(f"{method}({argument}={odd}): something was sent")
        assert found == []
        assert (await wire.query_application(), await shared.query_application()) == (21, 21)


@pytest.mark.real_time
def test_odd_arguments_are_refused_without_asyncio() -> None:
    found: list[str] = []
    with (
        ThreadedCamera(active=21, running=True) as emulator,
        smartcam.sync.connect(emulator.url) as camera,
        camera.results() as results,
    ):
        sent = len(emulator.log)
        for method, kinds in {**CAMERA, "get": TABLE["SyncSubscription.get"]}.items():
            owner: Any = results if method == "get" else camera
            for argument, odd in wrong(kinds):
                try:
                    outcome = getattr(owner, method)(**{**BASE.get(method, {}), argument: ODD[odd]})
                    if method in {"application", "frames", "reserve"}:
                        outcome.__enter__()
                except ConfigurationError:
                    continue
                except Exception as exc:  # noqa: BLE001 - whatever it is is judged
                    found.append(f"{method}({argument}={odd}): {exc!r:.100}")
                else:
                    found.append(f"{method}({argument}={odd}): {outcome!r:.100}")
        assert found == []
        assert len(emulator.log) == sent
        assert camera.trigger().application == 21


@pytest.mark.parametrize("option", OPTIONS)
def test_odd_options_are_refused(option: str) -> None:
    for odd in ODD.keys() - KINDS[OPTIONS[option]]:
        options: Any = {option: ODD[odd]}
        with pytest.raises(ConfigurationError):
            smartcam.connect("bvs://127.0.0.1", **options)


def test_numbers_of_numpy_are_numbers() -> None:
    options: Any = {"application": np.int32(7), "switch_timeout": np.float32(0.5)}
    settings = CameraSettings.make("bvs://127.0.0.1", None, {**options, "y_down": np.bool_(True)})
    assert (settings.application, settings.switch_timeout, settings.y_down) == (7, 0.5, True)
    assert type(settings.application) is int


# ---------------------------------------------------------------------- all else


CELL = """
cameras:
  cam: {software: {frames: "synthetic://", applications: {7: {present: {grey: [0, 90]}}}}}
"""


def inspecting(folder: Path, frame: Any) -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    """Give what inspects pictures."""
    folder.mkdir(exist_ok=True)
    path = folder / "cell.yaml"
    path.write_text(CELL, encoding="utf-8")
    cell = load_cell(path)["cam"]
    camera: Any = smartcam.connect(f"software:{path}")
    program, teaching = cell.program(7), Teaching(path, "cam", 7)
    square = np.full((80, 80), 60, np.uint8)
    square[20:60, 20:60] = 180
    part = PartModel.teach(square)
    outline = path.parent / "square.svg"
    outline.write_text(
        '<svg width="20mm" height="20mm" viewBox="0 0 20 20"><path d="M1 1h9v7h-9z"/></svg>'
    )
    software = {"software": SoftwareEntry.model_validate(CELL_OF_ONE)}

    def mistakes(name: Any = "cam", folder: Any = folder, **more: Any) -> Any:
        return [*software_mistakes(name, **{**software, **more}, folder=folder)]

    return {
        "CellCamera.program": (cell.program, {}),
        "Inspection.payload": (program.inspect(frame).payload, {}),
        "PartModel.from_outline": (
            PartModel.from_outline,
            {"path": outline, "pixels_per_mm": 4.0},
        ),
        "PartModel.predicted_sigma": (part.predicted_sigma, {}),
        "PartModel.read": (PartModel.read, {}),
        "PartModel.teach": (PartModel.teach, {"picture": square}),
        "PartModel.write": (part.write, {}),
        "Picture.__init__": (Picture, {"pixels": np.zeros((4, 4), np.uint8)}),
        "Picture.of": (Picture.of, {}),
        "Picture.read": (Picture.read, {}),
        "Program.inspect": (program.inspect, {"source": frame}),
        "SoftwareCamera.read_drawn_image": (camera.read_drawn_image, {}),
        "SoftwareCamera.read_judged_image": (camera.read_judged_image, {"result": RESULT}),
        "SoftwareDevice.__init__": (SoftwareDevice, {"camera": cell}),
        "Teaching.__init__": (Teaching, {"path": path, "camera": "cam", "application": 7}),
        "Teaching.program": (teaching.program, {}),
        "Teaching.save": (teaching.save, {}),
        "load_cell": (load_cell, {}),
        "make_camera": (make_camera, {"name": "cam", **software, "folder": folder}),
        "register_tool": (register_tool, {"name": "odd", "tool": Tool}),
        "software_mistakes": (mistakes, {}),
    }


@contextlib.asynccontextmanager
async def things() -> AsyncIterator[dict[str, tuple[Callable[..., Any], dict[str, Any]]]]:
    """Give every other callable of the table by its name, and what it is given otherwise."""
    source = smartcam.frames.open("synthetic://")
    with tempfile.TemporaryDirectory() as folder:
        recorder = Recorder(f"{folder}/good.mcap")
        async with EmulatedCamera(active=21, running=True) as recorded:
            with recorder:
                async with smartcam.connect(recorded.url, observers=[recorder]) as camera:
                    await camera.trigger()
        recording = load_recording(recorder.path)
    async with (
        EmulatedCamera(active=21, running=True) as emulator,
        EmulatedInSight(jobs=[{"file": "7a.job"}]) as insight,
        in_a_fleet("handbook") as (shared, _frames),
        smartcam.fleet.open(
            smartcam.fleet.FleetFile.model_validate(
                {"fleet": "other", "cameras": {"cam": {"url": "bvs://127.0.0.1:1"}}}
            )
        ) as fleet,
        source,
        source.reader() as reader,
        Codecs() as codecs,
    ):
        assert isinstance(shared, smartcam.fleet.FleetCamera)
        device, clock = emulator.device, ManualClock()
        frame = await reader.newest()
        picture = await codecs.jpeg(frame)
        plant = {"fleet": "plant", "cameras": {"cam": {"url": emulator.url}}}
        server = smartcam.fleet.FleetServer(smartcam.fleet.FleetFile.model_validate(plant))
        threaded = ThreadedCamera(manual_clock=True)
        rtsp = RtspServer({"a": source})
        yield {
            "find_format": (smartcam.frames.find_format, {}),
            "Codecs.converted": (codecs.converted, {"frame": frame}),
            "Codecs.decode": (codecs.decode, {"frame": picture}),
            "Codecs.jpeg": (codecs.jpeg, {"frame": frame}),
            "Codecs.jpegxl": (codecs.jpegxl, {}),
            "Codecs.png": (codecs.png, {}),
            "Layout.__init__": (smartcam.Layout, {"text": "n: int32"}),
            "load_fleet": (smartcam.fleet.load_fleet, {}),
            "load_scenario": (load_scenario, {"path": "none.yaml"}),
            "load_scenarios": (load_scenarios, {"path": "none.yaml"}),
            "EmulatedFleet.__init__": (EmulatedFleet, {"scenarios": [Scenario(name="a")]}),
            **inspecting(Path(folder), frame),
            "Recorder.__init__": (Recorder, {"path": "x"}),
            "Recorder.add_picture": (Recorder("y").add_picture, {"frame": frame}),
            "RotatingRecorder.__init__": (RotatingRecorder, {"path": "x"}),
            "RotatingRecorder.add_picture": (RotatingRecorder("y").add_picture, {"frame": frame}),
            "Recording.pictures": (lambda camera: [*recording.pictures(camera)], {}),
            "Recording.results_with_pictures": (
                lambda camera: [*recording.results_with_pictures(camera)],
                {},
            ),
            "Recording.camera": (recording.camera, {}),
            "Recording.all_items": (lambda camera: [*recording.all_items(camera)], {}),
            "Recording.errors": (lambda camera: [*recording.errors(camera)], {}),
            "Recording.events": (lambda camera: [*recording.events(camera)], {}),
            "Recording.frames": (lambda camera: [*recording.frames(camera)], {}),
            "Recording.items": (lambda camera: [*recording.items(camera)], {}),
            "Recording.results": (lambda camera: [*recording.results(camera)], {}),
            "FleetRecorder.__init__": (
                FleetRecorder,
                {"server": server, "section": RecordSection.model_validate({"folder": "x"})},
            ),
            "FleetReplay.__init__": (FleetReplay, {"recording": recording}),
            "ReplayedCamera.__init__": (ReplayedCamera, {"recording": recording}),
            "load_recording": (load_recording, {"path": "none.mcap"}),
            "replay": (replay, {"recording": recording}),
            "write_bag": (write_bag, {"recording": recording, "path": folder}),
            "write_pcap": (write_pcap, {"recording": recording, "path": folder}),
            "connect": (smartcam.connect, {"url": "bvs://127.0.0.1"}),
            "find": (
                lambda networks="127.0.0.1", **more: smartcam.find(networks, **more),
                {"may_disturb": True},
            ),
            "examine": (smartcam.doctor.examine, {"url": "bvs://127.0.0.1:1"}),
            "Backoff.__init__": (Backoff, {}),
            "FleetCamera.frame_source": (shared.frame_source, {}),
            "Fleet.agents": (fleet.agents, {}),
            "Fleet.cameras": (fleet.cameras, {}),
            "Fleet.events": (fleet.events, {}),
            "Fleet.find_cameras": (fleet.find_cameras, {}),
            "Fleet.names": (fleet.names, {}),
            "Fleet.reload": (fleet.reload, {}),
            "Fleet.results": (fleet.results, {}),
            "Fleet.status": (fleet.status, {}),
            "Fleet.outlets": (fleet.outlets, {}),
            "Fleet.stored_results": (fleet.stored_results, {}),
            "Outlets.__init__": (Outlets, {"section": {}, "folder": "."}),
            "Outlets.stored": (Outlets({}, ".").stored, {}),
            "Fleet.trigger": (fleet.trigger, {}),
            "Fleet.url_of": (fleet.url_of, {"name": "x"}),
            "fleet.open": (smartcam.fleet.open, {"address_or_file": "fleet://127.0.0.1"}),
            "FrameSource.__init__": (FrameSource, {"driver": source.driver}),
            "FrameSource.reader": (source.reader, {}),
            "FrameSource.newest": (source.newest, {}),
            "FrameSource.after": (source.after, {"moment": 0.0}),
            "FrameSource.trigger": (source.trigger, {}),
            "FrameSource.events": (
                lambda names="Any", **more: source.events(names, **more),
                {},
            ),
            "FrameFeatures.__getitem__": (lambda name: source.features[name], {}),
            "FrameFeatures.names": (source.features.names, {}),
            "FrameFeatures.describe": (source.features.describe, {}),
            "FrameFeatures.load": (source.features.load, {"user_set": "Default"}),
            "FrameFeatures.save": (source.features.save, {"user_set": "Default"}),
            "FrameFeatures.load_at_power_on": (
                source.features.load_at_power_on,
                {"user_set": "Default"},
            ),
            "FrameFeature.get": (source.features["Gain"].get, {}),
            "FrameFeature.describe": (source.features["Gain"].describe, {}),
            "FrameFeature.set": (source.features["Gain"].set, {"value": 1}),
            "FrameFeature.execute": (source.features["Gain"].execute, {}),
            "FrameReader.newest": (reader.newest, {}),
            "FrameReader.after": (reader.after, {"moment": 0.0}),
            "FrameReader.wait_newer": (reader.wait_newer, {"since": 0.0, "until": 0.0}),
            "FrameGroup.__init__": (FrameGroup, {"sources": {"a": source}}),
            "frames.open": (smartcam.frames.open, {"url": "synthetic://"}),
            "discover": (smartcam.frames.discover, {}),
            "Codecs.__init__": (Codecs, {}),
            "Codecs.h264_encoder": (codecs.h264_encoder, {}),
            "RateControl.__init__": (RateControl, {"latency": 1.0}),
            "RtpSender.__init__": (RtpSender, {"source": source, "to": "127.0.0.1:5004"}),
            "RtspServer.__init__": (RtspServer, {"sources": {"a": source}}),
            "RtspServer.url": (rtsp.url, {}),
            "ConformanceOptions.__init__": (ConformanceOptions, {"url": "bvs://127.0.0.1"}),
            "judge": (smartcam.conformance.camera.judge, {}),
            "Device.change_inspection": (device.change_inspection, {}),
            "Device.drop_triggers": (device.drop_triggers, {}),
            "Device.hold_busy": (device.hold_busy, {}),
            "Device.reboot": (device.reboot, {}),
            "Device.set_condition": (
                device.set_condition,
                {"condition": smartcam.Status.OVERHEAT, "on": True},
            ),
            "Device.set_endian": (device.set_endian, {}),
            "Device.switch_application": (device.switch_application, {"application": 21}),
            "Device.tick": (device.tick, {}),
            "EmulatedCamera.__init__": (EmulatedCamera, {}),
            "WireCamera.command": (emulator.command, {}),
            "WireCamera.inject": (lambda faults: emulator.inject(faults), {}),
            "WireCamera.wait_received": (emulator.wait_received, {"what": 0x30}),
            "EmulatedInSight.__init__": (EmulatedInSight, {}),
            "EmulatedInSight.answer_next": (insight.answer_next, {"code": 1}),
            "EmulatedInSight.load": (insight.load, {}),
            "EmulatedInSight.set_online": (insight.set_online, {}),
            "EmulatedInSight.wait_heard": (insight.wait_heard, {"command": "GO"}),
            "ManualClock.advance": (clock.advance, {}),
            "ManualClock.call_at": (clock.call_at, {"when": 1.0, "callback": print}),
            "TableScene.__init__": (TableScene, {}),
            "CameraLog.expect": (
                lambda expected=0x30, **more: threaded.log.expect(expected, **more),
                {},
            ),
            "CameraLog.expect_disconnect_before_close": (
                threaded.log.expect_disconnect_before_close,
                {},
            ),
            "CameraLog.expect_nothing_while_busy": (
                lambda also=smartcam.protocols.messages.Query, **more: (
                    threaded.log.expect_nothing_while_busy(also, **more)
                ),
                {},
            ),
            "ThreadedCamera.__init__": (ThreadedCamera, {}),
            "ThreadedCamera.advance": (threaded.advance, {}),
            "ThreadedCamera.command": (threaded.command, {}),
            "ThreadedCamera.inject": (lambda faults: threaded.inject(faults), {}),
            "ThreadedCamera.received": (threaded.received, {"what": 0x30}),
            "ThreadedCamera.run": (threaded.run, {}),
            "ThreadedCamera.wait_received": (threaded.wait_received, {"what": 0x30}),
        }


OTHERS = [
    name
    for name in TABLE
    if name != "SyncSubscription.get"
    and not (name.partition(".")[0].endswith("Camera") and name.partition(".")[2] in CAMERA)
]


async def test_odd_arguments_are_refused_everywhere_else() -> None:
    found: dict[str, list[str]] = {}
    async with things() as known:
        assert {*known} == {*OTHERS}
        for name in OTHERS:
            call, given = known[name]
            said = await judge(name, call, given)
            if said:
                found[name] = said
    assert found == {}


# ---------------------------------------------------------------------- values in texts


@pytest.mark.parametrize(
    ("seconds", "fine", "coarse"),
    [
        (0.0, "0 s", "0.0 s"),
        (0.0000421, "0.0421 ms", "0.0421 ms"),
        (0.0042, "4.2 ms", "4.2 ms"),
        (0.00999999, "10 ms", "10 ms"),
        (0.01, "0.01 s", "10 ms"),
        (0.0499, "0.05 s", "49.9 ms"),
        (0.0999, "0.1 s", "0.1 s"),
        (0.25, "0.25 s", "0.2 s"),
        (2.0, "2 s", "2.0 s"),
        (86_400.0, "86400 s", "86400.0 s"),
    ],
)
def test_shown_time_never_says_0_for_what_is_more(seconds: float, fine: str, coarse: str) -> None:
    assert duration_text(seconds) == fine
    assert duration_text(seconds, coarse=True) == coarse
