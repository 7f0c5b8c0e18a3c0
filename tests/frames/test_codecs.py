"""Codecs return the same pictures, work in threads, and survive cancelled calls."""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam._extras import load
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    LocalProtocolError,
    MissingExtraError,
)
from smartcam.frames import Codecs, find_format
from smartcam.frames._codecs.threads import MAX_LOOP_TIME, StreamRunner
from smartcam.frames._inside import read_stamp
from tests.frames.inside import pictures
from tests.frames.pictures import HEIGHT, WIDTH, fill, frame_of, known_of, stamped

simplejpeg: Any = load("simplejpeg")

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam.frames import Frame

GREY = frame_of(stamped(5), "Mono8", 5)
DEPTH = frame_of(np.random.default_rng(1).integers(0, 65536, (24, 31)).astype("<u2"), "Z16", 4)


@pytest.fixture
async def codecs() -> AsyncIterator[Codecs]:
    async with Codecs(threads=2) as opened:
        yield opened


# JPEG


async def test_grey_becomes_a_grey_jpeg_and_keeps_number_and_times(codecs: Codecs) -> None:
    encoded = await codecs.jpeg(GREY, quality=90)
    assert encoded.format.name == "MJPEG"
    assert simplejpeg.decode_jpeg_header(encoded.data)[2] == "Gray"
    assert known_of(encoded) == known_of(GREY)
    back = await codecs.decode(encoded)
    assert (back.format.name, back.stride) == ("Mono8", WIDTH)
    assert known_of(back) == known_of(GREY)
    assert read_stamp(back.array()) == (5, 5000)


async def test_quality_is_the_caller_s(codecs: Codecs) -> None:
    sizes = [len((await codecs.jpeg(GREY, quality=quality)).data) for quality in (15, 50, 95)]
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[2]
    with pytest.raises(ConfigurationError, match=r"quality: .* 1 to 100, got 0"):
        await codecs.jpeg(GREY, quality=0)


def coloured() -> Any:
    """Return soft colours, (48, 64, 3)."""
    down, across = np.mgrid[0:48, 0:64]
    return np.stack((across * 3, down * 4, 255 - across * 2 - down), axis=-1).astype(np.uint8)


@pytest.mark.parametrize("name", ["RGB8", "BGR8"])
async def test_jpeg_keeps_the_colours(codecs: Codecs, name: str) -> None:
    pixels = coloured() if name == "RGB8" else coloured()[..., ::-1]
    back = await codecs.decode(await codecs.jpeg(frame_of(pixels, name), quality=95))
    assert back.format.name == "RGB8"
    assert np.abs(back.array().astype(int) - coloured()).mean() < 3
    luma = await codecs.decode(await codecs.jpeg(frame_of(pixels, name)), "Mono8")
    assert luma.array().shape == (48, 64)


@pytest.mark.parametrize(
    "name",
    [
        *("YUYV", "UYVY", "NV12", "I420", "I422", "I444", "I420_full", "I420_709", "YCbCr422_8"),
        *("I420_709_full", "I420_2020", "I420_2020_full"),
    ],
)
async def test_planes_become_a_jpeg_of_the_same_colours(codecs: Codecs, name: str) -> None:
    found = find_format(name)
    rng = np.random.default_rng(2)
    y = np.repeat(np.repeat(rng.integers(40, 200, (6, 8)), 8, axis=0), 8, axis=1)
    data = bytearray(found.size(64, 48))
    empty = replace(GREY, data=data, format=found, width=64, height=48, stride=found.stride(64))
    fill(found.planes(data, 64, 48, found.stride(64)), (y, 110, 150))
    back = await codecs.decode(await codecs.jpeg(empty, quality=98))
    assert np.abs(back.array().astype(int) - empty.rgb()).mean() < 2


