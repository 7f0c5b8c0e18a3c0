"""``python -m benchmarks.thin_links``: frames over links that are too thin for them, beside a FIFO.

Two network namespaces with two cables between them, each shaped by ``tc ... tbf``: the fleet's bus
has one, plain TCP the other, at the same time. Latency is from the stamp in the picture to its
reading; both sides have one clock. Wants root, ``ip`` and ``tc``.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import smartcam
import smartcam.frames
from smartcam.fleet import FleetFrame
from smartcam.frames._synthetic import read_stamp

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Self

    from smartcam.frames import FrameReader

__all__ = ["ThinLinks", "fifo", "main", "one_on_request", "plain", "served", "streamed"]

HERE = Path(__file__).resolve().parent.parent
BUS, PLAIN = 0, 1
PORT = 7447  # of a namespace of its own
RAW = "synthetic://?size=1280x1024&fps=30"
SMALL = "synthetic://?size=640x480&fps=30"
PATIENCE = 60.0
FLEET = """\
listen: tcp/10.78.0.1:{port}
access: anyone-may-command
cameras:
  large: {{emulated: {{}}, frames: "{raw}"}}
  small: {{emulated: {{}}, frames: {{url: "{small}", linger: 60}}}}
"""


# ---------------------------------------------------------------------- the links


class ThinLinks:
    """Two namespaces, ``a`` and ``b``, with cables between them; a context manager.

    Raises:
        OSError, subprocess.CalledProcessError: none can be made here.
    """

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()
        self._spaces = [f"thin{os.getpid()}-{side}" for side in "ab"]

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            for space in self._spaces:
                _ip("netns", "add", space)
                stack.callback(_ip, "netns", "delete", space)
                _ip("-n", space, "link", "set", "lo", "up")
            for cable in (BUS, PLAIN):
                a, b = self._spaces
                ends = f"cable{cable}"
                _ip("link", "add", ends, "netns", a, "type", "veth", "peer", ends, "netns", b)
                for side, space in enumerate(self._spaces, start=1):
                    _ip("-n", space, "address", "add", f"10.{78 + cable}.0.{side}/24", "dev", ends)
                    _ip("-n", space, "link", "set", ends, "up")
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def shape(self, mbit: float) -> None:
        """Let this much through each way, in megabits a second."""
        for space in self._spaces:
            for cable in (BUS, PLAIN):
                shape = ("tbf", "rate", f"{mbit:g}mbit", "burst", "32kb", "latency", "50ms")
                _run("tc", "-n", space, "qdisc", "replace", "dev", f"cable{cable}", "root", *shape)

    @contextlib.contextmanager
    def running(self, side: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
        """Have Python run on a side, with a pipe of what it prints; it ends with the block."""
        space = self._spaces["ab".index(side)]
        process = subprocess.Popen(
            ["ip", "netns", "exec", space, sys.executable, *arguments],  # noqa: S607
            cwd=HERE,
            env={**os.environ, "PYTHONPATH": str(HERE)},
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            yield process
        finally:
            process.terminate()
            process.communicate(timeout=PATIENCE)

    def said(self, side: str, *arguments: str) -> Any:
        """Return the JSON that Python prints on a side."""
        with self.running(side, *arguments) as process:
            out, _ = process.communicate(timeout=PATIENCE)
        return json.loads(out)


def _ip(*arguments: str) -> None:
    _run("ip", *arguments)


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE)


@contextlib.contextmanager
def served(links: ThinLinks) -> Iterator[None]:
    """Have an agent serve two cameras, ``large`` and ``small``, at ``a``."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "fleet.yaml")
        file.write_text(FLEET.format(port=PORT, raw=RAW, small=SMALL), encoding="utf-8")
        with links.running("a", "-m", "smartcam", "serve", str(file)) as agent:
            assert agent.stdout is not None
            agent.stdout.readline()
            agent.stdout.readline()
            yield


def streamed(links: ThinLinks, camera: str, seconds: float, **options: Any) -> dict[str, Any]:
    """Return what came of a stream over the bus: see :func:`_look`."""
    found: dict[str, Any] = links.said("b", *_me("look", camera, seconds, json.dumps(options)))
    return found


def one_on_request(links: ThinLinks, count: int) -> dict[str, Any]:
    """Return how long one frame on request takes, and its parts: see :func:`_request`."""
    found: dict[str, Any] = links.said("b", *_me("request", count))
    return found


