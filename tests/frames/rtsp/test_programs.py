"""Other projects' programs as viewers, and the own driver."""

from __future__ import annotations

import asyncio
import shutil
import signal
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

import smartcam.frames
from smartcam.frames import RtspServer
from smartcam.frames._inside import read_stamp

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = [pytest.mark.real_time, pytest.mark.usefixtures("no_leaks")]

USER, SECRET = "me", "a password"
LIMIT = 60.0
"""Seconds after which a test fails."""

SMALL = "synthetic://?size=256x64&fps=60"


@asynccontextmanager
async def served(url: str = SMALL, **options: Any) -> AsyncIterator[RtspServer]:
    async with (
        smartcam.frames.open(url) as source,
        RtspServer({"left": source}, port=0, user=USER, password=SECRET, **options) as server,
    ):
        yield server


def named(server: RtspServer) -> str:
    """Return the URL with the password."""
    secret = SECRET.replace(" ", "%20")
    return server.url("left").replace("rtsp://", f"rtsp://{USER}:{secret}@")


def program(name: str, package: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"needs {name}: apt-get install {package}")
    return found


async def run(*command: str) -> tuple[int, str]:
    """Return the status and the output of a program."""
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    try:
        async with asyncio.timeout(LIMIT):
            output, _ = await process.communicate()
    except BaseException:
        process.kill()
        await process.wait()
        raise
    assert process.returncode is not None
    return process.returncode, output.decode()


@pytest.mark.parametrize("transport", ["tcp", pytest.param("udp", marks=pytest.mark.long)])
async def test_own_driver_reads_the_stamped_numbers(transport: str) -> None:
    async with served() as server:
        url = f"{named(server)}#transport={transport}"
        numbers = []
        async with smartcam.frames.open(url) as source, source.reader() as reader:
            async for frame in reader:
                stamp = read_stamp(frame.grey())
                assert stamp is not None
                numbers.append(stamp[0])
                if len(numbers) == 10:
                    break
        assert numbers == sorted(set(numbers))
        assert server.statistics()["left"].sent >= 10


@pytest.mark.long
@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_ffprobe(transport: str) -> None:
    ffprobe = program("ffprobe", "ffmpeg")
    async with served() as server:
        ended, output = await run(
            *(ffprobe, "-v", "warning", "-rtsp_transport", transport, "-count_frames"),
            *("-show_entries", "stream=codec_name,width,height,nb_read_frames"),
            *("-read_intervals", "%+1", "-of", "default=noprint_wrappers=1", named(server)),
        )
        *quiet, counted = output.splitlines()
        assert (ended, quiet) == (0, ["codec_name=h264", "width=256", "height=64"])
        # of 60 in a second; a slow machine skips some
        assert int(counted.partition("=")[2]) >= 10
        wrong = named(server).replace("a%20password", "wrong")
        ended, output = await run(ffprobe, "-v", "error", "-rtsp_transport", transport, wrong)
        assert ended != 0
        assert "401 Unauthorized" in output


@pytest.mark.long
@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_gstreamer(transport: str) -> None:
    launch = program("gst-launch-1.0", "gstreamer1.0-tools")
    inspect = program("gst-inspect-1.0", "gstreamer1.0-tools")
    for element, package in (("rtspsrc", "good"), ("h264parse", "bad")):
        if (await run(inspect, "--exists", element))[0] != 0:
            pytest.skip(f"needs {element}: apt-get install gstreamer1.0-plugins-{package}")
    if (await run(inspect, "--exists", "avdec_h264"))[0] != 0:
        pytest.skip("needs avdec_h264: apt-get install gstreamer1.0-libav")
    async with served() as server:
        ended, output = await run(
            *(launch, "rtspsrc", f"location={server.url('left')}", f"user-id={USER}"),
            *(f"user-pw={SECRET}", f"protocols={transport}", "!", "rtph264depay", "!"),
            *("h264parse", "!", "avdec_h264", "!", "fakesink", "num-buffers=30"),
        )
        assert ended == 0, output
        assert "Got EOS from element" in output
        assert "ERROR" not in output
        assert server.statistics()["left"].sent >= 30


@pytest.mark.long
async def test_stopped_and_killed_programs_disturb_no_other_viewer() -> None:
    ffmpeg = program("ffmpeg", "ffmpeg")
    url = "synthetic://?size=1280x1024&fps=30"
    async with served(url, crf=1, keyint=2) as server:
        command = (ffmpeg, "-v", "error", "-rtsp_transport", "tcp", "-i", named(server))
        sinks = ("-f", "null", "-")
        players = [await asyncio.create_subprocess_exec(*command, *sinks) for _ in range(3)]
        good, stopped, killed = players
        try:
            await counted(server, "viewers", 3)
            await more(server, 30)
            stopped.send_signal(signal.SIGSTOP)
            killed.kill()
            await killed.wait()
            await counted(server, "viewers", 2)
            await counted(server, "stalled", 1)
            await counted(server, "viewers", 1)
            await more(server, 30)
            assert good.returncode is None
        finally:
            for player in players:
                if player.returncode is None:
                    player.kill()
                await player.wait()
        await counted(server, "viewers", 0)


async def counted(server: RtspServer, what: str, count: int) -> None:
    """Wait until a counter exceeds 0."""
    async with asyncio.timeout(LIMIT):
        while getattr(server.statistics()["left"], what) != count:  # noqa: ASYNC110 - it has no event
            await asyncio.sleep(0.05)


async def more(server: RtspServer, frames: int) -> None:
    """Wait until a number of further frames were sent."""
    until = server.statistics()["left"].sent + frames
    async with asyncio.timeout(LIMIT):
        while server.statistics()["left"].sent < until:  # noqa: ASYNC110 - it has no event
            await asyncio.sleep(0.05)
