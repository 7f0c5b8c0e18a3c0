"""``smartcam record --pictures``: the pictures that results were made of."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import smartcam
from smartcam.recording import FleetReplay, load_recording
from tests.cli.commandline import run
from tests.processes import PATIENCE, Process

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.recording import Recording

CELL = """\
cameras:
  line1/cam1:
    software:
      frames: "synthetic://?size=320x240&fps=100"
      applications:
        5: {name: there, present: {grey: [0, 255]}}
  line1/blind: {emulated: {}}
"""
NAME = "line1/cam1"
TRIGGERS = ("--every", "0.05", "--count", "3")


def cell_of(folder: Path) -> Path:
    path = folder / "cell.yaml"
    path.write_text("fleet: plant\nlisten: tcp/127.0.0.1:0\n" + CELL)
    return path


def pictures_in(found: Recording) -> list[np.ndarray[Any, Any] | None]:
    return [
        None if one.picture is None else one.picture.array()
        for one in found.results_with_pictures(NAME)
    ]


@pytest.mark.parametrize(
    ("options", "count"), [((), 3), (("--pictures", "judged"), 3), (("--pictures", "none"), 0)]
)
def test_a_software_camera_is_recorded_with_its_pictures_or_without(
    tmp_path: Path, options: tuple[str, ...], count: int
) -> None:
    file = tmp_path / "run.mcap"
    url = f"software:{cell_of(tmp_path)}#{NAME}"
    run("record", url, "-o", str(file), *TRIGGERS, *options).done()
    found = load_recording(file)
    assert (found.counts.results, found.counts.pictures) == (3, count)
    assert sum(one is not None for one in pictures_in(found)) == count
    assert all(one.linked for one in found.results_with_pictures(NAME)) == (count > 0)


def test_none_goes_with_a_bag(tmp_path: Path) -> None:
    url = f"software:{cell_of(tmp_path)}#{NAME}"
    run("record", url, "--bag", str(tmp_path / "bag"), *TRIGGERS, "--pictures", "none").done()
    refused = run("record", url, "--bag", str(tmp_path / "more"), *TRIGGERS, "--pictures", "judged")
    assert refused.code == 2
    assert "pictures go into a recording (-o), not into a bag" in refused.err


def test_a_fleets_software_camera_is_recorded_and_played_with_its_pictures(tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    with Process("smartcam", "serve", str(cell_of(tmp_path))) as agent:
        urls = agent.read_until(b"\n", count=2).split()
        url, blind = urls
        run("record", url, "-o", str(file), *TRIGGERS, "--pictures", "judged").done()
        plain = tmp_path / "plain.mcap"
        run("record", url, "-o", str(plain), *TRIGGERS).done()
        refused = run(
            "record", blind, "-o", str(tmp_path / "no.mcap"), *TRIGGERS, "--pictures", "judged"
        )
    refused.failed(5, "line1/blind has no frames")
    assert load_recording(plain).counts.pictures == 0
    found = load_recording(file)
    # a result that came before the agent sent its frames to the recorder has no picture
    assert 1 <= found.counts.pictures <= 3
    assert sum(one is not None for one in pictures_in(found)) == found.counts.pictures
    asyncio.run(see_played(found))


async def see_played(found: Recording) -> None:
    """See that a replayed fleet shows the picture of each result."""
    recorded = pictures_in(found)
    assert len(recorded) == found.counts.results
    async with FleetReplay(found) as played, smartcam.connect(played.server.urls[NAME]) as camera:
        for wanted in recorded:
            await camera.trigger(timeout=PATIENCE)
            if wanted is not None:
                shown = await camera.newest_frame(max_age=math.inf)
                assert np.array_equal(shown.array(), wanted)


def test_a_camera_without_pictures_is_told_what_there_is_instead(tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    refused = run("record", "bvs://127.0.0.1:1", "-o", str(file), "--pictures", "judged")
    refused.failed(5, "sends no pictures with its results", "--pictures SOURCE", "--read-images")
    assert not file.exists()


def test_image_of_a_software_camera_is_that_of_a_trigger(tmp_path: Path) -> None:
    file = tmp_path / "seen.png"
    run("image", f"software:{cell_of(tmp_path)}#{NAME}", "-o", str(file)).done()
    assert file.read_bytes().startswith(b"\x89PNG")


def test_a_video_is_refused_since_it_has_no_results(tmp_path: Path) -> None:
    file = tmp_path / "run.mkv"
    refused = run("record", "bvs://127.0.0.1:1", "-o", str(file))
    assert refused.code == 2
    assert "a video has no results: expected FILE.mcap" in refused.err
    assert not file.exists()
