"""Cameras of a fleet: the same interface as other cameras, their types, and names of holders."""

from __future__ import annotations

import asyncio
import os
import socket
from typing import TYPE_CHECKING, Any, assert_type

import pytest

import smartcam
import smartcam.fleet
import smartcam.sync
from smartcam.exceptions import ConfigurationError, TriggerTimeoutError, UnsupportedError
from smartcam.sync import SyncCamera
from smartcam.testing import ThreadedCamera

if TYPE_CHECKING:
    from smartcam import Camera

PLANT = {
    "listen": "tcp/127.0.0.1:0",
    "cameras": {"a/b": {"emulated": {}, "application": 7, "interpret_as": "localizations"}},
}

HOST = socket.gethostname().partition(".")[0].lower()


@pytest.mark.real_time
async def test_camera_without_asyncio_is_reserved_and_says_by_whom() -> None:
    plant = smartcam.fleet.FleetFile.model_validate(PLANT)
    async with smartcam.fleet.serve(plant) as server:
        url = server.urls["a/b"]
        await asyncio.to_thread(reserve_in_turn, url)


def reserve_in_turn(url: str) -> None:
    with (
        smartcam.sync.connect(f"{url}?program=robot1") as robot,
        smartcam.sync.connect(url) as other,
    ):
        assert_type(robot, SyncCamera[Any])
        with robot.reserve(timeout=5.0) as mine:
            first = mine.trigger()
            with pytest.raises(TriggerTimeoutError) as caught:
                other.trigger(timeout=0.3)
            second = robot.trigger()
        third = other.trigger()
    assert [first.number, second.number, third.number] == [1, 2, 3]
    assert first.value[0].feature_id
    assert f"reserved by robot1 on {HOST}, pid {os.getpid()}, which" in str(caught.value)


def test_camera_at_the_wire_says_that_it_cannot_be_reserved() -> None:
    with (
        ThreadedCamera(active=21, running=True) as emulator,
        smartcam.sync.connect(emulator.url) as camera,
    ):
        with pytest.raises(UnsupportedError, match="cannot be reserved"), camera.reserve():
            pass
        with pytest.raises(UnsupportedError, match="a new connection takes it back"):
            camera.take_back()
        with pytest.raises(ConfigurationError, match="timeout"):
            camera.reserve(timeout="soon").__enter__()  # type: ignore[arg-type]


async def reserve(camera: Camera[Any]) -> None:
    """Be accepted by type checkers, as docs/sharing-a-camera.md has it."""
    async with camera.reserve(timeout=5.0) as mine:
        assert_type(mine, smartcam.Camera[Any])
