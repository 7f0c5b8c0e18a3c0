"""``fleet://`` as a source of frames, frames that come encoded, and frames without asyncio."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest

import smartcam.frames
import smartcam.sync
from smartcam import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
    UnsupportedError,
)
from smartcam.camera import FrameEncoding
from smartcam.fleet import FleetFile, FleetFrame, FleetServer
from smartcam.frames._inside import read_stamp
from tests.client.clientkit import gone
from tests.fleet.fleetkit import PATIENCE
from tests.fleet.framekit import looking
from tests.frames.drivers import frame
from tests.handmade import refusing
from tests.processes import free_place

NAME = "line1/cam3"


@contextlib.asynccontextmanager
async def served(frames: str | None = "synthetic://?size=300x200&fps=200") -> AsyncIterator[str]:
    """Give the fleet URL of a camera with frames."""
    camera = {"emulated": {}} if frames is None else {"emulated": {}, "frames": frames}
    file = {"listen": free_place(), "cameras": {NAME: camera}}
    async with FleetServer(FleetFile.model_validate(file)) as server:
        yield server.urls[NAME]


# ---------------------------------------------------------------------- the URL


@pytest.mark.real_time
async def test_camera_of_a_fleet_is_a_source_of_frames() -> None:
    async with served() as url:
        source = smartcam.frames.open(f"{url}?encoding=png", timeout=PATIENCE)
        for _ in range(2):  # it may be opened again
            async with source:
                assert str(source.format) == "PNG 300x200 at 200/s"
                async for got in source:
                    assert (got.format.name, got.source) == ("PNG", NAME)
                    break
                assert (await source.newest(timeout=PATIENCE)).sequence >= got.sequence


@pytest.mark.parametrize(
    ("query", "says"),
    [
        ("encoding=bmp", "encoding: expected raw, jpeg, png, jpegxl, h264, got 'bmp'"),
        ("encoding=png&bitrate=1e6", "bitrate: 'png' cannot keep to one; jpeg can, and h264"),
        ("encoding=h264&latency=0.1", "latency: 'h264' cannot keep to one; jpeg can"),
        ("encoding=h264&quality=7", "quality: h264 has none"),
        ("encoding=jpeg&latency=0.1&quality=7", "quality: expected none beside a bit rate"),
        ("encoding=jpeg&latency=0", "latency: expected a number from 0.001 to 60"),
        ("encoding=jpeg&quality=0", "quality: expected a number from 1 to 100"),
        ("encoding=png&quality=7", "quality: png has none"),
        ("qualtiy=7", "unknown 'qualtiy'"),
    ],
)
def test_wrong_parameter_is_told(query: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        smartcam.frames.open(f"fleet://localhost/{NAME}?{query}")


@pytest.mark.real_time
async def test_nobody_there_is_told_as_of_any_source() -> None:
    with refusing(socket.SOCK_STREAM) as port:
        source = smartcam.frames.open(f"fleet://127.0.0.1:{port}/{NAME}")
        error = await gone(source.__aenter__())
    assert isinstance(error, FrameSourceError)
    assert "127.0.0.1" in str(error)


@pytest.mark.real_time
async def test_camera_without_frames_is_told() -> None:
    async with served(None) as url:
        error = await gone(smartcam.frames.open(url).__aenter__())
        assert isinstance(error, UnsupportedError)


# ---------------------------------------------------------------------- encoded


@pytest.mark.both_buses
async def test_frame_comes_encoded_once_for_all_and_is_decoded_where_it_is_wanted() -> None:
    picture = np.tile(np.arange(0, 240, 5, dtype=np.uint8), (32, 1))
    given = frame(5, data=picture.tobytes(), width=48, height=32, stride=48, lost=2)
    old: Any = {"max_age": 3600.0, "timeout": PATIENCE}
    async with looking(source={"linger": 60.0}) as (plant, camera):
        async with camera.frames():
            await plant.driver.streams()
            plant.driver.give(given)
        jpegs = await asyncio.gather(
            *(camera.newest_frame(**old, encoding="jpeg", quality=95) for _ in range(3))
        )
        assert len({bytes(one.data) for one in jpegs}) == 1
        one = jpegs[0]
        assert (one.format.name, one.width, one.height, one.stride) == ("MJPEG", 48, 32, 0)
        assert (one.sequence, one.lost) == (5, 2)
        assert np.abs(one.grey().astype(int) - picture).max() < 10
        lossless: dict[FrameEncoding, str] = {"png": "PNG", "jpegxl": "JPEGXL"}
        for encoding, pixels in lossless.items():
            got = await camera.newest_frame(**old, encoding=encoding)
            assert got.format.name == pixels
            async with smartcam.frames.Codecs() as codecs:
                assert ((await codecs.decode(got)).array() == picture).all()


@pytest.mark.both_buses
async def test_frames_that_no_codec_takes_end_a_stream_and_say_why() -> None:
    deep = smartcam.frames.find_format("Mono16")
    async with (
        looking() as (plant, camera),
        plant.streaming(format=deep, stride=8, data=bytes(16)),
    ):
        async with camera.frames(encoding="jpeg", timeout=PATIENCE) as frames:
            assert isinstance(await gone(anext(frames)), FrameFormatError)
        assert isinstance(await gone(camera.newest_frame(encoding="jpeg")), FrameFormatError)
        assert (await camera.newest_frame()).format == deep


async def test_jpegs_of_the_camera_are_left_as_they_are() -> None:
    jpeg = smartcam.frames.find_format("MJPEG")
    given = frame(1, format=jpeg, data=b"\xff\xd8 as it came", stride=0)
    async with looking(source={"linger": 60.0}) as (plant, camera):
        asking = asyncio.create_task(camera.newest_frame(max_age=3600.0, encoding="jpeg"))
        await plant.driver.streams()
        plant.driver.give(given)
        got = await asking
        assert isinstance(got, FleetFrame)
        assert got.data is given.data
        assert got.encoding_time == 0.0


# ---------------------------------------------------------------------- without asyncio


@pytest.mark.real_time
async def test_frames_without_asyncio() -> None:
    def look(url: str) -> None:
        with smartcam.sync.connect(url) as camera:
            newest = camera.newest_frame(timeout=PATIENCE)
            assert camera.frame_after(timeout=PATIENCE).sequence > newest.sequence
            with camera.frames(timeout=PATIENCE) as frames:
                for got in frames:
                    stamp = read_stamp(got.array())
                    assert stamp is not None
                    assert stamp[0] == got.sequence
                    break
                later = frames.after(got.captured + 0.01, timeout=PATIENCE)
                assert frames.newest(max_age=60.0).sequence >= later.sequence > got.sequence
                assert frames.statistics().delivered >= 2

    async with served() as url:
        await asyncio.to_thread(look, url)