async def test_jpeg_is_compressed_again_in_its_own_colours(codecs: Codecs) -> None:
    large = await codecs.jpeg(GREY, quality=95)
    small = await codecs.jpeg(large, quality=30)
    assert len(small.data) < len(large.data)
    assert simplejpeg.decode_jpeg_header(small.data)[2] == "Gray"
    assert known_of(small) == known_of(GREY)


@pytest.mark.parametrize(
    ("name", "why"), [("Mono12", "8 bits a sample"), ("Z16", "8 bits"), ("BayerRG8", "converted")]
)
async def test_formats_that_jpeg_lacks_are_refused(codecs: Codecs, name: str, why: str) -> None:
    size = find_format(name).depth // 9 + 1
    with pytest.raises(FrameFormatError, match=f"{find_format(name).name} cannot become.*{why}"):
        await codecs.jpeg(frame_of(np.zeros((4, 4), f"<u{size}"), name))


def without_tables(data: bytes) -> bytes:
    """Return a JPEG without its Huffman tables, as cameras on USB send it."""
    kept, place = data[:2], 2
    while data[place + 1] != 0xDA:
        end = place + 2 + int.from_bytes(data[place + 2 : place + 4], "big")
        kept += b"" if data[place + 1] == 0xC4 else data[place:end]
        place = end
    return kept + data[place:]


async def test_jpeg_without_huffman_tables_is_read(codecs: Codecs) -> None:
    whole = await codecs.jpeg(frame_of(coloured(), "RGB8"))
    bare = without_tables(bytes(whole.data))
    assert b"\xff\xc4" not in bare
    assert (replace(whole, data=bare).rgb() == whole.rgb()).all()
    assert (replace(whole, data=bare).grey() == whole.grey()).all()


async def test_jpeg_with_bytes_around_its_end_is_read(codecs: Codecs) -> None:
    whole = await codecs.jpeg(GREY)
    data = bytes(whole.data)
    for odd in (data + bytes(500), data[:-2] + b"\0\0\0\0" + data[-2:]):
        assert (replace(whole, data=odd).grey() == whole.grey()).all()


async def test_damaged_jpeg_is_an_error_at_every_length(codecs: Codecs) -> None:
    whole = await codecs.jpeg(frame_of(stamped(1, 256, 16), "Mono8"))
    for length in range(0, len(whole.data) - 1, 7):
        with pytest.raises(FrameFormatError, match=f"expected a whole JPEG, got {length} bytes"):
            replace(whole, data=whole.data[:length]).grey()


async def test_picture_of_another_size_than_its_frame_is_refused(codecs: Codecs) -> None:
    for encode in (codecs.jpeg, codecs.png, codecs.jpegxl):
        encoded = replace(await encode(GREY), width=WIDTH - 1)
        with pytest.raises(FrameFormatError, match=f"{WIDTH}x{HEIGHT}"):
            await codecs.decode(encoded)


# without loss


@pytest.mark.parametrize("codec", ["png", "jpegxl"])
@pytest.mark.parametrize("name", ["Z16", "Mono8", "Mono12", "RGB8", "BGR8", "BayerGB8"])
async def test_lossless_codecs_lose_nothing(codecs: Codecs, codec: str, name: str) -> None:
    found = find_format(name)
    shape = (24, 31, 3) if "GR8" in name or name == "RGB8" else (24, 31)
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 1 << found.depth, shape).astype("<u2" if found.depth > 8 else np.uint8)
    frame = frame_of(pixels, name)
    encoded = await getattr(codecs, codec)(frame)
    assert encoded.format.name == {"png": "PNG", "jpegxl": "JPEGXL"}[codec]
    back = await codecs.decode(encoded, name)
    assert (back.array() == pixels).all()
    assert known_of(back) == known_of(frame)
    assert back.format is found


@pytest.mark.parametrize("codec", ["to_png", "to_jpegxl"])
@given(
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    seed=st.integers(0, 1 << 30),
    top=st.sampled_from([1, 300, 65536]),
)
def test_any_depth_picture_comes_back(
    codec: str, width: int, height: int, seed: int, top: int
) -> None:
    pixels = np.random.default_rng(seed).integers(0, top, (height, width)).astype("<u2")
    back = pictures.decode_frame(getattr(pictures, codec)(frame_of(pixels, "Z16")), "Z16")
    assert (back.array() == pixels).all()


