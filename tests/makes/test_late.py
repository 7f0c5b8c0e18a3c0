"""Test for each make that a late result is never returned to the next trigger.

The tests move the camera's clock by hand, so they do not depend on the speed of the machine. The
reason for each make's rule is in ``docs/decisions/0036-makes.md``.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

import smartcam
from smartcam import Camera
from smartcam.emulator import LineCamera, ManualClock
from smartcam.exceptions import TriggerTimeoutError
from smartcam.makes import EmulatedIfm, EmulatedIv3, EmulatedSr
from smartcam.models import Statistics
from smartcam.protocols import messages as m
from tests.handmade import until
from tests.makes.cameras import IV3_NUMBERS, NUMBERS

PATIENCE = 10.0
"""Largest number of seconds that a test waits for something."""

INSPECTION = 1.0
"""Seconds of an inspection, by the camera's clock."""


def ifm(clock: ManualClock) -> EmulatedIfm:
    defaults = {"parts": NUMBERS, "processing_time": INSPECTION}
    return EmulatedIfm(defaults=defaults, clock=clock)


def iv3(clock: ManualClock) -> EmulatedIv3:
    parts = [(one["n"],) for one in NUMBERS]
    return EmulatedIv3(parts=parts, processing_time=INSPECTION, clock=clock)


def sr(clock: ManualClock) -> EmulatedSr:
    """Return a reader that sends what it has read long after the reading's end."""
    codes = [str(one["n"]) for one in NUMBERS]
    options: dict[str, Any] = {"waits_for_end": True, "answer_time": INSPECTION}
    return EmulatedSr(codes=codes, reading_time=0.0, clock=clock, **options)


MAKES: dict[str, tuple[Callable[[ManualClock], LineCamera], str, str]] = {
    "ifm": (ifm, "?dialect=v3", "n: uint32"),
    "ifm, asynchronous": (ifm, "?dialect=v3&trigger=async", "n: uint32"),
    "iv3": (iv3, "", IV3_NUMBERS),
    "sr": (sr, "", "read: bool, n: string[10]"),
}


@contextlib.asynccontextmanager
async def manual_camera(make: str) -> AsyncIterator[tuple[LineCamera, ManualClock, Camera[Any]]]:
    """Run a camera with a manual clock, and a client of it."""
    put_up, query, layout = MAKES[make]
    clock = ManualClock()
    async with (
        put_up(clock) as emulator,
        smartcam.connect(f"{emulator.url}{query}", interpret_as=layout) as camera,
    ):
        yield emulator, clock, camera


def count_triggers(emulator: LineCamera) -> int:
    """Return the number of triggers that the camera has received."""
    return sum(isinstance(one.message, m.Trigger) for one in emulator.log)


def check_balance(statistics: Statistics) -> None:
    fates = ("triggered", "streamed", "late", "wrong_application", "uninterpretable", "unclaimed")
    assert statistics.received == sum(getattr(statistics, one) for one in fates)


@pytest.mark.parametrize("make", MAKES)
@pytest.mark.asyncio
async def test_late_result_is_never_the_next_triggers(make: str) -> None:
    async with manual_camera(make) as (emulator, clock, camera):
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=0.05)
        assert count_triggers(emulator) == 1
        second = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        await asyncio.sleep(0.05)  # long enough to send it too early
        while not second.done():
            clock.advance(INSPECTION / 10)
            await asyncio.sleep(0.002)
        result = await second
        assert int(result.value.n) == 1, "the result of the first trigger, which was given up"
        assert camera.statistics().triggered == 1
        check_balance(camera.statistics())


@pytest.mark.parametrize("make", MAKES)
@pytest.mark.asyncio
async def test_cancelled_triggers_result_is_never_the_next_ones(make: str) -> None:
    async with manual_camera(make) as (emulator, clock, camera):
        first = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        await until(lambda: count_triggers(emulator) == 1)
        first.cancel()
        await asyncio.wait({first})
        second = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        while not second.done():
            clock.advance(INSPECTION / 10)
            await asyncio.sleep(0.002)
        result = await second
        assert int(result.value.n) == 1
        check_balance(camera.statistics())


@pytest.mark.parametrize("make", MAKES)
@pytest.mark.asyncio
async def test_late_result_goes_to_streams_and_is_counted_late(make: str) -> None:
    async with manual_camera(make) as (_, clock, camera), camera.results() as results:
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=0.05)
        clock.advance(2 * INSPECTION)
        async with asyncio.timeout(PATIENCE):
            late = await anext(results)
        assert late.latency is None
        assert camera.statistics().late == 1
        check_balance(camera.statistics())
