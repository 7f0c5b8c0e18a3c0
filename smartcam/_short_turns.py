"""Let Python's threads take turns more often, as long as somebody in the process wants that.

A thread that works in Python keeps the others waiting for the interpreter's switch interval, by
default 5 ms, and an event loop beside it is as late as that. The interval belongs to the process,
so all who want a shorter one share this module: the shortest of the wanted ones holds, and the one
from before comes back when nobody wants one any more.
"""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

_wanted: Final[dict[object, float]] = {}  # seconds, by who wants them
_before: Final[list[float]] = []  # the one interval of a process in which nobody wants another


def shorten_turns(who: object, seconds: float) -> None:
    """Have turns of this length at most, until :func:`leave_turns`.

    Args:
        who: any object that can be a key; it wants one length at a time.
        seconds: length of a turn.
    """
    if not _wanted:
        _before[:] = [sys.getswitchinterval()]
    _wanted[who] = seconds
    _apply()


def leave_turns(who: object) -> None:
    """Want no short turns any more. Harmless when called twice."""
    if _wanted.pop(who, None) is not None:
        _apply()


@contextmanager
def short_turns(seconds: float) -> Iterator[None]:
    """Have turns of this length at most within a block."""
    who = object()
    shorten_turns(who, seconds)
    try:
        yield
    finally:
        leave_turns(who)


def _apply() -> None:
    """Set the interval that holds now, whatever other threads want meanwhile."""
    set_to = 0.0
    while set_to != (interval := min([*_wanted.values(), *_before])):
        sys.setswitchinterval(interval + 5e-7)  # Python cuts off to whole microseconds
        set_to = interval
