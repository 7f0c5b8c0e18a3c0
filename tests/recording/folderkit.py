"""A recorder beside an agent whose cameras count, all in this process."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

from smartcam.fleet import FleetFile, FleetServer, MemoryBus
from smartcam.fleet._inside import RecordSection
from smartcam.recording import FleetRecorder, Recording, load_recording
from tests.fleet.fleetkit import LAYOUT, PATIENCE
from tests.recording.inside import (
    MAX_WAITING_BYTES,
    ApplicationRuns,
    FileName,
    PictureMatcher,
    RecordedPicture,
    RecordedRun,
    ReplayedPictures,
    files_of,
)
from tests.recording.inside import _recorder as recorder
from tests.recording.inside import files as folder_files
from tests.recording.inside import pictures as folder_pictures
from tests.recording.inside import writer as folder_writer

__all__ = [
    "MAX_WAITING_BYTES",
    "NAME",
    "ApplicationRuns",
    "PictureMatcher",
    "RecordedPicture",
    "RecordedRun",
    "ReplayedPictures",
    "all_runs",
    "files",
    "folder_files",
    "folder_pictures",
    "folder_writer",
    "name_of",
    "recording",
    "runs",
    "section",
    "server",
    "until",
]

NAME = "line1/cam1"


def section(**fields: Any) -> RecordSection:
    """Return what a file says, with sizes as small as a test wants."""
    said = {"folder": "rec", "size": 1e8, "age": 3600.0, "keep": 1e10, "cameras": ("**",)}
    usual = {"frames": True, "pictures": "none"}
    return RecordSection.model_construct(**{**said, **usual, **fields})


def server(folder: Path, *urls: str, source: str | None = None) -> FleetServer:
    """Return the agent of cameras ``line1/cam1``, ... at these addresses."""
    entries = {
        f"line1/cam{place}": {
            "url": url,
            "application": 1,
            "interpret_as": LAYOUT,
            "reconnect": {"initial": 0.01, "maximum": 0.05},
            **({} if source is None else {"frames": source}),
        }
        for place, url in enumerate(urls, 1)
    }
    file = FleetFile.model_validate({"cameras": entries})
    return FleetServer(file, bus=MemoryBus().new_connection(), folder=folder)


@contextlib.asynccontextmanager
async def recording(
    place: Path,
    *urls: str,
    clock: Callable[[], float] = time.monotonic,
    source: str | None = None,
    **fields: Any,
) -> AsyncIterator[tuple[FleetRecorder, FleetServer]]:
    """Record cameras into ``place/rec``."""
    agent = server(place, *urls, source=source)
    recorder = FleetRecorder(agent, section(**fields), _clock=clock)
    async with recorder, agent:
        await agent.wait_first_attempts()
        yield recorder, agent


async def until(true: Callable[[], object]) -> None:
    """Wait for something that a thread does."""
    async with asyncio.timeout(PATIENCE):
        while not true():  # noqa: ASYNC110 - a thread does it
            await asyncio.sleep(0.005)


def files(folder: Path, camera: str = NAME) -> list[Path]:
    """Return the files of a camera, in order."""
    found = [(name, Path(entry.path)) for name, entry in files_of(folder / "rec")]
    return [path for name, path in sorted(found) if name.camera == camera]


def runs(found: Recording, camera: str = NAME) -> list[int]:
    """Return the numbers that the camera's results have."""
    return [result.value["run"] for result in found.results(camera)]


def write_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a folder's files written in many small chunks, however slow the machine is."""
    monkeypatch.setattr(folder_writer, "INTERVAL", 0.01)
    monkeypatch.setattr(recorder, "CHUNK", 1000)


def all_runs(folder: Path, camera: str = NAME) -> list[int]:
    """Return the numbers of all results in a folder, file by file as they sort by name."""
    names = sorted(path.name for path in files(folder, camera))
    return [run for name in names for run in runs(load_recording(folder / "rec" / name), camera)]


def name_of(path: Path) -> FileName:
    """Return what a file's name says."""
    found = FileName.parse(path.name)
    assert found is not None
    return found