@pytest.mark.parametrize("size", [(64, 64), (640, 480), (1920, 1080), (8, 300), (9, 7), (257, 256)])
def test_size_of_a_jpegxl_is_read_in_every_form(size: tuple[int, int]) -> None:
    for dtype, name in ((np.uint8, "Mono8"), (np.uint16, "Mono16")):
        encoded = pictures.to_jpegxl(frame_of(np.zeros(size[::-1], dtype), name))
        assert pictures.jpegxl_size(encoded) == size


@pytest.mark.parametrize("codec", ["png", "jpegxl"])
async def test_damaged_lossless_pictures_are_errors(codecs: Codecs, codec: str) -> None:
    encoded = await getattr(codecs, codec)(DEPTH)
    for length in (0, 1, 10, 24, 60, len(encoded.data) // 2):
        with pytest.raises(FrameFormatError):
            await codecs.decode(replace(encoded, data=encoded.data[:length]))


@given(st.binary(max_size=200), st.sampled_from(["MJPEG", "PNG", "JPEGXL"]))
def test_any_bytes_are_a_picture_or_an_error(data: bytes, name: str) -> None:
    magic = {"MJPEG": b"\xff\xd8\xff", "PNG": b"\x89PNG\r\n\x1a\n", "JPEGXL": b"\xff\x0a"}[name]
    for bytes_of in (data, magic + data):
        try:
            pictures.decode_frame(replace(GREY, data=bytes_of, format=find_format(name)), "")
        except FrameFormatError:
            continue


async def test_pixels_that_a_codec_cannot_give_are_refused(codecs: Codecs) -> None:
    encoded = await codecs.png(DEPTH)
    assert (await codecs.decode(encoded)).format.name == "Mono16"
    for name in ("Mono8", "RGB8", "NV12", "Mono12p"):
        with pytest.raises(FrameFormatError, match=f"expected {name}, got uint16"):
            await codecs.decode(encoded, name)
    with pytest.raises(FrameFormatError, match="expected one of MJPEG, PNG, JPEGXL, got Mono8"):
        await codecs.decode(GREY)
    with pytest.raises(FrameFormatError, match="H264 cannot become PNG"):
        await codecs.png(replace(GREY, format=find_format("H264")))


async def test_conversion_on_request(codecs: Codecs) -> None:
    deep = frame_of(np.array([[0x123, 0xFFF]], "<u2"), "Mono12")
    assert (await codecs.converted(deep, "Mono8")).array().tolist() == [[0x12, 0xFF]]
    assert (await codecs.converted(deep, "Mono16")).array().tolist() == [[0x123, 0xFFF]]
    assert (await codecs.converted(deep)).array().tolist() == [[[0x12] * 3, [0xFF] * 3]]
    colour = await codecs.converted(await codecs.jpeg(GREY, quality=95))
    assert (colour.format.name, colour.stride) == ("RGB8", 3 * WIDTH)
    assert read_stamp(colour.array()) == (5, 5000)
    assert known_of(colour) == known_of(GREY)


# threads


async def test_loop_goes_on_and_each_thread_has_one_call(
    codecs: Codecs, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, begun, at_work, most = threading.Event(), threading.Semaphore(0), [], [0]

    def slow(frame: Frame, quality: int) -> Frame:
        begun.release()
        at_work.append(threading.current_thread().name)
        most[0] = max(most[0], len(at_work))
        assert gate.wait(60)
        at_work.pop()
        return frame

    monkeypatch.setattr(pictures, "to_jpeg", slow)
    tasks = [asyncio.create_task(codecs.jpeg(GREY)) for _ in range(5)]
    for _ in range(2):
        assert await asyncio.to_thread(begun.acquire, timeout=60)
    for _ in range(100):
        await asyncio.sleep(0)
    assert len(at_work) == 2
    assert all(name.startswith("smartcam codecs") for name in at_work)
    gate.set()
    assert await asyncio.gather(*tasks) == [GREY] * 5
    assert most == [2]


@pytest.mark.parametrize("steps", range(6))
async def test_codecs_work_after_a_cancellation_at_any_step(codecs: Codecs, steps: int) -> None:
    tasks = [asyncio.create_task(codecs.jpeg(GREY)) for _ in range(4)]
    for _ in range(steps):
        await asyncio.sleep(0)
    for task in tasks:
        task.cancel()
    await asyncio.wait(tasks)
    for _ in range(3):
        assert read_stamp((await codecs.jpeg(GREY)).grey()) == (5, 5000)


def own_threads() -> set[threading.Thread]:
    return {one for one in threading.enumerate() if one.name.startswith("smartcam codecs")}


async def test_closing_ends_the_threads_and_the_waiting_calls(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate, begun = threading.Event(), threading.Event()

    def slow(frame: Frame, quality: int) -> Frame:
        begun.set()
        assert gate.wait(60)
        return frame

    monkeypatch.setattr(pictures, "to_jpeg", slow)
    before = own_threads()
    codecs = Codecs(threads=1)
    async with codecs:
        first, second = (asyncio.create_task(codecs.jpeg(GREY)) for _ in range(2))
        await asyncio.to_thread(begun.wait, 60)
        closing = asyncio.create_task(codecs.close())
        await asyncio.sleep(0)
        gate.set()
        await closing
        assert await first is GREY
        with pytest.raises(LocalProtocolError, match="they are closed"):
            await second
    for thread in own_threads() - before:
        thread.join(60)
    assert own_threads() - before == set()
    with pytest.raises(LocalProtocolError, match="they are closed"):
        await codecs.jpeg(GREY)
    with pytest.raises(LocalProtocolError, match="entered before"):
        await codecs.__aenter__()


async def test_closed_codecs_report_it() -> None:
    with pytest.raises(LocalProtocolError, match="async with"):
        await Codecs().jpeg(GREY)
    for threads in (0, 65):
        with pytest.raises(ConfigurationError, match=f"threads: .* 1 to 64, got {threads}"):
            Codecs(threads)


def _spend(seconds: float) -> threading.Thread:
    """Use CPU time; return the thread that used it."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass
    return threading.current_thread()


async def test_slow_calls_leave_the_event_loop(codecs: Codecs) -> None:
    runs, loop = StreamRunner(codecs), threading.current_thread()
    long = 3 * MAX_LOOP_TIME
    assert await runs(lambda: _spend(0)) is not loop  # the duration was unknown
    assert await runs(lambda: _spend(0)) is loop
    await runs(lambda: _spend(long))
    short = [await runs(lambda: _spend(0)) for _ in range(40)]
    back = short.index(loop)
    assert back >= 1  # calls after a long one may be as long
    assert set(short[back:]) == {loop}
    with pytest.raises(ZeroDivisionError):
        await runs(lambda: 1 / 0)
    await codecs.close()
    with pytest.raises(LocalProtocolError, match="they are closed"):
        await runs(lambda: _spend(0))


@pytest.mark.parametrize(
    ("module", "call", "extra"),
    [
        ("simplejpeg", "jpeg", "frames"),
        ("imagecodecs", "png", "frames"),
        ("imagecodecs", "jpegxl", "frames"),
        ("av", "h264_encoder", "video"),
        ("av", "h264_decoder", "video"),
    ],
)
async def test_missing_extra_is_named(
    codecs: Codecs, monkeypatch: pytest.MonkeyPatch, module: str, call: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"smartcam\[{extra}\]") as got:
        await getattr(codecs, call)(*([GREY] if extra == "frames" else []))
    assert got.value.extra == extra
