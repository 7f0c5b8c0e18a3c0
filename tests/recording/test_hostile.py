"""Hostile recordings: bounds hold, and mistakes lead to a typed error or a remark."""

from __future__ import annotations

import contextlib
import json
import math
import struct
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from smartcam.exceptions import ConfigurationError, RecordingError, SmartCamError
from smartcam.models import Connected, Disconnected, Status, StatusChanged
from smartcam.recording import Recorder, ReplayedCamera, load_recording, write_pcap
from smartcam.recording import _reader as reader
from tests.recording.inside import (
    FORMAT,
    KINDS,
    MAX_VALUES,
    PICTURE_SCHEMAS,
    RecordedPicture,
    message_fields,
    message_of,
)
from tests.recording.inside import form as forms
from tests.recording.inside import messages as pictures
from tests.recording.inside import records as bounds
from tests.recording.inside import schedule as plans
from tests.recording.picturekit import VARIED, all_formats, same, shot
from tests.recording.recordingkit import at, container, frame, session, status, write

RESULT = {
    "camera": "left",
    "application": 5,
    "number": 1,
    "received_at": "2026-01-02T03:04:05+00:00",
    "raw": "",
}

PACKERS: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstandard.ZstdCompressor().compress,
    "lz4": lz4.frame.compress,
    "": bytes,
}


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def chunk(data: bytes, how: str = "zstd", said: int | None = None) -> bytes:
    """Return a chunk that says that it unpacks to ``said`` bytes."""
    packed = PACKERS[how](data)
    head = struct.pack("<QQQI", 0, 0, len(data) if said is None else said, 0)
    return record(6, head + text(how) + struct.pack("<Q", len(packed)) + packed)


def message(body: object, channel: int = 1) -> bytes:
    """Return a message; a result unless of another channel."""
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    return record(5, struct.pack("<HIQQ", channel, 0, 0, 0) + data)


def written(path: Path, *records: bytes) -> Path:
    """Write a file of ours with channels 1 (results), 2 (frames), 3 (events) and 4 (errors)."""
    facts = text("format") + text(FORMAT)
    begin = record(12, text("smartcam") + struct.pack("<I", len(facts)) + facts)
    for number, kind in enumerate(("results", "frames", "events", "errors"), 1):
        name = text(KINDS[kind].schema)
        begin += record(3, struct.pack("<H", number) + name + text("jsonschema") + text(""))
        begin += record(
            4, struct.pack("<HH", number, number) + text("/x") + text("json") + text("")
        )
    end = record(15, bytes(4)) + record(2, bytes(20))
    path.write_bytes(bounds.MAGIC + begin + b"".join(records) + end + bounds.MAGIC)
    return path


# ---------------------------------------------------------------------- bounds


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("how", ["zstd", "lz4"])
@pytest.mark.parametrize("said", [None, 10, 1 << 60])
def test_load_recording_chunk_that_unpacks_beyond_the_bound_is_refused(
    tmp_path: Path, how: str, said: int | None
) -> None:
    path = written(tmp_path / "bomb.mcap", chunk(bytes(3 * bounds.MAX_CHUNK_BYTES), how, said))
    tracemalloc.start()
    try:
        with pytest.raises(RecordingError) as told:
            load_recording(path)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert str(told.value).startswith(f"recording {path}: a chunk unpacks to more than ")
    assert str(told.value).endswith(f" bytes, expected {bounds.MAX_CHUNK_BYTES} at most")
    assert most < 2 * bounds.MAX_CHUNK_BYTES


@pytest.mark.parametrize("how", ["zstd", "lz4", ""])
@pytest.mark.parametrize("said", [0, 10, 1 << 60])
def test_load_recording_chunk_of_another_size_than_said_is_damaged(
    tmp_path: Path, how: str, said: int
) -> None:
    good = message(RESULT)
    recording = load_recording(written(tmp_path / "run.mcap", chunk(good), chunk(good, how, said)))
    assert recording.counts.results == 1
    assert f"unpacks to {len(good)} bytes, expected {said};" in recording.remark


