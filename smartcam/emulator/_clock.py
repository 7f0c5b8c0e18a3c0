"""Clocks for emulated cameras: the real time, or a time that a test moves by hand."""

from __future__ import annotations

import asyncio
import heapq
import itertools
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from smartcam._arguments import check_callable, check_clock_seconds, check_seconds
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable

NANOSECONDS = 1_000_000_000
"""Number of nanoseconds in a second. Devices and the manual clock count whole nanoseconds, so that
sums of times do not depend on rounding."""


def nanoseconds(seconds: float) -> int:
    """Return seconds as whole nanoseconds."""
    return round(seconds * NANOSECONDS)


class TimerHandle(Protocol):
    """The timer that :meth:`Clock.call_at` returns."""

    def cancel(self) -> None:
        """Do not call the callback; this has no effect after the call."""
        ...


class Clock(ABC):
    """A source of time, in seconds from any origin, that calls functions at given times."""

    @property
    @abstractmethod
    def now(self) -> float:
        """The time, seconds."""

    @abstractmethod
    def call_at(self, when: float, callback: Callable[[], None]) -> TimerHandle:
        """Call ``callback`` once when the time reaches ``when``."""


class RealClock(Clock):
    """The running event loop's clock; usable inside a running loop only."""

    @property
    def now(self) -> float:
        """The loop's time, seconds."""
        return asyncio.get_running_loop().time()

    def call_at(self, when: float, callback: Callable[[], None]) -> TimerHandle:
        """Call ``callback`` by a timer of the loop."""
        return asyncio.get_running_loop().call_at(when, callback)


@dataclass(eq=False)
class OneTimer:
    """One timer of a clock, which is set again for each next event."""

    _clock: Clock
    _callback: Callable[[], None]  # called when the timer fires, which is then no longer set

    def __post_init__(self) -> None:
        self._handle: TimerHandle | None = None
        self._fires_at: int | None = None

    def set(self, when: int | None) -> None:
        """Set the timer to an instant, nanoseconds; None: cancel it."""
        if when == self._fires_at:
            return
        if self._handle is not None:
            self._handle.cancel()
        self._handle, self._fires_at = None, when
        if when is not None:
            self._handle = self._clock.call_at(when / NANOSECONDS, self._on_timer)

    def _on_timer(self) -> None:
        self._handle = self._fires_at = None
        self._callback()


@dataclass(slots=True, eq=False)
class _Timer:
    """A callback of a manual clock."""

    callback: Callable[[], None] | None

    def cancel(self) -> None:
        self.callback = None


class ManualClock(Clock):
    """A clock that stands still until :meth:`advance` moves it.

    One clock may serve several cameras; they move together.
    """

    def __init__(self) -> None:
        self._now = 0
        self._timers: list[tuple[int, int, _Timer]] = []
        self._numbers = itertools.count()
        self._advancing = False

    @property
    def now(self) -> float:
        """Seconds that the clock was moved so far."""
        return self._now / NANOSECONDS

    def call_at(self, when: float, callback: Callable[[], None]) -> TimerHandle:
        """Call ``callback`` inside the :meth:`advance` that reaches ``when``."""
        when = check_clock_seconds(when, "when", "clock")
        timer = _Timer(check_callable(callback, "callback", "clock"))
        entry = (nanoseconds(when), next(self._numbers), timer)
        heapq.heappush(self._timers, entry)
        return timer

    def advance(self, seconds: float) -> None:
        """Move the time, and run all events that depend on it.

        All events of the interval happen before this returns, in order of time, each
        at its own instant; messages that devices send are written to their sockets.
        Call it in the thread of the event loop.

        Args:
            seconds: time to move by; not negative.

        Raises:
            ConfigurationError: a negative time, or a call from inside another call.
        """
        seconds = check_seconds(seconds, "seconds", "clock")
        if self._advancing:
            raise ConfigurationError("clock: advance() was called inside advance()")
        target = self._now + nanoseconds(seconds)
        self._advancing = True
        try:
            while self._timers and self._timers[0][0] <= target:
                when, _, timer = heapq.heappop(self._timers)
                if timer.callback is not None:
                    self._now = max(self._now, when)
                    timer.callback()
            self._now = target
        finally:
            self._advancing = False
