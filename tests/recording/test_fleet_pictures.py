"""Pictures recorded by an agent: those of results, bounds, and losses."""

from __future__ import annotations

import asyncio
import json
import math
import os
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam.backoff import Backoff
from smartcam.exceptions import ConfigurationError, FrameSourceError
from smartcam.fleet import load_fleet
from smartcam.recording import FleetReplay, Recorder, load_recording
from tests.fleet.fleetkit import NumberedCamera
from tests.fleet.framekit import give_source
from tests.frames.drivers import ScriptedDriver, frame
from tests.recording.folderkit import (
    MAX_WAITING_BYTES,
    NAME,
    ApplicationRuns,
    PictureMatcher,
    RecordedPicture,
    RecordedRun,
    ReplayedPictures,
    files,
    folder_files,
    folder_pictures,
    folder_writer,
    recording,
    until,
)
from tests.recording.picturekit import result, shot
from tests.recording.recordingkit import at

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from smartcam.frames import Frame

pytestmark = pytest.mark.real_time


class Device(ScriptedDriver):
    """A device that gives a frame whenever it streams, and remembers it.

    Attributes:
        given: frames that it gave.
        left: frames that it still gives.
    """

    def __init__(self) -> None:
        super().__init__()
        self.given: list[Frame] = []
        self.left = 10**9

    async def show(self, every: float = 0.005) -> None:
        """Give frames until it is cancelled."""
        while True:
            await asyncio.sleep(every)
            if self.sink is not None and self.left:
                self.left -= 1
                self.given.append(frame(len(self.given) + 1))
                self.give(self.given[-1])


@pytest.fixture
async def device(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Device]:
    """The device behind ``frames:``; the recorder's thread is quick."""
    monkeypatch.setattr(folder_writer, "INTERVAL", 0.01)
    monkeypatch.setattr(folder_pictures, "RETRY", Backoff(initial=0.01, maximum=0.05))
    made = Device()
    give_source(monkeypatch, made)
    showing = asyncio.create_task(made.show())
    yield made
    showing.cancel()
    await asyncio.wait([showing])


async def test_each_result_has_the_first_picture_of_its_trigger(
    tmp_path: Path, device: Device
) -> None:
    async with NumberedCamera(time=0.02) as box:
        options: dict[str, Any] = {"source": "synthetic://", "pictures": "judged"}
        async with recording(tmp_path, box.url, **options) as (recorder, agent):
            camera = agent.shared_cameras[NAME].client
            await until(lambda: device.given)
            for _ in range(8):
                await camera.trigger()
            await until(lambda: device.given[-1].utc > device.given[0].utc + 0.1)
        assert recorder.counts[NAME].lost == 0
    found = load_recording(tmp_path / "rec")
    judged = [*found.results_with_pictures(NAME)]
    assert len(judged) == 8
    for made, picture, told in judged:
        assert made.triggered_at is not None
        begin, end = made.triggered_at.timestamp(), made.received_at.timestamp()
        first = next((one for one in device.given if begin <= one.utc <= end), None)
        got = None if picture is None else (picture.sequence, bytes(picture.data))
        assert got == (None if first is None else (first.sequence, bytes(first.data)))
        assert not told
    pictures = sum(one.picture is not None for one in judged)
    assert 0 < pictures == found.counts.pictures < len(device.given)
    assert device.calls[-1] == "close"


