"""Frame drivers that a test controls."""

from __future__ import annotations

import abc
import asyncio
import time
from typing import Any

from smartcam.exceptions import FrameSourceError
from smartcam.frames import (
    Frame,
    FrameAddress,
    FrameDriver,
    FrameSink,
    FrameSource,
    Moment,
    StreamFormat,
    find_format,
)
from tests.handmade import until

GREY = find_format("Mono8")


def frame(number: int = 1, **other: Any) -> Frame:
    """Return a frame of 4 x 2 pixels, whose values are all its number."""
    now = time.monotonic()
    about: dict[str, Any] = {
        "data": bytes([number % 256]) * 8,
        "format": GREY,
        "width": 4,
        "height": 2,
        "stride": 4,
        "captured": now,
        "utc": time.time(),
        "moment": Moment.EXPOSURE_START,
        "sequence": number,
        "source": "scripted",
    }
    return Frame(**(about | other))


class ShowingDriver(FrameDriver):
    """Runs :meth:`show` from each start to the next stop."""

    _task: asyncio.Task[None] | None = None

    @abc.abstractmethod
    async def show(self, sink: FrameSink) -> None:
        """Give frames until the task is cancelled, or there are no more."""

    async def start(self, sink: FrameSink) -> None:
        self._task = asyncio.create_task(self.show(sink))

    async def stop(self) -> None:
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    async def close(self) -> None:
        await self.stop()


class ScriptedDriver(FrameDriver):
    """Records its calls; the test gives frames by :meth:`give`."""

    def __init__(self, url: str = "synthetic://?size=300x300") -> None:
        super().__init__(FrameAddress.parse(url))
        self.calls: list[str] = []
        self.fails: dict[str, BaseException] = {}
        self.waits: dict[str, asyncio.Event] = {}
        self.sink: FrameSink | None = None
        self.rates: tuple[float, ...] = (30.0,)

    @property
    def name(self) -> str:
        return "scripted"

    async def _call(self, what: str) -> None:
        self.calls.append(what)
        if what in self.waits:
            await self.waits[what].wait()
        if what in self.fails:
            raise self.fails[what]

    async def open(self) -> StreamFormat:
        await self._call("open")
        return StreamFormat(GREY, 4, 2, self.rates)

    async def start(self, sink: FrameSink) -> None:
        await self._call("start")
        self.sink = sink

    async def stop(self) -> None:
        self.sink = None
        await self._call("stop")

    async def close(self) -> None:
        await self._call("close")

    def give(self, *frames: Frame) -> None:
        """Give frames from the streaming device."""
        assert self.sink is not None, "the device does not stream"
        for one in frames:
            self.sink.frame(one)

    async def streams(self) -> None:
        """Wait until the device streams."""
        await until(lambda: self.sink is not None)

    async def rests(self) -> None:
        """Wait until the device was stopped."""
        await until(lambda: self.calls[-1] == "stop")


def scripted(**options: Any) -> tuple[ScriptedDriver, FrameSource]:
    """Return a driver and its source, not open."""
    driver = ScriptedDriver()
    return driver, FrameSource(driver, **options)


class GoneError(FrameSourceError):
    """The error that a test's device ends with."""
