"""The storm of late results, short: ``late_storm.py`` has the long form."""

from __future__ import annotations

from typing import TYPE_CHECKING

import late_storm
import pytest
from storm_variants import VARIANTS

import smartcam
from smartcam.emulator import EmulatedCamera
from smartcam.emulator import faults as f
from smartcam.models import Status

if TYPE_CHECKING:
    from collections.abc import Sequence

pytestmark = pytest.mark.long

CALLS = 150
SEED = 1


async def test_storm_of_late_results_gives_no_trigger_another_ones_result(
    capsys: pytest.CaptureFixture[str],
) -> None:
    variants = [one for one in VARIANTS if one.promised]
    done = await late_storm.storms(variants, CALLS, SEED, at_once=7)
    with capsys.disabled():
        print(f"\nseed {SEED}\n{late_storm.table(done)}")  # noqa: T201
    assert [text for one in done for text in one.violations] == []
    for one in done:
        assert one.outcomes["result"] > one.calls / 20, one.variant.name
        # loading an application after each trigger whose input is in doubt pays the debts
        fewest = 0.0 if one.variant.habits.reads_input else one.calls / 20
        assert one.late > fewest, one.variant.name


async def test_storm_where_nothing_is_promised_counts_wrong_results() -> None:
    """The proof itself: it sees a wrong result where there is one."""
    variant = next(one for one in VARIANTS if one.name == "best effort: udp held")
    done = await late_storm.storm(variant, CALLS, SEED)
    assert done.violations == []
    assert done.wrong > 0


async def test_debt_that_is_paid_soon_costs_no_fence() -> None:
    assert await late_storm.debt_cost(0.01) < await late_storm.debt_cost(1.0)


async def test_debt_is_awaited_where_no_stop_can_void_it() -> None:
    assert await late_storm.debt_cost(0.3, "bid") > 290


FEEDABLE = {"id": 5, "layout": "n: int32", "input": "token: int32", "generator": "sequence"}
ANSWER_IS_LATE: dict[str, Sequence[f.BaseFault]] = {
    "SetInputAnswer": [f.Delay(on="SetInputAnswer", seconds=0.1)],
    "ResetErrorsAnswer": [
        f.Overtrigger(on="Trigger"),
        f.Delay(on="ResetErrorsAnswer", seconds=0.1),
    ],
}


@pytest.mark.parametrize("name", ANSWER_IS_LATE)
async def test_trigger_shorter_than_an_answer_that_it_needs_does_not_cost_the_link(
    name: str,
) -> None:
    faults = ANSWER_IS_LATE[name]
    async with (
        EmulatedCamera([FEEDABLE], active=5, dialect="bid", faults=faults) as emulator,
        smartcam.connect(emulator.url) as camera,
    ):
        for _ in faults[1:]:
            with pytest.raises(smartcam.OvertriggeredError):
                await camera.trigger(input=bytes(4))
        with pytest.raises(smartcam.TriggerTimeoutError, match="no trigger was sent"):
            await camera.trigger(input=bytes(4), timeout=0.05)
        assert (await camera.trigger(input=bytes(4))).application == 5
        assert Status.OVERTRIGGERED not in camera.status
        assert camera.statistics().sessions == 1
