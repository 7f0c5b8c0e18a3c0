"""A timer for deadlines that are set all the time and hardly ever reached.

A timer of the event loop costs more than the rest of a wait, and most are cancelled at once. This
timer stays when a later deadline is set, and is set again only when it fires too soon.
"""

from __future__ import annotations

import asyncio
import weakref
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

OwnerT = TypeVar("OwnerT")


class DeadlineTimer:
    """Calls back at a deadline; one deadline at a time.

    Args:
        callback: function that is called in the event loop.
    """

    __slots__ = ("_at", "_callback", "_deadline", "_timer")

    def __init__(self, callback: Callable[[], None]) -> None:
        self._callback = callback
        self._deadline: float | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._at = 0.0  # loop time at which the timer fires

    def set(self, deadline: float) -> None:
        """Call back at ``deadline`` (loop time), unless it is cleared or set anew before."""
        self._deadline = deadline
        if self._timer is not None and self._at <= deadline:
            return
        self._stop_timer()
        self._start_timer(deadline)

    def clear(self) -> None:
        """Do not call back."""
        self._deadline = None

    def cancel(self) -> None:
        """Do not call back, and leave nothing in the event loop."""
        self.clear()
        self._stop_timer()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _start_timer(self, at: float) -> None:
        self._at = at
        self._timer = asyncio.get_running_loop().call_at(at, self._on_timer)

    def _on_timer(self) -> None:
        at, deadline = self._at, self._deadline
        self._timer = None
        if deadline is None:
            return
        if deadline > at:
            self._start_timer(deadline)
            return
        self._deadline = None
        self._callback()


def weak_callback(owner: OwnerT, function: Callable[[OwnerT], None]) -> Callable[[], None]:
    """Return a function that calls ``function`` with ``owner``, as long as the owner lives.

    An owner of a timer that called a method of it would be freed by the garbage collector only.
    """
    reference = weakref.ref(owner)

    def call() -> None:
        living = reference()
        if living is not None:
            function(living)

    return call
