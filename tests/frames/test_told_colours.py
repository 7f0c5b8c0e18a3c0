"""A red picture is red on each path that carries its matrix and range. Y, U and V follow from the
recommendations' formulas, and FFmpeg's encoders write matrix and range into the stream.
tests/frames/v4l2 has the same for devices.
"""

from __future__ import annotations

import asyncio
import fractions
import itertools
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import numpy as np
import pytest

from smartcam import frames
from smartcam._extras import load
from smartcam.frames import Codecs, RtspServer
from smartcam.frames._inside import copy_with
from smartcam.recording import Recorder
from tests.frames.drivers import ShowingDriver
from tests.frames.pictures import HEIGHT, WIDTH, frame_of
from tests.frames.rtsp_client.camera import COUNT, SDP, Camera, camera_on, h265_packets, numbered

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from smartcam.frames import Frame, FrameSink

pytest.importorskip("av")
pytestmark = pytest.mark.real_time

LIMIT = 30.0
"""Seconds after which a test fails."""

WEIGHTS = {"601": (0.299, 0.114), "709": (0.2126, 0.0722), "2020": (0.2627, 0.0593)}
"""Shares of red and blue in Y, from the recommendations of ITU-R."""

X264_NAMES = {"601": "smpte170m", "709": "bt709", "2020": "bt2020nc"}
FORMATS = {
    ("601", False): "I420",
    ("601", True): "I420_full",
    ("709", False): "I420_709",
    ("709", True): "I420_709_full",
    ("2020", False): "I420_2020",
    ("2020", True): "I420_2020_full",
}
TOLD = pytest.mark.parametrize(("matrix", "full"), FORMATS)


def red_of(matrix: str, *, full: bool) -> tuple[int, int, int]:
    """Return Y, U and V of red."""
    red, blue = WEIGHTS[matrix]
    y, u, v = red, -red / (2 * (1 - blue)), 0.5
    if full:
        return round(255 * y), round(128 + 255 * u), min(255, round(128 + 255 * v))
    return round(16 + 219 * y), round(128 + 224 * u), round(128 + 224 * v)


def planes_of(matrix: str, *, full: bool) -> bytes:
    y, u, v = red_of(matrix, full=full)
    quarter = WIDTH * HEIGHT // 4
    return bytes([y]) * (WIDTH * HEIGHT) + bytes([u]) * quarter + bytes([v]) * quarter


def encoded(codec: str, matrix: str, *, full: bool) -> list[bytes]:
    """Return encoded red pictures, each a key frame with its parameters."""
    made = load("av").CodecContext.create(codec, "w")
    made.width, made.height, made.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    made.time_base = fractions.Fraction(1, 30)
    colours = f"colormatrix={X264_NAMES[matrix]}"
    if codec == "libx264":
        params = f"{colours}:fullrange={'on' if full else 'off'}:keyint=1:repeat-headers=1"
        made.options = {"preset": "ultrafast", "tune": "zerolatency", "x264-params": params}
    else:
        params = f"{colours}:range={'full' if full else 'limited'}:keyint=1:repeat-headers=1"
        params += ":log-level=none"
        made.options = {"preset": "ultrafast", "tune": "zerolatency", "x265-params": params}
    made.options |= {"crf": "8"}
    shape = HEIGHT * 3 // 2, WIDTH
    pixels = np.frombuffer(planes_of(matrix, full=full), np.uint8).reshape(shape)
    found = []
    for _ in range(COUNT):
        found += made.encode(load("av").VideoFrame.from_ndarray(pixels, "yuv420p"))
    return [bytes(one) for one in (*found, *made.encode(None))]


def check_red(frame: Frame, name: str) -> None:
    assert frame.format.name == name
    assert np.abs(frame.rgb().astype(int) - [255, 0, 0]).max() <= 3


async def newest(url: str) -> Frame:
    async with asyncio.timeout(LIMIT), frames.open(url) as source:
        return await source.newest()


