"""Software cameras: what a trigger costs above the tools, and what inspecting does to the loop.

Times are of the wall clock, from the call of ``trigger()`` to its result, in one process with the
client, the device and the source; the frame is handed over as soon as the run waits for it. So no
time that a real camera takes for a picture is in them.

``nothing`` is a tool that finds nothing, so all of it is the machinery: link, device, threads,
layout. A Data Matrix of 1.3 megapixels is read by ``read``, beside zxing-cpp alone with the same
pixels and the same kind of code.
"""

from __future__ import annotations

import asyncio
import contextlib
import statistics
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import zxingcpp

import smartcam
from benchmarks.measure import Comparison, Goal, Series
from smartcam import frames, inspection
from smartcam.inspection import SoftwareCamera
from smartcam.registry import FRAMES

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from numpy.typing import NDArray

    from benchmarks.measure import Plan

__all__ = ["run"]

SIZE = (1280, 1024)
TRIGGERS = 40
TRIGGERS_WITHOUT_WORK = 400
SECONDS = 5.0

CELL = """
cameras:
  bench:
    software:
      frames: "benchmark://"
      applications:
        1: {name: nothing, nothing: {}}
        2: {name: code, read: {codes: [DataMatrix]}}
"""


class _Nothing(inspection.Tool[inspection.ToolSettings]):
    """Finds nothing."""

    settings_model = inspection.ToolSettings

    def inspect(self, view: inspection.View) -> inspection.Finding:
        return inspection.Finding(ok=True)


class _Driver(frames.FrameDriver):
    """Gives a picture when it is told to."""

    sink: frames.FrameSink | None = None

    async def open(self) -> frames.StreamFormat:
        return frames.StreamFormat(frames.find_format("Mono8"), *SIZE)

    async def start(self, sink: frames.FrameSink) -> None:
        _Driver.sink = sink
        _show(np.zeros((SIZE[1], SIZE[0]), np.uint8))

    async def stop(self) -> None:
        _Driver.sink = None

    async def close(self) -> None:
        await self.stop()


def _show(picture: NDArray[np.uint8]) -> None:
    if _Driver.sink is None:
        raise RuntimeError("nobody looks")
    _Driver.sink.frame(
        frames.Frame(
            data=picture.data.cast("B"),
            format=frames.find_format("Mono8"),
            width=SIZE[0],
            height=SIZE[1],
            stride=SIZE[0],
            captured=time.monotonic(),
            utc=time.time(),
            moment=frames.Moment.EXPOSURE_START,
            sequence=1,
            source="benchmark",
        )
    )


def picture_of_code() -> NDArray[np.uint8]:
    """Return a picture of 1.3 megapixels with a Data Matrix, a little blurred and noisy."""
    code = zxingcpp.create_barcode("smartcam 47 0123456789", zxingcpp.BarcodeFormat.DataMatrix)
    small = np.array(code.to_image(scale=6, add_quiet_zones=True))
    picture = np.full((SIZE[1], SIZE[0]), 200, np.uint8)
    height, width = small.shape
    picture[400 : 400 + height, 500 : 500 + width] = np.where(small < 128, 40, 200)
    turn = cv2.getRotationMatrix2D((600, 500), 17.0, 1.0)
    turned = cv2.warpAffine(picture, turn, SIZE, borderValue=200)
    noise = np.random.default_rng(1).normal(0, 4, turned.shape)
    blurred = cv2.GaussianBlur(turned, (0, 0), 0.8)
    drawn: NDArray[np.uint8] = np.clip(blurred + noise, 0, 255).astype(np.uint8)
    return drawn


def run(plan: Plan) -> Iterator[Comparison]:
    """Measure triggers, and the loop's delay."""
    with contextlib.suppress(smartcam.PluginError):  # they are there from a run before
        FRAMES.register("benchmark", _Driver)
        inspection.register_tool("nothing", _Nothing)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "cell.yaml")
        file.write_text(CELL, encoding="utf-8")
        yield from asyncio.run(_run(plan, file))


