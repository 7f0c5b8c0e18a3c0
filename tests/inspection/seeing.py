"""A source of frames that a test controls, and a tool that a test can block."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from smartcam.exceptions import FrameSourceError
from smartcam.frames import Frame, FrameDriver, Moment, StreamFormat, find_format
from smartcam.inspection import Finding, Tool, ToolSettings, View, register_tool
from smartcam.registry import FRAMES
from tests.handmade import PATIENCE

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.frames import FrameAddress, FrameSink

WIDTH, HEIGHT = 64, 48
MONO = find_format("Mono8")


class Desk:
    """A controlled camera: its scene and its cable.

    Attributes:
        level: grey level of the next pictures.
        format: format of the pictures, grey, of 8 bits or of two bytes.
        streams: pictures come by themselves.
        plugged: False while the cable is out.
    """

    all: ClassVar[dict[str, Desk]] = {}

    def __init__(self, name: str) -> None:
        self.all[name] = self
        self.url = f"desk://{name}"
        self.level = 100
        self.format = MONO
        self.streams = True
        self.plugged = True
        self.sink: FrameSink | None = None
        self.number = 0

    def show(self, level: int, *, age: float = 0.0) -> None:
        """Send a picture that was exposed ``age`` seconds ago."""
        assert self.sink is not None, "nobody looks"
        self.number += 1
        pixels = np.full((HEIGHT, WIDTH), level, "<u2" if self.format.depth > 8 else "u1")
        self.sink.frame(
            Frame(
                data=pixels.tobytes(),
                format=self.format,
                width=WIDTH,
                height=HEIGHT,
                stride=WIDTH * pixels.itemsize,
                captured=time.monotonic() - age,
                utc=time.time() - age,
                moment=Moment.EXPOSURE_START,
                sequence=self.number,
                source=self.url,
            )
        )

    def unplug(self) -> None:
        """Unplug the cable."""
        self.plugged = False
        if self.sink is not None:
            self.sink.ended(FrameSourceError("the cable is out", source=self.url))

    def plug(self) -> None:
        """Plug the cable in again."""
        self.plugged = True


class DeskDriver(FrameDriver):
    """``desk://NAME``: what the test shows."""

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        self._desk = Desk.all[address.host]
        self._task: asyncio.Task[None] | None = None
        self._sink: FrameSink | None = None

    async def open(self) -> StreamFormat:
        if not self._desk.plugged:
            raise FrameSourceError("nobody there", source=self._desk.url)
        return StreamFormat(self._desk.format, WIDTH, HEIGHT)

    async def start(self, sink: FrameSink) -> None:
        if not self._desk.plugged:
            raise FrameSourceError("nobody there", source=self._desk.url)
        self._desk.sink = self._sink = sink
        self._task = asyncio.create_task(self._run())

    async def _run(self) -> None:
        while self._desk.plugged:
            await asyncio.sleep(0.005)
            if self._desk.plugged and self._desk.streams:
                self._desk.show(self._desk.level)

    async def stop(self) -> None:
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait({task})
        if self._desk.sink is self._sink:  # nobody else looks by now
            self._desk.sink = None

    async def close(self) -> None:
        await self.stop()


FRAMES.register("desk", DeskDriver)


class Gate:
    """A gate that blocks tools until it is opened.

    Attributes:
        reached: number of tools that came to it.
    """

    all: ClassVar[dict[str, Gate]] = {}

    def __init__(self, name: str) -> None:
        self.all[name] = self
        self.open = threading.Event()
        self.reached = 0

    def has(self, reached: int) -> bool:
        """Return whether ``count`` tools have reached the gate."""
        return self.reached == reached

    def pass_through(self) -> None:
        self.reached += 1
        if not self.open.wait(PATIENCE):
            raise TimeoutError("nobody opened the gate")


class LevelSettings(ToolSettings):
    """Allowed range of brightness."""

    most: int = Field(255, description="the brightest that is good")
    gate: str | None = Field(None, description="the gate to wait at")
    fails: bool = Field(False, description="have a fault")


class Level(Tool[LevelSettings]):
    """A tool that returns the first pixel's grey level, the input data, and a right angle."""

    settings_model = LevelSettings

    @property
    def fields(self) -> str:
        return "level: int32, input: string[8], angle: real32 deg"

    def inspect(self, view: View) -> Finding:
        if self.settings.gate is not None:
            Gate.all[self.settings.gate].pass_through()
        if self.settings.fails:
            raise RuntimeError("the tool has a fault")
        level = int(view.grey[0, 0])
        good = level <= self.settings.most
        given = view.input.decode().rstrip("\0")
        values = {"level": level, "input": given, "angle": math.pi / 2}
        return Finding(ok=good, reason="" if good else f"{level} is too bright", values=values)


register_tool("level", Level)

CELL = """
cameras:
  line1/cam1:
    software:
      frames: "{url}"{more}
      applications:
        7: {{name: bright, level: {{most: 200}}}}
        12: {{name: gated, level: {{gate: gate}}}}
        20: {{name: faulty, level: {{fails: true}}}}
        30: {{name: free, rate: 50, level: {{}}}}
        40: {{name: counted, sequence: true, level: {{}}}}
"""


def cell_of(folder: Path, desk: Desk, more: str = "") -> Path:
    """Write the cell file of the controlled camera, and return its path."""
    path = folder / "cell.yaml"
    path.write_text(CELL.format(url=desk.url, more=f"\n      {more}" if more else ""))
    return path
