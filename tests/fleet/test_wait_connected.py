"""Waiting for a session on a bus that loses messages."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import pytest

from smartcam.exceptions import ResponseTimeoutError
from tests.fleet.fleetkit import Plant
from tests.fleet.lossy_bus import LossyBus, only

ASK_AGAIN = 2.0


class Losing:
    """Loses the first questions that are asked, or answers."""

    def __init__(self, count: int) -> None:
        self.left = count

    def __call__(self, key: str, payload: bytes) -> Sequence[float]:
        self.left -= 1
        return (0.0,) if self.left < 0 else ()


@pytest.mark.parametrize("kind", ["ask", "reply"])
async def test_question_that_was_lost_is_asked_again(kind: str) -> None:
    bus = LossyBus()
    async with Plant(bus=bus) as plant, plant.camera() as camera:
        begun = asyncio.get_running_loop().time()
        bus.fate = only(kind, Losing(1))
        await camera.wait_connected(30.0)
        took = asyncio.get_running_loop().time() - begun
        assert ASK_AGAIN <= took < 2 * ASK_AGAIN
        assert bus.lost == 1


async def test_bus_that_loses_all_ends_it_by_its_deadline() -> None:
    bus = LossyBus()
    async with Plant(bus=bus) as plant, plant.camera() as camera:
        loop = asyncio.get_running_loop()
        begun = loop.time()
        bus.fate = only("ask", Losing(1000))
        with pytest.raises(
            ResponseTimeoutError, match=r"no session within 5 s.*did not answer"
        ) as got:
            await camera.wait_connected(5.0)
        assert got.value.waited == 5.0
        assert loop.time() - begun < 5.5
        bus.fate = only("ask", Losing(0))
        await camera.wait_connected(5.0)
