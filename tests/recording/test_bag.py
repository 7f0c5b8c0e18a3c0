"""Bags from recorders and recordings, read by other programs."""

from __future__ import annotations

import contextlib
import hashlib
import json
import struct
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.interfaces import Connection, ConnectionExtRosbag2, QosDurability, QosReliability
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import smartcam
from smartcam.emulator import EmulatedCamera
from smartcam.exceptions import (
    ConfigurationError,
    InterpretationError,
    MissingExtraError,
    RecordingError,
    UnsupportedError,
)
from smartcam.models import (
    CameraEvent,
    Connected,
    Disconnected,
    Header,
    Localization,
    Pose,
    PoseSigma,
    Position,
    Quaternion,
    Result,
    Status,
    StatusChanged,
    jsonable,
)
from smartcam.recording import BagRecorder, Recorder, load_recording, write_bag
from smartcam.recording._bags.items import BagCounts, topic_of_camera
from smartcam.recording._inside import BagConversion
from tests.recording.bagkit import nanoseconds, on, read, read_by_rosbags, read_raw
from tests.recording.inside import nanoseconds as recorded_time
from tests.recording.recordingkit import COUNTER, URL, at, container, containers, session, write
from tests.ros2.typekit import forget_stores

if TYPE_CHECKING:
    from smartcam.recording import Recording

TANGRAM: dict[str, Any] = {
    "id": 7,
    "layout": "(feature_id: string[50], quality: real32, photo_index: int32, "
    "x: real32, y: real32, theta: real32)*",
    "generator": "tangram",
    "processing_time": 0.01,
    "load_time": 0.01,
}

