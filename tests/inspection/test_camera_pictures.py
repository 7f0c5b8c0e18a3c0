"""Pictures with their results: in the process, in recordings and in replays."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import smartcam
from smartcam.backoff import Backoff
from smartcam.exceptions import UnsupportedError
from smartcam.inspection import SoftwareCamera
from smartcam.observers import Observer
from smartcam.recording import Recorder, load_recording, replay
from tests.handmade import PATIENCE, until
from tests.inspection.seeing import Desk, cell_of

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.frames import Frame
    from smartcam.models import Result

pytestmark = pytest.mark.real_time

LIMITS: dict[str, Any] = {
    "connect_timeout": PATIENCE,
    "switch_timeout": PATIENCE,
    "request_timeout": PATIENCE,
}


class Pictures(Observer):
    """Record pictures and results in their order."""

    def __init__(self) -> None:
        self.pictures: dict[int, Frame] = {}
        self.results: list[Result] = []

    def on_picture(self, result: Result, frame: Frame) -> None:
        assert result not in self.results, "the picture comes first"
        self.pictures[result.number] = frame

    def on_result(self, result: Result) -> None:
        self.results.append(result)


def opened(path: Path, *observers: Observer, **options: Any) -> SoftwareCamera[Any]:
    given = {**LIMITS, **options}
    camera = smartcam.connect(f"software:{path}", observers=[*observers], **given)
    assert isinstance(camera, SoftwareCamera)
    return camera


@pytest.fixture
def desk(request: pytest.FixtureRequest) -> Desk:
    return Desk(f"p{abs(hash(request.node.nodeid)):x}")


async def test_each_of_equal_results_has_its_own_picture_in_a_recording(
    tmp_path: Path, desk: Desk
) -> None:
    file, judged = tmp_path / "run.mcap", []
    with Recorder(file) as recorder:
        async with opened(cell_of(tmp_path, desk), recorder) as camera:
            for level in (10, 10, 10, 220, 10):
                desk.level = level
                await camera.trigger(timeout=PATIENCE)
                assert camera.last_picture is not None
                judged.append(camera.last_picture.frame)
    assert (recorder.counts.results, recorder.counts.pictures) == (5, 5)
    found = [*load_recording(file).results_with_pictures()]
    assert [one.result.value["level"] for one in found] == [10, 10, 10, 220, 10]
    assert all(one.linked for one in found)
    for one, frame in zip(found, judged, strict=True):
        assert one.picture is not None
        assert abs(one.picture.utc - frame.utc) < 1e-5
        assert np.array_equal(one.picture.array(), frame.array())


async def test_replay_gives_results_from_recorded_pictures(tmp_path: Path, desk: Desk) -> None:
    file = tmp_path / "run.mcap"
    with Recorder(file) as recorder:
        async with opened(cell_of(tmp_path, desk), recorder) as camera:
            for level in (30, 210):
                desk.level = level
                await camera.trigger(timeout=PATIENCE)
    recording = load_recording(file)
    pictures = {one.result.raw: one.picture for one in recording.results_with_pictures()}
    async with replay(recording) as emulator:
        layout = "ok: bool, reason: string[80], level: int32, input: string[8], angle: real32 deg"
        async with smartcam.connect(emulator.url, interpret_as=layout, **LIMITS) as camera:
            for level in (30, 210):
                result = await camera.trigger(timeout=PATIENCE)
                assert result.value.level == level
                picture = pictures[result.raw]
                assert picture is not None
                assert (picture.array() == level).all()


async def test_a_recorder_that_shall_have_no_pictures_has_none(tmp_path: Path, desk: Desk) -> None:
    with Recorder(tmp_path / "run.mcap", pictures=False) as recorder:
        async with opened(cell_of(tmp_path, desk), recorder) as camera:
            await camera.trigger(timeout=PATIENCE)
    assert (recorder.counts.results, recorder.counts.pictures) == (1, 0)


async def test_results_of_a_free_run_keep_their_pictures_after_earlier_sessions(
    tmp_path: Path, desk: Desk
) -> None:
    path = cell_of(tmp_path, desk)
    path.write_text(path.read_text().replace("free, rate: 50", "free, rate: 50, sequence: true"))
    seen = Pictures()

    async def listen(camera: SoftwareCamera[Any]) -> None:
        done = len(seen.results)
        results = camera.results()
        await until(lambda: len(seen.results) >= done + 3)
        results.close()
        for result in seen.results[-3:]:
            judged = camera._pairs.find_picture(result)
            assert judged is not None
            assert judged.number == result.sequence

    async with opened(path, seen, reconnect=Backoff(initial=0.05)) as camera:
        await camera.switch_application(30)
        await camera.start()
        await until(lambda: camera.statistics().received >= 3)  # nobody listens
        await listen(camera)
        emulator: Any = camera._device.emulator
        before = emulator.device.sessions
        emulator._session_link.close("the cable is cut")
        await until(lambda: emulator.device.sessions > before)
        await listen(camera)
    assert len(seen.results) >= 6
    assert {one.number for one in seen.results} == set(seen.pictures)


async def test_pictures_of_old_results_and_of_others_are_not_there(
    tmp_path: Path, desk: Desk
) -> None:
    async with opened(cell_of(tmp_path, desk)) as camera:
        first = await camera.trigger(timeout=PATIENCE)
        desk.level = 50
        for _ in range(3):
            last = await camera.trigger(timeout=PATIENCE)
        data, other = await asyncio.gather(
            camera.read_judged_image(first), camera.read_judged_image(last, drawn=True)
        )
        assert data != other
        for _ in range(8):
            await camera.trigger(timeout=PATIENCE)
        with pytest.raises(UnsupportedError, match="expected one of the last 8 results"):
            await camera.read_judged_image(first)