async def test_all_pictures_are_in_files_that_follow_each_other_within_their_bound(
    tmp_path: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folder_files, "ITEMS_PER_CHECK", 1)
    async with NumberedCamera() as box:
        options: dict[str, Any] = {
            "pictures": "all",
            "size": 20_000.0,
            "keep": 60_000.0,
        }
        camera = recording(tmp_path, box.url, source="synthetic://", **options)
        async with camera as (recorder, agent):
            await until(lambda: files(tmp_path) and device.given)
            first = files(tmp_path)[0]
            device.left = 0
            while first.exists() or len(files(tmp_path)) < 2:
                device.left = 1
                await agent.shared_cameras[NAME].client.trigger()
                await until(lambda: not device.left and not recorder.counts[NAME].waiting)
        assert recorder.counts[NAME].lost == 0
    found = load_recording(tmp_path / "rec")
    numbers = [one.frame.sequence for one in found.items(NAME) if isinstance(one, RecordedPicture)]
    assert sum(path.stat().st_size for path in files(tmp_path)) <= 60_000 + 2 * 20_000
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert found.counts.results > 0
    assert [*found.errors()] == []


async def test_source_that_is_gone_is_told_once_and_used_again(
    tmp_path: Path, device: Device
) -> None:
    device.fails["open"] = FrameSourceError("the cable is out")
    async with NumberedCamera() as box:
        options: dict[str, Any] = {"source": "synthetic://", "pictures": "all"}
        async with recording(tmp_path, box.url, **options) as (recorder, _):
            await until(lambda: device.calls.count("open") >= 3)
            device.fails.clear()
            await until(lambda: device.given)
            before = recorder.counts[NAME].written
            await until(lambda: recorder.counts[NAME].written > before + 3)
    found = load_recording(tmp_path / "rec")
    errors = [one.text for one in found.errors()]
    assert [one for one in errors if "the cable is out" in one] == [
        "its pictures are not recorded: the cable is out"
    ]
    assert found.counts.pictures > 3