@pytest.mark.parametrize("small", [message(RESULT), record(0x77, b"")])
def test_load_recording_more_records_than_bytes_is_refused(tmp_path: Path, small: bytes) -> None:
    path = written(tmp_path / "bomb.mcap", chunk(small * 200_000))
    assert path.stat().st_size < bounds.RECORD_ALLOWANCE
    with pytest.raises(RecordingError, match=r"10001 records in the first \d+ bytes of the file"):
        load_recording(path)


def test_load_recording_many_chunks_of_nothing_new_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bounds, "UNPACKED_BYTES_ALLOWANCE", 1 << 20)
    padding = record(0x77, bytes(1 << 22))
    with pytest.raises(RecordingError, match=r"bytes of the file unpack to .*, expected 10000 for"):
        load_recording(written(tmp_path / "bomb.mcap", *[chunk(padding)] * 2))


def test_load_recording_results_of_one_frame_again_and_again_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bounds, "UNPACKED_BYTES_ALLOWANCE", 1 << 20)
    large = message(message_of("frames", container(0, bytes(1 << 16))), 2)
    small = {**RESULT, "raw_from": 0}
    del small["raw"]
    path = written(tmp_path / "bomb.mcap", chunk(large + message(small) * 100))
    with pytest.raises(RecordingError, match=r"bytes of the file unpack to .*, expected 10000 for"):
        load_recording(path)


def test_load_recording_message_of_too_many_values_ends_it(tmp_path: Path) -> None:
    good, bad = message(RESULT), message(b"[" + b"[]," * MAX_VALUES + b"1]")
    recording = load_recording(written(tmp_path / "bomb.mcap", chunk(good + bad)))
    assert recording.counts.results == 1
    assert f"values, expected {MAX_VALUES} at most" in recording.remark


def test_load_recording_more_values_than_the_file_can_have_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "VALUE_ALLOWANCE", 1000)
    many = message({**RESULT, "value": [0] * 100_000})
    with pytest.raises(RecordingError, match=r"values in the messages of the first \d+ bytes"):
        load_recording(written(tmp_path / "bomb.mcap", chunk(many)))


def test_load_recording_too_many_cameras_are_refused(tmp_path: Path) -> None:
    all_of_them = b"".join(
        message({**RESULT, "camera": str(number)}) for number in range(forms.MAX_CAMERAS + 1)
    )
    with pytest.raises(RecordingError, match="10001 cameras, expected 10000 at most"):
        load_recording(written(tmp_path / "run.mcap", chunk(all_of_them)))


def test_replay_of_more_than_fits_into_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = {"application": 5, "data": "00" * 600}
    items = [*session(), *(frame(1 + n, "< ResultContainer", **data) for n in range(2))]
    recording = write(tmp_path / "run.mcap", items)
    monkeypatch.setattr(plans, "MAX_REPLAY_BYTES", 1000)
    with pytest.raises(RecordingError, match="1200 bytes of containers"):
        ReplayedCamera(recording)


def test_recorder_message_that_could_not_be_read_ends_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forms, "MAX_MESSAGE_BYTES", 1000)
    recorder = Recorder(tmp_path / "run.mcap").open()
    recorder.on_frame(frame(0, "> Trigger", data="0" * 1000))
    with pytest.raises(RecordingError, match=r"a message of \d+ bytes, expected 1000 at most"):
        recorder.close()


