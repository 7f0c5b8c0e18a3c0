"""Frames: what a frame costs on its way to readers, to a JPEG, and what it does to the loop.

Frames are handed on without a copy, so the yardstick of one reader is the same driver whose frames
go straight into an ``asyncio.Queue`` of one. JPEGs are encoded by the codecs' threads, beside
simplejpeg called alone with the same picture and quality, and in a bare thread: what the way there
and back costs, which is what the loop is kept free with. The CPU time is the process', with all of
its threads.

The loop's delay is of the wall clock: the longest time by which a timer of 1 ms came too late while
four drawn cameras of 640x480 give 30 frames a second each, and each frame becomes a JPEG. What else
the machine does is in it; so it has a goal, and no test judges by it.
"""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import simplejpeg  # type: ignore[import-untyped]

from benchmarks.measure import Comparison, Goal, Series, cpu_microseconds, take_turns_awaiting
from smartcam import frames
from smartcam.frames._synthetic import SyntheticDriver, stripes

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

    from benchmarks.measure import Cost, Plan

__all__ = ["run"]

SIZE = (640, 480)
FRAMES = 3_000
PICTURES = 150
SECONDS = 6.0
CAMERAS = 4
RATE = 30.0


class _Driver(SyntheticDriver):
    """Gives the same frame as often as it is told to."""

    def __init__(self) -> None:
        super().__init__(frames.FrameAddress.parse("synthetic://"))
        self.sink: frames.FrameSink | None = None

    async def start(self, sink: frames.FrameSink) -> None:
        self.sink = sink

    async def stop(self) -> None:
        self.sink = None


def _frame() -> frames.Frame:
    noise = np.random.default_rng(1).integers(0, 16, (SIZE[1], SIZE[0]), dtype=np.uint8)
    now = time.monotonic()
    return frames.Frame(
        data=(stripes(*SIZE) + noise).tobytes(),
        format=frames.find_format("Mono8"),
        width=SIZE[0],
        height=SIZE[1],
        stride=SIZE[0],
        captured=now,
        utc=time.time(),
        moment=frames.Moment.EXPOSURE_START,
        sequence=1,
        source="benchmark",
    )


def run(plan: Plan) -> Iterator[Comparison]:
    """Measure readers, JPEGs, and the loop's delay."""
    yield from asyncio.run(_run(plan))


async def _run(plan: Plan) -> list[Comparison]:
    return [one async for one in _compared(plan)]


async def _compared(plan: Plan) -> AsyncIterator[Comparison]:
    count = plan.operations(FRAMES, least=10)
    found = await take_turns_awaiting(
        plan,
        {
            "one reader": lambda: _read(1, count),
            "four readers": lambda: _read(4, count),
            "a queue": lambda: _queued(count),
        },
    )
    bare = found["a queue"]
    for name in ("one reader", "four readers"):
        yield Comparison("frames", f"a frame to {name}, over a bare queue", found[name], bare)
    pictures = plan.operations(PICTURES, least=3)
    found = await take_turns_awaiting(
        plan,
        {
            "codecs": lambda: _jpegs(pictures),
            "simplejpeg": lambda: _alone(pictures),
            "in a thread": lambda: _in_a_thread(pictures),
        },
    )
    yield Comparison(
        "frames",
        "JPEG q85 of 640x480 by the codecs' threads, over simplejpeg alone",
        found["codecs"],
        found["simplejpeg"],
        "ratio",
        Goal("at most", 1.1),
    )
    yield Comparison(
        "frames",
        "the same over simplejpeg in a bare thread of the loop's",
        found["codecs"],
        found["in a thread"],
    )
    seconds = 0.2 if plan.quick else SECONDS
    delays, idle = [], []
    for _ in range(plan.rounds):
        delays.append(await _delay(seconds))
        idle.append(await _idle(seconds))
    yield Comparison(
        "frames",
        "longest delay of the loop with 4 x 30 frames/s to JPEG",
        Series("smartcam", "ms", delays),
        None,
        "alone",
        Goal("at most", 5.0, "ms"),
        "wall clock: what else the machine does is in it",
    )
    yield Comparison(
        "frames",
        "four open sources that nobody reads",
        Series("smartcam", "percent", idle),
        None,
        "alone",
        Goal("at most", 0.05, "percent"),
    )


async def _read(readers: int, count: int) -> Cost:
    driver, frame = _Driver(), _frame()
    async with frames.FrameSource(driver) as source:
        reading = [source.reader() for _ in range(readers)]
        while driver.sink is None:  # noqa: ASYNC110 - a few turns of the loop
            await asyncio.sleep(0)
        begin = time.process_time()
        for _ in range(count):
            driver.sink.frame(frame)
            for reader in reading:
                await anext(reader)
        return cpu_microseconds(begin, count)


async def _queued(count: int) -> Cost:
    queue: asyncio.Queue[frames.Frame] = asyncio.Queue(1)
    frame = _frame()
    begin = time.process_time()
    for _ in range(count):
        queue.put_nowait(frame)
        await queue.get()
    return cpu_microseconds(begin, count)


async def _jpegs(count: int) -> Cost:
    frame = _frame()
    async with frames.Codecs(threads=1) as codecs:
        await codecs.jpeg(frame, quality=85)
        begin = time.process_time()
        for _ in range(count):
            await codecs.jpeg(frame, quality=85)
        return cpu_microseconds(begin, count)


def _bare() -> Callable[[], bytes]:
    """Return what makes the same JPEG without us."""
    picture = np.ascontiguousarray(_frame().array())[..., None]
    return partial(simplejpeg.encode_jpeg, picture, quality=85, colorspace="GRAY")


async def _in_a_thread(count: int) -> Cost:
    encode = _bare()
    with ThreadPoolExecutor(1) as pool:
        loop = asyncio.get_running_loop()
        await loop.run_in_executor(pool, encode)
        begin = time.process_time()
        for _ in range(count):
            await loop.run_in_executor(pool, encode)
        return cpu_microseconds(begin, count)


async def _alone(count: int) -> Cost:
    encode = _bare()
    begin = time.process_time()
    for _ in range(count):
        encode()
    return cpu_microseconds(begin, count)


async def _delay(seconds: float) -> float:
    """Return the longest delay of a timer, ms."""
    url = f"synthetic://?size={SIZE[0]}x{SIZE[1]}&fps={RATE:g}"
    sources = {f"camera{number}": frames.open(url) for number in range(CAMERAS)}
    longest = 0.0
    loop = asyncio.get_running_loop()
    async with frames.FrameGroup(sources), frames.Codecs(threads=2) as codecs:
        working = [asyncio.create_task(_encode(source, codecs)) for source in sources.values()]
        end = loop.time() + seconds
        while (now := loop.time()) < end:
            await asyncio.sleep(0.001)
            longest = max(longest, loop.time() - now - 0.001)
        for one in working:
            one.cancel()
        await asyncio.wait(working)
    return 1e3 * longest


async def _encode(source: frames.FrameSource, codecs: frames.Codecs) -> None:
    async for frame in source:
        await codecs.jpeg(frame, quality=85)


async def _idle(seconds: float) -> float:
    """Return the part of a core that open sources take, percent."""
    sources = [frames.open("synthetic://") for _ in range(CAMERAS)]
    for source in sources:
        await source.__aenter__()
    begin = time.process_time()
    await asyncio.sleep(seconds)
    used = time.process_time() - begin
    for source in sources:
        await source.close()
    return 100 * used / seconds
