"""Model the device's calendar clock and its queue of input data."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Mapping

LOST_CLOCK = datetime(1970, 1, 1, tzinfo=UTC)
"""Time that the clock shows after a restart: a related camera's manual says that it is lost; the
value is inferred.

The camera's clock has no time zone; UTC stands here because our times need one.
"""

_UNITS = ("year", "month", "day", "hour", "minute", "second")


@dataclass(eq=False)
class CalendarClock:
    """Year to second, without a time zone."""

    _time: datetime  # time that the clock showed when it was set
    _set_at: int  # the device's time then, nanoseconds

    def __post_init__(self) -> None:
        self._time = self._time.replace(tzinfo=UTC)

    def read(self, now: int) -> datetime:
        """Return the time that the clock shows; it stops at the end of the year 9999."""
        try:
            return self._time + timedelta(microseconds=(now - self._set_at) // 1000)
        except OverflowError:
            return datetime.max.replace(tzinfo=UTC)

    def set(self, message: m.SetClock, now: int) -> bool:
        """Set the clock; return False for a message that holds no valid time.

        Source: mvBlueGEMINI manual p. 30 (published): invalid values may be dropped or converted.
        """
        try:
            time = LOST_CLOCK.replace(**{name: getattr(message, name) for name in _UNITS})
        except (ValueError, OverflowError):
            return False
        self._time, self._set_at = time, now
        return True

    def answer(self, now: int, *, code: int = 0) -> m.ClockAnswer:
        """Return the time that the clock shows as a message."""
        time = self.read(now)
        return m.ClockAnswer(code=code, **{name: getattr(time, name) for name in _UNITS})


class InputQueue:
    """A queue of input containers, of which each inspection takes one.

    Source: SC manual p. 30 and p. 33 (published): with more containers than inspections one is
    dropped, with fewer one is reused. Which one is dropped, and how many are kept, is unknown.
    """

    def __init__(self, depth: int) -> None:
        self._depth = depth  # largest number of containers kept
        self._queue: deque[Mapping[str, Any]] = deque()
        self._last: Mapping[str, Any] | None = None

    def __len__(self) -> int:
        return len(self._queue)

    @property
    def was_given(self) -> bool:
        """True if there was a container since the last :meth:`clear`."""
        return bool(self._queue) or self._last is not None

    def put(self, values: Mapping[str, Any]) -> bool:
        """Queue a container; return False if the oldest one was dropped for it."""
        is_in_step = len(self._queue) < self._depth
        if not is_in_step:
            self._queue.popleft()
        self._queue.append(values)
        return is_in_step

    def take(self) -> tuple[Mapping[str, Any] | None, bool]:
        """Return the next container and True, or the last container again and False.

        None in place of a container means zeros: there was none yet.
        """
        is_in_step = bool(self._queue)
        if is_in_step:
            self._last = self._queue.popleft()
        return self._last, is_in_step

    def clear(self) -> None:
        """Forget all containers, including the last one."""
        self._queue.clear()
        self._last = None


@dataclass(slots=True)
class RunFaults:
    """The changes that faults make to one inspection."""

    delay: int = 0  # additional duration of the inspection, nanoseconds
    no_result: bool = False  # whether the inspection sends no container
    extra_copies: int = 0  # number of times that the container is sent again
