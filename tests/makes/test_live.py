"""Run smartcam's suite for cameras with the makes' emulated cameras."""

from __future__ import annotations

import asyncio

import pytest

import smartcam
from smartcam.exceptions import OvertriggeredError
from smartcam.testing import CameraKind, CameraSuite, LiveCamera
from tests.handmade import until
from tests.makes.cameras import IFM_KINDS, IV3_KINDS, SR_KINDS

pytestmark = [pytest.mark.long, pytest.mark.widest]


class TestIfm(CameraSuite):
    camera_kinds = IFM_KINDS

    def test_trigger_while_somebody_elses_inspection_runs_waits_for_its_end(
        self, camera_kind: CameraKind
    ) -> None:
        """Test the same as the suite; the suite's camera shows in its status that it inspects."""

        async def look() -> None:
            async with (
                camera_kind.open() as live,
                smartcam.connect(
                    live.url, application=LiveCamera.SLOW, interpret_as=camera_kind.numbers
                ) as camera,
            ):
                if not camera.capabilities.unasked_results:
                    return
                live.trigger()
                assert (await camera.trigger()).value.n == 1
                statistics = camera.statistics()
                assert (statistics.triggered, statistics.received) == (1, 2)

        asyncio.run(look())

    def test_trigger_dropped_while_ours_is_under_way_is_an_overtrigger(
        self, camera_kind: CameraKind
    ) -> None:
        """Test the same as the suite; with a ticket the result is the trigger's own."""

        async def look() -> None:
            async with (
                camera_kind.open() as live,
                smartcam.connect(
                    live.url, application=LiveCamera.SLOW, interpret_as=camera_kind.numbers
                ) as camera,
            ):
                task = asyncio.create_task(camera.trigger())
                await until(lambda: live.inspects)
                live.trigger()
                if "async" in live.url:
                    with pytest.raises(OvertriggeredError):
                        await task
                else:
                    assert (await task).value.n == 0

        asyncio.run(look())


class TestIv3(CameraSuite):
    camera_kinds = IV3_KINDS


class TestSr(CameraSuite):
    camera_kinds = SR_KINDS
