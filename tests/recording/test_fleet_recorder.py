"""Recording by an agent: consecutive files, their age, the bound on the disk, disks that fail."""

from __future__ import annotations

import asyncio
import errno
import itertools
import json
import logging
import os
import shutil
import subprocess
import sys
import threading
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from smartcam.exceptions import ConfigurationError, NotRunningError, RecordingError
from smartcam.models import ApplicationChanged, Connected, Result, Status, StatusChanged
from smartcam.observers import RawFrame
from smartcam.protocols import BVS
from smartcam.protocols.messages import Sender
from smartcam.recording import FleetRecorder, Recorder, load_recording
from smartcam.recording._folders.camera_recording import CameraRecording
from smartcam.recording._state import RecordedState
from tests.fleet.fleetkit import NumberedCamera, trigger_request
from tests.recording.folderkit import (
    NAME,
    all_runs,
    files,
    name_of,
    recording,
    runs,
    section,
    server,
    until,
)
from tests.recording.inside import (
    GAP,
    FolderFiles,
    Limits,
    RecordingFolder,
    load_compress,
    plan_replay,
)
from tests.recording.inside import files as folder_files
from tests.recording.inside import writer as folder_writer
from tests.recording.recordingkit import URL, at, container, frame, session

pytestmark = pytest.mark.real_time


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the thread take what came a hundred times a second."""
    monkeypatch.setattr(folder_writer, "INTERVAL", 0.01)
    monkeypatch.setattr(folder_writer, "RETRY_DELAYS", (0.02,))
    monkeypatch.setattr(folder_writer, "MIN_FREE_BYTES", 0)


class Disk:
    """A disk whose ``fsync`` does as it is told.

    Attributes:
        error: it raises this; None: nothing.
        stuck: it waits for this.
        calls: how often it was called.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.error: OSError | None = None
        self.stuck: threading.Event | None = None
        self.calls = 0
        self._real = os.fsync
        monkeypatch.setattr(os, "fsync", self._fsync)

    def _fsync(self, descriptor: int) -> None:
        self.calls += 1
        if self.stuck is not None:
            self.stuck.wait(60)
        if self.error is not None:
            raise self.error
        self._real(descriptor)


# ---------------------------------------------------------------------- files that follow


async def test_files_follow_and_no_result_is_lost_between(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folder_files, "ITEMS_PER_CHECK", 1)
    async with NumberedCamera(rate=500) as box:
        async with recording(tmp_path, box.url, size=6000) as (recorder, _):
            await until(lambda: len(files(tmp_path)) >= 4)
        counts = recorder.counts[NAME]
    assert (counts.waiting, counts.lost) == (0, 0)
    found = files(tmp_path)
    assert [path.name for path in found] == sorted(path.name for path in found)
    loaded = [load_recording(path) for path in found]
    assert [one.remark for one in loaded] == [""] * len(found)
    assert sum(sum(one.counts) for one in loaded) == counts.written
    numbers = all_runs(tmp_path)
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert min(len(runs(one)) for one in loaded[:-1]) > 1
    whole = load_recording(tmp_path / "rec")
    assert runs(whole) == numbers
    played = [
        int.from_bytes(data[:4], "little")
        for take in plan_replay(whole).applications[1].untriggered
        for data in take.containers
    ]
    # frames come while the session ends, whose results nobody is handed
    assert played[: len(numbers)] == numbers


async def test_each_file_says_what_the_camera_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folder_files, "ITEMS_PER_CHECK", 1)
    async with NumberedCamera() as box, recording(tmp_path, box.url, size=6000) as (_, agent):
        camera = agent.shared_cameras[NAME].client
        for _ in range(60):
            await camera.trigger()
        while len(files(tmp_path)) < 2:  # the thread may be late
            await camera.trigger()
    first, *rest = files(tmp_path)
    assert rest
    first.unlink()
    found = load_recording(tmp_path / "rec")
    plan = plan_replay(found)
    triggered = [take.containers for take in plan.applications[1].triggered]
    assert (plan.active, plan.running, plan.applications[1].waits) == (1, True, True)
    # the seam may have cut one off from its trigger, not more
    assert len(runs(found)) - 1 <= len(triggered) <= len(runs(found))
    assert found.camera(NAME).interpret_as is not None
    for path in rest:  # the state's time is not that of writing, or a replay began too early
        state, behind, *_ = load_recording(path).all_items(NAME)
        assert isinstance(state, RecordedState)
        assert state.at is not None
        assert state.at == (behind.received_at if isinstance(behind, Result) else behind.at)