TYPES = {
    "/table/results": "smartcam_msgs/msg/Result",
    "/table/localizations": "geometry_msgs/msg/PoseArray",
    "/table/detections": "vision_msgs/msg/Detection3DArray",
    "/table/status": "smartcam_msgs/msg/CameraStatus",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


async def both(folder: Path, *, triggers: int = 3, **options: Any) -> BagCounts:
    """Record a run as ``run.mcap`` and as the bag ``live``."""
    settings: Any = {"name": "table", "application": 7, "interpret_as": "localizations", **options}
    async with EmulatedCamera([TANGRAM, COUNTER]) as emulator:
        with Recorder(folder / "run.mcap") as recorder, BagRecorder(folder / "live") as bag:
            for one in (recorder, bag):
                one.describe("table", interpret_as=settings["interpret_as"])
            observers = [recorder, bag]
            async with smartcam.connect(emulator.url, observers=observers, **settings) as camera:
                for _ in range(triggers):
                    with contextlib.suppress(InterpretationError):
                        await camera.trigger()
    return bag.bag_counts


_CLEAN: list[tuple[Path, BagCounts]] = []


async def clean(factory: pytest.TempPathFactory) -> tuple[Path, BagCounts]:
    """Return the folder of a run in which all went well, recorded once; and its counts."""
    if not _CLEAN:
        folder = factory.mktemp("clean")
        _CLEAN.append((folder, await both(folder)))
    return _CLEAN[0]


def part(x: float = 0.5, frame: str = "left", feature: str = "bolt") -> Localization:
    pose = Pose(Header(1, at(1), frame), Position(x, 0.25, 0.125), Quaternion(0.0, 0.0, 0.6, 0.8))
    return Localization(feature, 0.75, 2, pose)


def result(seconds: float, value: object, raw: bytes = b"\1\2", **fields: Any) -> Result:
    made = Result("left", 5, None, 1, at(seconds), at(seconds + 0.5), 0.5, raw, value)
    return made._replace(**fields)


# ---------------------------------------------------------------------- what a recorder writes


async def test_bag_has_what_the_recorder_had(tmp_path_factory: pytest.TempPathFactory) -> None:
    tmp_path, counts = await clean(tmp_path_factory)
    recording = load_recording(tmp_path / "run.mcap")
    results, messages = list(recording.results()), read_by_rosbags(tmp_path / "live")

    assert counts == BagCounts(len(messages), 3, 0, 3, 0)
    assert len(results) == 3
    assert [one.at for one in messages] == sorted(one.at for one in messages)
    told = on("/table/results", messages)
    poses, found = on("/table/localizations", messages), on("/table/detections", messages)
    for was, one, array, seen in zip(results, told, poses, found, strict=True):
        arrived = recorded_time(was.received_at)
        assert one.at == array.at == seen.at == arrived
        for stamped in (one, array, seen):
            assert nanoseconds(stamped.message.header.stamp) == arrived
            assert stamped.message.header.frame_id == "table"
        assert (one.message.camera_name, one.message.application_id) == ("table", 7)
        assert (one.message.result_id, one.message.error) == (was.number, "")
        assert (bytes(one.message.data), one.message.json) == (was.raw, "")

        parts = was.value
        assert len(parts) > 1
        assert [_plain(pose) for pose in array.message.poses] == [_said(one) for one in parts]
        assert [
            (each.feature_id, each.quality, each.photo_index, _plain(each.pose.pose))
            for each in one.message.localizations
        ] == [
            (each["feature_id"], each["quality"], each["photo_index"], _said(each))
            for each in parts
        ]
        for said, detection in zip(parts, seen.message.detections, strict=True):
            (hypothesis,) = detection.results
            assert hypothesis.hypothesis.class_id == said["feature_id"]
            assert hypothesis.hypothesis.score == said["quality"]
            assert _plain(hypothesis.pose.pose) == _plain(detection.bbox.center) == _said(said)


def _plain(pose: Any) -> tuple[float, ...]:
    place, turn = pose.position, pose.orientation
    return (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)


def _said(part: dict[str, Any]) -> tuple[float, ...]:
    return (*part["pose"]["position"].values(), *part["pose"]["orientation"].values())


async def test_bag_of_the_recording_has_the_same_bytes_as_the_recorders(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    tmp_path, counts = await clean(tmp_path_factory)
    assert write_bag(load_recording(tmp_path / "run.mcap"), tmp_path / "made") == counts
    live, made = read_raw(tmp_path / "live/live_0.mcap"), read_raw(tmp_path / "made/made_0.mcap")
    assert live == made
    assert len(live) == counts.messages


async def test_bag_is_what_rosbag2_says_of_mcap(tmp_path_factory: pytest.TempPathFactory) -> None:
    tmp_path, counts = await clean(tmp_path_factory)
    path = tmp_path / "live/live_0.mcap"
    messages = read_raw(path)
    assert {one.topic: one.schema for one in messages} == TYPES
    assert {one.encodings for one in messages} == {("ros2msg", "cdr")}
    assert all(one.data[:4] == b"\0\1\0\0" for one in messages)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        records = [one.metadata for one in reader.iter_metadata() if one.name == "rosbag2"]
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == counts.messages
    assert summary.statistics.channel_count == len(TYPES)
    said = yaml.safe_load((path.parent / "metadata.yaml").read_text())
    information = said["rosbag2_bagfile_information"]
    assert list(said) == ["rosbag2_bagfile_information"]
    assert yaml.safe_load(records[-1]["serialized_metadata"]) == information
    assert [yaml.safe_load(one["serialized_metadata"])["version"] for one in records] == [8, 8]


async def test_bag_definitions_make_types_of_the_same_hash(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    tmp_path, _ = await clean(tmp_path_factory)
    with (tmp_path / "live/live_0.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    seen = set()
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        store = get_typestore(Stores.EMPTY)  # nothing but what the definition says
        store.register(get_types_from_msg(schema.data.decode(), schema.name))
        assert store.hash_rihs01(schema.name) == channel.metadata["topic_type_hash"]
        seen.add(schema.name)
    assert seen == set(TYPES.values())


async def test_bag_metadata_has_the_fields_of_rosbag2(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    # rosbag2_storage/include/rosbag2_storage/yaml.hpp: what BagMetadata is read from
    tmp_path, counts = await clean(tmp_path_factory)
    messages = read_raw(tmp_path / "live/live_0.mcap")
    said = yaml.safe_load((tmp_path / "live/metadata.yaml").read_text())
    information = said["rosbag2_bagfile_information"]
    first, last = min(one.at for one in messages), max(one.at for one in messages)
    topics = information.pop("topics_with_message_count")
    span = {
        "starting_time": {"nanoseconds_since_epoch": first},
        "duration": {"nanoseconds": last - first},
        "message_count": counts.messages,
    }
    assert information == {
        "version": 8,
        "storage_identifier": "mcap",
        **span,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": ["live_0.mcap"],
        "files": [{"path": "live_0.mcap", **span}],
        "custom_data": None,
        "ros_distro": "jazzy",
    }
    for topic in topics:
        facts = topic["topic_metadata"]
        mine = [one for one in messages if one.topic == facts["name"]]
        assert topic["message_count"] == len(mine)
        assert facts == {
            "name": facts["name"],
            "type": TYPES[facts["name"]],
            "serialization_format": "cdr",
            "offered_qos_profiles": mine[0].metadata["offered_qos_profiles"],
            "type_description_hash": mine[0].metadata["topic_type_hash"],
        }


async def test_bag_policies_are_those_of_a_driver_and_the_status_is_latched(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    tmp_path, _ = await clean(tmp_path_factory)
    for path in (tmp_path / "live", tmp_path / "live/live_0.mcap"):
        with Reader(path) as reader:
            policies = {one.topic: _policies(one) for one in reader.connections}
        assert policies.pop("/table/status") == (1, QosReliability.RELIABLE, "TRANSIENT_LOCAL")
        assert policies.pop("/diagnostics") == (10, QosReliability.RELIABLE, "VOLATILE")
        assert set(policies.values()) == {(5, QosReliability.RELIABLE, "VOLATILE")}


def _policies(connection: Connection) -> tuple[int, QosReliability, str]:
    assert isinstance(connection.ext, ConnectionExtRosbag2)
    (qos,) = connection.ext.offered_qos_profiles
    return qos.depth, qos.reliability, QosDurability(qos.durability).name


BROKEN = "System Error: the camera needs a reboot at least"


def test_bag_status_tells_what_the_camera_is_doing(tmp_path: Path) -> None:
    with BagRecorder(tmp_path / "bag") as bag:
        for event in (
            Connected(camera="left", at=at(0), url=URL),
            StatusChanged(
                camera="left", at=at(1), status=Status.RUNNING | Status(0x40), previous=None
            ),
            smartcam.ApplicationChanged(camera="left", at=at(2), application=7, previous=None),
            StatusChanged(camera="left", at=at(3), status=Status.SYSTEM_ERROR, previous=None),
            Disconnected(camera="left", at=at(4), reason="gone", expected=False),
        ):
            bag.on_state(event)
    messages = read(tmp_path / "bag")
    told = [
        (
            (one.message.connected, one.message.ready, one.message.running, one.message.busy),
            one.message.application_id,
            (one.message.status, one.message.status_names),
            one.message.error,
        )
        for one in on("/left/status", messages)
    ]
    no: tuple[int, list[str]] = (0, [])
    running = (0xC0, ["0x40", "RUNNING"])
    assert told == [
        ((True, False, False, False), 0, no, ""),
        ((True, True, True, False), 0, running, ""),
        ((True, True, True, False), 7, running, ""),
        ((True, False, False, False), 7, (2, ["SYSTEM_ERROR"]), BROKEN),
        ((False, False, False, False), 0, no, "gone"),
    ]
    assert {one.message.camera_name for one in on("/left/status", messages)} == {"left"}
    health = [one.message.status[0] for one in on("/diagnostics", messages)]
    assert [(int(one.level), one.name, one.message) for one in health] == [
        (0, "left: camera", "connected"),
        (0, "left: camera", "ready"),
        (2, "left: camera", BROKEN),
        (2, "left: camera", "gone"),
    ]
    assert {one.hardware_id for one in health} == {"192.168.0.10:36701"}


def test_bag_errors_are_diagnostics_with_their_text(tmp_path: Path) -> None:
    with BagRecorder(tmp_path / "bag") as bag:
        bag.on_error("left", smartcam.TriggerTimeoutError("no result came"), at(1))
    assert bag.bag_counts == BagCounts(messages=1, errors=1)
    (one,) = read(tmp_path / "bag")
    (status,) = one.message.status
    assert (int(status.level), status.message) == (1, "TriggerTimeoutError: no result came")
    assert [(pair.key, pair.value) for pair in status.values] == [("triggered at", str(at(1)))]


# ---------------------------------------------------------------------- what could not be read


async def test_bag_result_that_cannot_be_read_is_there_with_its_bytes_and_why(
    tmp_path: Path,
) -> None:
    counts = await both(tmp_path, interpret_as="a: int64")
    made = write_bag(load_recording(tmp_path / "run.mcap"), tmp_path / "made")
    assert (counts.results, counts.uninterpreted, counts.localizations) == (3, 3, 0)
    assert made == counts
    for folder in ("live", "made"):
        told = [one.message for one in on("/table/results", read(tmp_path / folder))]
        assert [bytes(one.data) for one in told] == sent(load_recording(tmp_path / "run.mcap"))
        assert [(one.json, one.application_id) for one in told] == [("", 7)] * 3
        for one in told:
            assert one.error.startswith("InterpretationError: container: expected 8 bytes, got")


def sent(recording: Recording) -> list[bytes]:
    """Return the data of the containers that came."""
    return [bytes.fromhex(data) for _, data in containers(recording)]


async def test_bag_result_that_could_not_be_read_is_read_again(tmp_path: Path) -> None:
    await both(tmp_path, interpret_as="a: int64")
    recording = load_recording(tmp_path / "run.mcap")
    counts = write_bag(recording, tmp_path / "made", interpret_as="localizations")
    assert (counts.results, counts.uninterpreted, counts.localizations) == (3, 0, 3)
    messages = read(tmp_path / "made")
    came = [one.at for one in recording.frames() if one.message == "ResultContainer"]
    assert [one.at for one in on("/table/localizations", messages)] == [*map(recorded_time, came)]
    assert all(one.message.poses for one in on("/table/localizations", messages))


def test_bag_error_claims_no_bytes_where_several_containers_came(tmp_path: Path) -> None:
    with BagRecorder(tmp_path / "bag") as bag:
        bag.on_frame(container(1, b"\1"))
        bag.on_frame(container(2, b"\2"))
        bag.on_frame(container(3, b"\3"))
        bag.on_result(result(1, None, b"\1"))
        bag.on_error("left", InterpretationError("which?"), None)
        bag.on_frame(container(4, b"\4"))
        bag.on_error("left", InterpretationError("this"), None)
    told = [one.message for one in on("/left/results", read(tmp_path / "bag"))]
    assert [(one.error, bytes(one.data), one.application_id) for one in told] == [
        ("", b"\1", 5),
        ("InterpretationError: which?", b"", 0),
        ("InterpretationError: this", b"\4", 5),
    ]
    assert bag.bag_counts.uninterpreted == 2


# ---------------------------------------------------------------------- of a recording


def test_bag_without_poses_has_no_topic_of_poses(tmp_path: Path) -> None:
    items = [result(1, {"n": 1}), result(2, [{"n": 1}]), result(3, []), result(4, b"\1", b"\1")]
    write_bag(write(tmp_path / "run.mcap", items), tmp_path / "bag")
    messages = read(tmp_path / "bag")
    assert {one.topic for one in messages} == {"/left/results"}
    assert [one.message.json for one in messages] == ['{"n":1}', '[{"n":1}]', "[]", ""]


def test_bag_of_pixels_has_them_as_json_and_no_poses(tmp_path: Path) -> None:
    spec = "localizations: (feature_id: string[50], quality: real32, x: real32 px, y: real32 px)*"
    items = [result(1, [part()]), result(2, [part(frame="robot")])]
    recording = write(tmp_path / "run.mcap", items, interpret_as=spec)
    assert write_bag(recording, tmp_path / "bag").localizations == 1
    messages = read(tmp_path / "bag")
    (poses,) = on("/left/localizations", messages)
    assert poses.message.header.frame_id == "robot"  # a calibration has made metres of them
    pixels, metres = [one.message for one in on("/left/results", messages)]
    assert (json.loads(pixels.json)[0]["feature_id"], len(pixels.localizations)) == ("bolt", 0)
    assert (metres.json, len(metres.localizations)) == ("", 1)


def test_bag_of_an_agents_pixels_has_no_poses(tmp_path: Path) -> None:
    recording = write(tmp_path / "run.mcap", [result(1, [part()])], pixels=True)
    assert write_bag(recording, tmp_path / "bag").localizations == 0
    (one,) = read(tmp_path / "bag")
    assert json.loads(one.message.json)[0]["feature_id"] == "bolt"


def test_bag_parts_in_several_frames_are_in_no_array(tmp_path: Path) -> None:
    items = [result(1, [part(frame="robot"), part(frame="table")])]
    write_bag(write(tmp_path / "run.mcap", items), tmp_path / "bag")
    told, why = read(tmp_path / "bag")
    frames = [one.pose.header.frame_id for one in told.message.localizations]
    assert (frames, told.message.header.frame_id) == (["robot", "table"], "")
    assert why.message.status[0].message == "result 1: poses in several frames: robot, table"


@pytest.mark.parametrize(
    ("items", "facts"),
    [
        ([result(1, []), result(2, [part()])], {"interpret_as": "localizations"}),
        ([result(1, [part()]), result(2, [])], {}),
    ],
)
def test_bag_result_without_parts_is_an_empty_pose_array(
    tmp_path: Path, items: list[Result], facts: dict[str, str]
) -> None:
    write_bag(write(tmp_path / "run.mcap", items, **facts), tmp_path / "bag")
    arrays = on("/left/localizations", read(tmp_path / "bag"))
    assert sorted(len(one.message.poses) for one in arrays) == [0, 1]


def test_bag_keeps_the_frame_that_a_calibration_gave(tmp_path: Path) -> None:
    recording = write(tmp_path / "run.mcap", [result(1, [part(frame="robot")])])
    write_bag(recording, tmp_path / "bag")
    frames = {one.topic: one.message.header.frame_id for one in read(tmp_path / "bag")}
    assert frames == {
        "/left/results": "robot",
        "/left/localizations": "robot",
        "/left/detections": "robot",
    }


def test_bag_value_that_is_nearly_a_localization_is_none(tmp_path: Path) -> None:
    good: dict[str, Any] = jsonable(part())
    broken: list[dict[str, Any]] = [
        {"quality": None},
        {"quality": "0.5"},
        {"quality": True},
        {"photo_index": 1.5},
        {"feature_id": 3},
        {"pose": {"position": {}}},
        {"pose": {**good["pose"], "sigma": {"x": 0.1}}},
        {"more": 1},
    ]
    sigma = {"pose": jsonable(part().pose.with_sigma(PoseSigma(1e-4, 2e-4, 1e-3, 0.5)))}
    items = [result(number, [{**good, **one}]) for number, one in enumerate([sigma, *broken])]
    recording = write(tmp_path / "run.mcap", items)
    assert write_bag(recording, tmp_path / "bag").localizations == 1
    messages = read(tmp_path / "bag")
    assert [one.at for one in on("/left/localizations", messages)] == [recorded_time(at(0.5))]
    told = [one.message for one in on("/left/results", messages)]
    assert [bool(one.json) for one in told] == [False, *[True] * len(broken)]


async def test_bag_interpreted_again_is_what_the_client_would_have_had(tmp_path: Path) -> None:
    await both(tmp_path, interpret_as="raw")
    await both(_folder(tmp_path / "other"), y_down=True)
    recording = load_recording(tmp_path / "run.mcap")
    counts = write_bag(recording, tmp_path / "made", interpret_as="localizations", y_down=True)
    assert (counts.uninterpreted, counts.localizations) == (0, 3)
    made, live = (
        [[_plain(pose) for pose in one.message.poses] for one in on("/table/localizations", found)]
        for found in (read(tmp_path / "made"), read(tmp_path / "other/live"))
    )
    plain = tmp_path / "plain"
    write_bag(recording, plain, interpret_as="localizations")
    up = [one.message.poses for one in on("/table/localizations", read(plain))]
    assert [[-pose[1] for pose in poses] for poses in made] == [
        [pose.position.y for pose in poses] for poses in up
    ]
    assert [len(poses) for poses in made] == [len(poses) for poses in live]


@pytest.mark.parametrize(
    ("facts", "given", "y"),
    [
        ({}, None, 0.25),
        ({"y_down": True}, None, -0.25),
        ({"y_down": True}, False, 0.25),
        ({}, True, -0.25),
    ],
)
def test_bag_takes_the_axis_as_it_was_recorded(
    tmp_path: Path, facts: dict[str, Any], given: bool | None, y: float
) -> None:
    raw = struct.pack("<50sfifff", b"bolt", 0.5, 0, 0.5, 0.25, 0.0)
    items = [*session(), result(1, None, raw)]
    recording = write(tmp_path / "run.mcap", items, **facts)
    counts = write_bag(recording, tmp_path / "bag", interpret_as="localizations", y_down=given)
    assert counts.localizations == 1, [one.message for one in read(tmp_path / "bag")]
    (array,) = on("/left/localizations", read(tmp_path / "bag"))
    assert [pose.position.y for pose in array.message.poses] == [y]


def _folder(path: Path) -> Path:
    path.mkdir()
    return path


class Shifted:
    """A calibration: a metre further."""

    y_down = None

    def to_robot(self, parts: list[Localization]) -> list[Localization]:
        return [
            one._replace(
                pose=one.pose._replace(
                    header=one.pose.header._replace(frame_id="robot"),
                    position=one.pose.position._replace(x=one.pose.position.x + 1.0),
                )
            )
            for one in parts
        ]


async def test_bag_with_a_calibration_is_in_the_robots_frame(tmp_path: Path) -> None:
    await both(tmp_path, triggers=1)
    recording = load_recording(tmp_path / "run.mcap")
    write_bag(recording, tmp_path / "plain")
    write_bag(recording, tmp_path / "robot", calibration=Shifted())
    (was,), (now,) = (
        on("/table/localizations", read(tmp_path / name)) for name in ("plain", "robot")
    )
    assert now.message.header.frame_id == "robot"
    assert [pose.position.x for pose in now.message.poses] == [
        pose.position.x + 1.0 for pose in was.message.poses
    ]


def test_bag_reads_again_in_the_byte_order_that_was_told(tmp_path: Path) -> None:
    items = [*session(endian=1), result(1, None, b"\0\0\1\2")]
    write_bag(write(tmp_path / "run.mcap", items), tmp_path / "bag", interpret_as="n: int32")
    (one,) = on("/left/results", read(tmp_path / "bag"))
    assert json.loads(one.message.json) == {"n": 258}


def test_bag_of_one_camera_has_nothing_of_the_other(tmp_path: Path) -> None:
    items = [result(1, None), result(2, None, camera="right")]
    recording = write(tmp_path / "run.mcap", items)
    write_bag(recording, tmp_path / "bag", camera="right")
    assert {one.topic for one in read(tmp_path / "bag")} == {"/right/results"}
    with pytest.raises(ConfigurationError, match="it has no camera 'none'"):
        write_bag(recording, tmp_path / "other", camera="none")
    assert not (tmp_path / "other").exists()


def test_bag_of_another_protocol_is_not_read_again(tmp_path: Path) -> None:
    url = "insight://192.168.0.10"
    items: list[CameraEvent | Result] = [Connected(camera="left", at=at(0), url=url)]
    items.append(result(1, {"A1": 3}))
    recording = write(tmp_path / "run.mcap", items)
    with pytest.raises(UnsupportedError, match="only results of bvs can be interpreted again"):
        write_bag(recording, tmp_path / "bag", interpret_as="n: int32")
    assert write_bag(recording, tmp_path / "bag").results == 1


@pytest.mark.parametrize(
    ("camera", "name"),
    [
        ("left", "left"),
        ("line1/cam3", "line1/cam3"),
        ("192.168.0.10:36701", "_192_168_0_10_36701"),
        ("//a b//c--d/", "a_b/c_d"),
        ("line 1/2", "line_1/_2"),
        ("", "camera"),
        ("/", "camera"),
    ],
)
def test_bag_topics_are_names_of_ros(camera: str, name: str) -> None:
    assert topic_of_camera(camera) == name


def test_bag_topics_of_two_cameras_are_never_the_same(tmp_path: Path) -> None:
    items = [result(number, number, camera=name) for number, name in enumerate(["a-b", "a_b"])]
    write_bag(write(tmp_path / "run.mcap", items), tmp_path / "bag")
    messages = [(one.topic, one.message.json) for one in read(tmp_path / "bag")]
    assert messages == [("/a_b/results", "0"), ("/a_b_2/results", "1")]


# ---------------------------------------------------------------------- what goes wrong


def test_bag_place_that_cannot_be_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    there, other, file = tmp_path / "there", tmp_path / "other", tmp_path / "file"
    there.mkdir()
    other.mkdir()
    (other / "precious.mcap").write_text("mine")
    file.write_text("mine")
    for path, overwrite, text in [
        (there, False, "it exists already; overwrite"),
        (other, True, "the folder holds 'precious.mcap', which is no part of a bag"),
        (file, True, "this is no folder"),
        (tmp_path / "none" / "bag", True, "No such file or directory"),
        (tmp_path / "nul\0", False, "the path of a file or folder"),
    ]:
        with pytest.raises(ConfigurationError, match=text):
            BagRecorder(path, overwrite=overwrite).open()
    assert sorted(one.name for one in tmp_path.iterdir()) == ["file", "other", "there"]
    assert (other / "precious.mcap").read_text() == file.read_text() == "mine"
    assert list(there.iterdir()) == []


def test_bag_takes_the_place_of_a_bag(tmp_path: Path) -> None:
    recording = write(tmp_path / "run.mcap", [result(1, 1), result(2, 2)])
    write_bag(recording, tmp_path / "bag")
    (tmp_path / "bag/bag_1.mcap").write_text("of a longer one")
    with BagRecorder(tmp_path / "bag", overwrite=True) as bag:
        assert sorted(one.name for one in (tmp_path / "bag").iterdir()) == ["bag_0.mcap"]
        with pytest.raises(ConfigurationError, match="another recorder is writing"):
            write_bag(recording, tmp_path / "bag", overwrite=True)
        bag.on_result(result(3, 3))
    assert [one.message.json for one in read(tmp_path / "bag")] == ["3"]


def test_bag_is_not_made_in_the_folder_of_its_recording(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    recording = write(tmp_path / "bag/bag_0.mcap", [result(1, 1)])
    with pytest.raises(ConfigurationError, match="is in this folder"):
        write_bag(recording, tmp_path / "bag", overwrite=True)
    assert len(list(recording.results())) == 1


@pytest.mark.parametrize("missing", ["rosbags.typesys.stores.ros2_jazzy", "zstandard", "yaml"])
def test_bag_without_a_library_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    forget_stores()
    with pytest.raises(MissingExtraError, match=r'pip install "smartcam\['):
        BagRecorder(tmp_path / "bag").open()
    assert list(tmp_path.iterdir()) == []


def test_bag_that_was_cut_off_is_read_up_to_there(tmp_path: Path) -> None:
    path = tmp_path / "bag/bag_0.mcap"
    with BagRecorder(tmp_path / "bag") as bag:
        for number in range(5):
            bag.on_result(result(number, [part()]))
    whole = path.read_bytes()
    end = whole.index(b"\x0f\x04\0\0\0\0\0\0\0")  # the record DataEnd
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[:end])
    names: list[str] = []
    with cut.open("rb") as stream, pytest.raises(McapError):
        names.extend(type(record).__name__ for record in StreamReader(stream).records)
    assert names.count("Message") == 15
    with pytest.raises(ReaderError, match="File end magic is invalid"):
        read_by_rosbags(cut)  # so docs/bags.md names what gives it an end


needs_full = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="a disk that is always full: Linux has one"
)


def on_a_full_disk(folder: Path) -> Path:
    folder.mkdir()
    (folder / f"{folder.name}_0.mcap").symlink_to("/dev/full")
    return folder


@needs_full
@pytest.mark.real_time
async def test_bag_on_a_full_disk_ends_with_its_reason(tmp_path: Path) -> None:
    bag = BagRecorder(on_a_full_disk(tmp_path / "bag"), overwrite=True).open()
    assert str(await bag.wait_failed()) == f"recording {tmp_path / 'bag'}: No space left on device"
    bag.on_result(result(1, 1))
    with pytest.raises(RecordingError, match="No space left on device"):
        bag.close()
    assert not (tmp_path / "bag/metadata.yaml").exists()


@needs_full
def test_bag_of_a_recording_on_a_full_disk_leaves_nothing(tmp_path: Path) -> None:
    recording = write(tmp_path / "run.mcap", [result(1, 1)])
    with pytest.raises(RecordingError, match=r"bag .*bag: No space left on device"):
        write_bag(recording, on_a_full_disk(tmp_path / "bag"), overwrite=True)
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize(
    ("item", "text"),
    [
        (result(1, 1, application=1 << 70), "application_id"),
        (result(1, 1, number=-1), "result_id"),
        (result(1e9, 1), "header.stamp.sec"),
    ],
)
def test_bag_of_numbers_that_no_message_holds_is_a_recording_error(
    tmp_path: Path, item: Result, text: str
) -> None:
    recording = write(tmp_path / "run.mcap", [result(0, 1), item])
    assert len(list(recording.results())) == 2
    with pytest.raises(RecordingError, match=rf"^bag .*/bag: .*{text}: expected u?int"):
        write_bag(recording, tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_bag_recorder_says_which_message_cannot_be(tmp_path: Path) -> None:
    bag = BagRecorder(tmp_path / "bag").open()
    bag.on_result(result(1, 1, application=1 << 70))
    with pytest.raises(RecordingError, match=r"smartcam_msgs/msg/Result: application_id"):
        bag.close()


def test_bag_of_a_recording_can_be_left_and_leaves_nothing(tmp_path: Path) -> None:
    noise = hashlib.shake_256(b"noise").digest(1 << 19)
    items = [result(number, None, noise) for number in range(12)]
    recording = write(tmp_path / "run.mcap", items)
    conversion = BagConversion(recording, tmp_path / "bag", None, None, None, None, False)
    steps, path = conversion.steps(), tmp_path / "bag/bag_0.mcap"
    sizes = []
    for _ in items[1:]:
        next(steps)
        sizes.append(path.stat().st_size)
    assert len(set(sizes)) > 2  # it is written as it comes: nothing waits for the end
    assert not (tmp_path / "bag/metadata.yaml").exists()
    steps.close()
    assert not (tmp_path / "bag").exists()
