"""Pictures of an emulated smart camera on a real socket, and their bitmaps."""

from __future__ import annotations

import asyncio
import math
import struct
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam import frames
from smartcam.emulator import EmulatedInSight
from smartcam.exceptions import ConfigurationError, FrameFormatError, FrameSourceError
from smartcam.frames import Moment
from smartcam.frames._inside import read_bitmap


def picture(value: int) -> Any:
    """Return a picture that looks different after each turn or flip."""
    return np.arange(12, dtype=np.uint8).reshape(3, 4) + np.uint8(value)


async def test_each_new_picture_is_given_once() -> None:
    async with EmulatedInSight(online=True, image=picture(1)) as camera:
        url = f"{camera.url}?fps=4&name=station"
        async with frames.open(url, stall=None, timeout=60) as source:
            assert str(source.format) == "Mono8 4x3 at 4/s"
            assert camera.sessions == []
            got, changed = [], []
            async for frame in source:
                got.append(frame)
                assert (frame.grey() == picture(len(got))).all()
                if len(got) == 3:
                    break
                await asyncio.sleep(1)  # four requests give the same picture
                changed.append(time.monotonic())
                camera.set_image(picture(len(got) + 1))
            assert source.statistics().frames == 3
            for _ in range(1000):
                if not camera.sessions:
                    break
                await asyncio.sleep(0)
            assert camera.sessions == []
    assert [frame.sequence for frame in got] == [1, 2, 3]
    assert {frame.source for frame in got} == {"station"}
    assert {frame.moment for frame in got} == {Moment.ARRIVAL}
    assert got[0].duration == math.inf
    for frame, shown in zip(got[1:], changed, strict=True):
        assert frame.began <= shown <= frame.captured


async def test_lost_camera_ends_readers_and_the_next_reader_reconnects() -> None:
    async with (
        EmulatedInSight(online=True, image=picture(1)) as camera,
        frames.open(camera.url, timeout=60, stall=None) as source,
    ):
        reader = source.reader()
        await reader.newest()
        camera.drop_connections()
        with pytest.raises(FrameSourceError, match=r"[Cc]onnection") as got:  # closed, or reset
            await reader.__anext__()
        assert got.value.source == source.name
        assert (await source.newest(timeout=60)).width == 4
        assert source.statistics().started == 2


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("fps=0", "fps: expected a number from 0.001 to 100, got '0'"),
        ("timeout=x", "timeout: expected a number"),
        ("fpss=2", "unknown 'fpss'; known are 'dialect'"),
    ],
)
def test_wrong_parameters_are_refused_with_the_cure(query: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as got:
        frames.open(f"insight://admin:s3cret@127.0.0.1?{query}")
    assert message in str(got.value)
    assert "s3cret" not in str(got.value)


async def test_refused_session_is_reported_without_the_password() -> None:
    async with EmulatedInSight(online=True) as camera:
        url = camera.url.replace("//", "//admin:s3cret@")
        with pytest.raises(FrameSourceError, match="the user or the password is wrong") as got:
            await frames.open(url).__aenter__()
    assert "s3cret" not in str(got.value) + repr(got.value)


async def test_picture_that_is_no_bitmap_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "smartcam.emulator._insight.commands.bitmap",
        lambda _: b"BM" + (60).to_bytes(4, "little") + bytes(54),
    )
    async with EmulatedInSight(online=True) as camera:
        with pytest.raises(FrameFormatError, match="expected an uncompressed bitmap"):
            await frames.open(camera.url).__aenter__()


# bitmaps


def made(
    width: int, rows: int, bits: int, body: bytes, palette: bytes = b"", used: int = 0
) -> bytes:
    offset = 54 + len(palette)
    head = struct.pack("<2sIHHI", b"BM", offset + len(body), 0, 0, offset)
    info = struct.pack("<IiiHHIIiiII", 40, width, rows, 1, bits, 0, len(body), 0, 0, used, 0)
    return head + info + palette + body


def test_bitmap_s_colours_and_orders() -> None:
    row = bytes([1, 2, 3, 4, 5, 6, 0, 0])
    assert read_bitmap(made(2, 1, 24, row)).tolist() == [[[3, 2, 1], [6, 5, 4]]]
    assert read_bitmap(made(1, -2, 32, bytes(range(8)))).tolist() == [[[2, 1, 0]], [[6, 5, 4]]]
    two = made(2, 1, 8, b"\0\1\0\0", bytes([1, 2, 3, 0, 9, 9, 9, 0]), used=2)
    assert read_bitmap(two).tolist() == [[[3, 2, 1], [9, 9, 9]]]
    dark = made(2, 1, 8, b"\0\1\0\0", bytes([7, 7, 7, 0, 9, 9, 9, 0]), used=2)
    assert read_bitmap(dark).tolist() == [[7, 9]]


@given(st.binary(max_size=200))
def test_any_bytes_are_a_bitmap_or_an_error(data: bytes) -> None:
    for given_data in (data, b"BM" + data, made(3, 3, 8, data), made(2**31 - 1, -(2**31), 8, data)):
        try:
            assert read_bitmap(given_data).size
        except FrameFormatError:
            continue
