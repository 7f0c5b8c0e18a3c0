"""Pictures on their way: from the stamp drawn into one to the stamp read at the far end.

640 x 480 grey at 30 a second over loopback, the ways of the papers that this follows: raw, as JPEG
and as H.264, as a stream and one on request, beside GStreamer (with x264's defaults, and tuned, by
appsrc and appsink, without a conversion) and rospy where Debian has installed them. It is the
software's latency, of the wall clock; neither exposure nor a display is in it. The stream of frames
itself, read in this process, is the first line: what the others have above it is the way. CPU time
is that of both ends with the drawing.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import socket
import statistics
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import smartcam
import smartcam.fleet
from benchmarks.measure import Comparison, Goal, Series
from benchmarks.peers import peer
from benchmarks.peers.gstreamer_pictures import has_gstreamer
from benchmarks.peers.rospy_pictures import PYTHON, ROS, can
from smartcam import frames
from smartcam.fleet import FleetFile
from smartcam.frames._synthetic import read_stamp

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator

    from benchmarks.measure import Plan

__all__ = ["run"]

SIZE = (640, 480)
RATE = 30
SECONDS = 4.0
URL = f"synthetic://?size={SIZE[0]}x{SIZE[1]}&fps={RATE}"
OURS = "RTP, H.264"
TUNED_PEER = "GStreamer, RTP, x264enc tuned"
"""The two ways whose CPU is compared."""

ASKED = 10.0
"""Requests a second."""

LIMIT = 30.0
"""Seconds until one that gives no picture is an error."""


@dataclass(frozen=True, slots=True)
class Way:
    """How pictures came.

    Attributes:
        latencies: milliseconds from stamp to stamp.
        sizes: bytes of each on the way; empty where nobody says.
        cpu: percent of a core.
    """

    latencies: list[float]
    sizes: list[int]
    cpu: float

    @property
    def median(self) -> float:
        """The latency in the middle."""
        return statistics.median(self.latencies)

    def __str__(self) -> str:
        worst = float(np.quantile(self.latencies, 0.99))
        size = f", {statistics.mean(self.sizes) / 1e3:.1f} kB each" if self.sizes else ""
        return f"p99 {worst:.1f} ms, CPU {self.cpu:.1f} %{size}"


def run(plan: Plan) -> Iterator[Comparison]:
    """Measure each way, one after the other, in each round."""
    seconds = SECONDS * max(plan.scale, 0.1)
    ways: dict[str, Callable[[float], Way]] = {
        "in this process": _awaited(_local),
        "bus, raw": _awaited(lambda one: _bus(one, encoding="raw")),
        "bus, JPEG q15": _awaited(lambda one: _bus(one, encoding="jpeg", quality=15)),
        "one on request, JPEG q15": _awaited(_asked),
        OURS: _alone,
    }
    if has_gstreamer():
        ways["GStreamer, RTP, x264enc as it comes"] = lambda one: _gstreamer(one, "")
        ways[TUNED_PEER] = lambda one: _gstreamer(one, TUNED)
    if can(ROS):
        ways["rospy, raw"] = lambda one: _rospy(one, "raw")
    if can(f"{ROS}, cv2"):
        ways["rospy, JPEG q15"] = lambda one: _rospy(one, "jpeg")
    found: dict[str, list[Way]] = {name: [] for name in ways}
    for number in range(plan.rounds):
        for name, way in list(ways.items())[:: -1 if number % 2 else 1]:
            found[name].append(way(seconds))
    for name, rounds in found.items():
        series = Series("latency", "ms", [one.median for one in rounds])
        yield Comparison("transports", name, series, how="alone", note=str(rounds[-1]))
    if TUNED_PEER in found:
        ours, theirs = (
            Series(name, "% of a core", [one.cpu for one in found[name]])
            for name in (OURS, TUNED_PEER)
        )
        note = "of both ends, in turn"
        yield Comparison(
            "transports", "CPU of RTP", ours, theirs, goal=Goal("at most", 1.0), note=note
        )


def _awaited(way: Callable[[float], Awaitable[Way]]) -> Callable[[float], Way]:
    async def limited(seconds: float) -> Way:
        async with asyncio.timeout(seconds + LIMIT):
            return await way(seconds)

    return lambda seconds: asyncio.run(limited(seconds))


# ---------------------------------------------------------------------- ours


async def _local(seconds: float) -> Way:
    async with frames.open(URL) as source, source.reader(timeout=LIMIT) as reader:
        return await _read(reader, seconds)


async def _bus(seconds: float, **form: Any) -> Way:
    async with _shared() as camera, camera.frames(**form) as reader:
        return await _read(reader, seconds)


async def _asked(seconds: float) -> Way:
    """Ask for the newest frame; from the request to its pixels, which may be drawn before it."""
    async with _shared() as camera, frames.Codecs(threads=1) as codecs:
        begin, cpu, latencies, sizes = time.monotonic(), _cpu(), [], []
        await camera.newest_frame(encoding="jpeg", quality=15)
        while time.monotonic() < begin + seconds:
            await asyncio.sleep(1 / ASKED)
            asked = time.monotonic()
            frame = await camera.newest_frame(encoding="jpeg", quality=15)
            await codecs.decode(frame)
            latencies.append((time.monotonic() - asked) * 1e3)
            sizes.append(len(frame.data))
        return Way(latencies, sizes, _percent(cpu, begin))


async def _rtp(seconds: float) -> Way:
    port = _free_port()
    url = f"rtp://127.0.0.1:{port}?size={SIZE[0]}x{SIZE[1]}"
    async with (
        frames.open(URL) as source,
        frames.open(url) as far,
        far.reader(timeout=LIMIT) as reader,
        frames.RtpSender(source, f"127.0.0.1:{port}") as sender,
    ):
        way = await _read(reader, seconds, sized=False)
        sent = sender.statistics()
        return Way(way.latencies, [sent.bytes // max(1, sent.frames)], way.cpu)


def _alone(seconds: float) -> Way:
    """Send and receive by RTP in a process of its own, as the yardstick does."""
    command = [sys.executable, "-m", "benchmarks.transports", str(seconds)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=seconds + 2 * LIMIT)
    if done.returncode:
        raise RuntimeError(f"RTP: {done.stderr[-2000:]}")
    return Way(**json.loads(done.stdout))


@contextlib.asynccontextmanager
async def _shared() -> AsyncIterator[Any]:
    """Share a camera that has these frames over Zenoh, and connect to it."""
    with peer("trigger", "together") as port:
        file = FleetFile.model_validate(
            {
                "listen": "tcp/127.0.0.1:0",
                "cameras": {
                    "one": {"url": f"bvs://127.0.0.1:{port}?dialect=handbook", "frames": URL}
                },
            }
        )
        async with smartcam.fleet.serve(file) as server:
            await server.wait_first_attempts()
            url = f"fleet://127.0.0.1:{server.address.port}/one"
            async with smartcam.connect(url) as camera:
                yield camera


async def _read(reader: frames.FrameReader, seconds: float, *, sized: bool = True) -> Way:
    """Read the brightness; ``sized`` counts the bytes of each frame, as they came, too."""
    latencies: list[float] = []
    sizes: list[int] = []
    async with frames.Codecs(threads=1) as codecs:
        await anext(reader)
        begin, cpu = time.monotonic(), _cpu()
        async for frame in reader:
            if sized:
                sizes.append(len(frame.data))
            shown = await codecs.decode(frame) if frame.format.compressed else frame
            _note(latencies, shown.grey())
            if latencies and time.monotonic() > begin + seconds:
                break
        return Way(latencies, sizes, _percent(cpu, begin))


def _note(latencies: list[float], picture: Any) -> None:
    now = time.monotonic_ns()
    stamp = read_stamp(picture)
    if stamp is not None:
        latencies.append((now - stamp[1]) / 1e6)


# ---------------------------------------------------------------------- others


TUNED = (
    "tune=zerolatency speed-preset=ultrafast key-int-max=30 intra-refresh=true pass=qual "
    "quantizer=23 threads=1"
)
"""Options of x264enc that make the stream that smartcam makes: the same quality and bytes."""


def _gstreamer(seconds: float, options: str) -> Way:
    """Have a process put pictures into a pipeline by appsrc, and take them out by appsink."""
    command = [PYTHON, "-m", "benchmarks.peers.gstreamer_pictures", options, str(seconds)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=seconds + 2 * LIMIT)
    if done.returncode:
        raise RuntimeError(f"GStreamer: {done.stderr[-2000:]}")
    found = json.loads(done.stdout.splitlines()[-1])
    cpu = 100 * found["cpu"] / found["seconds"]
    return Way(found["latencies"], [round(found["size"])], cpu)


def _rospy(seconds: float, how: str) -> Way:
    """Have rospy publish and subscribe, each in a process of its own."""
    command = [PYTHON, "-m", "benchmarks.peers.rospy_pictures", how, str(seconds)]
    cpu, begin = _cpu(), time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, timeout=seconds + LIMIT)
    if done.returncode:
        raise RuntimeError(f"rospy: {done.stderr[-2000:]}")
    last = done.stdout.splitlines()[-2:]
    latencies, sizes = ([float(one) for one in line.split()] for line in last)
    return Way(latencies, [round(one) for one in sizes], _percent(cpu, begin))


# ---------------------------------------------------------------------- counting


def _cpu() -> float:
    """Return the CPU time of this process and of its children, those that run by ``/proc``."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime + sum(_running())


def _running() -> Iterator[float]:
    """Yield the CPU time of each child that runs."""
    ticks = os.sysconf("SC_CLK_TCK")
    with contextlib.suppress(OSError):
        for child in Path(f"/proc/self/task/{os.getpid()}/children").read_text("ascii").split():
            words = Path(f"/proc/{child}/stat").read_text("ascii").rpartition(")")[2].split()
            yield (int(words[11]) + int(words[12])) / ticks


def _percent(cpu: float, begin: float) -> float:
    return 100 * (_cpu() - cpu) / (time.monotonic() - begin)


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port - port % 2


if __name__ == "__main__":
    print(json.dumps(asdict(asyncio.run(_rtp(float(sys.argv[1]))))))
