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


def shorten_switch_interval(owner: object, seconds: float) -> None:
    """Limit Python's switch interval, until :func:`restore_switch_interval`.

    Args:
        owner: any object that can be a dict's key; a new request replaces its last one.
        seconds: largest interval.
    """
    if not _requested:
        _original[:] = [sys.getswitchinterval()]
    _requested[owner] = seconds
    _apply()


def restore_switch_interval(owner: object) -> None:
    """End an object's request for a short interval. Harmless when called twice."""
    if _requested.pop(owner, None) is not None:
        _apply()


@contextmanager
def short_switch_interval(seconds: float) -> Iterator[None]:
    """Limit Python's switch interval within a block."""
    owner = object()
    shorten_switch_interval(owner, seconds)
    try:
        yield
    finally:
        restore_switch_interval(owner)


def _apply() -> None:
    """Set the shortest requested interval, even if other threads change the requests."""
    last_set = 0.0
    while last_set != (interval := min([*_requested.values(), *_original])):
        sys.setswitchinterval(interval + 5e-7)  # Python rounds down to whole microseconds
        last_set = interval
