"""Several programs at one camera, in short; the long form is a command of the proof."""

from __future__ import annotations

import pytest

from tests.proofs.fleet_storm import Figures, storm_in_process, storm_over_zenoh


def check(figures: Figures, calls: int) -> None:
    assert figures.violations == []
    assert figures.calls >= calls
    assert figures.outcomes["result"] > 0.2 * calls
    assert figures.outcomes["cancelled"] > 0


async def test_each_gets_its_own_result_inside_a_process() -> None:
    check(await storm_in_process(300, 1), 300)


@pytest.mark.long
@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.widest)])
async def test_each_gets_its_own_result_inside_a_process_for_long(seed: int) -> None:
    figures = await storm_in_process(3000, seed)
    check(figures, 3000)
    assert figures.restarts > 0


@pytest.mark.long
@pytest.mark.real_time
async def test_each_gets_its_own_result_over_zenoh() -> None:
    """Two programs, of which one is stopped for a moment; and one that is killed."""
    figures = await storm_over_zenoh(120, 1, programs=2, kills=1, stop=0.2)
    check(figures, 120)
    assert (figures.killed, figures.stopped) == (1, 1)
