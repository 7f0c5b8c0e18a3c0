"""Pictures in recordings, read by other programs, and replayed as a source."""

from __future__ import annotations

import asyncio
import dataclasses
import itertools
import json
import math
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

import smartcam
import smartcam.frames
from smartcam.emulator import EmulatedInSight
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
    RecordingError,
)
from smartcam.frames import (
    Frame,
    FrameAddress,
    FrameSink,
    FrameSource,
    StreamFormat,
)
from smartcam.frames._inside import read_bitmap
from smartcam.models import Result
from smartcam.recording import (
    Recorder,
    RotatingRecorder,
    load_recording,
    replay,
)
from smartcam.recording._inside import ResultPictures
from tests.frames.drivers import ShowingDriver
from tests.recording.picturekit import BEGIN, VARIED, result, same, shot
from tests.recording.recordingkit import at, session, write

has_full_disk = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")


async def until(true: Callable[[], object]) -> None:
    """Wait until something is true, 60 s at most."""
    async with asyncio.timeout(60):
        while not true():  # noqa: ASYNC110 - another thread makes it so
            await asyncio.sleep(0.005)


def recorded(path: Path, *pictures: Frame) -> Path:
    with Recorder(path) as recorder:
        for picture in pictures:
            assert recorder.add_picture(picture)
    return path


# ---------------------------------------------------------------------- the file


def test_pictures_are_read_as_they_were_recorded(tmp_path: Path) -> None:
    forms = ("Mono8", "BayerRG12Packed", "NV12", "MJPEG", "H264")
    written = [
        shot(number, form, **other)
        for number, (form, other) in enumerate((form, other) for form in forms for other in VARIED)
    ]
    recording = load_recording(recorded(tmp_path / "run.mcap", *written))
    assert (recording.counts.pictures, recording.remark) == (len(written), "")
    found = [*recording.pictures("left")]
    assert len(found) == len(written)
    assert all(map(same, written, found))


def test_picture_is_foxgloves_to_its_own_schemas(tmp_path: Path) -> None:
    raw_image, compressed_image = (
        pytest.importorskip(f"foxglove_schemas_protobuf.{name}_pb2", reason="needs the extra dev")
        for name in ("RawImage", "CompressedImage")
    )

    raw, packed = shot(1, "BayerRG8"), shot(2, "MJPEG")
    path = recorded(tmp_path / "run.mcap", raw, packed)
    with path.open("rb") as stream:
        found = [*make_reader(stream, validate_crcs=True).iter_messages()]
    schemas = [schema.name for schema, _, _ in found if schema is not None]
    assert schemas == ["foxglove.RawImage", "foxglove.CompressedImage"]
    assert {channel.topic for _, channel, _ in found} == {"/left/pictures"}
    first = raw_image.RawImage.FromString(found[0][2].data)
    assert (first.width, first.height, first.step) == (64, 32, 64)
    assert (first.encoding, first.frame_id, first.data) == ("bayer_rggb8", "left", raw.data)
    stamp = first.timestamp.seconds * 10**9 + first.timestamp.nanos
    assert abs(stamp - raw.utc * 1e9) < 1000
    assert abs(found[0][2].log_time - raw.utc * 1e9) < 1000
    second = compressed_image.CompressedImage.FromString(found[1][2].data)
    assert (second.format, second.data) == ("jpeg", packed.data)


@pytest.mark.parametrize("form", ["Mono8", "MJPEG", "H264"])
def test_picture_is_read_by_the_schema_in_its_file(form: str, tmp_path: Path) -> None:
    decoder = pytest.importorskip("mcap_protobuf.decoder", reason="needs the extra dev")
    picture = shot(5, form, device_time=3.25, lost=2)
    path = recorded(tmp_path / "run.mcap", picture)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[decoder.DecoderFactory()])
        ((_, _, _, message),) = reader.iter_decoded_messages()
    said = (message.pixel_format, message.captured, message.sequence, message.lost)
    assert said == (form, picture.captured, 5, 2)
    assert (message.device_time, message.moment) == (3.25, "EXPOSURE_START")
    assert message.data == picture.data


