"""Frames in a fleet file."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import smartcam.fleet
from smartcam import ConfigurationError
from smartcam.calibration import CameraModel
from smartcam.calibration.formats import write_camera_info
from smartcam.fleet import FleetFile
from tests.fleet.test_file import against, entry, load, write

STRIPES = "synthetic://?size=300x200&fps=100"


def camera(said: str) -> str:
    return f"cameras:\n  line1/cam3:\n    emulated: {{}}\n    frames: {said}\n"


@pytest.mark.parametrize(
    ("said", "linger", "stall"),
    [
        (f"'{STRIPES}'", 2.0, 5.0),
        (f"{{url: '{STRIPES}', linger: 0}}", 0.0, 5.0),
        (f"{{url: '{STRIPES}', linger: 7.5, stall: null}}", 7.5, None),
    ],
)
def test_frames_are_a_url_or_a_mapping(
    tmp_path: Path, said: str, linger: float, stall: float | None
) -> None:
    found = load(tmp_path, camera(said)).cameras["line1/cam3"].frames
    assert found is not None
    assert (found.url, found.linger, found.stall) == (STRIPES, linger, stall)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ("synthetik://", ", line 4: .*cam3.frames.url: .*unknown scheme 'synthetik'; .*did you"),
        ("'synthetic://?fsp=3'", ", line 4: .*cam3.frames.url: .*unknown parameter 'fsp'"),
        ("{}", ", line 4: .*cam3.frames.url: Field required"),
        ("7", ", line 4: .*cam3.frames: Input should be a valid dict"),
        (f"{{url: '{STRIPES}', lingre: 1}}", ", line 4: .*frames.lingre: .*did you mean 'linger'"),
        (f"{{url: '{STRIPES}', linger: -1}}", ", line 4: .*frames.linger: .*greater than or equal"),
        (f"{{url: '{STRIPES}', stall: 0}}", ", line 4: .*frames.stall: .*greater than 0"),
        (f"{{url: '{STRIPES}', camera_info: no.yaml}}", ", line 4: .*camera_info: .*no.yaml"),
        (f"{{url: '{STRIPES}', camera_info: fleet.yaml}}", ", line 4: .*frames.camera_info: "),
    ],
)
def test_mistake_is_named_with_file_line_and_field(tmp_path: Path, said: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=rf"(?s)fleet \S*fleet.yaml{message}"):
        load(tmp_path, camera(said))


def test_mistake_of_a_file_made_in_python_is_told_when_it_starts() -> None:
    file = FleetFile.model_validate(entry(emulated={}, frames="synthetic://?fsp=3"))

    async def serve() -> None:
        async with smartcam.fleet.open(file):
            pass

    with pytest.raises(ConfigurationError, match="unknown parameter 'fsp'"):
        asyncio.run(serve())


def test_password_is_shown_by_no_representation(tmp_path: Path) -> None:
    frames = {"url": "rtsp://user:secret@h/stream"}
    assert "secret" not in repr(FleetFile.model_validate(entry(emulated={}, frames=frames)))


async def test_frames_of_a_file_come_with_their_lens(tmp_path: Path) -> None:
    lens = CameraModel(
        size=(300, 200), matrix=np.array([[300.0, 0, 150], [0, 300, 100], [0, 0, 1]])
    )
    write_camera_info(tmp_path / "lens.yaml", lens)
    path = write(tmp_path, camera(f"{{url: '{STRIPES}', camera_info: lens.yaml}}"))
    async with smartcam.fleet.open(path) as fleet:
        got = await fleet["line1/cam3"].newest_frame()
    assert (got.width, got.height, got.source) == (300, 200, "line1/cam3")
    assert got.camera_info is not None
    assert np.allclose(got.camera_info.matrix, lens.matrix)


@pytest.mark.long
def test_schema_knows_frames() -> None:
    for good in (STRIPES, {"url": STRIPES, "linger": 1, "stall": None}):
        assert against(entry(emulated={}, frames=good)) == []
    bad: list[Any] = [7, {}, {"url": STRIPES, "lingre": 1}, {"url": STRIPES, "linger": -1}]
    for one in bad:
        assert against(entry(emulated={}, frames=one)) == ["$.cameras.a.frames"], one
