"""Measure frames' CPU time against OpenCV's in one run; in the machine with video devices::

    python -m tests.frames.vivid.machine run tests/frames/vivid/measure.py

That counts instructions; with ``clock run`` the figures are real time, which depends on the load.
``... measure.py ours`` runs without OpenCV, ``... measure.py seconds=3`` for 3 s each.
"""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import Callable
from contextlib import AsyncExitStack

import smartcam.frames

SECONDS = 5.0
URL = "v4l2:///dev/video{}?format=YUYV&size=640x480&fps=25"


def cost(frames: int, began: tuple[float, float]) -> tuple[int, float]:
    """Return the number of frames and the percentage of a processor since a start."""
    wall, cpu = time.monotonic() - began[0], time.process_time() - began[1]
    return frames, 100 * cpu / wall


async def ours(cameras: int, seconds: float) -> tuple[int, float]:
    """Read several cameras at the same time, each by one reader."""

    async def read(reader: smartcam.frames.FrameReader, end: float) -> int:
        count = 0
        async for frame in reader:
            count += len(frame.data) == 614400
            if time.monotonic() > end:
                break
        return count

    async with AsyncExitStack() as stack:
        sources = [
            await stack.enter_async_context(smartcam.frames.open(URL.format(one)))
            for one in range(cameras)
        ]
        readers = [one.reader() for one in sources]
        for one in readers:
            await one.newest()
        began = time.monotonic(), time.process_time()
        end = began[0] + seconds
        return cost(sum(await asyncio.gather(*(read(one, end) for one in readers))), began)


async def idle(seconds: float) -> tuple[int, float]:
    """Open four sources, and read none."""
    async with AsyncExitStack() as stack:
        for one in range(4):
            await stack.enter_async_context(smartcam.frames.open(URL.format(one)))
        began = time.monotonic(), time.process_time()
        await asyncio.sleep(seconds)
        return cost(0, began)


def opencv(raw: bool, reuse: bool, seconds: float) -> tuple[int, float]:
    """Read with OpenCV: with its defaults, or the raw bytes."""
    import cv2

    capture = cv2.VideoCapture(0, cv2.CAP_V4L2)
    capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"YUYV"))
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, 640)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, 480)
    capture.set(cv2.CAP_PROP_FPS, 25)
    if raw:
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    _, picture = capture.read()
    began = time.monotonic(), time.process_time()
    count, end = 0, time.monotonic() + seconds
    while time.monotonic() < end:
        read, got = capture.read(picture) if reuse else capture.read()
        count += read and got.size > 0
    found = cost(count, began)
    capture.release()
    return found


def main(arguments: list[str]) -> None:
    """Measure all, twice, and print a table."""
    seconds = next((float(one[8:]) for one in arguments if one.startswith("seconds=")), SECONDS)
    kinds: dict[str, Callable[[], tuple[int, float]]] = {
        "idle, four sources": lambda: asyncio.run(idle(seconds)),
        "one": lambda: asyncio.run(ours(1, seconds)),
        "four": lambda: asyncio.run(ours(4, seconds)),
    }
    if "ours" not in arguments:
        kinds["opencv raw"] = lambda: opencv(True, False, seconds)
        kinds["opencv raw, same array"] = lambda: opencv(True, True, seconds)
        kinds["opencv defaults"] = lambda: opencv(False, False, seconds)
    for turn in range(2):
        for name, measure in kinds.items():
            frames, percent = measure()
            sys.stdout.write(
                f"{turn}  {name:24} {frames / seconds:6.1f} frames/s {percent:6.2f} % CPU\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
