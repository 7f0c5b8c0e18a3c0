"""Make Python switch between threads more often while a part of the process requests it.

A thread that works in Python makes the other threads, such as an event loop's, wait for the
interpreter's switch interval, by default 5 ms. The interval belongs to the process, so all who
request a shorter interval use this module. It sets the shortest requested interval, and restores
the original interval after the last request has ended.
"""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

_requested: Final[dict[object, float]] = {}  # requested seconds, by the requesting object
_original: Final[list[float]] = []  # the original interval while a shorter one is set


def shorten_turns(owner: object, seconds: float) -> None:
    """Limit the length of a thread's turns, until :func:`leave_turns`.

    Args:
        owner: any object that can be a dict's key; a new request replaces its last one.
        seconds: largest length of a turn.
    """
    if not _requested:
        _original[:] = [sys.getswitchinterval()]
    _requested[owner] = seconds
    _apply()


def leave_turns(owner: object) -> None:
    """End an object's request for short turns. Harmless when called twice."""
    if _requested.pop(owner, None) is not None:
        _apply()


@contextmanager
def short_turns(seconds: float) -> Iterator[None]:
    """Limit the length of a thread's turns within a block."""
    owner = object()
    shorten_turns(owner, seconds)
    try:
        yield
    finally:
        leave_turns(owner)


def _apply() -> None:
    """Set the shortest requested interval, even if other threads change the requests."""
    last_set = 0.0
    while last_set != (interval := min([*_requested.values(), *_original])):
        sys.setswitchinterval(interval + 5e-7)  # Python rounds down to whole microseconds
        last_set = interval