async def _run(plan: Plan, file: Path) -> list[Comparison]:
    seconds = 0.2 if plan.quick else SECONDS
    idle = [await _delay(None, seconds) for _ in range(plan.rounds)]
    async with smartcam.connect(f"software:{file}#bench") as camera:
        assert isinstance(camera, SoftwareCamera)
        compared = [one async for one in _compared(plan, camera)]
        working = [await _delay(camera, seconds) for _ in idle]
    delay = Comparison(
        "inspection",
        "longest delay of the loop while codes are read, more than of an idle one",
        Series("smartcam", "ms", working),
        Series("an idle loop", "ms", idle),
        "more",
        Goal("at most", 5.0, "ms"),
        "wall clock: what else the machine does is in both",
    )
    return [*compared, delay]


async def _compared(plan: Plan, camera: SoftwareCamera[Any]) -> AsyncIterator[Comparison]:
    picture = picture_of_code()
    _show_when_asked(camera, picture)
    count = plan.operations(TRIGGERS, least=5)
    above: list[float] = []
    reading: list[float] = []
    alone: list[float] = []
    for _ in range(plan.rounds):
        await camera.switch_application(1)
        above.append(await _triggers(camera, plan.operations(TRIGGERS_WITHOUT_WORK, least=5)))
        await camera.switch_application(2)
        reading.append(await _triggers(camera, count))
        alone.append(await _zxing(picture, count))
    yield Comparison(
        "inspection",
        "a trigger whose tool does nothing, median",
        Series("smartcam", "ms", above),
        None,
        "alone",
        Goal("at most", 0.5, "ms"),
        "wall clock: what else the machine does is in it",
    )
    yield Comparison(
        "inspection",
        "a Data Matrix of 1.3 MP, trigger to result, more than zxing-cpp alone, median",
        Series("smartcam", "ms", reading),
        Series("zxing-cpp", "ms", alone),
        "more",
        Goal("at most", 10.0, "ms"),
    )


async def _trigger(camera: SoftwareCamera[Any]) -> float:
    """Return the milliseconds of a trigger."""
    begin = time.perf_counter()
    result = await camera.trigger(timeout=10.0)
    took = 1e3 * (time.perf_counter() - begin)
    if not result.value.ok:
        raise RuntimeError(f"not ok: {result.value.reason}")
    return took


def _show_when_asked(camera: SoftwareCamera[Any], picture: NDArray[np.uint8]) -> None:
    """Hand the picture over as soon as a run waits for a frame."""
    inspector = camera._device.inspector  # noqa: SLF001 - no public name says when a picture is shown
    begin, loop = inspector.begin, asyncio.get_running_loop()

    def begin_and_show(*arguments: Any) -> None:
        begin(*arguments)
        loop.call_soon(_show, picture)

    inspector.begin = begin_and_show  # type: ignore[assignment,method-assign]


async def _triggers(camera: SoftwareCamera[Any], count: int) -> float:
    return statistics.median([await _trigger(camera) for _ in range(count)])


async def _zxing(picture: NDArray[np.uint8], count: int) -> float:
    """Return the milliseconds that zxing-cpp takes alone."""
    took: list[float] = []
    formats = zxingcpp.barcode_formats_from_str("DataMatrix")
    for _ in range(count):
        _show(picture)  # or the source counts as lost
        await asyncio.sleep(0)
        begin = time.perf_counter()
        found = zxingcpp.read_barcodes(picture, formats=formats)
        took.append(1e3 * (time.perf_counter() - begin))
        if not found:
            raise RuntimeError("zxing-cpp reads nothing")
    return statistics.median(took)


async def _delay(camera: SoftwareCamera[Any] | None, seconds: float) -> float:
    """Return the longest delay of a timer, ms, while triggers of a camera follow each other."""
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()

    async def work() -> None:
        while camera is not None and not ended.is_set():
            await _trigger(camera)

    working = asyncio.create_task(work())
    longest, end = 0.0, loop.time() + seconds
    while (now := loop.time()) < end:
        await asyncio.sleep(0.001)
        longest = max(longest, loop.time() - now - 0.001)
    ended.set()
    await working
    return 1e3 * longest
