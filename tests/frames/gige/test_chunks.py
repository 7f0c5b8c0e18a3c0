"""Chunk data that a camera sends with each picture is on the frame."""

import asyncio

import pytest

import smartcam.frames
from tests.frames.gige import camera as cameras
from tests.frames.gige.camera import camera, number_in


@pytest.mark.parametrize("chunk_type", [0x4001, 4, 5])
async def test_chunk_values_of_a_picture_are_on_its_frame(chunk_type: int) -> None:
    async with (
        camera(chunk_type=chunk_type) as there,
        smartcam.frames.open(
            f"gige://127.0.0.1:{there.port}?packet_size=576&feature.ChunkModeActive=true"
        ) as source,
        source.reader() as reader,
    ):
        for _ in range(5):
            frame = await anext(reader)
            assert frame.chunks == {
                "ChunkExposureTime": 1000.0,
                "ChunkFrameID": number_in(frame),
                "ChunkLineStatusAll": 0x5,
                "ChunkPixelFormat": "Mono8",
            }
            assert not frame.remark
            assert len(frame.data) == 64 * 48
        there.words[cameras.EXPOSURE] = 0x40A00000
        there.words[cameras.LINES] = 0xA
        async with asyncio.timeout(20):
            while frame.chunks["ChunkLineStatusAll"] != 0xA:
                frame = await anext(reader)
        assert frame.chunks["ChunkLineStatusAll"] == 0xA
        assert frame.chunks["ChunkExposureTime"] == 2048.0


async def test_without_chunks_there_are_no_values() -> None:
    async with (
        camera() as there,
        smartcam.frames.open(f"gige://127.0.0.1:{there.port}?packet_size=576") as source,
    ):
        frame = await source.newest()
        assert frame.chunks == {}
        with pytest.raises(smartcam.exceptions.FrameSourceError, match="not available now"):
            await source.features["ChunkExposureTime"].get()
        with pytest.raises(smartcam.exceptions.FrameSourceError, match="with each frame only"):
            await source.features["ChunkFrameID"].get()


async def test_unreadable_chunk_data_is_reported_and_the_picture_stays() -> None:
    async with (
        camera(payload_type=0x4001) as there,
        smartcam.frames.open(f"gige://127.0.0.1:{there.port}?packet_size=576") as source,
    ):
        there.words[cameras.PAYLOAD_EXTRA] = 700
        await source.features["BlackLevel"].set(1.0)  # PayloadSize is read again
        frame = await source.newest()
        assert number_in(frame)
        assert frame.chunks == {}
        assert "chunk data" in frame.remark


@pytest.mark.parametrize("rows", [40, 47])
async def test_chunk_data_of_another_size_than_in_the_features_is_no_picture(rows: int) -> None:
    async with (
        camera(chunk_type=4) as there,
        smartcam.frames.open(
            f"gige://127.0.0.1:{there.port}?packet_size=576&feature.ChunkModeActive=true"
        ) as source,
        source.reader() as reader,
    ):
        frame = await anext(reader)
        assert (frame.width, frame.height, frame.stride) == (64, 48, 64)
        there.words[cameras.HEIGHT] = rows  # a lock that the camera does not keep
        with pytest.raises(
            smartcam.exceptions.FrameFormatError,
            match=rf"64x48 has 3072 bytes, the chunk that came has {64 * rows}",
        ):
            await _until_the_end(reader)


async def _until_the_end(reader: smartcam.frames.FrameReader) -> None:
    async for frame in reader:
        assert frame.height == 48


async def test_chunk_data_without_its_ends_is_no_picture() -> None:
    async with camera(payload_type=4) as there:
        there.words[cameras.PAYLOAD_EXTRA] = 700
        async with smartcam.frames.open(f"gige://127.0.0.1:{there.port}?packet_size=576") as source:
            with pytest.raises(smartcam.exceptions.FrameFormatError, match="cannot be read"):
                await source.newest()
