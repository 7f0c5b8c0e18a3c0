"""Values that cannot cross the bus: each line of the table in ``docs/sharing-a-camera.md``."""

from __future__ import annotations

from typing import Any

import pytest

import smartcam
from smartcam import Camera, Result, UnsupportedError
from smartcam.emulator import EmulatedCamera
from smartcam.models import CameraEvent
from smartcam.observers import TraceEntry
from tests.fleet.kinds import connect

FLEET_URL = "fleet://localhost:1/line1/cam3"


class Ear(smartcam.Observer):
    """Counts what it hears."""

    def __init__(self) -> None:
        self.frames = self.results = self.events = 0

    def on_frame(self, entry: TraceEntry) -> None:
        self.frames += 1

    def on_result(self, result: Result) -> None:
        self.results += 1

    def on_state(self, event: CameraEvent) -> None:
        self.events += 1


async def test_observers_hear_of_results_and_events_and_not_of_frames() -> None:
    ear = Ear()
    async with (
        EmulatedCamera(running=True) as box,
        connect("in_process", box.url, observers=[ear]) as camera,
    ):
        await camera.trigger()
    assert (ear.frames, ear.results) == (0, 1)
    assert ear.events > 0


OPTIONS: dict[str, Any] = {
    "connect_attempts": 2,
    "close_timeout": 1.0,
    "liveness_timeout": None,
    "restore": True,
    "max_length": 1 << 16,
}


@pytest.mark.parametrize("name", OPTIONS)
def test_option_of_the_session_is_refused(name: str) -> None:
    with pytest.raises(UnsupportedError, match=rf"{name}: .* session, which its agent has"):
        smartcam.connect(FLEET_URL, **{name: OPTIONS[name]})


async def test_statistics_have_what_came_to_this_program() -> None:
    async with EmulatedCamera(running=True) as box, connect("in_process", box.url) as camera:
        await camera.trigger()
        box.device.trigger()  # nobody listens here
        await camera.query_application()  # its answer is behind the status that says so
        await camera.trigger(timeout=30)
        statistics = camera.statistics()
    assert (statistics.received, statistics.triggered, statistics.unclaimed) == (2, 2, 0)


async def test_error_crosses_with_kind_text_and_attributes() -> None:
    async def refused(kind: str) -> smartcam.CommandRejectedError:
        async with EmulatedCamera(running=True) as box:
            camera: Camera
            async with connect(kind, box.url, name="press") as camera:
                with pytest.raises(smartcam.CommandRejectedError) as caught:
                    await camera.switch_application(99)
        return caught.value

    at_the_wire, over_the_bus = await refused("wire"), await refused("in_process")
    assert vars(over_the_bus) == vars(at_the_wire)
    assert str(over_the_bus).replace("line1/cam1", "press") == str(at_the_wire)
