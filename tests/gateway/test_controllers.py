"""The examples for controllers, run as they stand against a gateway with an emulated camera."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam.emulator import EmulatedCamera
from smartcam.gateway import Gateway, GatewaySettings
from tests.gateway.controllers import (
    FanucController,
    KukaController,
    SiemensController,
    UrController,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

CONTROLLERS: dict[str, Any] = {
    "ur": UrController,
    "kuka": KukaController,
    "fanuc": FanucController,
    "siemens": SiemensController,
}
ANGLE = {"ur": 5, "kuka": 3, "fanuc": 5, "siemens": 3}
"""Place in a pose of the turn about the vertical axis."""


def pose_of(robot: str, numbers: Sequence[float]) -> tuple[float, float, float]:
    """Return x, y in metres and the turn in radians of what a controller has read."""
    if robot == "ur":
        return numbers[0], numbers[1], numbers[5]
    return numbers[0] / 1000, numbers[1] / 1000, math.radians(numbers[ANGLE[robot]])


@pytest.mark.real_time
@pytest.mark.parametrize("robot", CONTROLLERS)
async def test_example_picks_every_part_once_and_then_asks_for_new_ones(robot: str) -> None:
    settings = GatewaySettings(robot=robot, listen="tcp/127.0.0.1:0")  # type: ignore[arg-type]
    async with (
        EmulatedCamera(seed=1) as emulator,
        smartcam.connect(emulator.url, application=7, interpret_as="localizations") as camera,
        Gateway(camera, settings) as gateway,
    ):
        truth = [(one.x, one.y, one.theta) for one in emulator.scene.pieces.values()]
        picks = len(truth) + 2  # into a second picture
        controller = CONTROLLERS[robot](int(gateway.address.rpartition(":")[2]), picks)
        await asyncio.to_thread(controller.run)
    counts = gateway.counts
    assert len(controller.poses) == picks
    for numbers, (x, y, theta) in zip(controller.poses, [*truth, *truth[:2]], strict=True):
        found = pose_of(robot, numbers)
        assert math.dist(found[:2], (x, y)) < 0.001
        assert abs(math.remainder(found[2] - theta, math.tau)) < 0.02
    assert counts.errors == 0
    assert counts.delivered == picks
    assert counts.parts == counts.delivered + counts.forgotten + counts.waiting
    assert counts.requests == counts.answered + counts.errors + counts.abandoned


@pytest.mark.real_time
@pytest.mark.parametrize("robot", CONTROLLERS)
async def test_example_takes_no_part_of_an_answer_that_comes_too_late(robot: str) -> None:
    """The camera takes longer than the controller waits: it hangs up, and picks nothing."""
    slow = {"id": 7, "layout": "(x: real32, y: real32)*", "processing_time": 1.0, "load_time": 0,
            "constant": [{"x": 0.1, "y": 0.2}]}  # fmt: skip
    settings = GatewaySettings(robot=robot, listen="tcp/127.0.0.1:0", timeout=5)  # type: ignore[arg-type]
    interpret_as = "localizations: (x: real32, y: real32)*"
    async with (
        EmulatedCamera(applications=[slow]) as emulator,
        smartcam.connect(emulator.url, application=7, interpret_as=interpret_as) as camera,
        Gateway(camera, settings) as gateway,
    ):
        port = int(gateway.address.rpartition(":")[2])
        controller = CONTROLLERS[robot](port, 1, patience=0.03)
        await asyncio.to_thread(controller.run)
    assert controller.poses == []
    assert controller.errors == [99, 99, 99]
    assert gateway.counts.delivered == 0
    assert gateway.counts.abandoned >= 2  # the last one may not have come any more
