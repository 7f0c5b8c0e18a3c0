"""The storm of late results, short: ``late_storm.py`` has the long form."""

from __future__ import annotations

from typing import TYPE_CHECKING

import late_storm
from storm_variants import VARIANTS

if TYPE_CHECKING:
    import pytest

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
        assert one.late > one.calls / 20, one.variant.name


async def test_storm_where_nothing_is_promised_counts_wrong_results() -> None:
    """The proof itself: it sees a wrong result where there is one."""
    variant = next(one for one in VARIANTS if one.name == "best effort: udp held")
    done = await late_storm.storm(variant, CALLS, SEED)
    assert done.violations == []
    assert done.wrong > 0


async def test_debt_that_is_paid_soon_costs_no_fence() -> None:
    assert await late_storm.debt_cost(0.01) < await late_storm.debt_cost(1.0)
