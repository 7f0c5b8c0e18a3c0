"""A frame that does not become whole ends the link; the camera is there again at once."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from typing import TYPE_CHECKING, Any

import pytest
from bid_by_hand import bid_by_hand
from camera_by_hand import HEADER, MAGIC, RESULT, STATUS, HandmadeCamera
from camera_scripts import FAST, SOON
from clientkit import by_hand, gone, steps

from smartcam import ConnectionLostError, FrameError
from smartcam.protocols.framed import frame_age

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam import SmartCamera

MILLION = 1_000_000
each_dialect = pytest.mark.parametrize("dialect", ["handbook", "thesis"])


@contextlib.asynccontextmanager
async def speaking(box: HandmadeCamera, data: bytes) -> AsyncIterator[None]:
    """Have a camera say the same again and again, byte by byte, until the client comes back."""
    before = box.connections

    async def speak() -> None:
        for byte in itertools.cycle(data):
            if box.connections != before:
                return
            box.send(bytes([byte]))
            await asyncio.sleep(0.001)  # so that it is a segment of its own, mostly

    task = asyncio.create_task(speak())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait({task})


async def lost(camera: SmartCamera) -> str:
    """Wait until the link is lost; return the text of the broken frame's error."""
    async with asyncio.timeout(SOON):
        error = await gone(asyncio.create_task(camera.wait_status(lambda _: False, SOON)))
    assert isinstance(error, ConnectionLostError)
    assert isinstance(error.__cause__, FrameError)
    return str(error.__cause__)


@each_dialect
async def test_false_length_of_a_status_ends_the_link_at_its_header(dialect: str) -> None:
    async with by_hand(box={"dialect": dialect}, reconnect=FAST) as (box, camera):
        losing = asyncio.create_task(lost(camera))
        await steps(2)
        box.send(HEADER.pack(MAGIC[dialect], MILLION, STATUS))
        assert "announces" in await losing
        await camera.wait_connected(SOON)
        assert (await camera.trigger()).raw == b"found"


@each_dialect
async def test_false_length_of_a_result_ends_the_link_when_others_come(
    dialect: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_age, "HINT_TIME", 0.0)
    async with by_hand(box={"dialect": dialect}, reconnect=FAST) as (box, camera):
        results = camera.results()
        losing = asyncio.create_task(lost(camera))
        await steps(2)
        box.send(box.result_frame(b"before") + HEADER.pack(MAGIC[dialect], MILLION, RESULT))
        async with speaking(box, box.result_frame(b"unheard")):
            assert "holds another header" in await losing
            await camera.wait_connected(SOON)
        box.send(box.result_frame(b"behind"))
        assert [(await anext(results)).raw for _ in range(2)] == [b"before", b"behind"]
        assert (await camera.trigger()).raw == b"found"


@pytest.mark.parametrize("kind", ["handbook", "thesis", "bid"])
async def test_frame_that_trickles_ends_the_link(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"HINT_TIME": 0.0, "FRAME_TIME": 0.0, "FRAME_RATE": float("inf")}.items():
        monkeypatch.setattr(frame_age, name, value)
    box_of: Any = {"dialect": kind} if kind != "bid" else {}
    opening: Any = by_hand if kind != "bid" else bid_by_hand
    async with opening(box=box_of, reconnect=FAST) as (box, camera):
        losing = asyncio.create_task(lost(camera))
        await steps(2)
        box.send(box.frame(RESULT, bytes(60_000))[:99])
        async with speaking(box, b"\xff"):
            assert "does not become whole" in await losing
            await camera.wait_connected(SOON)
        assert (await camera.trigger()).raw == b"found"
