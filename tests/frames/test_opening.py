"""URLs of frame sources, and frames of the synthetic source."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam import frames
from smartcam.exceptions import ConfigurationError
from smartcam.frames._inside import read_stamp
from tests.frames.pictures import stripes, write_stamp

pytestmark = pytest.mark.usefixtures("no_leaks")


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("", "expected a URL or a path"),
        ("v4l://x", "unknown scheme 'v4l'; known are .*did you mean 'v4l2'"),
        ("synthetic://?size=640", "size: expected WIDTHxHEIGHT"),
        ("synthetic://?size=0x10", "size: expected WIDTHxHEIGHT"),
        ("synthetic://?size=100x100", "room for the stamp"),
        ("synthetic://?fps=nan", "fps: expected a number from"),
        ("synthetic://?fps=0", "fps: expected a number from"),
        ("synthetic://?fsp=3", "unknown parameter 'fsp'; known are .*did you mean 'fps'"),
        ("synthetic://?fps=3&fps=4", "is given twice"),
        ("rtsp://user:secret@[::1/x", "user:\\*\\*\\*@"),
    ],
)
def test_wrong_urls_are_refused_with_the_cure(url: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message) as caught:
        frames.open(url)
    assert "secret" not in str(caught.value)


@given(st.text(max_size=40))
def test_any_text_is_an_address_or_refused(text: str) -> None:
    with contextlib.suppress(ConfigurationError):
        frames.FrameAddress.parse(text)


async def test_drawn_frames_carry_their_number_and_moment() -> None:
    async with frames.open("synthetic://?size=320x240&fps=50&name=desk") as source:
        assert (source.name, source.format.width, source.format.rates) == ("desk", 320, (50.0,))
        numbers = []
        async for one in source:
            stamp = read_stamp(one.array())
            assert stamp is not None
            assert stamp[0] == one.sequence
            assert stamp[1] == pytest.approx(one.captured * 1e9, abs=1000)
            numbers.append(one.sequence)
            if len(numbers) == 5:
                break
        assert numbers == [1, 2, 3, 4, 5]


async def test_frames_that_were_not_drawn_in_time_are_lost() -> None:
    async with frames.open("synthetic://?size=320x240&fps=50") as source, source.reader() as reader:
        first = await anext(reader)
        await asyncio.sleep(0)
        loop: Any = asyncio.get_running_loop()
        loop._selector.now += 1.0  # the process was stopped for a second
        second = await anext(reader)
        assert second.lost == second.sequence - first.sequence - 1 > 40
        assert reader.statistics().lost == second.lost


@given(st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1), st.booleans())
def test_stamp_is_read_as_it_was_drawn_or_not_at_all(
    number: int, moment: int, in_colour: bool
) -> None:
    picture = stripes(256, 32)
    if in_colour:
        picture = np.repeat(picture[..., None], 3, axis=2)
    assert read_stamp(picture) is None
    write_stamp(picture, number, moment)
    assert read_stamp(picture) == (number, moment)
    other = picture.copy()
    write_stamp(other, number + 1 & (2**64 - 1), moment)
    torn = np.concatenate([picture[:4], other[4:]])
    assert read_stamp(torn) is None
    assert read_stamp(picture[:8]) is None


async def test_discovery_calls_each_kind_once() -> None:
    assert await frames.discover("synthetic") == []
    with pytest.raises(ConfigurationError, match="unknown scheme"):
        await frames.discover("nothing")


@pytest.mark.parametrize(
    ("format", "shape"),
    [
        ("Mono8", (64, 301)),
        ("YUYV", (64, 301, 2)),
        ("RGB8", (64, 301, 3)),
        ("Z16", (64, 301)),
        ("MJPEG", None),
    ],
)
async def test_drawn_frames_have_their_stamp_in_every_format(
    format: str, shape: tuple[int, ...] | None
) -> None:
    async with frames.open(f"synthetic://?size=301x64&fps=30&format={format}") as source:
        frame = await source.newest()
        assert frame.format is frames.find_format(format) is source.format.format
    assert shape is None or frame.array().shape == shape
    depth = frame.format.name == "Coord3D_C16"
    stamp = read_stamp(frame.array() if depth else frame.grey())
    assert stamp is not None
    assert stamp[0] == frame.sequence
    assert depth or read_stamp(frame.rgb()) == stamp


def test_error_of_another_format_lists_the_drawn_ones() -> None:
    with pytest.raises(ConfigurationError, match=r"format: expected one of Mono8, .* got 'NV12'"):
        frames.open("synthetic://?format=NV12")
