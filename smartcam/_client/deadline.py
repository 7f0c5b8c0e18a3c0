"""A timer for deadlines that are set often and hardly ever reached.

A new timer of the event loop costs more than all other steps of a wait, and most timers are
cancelled soon. This timer is kept when a later deadline is set; if it fires before that deadline,
it is started again.
"""

from __future__ import annotations

import asyncio
import weakref
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

OwnerT = TypeVar("OwnerT")


class DeadlineTimer:
    """Calls a function at a deadline; there is one deadline at a time.

    Args:
        callback: function that is called in the event loop.
    """

    __slots__ = ("_callback", "_deadline", "_fires_at", "_timer")

    def __init__(self, callback: Callable[[], None]) -> None:
        self._callback = callback
        self._deadline: float | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._fires_at = 0.0  # loop time at which the timer fires

    def set(self, deadline: float) -> None:
        """Call the function at ``deadline`` (loop time), unless that is cleared or set again."""
        self._deadline = deadline
        if self._timer is not None and self._fires_at <= deadline:
            return
        self._stop_timer()
        self._start_timer(deadline)

    def clear(self) -> None:
        """Remove the deadline, so that the function is not called."""
        self._deadline = None

    def cancel(self) -> None:
        """Remove the deadline and the timer in the event loop."""
        self.clear()
        self._stop_timer()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _start_timer(self, fires_at: float) -> None:
        self._fires_at = fires_at
        self._timer = asyncio.get_running_loop().call_at(fires_at, self._on_timer)

    def _on_timer(self) -> None:
        fires_at, deadline = self._fires_at, self._deadline
        self._timer = None
        if deadline is None:
            return
        if deadline > fires_at:
            self._start_timer(deadline)
            return
        self._deadline = None
        self._callback()


def weak_callback(owner: OwnerT, function: Callable[[OwnerT], None]) -> Callable[[], None]:
    """Return a function that calls ``function`` with ``owner``, as long as the owner exists.

    The timer does not refer to its owner, which is therefore freed without the garbage collector.
    """
    reference = weakref.ref(owner)

    def call() -> None:
        living_owner = reference()
        if living_owner is not None:
            function(living_owner)

    return call
