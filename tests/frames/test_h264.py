"""H.264 gives every frame at once, and only whole ones."""

from __future__ import annotations

import asyncio
import pickle
import threading
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import ConfigurationError, FrameFormatError
from smartcam.frames import Codecs, find_format
from smartcam.frames._inside import random_access_point, read_stamp
from tests.frames.pictures import HEIGHT, WIDTH, fill, frame_of, known_of, stamped

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam.frames import Frame
    from smartcam.frames._inside import H264Encoder

KEYINT = 8


@pytest.fixture
async def codecs() -> AsyncIterator[Codecs]:
    async with Codecs(threads=2) as opened:
        yield opened


def drawn(number: int) -> Frame:
    return frame_of(stamped(number), "Mono8", number)


async def encoded(encoder: H264Encoder, count: int, first: int = 0) -> list[Frame]:
    return [await encoder.encode(drawn(number)) for number in range(first, first + count)]


async def test_every_frame_comes_back_at_once_with_its_number_and_times(codecs: Codecs) -> None:
    encoder, decoder = codecs.h264_encoder(keyint=KEYINT, crf=18), codecs.h264_decoder()
    for number in range(3 * KEYINT):
        sent = await encoder.encode(drawn(number))
        assert (sent.format.name, sent.stride) == ("H264", 0)
        assert known_of(sent) == known_of(drawn(number))
        got = await decoder.decode(sent)
        assert got is not None
        assert known_of(got) == known_of(drawn(number))
        assert read_stamp(got.grey()) == (number, number * 1000)
        assert got.format.name == "I420_full"
        assert np.abs(got.grey().astype(int) - stamped(number)).mean() < 3


async def test_pictures_stay_as_they_were_while_the_decoder_goes_on(codecs: Codecs) -> None:
    """A picture's planes belong to the decoder until its bytes are read."""
    encoder, decoder = codecs.h264_encoder(keyint=KEYINT, crf=18), codecs.h264_decoder()
    got = [await decoder.decode(await encoder.encode(drawn(one))) for one in range(3 * KEYINT)]
    frames = [one for one in got if one is not None]
    assert len(frames) == len(got)
    seen = [frame.grey().copy() for frame in frames]
    asked = frames[1]
    assert asked.array().nbytes == len(asked.data) >= WIDTH * HEIGHT * 3 // 2
    assert asked.data is asked.data
    sent = pickle.loads(pickle.dumps(frames[3]))  # noqa: S301 - our own
    copies = [asked, replace(frames[2], lost=1), sent]
    for frame, grey in zip((*frames, *copies), (*seen, *seen[1:4]), strict=True):
        assert not frame.grey().flags.writeable
        assert np.array_equal(frame.grey(), grey)
        assert np.array_equal(frame.format.planes(frame.data, *_size_of(frame))[0], grey)
    assert [read_stamp(one.grey()) for one in frames] == [
        (number, number * 1000) for number in range(3 * KEYINT)
    ]


def _size_of(frame: Frame) -> tuple[int, int, int]:
    return frame.width, frame.height, frame.stride


async def test_no_frame_but_the_first_is_large(codecs: Codecs) -> None:
    sizes = [len(one.data) for one in await encoded(codecs.h264_encoder(keyint=KEYINT), 4 * KEYINT)]
    assert max(sizes[1:]) < sizes[0]


async def test_bitrate_is_kept(codecs: Codecs) -> None:
    sent = await encoded(codecs.h264_encoder(fps=30, keyint=30, bitrate=100_000), 90)
    rest = sum(len(one.data) for one in sent[30:])
    free = sum(len(one.data) for one in (await encoded(codecs.h264_encoder(crf=5), 90))[30:])
    assert rest * 8 / 2 < 150_000 < free * 8 / 2