def test_last_row_without_padding_is_padded_for_viewers(tmp_path: Path) -> None:
    picture = shot(1, stride=80)
    picture = dataclasses.replace(picture, data=bytes(80 * 31 + 64))
    (found,) = load_recording(recorded(tmp_path / "run.mcap", picture)).pictures()
    assert len(found.data) == 80 * 32
    assert np.array_equal(found.array(), picture.array())


def test_pictures_are_not_packed_and_results_are(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.add_picture(shot(1))
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert [one.compression for one in summary.chunk_indexes] == [""]
    other = write(tmp_path / "other.mcap", session())
    with other.path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert [one.compression for one in summary.chunk_indexes] == ["zstd"]


def test_recording_cut_off_anywhere_has_the_whole_pictures_before(tmp_path: Path) -> None:
    whole = recorded(tmp_path / "run.mcap", *(shot(number) for number in range(600)))
    data = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    for size in range(len(data) // 8, len(data), len(data) // 8):
        cut.write_bytes(data[:size])
        recording = load_recording(cut)
        found = [*recording.pictures()]
        assert all(same(shot(one.sequence), one) for one in found)
        assert [one.sequence for one in found] == [*range(len(found))]
        assert "cut off" in recording.remark
        assert len(found) >= 600 * size // len(data) - 560  # a chunk of 1 MiB is lost at most


# ---------------------------------------------------------------------- the recorder


def test_slow_disk_costs_counted_pictures_and_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = threading.Event()
    fsync = os.fsync

    def held(file: int) -> None:
        gate.wait(60)
        fsync(file)

    monkeypatch.setattr("smartcam.recording._recorder.MAX_WAITING_PICTURE_BYTES", 10_000)
    path = tmp_path / "run.mcap"
    made = Recorder(path).open()
    monkeypatch.setattr("os.fsync", held)
    kept = [made.add_picture(shot(number)) for number in range(50)]
    result = Result("left", 5, None, 1, None, at(1), None, b"\0", b"\0")
    made.on_result(result)
    gate.set()
    while made.counts.results and not made.add_picture(shot(50)):
        time.sleep(0.01)
    made.close()
    recording = load_recording(path)
    assert made.error is None
    assert recording.counts.results == 1
    assert 0 < sum(kept) < 50
    # the last one may have been refused several times before the disk took it
    assert recording.counts == made.counts
    assert recording.counts.left_out >= 50 - sum(kept)
    found = [*recording.pictures()]
    assert [one.sequence for one in found[:-1]] == [n for n, one in enumerate(kept) if one]
    assert found[-1].lost >= 50 - found[-2].sequence - 1


def test_picture_larger_than_the_room_is_kept_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.recording._recorder.MAX_WAITING_PICTURE_BYTES", 100)
    (found,) = load_recording(recorded(tmp_path / "run.mcap", shot(1))).pictures()
    assert same(shot(1), found)


def test_picture_beyond_the_bound_is_left_out_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.recording._recorder.MAX_PICTURE_SIZE_BYTES", 3000)
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        assert recorder.add_picture(shot(1))
        assert not recorder.add_picture(shot(2, width=128))
        assert recorder.add_picture(shot(3))
    found = load_recording(path)
    assert (found.counts.pictures, found.counts.left_out) == (2, 1)
    assert [one.lost for one in found.pictures()] == [0, 1]


WIDEST_PX = 1 << 20
UNREADABLE: dict[str, dict[str, Any]] = {
    "too wide": {"width": WIDEST_PX + 1, "height": 1},
    "too high": {"width": 1, "height": WIDEST_PX + 1},
    "of no width": {"form": "MJPEG", "width": 0},
    "too few bytes": {"data": b"few"},
    "rows of negative bytes": {"stride": -64},
    "no time": {"captured": math.nan},
    "no time of day": {"utc": math.nan},
    "a time before 1970": {"utc": -1.0},
    "a time beyond the file's": {"utc": 2e10},
    "an endless time of the device": {"device_time": math.inf},
    "a negative exposure": {"duration": -0.001},
    "an exposure of no time": {"duration": math.nan},
    "a number of 65 bits": {"sequence": 1 << 64},
    "fewer than none lost": {"lost": -1},
}
"""Pictures that nobody could read again."""


@pytest.mark.parametrize("case", UNREADABLE)
def test_picture_that_nobody_could_read_is_refused_and_the_file_stays_good(
    case: str, tmp_path: Path
) -> None:
    wrong = shot(2, **UNREADABLE[case])
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        assert recorder.add_picture(shot(1))
        with pytest.raises(FrameFormatError, match=r"left: a picture cannot be|needs|bytes"):
            recorder.add_picture(wrong)
        assert recorder.add_picture(shot(3))
    found = load_recording(path)
    assert found.remark == ""
    assert [one.sequence for one in found.pictures()] == [1, 3]

    with RotatingRecorder(tmp_path / "folder") as folder:
        for picture in (shot(1), wrong, shot(3)):
            folder.add_picture(picture)
    counts = folder.counts["left"]
    assert (counts.written, counts.waiting, counts.lost) == (2, 0, 1)
    again = load_recording(tmp_path / "folder")
    assert again.remark == ""
    assert [one.sequence for one in again.pictures()] == [1, 3]
    assert [one.error for one in again.errors()] == ["RecordingGap"]


def test_widest_picture_that_is_taken_is_read_again(tmp_path: Path) -> None:
    written = [shot(1), shot(2, width=WIDEST_PX, height=1), shot(3, width=1, height=WIDEST_PX)]
    recording = load_recording(recorded(tmp_path / "run.mcap", *written))
    assert recording.remark == ""
    assert all(map(same, written, recording.pictures()))


async def test_source_of_pictures_too_wide_ends_its_recording_with_the_reason(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.mcap"
    frames = [shot(1), shot(2, width=WIDEST_PX + 1, height=1), shot(3)]
    with Recorder(path) as recorder:
        async with FrameSource(_Burst(frames), stall=None) as source:
            with pytest.raises(FrameFormatError, match=r"1048577x1, expected 1 to 1048576 pixels"):
                await recorder.record(source)
    found = load_recording(path)
    assert (found.counts.pictures, found.remark) == (1, "")


@has_full_disk
def test_full_disk_ends_the_recording_with_its_text() -> None:
    made = Recorder("/dev/full", overwrite=True).open()
    made.add_picture(shot(1))
    with pytest.raises(RecordingError, match="No space left on device"):
        made.close()
    assert not made.add_picture(shot(2))


class _Burst(ShowingDriver):
    """Gives all frames at once, as a driver does that was held up."""

    def __init__(self, frames: list[Frame]) -> None:
        super().__init__(FrameAddress.parse("synthetic://"))
        self.frames = frames

    async def open(self) -> StreamFormat:
        return StreamFormat(self.frames[0].format, 64, 32)

    async def show(self, sink: FrameSink) -> None:
        for frame in self.frames:
            sink.frame(frame)


async def test_every_frame_of_a_burst_is_recorded(tmp_path: Path) -> None:
    frames = [shot(number) for number in range(20)]
    driver = _Burst(frames)
    with Recorder(tmp_path / "run.mcap") as recorder:
        async with FrameSource(driver) as source:
            counts = await recorder.record(source, count=20)
    assert (counts.offered, counts.skipped) == (20, 0)
    found = [*load_recording(tmp_path / "run.mcap").pictures()]
    assert [one.sequence for one in found] == [one.sequence for one in frames]


@pytest.mark.parametrize(
    "odd",
    [{"count": 0}, {"count": 1.5}, {"camera": 7}, {"on_start": 3}, {"source": "synthetic://"}],
)
async def test_odd_arguments_of_a_recording_are_refused(
    odd: dict[str, Any], tmp_path: Path
) -> None:
    async with smartcam.frames.open("synthetic://") as source:
        for recorder in (Recorder(tmp_path / "run.mcap"), RotatingRecorder(tmp_path / "rec")):
            with pytest.raises(ConfigurationError):
                await recorder.record(**{"source": source, **odd})


async def test_end_of_a_source_ends_its_recording(tmp_path: Path) -> None:
    path = recorded(tmp_path / "one.mcap", *(shot(number) for number in range(30)))
    again = tmp_path / "two.mcap"
    with Recorder(again) as recorder:
        async with smartcam.frames.open(f"{path}#pace=none") as source:
            counts = await recorder.record(source, camera="left")
    assert counts.delivered == 30
    written = [*load_recording(path).pictures()]
    found = [*load_recording(again).pictures()]
    assert [one.sequence for one in found] == [one.sequence for one in written]
    assert [one.utc for one in found] == [one.utc for one in written]


async def test_source_that_can_wait_waits_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recorded(tmp_path / "one.mcap", *(shot(number) for number in range(50)))
    monkeypatch.setattr("smartcam.recording._recorder.INTERVAL", 0.001)
    monkeypatch.setattr("smartcam.recording._recorder.MAX_WAITING_PICTURE_BYTES", 20_000)
    with Recorder(tmp_path / "two.mcap") as recorder:
        async with smartcam.frames.open(f"{path}#pace=none") as source:
            counts = await recorder.record(source)
    assert (counts.delivered, recorder.counts.left_out) == (50, 0)


@pytest.mark.long
def test_full_disk_costs_counted_pictures_until_there_is_room(tmp_path: Path) -> None:
    unshare = shutil.which("unshare")
    if unshare is None or subprocess.run([unshare, "-rm", "true"], check=False).returncode:  # noqa: S603
        pytest.skip("needs mount namespaces: unshare -rm is not allowed here")
    module = "tests.recording.full_disk_pictures"
    command = [unshare, "-rm", sys.executable, "-m", module, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)  # noqa: S603
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["told"][0].endswith("No space left on device")
    assert found["told"][1] == "None"
    counts, seen = found["counts"], found["seen"]
    assert (counts["written"], counts["waiting"]) == (len(seen), 0)
    assert sum(lost for _, lost in seen) >= counts["lost"] > 20
    # each number is there, or counted before the next one that is
    for (before, _), (number, lost) in itertools.pairwise(seen):
        assert number == before + lost + 1


@has_full_disk
async def test_recording_that_fails_ends_what_records() -> None:
    made = Recorder("/dev/full", overwrite=True).open()
    async with smartcam.frames.open("synthetic://?fps=100") as source:
        with pytest.raises(RecordingError, match="No space left"):
            await made.record(source)
    with pytest.raises(RecordingError):
        made.close()


async def test_cancelled_recording_keeps_what_came_and_leaves_the_source(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        async with smartcam.frames.open("synthetic://?fps=100") as source:
            running = asyncio.create_task(recorder.record(source))
            await until(lambda: recorder.counts.pictures >= 3)
            running.cancel()
            await asyncio.wait([running])
            assert running.cancelled()
            assert (await source.newest()).width == 640
    assert load_recording(tmp_path / "run.mcap").counts.pictures == recorder.counts.pictures


# ---------------------------------------------------------------------- as a source


async def played(url: str, **options: Any) -> list[Frame]:
    async with smartcam.frames.open(url, **options) as source:
        return [frame async for frame in source]


async def test_recording_is_played_with_its_times_numbers_and_gaps(tmp_path: Path) -> None:
    gaps = [0.0, 0.05, 0.07, 0.30, 0.31]
    written = [
        shot(3 * n, captured=50 + gap, utc=BEGIN + gap, lost=2, device_time=gap, duration=0.01)
        for n, gap in enumerate(gaps)
    ]
    found = await played(str(recorded(tmp_path / "run.mcap", *written)))
    assert [bytes(one.data) for one in found] == [one.data for one in written]
    for name in ("sequence", "lost", "utc", "device_time", "moment", "duration", "format"):
        assert [getattr(one, name) for one in found] == [getattr(one, name) for one in written]
    again = [one.captured - found[0].captured for one in found]
    # a busy machine makes a picture late, and the later ones then keep their distance
    assert all(later >= gap - 1e-6 for later, gap in zip(again, gaps, strict=True))
    assert all(one.captured <= time.monotonic() for one in found)


async def test_clock_that_begins_anew_is_bridged_by_utc(tmp_path: Path) -> None:
    written = [shot(1, captured=9e5), shot(2, captured=3.0, utc=BEGIN + 0.15)]
    began = time.monotonic()
    found = await played(str(recorded(tmp_path / "run.mcap", *written)))
    assert len(found) == 2
    assert found[1].captured - found[0].captured > 0.04
    assert time.monotonic() - began < 60


async def test_speed_and_name_are_parameters(tmp_path: Path) -> None:
    written = [shot(n, captured=10.0 * n, utc=BEGIN + 10 * n) for n in range(3)]
    path = recorded(tmp_path / "run.mcap", *written)
    found = await played(f"{path}#speed=500&name=again")
    assert [one.source for one in found] == ["again"] * 3


async def test_folder_of_recordings_is_one_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.recording._folders.writer.INTERVAL", 0.001)
    folder = RotatingRecorder(tmp_path / "rec", size=1e5, keep=1e9)
    written = [shot(n, width=256, height=256, utc=BEGIN + n / 10) for n in range(20)]
    with folder:
        for picture in written:
            assert folder.add_picture(picture)
            await until(lambda: not folder.counts["left"].waiting)
    files = sorted((tmp_path / "rec").glob("left_*.mcap"))
    assert len(files) > 3
    found = await played(f"{tmp_path / 'rec'}#pace=none")
    assert [one.sequence for one in found] == [one.sequence for one in written]
    assert load_recording(tmp_path / "rec").counts.pictures == 20


async def test_folder_keeps_no_more_than_it_may(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.recording._folders.writer.INTERVAL", 0.001)
    with RotatingRecorder(tmp_path / "rec", size=1e5, keep=3e5) as folder:
        for n in range(40):
            folder.add_picture(shot(n, width=256, height=256))
            await until(lambda: not folder.counts["left"].waiting)
    left = [*(tmp_path / "rec").glob("left_*.mcap")]
    assert sum(one.stat().st_size for one in left) < 3e5 + 2e5
    found = await played(f"{tmp_path / 'rec'}#pace=none")
    assert found[-1].sequence == 39


async def test_pictures_of_several_cameras_have_to_be_chosen_from(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.add_picture(shot(1), camera="a")
        recorder.add_picture(shot(2), camera="b")
    with pytest.raises(FrameFormatError, match=r"pictures of a, b: choose .*#camera=a") as told:
        await played(str(path))
    assert told.value.available == ("a", "b")
    assert [one.sequence for one in await played(f"{path}#camera=b")] == [2]
    with pytest.raises(FrameFormatError, match=r"no picture of camera .c.; it has .* of a, b"):
        await played(f"{path}#camera=c")


async def test_what_is_no_recording_is_told(tmp_path: Path) -> None:
    with pytest.raises(FrameSourceError, match=r"gone\.mcap: No such file"):
        await played(str(tmp_path / "gone.mcap"))
    (tmp_path / "text.mcap").write_text("hello, this is a text")
    with pytest.raises(FrameSourceError, match="no MCAP file"):
        await played(str(tmp_path / "text.mcap"))
    write(tmp_path / "run.mcap", session())
    with pytest.raises(FrameFormatError, match="it has no picture"):
        await played(str(tmp_path / "run.mcap"))
    with pytest.raises(ConfigurationError, match=r"unknown parameter 'sped'.*speed"):
        smartcam.frames.open(f"{tmp_path / 'run.mcap'}#sped=2")


async def test_size_that_changes_is_played_as_it_changes(tmp_path: Path) -> None:
    written = [shot(1), shot(2, width=32), shot(3, "RGB8")]
    found = await played(f"{recorded(tmp_path / 'run.mcap', *written)}#pace=none")
    assert [(one.width, one.format.name) for one in found] == [
        (64, "Mono8"),
        (32, "Mono8"),
        (64, "RGB8"),
    ]


# ---------------------------------------------------------------------- beside results


class _Late(_Burst):
    """Gives its frames when it is told to, as an agent that begins to stream does."""

    def __init__(self, frames: list[Frame]) -> None:
        super().__init__(frames)
        self.go_on = asyncio.Event()

    async def show(self, sink: FrameSink) -> None:
        await self.go_on.wait()
        await super().show(sink)


async def test_trigger_waits_for_the_first_picture_of_those_that_results_are_made_of(
    tmp_path: Path,
) -> None:
    driver = _Late([shot(1)])
    with Recorder(tmp_path / "run.mcap") as recorder:
        found = ResultPictures(recorder)
        async with FrameSource(driver) as source:
            recording = asyncio.create_task(found.record(source, "left"))
            waiting = asyncio.create_task(found.wait_streaming())
            await asyncio.sleep(0.05)
            assert not waiting.done()
            driver.go_on.set()
            await waiting
            recording.cancel()
            await asyncio.wait({recording})


def test_result_has_the_picture_that_the_recorder_was_told(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        for number in (1, 2, 3):
            recorder.on_result(result(number, number))
            if number != 2:
                recorder.add_picture(shot(number), result=result(number, number))
    found = [*load_recording(path).results_with_pictures("left")]
    numbers = [
        (one.result.number, one.picture and one.picture.sequence, one.linked) for one in found
    ]
    assert numbers == [(1, 1, True), (2, None, False), (3, 3, True)]


def test_result_of_a_later_client_never_has_the_picture_of_an_earlier_ones(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        for number, seconds in ((1, 1.0), (2, 2.000001)):  # each client begins with result 1
            made = result(1, seconds)
            recorder.on_result(made)
            recorder.add_picture(shot(number, utc=BEGIN + seconds + 1.5), result=made)
    found = [*load_recording(path).results_with_pictures("left")]
    assert [one.picture and one.picture.sequence for one in found] == [1, 2]
    assert all(one.linked for one in found)


def test_triggered_result_has_the_first_picture_surely_exposed_after_the_trigger(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.mcap"
    early = shot(1, utc=BEGIN + 1.05, duration=0.1)  # it may have begun before
    with Recorder(path) as recorder:
        recorder.add_picture(early)
        recorder.add_picture(shot(2, utc=BEGIN + 1.15, duration=0.1))
        recorder.add_picture(shot(3, utc=BEGIN + 1.25, duration=0.1))
        recorder.on_result(result(1, 1.3, triggered=1.0))
        recorder.on_result(result(2, 2.3, triggered=2.0))
        recorder.add_picture(shot(4, utc=BEGIN + 2.2))  # it came here behind its result
        recorder.add_picture(shot(5, utc=BEGIN + 2.4))
        recorder.on_result(result(3, 3.3, triggered=3.0))
        recorder.add_picture(shot(6, utc=BEGIN + 3.4))
    found = [*load_recording(path).results_with_pictures()]
    numbers = [(one.result.number, one.picture and one.picture.sequence) for one in found]
    assert numbers == [(1, 2), (2, 4), (3, None)]
    assert not any(one.linked for one in found)


def test_result_that_nobody_triggered_has_no_picture_by_the_times(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.add_picture(shot(1, utc=BEGIN + 1))
        recorder.add_picture(shot(2, utc=BEGIN + 2), camera="right")
        recorder.on_result(result(1, 2.5))
    ((_, picture, _),) = load_recording(path).results_with_pictures()
    assert picture is None


@pytest.mark.filterwarnings("ignore")
async def test_replayed_camera_shows_the_picture_of_its_last_trigger(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    pictures = [shot(n) for n in range(3)]
    async with EmulatedInSight([{"file": "a.job", "cells": {"B2": 1.0}}], online=True) as emulator:
        with Recorder(path) as recorder:
            async with smartcam.connect(emulator.url, name="left", observers=[recorder]) as camera:
                for picture in pictures:
                    made = await camera.trigger()
                    recorder.add_picture(picture, result=made)
    async with replay(load_recording(path)) as again, smartcam.connect(again.url) as camera:
        for picture in pictures:
            await camera.trigger()
            assert np.array_equal(read_bitmap(await camera.read_image()), picture.array())


async def test_image_that_a_camera_gave_is_kept_with_its_result(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    levels = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
    async with EmulatedInSight(
        [{"file": "a.job", "cells": {"B2": 1.0}}], online=True, image=levels
    ) as emulator:
        with Recorder(path) as recorder:
            async with smartcam.connect(
                f"{emulator.url}?cells=B2", name="left", observers=[recorder]
            ) as camera:
                made = await camera.trigger()
                recorder.add_image("left", await camera.read_image(), result=made)
    ((kept, picture, told),) = load_recording(path).results_with_pictures()
    assert told
    assert kept.number == made.number
    assert picture is not None
    assert np.array_equal(picture.array(), levels)
    with Recorder(tmp_path / "two.mcap") as recorder, pytest.raises(FrameFormatError):
        recorder.add_image("left", b"no bitmap")


# ---------------------------------------------------------------------- as a video


def packets(path: Path) -> list[tuple[float, bytes]]:
    """Return the times and bytes of a video's packets, by FFmpeg."""
    av = pytest.importorskip("av", reason="needs the extra video")
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        return [
            (float(one.pts * one.time_base), bytes(one))
            for one in container.demux(stream)
            if one.pts is not None
        ]


def test_video_has_the_times_of_the_captures(tmp_path: Path) -> None:
    path = tmp_path / "run.mkv"
    gaps = [0.0, 0.04, 0.1, 0.1004, 2.5]
    with Recorder(path) as recorder:
        for n, gap in enumerate(gaps):
            recorder.add_picture(shot(n, captured=50 + gap, utc=BEGIN + gap))
    times = [one for one, _ in packets(path)]
    assert times == pytest.approx([0.0, 0.04, 0.1, 0.101, 2.5], abs=1e-9)
    av = pytest.importorskip("av", reason="needs the extra video")
    with av.open(str(path)) as container:
        assert container.metadata["creation_time"].startswith("2026-01-02T03:04:05")


@pytest.mark.parametrize(
    "form",
    [
        *("Mono8", "Mono10", "Mono12", "Mono16", "RGB8", "BGR8", "RGBa8", "YUV422_8", "I420"),
        *("I420_709_full", "NV12", "I444", "I422_10", "Mono12Packed", "RGB8_limited"),
    ],
)
async def test_video_is_read_without_loss(form: str, tmp_path: Path) -> None:
    pytest.importorskip("av", reason="needs the extra video")
    path = tmp_path / "run.mkv"
    picture = shot(3, form)
    if picture.format.depth in (10, 12) and "Packed" not in form:  # upper bits mean nothing
        values = np.frombuffer(picture.data, "<u2") & ((1 << picture.format.depth) - 1)
        picture = dataclasses.replace(picture, data=values.astype("<u2").tobytes())
    if form == "RGB8_limited":
        with Recorder(path) as recorder, pytest.raises(FrameFormatError, match="mcap"):
            recorder.add_picture(picture)
        return
    with Recorder(path) as recorder:
        assert recorder.add_picture(picture)
    (found,) = await played(f"{path}#pace=none")
    if picture.format.name in {"Mono10", "Mono12", "Mono16", "Mono12Packed"}:
        assert np.array_equal(found.array(), picture.array())
    else:
        assert np.array_equal(found.rgb(), picture.rgb())


async def test_video_of_jpegs_has_them_as_they_came(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="needs the extra video")
    path = tmp_path / "run.mkv"
    async with smartcam.frames.open("synthetic://?format=MJPEG&fps=50") as source:
        frames = [await anext(reader) for reader in [source.reader()] for _ in range(3)]
    with Recorder(path) as recorder:
        for frame in frames:
            recorder.add_picture(frame)
    assert [data for _, data in packets(path)] == [bytes(one.data) for one in frames]


@pytest.mark.parametrize("form", ["BayerRG8", "Coord3D_C16", "PNG", "H264"])
def test_format_that_a_video_cannot_hold_is_refused(form: str, tmp_path: Path) -> None:
    pytest.importorskip("av", reason="needs the extra video")
    refused = pytest.raises(FrameFormatError, match=rf"{form} cannot become a video.*\.mcap")
    with Recorder(tmp_path / "run.mkv") as recorder, refused:
        recorder.add_picture(shot(1, form))


def test_video_of_another_size_is_a_further_file(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="needs the extra video")
    path = tmp_path / "run.mkv"
    with Recorder(path) as recorder:
        for picture in (shot(1), shot(2), shot(3, width=32)):
            recorder.add_picture(picture)
    assert recorder.files == (path, tmp_path / "run-2.mkv")
    assert [len(packets(one)) for one in recorder.files] == [2, 1]
    with Recorder(tmp_path / "b.mkv") as other:
        other.add_picture(shot(1), camera="left")
        with pytest.raises(ConfigurationError, match="pictures of one camera, 'left'"):
            other.add_picture(shot(2), camera="right")