async def test_file_is_over_when_it_is_old_also_of_a_silent_camera(tmp_path: Path) -> None:
    now = 0.0
    async with (
        NumberedCamera() as box,
        recording(tmp_path, box.url, age=60.0, clock=lambda: now) as (recorder, agent),
    ):
        await until(lambda: files(tmp_path) and not recorder.counts[NAME].waiting)
        assert "no end" in load_recording(files(tmp_path)[0]).remark
        now = 59.0
        await agent.shared_cameras[NAME].client.trigger()
        await until(lambda: not recorder.counts[NAME].waiting)
        assert len(files(tmp_path)) == 1
        now = 61.0
        await until(lambda: not load_recording(files(tmp_path)[0]).remark)
        assert len(files(tmp_path)) == 1  # nothing is to be said in another
        await agent.shared_cameras[NAME].client.trigger()
        await until(lambda: len(files(tmp_path)) == 2)
    assert all_runs(tmp_path) == [1, 2]


def test_names_sort_also_where_the_clock_goes_back(tmp_path: Path) -> None:
    folder, ages = tmp_path / "rec", itertools.count(step=100)
    for seconds in ((100.0, 50.0, 50.0), (60.0,)):
        compress = load_compress()
        files_of = RecordingFolder(folder)
        writer = FolderFiles(files_of, Limits(1e9, 60.0, 1e9), compress, ages.__next__)
        writer.enter()
        recording = CameraRecording(NAME, lambda given: iter([given]))
        for one in seconds:
            writer.write(recording, [frame(one, "> Query")._replace(camera=NAME)])
        writer.finish(recording)
        files_of.leave()
    found = [load_recording(path) for path in files(tmp_path)]
    assert [entry.at for one in found for entry in one.frames()] == [
        at(seconds) for seconds in (100, 50, 50, 60)
    ]
    assert [name_of(path).at - at(100) for path in files(tmp_path)] == [
        timedelta(milliseconds=place) for place in range(4)
    ]


def test_trigger_behind_which_a_file_is_damaged_gets_no_others_result(tmp_path: Path) -> None:
    compress = load_compress()
    folder = RecordingFolder(tmp_path / "rec")
    writer = FolderFiles(folder, Limits(1e9, 1e9, 1e9), compress, lambda: 0.0)
    writer.enter()
    recording = CameraRecording(NAME, lambda given: iter([given]))

    def write(*items: Any) -> None:
        writer.write(recording, [item._replace(camera=NAME) for item in items])

    writer.write(recording, [Connected(camera=NAME, at=at(0), url=URL)])
    writer.write(
        recording, [ApplicationChanged(camera=NAME, at=at(0), application=5, previous=None)]
    )
    waits = Status.RUNNING | Status.WAITING_FOR_TRIGGER
    writer.write(recording, [StatusChanged(camera=NAME, at=at(0), status=waits, previous=None)])
    write(*session()[:4], frame(1, "> Trigger"), container(1.5, b"one"), frame(2, "> Trigger"))
    first = files(tmp_path)[0]
    size = first.stat().st_size
    write(container(2.5, b"lost"))
    writer.finish(recording)
    write(container(3, b"by itself"), frame(4, "> Trigger"), container(4.25, b"two"))
    writer.finish(recording)
    folder.leave()
    os.truncate(first, size)
    app = plan_replay(load_recording(tmp_path / "rec")).applications[5]
    assert [take.containers for take in app.triggered] == [[b"one"], [b"two"]]
    assert [take.containers for take in app.untriggered] == [[b"by itself"]]