@pytest.mark.parametrize("name", ["RGB8", "BGR8", "YUYV", "UYVY", "NV12", "I420", "I422_709"])
async def test_other_formats_keep_their_colours(codecs: Codecs, name: str) -> None:
    found = find_format(name)
    stride = found.stride(64) + 8
    data = bytearray(found.size(64, 48, stride))
    frame = replace(drawn(1), data=data, format=found, width=64, height=48, stride=stride)
    y = np.repeat(np.repeat(np.random.default_rng(5).integers(40, 200, (6, 8)), 8, 0), 8, 1)
    if name.endswith("GB8") or name == "BGR8":
        view = np.ndarray((48, 64, 3), np.uint8, data, 0, (stride, 3, 1))
        view[...] = y[..., None] * np.array((1.0, 0.8, 0.6))
    else:
        fill(found.planes(data, 64, 48, stride), (y, 110, 150))
    sent = await codecs.h264_encoder(crf=5).encode(frame)
    got = await codecs.h264_decoder().decode(sent)
    assert got is not None
    assert got.format.name == ("I420_709" if "709" in name else "I420")
    assert np.abs(got.rgb().astype(int) - frame.rgb()).mean() < 4


async def test_jpeg_is_decoded_for_video(codecs: Codecs) -> None:
    sent = await codecs.h264_encoder(crf=10).encode(await codecs.jpeg(drawn(3), quality=95))
    got = await codecs.h264_decoder().decode(sent)
    assert got is not None
    assert read_stamp(got.rgb()) == (3, 3000)


async def test_formats_that_cannot_become_video_are_refused(codecs: Codecs) -> None:
    encoder = codecs.h264_encoder()
    deep = frame_of(np.zeros((4, 4), "<u2"), "Mono12")
    with pytest.raises(FrameFormatError, match="Mono12 cannot become video") as got:
        await encoder.encode(deep)
    assert "Mono8" in got.value.available
    with pytest.raises(FrameFormatError, match="even width and height, got 5x4"):
        await encoder.encode(frame_of(np.zeros((4, 5), np.uint8), "Mono8"))
    for name, value in (("keyint", 1), ("crf", 60), ("fps", 0), ("bitrate", 5)):
        with pytest.raises(ConfigurationError, match=f"{name}: expected"):
            codecs.h264_encoder(**{name: value})


