"""H.264 over a thin link that loses packets: 20 Mbit/s, 5 %, and an outage.

With ``-s``, the figures are printed.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from smartcam import frames
from tests.frames.rtp.link import THERE, Link, thin_link
from tests.frames.rtp.ways import HOST, two_ports

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [pytest.mark.long, pytest.mark.real_time]

ROOT = Path(__file__).parents[3]
LOSSY, OUTAGE, AFTER = 5.0, 1.0, 2.0
"""Seconds with a loss of 5 %, without any packet, and without loss."""


@pytest.fixture
def link() -> Iterator[Link]:
    with thin_link("20mbit") as made:
        yield made


def start(link: Link, end: int, *arguments: str) -> subprocess.Popen[str]:
    command = (*link.within(end), sys.executable, "-m", "tests.frames.rtp.ends", *arguments)
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)  # noqa: S603


@pytest.mark.parametrize(
    ("crf", "repair"),
    [
        pytest.param(4, 0.1, marks=pytest.mark.widest),
        (23, 0.1),
        pytest.param(23, 0, marks=pytest.mark.widest),
    ],
)
def test_pictures_over_a_link_that_loses_packets(link: Link, crf: int, repair: float) -> None:
    link.loss = 0.05
    seconds = LOSSY + OUTAGE + AFTER
    url = f"rtp://{THERE}:5004?size=640x480&repair={repair}"
    with contextlib.ExitStack() as stack:
        processes = [
            stack.enter_context(
                start(link, 0, "send", f"{THERE}:5004", f"{seconds + 4}", f"{crf}")
            ),
            stack.enter_context(start(link, 1, "receive", url, f"{seconds}")),
        ]
        for one in processes:
            stack.callback(one.kill)
        time.sleep(LOSSY)
        link.loss, cut = 1.0, time.monotonic_ns()
        time.sleep(OUTAGE)
        link.loss, ended = 0.0, time.monotonic_ns()
        sent, received = (one.communicate(timeout=60)[0].splitlines() for one in processes)
    *pictures, counted = map(json.loads, received)
    lossy = [one for one in pictures if one[2] < cut]
    after = [one for one in pictures if one[2] >= ended]
    ages = sorted((arrived - stamped) / 1e6 for _, stamped, arrived in pictures)
    share = len(lossy) / (lossy[-1][0] - lossy[0][0] + 1)
    sys.stdout.write(
        f"\ncrf {crf}, repair {repair:g} s: {share:.1%} of the pictures at 5 % loss; stamp to stamp"
        f" p50 {ages[len(ages) // 2]:.1f} ms, p99 {ages[int(len(ages) * 0.99)]:.1f} ms; after an "
        f"outage the first one came {(after[0][2] - ended) / 1e6:.0f} ms after its end\n"
        f"{counted}\n{json.loads(sent[-1])}\n"
    )
    numbers = [one[0] for one in pictures]
    assert None not in numbers
    assert numbers == sorted(set(numbers))
    assert share > (0.9 if repair else 0.3)
    assert ages[int(len(ages) * 0.99)] < 1000  # the encoder's target is 150
    assert after[0][2] - ended < 5e9  # for 1 s
    assert (counted["repaired"] > 0) == bool(repair)
    assert counted["lost"] > 0


CAPS = "video/x-raw,format=I420,width=320,height=240,framerate=30/1"
ENCODED = "x264enc tune=zerolatency speed-preset=ultrafast key-int-max=15 intra-refresh={refresh}"


@pytest.mark.parametrize("refresh", ["true", "false"])
async def test_gstreamer_is_received(refresh: str) -> None:
    port = two_ports()
    await _gst_or_skip("x264enc", "rtph264pay", "rtpbin")
    pipeline = (
        f"rtpbin name=b videotestsrc is-live=true ! {CAPS} ! {ENCODED.format(refresh=refresh)} ! "
        f"rtph264pay config-interval=-1 pt=96 ! b.send_rtp_sink_0 "
        f"b.send_rtp_src_0 ! udpsink host={HOST} port={port} "
        f"b.send_rtcp_src_0 ! udpsink host={HOST} port={port + 1} sync=false async=false"
    )
    clocks: list[Any] = []
    async with (
        _running("gst-launch-1.0", "-q", *pipeline.split()),
        frames.open(f"rtp://{HOST}:{port}?timeout=30", timeout=30) as source,
        asyncio.timeout(60),
    ):
        assert str(source.format) == "I420 320x240"
        async for frame in source:
            clocks.append(frame.device_time)
            assert (frame.lost, frame.grey().shape) == (0, (240, 320))
            if frame.device_time is not None and len(clocks) > 60:
                break
    assert abs(clocks[-1] - time.time()) < 60


async def test_gstreamer_plays_ours() -> None:
    port = two_ports()
    await _gst_or_skip("avdec_h264", "rtph264depay")
    pipeline = (
        f"udpsrc port={port} caps=application/x-rtp,media=video,clock-rate=90000,"
        "encoding-name=H264,payload=96 ! rtph264depay ! h264parse ! avdec_h264 ! "
        "identity eos-after=30 ! fakesink sync=false"
    )
    async with (
        frames.open("synthetic://?size=320x64&fps=60") as source,
        frames.RtpSender(source, f"{HOST}:{port}", keyint=10),
        _running("gst-launch-1.0", "-v", *pipeline.split()) as player,
    ):
        async with asyncio.timeout(60):
            out, _ = await player.communicate()
    assert b"width=(int)320, height=(int)64" in out
    assert player.returncode == 0


async def _gst_or_skip(*elements: str) -> None:
    wanted = (
        "apt-get install gstreamer1.0-tools gstreamer1.0-plugins-{good,bad,ugly} gstreamer1.0-libav"
    )
    if shutil.which("gst-inspect-1.0") is None:
        pytest.skip(f"there is no GStreamer: {wanted}")
    for element in elements:
        async with _running("gst-inspect-1.0", "--exists", element) as asked:
            if await asked.wait():
                pytest.skip(f"GStreamer has no {element}: {wanted}")


@contextlib.asynccontextmanager
async def _running(*command: str) -> Any:
    process = await asyncio.create_subprocess_exec(
        *command, stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