# ---------------------------------------------------------------------- the bound on the disk


async def test_oldest_are_deleted_and_never_what_is_not_ours(tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    folder.mkdir()
    (folder / "notes.txt").write_bytes(b"x" * 50_000)
    (folder / "line1.cam1_20200101T000000.000Z.mcap").write_bytes(b"x" * 50_000)
    with Recorder(folder / "mine.mcap") as other:
        other.on_frame(frame(0, "> Query"))
    kept = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert len(kept) == 3
    async with NumberedCamera(rate=500) as box:
        async with recording(tmp_path, box.url, size=6000, keep=30_000) as (recorder, _):
            first = None
            while first is None or first.exists():
                first = first or next((one for one in files(tmp_path)[1:]), None)
                await asyncio.sleep(0.01)
            await until(lambda: len(files(tmp_path)) >= 4)
        assert recorder.counts[NAME].lost == 0
    assert {name: (folder / name).read_bytes() for name in kept} == kept
    found = [path for path in files(tmp_path) if path.name not in kept]
    assert sum(path.stat().st_size for path in found) <= 30_000 + 2 * 6000
    numbers = [run for path in found for run in runs(load_recording(path))]
    assert numbers[0] > 1
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


async def test_bound_holds_where_only_open_files_are_left(tmp_path: Path) -> None:
    async with NumberedCamera(rate=500) as box, recording(tmp_path, box.url, size=1e9, keep=20_000):
        first = None
        while first is None or first.exists():
            first = first or next(iter(files(tmp_path)), None)
            await asyncio.sleep(0.01)
        await until(lambda: files(tmp_path))


# ---------------------------------------------------------------------- disks that fail


async def test_full_disk_is_told_once_counted_and_heals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, "smartcam.recording")
    disk = Disk(monkeypatch)
    told: list[RecordingError | None] = []
    async with NumberedCamera() as box:
        agent = server(tmp_path, box.url)
        recorder = FleetRecorder(agent, section(), on_trouble=told.append)
        async with recorder, agent:
            await agent.wait_first_attempts()
            camera = agent.shared_cameras[NAME].client
            assert (await camera.trigger()).raw[:4] == b"\1\0\0\0"
            await until(lambda: not recorder.counts[NAME].waiting)
            before = recorder.counts[NAME].written
            disk.error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            for _ in range(20):
                await camera.trigger()  # results go on
                await asyncio.sleep(0.01)
            await until(lambda: not recorder.counts[NAME].waiting)
            lost = recorder.counts[NAME].lost
            assert recorder.counts[NAME].written == before
            assert isinstance(recorder.trouble, RecordingError)
            disk.error = None
            while recorder.trouble is not None:
                await camera.trigger()
                await asyncio.sleep(0.01)
        counts = recorder.counts[NAME]
    assert [one if one is None else str(one) for one in told] == [
        f"recordings {tmp_path / 'rec'}: No space left on device",
        None,
    ]
    texts = [record.getMessage() for record in caplog.records]
    assert [text.rpartition(": ")[2] for text in texts] == [
        "No space left on device; nothing is recorded until the disk works again",
        "records are written again",
    ]
    first, second = files(tmp_path)
    whole = load_recording(tmp_path / "rec")
    numbers = runs(whole)
    # what was there stays, what is lost is one run of numbers, a new file goes on
    assert runs(load_recording(first)) == [1]
    assert numbers[-1] == box.runs
    assert numbers[1:] == list(range(numbers[1], box.runs + 1))
    (gap,) = [one for one in load_recording(second).errors() if one.error == GAP]
    assert gap.records == counts.lost >= lost >= 20
    assert gap.since is not None
    assert gap.since < gap.at
    assert "No space left on device" in gap.text
    assert sum(whole.counts) == counts.written + 1  # the gap, which nobody put in
    # nothing is taken for another trigger's result across the gap
    takes = plan_replay(whole).applications[1].triggered
    assert [take.containers[0][:4] for take in takes if take.containers] == [
        number.to_bytes(4, "little") for number in numbers
    ]


