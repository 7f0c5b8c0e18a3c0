"""Let Python's threads take turns more often while a part of the process requests it.

A thread that works in Python keeps the others waiting for the interpreter's switch interval, by
default 5 ms, and delays an event loop beside it by as much. The interval belongs to the process,
so all users of a shorter interval share this module. The shortest requested interval is set;
the original one is restored after the last request has ended.
"""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

_wanted: Final[dict[object, float]] = {}  # requested seconds, by the requesting object
_before: Final[list[float]] = []  # the original interval while a shorter one is set


def shorten_turns(owner: object, seconds: float) -> None:
    """Shorten turns to at most this length, until :func:`leave_turns`.

    Args:
        owner: any object that can be a key; it has one length at a time.
        seconds: length of a turn.
    """
    if not _wanted:
        _before[:] = [sys.getswitchinterval()]
    _wanted[owner] = seconds
    _apply()


def leave_turns(owner: object) -> None:
    """End an object's request for short turns. Harmless when called twice."""
    if _wanted.pop(owner, None) is not None:
        _apply()


@contextmanager
def short_turns(seconds: float) -> Iterator[None]:
    """Shorten turns to at most this length within a block."""
    owner = object()
    shorten_turns(owner, seconds)
    try:
        yield
    finally:
        leave_turns(owner)


def _apply() -> None:
    """Set the shortest requested interval, even if other threads change the requests."""
    set_to = 0.0
    while set_to != (interval := min([*_wanted.values(), *_before])):
        sys.setswitchinterval(interval + 5e-7)  # Python cuts off to whole microseconds
        set_to = interval
