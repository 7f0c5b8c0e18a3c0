"""Reading recordings: whole, cut off, damaged, and other files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from smartcam.emulator import EmulatedCamera
from smartcam.exceptions import ConfigurationError
from smartcam.recording import load_recording
from tests.recording.recordingkit import COUNTER, at, frame, record, session, write


async def test_load_recording_gives_what_was_recorded(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    async with EmulatedCamera([COUNTER]) as emulator:
        recording = await record(path, emulator, triggers=3, interpret_as="n: int32")
    assert (recording.remark, recording.counts.results) == ("", 3)
    results = list(recording.results())
    assert [(one.raw, one.value) for one in results] == [
        (number.to_bytes(4, "little"), {"n": number}) for number in range(3)
    ]
    assert all(one.triggered_at is not None and one.latency for one in results)
    frames = list(recording.frames("left"))
    assert [one.message for one in frames[:3]] == ["Disconnect", "Connect", "ConnectAnswer"]
    assert bytes.fromhex(frames[1].hex) == bytes.fromhex("505356420000000001000000")
    assert recording.camera().dialect == "handbook"


def test_recording_camera_is_named_where_there_are_several(tmp_path: Path) -> None:
    other = frame(0, "> Connect")._replace(camera="right")
    recording = write(tmp_path / "run.mcap", [frame(0, "> Connect"), other])
    with pytest.raises(ConfigurationError, match="it has 2 cameras, choose one: left, right"):
        recording.camera()
    with pytest.raises(ConfigurationError, match="it has no camera 'up'; it has: left, right"):
        recording.camera("up")
    assert recording.camera("right").url == ""


def test_recording_without_anything_has_no_camera(tmp_path: Path) -> None:
    recording = write(tmp_path / "run.mcap", [])
    assert (recording.seconds, recording.began) == (0.0, None)
    with pytest.raises(ConfigurationError, match="it has no camera"):
        recording.camera()


def test_load_recording_cut_anywhere_gives_the_begin(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write(path, session())
    whole = path.read_bytes()
    read: set[int] = set()
    for size in range(400, len(whole), 37):
        path.write_bytes(whole[:size])
        recording = load_recording(path)
        assert recording.remark.startswith("the file has no end: the recording was cut off; ")
        read.add(recording.counts.frames)
    assert read == {0, 4}  # a chunk is there or not


def test_load_recording_damaged_byte_is_told_or_harmless(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write(path, session())
    whole, count = path.read_bytes(), load_recording(path).counts
    remarks: set[str] = set()
    for place in range(8, len(whole), 11):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            found = load_recording(path)
            remarks.add(found.remark.partition(":")[0])
            assert found.remark or found.counts == count, place
        except ConfigurationError as exc:
            remarks.add(str(exc).partition("mcap: ")[2].partition(";")[0])
    ours = {"", "the file has no end", "this MCAP file is no recording of smartcam"}
    assert {text for text in remarks if not text.startswith("the file is damaged after")} <= ours
    assert remarks - ours


@pytest.mark.parametrize("step", [11, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize("size", [9, 200])
def test_load_recording_damaged_places_are_told_or_harmless(
    tmp_path: Path, size: int, step: int
) -> None:
    path = tmp_path / "run.mcap"
    write(path, session())
    whole, count = path.read_bytes(), load_recording(path).counts
    told = 0
    for place in range(8, len(whole) - size, step):  # zeros are read as records of no length
        path.write_bytes(whole[:place] + bytes(size) + whole[place + size :])
        try:
            found = load_recording(path)
        except ConfigurationError:
            continue
        assert found.remark or found.counts == count, place
        told += bool(found.remark)
    assert told


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "this is no MCAP file: it is empty"),
        (b"\xd4\xc3\xb2\xa1\x02\x00", "this is no MCAP file: it begins with d4 c3 b2 a1 02 00"),
    ],
)
def test_load_recording_no_mcap_is_refused(tmp_path: Path, data: bytes, text: str) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    with pytest.raises(ConfigurationError) as told:
        load_recording(path)
    assert str(told.value) == f"recording {path}: {text}"


def test_load_recording_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"run\.mcap: No such file or directory"):
        load_recording(tmp_path / "run.mcap")


def test_load_recording_of_another_program_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer: Any = Writer(stream)
        writer.start()
        schema = writer.register_schema("sensor_msgs/Image", "ros2msg", b"uint8 x")
        writer.add_message(writer.register_channel("/image", "cdr", schema), 0, b"x", 0)
        writer.finish()
    with pytest.raises(
        ConfigurationError, match="no recording of smartcam; it holds sensor_msgs/Image"
    ):
        load_recording(path)


def test_load_recording_of_another_form_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer: Any = Writer(stream)
        writer.start()
        writer.add_metadata("smartcam", {"format": "9", "version": "8.0"})
        writer.finish()
    with pytest.raises(
        ConfigurationError, match=r"its format is 9, this version .* by smartcam 8\.0"
    ):
        load_recording(path)


@pytest.mark.parametrize("form", ["1", "2", "3"])
def test_load_recording_of_either_form(tmp_path: Path, form: str) -> None:
    path = tmp_path / "run.mcap"
    said: dict[str, Any] = {"at": at(0).isoformat(), "camera": "left", "direction": "<"}
    said |= {"message": "ResultContainer", "hex": "0102aabb", "fields": {"application": 5}}
    if form == "1":
        said["fields"]["data"] = "aabb"
    else:
        said["data_from"] = 2
    with path.open("wb") as stream:
        writer: Any = Writer(stream)
        writer.start()
        writer.add_metadata("smartcam", {"format": form})
        schema = writer.register_schema("smartcam.Frame", "jsonschema", json.dumps({}).encode())
        channel = writer.register_channel("/left/frames", "json", schema)
        writer.add_message(channel, 0, json.dumps(said).encode(), 0)
        writer.finish()
    (entry,) = load_recording(path).frames()
    assert entry.fields == {"application": 5, "data": "aabb"}


def test_load_recording_other_topics_are_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer: Any = Writer(stream)
        writer.start()
        writer.add_metadata("smartcam", {"format": "3"})
        schema = writer.register_schema("mine", "jsonschema", json.dumps({}).encode())
        writer.add_message(writer.register_channel("/mine", "json", schema), 0, b"{}", 0)
        writer.finish()
    recording = load_recording(path)
    assert (recording.counts, recording.remark) == ((0, 0, 0, 0, 0, 0), "")