@pytest.mark.parametrize(
    ("container", "seconds"), [(bytes(1 << 19), 8), (bytes(range(256)) * 4, 600)]
)
def test_load_recording_real_ones_stay_far_below_the_bounds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, container: bytes, seconds: int
) -> None:
    # nothing but zeros, and a minute that is nothing but statuses and containers
    for name in ("RECORD_ALLOWANCE", "UNPACKED_BYTES_ALLOWANCE"):
        monkeypatch.setattr(bounds, name, getattr(bounds, name) >> 8)
    monkeypatch.setattr(reader, "VALUE_ALLOWANCE", 1 << 14)
    items: list[Any] = session()
    for number in range(seconds * 3):
        items += [status(number / 3, "RUNNING")] * 4
        items.append(frame(number / 3, "< ResultContainer", application=5, data=container.hex()))
    assert write(tmp_path / "run.mcap", items).remark == ""


# ---------------------------------------------------------------------- damage


WRONG: list[object] = [
    None, True, 7.5, float("inf"), 10**30, "", "0x" + "f" * 50, "2026-01-01", [1], {"a": 1},
    "0001-01-01T00:00:00+23:59", "9999-12-31T23:59:59+00:00", "http://x", "insight://h", "<",
    "\ud800",
]  # fmt: skip
"""Values that may stand where something else is expected."""


def messages() -> list[tuple[int, dict[str, Any]]]:
    """Return channel and body of each kind of message, as a recorder writes them."""
    events = session()
    frames = [message_fields(message_of("frames", one)) for one in events[:-1]]
    container = frame(1, "< ResultContainer", application=5, data="00")
    switch = frame(1, "> SwitchApplication", application=5)
    answer = frame(1, "< SwitchAnswer", application=5, code=0)
    frames += [message_fields(message_of("frames", one)) for one in (container, switch, answer)]
    at, camera = events[0].at, "left"
    told = [
        Connected(camera=camera, at=at, url="bvs://h:36701?dialect=handbook"),
        StatusChanged(camera=camera, at=at, status=Status.RUNNING, previous=Status.RUNNING),
        Disconnected(camera=camera, at=at, reason="over", expected=True),
    ]
    when = RESULT["received_at"]
    error = {"camera": camera, "at": when, "error": "X", "text": "x", "triggered_at": when}
    result = {**RESULT, "triggered_at": when, "latency": 0.1, "sequence": 3, "value": [1]}
    return [
        *((2, one) for one in frames),
        *((3, message_fields(message_of("events", one))) for one in told),
        (1, result),
        (1, {**result, "raw_from": 0, "value_from": "raw"}),
        (4, error),
    ]


def use(path: Path, made: Path) -> None:
    """Do everything that one does with a recording; only typed errors may come."""
    try:
        recording = load_recording(path)
    except SmartCamError:
        return
    list(recording.items())
    assert recording.seconds >= 0
    for camera in (None, *recording.cameras):
        for job in (
            lambda camera=camera: ReplayedCamera(recording, camera=camera),
            lambda camera=camera: write_pcap(recording, made, camera=camera, overwrite=True),
        ):
            with contextlib.suppress(SmartCamError):
                job()


@pytest.mark.parametrize(
    "anything",
    [
        pytest.param(WRONG[::5], id="some"),
        pytest.param(
            [one for n, one in enumerate(WRONG) if n % 5], id="rest", marks=pytest.mark.long
        ),
    ],
)
def test_recording_with_anything_anywhere_gives_typed_errors_only(
    tmp_path: Path, anything: list[object]
) -> None:
    told = messages()
    for index, (channel, body) in enumerate(told):
        places: list[tuple[str, ...]] = [(name,) for name in body]
        places += [("fields", name) for name in body.get("fields", {})]
        for place in places:
            for wrong in anything:
                changed = json.loads(json.dumps(body))
                inner = changed if len(place) == 1 else changed["fields"]
                inner[place[-1]] = wrong
                all_of_them = [*told[:index], (channel, changed), *told[index + 1 :]]
                data = b"".join(message(one, number) for number, one in all_of_them)
                use(written(tmp_path / "run.mcap", chunk(data, "")), tmp_path / "run.pcap")


