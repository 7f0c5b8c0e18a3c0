"""Software cameras of a fleet, recorded by the agent: each result has its picture."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
import smartcam.fleet
from smartcam.recording import FleetRecorder, FleetReplay, Recording, load_recording
from tests.handmade import PATIENCE
from tests.inspection.seeing import Desk, cell_of

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.fleet import FleetServer

pytest.importorskip("zenoh")
pytestmark = pytest.mark.real_time

NAME = "line1/cam1"


@pytest.fixture
def desk(request: pytest.FixtureRequest) -> Desk:
    return Desk(f"r{abs(hash(request.node.nodeid)):x}")


def plant_of(folder: Path, desk: Desk, pictures: str = "judged") -> Path:
    """Write a fleet file with a software camera that is recorded, and return its path."""
    path = cell_of(folder, desk)
    record = f"record: {{folder: rec, pictures: {pictures}}}\n"
    path.write_text(path.read_text() + "listen: tcp/127.0.0.1:0\n" + record)
    return path


def checked(found: Recording, count: int) -> list[int]:
    """Return the levels in a recording, whose results each have the picture of that level."""
    levels: list[int] = []
    for result, picture, told in found.results_with_pictures(NAME):
        assert told
        assert picture is not None
        assert picture.format.name == "Mono8"
        assert (picture.array() == result.value["level"]).all()
        levels.append(result.value["level"])
    assert len(levels) >= count
    assert found.counts.pictures == found.counts.results == len(levels)
    return levels


async def triggered(server: FleetServer, desk: Desk, *levels: int) -> None:
    async with smartcam.connect(server.urls[NAME]) as camera:
        for level in levels:
            desk.level = level
            result: Any = await camera.trigger(timeout=PATIENCE)
            assert result.value.level == level


@pytest.mark.parametrize("pictures", ["judged", "all"])
async def test_each_triggered_result_has_its_picture_and_is_played_with_it(
    tmp_path: Path, desk: Desk, pictures: str
) -> None:
    server = smartcam.fleet.serve(plant_of(tmp_path, desk, pictures))
    async with FleetRecorder(server) as recorder, server:
        await triggered(server, desk, 10, 10, 220, 10)
        assert recorder.counts[NAME].lost == 0
    found = load_recording(tmp_path / "rec")
    assert checked(found, 4) == [10, 10, 220, 10]
    async with FleetReplay(found) as played, smartcam.connect(played.server.urls[NAME]) as camera:
        for level in (10, 10, 220, 10):
            result: Any = await camera.trigger(timeout=PATIENCE)
            assert result.value.level == level
            frame = await camera.newest_frame(max_age=math.inf)
            assert (frame.array() == level).all()


async def test_results_of_a_free_run_have_their_pictures(tmp_path: Path, desk: Desk) -> None:
    desk.level = 20
    server = smartcam.fleet.serve(plant_of(tmp_path, desk))
    async with (
        FleetRecorder(server),
        server,
        smartcam.connect(server.urls[NAME], application=30) as camera,
    ):
        results = camera.results()
        async with asyncio.timeout(PATIENCE):
            for level in range(20, 30):
                desk.level = level
                while (await anext(results)).value.level != level:
                    pass
        results.close()
    levels = checked(load_recording(tmp_path / "rec"), 10)
    assert sorted(set(levels)) == [*range(20, 30)]


async def test_a_session_that_is_lost_and_a_camera_that_is_changed_mix_no_pictures(
    tmp_path: Path, desk: Desk
) -> None:
    path = plant_of(tmp_path, desk)
    server = smartcam.fleet.serve(path)
    async with FleetRecorder(server), server:
        await triggered(server, desk, 31, 32)
        camera = server.shared_cameras[NAME].client
        sessions = camera.statistics().sessions
        inner: Any = camera
        inner._connection.require_link().abort()
        async with asyncio.timeout(PATIENCE):
            while camera.statistics().sessions == sessions:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        await triggered(server, desk, 33)
        path.write_text(path.read_text().replace("most: 200", "most: 190"))
        assert (await server.reload()).changed == (NAME,)
        await triggered(server, desk, 34, 35)
    assert checked(load_recording(tmp_path / "rec"), 5) == [31, 32, 33, 34, 35]


async def test_no_pictures_are_recorded_where_none_are_wanted(tmp_path: Path, desk: Desk) -> None:
    server = smartcam.fleet.serve(plant_of(tmp_path, desk, "none"))
    async with FleetRecorder(server), server:
        await triggered(server, desk, 10)
    found = load_recording(tmp_path / "rec")
    assert (found.counts.results, found.counts.pictures) == (1, 0)
    assert [one.value["level"] for one in found.results(NAME)] == [10]
