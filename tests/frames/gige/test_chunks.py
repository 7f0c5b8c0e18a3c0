"""Chunk data: what the camera sends with each picture, on the frame."""

import asyncio

import pytest

import smartcam.frames
from tests.frames.gige import camera as cameras
from tests.frames.gige.camera import camera, number_in


async def test_values_that_come_with_a_picture_are_on_its_frame() -> None:
    async with (
        camera() as there,
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


async def test_chunk_data_that_cannot_be_read_is_told_and_the_picture_stays() -> None:
    async with (
        camera(payload_type=0x4001) as there,
        smartcam.frames.open(f"gige://127.0.0.1:{there.port}?packet_size=576") as source,
    ):
        there.words[cameras.PAYLOAD_EXTRA] = 700
        await source.features["BlackLevel"].set(1.0)  # its PayloadSize is read anew
        frame = await source.newest()
        assert number_in(frame)
        assert frame.chunks == {}
        assert "chunk data" in frame.remark
