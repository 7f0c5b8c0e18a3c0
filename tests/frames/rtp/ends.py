"""Sender and receiver for a link between two namespaces, each a process.

``python -m tests.frames.rtp.ends send HOST:PORT SECONDS CRF`` and ``receive URL SECONDS``, which
prints a line of JSON for each picture: number, nanoseconds of its stamp, of its arrival; then what
it counted.
"""

import asyncio
import dataclasses
import json
import sys
import time

from smartcam import frames
from smartcam.exceptions import FrameSourceError
from smartcam.frames._inside import read_stamp
from tests.frames.inside import RtpDriver


def say(what: object) -> None:
    sys.stdout.write(json.dumps(what) + "\n")


async def send(to: str, seconds: float, crf: float) -> None:
    async with (
        frames.open("synthetic://?size=640x480&fps=30") as source,
        frames.RtpSender(source, to, crf=crf) as sender,
    ):
        await asyncio.sleep(seconds)
        say(dataclasses.asdict(sender.statistics()))


async def receive(url: str, seconds: float) -> None:
    async with frames.open(url, timeout=seconds) as source, source.reader() as reader:
        driver = source.driver
        assert isinstance(driver, RtpDriver)
        counted = driver.statistics()
        try:
            async with asyncio.timeout(seconds):
                async for frame in reader:
                    stamp = read_stamp(frame.grey())
                    say([*(stamp or (None, None)), time.monotonic_ns()])
                    counted = driver.statistics()
        except (TimeoutError, FrameSourceError):
            pass
        say(dataclasses.asdict(counted))


if __name__ == "__main__":
    if sys.argv[1] == "send":
        asyncio.run(send(sys.argv[2], float(sys.argv[3]), float(sys.argv[4])))
    else:
        asyncio.run(receive(sys.argv[2], float(sys.argv[3])))
