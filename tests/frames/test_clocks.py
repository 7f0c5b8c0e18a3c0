"""Convert times of a camera's clock to the local clock."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.frames._clocks import DeviceClock


@given(
    st.floats(-3e-4, 3e-4),
    st.floats(0, 1e6),
    st.integers(0, 1000),
    st.sampled_from([5.0, 30.0, 120.0]),
)
def test_drift_and_moment_are_found_with_any_delay(
    drift: float, ahead: float, seed: int, rate: float
) -> None:
    chance, clock = random.Random(seed), DeviceClock()  # noqa: S311
    for number in range(int(60 * rate)):
        taken = 1000 + number / rate
        way = 0.002 + (chance.expovariate(500) if chance.random() < 0.9 else 0.2 * chance.random())
        found = clock.host_time(ahead + taken * (1 + drift), taken + way)
        assert found <= taken + way
        if number > 20 * rate:
            assert found - taken == pytest.approx(0.002, abs=0.0015)
    statistics = clock.statistics()
    assert statistics.jumps == 0
    assert statistics.drift == pytest.approx(drift, abs=1e-4)


@pytest.mark.parametrize("by", [-100.0, -0.03, 0.2, 3600.0, -3600.0])
def test_reset_clock_is_noticed_and_followed(by: float) -> None:
    clock, jumped = DeviceClock(), 0.0
    for number in range(400):
        taken = number * 0.02
        jumped = by if number >= 200 else 0.0
        found = clock.host_time(50 + taken + jumped, taken + 0.004)
        if not 200 <= number < 210:
            assert found == pytest.approx(taken + 0.004)
        assert found <= taken + 0.004
    assert clock.statistics().jumps == 1


def test_frames_that_come_late_for_a_while_are_no_jump() -> None:
    clock = DeviceClock()
    for number in range(600):
        taken = number * 0.1
        way = 0.8 if 100 < number < 120 else 0.001
        assert clock.host_time(taken, taken + way) == pytest.approx(taken + 0.001, abs=1e-4)
    assert clock.statistics().jumps == 0


@pytest.mark.parametrize("queue", [1.5, 4.0, 20.0])
@pytest.mark.parametrize("seconds", [2, 15, 60])
def test_queue_on_the_way_is_no_reset_clock(queue: float, seconds: float) -> None:
    clock = DeviceClock()
    for number in range(int(10 * (seconds + 40))):
        taken = number * 0.1
        held = 0.0 if not 20 < taken < 20 + seconds else min(queue, taken - 20)
        found = clock.host_time(taken, taken + 0.001 + held)
        assert found <= taken + 0.001 + 0.01 * seconds  # never much later than the truth
        if taken > 21 + seconds:
            assert found == pytest.approx(taken + 0.001, abs=1e-3)
    assert clock.statistics().jumps == 0


def test_drift_is_unknown_before_there_are_enough_frames() -> None:
    clock = DeviceClock()
    for number in range(7):
        clock.host_time(number * 0.5, number * 0.5)
        assert clock.statistics().drift is None