async def test_folder_that_goes_away_is_told_and_used_again_when_it_is_back(
    tmp_path: Path,
) -> None:
    async with NumberedCamera() as box, recording(tmp_path, box.url) as (recorder, agent):
        camera = agent.shared_cameras[NAME].client
        await camera.trigger()
        await until(lambda: not recorder.counts[NAME].waiting)
        shutil.move(tmp_path / "rec", tmp_path / "away")
        while recorder.trouble is None:
            await camera.trigger()
            await asyncio.sleep(0.01)
        assert "No such file or directory" in str(recorder.trouble)
        for _ in range(5):
            await camera.trigger()
            await asyncio.sleep(0.03)
        assert not (tmp_path / "rec").exists()  # it may have been a mount
        (tmp_path / "rec").mkdir()
        while recorder.trouble is not None:
            await camera.trigger()
            await asyncio.sleep(0.01)
        assert recorder.counts[NAME].lost > 0
    assert all_runs(tmp_path)[-1] == box.runs
    assert runs(load_recording(tmp_path / "away"))[0] == 1


async def test_folder_that_cannot_be_made_is_tried_again(tmp_path: Path) -> None:
    async with (
        NumberedCamera() as box,
        recording(tmp_path, box.url, folder="later/rec") as (recorder, agent),
    ):
        assert recorder.trouble is not None
        await agent.shared_cameras[NAME].client.trigger()
        (tmp_path / "later").mkdir()
        while recorder.trouble is not None:
            await agent.shared_cameras[NAME].client.trigger()
            await asyncio.sleep(0.01)
    assert runs(load_recording(tmp_path / "later" / "rec"))[-1] == box.runs


async def test_slow_disk_costs_records_and_neither_memory_nor_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folder_writer, "MAX_WAITING_BYTES", 20_000)
    disk = Disk(monkeypatch)
    async with NumberedCamera() as box:
        async with recording(tmp_path, box.url) as (recorder, agent):
            camera = agent.shared_cameras[NAME].client
            await camera.trigger()
            await until(lambda: not recorder.counts[NAME].waiting)
            disk.stuck, before = threading.Event(), disk.calls
            await camera.trigger()
            await until(lambda: disk.calls > before)
            for _ in range(100):
                await camera.trigger()
            counts = recorder.counts[NAME]
            assert counts.lost > 100
            assert counts.waiting < 150
            assert recorder.trouble is None
            disk.stuck.set()
            await until(lambda: not recorder.counts[NAME].waiting)
            await camera.trigger()
        counts = recorder.counts[NAME]
    whole = load_recording(tmp_path / "rec")
    gaps = [one for one in whole.errors() if one.error == GAP]
    assert sum(gap.records or 0 for gap in gaps) == counts.lost
    assert "too slow" in gaps[0].text
    assert runs(whole)[-1] == box.runs
    assert sum(whole.counts) == counts.written + len(gaps)
    last = [one for one in whole.all_items() if isinstance(one, RecordedState)][-1]
    assert last.application == 1  # events were kept
    assert last.status is not None
    assert Status.RUNNING in last.status


async def test_record_that_makes_no_json_is_counted_and_the_rest_is_written(
    tmp_path: Path,
) -> None:
    async with NumberedCamera() as box:
        async with recording(tmp_path, box.url) as (recorder, agent):
            deep: list[Any] = []
            for _ in range(5000):
                deep = [deep]
            odd = frame(0, "> Query", odd=deep)._replace(camera=NAME)
            dialect = BVS.dialects["handbook"]
            agent.observers[0].on_raw_frame(RawFrame(odd.at, NAME, dialect, Sender.CLIENT, odd))
            await agent.shared_cameras[NAME].client.trigger()
        assert recorder.counts[NAME].lost == 1
    assert all_runs(tmp_path) == [1]


