"""Objects of a fleet that were opened and not closed say so when nobody has them any more.

Its bus has it until the event loop is gone; the engine of a bus between processes has it for good.
"""

from __future__ import annotations

import asyncio
import gc
import warnings
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

import smartcam.fleet
from smartcam.fleet import FleetServer, MemoryBus
from tests.fleet.fleetkit import Plant

CAMERA = "line1/cam1"


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    """The file of a fleet with one emulated camera."""
    path = tmp_path / "fleet.yaml"
    path.write_text(f"fleet: plant\ncameras:\n  {CAMERA}: {{emulated: {{}}}}\n", encoding="utf-8")
    return path


def said_of(opened: Callable[[], Awaitable[object]]) -> list[str]:
    """Run something to its end, have nobody refer to what it leaves, return the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        asyncio.run(_run(opened))
        gc.collect()
    return [str(one.message) for one in caught if one.category is ResourceWarning]


async def _run(opened: Callable[[], Awaitable[object]]) -> None:
    await opened()


@pytest.mark.real_time
def test_fleet_and_agent_that_nobody_has_say_that_they_were_not_closed(plan: Path) -> None:
    said = said_of(lambda: smartcam.fleet.open(str(plan)).open())
    assert "<Fleet fleet://, 1 cameras> was not closed" in said
    assert any(one.startswith("agent ") and one.endswith(" was not stopped") for one in said)


@pytest.mark.real_time
def test_agent_that_nobody_has_says_that_it_was_not_stopped(plan: Path) -> None:
    async def start() -> None:
        await FleetServer(str(plan), bus=MemoryBus().new_connection()).start()

    assert any("of fleet plant was not stopped" in one for one in said_of(start))


@pytest.mark.real_time
def test_camera_of_a_fleet_that_nobody_has_says_that_it_was_not_closed() -> None:
    async def leave() -> None:
        async with Plant() as plant:
            await plant.camera().open()
            async with plant.camera():
                pass

    assert [one for one in said_of(leave) if "FleetCamera" in one and "was not closed" in one]


@pytest.mark.real_time
def test_fleet_that_was_closed_or_never_opened_says_nothing(plan: Path) -> None:
    async def close() -> None:
        smartcam.fleet.open(str(plan))
        smartcam.fleet.serve(str(plan))
        async with smartcam.fleet.open(str(plan)) as fleet:
            assert len(fleet) == 1

    assert said_of(close) == []
