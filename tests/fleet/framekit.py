"""Helpers of the tests of a fleet's frames: a device that does what a test says, at an agent."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest

from smartcam.fleet import FleetCamera
from smartcam.frames import FrameDriver, FrameSource
from tests.fleet.fleetkit import NAME, Plant, until
from tests.fleet.inside import FramesEntry, SharedFrames
from tests.frames.drivers import ScriptedDriver, frame
from tests.timed_loop import TimedLoop


def give_source(monkeypatch: pytest.MonkeyPatch, driver: FrameDriver) -> None:
    """Have the sources of a fleet file be a driver's."""
    monkeypatch.setattr(FramesEntry, "make_source", lambda *_: FrameSource(driver, stall=None))


class FramePlant(Plant):
    """A plant whose camera has frames, those that a test gives; on the bus that the mark says.

    Args:
        source: options of the frames' source.
        **options: as a plant has them.

    Attributes:
        driver: the device.
    """

    def __init__(self, source: dict[str, Any] | None = None, **options: Any) -> None:
        self.driver = ScriptedDriver()
        # the device gives nothing while a test waits for something else
        self._source = {"stall": None, **(source or {})}
        options.setdefault("zenoh", not isinstance(asyncio.get_running_loop(), TimedLoop))
        super().__init__(frames=self._make, **options)

    def _make(self) -> FrameSource:
        return FrameSource(self.driver, **self._source)

    @property
    def shared(self) -> SharedFrames:
        """The frames at the agent."""
        return self.agent.shared_cameras[NAME].frames

    @contextlib.asynccontextmanager
    async def streaming(self, every: float = 0.02, **other: Any) -> AsyncIterator[None]:
        """Have the device give numbered frames whenever it streams."""
        giving = asyncio.create_task(self._give(every, other))
        try:
            yield
        finally:
            giving.cancel()
            await asyncio.wait([giving])

    async def _give(self, every: float, other: dict[str, Any]) -> None:
        number = 0
        while True:
            await asyncio.sleep(every)
            if self.driver.sink is not None:
                number += 1
                self.driver.give(frame(number, **other))

    async def waits(self) -> None:
        """Wait until a program waits for the next frame."""
        await until(
            lambda: (
                self.driver.sink is not None
                and any(one.busy for one in self.shared._streams.values())
            )
        )


@contextlib.asynccontextmanager
async def looking(**options: Any) -> AsyncIterator[tuple[FramePlant, FleetCamera[Any]]]:
    """Give a plant whose camera has frames, and a program's camera."""
    async with FramePlant(**options) as plant, plant.camera() as camera:
        yield plant, camera