async def test_pictures_leave_room_for_results(
    tmp_path: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck, go_on = threading.Event(), threading.Event()
    real = os.fsync

    def waits(descriptor: int) -> None:
        stuck.set()
        go_on.wait(60)
        real(descriptor)

    size = folder_pictures.MAX_BYTES_WITH_PICTURES - (1 << 20)
    large = {"data": bytes(size), "width": 4096, "height": size // 4096, "stride": 4096}
    async with NumberedCamera() as box:
        options: dict[str, Any] = {"source": "synthetic://", "pictures": "all"}
        async with recording(tmp_path, box.url, **options) as (recorder, agent):
            await until(lambda: device.given)
            device.left = 0
            monkeypatch.setattr(os, "fsync", waits)
            first = await agent.shared_cameras[NAME].client.trigger()
            await until(stuck.is_set)
            device.give(*(frame(number, **large) for number in (9001, 9002, 9003)))
            second = await agent.shared_cameras[NAME].client.trigger()
            assert recorder.counts[NAME].lost == 1
            go_on.set()
            await until(lambda: device.sink is not None and not recorder.counts[NAME].waiting)
    assert folder_pictures.MAX_BYTES_WITH_PICTURES < MAX_WAITING_BYTES
    found = load_recording(tmp_path / "rec")
    kept = [one.frame.sequence for one in found.items(NAME) if isinstance(one, RecordedPicture)]
    assert [one for one in kept if one > 9000] == [9001, 9003]
    assert [one.number for one in found.results(NAME)] == [first.number, second.number]


def test_file_without_frames_has_no_pictures_to_record(tmp_path: Path) -> None:
    cameras: dict[str, Any] = {"a": {"emulated": {}}, "b/**": {"emulated": {"count": 2}}}
    told = {"record": {"pictures": "judged", "cameras": ["b/cam1"]}, "cameras": cameras}
    path = tmp_path / "plant.yaml"
    path.write_text(json.dumps(told))
    with pytest.raises(ConfigurationError, match=r"record\.pictures.*there is none"):
        load_fleet(path)
    cameras["b/**"]["frames"] = "synthetic://"
    path.write_text(json.dumps(told))
    found = load_fleet(path)
    assert found.record is not None
    assert found.record.pictures == "judged"


def _matched(*pictures: RecordedPicture, max_bytes: int = 1 << 20) -> list[int | None]:
    """Return the pictures of a result that was triggered at 1.05 s and came at 1.55 s."""
    matcher = PictureMatcher(max_bytes)
    for picture in pictures:
        matcher.add_picture(picture)
    matcher.results.append(result(1, 1.55, 1.05))
    return [
        None if one.picture is None else one.picture.sequence
        for one in matcher.take_matched(at_end=True)
    ]


def _picture(number: int, *, left_out: int = 0, **other: Any) -> RecordedPicture:
    return RecordedPicture("left", at(number / 10), shot(number, **other), left_out)


def test_picture_that_may_be_another_one_is_none() -> None:
    pictures = [_picture(number) for number in range(9, 16)]
    assert _matched(*pictures) == [11]
    assert _matched(*pictures[3:]) == [12]  # the camera gave none before
    size = len(pictures[0].frame.data)
    assert _matched(*pictures, max_bytes=5 * size) == [11]
    assert _matched(*pictures, max_bytes=4 * size) == [None]  # 11 is kept no longer
    assert _matched(*pictures[:2], *pictures[3:4], *pictures[5:]) == [12]
    assert _matched(*pictures[:2], _picture(12, lost=1), *pictures[4:]) == [None]
    assert _matched(*pictures[:2], _picture(12, left_out=1), *pictures[4:]) == [None]
    assert _matched(*pictures[:3], _picture(13, lost=1)) == [11]


async def test_replayed_fleet_shows_the_picture_of_each_result(
    tmp_path: Path, device: Device
) -> None:
    async with NumberedCamera(time=0.02) as box:
        options: dict[str, Any] = {"source": "synthetic://", "pictures": "judged"}
        async with recording(tmp_path, box.url, **options) as (_, agent):
            await until(lambda: device.given)
            for _ in range(6):
                await agent.shared_cameras[NAME].client.trigger()
            last = device.given[-1]
            await until(lambda: device.given[-1].utc > last.utc)
    found = load_recording(tmp_path / "rec")
    judged = [*found.results_with_pictures(NAME)]
    assert any(one.picture is not None for one in judged)
    shown = 0
    async with FleetReplay(found) as played, smartcam.connect(played.server.urls[NAME]) as camera:
        for made, picture, _ in judged:
            result = await camera.trigger()
            assert result.raw == made.raw
            if picture is not None:
                shown += 1
                frame = await camera.newest_frame(max_age=math.inf)
                assert (frame.sequence, bytes(frame.data)) == (picture.sequence, picture.data)
                assert frame.captured <= time.monotonic()
    assert shown == found.counts.pictures


def _lists(*takes: tuple[bool, bytes]) -> dict[int, ApplicationRuns]:
    made = ApplicationRuns(5)
    for triggered, data in takes:
        (made.triggered if triggered else made.untriggered).append(RecordedRun([data], 0.1))
    return {5: made}


def test_results_that_are_alike_have_pictures_only_in_one_order(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        for number, raw in enumerate((b"a", b"b", b"a", b"c"), 1):
            made = result(number, number)._replace(raw=raw)
            recorder.on_result(made)
            recorder.add_picture(shot(number), result=made)
    found = load_recording(path)

    def shown(applications: dict[int, ApplicationRuns], *given: bytes) -> list[int | None]:
        pictures = ReplayedPictures(found, "left", applications, 1.0)
        numbers: list[int | None] = []
        for data in given:
            pictures.show_picture_of(5, data)
            picture = pictures.current_picture
            numbers.append(None if picture is None else picture.sequence)
        return numbers

    one = [(True, b"a"), (True, b"b"), (True, b"a")]
    assert shown(_lists(*one), b"a", b"b", b"a", b"a", b"c") == [1, 2, 3, 1, None]
    assert shown(_lists((True, b"a"), (False, b"a"), (False, b"b")), b"a", b"b") == [None, 2]
    assert shown(_lists(*one, (True, b"a")), b"a", b"b") == [None, 2]  # one of them has no result
