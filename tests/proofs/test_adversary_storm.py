"""The storm of an adversary, short: ``adversary_storm.py`` has the long form."""

from __future__ import annotations

import adversary_storm
import pytest
from adversary_storm import VARIANTS

pytestmark = pytest.mark.long

CALLS = 100
SEED = 1


async def test_storm_of_an_adversary_gives_no_trigger_an_older_result(
    capsys: pytest.CaptureFixture[str],
) -> None:
    variants = [one for one in VARIANTS if one.rule != "count"]
    done = await adversary_storm.storms(variants, CALLS, SEED, at_once=len(variants))
    with capsys.disabled():
        print(f"\nseed {SEED}\n{adversary_storm.table(done)}")  # noqa: T201
    assert [text for one in done for text in one.violations] == []
    for one in done:
        assert one.outcomes["result"] > one.calls / 20, one.variant.name


async def test_storm_of_an_adversary_counts_wrong_results_where_nothing_is_promised() -> None:
    """The proof itself: it sees a wrong result where there is one."""
    variant = next(one for one in VARIANTS if one.name == "best effort: udp")
    done = await adversary_storm.storm(variant, CALLS, SEED)
    assert done.violations == []
    assert done.wrong > 0