async def test_late_viewer_gets_only_whole_pictures(codecs: Codecs) -> None:
    """At KEYINT + 1 FFmpeg alone gives half a picture: the next refresh begins with frame
    number 0, for which FFmpeg makes up no reference."""
    sent = await encoded(codecs.h264_encoder(keyint=KEYINT, crf=18), 5 * KEYINT)
    for begin in (1, KEYINT // 2, KEYINT + 1):
        decoder = codecs.h264_decoder()
        got = [await decoder.decode(one) for one in sent[begin:]]
        late = next(place for place, one in enumerate(got) if one is not None)
        assert 0 < late <= 3 * KEYINT
        for number, one in enumerate(got[late:], begin + late):
            assert one is not None
            assert np.abs(one.grey().astype(int) - stamped(number)).mean() < 3


async def test_no_picture_after_a_loss_before_it_is_whole(codecs: Codecs) -> None:
    sent = await encoded(codecs.h264_encoder(keyint=KEYINT, crf=18), 5 * KEYINT)
    decoder = codecs.h264_decoder()
    for one in sent[:10]:
        assert await decoder.decode(one) is not None
    decoder.note_loss()  # frame 10
    got = [await decoder.decode(one) for one in sent[11:]]
    assert got[0] is None
    assert got[2 * KEYINT] is not None
    for number, back in enumerate(got, 11):
        assert back is None or np.abs(back.grey().astype(int) - stamped(number)).mean() < 3


async def test_key_frame_on_request_ends_the_wait(codecs: Codecs) -> None:
    encoder, decoder = codecs.h264_encoder(keyint=KEYINT), codecs.h264_decoder()
    await encoded(encoder, 3)
    assert await decoder.decode(await encoder.encode(drawn(3))) is None
    encoder.request_key_frame()
    for number in range(4, 8):
        got = await decoder.decode(await encoder.encode(drawn(number)))
        assert got is not None
        assert read_stamp(got.grey()) == (number, number * 1000)


@pytest.mark.parametrize(
    ("data", "found"),
    [
        ("000000010605ffff", (False, None)),
        ("00000001674d 0000000168ee 00000001 06 0602 4180 80 000001 41 9a", (False, 1)),
        ("00000001 06 0601 c0 80 000001 41 9a", (False, 0)),
        ("00000001 06 0502 0000 0602 0880 80 000001 41 9a", (False, 16)),
        ("000001 65 88", (True, None)),
        ("", (False, None)),
        ("000001", (False, None)),
        ("000001 06", (False, None)),
    ],
)
def test_random_access_points_are_read_from_the_units(
    data: str, found: tuple[bool, int | None]
) -> None:
    assert random_access_point(bytes.fromhex(data)) == found


@given(st.binary(max_size=60))
def test_any_bytes_have_a_random_access_point_or_none(data: bytes) -> None:
    for given_data in (data, b"\0\0\1\6" + data, b"\0\0\1\6\6" + data):
        key, refresh = random_access_point(given_data)
        assert isinstance(key, bool)
        assert refresh is None or refresh >= 0


async def test_damaged_frame_is_an_error_and_counts_as_a_loss(codecs: Codecs) -> None:
    sent = await encoded(codecs.h264_encoder(keyint=KEYINT, crf=10), 5 * KEYINT)
    for damage in (lambda data: data[: len(data) // 2], lambda data: b"nothing of the kind"):
        decoder = codecs.h264_decoder()
        for one in sent[:10]:
            await decoder.decode(one)
        with pytest.raises(FrameFormatError, match="expected a whole encoded frame"):
            await decoder.decode(replace(sent[10], data=damage(bytes(sent[10].data))))
        got = [await decoder.decode(one) for one in sent[11:]]
        assert got[0] is None
        assert got[-1] is not None


async def test_another_size_restarts_the_stream_and_a_wrong_one_is_refused(codecs: Codecs) -> None:
    encoder, decoder = codecs.h264_encoder(), codecs.h264_decoder()
    await encoder.encode(drawn(0))
    small = await encoder.encode(frame_of(stamped(1, 256, 32), "Mono8"))
    assert await codecs.h264_decoder().decode(small) is not None
    with pytest.raises(FrameFormatError, match=f"got .* a picture of {WIDTH}x{HEIGHT}"):
        await decoder.decode(
            replace(await codecs.h264_encoder().encode(drawn(1)), width=WIDTH - 32)
        )


@pytest.mark.parametrize("steps", range(5))
async def test_stream_is_whole_after_a_cancelled_call(codecs: Codecs, steps: int) -> None:
    encoder, decoder = codecs.h264_encoder(keyint=KEYINT, crf=18), codecs.h264_decoder()
    for number in range(3):
        await decoder.decode(await encoder.encode(drawn(number)))
    task = asyncio.create_task(encoder.encode(drawn(100)))
    for _ in range(steps):
        await asyncio.sleep(0)
    task.cancel()
    await asyncio.wait([task])
    if not task.cancelled():  # done before the cancellation
        await decoder.decode(task.result())
    for number in range(4, 8):
        got = await decoder.decode(await encoder.encode(drawn(number)))
        assert got is not None
        assert np.abs(got.grey().astype(int) - stamped(number)).mean() < 3


async def test_cancelled_decoding_counts_as_a_loss(
    codecs: Codecs, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = await encoded(codecs.h264_encoder(keyint=KEYINT, crf=18), 4 * KEYINT)
    decoder = codecs.h264_decoder()
    await decoder.decode(sent[0])
    gate, begun, decode = threading.Event(), threading.Event(), decoder._decode

    def slow(frame: Frame, losses: int) -> Frame | None:
        begun.set()
        assert gate.wait(60)
        return decode(frame, losses)

    monkeypatch.setattr(decoder, "_decode", slow)
    task = asyncio.create_task(decoder.decode(sent[1]))
    await asyncio.to_thread(begun.wait, 60)
    task.cancel()
    await asyncio.wait([task])
    gate.set()
    got = [await decoder.decode(one) for one in sent[2:]]
    assert got[0] is None
    assert got[-1] is not None