@contextlib.contextmanager
def plain(links: ThinLinks) -> Iterator[None]:
    """Have a plain sender listen at ``a``, for :func:`_fifo` and :func:`_request`."""
    with links.running("a", *_me("send")) as sender:
        assert sender.stdout is not None
        sender.stdout.readline()
        yield


@contextlib.contextmanager
def fifo(links: ThinLinks, seconds: float) -> Iterator[subprocess.Popen[str]]:
    """Have a FIFO be filled at the same time; it prints what came of it: see :func:`_fifo`."""
    with links.running("b", *_me("fifo", seconds)) as process:
        yield process


def _me(*arguments: object) -> tuple[str, ...]:
    return ("-m", "benchmarks.thin_links", *map(str, arguments))


# ---------------------------------------------------------------------- the bus


async def _look(camera: str, seconds: str, options: str) -> dict[str, Any]:
    """Read a stream, and return what came in its last half.

    Returns:
        Seconds from the stamp to its reading: the median and the 99th percentile; bits a second,
        frames a second, and what the last frame says of what holds its rate.
    """
    said: Mapping[str, Any] = json.loads(options)
    url = f"fleet://10.78.0.1:{PORT}/{camera}"
    async with (
        smartcam.connect(url, connect_timeout=PATIENCE) as connected,
        connected.frames(timeout=PATIENCE, **said) as frames,
    ):
        return await _came(frames, float(seconds))


async def _came(frames: FrameReader, seconds: float) -> dict[str, Any]:
    latencies: list[float] = []
    size, begun, last = 0, time.monotonic(), None
    until = half = begun + seconds
    half -= seconds / 2
    async for frame in frames:
        now = time.monotonic()
        if now > until:
            break
        if now < half:
            continue
        stamp = read_stamp(frame.grey())
        if stamp is None or stamp[0] != frame.sequence:
            raise ValueError(f"frame {frame.sequence} has another's stamp: {stamp}")
        latencies.append(time.monotonic() - stamp[1] / 1e9)
        size += len(frame.data) if last is not None else 0
        last = frame
    latencies.sort()
    rate = getattr(last, "rate", None)
    return {
        "p50": statistics.median(latencies),
        "p99": latencies[int(0.99 * len(latencies))],
        "bitrate": 8 * size / (seconds / 2),
        "fps": len(latencies) / (seconds / 2),
        "quality": None if rate is None else rate.quality,
        "why": None if rate is None else rate.why,
    }


async def _request(count: str) -> dict[str, Any]:
    """Ask for single frames, and for as many bytes by plain TCP, by turns.

    Returns:
        Medians of seconds: of a frame on request, of its encoding, of a question and an answer of
        as many bytes by plain TCP; ``over``: of the first less the two others.
    """
    took: list[float] = []
    encoding: list[float] = []
    link: list[float] = []
    size = 0
    url = f"fleet://10.78.0.1:{PORT}/small"
    reader, writer = await asyncio.open_connection("10.79.0.1", PORT)
    async with smartcam.connect(url, connect_timeout=PATIENCE) as camera:
        for _ in range(int(count)):
            await asyncio.sleep(0.043)  # not in step with the camera
            begun = time.perf_counter()
            frame = await camera.newest_frame(encoding="jpeg", quality=15)
            took.append(time.perf_counter() - begun)
            assert isinstance(frame, FleetFrame)
            encoding.append(frame.encoding_time)
            size = len(frame.data)
            begun = time.perf_counter()
            writer.write(struct.pack("<I", size))
            await reader.readexactly(size)
            link.append(time.perf_counter() - begun)
    writer.close()
    over = [one - two - three for one, two, three in zip(took, encoding, link, strict=True)]
    found = {"request": took, "encoding": encoding, "link": link, "over": over}
    return {"size": size, **{name: statistics.median(one[2:]) for name, one in found.items()}}


# ---------------------------------------------------------------------- plain TCP