@pytest.mark.long
def test_disk_that_is_really_full(tmp_path: Path) -> None:
    """Fill a small tmpfs to its last byte, and clear it."""
    unshare = shutil.which("unshare")
    if unshare is None or subprocess.run([unshare, "-rm", "true"], check=False).returncode:  # noqa: S603
        pytest.skip("needs mount namespaces: unshare -rm is not allowed here")
    command = [unshare, "-rm", sys.executable, "-m", "tests.recording.full_disk", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)  # noqa: S603
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["told"].endswith("No space left on device")
    ours = [line for line in found["lines"] if "its index could not" not in line]
    assert ours == [
        f"{found['told']}; nothing is recorded until the disk works again",
        f"recordings {tmp_path / 'rec'}: records are written again",
    ]
    counts, runs_seen = found["recorder_counts"], found["runs"]
    assert counts["waiting"] == 0
    assert sum(found["gaps"]) == counts["lost"] > 600
    assert found["counts"] == counts["written"] + len(found["gaps"])
    missing = set(range(runs_seen[0], runs_seen[-1] + 1)) - set(runs_seen)
    assert runs_seen == sorted(set(runs_seen))
    assert len(missing) > 600  # all of them in one piece
    assert max(missing) - min(missing) + 1 == len(missing)


# ---------------------------------------------------------------------- life


async def test_second_recorder_of_a_folder_is_refused(tmp_path: Path) -> None:
    async with NumberedCamera() as box, recording(tmp_path, box.url):
        with pytest.raises(ConfigurationError, match="another recorder writes in it"):
            async with FleetRecorder(server(tmp_path, box.url), section()):
                pass
    async with FleetRecorder(server(tmp_path, box.url), section()):
        pass


async def test_recorder_wants_to_be_first_and_a_section(tmp_path: Path) -> None:
    async with NumberedCamera() as box:
        agent = server(tmp_path, box.url)
        with pytest.raises(ConfigurationError, match="record: is not in its file"):
            FleetRecorder(agent)
        async with agent:
            with pytest.raises(ConfigurationError, match="start the recorder before the server"):
                await FleetRecorder(agent, section()).start()


async def test_recorder_that_is_cancelled_at_its_start_leaves_the_folder_free(
    tmp_path: Path,
) -> None:
    made = FleetRecorder(server(tmp_path, "bvs://127.0.0.1:1"), section())
    task = asyncio.create_task(made.start())
    await asyncio.sleep(0)
    task.cancel()
    await asyncio.wait({task})
    async with FleetRecorder(server(tmp_path, "bvs://127.0.0.1:1"), section()):
        pass


async def test_only_the_chosen_cameras_and_no_frames_if_so_said(tmp_path: Path) -> None:
    async with NumberedCamera() as one, NumberedCamera() as two:
        fields: dict[str, Any] = {"cameras": ("line1/cam2",), "messages": False}
        async with recording(tmp_path, one.url, two.url, **fields) as (recorder, agent):
            for host in agent.shared_cameras.values():
                for _ in range(3):
                    await host.client.trigger()
        assert [*recorder.counts] == ["line1/cam2"]
    found = load_recording(tmp_path / "rec")
    assert (found.counts.frames, found.counts.results) == (0, 3)
    plan = plan_replay(found)
    assert [take.containers[0][:4] for take in plan.applications[1].triggered] == [
        number.to_bytes(4, "little") for number in (1, 2, 3)
    ]


async def test_errors_of_programs_triggers_are_recorded(tmp_path: Path) -> None:
    async with NumberedCamera() as box, recording(tmp_path, box.url) as (_, agent):
        host = agent.shared_cameras[NAME]
        await host.client.stop()
        request = trigger_request()
        with pytest.raises(NotRunningError):
            await host.client.trigger_for(request, None, 1.0)
    errors = [one.error for one in load_recording(tmp_path / "rec").errors()]
    assert errors == ["NotRunningError"]
