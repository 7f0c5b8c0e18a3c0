"""Test that triggers which time out or are cancelled at random leave no result to a later trigger.

Each value is the number of the run that it comes from, as counted by the emulated camera. A result
is the trigger's own only if its run is the last one that began, since nobody else triggers.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import random
from typing import Any

import pytest

import smartcam
from smartcam.emulator import LineClient
from smartcam.exceptions import TriggerTimeoutError
from smartcam.makes import EmulatedIfm, EmulatedIv3, EmulatedSr
from tests.makes.cameras import IV3_NUMBERS

STEPS = 60
SEEDS = range(6)


class Ifm(EmulatedIfm):
    """A sensor whose values are the numbers of its evaluations."""

    def __init__(self, **options: Any) -> None:
        super().__init__(
            applications=[{"id": 1, "processing_time": 0.05, "parts": [{"n": 0}]}], **options
        )
        self.parts[1] = ({"n": self.runs} for _ in itertools.count())

    @property
    def runs(self) -> int:
        return self._run_number


class Iv3(EmulatedIv3):
    """A sensor whose first tool's rate is the number of the trigger."""

    runs = 0

    def __init__(self, **options: Any) -> None:
        super().__init__(processing_time=0.05, **options)
        self.parts[0] = ((self.runs,) for _ in itertools.count())

    def hear(self, client: LineClient, line: str) -> None:
        self.runs += line == "T2"
        super().hear(client, line)


class Sr(EmulatedSr):
    """A reader whose codes are the numbers of its readings."""

    def __init__(self, **options: Any) -> None:
        super().__init__(reading_time=0.05, **options)
        self.codes = (str(self.runs) for _ in itertools.count())  # type: ignore[assignment]

    @property
    def runs(self) -> int:
        return self._reading_number


CAMERAS: dict[str, tuple[Any, str, str]] = {
    "ifm": (Ifm, "dialect=v3", "n: int32"),
    "ifm, asynchronous": (Ifm, "dialect=v3&trigger=async", "n: int32"),
    "iv3": (Iv3, "dialect=lines", IV3_NUMBERS),
    "sr": (Sr, "dialect=lines", "read: bool, n: string[10]"),
    "sr, late": (
        lambda: Sr(answer_time=0.12, waits_for_end=True),
        "dialect=lines",
        "read: bool, n: string[10]",
    ),
}


async def storm(camera: smartcam.Camera[Any], emulator: Any, chance: random.Random) -> int:
    """Trigger with random timeouts and cancellations; return the number of results.

    Each result has to be of the last run that began.
    """
    result_count = 0
    for _ in range(STEPS):
        timeout = chance.choice((0.01, 0.04, 0.06, 0.1, 0.3, 2.0))
        trigger = asyncio.create_task(camera.trigger(timeout=timeout))
        if chance.random() < 0.3:
            await asyncio.sleep(chance.uniform(0.0, 0.1))
            trigger.cancel()
        try:
            result = await trigger
        except (asyncio.CancelledError, TriggerTimeoutError):
            continue
        if result.raw != b"ERROR":
            result_count += 1
            assert int(result.value.n) == emulator.runs, "the result is of an earlier run"
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(chance.choice((0.0, 0.02))):
                await asyncio.sleep(1.0)
    return result_count


@pytest.mark.sampled(every=6)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.asyncio
async def test_no_trigger_gets_the_result_of_a_run_from_before_it(name: str, seed: int) -> None:
    make, query, layout = CAMERAS[name]
    async with (
        make() as emulator,
        smartcam.connect(f"{emulator.url}?{query}", interpret_as=layout) as camera,
    ):
        result_count = await storm(camera, emulator, random.Random(seed))  # noqa: S311
        assert result_count >= 1
        account = camera.statistics()
        fates = ("triggered", "streamed", "late", "wrong_application", "uninterpretable")
        found = sum(getattr(account, one) for one in (*fates, "unclaimed"))
        assert account.received == found
        assert account.triggered >= result_count


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.asyncio
async def test_cancelling_at_any_step_leaves_the_next_trigger_its_own_result(name: str) -> None:
    make, query, layout = CAMERAS[name]
    async with (
        make() as emulator,
        smartcam.connect(f"{emulator.url}?{query}", interpret_as=layout) as camera,
    ):
        for steps in range(40):
            trigger = asyncio.create_task(camera.trigger(timeout=2.0))
            for _ in range(steps):
                await asyncio.sleep(0)
            trigger.cancel()
            await asyncio.wait({trigger})
            result = await camera.trigger(timeout=5.0)
            assert int(result.value.n) == emulator.runs, f"after {steps} steps"
        assert camera.statistics().sessions == 1