@TOLD
async def test_h264_by_rtsp(matrix: str, full: bool) -> None:
    camera = Camera(encoded("libx264", matrix, full=full), cut=numbered)
    async with camera_on(camera) as where:
        check_red(await newest(f"rtsp://{where}"), FORMATS[matrix, full])


@TOLD
async def test_h265_by_rtsp(matrix: str, full: bool) -> None:
    camera = Camera(encoded("libx265", matrix, full=full), cut=h265_packets)
    camera.sdp = SDP.replace("H264/", "H265/").replace("a=fmtp:96 packetization-mode=1\r\n", "")
    async with camera_on(camera) as where:
        check_red(await newest(f"rtsp://{where}"), FORMATS[matrix, full])


@TOLD
@pytest.mark.parametrize(("codec", "name"), [("h264", "red.h264"), ("hevc", "red.h265")])
async def test_a_file(tmp_path: Path, codec: str, name: str, matrix: str, full: bool) -> None:
    path = tmp_path / name
    path.write_bytes(b"".join(encoded(f"libx{path.suffix[2:]}", matrix, full=full)))
    wrapped = tmp_path / "red.mkv"
    with load("av").open(str(path), format=codec) as had, load("av").open(str(wrapped), "w") as has:
        stream = has.add_stream_from_template(had.streams.video[0])
        for number, packet in enumerate(had.demux()):
            if packet.size:
                packet.stream, packet.pts, packet.dts = stream, number, number
                packet.time_base = fractions.Fraction(1, 30)
                has.mux(packet)
    check_red(await newest(str(wrapped)), FORMATS[matrix, full])


def red_frame(matrix: str, *, full: bool) -> Frame:
    made = frame_of(np.zeros((HEIGHT, WIDTH), np.uint8), "Mono8", 1)
    form = frames.find_format(FORMATS[matrix, full])
    return copy_with(made, format=form, data=planes_of(matrix, full=full), device_time=None)


class Showing(ShowingDriver):
    """Gives one frame repeatedly."""

    def __init__(self, frame: Frame) -> None:
        super().__init__(frames.FrameAddress.parse("synthetic://"))
        self.frame = frame

    async def open(self) -> frames.StreamFormat:
        return frames.StreamFormat(self.frame.format, WIDTH, HEIGHT)

    async def show(self, sink: FrameSink) -> None:
        for number in itertools.count(1):
            now = {"captured": time.monotonic(), "utc": time.time()}
            sink.frame(copy_with(self.frame, sequence=number, lost=0, **now))
            await asyncio.sleep(0.02)


@asynccontextmanager
async def showing(matrix: str, *, full: bool) -> AsyncIterator[frames.FrameSource]:
    """Give an open source of red pictures."""
    driver = Showing(red_frame(matrix, full=full))
    async with frames.FrameSource(driver, stall=None) as source:
        yield source


@TOLD
async def test_own_rtsp_server_sends_the_matrix(matrix: str, full: bool) -> None:
    async with (
        showing(matrix, full=full) as source,
        RtspServer({"red": source}, port=0, crf=8.0) as server,
    ):
        check_red(await newest(server.url("red")), FORMATS[matrix, full])


@TOLD
async def test_recording_stores_the_matrix(tmp_path: Path, matrix: str, full: bool) -> None:
    for path in (tmp_path / "red.mcap", tmp_path / "red.mkv"):
        with Recorder(path) as recorder:
            async with showing(matrix, full=full) as source:
                await recorder.record(source, count=3)
        check_red(await newest(str(path)), FORMATS[matrix, full])


@TOLD
async def test_jpeg_of_a_red_frame_is_red(matrix: str, full: bool) -> None:
    async with Codecs(threads=1) as codecs:
        made = await codecs.jpeg(red_frame(matrix, full=full), quality=95)
        check_red(await codecs.decode(made), "RGB8")
