"""Read frames of aravis' fake camera; test_aravis.py runs this in its own network namespace.

``python -m tests.frames.gige.in_namespace FRAMES QUERY [CAMERA'S ARGUMENTS]`` prints JSON.
"""

import asyncio
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import smartcam.frames
from smartcam.exceptions import FrameSourceError
from smartcam.frames import FrameAddress
from smartcam.frames._inside import GigEDriver

PROGRAM = "arv-fake-gv-camera-0.8"


def wrong_in(frame: smartcam.frames.Frame) -> str:
    """Return the fault of a picture of the fake camera: a ramp that moves with its id."""
    number = (frame.sequence - 1) % 65535 + 1
    ramp = np.arange(frame.width)[None, :] + np.arange(frame.height)[:, None]
    wrong = frame.array() != (ramp + number) % 255
    return f"frame {frame.sequence}: {int(wrong.sum())} pixels" if wrong.any() else ""


async def discovered() -> list[str]:
    """Wait for the fake camera, and return the cameras."""
    for _ in range(20):
        if found := await smartcam.frames.discover("gige"):
            return [f"{one.url} {one.name}" for one in found]
    return []


async def triggered(query: str) -> dict[str, object]:
    """Trigger twenty times."""
    await discovered()
    wrong, sequences = [], []
    async with smartcam.frames.open(f"gige://127.0.0.1?{query}", linger=20) as source:
        for _ in range(20):
            frame = await source.trigger()
            sequences.append(frame.sequence)
            if text := wrong_in(frame):
                wrong.append(text)
        started = source.statistics().started
    return {"wrong": wrong, "sequences": sequences, "started": started}


async def read(frames: int, query: str) -> dict[str, object]:
    found = await discovered()
    driver = GigEDriver(FrameAddress.parse(f"gige://127.0.0.1?{query}"))
    source = smartcam.frames.FrameSource(driver)
    wrong, second, last, first = [], "", 0, 0
    async with source:
        try:
            await GigEDriver(FrameAddress.parse(f"gige://127.0.0.1?{query}")).open()
        except FrameSourceError as error:
            second = str(error)
        shown = str(source.format)
        async with source.reader() as reader:
            begun = time.process_time()
            async for frame in reader:
                first, last = first or frame.sequence, frame.sequence
                if text := wrong_in(frame):
                    wrong.append(text)
                if last - first + 1 >= frames:
                    break
            spent = time.process_time() - begun
            account = reader.statistics()
    return {
        "found": found,
        "format": shown,
        "second": second,
        "wrong": wrong[:10],
        "span": last - first + 1,
        "offered": account.offered,
        "delivered": account.delivered,
        "lost": account.lost,
        "counts": repr(driver.counts),
        "cpu": spent,
    }


def main() -> None:
    frames, query, *arguments = sys.argv[1:]
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)  # noqa: S607
    with Path("/dev/null").open("w") as nothing:
        fake = subprocess.Popen(  # noqa: S603
            [PROGRAM, "-i", "127.0.0.1", "-s", "FAKE01", *arguments], stdout=nothing, stderr=nothing
        )
    try:
        made = read(int(frames), query) if int(frames) else triggered(query)
        print(json.dumps(asyncio.run(made)))  # noqa: T201
    finally:
        fake.terminate()
        fake.wait(10)


if __name__ == "__main__":
    main()
