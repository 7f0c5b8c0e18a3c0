"""The manual clock and the real one."""

from __future__ import annotations

import asyncio

import pytest

from smartcam.emulator import ManualClock, RealClock
from smartcam.exceptions import ConfigurationError


def test_manual_clock_stands_still() -> None:
    clock = ManualClock()
    assert clock.now == 0.0
    clock.advance(0.0)
    assert clock.now == 0.0


def test_manual_clock_advance_calls_in_order_of_time() -> None:
    clock = ManualClock()
    seen: list[tuple[str, float]] = []
    clock.call_at(2.0, lambda: seen.append(("b", clock.now)))
    clock.call_at(1.0, lambda: seen.append(("a", clock.now)))
    clock.call_at(2.0, lambda: seen.append(("c", clock.now)))
    clock.call_at(9.0, lambda: seen.append(("never", clock.now)))
    clock.advance(3.0)
    assert seen == [("a", 1.0), ("b", 2.0), ("c", 2.0)]
    assert clock.now == 3.0


def test_manual_clock_advance_calls_what_was_set_inside_it() -> None:
    clock = ManualClock()
    seen: list[float] = []

    def again() -> None:
        seen.append(clock.now)
        clock.call_at(clock.now + 0.1, again)

    clock.call_at(0.1, again)
    clock.advance(1.0)
    assert seen == pytest.approx([0.1 * n for n in range(1, 11)], abs=1e-12)


def test_manual_clock_past_instant_is_called_at_the_next_advance() -> None:
    clock = ManualClock()
    clock.advance(5.0)
    seen: list[float] = []
    clock.call_at(1.0, lambda: seen.append(clock.now))
    clock.advance(0.0)
    assert seen == [5.0]


def test_manual_clock_cancelled_timer_is_not_called() -> None:
    clock = ManualClock()
    seen: list[int] = []
    timer = clock.call_at(1.0, lambda: seen.append(1))
    timer.cancel()
    timer.cancel()
    clock.advance(2.0)
    assert seen == []


@pytest.mark.parametrize("seconds", [-1.0, float("nan")])
def test_manual_clock_backwards_is_refused(seconds: float) -> None:
    with pytest.raises(ConfigurationError, match="the time goes forwards"):
        ManualClock().advance(seconds)


def test_manual_clock_advance_inside_advance_is_refused_and_it_works_on() -> None:
    clock = ManualClock()
    clock.call_at(1.0, lambda: clock.advance(1.0))
    with pytest.raises(ConfigurationError, match="inside advance"):
        clock.advance(2.0)
    assert clock.now == 1.0
    clock.advance(2.0)
    assert clock.now == 3.0


async def test_real_clock_is_the_loops() -> None:
    clock = RealClock()
    loop = asyncio.get_running_loop()
    assert abs(loop.time() - clock.now) < 1.0
    called = asyncio.Event()
    clock.call_at(clock.now, called.set)
    async with asyncio.timeout(5):
        await called.wait()