async def _send() -> None:
    """Send what is asked for: so many bytes; 0: one frame; 2^32 - 1: all frames, in a queue."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                (wanted,) = struct.unpack("<I", await reader.readexactly(4))
                if 0 < wanted < (1 << 32) - 1:
                    writer.write(bytes(wanted))
                    continue
                async with smartcam.frames.open(RAW) as source, source.reader() as frames:
                    async for frame in frames:
                        writer.write(bytes(frame.data))  # every frame, however many wait
                        if not wanted or writer.is_closing():
                            break

    server = await asyncio.start_server(serve, "10.79.0.1", PORT)
    print("ready", flush=True)
    async with server:
        await server.serve_forever()


async def _fifo(seconds: str) -> dict[str, Any]:
    """Return what one frame takes that is alone on the link, and those of a FIFO: medians."""
    reader, writer = await asyncio.open_connection("10.79.0.1", PORT, limit=1 << 22)
    size = 1280 * 1024
    alone: list[float] = []
    for _ in range(7):
        writer.write(struct.pack("<I", 0))
        alone.append(await _read(reader, size))
        await asyncio.sleep(0.05)
    queued: list[float] = []
    writer.write(struct.pack("<I", (1 << 32) - 1))
    until = time.monotonic() + float(seconds)
    while time.monotonic() < until:
        queued.append(await _read(reader, size))
    writer.close()
    return {"alone": statistics.median(alone), "p50": statistics.median(queued)}


async def _read(reader: asyncio.StreamReader, size: int) -> float:
    import numpy as np

    data = await reader.readexactly(size)
    stamp = read_stamp(np.frombuffer(data, np.uint8).reshape(1024, 1280))
    if stamp is None:
        raise ValueError("a frame without a stamp")
    return time.monotonic() - stamp[1] / 1e9


# ---------------------------------------------------------------------- the table


def main(arguments: list[str] | None = None) -> int:
    """Print the figures; return 1 where a goal is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.thin_links", description=__doc__)
    parser.add_argument("--seconds", type=float, default=12.0, help="of each stream")
    seconds = parser.parse_args(arguments).seconds
    met = []
    with ThinLinks() as links, served(links), plain(links):
        links.shape(100)
        with fifo(links, seconds) as queue:
            raw = streamed(links, "large", seconds)
            out, _ = queue.communicate(timeout=PATIENCE)
        beside = json.loads(out)
        met += [raw["p50"] <= 1.1 * beside["alone"], beside["p50"] >= 20 * raw["p50"]]
        print("100 Mbit/s, 1280x1024 Mono8 at 30/s: 315 Mbit/s offered")
        _row("one frame alone, TCP", beside["alone"])
        _row("stream over the bus", raw["p50"], f"{raw['p50'] / beside['alone']:.2f}x of alone")
        _row("FIFO over TCP", beside["p50"], f"{beside['p50'] / raw['p50']:.0f}x of the bus")
        request = one_on_request(links, 60)
        met.append(request["over"] <= 2e-3)
        print(f"100 Mbit/s, one frame on request, 640x480 q15, {request['size']} bytes")
        for name in ("request", "encoding", "link", "over"):
            _row(name, request[name])
        for mbit, options in (
            (20, {"encoding": "jpeg", "quality": 85}),
            (20, {"encoding": "jpeg", "bitrate": 4e6}),
            (20, {"encoding": "h264", "bitrate": 2e6}),
            (4, {"encoding": "jpeg", "latency": 0.05}),
            (2, {"encoding": "jpeg", "latency": 0.05}),
            (1, {"encoding": "jpeg", "bitrate": 5e5}),
        ):
            links.shape(mbit)
            found = streamed(links, "small", seconds, **options)
            held = f"quality {found['quality']}, {found['why']}" if found["why"] else ""
            if options["encoding"] != "h264":  # what comes out of its decoder is not what crossed
                held = f"{found['bitrate'] / 1e6:.2f} Mbit/s, {held}"
            print(f"{mbit} Mbit/s, 640x480, {options}")
            _row("stream over the bus", found["p50"], f"{found['fps']:.1f}/s, {held}")
    print("goals:", "met" if all(met) else f"missed: {met}")
    return 0 if all(met) else 1


def _row(name: str, seconds: float, more: str = "") -> None:
    print(f"  {name:24}{1e3 * seconds:9.2f} ms  {more}")


PEERS = {"look": _look, "request": _request, "send": _send, "fifo": _fifo}

if __name__ == "__main__":
    if len(sys.argv) > 1 and sys.argv[1] in PEERS:
        made: Any = PEERS[sys.argv[1]]
        said = asyncio.run(made(*sys.argv[2:]))
        if said is not None:
            print(json.dumps(said))
    else:
        sys.exit(main())