@pytest.mark.parametrize("body", [b"[]", b"7", b"{", b"\xff", b"[" * 100_000, b"1" * 5000, b""])
def test_load_recording_message_that_is_no_object_is_told(tmp_path: Path, body: bytes) -> None:
    path = written(tmp_path / "run.mcap", chunk(message(RESULT) + message(body)))
    recording = load_recording(path)
    assert recording.counts.results == 1
    assert recording.remark.startswith("the file is damaged after message 1: ")


@pytest.mark.parametrize(
    "bad",
    [
        record(5, b"x"),
        record(3, b"\x01\x00\xff\xff\xff\xff"),
        record(4, b"x"),
        record(6, b"x" * 30),
        record(12, b"\xff\xff\xff\xff"),
        record(12, bytes(bounds.MAX_METADATA_BYTES + 1)),
        struct.pack("<BQ", 6, 1 << 60),
        chunk(message(RESULT)[:-3]),
        chunk(b"\x05\x00"),
        chunk(message(RESULT), "").replace(b"left", b"l\xfft"),
    ],
)
def test_load_recording_damaged_record_keeps_what_came_before(tmp_path: Path, bad: bytes) -> None:
    recording = load_recording(written(tmp_path / "run.mcap", chunk(message(RESULT)), bad))
    assert recording.counts.results == 1
    assert recording.remark


# ---------------------------------------------------------------------- one recorder a file


def test_recorder_second_one_on_a_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, overwrite=True) as first:
        first.on_frame(frame(0, "> Connect"))
        with pytest.raises(ConfigurationError) as told:
            Recorder(path, overwrite=True).open()
    assert str(told.value) == f"recording {path}: another recorder is writing this file"
    recording = load_recording(path)
    assert (recording.counts.frames, recording.remark) == (1, "")
    with Recorder(path, overwrite=True):  # free again
        pass
    assert load_recording(path).counts.frames == 0


RECORDS = """
import sys
from smartcam.recording import Recorder
Recorder(sys.argv[1], overwrite=True).open()
print("ready", flush=True)
sys.stdin.read()
"""


def test_recorder_file_of_another_process_is_refused_until_that_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    command = [sys.executable, "-c", RECORDS, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:  # noqa: S603
        assert other.stdout is not None
        assert other.stdout.readline() == b"ready\n"
        with pytest.raises(ConfigurationError, match="another recorder is writing this file"):
            Recorder(path, overwrite=True).open()
        other.kill()
    with Recorder(path, overwrite=True) as recorder:
        recorder.on_frame(frame(0, "> Connect"))
    assert load_recording(path).counts.frames == 1


# ---------------------------------------------------------------------- pictures


@pytest.mark.parametrize("form", all_formats())
def test_message_of_each_format_is_the_picture_again(form: str) -> None:
    for number, other in enumerate(VARIED):
        picture = RecordedPicture("left", at(number / 10), shot(number, form, **other), 4, 7, at(3))
        data = pictures.picture_message(picture)
        found = pictures.picture_of(pictures.schema_of(picture), memoryview(data))
        assert same(picture.frame, found.frame)
        assert found._replace(frame=picture.frame) == picture


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=200), schema=st.sampled_from(PICTURE_SCHEMAS))
def test_bytes_of_no_picture_are_refused(data: bytes, schema: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - whatever it is
        pictures.picture_of(schema, memoryview(data))


@settings(max_examples=300, deadline=None)
@given(place=st.integers(0, 200), byte=st.integers(0, 255), cut=st.booleans())
def test_damaged_picture_is_a_picture_of_its_size_or_refused(
    place: int, byte: int, cut: bool
) -> None:
    picture = RecordedPicture("left", at(0), shot(1))
    data = bytearray(pictures.picture_message(picture))
    data[place] = byte
    if cut:
        del data[-place - 1 :]
    try:
        found = pictures.picture_of(pictures.RAW, memoryview(bytes(data))).frame
    except ValueError:
        return
    found.format.check(found.data, found.width, found.height, found.stride)
    assert math.isfinite(found.utc)
    assert math.isfinite(found.captured)
