"""Recordings made by hand, and by a client of an emulated camera."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import smartcam
from smartcam.models import CameraEvent, Connected, Disconnected, Result
from smartcam.observers import TraceEntry
from smartcam.recording import Recorder, load_recording

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from smartcam.emulator import EmulatedCamera
    from smartcam.recording import Recording
    from smartcam.settings import CameraOptions

BEGIN = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
URL = "bvs://192.168.0.10:36701?dialect=handbook"

COUNTER: dict[str, Any] = {
    "id": 5,
    "layout": "n: int32",
    "generator": "sequence",
    "processing_time": 0.01,
    "load_time": 0.01,
}
"""An application whose containers are 0, 1, 2 and so on."""


def at(seconds: float) -> datetime:
    return BEGIN + timedelta(seconds=seconds)


def frame(seconds: float, text: str, **fields: Any) -> TraceEntry:
    """Return a frame of camera ``left``; ``text`` is its direction and its message."""
    direction, message = text.split()
    return TraceEntry(at(seconds), "left", direction, None, message, fields, "00")


def status(seconds: float, *names: str, endian: int = 0) -> TraceEntry:
    return frame(seconds, "< StatusReport", status=list(names), endian=endian)


def container(seconds: float, data: bytes, application: int = 5) -> TraceEntry:
    return frame(seconds, "< ResultContainer", application=application, data=data.hex())


def session(url: str = URL, *names: str, endian: int = 0) -> list[TraceEntry | CameraEvent]:
    """Return how a session with application 5 begins, at 0 s."""
    return [
        frame(0, "> Connect"),
        frame(0, "< ConnectAnswer", version=1),
        status(0, *names, endian=endian),
        frame(0, "< QueryAnswer", application=5),
        Connected(camera="left", at=at(0), url=url),
    ]


def write(
    path: Path, items: Iterable[TraceEntry | CameraEvent | Result], **facts: object
) -> Recording:
    """Record items as a client would, and load the file."""
    with Recorder(path) as recorder:
        recorder.describe("left", **facts)
        for item in items:
            if isinstance(item, TraceEntry):
                recorder.on_frame(item)
            elif isinstance(item, Result):
                recorder.on_result(item)
            else:
                recorder.on_state(item)
    return load_recording(path)


async def record(
    path: Path,
    emulator: EmulatedCamera,
    *,
    triggers: int,
    name: str = "left",
    **options: Any,
) -> Recording:
    """Record some triggers of application 5."""
    settings: CameraOptions = {"name": name, "application": 5, **options}  # type: ignore[typeddict-item]
    with Recorder(path) as recorder:
        async with smartcam.connect(emulator.url, observers=[recorder], **settings) as camera:
            for _ in range(triggers):
                await camera.trigger()
    return load_recording(path)


def containers(recording: Recording) -> list[tuple[int | None, str]]:
    """Return the containers that came, with their application where they tell it."""
    return [
        (entry.fields.get("application"), entry.fields["data"])
        for entry in recording.frames()
        if entry.message == "ResultContainer"
    ]


PACKET_URLS = {
    "tcp4": URL,
    "udp4": "bvs+udp://192.168.0.10:36701?dialect=handbook",
    "tcp6": "bvs://[2001:db8::7]:36701?dialect=handbook",
    "udp6": "bvs+udp://[2001:db8::7]:36701?dialect=handbook",
}
"""A camera's URL, by what its frames are carried in."""


def packet_items(url: str) -> list[TraceEntry | CameraEvent]:
    """Return what is known of two links: frames of all sizes, a loss, an end."""
    sizes = (1, 2, 3, 1440, 1441, 2921)
    frames = [
        container(1 + size / 1e4, b"")._replace(hex=(bytes(range(256)) * 12)[:size].hex())
        for size in sizes
    ]
    gone = Disconnected(camera="left", at=at(3), reason="gone", expected=False)
    return [*session(url), *frames, gone, frame(4, "> Connect"), frame(5, "< ConnectAnswer")]
