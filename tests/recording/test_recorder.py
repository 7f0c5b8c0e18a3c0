"""Files that a recorder writes, as other programs read them."""

from __future__ import annotations

import asyncio
import json
import pickle
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader

import smartcam
from smartcam.emulator import EmulatedCamera, EmulatedInSight, Job
from smartcam.exceptions import (
    ConfigurationError,
    MissingExtraError,
    RecordingError,
    TriggerTimeoutError,
)
from smartcam.models import Connected, Disconnected, Result, StatusChanged
from smartcam.recording import Recorder, load_recording
from tests.recording.inside import KINDS
from tests.recording.inside import _recorder as recorder
from tests.recording.recordingkit import COUNTER, at, frame, record, write


def messages(path: Path) -> list[tuple[str, str, dict[str, Any]]]:
    """Return topic, schema and body of every message, read by the mcap library alone."""
    with path.open("rb") as stream:
        found = make_reader(stream, validate_crcs=True).iter_messages()
        return [
            (channel.topic, schema.name if schema is not None else "", json.loads(message.data))
            for schema, channel, message in found
        ]


async def test_recorder_run_is_read_by_the_mcap_library(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    async with EmulatedCamera([COUNTER]) as emulator:
        await record(path, emulator, triggers=2, interpret_as="n: int32")
    found = messages(path)
    assert {(topic, schema) for topic, schema, _ in found} == {
        ("/left/frames", "smartcam.Frame"),
        ("/left/results", "smartcam.Result"),
        ("/left/events", "smartcam.Event"),
    }
    frames = [body for topic, _, body in found if topic == "/left/frames"]
    results = [body for topic, _, body in found if topic == "/left/results"]
    came = [frames[one["raw_from"] - 1] for one in results]
    raws = [one["hex"][2 * one["data_from"] :] for one in came]
    assert [(one["value"], raw, one["number"]) for one, raw in zip(results, raws, strict=True)] == [
        ({"n": 0}, "00000000", 1),
        ({"n": 1}, "01000000", 2),
    ]
    assert not {"sequence", "raw"} & results[0].keys()  # None is left out


@pytest.mark.long
async def test_recorder_messages_fit_their_schemas(tmp_path: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema", reason="needs jsonschema, of the extra dev")
    path = tmp_path / "run.mcap"
    async with EmulatedCamera([COUNTER], faults=[{"kind": "no_result"}]) as emulator:
        with Recorder(path) as made:
            async with smartcam.connect(emulator.url, application=5, observers=[made]) as camera:
                with pytest.raises(TriggerTimeoutError):
                    await camera.trigger(timeout=0.05)
                await camera.trigger()
    seen: set[str] = set()
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            rules = json.loads(schema.data)
            jsonschema.Draft202012Validator.check_schema(rules)
            jsonschema.validate(json.loads(message.data), rules)
            seen.add(schema.name)
    assert seen == {"smartcam.Frame", "smartcam.Result", "smartcam.Event", "smartcam.Error"}


def test_recorder_schemas_have_one_word_as_type() -> None:
    # what Foxglove reads: each property one plain type, each array's items too
    for kind in KINDS.values():
        for name, rules in kind.properties.items():
            assert rules["type"] in {"string", "integer", "number", "boolean", "object", "array"}
            assert rules["type"] != "array" or rules["items"] == {"type": "string"}, name


async def test_recorder_header_and_metadata_tell_the_run(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    async with EmulatedCamera([COUNTER], dialect="b16", quirks={"code": True}) as emulator:
        with Recorder(path) as made:
            made.describe("left", interpret_as="n: int32", application=None)
            async with smartcam.connect(emulator.url, name="left", observers=[made]):
                pass
        url = emulator.url
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "x-smartcam"
        assert reader.get_header().library == f"smartcam {smartcam.__version__}"
        told = [(one.name, one.metadata) for one in reader.iter_metadata()]
    assert told[0][0] == "smartcam"
    assert told[0][1]["format"] == "3"
    assert told[-1] == (
        "smartcam.camera",
        {
            "camera": "left",
            "interpret_as": "n: int32",
            "url": url,
            "protocol": "bvs",
            "dialect": "b16",
            "quirks": "code",
        },
    )


async def test_recorder_in_sight_password_is_nowhere(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    async with EmulatedInSight(
        [Job(file="1PartCheck.job", cells={"A1": 101.5})], users={"admin": "geheim17"}
    ) as emulator:
        url = emulator.url.replace("://", "://admin:geheim17@")
        with Recorder(path) as made:
            async with smartcam.connect(url, name="left", observers=[made]):
                pass
    assert "geheim17" not in str(messages(path))
    assert load_recording(path).cameras["left"].url.startswith("insight://admin@127.0.0.1:")


async def test_recorder_serves_two_cameras(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    async with EmulatedCamera([COUNTER]) as one, EmulatedCamera([COUNTER]) as other:
        with Recorder(path) as made:
            observers = [made]
            async with (
                smartcam.connect(one.url, name="left", application=5, observers=observers) as left,
                smartcam.connect(
                    other.url, name="a/b", application=5, observers=observers
                ) as right,
            ):
                await left.trigger()
                await right.trigger()
                await right.trigger()
    recording = load_recording(path)
    assert list(recording.cameras) == ["left", "a/b"]
    assert [len(list(recording.results(name))) for name in ("left", "a/b", "none")] == [1, 2, 0]
    assert {topic for topic, _, _ in messages(path)} >= {"/left/results", "/a/b/results"}


async def test_recorder_counts_what_it_took(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as made:
        made.on_frame(frame(0, "> Connect"))
        made.on_state(Connected(camera="left", at=at(0), url="bvs://h"))
        made.on_error("left", TriggerTimeoutError("none came"), at(1))
        assert made.counts == (1, 0, 1, 1, 0, 0)
        assert made.error is None


def test_recorder_before_open_and_after_close_takes_nothing(tmp_path: Path) -> None:
    made = Recorder(tmp_path / "run.mcap")
    made.on_frame(frame(0, "> Connect"))
    made.open()
    made.close()
    made.close()
    made.on_frame(frame(0, "> Connect"))
    assert made.counts.frames == 0
    assert [thread for thread in threading.enumerate() if "recorder" in thread.name] == []


def test_recorder_writes_while_it_records(tmp_path: Path) -> None:
    assert recorder.INTERVAL <= 0.5  # seconds that a process loses which is killed
    path, end = tmp_path / "run.mcap", time.monotonic() + 60
    with Recorder(path) as made:
        made.on_frame(frame(0, "> Connect"))
        made.on_frame(frame(0, "> Query"))
        while not (size := path.stat().st_size) or not load_recording(path).counts.frames:
            assert time.monotonic() < end
            time.sleep(0.02)
        assert load_recording(path).counts.frames == 2
        assert load_recording(path).remark.startswith("the file has no end")
        with path.open("rb") as stream:
            read = NonSeekingReader(stream).iter_messages(log_time_order=False)
            names = [json.loads(next(read)[2].data)["message"] for _ in range(2)]
            assert names == ["Connect", "Query"]
            with pytest.raises(McapError):
                next(read)
    assert path.stat().st_size > size


def test_recorder_file_that_is_there_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    with pytest.raises(ConfigurationError, match=r"run\.mcap: the file exists already; overwrite"):
        Recorder(path).open()
    assert path.read_text() == "precious"
    with Recorder(path, overwrite=True):
        pass
    assert load_recording(path).counts == (0, 0, 0, 0, 0, 0)


def test_recorder_place_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"none/run\.mcap: No such file or directory"):
        Recorder(tmp_path / "none" / "run.mcap").open()


def test_recorder_opened_twice_is_refused(tmp_path: Path) -> None:
    with (
        Recorder(tmp_path / "run.mcap") as made,
        pytest.raises(ConfigurationError, match="opened before; make a new recorder"),
    ):
        made.open()


def test_recorder_without_the_library_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(
        MissingExtraError, match=r'need zstandard: pip install "smartcam\[record\]"'
    ) as told:
        Recorder(tmp_path / "run.mcap").open()
    assert told.value.extra == "record"
    assert list(tmp_path.iterdir()) == []


needs_full = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="a disk that is always full: Linux has one"
)


@needs_full
@pytest.mark.real_time
async def test_recorder_full_disk_is_told_and_leaves_the_camera_alone() -> None:
    made = Recorder("/dev/full", overwrite=True).open()
    async with (
        EmulatedCamera([COUNTER]) as emulator,
        smartcam.connect(emulator.url, application=5, observers=[made]) as camera,
    ):
        error = await asyncio.wait_for(made.wait_failed(), 60)
        assert (await camera.trigger()).application == 5
    assert str(error) == "recording /dev/full: No space left on device"
    with pytest.raises(RecordingError, match="No space left on device"):
        made.close()


@needs_full
def test_recorder_full_disk_does_not_hide_the_first_error() -> None:
    with pytest.raises(KeyError), Recorder("/dev/full", overwrite=True):
        raise KeyError


async def test_recorder_wait_failed_can_be_cancelled(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as made:
        for _ in range(2):
            task = asyncio.create_task(made.wait_failed())
            await asyncio.sleep(0)
            task.cancel()
            await asyncio.wait({task})
            assert task.cancelled()


def test_recorder_disk_too_slow_ends_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "MAX_WAITING_BYTES", 2 * recorder.ITEM_OVERHEAD_BYTES)
    monkeypatch.setattr(recorder, "INTERVAL", 60.0)
    made = Recorder(tmp_path / "run.mcap").open()
    for _ in range(5):
        made.on_frame(frame(0, "> Query"))
    assert made.counts.frames == 2  # the second was one too many
    with pytest.raises(RecordingError, match="the disk is too slow: 0 MiB wait to be written"):
        made.close()


def test_recorder_value_that_makes_no_json_ends_the_recording(tmp_path: Path) -> None:
    class Odd:
        def _asdict(self) -> None:
            raise RuntimeError("no")

    made = Recorder(tmp_path / "run.mcap").open()
    made.on_result(Result("left", 1, None, 1, None, at(0), None, b"", Odd()))
    with pytest.raises(RecordingError, match=r"unexpected RuntimeError\('no'\)"):
        made.close()


def test_recording_error_survives_pickle() -> None:
    error = RecordingError("recording run.mcap: full")
    assert str(pickle.loads(pickle.dumps(error))) == "recording run.mcap: full"  # noqa: S301


def test_recorder_events_come_back_as_they_were(tmp_path: Path) -> None:
    events = [
        Connected(camera="left", at=at(0), url="bvs://192.168.0.10:36701?dialect=thesis"),
        StatusChanged(camera="left", at=at(1), status=smartcam.Status(0x41), previous=None),
        StatusChanged(
            camera="left", at=at(1), status=smartcam.Status(0), previous=smartcam.Status(0x41)
        ),
        smartcam.ApplicationChanged(camera="left", at=at(2), application=7, previous=None),
        smartcam.ApplicationChanged(camera="left", at=at(2), application=8, previous=7),
        smartcam.NoticeReceived(camera="left", at=at(2), kind="error", code=7, text="hot"),
        Disconnected(camera="left", at=at(3), reason="gone", expected=False),
        smartcam.Reconnected(camera="left", at=at(4), url="bvs://192.168.0.10:36701"),
    ]
    recording = write(tmp_path / "run.mcap", events)
    assert list(recording.events()) == events
    assert recording.seconds == 4.0
