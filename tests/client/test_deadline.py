"""The alarm, on an event loop whose time stands still until a test moves it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextvars import Context
from typing import TypeVarTuple

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from smartcam._client._inside import DeadlineTimer

Arguments = TypeVarTuple("Arguments")


class Loop(asyncio.SelectorEventLoop):
    """A loop of asyncio with a time of its own; counts the timers that are asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 1000.0
        self.timers: list[asyncio.TimerHandle] = []

    def time(self) -> float:
        return self.now

    def call_at(
        self,
        when: float,
        callback: Callable[[*Arguments], object],
        *args: *Arguments,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        timer = super().call_at(when, callback, *args, context=context)
        self.timers.append(timer)
        return timer

    def do(self, call: Callable[..., object], *arguments: object) -> None:
        self.call_soon(call, *arguments)
        self.turn()

    def turn(self) -> None:
        """Let the loop run once; timers that are due go off."""
        self.call_soon(self.stop)
        self.run_forever()

    def move_to(self, now: float) -> None:
        self.now = now
        for _ in range(3):  # a timer that is set for a moment that has passed
            self.turn()

    @property
    def waiting(self) -> list[float]:
        """The times at which the remaining timers go off."""
        return [one.when() for one in self.timers if not one.cancelled() and one.when() > self.now]


class Desk:
    """An alarm, its loop, and when it went off."""

    def __init__(self) -> None:
        self.loop = Loop()
        self.rung: list[float] = []
        self.alarm = DeadlineTimer(lambda: self.rung.append(self.loop.now))

    def set(self, deadline: float) -> None:
        self.loop.do(self.alarm.set, deadline)


@pytest.fixture
def desk() -> Iterator[Desk]:
    made = Desk()
    yield made
    made.loop.close()


def test_alarm_goes_off_once_at_its_deadline_and_not_before(desk: Desk) -> None:
    desk.set(1010)
    desk.loop.move_to(1009.9)
    assert desk.rung == []
    desk.loop.move_to(1010)
    desk.loop.move_to(1100)
    assert desk.rung == [1010]


def test_alarm_later_deadlines_share_a_timer(desk: Desk) -> None:
    for deadline in range(1010, 1020):
        desk.set(deadline)
        desk.alarm.clear()
    desk.set(1030)
    desk.set(1010)
    desk.set(1030)
    assert len(desk.loop.timers) == 1
    desk.loop.move_to(1029.9)
    assert (desk.rung, len(desk.loop.timers)) == ([], 2)
    desk.loop.move_to(1030)
    assert (desk.rung, len(desk.loop.timers)) == ([1030], 2)


def test_alarm_earlier_deadline_moves_the_timer(desk: Desk) -> None:
    desk.set(1030)
    desk.set(1010)
    assert desk.loop.waiting == [1010]
    desk.loop.move_to(1010)
    desk.loop.move_to(1030)
    assert desk.rung == [1010]


@pytest.mark.parametrize("passed", [1000, 999])
def test_alarm_deadline_that_has_passed_goes_off_in_the_loop_and_not_at_once(
    desk: Desk, passed: float
) -> None:
    def check() -> None:
        desk.alarm.set(passed)
        assert desk.rung == []

    desk.loop.do(check)
    desk.loop.turn()
    assert desk.rung == [1000]


def test_alarm_cleared_does_not_go_off_and_cancelled_leaves_nothing(desk: Desk) -> None:
    desk.set(1010)
    desk.alarm.clear()
    assert desk.loop.waiting == [1010]
    desk.alarm.cancel()
    desk.alarm.cancel()
    assert desk.loop.waiting == []
    desk.loop.move_to(1020)
    assert desk.rung == []
    desk.set(1030)
    desk.loop.move_to(1030)
    assert desk.rung == [1030]


def test_alarm_may_be_set_when_it_goes_off(desk: Desk) -> None:
    def again() -> None:
        desk.rung.append(desk.loop.now)
        if len(desk.rung) < 3:
            alarm.set(desk.loop.now + 10)

    alarm = DeadlineTimer(again)
    desk.loop.do(alarm.set, 1010)
    for now in range(1000, 1050, 5):
        desk.loop.move_to(now)
    assert desk.rung == [1010, 1020, 1030]
    assert desk.loop.waiting == []


class AlarmMachine(RuleBasedStateMachine):
    """Any order of deadlines: it goes off at the last that was set, and has one timer at most."""

    def __init__(self) -> None:
        super().__init__()
        self.desk = Desk()
        self.deadline: float | None = None
        self.expected: list[float] = []

    def teardown(self) -> None:
        self.desk.loop.close()

    @rule(after=st.integers(1, 9))
    def set(self, after: int) -> None:
        self.deadline = self.desk.loop.now + after
        self.desk.set(self.deadline)

    @rule()
    def clear(self) -> None:
        self.desk.alarm.clear()
        self.deadline = None

    @rule()
    def cancel(self) -> None:
        self.desk.alarm.cancel()
        self.deadline = None
        assert self.desk.loop.waiting == []

    @rule(by=st.integers(1, 9))
    def wait(self, by: int) -> None:
        now = self.desk.loop.now + by
        if self.deadline is not None and self.deadline <= now:
            self.expected.append(now)
            self.deadline = None
        self.desk.loop.move_to(now)

    @invariant()
    def it_is_as_expected(self) -> None:
        assert self.desk.rung == self.expected
        waiting = self.desk.loop.waiting
        assert len(waiting) <= 1
        assert self.deadline is None or waiting[0] <= self.deadline


TestAnyOrder = AlarmMachine.TestCase
